"""Columns of prisms over a triangulated plane, cut into tetrahedra."""

import numpy as np


def stacked(plane: np.ndarray, triangles: np.ndarray, heights: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Points (n L, 3) and tetrahedra (3 m (L - 1), 4) between planes of n nodes at L heights.

    Args:
        plane: x and y of the nodes of every plane (n, 2) [m].
        triangles: their triangles (m, 3), counter-clockwise.
        heights: of the planes (L,) [m], rising.
    """
    n = len(plane)
    points = np.column_stack([np.tile(plane, (len(heights), 1)), np.repeat(heights, n)])
    layers = [np.hstack([triangles + k * n, triangles + (k + 1) * n]) for k in range(len(heights) - 1)]
    return points, _split(np.concatenate(layers))


def _split(prisms: np.ndarray) -> np.ndarray:
    """Cut prisms (bottom a b c, top d e f) in three; diagonals start at the lower node number, so faces match."""
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
