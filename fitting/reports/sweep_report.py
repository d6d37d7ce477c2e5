"""Write the results of a fit to a sweep: fit.json, fit.png and fit.h5, and a table on the terminal."""

import json
import math
from collections.abc import Iterable
from itertools import zip_longest
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from fitting.fits.families import limits, models
from fitting.fits.honesty import alike_points, edges, moduli_errors, total_error
from fitting.fits.honesty.long_times import INTERVAL
from fitting.fits.posterior import Posterior
from fitting.fits.simulated_rheometer import largest_shift
from fitting.fits.viscoelastic import Fit, Kind
from fitting.methods.estimate import Estimate
from fitting.methods.generalised_maxwell import moduli, weighed
from fitting.methods.uncertainty import equilibrium_change, equilibrium_error
from fitting.readers.rheometer import Sweep
from fitting.reports import posterior_report
from fitting.waves import shear_waves
from liverjax.core.files import whole, write_whole
from liverjax.core.plotting import BLUE, GREEN, GREY, ORANGE, pyplot, save
from liverjax.core.struct import Content
from liverjax.core.versions import versions

if TYPE_CHECKING:
    from matplotlib.figure import Figure


#: Closed form and simulation count as equal if they differ by less than this fraction of a standard error.
AGREED = 0.1
STEMS = ("ratios", "relaxation_times")
MARK = "* changes by more than independent noise explains if the first or the last half decade is left out"


def numbers(values: Any) -> Any:
    """Return the values as JSON numbers. Values that are not finite become null."""
    if isinstance(values, dict):
        return {k: numbers(v) for k, v in values.items()}
    if isinstance(values, (list, tuple)):
        return [numbers(v) for v in values]
    if isinstance(values, (float, np.floating)):
        return float(values) if math.isfinite(values) else None
    return values.item() if isinstance(values, np.generic) else values


def summary(fit: Fit, sweep: Sweep) -> Content:
    """Return the content of fit.json for one fit (closed form or simulation)."""
    u, n, omega = fit.uncertainty, fit.modes, sweep.angular_frequency
    errors = fit.relative_errors(sweep)
    e = u.standard_errors
    limiting = limits.limit_errors(u, fit.model, fit.parameters)
    return {
        "method": fit.method,
        "model": fit.kind.name,
        "converged": fit.converged,
        "modes": n,
        "shear_modulus": float(fit.model.shear_modulus),
        "equilibrium_modulus": limits.equilibrium_of(fit.model),
        "ratios": fit.model.ratios.tolist(),
        "relaxation_times": fit.model.relaxation_times.tolist(),
        "standard_errors": {
            **limiting,
            "ratios": e[1 : n + 1].tolist(),
            "relaxation_times": e[n + 1 :].tolist(),
        },
        "mesh_bias": _bias_by_name(u, n, u.mesh_bias),
        "time_step_bias": _bias_by_name(u, n, u.time_step_bias),
        **own_numbers(fit.parameters, fit.kind),
        INTERVAL: ends_of_interval(fit.details),
        "interval_quantile_95": u.quantile,
        "correlation": u.correlation.tolist(),
        "correlation_names": list(u.names),
        "noise_factor": u.noise,
        "mean_relative_error": float(errors.mean()),
        "max_relative_error": float(errors.max()),
        "shear_waves": shear_waves.waves_of_moduli(
            *moduli_errors.moduli_of_model(fit, fit.solution.u, omega), omega, fit.details.get("density_kg_m3")
        ),
        "warnings": list(fit.warnings),
        "run_time_s": fit.run_time,
        "compile_time_s": fit.compile_time,
        "details": fit.details,
    }


def ends_of_interval(details: Content) -> list[float] | None:
    """Return the lower and upper end of the 95 % interval of the equilibrium modulus, or None if the fit has no such
    interval (not converged, or not Prony modes)."""
    found = details.get(INTERVAL)
    return [found["low"], found["high"]] if found else None


