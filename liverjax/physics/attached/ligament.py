"""A ligament: a cable between two points of the body, or from a set of nodes to a point outside the body.

The tension at length l is k (l - l0), with the stiffness k and the rest length l0. The tension is 0 if the ligament is
slack, so a ligament pulls and does not push. The user gives l0, or the tension T0 in the reference shape. With the
length L in the reference shape, the rest length is l0 = L - T0/k. A ligament from n nodes to a point outside has n
fibres, which share stiffness and tension equally.
"""

from typing import Any, ClassVar

import jax
import jax.numpy as jnp
import numpy as np

from liverjax.core import bounds
from liverjax.core.errors import InputError
from liverjax.core.struct import Array, Content, Indices, Number, Numbers, param, struct
from liverjax.mesh import locate, selection
from liverjax.mesh.tetrahedra import TetMesh
from liverjax.physics.attached.elements import Elements
from liverjax.physics.base import Physics, Step

#: If a fibre is shorter than its rest length by at most this fraction, it is not slack: the difference is roundoff.
_ROUNDED = 1e-9


@struct
class Ligament(Physics):
    """A ligament of m fibres. Each fibre pulls at n nodes of the body, and may end at a point outside the body."""

    nodes: Indices = param("1", "node numbers (n, m)", lower=0)
    weights: Array = param(
        "1", "weights (n, m): the vector along a fibre is the sum of weights times positions (minus `to`)"
    )
    to: Numbers | None = param("m", "end of all fibres outside the body (3,); None: both ends inside", default=None)
    stiffness: Number = param("N/m", "total stiffness of all fibres", above=0.0)
    pre_tension: Number | None = param(
        "N", "total tension of all fibres in the reference shape", lower=0.0, default=None
    )
    rest_length: Any = param("m", "of each fibre", above=0.0, default=None)

    section: ClassVar[str] = "ligament"
    keys: ClassVar[tuple[str, ...]] = ("where", "set", "to", "points", "stiffness", "pre_tension", "rest_length")

    @classmethod
    def read(cls, mesh: TetMesh, table: Content, name: str) -> "Ligament":
        """Read [[ligament]]: a set of nodes and a point outside the body, or two points of the body."""
        if ("points" in table) == ("to" in table):
            raise InputError(
                f"{name} needs either to = [x, y, z] with where or set, or points = [[x, y, z], [x, y, z]]: give one "
                "of them"
            )
        if "stiffness" not in table:
            raise InputError(f"{name} needs stiffness in N/m: give a number")
        given = {key: table[key] for key in ("stiffness", "pre_tension", "rest_length") if key in table}
        for key, value in given.items():
            bounds.check_one(f"{name}.{key}", value)
        if "to" in table:
            to = jnp.asarray(_vector(table["to"], f"{name} to"))
            nodes = selection.select(mesh, table.get("where"), table.get("set"), f"{name} where")
            return cls(nodes=jnp.asarray(nodes[None], jnp.int32), weights=jnp.ones((1, len(nodes))), to=to, **given)
        if "where" in table or "set" in table:
            raise InputError(f"{name} has both points and a selection (where or set): remove one of them")
        ends = table["points"]
        if not isinstance(ends, list) or len(ends) != 2:
            raise InputError(f"{name} points = {ends!r} must be two points of the body: write [[x, y, z], [x, y, z]]")
        return between(mesh, np.array([_vector(end, f"{name} points") for end in ends]), name, **given)

    def check(self, mesh: TetMesh, name: str) -> None:
        """Raise InputError for wrong node numbers, a wrong rest length or tension, or fibres of length 0."""
        numbers = np.asarray(self.nodes)
        if numbers.ndim != 2:
            raise InputError(
                f"{name}.nodes has shape {numbers.shape}: give an array (n, m) with the nodes of a fibre in each column"
            )
        selection.check_nodes(numbers.ravel(), mesh.number_of_nodes, f"{name}.nodes")
        bounds.check_shape(f"{name}.weights", self.weights, numbers.shape)
        bounds.check_shape(f"{name}.to", self.to, (3,))
        sums, whole = np.asarray(self.weights).sum(axis=0), 0.0 if self.to is None else 1.0
        if np.any(np.abs(sums - whole) > 1e-6):
            raise InputError(f"{name}.weights of each fibre must add up to {whole:g}: correct the weights")
        if (self.pre_tension is None) == (self.rest_length is None):
            raise InputError(f"{name} needs either pre_tension in N or rest_length in m: give one of them")
        lengths, rest = map(np.asarray, _lengths_and_rest(self, mesh))
        if np.any(lengths <= 0):
            raise InputError(f"{name} has a fibre of length 0: move one of the ends of this fibre")
        if self.pre_tension is not None and np.any(rest <= 0):
            most = float(np.asarray(self.stiffness) * lengths.min())
            raise InputError(
                f"{name}.pre_tension = {self.pre_tension} N must be below {most:.3g} N: give a smaller tension"
            )

    def _vectors(self, x: jax.Array) -> jax.Array:
        """Return the vectors (m, 3) [m] from end to end of the m fibres, for nodal positions x (V, 3)."""
        f = jnp.einsum("am,ami->mi", jnp.asarray(self.weights), x[self.nodes])
        return f if self.to is None else f - jnp.asarray(self.to)[None]

    def _lengths(self, x: jax.Array) -> jax.Array:
        f = self._vectors(x)
        return jnp.sqrt(jnp.sum(f * f, axis=1))

    def _rest(self, mesh: TetMesh) -> jax.Array:
        """Return the rest lengths (m,) [m] of the m fibres."""
        L = self._lengths(mesh.points)
        return jnp.full_like(L, self.rest_length) if self.pre_tension is None else L - self.pre_tension / self.stiffness

    def freeze(self, memory: None, step: Step) -> "Fibres":
        """Return the force term of the fibres for one step."""
        rest = self._rest(step.mesh)
        return Fibres(at=self.nodes, weights=self.weights, to=self.to, rest=rest, spring=self.stiffness / len(rest))

    def holds(self, mesh: TetMesh) -> tuple[np.ndarray, np.ndarray]:
        """Return nodes (n,) and directions (n, 3) of the fibres to a point outside, if taut in the reference shape."""
        if self.to is None:
            return np.zeros(0, int), np.zeros((0, 3))
        lengths, rest = map(np.asarray, _lengths_and_rest(self, mesh))
        taut = lengths >= (1 - _ROUNDED) * rest
        f = np.asarray(self._vectors(mesh.points))[taut]
        return np.asarray(self.nodes)[0, taut], f / lengths[taut, None]

    def is_tight(self, mesh: TetMesh) -> bool:
        """Return whether a fibre is under tension in the reference shape; True if numbers are unknown (inside jit)."""
        if any(isinstance(leaf, jax.core.Tracer) for leaf in jax.tree.leaves((self, mesh.points))):
            return True
        with jax.ensure_compile_time_eval():  # inside jit, jnp would make tracers of the known numbers too
            lengths, rest = np.asarray(self._lengths(jnp.asarray(mesh.points))), np.asarray(self._rest(mesh))
        return bool(np.any(lengths > (1 + _ROUNDED) * rest))

    def pulls_single_nodes(self) -> bool:
        """Return True: at each end, a fibre pulls at one node or at the nodes of one element, not on an area."""
        return True

    def is_straight_without_tension(self, mesh: TetMesh, x: jax.Array) -> bool:
        """Return whether a fibre has its rest length, up to roundoff, at positions x (V, 3), so that its tension is 0.

        In a small vibration about x such a fibre would be slack half of the time.
        """
        lengths, rest = np.asarray(self._lengths(x)), np.asarray(self._rest(mesh))
        return bool(np.any(np.abs(lengths - rest) <= _ROUNDED * rest))


