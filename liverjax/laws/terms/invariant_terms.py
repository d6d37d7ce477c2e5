"""Hand-derived terms at one deformation gradient: stress, tangent, and the stiffness between pairs of nodes.

They are the terms of section 4.1.2 of the book chapter, summed over the products g^k(I1, I2) h^k(J) of the energy. Here
J is an invariant like I1 and I2. With the energy W, the invariants I_a, the positions x_i of the nodes, W_a = dW/dI_a,
W_ab = d2W/dI_a dI_b and v_a,i = dI_a/dx_i,

    d2W/dx_i dx_j = sum_ab W_ab v_a,i (x) v_b,j + sum_a W_a d2I_a/dx_i dx_j

No matrix is inverted. Energies of principal stretches and of Green's strain add their second Piola-Kirchhoff stress to
S (see `Stress`), and their moduli to the stiffness.
"""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from liverjax.laws.energies import Energies, fibre_invariants
from liverjax.laws.terms import green_terms, stretch_terms
from liverjax.tensors.directions import components
from liverjax.tensors.matrices import (
    Matrix,
    Vector,
    add,
    add_matrices,
    cofactor,
    cross,
    dot,
    matmul,
    matvec,
    outer,
    right_cauchy_green,
    scale,
    scale_matrix,
    stored,
    transpose,
)
from liverjax.tensors.principal import principal
from liverjax.tensors.subsets import Subsets, in_subset, put_together


class Stress(NamedTuple):
    """Stress P = F S + p cof F, with p = dW/dJ. `S` is a symmetric matrix, or an array s for the matrix s Id."""

    S: Matrix | Any
    p: jax.Array


class Scalars(NamedTuple):
    """First and second derivatives of an energy with respect to invariants, at one deformation gradient."""

    first: dict
    second: dict


class State(NamedTuple):
    """Values at one deformation gradient that both force and stiffness need."""

    laws: tuple  # summands of the law, for their energies of stretches and of Green's strain
    F: Matrix
    C: Matrix | None
    cof: Matrix
    I1: Any
    J: jax.Array
    first: dict
    second: dict
    fibres: dict  # name of an invariant I4 -> fibre direction of the law with this invariant
    frame: Any  # principal stretches and axes, if a summand has an energy of stretches


class Pieces(NamedTuple):
    """The states of several laws, each in the elements of its region."""

    subsets: Subsets
    states: tuple[State, ...]
    F: Matrix
    cof: Matrix


def state(law: Energies, F: Matrix) -> State | Pieces:
    """Return the invariants and derivatives of the law (`liverjax.laws.base.Law`) at F."""
    if law.subsets is not None:
        own = (_state_of_law(law.piece(k), in_subset(law.subsets, k, F)) for k in range(len(law.pieces())))
        return Pieces(law.subsets, tuple(own), F, cofactor(F))
    return _state_of_law(law, F)


def _state_of_law(law: Energies, F: Matrix) -> State:
    return _state(Scalars(*law.energy_derivatives(law.measures(F))), F, law.summands())


def state_of(scalars: Scalars, F: Matrix) -> State:
    """Return the state at F of an energy of I1, I2 and J. `scalars`: derivatives of this energy."""
    return _state(scalars, F, ())


def _state(scalars: Scalars, F: Matrix, laws: tuple) -> State:
    """Return the state at F. C is computed only if W depends on I2; principal stretches only if a law needs them."""
    first, second = scalars
    cof = cofactor(F)
    C = right_cauchy_green(F) if "I2" in first else None
    I1 = None if C is None else C[0][0] + C[1][1] + C[2][2]
    fibres = {key: components(part.fibre, F[0][0]) for key, part in fibre_invariants(laws).items()}
    frame = principal(F) if any(part.stretch_energy is not None for part in laws) else None
    return State(laws, F, C, cof, I1, dot(F[0], cof[0]), first, second, fibres, frame)


def stress(s: State | Pieces) -> Stress:
    """Return S = 2 W_1 Id + 2 W_2 (I1 Id - C) + 2 W_4 a (x) a + … and p = W_J, with W_k = dW/dI_k and the fibre a.

    A derivative W_k that is not in the state is 0.
    """
    if isinstance(s, Pieces):
        return _put_together(s.subsets, [stress(own) for own in s.states])
    W1, W2, p = s.first.get("I1", 0.0), s.first.get("I2"), s.first.get("J", 0.0)
    tensors = [scale_matrix(2 * s.first[key], outer(a, a)) for key, a in s.fibres.items()]
    tensors += [stretch_terms.stress(law, s.F, s.frame) for law in s.laws if law.stretch_energy is not None]
    tensors += [green_terms.stress(law, s.F) for law in s.laws if law.green_energy is not None]
    if W2 is not None:
        diagonal = 2 * (W1 + s.I1 * W2)
        assert s.C is not None
        C = scale_matrix(-2 * W2, s.C)
        tensors.append(tuple(tuple(C[i][j] + (diagonal if i == j else 0.0) for j in range(3)) for i in range(3)))
    if not tensors:
        return Stress(2 * W1, p)
    S = tensors[0]
    for other in tensors[1:]:
        S = add_matrices(S, other)
    if W2 is None and "I1" in s.first:
        S = tuple(tuple(S[i][j] + (2 * W1 if i == j else 0.0) for j in range(3)) for i in range(3))
    return Stress(S, p)


