"""A rigid obstacle that the surface of the body cannot enter: a plane, a sphere, a cylinder or a cone.

Contact is tested at some points of every triangle (three in linear and quadratic meshes). At a point inside the
obstacle a pressure acts along the obstacle's normal, per reference area. It is `stiffness` times the depth of the
point. At points outside nothing acts, so the surface does not stick to the obstacle. There is no friction (see
`liverjax.physics.contact.friction`). The energy per area is half of pressure times depth. Its gradient and second
derivative are exact.

With this penalty the surface enters the obstacle by a depth of pressure over stiffness. By default the stiffness is
`HARDNESS` times the modulus of the body over the size of a triangle. At a pressure as large as this modulus, the depth
is then a hundredth of the triangle's size. `lj.obstacle_forces` returns the force and the maximum depth.

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
from liverjax.core.struct import Content, Indices, Number, Numbers, param, replace, static, struct
from liverjax.laws.base import Law
from liverjax.mesh import promotion, selection, surface
from liverjax.mesh.shape_functions import triangle_rule
from liverjax.mesh.tetrahedra import TetMesh
from liverjax.physics.base import NodalForce, Physics, Step
from liverjax.physics.contact.passage import in_body
from liverjax.physics.contact.shapes import SHAPES, Distance, distance
from liverjax.solvers.attached import Attached

#: Stiffness of the contact, over the stiffness of a layer of the body's material as thick as a triangle is wide.
HARDNESS = 100.0
#: A smaller distance, over the size of a triangle, counts as touching.
_TOUCHING = 1e-9
#: Contact points of a triangle: weights and barycentric coordinates (3, Q) of a rule of degree 2.
_POINTS = np.full(3, 1 / 3), np.full((3, 3), 1 / 6) + 0.5 * np.eye(3)


@struct
class Obstacle(Physics):
    """One rigid shape that does not move, moves by the vector `by` during the run, or follows a history."""

    triangles: Indices = param("1", "node numbers (m, 3) of the surface that may touch it", lower=0)
    shape: str = static(default="plane", about="plane, sphere, cylinder or cone", words=tuple(SHAPES))
    position: Numbers = param(
        "m", "point of the plane or of the cylinder's axis, sphere's centre, cone's tip (3,)", default=(0.0, 0.0, 0.0)
    )
    axis: Numbers = param(
        "1", "plane's normal to the free side; cylinder's axis; cone's, inwards (3,)", default=(0.0, 0.0, 1.0)
    )
    radius: Number = param("m", "of sphere and cylinder; of a cone's rounded tip", lower=0.0, default=0.0)
    half_angle: Number = param("deg", "of the cone, between axis and side", above=0.0, default=45.0)
    by: Numbers | None = param("m", "displacement (3,), reached at the last step", default=None)
    times: Numbers | None = param("s", "times of a history (T,)", default=None)
    history: Numbers | None = param("m", "displacements at these times (T, 3), or factors of by (T,)", default=None)
    stiffness: Any = param(
        "Pa/m", "pressure over depth, one number or one per triangle (m,); None: from the law", above=0.0, default=None
    )

    section: ClassVar[str] = "obstacle"
    #: Name of the field that is multiplied by the factors of a history.
    driven: ClassVar[str] = "by"
    keys: ClassVar[tuple[str, ...]] = (
        *("shape", "where", "set", "position", "axis", "radius", "half_angle", "by", "history", "stiffness"),
    )

    @classmethod
    def read(cls, mesh: TetMesh, table: Content, name: str) -> Self:
        """Read [[obstacle]]: a shape, its position and its numbers. By default the whole surface may touch it."""
        if "shape" not in table:
            raise InputError(f"{name} is without shape: give {', '.join(SHAPES)}")
        shape = as_word(table["shape"], f"{name} shape")
        if shape not in SHAPES:
            raise InputError(f"{name} shape = {shape!r} is not known: {hint(shape, SHAPES)}")
        for key in ("position", *SHAPES[shape]):
            if key not in table:
                raise InputError(f"{name} is a {shape} without {key}: give it")
        own = _numbers_of_shape(shape)
        for key in ("axis", "radius", "half_angle"):
            if key in table and key not in own:
                raise InputError(f"{name} is a {shape}, which has no {key}: leave it out")
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
        """Refuse numbers that do not define the shape, and triangles that are not in the mesh."""
        selection.check_triangles(mesh, self.triangles, f"{name}.triangles")
        for key in ("radius", "half_angle", "friction"):
            if np.ndim(getattr(self, key, 0.0)):
                raise InputError(f"{name}.{key} = {getattr(self, key)} must be one number: give one")
        for key in ("position", "axis", "by"):
            bounds.check_shape(f"{name}.{key}", getattr(self, key), (3,))
        bounds.check_shape(f"{name}.stiffness", self.stiffness, (), (len(self.triangles),))
        for key, idle in (("radius", 0.0), ("half_angle", 45.0)):
            if key not in _numbers_of_shape(self.shape) and np.any(np.asarray(getattr(self, key)) != idle):
                raise InputError(f"{name}.{key} = {getattr(self, key)} changes nothing: a {self.shape} has none")
        if "radius" in SHAPES[self.shape] and not np.all(np.asarray(self.radius) > 0):
            raise InputError(f"{name} radius = {self.radius} of a {self.shape} must be above 0: give it in m")
        if self.shape == "cone" and not np.all(np.asarray(self.half_angle) < 90):
            raise InputError(f"{name} half_angle = {self.half_angle} must be below 90 degrees: a plane has 90")
        if abs(np.linalg.norm(np.asarray(self.axis, float)) - 1) > 1e-6:
            raise InputError(f"{name} axis = {self.axis} must be of length 1: divide it by its length")
        history.check_times(self.times, self.history, name)
        if self.history is not None and np.ndim(self.history) == 2 and self.by is not None:
            raise InputError(f"{name} has by and a history of displacements: leave one of them out")
        if self.history is not None and np.ndim(self.history) == 1 and getattr(self, self.driven) is None:
            raise InputError(f"{name} history has factors, but there is no by to multiply with them: give by")

    def check_place(self, mesh: TetMesh, name: str) -> None:
        """Refuse an obstacle that begins inside the body."""
        size, deepest = float(np.ptp(np.asarray(mesh.points), axis=0).max()), float(_depth_at_beginning(self, mesh))
        if deepest > 1e-9 * size:
            raise InputError(
                f"{name} position = {np.asarray(self.position).tolist()} begins {deepest:.3g} m inside the body: move "
                "it out"
            )
        centre = np.asarray(self.position, float) + np.asarray(self.displacement(0, 1, 0.0))
        axis = np.asarray(self.axis, float)
        if in_body(self.shape, axis, mesh, np.asarray(mesh.points), centre[None], np.asarray(self.triangles)).any():
            raise InputError(f"{name} position = {np.asarray(self.position).tolist()} is inside the body: move it out")

    def holds(self, mesh: TetMesh) -> tuple[np.ndarray, np.ndarray]:
        """Nodes are held along the normal if their part of the surface touches the obstacle at the beginning."""
        d = _distances(self, mesh, mesh.points, self.displacement(0, 1, 0.0))
        near = np.asarray(d.value <= 1e3 * _TOUCHING * jnp.sqrt(_triangle_areas(self, mesh))[None])
        _, touching = np.nonzero(near)
        nodes = np.asarray(self.triangles)[touching]
        normals = np.stack([np.asarray(n)[near] for n in d.normal], axis=-1)
        return nodes.ravel(), np.repeat(normals, nodes.shape[1], axis=0)

    def in_body(self, mesh: TetMesh, law: Law) -> "Obstacle":
        """Take the default stiffness from the law.

        It is `HARDNESS` times the stiffness of a layer with the modulus K + 4/3 mu, with K limited to 3 mu.
        """
        if self.stiffness is not None:
            return self
        # Material under a contact can move sideways. With a large bulk modulus the contact would be stiffer than
        # needed.
        shear = law.shear_modulus()
        modulus = jnp.max(jnp.asarray(jnp.minimum(law.bulk_modulus(), 3 * shear) + 4 / 3 * shear))
        return replace(self, stiffness=HARDNESS * modulus / jnp.sqrt(_triangle_areas(self, mesh)))

    def at_beginning(self) -> "Obstacle":
        """The obstacle at time 0 of its history. Without a history it has not moved yet."""
        return replace(self, by=None) if self.history is None else self

    def enriched(self, mesh: TetMesh, more: Callable[[Indices], Indices]) -> "Obstacle":
        """The obstacle for the same triangles of the richer mesh."""
        return replace(self, triangles=promotion.with_faces(mesh, self.triangles))

    def displacement(self, k: Number, steps: int, dt: Number) -> jax.Array:
        """Displacement (3,) [m] at the end of step k; step 0 is the beginning of the run."""
        zero = jnp.zeros(3)
        if self.history is not None:
            return zero + history.value_at(self.by, k * dt, self.times, self.history)
        return zero if self.by is None else jnp.asarray(self.by) * (k / steps)

    def freeze(self, memory: None, step: Step) -> "Touching":
        """The obstacle, with its displacements at the beginning and at the end of the step."""
        dt = 0.0 if step.dt is None else step.dt
        moved = jnp.stack([self.displacement(n, step.steps, dt) for n in (step.k - 1, step.k)])
        # Newmark's method takes the force at the end only, doubled (`liverjax.physics.inertia`).
        own = replace(self, stiffness=2 * jnp.asarray(self.stiffness)) if step.averaged else self
        return Touching(obstacle=own, moved=moved.astype(step.x.dtype), at_end=step.averaged)


@struct
class Touching(NodalForce):
    """The obstacle during a step."""

    obstacle: Obstacle = param("1", "shape and stiffness")
    moved: jax.Array = param("m", "its displacement at the beginning and at the end (2, 3)")

    at_end: bool = static(default=False)  # type: ignore[misc]

    kinked: ClassVar[bool] = True

    def now(self, s: Number) -> jax.Array:
        """Its displacement (3,) [m] at fraction s of the step, if it does not depend on the body."""
        return self.moved[0] + s * (self.moved[1] - self.moved[0])

    def place(self, x: jax.Array, s: Number) -> jax.Array:
        """Its displacement (3,) [m] at positions x (V, 3) of the body and fraction s of the step."""
        return self.now(s)

    def force(self, mesh: TetMesh, x: jax.Array, s: Number) -> jax.Array:
        """Minus the forces of the pressures, distributed to the nodes of their triangles."""
        return self.force_at(mesh, x, self.place(x, s))

    def force_at(self, mesh: TetMesh, x: jax.Array, moved: jax.Array) -> jax.Array:
        """`force` with the obstacle displaced by `moved` (3,)."""
        return contact_force(self.obstacle, mesh, x, moved)

    def energy(self, mesh: TetMesh, x: jax.Array) -> jax.Array:
        """Half of stiffness times depth squared."""
        depth = jnp.minimum(_distances(self.obstacle, mesh, x, self.now(1.0)).value, 0.0)
        return 0.5 * jnp.sum(weighted_stiffness(self.obstacle, mesh) * depth**2)

    def attached(self, mesh: TetMesh, x: jax.Array, s: Number) -> Attached:
        """Second derivative of the energy: a part along the normal, and a part from the change of the normal."""
        d, k = _distances(self.obstacle, mesh, x, self.place(x, s)), weighted_stiffness(self.obstacle, mesh)
        depth = jnp.minimum(d.value, 0.0)
        # A surface that just touches counts as pressed: otherwise a body on a plane would have no support at first.
        inside = just_touching(self.obstacle, mesh, d).astype(x.dtype)
        H = jnp.stack(
            [
                jnp.stack([k * (inside * d.normal[i] * d.normal[j] + depth * d.bent[i][j]) for j in range(3)])
                for i in range(3)
            ]
        )
        return Attached(touching_nodes(self.obstacle, mesh), between_nodes(mesh, H))

    def definite(self, mesh: TetMesh, x: jax.Array, s: Number) -> Attached:
        """The stiffness along the normal only: the part from the change of the normal is never positive."""
        d, k = _distances(self.obstacle, mesh, x, self.place(x, s)), weighted_stiffness(self.obstacle, mesh)
        k = k * just_touching(self.obstacle, mesh, d).astype(x.dtype)
        H = jnp.stack([jnp.stack([k * a * b for b in d.normal]) for a in d.normal])
        return Attached(touching_nodes(self.obstacle, mesh), between_nodes(mesh, H))


def contact_force(obstacle: Obstacle, mesh: TetMesh, x: jax.Array, moved: jax.Array) -> jax.Array:
    """Gradient of the energy (V, 3) [N] at positions x (V, 3), with the obstacle displaced by `moved` (3,).

    It is the force of the nodes on the obstacle.
    """
    d = _distances(obstacle, mesh, x, moved)
    depth = depths(d, touching_distance(obstacle, mesh))
    push = weighted_stiffness(obstacle, mesh) * depth  # (Q, m), negative
    return shared_out(obstacle, mesh, x, jnp.stack([push * n for n in d.normal]))


def depths(d: Distance, near: jax.Array) -> jax.Array:
    """Distances (Q, m) [m] of points inside, 0 for other points.

    Points nearer than `near` (m,) count as pressed, as in the stiffness: `minimum` would have half the derivative at a
    point that just touches.
    """
    pressed = d.value - jax.lax.stop_gradient(jnp.maximum(d.value, 0.0))
    return jnp.where(d.value <= near[None], pressed, 0.0)


def shared_out(obstacle: Obstacle, mesh: TetMesh, x: jax.Array, pushes: jax.Array) -> jax.Array:
    """Distribute forces at points (3, Q, m) [N] to the nodes (V, 3)."""
    own = jnp.einsum("aq,iqm->ami", point_functions(mesh, x.dtype), pushes)
    return jnp.zeros_like(x).at[touching_nodes(obstacle, mesh)].add(own)


def between_nodes(mesh: TetMesh, H: jax.Array) -> jax.Array:
    """Stiffness (n, 3, n, 3, m) between nodes of triangles, from the stiffness H (3, 3, Q, m) [N/m] at their points."""
    N = point_functions(mesh, H.dtype)
    both = jnp.einsum("aq,bq->abq", N, N)
    return jnp.einsum("abq,ijqm->aibjm", both, H)


def largest_depth(obstacle: Obstacle, mesh: TetMesh, x: jax.Array, moved: jax.Array) -> jax.Array:
    """Maximum depth () [m] of the surface in the obstacle, at positions x (V, 3); 0 if all points are outside."""
    deepest = -jnp.min(_distances(obstacle, mesh, x, moved).value)
    return jnp.where(deepest >= 0, deepest, 0.0)  # `maximum` would have half the derivative at a point that touches


@jax.jit  # compiled, since the checks of a sweep call it for each row
def _depth_at_beginning(obstacle: Obstacle, mesh: TetMesh) -> jax.Array:
    """Depth () [m] of the obstacle in the body at the beginning of a run. A negative value is minus their distance."""
    return -jnp.min(_distances(obstacle, mesh, mesh.points, obstacle.displacement(0, 1, 0.0)).value)


def touching_nodes(obstacle: Obstacle, mesh: TetMesh) -> jax.Array:
    """Nodes (n, m) of the triangles: n = 3 or more for each."""
    return jnp.stack(surface.triangle_nodes(mesh, obstacle.triangles))


def point_functions(mesh: TetMesh, dtype: DTypeLike) -> jax.Array:
    """Shape functions of a triangle's nodes at its contact points (n, Q)."""
    return jnp.asarray(surface.triangle_functions(mesh, _rule(mesh)[1]), dtype)


