"""Generated meshes: box and cylinder, with node sets on their faces."""

import itertools
import math
from collections.abc import Sequence

import numpy as np

from liverjax.core.errors import InputError
from liverjax.mesh.cylinders import graded, graded_cylinder
from liverjax.mesh.prisms import stacked
from liverjax.mesh.tetrahedra import TetMesh, tet_mesh

#: Maximum number of tetrahedra of a shape. A run with this number of linear tetrahedra needs about 20 GB.
MOST_TETRAHEDRA = 20_000_000


def box(size: Sequence[float], cells: Sequence[int]) -> TetMesh:
    """Mesh a box with one corner at the origin. Each brick is cut into six tetrahedra along one diagonal (Kuhn).

    Args:
        size: edge lengths (x, y, z) [m].
        cells: number of bricks along each edge.
    """
    _positive("size", size)
    if len(size) != 3:
        raise InputError(f"box size has {len(size)} numbers: give three lengths in metres")
    if len(cells) != 3 or any(int(n) != n or n < 1 for n in cells):
        raise InputError(
            f"box cells = {np.asarray(cells).tolist()} must be three positive whole numbers: give e.g. [8, 8, 8]"
        )
    _not_too_many(6 * math.prod(int(n) for n in cells), "cells")
    shape = tuple(int(n) + 1 for n in cells)
    grid = np.indices(shape).reshape(3, -1).T
    corner = np.indices(tuple(int(n) for n in cells)).reshape(3, -1).T
    sixths = []
    for order in itertools.permutations(range(3)):
        path = np.vstack([np.zeros(3, dtype=int), np.cumsum(np.eye(3, dtype=int)[list(order)], axis=0)])
        if np.linalg.det(np.eye(3)[list(order)]) < 0:
            path = path[[2, 1, 0, 3]]
        nodes = corner[:, None, :] + path[None]
        sixths.append(np.ravel_multi_index(tuple(np.moveaxis(nodes, -1, 0)), shape))
    # The tetrahedra of one brick follow each other, so that neighbours in memory share nodes.
    tets = np.stack(sixths, axis=1).reshape(-1, 4)
    points = grid * np.asarray(size, dtype=float) / np.asarray(cells)
    names = ("x_min", "x_max"), ("y_min", "y_max"), ("z_min", "z_max")
    faces = {names[a][e]: np.flatnonzero(grid[:, a] == (e * cells[a])) for a in range(3) for e in range(2)}
    return tet_mesh(points, tets, faces)


def cylinder(
    radius: float,
    height: float,
    cell_size: float,
    rim_cell: float | None = None,
    rings: Sequence[float] = (),
    match_area: bool = False,
) -> TetMesh:
    """Mesh a cylinder about the z axis that stands on z = 0.

    Args:
        radius, height: radius and height [m].
        cell_size: target edge length [m]; there are at least two rings and one layer.
        rim_cell: edge length [m] at the rims of both faces and at `rings`; cells grow from there to `cell_size`.
        rings: radii [m] at which there is a ring of nodes, for example the radius of a punch.
        match_area: whether each polygon has the area of its circle.

    Without `rim_cell`, `rings` and `match_area`, ring k has 6 k nodes. Without `match_area`, the corners of a ring lie
    on its circle. The mesh then has less volume than the cylinder, with a difference of O(cell_size^2).

    Raises:
        InputError: a length is not positive, or a ring is outside the cylinder.
    """
    _positive("radius", [radius])
    _positive("height", [height])
    _positive("cell_size", [cell_size])
    if rim_cell is not None or len(rings) or match_area:
        return _graded(radius, height, (cell_size, cell_size if rim_cell is None else rim_cell), rings, match_area)
    count = max(2, math.ceil(radius / cell_size - 1e-9))
    layers = max(1, math.ceil(height / cell_size - 1e-9))
    _not_too_many(18 * count**2 * layers, "radius, height and cell_size")
    disc, triangles = _disc(count)
    points, tets = stacked(disc * radius, triangles, np.linspace(0.0, height, layers + 1))
    n, per_layer = np.arange(len(points)), len(disc)
    sets = {
        "bottom": n[:per_layer],
        "top": n[-per_layer:],
        "mantle": n[np.hypot(*points[:, :2].T) > radius * (1 - 1e-9)],
    }
    return tet_mesh(points, tets, sets)


def _graded(
    radius: float, height: float, cells: tuple[float, float], rings: Sequence[float], match_area: bool
) -> TetMesh:
    """Mesh a cylinder. `cells`: cell length [m] far from its rims and from `rings`, and cell length [m] near them."""
    cell_size, rim_cell = cells
    _positive("rim_cell", [rim_cell])
    for ring in rings:
        if not (np.isfinite(ring) and 0 < ring < radius):
            raise InputError(
                f"shape rings = {list(rings)} must lie between 0 and the radius {radius:g}: correct these numbers"
            )
    largest = min(cell_size, radius / 2)
    # A ring of radius r has at least 2 pi r / largest edges. This gives a lower bound of the number of tetrahedra.
    _not_too_many(18 * math.ceil(radius / largest) ** 2 * math.ceil(height / cell_size), "radius, height and cell_size")
    _not_too_many(18 * math.ceil(min(radius, height) / rim_cell) ** 2 // 100, "rim_cell")
    radii = graded(radius, dict.fromkeys([*map(float, rings), float(radius)], rim_cell), largest)
    heights = graded(height, {0.0: rim_cell, float(height): rim_cell}, cell_size)
    return graded_cylinder(radii, heights, match_area)


def _disc(rings: int) -> tuple[np.ndarray, np.ndarray]:
    """Return nodes and counter-clockwise triangles of a unit disc: one node at the centre, 6 k nodes on ring k."""
    points = [np.zeros((1, 2))]
    start = [0, 1]
    for k in range(1, rings + 1):
        angle = 2 * np.pi * np.arange(6 * k) / (6 * k)
        points.append(k / rings * np.column_stack([np.cos(angle), np.sin(angle)]))
        start.append(start[-1] + 6 * k)
    triangles = []
    for k in range(1, rings + 1):
        for sector in range(6):
            for m in range(k):
                outer = [start[k] + (sector * k + m + s) % (6 * k) for s in (0, 1)]
                inner = [start[k - 1] + (sector * (k - 1) + m + s) % max(1, 6 * (k - 1)) for s in (0, 1)]
                triangles.append([inner[0], outer[0], outer[1]])
                if m < k - 1:
                    triangles.append([inner[0], outer[1], inner[1]])
    return np.vstack(points), np.asarray(triangles)


def _not_too_many(tetrahedra: int, names: str) -> None:
    """Raise `InputError` if the planned mesh would have more than `MOST_TETRAHEDRA` elements."""
    if tetrahedra > MOST_TETRAHEDRA:
        remedy = (
            "give fewer cells" if names == "cells" else "use larger cells, or give lengths in metres, or add the unit"
        )
        raise InputError(
            f"the shape with these values of {names} would have about {min(tetrahedra, 10**300):.2g} tetrahedra, but "
            f"at most {MOST_TETRAHEDRA:.0e} are allowed: {remedy}"
        )


def _positive(name: str, values: Sequence[float]) -> None:
    if not all(np.isfinite(v) and v > 0 for v in values):
        shown = values[0] if len(values) == 1 else [float(v) for v in values]
        raise InputError(f"shape {name} = {shown} must be positive and finite: give lengths in metres")
