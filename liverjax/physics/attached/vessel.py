"""A vessel: bars along a centre line. The bars stiffen the tetrahedra that they cross. They have no bending stiffness.

The line is cut into pieces at the faces of the tetrahedra. A piece has no additional unknowns: its points move with the
linear or quadratic shape functions of its element. The cross-section is a ring, or a disc if `wall` is None. The law
acts in uniaxial tension along the piece, at constant volume. The tissue of the body is not removed where the wall lies.
"""

from collections.abc import Mapping
from pathlib import Path
from typing import Any, ClassVar, TypeVar

import jax
import jax.numpy as jnp
import numpy as np

from liverjax.core import bounds
from liverjax.core.did_you_mean import as_word
from liverjax.core.errors import InputError
from liverjax.core.struct import Indices, Number, param, struct
from liverjax.laws import layers
from liverjax.laws.base import Law
from liverjax.mesh import locate
from liverjax.mesh.adjacency import node_numbers
from liverjax.mesh.refinement import barycentric_in_parts
from liverjax.mesh.shape_functions import functions
from liverjax.mesh.tetrahedra import UNITS, TetMesh
from liverjax.physics.attached.centre_lines import CentreLines, centre_lines, read_surface
from liverjax.physics.attached.elements import Elements
from liverjax.physics.base import Physics, Step

T = TypeVar("T")
#: Two Gauss points on a piece integrate the squared derivatives of quadratic shape functions exactly.
_GAUSS = 0.5 + np.array([-0.5, 0.5]) / np.sqrt(3)


@struct
class Vessel(Physics):
    """m pieces of a centre line, each in one element."""

    element: Indices = param("1", "element numbers (m,)", lower=0)
    enters: jax.Array = param("1", "barycentric coordinates (4, m) of the beginning of each piece")
    leaves: jax.Array = param("1", "barycentric coordinates (4, m) of the end of each piece")
    radius: Number = param("m", "outer radius, one number or one per piece (m,)", above=0.0)
    wall: Number | None = param(
        "m", "thickness of the wall; None: the cross-section is a disc", above=0.0, default=None
    )
    law: Law = param("1", "law of the wall")

    section: ClassVar[str] = "vessel"
    keys: ClassVar[tuple[str, ...]] = ("where", "set", "line", "surface", "unit", "radius", "wall", "law")

    @classmethod
    def read(cls, mesh: TetMesh, table: dict[str, object], name: str) -> "Vessel":
        """Read [[vessel]]: a law, and either the points of a centre line with radii, or the file of a surface."""
        if ("line" in table) == ("surface" in table) or "law" not in table:
            raise InputError(
                f"{name} needs line = [[x, y, z], …] with radius in m or surface = 'tube.stl', and also [vessel.law]"
            )
        if "where" in table or "set" in table:
            raise InputError(
                f"{name} has where or set, but the position of a vessel is given by its line or surface: remove where "
                "and set"
            )
        given = {"wall": table["wall"]} if "wall" in table else {}
        law = layers.read_layer(table["law"], name)
        if "surface" in table:
            lines = _lines_of_surface(table, name)
            return crossing(mesh, lines, law, name=name, **given)
        if "radius" not in table or "unit" in table:
            raise InputError(
                f"{name} line needs radius, and cannot be used with unit: give radius and line in m, and remove unit"
            )
        line, radius = (bounds.array_of(table[key]) for key in ("line", "radius"))
        line, radius = (np.empty(0) if v is None else v for v in (line, radius))
        if line.ndim != 2 or line.shape[1] != 3 or len(line) < 2 or radius.shape not in ((), (len(line),)):
            raise InputError(
                f"{name} needs line = [[x, y, z], …] with two or more points, and radius as one number, or as one "
                "number per point: correct line and radius"
            )
        if not np.all(np.any(np.diff(line, axis=0) != 0, axis=1)):
            raise InputError(f"{name} line contains the same point twice in succession: remove one of the two points")
        return along(mesh, line, radius, law, name=name, **given)

    def check(self, mesh: TetMesh, name: str) -> None:
        """Raise InputError for unknown elements, a wall thicker than the radius, or a law with fibre directions."""
        numbers = np.asarray(self.element)
        if numbers.ndim != 1 or not numbers.size or numbers.max() >= mesh.number_of_elements:
            raise InputError(
                f"{name} has no elements, or an element number above {mesh.number_of_elements - 1}: correct the line "
                "of the vessel"
            )
        for key in ("enters", "leaves"):
            bounds.check_shape(f"{name}.{key}", getattr(self, key), (4, len(numbers)))
            if np.any(np.abs(np.asarray(getattr(self, key)).sum(axis=0) - 1) > 1e-6):
                raise InputError(f"{name}.{key} of each piece must add up to 1: give barycentric coordinates")
        for key in ("radius", "wall"):
            bounds.check_shape(f"{name}.{key}", getattr(self, key), (), (len(numbers),))
        if self.wall is not None and np.any(np.asarray(self.wall) > np.asarray(self.radius)):
            raise InputError(
                f"{name}.wall = {self.wall} m is thicker than the radius: remove wall to get a solid cross-section"
            )
        layers.check(self.law, name)

    def in_parts(self, mesh: TetMesh) -> "Vessel":
        """Return the vessel on the refined mesh, where every element of `mesh` is cut into eight
        (`liverjax.mesh.refinement`).

        The position of the vessel must be known (not inside jit).
        """
        m = len(np.asarray(self.element))
        first, last = (barycentric_in_parts(mesh, self.element, np.asarray(L)) for L in (self.enters, self.leaves))
        cut = locate.cut_lines(first, last)
        begin, end = (each[:, cut.line, cut.element] for each in (first, last))
        enters, leaves = (begin + at * (end - begin) for at in (cut.begin, cut.end))

        def of_pieces(numbers: T) -> T:
            return jax.tree.map(lambda v: v[..., cut.line] if jnp.shape(v)[-1:] == (m,) else v, numbers)

        return Vessel(
            element=node_numbers(8 * np.asarray(self.element)[cut.line] + cut.element),
            enters=jnp.asarray(enters, self.enters.dtype),
            leaves=jnp.asarray(leaves, self.leaves.dtype),
            radius=of_pieces(self.radius),
            wall=of_pieces(self.wall),
            law=of_pieces(self.law),
        )

    def freeze(self, memory: None, step: Step) -> "Bars":
        """Return the force term of the vessel for one step.

        The force term uses the isochoric part of the law, or the whole law if there is no isochoric part.
        """
        law = self.law.isochoric_part() or self.law
        return Bars(element=self.element, enters=self.enters, leaves=self.leaves, section_area=self.area(), law=law)

    def area(self) -> jax.Array:
        """Return the area [m^2] of the cross-section: one number, or one per piece (m,)."""
        inner = 0.0 if self.wall is None else self.radius - self.wall
        return jnp.pi * (jnp.asarray(self.radius) ** 2 - inner**2)


