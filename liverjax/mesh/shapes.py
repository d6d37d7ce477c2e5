"""Generated meshes: box and cylinder, with node sets on their faces."""

import itertools
import math
from collections.abc import Sequence

import numpy as np

from liverjax.core.errors import InputError
from liverjax.mesh.tetrahedra import TetMesh, tet_mesh


def box(size: Sequence[float], cells: Sequence[int]) -> TetMesh:
    """A box with one corner at the origin, each brick cut into six tetrahedra along one diagonal (Kuhn).

    Args:
        size: edge lengths (x, y, z) [m].
        cells: number of bricks along each edge.
    """
    _positive("size", size)
    if len(cells) != 3 or any(int(n) != n or n < 1 for n in cells):
        raise InputError(f"box cells = {list(cells)} must be three positive whole numbers: give e.g. [8, 8, 8]")
    shape = tuple(int(n) + 1 for n in cells)
    grid = np.indices(shape).reshape(3, -1).T
    corner = np.indices(tuple(int(n) for n in cells)).reshape(3, -1).T
    sixths = []
    for order in itertools.permutations(range(3)):
        path = np.vstack([np.zeros(3, dtype=int), np.cumsum(np.eye(3, dtype=int)[list(order)], axis=0)])
        if np.linalg.det(np.eye(3)[list(order)]) < 0:
            path = path[[0, 2, 1, 3]]
        nodes = corner[:, None, :] + path[None]
        sixths.append(np.ravel_multi_index(tuple(np.moveaxis(nodes, -1, 0)), shape))
    # Tetrahedra of one brick stay together: neighbours in memory share their nodes.
    tets = np.stack(sixths, axis=1).reshape(-1, 4)
    points = grid * np.asarray(size, dtype=float) / np.asarray(cells)
    names = ("x_min", "x_max"), ("y_min", "y_max"), ("z_min", "z_max")
    faces = {names[a][e]: np.flatnonzero(grid[:, a] == (e * cells[a])) for a in range(3) for e in range(2)}
    return tet_mesh(points, tets, faces)


def cylinder(radius: float, height: float, cell_size: float) -> TetMesh:
    """A cylinder about the z axis standing on z = 0: rings of 6 k nodes, layers of prisms cut into three tetrahedra.

    Args:
        radius, height: [m].
        cell_size: edge length aimed at [m]; at least two rings and one layer are made.

    The mantle is a polygon of 6 n corners on the circle, so the volume is below pi r^2 h by O(cell_size^2).
    """
    _positive("radius", [radius])
    _positive("height", [height])
    _positive("cell_size", [cell_size])
    rings = max(2, math.ceil(radius / cell_size - 1e-9))
    layers = max(1, math.ceil(height / cell_size - 1e-9))
    disc, triangles = _disc(rings)
    per_layer = len(disc)
    z = np.repeat(np.linspace(0.0, height, layers + 1), per_layer)
    points = np.column_stack([np.tile(disc * radius, (layers + 1, 1)), z])
    prisms = np.concatenate(
        [np.hstack([triangles + k * per_layer, triangles + (k + 1) * per_layer]) for k in range(layers)]
    )
    n = np.arange(len(points))
    sets = {
        "bottom": n[:per_layer],
        "top": n[-per_layer:],
        "mantle": n[np.hypot(*points[:, :2].T) > radius * (1 - 1e-9)],
    }
    return tet_mesh(points, _split_prisms(prisms), sets)


def _disc(rings: int) -> tuple[np.ndarray, np.ndarray]:
    """Unit disc: one node in the middle, 6 k on ring k; counter-clockwise triangles between neighbouring rings."""
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


def _split_prisms(prisms: np.ndarray) -> np.ndarray:
    """Three tetrahedra a prism (bottom a b c, top d e f); diagonals start at the lower node number, so faces match."""
    # Rotate each prism so that its smallest bottom number comes first: then only one quadrilateral is left to decide.
    shift = np.argmin(prisms[:, :3], axis=1)
    turn = (np.arange(3)[None] + shift[:, None]) % 3
    a, b, c = np.take_along_axis(prisms[:, :3], turn, axis=1).T
    d, e, f = np.take_along_axis(prisms[:, 3:], turn, axis=1).T
    first = np.column_stack([a, d, e, f])
    low = b < c
    second = np.where(low[:, None], np.column_stack([a, b, c, f]), np.column_stack([a, b, c, e]))
    third = np.where(low[:, None], np.column_stack([a, b, f, e]), np.column_stack([a, c, f, e]))
    return np.concatenate([first, second, third])


def _positive(name: str, values: Sequence[float]) -> None:
    if not all(np.isfinite(v) and v > 0 for v in values):
        shown = values[0] if len(values) == 1 else list(values)
        raise InputError(f"shape {name} = {shown} must be positive and finite: give lengths in metres")
