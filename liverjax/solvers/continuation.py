"""Newton's method along a load: the solution is followed from the last equilibrium, in parts where it fails in one go.

The residual r(q, s) has the loads and prescribed motion of a step's end at s = 1, of its beginning at s = 0. What is
out of balance at the beginning (inertia, a fluid) goes in proportion: r - (1 - s) r(start, 0) is 0 where a step begins.
Every part begins with the tangent at its beginning, -(r + dr/ds ds): prescribed motion is lifted through the tangent,
never jumped to. A part that fails is halved. Only the root at s = 1 counts, and derivatives are those of the root.
"""

from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax.ad_checkpoint import checkpoint_name

from liverjax.core import status
from liverjax.solvers.krylov import differentiable_solve
from liverjax.solvers.minimisation import minimise, untangled

#: A step that makes no more progress with a residual below so many times the precision (in float32, 5e-4 of the
#: forces; measured: 1e-4), or so many times what rounding positions does, is at roundoff: shorter steps do not help.
_PRECISIONS, _ROUNDINGS = 4096, 8

#: A guess with elements of less than this part of their volume is not begun with: it may lead to a folded shape.
_FLAT = 0.1

#: Name of a step's root among what reverse mode may keep: with it nothing of how it was found is computed again.
ROOT = "root"


class StepStatistics(NamedTuple):
    """What one step took; every field an array (one a lane under vmap)."""

    status: jax.Array
    iterations: jax.Array  # of Newton, all parts together
    linear_iterations: jax.Array
    cuts: jax.Array  # how often a part was halved
    residual: jax.Array  # |r| over the forces at work


class StepOptions(NamedTuple):
    """How hard to try; all but the tolerance is static."""

    tolerance: float = 1e-8  # of |r| relative to the forces at work
    max_iterations: int = 25  # a part
    one_step: bool = False  # one linear solve a step and no more; derivatives are not those of it
    linear_tolerance: float = 5e-2  # of a direction, the loosest
    one_step_tolerance: float = 1e-4  # of the one direction where there is but one, the loosest
    contraction: float = 0.15  # of |r| in an iteration; a tangent that does worse is made anew
    wear: float = 1.2  # of the preconditioner: iterations a digit over those when it was new
    adjoint: float = 0.1  # tolerance of the solves that carry derivatives, over `tolerance`
    max_linear_iterations: int = 3000
    max_halvings: int = 6
    max_cuts: int = 12
    max_minimisation: int = 300  # iterations on the energy
    max_shortenings: int = 30  # of one of them


class Kept(NamedTuple):
    """A tangent that goes from step to step: good for the next one as long as iterations converge fast with it."""

    tangent: Any
    made: jax.Array  # False: there is none yet
    pace: jax.Array  # linear iterations a digit, with its preconditioner when that was new
    worn: jax.Array  # the preconditioner takes much longer by now


class _Point(NamedTuple):
    q: jax.Array  # best point of the current part
    size: jax.Array  # |r| there
    aim: jax.Array  # |r| that the last direction was to remove
    kept: Kept
    indefinite: jax.Array  # the last tangent solved with was not positive
    stale: jax.Array  # dq is of a tangent that was made before q
    remake: jax.Array  # the next evaluation is at q again, for a new tangent
    dq: jax.Array
    t: jax.Array  # part of dq to try next
    s: jax.Array
    q_begin: jax.Array  # where the current part began
    guessing: jax.Array  # it began at the guess
    unbalanced: jax.Array  # r at the step's beginning, 0 while guessing
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
    #: (tangent, b, tolerance, max_iterations) -> (solution of dr/dq x = b, iterations, whether dr/dq seems positive).
    solve: Callable[[Any, jax.Array, Any, int], tuple[jax.Array, jax.Array, jax.Array]]
    #: tangent -> approximate inverse of dr/dq, for derivatives.
    preconditioner: Callable[[Any], Callable[[jax.Array], jax.Array]]
    #: (tangent, b, tolerance, max_iterations) -> as `solve`, with dr/dq itself, and the residual over |b|: for
    #: derivatives, where dr/dq is symmetric. None: they are solved for with products of dr/dq.
    adjoint: Callable[[Any, jax.Array, Any, int], tuple[jax.Array, jax.Array]] | None = None
    #: Whether dr/dq is.
    symmetric: bool = True
    #: Whether r depends on s.
    moved: bool = True
    #: |r| that the digits of q leave.
    roundoff: Any = 0.0
    #: q -> energy of which r(q, 1) is the gradient; with it a step that cannot be followed is minimised.
    energy: Callable[[jax.Array], jax.Array] | None = None
    #: As `tangent`, of a matrix without negative eigenvalues.
    definite: Callable[[jax.Array, jax.Array, Any, Any], Any] | None = None
    #: (q, s) -> the least J of an element: not above 0 where elements are inverted.
    volume: Callable[[jax.Array, Any], jax.Array] | None = None
    #: The same of a body whose energy is finite where elements are inverted; None where it is already.
    surrogate: Any = None
    #: Where the loads are followed from if the start is a guess, and whether it is; None where a start is a state.
    rest: tuple[jax.Array, jax.Array] | None = None