def _lines_of_surface(table: Mapping[str, object], name: str) -> CentreLines:
    """Return the centre lines of the tubes in a surface file. If a radius is given, it replaces the measured radii."""
    unit, radius = as_word(table.get("unit", "m"), f"{name} unit"), table.get("radius")
    if unit not in UNITS:
        raise InputError(f"{name} unit = {unit!r} is not known: use one of {', '.join(UNITS)}")
    if not isinstance(table["surface"], str):
        raise InputError(f"{name} surface = {table['surface']!r} must name a file: write surface = 'tube.stl'")
    lines = centre_lines(*read_surface(Path(table["surface"]), UNITS[unit], name), name)
    if radius is None:
        return lines
    if isinstance(radius, bool) or not isinstance(radius, (int, float)):
        raise InputError(f"{name} radius = {radius!r} of a surface must be one number in m: correct or remove radius")
    return lines._replace(radius=np.full(len(lines.radius), float(radius)))


def along(mesh: TetMesh, line: np.ndarray, radius: Any, law: Law, name: str = "vessel", **given: object) -> Vessel:
    """Create a vessel along a line through n points (n, 3) [m], with one radius [m] or one per point (n,).

    Parts of the line outside the body are ignored.

    Raises:
        InputError: the whole line is outside the body.
    """
    cut = _cut(mesh, line[:-1], line[1:], name)
    if np.ndim(radius):
        middle = 0.5 * (cut.begin + cut.end)
        radius = jnp.asarray(radius[cut.line] + middle * (radius[cut.line + 1] - radius[cut.line]))
    else:
        radius = float(radius)
    return _of_pieces(mesh, cut, (line[:-1], line[1:]), radius, law, **given)


