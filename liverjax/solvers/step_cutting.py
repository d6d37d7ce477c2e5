"""Newton's method along a load: the solution is followed from the last equilibrium, if necessary in substeps.

The residual r(q, s) contains loads and prescribed motions: at the beginning of the step for s = 0, and at the end of
the step for s = 1. At the beginning of a step, forces may be out of balance (inertia, a fluid). So the equation r(q, s)
= (1 - s) r(start, 0) is solved, where `start` contains the unknowns at the beginning of the step. For s = 0, the
solution is q = start. A part of the load, from s to s + ds, is called a substep. Every substep begins with a linear
solve, with the tangent at the beginning of the substep and the right-hand side -(r + dr/ds ds). So a prescribed motion
enters through the tangent and not as a jump. If a substep fails, it is halved. Only the root at s = 1 is returned and
differentiated.
"""

from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax.ad_checkpoint import checkpoint_name

from liverjax.core import status
from liverjax.core.struct import Number
from liverjax.solvers.krylov import Earlier, Known, differentiable_solve, no_earlier, symmetric_solve
from liverjax.solvers.minimisation import minimise, untangled
from liverjax.solvers.problem import (
    LINEAR_TOLERANCE,
    MOST_LINEAR_ITERATIONS,
    Kept,
    Potential,
    Problem,
    StepOptions,
    StepStatistics,
)

#: If Newton's method makes no progress, the residual counts as roundoff in two cases. The relative residual is below
#: _PRECISIONS times the machine precision (5e-4 in float32; in tests, the relative residual stopped at about 1e-4), or
#: the residual is below ROUNDINGS times `Problem.roundoff`. Then shorter steps do not help.
_PRECISIONS, ROUNDINGS = 4096, 8

#: If the derivative of the residual can jump (kinks) and halving does not help, the full step q + dq is used, at most
#: this number of times per substep. The tangent changes at a kink.
_LEAPS = 8

#: Without inertia, a guess is not used if the volume ratio of any element is below this value (robust steps only). Such
#: a guess may lead to a folded shape.
_FLAT = 0.1

#: Maximum tolerance of the linear solve if a step consists of only one solve.
_ONE_STEP = 1e-4
#: A new tangent is made if |r|, divided by the norm of the right-hand side of the last direction, exceeds this value.
_CONTRACTION = 0.15
#: A new preconditioner is made if the number of linear iterations per digit exceeds this multiple of its first value.
_WEAR = 1.2
#: Tolerance of the solves for derivatives, divided by the tolerance of the step.
_ADJOINT = 0.1

#: Name of the root of a step for checkpoints: if reverse mode keeps the root, the iterations are not repeated.
ROOT = "root"


class _Point(NamedTuple):
    q: jax.Array  # last accepted iterate of the current substep
    size: jax.Array  # |r| at q
    aim: jax.Array  # norm of the right-hand side for the last direction dq
    kept: Kept
    beside: jax.Array | None  # additional unknowns at q (`Problem.beside`); None: no such unknowns
    looser: jax.Array  # factor that multiplies the tolerance of the next solve for `beside`
    indefinite: jax.Array  # whether the tangent of the last solve was not positive definite
    stale: jax.Array  # whether dq comes from a tangent that was made at an earlier iterate
    remake: jax.Array  # whether the next evaluation is at q again, for a new tangent
    dq: jax.Array
    t: jax.Array  # the next trial iterate is q + t dq
    s: jax.Array
    q_begin: jax.Array  # unknowns at the beginning of the current substep
    guessing: jax.Array  # whether the substep began at the guess
    unbalanced: jax.Array  # r at the beginning of the step; 0 if the substep began at the guess
    s_begin: jax.Array
    ds: jax.Array
    launch: jax.Array  # whether the next evaluation is at the beginning of a substep
    first: jax.Array  # whether the next evaluation is the first after the beginning of a substep
    iterations: jax.Array  # number of iterations in this substep
    halvings: jax.Array
    leaps: jax.Array  # number of full steps q + dq in this substep although |r| did not decrease
    total: jax.Array
    linear: jax.Array
    cuts: jax.Array
    relative: jax.Array
    done: jax.Array


