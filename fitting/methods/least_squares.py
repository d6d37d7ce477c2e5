"""Nonlinear least squares: Levenberg-Marquardt with a Jacobian by forward mode, and BFGS of jax.scipy beside it."""

from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import jax.scipy.optimize


class Solution(NamedTuple):
    """A minimum of cost = |r|^2 / 2, or the best point found."""

    u: jax.Array
    residuals: jax.Array
    jacobian: jax.Array
    cost: jax.Array
    iterations: jax.Array
    gradient: jax.Array  # largest cosine between the residuals and a column of the Jacobian
    converged: jax.Array


class State(NamedTuple):
    """Levenberg-Marquardt between two evaluations: the best point, and the trial to evaluate next."""

    u: jax.Array
    r: jax.Array
    J: jax.Array
    trial: jax.Array
    predicted: jax.Array  # gain of cost that the trial promises
    damping: jax.Array
    growth: jax.Array
    iterations: jax.Array
    converged: jax.Array
    stuck: jax.Array


#: Convergence: gain of the undamped step over the cost, and mean squared residual that counts as zero.
GAIN, ZERO, MAX_DAMPING = 1e-10, 1e-26, 1e12


def _steps(J: jax.Array, r: jax.Array, damping: jax.Array) -> tuple[jax.Array, jax.Array, jax.Array]:
    """Damped step, the gain of cost it promises, and that of the undamped step; one singular value decomposition."""
    scale = jnp.maximum(jnp.linalg.norm(J, axis=0), 1e-300)
    U, s, Vt = jnp.linalg.svd(J / scale[None], full_matrices=False)
    beta = U.T @ r
    weight = s / (s * s + damping)
    gain = jnp.sum(beta * beta * s * weight * (1 - 0.5 * s * weight))
    return -(Vt.T @ (weight * beta)) / scale, gain, 0.5 * jnp.sum(jnp.where(s > 1e-12 * s[0], beta * beta, 0.0))


def begin(u: jax.Array, n_residuals: int, damping: float = 1e-3) -> State:
    """State whose first trial is u itself."""
    dtype = u.dtype
    infinite = jnp.full(n_residuals, jnp.inf, dtype)
    no = jnp.array(False)
    return State(
        u=u,
        r=infinite,
        J=jnp.zeros((n_residuals, u.shape[0]), dtype),
        trial=u,
        predicted=jnp.asarray(jnp.inf, dtype),
        damping=jnp.asarray(damping, dtype),
        growth=jnp.asarray(2.0, dtype),
        iterations=jnp.asarray(-1, jnp.int32),
        converged=no,
        stuck=no,
    )


def accept(s: State, r: jax.Array, J: jax.Array, gain: float = GAIN) -> State:
    """Go to the trial if it is better, else raise the damping (Nielsen 1999); propose the next trial."""
    first = s.iterations < 0
    cost, cost_new = 0.5 * s.r @ s.r, 0.5 * r @ r
    # False for NaN; without its derivatives a point leads nowhere.
    better = (cost_new < cost) & jnp.all(jnp.isfinite(J))
    rho = jnp.where(first, 0.5, (cost - cost_new) / jnp.where(s.predicted > 0, s.predicted, 1.0))
    easier = jnp.where(first, s.damping, s.damping * jnp.maximum(1 / 9, 1 - (2 * rho - 1) ** 3))
    damping = jnp.where(better, jnp.maximum(easier, 1e-14), s.damping * s.growth)
    u, r, J = (jnp.where(better, new, old) for new, old in ((s.trial, s.u), (r, s.r), (J, s.J)))
    cost = jnp.minimum(cost, jnp.where(better, cost_new, cost))
    step, predicted, left = _steps(J, r, damping)
    # No step, however short, lowers the cost: at roundoff that is as converged as the arithmetic allows.
    exhausted = damping > MAX_DAMPING
    at_roundoff = jnp.isfinite(cost_new) & ((left <= 1e-4 * cost) | (cost <= 1e-14 * r.shape[0]))
    converged = (left <= gain * cost) | (cost <= ZERO * r.shape[0]) | (exhausted & at_roundoff)
    return State(
        u=u,
        r=r,
        J=J,
        trial=u + step,
        predicted=predicted,
        damping=damping,
        growth=jnp.where(better, 2.0, 2 * s.growth),
        iterations=s.iterations + 1,
        converged=converged & jnp.isfinite(cost),
        stuck=exhausted | ~jnp.isfinite(cost) | ~jnp.isfinite(predicted),
    )


def solution(s: State) -> Solution:
    """Result of a state."""
    norms = jnp.linalg.norm(s.J, axis=0) * jnp.linalg.norm(s.r)
    cosine = jnp.max(jnp.abs(s.J.T @ s.r) / jnp.where(norms > 0, norms, 1.0))
    return Solution(s.u, s.r, s.J, 0.5 * s.r @ s.r, s.iterations, cosine, s.converged)


def with_jacobian(residuals: Callable[..., jax.Array]) -> Callable[..., tuple[jax.Array, jax.Array]]:
    """(r, dr/du) of a residual function of (u, …) in one forward-mode pass."""

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
    """Minimise |residuals(u, *data)|^2 / 2 inside jit; vmap over `start` or `data` for many fits at once."""
    evaluate = with_jacobian(residuals)

    def go_on(s):
        return ~s.converged & ~s.stuck & (s.iterations < max_iterations)

    def step(s):
        return accept(s, *evaluate(s.trial, *data))

    n_residuals = jax.eval_shape(residuals, start, *data).shape[0]
    return solution(jax.lax.while_loop(go_on, step, begin(start, n_residuals)))


def levenberg_marquardt_host(
    evaluate: Callable[[jax.Array], tuple[jax.Array, jax.Array]],
    start: jax.Array,
    max_iterations: int = 20,
    progress: Callable[[int, float], None] = lambda iteration, cost: None,
) -> Solution:
    """The same iteration in Python, for residuals that take seconds and a start that is nearly the minimum.

    `progress` is told of every evaluation. It stops where a step would gain 1e-8 of the cost: 1e-3 standard errors.
    """
    trial, s, step = start, None, jax.jit(partial(accept, gain=1e-8))
    while s is None or not (bool(s.converged) or bool(s.stuck) or int(s.iterations) >= max_iterations):
        r, J = evaluate(trial)
        s = step(begin(start, r.shape[0], damping=1e-8) if s is None else s, r, J)
        trial = s.trial
        progress(int(s.iterations), float(0.5 * s.r @ s.r))
    return solution(s)


def bfgs(residuals: Callable[..., jax.Array], start: jax.Array, *data: Any, gtol: float = 1e-8) -> Solution:
    """The same problem by BFGS of `jax.scipy.optimize`; `gtol` bounds the gradient of the cost.

    Its line search often ends at roundoff before gtol is met, so convergence is judged by the least-squares gain
    that is left, as in Levenberg-Marquardt.
    """

    def cost(u):
        r = residuals(u, *data)
        return 0.5 * jnp.sum(r * r)

    found = jax.scipy.optimize.minimize(cost, start, method="BFGS", options={"gtol": gtol, "maxiter": 1000})
    r, J = with_jacobian(residuals)(found.x, *data)
    s = accept(begin(found.x, r.shape[0]), r, J)
    _, _, left = _steps(J, r, s.damping)
    near = (left <= 1e-4 * (r @ r)) | (r @ r <= 1e-14 * r.shape[0])  # the latter: exact to any data's digits
    return solution(s._replace(iterations=jnp.asarray(found.nit), converged=s.converged | near))