def crossing(mesh: TetMesh, lines: CentreLines, law: Law, name: str = "vessel", **given: object) -> Vessel:
    """Create a vessel along several centre lines, for example of a tree. Parts of lines outside the body are ignored.

    Raises:
        InputError: all lines are outside the body.
    """
    cut = _cut(mesh, lines.begin, lines.end, name)
    return _of_pieces(mesh, cut, (lines.begin, lines.end), jnp.asarray(lines.radius[cut.line]), law, **given)


def _cut(mesh: TetMesh, begin: np.ndarray, end: np.ndarray, name: str) -> locate.Pieces:
    cut = locate.pieces(mesh, begin, end)
    if not len(cut.element):
        raise InputError(f"{name} lies outside the body: move the vessel, or check its unit")
    return cut


def _of_pieces(
    mesh: TetMesh, cut: locate.Pieces, lines: tuple[np.ndarray, np.ndarray], radius: Number, law: Law, **given: Any
) -> Vessel:
    ends = []
    for at in (cut.begin, cut.end):
        points = lines[0][cut.line] + at[:, None] * (lines[1][cut.line] - lines[0][cut.line])
        L = locate.barycentric(mesh, points)
        ends.append(jnp.asarray(L[:, np.arange(len(points)), cut.element]))
    element = jnp.asarray(cut.element, jnp.int32)
    return Vessel(element=element, enters=ends[0], leaves=ends[1], radius=radius, law=law, **given)


@struct
class Bars(Elements):
    """Force term of a vessel with m pieces, for one step.

    `enters` and `leaves` are the barycentric coordinates of the beginning and of the end of each piece.
    """

    element: Indices = param("1", "element numbers (m,)")
    enters: jax.Array = param("1", "barycentric (4, m)")
    leaves: jax.Array = param("1", "barycentric (4, m)")
    section_area: jax.Array = param("m^2", "one number, or one per piece (m,)")
    law: Law = param("1", "law of the wall")

    def nodes(self, mesh: TetMesh) -> jax.Array:
        """Return the node numbers (n, m) of the elements of the m pieces, with n nodes per element."""
        count = 4 if mesh.order == 1 else 10
        return jnp.stack([nodes[self.element] for nodes in mesh.element_nodes[:count]])

    def _lengths(self, mesh: TetMesh) -> jax.Array:
        corners = mesh.points[mesh.tetrahedra[self.element]]
        f = jnp.einsum("am,mai->mi", self.leaves - self.enters, corners)
        return jnp.sqrt(jnp.sum(f * f, axis=1))

    def tangents(self, mesh: TetMesh) -> jax.Array:
        """Return the factors p (see `Elements.tangents`): derivatives of the shape functions along each piece."""
        along = (self.leaves - self.enters) / self._lengths(mesh)[None]
        if mesh.order == 1:
            return along[None, :, None, :]
        rows = []
        for at in _GAUSS:
            L = self.enters + float(at) * (self.leaves - self.enters)
            rows.append(_slopes_along(L, along))
        return jnp.stack(rows, axis=1)[None]

    def energies(self, mesh: TetMesh, C: tuple[jax.Array, ...]) -> jax.Array:
        """Return the energies [J] at the integration points: volume of the wall times energy density.

        The energy density is that of an incompressible sample in tension.
        """
        law = jax.tree.map(lambda v: v if jnp.ndim(v) == 0 else v[None], self.law)
        volume = self.section_area * self._lengths(mesh) / len(C[0])
        return volume[None] * layers.axial_energy(law, jnp.sqrt(C[0]))


def _slopes_along(L: jax.Array, along: jax.Array) -> jax.Array:
    """Return the derivatives (10, m) of the ten quadratic shape functions in the direction `along`, for m pieces.

    L (4, m) are the barycentric coordinates of a point of each piece, and `along` (4, m) are their derivatives along
    the piece. The derivatives of the shape functions are linear in L.
    """
    corners = np.eye(4)
    table = functions(2, corners)[1]  # (10, 4, 4): derivatives with respect to L_k, at every corner
    return jnp.einsum("akc,cm,km->am", jnp.asarray(table, L.dtype), L, along)