def _put_together(subsets: Subsets, found: list[Stress]) -> Stress:
    """Join the stresses of all regions. If one of these stresses is a matrix, all are written as matrices."""
    if any(isinstance(S, tuple) for S, _ in found):
        found = [Stress(S if isinstance(S, tuple) else _spherical(S), p) for S, p in found]
    return put_together(subsets, found)


def _spherical(S: Any) -> Matrix:
    zero = jnp.zeros_like(S)
    return ((S, zero, zero), (zero, S, zero), (zero, zero, S))


def piola(F: Matrix, cof: Matrix, resultant: Stress) -> Matrix:
    """Return the first Piola-Kirchhoff stress P = F S + p cof F [Pa]."""
    S, p = resultant
    FS = matmul(F, S) if isinstance(S, tuple) else scale_matrix(S, F)
    return tuple(tuple(FS[i][j] + p * cof[i][j] for j in range(3)) for i in range(3))


#: Minimum |J| in the denominator of the second Piola-Kirchhoff stress. A smaller |J| is replaced by this value.
_FLAT = 1e-3


def second_piola(F: Matrix, resultant: Stress) -> Matrix:
    """Return the second Piola-Kirchhoff stress S + p J C^-1 [Pa] of P = F S + p cof F.

    Section 4.2 of the book chapter uses F^-1, which does not exist at J = 0. Here J C^-1 = cof(F)^T cof(F) / J is used,
    with a denominator of at least 1e-3 in absolute value.
    """
    S, p = resultant
    cof = cofactor(F)
    columns = transpose(cof)
    J = dot(F[0], cof[0])
    p_over_J = p / jnp.where(abs(J) < _FLAT, jnp.copysign(_FLAT, J), J)

    def entry(i: int, j: int) -> jax.Array:
        s = S[i][j] if isinstance(S, tuple) else (S if i == j else 0.0)
        return s + p_over_J * dot(columns[i], columns[j])

    return tuple(tuple(entry(min(i, j), max(i, j)) for j in range(3)) for i in range(3))


def first_piola(law: Energies, F: Matrix) -> Matrix:
    """Return the first Piola-Kirchhoff stress [Pa] at a deformation gradient F, a tuple matrix."""
    s = state(law, F)
    return piola(F, s.cof, stress(s))


def slopes(s: State, D: Vector) -> dict[str, Vector]:
    """Return derivatives at a node with shape vector D: dJ/dx = cof F D, and half of dI/dx for I1, I2 and I4.

    Half of dI/dx is F D for I1, F (I1 Id - C) D for I2, and (a.D) F a for I4 with the fibre a.
    """
    FD = matvec(s.F, D)
    v = {"I1": FD, **{key: scale(dot(a, D), matvec(s.F, a)) for key, a in s.fibres.items()}}
    if "J" in s.first:
        v["J"] = matvec(s.cof, D)
    if s.C is not None:
        v["I2"] = add(scale(s.I1, FD), scale(-1.0, matvec(s.F, matvec(s.C, D))))
    return v


def _weight(invariant: str) -> float:
    return 1.0 if invariant == "J" else 2.0


class _Parts(NamedTuple):
    """Values that the stiffness of all node pairs needs."""

    J: jax.Array
    first: dict
    second: dict
    slopes: list[dict]  # `slopes` of every node
    diagonal: dict  # (i, j) -> D_i . S D_j
    turning: dict  # (i, j) -> W_J F (D_i x D_j), only for i != j (otherwise it is 0)
    metric: dict  # (i, j) -> D_i . D_j, if the energy depends on I2
    left: Matrix | None  # F F^T, if the energy depends on I2


def _parts(s: State, D: list[Vector], pairs: tuple[tuple[int, int], ...]) -> _Parts:
    """Compute the values that the stiffness of all node pairs needs, and write these values to memory.

    Without this, JAX on CPUs would compute these values again for each matrix entry, which is 20 % slower.
    """
    S, p = stress(s)
    metric = {(i, j): dot(D[i], D[j]) for i, j in pairs}
    tensor = isinstance(S, tuple)
    diagonal = {(i, j): dot(D[i], matvec(S, D[j])) if tensor else S * metric[i, j] for i, j in pairs}
    turning = {(i, j): scale(p, matvec(s.F, cross(D[i], D[j]))) for i, j in pairs if i != j and "J" in s.first}
    left = right_cauchy_green(transpose(s.F)) if "I2" in s.first else None
    v = [slopes(s, d) for d in D]
    return stored(_Parts(s.J, s.first, s.second, v, diagonal, turning, metric if left else {}, left))


