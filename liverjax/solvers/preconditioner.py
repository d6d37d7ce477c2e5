"""A coarse space for the preconditioner: affine motions of patches of nodes (`liverjax.mesh.adjacency.patches`).

The block-Jacobi preconditioner removes errors of short wavelength. In the coarse space, the equations are solved
directly for motions that vary slowly over the body. The sum of both is a two-level Schwarz preconditioner (Smith,
Bjorstad and Gropp 1996).
"""

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from liverjax.core.struct import Number
from liverjax.mesh.tetrahedra import TetMesh
from liverjax.solvers.block_matrix import BlockMatrix
from liverjax.tensors.places import given, taken

#: A vector as one array (V,) per component.
Columns = Sequence[jax.Array]


class Coarse(NamedTuple):
    """Inverse of a matrix that is restricted to the coarse space of P patches, with m components per node."""

    inverse: jax.Array  # (4 m P, 4 m P) inverse of the coarse matrix
    used: jax.Array  # False if the coarse space is not used


def coarse(mesh: TetMesh, A: BlockMatrix, mask: jax.Array, used: Number) -> Coarse:
    """Make the coarse space from the first m rows and columns of each block of A.

    The stored inverse is 0 if `used` is false, or if the coarse matrix is not positive definite.

    Args:
        mesh: `TetMesh`.
        A: the matrix.
        mask: (V, m) 1 for free directions, else 0. m is 3 for displacements and 1 for a pressure.
        used: whether the coarse space saves time (see `worthwhile`).
    """
    f, number = mesh.pattern.patch_functions, mesh.pattern.number_of_patches

    def invert(A):
        return _inverse(_galerkin(mesh, A, f, mask, number))

    size = 4 * mask.shape[1] * number
    inverse = jax.lax.cond(used, invert, lambda A: jnp.zeros((size, size), f.dtype), A)
    return Coarse(inverse, jnp.asarray(used))


def _inverse(E: jax.Array) -> jax.Array:
    """Return the inverse of a coarse matrix; 0 if the matrix is not positive definite."""
    d = jnp.diagonal(E)
    # In a patch that is flat or has no free nodes along an axis, some coarse motions are 0. The added diagonal
    # excludes these motions.
    E = E + jnp.diag(jnp.where(d > 0, max(1e-9, 100 * float(jnp.finfo(d.dtype).eps)) * d, 1.0))
    factor = jax.scipy.linalg.cho_factor(E)
    inverse = jax.scipy.linalg.cho_solve(factor, jnp.eye(len(E), dtype=E.dtype))
    return jnp.where(jnp.all(jnp.isfinite(inverse)), inverse, 0.0)


def coarse_of_product(mesh: TetMesh, product: Callable[[jax.Array], jax.Array]) -> Coarse:
    """Make the coarse space of a symmetric matrix of the vertices. `product` multiplies this matrix by a vector (V,).

    One product is needed for each coarse motion.
    """
    f, patch, number = mesh.pattern.patch_functions, mesh.pattern.patches, mesh.pattern.number_of_patches

    def column(k: jax.Array) -> jax.Array:
        result = product(jnp.where(patch == k // 4, f[:, k % 4], 0.0))
        return given(jnp.zeros_like(f[:1], shape=(number, 4)), patch, f * result[:, None]).ravel()

    E = jax.lax.map(column, jnp.arange(4 * number))
    return Coarse(_inverse((E + E.T) / 2), jnp.array(True))


def worthwhile(A: BlockMatrix, inertia: Any) -> jax.Array:
    """Return whether the coarse space saves time: if `inertia` is on average below 1/30 of the diagonal of A."""
    if inertia is None:
        return jnp.array(True)
    total = sum(jnp.sum(A.diagonal[r][r]) for r in range(3)) / 3
    return jnp.sum(inertia) < total / 30


def correction(mesh: TetMesh, coarse: Coarse, mask: jax.Array) -> Callable[[Columns], Columns]:
    """Return the function v -> Z (Z^T A Z)^-1 Z^T v, with the coarse motions Z, for v with m columns (V,)."""
    f, patch = mesh.pattern.patch_functions.T, mesh.pattern.patches
    masks, number = mask.T, mesh.pattern.number_of_patches
    m = len(masks)

    def apply(columns):
        weighted = jnp.stack([fk * free * r for fk in f for free, r in zip(masks, columns, strict=True)], axis=-1)
        sums = given(jnp.zeros((number, 4 * m), weighted.dtype), patch, weighted)
        motion = (coarse.inverse @ sums.ravel()).reshape(number, 4, m)
        # The sum over k is a Python loop: on XLA:CPU, a sum over an array axis of length 4 would take most of the time.
        return tuple(masks[i] * sum(f[k] * taken(motion[:, k, i], patch) for k in range(4)) for i in range(m))

    return apply


def corrected(
    mesh: TetMesh, coarse: Coarse, mask: jax.Array, fine: Callable[[Columns], Columns]
) -> Callable[[Columns], Columns]:
    """Return the preconditioner `fine` with the coarse solution added, if the coarse space is used."""
    apply = correction(mesh, coarse, mask)

    def both(columns):
        return tuple(a + b for a, b in zip(fine(columns), apply(columns), strict=True))

    return lambda columns: jax.lax.cond(coarse.used, both, fine, columns)


def _galerkin(mesh: TetMesh, A: BlockMatrix, f: jax.Array, mask: jax.Array, number: int) -> jax.Array:
    """Return the coarse matrix Z^T A Z (4 m P, 4 m P) for the coarse motions Z of P patches, m components per node.

    The matrix is a sum over the edges, plus the transpose of this sum, plus a sum over the diagonal blocks of A.
    """
    pattern, m = mesh.pattern, mask.shape[1]
    size = 4 * m * number
    low, high = pattern.edges
    patch, slot = pattern.patches, pattern.edge_slots

    def pairs(blocks, i, j):
        free_i, free_j = taken(mask, i).T, taken(mask, j).T
        B = jnp.stack([blocks[r][c] * free_i[r] * free_j[c] for r in range(m) for c in range(m)], axis=1)
        both = (taken(f, i)[:, :, None] * taken(f, j)[:, None, :]).reshape(-1, 16)
        entries = (both[:, :, None] * B[:, None, :]).reshape(-1, 16 * m * m)
        nothing = jnp.zeros((number * number, 16 * m * m), f.dtype)
        return given(nothing, taken(patch, i) * number + taken(patch, j), entries)

    once = pairs([[taken(entry.ravel(), slot) for entry in row[:m]] for row in A.rows[:m]], low, high)
    every = jnp.arange(mesh.number_of_vertices)
    once, own = (
        jnp.transpose(E.reshape(number, number, 4, 4, m, m), (0, 2, 4, 1, 3, 5)).reshape(size, size)
        for E in (once, pairs(A.diagonal, every, every))
    )
    return once + once.T + own
