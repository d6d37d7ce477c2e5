"""The influence of the ends of the band: the fit is repeated without the first and without the last half decade."""

from functools import partial

import numpy as np

from fitting.fits import viscoelastic
from fitting.fits.honesty import chance_of_ends
from fitting.fits.honesty.alike_points import (
    CONTAINED,
    INDEPENDENT,
    OF_INDEPENDENT,
    SHARED,
    with_alike_points,
    with_weights_shown,
)
from fitting.fits.honesty.long_times import with_interval
from fitting.fits.time_tests import TimeFit
from fitting.fits.viscoelastic import FLUID, MISSES, Fit
from fitting.methods import generalised_maxwell, host, kramers_kronig, relaxation_spectrum, springpots
from fitting.methods.estimate import without_part
from fitting.methods.generalised_maxwell import Spectrum
from fitting.methods.least_squares import from_starts
from fitting.methods.noise.uneven_noise import weighted_by_sizes
from fitting.methods.uncertainty import equilibrium_change, equilibrium_error
from fitting.readers.rheometer import Sweep, some

HALF_DECADE = float(np.sqrt(10))
#: KRAMERS_KRONIG: words in each warning from the Kramers-Kronig check of the data. PARTS: names of the two repeated
#: fits in the report.
KRAMERS_KRONIG = "Kramers-Kronig"
PARTS = ("without_first_half_decade", "without_last_half_decade")


def honest(fit: Fit, sweep: Sweep, dense: Spectrum) -> Fit:
    """Add the results of further checks to the fit. These are: standard errors for correlated noise, the check of the
    data with the Kramers-Kronig relations, the check of the residuals for structure, the influence of the ends of the
    band, and the interval of the equilibrium modulus."""
    wider = with_alike_points(fit, sweep)
    if wider is not fit:
        own = {name: error for name, (_, error) in values(fit).items()}
        fit = wider._replace(details=wider.details | {OF_INDEPENDENT: own})
    details, warnings = dict(fit.details), list(fit.warnings)
    sizes = viscoelastic.sizes_of_noise(fit, sweep)
    found = kramers_kronig.of_data(sweep, dense, sizes)
    told = kramers_kronig.sentences(found, sweep)
    details["consistency"] = {
        "kramers_kronig_misfit": found.misfit,
        "scatter": found.scatter if np.isfinite(found.scatter) else None,
        "breaches": [{"from_Hz": a / (2 * np.pi), "to_Hz": b / (2 * np.pi), "what": w} for a, b, w in found.breaches],
        "instrument_above_Hz": None if found.onset is None else found.onset / (2 * np.pi),
    }
    if np.max(fit.relative_errors(sweep)) > viscoelastic.EXACT:
        runs, structured = kramers_kronig.structure(sweep.angular_frequency, *_left_over(fit, sweep, sizes))
        details["residuals"] = runs
        told += structured
        if structured and INDEPENDENT in details:  # report the correlated noise only once
            warnings = [w for w in warnings if not w.startswith(SHARED)]
            told = [w.replace(kramers_kronig.NOT_CONTAINED, CONTAINED) for w in told]
    if found.far and any(w.startswith(MISSES) for w in warnings):
        told = [w for w in told if KRAMERS_KRONIG not in w]
        warnings = [w for w in warnings if not w.startswith(MISSES)] + [_nearest(fit, sweep, found.misfit)]
    details["band_sensitivity"] = sensitivity(fit, sweep)
    details["band_scatter"] = {
        part: chance_of_ends.moved_by_noise(fit, sweep, k) for part, k in _points_left(sweep).items()
    }
    fit = fit._replace(details=details)
    sentences = (*warnings, *told, *_moved_most(fit))
    whole = _with_long_times(fit._replace(warnings=sentences), sweep)
    return whole._replace(warnings=viscoelastic.by_importance(whole.warnings))


def _with_long_times(fit: Fit, sweep: Sweep) -> Fit:
    """Add the interval of the equilibrium modulus, if the strengths and times of Prony modes are the only unknowns of
    the fit."""
    if fit.parameters is not None or len(fit.solution.u) != 2 * fit.modes + (fit.kind.name != FLUID.name):
        return fit
    fluid = fit.kind.name == FLUID.name
    natural = generalised_maxwell.natural_fluid if fluid else generalised_maxwell.natural
    own = natural(np.asarray(fit.solution.u))
    # For a compressed sample, each reported modulus is the modulus that fits the data, times a factor.
    of = "shear_modulus" if fluid else "equilibrium_modulus"
    factor = float(getattr(fit.model, of) / max(float(getattr(own, of)), 1e-300))
    u, common = fit.uncertainty, 0.0
    if u.shared is not None:
        common = float(np.linalg.norm(equilibrium_change(u.values, u.shared)))
    shown = with_weights_shown(fit, sweep)
    noise = u.noise if shown is sweep else 1.0
    return with_interval(fit, [shown], [noise], factor, common) if factor > 0 else fit


