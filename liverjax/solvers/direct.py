"""Solve linear systems that are too ill-conditioned for Krylov methods, by sparse factorisation.

The factorisation is SciPy's SuperLU. It runs on the CPU, outside the compiled program. The required time and memory
grow faster than the number n of nodes (as n^1.5 to n^2), so SuperLU is suitable for bodies with a few thousand nodes.
"""

from collections.abc import Callable
from functools import partial
from typing import TYPE_CHECKING, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from liverjax.core.struct import Number
from liverjax.mesh.shape_functions import basis
from liverjax.mesh.tetrahedra import TetMesh
from liverjax.solvers.attached import Attached, Between, GivesWay, Masses
from liverjax.solvers.block_matrix import Block, BlockMatrix
from liverjax.solvers.point_matrix import PointMatrix

if TYPE_CHECKING:
    import scipy.sparse
    import scipy.sparse.linalg


def solve(
    A: BlockMatrix,
    free: jax.Array,
    b: jax.Array,
    normals: jax.Array | None = None,
    attached: tuple[Between, ...] = (),
) -> jax.Array:
    """Solve A x = b for a matrix A of m x m blocks and a right-hand side b (m, V). Return x (m, V).

    x is 0 where `free` (m, V) is 0, and NaN if A is singular. `normals` (V, 3) are unit vectors or 0: the motion of
    each node (the first three rows of x) has no component along its normal. The matrices `attached` are added to A.
    """
    rows, diagonal = (jnp.stack([jnp.stack(row) for row in blocks]) for blocks in (A.rows, A.diagonal))
    shape = jax.ShapeDtypeStruct(b.shape, b.dtype)
    given = (rows, diagonal, A.nodes, free, b, normals, attached)
    return jax.pure_callback(_solve, shape, *given, vmap_method="sequential")


def solve_points(
    mesh: TetMesh,
    A: PointMatrix,
    free: tuple[jax.Array, jax.Array],
    b: tuple[jax.Array, jax.Array],
    normals: Number | None = None,
    attached: tuple[Between, ...] = (),
) -> jax.Array:
    """Solve the linear system of quadratic elements, with the same arguments as `solve`.

    The result is a flat vector: the positions (3 V,), then the pressures of the vertices if A has pressures. `free` and
    `b` are pairs of arrays: for positions (3, V) and for pressures. If the second array of `free` is empty, all
    pressures are free. If the second array of `b` is empty, the right-hand side of the pressures is 0.
    """
    blocks = jnp.stack([jnp.stack([jnp.stack(row) for row in A.blocks[pair]]) for pair in sorted(A.blocks)])
    own = None if A.own is None else _filled(A.own, b[0][0])
    coupled = None
    if A.border is not None and A.pressures is not None:
        C = A.pressures
        coupled = (jnp.stack([jnp.stack(g) for g in A.border]), C.rows[0][0], C.diagonal[0][0], C.nodes)
    nodes = jnp.stack(mesh.element_nodes)
    signs = mesh.oriented(jnp.ones((len(nodes), 1, mesh.number_of_elements), b[0].dtype))[:, 0]
    size = b[0].size + (0 if coupled is None else mesh.number_of_vertices)
    shape = jax.ShapeDtypeStruct((size,), b[0].dtype)
    host = partial(_solve_points, mesh.order)
    given = (blocks, (nodes, signs), own, coupled, free, b, normals, attached)
    return jax.pure_callback(host, shape, *given, vmap_method="sequential")


def _filled(blocks: Block, like: jax.Array) -> jax.Array:
    return jnp.stack([jnp.stack([jnp.zeros_like(like) if e is None else e for e in row]) for row in blocks])


def across(normals: np.ndarray, size: int) -> "scipy.sparse.csr_array":
    """Return the matrix (size, size) of the blocks n n^T of all nodes (unit normal n), in the order of the unknowns."""
    import scipy.sparse  # takes a fifth of the package's import time, so it is imported only where it is needed

    number, own = len(normals), np.arange(len(normals))
    entries = [
        (normals[:, r] * normals[:, c], (r * number + own, c * number + own)) for r in range(3) for c in range(3)
    ]
    values, lines, columns = (np.concatenate(a) for a in zip(*((v, *at) for v, at in entries), strict=True))
    return scipy.sparse.coo_array((values, (lines, columns)), shape=(size, size)).tocsr()


