"""The total error of every parameter. Noise causes one share of this error, and each of several other sources causes
another share. The shares are independent of each other, so the total error is the root of the sum of their squares. The
scatter between samples is not included: the parameters describe the measured curve, not the material.
"""

import numpy as np

from fitting.fits.honesty import edges
from fitting.fits.honesty.long_times import INTERVAL
from fitting.fits.honesty.rise_of_load import OF_A_STEP, share_of_rise
from fitting.fits.honesty.short_times import MISSING
from fitting.fits.simulated_rheometer import Simulation
from fitting.fits.time_tests import TimeFit
from fitting.fits.viscoelastic import Fit
from fitting.methods.uncertainty import equilibrium_change

#: Usual standard deviations [m]: GAP of the gap that the instrument displays, RADIUS of the radius of the plates.
GAP, RADIUS = 50e-6, 10e-6


def of_geometry(simulation: Simulation, gap_error: float | None, axial: bool = False) -> float:
    """Return the relative error of all moduli due to the size of the sample between the plates.

    Torque divided by twist is G pi R^4 / (2 h) for the shear modulus G, the radius R and the gap h. Force divided by
    displacement is 3 G pi R^2 / h. The stiffness of a bent rod also contains R^4.

    Args:
        simulation: the radius and the gap.
        gap_error: standard deviation [m] of the gap; None: `GAP`.
        axial: True if force and displacement or moduli of tension were measured; False if torque and twist were
            measured.
    """
    gap, power = GAP if gap_error is None else gap_error, 2 if axial else 4
    return float(np.hypot(gap / simulation.height, power * RADIUS / simulation.radius))


def of_described_sizes(per_size: tuple[float, float]) -> float:
    """Return the error of `of_geometry` for a test that a TOML file describes. `per_size`: see `TimeTest`."""
    return float(np.hypot(GAP * per_size[0], RADIUS * per_size[1]))


def error_shares(fit: Fit | TimeFit) -> dict[str, dict[str, float]]:
    """Return the errors of the parameters: for each source of error, a dictionary whose keys are the parameter names of
    `edges.every_value`. The error of the gap is a part of the share `geometry`.

    The share `band` is the larger change of a parameter if one end of the band is left out. This change counts only if
    it is larger than expected from noise (`edges.decided_by`). The share is the square root of a difference: the square
    of this change, minus the square of the standard error. If noise alone causes a change larger than the standard
    error, the square of that change is subtracted instead. If the result is very large
    (`edges.RUNS_AWAY`), the share is the absolute value of the parameter or its standard error, whichever is larger.
    This change is not computed for the strengths of a spectrum, so their share `band` is 0.
    For the share `long_times`, the farther end of `long_times.equilibrium_interval` is converted to a standard
    deviation, and the standard error is subtracted (as squares). The share `short_times` is the part of G0 that relaxed
    before the record (module `short_times`). The share `rise_of_load` is the change if the load was a step at the first
    row that shows the new load.
    """
    known = edges.every_value(fit)
    noise = {name: error for name, (_, error) in known.items()}
    gap, usual = fit.details.get("gap_error"), Simulation()
    relative = fit.details.get("geometry_error", of_geometry(usual, None if gap is None else gap * usual.height))
    moduli = edges.moduli_among(fit)
    out = {
        "noise": noise,
        "geometry": {n: relative * abs(v) if n in moduli else 0.0 for n, (v, _) in known.items()},
        "band": dict.fromkeys(known, 0.0),
    }
    for part in edges.PARTS:
        for name in edges.decided_by(fit, part):
            change, scatter = (fit.details[key][part][name] for key in ("band_sensitivity", "band_scatter"))
            beyond = np.sqrt(max(0.0, change**2 - max(noise[name], scatter) ** 2))
            # If the other points do not determine a parameter, its change may have any size. So the absolute value of
            # the parameter is used as the error.
            own = max(abs(known[name][0]), noise[name])
            out["band"][name] = max(out["band"][name], float(own if beyond > edges.RUNS_AWAY * own else beyond))
    shown = fit.parameters or fit.uncertainty
    for source, moved in (("mesh", shown.mesh_bias), ("time_step", shown.time_step_bias)):
        if moved is not None:
            out[source] = _of_bias(fit, moved)
    interval = fit.details.get(INTERVAL)
    if interval and interval["wider_than_standard_error"] and "equilibrium_modulus" in known:
        out["long_times"] = dict.fromkeys(known, 0.0) | {"equilibrium_modulus": interval["beyond_standard_error"]}
    if isinstance(fit, TimeFit) and OF_A_STEP in fit.details:
        out["rise_of_load"] = share_of_rise(fit, list(known))
    if MISSING in fit.details and "shear_modulus" in known:
        out["short_times"] = dict.fromkeys(known, 0.0) | {"shear_modulus": fit.details[MISSING]}
    return out


def total_errors(fit: Fit | TimeFit) -> dict[str, float]:
    """Return the total error of each parameter: the root of the sum of the squares of its `error_shares`."""
    return root_of_squares(error_shares(fit))


def root_of_squares(shares: dict[str, dict[str, float]]) -> dict[str, float]:
    """Return the total errors by name, from the errors of independent sources."""
    return {name: float(np.sqrt(sum(part[name] ** 2 for part in shares.values()))) for name in shares["noise"]}


def _of_bias(fit: Fit | TimeFit, moved: np.ndarray) -> dict[str, float]:
    """Return the absolute change of each parameter, by name. `moved` (P,): changes of the parameters of the model. For
    Prony modes, these are the changes of G0, ratios and relaxation times. The change of the equilibrium modulus of
    Prony modes is computed from these changes."""
    names = (fit.parameters or fit.uncertainty).names
    out = {name: abs(float(d)) for name, d in zip(names, moved, strict=True)}
    if fit.parameters is None:
        out["equilibrium_modulus"] = abs(float(equilibrium_change(fit.uncertainty.values, moved)))
    return {name: out[name] for name in edges.every_value(fit)}
