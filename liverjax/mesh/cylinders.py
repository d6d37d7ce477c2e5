"""Meshes of cylinders with rings at given radii and layers at given heights, and sectors for axisymmetric problems.

A ring is a regular polygon. Its corners lie a little outside the circle, so that the polygon and the circle have the
same area. The error of a computed stiffness is then of order 4, not 2, in the angle between neighbouring corners.
"""

import itertools
from collections.abc import Mapping
from typing import NamedTuple

import numpy as np

from liverjax.core.errors import InputError
from liverjax.mesh.prisms import stacked
from liverjax.mesh.tetrahedra import TetMesh, tet_mesh

#: Increase of the cell length, divided by the distance from a rim. With quadratic elements, a smaller increase hardly
#: improves the accuracy (experiments/TABLES.md).
GROWTH = 0.7


def graded(length: float, cells: Mapping[float, float], largest: float, growth: float = GROWTH) -> np.ndarray:
    """Return positions of nodes from 0 to `length`, with short cells near given positions.

    Args:
        length: total length [m].
        cells: position [m] -> length of a cell there [m]. The result contains all these positions.
        largest: maximum length of a cell [m].
        growth: increase of the cell length, divided by the distance from such a position.

    Returns:
        Increasing positions (n,) [m].
    """
    stops = np.unique([0.0, *cells, length])
    parts = [np.zeros(1)]
    for low, high in itertools.pairwise(stops):
        # The points x have geometric spacing near both ends, so that cells much shorter than the interval are resolved.
        half = np.concatenate([np.zeros(1), np.geomspace(1e-6, 0.5, 500)])
        x = low + (high - low) * np.concatenate([half, 1 - half[-2::-1]])
        cell = np.full_like(x, largest)
        for place, size in cells.items():
            cell = np.minimum(cell, size + growth * np.abs(x - place))
        count = np.concatenate([np.zeros(1), np.cumsum((1 / cell[1:] + 1 / cell[:-1]) / 2 * np.diff(x))])
        n = max(1, int(np.ceil(count[-1] - 1e-6)))
        parts.append(np.interp(np.linspace(0.0, count[-1], n + 1)[1:], count, x))
    return np.concatenate(parts)


def graded_cylinder(radii: np.ndarray, heights: np.ndarray, match_area: bool = True) -> TetMesh:
    """Mesh a cylinder about the z axis, with rings of nodes at `radii` and layers of nodes at `heights`.

    Edges around the axis are about as long as the largest distance between neighbouring rings. The number of corners
    increases from one ring to the next only if the distance between these rings is above half of this length.

    Args:
        radii: radii of the rings (n,) [m], increasing from 0 (the axis).
        heights: heights of the layers (m,) [m], increasing.
        match_area: whether each polygon has the area of its circle. Otherwise its corners are on the circle.

    Returns:
        A mesh with the node sets bottom, top and mantle.

    Raises:
        InputError: radii or heights do not increase, or radii do not begin at 0.
    """
    radii, heights = _rising("radii", radii), _rising("heights", heights)
    corners = _corners(radii)
    disc, triangles = _rings(radii, corners, match_area)
    points, tets = stacked(disc, triangles, heights)
    n, per_layer = np.arange(len(points)), len(disc)
    sets = {"bottom": n[:per_layer], "top": n[-per_layer:], "mantle": n[n % per_layer >= per_layer - corners[-1]]}
    return tet_mesh(points, tets, sets)


class Sector(NamedTuple):
    """A part of a cylinder between two planes through its axis."""

    mesh: TetMesh  # node sets bottom, top, mantle, axis, start (the plane y = 0) and end
    normal: np.ndarray  # normal (3,) of the plane `end`
    parts: float  # number of such sectors in the whole cylinder
    stretch: float  # distance of a ring's corners from the axis, divided by the radius of the ring


