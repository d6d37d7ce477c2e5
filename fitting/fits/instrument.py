"""Errors of the instrument in a fit, shared by all points: inertia and gap, each with a prior; and compression.

The instrument subtracts its inertia I, so G' is off by delta I omega^2 / K where I is off by delta. Fitted without a
prior, such a term takes up the model's misfit. Here delta is normal around 0 with `raw_torque.UNCERTAINTY`, it
is found from raw columns alone, and it is used only if it stays the same when the end of the band is left out.
"""

from typing import Any, NamedTuple

import numpy as np

from fitting.fits import viscoelastic
from fitting.fits.honesty.edges import HALF_DECADE
from fitting.fits.viscoelastic import Fit
from fitting.methods import host, uncertainty
from fitting.methods.estimate import Estimate, errors_and_correlation
from fitting.methods.generalised_maxwell import Maxwell, weighed
from fitting.readers import raw_torque
from fitting.readers.frequency_sweep import Sweep, some
from fitting.rigs import compression
from liverjax import laws

#: Rounds of fit and correction.
ROUNDS = 4


class InertiaError(NamedTuple):
    """How far the inertia that was subtracted is off, relative."""

    value: float
    standard_error: float
    part: float | None  # the same without the last half decade; None where too few points are left
    part_error: float | None

    @property
    def steady(self) -> bool:
        """It does not move with the band by more than two standard errors of the shorter one."""
        return (
            self.part is not None and self.part_error is not None and abs(self.value - self.part) <= 2 * self.part_error
        )


def without_error_of_inertia(fit: Fit, sweep: Sweep) -> tuple[Fit, Sweep]:
    """The fit of Prony modes with the error of the instrument's inertia beside them, and the sweep corrected by it.

    Fit and sweep stay as they were if there are no raw columns, or if the model has no Prony modes. Where the error
    moves with the band, it is reported and not used.
    """
    if sweep.inertia is None or fit.kind.values is not None or not isinstance(fit.solution.u, np.ndarray):
        return fit, sweep
    value, error, refitted = _error_of_inertia(fit, sweep)
    kept = sweep.angular_frequency < sweep.angular_frequency[-1] / HALF_DECADE * (1 - 1e-9)
    part: tuple[Any, Any] = (None, None)
    if len(np.unique(sweep.angular_frequency[kept])) > len(fit.solution.u) // 2 + 1:
        shorter = some(sweep, kept)
        part = _error_of_inertia(viscoelastic.closed_form(shorter, fit.modes), shorter)[:2]
    found = InertiaError(value, error, *part)
    details = fit.details | {"instrument": inertia_numbers(found)}
    if not found.steady:
        moved = "too few points are left to check it" if found.part is None else f"it is {_cent(found.part)} there"
        told = (
            f"the instrument's inertia seems off by {_cent(value)} (standard error {_cent(error)}), but not "
            f"without the last half decade ({moved}): the misfit of the model poses as inertia, so it is not corrected"
        )
        return fit._replace(details=details, warnings=(*fit.warnings, told)), sweep
    corrected = _shifted(sweep, value)
    note = (
        f"the inertia that the instrument subtracted is taken to be off by {_cent(value)} (standard error "
        f"{_cent(error)}, prior {_cent(raw_torque.UNCERTAINTY)}), and the storage moduli are corrected for it"
    )
    corrected = corrected._replace(notes=(*sweep.notes, note))
    spread = _with_direction(refitted, corrected, error)
    return refitted._replace(details=refitted.details | details, uncertainty=spread), corrected


def _cent(value: float) -> str:
    return f"{100 * value:.2g} %"


def inertia_numbers(found: InertiaError) -> dict[str, object]:
    """The part `instrument` of fit.json."""
    return {
        "inertia_off_by": found.value,
        "standard_error": found.standard_error,
        "prior_standard_deviation": raw_torque.UNCERTAINTY,
        "without_last_half_decade": found.part,
        "moves_with_the_band": not found.steady,
    }


def _residuals_per_error(sweep: Sweep) -> np.ndarray:
    """Change of the residuals (2n,) by an error of 1."""
    assert sweep.inertia is not None
    return np.concatenate([sweep.inertia, np.zeros(len(sweep.inertia))]) / np.concatenate(sweep.deviations)


def _shifted(sweep: Sweep, value: float) -> Sweep:
    assert sweep.inertia is not None
    return sweep._replace(storage=sweep.storage + value * sweep.inertia)