def moduli_rows(fit: Fit, sweep: Sweep) -> Content:
    """Return the entry `moduli` of fit.json: G' and G'' of a closed-form fit, and their standard errors. The errors
    contain the uncertainty about the choice of the model."""
    found = moduli_errors.fitted_moduli(fit, sweep.angular_frequency, sweep.noise_given)
    storage, loss = np.split(found.values, 2)
    errors = np.split(found.standard_errors, 2)
    return {
        "angular_frequency": sweep.angular_frequency.tolist(),
        "storage": storage.tolist(),
        "loss": loss.tolist(),
        "standard_errors": {"storage": errors[0].tolist(), "loss": errors[1].tolist()},
        "interval_quantile_95": found.quantile,
        "weights_of_models": moduli_errors.model_weights(fit),
    }


def _bias_by_name(u: Estimate, n: int, moved: np.ndarray | None) -> Content | None:
    """Return the biases `moved` of the parameters of `n` modes, under the same names as the standard errors. Returns
    None if the biases are unknown."""
    if moved is None:
        return None
    return {
        "shear_modulus": moved[0],
        "equilibrium_modulus": equilibrium_change(u.values, moved),
        "ratios": moved[1 : n + 1].tolist(),
        "relaxation_times": moved[n + 1 :].tolist(),
    }


def band_sensitivity(fit: Fit) -> Content:
    """Return the changes of the parameters if one end of the band is ignored, under the same names as in
    `standard_errors`. An entry is None if too few points remained for a fit."""
    changes = fit.details.get("band_sensitivity", {})
    return {part: None if found is None else by_stem(found) for part, found in changes.items()}


def by_stem(flat: dict[str, float]) -> Content:
    """Return values under the same names as in `standard_errors`: ratios[0], ratios[1], … become one list `ratios`."""
    out: Content = {}
    for name, value in flat.items():
        stem = name.split("[")[0]
        if stem == name:
            out[name] = value
        else:
            out.setdefault(stem, []).append(value)
    return out


def own_numbers(p: Estimate | None, kind: Kind) -> Content:
    """Return the parameters of a model that is not made of Prony modes, for fit.json (empty if `p` is None)."""
    if p is None:
        return {}
    rows = zip(p.names, p.values, p.standard_errors, kind.units, strict=True)
    return {"parameters": {n: {"value": v, "standard_error": e, "unit": unit} for n, v, e, unit in rows}}


def spectrum_rows(details: Content) -> list[str]:
    """Return lines to print about the relaxation spectrum of a fit, or an empty list for other models."""
    found = details.get("spectrum")
    if not found:
        return []
    times = found["relaxation_times"]
    return [
        f"{len(times)} strengths from {times[-1]:.2g} to {times[0]:.2g} s,",
        f"on a grid of {found['times_per_decade']} times per decade;",
        f"the data determine the strengths over {found['decades_carried']:.2g} decades,",
        f"{found['effective_parameters']:.2g} effective parameters",
    ]


def own_rows(p: Estimate, kind: Kind, details: Content, marked: Iterable[str] = ()) -> list[str]:
    """Return lines with the parameters of a model, and with the largest difference between the model and its Prony
    modes. Names in `marked` get a star."""
    rows = []
    for name, value, error, unit in zip(p.names, p.values, p.standard_errors, kind.units, strict=True):
        if not name.startswith("strengths["):
            star = " *" if name in marked else ""
            rows.append(f"{name:20s} {value:9.4g} ± {error:.2g} {'' if unit == '1' else unit}{star}".rstrip())
    rows += spectrum_rows(details)
    made = details["conversion"]
    apart = 100 * made["largest_relative_error"]
    return [*rows, f"as {made['modes']} Prony modes (largest", f"difference {apart:.2g} %): see fit.json"]


