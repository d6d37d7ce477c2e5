"""The tests that can be fitted together, and their measured values, scales and noise."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from fitting.fits import time_tests
from fitting.readers.frequency_sweep import Sweep
from fitting.readers.time_tests import TimeTest
from fitting.waves.dispersion import Dispersion

#: QUIETEST: minimum relative noise of a test. FIRST: relative noise in round 1.
QUIETEST, FIRST = 1e-5, 0.03


Measured = Sweep | TimeTest | Dispersion


class ResolvedBand(NamedTuple):
    """The range of relaxation times [s] that the tests resolve together."""

    resolved: tuple[float, float]


def resolved_by(tests: Sequence[Measured]) -> tuple[float, float]:
    """Return the shortest and the longest relaxation time [s] that at least one of the tests resolves."""
    ends = np.array([t.resolved for t in tests])
    return float(ends[:, 0].min()), float(ends[:, 1].max())


def name_of(test: Measured) -> str:
    """Return the kind of test: sweep, dispersion, relaxation or creep."""
    if isinstance(test, TimeTest):
        return test.kind
    return "sweep" if isinstance(test, Sweep) else "dispersion"


def series_of(test: Measured) -> tuple[str, ...]:
    """Return the names of the series in the measured values of a test, for example " (G')". All series have the same
    length. If there is only one series, its name is empty."""
    if isinstance(test, Sweep):
        return (" (G')", " (G'')")
    waves = isinstance(test, Dispersion) and test.attenuation is not None
    return (" (velocity)", " (attenuation)") if waves else ("",)


def reported_numbers(test: Measured) -> tuple[tuple, np.ndarray, np.ndarray]:
    """Return three results: the arrays from which a test is predicted, the measured values, and the scales of these
    values."""
    if isinstance(test, Sweep):
        return (test.angular_frequency,), np.concatenate([test.storage, test.loss]), np.concatenate(test.deviations)
    if isinstance(test, Dispersion):
        measured = test.measured
        return (test.angular_frequency, test.density, np.arange(len(measured))), measured, test.scales
    at, driven, rows, answer, scales = time_tests.data_in_time(test)
    return (at, driven, rows), answer, scales


def sizes_of(test: Measured) -> np.ndarray:
    """Return the divisors for relative errors: the measured values, with a lower bound in relaxation and creep. If the
    standard deviations of a sweep were estimated from scatter, the divisor of G'' is |G*|, because errors of the phase
    angle may cause this scatter."""
    _, measured, scales = reported_numbers(test)
    if isinstance(test, Sweep) and test.sd_estimated:
        return np.concatenate([test.storage, np.hypot(test.storage, test.loss)])
    return scales if isinstance(test, TimeTest) else measured


def sizes_beside(test: Measured, fitted: np.ndarray) -> np.ndarray:
    """Return the divisors for relative errors of a test (`sizes_of`). The fit predicts the values `fitted`. The divisor
    is infinite for a value that does not count (`time_tests.relative_sizes`)."""
    sizes = sizes_of(test)
    if not isinstance(test, TimeTest):
        return sizes
    return time_tests.relative_sizes(reported_numbers(test)[1], fitted, sizes, test.rounding)


def relative_errors_of(test: Measured, fitted: np.ndarray) -> np.ndarray:
    """Return the relative errors (k,) of those k values of a test that count (`sizes_beside`). The fit predicts the
    values `fitted`."""
    sizes = sizes_beside(test, fitted)
    return (np.abs(fitted - reported_numbers(test)[1]) / sizes)[np.isfinite(sizes)]


def least_noise(test: Measured) -> float:
    """Return the lower bound of the noise of a test, divided by its scales. The bound is 1 if standard deviations are
    given: the fit may enlarge them, but not reduce them."""
    return 1.0 if isinstance(test, Sweep) and test.noise_given else QUIETEST


def first_noise(test: Measured) -> float:
    """Return the noise of a test in round 1, divided by its scales. All tests begin with the relative noise `FIRST`."""
    return max(least_noise(test), FIRST * float(np.median(np.abs(sizes_of(test)) / reported_numbers(test)[2])))