def _rule(mesh: TetMesh) -> tuple[np.ndarray, np.ndarray]:
    """Weights and contact points of a triangle.

    A surface of order 3 has more than three: it could enter between three.
    """
    return triangle_rule() if mesh.order == 3 else _POINTS


def contact_points(obstacle: Obstacle, mesh: TetMesh, x: jax.Array) -> jax.Array:
    """Contact points of the triangles (3, Q, m) [m] at positions x (V, 3)."""
    return jnp.einsum("aq,ami->iqm", point_functions(mesh, x.dtype), x[touching_nodes(obstacle, mesh)])


def distances(obstacle: Obstacle, at: jax.Array, moved: jax.Array) -> Distance:
    """Distances of points (3, Q, m) [m] from the obstacle, which is displaced by `moved` (3,)."""
    place = jnp.asarray(obstacle.position, at.dtype) + moved
    axis, angle = jnp.asarray(obstacle.axis, at.dtype), jnp.deg2rad(jnp.asarray(obstacle.half_angle, at.dtype))
    y = [at[i] - place[i] for i in range(3)]
    return distance(obstacle.shape, y, [axis[0], axis[1], axis[2]], obstacle.radius, angle)


@partial(jax.jit, inline=True)
def _distances(obstacle: Obstacle, mesh: TetMesh, x: jax.Array, moved: jax.Array) -> Distance:
    """Distances of the contact points of the triangles (Q, m)."""
    return distances(obstacle, contact_points(obstacle, mesh, x), moved)


