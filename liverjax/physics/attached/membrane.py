"""A membrane on a part of the surface, for example the capsule. It moves with the surface and has no bending
stiffness.

The law of the membrane acts in its plane. The stress through the thickness is 0 (plane stress). If the law has an
isochoric part, the membrane is incompressible: the stretch through the thickness is 1 divided by the area ratio. For
other laws, this stretch is an unknown at every integration point.

Source: Holzapfel, Eberlein, Wriggers and Weizsaecker 1996, "A new axisymmetrical membrane element for anisotropic,
finite strain analysis of arteries", and Bonet and Wood 2008, section 6.6 (plane stress).
"""

from collections.abc import Callable
from typing import Any, ClassVar

import jax
import jax.numpy as jnp
import numpy as np

from liverjax.core.errors import InputError
from liverjax.core.struct import Content, Indices, Number, param, replace, struct
from liverjax.laws import layers
from liverjax.laws.base import Law
from liverjax.mesh import promotion, selection, surface
from liverjax.mesh.tetrahedra import TetMesh
from liverjax.physics.attached.elements import Elements
from liverjax.physics.base import Physics, Step


@struct
class Membrane(Physics):
    """A thin layer on m triangles of the surface. The layer has no tension in the reference shape."""

    triangles: Indices = param("1", "node numbers (m, 3)", lower=0)
    thickness: Number = param("m", "thickness of the layer: one number, or one per triangle (m,)", above=0.0)
    law: Law = param("1", "law of the layer; parameters may have one value per triangle (m,)")

    section: ClassVar[str] = "membrane"
    keys: ClassVar[tuple[str, ...]] = ("where", "set", "thickness", "law")

    @classmethod
    def read(cls, mesh: TetMesh, table: Content, name: str) -> "Membrane":
        """Read [[membrane]]: a part of the surface (by default all of it), a thickness and a law."""
        for key, example in (
            ("thickness", "thickness = 5e-5, in m"),
            ("law", "[membrane.law] with name and parameters"),
        ):
            if key not in table:
                raise InputError(f"{name} needs {key}: write {example}")
        whole = "where" not in table and "set" not in table
        place = f"{name} where"
        nodes = None if whole else selection.select(mesh, table.get("where"), table.get("set"), place)
        triangles = selection.surface_of(mesh, nodes, table.get("set"))
        if not len(triangles):
            raise InputError(
                f"{place}: the selected region contains nodes, but no triangle of the boundary: enlarge the region to "
                "a whole face"
            )
        law = layers.read_layer(table["law"], name)
        return cls(triangles=jnp.asarray(triangles, jnp.int32), thickness=table["thickness"], law=law)

    def check(self, mesh: TetMesh, name: str) -> None:
        """Raise InputError for unknown triangles, a wrong number of thicknesses, or a law with fibre directions."""
        selection.check_triangles(mesh, self.triangles, f"{name}.triangles")
        if np.shape(self.thickness) not in ((), (len(self.triangles),)):
            shape, count = np.shape(self.thickness), len(self.triangles)
            raise InputError(f"{name}.thickness has shape {shape}: give one number, or one per triangle ({count})")
        layers.check(self.law, name)

    def enriched(self, mesh: TetMesh, more: Callable[[Indices], Indices]) -> "Membrane":
        """Return the membrane on the same triangles, for the mesh with elements of higher order."""
        return replace(self, triangles=promotion.with_faces(mesh, self.triangles))

    def freeze(self, memory: None, step: Step) -> "Stretched":
        """Return the force term of the membrane for one step.

        The force term uses the isochoric part of the law, or the whole law if there is no isochoric part.
        """
        isochoric = self.law.isochoric_part()
        law, solved = (self.law, jnp.ones(0)) if isochoric is None else (isochoric, None)
        return Stretched(triangles=self.triangles, thickness=self.thickness, law=law, solved=solved)


@struct
class Stretched(Elements):
    """Force term of a membrane on m triangles, for one step."""

    triangles: Indices = param("1", "node numbers (m, 3)")
    thickness: Any = param("m", "of the layer")
    law: Law = param("1", "isochoric part, or the whole law if the stretch through the thickness is an unknown")
    solved: object = param("1", "not None if the stretch through the thickness is an unknown", default=None)

    def nodes(self, mesh: TetMesh) -> jax.Array:
        """Return the node numbers (n, m) of the m triangles, with n = 3 or more nodes per triangle."""
        return jnp.stack(surface.triangle_nodes(mesh, self.triangles))

    def tangents(self, mesh: TetMesh) -> jax.Array:
        """Return the factors p of two tangent vectors (see `Elements.tangents`).

        In the reference shape, the tangent vectors are orthogonal unit vectors in the plane of the triangle.
        """
        _, along = surface.triangle_slopes(mesh)
        r11, r12, r22 = (r[None, None] for r in self._edges(mesh))
        first, second = (jnp.asarray(a.T, r11.dtype)[:, :, None] for a in along)
        return jnp.stack([first / r11, (second - r12 / r11 * first) / r22])

    def energies(self, mesh: TetMesh, C: tuple[jax.Array, ...]) -> jax.Array:
        """Return the energy [J] at every integration point: thickness times area times energy density."""
        weights, _ = surface.triangle_slopes(mesh)
        r11, _, r22 = self._edges(mesh)
        law = jax.tree.map(lambda v: v if jnp.ndim(v) == 0 else v[None], self.law)
        W = layers.in_plane_energy(law, C, self.solved is not None)
        return (0.5 * self.thickness * r11 * r22)[None] * jnp.asarray(weights, W.dtype)[:, None] * W

    def _edges(self, mesh: TetMesh) -> tuple[jax.Array, jax.Array, jax.Array]:
        """Return the entries r11, r12 and r22, each (m,) [m], of a 2 x 2 Cholesky factor for each of the m triangles.

        The factorised matrix contains the scalar products of two edges of the triangle in the reference shape.
        """
        corners = jnp.moveaxis(mesh.points[self.triangles[:, :3]], 0, -1)
        first, second = corners[1] - corners[0], corners[2] - corners[0]
        r11 = jnp.sqrt(jnp.sum(first * first, axis=0))
        r12 = jnp.sum(first * second, axis=0) / r11
        return r11, r12, jnp.sqrt(jnp.sum(second * second, axis=0) - r12 * r12)
