"""A rigid obstacle that a given force presses into the body, for example an indenter with a weight on it.

The obstacle moves only along the line of its force. The displacement t of the obstacle along this line follows
from the balance of forces,

    dE/dt(x, t) = F,

with the magnitude F of the force and the energy E of the contact at positions x. The elimination of t adds -h h^T /
E_tt to the stiffness of the contact, with h = d2E/dx dt and E_tt = d2E/dt2. This dense matrix of rank one is not
stored. Matrix-vector products add its effect, and a factorisation is corrected for it.
"""

from collections.abc import Callable, Mapping
from typing import Any, ClassVar, Self

import jax
import jax.numpy as jnp
import numpy as np

from liverjax.core import history
from liverjax.core.errors import InputError
from liverjax.core.struct import Number, Numbers, param, replace, struct
from liverjax.mesh.tetrahedra import TetMesh
from liverjax.physics.base import End, Start, Step
from liverjax.physics.contact.obstacle import (
    Obstacle,
    Touching,
    contact_points,
    depths,
    distances,
    near_points,
    point_functions,
    reach_of_touch,
    shared_out,
    three_numbers,
    touching_distance,
    touching_nodes,
    weighted_stiffness,
)
from liverjax.solvers.attached import GivesWay

#: Maximum number of steps in the search for the position of the obstacle.
_MOST_STEPS = 200


@struct
class PressedObstacle(Obstacle):
    """An obstacle that a given force presses into the body."""

    force: Numbers = param("N", "force on the obstacle (3,), reached at the last step", default=(0.0, 0.0, 0.0))

    keys: ClassVar[tuple[str, ...]] = (*(key for key in Obstacle.keys if key != "by"), "force")
    driven: ClassVar[str] = "force"

    @classmethod
    def read(cls, mesh: TetMesh, table: Mapping[str, object], name: str) -> Self:
        """Read [[obstacle]] with a force."""
        plain = super().read(mesh, {key: value for key, value in table.items() if key != "force"}, name)
        return replace(plain, force=three_numbers(table["force"], f"{name} force"))

    def check(self, mesh: TetMesh, name: str) -> None:
        """Raise InputError as `Obstacle.check` does, and for a missing force, a given motion or negative factors."""
        super().check(mesh, name)
        history.check_times(self.times, self.history, name, (1,))
        if self.history is not None and np.any(np.asarray(self.history) < 0):
            least = float(np.min(np.asarray(self.history)))
            raise InputError(
                f"{name} history contains the factor {least:g}, but the force of an obstacle can only press: give "
                "factors of 0 or more"
            )
        if self.by is not None:
            raise InputError(f"{name} has both 'force' and 'by': remove one of them")
        force = np.asarray(self.force, float)
        if force.shape != (3,) or not np.all(np.isfinite(force)) or not np.any(force):
            raise InputError(f"{name} force = {self.force} must be three numbers in N, not all 0: give a force")

    def check_place(self, mesh: TetMesh, name: str) -> None:
        """Raise InputError in the same cases as `Obstacle.check_place`, and also if the obstacle misses the body when
        the force moves it."""
        super().check_place(mesh, name)
        if not self._meets(mesh, contact_points):
            if self._meets(mesh, near_points):
                raise InputError(
                    f"{name} passes between the points at which contact is tested, because the triangles are too large "
                    "for the radius of the obstacle: refine the mesh there"
                )
            force = np.asarray(self.force, float).tolist()
            raise InputError(f"{name} force = {force} presses the obstacle past the body: change force or position")

    def _meets(self, mesh: TetMesh, points: Callable[..., jax.Array]) -> bool:
        """Return whether the obstacle reaches the surface at the given points when it moves along its force."""
        at = points(self, mesh, mesh.points)
        size = float(np.ptp(np.asarray(mesh.points), axis=0).max())
        travel = 0.0
        far = size + max(float(_gap_after(self, at, travel)), 0.0)
        for _ in range(_MOST_STEPS):
            gap = float(_gap_after(self, at, travel))
            if gap <= 1e-3 * size:
                return True
            travel += gap
            if travel > 2 * far:
                break
        return False

    def holds(self, mesh: TetMesh) -> tuple[np.ndarray, np.ndarray]:
        """Return no nodes: the obstacle can move, so it does not prevent rigid motions of the body."""
        return np.zeros(0, int), np.zeros((0, 3))

    def at_beginning(self) -> "PressedObstacle":
        """Return the obstacle under the force at time 0. If there is no history, this force is 0."""
        return self if self.history is not None else replace(self, times=jnp.zeros(1), history=jnp.zeros(1))

    def direction(self) -> jax.Array:
        """Return the direction (3,) of the force, a unit vector."""
        force = jnp.asarray(self.force, float)
        return force / jnp.linalg.norm(force)

    def load(self, k: Number, steps: int, dt: Number) -> jax.Array:
        """Return the magnitude () [N] of the force at the end of step k. Step 0 is the beginning of the run."""
        whole = jnp.linalg.norm(jnp.asarray(self.force, float))
        factor = k / steps if self.history is None else history.value_at(1.0, k * dt, self.times, self.history)
        # `maximum` would give half of the derivative at a factor of 0.
        return jnp.where(factor >= 0, whole * factor, 0.0)

    def displacement(self, k: Number, steps: int, dt: Number) -> jax.Array:
        """Return a zero vector (3,), since no motion is prescribed."""
        return jnp.zeros(3)

    def begin(self, start: Start) -> jax.Array:
        """Return the displacement () [m] along the force at the beginning of a run, which is 0."""
        return jnp.zeros((), start.x.dtype)

    @classmethod
    def acts_without_memory(cls) -> bool:
        """Return True, since the force may act already at the beginning of a run."""
        return True

    def freeze(self, memory: Any, step: Step) -> "Pressing":
        """Return the force term of a step.

        It stores the magnitudes of the force at the beginning and at the end of the step, and the displacement of the
        obstacle at the beginning.
        """
        dt, dtype = 0.0 if step.dt is None else step.dt, step.x.dtype
        load = jnp.stack([jnp.asarray(self.load(n, step.steps, dt), dtype) for n in (step.k - 1, step.k)])
        return Pressing(
            obstacle=self,
            moved=jnp.zeros((2, 3), dtype),
            load=load,
            direction=self.direction().astype(dtype),
            before=jnp.zeros((), dtype) if memory is None else memory,
            nodes=touching_nodes(self, step.mesh),
            functions=point_functions(step.mesh, dtype),
            hardness=weighted_stiffness(self, step.mesh),
            near=touching_distance(self, step.mesh),
            reach=reach_of_touch(self, step.mesh),
        )

    def advance(self, memory: jax.Array, acting: "Pressing", end: End) -> jax.Array:
        """Return the displacement () [m] along the force at the end of the step."""
        return acting.travel(acting.points(end.x), 1.0)


