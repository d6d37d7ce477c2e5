"""Complex sparse linear systems of harmonic motion. For every frequency the matrix is factorised once on the CPU,
outside the compiled program.

The matrix is symmetric but not Hermitian. So the same factor solves the equations, the equations for derivatives and
the adjoint equations, and the factor is kept in memory (`KEPT`). The matrix is factorised by
`liverjax.solvers.factors.multifrontal`. If this fails, SciPy's SuperLU is used, which searches pivots in the whole
matrix.
"""

import hashlib
import warnings
from concurrent.futures import ThreadPoolExecutor
from typing import TYPE_CHECKING, Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from liverjax.solvers.blas import one_blas_thread
from liverjax.solvers.direct import across
from liverjax.solvers.factors import multifrontal
from liverjax.solvers.factors.dissection import dissected
from liverjax.solvers.factors.memory import free_memory
from liverjax.waves.operator import Motion, Operator, forces_of_motion, free_part

if TYPE_CHECKING:
    import scipy.sparse

#: Displacements (F, V, 3) [m] at every frequency, and pressures (F, P) [Pa] or None.
Motions = Motion
#: Maximum memory [bytes] of the factors that are kept for derivatives. Factors of other matrices are deleted first. If
#: the factors of all frequencies need more memory, they are kept as 16-bit integers, with half the memory.
KEPT = 2e9

_factors: dict[bytes, multifrontal.Factor] = {}
_orders: dict[bytes, "_Order"] = {}


def motions(A: Operator, factors: jax.Array, omegas: jax.Array, b: Motions) -> Motions:
    """Return the motion x at every frequency: the solution of P A P x = P b, where P is the projection onto the free
    directions. The motion in directions that are not free is 0.

    The function may be differentiated in forward and reverse mode with respect to all arrays except the free
    directions. If the matrix of a frequency is singular, the motion at this frequency is NaN.

    Args:
        A: `Operator`.
        factors: complex factors m(omega) of the relaxing stiffness at every frequency, (F,) or (F, E).
        omegas: angular frequencies (F,) [rad/s].
        b: complex forces (F, V, 3) [N], and right sides of the volume balance (F, P) [m^3] or None.
    """

    V = b[0].shape[1]

    def free(x: jax.Array) -> jax.Array:
        return _in_one_row(jax.vmap(lambda *own: free_part(A, own))(*_parted(x, V)))

    def product(x: jax.Array) -> jax.Array:
        moved = free(x)
        return free(_in_one_row(at_every(A, factors, omegas, _parted(moved, V)))) + (x - moved)

    def factorised(_: Any, load: jax.Array) -> jax.Array:
        shape = jax.ShapeDtypeStruct(load.shape, load.dtype)
        given = (A, factors, omegas, load)
        return jax.pure_callback(_host, shape, *jax.lax.stop_gradient(given), vmap_method="sequential")

    # Displacements and pressures are put into one array, because JAX cannot differentiate a linear solve of several
    # arrays if one of them is not used.
    x = jax.lax.custom_linear_solve(product, free(_in_one_row(b)), factorised, symmetric=True)
    u, p = _parted(x, V)
    return u, None if b[1] is None else p


def _in_one_row(x: Motions) -> jax.Array:
    """Return displacements and pressures in one array (F, 3 V + P): the x components of all nodes, then y, then z, then
    the pressures."""
    u, p = x
    columns = jnp.swapaxes(u, 1, 2).reshape(len(u), -1)
    return columns if p is None else jnp.concatenate([columns, p], axis=1)


def _parted(x: jax.Array, V: int) -> Motions:
    u = jnp.swapaxes(x[:, : 3 * V].reshape(len(x), 3, V), 1, 2)
    return u, x[:, 3 * V :] if x.shape[1] > 3 * V else None


def at_every(A: Operator, factors: jax.Array, omegas: jax.Array, x: Motions) -> Motions:
    """Return the nodal forces and the volume balance (`forces_of_motion`) at every frequency. The frequencies are
    computed one after another."""
    return jax.lax.map(lambda at: forces_of_motion(A, *at), (factors, omegas, x))