def nothing_kept(problem: Problem, start: jax.Array) -> Kept:
    """Return the empty `Kept` for the first step."""
    zero = jnp.zeros((), start.dtype)
    made = jax.eval_shape(lambda q: problem.tangent(q, zero, problem.residual(q, zero)[2], None), start)
    no, beside = jnp.array(False), None if problem.beside is None else problem.beside.before
    # Solves for derivatives use earlier solves only if the matrix is symmetric (equal to its transpose).
    both = start if beside is None else jnp.concatenate([start, beside])
    adjoints = () if problem.adjoint is None else no_earlier(start, both)
    empty = (jax.tree.map(lambda a: jnp.zeros(a.shape, a.dtype), a) for a in (made, beside))
    tangent, beside = jax.lax.stop_gradient(tuple(empty))
    return Kept(tangent, no, zero, no, jax.lax.stop_gradient(jnp.zeros_like(start)), zero, beside, adjoints)


def solve(
    problem: Problem,
    start: jax.Array,
    options: StepOptions = StepOptions(),
    guess: jax.Array | None = None,
    kept: Kept | None = None,
    near: Any = None,
) -> tuple[jax.Array, StepStatistics, Kept]:
    """Find the root q of r(q, 1): follow the solution from `start` (n,) at s = 0. Try `guess` first if it is given.

    The root has no derivatives with respect to `start` and `guess`.

    Returns the root, the statistics, and the `Kept` for the next step. The argument `kept` comes from the last step,
    and `near` is a nearby tangent for derivatives. If the problem has an `adjoint`, the additional unknowns `beside` of
    the result are differentiated together with the root.
    """
    start = jax.lax.stop_gradient(start)
    guess = predicted = None if guess is None else jax.lax.stop_gradient(guess)
    kept = nothing_kept(problem, start) if kept is None else kept
    last, kept = kept.adjoints, jax.lax.stop_gradient(kept._replace(adjoints=()))
    one = jnp.ones((), start.dtype)
    if guess is not None:
        guess = guess + kept.trust * kept.surprise

    kind = jax.tree.map(lambda a: a.dtype, kept)

    def follow(_, start):
        root, (statistics, kept) = found(start)
        if predicted is not None:
            off = jnp.where(statistics.status == status.CONVERGED, root - predicted, 0.0)
            kept = kept._replace(surprise=off, trust=_foretold(off, kept.surprise))
        if problem.beside is not None:
            kept = kept._replace(beside=problem.beside.solved(root, one, problem.beside.guess(kept.beside, 1.0)))
        # Counts and node numbers are returned as floating-point numbers: implicit differentiation gives every output a
        # tangent, and jax 0.10 raises an error for tangents of integers.
        return root, (statistics, jax.tree.map(lambda a: a.astype(start.dtype), kept))

    def found(start):
        if options.one_step:
            return _one_step(problem, start, kept, options)
        if problem.potential is not None:
            return _robust(problem, problem.potential, start, guess, kept, options)
        guessing = jnp.array(guess is not None)
        return _follow(problem, start, start if guess is None else guess, guessing, kept, options)

    # The result of the search counts as a constant, so its derivative rule may be any function. Then `_with_derivative`
    # gives the root its derivative.
    if options.differentiable:
        found_by = jax.lax.custom_root(lambda q: q, start, follow, lambda _, y: jnp.zeros_like(y), has_aux=True)
    else:
        found_by = follow(None, start)
    q, (statistics, kept) = jax.lax.stop_gradient(found_by)
    kept = jax.tree.map(lambda a, dtype: a.astype(dtype), kept, kind)
    q, beside, statistics = checkpoint_name((q, kept.beside, statistics), ROOT)
    root, adjoints = q, last
    if options.differentiable:
        root, beside, adjoints = _with_derivative(problem, q, beside, last, options.tolerance, near)
    code, iterations, linear, cuts = (n.astype(jnp.int32) for n in statistics[:4])
    kept = kept._replace(beside=beside, adjoints=adjoints)
    return root, StepStatistics(code, iterations, linear, cuts, statistics.residual), kept


def _foretold(vector: jax.Array, before: jax.Array) -> jax.Array:
    """Return the factor f from 0 to 1 for which f times `before` (from the last step) is closest to `vector`."""
    square = jnp.vdot(before, before)
    return jnp.clip(jnp.vdot(vector, before) / jnp.where(square > 0, square, 1.0), 0.0, 1.0)