def just_touching(obstacle: Obstacle, mesh: TetMesh, d: Distance) -> jax.Array:
    """Whether points (Q, m) are inside, or near enough to count as touching."""
    return d.value <= touching_distance(obstacle, mesh)[None]


def touching_distance(obstacle: Obstacle, mesh: TetMesh) -> jax.Array:
    """Maximum distance (m,) [m] that counts as touching."""
    return _TOUCHING * jnp.sqrt(_triangle_areas(obstacle, mesh))


#: To find a depth between contact points: minimum and maximum number of intervals along the edge of a triangle.
_FEWEST, _MOST = 6, 24


def missed_depth(obstacle: Obstacle, mesh: TetMesh, x: jax.Array, moved: jax.Array) -> tuple[float, float]:
    """Depth [m] of a round obstacle in the body that the contact points miss; and its approach [m].

    The obstacle is displaced by `moved` (3,), and the body is at positions x (V, 3). The approach is the depth in the
    reference shape, or a tenth of the radius if the obstacle is outside of this shape.
    """

    def depth(y: jax.Array) -> float:
        return float(-jnp.min(distances(obstacle, near_points(obstacle, mesh, y), moved).value))

    seen = float(largest_depth(obstacle, mesh, x, moved))
    approach = depth(mesh.points)
    return max(depth(x) - seen, 0.0), approach if approach > 0 else 0.1 * _radius_and_width(obstacle, mesh)[0]


