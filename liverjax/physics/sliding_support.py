"""A sliding support: nodes in a plane part of the surface stay in this plane and move in it without friction."""

from collections.abc import Callable
from typing import Any, ClassVar

import jax.numpy as jnp
import numpy as np

from liverjax.core import bounds
from liverjax.core.errors import InputError
from liverjax.core.struct import Content, Indices, Numbers, param, replace, static, struct
from liverjax.mesh import selection
from liverjax.mesh.tetrahedra import TetMesh
from liverjax.physics.base import Free, Physics

#: Nodes count as coplanar if their distances from the plane, divided by the extent of the nodes, are at most this
#: value.
_FLAT = 1e-6


@struct
class SlidingSupport(Physics):
    """Nodes that do not move along the normal of a plane. The normal is a coordinate axis or any direction."""

    nodes: Indices = param("1", "node numbers (n,)", lower=0)
    normal: Numbers | None = param("1", "unit normal of the plane (3,); not used with an axis", default=None)
    axis: str = static(default="", about="x, y or z if the normal is that axis", words=("", *selection.AXES))

    section: ClassVar[str] = "support"
    keys: ClassVar[tuple[str, ...]] = ("where", "set", "sliding")

    @classmethod
    def read(cls, mesh: TetMesh, table: Content, name: str) -> "SlidingSupport":
        """Read [[support]] with `sliding = true`. The selected nodes define the plane."""
        if table["sliding"] is not True:
            raise InputError(
                f"{name} sliding = {table['sliding']!r} is not true: write sliding = true, or remove sliding"
            )
        nodes = selection.select(mesh, table.get("where"), table.get("set"), f"{name} where")
        return on_plane(mesh, nodes, name)

    def check(self, mesh: TetMesh, name: str) -> None:
        """Raise InputError for wrong node numbers, or for a normal that is missing or not of length 1."""
        selection.check_nodes(self.nodes, mesh.number_of_nodes, f"{name}.nodes")
        bounds.check_shape(f"{name}.normal", self.normal, (3,))
        if not self.axis and (self.normal is None or abs(np.linalg.norm(np.asarray(self.normal)) - 1) > 1e-6):
            raise InputError(
                f"{name} normal = {self.normal} must be of length 1: give such a vector, for example [0, 0, 1]"
            )

    def constrain(self, free: Free) -> Free:
        """Return the free directions, after the normal of the plane is removed from the directions of the nodes."""
        if self.axis:
            return free._replace(mask=free.mask.at[self.nodes, selection.AXES.index(self.axis)].set(0.0))
        normals = jnp.zeros_like(free.mask) if free.normals is None else free.normals
        normal = jnp.asarray(self.normal, free.mask.dtype)[None]
        # If a node is fixed along all axes in which the normal has a component, it is already fixed along the normal.
        loose = jnp.max(free.mask[self.nodes] * (jnp.abs(normal) > 1e-12), axis=1, keepdims=True)
        return free._replace(normals=normals.at[self.nodes].set(loose * normal))

    def enriched(self, mesh: TetMesh, more: Callable[[Any], Any]) -> "SlidingSupport":
        """Return the support with the nodes that the mesh of higher order adds between the nodes of the support."""
        return replace(self, nodes=more(self.nodes))

    def holds(self, mesh: TetMesh) -> tuple[np.ndarray, np.ndarray]:
        """Return the nodes (n,), and for each node the normal (n, 3) along which it is constrained."""
        nodes = np.asarray(self.nodes)
        normal = np.eye(3)[selection.AXES.index(self.axis)] if self.axis else np.asarray(self.normal)
        return nodes, np.tile(normal, (len(nodes), 1))


def on_plane(mesh: TetMesh, nodes: np.ndarray, name: str = "support") -> SlidingSupport:
    """Create a sliding support of n nodes (n,) that lie in one plane. The normal is computed from the nodes.

    Raises:
        InputError: the nodes do not span a plane, or do not lie in one plane.
    """
    points = np.asarray(mesh.points)[nodes]
    size, axes = np.linalg.svd(points - points.mean(axis=0), full_matrices=False)[1:]
    if len(points) < 3 or size[1] <= _FLAT * size[0]:
        raise InputError(f"{name} where selects nodes that do not span a plane: enlarge the region to a whole face")
    off = np.abs((points - points.mean(axis=0)) @ axes[2]).max()
    if off > _FLAT * size[0]:
        raise InputError(
            f"{name} where selects nodes that lie up to {off:.3g} m from one plane: select a plane part of the "
            "surface, or write several supports"
        )
    numbers = jnp.asarray(nodes, jnp.int32)
    along = np.flatnonzero(np.abs(np.abs(axes[2]) - 1) < _FLAT**2 + 1e-12)
    if len(along):
        return SlidingSupport(nodes=numbers, axis=selection.AXES[int(along[0])])
    return SlidingSupport(nodes=numbers, normal=jnp.asarray(axes[2]))
