"""Weights for loss moduli that scatter because of phase errors. This scatter is proportional to |G*|, not to G''."""

import numpy as np

from fitting.readers.frequency_sweep import (
    Sweep,
    distance_from_smooth,
    distances_from_polynomials,
    merged,
    mostly_repeated,
)

#: Phase errors may be the cause of the scatter of G'' if the relative scatter of G'' exceeds both _SCATTERS and _MORE
#: times the relative scatter of G'. With few points (n), the ratio of the two scatters can be larger by chance, so
#: _MORE is multiplied by 1 + _BY_CHANCE / n. If G' and G'' have equal noise, 1 % of all sweeps exceed a ratio of 6 at
#: 12 points, and of 3 at 40 points.
_SCATTERS, _MORE, _BY_CHANCE = 0.03, 3.0, 9.0
#: Minimum number of points, and of points per decade, for this test. With fewer points, the curvature of G' and of the
#: sine of the loss angle over log frequency would look like scatter.
_FEWEST, _PER_DECADE = 8, 5.0
#: Noise proportional to G'' is assumed only if its log-likelihood exceeds that of noise proportional to |G*| by more
#: than this value. The reason: noise proportional to G'' in G'' alone is rare.
_BETTER = 8.0
#: Number of neighbouring points per polynomial in the comparison of the two kinds of noise.
_NEIGHBOURS = 5


def weighed_by_scatter(sweep: Sweep) -> Sweep:
    """Return the sweep with standard deviations from the scatter of its points, if phase errors cause the scatter of
    G''. Otherwise return the sweep unchanged.

    The error of G'' is the phase error [rad] times G'. If the residuals were divided by G'', points that are low by
    chance would have the largest weight. Where G'' << G', the model would then fit the noise.
    """
    size = np.hypot(sweep.storage, sweep.loss)
    x, sine, log_storage = merged(np.log(sweep.angular_frequency), sweep.loss / size, np.log(sweep.storage))
    if sweep.storage_sd is not None or len(x) < _FEWEST or mostly_repeated(sweep.angular_frequency):
        return sweep
    if (len(x) - 1) * np.log(10) < _PER_DECADE * np.ptp(x) * (1 - 1e-6):
        return sweep
    storage, phase = (distance_from_smooth(x, y) for y in (log_storage, sine))
    scatters = float(np.median(phase * size / sweep.loss))
    if not (scatters > _SCATTERS and scatters > _MORE * (1 + _BY_CHANCE / len(x)) * storage):
        return sweep
    if _likelier_in_proportion(x, sine) > _BETTER:
        return sweep
    note = (
        f"G'' scatters by {100 * scatters:.2g} % and G' by {100 * storage:.2g} %, for example because the error of "
        f"the phase is {np.degrees(phase):.2g} degrees, or because of outliers. So the residuals of G'' are divided by "
        "|G*|, not by G''; give standard deviations if you want other weights"
    )
    storage_sd = np.maximum(storage, phase * sweep.loss / size) * sweep.storage
    return sweep._replace(storage_sd=storage_sd, loss_sd=phase * size, sd_estimated=True, notes=(*sweep.notes, note))


def _likelier_in_proportion(x: np.ndarray, sine: np.ndarray) -> float:
    """Return the log-likelihood of noise proportional to `sine` (n,), minus the log-likelihood of constant noise."""
    equal, growing = (np.mean(distances_from_polynomials(x, y, _NEIGHBOURS) ** 2) for y in (sine, np.log(sine)))
    return float(0.5 * len(x) * np.log(equal / max(growing, 1e-300)) - np.sum(np.log(sine)))
