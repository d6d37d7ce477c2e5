"""Change of the fitted parameters if a fit excludes the points at one end of the band: the part due to noise alone."""

from functools import partial

import numpy as np
import scipy.special

from fitting.fits.time_tests import TimeFit
from fitting.fits.viscoelastic import FLUID, Fit
from fitting.methods import uncertainty
from fitting.methods.estimate import with_slope
from fitting.methods.noise.uneven_noise import sizes_shown
from fitting.readers import frequency_sweep
from fitting.readers.rheometer import Sweep

#: Probability that noise alone causes a warning about the ends of the band.
CHANCE = 0.05
#: SMOOTH: if the scatter of the points about a smooth curve is below this fraction of the residuals, the residuals are
#: not noise (the model is inadequate). ENOUGH: minimum number of points for this comparison.
SMOOTH, ENOUGH = 0.5, 16


def moved_by_noise(fit: Fit, sweep: Sweep, kept: np.ndarray) -> dict[str, float]:
    """Return the standard deviation of the change of each parameter in `edges.values` due to noise alone. The change is
    the difference between two fits: `fit` to all n points, and a fit to only the points `kept` (n,). All results are
    first-order estimates.

    Both fits contain the kept points, so their errors are correlated. Therefore the function computes the variance of
    the difference between the two fits, not the variance of the second fit.
    """
    J, names, slope = np.asarray(fit.solution.jacobian), *_slopes_of_reported(fit)
    points = 2 * len(kept)
    if not (np.all(np.isfinite(J)) and len(J) >= points and len(kept) == len(fit.storage)):
        return dict.fromkeys(names, 0.0)
    rows = np.concatenate([kept, kept, np.ones(len(J) - points, bool)])  # the residuals of the prior are always kept
    scale = np.maximum(np.linalg.norm(J, axis=0), 1e-300)
    change = -np.linalg.pinv(J / scale)
    change[:, rows] += np.linalg.pinv(J[rows] / scale)
    change = (slope / scale) @ change[:, :points] * _noise_of_residuals(fit, sweep, J[:points])
    return dict(zip(names, np.linalg.norm(change, axis=1).tolist(), strict=True))


def farthest_by_chance(fit: Fit | TimeFit, numbers: int) -> float:
    """Return a quantile of Student's t. Each change at the two ends is divided by its standard deviation. Noise alone
    makes the largest of these ratios exceed the quantile with a probability of at most `CHANCE`.

    Args:
        fit: the fit whose residuals give the noise.
        numbers: number of parameters that are compared at each end.
    """
    return float(scipy.special.stdtrit(max(1.0, fit.uncertainty.freedom), 1 - CHANCE / (4 * max(1, numbers))))


def _slopes_of_reported(fit: Fit) -> tuple[list[str], np.ndarray]:
    """Return the names of the P reported parameters, and their derivatives (P, p) with respect to the p unknowns u. For
    a compressed sample, these are the parameters of the sample at rest."""
    u = np.asarray(fit.solution.u)
    if fit.parameters is not None:
        assert fit.kind.values is not None
        natural, slope = with_slope(fit.kind.values, u)
        own = _as_reported(slope, natural, fit.parameters.values)
        free = [k for k, name in enumerate(fit.kind.names) if not name.startswith("strengths[")]
        return [fit.kind.names[k] for k in free], own[free]
    natural, slope = with_slope(partial(uncertainty.parameter_vector, maxwell=fit.kind.maxwell), u)
    own, names = _as_reported(slope, natural, fit.uncertainty.values), list(fit.uncertainty.names)
    if fit.kind.name == FLUID.name:
        return names, own
    ratios = slice(1, fit.modes + 1)
    rest = own[0] * (1 - fit.uncertainty.values[ratios].sum()) - fit.uncertainty.values[0] * own[ratios].sum(axis=0)
    return [*names, "equilibrium_modulus"], np.vstack([own, rest])


def _as_reported(slope: np.ndarray, natural: np.ndarray, reported: np.ndarray) -> np.ndarray:
    """Return the derivatives (P, p) of the P reported parameters with respect to the p unknowns u. `slope` contains the
    derivatives of the fitted values `natural`. For a compressed sample, a reported value is a fitted value times a
    factor."""
    return slope * np.divide(reported, natural, out=np.ones_like(natural), where=natural != 0)[:, None]


def _noise_of_residuals(fit: Fit, sweep: Sweep, J: np.ndarray) -> np.ndarray:
    """Return the standard deviations (2n,) of the noise of G' and G'' at n frequencies, divided by the scales of the
    residuals. Residuals that lie on a smooth curve over the frequency do not count as noise."""
    r, n = np.asarray(fit.solution.residuals)[: len(J)], len(J) // 2
    own = None if fit.kind.effective is not None else sizes_shown(J, r, np.concatenate(sweep.deviations))
    sizes = np.full(2 * n, fit.uncertainty.noise) if own is None else own
    # The scatter of few points, or of points with repeated frequencies, cannot be estimated.
    if len(np.unique(sweep.angular_frequency)) < max(n, ENOUGH):
        return sizes
    columns = ((sweep.storage, slice(0, n)), (sweep.loss, slice(n, 2 * n)))
    for (modulus, rows), deviation in zip(columns, sweep.deviations, strict=True):
        # The relative noise may differ between the points, so the median is compared.
        typical = np.median(sizes[rows] * deviation / modulus)
        seen = frequency_sweep.scatter(sweep.angular_frequency, modulus)
        sizes[rows] *= seen / typical if seen < SMOOTH * typical else 1.0
    return sizes
