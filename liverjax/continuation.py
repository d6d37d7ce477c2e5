"""Newton's method along a load: the solution is followed from the last equilibrium, in parts where it fails in one go.

The residual r(q, s) has the loads and prescribed motion of a step's end at s = 1, of its beginning at s = 0. Every
part begins with the tangent at its beginning, -(r + dr/ds ds): prescribed motion is lifted through the tangent, never
jumped to. A part that fails is halved. Only the root at s = 1 counts, and derivatives are those of the root.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from liverjax import status
from liverjax.linear import differentiable_solve


class StepStatistics(NamedTuple):
    """What one step took; every field an array (one a lane under vmap)."""

    status: jax.Array
    iterations: jax.Array  # of Newton, all parts together
    linear_iterations: jax.Array
    cuts: jax.Array  # how often a part was halved
    residual: jax.Array  # |r| over the forces at work


class StepOptions(NamedTuple):
    """How hard to try; all static."""

    tolerance: float = 1e-8  # of |r| relative to the forces at work
    max_iterations: int = 25  # a part; 1 takes one step of Newton and asks for no convergence
    linear_tolerance: float = 1e-3
    adjoint_tolerance: float = 1e-11
    max_linear_iterations: int = 3000
    max_halvings: int = 6
    max_cuts: int = 12


class _Point(NamedTuple):
    q: jax.Array  # best point of the current part
    size: jax.Array  # |r| there
    dq: jax.Array
    t: jax.Array  # part of dq to try next
    s: jax.Array
    q_begin: jax.Array  # where the current part began
    s_begin: jax.Array
    ds: jax.Array
    launch: jax.Array  # the next evaluation is at the beginning of a part
    first: jax.Array  # the next evaluation is the first of a part
    iterations: jax.Array  # of the part
    halvings: jax.Array
    total: jax.Array
    linear: jax.Array
    cuts: jax.Array
    relative: jax.Array
    done: jax.Array


def solve(
    residual: Callable[[jax.Array, jax.Array], tuple[jax.Array, jax.Array, Any]],
    direction: Callable[[jax.Array, jax.Array, Any], Callable],
    start: jax.Array,
    precondition: Callable[[jax.Array], jax.Array],
    options: StepOptions = StepOptions(),
    symmetric: bool = True,
) -> tuple[jax.Array, StepStatistics]:
    """Root in q of r(q, 1), followed from `start` at s = 0.

    Args:
        residual: (q, s) -> (r, force, by): a flat vector (n,), the size of the forces that it is small against, and
            what `direction` needs beside. May close over traced parameters; derivatives are exact at the root.
        direction: (q, s, by) -> a function (b, tolerance, max_iterations) -> (solution of dr/dq x = b, iterations).
        start: flat vector (n,); carries no derivative.
        precondition: approximate inverse of the tangent for derivatives; carries none itself.
        options: tolerances and limits.
        symmetric: whether dr/dq is.
    """

    def iterate(_, start):
        return _follow(residual, direction, start, options)

    def tangent_solve(linear, y):
        limits = (options.adjoint_tolerance, options.max_linear_iterations)
        return differentiable_solve(linear, y, precondition, *limits, symmetric)

    def at_end(q):
        return residual(q, jnp.ones((), q.dtype))[0]

    root, statistics = jax.lax.custom_root(at_end, jax.lax.stop_gradient(start), iterate, tangent_solve, has_aux=True)
    counts = (n.astype(jnp.int32) for n in statistics[:4])
    return root, StepStatistics(*counts, statistics.residual)


def _follow(residual, direction, start, options):
    dtype = start.dtype
    one = jnp.ones((), dtype)

    def step(c: _Point) -> _Point:
        trial = jnp.where(c.launch, c.q_begin, c.q + c.t * c.dq)
        s = jnp.where(c.launch, c.s_begin, c.s)
        r, force, by = residual(trial, s)
        size = jnp.linalg.norm(r)
        relative = size / jnp.where(force > 0, force, 1.0)
        finite = jnp.isfinite(size) & jnp.isfinite(force)
        better = finite & ((size < c.size) | c.first) & ~c.launch
        converged = better & (relative <= options.tolerance)
        if options.max_iterations == 1:
            converged = better
        arrived = converged & (s >= 1)
        halvings = jnp.where(better | c.launch, 0, c.halvings + 1)
        spent = (c.iterations >= options.max_iterations) | (halvings > options.max_halvings)
        failed = ~c.launch & ~converged & (spent | (c.first & ~finite))
        cuts = c.cuts + failed
        launch_now = c.launch | (converged & ~arrived)  # a new part begins at this very point
        ds = jnp.where(converged, jnp.minimum(2 * c.ds, 1 - s), jnp.where(failed, 0.5 * c.ds, c.ds))
        ds = jnp.where(1 - s - ds < 1e-9, 1 - s, ds) * ~failed + ds * failed
        done = arrived | (failed & (cuts > options.max_cuts)) | (c.launch & ~finite)
        go_on = (launch_now | better) & ~done & ~failed
        change = jax.lax.cond(
            launch_now, lambda: jax.jvp(lambda s: residual(trial, s)[0], (s,), (one,))[1], lambda: jnp.zeros_like(r)
        )
        load = jnp.where(go_on, -r - ds * change, jnp.zeros_like(r))
        forcing = jnp.where(
            launch_now, options.linear_tolerance, 0.3 * options.tolerance / jnp.maximum(relative, 1e-300)
        )
        forcing = jnp.clip(forcing, 1e-12, options.linear_tolerance)
        dq, linear = jax.lax.cond(
            go_on,
            lambda: direction(trial, s, by)(load, forcing, options.max_linear_iterations),
            lambda: (jnp.zeros_like(r), jnp.zeros((), jnp.int32)),
        )
        accepted = better | launch_now
        return _Point(
            q=jnp.where(accepted, trial, c.q),
            size=jnp.where(accepted, size, c.size),
            dq=jnp.where(go_on, dq, c.dq),
            t=jnp.where(go_on, 1.0, 0.5 * c.t),
            s=jnp.where(launch_now, s + ds, s),
            q_begin=jnp.where(launch_now, trial, c.q_begin),
            s_begin=jnp.where(launch_now, s, c.s_begin),
            ds=ds,
            launch=failed,
            first=launch_now,
            iterations=jnp.where(launch_now, 1, c.iterations + better),
            halvings=halvings,
            total=c.total + (go_on & ~arrived),
            linear=c.linear + linear,
            cuts=cuts,
            relative=jnp.where(accepted | ~finite, relative, c.relative),
            done=done,
        )

    zero, no = jnp.zeros((), jnp.int32), jnp.array(False)
    begin = _Point(
        q=start,
        size=jnp.full((), jnp.inf, dtype),
        dq=jnp.zeros_like(start),
        t=one,
        s=0 * one,
        q_begin=start,
        s_begin=0 * one,
        ds=one,
        launch=jnp.array(True),
        first=no,
        iterations=zero,
        halvings=zero,
        total=zero,
        linear=zero,
        cuts=zero,
        relative=one,
        done=no,
    )
    end = jax.lax.while_loop(lambda c: ~c.done, step, begin)
    good = (end.s >= 1) & ((end.relative <= options.tolerance) | (options.max_iterations == 1))
    failure = jnp.where(jnp.isfinite(end.relative), status.STALLED, status.NOT_FINITE)
    code = jnp.where(good & jnp.isfinite(end.relative), status.CONVERGED, failure)
    counts = (code, end.total, end.linear, end.cuts)
    return end.q, StepStatistics(*(n.astype(dtype) for n in counts), end.relative)
