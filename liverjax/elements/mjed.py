"""MJED (Multiplicative Jacobian Energy Decomposition): force and stiffness of tetrahedra from hand-derived formulas.

The formulas follow section 4.1.2 of the chapter, with J as one of the invariants I_a. W_a and W_ab are the first and
second derivatives of the energy density W with respect to I_a and I_b, summed over all terms of W before the assembly:

    f_i  = V0 sum_a W_a v_a,i                                             v_a,i = dI_a/dx_i
    K_ij = V0 [ sum_ab W_ab v_a,i (x) v_b,j + sum_a W_a d2I_a/dx_i dx_j ]

V0 is the reference volume of the element, x_i is the position of node i, and (x) is the tensor product. The computing
time does not grow with the number of terms g^k(I1, I2) h^k(J) of W. No matrix is inverted. In all functions the force
is the gradient of the energy, f = + dW/dx; the nodal force in the chapter is -dW/dx.

A linear element has one integration point. At each integration point of a quadratic element, the same formulas hold if
the corners are replaced by the four points y_k of `liverjax.mesh.shape_functions`.
"""

from functools import partial
from typing import TYPE_CHECKING, Any

import jax
import jax.numpy as jnp
import numpy as np

from liverjax.core.errors import InputError
from liverjax.laws.base import Law
from liverjax.laws.terms import chapter_terms
from liverjax.laws.terms.invariant_terms import blocks, first_piola, state
from liverjax.mesh.shape_functions import basis
from liverjax.mesh.tetrahedra import TetMesh
from liverjax.tensors.matrices import Matrix, deformation_gradient, dot, stored, transpose

if TYPE_CHECKING:
    import scipy.sparse

#: Pairs of corners for which stiffness blocks are computed. The other blocks follow from these blocks.
_PAIRS = ((1, 1), (1, 2), (1, 3), (2, 2), (2, 3), (3, 3))


def energy(mesh: TetMesh, law: Law, x: jax.Array) -> jax.Array:
    """Return the total strain energy [J] at positions x (V, 3) [m]."""
    law = mesh.at_points(law)
    return jnp.sum(mesh.weights * law.strain_energy(law.measures(deformation_gradient(mesh, x))))


def nodal_force(mesh: TetMesh, P: Matrix) -> jax.Array:
    """Return the nodal forces (V, 3) [N] due to first Piola-Kirchhoff stresses P [Pa].

    The force at corner a is the sum of V0 P D_a over the integration points, with volumes V0 and gradients D_a [1/m] of
    the shape functions.
    """
    D, V0 = mesh.gradients, mesh.weights
    forces: Any = [[V0 * dot(P[i], tuple(D[a])) for i in range(3)] for a in range(3)]
    if mesh.order > 1:
        forces = stored(forces)
    return jnp.stack(mesh.spread(forces), axis=-1)


@jax.jit
def internal_force(mesh: TetMesh, law: Law, x: jax.Array) -> jax.Array:
    """Return dW/dx (V, 3) [N], the gradient of the total energy W with respect to the positions. The sign is plus.

    Args:
        mesh: `TetMesh`.
        law: any law. The result can be differentiated with respect to the parameters of the law.
        x: positions (V, 3) [m].
    """
    return nodal_force(mesh, first_piola(mesh.at_points(law), deformation_gradient(mesh, x)))


def linear_force(mesh: TetMesh, law: Law, motion: jax.Array) -> jax.Array:
    """Return the derivative (V, 3) [N] of `internal_force` at the reference shape, along a motion (V, 3) [m].

    The deformation gradient is linear in the motion, and the nodal forces are linear in the stress. So only the stress
    has to be differentiated.
    """
    law, dF = mesh.at_points(law), deformation_gradient(mesh, motion)
    rest = tuple(tuple(jnp.full_like(dF[i][j], i == j) for j in range(3)) for i in range(3))
    return nodal_force(mesh, jax.jvp(partial(first_piola, law), (rest,), (dF,))[1])


