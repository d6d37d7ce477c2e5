"""A rigid obstacle that the surface of the body cannot enter: a plane, a sphere, a cylinder or a cone.

Contact is tested at some points of every surface triangle (three points in linear and quadratic meshes). At a point
inside the obstacle, a force per reference area (the pressure) acts along the obstacle's normal. The pressure is
`stiffness` times the depth of the point. No force acts at points outside, so the surface does not stick to the
obstacle. There is no friction (see `liverjax.physics.contact.friction`). The energy per area is half of pressure times
depth. The gradient and the second derivative of the energy are exact.

With this penalty method the surface enters the obstacle. The depth is the pressure divided by `stiffness`. By default
the stiffness is `HARDNESS` times the modulus of the element at a triangle, divided by the size of the triangle. If the
pressure is as large as this modulus, the depth is a hundredth of the triangle's size. `lj.obstacle_forces` returns the
force and the maximum depth.

Source: Wriggers 2006, Computational Contact Mechanics, chapters 5 and 6 (penalty, exact tangent).
"""

from collections.abc import Callable
from functools import partial
from typing import Any, ClassVar, Self

import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import DTypeLike

from liverjax.core import bounds, history
from liverjax.core.did_you_mean import as_word, hint
from liverjax.core.errors import InputError
from liverjax.core.struct import Array, Content, Indices, Number, Numbers, param, replace, static, struct
from liverjax.laws.base import Law
from liverjax.mesh import promotion, selection, surface
from liverjax.mesh.shape_functions import triangle_rule
from liverjax.mesh.tetrahedra import TetMesh
from liverjax.physics.base import NodalForce, Physics, Step
from liverjax.physics.contact.passage import in_body
from liverjax.physics.contact.shapes import SHAPES, Distance, distance
from liverjax.solvers.attached import Attached

#: Stiffness of the contact, divided by the stiffness of a layer of the body's material. The thickness of this layer is
#: the size of a triangle.
HARDNESS = 100.0
#: A point counts as touching if its distance, divided by the size of a triangle, is at most `_TOUCHING`. In the
#: reference shape, the limit is `_NEAR`: nodes of files in float32 have roundoff (see `reach_of_touch`).
_TOUCHING, _NEAR = 1e-9, 1e-6
#: Weights (Q,) and barycentric coordinates (3, Q) of Q = 3 contact points of a triangle (integration rule of degree 2).
_POINTS = np.full(3, 1 / 3), np.full((3, 3), 1 / 6) + 0.5 * np.eye(3)