@jax.jit  # compiled, since the checks of a sweep call this function for each run
def _lengths_and_rest(ligament: Ligament, mesh: TetMesh) -> tuple[jax.Array, jax.Array]:
    """Return the lengths (m,) [m] of the m fibres in the reference shape, and their rest lengths (m,) [m]."""
    return ligament._lengths(mesh.points), ligament._rest(mesh)


def between(mesh: TetMesh, points: np.ndarray, name: str = "ligament", **given: Any) -> Ligament:
    """Create a ligament of one fibre between two points (2, 3) [m] of the body.

    Raises:
        InputError: a point lies outside the body.
    """
    nodes, values = locate.weights(mesh, *locate.elements_at(mesh, points, f"{name} points"))
    signed = values * np.array([[-1.0, 1.0]])
    both = np.concatenate([nodes[:, 0], nodes[:, 1]])[:, None]
    weights = np.concatenate([signed[:, 0], signed[:, 1]])[:, None]
    return Ligament(nodes=jnp.asarray(both, jnp.int32), weights=jnp.asarray(weights), **given)


def _vector(value: object, name: str) -> np.ndarray:
    for one in value if isinstance(value, (list, tuple)) else ():
        bounds.check_one(name, one)
    vector = bounds.array_of(value)
    if vector is None or vector.shape != (3,):
        raise InputError(f"{name} = {value!r} is not a point: give three numbers in m")
    return vector


@struct
class Fibres(Elements):
    """Force term of a ligament with m fibres, for one step. Each fibre pulls at n nodes."""

    at: Any = param("1", "node numbers (n, m)")
    weights: Array = param("1", "weights (n, m) of the nodes in the vector along the fibre")
    to: Any = param("m", "end outside the body (3,), or None")
    rest: Any = param("m", "rest lengths (m,)")
    spring: Any = param("N/m", "stiffness of one fibre")

    def nodes(self, mesh: TetMesh) -> jax.Array:
        """Return the numbers (n, m) of the n nodes at which each of the m fibres pulls."""
        return self.at

    def tangents(self, mesh: TetMesh) -> jax.Array:
        """Return the weights p (1, n, 1, m) of the n nodes of m fibres.

        The tangent vector goes from end to end of a fibre.
        """
        return jnp.asarray(self.weights)[None, :, None, :]

    def away(self) -> jax.Array | None:
        """Return the positions (1, 3, 1, m) [m] of the ends outside the body, or None if both ends are inside."""
        if self.to is None:
            return None
        return jnp.broadcast_to(jnp.asarray(self.to)[None, :, None, None], (1, 3, 1, len(self.rest)))

    def energies(self, mesh: TetMesh, C: tuple[jax.Array, ...]) -> jax.Array:
        """Return the energy [J] of each fibre: half of stiffness times elongation squared, or 0 for a slack fibre."""
        length, rest = jnp.sqrt(C[0]), self.rest[None]
        # A fibre at its rest length counts as taut. The function `maximum` would give half of the derivative there.
        longer = jnp.where(length >= (1 - _ROUNDED) * rest, length - rest, 0.0)
        return 0.5 * self.spring * longer * longer
