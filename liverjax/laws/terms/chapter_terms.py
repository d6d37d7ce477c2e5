"""Stress and stiffness as in the book chapter (section 4.1.2), for an energy that is a sum of products g^k(I1, I2)
h^k(J). The stiffness has six terms for every product.

This is a variant for comparison. The default, `liverjax.laws.terms.invariant_terms`, first adds the scalar derivatives
of all products. The default gives the same values up to roundoff, and its cost does not grow with the number of
products. `liverjax.laws.terms.products` writes the laws as sums of such products.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp

from liverjax.core.struct import Number, T
from liverjax.laws.energies import Energies
from liverjax.laws.terms import products
from liverjax.tensors.matrices import (
    IDENTITY,
    Matrix,
    Vector,
    add_matrices,
    cofactor,
    cross,
    dot,
    invariants,
    matmul,
    matvec,
    outer,
    right_cauchy_green,
    scale,
    scale_matrix,
    stored,
    transpose,
)


class _Term(NamedTuple):
    """Scalars of one product: g(I1, I2) with its partial derivatives, and h(J) with its derivatives."""

    g: Number
    g1: Number
    g2: Number
    g11: Number
    g12: Number
    g22: Number
    h: Number
    h1: jax.Array
    h2: jax.Array


def _power(x: Number, n: int) -> Number:
    return 1.0 if n == 0 else x**n


def _term(k: products.Product, I1: Number, I2: Number, J: jax.Array) -> _Term:
    c, i, j, p = k

    def g(a: int, b: int) -> Number:
        """Return the derivative of g, of order a with respect to I1 and of order b with respect to I2."""
        factor = (1, i, i * (i - 1))[a] * (1, j, j * (j - 1))[b]
        return 0.0 if factor == 0 else c * factor * _power(I1, i - a) * _power(I2, j - b)

    h = J**p if p else 1.0
    inverse = 1 / J
    return _Term(g(0, 0), g(1, 0), g(0, 1), g(2, 0), g(1, 1), g(0, 2), h, p * h * inverse, p * (p - 1) * h * inverse**2)


class _At(NamedTuple):
    F: Matrix
    C: Matrix
    B: Matrix  # I1 Id - C
    cof: Matrix
    J: jax.Array
    # for each group of products with the energy phi(sum of products): its terms, phi' and phi'' (None if phi'' is 0)
    groups: list


def _state_at(law: Energies, F: Matrix) -> _At:
    C, I = right_cauchy_green(F), invariants(("I1", "I2", "J"), F)
    B = tuple(tuple((I.I1 if r == c else 0.0) - C[r][c] for c in range(3)) for r in range(3))
    groups = []
    for part in law.summands():
        for group in products.groups(part):
            terms = [_term(k, I.I1, I.I2, I.J) for k in group.products]
            first, second = (1.0, 0.0) if group.slopes is None else group.slopes(sum(t.g * t.h for t in terms))
            groups.append((terms, first, None if group.slopes is None else second))
        for h1, h2 in products.functions_of_volume(part, I.J):
            groups.append(([_Term(1.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, h1, h2)], 1.0, None))
    return _At(F, C, B, cofactor(F), I.J, groups)


def _stress_of_product(t: _Term, s: _At) -> Matrix:
    """Return S^k = 2 dg/dC of the product W^k = g(I1, I2) h(J). No matrix is inverted."""
    return add_matrices(scale_matrix(2 * t.g1, IDENTITY), scale_matrix(2 * t.g2, s.B))


def first_piola(law: Energies, F: Matrix) -> Matrix:
    """Return the first Piola-Kirchhoff stress [Pa] of the products g h: sum_k phi' (h' g cof F + h F S^k).

    phi is the function of a group of products (`liverjax.laws.terms.products.Group`), and S^k = 2 dg/dC.
    """
    s = _state_at(law, F)
    total = scale_matrix(0.0, F)
    for terms, phi1, _ in s.groups:
        for t in terms:
            P = add_matrices(scale_matrix(t.h1 * t.g, s.cof), scale_matrix(t.h, matmul(F, _stress_of_product(t, s))))
            total = add_matrices(total, scale_matrix(phi1, P))
    return total


def constant_matrices(D: list[Vector], pairs: tuple) -> list[tuple[Matrix, jax.Array]]:
    """Return constant parts of the chapter's matrices L and U: D_i (x) D_j and D_i . D_j for pairs of shape vectors."""
    return [(outer(D[i], D[j]), dot(D[i], D[j])) for i, j in pairs]


class Layout(NamedTuple):
    """Options: which values are stored in memory. The default is the fastest choice (experiments/chapter)."""

    #: `constant_matrices(D, pairs)`, stored in advance as the chapter proposes. None means that the values are computed
    #: when they are used.
    constant: list | None = None
    #: Whether values that several stiffness matrices need are written to memory, as `invariant_terms` does. In this
    #: module, this is slower.
    write: bool = False


