"""A rigid plate: nodes that rotate about an axis as one body. The angle or the torque is given as a function of time.

The plate has only two motions: the rotation, and the displacement along the axis if it is free. The unknowns of the
solver are still nodal vectors. The nodal field b = e x (x - c) / R represents the rotation. Here e is the direction of
the axis and c a point of the axis. x are the positions of the plate's nodes at the beginning of a step, and R^2 is the
sum of their squared distances from the axis. The nodal field a b, with a number a, represents a rotation by the angle a
/ R. The nodes move exactly on circles, so angles may be large.
"""

from collections.abc import Callable
from typing import Any, ClassVar, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from liverjax.core import bounds
from liverjax.core.errors import InputError
from liverjax.core.struct import Indices, Number, Numbers, param, replace, static, struct
from liverjax.mesh import selection
from liverjax.mesh.tetrahedra import TetMesh
from liverjax.physics.base import Free, NodalForce, Physics, Step


@struct
class RigidPlate(Physics):
    """Nodes that rotate about an axis as one body."""

    nodes: jax.Array = param("1", "node numbers (n,)", lower=0)
    turn: Number = param("rad or N m", "angle or torque: one number, or values (T,) of a history, linear in between")
    times: Numbers | None = param(
        "s",
        "increasing times of the history (T,); None: `turn` is constant (but a torque grows with load steps)",
        default=None,
    )
    axis: jax.Array = param("1", "direction of the axis (3,), of length 1", default=(0.0, 0.0, 1.0))
    centre: jax.Array = param("m", "a point of the axis (3,)", default=(0.0, 0.0, 0.0))
    by: str = static(default="angle", about="what is given: angle or torque", words=("angle", "torque"))
    lifts: bool = static(default=False, about="whether the plate can move freely along the axis")
    still: Indices | None = param(
        "1", "numbers (m,) of cubic shape functions between the nodes; their unknowns stay 0", default=None
    )

    section: ClassVar[str] = "plate"
    ties: ClassVar[bool] = True

    def check(self, mesh: TetMesh, name: str) -> None:
        """Raise InputError for wrong node numbers, a wrong axis or a wrong history."""
        numbers, turn = np.asarray(self.nodes), np.asarray(self.turn)
        times = np.zeros(()) if self.times is None else np.asarray(self.times)
        selection.check_nodes(numbers, mesh.number_of_nodes, f"{name}.nodes", once=True)
        if numbers.size < 2:
            raise InputError(f"{name} has fewer than two nodes: give two nodes or more")
        bounds.check_shape(f"{name}.axis", self.axis, (3,))
        bounds.check_shape(f"{name}.centre", self.centre, (3,))
        if abs(np.linalg.norm(np.asarray(self.axis)) - 1) > 1e-6:
            raise InputError(
                f"{name} axis = {self.axis} must be of length 1: give such a vector, for example [0, 0, 1]"
            )
        if times.shape != turn.shape or (times.ndim and (np.diff(times) <= 0).any()):
            raise InputError(f"{name} needs ascending times and one value of turn for each time: correct the history")
        points = np.asarray(mesh.points)
        arms = np.cross(np.asarray(self.axis), points[numbers] - np.asarray(self.centre))
        if not np.abs(arms).max() > 1e-9 * np.ptp(points):
            raise InputError(f"{name} has only nodes on its axis: add other nodes, or move the centre")

    def at_rest(self, mesh: TetMesh) -> "Plate":
        """Return the nodes of the plate in their reference positions."""
        X, zero = mesh.points[self.nodes], jnp.zeros((), mesh.points.dtype)
        return Plate(self, X, X, zero, zero)

    def tied(self, step: Step) -> "Plate":
        """Return the nodes of the plate during a step, with the given angle or torque at its beginning and end."""
        before = after = jnp.asarray(self.turn)
        if self.times is None and self.by == "torque" and step.dt is None:
            # A torque grows with the load steps like other loads.
            before, after = (jnp.asarray(n / step.steps * after) for n in (step.k - 1, step.k))
        if self.times is not None:
            before, after = (jnp.interp(step.dt * n, jnp.asarray(self.times), after) for n in (step.k - 1, step.k))
        return Plate(self, step.mesh.points[self.nodes], step.x[self.nodes], before, after)

    def freeze(self, memory: None, step: Step) -> "Torque | None":
        """Return the force term of the torque for one step, or None if the angle is given (which adds no force)."""
        if self.by == "angle":
            return None
        return Torque(plate=self.tied(step))

    def enriched(self, mesh: TetMesh, more: Callable[[Any], Any]) -> "RigidPlate":
        """Return the plate with the nodes that the mesh of higher order adds between the nodes of the plate.

        In a cubic mesh, the added numbers belong to cubic shape functions, not to nodes with a position. In a rigid
        motion of the plate, the unknowns of these functions are 0.
        """
        nodes = more(self.nodes)
        return replace(self, nodes=nodes) if mesh.order < 3 else replace(self, still=nodes[len(self.nodes) :])

    def constrain(self, free: Free) -> Free:
        """Remove the unknowns of the cubic shape functions on the plate from the free directions. They stay 0."""
        return free if self.still is None else free._replace(mask=free.mask.at[self.still].set(0.0))

    def holds(self, mesh: TetMesh) -> tuple[np.ndarray, np.ndarray]:
        """Return pairs of nodes (n, 2) and their directions (n, 2, 3), for n constraints of the plate.

        The motion of each node is constrained in three directions: towards the axis, around the axis and along the
        axis. If the plate can move in one of these directions, only the motion relative to the node farthest from the
        axis is constrained.
        """
        # In float64, roundoff is too small to be mistaken for a constraint.
        nodes, axis, centre = np.asarray(self.nodes), np.asarray(self.axis, float), np.asarray(self.centre, float)
        arms = np.cross(axis, np.asarray(mesh.points, float)[nodes] - centre)
        radii, axis = np.linalg.norm(arms, axis=1), np.broadcast_to(axis, arms.shape)
        far = int(np.argmax(radii))
        some, ratio = arms[far] / radii[far], (radii / radii[far])[:, None]
        # For a node on the axis, any direction perpendicular to the axis can be used.
        around = np.where(ratio > 1e-9, arms / np.maximum(radii, 1e-300)[:, None], some)
        free = (0 * arms, ratio * some * (self.by == "torque"), axis * self.lifts)  # motions of the farthest node
        own = (np.cross(around, axis), around, axis)
        both = [np.stack([nodes, np.where(b.any(axis=1), nodes[far], nodes)], axis=1) for b in free]
        return np.concatenate(both), np.stack([np.concatenate(own), -np.concatenate(free)], axis=1)