def write(
    out: Path, sweep: Sweep, fits: list[Fit], profile: Content | None, posterior: Posterior | None = None
) -> Content:
    """Write fit.json, fit.png and fit.h5, with the last fit as the main result. Return the content of fit.json. If
    there is a posterior, fit.json contains its summary, and posterior.csv contains its draws."""
    out.mkdir(parents=True, exist_ok=True)
    main = fits[-1]
    data = ", ".join(sweep.files) or sweep.source
    content = summary(main, sweep) | {"data": data, "notes": list(sweep.notes), "versions": versions()}
    content["moduli"] = moduli_rows(fits[0], sweep)
    content["band_sensitivity"] = band_sensitivity(fits[0])
    whole = total_error.total_errors(main)
    content["total_errors"] = by_stem(whole)
    for name, own in content.get("parameters", {}).items():
        if name in whole:
            own["total_error"] = whole[name]
    content["error_shares"] = {source: by_stem(part) for source, part in total_error.error_shares(main).items()}
    if len(fits) > 1:
        content["closed_form"] = summary(fits[0], sweep)
        content["largest_shift_over_standard_error"] = largest_shift(*fits)
    if profile is not None:  # the profile intervals always belong to the closed-form fit
        content.get("closed_form", content)["profile_intervals_95"] = profile
    if posterior is not None:
        content["posterior"] = posterior_report.summary(posterior)
        content["warnings"] += [*posterior.warnings(), *alike_points.posterior_cautions(main, sweep)]
        posterior_report.write_draws(out / "posterior.csv", posterior)
    content = numbers(content)
    write_whole(out / "fit.json", json.dumps(content, indent=2, allow_nan=False) + "\n")
    save(figure(sweep, fits), out / "fit.png")
    _store(out / "fit.h5", sweep.as_measured, fits, content)
    return content


def _store(path: Path, sweep: Sweep, fits: list[Fit], content: Content) -> None:
    import h5py

    with whole(path) as new, h5py.File(new, "w") as file:
        file.attrs["fit.json"] = json.dumps(content)
        data = file.create_group("data")
        for name in ("angular_frequency", "storage", "loss", "storage_sd", "loss_sd"):
            if getattr(sweep, name) is not None:
                data[name] = getattr(sweep, name)
                data[name].attrs["unit"] = "rad/s" if name == "angular_frequency" else "Pa"
        for fit in fits:
            group = file.create_group(fit.method)
            group["storage"], group["loss"] = fit.storage, fit.loss
            group["shear_modulus"] = fit.model.shear_modulus
            group["ratios"], group["relaxation_times"] = fit.model.ratios, fit.model.relaxation_times
            group["covariance"] = fit.uncertainty.covariance
            group["covariance"].attrs["order"] = list(fit.uncertainty.names)


def figure(sweep: Sweep, fits: list[Fit]) -> "Figure":
    """Plot moduli and residuals (left); time constants and the table of parameters (right).

    Lengths are in inches. A longer table makes the picture higher, so no panel shrinks and no line is cut off.
    """
    fit = fits[-1]
    lines = _parameter_rows(fit)
    foot = 0.16 * len(lines) + 0.35
    height = max(5.6, 3.4 + foot)
    fig = pyplot().figure(figsize=(10, height), layout="constrained")
    halves: Any = fig.subfigures(1, 2, width_ratios=(5.6, 4.4))
    left, right = halves
    top, rest = left.subplots(2, 1, sharex=True, height_ratios=(height - 1.9, 1.9))
    times, table = right.subplots(2, 1, height_ratios=(height - foot, foot))
    draw_moduli(top, rest, sweep, fits)
    draw_time_constants(times, sweep, fits)
    table.axis("off")
    text = table.text(0, 1, "\n".join(lines), family="monospace", fontsize=8, va="top", transform=table.transAxes)
    text.set_in_layout(False)  # the height of these axes was already computed from the text
    seconds = f"{fit.run_time:.2g} s run, {fit.compile_time:.2g} s compile"
    plural = "s" if fit.modes > 1 else ""
    mean = 100 * fit.relative_errors(sweep).mean()
    model = "" if fit.parameters is None else f"{fit.kind.name}, "
    title = f"{fit.method}, {model}{fit.modes} mode{plural}: mean error {mean:.2g} %, {seconds}"
    fig.suptitle(title + _nearest_of_all(fits), fontsize=10)
    return fig


def _nearest_of_all(fits: list[Fit]) -> str:
    """Return a second line for the title of the figure. It states the smallest misfit that a linear material with any
    relaxation spectrum can have. The string is empty if this misfit is unknown."""
    misfit = fits[0].details.get("consistency", {}).get("kramers_kronig_misfit")
    if misfit is None:
        return ""
    return f"\nno spectrum of any shape comes closer than {100 * misfit:.2g} % (root mean square of |G*|)"


