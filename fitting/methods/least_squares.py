"""Nonlinear least squares: Levenberg-Marquardt, compiled or in NumPy, and BFGS of jax.scipy. The same code works with
JAX and NumPy arrays. Leading axes of the arrays may contain many fits, which then run at the same time.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import jax.scipy.optimize
import numpy as np

from fitting.methods import host
from fitting.methods.host import Array
from liverjax.solvers.blas import one_blas_thread


class Solution(NamedTuple):
    """Result of a search: a minimum of the cost |r|^2 / 2 of the residuals r. If the search has not converged, u has
    the smallest cost so far."""

    u: Array
    residuals: Array
    jacobian: Array
    cost: Array
    iterations: Array
    gradient: Array  # largest |cosine| of the angles between the residuals and the columns of the Jacobian
    converged: Array


class State(NamedTuple):
    """State of Levenberg-Marquardt between two evaluations: the unknowns u with the smallest cost so far (residuals r,
    Jacobian J), and the trial point to evaluate next."""

    u: Array
    r: Array
    J: Array
    trial: Array
    predicted: Array  # predicted decrease of the cost at the trial point
    damping: Array
    growth: Array
    iterations: Array
    converged: Array
    stuck: Array


#: A fit has converged if the undamped step would decrease the cost by less than GAIN (relative). A mean squared
#: residual below ZERO counts as zero. MAX_DAMPING is the upper bound of the damping.
GAIN, ZERO, MAX_DAMPING = 1e-10, 1e-26, 1e12
#: The search that reached the lowest cost may use the maximum number of iterations times this factor.
LONGER = 8


def _damped_steps(J: Array, r: Array, damping: Array) -> tuple[Array, Array, Array]:
    """Return the damped step, the expected decrease of the cost by this step, and the expected decrease by the undamped
    step. All three come from one SVD."""
    xp = host.arrays_of(J)
    scale = xp.maximum(xp.linalg.norm(J, axis=-2), 1e-300)
    U, s, Vt = xp.linalg.svd(J / scale[..., None, :], full_matrices=False)
    beta = xp.sum(U * r[..., :, None], axis=-2)
    weight = s / (s * s + damping[..., None])
    gain = xp.sum(beta * beta * s * weight * (1 - 0.5 * s * weight), axis=-1)
    step = -xp.sum(Vt * (weight * beta)[..., :, None], axis=-2) / scale
    return step, gain, 0.5 * xp.sum(xp.where(s > 1e-12 * s[..., :1], beta * beta, 0.0), axis=-1)


def begin(u: Array, n_residuals: int, damping: float = 1e-3) -> State:
    """Return the first state of Levenberg-Marquardt. Its trial point is the starting point u (…, P) with P unknowns."""
    xp, dtype, fits = host.arrays_of(u), u.dtype, u.shape[:-1]
    no = xp.full(fits, False)
    return State(
        u=u,
        r=xp.full((*fits, n_residuals), xp.inf, dtype),
        J=xp.zeros((*fits, n_residuals, u.shape[-1]), dtype),
        trial=u,
        predicted=xp.full(fits, xp.inf, dtype),
        damping=xp.full(fits, damping, dtype),
        growth=xp.full(fits, 2.0, dtype),
        iterations=xp.full(fits, -1, xp.int32),
        converged=no,
        stuck=no,
    )


def _cost(r: Array) -> Array:
    return 0.5 * (r * r).sum(axis=-1)


def accept(s: State, r: Array, J: Array, gain: float = GAIN) -> State:
    """Move to the trial point (residuals r, Jacobian J) if its cost is lower. Otherwise raise the damping (Nielsen
    1999). Then propose the next trial point."""
    xp = host.arrays_of(s.u)
    first = s.iterations < 0
    cost, cost_new = _cost(s.r), _cost(r)
    # `better` is False for NaN. A point without finite derivatives is rejected, because no next step could be computed.
    better = (cost_new < cost) & xp.all(xp.isfinite(J), axis=(-2, -1))
    rho = xp.where(first, 0.5, (cost - cost_new) / xp.where(s.predicted > 0, s.predicted, 1.0))
    easier = xp.where(first, s.damping, s.damping * xp.maximum(1 / 9, 1 - (2 * rho - 1) ** 3))
    damping = xp.where(better, xp.maximum(easier, 1e-14), s.damping * s.growth)
    u, r = (xp.where(better[..., None], new, old) for new, old in ((s.trial, s.u), (r, s.r)))
    J = xp.where(better[..., None, None], J, s.J)
    cost = xp.minimum(cost, xp.where(better, cost_new, cost))
    step, predicted, left = _damped_steps(J, r, damping)
    # `exhausted`: even a very short step does not lower the cost. If the decrease that is still possible is as small as
    # roundoff, the fit has converged as far as the arithmetic allows.
    exhausted = damping > MAX_DAMPING
    at_roundoff = xp.isfinite(cost_new) & ((left <= 1e-4 * cost) | (cost <= 1e-14 * r.shape[-1]))
    converged = (left <= gain * cost) | (cost <= ZERO * r.shape[-1]) | (exhausted & at_roundoff)
    return State(
        u=u,
        r=r,
        J=J,
        trial=u + step,
        predicted=predicted,
        damping=damping,
        growth=xp.where(better, 2.0, 2 * s.growth),
        iterations=s.iterations + 1,
        converged=converged & xp.isfinite(cost),
        stuck=exhausted | ~xp.isfinite(cost) | ~xp.isfinite(predicted),
    )


def solution(s: State) -> Solution:
    """Return the result of one fit from its last state."""
    xp = host.arrays_of(s.u)
    norms = xp.linalg.norm(s.J, axis=0) * xp.linalg.norm(s.r)
    cosine = xp.max(xp.abs(s.J.T @ s.r) / xp.where(norms > 0, norms, 1.0))
    return Solution(s.u, s.r, s.J, _cost(s.r), s.iterations, cosine, s.converged)


def degrees_of_freedom(jacobian: np.ndarray, counts: np.ndarray) -> np.ndarray:
    """Return the degrees of freedom (K,) of K groups of residuals: for each group, the number of its residuals minus
    the sum of their leverages.

    A group that the parameters fit exactly has 0 degrees of freedom (Cook and Weisberg 1982, Residuals and Influence in
    Regression).

    Args:
        jacobian: Jacobian (n, P) of all n residuals with respect to P parameters. Rows of a prior may follow the rows
            of the groups.
        counts: numbers (K,) of residuals of the groups.
    """
    if not np.all(np.isfinite(jacobian)):
        return counts * max(0.0, 1 - jacobian.shape[1] / counts.sum())
    U, sizes, _ = np.linalg.svd(jacobian, full_matrices=False)
    leverages = np.sum(U[:, sizes > 1e-12 * sizes.max(initial=0.0)] ** 2, axis=1)
    return counts - np.add.reduceat(leverages[: counts.sum()], np.append(0, np.cumsum(counts)[:-1]))


def with_jacobian(residuals: Callable[..., jax.Array]) -> Callable[..., tuple[jax.Array, jax.Array]]:
    """Convert a residual function of (u, …) to a function that returns the residuals r and the Jacobian dr/du, in one
    pass of forward-mode differentiation."""

    def evaluate(u: jax.Array, *data: Any) -> tuple[jax.Array, jax.Array]:
        def twice(u):
            r = residuals(u, *data)
            return r, r

        J, r = jax.jacfwd(twice, has_aux=True)(u)
        return r, J

    return evaluate


def levenberg_marquardt(
    residuals: Callable[..., jax.Array], start: jax.Array, *data: Any, max_iterations: int = 200
) -> Solution:
    """Minimise |residuals(u, *data)|^2 / 2 inside jit. To run many fits at the same time, use vmap over `start` or
    `data`."""
    evaluate = with_jacobian(residuals)

    def go_on(s):
        return ~s.converged & ~s.stuck & (s.iterations < max_iterations)

    def step(s):
        return accept(s, *evaluate(s.trial, *data))

    n_residuals = jax.eval_shape(residuals, start, *data).shape[0]
    return solution(jax.lax.while_loop(go_on, step, begin(start, n_residuals)))


#: A function of u (…, P) and data that returns residuals (…, m) and their Jacobian (…, m, P), in NumPy.
Evaluate = Callable[..., tuple[np.ndarray, np.ndarray]]


def from_starts(evaluate: Evaluate, starts: np.ndarray, *data: Any, max_iterations: int = 200) -> Solution:
    """Return the best minimum that Levenberg-Marquardt finds from S starting points (S, P) with P unknowns, in NumPy.
    Nothing is compiled.

    If the search that reached the lowest cost has not converged, only this search is continued. For example,
    convergence is slow if a model has too few modes for a wide curve.

    Args:
        evaluate: function of (u, *data), for example `host.with_jacobian` applied to a residual function.
        starts: starting points (S, P).
        data: further arguments of `evaluate`.
        max_iterations: maximum number of iterations of each search; `LONGER` times as many for the search with the
            lowest cost.
    """
    # The matrices are small. While other programs ran, their decomposition took 50 times as long with several threads
    # as with one.
    with one_blas_thread():
        found = _best_minimum(evaluate, starts, data, max_iterations)
        if found.converged or found.iterations < max_iterations:
            return found
        further = _best_minimum(evaluate, np.asarray(found.u)[None], data, (LONGER - 1) * max_iterations)
    return further._replace(iterations=found.iterations + further.iterations)


def _best_minimum(evaluate: Evaluate, starts: np.ndarray, data: tuple, max_iterations: int) -> Solution:
    """Return the solution with the lowest cost that is reached from S starting points (S, P) with P unknowns. All
    searches run at the same time."""
    going: np.ndarray = np.arange(len(starts))
    s: Any = None
    with np.errstate(all="ignore"):  # a trial point that overflows is rejected
        while s is None or len(going):
            r, J = evaluate(starts if s is None else s.trial[going], *data)
            if s is None:  # copies, because `begin` uses one array for several fields
                s = State(*(field.copy() for field in begin(starts, r.shape[-1])))
            new = accept(State(*(field[going] for field in s)), r, J)
            for field, values in zip(s, new, strict=True):
                field[going] = values
            going = going[~new.converged & ~new.stuck & (new.iterations < max_iterations)]
        cost = _cost(s.r)
        best = int(np.argmin(np.where(np.isfinite(cost), cost, np.inf)))
        return solution(State(*(field[best] for field in s)))


def levenberg_marquardt_host(
    evaluate: Callable[[jax.Array], tuple[jax.Array, jax.Array]],
    start: jax.Array,
    max_iterations: int = 20,
    progress: Callable[[int, float], None] = lambda iteration, cost: None,
) -> Solution:
    """Minimise |r|^2 / 2 by Levenberg-Marquardt in Python, for residuals that take seconds to compute. The starting
    point must be near the minimum.

    `progress` is called with the number of iterations and the cost after every evaluation. The iteration stops if a
    step would lower the cost by less than 1e-8 times the cost. Such a step changes a parameter by about 1e-3 standard
    errors.
    """
    trial: jax.Array = start
    s: Any = None
    with np.errstate(all="ignore"):  # a trial point that overflows is rejected
        while s is None or not (bool(s.converged) or bool(s.stuck) or int(s.iterations) >= max_iterations):
            r, J = (np.asarray(value) for value in evaluate(trial))
            s = begin(np.asarray(start), len(r), damping=1e-8) if s is None else s
            s = State(*(np.asarray(field) for field in accept(s, r, J, gain=1e-8)))
            trial = jnp.asarray(s.trial)
            progress(int(s.iterations), float(_cost(s.r)))
        return jax.tree.map(jnp.asarray, solution(s))


def bfgs(residuals: Callable[..., jax.Array], start: jax.Array, *data: Any, gtol: float = 1e-8) -> Solution:
    """Minimise |residuals(u, *data)|^2 / 2 by BFGS of `jax.scipy.optimize`. `gtol` is the tolerance for the gradient of
    the cost.

    The line search of BFGS often ends at roundoff before gtol is reached. So a fit has converged if an undamped
    least-squares step would decrease the cost by at most 2e-4 times the cost.
    """

    def cost(u):
        r = residuals(u, *data)
        return 0.5 * jnp.sum(r * r)

    found = jax.scipy.optimize.minimize(cost, start, method="BFGS", options={"gtol": gtol, "maxiter": 1000})
    r, J = with_jacobian(residuals)(found.x, *data)
    s = accept(begin(found.x, r.shape[0]), r, J)
    _, _, left = _damped_steps(J, r, s.damping)
    near = (left <= 1e-4 * (r @ r)) | (r @ r <= 1e-14 * r.shape[0])  # 2nd condition: r is far below any noise
    return solution(s._replace(iterations=jnp.asarray(found.nit), converged=s.converged | near))
