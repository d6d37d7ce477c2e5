"""Models other than Prony modes of a solid (springpots, a spectrum on a grid, fluids), and the choice between all
models. The moduli of all models are known in closed form, without simulation.

One information criterion is used both to compare the models and to choose the number of modes. For the simulation, each
model is converted to Prony modes. The details of a fit contain the largest error of this conversion over the band.
"""

import time
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from fitting.fits import viscoelastic
from fitting.fits.families import limits
from fitting.fits.families.choice import STRONG, contains, label_of, preferred, undecided
from fitting.fits.viscoelastic import Fit, Kind, information_criterion, number_of_parameters
from fitting.methods import as_prony_modes, generalised_maxwell, host, relaxation_spectrum, springpots, uncertainty
from fitting.methods.estimate import Estimate
from fitting.methods.generalised_maxwell import Spectrum
from fitting.methods.least_squares import Solution
from fitting.readers.rheometer import Sweep
from liverjax.core.struct import Content

MODELS = ("prony", "fractional", "spectrum", "auto")
#: Key in `Fit.details` of the table of compared models.
TABLE_OF_MODELS = "models_compared"

#: An exponent is at its bound if its distance from 0 or 1 is below this value, unless its standard error is small.
BOUND = 1e-3
#: Below this distance from 0 or 1, an exponent is at its bound even if its standard error is small.
SHARP = 1e-4


def fractional(sweep: Sweep) -> list[Fit]:
    """Fit every springpot model of `springpots.FRACTIONAL` to a sweep. Each fit is the lowest minimum found from 24
    starting points."""
    starts = springpots.starting_points(sweep)
    # A model with as many parameters as measured values fits any data without residuals, so it is not fitted.
    most = 2 * len(np.unique(sweep.angular_frequency))
    out = []
    for model in springpots.FRACTIONAL:
        if len(model.free) >= most:
            continue
        begin = time.perf_counter()
        found = springpots.best_minimum(model, sweep, starts[:, list(model.free)])
        out.append(_fractional_fit(sweep, model, found, time.perf_counter() - begin))
    return out


def _fractional_fit(sweep: Sweep, model: springpots.Fractional, found: Solution, seconds: float) -> Fit:
    reference = springpots.reference_frequency(sweep)

    def at(u, omega):
        return springpots.moduli(springpots.full(model, u), model.switches, omega / reference)

    def values(u):
        return model.values(springpots.full(model, u), reference)

    made = _conversion(sweep, lambda omega: at(found.u, omega), model.solid)
    kind = Kind(
        name=model.name,
        maxwell=lambda u: as_prony_modes.modes(made, at(u, made.omega)),
        names=model.names,
        units=model.units,
        values=values,
        moduli=at,
    )
    return _finished(viscoelastic.fitted(sweep, found, kind, seconds, 0.0, {}), made)


def spectrum_fit(sweep: Sweep, found: relaxation_spectrum.GridSpectrum | None = None) -> Fit:
    """Fit a smooth, non-negative relaxation spectrum with 2 or 3 relaxation times per decade. `found`: this spectrum,
    if it was computed before."""
    found = found or relaxation_spectrum.fit(sweep)
    solid = int(found.equilibrium > 0)
    strengths = np.concatenate([[found.equilibrium], found.strengths])[1 - solid :]
    prior = found.prior[:, 1 - solid :]

    def moduli(u, omega):
        return relaxation_spectrum.moduli_of_logarithms(u, np.asarray(omega), found.times, bool(solid))

    def held(u):
        return host.exponential(u) @ prior.T

    def residuals(u):
        data, scales = np.concatenate([sweep.storage, sweep.loss]), np.concatenate(sweep.deviations)
        misfit = (np.concatenate(moduli(u, sweep.angular_frequency), axis=-1) - data) / scales
        return np.concatenate([misfit, held(u)], axis=-1)

    u = np.log(strengths)
    made = _conversion(sweep, lambda omega: moduli(u, omega), bool(solid))
    names = ("equilibrium_modulus",) * solid + tuple(f"strengths[{k}]" for k in found.places)
    kind = Kind(
        name="spectrum",
        maxwell=lambda u: as_prony_modes.modes(made, moduli(u, made.omega)),
        names=names,
        units=("Pa",) * len(names),
        values=host.exponential,
        prior=held,
        effective=found.effective,
        moduli=moduli,
    )
    r, J = host.with_jacobian(residuals, u)
    cosine = np.max(np.abs(J.T @ r) / np.maximum(np.linalg.norm(J, axis=0) * np.linalg.norm(r), 1e-300))
    solution = Solution(u, r, J, 0.5 * r @ r, np.array(1), cosine, np.array(True))
    details = {
        "relaxation_times": found.times.tolist(),
        "times_per_decade": found.per_decade,
        "smoothing": found.smoothing,
        "effective_parameters": found.effective,
        "decades_carried": found.decades,
    }
    fit = viscoelastic.fitted(sweep, solution, kind, 0.0, 0.0, {"spectrum": details})
    if solid:
        lowest = sweep.angular_frequency[0] * np.sqrt(10.0) ** np.arange(3)
        noise = fit.uncertainty.noise * float(np.median(sweep.deviations[0] / sweep.storage))
        told = limits.still_relaxing(moduli(u, lowest)[0], noise, float(np.max(found.times)))
        fit = fit._replace(warnings=(*fit.warnings, *told))
    fit = fit._replace(warnings=(*fit.warnings, *relaxation_spectrum.gap_sentences(found)))
    return _finished(fit, made)