def _with_derivative(
    problem: Problem,
    q: jax.Array,
    beside: jax.Array | None,
    last: Earlier | tuple[()],
    tolerance: Number,
    near: Any,
) -> tuple[jax.Array, jax.Array | None, Earlier | tuple[()]]:
    """Return the root q and `beside` with implicit derivatives, and the earlier linear solves for the next derivative.

    These solves must be carried from step to step. So they are treated as additional unknowns that are equal to `last`.
    Forward mode carries the solves to the next step, and reverse mode carries them to the previous step.
    """
    one, n = jnp.ones((), q.dtype), len(q)
    both, lacking = q, None
    if beside is not None and problem.beside is not None and problem.adjoint is not None:
        both, lacking = jnp.concatenate([q, beside]), problem.beside.lack

    def residual(u):
        if lacking is not None:
            return jnp.concatenate(lacking(u[:n], u[n:])), beside
        r, _, by = _evaluated_near(problem, u, one, beside, 1.0)
        return r, by

    def lack(unknowns):
        u, hints = unknowns
        return residual(u)[0], jax.tree.map(jnp.subtract, hints, last)

    def tangent_solve(linear, y):
        some = None if near is None else (jnp.array(True), near)
        by = residual(q)[1] if beside is None else beside
        K = problem.tangent(q, one, jax.lax.stop_gradient(by), some)
        limits = (jnp.maximum(_ADJOINT * tolerance, 1e-13), MOST_LINEAR_ITERATIONS)
        if problem.adjoint is None:
            known = Known(problem.symmetric)
            matvec, b = (lambda v: linear((v, ()))[0]), y[0]
            return differentiable_solve(matvec, b, problem.preconditioner(K), *limits, known), ()
        return symmetric_solve(linear, y, lambda b, earlier: problem.adjoint(K, b, *limits, earlier), limits[0])

    root, hints = jax.lax.custom_root(lack, (both, last), lambda _, u: (_guarded(problem, u[0]), u[1]), tangent_solve)
    return root[:n], beside if lacking is None else root[n:], hints


def _guarded(problem: Problem, q: jax.Array) -> jax.Array:
    """Return q. A derivative through this function is NaN on purpose: a correct derivative never passes through it.

    Suppose that a loop contains a root and is differentiated twice, the second time in reverse mode. Up to jax 0.10,
    the second derivative does not use the derivative rule of the root (jax 0.11.2 does). Without the NaN, that
    derivative would treat the root as a constant: it would be wrong without a warning.
    """
    leaves = [jnp.ravel(leaf)[:1] for leaf in jax.tree.leaves(problem.numbers)]
    some = [leaf for leaf in leaves if leaf.size and jnp.issubdtype(leaf.dtype, jnp.floating)]
    if not some:
        return q
    total = jnp.sum(jnp.concatenate([leaf.astype(q.dtype) for leaf in some]))
    # The square root has no derivative at 0: there it gives NaN.
    return q + jnp.sqrt(jnp.where(jnp.isfinite(total), 0.0 * total, 0.0))


def _evaluated_near(problem: Problem, q: jax.Array, s: jax.Array, beside: jax.Array | None, looser: Number) -> tuple:
    """Evaluate the residual at q. `beside`: guess of the additional unknowns (their values at a nearby q)."""
    if problem.beside is None or beside is None:
        return problem.residual(q, s)
    return problem.residual(q, s, problem.beside.guess(beside, looser))


def _one_step(problem: Problem, start: jax.Array, kept: Kept, options: StepOptions) -> tuple[jax.Array, Any]:
    """Do one linear solve from the beginning of the step (book chapter, section 4.1.2), with the chosen stiffness."""
    if problem.potential is not None:
        problem = problem._replace(tangent=problem.potential.definite)
    zero, one = jnp.zeros((), start.dtype), jnp.ones((), start.dtype)
    r, _, by = problem.residual(start, zero)
    load = -r - _along(problem, start, zero)  # loads and motions at the end of the step
    at = (start, zero, by)
    finest = 16 * float(jnp.finfo(start.dtype).eps)
    wanted = jnp.clip(0.3 * options.tolerance, finest, _ONE_STEP)
    dq, linear, kept, _ = _direction(problem, kept, at, load, wanted, (True, True))
    q = start + dq
    r, force, _ = problem.residual(q, one)
    relative = jnp.linalg.norm(r) / jnp.where(force > 0, force, 1.0)
    code = jnp.where(relative <= options.tolerance, status.CONVERGED, status.ONE_STEP)
    code = jnp.where(jnp.isfinite(relative), code, status.NOT_FINITE)
    a, b, c, d = (jnp.asarray(n, start.dtype) for n in (code, one, linear, zero))
    return q, (StepStatistics(a, b, c, d, relative), kept)