class _Order(NamedTuple):
    """Positions of the matrix entries and order of elimination. They are the same for all moduli and frequencies.

    The unknowns are numbered node by node (x, y, z), and the pressures are last.
    """

    pairs: np.ndarray  # (n n E,) index of the matrix block for each pair of the n nodes of an element
    blocks: "scipy.sparse.csr_array"  # (V, V): one matrix block for each pair of nodes with a common element
    free: np.ndarray  # indices of the free unknowns
    entries: "scipy.sparse.csr_array | None"  # entries of free unknowns in the matrix blocks; None: see `_order`
    plan: list[multifrontal.Front]


def _host(*given: object) -> np.ndarray:
    with one_blas_thread():
        return _at_the_frequencies(*given)


def _at_the_frequencies(*given: object) -> np.ndarray:
    A, factors, omegas, b = jax.tree.map(np.asarray, given)
    V, size = len(A.points), b.shape[1]
    by_node = np.concatenate([np.arange(3 * V).reshape(3, V).T.ravel(), np.arange(3 * V, size)])
    free = _free_unknowns(A)
    order, matrix, x = None, _digest(A), np.zeros_like(b)
    for f, omega in enumerate(omegas):
        key, load = matrix + factors[f].tobytes() + np.float64(omega).tobytes(), b[f, by_node[free]]
        found, error = (None, np.inf) if key not in _factors else multifrontal.refined_solution(_factors[key], load)
        if error > multifrontal.WRONG:
            order = _order(A, free) if order is None else order
            K = _matrix(A, order, factors[f], omega)
            small = len(omegas) * (K.data.nbytes + multifrontal.single_bytes(order.plan, K.dtype)) > KEPT
            found = _first_solution(K, order.plan, load, (key, small))
        x[f, by_node[free]] = found
    return x


def _free_unknowns(A: Any) -> np.ndarray:
    keep = A.free.mask.ravel()
    return np.flatnonzero(keep if A.pressures is None else np.concatenate([keep, A.pressures.mask]))


def _digest(A: Any) -> bytes:
    """Return a digest of all arrays of A. Equal arrays have equal digests."""

    def of_leaf(leaf: np.ndarray) -> bytes:
        return hashlib.blake2b(np.ascontiguousarray(leaf).data, digest_size=16).digest()

    with ThreadPoolExecutor() as pool:
        return hashlib.blake2b(b"".join(pool.map(of_leaf, jax.tree.leaves(A))), digest_size=16).digest()