@struct
class Obstacle(Physics):
    """A rigid obstacle. It is at rest, moves by the vector `by` during the run, or follows a history of T times."""

    triangles: Indices = param("1", "surface triangles that may touch the obstacle: node numbers (m, 3)", lower=0)
    shape: str = static(default="plane", about="plane, sphere, cylinder or cone", words=tuple(SHAPES))
    position: Numbers = param(
        "m", "point of plane or cylinder axis, centre of sphere, tip of cone (3,)", default=(0.0, 0.0, 0.0)
    )
    axis: Numbers = param(
        "1",
        "unit vector (3,): outward normal of a plane, axis of a cylinder, or inward axis of a cone",
        default=(0.0, 0.0, 1.0),
    )
    radius: Number = param(
        "m", "radius of sphere, cylinder or the rounded tip of a cone", lower=0.0, default=0.0, typical=0.01
    )
    half_angle: Number = param("deg", "angle between axis and side of a cone", above=0.0, default=45.0)
    by: Numbers | None = param("m", "displacement (3,), reached at the last step", default=None)
    times: Numbers | None = param("s", "times of a history (T,)", default=None)
    history: Numbers | None = param(
        "m", "displacements at these times (T, 3), or factors (T,) that multiply `by`", default=None
    )
    stiffness: Any = param(
        "Pa/m", "pressure per depth, one number or one per triangle (m,); None: default", above=0.0, default=None
    )

    section: ClassVar[str] = "obstacle"
    #: Name of the field that is multiplied by the factors of a history.
    driven: ClassVar[str] = "by"
    keys: ClassVar[tuple[str, ...]] = (
        *("shape", "where", "set", "position", "axis", "radius", "half_angle", "by", "history", "stiffness"),
    )

    @classmethod
    def read(cls, mesh: TetMesh, table: Content, name: str) -> Self:
        """Read [[obstacle]]: shape, position and dimensions. By default the whole surface may touch the obstacle."""
        if "shape" not in table:
            raise InputError(f"{name} has no shape: use one of {', '.join(SHAPES)}")
        shape = as_word(table["shape"], f"{name} shape")
        if shape not in SHAPES:
            raise InputError(f"{name} shape = {shape!r} is not known: {hint(shape, SHAPES)}")
        for key in ("position", *SHAPES[shape]):
            if key not in table:
                raise InputError(f"{name} is a {shape} without {key}: add this key")
        own = _numbers_of_shape(shape)
        for key in ("axis", "radius", "half_angle"):
            if key in table and key not in own:
                raise InputError(f"{name} is a {shape}, which has no {key}: remove this key")
        whole = "where" not in table and "set" not in table
        nodes = None if whole else selection.select(mesh, table.get("where"), table.get("set"), f"{name} where")
        triangles = selection.surface_of(mesh, nodes, table.get("set"))
        given: Content = {key: table[key] for key in ("radius", "half_angle", "stiffness") if key in table}
        given |= {k: three_numbers(table[k], f"{name} {k}") for k in ("position", "axis", "by") if k in table}
        if "axis" in given:
            given["axis"] = given["axis"] / max(float(jnp.linalg.norm(given["axis"])), 1e-300)
        if "history" in table:
            given["times"], given["history"] = history.read_history(table["history"], name)
        return cls(triangles=jnp.asarray(triangles, jnp.int32), shape=shape, **given)

    def check(self, mesh: TetMesh, name: str) -> None:
        """Raise InputError if a value is wrong or contradicts another value, or if triangles are not in the mesh."""
        selection.check_triangles(mesh, self.triangles, f"{name}.triangles")
        for key in ("radius", "half_angle", "friction"):
            if np.ndim(getattr(self, key, 0.0)):
                raise InputError(f"{name}.{key} = {getattr(self, key)} must be one number: give a single number")
        for key in ("position", "axis", "by"):
            bounds.check_shape(f"{name}.{key}", getattr(self, key), (3,))
        bounds.check_shape(f"{name}.stiffness", self.stiffness, (), (len(self.triangles),))
        for key, idle in (("radius", 0.0), ("half_angle", 45.0)):
            if key not in _numbers_of_shape(self.shape) and np.any(np.asarray(getattr(self, key)) != idle):
                raise InputError(
                    f"{name}.{key} = {getattr(self, key)} has no effect on a {self.shape}: remove this key"
                )
        if "radius" in SHAPES[self.shape] and not np.all(np.asarray(self.radius) > 0):
            raise InputError(f"{name} radius = {self.radius} of a {self.shape} must be above 0: give it in m")
        if self.shape == "cone" and not np.all(np.asarray(self.half_angle) < 90):
            raise InputError(
                f"{name} half_angle = {self.half_angle} must be below 90 degrees: use shape = 'plane' for 90"
            )
        if abs(np.linalg.norm(np.asarray(self.axis, float)) - 1) > 1e-6:
            raise InputError(
                f"{name} axis = {self.axis} must be of length 1: give such a vector, for example [0, 0, 1]"
            )
        history.check_times(self.times, self.history, name)
        if self.history is not None and np.ndim(self.history) == 2 and self.by is not None:
            raise InputError(f"{name} has both 'by' and a history of displacements: remove one of them")
        if self.history is not None and np.ndim(self.history) == 1 and getattr(self, self.driven) is None:
            raise InputError(
                f"{name} history contains factors that multiply the vector 'by', but 'by' is missing: give 'by'"
            )

    def check_place(self, mesh: TetMesh, name: str) -> None:
        """Raise InputError if the obstacle is inside the body at the beginning."""
        size, deepest = float(np.ptp(np.asarray(mesh.points), axis=0).max()), float(_depth_at_beginning(self, mesh))
        if deepest > 1e-9 * size:
            raise InputError(
                f"{name} position = {np.asarray(self.position).tolist()}: at the beginning, the obstacle overlaps "
                f"the body by {deepest:.3g} m; move the obstacle out of the body"
            )
        centre = np.asarray(self.position, float) + np.asarray(self.displacement(0, 1, 0.0))
        axis = np.asarray(self.axis, float)
        if in_body(self.shape, axis, mesh, np.asarray(mesh.points), centre[None], np.asarray(self.triangles)).any():
            raise InputError(
                f"{name} position = {np.asarray(self.position).tolist()} is inside the body: move the obstacle out of "
                "the body"
            )

    def holds(self, mesh: TetMesh) -> tuple[np.ndarray, np.ndarray]:
        """Return the nodes (n,) of triangles that touch the obstacle at the beginning, and the normals (n, 3) there."""
        d = _distances(self, mesh, mesh.points, self.displacement(0, 1, 0.0))
        near = np.asarray(d.value <= _NEAR * jnp.sqrt(_triangle_areas(self, mesh))[None])
        _, touching = np.nonzero(near)
        nodes = np.asarray(self.triangles)[touching]
        normals = np.stack([np.asarray(n)[near] for n in d.normal], axis=-1)
        return nodes.ravel(), np.repeat(normals, nodes.shape[1], axis=0)

    def in_body(self, mesh: TetMesh, law: Law) -> "Obstacle":
        """Return the obstacle with a default stiffness from the law, if the user gave no stiffness.

        The default is `HARDNESS` times the modulus K + 4/3 mu of the element at the triangle, divided by the square
        root of the area of the triangle. mu is the shear modulus. The bulk modulus K is limited to 3 mu.
        """
        if self.stiffness is not None:
            return self
        # Material under a contact can move sideways, so a large bulk modulus makes this material only slightly stiffer.
        # Without the limit 3 mu, the contact would be much stiffer than the material.
        shear = law.shear_modulus()
        modulus = jnp.asarray(jnp.minimum(law.bulk_modulus(), 3 * shear) + 4 / 3 * shear)
        if modulus.ndim:  # the largest modulus of each element, if it has several points
            modulus = jnp.max(jnp.atleast_2d(modulus), axis=0)[surface.elements_of_faces(mesh, self.triangles)]
        return replace(self, stiffness=HARDNESS * modulus / jnp.sqrt(_triangle_areas(self, mesh)))

    def at_beginning(self) -> "Obstacle":
        """Return the obstacle at time 0 of its history. Without a history, the obstacle is at its initial position."""
        return replace(self, by=None) if self.history is None else self

    def enriched(self, mesh: TetMesh, more: Callable[[Indices], Indices]) -> "Obstacle":
        """Return the obstacle with the same triangles, for the mesh with elements of higher order."""
        return replace(self, triangles=promotion.with_faces(mesh, self.triangles))

    def displacement(self, k: Number, steps: int, dt: Number) -> jax.Array:
        """Return the displacement (3,) [m] at the end of step k. Step 0 is the beginning of the run."""
        zero = jnp.zeros(3)
        if self.history is not None:
            return zero + history.value_at(self.by, k * dt, self.times, self.history)
        return zero if self.by is None else jnp.asarray(self.by) * (k / steps)

    def freeze(self, memory: None, step: Step) -> "Touching":
        """Return the force term of a step.

        It stores the obstacle's displacements at the beginning and at the end of the step.
        """
        dt = 0.0 if step.dt is None else step.dt
        moved = jnp.stack([self.displacement(n, step.steps, dt) for n in (step.k - 1, step.k)])
        # Newmark's method uses only the force at the end of the step, doubled (`liverjax.physics.inertia`).
        own = replace(self, stiffness=2 * jnp.asarray(self.stiffness)) if step.averaged else self
        return touching_term(own, step.mesh, moved.astype(step.x.dtype), step.averaged)


