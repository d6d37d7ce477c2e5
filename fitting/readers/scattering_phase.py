"""Loss moduli that scatter with the error of the phase: a part of |G*|, not of G''."""

import numpy as np

from fitting.readers.frequency_sweep import Sweep, distance_from_smooth, distances_from_polynomials

#: The phase may be the cause where G'' scatters by more than this part of itself, and by this factor more than G'; with
#: few points (n) chance makes larger factors: 1 % of sweeps with equal noise are above 6 at 12 points, 3 at 40.
_SCATTERS, _MORE, _BY_CHANCE = 0.03, 3.0, 9.0
#: Fewest points whose scatter is looked at, and fewest per decade: fewer show the curvature of the material as scatter.
_FEWEST, _PER_DECADE = 8, 5.0
#: Noise in proportion to G'' must be more likely than this (logarithm): G'' alone has few causes of such noise.
_BETTER = 8.0
#: Neighbours that the two kinds of noise are compared over.
_NEIGHBOURS = 5


def weighed_by_scatter(sweep: Sweep) -> Sweep:
    """The sweep with deviations from the scatter of its own points, if the phase causes the scatter of G''.

    An error of the phase changes G'' by this part of G'. Divided by G'' itself, as if all points were equally good in
    percent, points that are low by chance weigh most: where G'' << G' a fit then follows the noise.
    """
    omega, size = sweep.angular_frequency, np.hypot(sweep.storage, sweep.loss)
    if sweep.storage_sd is not None or len(np.unique(omega)) < max(len(omega), _FEWEST):
        return sweep
    x, sine = np.log(omega), sweep.loss / size
    if (len(x) - 1) * np.log(10) < _PER_DECADE * np.ptp(x) * (1 - 1e-6):
        return sweep
    storage, phase = (distance_from_smooth(x, y) for y in (np.log(sweep.storage), sine))
    scatters = float(np.median(phase * size / sweep.loss))
    if not (scatters > _SCATTERS and scatters > _MORE * (1 + _BY_CHANCE / len(x)) * storage):
        return sweep
    if _likelier_in_proportion(x, sine) > _BETTER:
        return sweep
    note = (
        f"G'' scatters by {100 * scatters:.2g} % and G' by {100 * storage:.2g} %, as by an error of the phase of "
        f"{np.degrees(phase):.2g} degrees (or by outliers): G'' is weighed by |G*|, not by itself; give deviations to "
        "weigh otherwise"
    )
    storage_sd = np.maximum(storage, phase * sine) * sweep.storage
    return sweep._replace(storage_sd=storage_sd, loss_sd=phase * size, sd_estimated=True, notes=(*sweep.notes, note))


def _likelier_in_proportion(x: np.ndarray, sine: np.ndarray) -> float:
    """Logarithm of the likelihood of noise in proportion to `sine` (n,), over that of equal noise."""
    equal, growing = (np.mean(distances_from_polynomials(x, y, _NEIGHBOURS) ** 2) for y in (sine, np.log(sine)))
    return float(0.5 * len(x) * np.log(equal / max(growing, 1e-300)) - np.sum(np.log(sine)))