def nothing_kept(method: Method, start: jax.Array) -> Kept:
    """What the first of several steps is given."""
    zero = jnp.zeros((), start.dtype)
    made = jax.eval_shape(lambda q: method.tangent(q, zero, method.residual(q, zero)[2], None), start)
    no = jnp.array(False)
    return Kept(jax.tree.map(lambda a: jnp.zeros(a.shape, a.dtype), made), no, zero, no)


def solve(
    method: Method,
    start: jax.Array,
    options: StepOptions = StepOptions(),
    guess: jax.Array | None = None,
    kept: Kept | None = None,
    near: Any = None,
) -> tuple[jax.Array, StepStatistics, Kept]:
    """Root in q of r(q, 1), followed from `start` (n,) at s = 0, or from `guess` first; neither has a derivative.

    Returns the root, what it took, and the tangent for the next step; `kept` is that of the last, `near` one of which
    derivatives may take parts.
    """
    start = jax.lax.stop_gradient(start)
    guess = None if guess is None else jax.lax.stop_gradient(guess)
    kept = nothing_kept(method, start) if kept is None else jax.lax.stop_gradient(kept)
    one = jnp.ones((), start.dtype)

    def at_end(q):
        return method.residual(q, one)[0]

    kind = jax.tree.map(lambda a: a.dtype, kept)

    def follow(_, start):
        root, (statistics, kept) = found(start)
        # Counts and node numbers leave as floating-point numbers: implicit differentiation gives every output a
        # tangent, and jax 0.10 refuses those of integers.
        return root, (statistics, jax.tree.map(lambda a: a.astype(start.dtype), kept))

    def found(start):
        if options.one_step:
            return _one_step(method, start, kept, options)
        if method.energy is not None:
            return _robust(method, start, guess, kept, options)
        guessing = jnp.array(guess is not None)
        return _follow(method, start, start if guess is None else guess, guessing, kept, options)

    # Two rules: how the root was found has no derivative, and the root's own is by the tangent there.
    q, aux = jax.lax.custom_root(at_end, start, follow, lambda _, y: jnp.zeros_like(y), has_aux=True)
    statistics, kept = jax.lax.stop_gradient(aux)
    kept = jax.tree.map(lambda a, dtype: a.astype(dtype), kept, kind)
    q, statistics = checkpoint_name((jax.lax.stop_gradient(q), statistics), ROOT)

    def tangent_solve(linear, y):
        some = None if near is None else (jnp.array(True), near)
        K = method.tangent(q, one, jax.lax.stop_gradient(method.residual(q, one)[2]), some)
        limits = (jnp.maximum(options.adjoint * options.tolerance, 1e-13), options.max_linear_iterations)
        solver = None if method.adjoint is None else lambda b: method.adjoint(K, b, *limits)
        return differentiable_solve(linear, y, method.preconditioner(K), *limits, method.symmetric, solver)

    root = jax.lax.custom_root(at_end, q, lambda _, q: q, tangent_solve)
    code, iterations, linear, cuts = (n.astype(jnp.int32) for n in statistics[:4])
    return root, StepStatistics(code, iterations, linear, cuts, statistics.residual), kept


