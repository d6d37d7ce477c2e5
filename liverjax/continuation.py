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
    max_iterations: int = 25  # a part; 1: one step of Newton, no convergence asked for, derivatives not those of it
    linear_tolerance: float = 5e-2  # of a direction, the loosest
    one_step_tolerance: float = 1e-4  # of the one direction where there is but one iteration
    contraction: float = 0.15  # of |r| in an iteration; a tangent that does worse is made anew
    adjoint_tolerance: float = 1e-11
    max_linear_iterations: int = 3000
    max_halvings: int = 6
    max_cuts: int = 12


class _Point(NamedTuple):
    q: jax.Array  # best point of the current part
    size: jax.Array  # |r| there
    aim: jax.Array  # |r| that the last direction was to remove
    tangent: Any  # as last made
    stale: jax.Array  # dq is of a tangent that was made before q
    remake: jax.Array  # the next evaluation is at q again, for a new tangent
    dq: jax.Array
    t: jax.Array  # part of dq to try next
    s: jax.Array
    q_begin: jax.Array  # where the current part began
    guessing: jax.Array  # it began at the guess
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


class Method(NamedTuple):
    """A problem and how its linear systems are solved."""

    #: (q, s) -> (r, force, by): a flat vector (n,), the size of the forces that it is small against, and what
    #: `tangent` needs beside. May close over traced parameters; derivatives are exact at the root.
    residual: Callable[[jax.Array, jax.Array], tuple[jax.Array, jax.Array, Any]]
    #: (q, s, by, near) -> any pytree that stands for dr/dq, used again while iterations converge fast with it; near
    #: is None, or whether an earlier one is near enough to take parts from, and that one.
    tangent: Callable[[jax.Array, jax.Array, Any, Any], Any]
    #: (tangent, b, tolerance, max_iterations) -> (solution of dr/dq x = b, iterations).
    solve: Callable[[Any, jax.Array, Any, int], tuple[jax.Array, jax.Array]]
    #: tangent -> approximate inverse of dr/dq, for derivatives.
    preconditioner: Callable[[Any], Callable[[jax.Array], jax.Array]]
    #: Whether dr/dq is.
    symmetric: bool = True
    #: Whether r depends on s.
    moved: bool = True


def solve(
    method: Method, start: jax.Array, options: StepOptions = StepOptions(), guess: jax.Array | None = None
) -> tuple[jax.Array, StepStatistics]:
    """Root in q of r(q, 1), followed from `start` (n,) at s = 0, or from `guess` first; neither has a derivative."""
    start = jax.lax.stop_gradient(start)
    guess = None if guess is None else jax.lax.stop_gradient(guess)
    residual = method.residual

    def iterate(_, start):
        return _follow(method, start, guess, options)

    def tangent_solve(linear, y):
        begin = jnp.zeros((), start.dtype)
        K = method.tangent(start, begin, jax.lax.stop_gradient(residual(start, begin)[2]), None)
        limits = (options.adjoint_tolerance, options.max_linear_iterations)
        return differentiable_solve(linear, y, method.preconditioner(K), *limits, method.symmetric)

    def at_end(q):
        return residual(q, jnp.ones((), q.dtype))[0]

    root, statistics = jax.lax.custom_root(at_end, start, iterate, tangent_solve, has_aux=True)
    counts = (n.astype(jnp.int32) for n in statistics[:4])
    return root, StepStatistics(*counts, statistics.residual)