@struct
class Touching(NodalForce):
    """Force term of a rigid obstacle, for one step."""

    obstacle: Obstacle = param("1", "shape and stiffness")
    moved: jax.Array = param("m", "displacement at the beginning and at the end of the step (2, 3)")
    near: Array = param("m", "maximum distance of points that touch (m,)")
    reach: Array = param("m", "the same if the obstacle presses on no point (Q, m)")

    at_end: bool = static(default=False)  # type: ignore[misc]

    kinked: ClassVar[bool] = True

    def now(self, s: Number) -> jax.Array:
        """Return the prescribed displacement (3,) [m] of the obstacle at fraction s of the step."""
        return self.moved[0] + s * (self.moved[1] - self.moved[0])

    def place(self, x: jax.Array, s: Number) -> jax.Array:
        """Return the displacement (3,) [m] of the obstacle at fraction s of the step, with the body at x (V, 3)."""
        return self.now(s)

    def touches(self, d: Distance) -> jax.Array:
        """Return whether points (Q, m) with distances `d` are inside the obstacle, or near enough to count as touching.

        Points within their `reach` touch only if the obstacle presses on no point. Points that move away do not touch:
        a stiffness would make their motion in Newton's method very slow.
        """
        near = self.near[None]
        return (d.value <= near) | ((d.value <= self.reach) & jnp.all(d.value >= -near))

    def force(self, mesh: TetMesh, x: jax.Array, s: Number) -> jax.Array:
        """Return the contact forces (V, 3) [N] on the nodes, times -1 (the gradient of the contact energy)."""
        d = _distances(self.obstacle, mesh, x, self.place(x, s))
        depth = depths(d, self.touches(d))
        push = weighted_stiffness(self.obstacle, mesh) * depth  # (Q, m) [N] contact force at each point, times -1
        return shared_out(self.obstacle, mesh, x, jnp.stack([push * n for n in d.normal]))

    def energy(self, mesh: TetMesh, x: jax.Array) -> jax.Array:
        """Return the energy [J] of the contact: half of stiffness times depth squared."""
        depth = jnp.minimum(_distances(self.obstacle, mesh, x, self.now(1.0)).value, 0.0)
        return 0.5 * jnp.sum(weighted_stiffness(self.obstacle, mesh) * depth**2)

    def attached(self, mesh: TetMesh, x: jax.Array, s: Number) -> Attached:
        """Return the second derivative of the energy.

        One part acts along the normal. The other part is due to the change of the normal.
        """
        d, k = _distances(self.obstacle, mesh, x, self.place(x, s)), weighted_stiffness(self.obstacle, mesh)
        depth = jnp.minimum(d.value, 0.0)
        # A surface that just touches counts as pressed. Otherwise a body on a plane would have no support in the first
        # iteration.
        inside = self.touches(d).astype(x.dtype)
        H = jnp.stack(
            [
                jnp.stack([k * (inside * d.normal[i] * d.normal[j] + depth * d.bent[i][j]) for j in range(3)])
                for i in range(3)
            ]
        )
        return Attached(touching_nodes(self.obstacle, mesh), between_nodes(mesh, H))

    def definite(self, mesh: TetMesh, x: jax.Array, s: Number) -> Attached:
        """Return the stiffness along the normal.

        The part due to the change of the normal is omitted, since the eigenvalues of this part are never positive.
        """
        d, k = _distances(self.obstacle, mesh, x, self.place(x, s)), weighted_stiffness(self.obstacle, mesh)
        k = k * self.touches(d).astype(x.dtype)
        H = jnp.stack([jnp.stack([k * a * b for b in d.normal]) for a in d.normal])
        return Attached(touching_nodes(self.obstacle, mesh), between_nodes(mesh, H))