def _follow(
    problem: Problem, start: jax.Array, guess: jax.Array, guessing: jax.Array, kept: Kept, options: StepOptions
) -> tuple[jax.Array, Any]:
    begin = _first_point(start, guess, guessing, kept, None if problem.beside is None else problem.beside.before)
    end = jax.lax.while_loop(lambda c: ~c.done, partial(_iterate, problem, options, start), begin)
    stopped = jnp.where(end.cuts > options.max_cuts, status.STEP_CUT, status.STALLED)
    failure = jnp.where(end.indefinite, status.INDEFINITE, stopped)
    failure = jnp.where(jnp.isfinite(end.relative), failure, status.NOT_FINITE)
    code = jnp.where((end.s >= 1) & (end.relative <= options.tolerance), status.CONVERGED, failure)
    a, b, c, d = (n.astype(start.dtype) for n in (code, end.total, end.linear, end.cuts))
    return end.q, (StepStatistics(a, b, c, d, end.relative), end.kept._replace(beside=end.beside))


def _robust(
    problem: Problem, potential: Potential, start: jax.Array, guess: jax.Array, kept: Kept, options: StepOptions
) -> tuple[jax.Array, jax.Array]:
    """Follow the solution along the load. Minimise the energy if this fails or if elements are inverted at `start`.

    In the first step of a static run, a `start` that differs from the reference shape is only a guess. If an element of
    the guess is nearly flat, or if the guess leads to no solution, the solution is followed from the reference shape.
    """
    zero = jnp.zeros((), start.dtype)
    nothing = StepStatistics(zero + status.STALLED, zero, zero, zero, zero)
    guessing = jnp.array(guess is not None)
    if potential.rest is not None:
        shape, guessing = potential.rest
        guess, start = start, jnp.where(guessing, shape, start)
    guess = start if guess is None else guess
    volume = potential.volume(guess, zero + 1)
    begin = jnp.where(guessing & (volume > 0), guess, start)
    guessing = guessing & (volume > (0 if potential.rest is None else _FLAT))
    q, (taken, kept) = jax.lax.cond(
        potential.volume(start, zero) <= 0,
        lambda: (start, (nothing, kept)),
        lambda: _follow(problem, start, guess, guessing, kept, options),
    )

    def again():
        first, iterations, linear = untangled(problem, begin, options)
        least = minimise(problem, first, options)
        iterations, linear = iterations + least.iterations, linear + least.linear_iterations
        more = (least.code, taken.iterations + iterations, taken.linear_iterations + linear)
        a, b, c = (jnp.asarray(n, start.dtype) for n in more)
        taken_now = StepStatistics(a, b, c, taken.cuts, least.relative)
        return least.q, (taken_now, kept._replace(made=jnp.array(False)))

    return jax.lax.cond(taken.status == status.CONVERGED, lambda: (q, (taken, kept)), again)


def _first_point(
    start: jax.Array, guess: jax.Array, guessing: jax.Array, kept: Kept, beside: jax.Array | None
) -> _Point:
    zero, none, one, no = jnp.zeros((), start.dtype), jnp.zeros((), jnp.int32), jnp.ones((), start.dtype), False
    first = jnp.where(guessing, guess, start)
    return _Point(
        q=first,
        size=one * jnp.inf,
        aim=zero,
        kept=kept,
        beside=beside,
        looser=one,
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
        leaps=none,
        total=none,
        linear=none,
        cuts=none,
        relative=one,
        done=jnp.array(no),
    )


class _Verdict(NamedTuple):
    """The decision that follows from the residual at a trial iterate."""

    accepted: jax.Array  # the trial iterate replaces the last accepted iterate
    better: jax.Array
    converged: jax.Array  # whether the iterations of the substep have converged
    arrived: jax.Array  # whether the last substep has converged (the step is then finished)
    remake: jax.Array
    failed: jax.Array
    lost: jax.Array  # the guess leads to no solution: the last equilibrium is tried next, and no cut is counted
    launch_now: jax.Array  # a new substep begins at this iterate
    go_on: jax.Array  # a new direction is needed
    halvings: jax.Array
    leap: jax.Array  # the full step q + dq is used, even if |r| increases
    cuts: jax.Array
    done: jax.Array


