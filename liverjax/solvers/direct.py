"""Linear solves by a sparse factorisation on the host, for matrices too ill-conditioned to iterate on.

SciPy's SuperLU: time and memory grow faster than the mesh (n^1.5 to n^2), so this is for bodies of some thousand nodes.
"""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import scipy.sparse
import scipy.sparse.linalg

from liverjax.solvers.block_matrix import BlockMatrix


def solve(A: BlockMatrix, free: jax.Array, b: jax.Array, normals: jax.Array | None = None) -> jax.Array:
    """Solution (m, V) of A x = b (m, V) for m x m blocks, 0 where `free` (m, V) is 0; NaN where A is singular.

    With `normals` (V, 3), unit vectors or 0, the first three rows of x are 0 along them.
    """
    rows, diagonal = (jnp.stack([jnp.stack(row) for row in blocks]) for blocks in (A.rows, A.diagonal))
    shape = jax.ShapeDtypeStruct(b.shape, b.dtype)
    given = (rows, diagonal, A.nodes, free, b, normals)
    return jax.pure_callback(_solve, shape, *given, vmap_method="sequential")


def _across(normals: np.ndarray, size: int) -> scipy.sparse.csr_array:
    """n n^T of every node, in the order of the unknowns, (size, size)."""
    number, own = len(normals), np.arange(len(normals))
    entries = [
        (normals[:, r] * normals[:, c], (r * number + own, c * number + own)) for r in range(3) for c in range(3)
    ]
    values, lines, columns = (np.concatenate(a) for a in zip(*((v, *at) for v, at in entries), strict=True))
    return scipy.sparse.coo_array((values, (lines, columns)), shape=(size, size)).tocsr()


def _solve(rows: Any, diagonal: Any, nodes: Any, free: Any, b: Any, normals: Any) -> np.ndarray:
    rows, diagonal, nodes, free, b = (np.asarray(a) for a in (rows, diagonal, nodes, free, b))
    m, n = b.shape
    own = np.arange(n)
    lines, columns, values = [], [], []
    for r in range(m):
        for c in range(m):
            lines += [np.broadcast_to(r * n + own, nodes.shape).ravel(), r * n + own]
            columns += [(c * n + nodes).ravel(), c * n + own]
            values += [rows[r, c].ravel(), diagonal[r, c]]
    A = scipy.sparse.coo_array((np.concatenate(values), (np.concatenate(lines), np.concatenate(columns))))
    if normals is not None:
        N = _across(np.asarray(normals), m * n)
        inside = scipy.sparse.eye_array(m * n) - N
        A = inside @ A.tocsr() @ inside + abs(diagonal[0, 0]).mean() * N
    keep = np.flatnonzero(free.ravel())
    A = A.tocsr()[keep][:, keep].tocsc()
    x = np.zeros(m * n, dtype=b.dtype)
    try:
        # The pattern is symmetric and so, nearly, is the best order of the unknowns.
        factor = scipy.sparse.linalg.splu(A, permc_spec="MMD_AT_PLUS_A", options={"SymmetricMode": True})
        x[keep] = factor.solve(b.ravel()[keep])
    except (RuntimeError, ValueError):  # singular, or not finite
        x[keep] = np.nan
    return x.reshape(m, n)
