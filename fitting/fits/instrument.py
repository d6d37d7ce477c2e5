"""Errors of the instrument that are common to all points of a fit (inertia, friction, gap), each with a prior.

The instrument subtracts the torque of its inertia I from the measured torque. The modulus is the remaining torque per
angle, divided by the constant K of the geometry. If the true inertia is I (1 + delta), G' is too small by delta I
omega^2 / K at the angular frequency omega. Without a prior, delta would compensate errors of the model. Here delta has
a normal prior around 0 with the standard deviation `raw_torque.UNCERTAINTY`. delta is fitted only if the file contains
the raw torque or the raw phase. The fitted delta is used only if it changes by at most two standard errors when the
upper end of the band is left out. If this change cannot be computed, the moduli are not corrected, and the standard
errors contain the whole delta. The friction b of the bearing adds b omega / K to G''. The error of b has a normal prior
around 0 with the standard deviation that the user gives.
"""

import time
from typing import NamedTuple

import numpy as np

from fitting.fits import compressed_sample, viscoelastic
from fitting.fits.families import models
from fitting.fits.honesty.edges import HALF_DECADE
from fitting.fits.viscoelastic import Fit
from fitting.methods import generalised_maxwell, host, uncertainty
from fitting.methods.estimate import Estimate, wider
from fitting.readers import raw_torque
from fitting.readers.frequency_sweep import Sweep, check_sweep, some
from fitting.rigs import compression

#: The standard error of an instrument error is divided by the standard deviation of its prior. If this ratio is at
#: least this value, the data do not determine the instrument error.
UNTOLD = 0.9
#: ROUNDS: maximum number of rounds; each round is a fit and a correction. HALVINGS: maximum number of halvings of a
#: correction that would make a modulus 0 or negative.
ROUNDS, HALVINGS = 20, 30
#: A correction below this many standard deviations of the prior counts as 0. This limit is needed for data without
#: noise, because their standard error is 0.
SETTLED = 1e-6


class Nuisance(NamedTuple):
    """An error of the inertia or of the friction that the instrument subtracts. The unit of this error is the standard
    deviation of its prior."""

    name: str
    moved: np.ndarray  # (n,) change of G* [Pa] at the n frequencies if the error is one standard deviation
    unit: float  # standard deviation of the prior, in the unit of the report

    @property
    def reported(self) -> str:
        """Name of this error in fit.json. The value there is the true quantity minus the subtracted quantity; for the
        inertia, this difference is divided by the subtracted inertia."""
        return "friction_off_by_N_m_s" if self.name == "friction" else "inertia_off_by"

    def told(self, deviations: float) -> str:
        """Return the size of this error with its unit, as a string for a warning. `deviations`: the error in standard
        deviations of its prior."""
        value = self.unit * deviations
        return _cent(value) if self.name == "inertia" else f"{value:.2g} N m s"

    def compared(self, deviations: float) -> str:
        """Return words for a warning: by how much the true friction or inertia is larger or smaller than the value that
        the instrument subtracted."""
        return (
            f"{self.told(abs(deviations))} {'larger' if deviations > 0 else 'smaller'} than the value that was "
            "subtracted"
        )


class InstrumentErrors(NamedTuple):
    """The k errors of the quantities that the instrument subtracted (inertia, friction), in standard deviations of
    their priors."""

    values: np.ndarray  # (k,)
    covariance: np.ndarray  # (k, k)
    part: np.ndarray | None  # `values` fitted without the last half decade of the sweep; None: unknown
    part_errors: np.ndarray | None
    found: bool  # False: the rounds of fit and correction did not converge

    @property
    def steady(self) -> np.ndarray:
        """Whether each instrument error (k,) was found and changes by at most two standard errors if the last half
        decade of the sweep is left out."""
        if self.part is None or self.part_errors is None or not self.found:
            return np.zeros(len(self.values), bool)
        return np.abs(self.values - self.part) <= 2 * self.part_errors

    @property
    def unchecked(self) -> bool:
        """Whether the instrument errors were found, but not without the last half decade of the sweep."""
        return self.found and self.part is None


class Corrected(NamedTuple):
    """k instrument errors that were fitted together with the modes, in standard deviations of their priors."""

    values: np.ndarray  # (k,)
    covariance: np.ndarray  # (k, k)
    fit: Fit  # to the corrected moduli
    found: bool  # False: the rounds of fit and correction did not converge

    @property
    def criterion(self) -> float:
        """The Bayesian information criterion of the fit, plus the sum of the squares of the instrument errors (from
        their priors)."""
        return viscoelastic.information_criterion(self.fit) + float(self.values @ self.values)


