"""A rigid obstacle with Coulomb friction: the surface sticks until the shear stress reaches mu times the pressure.

mu is the friction coefficient. Every contact point has an elastic slip e [m] along the obstacle's surface, which is
stored from step to step. Within a step, the slip grows with the motion of the point relative to the obstacle. The
maximum slip is mu times the depth of the point in the obstacle. At the maximum slip the point slides. The shear stress
is `stiffness` times e, and the pressure is `stiffness` times the depth. So a sticking point moves by at most mu times
its depth, and does not creep. When a contact opens, its slip is set to 0.

The force has no energy, since sliding dissipates energy. The tangent is exact. It is not symmetric if points slide.

Source: Wriggers 2006, Computational Contact Mechanics, sections 5.2 and 6.4 (penalty, return mapping).
"""

from typing import Any, ClassVar, Self

import jax
import jax.numpy as jnp
import numpy as np

from liverjax.core.struct import Array, Content, Number, param, replace, struct
from liverjax.mesh.tetrahedra import TetMesh
from liverjax.physics.base import End, Start, Step
from liverjax.physics.contact.obstacle import (
    Obstacle,
    Touching,
    between_nodes,
    contact_points,
    distances,
    point_functions,
    shared_out,
    touching_nodes,
    weighted_stiffness,
)
from liverjax.solvers.attached import Attached


@struct
class RoughObstacle(Obstacle):
    """An obstacle with friction: it resists sliding along its surface."""

    friction: Number = param("1", "Coulomb's coefficient, mu", lower=0.0, upper=10.0, default=0.0)

    keys: ClassVar[tuple[str, ...]] = (*Obstacle.keys, "friction")
    conservative: ClassVar[bool] = False

    @classmethod
    def read(cls, mesh: TetMesh, table: Content, name: str) -> Self:
        """Read [[obstacle]] with a friction coefficient."""
        plain = super().read(mesh, table, name)
        return replace(plain, friction=table["friction"])

    def holds(self, mesh: TetMesh) -> tuple[np.ndarray, np.ndarray]:
        """Return the nodes of triangles that touch the obstacle at the beginning, and their constrained directions.

        All three directions are constrained. If the friction coefficient is 0, only the normal is constrained.
        """
        nodes, normals = super().holds(mesh)
        if not np.all(np.asarray(self.friction) > 0):
            return nodes, normals
        return np.tile(nodes, 3), np.repeat(np.eye(3), len(nodes), axis=0)

    def begin(self, start: Start) -> jax.Array:
        """Return the elastic slip at the beginning: zeros (3, Q, m) for Q contact points on each of m triangles."""
        return jnp.zeros_like(contact_points(self, start.mesh, start.x))

    def freeze(self, memory: Any, step: Step) -> "Rubbing":
        """Return the force term of a step.

        It stores the slip and the contact points (relative to the obstacle) at the beginning of the step.
        """
        plain = super().freeze(memory, step)
        moved = plain.moved
        # In a static run the first positions are only a guess, so slip is measured from the reference shape.
        x = step.x if step.inertia else jnp.where(step.k == 1, step.mesh.points, step.x)
        past = contact_points(self, step.mesh, x) - moved[0][:, None, None]
        slip = jnp.zeros_like(past) if memory is None else memory
        return Rubbing(
            obstacle=plain.obstacle,
            at_end=plain.at_end,
            moved=moved,
            near=plain.near,
            reach=plain.reach,
            slip=slip,
            past=past,
            friction=self.friction,
            nodes=touching_nodes(self, step.mesh),
            functions=point_functions(step.mesh, step.x.dtype),
        )

    def advance(self, memory: jax.Array, acting: "Rubbing", end: End) -> jax.Array:
        """Return the elastic slip (3, Q, m) [m] of the contact points at the end of the step."""
        return acting.slip_at(acting.points(end.x), 1.0)


