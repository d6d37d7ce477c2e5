"""MJED: force and stiffness of linear tetrahedra from hand-derived terms, all terms of the energy at once.

Chapter, section 4.1.2, with J treated as one more invariant and the scalars summed before anything is assembled:

    f_i  = V0 sum_a W_a v_a,i                                             v_a,i = dI_a/dx_i
    K_ij = V0 [ sum_ab W_ab v_a,i (x) v_b,j + sum_a W_a d2I_a/dx_i dx_j ]

so the cost does not grow with the number of terms g^k h^k. No matrix is inverted. All functions take the force as the
gradient of the energy, f = + dW/dx (the chapter's nodal force is its negative).
"""

from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import scipy.sparse

from liverjax.kinematics import (
    Matrix,
    Vector,
    add,
    cofactor,
    cross,
    deformation_gradient,
    dot,
    invariants,
    matmul,
    matvec,
    right_cauchy_green,
    scale,
    transpose,
)
from liverjax.laws.base import Law
from liverjax.mesh import TetMesh


class Stress(NamedTuple):
    """P = F S + p cof F, arrays of shape (E,): `S` a symmetric matrix or, where it is spherical, one array; p = W_J."""

    S: Matrix | Any
    p: Any


class State(NamedTuple):
    """What force and stiffness share at one deformation gradient."""

    F: Matrix
    C: Matrix | None
    cof: Matrix
    I1: Any
    J: Any
    first: dict
    second: dict


def state(law: Law, F: Matrix) -> State:
    """Invariants that the law asks for and its scalar derivatives; C only where I2 needs it."""
    C = right_cauchy_green(F) if "I2" in law.invariants else None
    I = invariants(law.invariants, F, C)
    first, second = law.energy_derivatives(I)
    return State(F, C, cofactor(F), I.I1, I.J, first, second)


def stress(s: State) -> Stress:
    """S = 2 W_1 Id + 2 W_2 (I1 Id - C) and p = W_J; absent derivatives leave no term."""
    W1, W2, p = s.first.get("I1", 0.0), s.first.get("I2"), s.first.get("J", 0.0)
    if W2 is None:
        return Stress(2 * W1, p)
    diagonal = 2 * (W1 + s.I1 * W2)
    C = scale(-2 * W2, s.C[0]), scale(-2 * W2, s.C[1]), scale(-2 * W2, s.C[2])
    return Stress(tuple(tuple(C[i][j] + (diagonal if i == j else 0.0) for j in range(3)) for i in range(3)), p)


def piola(F: Matrix, cof: Matrix, resultant: Stress) -> Matrix:
    """P = F S + p cof F."""
    S, p = resultant
    FS = matmul(F, S) if isinstance(S, tuple) else tuple(scale(S, row) for row in F)
    return tuple(tuple(FS[i][j] + p * cof[i][j] for j in range(3)) for i in range(3))


def second_piola(F: Matrix, resultant: Stress) -> Matrix:
    """S + p J C^-1 [Pa] of P = F S + p cof F, with J C^-1 = cof(F)^T cof(F) / J.

    Section 4.2 needs F^-1 here, so it is not defined at J = 0: infinite there, and of the other sign beyond.
    """
    S, p = resultant
    cof = cofactor(F)
    columns = transpose(cof)
    p_over_J = p / dot(F[0], cof[0])

    def entry(i: int, j: int) -> Any:
        s = S[i][j] if isinstance(S, tuple) else (S if i == j else 0.0)
        return s + p_over_J * dot(columns[i], columns[j])

    return tuple(tuple(entry(min(i, j), max(i, j)) for j in range(3)) for i in range(3))


def first_piola(law: Law, F: Matrix) -> Matrix:
    """First Piola-Kirchhoff stress [Pa] of a tuple matrix F."""
    s = state(law, F)
    return piola(F, s.cof, stress(s))


def slopes(s: State, D: Vector) -> dict[str, Vector]:
    """FD, F (I1 Id - C) D and cof(F) D: half of dI1/dx and dI2/dx, and dJ/dx, of a node with shape vector D."""
    FD = matvec(s.F, D)
    v = {"I1": FD}
    if "J" in s.first:
        v["J"] = matvec(s.cof, D)
    if s.C is not None:
        v["I2"] = add(scale(s.I1, FD), scale(-1.0, matvec(s.F, matvec(s.C, D))))
    return v


_WEIGHT = {"I1": 2.0, "I2": 2.0, "J": 1.0}