def element_stiffness(
    mesh: TetMesh, law: Law, x: jax.Array, regularised: bool = False, terms: str = "contracted"
) -> dict[tuple[int, int], Matrix]:
    """Return stiffness blocks {(a, b): K_ab} [N/m] of corners 1 <= a <= b <= 3: 45 entries per integration point.

    `terms` is "contracted", or "chapter" for six terms per product g(I1, I2) h(J) of W
    (`liverjax.laws.terms.chapter_terms`). `regularised`: see `stiffness_matrix`. The other blocks follow from the
    symmetry, K_ba = K_ab^T, and from K_0b = -(K_1b + K_2b + K_3b).
    """
    F, pairs = stored(deformation_gradient(mesh, x)), tuple((a - 1, b - 1) for a, b in _PAIRS)
    D = [tuple(mesh.gradients[a]) for a in range(3)]
    law = mesh.at_points(law)
    if terms not in ("contracted", "chapter"):
        raise InputError(f"terms = {terms!r} is not known: use contracted or chapter")
    if terms == "chapter":
        per_volume = chapter_terms.blocks(law, F, D, pairs, regularised)
    else:
        per_volume = blocks(state(law, F), D, pairs, regularised)
    return {
        pair: tuple(tuple(mesh.weights * entry for entry in row) for row in K)
        for pair, K in zip(_PAIRS, per_volume, strict=True)
    }


def all_blocks(blocks: dict[tuple[int, int], Matrix]) -> list[list[Matrix]]:
    """Return all 4 x 4 blocks of every element, from the six blocks of `element_stiffness`."""

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


_ENTRIES = [(a, b, r, c) for a, b in _PAIRS for r in range(3) for c in range(r if a == b else 0, 3)]


def _expansion() -> np.ndarray:
    """Return the matrix (45, 144) that expands the 45 different entries of an element matrix to all 144 entries."""
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


@partial(jax.jit, static_argnames=("regularised", "terms"))
def element_matrices(
    mesh: TetMesh, law: Law, x: jax.Array, regularised: bool = False, terms: str = "contracted"
) -> jax.Array:
    """Return stiffness matrices (E, 9 n^2) [N/m] of elements with n nodes. Row: 3 * local node + component."""
    K = element_stiffness(mesh, law, x, regularised, terms)
    entries = [K[a, b][r][c] for a, b, r, c in _ENTRIES]
    # A product with a constant matrix gives all 144 entries. Stacking the entries one by one triples the compile time.
    corners = jnp.stack(jnp.broadcast_arrays(*entries), axis=-1) @ jnp.asarray(_EXPANSION, x.dtype)
    return corners if mesh.order == 1 else of_nodes(mesh.order, corners)


def of_nodes(order: int, corners: jax.Array) -> jax.Array:
    """Return matrices (E, 9 n^2) of elements with n nodes, from corner matrices (Q, E, 144) at Q integration points."""
    Q, E = corners.shape[:2]
    c = jnp.asarray(basis(order).c, corners.dtype)
    K = jnp.einsum("akq,qekilj,blq->eaibj", c, corners.reshape(Q, E, 4, 3, 4, 3), c)
    return K.reshape(E, -1)


def sparse(mesh: TetMesh, entries: np.ndarray) -> "scipy.sparse.csr_array":
    """Assemble matrices (E, 9 n^2) of elements with n nodes into a matrix (3V, 3V). Row: 3 * node + component.

    In elements of order 3, rows and columns are multiplied by the signs of the shape functions (`TetMesh.oriented`).
    """
    import scipy.sparse  # imported here, since it takes a fifth of the package's import time

    nodes = mesh.element_nodes_on_host.T
    dofs = (3 * nodes[:, :, None] + np.arange(3)).reshape(len(nodes), -1)
    rows, columns = np.repeat(dofs, dofs.shape[1], axis=1), np.tile(dofs, (1, dofs.shape[1]))
    n = 3 * mesh.number_of_nodes
    if mesh.order == 3:
        signs = np.repeat(mesh.oriented(jnp.ones((nodes.shape[1], 1, len(nodes))))[:, 0].T, 3, axis=1)
        entries = signs[:, :, None] * np.reshape(entries, (*dofs.shape, -1)) * signs[:, None]
    return scipy.sparse.coo_array((np.ravel(entries), (rows.ravel(), columns.ravel())), shape=(n, n)).tocsr()


def stiffness_matrix(
    mesh: TetMesh, law: Law, x: jax.Array, regularised: bool = False, terms: str = "contracted"
) -> "scipy.sparse.csr_array":
    """Return the second derivative of the total energy: a sparse matrix (3V, 3V) [N/m]. Row: 3 * node + component.

    Args:
        mesh, law, x: the same arguments as for `internal_force`.
        regularised: whether to use the regularisation of section 4.1.2 iii of the book chapter, modified such that the
            trace of the matrix does not change. It changes the path of Newton's iterations, but not their solution.
        terms: "contracted", or "chapter" for the six terms per product g(I1, I2) h(J) of the chapter. Both give
            the same matrix up to roundoff.
    """
    return sparse(mesh, np.asarray(element_matrices(mesh, law, x, regularised, terms)))