def _order(A: Any, free: np.ndarray) -> _Order:
    """Return the order of elimination. It is computed only if the mesh or the free unknowns differ from the last call.

    The field `entries` is None if the matrix has entries that do not come from the elements (`_elements_alone`).
    """
    import scipy.sparse  # imported only where it is used, because it takes a fifth of the package's import time

    V, widths = len(A.points), [A.nodes, *(own.nodes for own in A.attached)]
    alone = _elements_alone(A)
    key = _digest((widths, A.points, free)) + bytes([alone])
    if key not in _orders:
        ends = np.arange(0, A.nodes.size + 1, len(A.nodes))
        of_elements = scipy.sparse.csr_array((np.ones(A.nodes.size), A.nodes.T.ravel(), ends), shape=(len(ends) - 1, V))
        near = blocks = (of_elements.T @ of_elements).tocsr()
        blocks.sort_indices()
        known = np.repeat(V * np.arange(V), np.diff(blocks.indptr)) + blocks.indices
        pairs = np.searchsorted(known, (V * A.nodes.astype(np.int64)[:, None] + A.nodes[None]).ravel())
        for nodes in widths[1:]:
            at = tuple(a.ravel() for a in np.broadcast_arrays(nodes[:, None], nodes[None]))
            near = near + scipy.sparse.coo_array((np.ones(len(at[0])), at), shape=(V, V))
        most = max(len(nodes) for nodes in widths)
        elements = np.concatenate([np.pad(nodes, ((0, most - len(nodes)), (0, 0)), "edge") for nodes in widths], axis=1)
        groups = dissected(elements, np.asarray(A.points))
        plan = multifrontal.fronts(near.tocsr(), groups, np.where(free < 3 * V, free // 3, free - 3 * V))
        _orders.clear()
        _orders[key] = _Order(pairs, blocks, free, _entries_of_free(blocks, free) if alone else None, plan)
    return _orders[key]


def _elements_alone(A: Any) -> bool:
    """Return whether all matrix entries come from stiffness and mass of the elements, and no node slides."""
    other = (A.springs, A.pressures, A.free.normals)
    return all(own is None for own in other) and not A.attached and (A.mass is None or A.mass.ndim == 3)


def _entries_of_free(blocks: "scipy.sparse.csr_array", free: np.ndarray) -> "scipy.sparse.csr_array":
    """Return a sparse matrix of the free unknowns. Each entry is its index among the entries of all matrix blocks."""
    import scipy.sparse

    every = np.arange(9 * blocks.nnz, dtype=np.min_scalar_type(9 * blocks.nnz)).reshape(-1, 3, 3)
    size = 3 * blocks.shape[0]
    return scipy.sparse.bsr_array((every, blocks.indices, blocks.indptr), shape=(size, size)).tocsr()[free][:, free]


def _matrix(A: Any, order: _Order, factor: np.ndarray, omega: float) -> Any:
    """Return the sparse matrix K(omega) - omega^2 M of the free unknowns."""
    import scipy.sparse

    V, blocks = len(A.points), order.blocks
    size, data, entries = 3 * V, _blocks_of_nodes(A, order, factor, omega), order.entries
    if entries is not None:
        values = data.ravel()[entries.data]
        return scipy.sparse.csr_array((values, entries.indices, entries.indptr), shape=entries.shape)
    K = scipy.sparse.bsr_array((data, blocks.indices, blocks.indptr), shape=(size, size)).tocsr()
    more = _entries_beside(A, omega)
    if more:
        size += 0 if A.pressures is None else len(A.pressures.mask)
        values, lines, columns = (np.concatenate(a) for a in zip(*more, strict=True))
        K.resize((size, size))
        K = (K + scipy.sparse.coo_array((values, (lines, columns)), shape=(size, size))).tocsr()
    if A.free.normals is not None:
        # Nodes that slide cannot move along their normal n: I - n n^T removes this direction from the equations.
        by_node = np.concatenate([np.arange(3 * V).reshape(3, V).T.ravel(), np.arange(3 * V, size)])
        normals = _with_empty_lines(across(A.free.normals, 3 * V), size)[by_node][:, by_node]
        inside = scipy.sparse.eye_array(size) - normals
        K = (inside @ K @ inside + abs(K.diagonal()).mean() * normals).tocsr()
    return K if len(order.free) == size else K[order.free][:, order.free]


def _blocks_of_nodes(A: Any, order: _Order, factor: np.ndarray, omega: float) -> np.ndarray:
    """Return the complex matrix blocks of pairs of nodes (blocks, 3, 3) [N/m], summed over the elements.

    The sums use real arrays, and each sum is computed once, because the allocation of large arrays takes longer here
    than the arithmetic.
    """
    number = order.blocks.nnz

    def summed(values: np.ndarray) -> np.ndarray:
        return np.bincount(order.pairs, values.ravel(), number)

    data = np.empty((number, 3, 3), complex)
    inertia = None if A.mass is None or A.mass.ndim == 1 else omega**2 * summed(A.mass)
    for r, s in np.ndindex(3, 3):
        own, to = A.relaxing[:, r, :, s], data[:, r, s]
        if factor.ndim:  # one value for each element
            to.real, to.imag = summed(factor.real * own), summed(factor.imag * own)
        else:
            whole = summed(own)
            to.real, to.imag = factor.real * whole, factor.imag * whole
        if A.rest is not None:
            to.real += summed(A.rest[:, r, :, s])
        if r == s and inertia is not None:
            to.real -= inertia
    return data


def _first_solution(K: Any, plan: list[multifrontal.Front], b: np.ndarray, kept: tuple[bytes, bool]) -> np.ndarray:
    """Factorise K, keep the factor for later calls, and return the solution of K x = b. `kept`: key of the factor, and
    whether the factor is kept as 16-bit integers."""
    for single in (True, False):
        if single and K.shape[0] < multifrontal.SINGLE_FROM:
            continue
        small = _has_to_be_small(K, plan, single, kept[1])
        if small is None:
            return np.full(len(b), np.nan)
        try:
            factor = multifrontal.factorised(K, plan, single, small)
        except np.linalg.LinAlgError:
            break
        x, error = multifrontal.refined_solution(factor, b)
        if error < multifrontal.WRONG:
            _keep(kept[0], factor)
            return x
    return _pivoted(K, b)


def _has_to_be_small(
    K: "scipy.sparse.csr_array", plan: list[multifrontal.Front], single: bool, small: bool
) -> bool | None:
    """Return whether the factor has to be kept as 16-bit integers, because `small` is true or because there is not
    enough memory.

    If the memory is too small even for 16-bit integers, warn and return None. Without this check, the operating system
    would end the program without a message.
    """
    free, needed = free_memory(), np.inf
    for own in (small, single):  # 16-bit integers are used only in single precision
        needed = multifrontal.needed_bytes(plan, K.dtype, single, single and own)
        if needed < free:
            return own
    warnings.warn(
        f"{K.shape[0]} equations of harmonic motion need at least {needed / 1e9:.3g} GB of memory, but only "
        f"{free / 1e9:.3g} GB are free: use a coarser mesh, a lower order, or a machine with more memory",
        stacklevel=2,
    )
    return None


def _keep(key: bytes, factor: multifrontal.Factor) -> None:
    """Delete the factors of other matrices. Keep this factor if all factors together need less than `KEPT` bytes."""
    for other in [other for other in _factors if other[:16] != key[:16]]:
        del _factors[other]
    if factor.nbytes + sum(own.nbytes for own in _factors.values()) < KEPT:
        _factors[key] = factor


def _pivoted(K: Any, b: np.ndarray) -> np.ndarray:
    import scipy.sparse.linalg

    try:
        return scipy.sparse.linalg.splu(K.tocsc(), permc_spec="MMD_AT_PLUS_A").solve(b.astype(K.dtype))
    except (RuntimeError, ValueError):  # the matrix is singular or not finite
        return np.full(len(b), np.nan)


def _entries_beside(A: Any, omega: float) -> list[tuple]:
    """Return values, rows and columns of all matrix entries that are not in the element matrices: lumped masses,
    springs, attached elements and pressures."""
    every, found = 3 * np.arange(len(A.points)), []
    if A.mass is not None and A.mass.ndim == 1:
        found += [(-(omega**2) * A.mass + 0j, every + r, every + r) for r in range(3)]
    for r, c in np.ndindex(3, 3):
        if A.springs is not None and A.springs[r][c] is not None:
            found.append((A.springs[r][c] + 0j, every + r, every + c))
    for K in A.attached:
        at = 3 * K.nodes[:, None] + np.arange(3)[None, :, None]
        lines, columns = (a.ravel() for a in np.broadcast_arrays(at[:, :, None, None], at[None, None]))
        found.append((K.blocks.ravel() + 0j, lines, columns))
    if A.pressures is not None:
        own, p = A.pressures, 3 * len(A.points) + A.pressures.nodes
        at = 3 * A.nodes[:, None] + np.arange(3)[None, :, None]
        line, column = (a.ravel() for a in np.broadcast_arrays(at[:, :, None], p[None, None]))
        flow = 0.0 if own.flow is None else own.flow / (1j * omega)
        among = [a.ravel() for a in np.broadcast_arrays(p[:, None], p[None])]
        pull = own.pull.ravel() + 0j
        found += [(pull, line, column), (pull, column, line), (-(own.store + flow).ravel() + 0j, *among)]
    return found


def _with_empty_lines(N: Any, size: int) -> Any:
    """Return the matrix N with rows and columns of zeros appended, so that it has the shape (size, size)."""
    import scipy.sparse

    N = N.tocoo()
    return scipy.sparse.coo_array((N.data, (N.row, N.col)), shape=(size, size)).tocsr()
