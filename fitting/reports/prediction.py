"""Predict a test that was not fitted, and check the size of the error and the coverage of the stated intervals."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import scipy.stats

from fitting.fits import time_tests
from fitting.fits.together.measured_tests import Measured, name_of, reported_numbers, series_of, sizes_of
from fitting.fits.viscoelastic import Fit
from fitting.methods.generalised_maxwell import Maxwell
from fitting.readers.frequency_sweep import Sweep
from fitting.readers.noise_of_series import noise_of_series
from fitting.readers.time_tests import TimeTest

#: A factor that differs from 1 by less than this number is not printed.
_ONE = 0.005


class Prediction(NamedTuple):
    """A test with m measured values, and its prediction. The values are in the order of
    `fitting.fits.together.Together.fitted`."""

    name: str  # sweep, dispersion, relaxation or creep
    source: str
    predicted: np.ndarray  # (m,)
    measured: np.ndarray  # (m,)
    standard_errors: np.ndarray  # (m,) of the predicted values; infinite if the fit does not determine a value
    scales: np.ndarray  # (m,) residuals are weighted by 1 / scales: standard deviations if the test has them
    sizes: np.ndarray  # (m,) relative error = |predicted - measured| / sizes; infinite if a value does not count
    inside: np.ndarray  # (m,) whether the point is in the band of the fitted sweep, see `_in_band`
    noise: np.ndarray  # (m,) noise of the measured values, divided by `scales`; NaN: too few values to estimate it
    quantile: float  # half width of a 95 % interval of the fit, divided by the standard error

    @property
    def relative_errors(self) -> np.ndarray:
        """|predicted - measured| divided by the sizes (m,)."""
        return np.abs(self.predicted - self.measured) / self.sizes

    @property
    def counted(self) -> np.ndarray:
        """Whether each value is in the band of the sweep and has not decayed into the noise (m,)."""
        return self.inside & np.isfinite(self.sizes)

    @property
    def factor(self) -> float:
        """Factor by which the prediction must be multiplied to fit the test best. In a test of another sample or at
        another strain, all values often differ from the prediction by the same factor."""
        y, p = (v[self.inside] / self.scales[self.inside] for v in (self.measured, self.predicted))
        return float(p @ y / (p @ p))

    @property
    def covered(self) -> float:
        """Fraction of the `counted` values that lie within the 95 % interval of the prediction. The half width of this
        interval is the root of the sum of two squares: the half width from the fit (`quantile`), and the half width
        from the scatter of the measured values. NaN if this scatter is unknown, or if no value counts."""
        if np.isnan(self.noise).any() or not self.counted.any():
            return np.nan
        off, own = (v[self.counted] for v in (self.predicted - self.measured, self.noise * self.scales))
        of_fit = self.quantile * self.standard_errors[self.counted]
        return float(np.mean(np.abs(off) < np.hypot(of_fit, scipy.stats.norm.ppf(0.975) * own)))


def predict(fit: Fit, resolved: tuple[float, float], test: Measured) -> Prediction:
    """Predict a test, and compare the prediction with the measured values.

    Args:
        fit: fit of a sweep. Its Prony modes are the model.
        resolved: shortest and longest relaxation time [s] that the sweep resolves.
        test: a test that was not fitted.
    """
    at, measured, scales = reported_numbers(test)
    vector, n = np.asarray(fit.uncertainty.values, float), fit.modes

    def answers(p: jax.Array) -> jax.Array:
        model = Maxwell(p[0], p[1 : n + 1], p[n + 1 :])
        return time_tests.response_in_time(name_of(test), model, *map(jnp.asarray, at))

    slopes = np.asarray(jax.jacfwd(answers)(jnp.asarray(vector)))
    with np.errstate(over="ignore", invalid="ignore"):
        errors = np.linalg.norm(slopes @ fit.uncertainty.root, axis=1)
    inside = _in_band(test, resolved, len(measured))
    errors = np.where(errors < 1e30, errors, np.inf)
    predicted = np.asarray(answers(jnp.asarray(vector)))
    sizes = sizes_of(test)
    if isinstance(test, TimeTest):
        sizes = time_tests.sizes_of_prediction(measured, predicted, sizes, test.rounding)
    off, parts = (predicted - measured) / scales, len(series_of(test))
    noise = _scatter_around(off.reshape(parts, -1), inside.reshape(parts, -1), test).ravel()
    own = (errors, scales, sizes, inside, noise, fit.uncertainty.quantile)
    return Prediction(name_of(test), test.source, predicted, measured, *own)


def _in_band(test: Measured, resolved: tuple[float, float], count: int) -> np.ndarray:
    """Return for each of the `count` values (m,) of a test whether the value depends only on resolved relaxation times.

    In a relaxation or creep test, this needs two conditions. First, since the last change of the load, at least the
    shortest of these times has passed (`TimeTest.since_change`). Second, since the beginning of the load, at most the
    longest of these times has passed. In a cyclic test, a weaker second condition is enough: up to the time of this
    value, no interval without a change of the load was longer than the longest of these times."""
    low, high = resolved[0] * (1 - 1e-9), resolved[1] * (1 + 1e-9)
    if not isinstance(test, TimeTest):
        omega = np.asarray(reported_numbers(test)[0][0])
        place = np.tile(1 / omega, count // len(omega))
        return (place >= low) & (place <= high)
    since = test.since_change
    inside = test.time - test.begun <= high
    if test.cyclic:
        inside |= np.maximum.accumulate(since) <= high
    return ((since >= low) & inside)[time_tests.thinned(test)]


def _scatter_around(off: np.ndarray, inside: np.ndarray, test: Measured) -> np.ndarray:
    """Return the noise (s, k) of the values of a test with s series (`series_of`), divided by the scales.

    `off` (s, k): prediction minus test, divided by the scales. `inside` (s, k): whether a value is in the band. If
    every series has four values or more in the band, the noise of each series is estimated from these values.
    Otherwise, all series get one noise, from the second differences of the values in the band. If there are fewer than
    two second differences, the values outside the band are used too, and a series with fewer than four values gets NaN.
    In a sweep with measured standard deviations, the noise is at least 1 (also instead of NaN)."""
    rows = [own[counted] for own, counted in zip(off, inside, strict=True)]
    bends = np.concatenate([np.diff(row, 2) for row in rows])
    fewest = min(map(len, rows))
    if fewest < 4 and len(bends) > 1:  # a second difference has 6 times the variance of the noise
        found = [float(np.sqrt(np.mean(bends**2) / 6))] * len(rows)
    else:
        every = rows if fewest >= 4 else off
        found = [noise_of_series(row) if len(row) >= 4 else np.nan for row in every]
    if isinstance(test, Sweep) and test.noise_given:
        found = [float(np.fmax(1.0, each)) for each in found]
    return np.repeat(np.array(found)[:, None], off.shape[1], axis=1)


def sentence(found: Prediction) -> str:
    """Return one line about a prediction for the user."""
    share, inside = len(found.measured), int(found.inside.sum())
    name = f"{found.name} {found.source}"
    counted = found.counted
    if not counted.any():
        where = "in the band have decayed into the noise" if inside else "lie outside the band of the sweep"
        return f"{name}: predicted, but all {inside or share} values {where}"
    off = 100 * found.relative_errors[counted].mean()
    told = f"{name}: predicted within {off:.2g} % on average"
    if not np.isnan(found.covered):
        told += f"; {100 * found.covered:.0f} % of {counted.sum()} numbers lie in the 95 % interval of the prediction"
    with_factor = found._replace(predicted=found.factor * found.predicted)
    if abs(found.factor - 1) > _ONE and 100 * with_factor.relative_errors[counted].mean() <= 0.5 * off:
        told += f"; {found.factor:.3g} times the prediction would fit the test best"
    outside = share - inside
    also = "1 number outside the band is" if outside == 1 else f"{outside} numbers outside the band are"
    return told + (f"; {also} not counted" if outside else "")