def _one_step(method: Method, start: jax.Array, kept: Kept, options: StepOptions) -> tuple[jax.Array, Any]:
    """One linear solve from the step's beginning and no more (chapter, section 4.1.2), by the stiffness asked for."""
    if method.definite is not None:
        method = method._replace(tangent=method.definite)
    zero, one = jnp.zeros((), start.dtype), jnp.ones((), start.dtype)
    r, _, by = method.residual(start, zero)
    load = -r - _along(method, start, zero) if method.moved else -r
    at = (start, zero, by)
    finest = 16 * float(jnp.finfo(start.dtype).eps)
    wanted = jnp.clip(0.3 * options.tolerance, finest, options.one_step_tolerance)
    dq, linear, kept, _ = _direction(method, options, kept, at, load, wanted, True, True)
    q = start + dq
    r, force, _ = method.residual(q, one)
    relative = jnp.linalg.norm(r) / jnp.where(force > 0, force, 1.0)
    code = jnp.where(relative <= options.tolerance, status.CONVERGED, status.ONE_STEP)
    code = jnp.where(jnp.isfinite(relative), code, status.NOT_FINITE)
    a, b, c, d = (jnp.asarray(n, start.dtype) for n in (code, one, linear, zero))
    return q, (StepStatistics(a, b, c, d, relative), kept)


def _follow(
    method: Method, start: jax.Array, guess: jax.Array, guessing: jax.Array, kept: Kept, options: StepOptions
) -> tuple[jax.Array, Any]:
    begin = _first_point(start, guess, guessing, kept)
    end = jax.lax.while_loop(lambda c: ~c.done, partial(_iterate, method, options, start), begin)
    stopped = jnp.where(end.cuts > options.max_cuts, status.STEP_CUT, status.STALLED)
    failure = jnp.where(end.indefinite, status.INDEFINITE, stopped)
    failure = jnp.where(jnp.isfinite(end.relative), failure, status.NOT_FINITE)
    code = jnp.where((end.s >= 1) & (end.relative <= options.tolerance), status.CONVERGED, failure)
    a, b, c, d = (n.astype(start.dtype) for n in (code, end.total, end.linear, end.cuts))
    return end.q, (StepStatistics(a, b, c, d, end.relative), end.kept)


def _robust(method: Method, start: jax.Array, guess: Any, kept: Kept, options: StepOptions) -> tuple[jax.Array, Any]:
    """The load is followed; where that fails, or elements are inverted at the beginning, the energy is made least.

    At rest a start is but a guess: where it is nearly flat or leads nowhere, the load is followed from the reference
    shape.
    """
    zero = jnp.zeros((), start.dtype)
    assert method.volume is not None
    nothing = StepStatistics(zero + status.STALLED, zero, zero, zero, zero)
    guessing = jnp.array(guess is not None)
    if method.rest is not None:
        shape, guessing = method.rest
        guess, start = start, jnp.where(guessing, shape, start)
    guess = start if guess is None else guess
    volume = method.volume(guess, zero + 1)
    begin = jnp.where(guessing & (volume > 0), guess, start)
    guessing = guessing & (volume > (0 if method.rest is None else _FLAT))
    q, (taken, kept) = jax.lax.cond(
        method.volume(start, zero) <= 0,
        lambda: (start, (nothing, kept)),
        lambda: _follow(method, start, guess, guessing, kept, options),
    )

    def again():
        first, iterations, linear = untangled(method, begin, options)
        least = minimise(method, first, options)
        iterations, linear = iterations + least.iterations, linear + least.linear_iterations
        more = (least.code, taken.iterations + iterations, taken.linear_iterations + linear)
        a, b, c = (jnp.asarray(n, start.dtype) for n in more)
        taken_now = StepStatistics(a, b, c, taken.cuts, least.relative)
        return least.q, (taken_now, kept._replace(made=jnp.array(False)))

    return jax.lax.cond(taken.status == status.CONVERGED, lambda: (q, (taken, kept)), again)