class Plate(NamedTuple):
    """The n nodes of a plate during a step. Symbols: docstring of the module."""

    plate: RigidPlate
    reference: jax.Array  # (n, 3) [m] reference positions
    carrier: jax.Array  # (n, 3) [m] positions at the beginning of the step, which define the field b
    before: jax.Array  # angle [rad] or torque [N m] at the beginning of the step
    after: jax.Array  # angle or torque at the end of the step

    def arms(self, x: jax.Array) -> jax.Array:
        """Return the vectors e x (x - c) (n, 3) [m] of the plate's n nodes at positions x (V, 3) (axis e, centre c)."""
        return self._arms(x[self.plate.nodes])

    def _arms(self, x: jax.Array) -> jax.Array:
        return jnp.cross(self._axis(x)[None], x - jnp.asarray(self.plate.centre, x.dtype)[None])

    def _axis(self, like: jax.Array) -> jax.Array:
        return jnp.asarray(self.plate.axis, like.dtype)

    @property
    def radius(self) -> jax.Array:
        """Return R [m]: the square root of the sum of the squared distances of the nodes from the axis."""
        return jnp.linalg.norm(self._arms(self.reference))

    @property
    def linear(self) -> bool:
        """Whether positions are linear in the plate's unknowns: true if the angle is given, not the torque."""
        return self.plate.by == "angle"

    def angle(self, x: jax.Array) -> jax.Array:
        """Return the angle [rad] of the plate at positions x (V, 3), between -pi and pi."""
        e, (old, new) = self._axis(x), (self._arms(self.reference), self.arms(x))
        return jnp.arctan2(jnp.sum(jnp.cross(old, new) @ e), jnp.sum(old * new))

    def lift(self, x: jax.Array) -> jax.Array:
        """Return the displacement [m] of the plate along the axis at positions x (V, 3)."""
        return jnp.mean((x[self.plate.nodes] - self.reference) @ self._axis(x))

    def torque(self, x: jax.Array, f: jax.Array) -> jax.Array:
        """Return the moment [N m], about the axis, of the forces f (V, 3) [N] on the plate's nodes at x (V, 3)."""
        return jnp.sum(self.arms(x) * f[self.plate.nodes])

    def not_given(self, mask: jax.Array, axes: jax.Array | None) -> tuple[jax.Array, jax.Array | None]:
        """Return the mask and the free directions `axes` (both (V, 3)), changed if the angle of the plate is given.

        The mask is then 0 at the plate's nodes. If the plate can move along its axis, the returned `axes` contain the
        direction of this axis at these nodes.
        """
        if self.plate.by == "torque":
            return mask, axes
        nodes = self.plate.nodes
        if self.plate.lifts:
            axes = (jnp.zeros_like(mask) if axes is None else axes).at[nodes].set(self._axis(mask))
        return mask.at[nodes].set(0.0), axes

    def rigid(self, x: jax.Array, velocity: jax.Array, acceleration: jax.Array) -> tuple[jax.Array, jax.Array]:
        """Return velocity and acceleration (V, 3), with the values of a rigid motion at the plate's nodes.

        If Newmark's method were applied to each node separately, the acceleration towards the axis would be missing.
        The error would change sign in every step, and grow.
        """
        if self.plate.by == "angle":
            return velocity, acceleration
        nodes, axis, arms = self.plate.nodes, self._axis(x), self.arms(x)

        def motion(field: jax.Array) -> tuple[jax.Array, jax.Array]:
            lift = jnp.mean(field[nodes] @ axis) if self.plate.lifts else jnp.zeros((), x.dtype)
            return jnp.sum(arms * field[nodes]) / self.radius**2, lift * axis[None]

        (rate, lift), (growth, up) = motion(velocity), motion(acceleration)
        towards = rate**2 * jnp.cross(axis[None], arms)
        velocity = velocity.at[nodes].set(rate * arms + lift)
        return velocity, acceleration.at[nodes].set(growth * arms + towards + up)

    def spread(self, field: jax.Array, turn: Number, lift: Number) -> jax.Array:
        """Return `field` (V, 3) with new rows of the plate's nodes.

        These rows contain the sum of the plate's two motions, multiplied by the amplitudes `turn` and `lift`.
        """
        rows = turn * self._arms(self.carrier) / self.radius
        if self.plate.lifts:
            rows = rows + lift * self._axis(field)[None] / len(self.reference) ** 0.5
        return field.at[self.plate.nodes].set(rows)

    def amplitudes(self, field: jax.Array, arms: jax.Array) -> tuple[Number, Number]:
        """Return R times the rotation, and sqrt(n) times the axial displacement, of n plate nodes in a field (V, 3).

        If the angle is given, the first number is 0. `arms` (n, 3) are the vectors e x (x - c) of the nodes. R, e and
        c: docstring of the module.
        """
        rows = field[self.plate.nodes]
        turn = jnp.sum(arms * rows) / self.radius if self.plate.by == "torque" else 0.0
        return turn, jnp.sum(rows @ self._axis(field)) / len(self.reference) ** 0.5

    def gathered(self, field: jax.Array, x: jax.Array | None = None) -> jax.Array:
        """Project a field (V, 3) onto the plate's free motions. For a field of forces, x (V, 3) are the positions."""
        return self.spread(field, *self.amplitudes(field, self._arms(self.carrier) if x is None else self.arms(x)))

    def at(self, x: jax.Array) -> "Plate":
        """Return the plate with the directions of its motions at positions x (V, 3)."""
        return self._replace(carrier=x[self.plate.nodes])

    def turned(self, field: jax.Array, other: "Plate") -> jax.Array:
        """Return `field` (V, 3), changed such that the plate moves in the directions of `other` (same plate, moved)."""
        return other.spread(field, *self.amplitudes(field, self._arms(self.carrier)))

    def given(self, s: Number) -> jax.Array:
        """Return the given angle [rad] or torque [N m] at fraction s of the step."""
        return self.before + s * (self.after - self.before)

    def unknown(self, field: jax.Array, x: jax.Array) -> jax.Array:
        """Return `field` (V, 3) with the plate's unknowns for the positions x (V, 3), in the rows of its nodes."""
        turn = self.radius * self.angle(x) if self.plate.by == "torque" else 0.0
        return self.spread(field, turn, len(self.reference) ** 0.5 * self.lift(x))

    def placed(self, field: jax.Array, s: Number) -> jax.Array:
        """Return `field` (V, 3) with positions [m] at fraction s of the step instead of the plate's unknowns."""
        turn, lift = self.amplitudes(field, self._arms(self.carrier))
        angle = turn / self.radius if self.plate.by == "torque" else self.given(s)
        return self.moved(field, angle, lift / len(self.reference) ** 0.5)

    def moved(self, field: jax.Array, angle: Number, lift: Number) -> jax.Array:
        """Return `field` with the positions of the plate's nodes at an angle [rad] and an axial displacement [m]."""
        axis, arms = self._axis(field)[None], self._arms(self.reference)
        # Rodrigues' formula for a rotation by the angle a about the axis e: r = x - c changes by sin(a) e x r, plus
        # (cos(a) - 1) times the component of r perpendicular to e.
        rows = self.reference + jnp.sin(angle) * arms + (jnp.cos(angle) - 1) * jnp.cross(arms, axis)
        if self.plate.lifts:
            rows = rows + lift * axis
        return field.at[self.plate.nodes].set(rows)


@struct
class Torque(NodalForce):
    """Force term of the torque, for one step: forces on the plate's nodes, tangential to their circular paths."""

    plate: Plate = param("1", "its nodes")

    def force(self, mesh: TetMesh, x: jax.Array, s: Number) -> jax.Array:
        """Return the forces (V, 3) [N] on the nodes, times -1.

        The moment of the forces about the axis is the torque.
        """
        rows = -self.plate.given(s) * self.plate.arms(x) / self.plate.radius**2
        return jnp.zeros_like(x).at[self.plate.plate.nodes].set(rows)

    def energy(self, mesh: TetMesh, x: jax.Array) -> jax.Array:
        """Return the energy [J] at the end of the step: torque times angle, times -1."""
        return -self.plate.after * self.plate.angle(x)