def _conversion(sweep: Sweep, moduli: Any, solid: bool) -> as_prony_modes.Conversion:
    return as_prony_modes.convert(moduli, sweep.angular_frequency[0], sweep.angular_frequency[-1], solid)


def _finished(fit: Fit, made: as_prony_modes.Conversion) -> Fit:
    """Add two things to the fit: the error of the conversion to Prony modes, and the warnings about the model."""
    fit = fit._replace(details=fit.details | {"conversion": {"modes": fit.modes, "largest_relative_error": made.error}})
    return fit._replace(warnings=(*fit.warnings, *sentences_of_modes(fit), *undetermined(fit)))


def sentences_of_modes(fit: Fit) -> list[str]:
    """Return the warnings about the Prony modes that represent a springpot model or a spectrum."""
    endless = fit.kind.name != "fractional_zener" and fit.kind.effective is None and not _has_spring(fit.parameters)
    sentences = [_cut_off(fit)] if endless else []
    error = fit.details["conversion"]["largest_relative_error"]
    if error > as_prony_modes.ALLOWED:
        sentences.append(
            f"{fit.modes} Prony modes represent the model {fit.kind.name} only with errors of up to "
            f"{100 * error:.2g} %: simulate a narrower band with --max-frequency"
        )
    return sentences + limits.limit_sentences(fit.kind.name, fit.uncertainty, fit.model, fit.parameters)


def _has_spring(own: Estimate | None) -> bool:
    """Return whether an exponent of a fractional model is 0. A springpot with the exponent 0 is a spring."""
    return own is not None and bool(np.any(_bounded(own) & (own.values < 0.5)))


def limiting_moduli(fit: Fit) -> dict[str, float]:
    """Return the moduli [Pa] of the fitted model at frequency 0 (0 for a fluid) and at infinite frequency. An infinite
    modulus is not included. If a springpot is a spring (exponent 0), the result contains the moduli of the Prony
    modes."""
    if fit.parameters is None or _has_spring(fit.parameters):
        return limits.of_the_modes(fit.model)
    return {"equilibrium_modulus": 0.0} | limits.of_the_model(fit.parameters)


def _cut_off(fit: Fit) -> str:
    return (
        f"the model {fit.kind.name} has no finite instantaneous modulus: shear_modulus belongs to the {fit.modes} "
        "Prony modes that represent the model over the measured band, and is not valid at higher frequencies"
    )


def undetermined(fit: Any) -> list[str]:
    """Return warnings about the parameters of a fractional model that the data do not determine. `fit` may be the fit
    of a sweep, of another test or of several tests."""
    if fit.parameters is None or fit.kind.effective is not None:
        return []
    free = [n for n, ok in zip(fit.kind.names, determined(fit.parameters), strict=True) if not ok]
    told = at_bounds(fit.parameters)
    if free:
        told.append(f"the data do not determine {' and '.join(free)} of the model {fit.kind.name}: use a simpler model")
    return told


def at_bounds(own: Estimate) -> list[str]:
    """Return a warning for each exponent at its bound, 0 or 1. The standard error of such an exponent has no
    meaning."""
    out = []
    for name, value, bound in zip(own.names, own.values, _bounded(own), strict=True):
        if bound:
            what = "dashpot" if value > 0.5 else "spring"
            out.append(
                f"{name} is at its bound {round(float(value))}: the springpot is a {what}, and the standard error of "
                "the exponent has no meaning"
            )
    return out


def determined(own: Estimate) -> np.ndarray:
    """Return whether the data determine each parameter. The data determine a parameter if its standard error is below
    half its absolute value, or if the parameter is an exponent at 0 or 1."""
    return (own.standard_errors < 0.5 * np.abs(own.values)) | _bounded(own)


def _bounded(own: Estimate) -> np.ndarray:
    """Return whether each parameter is an exponent at 0 or 1. A nearly elastic solid may have a small exponent with a
    small error; such an exponent is not at its bound."""
    off = np.minimum(own.values, 1 - own.values)
    known = (own.standard_errors < 0.1 * np.abs(off)) & (off > SHARP)
    return np.array(["exponent" in name for name in own.names]) & (off < BOUND) & ~known