def _first_point(start: jax.Array, guess: jax.Array, guessing: jax.Array, kept: Kept) -> _Point:
    zero, none, one, no = jnp.zeros((), start.dtype), jnp.zeros((), jnp.int32), jnp.ones((), start.dtype), False
    first = jnp.where(guessing, guess, start)
    return _Point(
        q=first,
        size=one * jnp.inf,
        aim=zero,
        kept=kept,
        indefinite=jnp.array(no),
        stale=jnp.array(no),
        remake=jnp.array(no),
        dq=jnp.zeros_like(start),
        t=one,
        s=zero,
        q_begin=first,
        guessing=guessing,
        unbalanced=jnp.zeros_like(start),
        s_begin=zero,
        ds=one,
        launch=jnp.array(True),
        first=jnp.array(no),
        iterations=none,
        halvings=none,
        total=none,
        linear=none,
        cuts=none,
        relative=one,
        done=jnp.array(no),
    )


class _Verdict(NamedTuple):
    """What the residual at a trial point means."""

    accepted: jax.Array  # the point is the best of its part so far, or the beginning of one
    better: jax.Array
    converged: jax.Array  # at the end of a part
    arrived: jax.Array  # at the end of the last
    remake: jax.Array
    failed: jax.Array
    lost: jax.Array  # a guess that leads nowhere: it costs no cut, the last equilibrium is next
    launch_now: jax.Array  # a new part begins at this very point
    go_on: jax.Array  # a direction is wanted
    halvings: jax.Array
    cuts: jax.Array
    done: jax.Array


def _judge(
    c: _Point, s: jax.Array, size: jax.Array, relative: jax.Array, roundoff: Any, options: StepOptions
) -> _Verdict:
    finite = jnp.isfinite(size) & jnp.isfinite(relative)
    # The first point of a part need not be better, if its direction was that of a tangent made there.
    free = c.first & (~c.stale | (size < c.aim))
    better = finite & ((size < c.size) | free | c.remake) & ~c.launch
    converged = better & (relative <= options.tolerance)
    arrived = converged & (s >= 1)
    # A direction of an earlier tangent that leads nowhere is not halved: the tangent is made anew first.
    remake = ~better & ~c.launch & c.stale
    halvings = jnp.where(better | c.launch | remake, 0, c.halvings + 1)
    spent = (c.iterations >= options.max_iterations) | (halvings > options.max_halvings)
    failed = ~c.launch & ~converged & ~remake & (spent | (c.first & ~finite))
    small = (c.relative <= _PRECISIONS * float(jnp.finfo(size.dtype).eps)) | (c.size <= _ROUNDINGS * roundoff)
    exhausted = failed & ~c.first & (s >= 1) & small
    lost = c.guessing & (failed | (c.launch & ~finite)) & ~exhausted
    cuts = c.cuts + (failed & ~lost & ~exhausted)
    launch_now = (c.launch & ~lost) | (converged & ~arrived)
    hopeless = cuts > options.max_cuts
    done = arrived | exhausted | (failed & ~lost & hopeless) | (c.launch & ~finite & ~lost)
    return _Verdict(
        accepted=better | launch_now,
        better=better,
        converged=converged,
        arrived=arrived,
        remake=remake,
        failed=failed,
        lost=lost,
        launch_now=launch_now,
        go_on=(launch_now | better) & ~done & ~failed,
        halvings=halvings,
        cuts=cuts,
        done=done,
    )


