"""Noise that neighbouring answers of a test in time share: the errors of its numbers, which independent noise
underestimates."""

from collections.abc import Callable
from functools import partial

import numpy as np

from fitting.fits.time_tests import INDEPENDENT, TimeFit
from fitting.methods import host, uncertainty
from fitting.methods.estimate import Estimate, errors_and_correlation
from fitting.methods.noise.alike_noise import alike_noise
from fitting.methods.noise.uneven_noise import probability_of_sizes, uneven_root

#: Errors that the residuals of single answers show count from this factor above those of equal noise.
_UNEVEN_FROM = 1.3


def with_own_noise(fit: TimeFit) -> TimeFit:
    """The fit with the errors of its noise: shared by neighbours (`with_alike_noise`), or of another size at some
    answers than at others, as where it grows with time.
    """
    own = fit.parameters
    if fit.kind.effective is not None or not np.all(np.isfinite((own or fit.uncertainty).standard_errors)):
        return fit
    fit = with_alike_noise(fit)
    if not fit.uncertainty.noise > 0:
        return fit
    r, J = np.asarray(fit.solution.residuals), np.asarray(fit.solution.jacobian)
    root, u, own = uneven_root(J, r, np.eye(J.shape[1])), np.asarray(fit.solution.u), fit.parameters
    modes = _at_least(fit.uncertainty, host.with_jacobian(_modes_of(fit), u)[1] @ root)
    if own is not None and fit.kind.values is not None:
        own = _at_least(own, host.with_jacobian(fit.kind.values, u)[1] @ root)
    return fit._replace(uncertainty=modes, parameters=own)


def _at_least(estimate: Estimate, root: np.ndarray) -> Estimate:
    """The estimate with errors as large as those of a square root (P, k) of the covariance, where these are larger."""
    ratio = np.linalg.norm(root, axis=1) / np.where(estimate.standard_errors > 0, estimate.standard_errors, np.inf)
    factor = np.where(np.isfinite(ratio) & (ratio > _UNEVEN_FROM), ratio, 1.0)
    return estimate._replace(
        root=factor[:, None] * np.asarray(estimate.root), standard_errors=factor * estimate.standard_errors
    )


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
    size, constant = _sizes(fit, r, J)
    inverse = np.linalg.pinv(J) * size
    r, J = r / size, J / size[:, None]
    group, axis = np.zeros(len(r)), np.array([1.0, 0.0, 0.0])
    lines = (fit.time[:, None] * axis, np.arange(len(r))[:, None] * axis)
    found = [a for a in (alike_noise(places, group, r, J, inverse) for places in lines) if a is not None]
    if not found and not constant:
        return fit
    u, own = np.asarray(fit.solution.u), fit.parameters
    if not found:
        modes = _of_such_noise(fit.uncertainty, _modes_of(fit), u, inverse)
        own = own if own is None or fit.kind.values is None else _of_such_noise(own, fit.kind.values, u, inverse)
        return fit._replace(uncertainty=modes, parameters=own)
    alike = max(found, key=lambda a: a.gain)
    modes = _of_such_noise(fit.uncertainty, _modes_of(fit), u, alike.root, alike.independent)
    if own is not None and fit.kind.values is not None:
        own = _of_such_noise(own, fit.kind.values, u, alike.root, alike.independent)
    sentence = (
        f"neighbouring answers share their noise, or the model misses something: {len(r)} answers measure as much as "
        f"{alike.independent:.0f} of independent noise; the standard errors are those of such noise"
    )
    details = fit.details | {INDEPENDENT: float(alike.independent)}
    return fit._replace(uncertainty=modes, parameters=own, warnings=(*fit.warnings, sentence), details=details)


def _modes_of(fit: TimeFit) -> Callable:
    return partial(uncertainty.parameter_vector, maxwell=fit.kind.maxwell)


#: Gain in the logarithm of the probability from which the noise counts as one of constant size.
_CONSTANT = 3.0


def _sizes(fit: TimeFit, r: np.ndarray, J: np.ndarray) -> tuple[np.ndarray, bool]:
    """Deviations of the residuals r (m,), and whether the noise of the answers is of constant size, not in proportion
    to them: whichever the residuals make more probable."""
    # The residuals are divided by the measured answers, whose noise would look like an order in J: by the fitted ones.
    lower = fit.scales**2 - fit.measured**2
    relative = np.sqrt(np.maximum(fit.fitted**2 + lower, 1e-300)) / fit.scales
    constant = np.median(fit.scales) / fit.scales
    (one, level), (other, its_level) = (probability_of_sizes(J, r, size) for size in (relative, constant))
    is_constant = other > one + _CONSTANT
    return (its_level * constant if is_constant else level * relative), bool(is_constant)


def _of_such_noise(
    estimate: Estimate, natural_of: Callable, u: np.ndarray, root: np.ndarray, independent: float | None = None
) -> Estimate:
    """The estimate with the errors of a square root (p, k) of the covariance of u."""
    root = host.with_jacobian(natural_of, u)[1] @ root
    errors, correlation = errors_and_correlation(root)
    errors = np.where(np.isfinite(estimate.standard_errors), errors, np.inf)
    taken = estimate.components - estimate.freedom
    freedom = estimate.freedom if independent is None else max(1.0, independent - taken)
    return estimate._replace(root=root, standard_errors=errors, correlation=correlation, freedom=freedom)
