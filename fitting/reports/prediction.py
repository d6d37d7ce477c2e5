"""Predict a test that was not fitted, and check the size of the error and the coverage of the stated intervals."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import scipy.stats

from fitting.fits import time_tests
from fitting.fits.together import Measured, name_of, reported_numbers, sizes_of
from fitting.fits.viscoelastic import Fit
from fitting.methods.generalised_maxwell import Maxwell
from fitting.readers.noise_of_series import noise_of_series
from fitting.readers.time_tests import TimeTest


class Prediction(NamedTuple):
    """A test with m measured values, and its prediction. The values are in the order of
    `fitting.fits.together.Together.fitted`."""

    name: str  # sweep, dispersion, relaxation or creep
    source: str
    predicted: np.ndarray  # (m,)
    measured: np.ndarray  # (m,)
    standard_errors: np.ndarray  # (m,) of the predicted values; infinite if the fit does not determine a value
    scales: np.ndarray  # (m,) residuals are weighted by 1 / scales: standard deviations if the test has them
    sizes: np.ndarray  # (m,) relative error = |predicted - measured| / sizes
    inside: np.ndarray  # (m,) whether the point is in the band of the fitted sweep

    @property
    def relative_errors(self) -> np.ndarray:
        """|predicted - measured| divided by the sizes (m,)."""
        return np.abs(self.predicted - self.measured) / self.sizes

    @property
    def factor(self) -> float:
        """Factor by which the prediction must be multiplied to fit the test best. With another sample or another
        strain, all values often differ by one factor."""
        y, p = (v[self.inside] / self.scales[self.inside] for v in (self.measured, self.predicted))
        return float(p @ y / (p @ p))

    @property
    def covered(self) -> float:
        """Fraction of the measured values in the band that lie within the 95 % interval of the prediction. The width of
        this interval includes the scatter of the measured values."""
        off = (self.predicted - self.measured)[self.inside]
        own = self.scales[self.inside] * noise_of_series(off / self.scales[self.inside])
        return float(
            np.mean(np.abs(off) < scipy.stats.norm.ppf(0.975) * np.hypot(self.standard_errors[self.inside], own))
        )


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
    low, high = resolved
    if isinstance(test, TimeTest):
        place = np.asarray(at[0])[np.asarray(at[2])] - test.begun
    else:
        omega = np.asarray(at[0])
        place = np.tile(1 / omega, len(measured) // len(omega))
    inside = (place >= low * (1 - 1e-9)) & (place <= high * (1 + 1e-9))
    errors = np.where(errors < 1e30, errors, np.inf)
    predicted = np.asarray(answers(jnp.asarray(vector)))
    return Prediction(name_of(test), test.source, predicted, measured, errors, scales, sizes_of(test), inside)


def sentence(found: Prediction) -> str:
    """Return one line about a prediction for the user."""
    share, inside = len(found.measured), int(found.inside.sum())
    name = f"{found.name} {found.source}"
    if not inside:
        return f"{name}: predicted, but all {share} values lie outside the band of the sweep"
    off = 100 * found.relative_errors[found.inside].mean()
    told = (
        f"{name}: predicted within {off:.2g} % on average; {100 * found.covered:.0f} % of {inside} numbers lie in the "
        f"95 % interval of the prediction"
    )
    if abs(found.factor - 1) > 0.005 * off:  # at least half of the error is one common factor
        told += f"; {found.factor:.3g} times the prediction would fit the test best"
    outside = share - inside
    also = "1 number outside the band is" if outside == 1 else f"{outside} numbers outside the band are"
    return told + (f"; {also} not counted" if outside else "")
