"""Newton's method with a line search. The root is differentiated implicitly.

Conjugate gradients or BiCGSTAB solve the linear systems. The steps of a scene use `liverjax.solvers.step_cutting`
instead, which can divide the load of a step into parts.
"""

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp

from liverjax.core import status
from liverjax.core.struct import Number
from liverjax.solvers.krylov import (
    Known,
    conjugate_gradients,
    differentiable_solve,
    stabilised_biconjugate_gradients,
)


class NewtonStatistics(NamedTuple):
    """Statistics of one solve. Every field is an array; under vmap it has one entry for each run."""

    status: jax.Array
    iterations: jax.Array
    linear_iterations: jax.Array
    residual: jax.Array  # |r| divided by the given scale, at the returned q


class NewtonOptions(NamedTuple):
    """Tolerances and limits. All except the tolerance are fixed in the compiled program."""

    tolerance: float = 1e-8  # upper bound of |r|, relative to the given scale
    max_iterations: int = 25
    linear_tolerance: float = 1e-4  # tolerance of the linear solve in each Newton step
    adjoint_tolerance: float = 1e-10  # tolerance of the solves for derivatives
    max_linear_iterations: int = 2000
    max_halvings: int = 10
    symmetric: bool = True  # whether the tangent is symmetric; if not, BiCGSTAB solves the linear systems


def newton_root(
    residual: Callable[[jax.Array], jax.Array],
    start: jax.Array,
    precondition: Callable[[jax.Array], jax.Array],
    scale: Number,
    options: NewtonOptions = NewtonOptions(),
) -> tuple[jax.Array, NewtonStatistics]:
    """Find a root of `residual`, a function of a flat vector (n,).

    Args:
        residual: the function may use parameters of the scene. The derivatives of the root with respect to these
            parameters are exact (implicit function theorem with the true tangent).
        start: first guess, without derivatives.
        precondition: approximate inverse of the tangent, without derivatives.
        scale: a force [N]. The tolerance of the residual is relative to this force.
        options: tolerances and limits.
    """

    def iterate(residual, start):
        return _halving_newton(residual, start, precondition, jax.lax.stop_gradient(scale), options)

    def tangent_solve(linear, y):
        limits = (options.adjoint_tolerance, options.max_linear_iterations)
        return differentiable_solve(linear, y, precondition, *limits, Known(options.symmetric))

    root, statistics = jax.lax.custom_root(residual, jax.lax.stop_gradient(start), iterate, tangent_solve, has_aux=True)
    code, iterations, linear = (n.astype(jnp.int32) for n in statistics[:3])
    return root, NewtonStatistics(code, iterations, linear, statistics.residual)


class _Iterate(NamedTuple):
    """State of the iteration: `q` is the iterate with the smallest |r|, and `q + t dq` is the next trial."""

    q: jax.Array
    r: jax.Array
    dq: jax.Array
    t: jax.Array
    halvings: jax.Array
    iterations: jax.Array
    linear_iterations: jax.Array
    done: jax.Array


def _halving_newton(residual, start, precondition, scale, options):
    """Run Newton's method. A step is halved if |r| does not decrease.

    The code of the residual and of the tangent occurs only once in the compiled program. So the compilation is twice as
    fast.
    """
    goal = options.tolerance * scale
    method = conjugate_gradients if options.symmetric else stabilised_biconjugate_gradients

    def norm(r):
        return jnp.linalg.norm(r)

    def step(c: _Iterate) -> _Iterate:
        trial = c.q + c.t * c.dq
        r, matvec = jax.linearize(residual, trial)
        first = c.iterations == 0
        better = (norm(r) < norm(c.r)) | first  # false if |r| is NaN
        q, r = jnp.where(better, trial, c.q), jnp.where(better, r, c.r)
        halvings = jnp.where(better, 0, c.halvings + 1)
        converged = norm(r) <= goal
        spent = (c.iterations > options.max_iterations) | (halvings > options.max_halvings)
        done = converged | spent | ~jnp.isfinite(norm(r))
        # The tolerance of the linear solve is `linear_tolerance`, or smaller if the last Newton step requires it.
        forcing = jnp.clip(0.1 * goal / norm(r), 1e-12, options.linear_tolerance)
        # If no new direction is needed, the right-hand side is 0, and the linear solver does no iteration.
        load = jnp.where(better & ~done, -r, jnp.zeros_like(r))
        dq, s = method(matvec, load, precondition, forcing, options.max_linear_iterations)
        return _Iterate(
            q=q,
            r=r,
            dq=jnp.where(better, dq, c.dq),
            t=jnp.where(better, 1.0, 0.5 * c.t),
            halvings=halvings,
            iterations=c.iterations + better,
            linear_iterations=c.linear_iterations + s.iterations,
            done=done,
        )

    zero = jnp.zeros((), jnp.int32)
    begin = _Iterate(
        q=start,
        r=jnp.full_like(start, jnp.inf),
        dq=jnp.zeros_like(start),
        t=jnp.ones((), start.dtype),
        halvings=zero,
        iterations=zero,
        linear_iterations=zero,
        done=jnp.array(False),
    )
    end = jax.lax.while_loop(lambda c: ~c.done, step, begin)
    size = norm(end.r)
    code = jnp.where(size <= goal, status.CONVERGED, jnp.where(jnp.isfinite(size), status.STALLED, status.NOT_FINITE))
    # Counts are returned as floating-point numbers: implicit differentiation gives every output a JAX tangent.
    counts = (code, end.iterations - 1, end.linear_iterations)
    return end.q, NewtonStatistics(*(n.astype(start.dtype) for n in counts), size / scale)