def touching_term(obstacle: Obstacle, mesh: TetMesh, moved: jax.Array, at_end: bool = False) -> Touching:
    """Return the force term of an obstacle that is displaced by `moved` (2, 3) [m] at both ends of a step."""
    near, far = touching_distance(obstacle, mesh), reach_of_touch(obstacle, mesh)
    return Touching(obstacle=obstacle, moved=moved, near=near, reach=far, at_end=at_end)


def depths(d: Distance, touching: jax.Array) -> jax.Array:
    """Return the signed distances (Q, m) [m] of points inside the obstacle (negative), and 0 for other points.

    Points of the mask `touching` (Q, m) count as pressed, so they have a stiffness. `jnp.minimum(d.value, 0)` is not
    used, because its derivative in JAX is only half of the correct value at a point that just touches.
    """
    pressed = d.value - jax.lax.stop_gradient(jnp.maximum(d.value, 0.0))
    return jnp.where(touching, pressed, 0.0)


def shared_out(obstacle: Obstacle, mesh: TetMesh, x: jax.Array, pushes: jax.Array) -> jax.Array:
    """Distribute forces (3, Q, m) [N] at Q points of m triangles to the nodes. Return the nodal forces (V, 3) [N]."""
    own = jnp.einsum("aq,iqm->ami", point_functions(mesh, x.dtype), pushes)
    return jnp.zeros_like(x).at[touching_nodes(obstacle, mesh)].add(own)


