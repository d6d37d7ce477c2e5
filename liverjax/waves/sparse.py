"""Complex sparse solves of harmonic motion, by a factorisation on the host for every frequency.

SciPy's SuperLU: time and memory grow faster than the mesh. The matrix is symmetric, not Hermitian, so one solver serves
the equations, their derivatives and their adjoints.
"""

from typing import Any

import jax
import numpy as np

from liverjax.solvers.direct import across
from liverjax.waves.operator import Operator, forces_of_motion


def motions(A: Operator, factors: jax.Array, omegas: jax.Array, b: jax.Array) -> jax.Array:
    """Complex motions u (F, V, 3) [m] with P A P u = P b. P projects onto the free directions; u is 0 along the others.

    Args:
        A: `Operator`.
        factors: m(omega) of every frequency, complex (F,) or (F, E).
        omegas: angular frequencies (F,) [rad/s].
        b: forces (F, V, 3) complex [N].

    Differentiable in both modes by everything but what is free. Rows of a matrix without an inverse are NaN.
    """
    free = jax.vmap(A.free.vectors)

    def product(u: jax.Array) -> jax.Array:
        moved = free(u)
        return free(_all(A, factors, omegas, moved)) + (u - moved)

    def factorised(_: Any, load: jax.Array) -> jax.Array:
        shape = jax.ShapeDtypeStruct(load.shape, load.dtype)
        given = (A, factors, omegas, load)
        return jax.pure_callback(_host, shape, *jax.lax.stop_gradient(given), vmap_method="sequential")

    return jax.lax.custom_linear_solve(product, free(b), factorised, symmetric=True)


def _all(A: Operator, factors: jax.Array, omegas: jax.Array, u: jax.Array) -> jax.Array:
    """`forces_of_motion` at every frequency, one after the other: element matrices are read once each."""
    return jax.lax.map(lambda at: forces_of_motion(A, *at), (factors, omegas, u))


def _host(*given: Any) -> np.ndarray:
    A, factors, omegas, b = jax.tree.map(np.asarray, given)
    V = b.shape[1]
    parts, lines, columns = _places(A, V)
    keep = np.flatnonzero(A.free.mask.T)
    N = None if A.free.normals is None else across(A.free.normals, 3 * V)
    u = np.zeros((len(b), 3 * V), b.dtype)
    for f, omega in enumerate(omegas):
        values = np.concatenate([part(factors[f], omega) for part in parts])
        u[f, keep] = _solved(values, (lines, columns), (keep, N), b[f].T.ravel())
    return np.swapaxes(u.reshape(len(b), 3, V), 1, 2)


def _places(A: Operator, V: int) -> tuple[list, np.ndarray, np.ndarray]:
    """Parts of the values as functions of m and omega, lines and columns; all x of the nodes come first."""
    n = len(A.nodes)
    at = np.asarray(A.nodes)[:, None] + V * np.arange(3)[None, :, None]  # (n, 3, E)
    square = np.broadcast_arrays(at[:, :, None, None], at[None, None])
    places = [[a.ravel() for a in square]]
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
        own = K.nodes[:, None] + V * np.arange(3)[None, :, None]
        places.append([a.ravel() for a in np.broadcast_arrays(own[:, :, None, None], own[None, None])])
        parts.append(lambda m, w, K=K: K.blocks.ravel() + 0j)
    assert n == len(A.relaxing)
    lines, columns = (np.concatenate(a) for a in zip(*places, strict=True))
    return parts, lines, columns


def _solved(values: np.ndarray, places: Any, free: Any, b: np.ndarray) -> np.ndarray:
    import scipy.sparse.linalg  # a fifth of the time that importing the package takes: only where it is used

    keep, N = free
    A = scipy.sparse.coo_array((values, places), shape=(len(b), len(b))).tocsr()
    if N is not None:
        inside = scipy.sparse.eye_array(len(b)) - N
        A = inside @ A @ inside + abs(A.diagonal()).mean() * N
    try:
        # The pattern is symmetric and so, nearly, is the best order of the unknowns.
        A = A[keep][:, keep].tocsc()
        factor = scipy.sparse.linalg.splu(A, permc_spec="MMD_AT_PLUS_A", options={"SymmetricMode": True})
        return factor.solve(b[keep].astype(A.dtype))
    except (RuntimeError, ValueError):  # singular, or not finite
        return np.full(len(keep), np.nan)