def _entries(attached: tuple[Between, ...], n: int) -> list[tuple]:
    """Return the values, row indices and column indices of the matrices in `attached`.

    The unknowns are first the x of all n nodes, then all y, then all z.
    """
    found = []
    for nodes, blocks in (own for own in attached if isinstance(own, Attached)):
        at = (nodes[:, None] + n * np.arange(3)[None, :, None]).reshape(-1, nodes.shape[1])
        found.append((blocks.reshape(len(at), len(at), -1), at[:, None], at[None]))
    for own in (own for own in attached if isinstance(own, Masses)):
        values = own.matrix[:, :, None] * own.signs[:, None] * own.signs[None] * own.size
        for axis in range(3):
            at = own.nodes + axis * n
            found.append((values, at[:, None], at[None]))
    return found


def _solve(*given: object) -> np.ndarray:
    rows, diagonal, nodes, free, b, normals, attached = jax.tree.map(np.asarray, given)
    own = _kept_or_made(_factorised_blocks, (rows, diagonal, nodes, free, normals, attached))
    return _solution(own, b.ravel()).reshape(b.shape)


def _factorised_blocks(matrix: tuple) -> "_Factor":
    import scipy.sparse

    rows, diagonal, nodes, free, normals, attached = matrix
    m, n = free.shape
    own = np.arange(n)
    lines, columns, values = [], [], []
    for r in range(m):
        for c in range(m):
            lines += [np.broadcast_to(r * n + own, nodes.shape).ravel(), r * n + own]
            columns += [(c * n + nodes).ravel(), c * n + own]
            values += [rows[r, c].ravel(), diagonal[r, c]]
    for entry in _entries(attached, n):
        more = [a.ravel() for a in np.broadcast_arrays(*entry)]
        values, lines, columns = [*values, more[0]], [*lines, more[1]], [*columns, more[2]]
    A = scipy.sparse.coo_array((np.concatenate(values), (np.concatenate(lines), np.concatenate(columns))))
    return _factorised(A.tocsr(), free.ravel(), (normals, abs(diagonal[0, 0]).mean()), _given_ways(attached, m * n))


def _given_ways(attached: tuple[Between, ...], size: int) -> tuple[np.ndarray, np.ndarray]:
    """Return the matrix H (size, n) and the stiffnesses (n,) of n rank-one changes `GivesWay`. Each column of H is the
    vector h of one change, in the order of the unknowns.
    """
    found = [own for own in attached if isinstance(own, GivesWay)]
    H = np.zeros((size, len(found)))
    for column, own in zip(H.T, found, strict=True):
        column[: own.h.size] = own.h.T.ravel()
    return H, np.array([own.size for own in found])


def _solve_points(order: int, *given: object) -> np.ndarray:
    blocks, nodes_and_signs, own, coupled, free, b, normals, attached = jax.tree.map(np.asarray, given)
    matrix = (blocks, nodes_and_signs, own, coupled, free, normals, attached)
    load = b[0].ravel()
    if coupled is not None:
        load = np.concatenate([load, b[1] if len(b[1]) else np.zeros(len(coupled[2]))])
    return _solution(_kept_or_made(partial(_factorised_points, order), matrix), load).astype(b[0].dtype)


def _factorised_points(order: int, matrix: tuple) -> "_Factor":
    import scipy.sparse

    blocks, (nodes, signs), own, coupled, free, normals, attached = matrix
    n, c = free[0].shape[1], basis(order).c
    pairs = [(a, b) for a in (1, 2, 3) for b in (1, 2, 3) if a <= b]
    K = np.zeros((4, 4, 3, 3, *blocks.shape[-2:]))
    for (a, k), block in zip(pairs, blocks, strict=True):
        K[a, k], K[k, a] = block, np.swapaxes(block, 0, 1)
    K[0, 1:] = -K[1:, 1:].sum(axis=0)
    K[:, 0] = -K[:, 1:].sum(axis=1)
    element = np.einsum("akq,klrsqe,blq->arbse", c, K, c, optimize=True)
    element = (element * signs[:, None, None, None] * signs[:, None]).reshape(3 * len(nodes), 3 * len(nodes), -1)
    at = (nodes[:, None] + n * np.arange(3)[None, :, None]).reshape(3 * len(nodes), -1)
    entries = [(element, at[:, None], at[None]), *_entries(attached, n)]
    if own is not None:
        every = np.arange(n)
        entries += [(own[r, s], r * n + every, s * n + every) for r in range(3) for s in range(3)]
    known = free[0].ravel()
    if coupled is not None:
        border, rows, diagonal, near = coupled
        g = np.concatenate([-border.sum(axis=0)[None], border])
        G = -np.einsum("akq,krqe,vq->arve", c, g, basis(order).L, optimize=True) * signs[:, None, None]
        G = G.reshape(len(at), 4, -1)
        balance = 3 * n + nodes[:4]
        every = 3 * n + np.arange(len(diagonal))
        entries += [(G, at[:, None], balance[None]), (G, balance[None], at[:, None])]
        entries += [(-rows, every[None], 3 * n + near), (-diagonal, every, every)]
        known = np.concatenate([known, free[1] if len(free[1]) else np.ones(len(diagonal))])
    parts = [[a.ravel() for a in np.broadcast_arrays(*entry)] for entry in entries]
    values, lines, columns = (np.concatenate(a) for a in zip(*parts, strict=True))
    A = scipy.sparse.coo_array((values, (lines, columns)), shape=(len(known), len(known))).tocsr()
    ways = _given_ways(attached, len(known))
    return _factorised(A, known, (normals, abs(element[0, 0]).mean()), ways)