def between_nodes(mesh: TetMesh, H: jax.Array) -> jax.Array:
    """Return the stiffness (n, 3, n, 3, m) [N/m] between the n nodes of each of m triangles.

    H (3, 3, Q, m) is the stiffness at the Q contact points of each triangle.
    """
    N = point_functions(mesh, H.dtype)
    both = jnp.einsum("aq,bq->abq", N, N)
    return jnp.einsum("abq,ijqm->aibjm", both, H)


def largest_depth(obstacle: Obstacle, mesh: TetMesh, x: jax.Array, moved: jax.Array) -> jax.Array:
    """Return the maximum depth () [m] of contact points in the obstacle at positions x; 0 if all are outside."""
    deepest = -jnp.min(_distances(obstacle, mesh, x, moved).value)
    return jnp.where(deepest >= 0, deepest, 0.0)  # at a point that touches, `maximum` gives half the derivative


@jax.jit  # compiled, since the checks of a sweep call this function for each run
def _depth_at_beginning(obstacle: Obstacle, mesh: TetMesh) -> jax.Array:
    """Return the depth () [m] of the surface in the obstacle at the beginning of a run.

    If body and obstacle do not touch, the result is negative: their distance, times -1.
    """
    return -jnp.min(_distances(obstacle, mesh, mesh.points, obstacle.displacement(0, 1, 0.0)).value)


def touching_nodes(obstacle: Obstacle, mesh: TetMesh) -> jax.Array:
    """Return the node numbers (n, m) of the m triangles, with n = 3 or more nodes per triangle."""
    return jnp.stack(surface.triangle_nodes(mesh, obstacle.triangles))


def point_functions(mesh: TetMesh, dtype: DTypeLike) -> jax.Array:
    """Return the shape functions (n, Q) of the n nodes of a triangle at its Q contact points."""
    return jnp.asarray(surface.triangle_functions(mesh, _rule(mesh)[1]), dtype)


def _rule(mesh: TetMesh) -> tuple[np.ndarray, np.ndarray]:
    """Return the weights (Q,) and barycentric coordinates (3, Q) of the Q contact points of a triangle.

    In elements of order 3, a triangle has more than three points. With only three points, an obstacle could enter the
    surface between them.
    """
    return triangle_rule() if mesh.order == 3 else _POINTS


def contact_points(obstacle: Obstacle, mesh: TetMesh, x: jax.Array) -> jax.Array:
    """Return the positions (3, Q, m) [m] of Q contact points on each of m triangles, for nodal positions x (V, 3)."""
    return jnp.einsum("aq,ami->iqm", point_functions(mesh, x.dtype), x[touching_nodes(obstacle, mesh)])


def distances(obstacle: Obstacle, at: jax.Array, moved: jax.Array) -> Distance:
    """Return the signed distances [m] from the obstacle of the points `at` (3, Q, m) [m].

    These are Q contact points on each of m triangles. The obstacle is displaced by `moved` (3,) [m].
    """
    place = jnp.asarray(obstacle.position, at.dtype) + moved
    axis, angle = jnp.asarray(obstacle.axis, at.dtype), jnp.deg2rad(jnp.asarray(obstacle.half_angle, at.dtype))
    y = [at[i] - place[i] for i in range(3)]
    return distance(obstacle.shape, y, [axis[0], axis[1], axis[2]], obstacle.radius, angle)


@partial(jax.jit, inline=True)
def _distances(obstacle: Obstacle, mesh: TetMesh, x: jax.Array, moved: jax.Array) -> Distance:
    """Return the signed distances (Q, m) [m] of the contact points from the obstacle, displaced by `moved` (3,) [m]."""
    return distances(obstacle, contact_points(obstacle, mesh, x), moved)


def touching_distance(obstacle: Obstacle, mesh: TetMesh) -> jax.Array:
    """Return the maximum distance (m,) [m] of a point that counts as touching, for each of m triangles."""
    return _TOUCHING * jnp.sqrt(_triangle_areas(obstacle, mesh))


def reach_of_touch(obstacle: Obstacle, mesh: TetMesh) -> jax.Array:
    """Return the maximum distances (Q, m) [m] at which points count as touching an obstacle that presses on no point.

    A body that lies on the obstacle may have a small gap, because of the roundoff of its nodes (see `_NEAR`). Points
    with such a gap in the reference shape touch despite the gap.
    """
    near = touching_distance(obstacle, mesh)[None]
    gap = _distances(obstacle, mesh, mesh.points, obstacle.displacement(0, 1, 0.0)).value
    return near + jnp.where((gap > 0) & (gap <= _NEAR / _TOUCHING * near), gap, 0.0)


