"""Noise that is correlated between neighbouring frequencies of a sweep, for example because of a drift. If the noise is
treated as independent, the standard errors of the parameters are too small. This module corrects the standard errors.
If a model lacks a part of the relaxation spectrum, its residuals are correlated in the same way.
"""

from collections.abc import Callable
from functools import partial

import numpy as np

from fitting.fits.viscoelastic import EXACT, Fit, sizes_of_noise
from fitting.methods import host, uncertainty
from fitting.methods.estimate import Estimate, errors_and_correlation, freedom_of_alike, wider
from fitting.methods.noise.alike_noise import LOST, Alike, along_rows
from fitting.readers.frequency_sweep import Sweep, mostly_repeated

#: Key in `Fit.details` of a number N: N moduli with independent noise carry the same information as the measured
#: moduli.
INDEPENDENT = "independent_moduli"
#: Key in `Fit.details` of the standard errors for independent noise, by names of the parameters.
OF_INDEPENDENT = "errors_of_independent_noise"
#: Words in the warning about structured residuals, if the noise of neighbouring frequencies is correlated. The words
#: say that the standard errors include this noise.
CONTAINED = "the standard errors contain it, as correlated noise of neighbours"
#: First words of the warning about noise that is correlated between neighbouring frequencies.
SHARED = "the noise of neighbouring frequencies is correlated"


def with_alike_points(fit: Fit, sweep: Sweep) -> Fit:
    """Return the fit with standard errors for noise that is correlated between neighbouring frequencies, if the
    residuals show such noise. If most frequencies are repeated, the fit is returned unchanged."""
    alike = None if mostly_repeated(sweep.angular_frequency) else alike_of(fit)
    if alike is None:
        return fit
    u, own = np.asarray(fit.solution.u), fit.parameters
    modes = not_below(fit.uncertainty, partial(uncertainty.parameter_vector, maxwell=fit.kind.maxwell), u, alike)
    if own is not None and fit.kind.values is not None:
        own = not_below(own, fit.kind.values, u, alike)
    told = (
        f"{SHARED}, or the model is inadequate. The {2 * len(fit.storage)} moduli carry the information of "
        f"{alike.independent:.0f} independent moduli; the standard errors include this effect"
    )
    fluid = uncertainty.like_a_fluid(modes, uncertainty.LOWER) if fit.kind.name == "prony" else []
    # The fit may already have the warning about a fluid, from the smaller errors before this correction.
    fluid = [] if any("(a fluid)" in w for w in fit.warnings) else fluid
    details = fit.details | {INDEPENDENT: float(alike.independent)}
    return fit._replace(uncertainty=modes, parameters=own, warnings=(*fit.warnings, *fluid, told), details=details)


def alike_of(fit: Fit) -> Alike | None:
    """Return the size and correlation length of noise that is correlated between neighbouring frequencies. Returns None
    if the residuals show no such noise. Points with the same frequency count as neighbours, so only few frequencies may
    occur twice.

    The function also returns None for exact data and for spectra. The errors of a spectrum depend on its prior too.
    """
    r, J, n = np.asarray(fit.solution.residuals), np.asarray(fit.solution.jacobian), len(fit.storage)
    numbers = fit.parameters or fit.uncertainty
    known = np.any(np.isfinite(numbers.standard_errors)) and fit.kind.effective is None and len(r) == 2 * n
    if not known or np.sqrt(np.mean(r**2)) < EXACT * max(1.0, fit.uncertainty.noise):
        return None
    size = np.linalg.norm(J, axis=0)
    size = np.where(size > 0, size, 1.0)
    inverse = np.linalg.pinv(J / size, rcond=LOST) / size[:, None]
    return along_rows([n, n], r, J, fit.uncertainty.noise, inverse)


def with_weights_shown(fit: Fit, sweep: Sweep) -> Sweep:
    """Return the sweep with new weights, from the noise of G' and G'' that the residuals show. The sweep is unchanged
    if all values have the same relative noise, or if standard deviations that describe the noise are given. It is also
    unchanged if neighbouring residuals are correlated, because such residuals may be a misfit of the model."""
    sizes = None if INDEPENDENT in fit.details else sizes_of_noise(fit, sweep)
    if sizes is None:
        return sweep
    first, second = (d * s for d, s in zip(sweep.deviations, np.split(sizes, 2), strict=True))
    return sweep._replace(storage_sd=first, loss_sd=second, sd_estimated=True)


def posterior_cautions(fit: Fit, sweep: Sweep) -> list[str]:
    """Return warnings about the posterior of a fit: the noise of neighbouring frequencies is correlated, or the
    posterior does not use the standard deviations of the file, although the fit uses them as weights."""
    if INDEPENDENT in fit.details:
        return [
            "the posterior assumes independent noise of all moduli, but neighbouring points are correlated. The "
            "intervals of the posterior are too narrow: use the standard errors"
        ]
    in_file = sweep.storage_sd is not None and not (sweep.sd_estimated or sweep.sd_before)
    if not in_file or with_weights_shown(fit, sweep) is sweep:
        return []
    return [
        "the posterior does not use the deviations in the file as weights. They are not noise, so the posterior uses "
        "the noise of G' and of G'' that the residuals show. Its means and intervals may therefore differ from the "
        "parameters and standard errors of the fit"
    ]


def not_below(estimate: Estimate, natural_of: Callable, u: np.ndarray, alike: Alike) -> Estimate:
    """Return the estimate with standard errors and degrees of freedom for correlated noise. The error of a parameter
    due to noise changes only if correlated noise gives a larger error. Errors that are common to all points do not
    change.

    Args:
        estimate: the estimate for independent noise.
        natural_of: function from the unknowns u to the parameters.
        u: unknowns (p,) at the minimum.
        alike: the correlated noise.
    """
    shared = np.zeros((len(estimate.values), 0)) if estimate.shared is None else estimate.shared
    noise = np.asarray(estimate.root)[:, : np.shape(estimate.root)[1] - shared.shape[1]]
    before = np.linalg.norm(noise, axis=1)
    size = np.linalg.norm(host.with_jacobian(natural_of, u)[1] @ alike.root, axis=1)
    factor = np.maximum(1.0, size / np.where(before > 0, before, np.inf))
    noise = factor[:, None] * noise
    errors, correlation = errors_and_correlation(noise)
    errors = np.where(np.isfinite(estimate.standard_errors), errors, np.inf)  # infinite errors stay infinite
    freedom = freedom_of_alike(estimate.freedom, estimate.components, alike.independent)
    found = estimate._replace(root=noise, standard_errors=errors, correlation=correlation, shared=None, freedom=freedom)
    for direction in shared.T:
        found = wider(found, direction)
    return found
