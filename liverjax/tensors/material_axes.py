"""Stress and stiffness in three material axes a_m (columns of A): principal directions, or fibre, sheet and normal.

With the deformation gradient F and f_m = F a_m, the material part of the stiffness between two nodes is sum_mn kappa_mn
f_m (x) f_n. The coefficients kappa_mn contain the moduli and the shape vectors of the two nodes. The shape vector of a
node is the gradient D of its shape function; in the material axes it is A^T D.
"""

from typing import Any

import jax

from liverjax.core.struct import Number
from liverjax.tensors.matrices import Matrix, Vector, dot, matmul, stored, transpose

#: `PAIRS`: pairs of different axes. `SIX`: indices of the six components of a symmetric matrix.
PAIRS = ((0, 1), (0, 2), (1, 2))
SIX = ((0, 0), (1, 1), (2, 2), *PAIRS)


def symmetric(six: tuple) -> Matrix:
    """Return the symmetric matrix with the six components 11, 22, 33, 12, 13, 23."""
    xx, yy, zz, xy, xz, yz = six
    return ((xx, xy, xz), (xy, yy, yz), (xz, yz, zz))


def six_of(S: Matrix) -> tuple:
    """Return the six components 11, 22, 33, 12, 13, 23 of a symmetric matrix."""
    return tuple(S[i][j] for i, j in SIX)


def rotated(S: Matrix, A: Matrix) -> Matrix:
    """Return the product A S A^T for a symmetric matrix S. Only the six different entries are computed."""
    AS = matmul(A, S)
    return symmetric(tuple(dot(AS[i], A[j]) for i, j in SIX))


def orthotropic(normal: Matrix, shear: Vector, a: Vector, b: Vector) -> Matrix:
    """Return the coefficients kappa for the shape vectors a and b of two nodes, in the material axes.

    The moduli are C_mmnn (`normal`), and C_mnmn (`shear`) for the pairs 12, 13, 23.
    """
    kappa = [[normal[m][n] * (a[m] * b[n]) for n in range(3)] for m in range(3)]
    for (m, n), G in zip(PAIRS, shear, strict=True):
        kappa[m][n] = kappa[m][n] + G * (a[n] * b[m])
        kappa[n][m] = kappa[n][m] + G * (a[m] * b[n])
        kappa[m][m] = kappa[m][m] + G * (a[n] * b[n])
        kappa[n][n] = kappa[n][n] + G * (a[m] * b[m])
    return tuple(map(tuple, kappa))


_INDEX = ((0, 3, 4), (3, 1, 5), (4, 5, 2))


def half_contracted(moduli: Any, b: Vector) -> list:
    """Return the sums T_mpn = sum_q C_mpnq b_q, from which `anisotropic` computes the coefficients kappa.

    The 6 x 6 moduli C are in the order of `SIX`. b is the shape vector of the second node.
    """
    return [
        [[_contract([moduli[_INDEX[m][p]][_INDEX[n][q]] for q in range(3)], b) for n in range(3)] for p in range(3)]
        for m in range(3)
    ]


def anisotropic(T: list, a: Vector) -> Matrix:
    """Return the coefficients kappa_mn = sum_p a_p T_mpn.

    a is the shape vector of the first node, and T the result of `half_contracted`.
    """
    return tuple(tuple(_contract([T[m][p][n] for p in range(3)], a) for n in range(3)) for m in range(3))


def _contract(values: list, a: Vector) -> jax.Array:
    """Return the scalar product of `values` and `a`.

    Terms in which an entry of `a` is the Python number 0 are omitted.
    """
    terms = [v if isinstance(c, float) and c == 1 else v * c for v, c in zip(values, a, strict=True) if not _is_zero(c)]
    return sum(terms[1:], terms[0])


def _is_zero(c: Number) -> bool:
    return isinstance(c, float) and c == 0


def pushed(FA: Matrix, kappa: Matrix) -> Matrix:
    """Return the sum of kappa_mn f_m (x) f_n over m and n. The vectors f_m are the columns of F A."""
    return matmul(stored(matmul(FA, kappa)), transpose(FA))
