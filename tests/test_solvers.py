"""Linear and nonlinear solvers: residuals, counts, status codes, implicit derivatives."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from liverjax.core import status
from liverjax.solvers import newton, step_cutting
from liverjax.solvers.krylov import (
    EARLIER,
    Earlier,
    conjugate_gradients,
    differentiable_solve,
    no_earlier,
    started,
    symmetric_solve,
)
from liverjax.solvers.problem import Problem, StepOptions

RNG = np.random.default_rng(0)
_B = RNG.standard_normal((20, 20))
A = jnp.asarray(_B @ _B.T + 20 * np.eye(20))
b = jnp.asarray(RNG.standard_normal(20))


def _none(r):
    return r


def test_conjugate_gradients_report_what_they_did():
    x, s = conjugate_gradients(lambda v: A @ v, b, _none, 1e-12, 100)
    assert np.allclose(A @ x, b, atol=1e-10) and s.iterations <= 21
    assert np.isclose(s.residual, jnp.linalg.norm(b - A @ x) / jnp.linalg.norm(b))
    _, s = conjugate_gradients(lambda v: A @ v, b, _none, 1e-12, 3)
    assert s.iterations == 3 and s.residual > 1e-6
    exact = jnp.linalg.inv(A)
    _, s = conjugate_gradients(lambda v: A @ v, b, lambda r: exact @ r, 1e-10, 100)
    assert s.iterations == 1
    zero, s = conjugate_gradients(lambda v: A @ v, 0 * b, _none, 1e-10, 100)
    assert s.iterations == 0 and not zero.any()
    # An indefinite matrix is detected, and the iteration stops.
    _, s = conjugate_gradients(lambda v: -(A @ v), b, _none, 1e-10, 100)
    assert s.iterations <= 1 and s.residual > 0.1


def test_differentiable_solve():
    def f(scale, b):
        x = differentiable_solve(lambda v: scale * (A @ v), b, _none, 1e-13, 200)
        return jnp.sum(x**3)

    def g(scale, b):
        return jnp.sum(jnp.linalg.solve(scale * A, b) ** 3)

    for argument in (0, 1):
        assert np.allclose(jax.grad(f, argument)(1.3, b), jax.grad(g, argument)(1.3, b), rtol=1e-9)
    assert np.isclose(jax.jvp(lambda s: f(s, b), (1.3,), (1.0,))[1], jax.grad(g)(1.3, b), rtol=1e-9)


def test_a_wrong_solution_does_not_pass_for_one():
    for solve in (
        lambda: differentiable_solve(lambda v: -(A @ v), b, _none, 1e-13, 200),  # not positive definite
        lambda: differentiable_solve(lambda v: A @ v, b, _none, 1e-13, 2),  # too few iterations
    ):
        assert np.isnan(solve()).all()


def _solve(p, start=None, **options):
    """Solve A x + p x^3 = b."""
    start = jnp.zeros_like(b) if start is None else start
    settings = newton.NewtonOptions(**({"tolerance": 1e-13} | options))
    return newton.newton_root(lambda x: A @ x + p * x**3 - b, start, _none, jnp.linalg.norm(b), settings)


def test_newton_converges_and_is_differentiable_both_ways():
    x, s = _solve(10.0)
    assert s.status == status.CONVERGED and s.residual <= 1e-13 and 1 <= s.iterations < 10
    assert np.allclose(A @ x + 10 * x**3, b, atol=1e-11)
    for p in (0.5, 10.0):
        by_rule = jax.grad(lambda p: jnp.sum(_solve(p)[0]))(p)
        forward = jax.jvp(lambda p: jnp.sum(_solve(p)[0]), (p,), (1.0,))[1]
        H = jnp.linalg.inv(A + jnp.diag(3 * p * _solve(p)[0] ** 2))
        exact = -jnp.sum(H @ _solve(p)[0] ** 3)
        assert np.isclose(by_rule, exact, rtol=1e-9) and np.isclose(forward, exact, rtol=1e-9)


def test_newton_tells_the_truth_when_it_fails():
    _, s = _solve(10.0, max_iterations=1, tolerance=1e-16)
    assert s.status == status.STALLED and "smaller steps" in status.advice(s.status)
    _, s = newton.newton_root(lambda x: jnp.log(x), jnp.array([-1.0]), _none, 1.0)
    assert s.status == status.NOT_FINITE and "inverted" in status.advice(s.status)


def test_newton_halves_a_step_that_overshoots():
    # From 3, the full Newton step for atan diverges.
    x, s = newton.newton_root(jnp.arctan, jnp.array([3.0]), _none, 1.0, newton.NewtonOptions(tolerance=1e-12))
    assert s.status == status.CONVERGED and abs(x[0]) < 1e-12


def test_a_solve_begun_near_its_solution_is_as_exact_and_takes_less():
    exact = jnp.linalg.solve(A, b)
    taken = []

    def solver(b, tolerance):
        x, s = conjugate_gradients(lambda v: A @ v, b, _none, tolerance, 100)
        taken.append(int(s.iterations))
        return x, s.residual

    # the last starting point is farther away than 0, and is not used
    for near in (jnp.zeros(20), exact + 1e-5 * b, 1e3 * b):
        x, residual = started(solver, lambda v: A @ v, b, near, 1e-10)
        left = float(jnp.linalg.norm(b - A @ x) / jnp.linalg.norm(b))
        assert left < 1e-10 and np.isclose(float(residual), left, rtol=1e-3)
    assert taken[1] < taken[0] == taken[2]


def test_derivatives_handed_from_step_to_step():
    """For x_k = A^-1 (x_(k-1)^2 + p), the next solve begins with earlier ones, in both modes, and no result changes."""
    found = []

    def solver(b, earlier):
        x = jnp.linalg.solve(A, b)
        jax.debug.callback(lambda *a: found.append([np.asarray(v) for v in a]), earlier, x)
        return x, b, jnp.zeros(())

    def end(p, handed):
        x, nothing = jnp.zeros(20), no_earlier(p, p)
        last = nothing
        for _ in range(3):
            x, last = symmetric_solve(lambda u: (A @ u[0], u[1]), (x**2 + p, last), solver, 1e-10)
            last = last if handed else nothing
        return jnp.sum(x**3)

    plain, handed = (jax.grad(lambda p, h=h: end(p, h))(b) for h in (False, True))
    jax.effects_barrier()
    assert np.allclose(plain, handed, rtol=1e-12, atol=0)
    # In reverse mode, the first solve has no earlier one, the second has one, and the third has both, the latest first.
    (first, x), (second, y), (third, _) = ((Earlier(*e), x) for e, x in found[-3:])
    assert not first.solutions.any() and np.array_equal(second.solutions[0], x) and not second.solutions[1:].any()
    assert np.array_equal(third.solutions[:2], [y, x]) and np.allclose(third.loads[:2], [A @ y, A @ x], rtol=1e-10)
    forward = jax.jvp(lambda p: end(p, True), (b,), (jnp.ones(20),))[1]
    assert np.isclose(forward, plain.sum(), rtol=1e-12)


def test_earlier_solves_of_nearly_the_same_loads_are_combined():
    """Loads on a curve in time are nearly equal. The next load is extrapolated as by a polynomial through them."""

    def load(t):
        return jnp.sin(jnp.arange(20.0) + t) + t**2 * b

    earlier = no_earlier(b, b)
    for k in range(EARLIER):
        earlier = earlier.with_latest(load(0.01 * k), jnp.linalg.solve(A, load(0.01 * k)))
    new = load(0.01 * EARLIER)
    left = jnp.linalg.norm(new - A @ earlier.combined(new)) / jnp.linalg.norm(new)
    line = jnp.linalg.norm(new - 2 * earlier.loads[0] + earlier.loads[1]) / jnp.linalg.norm(new)
    assert left < 1e-6 < 1e-5 < line
    assert not no_earlier(b, b).combined(b).any()
    # The same load several times adds no information, and causes no error.
    same = no_earlier(b, b)
    for _ in range(EARLIER):
        same = same.with_latest(b, A @ b)
    assert np.allclose(same.combined(2 * b), 2 * A @ b, rtol=1e-12)


def test_a_guess_takes_up_what_the_last_steps_foretold():
    """The solutions are 1 + k/10 + k^2/20, and the guess is a linear extrapolation. It is always 1/10 too small. From
    the third step on, the guess contains this error.
    """

    def root(k):
        return 1 + 0.1 * k + 0.05 * k**2

    def run(forgetful):
        q, before, kept, taken = jnp.ones(1), jnp.ones(1), None, []
        for k in range(1, 7):
            new, s, kept = step(jnp.asarray(float(k)), q, 2 * q - before, kept)
            q, before = new, q
            kept = kept._replace(trust=0 * kept.trust) if forgetful else kept
            taken.append(int(s.iterations))
        return float(q[0]), taken

    @jax.jit
    def step(k, start, guess, kept):
        method = Problem(
            residual=lambda q, s: (q**3 - root(k) ** 3, jnp.ones(()), None),
            tangent=lambda q, s, by, near: 3 * q**2,
            solve=lambda K, b, tolerance, most: (b / K, jnp.ones((), jnp.int32), jnp.array(True)),
            preconditioner=lambda K: lambda r: r / K,
            moved=False,
        )
        return step_cutting.solve(method, start, StepOptions(), guess, kept)

    (end, taken), (same, more) = run(False), run(True)
    assert np.isclose(end, root(6), rtol=1e-8) and np.isclose(same, root(6), rtol=1e-8)
    assert taken[:2] == more[:2] and all(a < b for a, b in zip(taken[3:], more[3:], strict=True))


@pytest.mark.slow
def test_a_second_derivative_of_steps_is_right_or_nan_never_another_number():
    """Two steps in a loop, each the root of q^3 + a q = 1 + q_before / 10."""

    def end(a):
        def step(before, _):
            method = Problem(
                residual=lambda q, s: (q**3 + a * q - 1 - before / 10, jnp.ones(()), None),
                tangent=lambda q, s, by, near: 3 * q**2 + a,
                solve=lambda K, b, tolerance, most: (b / K, jnp.ones((), jnp.int32), jnp.array(True)),
                preconditioner=lambda K: lambda r: r / K,
                moved=False,
                numbers=(a, before),
            )
            return step_cutting.solve(method, before, StepOptions(tolerance=1e-14))[0], None

        return jax.lax.scan(step, jnp.full(1, 0.4), None, length=2)[0][0]

    a, slope = jnp.asarray(2.0), jax.grad(end)
    differences = (slope(a + 1e-4) - slope(a - 1e-4)) / 2e-4  # an error of 1e-8, the square of the step width
    for second in (jax.jacfwd(jax.jacfwd(end)), jax.grad(jax.jacfwd(end))):
        assert np.isclose(second(a), differences, rtol=1e-7)
    for second in (jax.hessian(end), jax.grad(slope)):
        assert np.isnan(second(a)) or np.isclose(second(a), differences, rtol=1e-7)


def test_lanes_do_not_disturb_each_other():
    p = jnp.array([0.1, jnp.nan, 20.0])
    x, s = jax.vmap(_solve)(p)
    assert s.status.tolist() == [status.CONVERGED, status.NOT_FINITE, status.CONVERGED]
    assert np.allclose(x[0], _solve(0.1)[0]) and np.allclose(x[2], _solve(20.0)[0])


def test_a_step_that_fails_in_one_go_is_followed_in_parts():
    """For log q + 5 = 0 from q = 1, full steps leave the domain until the part of the load is an eighth."""
    method = Problem(
        residual=lambda q, s: (jnp.log(q) + 5, jnp.ones(()), None),
        tangent=lambda q, s, by, near: 1 / q,
        solve=lambda K, b, tolerance, most: (b / K, jnp.ones((), jnp.int32), jnp.array(True)),
        preconditioner=lambda K: lambda r: r / K,
        moved=False,
    )
    options = StepOptions(max_halvings=0)
    cuts = []
    for guess in (None, jnp.array([-1.0])):  # a guess outside the domain causes no cut
        q, s, kept = jax.jit(lambda q, g=guess: step_cutting.solve(method, q, options, g))(jnp.ones(1))
        assert s.status == status.CONVERGED and bool(kept.made)
        assert np.allclose(q, np.exp(-5), rtol=1e-7)
        cuts.append(int(s.cuts))
    assert cuts[0] == cuts[1] >= 3
    q, s, _ = jax.jit(lambda q: step_cutting.solve(method, q, options._replace(max_cuts=2)))(jnp.ones(1))
    assert s.status != status.CONVERGED and np.isfinite(q)


def test_a_step_without_solution_reports_the_residual_of_the_returned_values():
    """q^2 - 1 + 3 s = 0 has no solution from s = 1/3. The residual of a smaller load was reported, near 0."""
    method = Problem(
        residual=lambda q, s: (q**2 - 1 + 3 * s, jnp.ones(()), None),
        tangent=lambda q, s, by, near: 2 * q,
        solve=lambda K, b, tolerance, most: (b / K, jnp.ones((), jnp.int32), jnp.array(True)),
        preconditioner=lambda K: lambda r: r / K,
    )
    q, s, _ = jax.jit(lambda q: step_cutting.solve(method, q, StepOptions()))(jnp.ones(1))
    assert s.status == status.STEP_CUT and s.cuts == StepOptions().max_cuts + 1
    assert np.isclose(s.residual, abs(q[0] ** 2 + 2), rtol=1e-12)


@pytest.mark.parametrize("kinks", [True, False])
def test_where_springs_come_to_act_a_direction_halved_in_vain_is_taken_whole(kinks):
    """Two stiff springs act in compression only. The second one acts after a thousandth of the step, and |r| rises."""
    n = jnp.array([[2.0, 1.0], [0.1, -1.0]])
    gap, k, rest = jnp.array([0.0, 1e-4 - 1.0]), jnp.array([1e3, 1e7]), jnp.array([0.0, -1.0])
    method = Problem(
        residual=lambda q, s: (q - rest + n.T @ (k * jnp.minimum(gap + n @ q, 0.0)), k[0], None),
        tangent=lambda q, s, by, near: jnp.eye(2) + n.T @ jnp.diag(jnp.where(gap + n @ q < 0, k, 0.0)) @ n,
        solve=lambda K, b, tolerance, most: (jnp.linalg.solve(K, b), jnp.ones((), jnp.int32), jnp.array(True)),
        preconditioner=lambda K: lambda r: r,
        moved=False,
        kinks=kinks,
    )
    start = jnp.array([1.0, -1.0])
    q, s, _ = jax.jit(lambda q: step_cutting.solve(method, q, StepOptions(tolerance=1e-10)))(start)
    # Both act at the end. Parts of the step find this solution too, with many more solves.
    both = np.linalg.solve(np.eye(2) + n.T @ (k[:, None] * n), rest - n.T @ (k * gap))
    assert s.status == status.CONVERGED and np.allclose(q, both, rtol=1e-8)
    assert (s.cuts == 0) == kinks == (s.iterations <= 4)