def _error_of_inertia(fit: Fit, sweep: Sweep) -> tuple[float, float, Fit]:
    """The error of the inertia, its standard error, and the fit to the moduli that it corrects."""
    value = 0.0
    for _ in range(ROUNDS):
        here = _shifted(sweep, value)
        J, r = np.asarray(fit.solution.jacobian), np.asarray(fit.solution.residuals)
        noise = max(fit.uncertainty.noise, 1e-12)
        d = _residuals_per_error(here)
        own = d - J @ np.linalg.lstsq(J, d, rcond=1e-12)[0]  # what the modes cannot follow
        precision = own @ own / noise**2 + raw_torque.UNCERTAINTY**-2
        # The prior is of the whole error, the residuals are of what is left of it.
        step = (own @ r / noise**2 - value / raw_torque.UNCERTAINTY**2) / precision
        value, error = value + step, precision**-0.5
        corrected = _shifted(sweep, value)
        if np.any(corrected.storage <= 0):  # a sweep that is the instrument's
            return value - step, error, fit
        fit = viscoelastic.modes_from(corrected, fit.solution.u[None], fit.kind)._replace(details=fit.details)
        if abs(step) < 1e-3 * error:
            break
    return float(value), float(error), fit


def _with_direction(fit: Fit, sweep: Sweep, error: float) -> Estimate:
    """The estimate with the part of its errors that the inertia's error causes."""
    J = np.asarray(fit.solution.jacobian)
    _, slope = host.with_jacobian(
        lambda u: uncertainty.parameter_vector(u, fit.kind.maxwell), np.asarray(fit.solution.u)
    )
    moved = slope @ np.linalg.lstsq(J, _residuals_per_error(sweep), rcond=1e-12)[0]
    return _wider(fit.uncertainty, moved * error)


def with_gap_error(fit: Fit, relative: float) -> Fit:
    """The fit with the error of the gap. All moduli share this error; ratios and times do not have it."""
    modes = fit.modes
    first = np.concatenate([fit.uncertainty.values[:1], np.zeros(2 * modes)])
    own = fit.parameters
    if own is not None:
        moduli = np.array([unit.startswith("Pa") for unit in fit.kind.units])
        own = _wider(own, np.where(moduli, relative * own.values, 0.0))
    details = fit.details | {"gap_error": relative}
    return fit._replace(uncertainty=_wider(fit.uncertainty, relative * first), parameters=own, details=details)


def of_compressed_sample(fit: Fit, sweep: Sweep, factors: compression.Shares) -> Fit:
    """The fit in closed form of a compressed sample, with the numbers of the sample at rest.

    Storage and loss of the fit stay those that the instrument shows, and so do its residuals.

    Args:
        fit: Prony modes of the moduli as they were measured.
        sweep: these moduli.
        factors: what the compression makes of them.
    """
    seen = fit.kind.maxwell
    kind = fit.kind._replace(maxwell=lambda u: weighed(seen(u), 1 / factors.relaxing, 1 / factors.equilibrium))
    spread = uncertainty.estimate(fit.solution, sweep.noise_given, kind.maxwell)
    model = Maxwell(spread.values[0], spread.values[1 : fit.modes + 1], spread.values[fit.modes + 1 :])
    old, new = (uncertainty.cautions(sweep, of, kind.name) for of in (fit.uncertainty, spread))
    warnings = (*(w for w in fit.warnings if w not in old), *new)
    return fit._replace(model=model, kind=kind, uncertainty=spread, warnings=warnings)


def compression_numbers(fit: Fit, simulation: viscoelastic.Simulation) -> dict[str, object]:
    """The part `precompression` of fit.json, of `of_compressed_sample` or of the simulation after it."""
    law, strain = laws.typical(simulation.law), simulation.precompression
    G, glued = float(np.asarray(law.shear_modulus())), fit.method != "closed-form"
    factors = compression.shares(law, strain)
    force = fit.details["force_of_law_N"] if glued else compression.smooth_force(law, strain, simulation.radius)
    G0, rest = float(fit.model.shear_modulus), float(fit.model.equilibrium_modulus)
    return {
        "strain": strain,
        "height_at_rest_m": simulation.height / (1 - strain),
        "plates": "glued" if glued else "smooth",
        "law": simulation.law,
        "bulk_over_shear_modulus": float(np.asarray(law.bulk_modulus())) / G,
        "smooth_factor_of_relaxing_moduli": factors.relaxing,
        "smooth_factor_of_equilibrium_modulus": factors.equilibrium,
        "axial_force_N": force * rest / G,
        "axial_force_standard_error_N": force * uncertainty.equilibrium_error(fit.uncertainty) / G,
        "axial_force_mesh_bias_N": fit.details.get("force_of_law_mesh_bias_N", 0.0) * rest / G,
        "axial_force_at_once_N": force * G0 / G,
    }


def _wider(estimate: Estimate, direction: np.ndarray) -> Estimate:
    """The estimate with one more source of error (P,), independent of the others."""
    root = np.column_stack([estimate.root, direction])
    errors, correlation = errors_and_correlation(root)
    lost = ~np.isfinite(estimate.standard_errors)
    return estimate._replace(root=root, standard_errors=np.where(lost, np.inf, errors), correlation=correlation)