def _follow(method, start, guess, options):
    residual = method.residual
    dtype = start.dtype
    one = jnp.ones((), dtype)
    loosest = options.one_step_tolerance if options.max_iterations == 1 else options.linear_tolerance

    def along(q, s):
        """dr/ds: how prescribed motion and loads change the residual."""
        return jax.jvp(lambda s: residual(q, s)[0], (s,), (one,))[1]

    def step(c: _Point) -> _Point:
        trial = jnp.where(c.launch, c.q_begin, jnp.where(c.remake, c.q, c.q + c.t * c.dq))
        s = jnp.where(c.launch, c.s_begin, c.s)
        r, force, by = residual(trial, s)
        size = jnp.linalg.norm(r)
        relative = size / jnp.where(force > 0, force, 1.0)
        finite = jnp.isfinite(size) & jnp.isfinite(force)
        better = finite & ((size < c.size) | c.first | c.remake) & ~c.launch
        converged = better & (relative <= options.tolerance)
        if options.max_iterations == 1:
            converged = better
        arrived = converged & (s >= 1)
        # A direction of an earlier tangent that leads nowhere is not halved: the tangent is made anew first.
        remake = ~better & ~c.launch & c.stale
        halvings = jnp.where(better | c.launch | remake, 0, c.halvings + 1)
        spent = (c.iterations >= options.max_iterations) | (halvings > options.max_halvings)
        failed = ~c.launch & ~converged & ~remake & (spent | (c.first & ~finite))
        # A guess that leads nowhere costs no cut: the last equilibrium is next.
        lost = c.guessing & (failed | (c.launch & ~finite))
        cuts = c.cuts + (failed & ~lost)
        launch_now = (c.launch & ~lost) | (converged & ~arrived)  # a new part begins at this very point
        longer = jnp.minimum(2 * c.ds, 1 - s)
        longer = jnp.where(1 - s - longer < 1e-9, 1 - s, longer)
        ds = jnp.where(converged, longer, jnp.where(failed & ~lost, 0.5 * c.ds, c.ds))
        hopeless = jnp.array(not method.moved) | (cuts > options.max_cuts)  # parts of nothing are all alike
        done = arrived | (failed & ~lost & hopeless) | (c.launch & ~finite & ~lost)
        go_on = (launch_now | better) & ~done & ~failed
        load = -r
        if method.moved:
            load = load - jax.lax.cond(launch_now, lambda: ds * along(trial, s), lambda: jnp.zeros_like(r))
        load = jnp.where(go_on, load, jnp.zeros_like(r))
        aim = jnp.linalg.norm(load)
        renew = launch_now | (go_on & (c.remake | (size > options.contraction * c.aim)))
        near = (~launch_now, c.tangent)
        K = jax.lax.cond(renew, lambda: method.tangent(trial, s, by, near), lambda: c.tangent)
        # No direction is solved for beyond what it can remove (Eisenstat and Walker 1996), nor beyond the goal.
        ratio = size / jnp.where(c.aim > 0, c.aim, 1.0)
        reach = 0.3 * jnp.where(renew, ratio**2, ratio)
        goal = 0.3 * options.tolerance / jnp.maximum(relative, 1e-300)
        forcing = jnp.where(launch_now, loosest, jnp.maximum(reach, jnp.maximum(goal, 1e-12)))
        dq, linear = jax.lax.cond(
            go_on,
            lambda: method.solve(K, load, jnp.minimum(forcing, loosest), options.max_linear_iterations),
            lambda: (jnp.zeros_like(r), jnp.zeros((), jnp.int32)),
        )
        accepted = better | launch_now
        return _Point(
            q=jnp.where(accepted, trial, c.q),
            size=jnp.where(accepted, size, c.size),
            aim=jnp.where(go_on, aim, c.aim),
            tangent=K,
            stale=jnp.where(go_on, ~renew, c.stale),
            remake=remake,
            dq=jnp.where(go_on, dq, c.dq),
            t=jnp.where(go_on, 1.0, 0.5 * c.t),
            s=jnp.where(launch_now, s + ds, s),
            q_begin=jnp.where(lost, start, jnp.where(launch_now, trial, c.q_begin)),
            guessing=c.guessing & ~lost & ~(converged & ~arrived),
            s_begin=jnp.where(launch_now, s, c.s_begin),
            ds=ds,
            launch=failed | lost,
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
    made = jax.eval_shape(lambda q: method.tangent(q, 0 * one, residual(q, 0 * one)[2], None), start)
    first = start if guess is None else guess
    begin = _Point(
        q=first,
        size=jnp.full((), jnp.inf, dtype),
        aim=0 * one,
        tangent=jax.tree.map(lambda a: jnp.zeros(a.shape, a.dtype), made),
        stale=no,
        remake=no,
        dq=jnp.zeros_like(start),
        t=one,
        s=0 * one,
        q_begin=first,
        guessing=jnp.array(guess is not None),
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
