"""The contribution of each test to the parameters of a common fit."""

from collections.abc import Callable
from functools import partial

import numpy as np

from fitting.fits.together.doubts import APART, MISSED
from fitting.fits.together.measured_tests import (
    QUIETEST,
    ResolvedBand,
    first_noise,
    least_noise,
    name_of,
    relative_errors_of,
    reported_numbers,
    resolved_by,
)
from fitting.fits.together.residuals_of_tests import LEAST_FREEDOM, Share, Together, size_of_noise, tests_evaluated
from fitting.fits.together.starting_points import starts_of_all
from fitting.methods import host, uncertainty
from fitting.methods.estimate import errors_and_correlation, spread
from fitting.methods.least_squares import from_starts

#: MORE: maximum number of additional modes in a fit to one test. CLEARLY: minimum decrease of the information criterion
#: for an additional mode (Kass and Raftery 1995).
MORE, CLEARLY = 2, 10.0


def shares_of(fit: Together) -> list[Share]:
    """Return the contribution of each test: the standard errors of the parameters without this test, and the misfit of
    a fit to this test alone."""
    u = np.asarray(fit.solution.u)
    vector = host.with_jacobian(partial(uncertainty.parameter_vector, maxwell=fit.kind.maxwell), u)[1]
    rows = np.asarray(fit.solution.jacobian)
    return shares_by_rows(fit, rows, vector, fit.uncertainty.values, partial(_residuals_alone, fit))


def _residuals_alone(fit: Together, k: int) -> np.ndarray:
    """Return the residuals of all tests, divided by their scales, from a fit to test k alone. The residuals of the
    other tests are 0.

    This fit has as many modes as the common fit, or more if additional modes fit the test better. The common fit of
    tests that contradict each other may have too few modes.
    """
    parts = [reported_numbers(t) for t in fit.tests]
    # Infinite standard deviations exclude a test.
    data = [(at, y, scales if j == k else np.full(len(y), np.inf)) for j, (at, y, scales) in enumerate(parts)]
    evaluate = partial(tests_evaluated, list(map(name_of, fit.tests)), fit.kind)
    count, u = len(parts[k][1]), np.asarray(fit.solution.u)[None]
    every, own = (ResolvedBand(resolved_by(tests)) for tests in (fit.tests, [fit.tests[k]]))
    starts = np.concatenate([u, starts_of_all(fit.tests, every, fit.modes, fit.kind)[1:]])
    best = np.asarray(from_starts(evaluate, starts, data).residuals)
    free, share = starts.shape[1], fit.shares[k]
    noise = size_of_noise(best, count - min(free, count / 2))
    if share.noise <= APART * noise and share.misfit < MISSED:
        return best
    lowest = _criterion_alone(best, count, free)
    for modes in range(fit.modes, fit.modes + MORE + 1):
        # If the moduli of this test are far from the moduli of the other tests, starting points for all tests are not
        # near the minimum of this test. So these starting points are computed for this test alone.
        starts = starts_of_all([fit.tests[k]], own, modes, fit.kind)
        r, free = np.asarray(from_starts(evaluate, starts, data).residuals), starts.shape[1]
        criterion = _criterion_alone(r, count, free)
        if free <= count / 2 and criterion < lowest - CLEARLY:
            best, lowest = r, criterion
    return best


def _criterion_alone(r: np.ndarray, count: int, free: int) -> float:
    """Return the Bayesian information criterion of a fit with `free` parameters to the `count` values of one test."""
    return float(2 * count * np.log(max(size_of_noise(r, count), QUIETEST)) + free * np.log(count))


def shares_by_rows(
    fit: Together, jacobian: np.ndarray, slope: np.ndarray, values: np.ndarray, alone: Callable[[int], np.ndarray]
) -> list[Share]:
    """Return the contribution of each test: the standard errors of the parameters from the residuals of the other tests
    only, and the misfit of a fit to this test alone.

    Args:
        fit: the common fit.
        jacobian: derivatives of the residuals of all tests with respect to u; rows of a prior may follow.
        slope: derivatives of the reported parameters with respect to u.
        values: the reported parameters.
        alone: function of the index of a test. It returns the residuals of a fit to this test alone, divided by their
            scales, for all tests in the order of the common fit.
    """
    counts = [s.points for s in fit.shares]
    free = jacobian.shape[1] if fit.kind.effective is None else fit.kind.effective
    place = np.repeat(np.arange(len(counts)), counts)
    place = np.concatenate([place, np.full(len(jacobian) - len(place), -1)])
    out = []
    for k, share in enumerate(fit.shares):
        root, _ = spread(jacobian[place != k], 1.0, slope)
        without = errors_and_correlation(root)[0]
        r, (_, y, scales) = alone(k)[: sum(counts)][place[: sum(counts)] == k], reported_numbers(fit.tests[k])
        freedom, errors = counts[k] - min(free, counts[k] / 2), relative_errors_of(fit.tests[k], y + r * scales)
        unknown = ~(without < 1e3 * np.abs(values))
        # A fit with as many parameters as values follows the noise, so its residuals do not show the noise.
        least = least_noise if counts[k] - free >= LEAST_FREEDOM else first_noise
        out.append(
            share._replace(
                alone=max(least(fit.tests[k]), size_of_noise(r, freedom)),
                misfit_alone=size_of_noise(errors, freedom * len(errors) / counts[k]),
                errors_without=np.where(unknown, np.inf, without),
            )
        )
    return out