def _judge(
    c: _Point, s: jax.Array, size: jax.Array, relative: jax.Array, problem: Problem, options: StepOptions
) -> _Verdict:
    finite = jnp.isfinite(size) & jnp.isfinite(relative)
    # The first iterate of a substep may have a larger |r| in two cases: its direction comes from a new tangent, or |r|
    # is below the norm of the right-hand side of this direction (`aim`).
    free = c.first & (~c.stale | (size < c.aim))
    better = finite & ((size < c.size) | free | c.remake) & ~c.launch
    converged = better & (relative <= options.tolerance)
    arrived = converged & (s >= 1)
    # If dq comes from an earlier tangent and does not reduce |r|, a new tangent is made first. dq is not halved yet.
    remake = ~better & ~c.launch & c.stale
    halvings = jnp.where(better | c.launch | remake, 0, c.halvings + 1)
    small = (c.relative <= _PRECISIONS * float(jnp.finfo(size.dtype).eps)) | (c.size <= ROUNDINGS * problem.roundoff)
    leap = (halvings > options.max_halvings) & (c.leaps < _LEAPS) & ~small & problem.kinks
    spent = (c.iterations >= options.max_iterations) | ((halvings > options.max_halvings) & ~leap)
    failed = ~c.launch & ~converged & ~remake & (spent | (c.first & ~finite))
    halvings = jnp.where(leap, 0, halvings)
    exhausted = failed & ~c.first & (s >= 1) & small
    lost = c.guessing & (failed | (c.launch & ~finite)) & ~exhausted
    closing = c.cuts > options.max_cuts
    cuts = c.cuts + (failed & ~lost & ~exhausted & ~closing)
    launch_now = (c.launch & ~lost) | (converged & ~arrived)
    done = arrived | exhausted | closing | (((cuts > options.max_cuts) | (c.launch & ~lost)) & ~finite)
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
        leap=leap & ~failed,
        cuts=cuts,
        done=done,
    )


def _iterate(problem: Problem, options: StepOptions, start: jax.Array, c: _Point) -> _Point:
    """Evaluate the residual once, and solve for a direction if it is needed."""
    # After the last allowed cut, the residual of the full load is evaluated at the last iterate, and is reported.
    closing = c.cuts > options.max_cuts
    c = c._replace(launch=c.launch & ~closing, remake=c.remake | closing, s=jnp.where(closing, 1.0, c.s))
    trial = jnp.where(c.launch, c.q_begin, jnp.where(c.remake, c.q, c.q + c.t * c.dq))
    s = jnp.where(c.launch, c.s_begin, c.s)
    r, force, by = _evaluated_near(problem, trial, s, c.beside, c.looser)
    unbalanced = jnp.where(c.launch & ~c.guessing & (c.s_begin == 0), r, c.unbalanced)
    r = r - (1 - s) * unbalanced
    size = jnp.linalg.norm(r)
    relative = size / jnp.where(force > 0, force, 1.0)
    v = _judge(c, s, size, relative, problem, options)
    longer = jnp.minimum(2 * c.ds, 1 - s)
    longer = jnp.where(1 - s - longer < 1e-9, 1 - s, longer)
    ds = jnp.where(v.converged, longer, jnp.where(v.failed & ~v.lost, 0.5 * c.ds, c.ds))
    load = -r - jnp.where(v.launch_now, ds, 0.0) * unbalanced
    if problem.moved:
        load = load - jax.lax.cond(v.launch_now, lambda: ds * _along(problem, trial, s), lambda: jnp.zeros_like(r))
    slow = c.remake | (size > _CONTRACTION * c.aim)
    renew = (v.launch_now & (~c.guessing | ~c.kept.made)) | (v.go_on & ~v.launch_now & slow)
    # The linear solve is only as accurate as is useful (Eisenstat and Walker 1996) and as the tolerance requires.
    ratio = size / jnp.where(c.aim > 0, c.aim, 1.0)
    reach = 0.3 * jnp.where(renew, ratio**2, ratio)
    goal = 0.3 * options.tolerance / jnp.maximum(relative, jnp.finfo(relative.dtype).tiny)
    forcing = jnp.where(v.launch_now, LINEAR_TOLERANCE, jnp.maximum(reach, jnp.maximum(goal, 1e-12)))
    forcing = jnp.minimum(forcing, LINEAR_TOLERANCE)
    at = (trial, s, by)
    dq, linear, kept, positive = _direction(problem, c.kept, at, load, forcing, (renew, v.go_on))
    return _Point(
        q=jnp.where(v.accepted, trial, c.q),
        size=jnp.where(v.accepted, size, c.size),
        aim=jnp.where(v.go_on, jnp.linalg.norm(load), c.aim),
        kept=kept,
        beside=None if c.beside is None else jnp.where(v.accepted, by, c.beside),
        looser=_looser(options, v, forcing * relative, c.looser),
        indefinite=jnp.where(v.go_on, ~positive, c.indefinite),
        stale=jnp.where(v.go_on, ~renew, c.stale),
        remake=v.remake,
        dq=jnp.where(v.go_on, dq, c.dq),
        t=jnp.where(v.go_on | v.leap, 1.0, 0.5 * c.t),
        s=jnp.where(v.launch_now, s + ds, s),
        q_begin=jnp.where(v.lost, start, jnp.where(v.launch_now, trial, c.q_begin)),
        unbalanced=unbalanced,
        guessing=c.guessing & ~v.lost & ~(v.converged & ~v.arrived),
        s_begin=jnp.where(v.launch_now, s, c.s_begin),
        ds=ds,
        launch=v.failed | v.lost,
        first=v.launch_now | v.leap,
        iterations=jnp.where(v.launch_now, 1, c.iterations + v.better),
        halvings=v.halvings,
        leaps=jnp.where(v.launch_now, 0, c.leaps + v.leap),
        total=c.total + (v.go_on & ~v.arrived),
        linear=c.linear + linear,
        cuts=v.cuts,
        relative=jnp.where(v.accepted | ~jnp.isfinite(relative), relative, c.relative),
        done=v.done,
    )


