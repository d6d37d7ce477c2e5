"""Noise that is correlated between neighbouring measured values of a relaxation or creep test. If the noise is treated
as independent, the standard errors of the parameters are too small. This module corrects the standard errors."""

from collections.abc import Callable, Sequence
from functools import partial
from typing import TypeVar

import numpy as np

from fitting.fits import time_tests, viscoelastic
from fitting.fits.time_tests import INDEPENDENT, TimeFit
from fitting.fits.together.measured_tests import Measured, reported_numbers
from fitting.fits.together.residuals_of_tests import Together
from fitting.methods import host, uncertainty
from fitting.methods.estimate import Estimate, errors_and_correlation, freedom_of_alike
from fitting.methods.noise.alike_noise import alike_noise
from fitting.methods.noise.uneven_noise import probability_of_sizes, uneven_root
from fitting.readers.time_tests import TimeTest

#: A standard error can be computed from the size of each residual, or for noise of equal size. The first is used if it
#: exceeds the second by this factor.
_UNEVEN_FROM = 1.3


def fitted_by_its_noise(test: TimeTest, modes: int | str = "auto") -> tuple[TimeTest, TimeFit]:
    """Fit Prony modes to a test, and return the test and the fit. `constant_noise` of the returned test is True if the
    noise has the same standard deviation at all measured values.

    The first fit assumes noise that is proportional to the measured values. If the residuals show a constant standard
    deviation instead, small values had too much weight. Then the test is fitted again with equal scales.
    """
    fit = time_tests.fit(test, modes)
    if test.constant_noise or not _has_constant_noise(fit):
        return test, fit
    test = test._replace(constant_noise=True)
    return test, time_tests.fit(test, modes)


def _has_constant_noise(fit: TimeFit) -> bool:
    """Return whether the residuals are noise with a constant standard deviation. The result is False if the residuals
    have a structure, because such residuals are not noise."""
    if not (fit.converged and fit.uncertainty.noise > 0 and np.all(np.isfinite(fit.uncertainty.standard_errors))):
        return False
    if fit.relative_errors.max() <= viscoelastic.EXACT or time_tests.structured_misfit(fit):
        return False
    return _sizes(fit, np.asarray(fit.solution.residuals), np.asarray(fit.solution.jacobian))[1]


def with_own_noise(fit: TimeFit) -> TimeFit:
    """Return the fit with standard errors for the noise that its residuals show. The noise of neighbouring values may
    be correlated (`with_alike_noise`). The noise may also be larger for some values than for others, for example if it
    grows with time.
    """
    if not _has_errors_of_noise(fit):
        return fit
    fit = with_alike_noise(fit)
    r, J = np.asarray(fit.solution.residuals), np.asarray(fit.solution.jacobian)
    root, u, own = uneven_root(J, r, np.eye(J.shape[1])), np.asarray(fit.solution.u), fit.parameters
    modes = _at_least(fit.uncertainty, host.with_jacobian(_modes_of(fit), u)[1] @ root)
    if own is not None and fit.kind.values is not None:
        own = _at_least(own, host.with_jacobian(fit.kind.values, u)[1] @ root)
    fluid = uncertainty.like_a_fluid(modes, "measure longer") if fit.kind.name == "prony" else []
    return fit._replace(uncertainty=modes, parameters=own, warnings=(*fit.warnings, *fluid))


def _has_errors_of_noise(fit: TimeFit) -> bool:
    """Return whether at least one standard error is finite, and whether noise alone causes the standard errors. Other
    standard errors may be infinite, for example the error of an exponent at its bound. For a spectrum the result is
    False, because its errors depend on its prior too."""
    numbers = fit.parameters or fit.uncertainty
    known = np.all(np.isfinite(numbers.values)) and np.any(np.isfinite(numbers.standard_errors))
    return bool(known and fit.kind.effective is None and fit.uncertainty.noise > 0)


def _at_least(estimate: Estimate, root: np.ndarray) -> Estimate:
    """Replace some standard errors of the estimate by larger standard errors from a second covariance. `root` (P, k) is
    the square root of this covariance of the P parameters, with k columns. A standard error is replaced if the new
    value is more than `_UNEVEN_FROM` times larger."""
    ratio = np.linalg.norm(root, axis=1) / np.where(estimate.standard_errors > 0, estimate.standard_errors, np.inf)
    factor = np.where(np.isfinite(ratio) & (ratio > _UNEVEN_FROM), ratio, 1.0)
    return estimate._replace(
        root=factor[:, None] * np.asarray(estimate.root), standard_errors=factor * estimate.standard_errors
    )


def with_alike_noise(fit: TimeFit) -> TimeFit:
    """Return the fit with standard errors for noise that is correlated between neighbouring values, if the residuals
    show such noise.

    Two kinds of correlation are tested. The correlation may decrease with the distance in time, for example in a drift.
    Or the correlation may decrease with the number of measured values between two values, for example if the instrument
    averages or the model lacks a part of the spectrum. The more probable kind of correlation is used.
    """
    r, J = np.asarray(fit.solution.residuals), np.asarray(fit.solution.jacobian)
    if not _has_errors_of_noise(fit):
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
        f"the noise of neighbouring values is correlated, or the model is inadequate. The {len(r)} values carry the "
        f"information of {alike.independent:.0f} independent values; the standard errors include this effect"
    )
    fit = time_tests.with_elastic_error(fit, np.sqrt(len(r) / alike.independent))
    details = fit.details | {INDEPENDENT: float(alike.independent)}
    return fit._replace(uncertainty=modes, parameters=own, warnings=(*fit.warnings, sentence), details=details)