class _Factor(NamedTuple):
    """Factor of a matrix, for the unknowns that are free."""

    keep: np.ndarray  # indices of the free unknowns
    factor: "scipy.sparse.linalg.SuperLU | None"  # None: the matrix is singular, or has entries that are not finite
    ways: tuple[np.ndarray, np.ndarray]  # H and the diagonal of S, for the rank-one changes


def _factorised(A: "scipy.sparse.csr_array", free: np.ndarray, along: tuple, ways: tuple) -> _Factor:
    """Factorise A without the unknowns for which `free` (n,) is 0. The matrix of the system is A - H S^-1 H^T.

    `ways` contains H and the diagonal of S, which `_solution` uses. `along` contains the normals (or None) and a
    stiffness. The solution is 0 along the normals, and the stiffness replaces the entries of A in these directions.
    """
    import scipy.sparse.linalg

    (normals, mean), (H, size) = along, ways
    if normals is not None:
        N = across(np.asarray(normals), len(free))
        inside = scipy.sparse.eye_array(len(free)) - N
        A, H = inside @ A @ inside + mean * N, inside @ H
    keep = np.flatnonzero(free)
    try:
        # The sparsity pattern of A is symmetric, so an elimination order for A + A^T is also good for A.
        factor = scipy.sparse.linalg.splu(
            A[keep][:, keep].tocsc(), permc_spec="MMD_AT_PLUS_A", options={"SymmetricMode": True}
        )
    except (RuntimeError, ValueError):
        factor = None
    # SuperLU accepts right-hand sides only in the precision of the matrix.
    return _Factor(keep, factor, (H.astype(A.dtype), size))


def _solution(own: _Factor, b: np.ndarray) -> np.ndarray:
    """Return the solution x (n,) for the right-hand side b (n,). x is 0 at unknowns that are not free. If the matrix is
    singular, x is NaN at the free unknowns."""
    x, keep, (H, size) = np.zeros_like(b), own.keep, own.ways
    if own.factor is None:
        x[keep] = np.nan
        return x
    try:
        x[keep] = own.factor.solve(b[keep])
        if len(size):  # formula of Sherman, Morrison and Woodbury
            Z, H = own.factor.solve(H[keep]), H[keep]
            x[keep] += Z @ np.linalg.solve(np.diag(size) - H.T @ Z, H.T @ x[keep])
    except (RuntimeError, ValueError, np.linalg.LinAlgError):
        x[keep] = np.nan
    return x


#: The last matrix, as copies of its arrays, and its factor. For the columns of a Jacobian, vmap calls the solver
#: repeatedly with the same matrix.
_last: list[tuple[list[np.ndarray], object, _Factor]] = []


def _kept_or_made(made: Callable[[tuple], _Factor], matrix: tuple) -> _Factor:
    """Return the factor of a matrix. If the matrix equals the last matrix, the factor of the last matrix is
    returned."""
    leaves, structure = jax.tree.flatten(matrix)
    for before, own_structure, factor in _last[:1]:
        if structure == own_structure and all(map(_equal, before, leaves)):
            return factor
    factor = made(matrix)
    _last[:] = [([np.array(leaf) for leaf in leaves], structure, factor)]  # JAX may reuse the memory of its arrays
    return factor


def _equal(a: np.ndarray, b: np.ndarray) -> bool:
    return a.shape == b.shape and a.dtype == b.dtype and bool(np.array_equal(a, b))
