"""Noise that neighbouring answers of a test in time share: the errors of its numbers, which independent noise
underestimates."""

from collections.abc import Callable
from functools import partial

import numpy as np

from fitting.fits.time_tests import INDEPENDENT, TimeFit
from fitting.methods import host, uncertainty
from fitting.methods.estimate import Estimate, errors_and_correlation
from fitting.methods.noise.alike_noise import Alike, alike_noise


def with_alike_noise(fit: TimeFit) -> TimeFit:
    """The fit with the errors of noise that neighbouring answers share, if its residuals show any.

    Neighbours are near each other in time, as in a drift, or in the order of the answers, as where the instrument
    averages or the model misses a part of the spectrum. The more probable of the two is taken.
    """
    r, J = np.asarray(fit.solution.residuals), np.asarray(fit.solution.jacobian)
    numbers = fit.parameters or fit.uncertainty
    if fit.kind.effective is not None or not np.all(np.isfinite(numbers.standard_errors)):
        return fit  # a spectrum has errors of its prior, not of noise alone
    if not fit.uncertainty.noise > 0:
        return fit
    # The residuals are divided by the measured answers, whose noise would look like an order in J: by the fitted ones.
    lower = fit.scales**2 - fit.measured**2
    size = fit.uncertainty.noise * np.sqrt(np.maximum(fit.fitted**2 + lower, 1e-300)) / fit.scales
    r, J = r / size, J / size[:, None]
    group, axis = np.zeros(len(r)), np.array([1.0, 0.0, 0.0])
    lines = (fit.time[:, None] * axis, np.arange(len(r))[:, None] * axis)
    found = [a for a in (alike_noise(places, group, r, J) for places in lines) if a is not None]
    if not found:
        return fit
    alike = max(found, key=lambda a: a.gain)
    u, own = np.asarray(fit.solution.u), fit.parameters
    modes = _of_such_noise(fit.uncertainty, partial(uncertainty.parameter_vector, maxwell=fit.kind.maxwell), u, alike)
    if own is not None and fit.kind.values is not None:
        own = _of_such_noise(own, fit.kind.values, u, alike)
    sentence = (
        f"neighbouring answers share their noise, or the model misses something: {len(r)} answers measure as much as "
        f"{alike.independent:.0f} of independent noise; the standard errors are those of such noise"
    )
    details = fit.details | {INDEPENDENT: float(alike.independent)}
    return fit._replace(uncertainty=modes, parameters=own, warnings=(*fit.warnings, sentence), details=details)


def _of_such_noise(estimate: Estimate, natural_of: Callable, u: np.ndarray, alike: Alike) -> Estimate:
    root = host.with_jacobian(natural_of, u)[1] @ alike.root
    errors, correlation = errors_and_correlation(root)
    freedom = max(1.0, alike.independent - (estimate.components - estimate.freedom))
    larger = np.maximum(errors, estimate.standard_errors)
    return estimate._replace(root=root, standard_errors=larger, correlation=correlation, freedom=freedom)