def draw_moduli(top: Any, rest: Any, sweep: Sweep, fits: list[Fit]) -> None:
    """Draw data, closed form (a line) and simulation on `top`, and the relative deviation of the fit on `rest`."""
    fit, closed = fits[-1], fits[0]
    f = sweep.angular_frequency / (2 * np.pi)
    fine = np.geomspace(f[0], f[-1], 400)
    lines = _moduli_as_measured(closed, 2 * np.pi * fine)
    rows = (
        ("G'", sweep.storage, sweep.as_measured.storage_sd, fit.storage, BLUE, lines[0], "o", "x"),
        ("G''", sweep.loss, sweep.as_measured.loss_sd, fit.loss, ORANGE, lines[1], "s", "+"),
    )
    bands = _bands(closed, sweep)
    for symbol, data, sd, fitted, colour, line, marker, cross in rows:
        if sd is not None:  # a log axis cannot show a bar below zero
            low = np.minimum(sd, 0.9 * data)
            top.errorbar(f, data, yerr=[low, sd], fmt="none", ecolor=colour, alpha=0.35, capsize=2)
        measured = f"{symbol} measured" + ("" if sd is None else " ± sd")
        top.plot(f, data, marker, color=colour, ms=4, mfc="none", label=measured)
        top.plot(fine, line, "-", color=colour, lw=1.2, label=f"{symbol} closed form")
        if symbol in bands:
            top.fill_between(f, *bands[symbol], color=colour, alpha=0.2, lw=0, label=f"{symbol} 95 %")
        if fit.method == "torsion":
            top.plot(f, fitted, cross, color="black", ms=5, label=f"{symbol} simulated")
        rest.plot(f, 100 * (fitted / data - 1), marker, color=colour, ms=3, label=symbol)
    top.set(xscale="log", yscale="log", ylabel="modulus [Pa]")
    if sweep.grey is not None:
        hertz = sweep.grey[:, 0] / (2 * np.pi)
        top.plot(hertz, sweep.grey[:, 1], "o", color=GREY, ms=4, mfc="none", label="left out: instrument")
        top.plot(hertz, sweep.grey[:, 2], "s", color=GREY, ms=4, mfc="none")
    _legend_above(top, 2)
    doubtful = fits[0].details.get("consistency", {}).get("instrument_above_Hz")
    if doubtful is not None:
        for axes in (top, rest):
            axes.axvspan(1.02 * doubtful, 1.05 * f[-1], color=GREY, alpha=0.15, lw=0)
        place = {"ha": "right", "va": "bottom", "transform": rest.get_xaxis_transform()}
        rest.text(1.05 * f[-1], 0.02, "instrument", fontsize=7, **place)
    rest.axhline(0, color=GREY, lw=0.8)
    rest.set(xscale="log", xlabel="frequency [Hz]", ylabel="fit - data [%]")


def _bands(closed: Fit, sweep: Sweep) -> dict[str, tuple[np.ndarray, np.ndarray]]:
    """Return the ends of the 95 % intervals of G' and G'' at the measured frequencies. The result is empty for a
    compressed sample."""
    if "precompression" in closed.details:
        return {}
    found = moduli_errors.fitted_moduli(closed, sweep.angular_frequency, sweep.noise_given)
    half = found.quantile * np.where(np.isfinite(found.standard_errors), found.standard_errors, 0.0)
    low, high = (np.split(end, 2) for end in (np.maximum(found.values - half, 0.1 * found.values), found.values + half))
    return {symbol: (low[k], high[k]) for k, symbol in enumerate(("G'", "G''"))}


