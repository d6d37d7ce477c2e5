"""Complex sparse solves of harmonic motion, by a factorisation on the host for every frequency.

The matrix is symmetric, not Hermitian, so one factor serves the equations, their derivatives and their adjoints: it is
kept for them (`KEPT`). See `liverjax.solvers.multifrontal`; SciPy's SuperLU, which chooses its pivots in the whole
matrix, follows where that fails.
"""

import hashlib
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from liverjax.core.struct import Number
from liverjax.solvers import multifrontal
from liverjax.solvers.direct import across
from liverjax.waves.operator import Motion, Operator, forces_of_motion, free_part

#: Motions of every frequency: (F, V, 3), and (F, P) or None.
Motions = Motion
#: Memory [bytes] of the factors that are kept for derivatives; those of other matrices are given up first.
KEPT = 2e9

_factors: dict[bytes, multifrontal.Factor] = {}


def motions(A: Operator, factors: jax.Array, omegas: jax.Array, b: Motions) -> Motions:
    """Free motions of every frequency with P A P x = P b, where P leaves what is free; 0 where it is not.

    Args:
        A: `Operator`.
        factors: m(omega) of every frequency, complex (F,) or (F, E).
        omegas: angular frequencies (F,) [rad/s].
        b: forces (F, V, 3) complex [N], and the balance of pressures (F, P) [m^3] or None.

    Differentiable in both modes by everything but what is free. Rows of a matrix without an inverse are NaN.
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

    # One array: of a linear solve for several, JAX has no derivative where one is not used.
    x = jax.lax.custom_linear_solve(product, free(_in_one_row(b)), factorised, symmetric=True)
    u, p = _parted(x, V)
    return u, None if b[1] is None else p


def _in_one_row(x: Motions) -> jax.Array:
    """(F, 3 V + P): all x of the nodes first, the pressures last."""
    u, p = x
    columns = jnp.swapaxes(u, 1, 2).reshape(len(u), -1)
    return columns if p is None else jnp.concatenate([columns, p], axis=1)


def _parted(x: jax.Array, V: int) -> Motions:
    u = jnp.swapaxes(x[:, : 3 * V].reshape(len(x), 3, V), 1, 2)
    return u, x[:, 3 * V :] if x.shape[1] > 3 * V else None


def at_every(A: Operator, factors: jax.Array, omegas: jax.Array, x: Motions) -> Motions:
    """`forces_of_motion` at every frequency, one after the other: element matrices are read once each."""
    return jax.lax.map(lambda at: forces_of_motion(A, *at), (factors, omegas, x))


class _Sparse(NamedTuple):
    """Places of the entries, and what is free; all x of the nodes come first, the pressures last."""

    parts: list  # values as functions of m and omega
    lines: np.ndarray
    columns: np.ndarray
    keep: np.ndarray  # numbers of the free unknowns
    normals: Any  # n n^T of nodes that slide, or None
    size: int


def _host(*given: object) -> np.ndarray:
    A, factors, omegas, b = jax.tree.map(np.asarray, given)
    system, plan, matrix, x = _system(A, b.shape[1]), None, _digest(A), np.zeros_like(b)
    for f, omega in enumerate(omegas):
        key, load = matrix + factors[f].tobytes() + np.float64(omega).tobytes(), b[f, system.keep]
        found, error = (None, np.inf) if key not in _factors else multifrontal.refined_solution(_factors[key], load)
        if error > multifrontal.WRONG:
            K = _matrix(system, factors[f], omega)
            plan = _plan(A, system, K) if plan is None else plan
            found = _first_solution(K, plan, load, key)
        x[f, system.keep] = found
    return x


def _digest(A: Any) -> bytes:
    """The same for the same numbers."""
    found = hashlib.blake2b(digest_size=16)
    for leaf in jax.tree.leaves(A):
        found.update(np.ascontiguousarray(leaf).tobytes())
    return found.digest()


def _matrix(system: _Sparse, factor: np.ndarray, omega: float) -> Any:
    import scipy.sparse  # a fifth of the time that importing the package takes: only where it is used

    values = np.concatenate([part(factor, omega) for part in system.parts])
    K = scipy.sparse.coo_array((values, (system.lines, system.columns)), shape=(system.size,) * 2).tocsr()
    if system.normals is not None:
        inside = scipy.sparse.eye_array(system.size) - system.normals
        K = inside @ K @ inside + abs(K.diagonal()).mean() * system.normals
    return K[system.keep][:, system.keep]


def _plan(A: Any, system: _Sparse, K: Any) -> list[multifrontal.Front]:
    """Which unknowns are eliminated when."""
    V, widths = len(A.points), [A.nodes, *(own.nodes for own in A.attached)]
    most = max(len(nodes) for nodes in widths)
    elements = np.concatenate([np.pad(nodes, ((0, most - len(nodes)), (0, 0)), "edge") for nodes in widths], axis=1)
    node = np.where(system.keep < 3 * V, system.keep % V, system.keep - 3 * V)
    return multifrontal.fronts(K, multifrontal.dissected(elements, np.asarray(A.points)), node)


def _first_solution(K: Any, plan: list[multifrontal.Front], b: np.ndarray, key: bytes) -> np.ndarray:
    """The solution, with the factor kept for the next one."""
    for single in (True, False):
        if single and K.shape[0] < multifrontal.SINGLE_FROM:
            continue
        try:
            factor = multifrontal.factorised(K, plan, single)
        except np.linalg.LinAlgError:
            break
        x, error = multifrontal.refined_solution(factor, b)
        if error < multifrontal.WRONG:
            _keep(key, factor)
            return x
    return _pivoted(K, b)


def _keep(key: bytes, factor: multifrontal.Factor) -> None:
    """Keep factors up to `KEPT` bytes; of one matrix, those of the first frequencies."""
    for other in [other for other in _factors if other[:16] != key[:16]]:
        del _factors[other]
    if factor.nbytes + sum(own.nbytes for own in _factors.values()) < KEPT:
        _factors[key] = factor


def _pivoted(K: Any, b: np.ndarray) -> np.ndarray:
    import scipy.sparse.linalg

    try:
        return scipy.sparse.linalg.splu(K.tocsc(), permc_spec="MMD_AT_PLUS_A").solve(b.astype(K.dtype))
    except (RuntimeError, ValueError):  # singular, or not finite
        return np.full(len(b), np.nan)


def _system(A: Any, size: int) -> _Sparse:
    V = len(A.points)
    at = A.nodes[:, None] + V * np.arange(3)[None, :, None]  # (n, 3, E)
    places = [_places_of_blocks(at)]
    rest = 0.0 if A.rest is None else A.rest
    mass: Any = 0.0
    if A.mass is not None and A.mass.ndim == 3:
        mass = A.mass[:, None, :, None] * np.eye(3)[None, :, None, :, None]
    parts: list = [lambda m, w: (m * A.relaxing + rest - w**2 * mass).reshape(-1)]
    every = np.arange(V)
    if A.mass is not None and A.mass.ndim == 1:
        places.append([np.arange(3 * V)] * 2)
        parts.append(lambda m, w: -(w**2) * np.tile(A.mass, 3) + 0j)
    for r, c in np.ndindex(3, 3):
        if A.springs is not None and A.springs[r][c] is not None:
            places.append([r * V + every, c * V + every])
            parts.append(lambda m, w, K=A.springs[r][c]: K + 0j)
    for K in A.attached:
        places.append(_places_of_blocks(K.nodes[:, None] + V * np.arange(3)[None, :, None]))
        parts.append(lambda m, w, K=K: K.blocks.ravel() + 0j)
    keep = A.free.mask.T.ravel()
    if A.pressures is not None:
        more, where = _of_pressures(A.pressures, at, V)
        parts, places = parts + more, places + where
        keep = np.concatenate([keep, A.pressures.mask])
    normals = None if A.free.normals is None else _with_empty_lines(across(A.free.normals, 3 * V), size)
    lines, columns = (np.concatenate(a) for a in zip(*places, strict=True))
    return _Sparse(parts, lines, columns, np.flatnonzero(keep), normals, size)


def _places_of_blocks(at: np.ndarray) -> list[np.ndarray]:
    """Lines and columns of matrices (n, 3, n, 3, E)."""
    return [a.ravel() for a in np.broadcast_arrays(at[:, :, None, None], at[None, None])]


def _of_pressures(own: Any, at: np.ndarray, V: int) -> tuple[list, list]:
    """Values and places of what couples motions and pressures, and pressures among themselves."""
    p = 3 * V + own.nodes
    line, column = (a.ravel() for a in np.broadcast_arrays(at[:, :, None], p[None, None]))
    among = [a.ravel() for a in np.broadcast_arrays(p[:, None], p[None])]

    def pulled(m: Number, w: float) -> np.ndarray:
        return own.pull.ravel() + 0j

    def stored(m: Number, w: float) -> np.ndarray:
        flow = 0.0 if own.flow is None else own.flow / (1j * w)
        return -(own.store + flow).ravel() + 0j

    return [pulled, pulled, stored], [[line, column], [column, line], among]


def _with_empty_lines(N: Any, size: int) -> Any:
    """The matrix with lines and columns of 0 behind it."""
    import scipy.sparse

    N = N.tocoo()
    return scipy.sparse.coo_array((N.data, (N.row, N.col)), shape=(size, size)).tocsr()
