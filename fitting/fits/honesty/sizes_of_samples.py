"""Errors of the parameters of a common fit of several tests, due to errors in the sizes of the samples.

A wrong gap or radius multiplies all moduli of a test by a factor (see `total_error.of_geometry`). If only one test is
fitted, this factor changes only G0. If tests with different factors are fitted together, ratios and relaxation times
change too.
"""

from functools import partial

import numpy as np

from fitting.fits.together import measured_tests
from fitting.fits.together.residuals_of_tests import Together
from fitting.methods import uncertainty
from fitting.methods.estimate import with_slope
from fitting.waves.dispersion import Dispersion


def shares_with_sizes(fit: Together, relative: float | np.ndarray) -> dict[str, dict[str, float]]:
    """Return the errors of each parameter due to noise and due to the sizes of the samples. The strengths of a spectrum
    are not included.

    Args:
        fit: the common fit.
        relative: relative standard deviations (K,) of the factors of the K tests, or one number for all tests.
    """
    own = fit.uncertainty if fit.parameters is None else fit.parameters
    names = [n for n in own.names if not n.startswith("strengths[")]
    kept = [own.names.index(n) for n in names]
    by_size = _by_sizes(fit)[kept] * relative
    # If the samples are different, their factors are independent. If one sample is mounted only once, all its tests
    # have the same factor. The larger of these two errors is used.
    both = np.maximum(np.linalg.norm(by_size, axis=1), np.abs(by_size.sum(axis=1)))
    shares = {"noise": own.standard_errors[kept], "geometry": both}
    found = {source: dict(zip(names, part.tolist(), strict=True)) for source, part in shares.items()}
    if fit.parameters is None and np.isfinite(uncertainty.equilibrium_error(own)):
        found["noise"]["equilibrium_modulus"] = uncertainty.equilibrium_error(own)
        rest = uncertainty.equilibrium_change(own.values, by_size)
        found["geometry"]["equilibrium_modulus"] = float(max(np.linalg.norm(rest), abs(rest.sum())))
    return found


def _by_sizes(fit: Together) -> np.ndarray:
    """Return the derivatives (P, K) of the P parameters with respect to the logarithms of the factors of the K tests.
    The factor of a test multiplies all its moduli."""
    J, u = np.asarray(fit.solution.jacobian), fit.solution.u
    of = fit.kind.values if fit.parameters is not None else None
    _, slope = with_slope(of or partial(uncertainty.parameter_vector, maxwell=fit.kind.maxwell), u)
    if not np.all(np.isfinite(J)):
        return np.zeros((len(slope), len(fit.tests)))
    moved, first = np.zeros((len(J), len(fit.tests))), 0
    for k, (test, share) in enumerate(zip(fit.tests, fit.shares, strict=True)):
        _, measured, scales = measured_tests.reported_numbers(test)
        if not isinstance(test, Dispersion):  # waves do not depend on the size of the sample
            sign = -1.0 if measured_tests.name_of(test) == "creep" else 1.0  # a stiffer sample creeps less
            moved[first : first + share.points, k] = sign * measured / (scales * share.noise)
        first += share.points
    size = np.maximum(np.linalg.norm(J, axis=0), 1e-300)
    return (slope / size) @ (np.linalg.pinv(J / size) @ moved)