@struct
class Rubbing(Touching):
    """Force term of an obstacle with friction, for one step: Q contact points on each of m triangles with n nodes."""

    friction: Number = param("1", "mu", default=0.0)
    slip: Any = param("m", "elastic slip at the beginning of the step (3, Q, m)", default=None)
    past: jax.Array | None = param(
        "m", "contact points at the beginning of the step, relative to the obstacle (3, Q, m)", default=None
    )
    nodes: Array | None = param("1", "nodes of the triangles (n, m)", default=None)
    functions: Array | None = param(
        "1", "shape functions of a triangle's nodes at its contact points (n, Q)", default=None
    )

    conservative: ClassVar[bool] = False  # type: ignore[misc]

    def points(self, x: jax.Array) -> jax.Array:
        """Return the positions (3, Q, m) [m] of the contact points, at nodal positions x (V, 3)."""
        return jnp.einsum("aq,ami->iqm", self.functions, x[self.nodes])

    def slip_at(self, at: jax.Array, s: Number) -> jax.Array:
        """Return the elastic slip (3, Q, m) [m] of contact points `at` (3, Q, m) [m], at fraction s of the step."""
        n, most = self._law(at, s)
        trial = self._trial(at, s, n)
        size = _of_slip(trial)
        return trial * jnp.where(size > most, most / size, 1.0)[None]

    def _law(self, at: jax.Array, s: Number) -> tuple[jax.Array, jax.Array]:
        """Return the normals (3, Q, m) of the obstacle, and the maximum slip (Q, m) [m] at the current pressure."""
        d = distances(self.obstacle, at, self.now(s))
        return jnp.stack(d.normal), jnp.multiply(self.friction, jnp.maximum(-d.value, 0.0))

    def _trial(self, at: jax.Array, s: Number, n: jax.Array) -> jax.Array:
        """Return the slip (3, Q, m) [m] that results if all points stick, in the planes with normals n (3, Q, m)."""
        trial = self.slip + at - self.now(s)[:, None, None] - self.past
        return trial - n * jnp.sum(n * trial, axis=0, keepdims=True)

    def _guessed(self, at: jax.Array, s: Number) -> jax.Array:
        """Return a mask (1, 1, Q, m) of the points with friction that just touch the obstacle and are not inside it.

        In the tangent, such points count as pressed and sticking.
        """
        d = distances(self.obstacle, at, self.now(s))
        return (self.touches(d) & (d.value >= 0) & (self.friction > 0))[None, None]

    def force(self, mesh: TetMesh, x: jax.Array, s: Number) -> jax.Array:
        """Return the nodal forces (V, 3) [N] due to contact pressure and frictional shear, times -1."""
        shear = weighted_stiffness(self.obstacle, mesh)[None] * self.slip_at(self.points(x), s)
        return super().force(mesh, x, s) + shared_out(self.obstacle, mesh, x, shear)

    def attached(self, mesh: TetMesh, x: jax.Array, s: Number) -> Attached:
        """Return the stiffness: the complete derivative of the force with respect to the positions."""
        at, plain = self.points(x), super().attached(mesh, x, s)
        units = [jnp.zeros_like(at).at[j].set(1.0) for j in range(3)]
        H = jnp.stack([jax.jvp(lambda at: self.slip_at(at, s), (at,), (unit,))[1] for unit in units], axis=1)
        return self._with_shear(mesh, plain, jnp.where(self._guessed(at, s), _planes(self._law(at, s)[0]), H))

    def energy_from(self, mesh: TetMesh, x: jax.Array, start: jax.Array) -> jax.Array:
        """Return the energy [J] of the contact, plus an energy of the slip.

        Up to the maximum slip at `start`, the energy of the slip is half of stiffness times slip squared. Above the
        maximum slip this energy grows linearly.
        """
        one = jnp.ones((), x.dtype)
        n, most = self._law(self.points(start), one)
        size = _of_slip(self._trial(self.points(x), one, n))
        stored = jnp.where(size > most, most * (size - 0.5 * most), 0.5 * size * size)
        return self.energy(mesh, x) + jnp.sum(weighted_stiffness(self.obstacle, mesh) * stored)

    def definite(self, mesh: TetMesh, x: jax.Array, s: Number) -> Attached:
        """Return the second derivative of `energy_from` for `start` = x, without the change of the contact normals.

        A sliding point has no stiffness along its direction of sliding.
        """
        at, plain = self.points(x), super().definite(mesh, x, s)
        n, most = self._law(at, s)
        trial = self._trial(at, s, n)
        size = _of_slip(trial)
        slides, way = (size > most)[None, None], trial / size[None]
        H = _planes(n) - jnp.where(slides, way[:, None] * way[None], 0.0)
        H = jnp.where(slides, (most / size)[None, None], 1.0) * H
        return self._with_shear(mesh, plain, jnp.where(self._guessed(at, s), _planes(n), H))

    def _with_shear(self, mesh: TetMesh, plain: Attached, H: jax.Array) -> Attached:
        """Return the stiffness `plain` of the pressures plus that of the shear (`stiffness` times H (3, 3, Q, m))."""
        shear = weighted_stiffness(self.obstacle, mesh)[None, None] * H
        return Attached(plain.nodes, plain.blocks + between_nodes(mesh, shear))

    def product(self, mesh: TetMesh, x: jax.Array, s: Number, dx: jax.Array) -> jax.Array:
        """Return zeros, since `attached` already contains the complete derivative of the force."""
        return jnp.zeros_like(dx)


def _of_slip(trial: jax.Array) -> jax.Array:
    """Return the lengths (Q, m) [m] of slips (3, Q, m). Each length is at least 2e-103, in single precision 2e-13.

    The bound avoids a division by 0. With this bound, the lengths to the power -3, which occur in second derivatives,
    do not overflow.
    """
    least = float(jnp.finfo(trial.dtype).tiny) ** (2 / 3)
    return jnp.sqrt(jnp.maximum(jnp.sum(trial * trial, axis=0), least))


def _planes(n: jax.Array) -> jax.Array:
    """Return the projection tensors (3, 3, Q, m) onto planes with normals n (3, Q, m)."""
    return jnp.eye(3, dtype=n.dtype)[:, :, None, None] - n[:, None] * n[None]