def nuisances_of(sweep: Sweep) -> list[Nuisance]:
    """Return the errors of the instrument (inertia, friction) that can be fitted with the data of the sweep."""
    out = []
    if sweep.inertia is not None:
        out.append(Nuisance("inertia", raw_torque.UNCERTAINTY * sweep.inertia + 0j, raw_torque.UNCERTAINTY))
    if sweep.friction is not None:
        out.append(Nuisance("friction", -1j * sweep.friction, sweep.friction_error))
    return out


def spectrum_before_correction(sweep: Sweep) -> generalised_maxwell.Spectrum:
    """Return the spectrum on the dense grid. A sweep without data of the instrument is refused if no model describes
    it. A sweep with such data may seem impossible only because of an error of the instrument. So for this sweep,
    `refuse_impossible` must be called after the correction."""
    if not nuisances_of(sweep):
        return generalised_maxwell.refuse_impossible(sweep)
    check_sweep(sweep)
    return generalised_maxwell.spectrum(sweep)


def without_error_of_inertia(fit: Fit, sweep: Sweep, factors: compression.Shares | None = None) -> tuple[Fit, Sweep]:
    """Fit the instrument's errors together with the Prony modes, and return the fit and the corrected sweep.

    The fit and the sweep are returned unchanged if the sweep has no data of the instrument. For a model without free
    Prony modes, see `_of_rival_modes`. If one of the errors changes when the upper end of the band is left out, all
    errors are reported, but the moduli are not corrected. If this change cannot be computed, the moduli are not
    corrected either, but the standard errors contain the errors of the instrument. If the number of modes was chosen
    automatically, more modes are tried, too. If the modes were compared with other models, these models are fitted
    again to the corrected moduli. All these fits use Levenberg-Marquardt, also if the first fit used BFGS. `factors`:
    see `of_compressed_sample`; only for a compressed sample.
    """
    begin, known = time.perf_counter(), nuisances_of(sweep)
    if not known:
        return fit, sweep
    if fit.kind.values is not None:
        return _of_rival_modes(fit, sweep, factors)
    weighed = _with_noise_as_measured(sweep)
    tried = [_errors_of_instrument(_fitted_again(fit, weighed), weighed), *_with_more_modes(fit, weighed)]
    determined = [own for own in tried if _all_modes_determined(own, weighed)] or tried[:1]
    ways = [(own, _in_both_bands(own, weighed)) for own in sorted(determined, key=lambda own: own.criterion)]
    best, errors = next(((own, e) for own, e in ways if e.steady.all()), (tried[0], None))
    if errors is None:
        errors = _in_both_bands(best, weighed)
        details = fit.details | {"instrument": instrument_numbers(errors, known)}
        warnings, seconds = (*fit.warnings, *_not_corrected(errors, known)), fit.run_time + time.perf_counter() - begin
        if errors.unchecked:
            whole = np.column_stack([_root_of(errors.covariance), errors.values])
            fit = fit._replace(uncertainty=_with_directions(fit, sweep, known, whole))
        return fit._replace(details=details, warnings=warnings, run_time=seconds), sweep
    corrected = _shifted(weighed, known, best.values)
    corrected = corrected._replace(notes=(*sweep.notes, *_corrections(known, best)))
    details = fit.details | best.fit.details | {"instrument": instrument_numbers(errors, known)}
    refitted = best.fit._replace(details=details, compile_time=fit.compile_time)
    if viscoelastic.TRIED in details:
        refitted = _beside_more_modes(fit, refitted, tried, weighed)
    spread = _with_directions(refitted, corrected, known, _root_of(best.covariance))
    refitted = models.compared_again(
        refitted._replace(uncertainty=spread),
        corrected,
        lambda other: other if factors is None else compressed_sample.of_compressed_sample(other, corrected, factors),
    )
    return refitted._replace(run_time=fit.run_time + time.perf_counter() - begin), corrected


def _of_rival_modes(fit: Fit, sweep: Sweep, factors: compression.Shares | None) -> tuple[Fit, Sweep]:
    """Fit Prony modes together with the instrument's errors. If they explain the sweep better than `fit`, return this
    fit and the corrected sweep. Otherwise return `fit` with a new computing time, and the sweep. `fit`: a model without
    free Prony modes. Such a model, for example a spectrum, can fit the error of the inertia as a part of the material.
    """
    modes = models.rival_modes(fit)
    if modes is None:
        return fit, sweep
    found, corrected = without_error_of_inertia(modes, sweep, factors)
    prior = float(np.sum(used_errors(found, sweep)[1] ** 2))
    better = corrected is not sweep and models.is_preferred(found, fit, prior)
    return (found, corrected) if better else (fit._replace(run_time=found.run_time), sweep)