def near_points(obstacle: Obstacle, mesh: TetMesh, x: jax.Array) -> jax.Array:
    """Points of the triangles (3, Q, m) [m] at positions x (V, 3).

    Their spacing is below the radius, where possible.
    """
    radius, width = _radius_and_width(obstacle, mesh)
    n = int(np.clip(np.ceil(3 * width / radius), _FEWEST, _MOST))
    lattice = np.array([(i, j, n - i - j) for i in range(n + 1) for j in range(n + 1 - i)]).T / n
    functions = jnp.asarray(surface.triangle_functions(mesh, lattice), x.dtype)
    return jnp.einsum("aq,ami->iqm", functions, x[touching_nodes(obstacle, mesh)])


def _radius_and_width(obstacle: Obstacle, mesh: TetMesh) -> tuple[float, float]:
    """Radius of the obstacle [m] (at least a thousandth of the width), and width of the largest triangle [m]."""
    width = float(jnp.sqrt(jnp.max(_triangle_areas(obstacle, mesh))))
    return max(float(np.max(np.asarray(obstacle.radius))), 1e-3 * width), width


def touches_without_pressure(obstacle: Obstacle, mesh: TetMesh, x: jax.Array) -> bool:
    """Whether the surface at positions x (V, 3) touches the obstacle at its first position, but without pressure."""
    d = _distances(obstacle, mesh, x, obstacle.displacement(0, 1, 0.0))
    nothing = d.value >= -_TOUCHING * jnp.sqrt(_triangle_areas(obstacle, mesh))[None]
    return bool(just_touching(obstacle, mesh, d).any() & nothing.all())


