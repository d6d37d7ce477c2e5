"""Minimise the energy of a step, if elements are inverted at the beginning or if the usual Newton iterations fail.

`liverjax.solvers.step_cutting` does the usual Newton iterations. The minimisation uses the true tangent if conjugate
gradients find no negative curvature in it. Otherwise it uses a tangent without negative eigenvalues
(`liverjax.elements.projection`). A backtracking line search halves the step length until the energy decreases enough
(Armijo's condition). Near the minimum the convergence is quadratic. If elements are inverted at the start, a
minimisation with a stable neo-Hookean law of the same moduli first removes the inversions. The energy of this law is
finite everywhere, so every law can start from inverted elements.

If pressures are unknowns, the solution is a saddle point of the energy. With the optimal pressures for each set of
positions, the solution is a minimum. So only positions are varied, and the pressures follow from the positions. In
quadratic elements the pressures are eliminated from a tangent without negative eigenvalues, so that the tangent is
positive definite.

Forces without an energy, for example friction, are held constant during an iteration. Constant forces have an energy.
At the beginning of the iteration, the gradient of the total energy is the residual.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp

from liverjax.core import status
from liverjax.solvers.problem import LINEAR_TOLERANCE, MOST_LINEAR_ITERATIONS, Potential, Problem, StepOptions

#: Required decrease of the energy, divided by the decrease that its derivative predicts (Armijo; Nocedal and Wright
#: 2006, 3.1).
_FALL = 1e-4
#: A relative difference of energies below this multiple of the machine precision counts as roundoff. Then the line
#: search also accepts a smaller residual instead of a smaller energy.
_ROUNDOFF = 5e3
#: After the true tangent has failed, it is tried again after at most this number of iterations.
_PATIENCE = 8
#: Maximum number of iterations, and maximum number of halvings of the step length in one iteration.
_MOST_ITERATIONS, _MOST_SHORTENINGS = 300, 30
#: A true tangent that is not symmetric, or has pressures, is used only if the relative residual is below this value.
#: Far from the solution the tangent may be indefinite. BiCGSTAB does not detect this and would use all its iterations.
_NEAR = 0.1
#: Maximum tolerance of the linear solves if pressures follow from positions and a solve does not eliminate them. It is
#: small, because the ratio of bulk to shear modulus amplifies errors of the pressure equations.
_WITH_PRESSURES = 1e-6
#: Tolerance of the minimisation that removes inversions with a surrogate law.
_UNTANGLED = 1e-4


class Minimum(NamedTuple):
    """Result of a minimisation: the last iterate."""

    q: jax.Array
    code: jax.Array
    iterations: jax.Array
    linear_iterations: jax.Array
    relative: jax.Array  # norm of the residual, divided by the norm of all forces


class _Descent(NamedTuple):
    q: jax.Array
    energy: jax.Array
    r: jax.Array
    relative: jax.Array
    by: jax.Array
    definite: jax.Array  # number of iterations without the true tangent, until the true tangent is tried again
    patience: jax.Array  # the next value of `definite` if the true tangent fails again
    indefinite: jax.Array  # whether the last true tangent was not positive definite
    stuck: jax.Array
    iterations: jax.Array
    linear: jax.Array


def minimise(problem: Problem, start: jax.Array, options: StepOptions) -> Minimum:
    """Find a minimum of `problem.potential.energy` near `start` (n,), with the loads at the end of the step.

    Args:
        problem: `liverjax.solvers.problem.Problem` with a potential.
        start: flat vector of unknowns. Elements may be inverted if the energy is finite there.
        options: `liverjax.solvers.problem.StepOptions`.
    """

    def go_on(c):
        searching = jnp.isfinite(c.energy) & (c.relative > options.tolerance) & ~c.stuck
        return searching & (c.iterations < _MOST_ITERATIONS)

    zero = jnp.zeros((), jnp.int32)
    begin = _evaluated(problem, start, zero, zero + 1, jnp.array(False), zero, zero)
    end = jax.lax.while_loop(go_on, lambda c: _descend(problem, options, c), begin)
    finite = jnp.isfinite(end.energy) & jnp.isfinite(end.relative)
    failure = jnp.where(finite, jnp.where(end.indefinite, status.INDEFINITE, status.STALLED), status.NOT_FINITE)
    code = jnp.where(finite & (end.relative <= options.tolerance), status.CONVERGED, failure)
    return Minimum(end.q, code, end.iterations, end.linear, end.relative)


def _potential(problem: Problem) -> Potential:
    assert problem.potential is not None
    return problem.potential


def _settled(problem: Problem, q: jax.Array) -> jax.Array:
    settled = _potential(problem).settled
    return q if settled is None else settled(q)


def untangled(problem: Problem, start: jax.Array, options: StepOptions) -> tuple[jax.Array, jax.Array, jax.Array]:
    """Try to find unknowns near `start` without inverted elements.

    Return the unknowns, the number of iterations and the number of linear iterations.
    """
    zero, potential = jnp.zeros((), jnp.int32), _potential(problem)
    surrogate = potential.surrogate
    if surrogate is None:
        return start, zero, zero

    def away():
        # The unknowns of the surrogate are only positions.
        n = len(start) if potential.positions is None else potential.positions
        least = minimise(surrogate, start[:n], options._replace(tolerance=_UNTANGLED))
        return jnp.concatenate([least.q, start[n:]]), least.iterations, least.linear_iterations

    return jax.lax.cond(potential.volume(start, jnp.ones((), start.dtype)) <= 0, away, lambda: (start, zero, zero))


def _evaluated(
    problem: Problem, q: jax.Array, definite: jax.Array, patience: jax.Array, indefinite: jax.Array, *counts: jax.Array
) -> _Descent:
    q = _settled(problem, q)
    r, force, by = problem.residual(q, jnp.ones((), q.dtype))
    relative = jnp.linalg.norm(r) / jnp.where(force > 0, force, 1.0)
    energy = _potential(problem).energy(q, q)
    return _Descent(q, energy, r, relative, by, definite, patience, indefinite, jnp.array(False), *counts)


def _descend(problem: Problem, options: StepOptions, c: _Descent) -> _Descent:
    one, definite = jnp.ones((), c.q.dtype), c.definite > 0
    if not problem.symmetric or _potential(problem).settled is not None:
        definite = definite | (c.relative > _NEAR)
    K = _potential(problem).definite(c.q, one, c.by, None, definite)
    goal = 0.3 * options.tolerance / jnp.maximum(c.relative, jnp.finfo(c.relative.dtype).tiny)
    forcing = jnp.clip(jnp.minimum(LINEAR_TOLERANCE, jnp.sqrt(c.relative)), jnp.minimum(goal, 0.5), 0.5)
    if _potential(problem).settled is not None:
        loose = definite & _potential(problem).eliminates
        forcing = jnp.where(loose, forcing, jnp.minimum(forcing, _WITH_PRESSURES))
    dq, linear, positive = problem.solve(K, -c.r, forcing, MOST_LINEAR_ITERATIONS)
    slope = jnp.vdot(c.r, dq)
    usable = jnp.isfinite(slope) & (slope < 0) & (positive | definite)
    t = _length(problem, c, dq, slope, usable)
    moved = usable & (t > 0)
    failed = ~definite & ~moved
    new = _evaluated(
        problem,
        jnp.where(moved, c.q + t * dq, c.q),
        jnp.where(failed, c.patience, jnp.maximum(c.definite - 1, 0)),
        jnp.where(failed, jnp.minimum(2 * c.patience, _PATIENCE), jnp.where(definite, c.patience, 1)),
        jnp.where(definite, c.indefinite, ~positive),
        c.iterations + 1,
        c.linear + linear,
    )
    return new._replace(stuck=definite & ~moved)


def _length(problem: Problem, c: _Descent, dq: jax.Array, slope: jax.Array, usable: jax.Array) -> jax.Array:
    """Return the first step length t among 1, 1/2, 1/4, … for which the energy decreases sufficiently (Armijo).

    If the energies at q and q + t dq differ only by roundoff, a smaller residual at q + t dq is also enough. The result
    is 0 if no step length is found.
    """
    one, size = jnp.ones((), c.q.dtype), jnp.linalg.norm(c.r)

    def good(t):
        q = _settled(problem, c.q + t * dq)
        energy = _potential(problem).energy(q, c.q)
        falls = energy <= c.energy + _FALL * t * slope
        level = abs(energy - c.energy) <= _ROUNDOFF * jnp.finfo(c.q.dtype).eps * abs(c.energy)
        better = jnp.linalg.norm(problem.residual(q, one)[0]) < size
        return falls | (level & better)

    def go_on(state):
        _, found, n = state
        return usable & ~found & (n <= _MOST_SHORTENINGS)

    def halve(state):
        t, _, n = state
        return 0.5 * t, good(0.5 * t), n + 1

    t, found, _ = jax.lax.while_loop(go_on, halve, (2 * one, jnp.array(False), 0))
    return jnp.where(found, t, 0.0)