def block(s: State, resultant: Stress, Di: Vector, Dj: Vector, vi: dict, vj: dict, regularised: bool) -> Matrix:
    """d2W/dx_i dx_j per reference volume: the chapter's G, H, I, Lambda, M and R of all terms at once.

    Args:
        s, resultant: `state` and `stress` of the element.
        Di, Dj: shape vectors of the two nodes; vi, vj: their `slopes`.
        regularised: replace G as in section 4.1.2 iii, with eps/3 where the chapter prints eps (the trace is kept).
    """
    second = dict(s.second)
    W_JJ = second.pop(("J", "J"), None) if regularised else None
    # v_a,i (x) sum_b W_ab v_b,j: one outer product an invariant.
    partner: dict[str, Vector] = {}
    for (a, b), W in second.items():
        for row, column in dict.fromkeys(((a, b), (b, a))):
            term = scale(W * (_WEIGHT[row] * _WEIGHT[column]), vj[column])
            partner[row] = add(partner[row], term) if row in partner else term
    W2 = s.first.get("I2")
    if W2 is not None:  # W_2 d2I2 = 2 W_2 (… + 2 FDi (x) FDj - FDj (x) FDi - (Di.Dj) F F^T)
        term = scale(4 * W2, vj["I1"])
        partner["I1"] = add(partner["I1"], term) if "I1" in partner else term
    K = [[sum((vi[a][r] * q[c] for a, q in partner.items()), 0.0) for c in range(3)] for r in range(3)]
    if W2 is not None:
        swapped, metric = scale(-2 * W2, vj["I1"]), -2 * W2 * dot(Di, Dj)
        for r in range(3):
            for c in range(3):
                K[r][c] = K[r][c] + swapped[r] * vi["I1"][c] + metric * dot(s.F[r], s.F[c])
    # W_1 d2I1 and the first part of W_2 d2I2 together: D_i . S D_j Id.
    S, p = resultant
    diagonal = dot(Di, matvec(S, Dj)) if isinstance(S, tuple) else S * dot(Di, Dj)
    if W_JJ is not None:
        eps = jnp.clip(1 - s.J, 0, 1)
        diagonal = diagonal + W_JJ * eps / 3 * dot(vi["J"], vj["J"])
        for r in range(3):
            for c in range(3):
                K[r][c] = K[r][c] + W_JJ * (1 - eps) * vi["J"][r] * vj["J"][c]
    for r in range(3):
        K[r][r] = K[r][r] + diagonal
    if "J" in s.first:  # W_J d2J = -W_J [F (D_i x D_j)]_x
        n = scale(p, matvec(s.F, cross(Di, Dj)))
        for r, c, q in ((0, 1, n[2]), (2, 0, n[1]), (1, 2, n[0])):
            K[r][c], K[c][r] = K[r][c] + q, K[c][r] - q
    return tuple(tuple(row) for row in K)


def tangent(law: Law, F: Matrix, regularised: bool = False) -> list[list[Matrix]]:
    """d2W/dF dF [Pa] as nested [J][L] of matrices (i, k): the blocks of shape vectors e_J and e_L."""
    s = state(law, F)
    e = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))
    v = [slopes(s, D) for D in e]
    resultant = stress(s)
    return [[block(s, resultant, e[J], e[L], v[J], v[L], regularised) for L in range(3)] for J in range(3)]


def energy(mesh: TetMesh, law: Law, x: jax.Array) -> jax.Array:
    """Total strain energy [J] at positions x (V, 3) [m]."""
    F = deformation_gradient(mesh, x)
    C = right_cauchy_green(F) if "I2" in law.invariants else None
    return jnp.sum(mesh.volumes * law.strain_energy(invariants(law.invariants, F, C)))


def nodal_force(mesh: TetMesh, P: Matrix) -> jax.Array:
    """Sum over elements of V0 P D_a at their nodes: (V, 3) [N] from first Piola-Kirchhoff stresses [Pa]."""
    D, V0 = mesh.shape_vectors, mesh.volumes
    forces = [[V0 * dot(P[i], D[a]) for i in range(3)] for a in range(3)]
    forces = [[-(forces[0][i] + forces[1][i] + forces[2][i]) for i in range(3)], *forces]
    columns = []
    for i in range(3):
        # Chained scatters: after a concatenate XLA:CPU recomputes the stress for every update (4 times slower).
        column = jnp.zeros(mesh.points.shape[0], dtype=mesh.points.dtype)
        for a in range(4):
            column = column.at[mesh.tetrahedra[:, a]].add(forces[a][i])
        columns.append(column)
    return jnp.stack(columns, axis=-1)


@jax.jit
def internal_force(mesh: TetMesh, law: Law, x: jax.Array) -> jax.Array:
    """Gradient of the total energy with respect to the positions, (V, 3) [N].

    Args:
        mesh: `TetMesh`.
        law: any law; parameters may be traced.
        x: positions (V, 3) [m].
    """
    return nodal_force(mesh, first_piola(law, deformation_gradient(mesh, x)))