def identifiable(fit: Fit, sweep: Sweep) -> bool:
    """Return whether the fit converged and the data determine every parameter. For a spectrum, only the convergence is
    checked: its prior determines the parameters that the data do not determine."""
    if fit.parameters is None:
        return viscoelastic.identifiable(fit, sweep)
    return fit.converged and (fit.kind.effective is not None or bool(np.all(determined(fit.parameters))))


def starts_of_kind(kind: Kind, sweep: Sweep, modes: int, dense: Spectrum) -> np.ndarray:
    """Return starting points for Prony modes of a solid or of a fluid. `dense`: see `choose`."""
    starts = generalised_maxwell.starts(sweep, modes, dense)
    fluid_of = generalised_maxwell.fluid_of
    return np.stack([fluid_of(u) for u in starts]) if kind.name == viscoelastic.FLUID.name else starts


def fluid(sweep: Sweep, dense: Spectrum) -> Fit:
    """Fit Prony modes of a fluid, which has no equilibrium modulus. The information criterion chooses the number of
    modes."""
    largest = min(uncertainty.supported_modes(sweep), generalised_maxwell.largest_number_of_modes(sweep))
    chosen, failures = None, 0
    for modes in range(1, largest + 1):
        starts = starts_of_kind(viscoelastic.FLUID, sweep, modes, dense)
        fit = viscoelastic.modes_from(sweep, starts, viscoelastic.FLUID)
        better = chosen is None or information_criterion(fit) < information_criterion(chosen)
        if chosen is None or (better and identifiable(fit, sweep)):
            chosen, failures = fit, 0
        else:
            failures += 1
        if failures == 2 or np.max(fit.relative_errors(sweep)) < viscoelastic.EXACT:
            break
    assert chosen is not None
    return chosen


def every_model(sweep: Sweep, model: str, prony: Fit | None, dense: Spectrum) -> list[Fit]:
    """Return the fits of all models that `choose` compares. The arguments are the same as for `choose`."""
    tried: list[Fit] = []
    if model in ("fractional", "auto"):
        tried += fractional(sweep)
    if model in ("spectrum", "auto"):
        tried.append(spectrum_fit(sweep))
    if model == "auto" and prony is not None:
        tried.append(prony)
        if uncertainty.may_be_fluid(prony.uncertainty):
            tried.append(fluid(sweep, dense))
    return tried


def best_of_models(tried: Sequence[Fit], sweep: Sweep) -> tuple[Fit, list[Fit]]:
    """Return the fit of the best model, and the fits of all models whose parameters the data determine. If there is no
    such model, all fits in `tried` are compared and returned."""
    able = [fit for fit in tried if identifiable(fit, sweep)] or list(tried)
    return able[preferred([label_of(f) for f in able], [information_criterion(f) for f in able])], able


def choose(sweep: Sweep, model: str, prony: Fit | None, dense: Spectrum) -> Fit:
    """Return the fit with the lowest information criterion (`preferred`) among the models whose parameters the data
    determine.

    Args:
        sweep: data.
        model: one of `MODELS` except "prony".
        prony: the best fit of Prony modes. It is compared only if `model` is "auto".
        dense: result of `generalised_maxwell.spectrum(sweep)`.
    """
    tried = every_model(sweep, model, prony, dense)
    return _with_rivals(best_of_models(tried, sweep)[0], tried, sweep)._replace(
        run_time=sum(fit.run_time for fit in tried), compile_time=sum(fit.compile_time for fit in tried)
    )


def _with_rivals(chosen: Fit, tried: list[Fit], sweep: Sweep) -> Fit:
    """Return the chosen fit with the other models: their table, their fits (`rivals`) and the warnings about them."""
    able = best_of_models(tried, sweep)[1]
    return chosen._replace(
        warnings=(*chosen.warnings, *_rival_models(chosen, tried, able)),
        details=chosen.details | {TABLE_OF_MODELS: _compared(sweep, tried)},
        rivals=tuple(fit for fit in able if fit is not chosen),
    )


def rival_modes(chosen: Fit) -> Fit | None:
    """Return the fit of free Prony modes that was compared with `chosen`, or None if there is no such fit. If a solid
    and a fluid were compared, `preferred` selects one of them. The returned fit contains the table of the compared
    models and their computation time."""
    free = {fit.kind.name: fit for fit in chosen.rivals if fit.kind.values is None}
    if not free:
        return None
    fits = list(free.values())
    fit = fits[preferred([label_of(f) for f in fits], [information_criterion(f) for f in fits])]
    details = fit.details | {TABLE_OF_MODELS: chosen.details[TABLE_OF_MODELS]}
    return fit._replace(details=details, run_time=chosen.run_time, compile_time=chosen.compile_time)