def _block(s: _Parts, pair: tuple[int, int], regularised: bool) -> Matrix:
    """Return the stiffness between two nodes, without the parts from energies of stretches and of Green's strain."""
    vi, vj = s.slopes[pair[0]], s.slopes[pair[1]]
    second = dict(s.second)
    W_JJ = second.pop(("J", "J"), None) if regularised else None
    # The sum is written as v_a,i (x) (sum_b W_ab v_b,j), which needs only one outer product per invariant a.
    partner: dict[str, Vector] = {}
    for (a, b), W in second.items():
        for row, column in dict.fromkeys(((a, b), (b, a))):
            term = scale(W * (_weight(row) * _weight(column)), vj[column])
            partner[row] = add(partner[row], term) if row in partner else term
    W2 = s.first.get("I2")
    if W2 is not None:  # W_2 d2I2 = 2 W_2 (… + 2 FDi (x) FDj - FDj (x) FDi - (Di.Dj) F F^T)
        term = scale(4 * W2, vj["I1"])
        partner["I1"] = add(partner["I1"], term) if "I1" in partner else term
    K = [[sum((vi[a][r] * q[c] for a, q in partner.items()), 0.0) for c in range(3)] for r in range(3)]
    if W2 is not None and s.left is not None:
        swapped, metric = scale(-2 * W2, vj["I1"]), -2 * W2 * s.metric[pair]
        for r in range(3):
            for c in range(3):
                K[r][c] = K[r][c] + swapped[r] * vi["I1"][c] + metric * s.left[r][c]
    # The sum of W_1 d2I1 and the first term of W_2 d2I2 is D_i . S D_j Id.
    diagonal = s.diagonal[pair]
    if W_JJ is not None:
        eps = jnp.clip(1 - s.J, 0, 1)
        diagonal = diagonal + W_JJ * eps / 3 * dot(vi["J"], vj["J"])
        for r in range(3):
            for c in range(3):
                K[r][c] = K[r][c] + W_JJ * (1 - eps) * vi["J"][r] * vj["J"][c]
    for r in range(3):
        K[r][r] = K[r][r] + diagonal
    if pair in s.turning:  # W_J d2J = -W_J [F (D_i x D_j)]_x
        n = s.turning[pair]
        for r, c, q in ((0, 1, n[2]), (2, 0, n[1]), (1, 2, n[0])):
            K[r][c], K[c][r] = K[r][c] + q, K[c][r] - q
    return tuple(tuple(row) for row in K)


def blocks(
    s: State | Pieces, D: list[Vector], pairs: tuple[tuple[int, int], ...], regularised: bool = False
) -> list[Matrix]:
    """Return stiffness matrices d2W/dx_i dx_j per reference volume: the chapter's terms G + H + I + Lambda + M + R.

    Args:
        s: `state` of the element.
        D: shape vectors of the nodes of the element [1/m].
        pairs: pairs (i, j) of nodes, as indices into D. The result has one matrix for each pair.
        regularised: whether to replace G as in section 4.1.2 iii of the book chapter, with eps = 1 - J, limited to the
            range from 0 to 1. In the term with the identity matrix, eps/3 is used where the chapter prints eps, so that
            the trace of G does not change.
    """
    if isinstance(s, Pieces):
        own = [blocks(each, in_subset(s.subsets, k, D), pairs, regularised) for k, each in enumerate(s.states)]
        return put_together(s.subsets, own)
    if s.frame is not None:
        s = s._replace(frame=stored(s.frame))
    parts = _parts(s, D, pairs)
    result = [_block(parts, pair, regularised) for pair in pairs]
    for law in s.laws:
        if law.stretch_energy is not None:
            more = stretch_terms.blocks(law, s.F, s.frame, D, pairs)
            result = [add_matrices(a, b) for a, b in zip(result, more, strict=True)]
        if law.green_energy is not None:
            more = green_terms.blocks(law, s.F, D, pairs)
            result = [add_matrices(a, b) for a, b in zip(result, more, strict=True)]
    return result


_UNIT_VECTORS = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))


def tangent(s: State | Pieces) -> list[list[Matrix]]:
    """Return d2W/dF dF [Pa] as nested lists [J][L] of matrices (i, k). The function `blocks` computes these matrices,
    with the unit vectors e_J and e_L as shape vectors."""
    pairs = tuple((J, L) for J in range(3) for L in range(3))
    A = blocks(s, list(_UNIT_VECTORS), pairs)
    return [A[3 * J : 3 * J + 3] for J in range(3)]