def _iterate(method: Method, options: StepOptions, start: jax.Array, c: _Point) -> _Point:
    """One evaluation of the residual, and a direction where one is wanted."""
    trial = jnp.where(c.launch, c.q_begin, jnp.where(c.remake, c.q, c.q + c.t * c.dq))
    s = jnp.where(c.launch, c.s_begin, c.s)
    r, force, by = method.residual(trial, s)
    unbalanced = jnp.where(c.launch & ~c.guessing & (c.s_begin == 0), r, c.unbalanced)
    r = r - (1 - s) * unbalanced
    size = jnp.linalg.norm(r)
    relative = size / jnp.where(force > 0, force, 1.0)
    v = _judge(c, s, size, relative, method.roundoff, options)
    longer = jnp.minimum(2 * c.ds, 1 - s)
    longer = jnp.where(1 - s - longer < 1e-9, 1 - s, longer)
    ds = jnp.where(v.converged, longer, jnp.where(v.failed & ~v.lost, 0.5 * c.ds, c.ds))
    load = -r - jnp.where(v.launch_now, ds, 0.0) * unbalanced
    if method.moved:
        load = load - jax.lax.cond(v.launch_now, lambda: ds * _along(method, trial, s), lambda: jnp.zeros_like(r))
    slow = c.remake | (size > options.contraction * c.aim)
    renew = (v.launch_now & (~c.guessing | ~c.kept.made)) | (v.go_on & ~v.launch_now & slow)
    # No direction is solved for beyond what it can remove (Eisenstat and Walker 1996), nor beyond the goal.
    ratio = size / jnp.where(c.aim > 0, c.aim, 1.0)
    reach = 0.3 * jnp.where(renew, ratio**2, ratio)
    goal = 0.3 * options.tolerance / jnp.maximum(relative, 1e-300)
    forcing = jnp.where(v.launch_now, options.linear_tolerance, jnp.maximum(reach, jnp.maximum(goal, 1e-12)))
    forcing = jnp.minimum(forcing, options.linear_tolerance)
    at = (trial, s, by)
    dq, linear, kept, positive = _direction(method, options, c.kept, at, load, forcing, renew, v.go_on)
    return _Point(
        q=jnp.where(v.accepted, trial, c.q),
        size=jnp.where(v.accepted, size, c.size),
        aim=jnp.where(v.go_on, jnp.linalg.norm(load), c.aim),
        kept=kept,
        indefinite=jnp.where(v.go_on, ~positive, c.indefinite),
        stale=jnp.where(v.go_on, ~renew, c.stale),
        remake=v.remake,
        dq=jnp.where(v.go_on, dq, c.dq),
        t=jnp.where(v.go_on, 1.0, 0.5 * c.t),
        s=jnp.where(v.launch_now, s + ds, s),
        q_begin=jnp.where(v.lost, start, jnp.where(v.launch_now, trial, c.q_begin)),
        unbalanced=unbalanced,
        guessing=c.guessing & ~v.lost & ~(v.converged & ~v.arrived),
        s_begin=jnp.where(v.launch_now, s, c.s_begin),
        ds=ds,
        launch=v.failed | v.lost,
        first=v.launch_now,
        iterations=jnp.where(v.launch_now, 1, c.iterations + v.better),
        halvings=v.halvings,
        total=c.total + (v.go_on & ~v.arrived),
        linear=c.linear + linear,
        cuts=v.cuts,
        relative=jnp.where(v.accepted | ~jnp.isfinite(relative), relative, c.relative),
        done=v.done,
    )


def _along(method: Method, q: jax.Array, s: jax.Array) -> jax.Array:
    """dr/ds: how prescribed motion and loads change the residual."""
    return jax.jvp(lambda s: method.residual(q, s)[0], (s,), (jnp.ones_like(s),))[1]


def _direction(
    method: Method, options: StepOptions, kept: Kept, at: Any, load: jax.Array, forcing: Any, renew: Any, wanted: Any
) -> tuple[jax.Array, jax.Array, Kept, jax.Array]:
    """Solution of dr/dq dq = load to `forcing`, its iterations, the tangent it is of and whether that is positive."""
    near = (kept.made & ~kept.worn, kept.tangent)
    q, s, by = at
    K = jax.lax.cond(renew, lambda: method.tangent(q, s, by, near), lambda: kept.tangent)
    dq, linear, positive = jax.lax.cond(
        wanted,
        lambda: method.solve(K, load, forcing, options.max_linear_iterations),
        lambda: (jnp.zeros_like(load), jnp.zeros((), jnp.int32), jnp.array(True)),
    )
    pace = (linear / -jnp.log10(forcing)).astype(load.dtype)
    first = jnp.where(renew & ~near[0], pace, kept.pace)
    worn = jnp.where(wanted, pace > options.wear * first, kept.worn)
    return dq, linear, Kept(K, kept.made | renew, first, worn), positive