def is_preferred(corrected: Fit, other: Fit, prior: float) -> bool:
    """Return whether the criterion prefers `corrected`, a fit with an error of the instrument, to `other`, a fit of the
    uncorrected sweep. `prior`: each error of the instrument is divided by the standard deviation of its prior; `prior`
    is the sum of the squares."""
    criteria = [information_criterion(corrected) + prior, information_criterion(other)]
    return preferred([label_of(corrected), label_of(other)], criteria) == 0


def compared_again(chosen: Fit, sweep: Sweep, at_rest: Callable[[Fit], Fit]) -> Fit:
    """Fit the other models again, to a corrected sweep, and return `chosen` (free Prony modes) with these models as
    rivals. If `chosen` was not compared with other models before, it is returned unchanged. The correction was found
    with the chosen model, so the comparison favours this model.

    Args:
        chosen: fit to the corrected sweep. Its details contain the table of the models that were compared before.
        sweep: the corrected sweep.
        at_rest: function that converts a fit to the parameters of the sample at rest. `chosen` already has these
            parameters.
    """
    if TABLE_OF_MODELS not in chosen.details:
        return chosen
    dense, prony, fluids = generalised_maxwell.spectrum(sweep), chosen, viscoelastic.FLUID.name
    if chosen.kind.name == fluids:
        modes = next(row["modes"] for row in chosen.details[TABLE_OF_MODELS] if row["model"] == "prony")
        solids = [viscoelastic.closed_form(sweep, n, dense) for n in sorted({modes, chosen.modes})]
        prony = min(solids, key=lambda fit: (not identifiable(fit, sweep), information_criterion(fit)))
    others = [fit for fit in every_model(sweep, "auto", prony, dense) if fit.kind.name != chosen.kind.name]
    return _with_rivals(chosen, [*(at_rest(fit) for fit in others), chosen], sweep)


def _compared(sweep: Sweep, tried: list[Fit]) -> list[Content]:
    """Return a table with the information criterion and other results of each model, best model first."""
    best = min(information_criterion(fit) for fit in tried)
    rows = [
        {
            "model": fit.kind.name,
            "parameters": number_of_parameters(fit),
            "modes": fit.modes,
            "information_criterion": information_criterion(fit),
            "above_the_lowest": information_criterion(fit) - best,
            "identifiable": identifiable(fit, sweep),
            "mean_relative_error": float(np.mean(fit.relative_errors(sweep))),
        }
        for fit in tried
    ]
    return sorted(rows, key=lambda row: row["information_criterion"])


def _is_beaten(general: Fit, special: Fit) -> bool:
    """Return whether `general` contains the special case `special` and `preferred` chooses `special`."""
    labels, fits = [label_of(general), label_of(special)], (general, special)
    return contains(*labels) and preferred(labels, [information_criterion(f) for f in fits]) == 1


def _rival_models(chosen: Fit, tried: list[Fit], able: list[Fit]) -> list[str]:
    """Return warnings in two cases: another model fits the data about equally well, or another model fits better but
    the data do not determine all its parameters."""
    best, out = min(tried, key=information_criterion), []
    free = not any(best is fit for fit in able)
    if free and information_criterion(best) < information_criterion(chosen) - STRONG:
        apart = information_criterion(chosen) - information_criterion(best)
        out.append(
            f"{best.kind.name} would fit the data more closely (criterion {apart:.2g} lower), but the data do not "
            "determine some of its parameters"
        )
    others = [f for f in able if f is not chosen and not _is_beaten(f, chosen)]
    if not others:
        return out
    second = min(others, key=information_criterion)
    apart = information_criterion(second) - information_criterion(chosen)
    if apart >= STRONG:
        return out
    if apart <= -STRONG:  # usual cause: the data were corrected for an error that was fitted with the chosen model
        return [
            *out,
            f"{second.kind.name} explains the data better than {chosen.kind.name} (criterion {-apart:.2g} "
            f"lower; {STRONG:g} is very strong evidence), and their moduli may differ much outside the measured band",
        ]
    return [*out, undecided(second.kind.name, chosen.kind.name, apart)]


def comparison(fit: Fit) -> list[str]:
    """Return lines of text with the information criterion of each model, best model first. The list is empty if only
    one model was fitted."""
    rows = fit.details.get(TABLE_OF_MODELS, [])
    if len(rows) < 2:
        return []
    lines = [f"{'model':24s} {'parameters':>10s} {'criterion':>10s} {'mean error':>11s}"]
    for row in rows:
        free = "" if row["identifiable"] else "   parameters left free"
        lines.append(
            f"{row['model']:24s} {row['parameters']:10.3g} {'+' + format(row['above_the_lowest'], '.1f'):>10s} "
            f"{100 * row['mean_relative_error']:9.2g} %{free}"
        )
    return lines