def _with_more_modes(fit: Fit, sweep: Sweep) -> list[Corrected]:
    """Return fits of the instrument errors with more modes than `fit`. The list is empty if the user gave the number of
    modes. For a fluid, the program always chooses the number of modes.

    If the inertia is wrong, a fit with enough modes may not converge. So the first fit may have too few modes.
    """
    if viscoelastic.TRIED not in fit.details and fit.kind.name != viscoelastic.FLUID.name:
        return []
    most = min(fit.modes + 2, viscoelastic.most_modes(sweep))
    found = [_from_several_starts(fit, modes, sweep) for modes in range(fit.modes + 1, most + 1)]
    return [own for own in found if own is not None]


def _from_several_starts(fit: Fit, modes: int, sweep: Sweep) -> Corrected | None:
    """Return the instrument errors, fitted together with `modes` modes of the kind of `fit`, or None if every fit
    failed.

    The search begins at errors of 0. If it finds no fit whose modes the data determine, it begins again at errors of
    plus and minus one standard deviation of the prior. A wrong inertia can make G' fall with the frequency. Then a mode
    with a time near 0 may be fitted instead of the error.
    """
    known, found = nuisances_of(sweep), []
    for start in (0.0, 1.0, -1.0):
        values = np.eye(len(known))[0] * start
        moved = _shifted(sweep, known, values)
        if not (np.all(moved.storage > 0) and np.all(moved.loss > 0)):
            continue
        try:
            begin = models.starts_of_kind(fit.kind, moved, modes, generalised_maxwell.spectrum(moved))
            own = viscoelastic.modes_from(moved, begin, fit.kind)
            found.append(_errors_of_instrument(own, sweep, values))
        except (ArithmeticError, RuntimeError, ValueError):  # no fit at this start
            continue
        if _all_modes_determined(found[-1], sweep):
            return found[-1]
    return found[0] if found else None


def _all_modes_determined(own: Corrected, sweep: Sweep) -> bool:
    """Return whether the instrument errors were found, and the data determine all modes."""
    return own.found and viscoelastic.identifiable(own.fit, sweep)


def _in_both_bands(own: Corrected, sweep: Sweep) -> InstrumentErrors:
    """Return the instrument errors from the whole sweep, and from the sweep without its last half decade."""
    return InstrumentErrors(own.values, own.covariance, *_of_part(own.fit, sweep), own.found)


def _of_part(fit: Fit, sweep: Sweep) -> tuple[np.ndarray | None, np.ndarray | None]:
    """Return the instrument errors without the last half decade of the sweep, and their standard errors. Return (None,
    None) if too few points are left, or if the errors are not found."""
    kept = sweep.angular_frequency < sweep.angular_frequency[-1] / HALF_DECADE * (1 - 1e-9)
    if len(np.unique(sweep.angular_frequency[kept])) <= len(fit.solution.u) // 2 + 1:
        return None, None
    shorter = some(sweep, kept)
    dense = generalised_maxwell.spectrum(shorter)  # a wrong inertia may make these moduli impossible
    part = _errors_of_instrument(viscoelastic.closed_form(shorter, fit.modes, dense), shorter)
    return (part.values, np.sqrt(np.diag(part.covariance))) if part.found else (None, None)


def _beside_more_modes(fit: Fit, chosen: Fit, tried: list[Corrected], sweep: Sweep) -> Fit:
    """Return the chosen fit with the table of tried numbers of modes, and with warnings about these numbers. Rows with
    fewer modes than `fit` belong to the uncorrected moduli. Each other row belongs to moduli that were corrected with
    the instrument errors of this row.
    """
    known = nuisances_of(sweep)
    rows = [row for row in fit.details[viscoelastic.TRIED] if row["modes"] < fit.modes]
    rows += [
        viscoelastic.row_of_modes(own.fit, _shifted(sweep, known, own.values))
        | {"information_criterion": own.criterion}
        for own in tried
    ]
    mine = next(row for row in rows if row["modes"] == chosen.modes)
    warnings = [w for w in fit.warnings if viscoelastic.NOT_FITTED in w]
    warnings += viscoelastic.closer_number(rows, mine, [own.fit for own in tried])
    return chosen._replace(warnings=(*chosen.warnings, *warnings), details=chosen.details | {viscoelastic.TRIED: rows})