def _left_over(fit: Fit, sweep: Sweep, sizes: np.ndarray | None) -> tuple[np.ndarray, np.ndarray]:
    """Return the residuals (n,) [Pa] of G' and of G'' at n frequencies. If some values have more relative noise than
    others (`viscoelastic.sizes_of_noise`), return the residuals of a fit with weights for this noise
    (`weighted_by_sizes`)."""
    if sizes is None:
        return fit.storage - sweep.storage, fit.loss - sweep.loss
    J, r = np.asarray(fit.solution.jacobian), np.asarray(fit.solution.residuals)
    halves = (np.arange(len(r)) >= len(r) // 2).astype(int)
    storage, loss = np.split(np.concatenate(sweep.deviations) * weighted_by_sizes(J, r, sizes, [halves]), 2)
    return storage, loss


def _nearest(fit: Fit, sweep: Sweep, misfit: float) -> str:
    """Return a warning for a fit to data that no model fits well. Even the best spectrum of any shape does not fit
    these data, so errors of the data cause a part of the misfit."""
    errors, closer = fit.relative_errors(sweep), fit.kind.effective is None
    return (
        f"{MISSES} by {100 * errors.mean():.2g} % on average and by {100 * errors.max():.3g} % at most. The best "
        f"spectrum of any shape still misses the data by {100 * misfit:.2g} % ({KRAMERS_KRONIG}), so the data cause a "
        "part of the misfit: look for drift, or strain beyond the linear "
        f"range{'; --model auto shows what comes closer' * closer}"
    )


def sensitivity(fit: Fit, sweep: Sweep) -> dict[str, dict[str, float] | None]:
    """Return the change of each parameter, by name, if a fit excludes the first or the last half decade.

    The changes of an end are None if too few points are left. For a spectrum, only the equilibrium modulus is compared.
    """
    return {part: _change(fit, sweep, kept) for part, kept in _points_left(sweep).items()}


def _points_left(sweep: Sweep) -> dict[str, np.ndarray]:
    """Return two masks (n,) of the n points: the points of the fit without the first half decade, and the points of the
    fit without the last half decade."""
    omega = sweep.angular_frequency
    kept = (omega > omega[0] * HALF_DECADE * (1 + 1e-9), omega < omega[-1] / HALF_DECADE * (1 - 1e-9))
    return dict(zip(PARTS, kept, strict=True))


def values(fit: Fit | TimeFit) -> dict[str, tuple[float, float]]:
    """Return the value and the standard error of each parameter that is compared. The keys are the names of the
    parameters in the report. The strengths of a spectrum are not compared. The standard errors do not contain the error
    of the gap (--gap-error). A wrong gap multiplies the moduli at all frequencies by one factor. So it cannot change a
    parameter if one end of the band is left out."""
    return {n: own for n, own in every_value(fit).items() if not n.startswith("strengths[")}


def every_value(fit: Fit | TimeFit) -> dict[str, tuple[float, float]]:
    """Return the values and standard errors of `values`, and also those of the strengths of a spectrum."""
    gap, every = fit.details.get("gap_error", 0.0), _with_all_errors(fit)
    if not gap:
        return every
    moduli = moduli_among(fit)
    return {n: (v, without_part(e, gap * v) if n in moduli else e) for n, (v, e) in every.items()}


def moduli_among(fit: Fit | TimeFit) -> set[str]:
    """Return the names of the parameters that are proportional to the measured moduli."""
    if fit.parameters is None:
        return {"shear_modulus", "equilibrium_modulus"}
    return {n for n, unit in zip(fit.kind.names, fit.kind.units, strict=True) if unit.startswith("Pa")}


def _with_all_errors(fit: Fit | TimeFit) -> dict[str, tuple[float, float]]:
    if fit.parameters is not None:
        rows = zip(fit.kind.names, fit.parameters.values, fit.parameters.standard_errors, strict=True)
        return {n: (float(v), float(e)) for n, v, e in rows}
    u = fit.uncertainty
    out = {n: (float(v), float(e)) for n, v, e in zip(u.names, u.values, u.standard_errors, strict=True)}
    rest = float(fit.model.shear_modulus * (1 - fit.model.ratios.sum()))
    first = {"shear_modulus": out.pop("shear_modulus")}
    return first | ({} if fit.kind.name == FLUID.name else {"equilibrium_modulus": (rest, equilibrium_error(u))}) | out


def moved(fit: Fit) -> set[str]:
    """Return the names of the parameters that depend strongly on the ends of the band (`decided_by`)."""
    return {name for part in PARTS for name in decided_by(fit, part)}


def decided_by(fit: Fit | TimeFit, part: str) -> dict[str, float]:
    """Return the parameters that depend strongly on the half decade of `part` (one of `PARTS`). If this half decade is
    left out, these parameters change by more than two limits: their standard error, and the change that noise can
    cause. The keys are the names of the parameters. Each value is the absolute change, divided by the larger limit.
    """
    changes, known = (fit.details.get("band_sensitivity") or {}).get(part) or {}, values(fit)
    by_noise = (fit.details.get("band_scatter") or {}).get(part) or {}
    # The smooth residuals of an inadequate model are not noise and do not explain a change. So the limit is the error
    # for independent noise.
    known |= {name: (known[name][0], e) for name, e in fit.details.get(OF_INDEPENDENT, {}).items() if name in known}
    far, out = chance_of_ends.farthest_by_chance(fit, len(changes)), {}
    for name, change in changes.items():
        value, error = known[name]
        allowed = max(error, far * by_noise.get(name, 0.0))
        if abs(change) > allowed and abs(change) > 1e-6 * abs(value):
            out[name] = abs(change) / max(allowed, 1e-300)
    return out


def _change(fit: Fit, sweep: Sweep, kept: np.ndarray) -> dict[str, float] | None:
    """Return the changes of the parameters, by name, if only the points `kept` (n,) are fitted (new minus old values).
    Returns None if too few points are kept."""
    if len(np.unique(sweep.angular_frequency[kept])) <= max(2, len(fit.solution.u) // 2 + 1):
        return None
    # Each kept point keeps its weight, because the standard deviations were smoothed over the whole sweep.
    storage_sd, loss_sd = sweep.deviations
    part = some(sweep._replace(storage_sd=storage_sd, loss_sd=loss_sd), kept)
    old = {name: value for name, (value, _) in values(fit).items()}
    if fit.kind.effective is not None:
        found = fit.details["spectrum"]
        grid = relaxation_spectrum.at(part, found["times_per_decade"], found["smoothing"])
        # For a compressed sample, each reported modulus is the modulus that fits the data, times a factor.
        factor = {name: value / float(np.exp(fit.solution.u[0])) for name, value in old.items()}
        return {name: factor[name] * grid.equilibrium - value for name, value in old.items()}
    if fit.parameters is not None:
        (model,) = (m for m in springpots.FRACTIONAL if m.name == fit.kind.name)
        starts = springpots.starting_points(part)[:, list(model.free)]
        starts[-1] = np.asarray(fit.solution.u)
        # The variables u refer to a frequency in the middle of the whole band. So the whole sweep is used here. Points
        # that are left out get infinite scales.
        scales = np.where(np.tile(kept, 2), np.concatenate(sweep.deviations), np.inf)
        found = springpots.best_minimum(model, sweep, starts, scales)
        assert fit.kind.values is not None
        again = fit.kind.values(found.u)
        return {n: float(v) - old[n] for n, v in zip(model.names, again, strict=True)}
    starts = generalised_maxwell.starts(part, fit.modes, generalised_maxwell.spectrum(part))
    fluid = fit.kind.name == FLUID.name
    starts = np.stack([generalised_maxwell.fluid_of(u) for u in starts]) if fluid else starts
    starts[-1] = np.asarray(fit.solution.u)
    data = (part.angular_frequency, part.storage, part.loss, np.concatenate(part.deviations))
    evaluate = partial(host.with_jacobian, viscoelastic.residuals_of(fit.kind))
    modes = fit.kind.maxwell(from_starts(evaluate, starts, *data).u)
    numbers = np.concatenate([[modes.shear_modulus], modes.ratios, modes.relaxation_times])
    new = dict(zip(fit.uncertainty.names, numbers.tolist(), strict=True))
    new["equilibrium_modulus"] = float(modes.equilibrium_modulus)
    return {name: new[name] - value for name, value in old.items()}


def _moved_most(fit: Fit) -> list[str]:
    """Return a warning if parameters depend on the ends of the band. For each end, the warning names the three
    parameters (or fewer) with the largest changes relative to their limits."""
    known, told = values(fit), []
    for part, end in zip(PARTS, ("first", "last"), strict=True):
        beyond = decided_by(fit, part)
        names = sorted(beyond, key=lambda name: -beyond[name])
        rows = [(name, fit.details["band_sensitivity"][part][name], known[name][0]) for name in names]
        if rows:
            listed = ", ".join(f"{n} by {_relative_change(d, v)}" for n, d, v in rows[:3])
            rest = f" and {len(rows) - 3} more" if len(rows) > 3 else ""
            told.append(f"leaving out the {end} half decade changes {listed}{rest}")
    if not told:
        return []
    return [
        f"{'; '.join(told)}. These changes are larger than expected from independent noise, so these parameters "
        "depend on the ends of the band: use the total errors, or measure a wider band"
    ]


#: Above this relative change, the other points do not determine the parameter, and its new value has no meaning.
RUNS_AWAY = 10.0


def _relative_change(change: float, value: float) -> str:
    if not value:
        return f"{change:+.2g}"
    part = change / value
    if abs(part) >= RUNS_AWAY:
        return "more than tenfold"
    return f"{100 * part:+.2g} %" if abs(part) < 0.995 else f"{100 * part:+.3g} %"  # two digits would print 1e+02 %
