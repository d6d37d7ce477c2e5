"""An elastic support: springs between the body and a rigid wall, at nodes or on a part of the surface.

Springs on a surface (a Winkler foundation) have two stiffnesses per area: one normal and one tangential to the
reference surface. In the reference shape the springs have no tension. A history of factors changes the stiffness of the
springs over time. A history of displacements moves the wall, and with it one end of the springs. In linear elements
each node of a triangle gets a third of the triangle's stiffness. In elements of higher order the springs are integrated
over the triangle.
"""

from collections.abc import Callable
from functools import partial
from typing import Any, ClassVar

import jax
import jax.numpy as jnp
import numpy as np

from liverjax.core import bounds, history
from liverjax.core.errors import InputError
from liverjax.core.struct import Content, Indices, Number, Numbers, param, replace, struct
from liverjax.mesh import promotion, selection, surface
from liverjax.mesh.shape_functions import triangle_rule
from liverjax.mesh.tetrahedra import TetMesh
from liverjax.physics.base import NodalForce, Physics, Step
from liverjax.solvers.attached import Attached
from liverjax.solvers.block_matrix import Block

#: Order of the elements -> degree of the integration rule on their triangles.
_DEGREE = {2: 4, 3: 5}


@struct
class ElasticSupport(Physics):
    """Springs on m triangles of the surface (`normal`, `tangential`), or on n nodes (`stiffness`)."""

    triangles: Any = param("1", "node numbers (m, 3)", lower=0, default=None)
    normal: Number = param("Pa/m", "stiffness per area along the normal", lower=0.0, default=0.0)
    tangential: Number = param("Pa/m", "stiffness per area along the surface", lower=0.0, default=0.0)
    nodes: Indices | None = param("1", "node numbers (n,)", lower=0, default=None)
    stiffness: Number = param("N/m", "stiffness of each node, equal in all directions", lower=0.0, default=0.0)
    times: Numbers | None = param("s", "times of a history (T,)", default=None)
    history: Numbers | None = param(
        "1", "factors (T,) that multiply the stiffness, or displacements of the wall (T, 3) [m]", default=None
    )

    section: ClassVar[str] = "support"
    keys: ClassVar[tuple[str, ...]] = ("where", "set", "normal", "tangential", "stiffness", "history")

    @classmethod
    def read(cls, mesh: TetMesh, table: Content, name: str) -> "ElasticSupport":
        """Read [[support]]: a set of nodes and the stiffnesses."""
        nodes = selection.select(mesh, table.get("where"), table.get("set"), f"{name} where")
        given: Content = {k: table[k] for k in ("normal", "tangential", "stiffness") if k in table}
        if ("stiffness" in given) == bool({"normal", "tangential"} & set(given)):
            raise InputError(
                f"{name} needs either normal and tangential in Pa/m, for springs on the surface, or stiffness in N/m, "
                "for springs on nodes: give one of them"
            )
        for key, value in given.items():
            bounds.check_one(f"{name}.{key}", value)
        if "history" in table:
            given["times"], given["history"] = history.read_history(table["history"], name)
        if "stiffness" in given:
            return cls(nodes=jnp.asarray(nodes, jnp.int32), **given)
        triangles = selection.surface_of(mesh, nodes, table.get("set"))
        if not len(triangles):
            raise InputError(
                f"{name}: the selected region contains nodes, but no triangle of the boundary: enlarge the region to a "
                "whole face"
            )
        return cls(triangles=jnp.asarray(triangles, jnp.int32), **given)

    def check(self, mesh: TetMesh, name: str) -> None:
        """Raise InputError for wrong or missing node numbers, wrong stiffnesses, or a wrong history."""
        history.check_times(self.times, self.history, name)
        if (self.triangles is None) == (self.nodes is None):
            raise InputError(f"{name} needs either triangles or nodes: give one of them")
        if self.nodes is not None:
            selection.check_nodes(self.nodes, mesh.number_of_nodes, f"{name}.nodes", once=True)
            bounds.check_shape(f"{name}.stiffness", self.stiffness, (), np.shape(self.nodes))
            _refuse_idle(self, ("normal", "tangential"), name, "for springs on nodes give stiffness in N/m")
        else:
            selection.check_triangles(mesh, self.triangles, f"{name}.triangles")
            for key in ("normal", "tangential"):
                bounds.check_shape(f"{name}.{key}", getattr(self, key), (), (len(self.triangles),))
            _refuse_idle(self, ("stiffness",), name, "for springs on a surface give normal and tangential in Pa/m")
        if self.history is not None and np.ndim(self.history) == 1:
            bounds.check_bound(f"{name} history", {"lower": 0.0}, self.history)

    def freeze(self, memory: None, step: Step) -> "Springs | Foundation":
        """Return the force term of the springs for one step, with one symmetric 3 x 3 stiffness matrix per node.

        On surfaces of elements of higher order, there is one stiffness matrix per integration point.
        """
        kind: Any = Foundation if self.triangles is not None and step.mesh.order > 1 else Springs
        own = point_blocks(self, step.mesh) if kind is Foundation else blocks(self, step.mesh)
        given = {"triangles": self.triangles} if kind is Foundation else {}
        if self.history is None:
            return kind(blocks=own, **given)
        before, after = (history.entry_at(n * step.dt, self.times, self.history) for n in (step.k - 1, step.k))
        if after.ndim:
            return kind(blocks=own, wall=jnp.stack([before, after]), **given)
        return kind(blocks=tuple(tuple(after * entry for entry in row) for row in own), **given)

    def pulls_single_nodes(self) -> bool:
        """Return whether the springs act at nodes. If not, they act on an area."""
        return self.triangles is None

    def enriched(self, mesh: TetMesh, more: Callable[[Indices], Indices]) -> "ElasticSupport":
        """Return the support on the same triangles or nodes, for the mesh with elements of higher order."""
        if self.triangles is None:
            return self
        return replace(self, triangles=promotion.with_faces(mesh, self.triangles))

    def holds(self, mesh: TetMesh) -> tuple[np.ndarray, np.ndarray]:
        """Return nodes (n,) and directions (n, 3): the principal axes of the springs that have a stiffness."""
        K = np.moveaxis(np.array([[np.asarray(e) for e in row] for row in blocks(self, mesh)]), -1, 0)
        size, axes = np.linalg.eigh(K)
        node, axis = np.nonzero(size > 1e-9 * max(size.max(), 1e-300))
        return node, axes[node, :, axis]