def blocks(
    law: Energies,
    F: Matrix,
    D: list[Vector],
    pairs: tuple,
    regularised: bool = False,
    layout: Layout = Layout(),
) -> list[Matrix]:
    """Return stiffness matrices d2W/dx_i dx_j per reference volume, for pairs (i, j) of nodes with shape vectors D.

    A matrix is the sum of the chapter's terms G + H + I + Lambda + M + R over all products, plus the term with phi'' of
    each group of products. `regularised` changes the term G of every product, but not the term with phi''.
    """
    keep = _written if layout.write else lambda values: values
    s = keep(_state_at(law, F))
    nodes = keep([_node(s, d) for d in D])
    constant = constant_matrices(D, pairs) if layout.constant is None else layout.constant
    return [_six_terms(s, nodes[i], nodes[j], c, regularised) for (i, j), c in zip(pairs, constant, strict=True)]


class _Node(NamedTuple):
    """Values at one node that the six terms need."""

    D: Vector
    cof: Vector  # cof F D
    B: Vector  # B D
    S: list[list[Vector]]  # S^k D, for each group and term
    FS: list[list[Vector]]  # F S^k D


def _node(s: _At, D: Vector) -> _Node:
    S = [[matvec(_stress_of_product(t, s), D) for t in terms] for terms, _, _ in s.groups]
    return _Node(D, matvec(s.cof, D), matvec(s.B, D), S, [[matvec(s.F, v) for v in group] for group in S])


def _written(values: T) -> T:
    """Return the pytree with its arrays written to memory (`stored`). Plain numbers are not changed."""
    leaves, tree = jax.tree.flatten(values)
    arrays = iter(stored([v for v in leaves if jnp.ndim(v)]))
    return jax.tree.unflatten(tree, [next(arrays) if jnp.ndim(v) else v for v in leaves])


def _six_terms(s: _At, i: _Node, j: _Node, constant: tuple[Matrix, Number], regularised: bool) -> Matrix:
    K = scale_matrix(0.0, IDENTITY)
    for n, (terms, phi1, phi2) in enumerate(s.groups):
        for t, FSDi, FSDj, SDj in zip(terms, i.FS[n], j.FS[n], j.S[n], strict=True):
            G = scale_matrix(t.h2 * t.g, outer(i.cof, j.cof))
            if regularised:  # with eps/3 the trace of G does not change (the chapter prints eps)
                eps = jnp.clip(1 - s.J, 0, 1)
                trace = scale_matrix(t.h2 * t.g * eps / 3 * dot(i.cof, j.cof), IDENTITY)
                G = add_matrices(scale_matrix(1 - eps, G), trace)
            H = scale_matrix(t.h1 * t.g, _second_derivative_of_J(s.F, i.D, j.D))
            I_ = scale_matrix(t.h1, outer(i.cof, FSDj))
            Lambda = scale_matrix(t.h1, outer(FSDi, j.cof))
            M = scale_matrix(t.h * dot(i.D, SDj), IDENTITY)
            R = scale_matrix(t.h, matmul(matmul(s.F, _linear_matrices(t, i, j, constant)), transpose(s.F)))
            for part in (G, H, I_, Lambda, M, R):
                K = add_matrices(K, scale_matrix(phi1, part))
        if phi2 is not None:
            K = add_matrices(K, scale_matrix(phi2, outer(_slope(terms, i, n), _slope(terms, j, n))))
    return K


def _second_derivative_of_J(F: Matrix, Di: Vector, Dj: Vector) -> Matrix:
    """Return d2J/dx_i dx_j = -[F (D_i x D_j)]_x, where [v]_x is the matrix of the cross product with v."""
    n0, n1, n2 = matvec(F, cross(Di, Dj))
    return ((0.0, n2, -n1), (-n2, 0.0, n0), (n1, -n0, 0.0))


def _linear_matrices(t: _Term, i: _Node, j: _Node, constant: tuple[Matrix, Number]) -> Matrix:
    """Return the sum L + U of the chapter's matrices L and U.

    They follow from dS/dC : H = beta H + sum delta_ab (B_b : H) B_a for any symmetric H, with B_1 = Id and B_2 = I1 Id
    - C. The numbers beta and delta_ab are combinations of derivatives of g.
    """
    DiDj, product = constant
    beta = -2 * t.g2
    L = add_matrices(scale_matrix(beta, transpose(DiDj)), scale_matrix(beta * product, IDENTITY))
    U = scale_matrix(4 * (t.g11 + t.g2), DiDj)
    for weight, a, b in ((t.g12, i.D, j.B), (t.g12, i.B, j.D), (t.g22, i.B, j.B)):
        U = add_matrices(U, scale_matrix(4 * weight, outer(a, b)))
    return add_matrices(L, U)


def _slope(terms: list[_Term], node: _Node, n: int) -> Vector:
    """Return the derivative d(sum_k g h)/dx with respect to the position of a node, for the terms of group n."""
    v = scale(sum(t.h1 * t.g for t in terms), node.cof)
    for t, FS in zip(terms, node.FS[n], strict=True):
        v = tuple(a + t.h * b for a, b in zip(v, FS, strict=True))
    return v