#: Allowed error of the solve for the additional unknowns, divided by the residual expected after the next iteration.
_BESIDE = 0.1


def _looser(options: StepOptions, v: _Verdict, expected: jax.Array, before: jax.Array) -> jax.Array:
    """Return the factor that multiplies the tolerance of the next solve for the additional unknowns.

    The factor is proportional to the residual that is expected after the next iteration, and at least 1. If a substep
    begins again, this residual is unknown, so the factor is 1.
    """
    wanted = jnp.maximum(1.0, _BESIDE * expected / options.tolerance)
    return jnp.where(v.failed | v.lost, 1.0, jnp.where(v.go_on, wanted, before)).astype(before.dtype)


def _along(problem: Problem, q: jax.Array, s: jax.Array) -> jax.Array:
    """Return the derivative dr/ds of the residual with respect to the load fraction s (loads, prescribed motions)."""
    return jax.jvp(lambda s: problem.residual(q, s)[0], (s,), (jnp.ones_like(s),))[1]


def _direction(
    problem: Problem, kept: Kept, at: Any, load: jax.Array, forcing: Number, when: tuple[Number, Number]
) -> tuple[jax.Array, jax.Array, Kept, jax.Array]:
    """Solve dr/dq dq = load for dq, with the right-hand side `load` and the relative tolerance `forcing`.

    Return dq, the number of iterations, the new `kept`, and whether dr/dq seems positive definite.

    `at` contains q, s and `by`. `by` is the third result of `Problem.residual`. `when` contains two flags: whether a
    new tangent is made, and whether a solution is needed (otherwise dq is 0).
    """
    near, (renew, wanted) = (kept.made & ~kept.worn, kept.tangent), when
    q, s, by = at
    K = jax.lax.cond(renew, lambda: problem.tangent(q, s, by, near), lambda: kept.tangent)
    dq, linear, positive = jax.lax.cond(
        wanted,
        lambda: problem.solve(K, load, forcing, MOST_LINEAR_ITERATIONS),
        lambda: (jnp.zeros_like(load), jnp.zeros((), jnp.int32), jnp.array(True)),
    )
    pace = (linear / -jnp.log10(forcing)).astype(load.dtype)
    first = jnp.where(renew & ~near[0], pace, kept.pace)
    worn = jnp.where(wanted, pace > _WEAR * first, kept.worn)
    return dq, linear, kept._replace(tangent=K, made=kept.made | renew, pace=first, worn=worn), positive