def _refuse_idle(support: ElasticSupport, keys: tuple[str, ...], name: str, instead: str) -> None:
    """Raise InputError if one of the stiffnesses `keys` is not 0.

    They belong to the other kind of springs, so they would have no effect.
    """
    for key in keys:
        if np.any(np.asarray(getattr(support, key)) != 0):
            raise InputError(f"{name}.{key} = {getattr(support, key)} has no effect: {instead}")


@partial(jax.jit, inline=True)
def blocks(support: ElasticSupport, mesh: TetMesh) -> Block:
    """Return the spring stiffness of the nodes: 3 x 3 blocks of arrays (V,) [N/m]."""
    zero = jnp.zeros(mesh.points.shape[0], mesh.points.dtype)
    if support.triangles is None:
        own = zero.at[support.nodes].add(support.stiffness)
        return tuple(tuple(own if r == c else zero for c in range(3)) for r in range(3))

    def shared(whole: jax.Array) -> jax.Array:
        total = zero
        for nodes, part in surface.nodal_shares(mesh, support.triangles):
            total = total.at[nodes].add(part * whole)
        return total

    return _each(support, mesh, shared)


def point_blocks(support: ElasticSupport, mesh: TetMesh) -> Block:
    """Return the spring stiffness at Q integration points of m triangles: 3 x 3 blocks of arrays (Q, m) [N/m]."""
    weights = triangle_rule(_DEGREE[mesh.order])[0]
    return _each(support, mesh, lambda whole: jnp.asarray(weights, whole.dtype)[:, None] * whole[None])


def _each(support: ElasticSupport, mesh: TetMesh, shared: Callable[[jax.Array], jax.Array]) -> Block:
    """Return the spring stiffness as 3 x 3 blocks of arrays.

    The function `shared` distributes stiffnesses (m,) [N/m] of m triangles to nodes or integration points.
    """
    normal = surface.areas(mesh.points, support.triangles)
    area = jnp.sqrt(jnp.sum(normal * normal, axis=1))
    n = normal / area[:, None]

    def entry(r: int, c: int) -> jax.Array:
        along = support.tangential if r == c else 0.0
        return shared(area * ((support.normal - support.tangential) * n[:, r] * n[:, c] + along))

    upper = {(r, c): entry(r, c) for r in range(3) for c in range(r, 3)}
    return tuple(tuple(upper[min(r, c), max(r, c)] for c in range(3)) for r in range(3))