def _corrections(known: list[Nuisance], best: Corrected) -> list[str]:
    """Return a note on each instrument error: the moduli are corrected for this error, or the data do not determine
    it."""
    return [
        f"the instrument's {n.name} is {n.compared(v)} (standard error {n.told(e)}, prior {n.told(1.0)}). The moduli "
        "are corrected for this error"
        if e < UNTOLD
        else f"the data do not determine the instrument's {n.name}: its standard error is {n.told(e)} with the data "
        f"and {n.told(1.0)} without the data, and the moduli contain this error"
        for n, v, e in zip(known, best.values, np.sqrt(np.diag(best.covariance)), strict=True)
    ]


def used_errors(fit: Fit, sweep: Sweep) -> tuple[list[Nuisance], np.ndarray]:
    """Return the k instrument errors that the standard errors of the fit contain, and their values (k,) in standard
    deviations of the priors. The sweep was corrected for these values. They are 0 if the sweep was not corrected."""
    told, known = fit.details.get("instrument"), nuisances_of(sweep)
    if told is None or told["moves_with_the_band"]:
        return [], np.zeros(0)
    if told["could_not_be_checked"]:
        return known, np.zeros(len(known))
    return known, np.array([told[n.reported] / n.unit for n in known])


def _not_corrected(errors: InstrumentErrors, known: list[Nuisance]) -> list[str]:
    """Return a warning for each instrument error that changes when the upper end of the band is left out, or one
    warning if the errors were not found. If this change cannot be computed, there is a warning for each error of at
    least two standard errors."""
    out, e = [], np.sqrt(np.diag(errors.covariance))
    if not errors.found:
        each = " and ".join(n.name for n in known)
        return [
            f"the error of the instrument's {each} was not found together with the modes. The moduli are not "
            "corrected for this error, and the errors of the parameters do not contain this error: use "
            "--max-frequency to exclude the frequencies at which the instrument carries most of the torque, or give "
            "another number of --modes"
        ]
    for k in np.flatnonzero(~errors.steady):
        n = known[k]
        seems = f"the instrument's {n.name} seems {n.compared(errors.values[k])} (standard error {n.told(e[k])})"
        if errors.part is not None:
            out.append(
                f"{seems}, but not in a fit without the last half decade (the error is then {n.told(errors.part[k])}). "
                f"So a misfit of the model poses as {n.name}, and this error is not corrected"
            )
        elif abs(errors.values[k]) >= 2 * e[k]:
            out.append(
                f"{seems}. A fit without the last half decade cannot check this error, so the moduli are not "
                "corrected, and the standard errors contain this error: measure more points at lower frequencies"
            )
    return out


def _cent(value: float) -> str:
    return f"{100 * value:.2g} %"


def instrument_numbers(found: InstrumentErrors, known: list[Nuisance]) -> dict[str, object]:
    """Return the entry `instrument` of fit.json: values, standard errors and priors of the instrument errors."""
    out: dict[str, object] = {}
    errors = np.sqrt(np.diag(found.covariance))
    for k, n in enumerate(known):
        sd = "friction_" if n.name == "friction" else ""
        out |= {
            n.reported: n.unit * float(found.values[k]),
            f"{sd}standard_error": n.unit * float(errors[k]),
            f"{sd}prior_standard_deviation": n.unit,
            f"{sd}without_last_half_decade": None if found.part is None else n.unit * float(found.part[k]),
        }
    moves = not found.unchecked and not bool(found.steady.all())
    return out | {"moves_with_the_band": moves, "could_not_be_checked": found.unchecked}


def directions(sweep: Sweep, known: list[Nuisance]) -> np.ndarray:
    """Return the changes (2n, k) of the residuals of G' and G'' at n frequencies if each of the k instrument errors
    changes by one standard deviation of its prior."""
    scales = np.concatenate(sweep.deviations)
    return np.stack([np.concatenate([n.moved.real, n.moved.imag]) / scales for n in known], axis=1)


def _shifted(sweep: Sweep, known: list[Nuisance], values: np.ndarray) -> Sweep:
    moved = sum((v * n.moved for v, n in zip(values, known, strict=True)), np.zeros(len(sweep.storage), complex))
    return sweep._replace(storage=sweep.storage + moved.real, loss=sweep.loss + moved.imag)