def element_stiffness(
    mesh: TetMesh, law: Law, x: jax.Array, regularised: bool = False
) -> dict[tuple[int, int], Matrix]:
    """Blocks {(a, b): K_ab} [N/m] of nodes 1 <= a <= b <= 3 of every element, 45 different numbers each.

    The other blocks follow from symmetry, K_ba = K_ab^T, and from K_0b = -(K_1b + K_2b + K_3b).
    """
    s = state(law, deformation_gradient(mesh, x))
    resultant = stress(s)
    D = [tuple(mesh.shape_vectors[a]) for a in range(3)]
    v = [slopes(s, d) for d in D]
    V0 = mesh.volumes
    blocks = {}
    for a in range(3):
        for b in range(a, 3):
            K = block(s, resultant, D[a], D[b], v[a], v[b], regularised)
            blocks[a + 1, b + 1] = tuple(tuple(V0 * entry for entry in row) for row in K)
    return blocks


def all_blocks(blocks: dict[tuple[int, int], Matrix]) -> list[list[Matrix]]:
    """The 4 x 4 blocks of every element from the six of `element_stiffness`."""

    def negative_sum(*matrices: Matrix) -> Matrix:
        return tuple(tuple(-(a + b + c) for a, b, c in zip(*rows, strict=True)) for rows in zip(*matrices, strict=True))

    K: list[list[Any]] = [[None] * 4 for _ in range(4)]
    for (a, b), block_ab in blocks.items():
        K[a][b], K[b][a] = block_ab, transpose(block_ab)
    for b in (1, 2, 3):
        K[0][b] = negative_sum(K[1][b], K[2][b], K[3][b])
        K[b][0] = transpose(K[0][b])
    K[0][0] = negative_sum(K[0][1], K[0][2], K[0][3])
    return K


_PAIRS = ((1, 1), (1, 2), (1, 3), (2, 2), (2, 3), (3, 3))
_ENTRIES = [(a, b, r, c) for a, b in _PAIRS for r in range(3) for c in range(r if a == b else 0, 3)]


def _expansion() -> np.ndarray:
    """(45, 144): the element matrix as sums of its 45 different entries, signs and all."""
    basis = dict(zip(_ENTRIES, np.eye(45), strict=True))
    blocks = {
        (a, b): tuple(
            tuple(basis[(a, b, min(r, c), max(r, c)) if a == b else (a, b, r, c)] for c in range(3)) for r in range(3)
        )
        for a, b in _PAIRS
    }
    K = all_blocks(blocks)
    return np.stack([K[a][b][r][c] for a in range(4) for r in range(3) for b in range(4) for c in range(3)], axis=1)


_EXPANSION = _expansion()


@partial(jax.jit, static_argnames="regularised")
def element_matrices(mesh: TetMesh, law: Law, x: jax.Array, regularised: bool = False) -> jax.Array:
    """Element stiffness matrices (E, 144) [N/m], degree of freedom 3 * local node + component."""
    blocks = element_stiffness(mesh, law, x, regularised)
    entries = [blocks[a, b][r][c] for a, b, r, c in _ENTRIES]
    # A product with a constant writes the other 99 entries: stacked one by one they triple the time to compile.
    return jnp.stack(jnp.broadcast_arrays(*entries), axis=-1) @ jnp.asarray(_EXPANSION, x.dtype)


def sparse(mesh: TetMesh, entries: np.ndarray) -> scipy.sparse.csr_array:
    """Global matrix (3V, 3V) of element matrices (E, 12, 12), degree of freedom 3 * node + component."""
    dofs = (3 * np.asarray(mesh.tetrahedra)[:, :, None] + np.arange(3)).reshape(-1, 12)
    rows, columns = np.repeat(dofs, 12, axis=1), np.tile(dofs, (1, 12))
    n = 3 * mesh.number_of_nodes
    return scipy.sparse.coo_array((np.ravel(entries), (rows.ravel(), columns.ravel())), shape=(n, n)).tocsr()


def stiffness_matrix(mesh: TetMesh, law: Law, x: jax.Array, regularised: bool = False) -> scipy.sparse.csr_array:
    """Second derivative of the total energy, scipy.sparse (3V, 3V) [N/m], degree of freedom 3 * node + component.

    Args:
        mesh, law, x: as in `internal_force`.
        regularised: section 4.1.2 iii, trace kept; changes the path of a Newton iteration, never its root.
    """
    return sparse(mesh, np.asarray(element_matrices(mesh, law, x, regularised)))
