"""Shape functions of straight tetrahedra, and their integration points.

L_k are the barycentric coordinates. Their gradients D_k are constant; these are the shape vectors of the linear
element. N_a are the shape functions, and x_a the positions of the nodes. With c_ak = dN_a/dL_k and y_k = sum_a c_ak
x_a, the deformation gradient F is (⊗: tensor product):

    grad N_a = sum_k c_ak D_k,    so    F = sum_a x_a ⊗ grad N_a = sum_k y_k ⊗ D_k

So at each point, an element of any order behaves like a linear element with corners y_k. The formulas for force and
stiffness of linear elements (`liverjax.elements.mjed`) therefore hold at every point, and no matrix is inverted.

The functions of order 2 are L_k (2 L_k - 1) for the vertices and 4 L_i L_j for the edges (10 nodes). Order 3 adds L_i
L_j (L_i - L_j) for the edges and 27 L_i L_j L_k for the faces. The unknowns of these additional functions are not
positions. Order 3 is used to estimate the mesh error (`liverjax.simulation.mesh_error`).
"""

from functools import cache
from typing import NamedTuple

import numpy as np

from liverjax.mesh.adjacency import PAIRS

#: Corners of the faces of an element. Face k is opposite to corner k.
FACES = ((1, 2, 3), (0, 2, 3), (0, 1, 3), (0, 1, 2))


class Basis(NamedTuple):
    """Shape functions at the integration points of an element. The NumPy arrays are the same for all elements."""

    weights: np.ndarray  # weights of the Q points (Q,), with the sum 1
    L: np.ndarray  # the 4 linear functions (4, Q)
    N: np.ndarray  # all n functions (n, Q)
    c: np.ndarray  # derivatives of N with respect to L (n, 4, Q)


@cache
def basis(order: int) -> Basis:
    """Return the shape functions of `order` 2 or 3 at the points of an integration rule.

    The rule integrates products of two gradients of these functions exactly.
    """
    weights, L = _four_points() if order == 2 else _fourteen_points()
    return Basis(weights, L, *functions(order, L))


def functions(order: int, L: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the functions N (n, Q) and derivatives c = dN/dL (n, 4, Q) at barycentric coordinates L (4, Q)."""
    values = [L[k] * (2 * L[k] - 1) for k in range(4)] + [4 * L[i] * L[j] for i, j in PAIRS]
    slopes = [{k: 4 * L[k] - 1} for k in range(4)] + [{i: 4 * L[j], j: 4 * L[i]} for i, j in PAIRS]
    if order == 3:
        values += [L[i] * L[j] * (L[i] - L[j]) for i, j in PAIRS]
        slopes += [{i: (2 * L[i] - L[j]) * L[j], j: (L[i] - 2 * L[j]) * L[i]} for i, j in PAIRS]
        values += [27 * L[i] * L[j] * L[k] for i, j, k in FACES]
        slopes += [{i: 27 * L[j] * L[k], j: 27 * L[i] * L[k], k: 27 * L[i] * L[j]} for i, j, k in FACES]
    c = np.zeros((len(values), *L.shape))
    for a, slope in enumerate(slopes):
        for k, value in slope.items():
            c[a, k] = value
    return np.stack(values), c


def _four_points() -> tuple[np.ndarray, np.ndarray]:
    """Return weights (4,) and barycentric coordinates (4, 4) of a rule of degree 2 (Hammer and Stroud 1956)."""
    near, far = (5 + 3 * np.sqrt(5)) / 20, (5 - np.sqrt(5)) / 20
    return np.full(4, 0.25), far + (near - far) * np.eye(4)


def _fourteen_points() -> tuple[np.ndarray, np.ndarray]:
    """Return positive weights (14,) and barycentric coordinates (4, 14) of a rule of degree 5 (Walkington 2000)."""
    columns, weights = [], []
    for a, w in ((0.31088591926330060980, 0.11268792571801585080), (0.092735250310891226402, 0.073493043116361949544)):
        columns += [np.where(np.arange(4) == k, 1 - 3 * a, a) for k in range(4)]
        weights += 4 * [w]
    a = 0.045503704125649649492
    columns += [np.where(np.isin(np.arange(4), pair), 0.5 - a, a) for pair in PAIRS]
    weights += 6 * [0.042546020777081466438]
    return np.array(weights) / np.sum(weights), np.stack(columns, axis=1)


@cache
def triangle_rule(degree: int = 4) -> tuple[np.ndarray, np.ndarray]:
    """Return weights (Q,) and barycentric coordinates (3, Q) of an integration rule on a triangle.

    The degree of the rule is 4 (Dunavant 1985) or 5 (Radon 1948).
    """
    pairs = [(0.445948490915965, 0.223381589678011), (0.091576213509771, 0.109951743655322)]
    if degree == 5:
        root = np.sqrt(15)
        pairs = [((6 + sign * root) / 21, (155 + sign * root) / 1200) for sign in (-1, 1)]
    columns = [np.where(np.arange(3) == k, 1 - 2 * a, a) for a, _ in pairs for k in range(3)]
    weights = [w for _, w in pairs for _ in range(3)]
    if degree == 5:
        columns, weights = [*columns, np.full(3, 1 / 3)], [*weights, 9 / 40]
    return np.array(weights) / np.sum(weights), np.stack(columns, axis=1)