@jax.jit
def _gap_after(obstacle: PressedObstacle, at: jax.Array, travel: Number) -> jax.Array:
    """Return the minimum distance () [m] of points (3, Q, m) from the obstacle, moved by `travel` along its force."""
    return jnp.min(distances(obstacle, at, jnp.asarray(travel * obstacle.direction())).value)


@struct
class Pressing(Touching):
    """Force term of a pressed obstacle, for one step: Q contact points on each of m triangles with n nodes."""

    load: Any = param("N", "magnitude of the force at the beginning and at the end of the step (2,)", default=None)
    direction: Any = param("1", "direction of the force (3,)", default=None)
    before: Any = param("m", "displacement along the force at the beginning of the step ()", default=None)
    nodes: jax.Array | None = param("1", "nodes of the triangles (n, m)", default=None)
    functions: jax.Array | None = param(
        "1", "shape functions of a triangle's nodes at its contact points (n, Q)", default=None
    )
    hardness: Any = param("N/m", "contact stiffness times area, for each contact point (Q, m)", default=None)

    def points(self, x: jax.Array) -> jax.Array:
        """Return the positions (3, Q, m) [m] of the contact points, at nodal positions x (V, 3)."""
        return jnp.einsum("aq,ami->iqm", self.functions, x[self.nodes])

    def place(self, x: jax.Array, s: Number) -> jax.Array:
        """Return the displacement (3,) [m] of the obstacle, at positions x (V, 3) and fraction s of the step."""
        return self.travel(self.points(x), s) * self.direction

    def travel(self, at: jax.Array, s: Number) -> jax.Array:
        """Return the displacement () [m] of the obstacle along its force for which the contact balances this force.

        The result is NaN if no such displacement is found.
        """
        load = self.load[0] + s * (self.load[1] - self.load[0])
        found = self._found(*jax.lax.stop_gradient((at, load)))
        # Newton steps that begin at the solution do not change its value, but they give its derivatives: one step gives
        # the first derivative, two steps also give the second derivative.
        for _ in range(2):
            held, slope, _ = self._resistance(at, found)
            found = found + (load - held) / jnp.where(slope > 0, slope, 1.0)
        return found

    def _resistance(self, at: jax.Array, travel: jax.Array) -> tuple[jax.Array, jax.Array, jax.Array]:
        """Return the contact force [N], its derivative [N/m], and the minimum distance [m] of `at` from the obstacle.

        The obstacle is displaced by `travel` along its force. The contact force acts against this displacement, and the
        derivative is that with respect to `travel`. `at` are the contact points.
        """
        d = distances(self.obstacle, at, travel * self.direction)
        inside = self.touches(d)
        depth, inside = depths(d, inside), inside.astype(at.dtype)
        along = sum(n * t for n, t in zip(d.normal, self.direction, strict=True))
        bent = sum(self.direction[i] * d.bent[i][j] * self.direction[j] for i in range(3) for j in range(3))
        slope = self.hardness * (inside * along * along + depth * bent)
        return -jnp.sum(self.hardness * depth * along), jnp.sum(slope), jnp.min(d.value)

    def _found(self, at: jax.Array, load: jax.Array) -> jax.Array:
        """Find the displacement () [m] of the obstacle by Newton's method; NaN if none is found.

        The contact force grows with the displacement. A step of Newton's method is at most twice the maximum depth, or
        twice the lower bound `least` of this depth if this bound is larger.
        """
        own = jax.lax.stop_gradient(self)
        first = own._resistance(at, own.before)[0]
        # Positions have roundoff. So the forces balance only up to `hardness` times this roundoff.
        size = jnp.max(jnp.abs(at)) + jnp.max(jnp.abs(jnp.asarray(own.obstacle.position, at.dtype)))
        rounded = size * jnp.max(own.hardness)
        enough = float(jnp.finfo(at.dtype).eps) * (16 * jnp.maximum(load, first) + rounded)
        # `least` is a lower bound of the maximum depth: the depth that balances the force if all points have the same
        # depth.
        least = load / jnp.sum(own.hardness)

        def unfinished(c: tuple) -> jax.Array:
            _, held, steps = c
            return (abs(held - load) > enough) & (steps < _MOST_STEPS)

        def closer(c: tuple) -> tuple:
            travel, _, steps = c
            held, slope, gap = own._resistance(at, travel)
            newton = (load - held) / jnp.where(slope > 0, slope, 1.0)
            most = 2 * jnp.maximum(-gap, least)
            step = jnp.where((gap >= 0) & (load > 0), gap + least, jnp.clip(newton, -most, most))
            travel = travel + step
            return travel, own._resistance(at, travel)[0], steps + 1

        begin = (own.before, first, jnp.zeros((), jnp.int32))
        travel, held, _ = jax.lax.while_loop(unfinished, closer, begin)
        return jnp.where(abs(held - load) <= 1e3 * enough, travel, jnp.nan)

    def energy(self, mesh: TetMesh, x: jax.Array) -> jax.Array:
        """Return the energy [J] of the contact minus the work of the force."""
        at = self.points(x)
        travel = self.travel(at, 1.0)
        depth = jnp.minimum(distances(self.obstacle, at, travel * self.direction).value, 0.0)
        return 0.5 * jnp.sum(self.hardness * depth**2) - self.load[1] * travel

    def gives_way(self, mesh: TetMesh, x: jax.Array, s: Number, definite: bool) -> GivesWay:
        """Return the loss of stiffness due to the free displacement of the obstacle along its force.

        If `definite` is true, the change of the normals is ignored, as in `Touching.definite`.
        """
        at = self.points(x)
        d = distances(self.obstacle, at, self.travel(at, s) * self.direction)
        towards = sum(n * t for n, t in zip(d.normal, self.direction, strict=True))
        along = self.hardness * self.touches(d) * towards
        pushes = jnp.stack([along * n for n in d.normal])
        if not definite:
            depth = self.hardness * jnp.minimum(d.value, 0.0)
            pushes = pushes + depth[None] * jnp.einsum(
                "ijqm,j->iqm", jnp.stack([jnp.stack(r) for r in d.bent]), self.direction
            )
        size = jnp.einsum("i,iqm->", self.direction, pushes)
        return GivesWay(-shared_out(self.obstacle, mesh, x, pushes), jnp.where(size > 0, size, 1.0))
