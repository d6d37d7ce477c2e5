"""Make columns of prisms over a triangulated plane, and cut them into tetrahedra."""

import numpy as np


def stacked(plane: np.ndarray, triangles: np.ndarray, heights: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the points (n L, 3) [m] of L planes with n nodes each, and the tetrahedra (3 m (L - 1), 4) between them.

    Args:
        plane: x and y of the nodes in every plane (n, 2) [m].
        triangles: triangles of a plane (m, 3), counter-clockwise.
        heights: heights of the planes (L,) [m], increasing.
    """
    n = len(plane)
    points = np.column_stack([np.tile(plane, (len(heights), 1)), np.repeat(heights, n)])
    layers = [np.hstack([triangles + k * n, triangles + (k + 1) * n]) for k in range(len(heights) - 1)]
    return points, _split(np.concatenate(layers))


def _split(prisms: np.ndarray) -> np.ndarray:
    """Cut each prism (bottom nodes a b c, top nodes d e f) into three tetrahedra.

    On each side of a prism, the diagonal starts at the node with the lowest number, so neighbouring prisms match.
    """
    # Rotate each prism so that its bottom node with the lowest number is first. Then prisms differ only in the diagonal
    # of the side opposite to this node.
    shift = np.argmin(prisms[:, :3], axis=1)
    turn = (np.arange(3)[None] + shift[:, None]) % 3
    a, b, c = np.take_along_axis(prisms[:, :3], turn, axis=1).T
    d, e, f = np.take_along_axis(prisms[:, 3:], turn, axis=1).T
    first = np.column_stack([a, d, e, f])
    low = b < c
    second = np.where(low[:, None], np.column_stack([a, b, c, f]), np.column_stack([a, b, c, e]))
    third = np.where(low[:, None], np.column_stack([a, b, f, e]), np.column_stack([a, c, f, e]))
    return np.concatenate([first, second, third])