def _moduli_as_measured(closed: Fit, omega: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return G' and G'' as the instrument measures them. If the sample is compressed, these moduli differ from
    those of the sample at rest."""
    found = closed.details.get("precompression")
    factors = (1.0, 1.0)
    if found is not None:
        factors = found["smooth_factor_of_relaxing_moduli"], found["smooth_factor_of_equilibrium_modulus"]
    if found is None or closed.kind.moduli is None or closed.parameters is None:
        storage, loss = moduli(weighed(closed.model, *factors), omega)
        return np.asarray(storage), np.asarray(loss)
    solid = closed.kind.names[0] == "equilibrium_modulus"
    stands = closed.parameters.values[0] if solid else 0.0
    storage, loss = closed.kind.moduli(closed.solution.u, omega)
    return (storage - stands) * factors[0] + stands * factors[1], loss * factors[0]


def _legend_above(axes: Any, columns: int) -> None:
    """Put the legend outside of the axes, where it covers no data."""
    axes.legend(loc="lower left", bbox_to_anchor=(0, 1), borderaxespad=0.3, fontsize=8, ncols=columns, frameon=False)


def draw_time_constants(axes: Any, sweep: Sweep, fits: list[Fit], columns: int = 2) -> None:
    """Draw the Prony ratios over the relaxation times with 95 % intervals, and the band that the frequencies resolve.

    Args:
        columns: number of columns of the legend.
    """
    low, high = 1 / sweep.angular_frequency[-1], 1 / sweep.angular_frequency[0]
    axes.axvspan(low, high, color=GREY, alpha=0.12, label="resolved by the data")
    whole = total_error.total_errors(fits[-1])
    for fit, colour, marker in zip(fits, (GREEN, "black"), "ox", strict=False):
        n, u = fit.modes, fit.uncertainty
        tau, g = u.values[n + 1 :], u.values[1 : n + 1]
        half = np.where(np.isfinite(u.standard_errors), u.quantile * u.standard_errors, 0)
        x = np.vstack([np.minimum(half[n + 1 :], 0.95 * tau), np.minimum(half[n + 1 :], 50 * tau)])
        y = np.minimum(half[1 : n + 1], 1)
        axes.errorbar(
            tau, g, xerr=x, yerr=y, fmt=marker, color=colour, ms=5, capsize=2, lw=1, label=f"{fit.method}, 95 %"
        )
    if fit.parameters is None:
        wide = [np.array([u.quantile * whole[f"{name}[{k}]"] for k in range(n)]) for name in STEMS]
        ends = [np.array([np.minimum(w, 0.95 * v), w]) for w, v in zip(wide, (g, tau), strict=True)]
        axes.errorbar(tau, g, xerr=ends[1], yerr=ends[0], fmt="none", color=GREY, lw=0.8, label="with the ends, 95 %")
    axes.set(xscale="log", xlabel="relaxation time [s]", ylabel="ratio of G0 [1]")
    axes.set_ylim(0, 1.05 * axes.get_ylim()[1])  # leaves room above the largest error bar
    _legend_above(axes, columns)


def _parameter_rows(fit: Fit) -> list[str]:
    """Return lines with the moduli and one line per mode, or with the parameters of a model without Prony modes."""
    u, n = fit.uncertainty, fit.modes
    if fit.parameters is not None:
        return own_rows(fit.parameters, fit.kind, fit.details, edges.moved(fit))
    decided, equilibrium = edges.moved(fit), limits.equilibrium_of(fit.model)

    def mark(name):
        return "*" if name in decided else " "

    whole = total_error.total_errors(fit)
    error = equilibrium_error(u)
    rest = (
        f"{equilibrium:9.4g} ± {error:.2g} Pa {mark('equilibrium_modulus')}" if np.isfinite(error) else "0 Pa (a fluid)"
    )
    rows = [
        f"G0    {u.values[0]:9.4g} ± {u.standard_errors[0]:.2g} Pa {mark('shear_modulus')}",
        f"G_inf {rest}",
        "",
        f"{'mode':4s} {'ratio [1]':>20s} {'relaxation time [s]':>22s}",
    ]
    for k, name in enumerate(("shear_modulus", "equilibrium_modulus")):
        if np.isfinite(whole.get(name, np.inf)):
            rows[k] += f" total ± {whole[name]:.2g}"
    rows = [row.rstrip() for row in rows]
    for k in range(n):
        places = ((1 + k, f"ratios[{k}]"), (1 + n + k, f"relaxation_times[{k}]"))
        ratio, time = (f"{u.values[j]:.4g} ± {u.standard_errors[j]:.2g}{mark(name)}" for j, name in places)
        rows.append(f"{k + 1:4d} {ratio:>20s} {time:>22s}".rstrip())
    return [*rows, "* depends on the ends of the band"] if decided else rows


def _lines(fit: Fit) -> list[str]:
    u, n = fit.uncertainty, fit.modes
    if fit.parameters is not None:
        return own_rows(fit.parameters, fit.kind, fit.details, edges.moved(fit))

    decided = edges.moved(fit)

    def row(name, value, error, unit, key):
        mark = " *" if key in decided else ""
        return f"{name:5s} {value:11.5g} ± {error:<9.2g} {unit:2s}{mark}".rstrip()

    rows = [row("G0", u.values[0], u.standard_errors[0], "Pa", "shear_modulus")]
    if np.isfinite(equilibrium_error(u)):
        rows.append(row("G_inf", limits.equilibrium_of(fit.model), equilibrium_error(u), "Pa", "equilibrium_modulus"))
    else:
        rows.append("G_inf           0 Pa, a fluid")
    for i in range(n):
        rows.append(row(f"g{i + 1}", u.values[1 + i], u.standard_errors[1 + i], "", f"ratios[{i}]"))
        time = f"relaxation_times[{i}]"
        rows.append(row(f"tau{i + 1}", u.values[1 + n + i], u.standard_errors[1 + n + i], "s", time))
    return rows


def table(sweep: Sweep, fits: list[Fit]) -> str:
    """Return a table with one column for each method: parameters ± standard error, then misfits and run times."""
    columns = []
    for fit in fits:
        errors = fit.relative_errors(sweep)
        head = f"{fit.method}{'' if fit.converged else ' (not converged)'}"
        rows = [
            head,
            *_lines(fit),
            f"mean error {100 * errors.mean():.3g} %, largest {100 * errors.max():.3g} %",
            f"run {fit.run_time:.2g} s, compile {fit.compile_time:.2g} s",
        ]
        columns.append(rows)
    width = max(len(r) for r in columns[0]) + 3
    rows = ["".join(f"{c:{width}s}" for c in row).rstrip() for row in zip_longest(*columns, fillvalue="")]
    decided = [MARK] if any(edges.moved(fit) for fit in fits) else []
    return "\n".join(
        [*rows, *decided, *_totals(fits[-1]), *_compression(fits), *_agreement(fits), *models.comparison(fits[0])]
    )


#: Names of the sources of errors, for the user.
SOURCES = {
    "noise": "noise",
    "geometry": "gap and radius",
    "band": "ends of the band",
    "long_times": "relaxation after the test",
    "mesh": "mesh",
    "time_step": "time step",
}


def _totals(fit: Fit) -> list[str]:
    """Return lines with the total errors of the moduli and the contribution of each source."""
    whole, parts, known = total_error.total_errors(fit), total_error.error_shares(fit), edges.values(fit)
    symbols = {"shear_modulus": "G0", "equilibrium_modulus": "G_inf"}
    out = []
    for name in (n for n in symbols if n in known and known[n][0] > 0 and np.isfinite(whole[n])):
        value = known[name][0]
        each = [f"{word} {100 * parts[s][name] / value:.2g} %" for s, word in SOURCES.items() if s in parts]
        out.append(f"{symbols[name]} with all known errors: ± {whole[name]:.2g} Pa ({', '.join(each)})")
    return out


def _compression(fits: list[Fit]) -> list[str]:
    """Return lines with the compression of the sample and the predicted axial force; no lines without compression."""
    found = [fit.details["precompression"] for fit in fits if "precompression" in fit.details]
    if not found:
        return []
    each = ((f["axial_force_N"], f["axial_force_total_error_N"], f["plates"]) for f in found)
    forces = ", ".join(f"{F:.3g}{'' if e is None else f' ± {e:.2g}'} N ({plates} plates)" for F, e, plates in each)
    one = found[0]
    kept = one["modulus_if_incompressible"]
    if_kept = "" if kept is None else f"; smooth plates: G0 is {kept:.4g} times as large if the volume is kept"
    return [
        f"moduli and ratios describe the sample before it was compressed by {100 * one['strain']:.3g} % from "
        f"{one['height_at_rest_m']:.4g} m (law {one['law']}, K / G {one['bulk_over_shear_modulus']:.3g}{if_kept})",
        f"axial force after relaxation, with all known errors, to be compared with the instrument's: {forces}",
    ]


def _agreement(fits: list[Fit]) -> list[str]:
    """Return one line on the difference between simulation and closed form."""
    if len(fits) < 2:
        return []
    shift, seconds = largest_shift(*fits), fits[-1].run_time + fits[-1].compile_time
    if shift > AGREED:
        return [f"the simulation changes a parameter by {shift:.2g} standard errors, in {seconds:.2g} s"]
    return [
        f"closed form and simulation agree within {100 * max(shift, 1e-3):.1g} % of the standard errors: the "
        f"simulation ({seconds:.2g} s) is not needed here, and --method closed-form gives the same result"
    ]