@struct
class Springs(NodalForce):
    """Force term of springs at nodes, for one step."""

    blocks: Block = param("N/m", "3 x 3 blocks of arrays (V,)")
    wall: jax.Array | None = param(
        "m", "displacement of the wall at the beginning and at the end of the step (2, 3)", default=None
    )

    def _stretch(self, mesh: TetMesh, x: jax.Array, s: Number) -> jax.Array:
        """Return the elongation (V, 3) [m] of the springs, as a vector for each node."""
        if self.wall is None:
            return x - mesh.points
        return x - mesh.points - (self.wall[0] + s * (self.wall[1] - self.wall[0]))[None]

    def force(self, mesh: TetMesh, x: jax.Array, s: Number) -> jax.Array:
        """Return the nodal forces (V, 3) [N] (gradient of the energy): stiffness blocks times elongation."""
        u = self._stretch(mesh, x, s).T
        return jnp.stack([sum(row[c] * u[c] for c in range(3)) for row in self.blocks], axis=-1)

    def energy(self, mesh: TetMesh, x: jax.Array) -> jax.Array:
        """Return the energy [J] of the springs: half of elongation times force."""
        return 0.5 * jnp.sum(self._stretch(mesh, x, 1.0) * self.force(mesh, x, 1.0))

    def stiffness(self) -> Block:
        """Return the stiffness blocks (V,) [N/m] of the springs. They are constant during the step."""
        return self.blocks


@struct
class Foundation(NodalForce):
    """Force term of springs on m triangles, integrated with Q points per triangle, for one step."""

    triangles: Indices = param(
        "1", "node numbers (m, 3), or (m, 4) for elements of order 3 (`liverjax.mesh.promotion.with_faces`)"
    )
    blocks: Block = param("N/m", "3 x 3 blocks of arrays (Q, m)")
    wall: jax.Array | None = param(
        "m", "displacement of the wall at the beginning and at the end of the step (2, 3)", default=None
    )

    def _at_points(self, mesh: TetMesh, x: jax.Array, s: Number) -> tuple[jax.Array, jax.Array, jax.Array]:
        """Return node numbers (n, m), shape functions (n, Q), and the elongation (3, Q, m) [m] of the springs.

        There are m triangles with n nodes and Q integration points each.
        """
        nodes = jnp.stack(surface.triangle_nodes(mesh, self.triangles))
        N = jnp.asarray(surface.triangle_functions(mesh, triangle_rule(_DEGREE[mesh.order])[1]), x.dtype)
        u = jnp.einsum("aq,ami->iqm", N, (x - mesh.points)[nodes])
        if self.wall is not None:
            u = u - (self.wall[0] + s * (self.wall[1] - self.wall[0]))[:, None, None]
        return nodes, N, u

    def force(self, mesh: TetMesh, x: jax.Array, s: Number) -> jax.Array:
        """Return the nodal forces (V, 3) [N] (gradient of the energy), from the forces at the integration points."""
        nodes, N, u = self._at_points(mesh, x, s)
        own = jnp.stack([sum(row[c] * u[c] for c in range(3)) for row in self.blocks])
        return jnp.zeros_like(x).at[nodes].add(jnp.einsum("aq,iqm->ami", N, own))

    def energy(self, mesh: TetMesh, x: jax.Array) -> jax.Array:
        """Return the energy [J] of the springs: half of elongation times force."""
        u = self._at_points(mesh, x, 1.0)[2]
        return 0.5 * jnp.einsum("iqm,ijqm,jqm->", u, jnp.stack([jnp.stack(row) for row in self.blocks]), u)

    def attached(self, mesh: TetMesh, x: jax.Array, s: Number) -> Attached:
        """Return the stiffness between the nodes of each triangle: the second derivative of the energy."""
        nodes, N, _ = self._at_points(mesh, x, s)
        H = jnp.stack([jnp.stack(row) for row in self.blocks])
        return Attached(nodes, jnp.einsum("aq,bq,ijqm->aibjm", N, N, H))