def _modes_of(fit: TimeFit | Together) -> Callable:
    return partial(uncertainty.parameter_vector, maxwell=fit.kind.maxwell)


#: Noise of constant size is compared with noise that is proportional to the response. Constant size is assumed if its
#: log probability is larger than the other log probability by more than this value.
_CONSTANT = 3.0


def _sizes(fit: TimeFit, r: np.ndarray, J: np.ndarray) -> tuple[np.ndarray, bool]:
    """Return the standard deviations of the m residuals r (m,), and whether the noise has a constant standard
    deviation. The alternative is a standard deviation that is proportional to the measured response. The residuals
    decide which case is more probable. J: derivatives (m, p) of the residuals with respect to the p unknowns."""
    # The scales are computed from measured values, so they contain noise. This noise would disturb the comparison. So
    # the fitted values replace the measured values here. The lower bound of the scales is the same for all values.
    if np.ptp(fit.scales) == 0:  # the fit already assumes constant noise
        equal = np.ones(len(r))
        return probability_of_sizes(J, r, equal)[1] * equal, True
    lower = max(0.0, float(np.median(fit.scales**2 - fit.measured**2)))
    relative = np.sqrt(np.maximum(fit.fitted**2 + lower, 1e-300)) / fit.scales
    constant = np.median(fit.scales) / fit.scales
    (one, level), (other, its_level) = (probability_of_sizes(J, r, size) for size in (relative, constant))
    is_constant = other > one + _CONSTANT
    return (its_level * constant if is_constant else level * relative), bool(is_constant)


def _of_such_noise(
    estimate: Estimate, natural_of: Callable, u: np.ndarray, root: np.ndarray, independent: float | None = None
) -> Estimate:
    """Return the estimate with standard errors from another covariance of the p unknowns u. `natural_of`: function from
    u to the parameters. `root` (p, k): square root of this covariance, with k columns. `independent`: new number of
    independent residuals. None: this number does not change."""
    root = host.with_jacobian(natural_of, u)[1] @ root
    errors, correlation = errors_and_correlation(root)
    errors = np.where(np.isfinite(estimate.standard_errors), errors, np.inf)
    freedom = estimate.freedom
    if independent is not None:
        freedom = freedom_of_alike(freedom, estimate.components, independent)
    return estimate._replace(root=root, standard_errors=errors, correlation=correlation, freedom=freedom)


AFit = TypeVar("AFit", TimeFit, Together)


def with_offset_errors(fit: AFit, tests: Sequence[Measured], factors: Sequence[float]) -> tuple[AFit, float]:
    """Return (fit, error). The standard errors of this fit also contain the errors of the base lines: the sensor
    offsets and drifts that were subtracted from the data.

    `error` is the standard error [Pa] of the equilibrium modulus due to the base lines alone. All measured values of a
    test contain the same error of the base line, so more measured values do not make this standard error smaller.

    Args:
        fit: the fit of these tests.
        tests: one or more tests.
        factors: for each test, the factor that multiplied its scales in the fit.
    """
    J, u, row, columns = np.asarray(fit.solution.jacobian), np.asarray(fit.solution.u), 0, []
    for test, factor in zip(tests, factors, strict=True):
        scales = reported_numbers(test)[2] * factor
        errors = test.base_line_errors(time_tests.thinned(test)) if isinstance(test, TimeTest) else ()
        for error in errors:
            change = np.zeros(len(J))
            change[row : row + len(scales)] = error / scales
            columns.append(change)
        row += len(scales)
    if not columns:
        return fit, 0.0
    shifts = np.linalg.pinv(J) @ np.column_stack(columns)
    modes, moved = _with_shifts(fit.uncertainty, _modes_of(fit), u, shifts)
    own = fit.parameters
    if own is not None and fit.kind.values is not None:
        own, _ = _with_shifts(own, fit.kind.values, u, shifts)
    rest = float(np.linalg.norm(uncertainty.equilibrium_change(fit.uncertainty.values, moved)))
    return fit._replace(uncertainty=modes, parameters=own), rest


def _with_shifts(
    estimate: Estimate, natural_of: Callable, u: np.ndarray, shifts: np.ndarray
) -> tuple[Estimate, np.ndarray]:
    """Return the estimate with additional independent errors, and the changes of the parameters due to these errors.
    `natural_of`: function from the unknowns u to the parameters. Each column of `shifts` belongs to one error, and is
    the change of u if this error is one standard deviation."""
    moved = host.with_jacobian(natural_of, u)[1] @ shifts
    root = np.column_stack([estimate.root, moved])
    errors, correlation = errors_and_correlation(root)
    errors = np.where(np.isfinite(estimate.standard_errors), errors, np.inf)
    return estimate._replace(root=root, standard_errors=errors, correlation=correlation), moved