def sector(radii: np.ndarray, heights: np.ndarray, corners: int, slices: int = 1) -> Sector:
    """Mesh the part of a cylinder between the plane y = 0 and another plane through the axis.

    An axisymmetric problem needs only one slice, since both planes are planes of symmetry. Every polygon has the area
    of its circle.

    Args:
        radii, heights: see `graded_cylinder`.
        corners: number of corners of every ring of the whole cylinder, at least 3.
        slices: number of edges of every ring in the sector; `corners` / 4 gives a quarter of the cylinder.

    Raises:
        InputError: radii or heights do not increase, radii do not begin at 0, or `slices` is below 1 or not below half
            of `corners`.
    """
    radii, heights = _rising("radii", radii), _rising("heights", heights)
    if not 0 < 2 * slices < corners:
        raise InputError(
            f"slices = {slices} must be at least 1 and less than half of corners = {corners}: change one of the two"
        )
    stretch, step = _stretch(corners), 2 * np.pi / corners
    angle = step * np.arange(slices + 1)
    ring = stretch * np.column_stack([np.cos(angle), np.sin(angle)])
    plane = np.concatenate([np.zeros((1, 2)), *(r * ring for r in radii[1:])])
    # Node 0 is on the axis. Each ring adds slices + 1 nodes.
    inner = np.zeros((len(radii) - 1, slices + 1), int)
    outer = 1 + np.arange((len(radii) - 1) * (slices + 1)).reshape(len(radii) - 1, slices + 1)
    inner[1:] = outer[:-1]
    first = np.stack([inner[:, :-1], outer[:, :-1], outer[:, 1:]], axis=-1)
    second = np.stack([inner[1:, :-1], outer[1:, 1:], inner[1:, 1:]], axis=-1)
    points, tets = stacked(plane, np.concatenate([first.reshape(-1, 3), second.reshape(-1, 3)]), heights)
    n = np.arange(len(points))
    on_plane = n % len(plane)
    sets = {
        "bottom": n[: len(plane)],
        "top": n[-len(plane) :],
        "mantle": n[on_plane >= len(plane) - slices - 1],
        "axis": n[on_plane == 0],
        "start": n[np.isin(on_plane, [0, *outer[:, 0]])],
        "end": n[np.isin(on_plane, [0, *outer[:, -1]])],
    }
    normal = np.array([-np.sin(angle[-1]), np.cos(angle[-1]), 0.0])
    return Sector(tet_mesh(points, tets, sets), normal, corners / slices, stretch)


def _stretch(corners: int) -> float:
    """Return the circumradius of a regular polygon, divided by the radius of the circle with the same area."""
    step = 2 * np.pi / corners
    return float(np.sqrt(step / np.sin(step)))


def _corners(radii: np.ndarray) -> np.ndarray:
    """Return the number of corners of each ring (of each radius except the first, which is 0)."""
    width = np.diff(radii)
    edge = width.max()
    found, last = [], 6
    for k, w in enumerate(width):
        wanted = round(2 * np.pi * radii[k + 1] / edge)
        # If the distance between two rings is below half an edge, polygons with different numbers of corners would
        # intersect.
        if k == 0 or w > edge / 2:
            last = max(last, wanted)
        found.append(last)
    return np.array(found)


def _rings(radii: np.ndarray, corners: np.ndarray, match_area: bool) -> tuple[np.ndarray, np.ndarray]:
    """Return nodes and counter-clockwise triangles of a disc: one node at the centre, then ring after ring."""
    points, triangles = [np.zeros((1, 2))], []
    inner = np.zeros(1, int)
    for radius, count in zip(radii[1:], corners, strict=True):
        turns = np.arange(count) / count
        size = radius * (_stretch(count) if match_area else 1.0)
        points.append(size * np.column_stack([np.cos(2 * np.pi * turns), np.sin(2 * np.pi * turns)]))
        outer = inner[-1] + 1 + np.arange(count)
        triangles += _ring_of_triangles(inner, outer)
        inner = outer
    return np.vstack(points), np.array(triangles)


def _ring_of_triangles(inner: np.ndarray, outer: np.ndarray) -> list[list[int]]:
    """Return the triangles between two rings.

    Each triangle contains the next edge of the inner or of the outer ring: the edge whose middle has the smaller angle
    about the axis.
    """
    n, m = len(inner), len(outer)
    if n == 1:
        return [[inner[0], outer[j], outer[(j + 1) % m]] for j in range(m)]
    found, i, j = [], 0, 0
    while i < n or j < m:
        if i == n or (j < m and (j + 0.5) / m <= (i + 0.5) / n):
            found.append([inner[i % n], outer[j], outer[(j + 1) % m]])
            j += 1
        else:
            found.append([inner[i], outer[j % m], inner[(i + 1) % n]])
            i += 1
    return found


def _rising(name: str, places: np.ndarray) -> np.ndarray:
    places = np.asarray(places, float)
    if places.ndim != 1 or len(places) < 2 or not np.all(np.isfinite(places)) or not np.all(np.diff(places) > 0):
        raise InputError(f"{name} = {places} must be two or more increasing numbers: correct these numbers")
    if name == "radii" and places[0] != 0:
        raise InputError(f"the list of radii begins at {places[0]:g}: begin with 0 (the axis)")
    return places