#: Minimum and maximum number of intervals along the edge of a triangle in the search for a depth between contact
#: points.
_FEWEST, _MOST = 6, 24


def missed_depth(obstacle: Obstacle, mesh: TetMesh, x: jax.Array, moved: jax.Array) -> tuple[float, float]:
    """Return the depth [m] of a round obstacle between the contact points, and the approach [m] of the obstacle.

    The obstacle is displaced by `moved` (3,), and the body is at positions x (V, 3). The depth is the maximum depth on
    a fine grid, minus that at the contact points. The approach is the maximum depth of the displaced obstacle in the
    undeformed body. If the displaced obstacle would not touch the undeformed body, the approach is a tenth of the
    radius.
    """

    def depth(y: jax.Array) -> float:
        return float(-jnp.min(distances(obstacle, near_points(obstacle, mesh, y), moved).value))

    seen = float(largest_depth(obstacle, mesh, x, moved))
    approach = depth(mesh.points)
    return max(depth(x) - seen, 0.0), approach if approach > 0 else 0.1 * _radius_and_width(obstacle, mesh)[0]


def near_points(obstacle: Obstacle, mesh: TetMesh, x: jax.Array) -> jax.Array:
    """Return the positions (3, Q, m) [m] of Q points of a fine grid on each of m contact triangles.

    x (V, 3) are the nodal positions. If possible, the spacing of the points is below the radius of the obstacle.
    """
    radius, width = _radius_and_width(obstacle, mesh)
    n = int(np.clip(np.ceil(3 * width / radius), _FEWEST, _MOST))
    lattice = np.array([(i, j, n - i - j) for i in range(n + 1) for j in range(n + 1 - i)]).T / n
    functions = jnp.asarray(surface.triangle_functions(mesh, lattice), x.dtype)
    return jnp.einsum("aq,ami->iqm", functions, x[touching_nodes(obstacle, mesh)])


def _radius_and_width(obstacle: Obstacle, mesh: TetMesh) -> tuple[float, float]:
    """Return the radius [m] of the obstacle (at least a thousandth of the width), and the width [m].

    The width is the square root of the area of the largest triangle.
    """
    width = float(jnp.sqrt(jnp.max(_triangle_areas(obstacle, mesh))))
    return max(float(np.max(np.asarray(obstacle.radius))), 1e-3 * width), width


def touches_without_pressure(obstacle: Obstacle, mesh: TetMesh, x: jax.Array) -> bool:
    """Return whether the surface touches the obstacle without pressure.

    The obstacle is at its initial position, and x (V, 3) are the positions of the body.
    """
    d = _distances(obstacle, mesh, x, obstacle.displacement(0, 1, 0.0)).value
    return bool((d <= reach_of_touch(obstacle, mesh)).any() & (d >= -touching_distance(obstacle, mesh)[None]).all())


@partial(jax.jit, inline=True)
def _triangle_areas(obstacle: Obstacle, mesh: TetMesh) -> jax.Array:
    """Return the areas (m,) [m^2] of the m triangles in the reference shape."""
    normal = surface.areas(mesh.points, obstacle.triangles)
    return jnp.sqrt(jnp.sum(normal * normal, axis=1))


def weighted_stiffness(obstacle: Obstacle, mesh: TetMesh) -> jax.Array:
    """Return stiffness times reference area (Q, m) [N/m] for the Q contact points of each of m triangles."""
    whole = _triangle_areas(obstacle, mesh) * obstacle.stiffness
    return jnp.asarray(_rule(mesh)[0], whole.dtype)[:, None] * whole[None]


def three_numbers(value: object, name: str) -> jax.Array:
    """Convert a value of a scene file to a vector (3,).

    Raises:
        InputError: the value does not consist of three finite numbers.
    """
    vector = bounds.array_of(value)
    if vector is None or vector.shape != (3,):
        raise InputError(f"{name} = {value!r} must be three numbers: write [x, y, z]")
    return jnp.asarray(vector)


def _numbers_of_shape(shape: str) -> tuple[str, ...]:
    """Return the names of the dimensions that a shape must have or may have."""
    return (*SHAPES[shape], "radius") if shape == "cone" else SHAPES[shape]