def _with_noise_as_measured(sweep: Sweep) -> Sweep:
    """Return the sweep with the standard deviations of its measured moduli as fixed numbers. A correction then changes
    the moduli but not their noise.
    """
    if sweep.storage_sd is not None:
        return sweep
    storage_sd, loss_sd = sweep.deviations
    return sweep._replace(storage_sd=storage_sd, loss_sd=loss_sd, sd_before=True)


def _errors_of_instrument(fit: Fit, sweep: Sweep, values: np.ndarray | None = None) -> Corrected:
    """Fit the instrument errors together with the modes, in rounds of a fit and a correction.

    Args:
        fit: fit to the moduli of the sweep after the correction by `values`.
        sweep: the measured moduli.
        values: instrument errors (k,) at the start; None: zeros.
    """
    known = nuisances_of(sweep)
    values, covariance = np.zeros(len(known)) if values is None else values, np.eye(len(known))
    for _ in range(ROUNDS):
        here = _shifted(sweep, known, values)
        J, r = np.asarray(fit.solution.jacobian), np.asarray(fit.solution.residuals)
        noise = max(fit.uncertainty.noise, 1e-12)
        d = directions(here, known)
        own = d - J @ np.linalg.lstsq(J, d, rcond=1e-12)[0]  # the part of d that the modes cannot fit
        precision = own.T @ own / noise**2 + np.eye(len(known))
        # The prior is valid for the whole error, but the residuals contain only the part that is not corrected yet.
        whole = np.linalg.solve(precision, own.T @ r / noise**2 - values)
        covariance = np.linalg.inv(precision)
        step = _halved_until_positive(sweep, known, values, whole)
        values = values + step
        fit = _fitted_again(fit, _shifted(sweep, known, values))
        if np.all(np.abs(whole) < np.maximum(1e-3 * np.sqrt(np.diag(covariance)), SETTLED)):
            return Corrected(values, covariance, fit, True)
    return Corrected(values, covariance, fit, False)


def _fitted_again(fit: Fit, sweep: Sweep) -> Fit:
    """Fit the modes to the corrected moduli of `sweep`. The search begins at the values of the modes in `fit`."""
    found = viscoelastic.modes_from(sweep, np.asarray(fit.solution.u)[None], fit.kind)
    return found._replace(details=fit.details | found.details)


def _halved_until_positive(sweep: Sweep, known: list[Nuisance], values: np.ndarray, step: np.ndarray) -> np.ndarray:
    """Halve the `step` of the instrument errors until all moduli that are corrected by `values` + step are positive.
    Return this step. Returns zeros if `HALVINGS` halvings are not enough.

    The first step may be far too long if the modes fit a part of a large error.
    """
    for _ in range(HALVINGS):
        moved = _shifted(sweep, known, values + step)
        if np.all(moved.storage > 0) and np.all(moved.loss > 0):
            return step
        step = step / 2
    return np.zeros_like(step)


def _root_of(covariance: np.ndarray) -> np.ndarray:
    """Return a matrix A (k, k) such that the covariance is A A^T. An eigenvalue that is slightly negative because of
    rounding counts as 0."""
    sizes, vectors = np.linalg.eigh(covariance)
    return vectors * np.sqrt(np.maximum(sizes, 0.0))


def _with_directions(fit: Fit, sweep: Sweep, known: list[Nuisance], root: np.ndarray) -> Estimate:
    """Return the estimate of the modes with standard errors that also contain the k errors of the instrument. `root`
    (k, c): square root of the covariance of these errors, with c columns."""
    J = np.asarray(fit.solution.jacobian)
    _, slope = host.with_jacobian(
        lambda u: uncertainty.parameter_vector(u, fit.kind.maxwell), np.asarray(fit.solution.u)
    )
    moved = slope @ np.linalg.lstsq(J, directions(sweep, known), rcond=1e-12)[0]
    estimate = fit.uncertainty
    for direction in (moved @ root).T:
        estimate = wider(estimate, direction)
    return estimate


def with_gap_error(fit: Fit, relative: float) -> Fit:
    """Return the fit with the error of the gap in its standard errors. `relative`: relative standard error of all
    moduli due to the gap. This error does not change ratios and relaxation times."""
    modes = fit.modes
    first = np.concatenate([fit.uncertainty.values[:1], np.zeros(2 * modes)])
    own = fit.parameters
    if own is not None:
        moduli = np.array([unit.startswith("Pa") for unit in fit.kind.units])
        own = wider(own, np.where(moduli, relative * own.values, 0.0))
    details = fit.details | {"gap_error": relative}
    return fit._replace(uncertainty=wider(fit.uncertainty, relative * first), parameters=own, details=details)