@partial(jax.jit, inline=True)
def _triangle_areas(obstacle: Obstacle, mesh: TetMesh) -> jax.Array:
    """Areas (m,) [m^2] of the triangles in the reference shape."""
    normal = surface.areas(mesh.points, obstacle.triangles)
    return jnp.sqrt(jnp.sum(normal * normal, axis=1))


def weighted_stiffness(obstacle: Obstacle, mesh: TetMesh) -> jax.Array:
    """Stiffness times reference area of every point (Q, m) [N/m]."""
    whole = _triangle_areas(obstacle, mesh) * obstacle.stiffness
    return jnp.asarray(_rule(mesh)[0], whole.dtype)[:, None] * whole[None]


def three_numbers(value: object, name: str) -> jax.Array:
    """A vector (3,) of a scene file.

    Raises:
        InputError: the value is not three finite numbers.
    """
    vector = bounds.array_of(value)
    if vector is None or vector.shape != (3,):
        raise InputError(f"{name} = {value!r} must be three numbers: write [x, y, z]")
    return jnp.asarray(vector)


def _numbers_of_shape(shape: str) -> tuple[str, ...]:
    """Names of the numbers that a shape needs or may have."""
    return (*SHAPES[shape], "radius") if shape == "cone" else SHAPES[shape]
