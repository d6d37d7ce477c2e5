"""An elastic support: springs between the body and a wall that does not move, on nodes or on a part of the surface.

Springs on a surface have a stiffness per area, one along the normal of the reference surface and one along the surface
(a Winkler foundation). They begin without tension. A history of factors changes their stiffness in time. A history of
displacements moves the wall, and the springs with it. Each node of a triangle has a third of it; in quadratic elements
the middles of its edges have these thirds.
"""

from typing import Any, ClassVar

import jax
import jax.numpy as jnp
import numpy as np

from liverjax.core import bounds, history
from liverjax.core.errors import InputError
from liverjax.core.struct import Content, Indices, Number, Numbers, param, struct
from liverjax.mesh import selection, surface
from liverjax.mesh.tetrahedra import TetMesh
from liverjax.physics.base import NodalForce, Physics, Step
from liverjax.solvers.block_matrix import Block


@struct
class ElasticSupport(Physics):
    """Springs on triangles of the surface (`normal`, `tangential`) or on nodes (`stiffness`)."""

    triangles: Any = param("1", "node numbers (m, 3)", lower=0, default=None)
    normal: Number = param("Pa/m", "stiffness per area along the normal", lower=0.0, default=0.0)
    tangential: Number = param("Pa/m", "stiffness per area along the surface", lower=0.0, default=0.0)
    nodes: Indices | None = param("1", "node numbers (n,)", lower=0, default=None)
    stiffness: Number = param("N/m", "of each node, in every direction", lower=0.0, default=0.0)
    times: Numbers | None = param("s", "times of a history (T,)", default=None)
    history: Numbers | None = param(
        "1", "factors of the stiffness (T,), or where the wall moves to (T, 3) [m]", default=None
    )

    section: ClassVar[str] = "support"
    keys: ClassVar[tuple[str, ...]] = ("where", "set", "normal", "tangential", "stiffness", "history")

    @classmethod
    def read(cls, mesh: TetMesh, table: Content, name: str) -> "ElasticSupport":
        """From [[support]]: a place, and stiffnesses."""
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
        triangles = selection.boundary_triangles(mesh, nodes)
        if not len(triangles):
            raise InputError(f"{name} where meets nodes but no boundary triangle: widen it to a whole face")
        return cls(triangles=jnp.asarray(triangles, jnp.int32), **given)

    def check(self, mesh: TetMesh, name: str) -> None:
        """Refuse wrong node numbers, a missing place, and a history that does not fit its times."""
        history.check(self.times, self.history, name)
        if (self.triangles is None) == (self.nodes is None):
            raise InputError(f"{name} needs either triangles or nodes: give one of them")
        if self.nodes is not None:
            selection.check_nodes(self.nodes, mesh.number_of_nodes, f"{name}.nodes")
            bounds.check_shape(f"{name}.stiffness", self.stiffness, (), np.shape(self.nodes))
        else:
            selection.check_triangles(mesh, self.triangles, f"{name}.triangles")
            for key in ("normal", "tangential"):
                bounds.check_shape(f"{name}.{key}", getattr(self, key), (), (len(self.triangles),))
        if self.history is not None and np.ndim(self.history) == 1:
            bounds.check_bound(f"{name} history", {"lower": 0.0}, self.history)

    def freeze(self, memory: None, step: Step) -> "Springs":
        """One symmetric block a node."""
        own = blocks(self, step.mesh)
        if self.history is None:
            return Springs(blocks=own)
        before, after = (history.entry_at(n * step.dt, self.times, self.history) for n in (step.k - 1, step.k))
        if after.ndim:
            return Springs(blocks=own, wall=jnp.stack([before, after]))
        return Springs(blocks=tuple(tuple(after * entry for entry in row) for row in own))

    def holds(self, mesh: TetMesh) -> tuple[np.ndarray, np.ndarray]:
        """Nodes are held along the axes in which their block has a stiffness."""
        K = np.moveaxis(np.array([[np.asarray(e) for e in row] for row in blocks(self, mesh)]), -1, 0)
        size, axes = np.linalg.eigh(K)
        node, axis = np.nonzero(size > 1e-9 * max(size.max(), 1e-300))
        return node, axes[node, :, axis]


def blocks(support: ElasticSupport, mesh: TetMesh) -> Block:
    """3 x 3 blocks of (V,) [N/m]."""
    zero = jnp.zeros(mesh.points.shape[0], mesh.points.dtype)
    if support.triangles is None:
        own = zero.at[support.nodes].add(support.stiffness)
        return tuple(tuple(own if r == c else zero for c in range(3)) for r in range(3))
    normal = surface.areas(mesh.points, support.triangles)
    area = jnp.sqrt(jnp.sum(normal * normal, axis=1))
    n = normal / area[:, None]

    def entry(r: int, c: int) -> jax.Array:
        along = support.tangential if r == c else 0.0
        whole = area * ((support.normal - support.tangential) * n[:, r] * n[:, c] + along)
        total = zero
        for nodes, part in surface.nodal_shares(mesh, support.triangles):
            total = total.at[nodes].add(part * whole)
        return total

    upper = {(r, c): entry(r, c) for r in range(3) for c in range(r, 3)}
    return tuple(tuple(upper[min(r, c), max(r, c)] for c in range(3)) for r in range(3))


@struct
class Springs(NodalForce):
    """Springs during a step."""

    blocks: Block = param("N/m", "3 x 3 of (V,)")
    wall: jax.Array | None = param(
        "m", "displacement of the wall at the beginning and at the end of the step (2, 3)", default=None
    )

    def _stretch(self, mesh: TetMesh, x: jax.Array, s: Number) -> jax.Array:
        """Stretch of the springs (V, 3) [m]."""
        if self.wall is None:
            return x - mesh.points
        return x - mesh.points - (self.wall[0] + s * (self.wall[1] - self.wall[0]))[None]

    def force(self, mesh: TetMesh, x: jax.Array, s: Number) -> jax.Array:
        """Blocks times displacement."""
        u = self._stretch(mesh, x, s).T
        return jnp.stack([sum(row[c] * u[c] for c in range(3)) for row in self.blocks], axis=-1)

    def energy(self, mesh: TetMesh, x: jax.Array) -> jax.Array:
        """Half of displacement times force."""
        return 0.5 * jnp.sum(self._stretch(mesh, x, 1.0) * self.force(mesh, x, 1.0))

    def stiffness(self) -> Block:
        """The blocks."""
        return self.blocks
