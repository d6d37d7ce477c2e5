"""Write the results of a fit to several samples: fit.json, fit.png and fit.h5, and a table on the terminal."""

import json
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from fitting.fits.families import limits
from fitting.fits.honesty import edges, total_error
from fitting.fits.samples import Samples, outliers, typical_values
from fitting.fits.viscoelastic import SHORT
from fitting.methods import generalised_maxwell
from fitting.methods.population import BELOW
from fitting.readers.rheometer import WARMER
from fitting.readers.units import celsius
from fitting.reports.sweep_report import band_sensitivity, by_stem, numbers, summary
from liverjax.core.files import whole, write_whole
from liverjax.core.plotting import BLUE, GREY, ORANGE, pyplot, save
from liverjax.core.struct import Content
from liverjax.core.versions import versions

if TYPE_CHECKING:
    from matplotlib.figure import Figure


def write(out: Path, found: Samples) -> Content:
    """Write fit.json, fit.png and fit.h5 into the folder `out`. Return the content of fit.json."""
    out.mkdir(parents=True, exist_ok=True)
    content = numbers(_json_content(found))
    write_whole(out / "fit.json", json.dumps(content, indent=2, allow_nan=False) + "\n")
    save(figure(found), out / "fit.png")
    _store_samples(out / "fit.h5", found, content)
    return content


def _json_content(found: Samples) -> Content:
    """Return the content of fit.json: first the model of a typical sample, then the population and all samples."""
    typical, errors = found.typical, np.concatenate([f.relative_errors(s) for f, s in _pairs(found)])
    own: Content = {}
    if found.kind.values is not None:
        known = {n: p.mean_error for n, p in _known_errors(found).items()}
        rows = typical_values(found.fits, found.populations).items()
        own = {"parameters": {n: {"value": v, "standard_error": v * known[n] if n in known else None} for n, v in rows}}
    return {
        "method": "closed-form",
        "model": found.kind.name,
        "converged": all(f.converged for f in found.fits),
        "modes": len(typical.ratios),
        "shear_modulus": float(typical.shear_modulus),
        "equilibrium_modulus": limits.equilibrium_of(typical),
        "ratios": np.asarray(typical.ratios).tolist(),
        "relaxation_times": np.asarray(typical.relaxation_times).tolist(),
        "standard_errors": _errors_of_typical(found),
        **own,
        "correlation": None,  # the populations of the parameters are estimated one by one
        "population": {name: _population(p) for name, p in found.populations.items()},
        "details": {"spectrum": _times_of_strengths(found)} if found.kind.effective is not None else {},
        "samples": [_sample_entry(found, k) for k in range(len(found.fits))],
        "models_compared": found.compared,
        "mean_relative_error": float(errors.mean()),
        "max_relative_error": float(errors.max()),
        "warnings": warnings(found),
        "run_time_s": sum(f.run_time for f in found.fits),
        "compile_time_s": sum(f.compile_time for f in found.fits),
        "versions": versions(),
    }


def _errors_of_typical(found: Samples) -> Content:
    """Return the standard errors of the numbers of the typical sample, under the names for one sample. They are the
    errors of the means of the populations. The error of a modulus also contains its difference from the mean.
    An error is None if it is unknown. If the model has no free Prony modes, the modes represent the means of other
    parameters, so the errors of the modes are unknown."""
    relative = {name: p.mean_error for name, p in _known_errors(found).items()}
    typical = found.typical

    def error_of(value: float, name: str) -> float | None:
        return value * relative[name] if name in relative else None

    known = [f"[{k}]" for k in range(len(found.populations)) if f"ratios[{k}]" in relative]
    names = [place for place in known if f"relaxation_times{place}" in relative]
    out: Content = {}
    for name, value in limits.of_the_modes(typical).items():
        p = found.populations.get(name)
        out[name] = None if p is None else float(np.hypot(p.mean * p.mean_error, p.mean - value))
    for stem, values in (("ratios", typical.ratios), ("relaxation_times", typical.relaxation_times)):
        places = names if found.kind.values is None else ["" for _ in values]
        rows = zip(np.asarray(values).tolist(), places, strict=True)
        out[stem] = [error_of(value, stem + place) for value, place in rows]
    return out


def _times_of_strengths(found: Samples) -> Content:
    """Return a dictionary that gives the relaxation time [s] for the name of each strength of a spectrum, and the
    number of relaxation times per decade."""
    out: Content = {}
    for fit in found.fits:
        names = (n for n in fit.kind.names if n.startswith("strengths["))
        out |= dict(zip(names, fit.details["spectrum"]["relaxation_times"], strict=True))
    return {"relaxation_times": out, "times_per_decade": found.fits[0].details["spectrum"]["times_per_decade"]}


def _labels(found: Samples) -> dict[str, str]:
    """Return the printed name of each parameter. A strength of a spectrum is named by its relaxation time."""
    times = _times_of_strengths(found)["relaxation_times"] if found.kind.effective is not None else {}
    return {n: f"strength at {times[n]:.3g} s" if n in times else n for n in found.populations}


def _pairs(found: Samples) -> zip:
    return zip(found.fits, found.sweeps, strict=True)


def _known_errors(found: Samples) -> Content:
    return {name: p for name, p in found.populations.items() if p is not None}


def _population(p: Any) -> Content | None:
    if p is None:
        return None
    return {
        "mean": p.mean,
        "spread_of_logarithms": p.spread,
        "interval_95_of_the_mean": list(p.mean_interval),
        "interval_95_of_a_new_sample": list(p.new_interval),
    }


def _sample_entry(found: Samples, k: int) -> Content:
    """Return the separate fit of sample `k`, and the sample's parameters after shrinkage towards the population mean
    (pooled)."""
    fit, sweep = found.fits[k], found.sweeps[k]
    pooled = {
        name: {"value": p.pooled[k], "standard_deviation_of_logarithm": p.pooled_errors[k]}
        for name, p in _known_errors(found).items()
    }
    more = {"data": sweep.source, "notes": list(sweep.notes), "pooled": pooled}
    whole = by_stem(total_error.total_errors(fit))
    return summary(fit, sweep) | {"band_sensitivity": band_sensitivity(fit), "total_errors": whole} | more


#: Pairs of texts: words that occur in a warning about a single sample, and what the summary says about all samples that
#: have this warning.
COUNTED = (
    ("mark of the instrument", "the instrument dominates the last points"),
    ("not corrected", "an error of the instrument's inertia is not corrected"),
    ("Kramers-Kronig", "G' and G'' are not consistent with each other"),
    ("structured misfit", "the misfit has structure"),
    ("half decade", "some parameters depend on the ends of the band"),
    (SHORT, "the test ends before the material has relaxed, and no interval of G_inf contains the rest"),
    ("(a fluid)", "the equilibrium modulus cannot be distinguished from zero"),
    ("have merged", "two relaxation times have merged"),
    ("extrapolated", "a relaxation time lies outside of the range that the frequencies resolve"),
    ("use fewer modes", "a mode is not needed or not determined"),
)

#: Two samples have different bands if the logarithms of the ends of their bands differ by more than this value.
OTHER_BAND = 0.7
#: A typical sample is called a fluid if its equilibrium modulus, divided by G0, is below this value.
FLUID_BELOW = 1e-6


def warnings(found: Samples) -> list[str]:
    """Return warnings about the population. For each kind of warning about single samples, also return a sentence that
    counts the samples with this warning."""
    out, of_modes = [], found.kind.values is None
    fluid = np.sum(found.typical.ratios) > 1 - FLUID_BELOW
    for name, p in found.populations.items():
        own = np.array([found.values(k)[name][0] for k in range(len(found.fits))])
        if name.startswith("strengths["):
            continue  # no warning, because many strengths of a spectrum are zero or not determined
        if p is None and "exponent" in name and np.all(np.abs(own - np.round(own[0])) < 1e-3):
            out.append(
                f"{name}: the value is {np.round(own[0]):g} in all samples, so the springpot is a spring or dashpot"
            )
        elif p is None:
            typical = ", and the typical sample is a fluid" if name == "equilibrium_modulus" and fluid else ""
            or_zero = " or its values may all be 0" if name == "equilibrium_modulus" else ""
            out.append(
                f"{name}: fewer than two samples determine this parameter{or_zero}, so its mean and spread are "
                f"unknown{typical}"
            )
        else:
            if p.spread == 0:
                out.append(
                    f"{name}: the differences between the samples are not larger than the errors of the fits, so no "
                    "spread between the samples is found"
                )
            without = [Path(s.source).name for s, x in zip(found.sweeps, p.pooled, strict=True) if np.isnan(x)]
            if without:
                out.append(
                    f"{name}: the fit of {', '.join(without)} does not determine this parameter (perhaps a fluid, or "
                    "another frequency band), so mean and spread are computed from the other samples"
                )
    out += _limits_of_typical(found)
    out += _moduli_of_typical(found)
    out += outliers(found)
    columns = [s.raw["temperature"] for s in found.sweeps if s.raw and "temperature" in s.raw]
    heat = np.array([np.nanmean(column) for column in columns if np.any(np.isfinite(column))])
    if heat.size and np.ptp(heat) > WARMER:
        low, high = celsius(np.array([heat.min(), heat.max()]))
        out.append(
            f"the samples were measured at {low:.4g} to {high:.4g} °C, so the spread between the samples contains the "
            "effect of the temperature"
        )
    failed = [Path(s.source).name for f, s in _pairs(found) if not f.converged]
    if failed:
        out.append(
            f"the fit of {', '.join(failed)} did not converge, and the parameters with the smallest "
            f"misfit so far are given: try {'fewer modes' if of_modes else 'another --model'}"
        )
    for words, told in COUNTED:
        count = sum(any(words in w for w in f.warnings) for f in found.fits)
        if count:
            out.append(f"in {count} of {len(found.fits)} samples {told}; fit.json has the warnings of each sample")
    return out


#: A warning is given if the equilibrium modulus of the typical sample's Prony modes differs from the population mean by
#: more than this fraction.
APART = 0.01


def _limits_of_typical(found: Samples) -> list[str]:
    """Return a warning if the equilibrium modulus of the Prony modes at the top of fit.json differs from the population
    mean."""
    p = found.populations.get("equilibrium_modulus")
    if p is None:
        return []
    rest = limits.of_the_modes(found.typical)["equilibrium_modulus"]
    if abs(rest / p.mean - 1) < APART:
        return []
    why = f"the modes agree with the model {found.kind.name} only over the measured band"
    if found.kind.values is None:
        why = "the mean ratios do not agree with the mean moduli, so use the values of the population"
    return [
        f"the equilibrium modulus of the typical sample's Prony modes is {rest:.4g} Pa, but the population mean is "
        f"{p.mean:.4g} Pa: {why}"
    ]


#: A warning is given if G' or G'' of the typical sample differs from the mean of the samples by more than this value
#: plus the standard error of this mean (mean differences of logarithms over the band of a sample).
FAR_FROM_MEAN = 0.2


def _moduli_of_typical(found: Samples) -> list[str]:
    """Return a warning if the moduli of the typical sample are far from the geometric means of the fitted moduli. For
    example, the modes with one index have other relaxation times in samples that were measured over other bands."""
    bands = [np.log(s.angular_frequency) for s in found.sweeps]
    worst, where = 0.0, 0
    for k, at in enumerate(bands):
        moduli = np.log(np.maximum(generalised_maxwell.moduli(found.typical, np.exp(at)), 1e-300))
        for typical, name in zip(moduli, ("storage", "loss"), strict=True):
            logs = [np.log(np.maximum(getattr(fit, name), 1e-300)) for fit in found.fits]
            pairs = zip(bands, logs, strict=True)
            every = np.stack([np.interp(at, own, log, left=np.nan, right=np.nan) for own, log in pairs])
            count = np.isfinite(every).sum(axis=0)  # samples that were measured at each frequency
            mean = np.nansum(every, axis=0) / count
            variance = np.nansum((every - mean) ** 2, axis=0) / np.maximum(count - 1, 1)
            apart = float(np.abs(typical - mean).mean())
            if apart > max(worst, FAR_FROM_MEAN + np.sqrt(variance / count).mean()):
                worst, where = apart, k
    return [_far_typical(found, worst, where)] if worst else []


def _far_typical(found: Samples, apart: float, where: int) -> str:
    """Return the warning that the moduli of the typical sample differ from the mean moduli in the band of sample
    `where`. `apart`: mean difference of the logarithms."""
    ends = np.array([s.angular_frequency[[0, -1]] for s in found.sweeps]) / (2 * np.pi)
    why = "the means of the parameters do not describe such different samples; use the fits of the single samples"
    if np.any(np.abs(np.log(ends / ends[0])) > OTHER_BAND):
        bands = sorted({f"{low:.3g} to {high:.3g} Hz" for low, high in ends})
        why = (
            f"the samples have different bands ({', '.join(bands)}), so their parameters have different meanings; fit "
            "only samples with the same band together, or give a common band with --min-frequency and --max-frequency"
        )
    return (
        f"G' or G'' of the typical sample differs from the mean of the samples by a factor of {np.exp(apart):.2g} on "
        f"average over the band of {Path(found.sweeps[where].source).name}: {why}"
    )


def table(found: Samples) -> str:
    """Return the tables of the population, of the samples, and of the criterion of each model."""
    units = dict(zip(found.kind.names, found.kind.units, strict=True))
    rows = [
        f"{len(found.fits)} samples, {found.kind.name}",
        f"{'':22s} {'mean':>10s} {'spread':>7s}   {'95 % of the mean':22s}   95 % of a new sample",
    ]
    labels = _labels(found)
    for name, p in found.populations.items():
        label = labels[name]
        unit = units.get(
            name, {"shear_modulus": "Pa", "equilibrium_modulus": "Pa"}.get(name, "Pa" if name.startswith("str") else "")
        )
        unit = "s" if name.startswith("relaxation_time") else "" if unit == "1" else unit
        if p is None:
            rows += [f"{name:22s} {'?':>10s}"] if not name.startswith("strengths[") else []
            continue
        ends = (f"{low:.4g} to {high:.4g}" for low, high in (p.mean_interval, p.new_interval))
        middle, new = ends
        rows.append(f"{label:22s} {p.mean:10.4g} {100 * p.spread:5.0f} %   {middle:22s}   {new} {unit}".rstrip())
    every = [found.values(k) for k in range(len(found.fits))]
    # `name`: the parameter whose value is above zero in most samples.
    name = max(found.populations, key=lambda n: sum(own[n][0] > 0 for own in every))
    rows.append(f"{'sample':32s} {'mean error':>10s}   {labels[name]}")
    for (fit, sweep), own in zip(_pairs(found), every, strict=True):
        value, error = own[name]
        mark = " *" if name in edges.moved(fit) else ""
        mean = f"{100 * fit.relative_errors(sweep).mean():.2g} %"
        rows.append(f"{Path(sweep.source).name[-32:]:32s} {mean:>10s}   {value:.4g} ± {error:.2g}{mark}")
    if len(found.compared) > 1:
        rows.append(f"{'model':28s} {'criterion':>10s}")
        for row in found.compared:
            label = row["model"] + (f", {row['modes']} modes" if "modes" in row else "")
            free = "" if row["identifiable"] else "   parameters left free"
            rows.append(f"{label:28s} {'+' + format(row['above_the_lowest'], '.1f'):>10s}{free}")
    return "\n".join(rows)


def figure(found: Samples) -> "Figure":
    """Plot the moduli of all samples (left). On the right, plot for each parameter the values of all samples, with the
    95 % intervals of the population mean and of a new sample."""
    fig = pyplot().figure(figsize=(10, max(5.0, 0.7 * len(found.populations) + 1.5)), layout="constrained")
    left, right = fig.subplots(1, 2, width_ratios=(5.6, 4.4))
    for fit, sweep in _pairs(found):
        f = sweep.angular_frequency / (2 * np.pi)
        for data, fitted, colour in ((sweep.storage, fit.storage, BLUE), (sweep.loss, fit.loss, ORANGE)):
            left.plot(f, data, "o", color=colour, ms=3, mfc="none", alpha=0.6)
            left.plot(f, fitted, "-", color=colour, lw=0.9, alpha=0.8)
    left.plot([], [], "o-", color=BLUE, ms=3, label="G' measured and fitted")
    left.plot([], [], "o-", color=ORANGE, ms=3, label="G'' measured and fitted")
    left.set(xscale="log", yscale="log", xlabel="frequency [Hz]", ylabel="modulus [Pa]")
    left.legend(fontsize=8, frameon=False, loc="lower left", bbox_to_anchor=(0, 1), ncols=2, borderaxespad=0.3)
    known, labels = _known_errors(found), _labels(found)
    for row, (name, p) in enumerate(known.items()):
        own = np.array([found.values(k)[name][0] for k in range(len(found.fits))]) / p.mean
        own = own[np.isfinite(p.pooled) & (own > BELOW)]
        right.plot(own, np.full(len(own), row), "|", color=GREY, ms=9)
        right.plot(np.array(p.new_interval) / p.mean, [row - 0.2] * 2, "-", color=ORANGE, lw=1.2)
        right.plot(np.array(p.mean_interval) / p.mean, [row + 0.2] * 2, "-", color=BLUE, lw=2.5)
    for marker, colour, label in (
        ("|", GREY, "sample"),
        ("-", BLUE, "95 % of the mean"),
        ("-", ORANGE, "of a new sample"),
    ):
        right.plot([], [], marker, color=colour, label=label)
    right.set(xscale="log", xlabel="value / mean [1]", yticks=range(len(known)), yticklabels=[labels[n] for n in known])
    shown = [t for t in (0.01, 0.03, 0.1, 0.2, 0.5, 0.8, 1, 1.25, 2, 5, 10, 30, 100) if _inside(t, right.get_xlim())]
    right.minorticks_off()
    right.set_xticks(shown, labels=[f"{t:g}" for t in shown])
    right.invert_yaxis()
    right.legend(fontsize=8, frameon=False, loc="lower right", bbox_to_anchor=(1, 1), ncols=3, borderaxespad=0.3)
    return fig


def _inside(value: float, limits: tuple[float, float]) -> bool:
    return limits[0] <= value <= limits[1]


def _store_samples(path: Path, found: Samples, content: Content) -> None:
    import h5py

    with whole(path) as new, h5py.File(new, "w") as file:
        file.attrs["fit.json"] = json.dumps(content)
        for k, (fit, sweep) in enumerate(_pairs(found)):
            group = file.create_group(f"samples/{k}")
            group.attrs["data"] = sweep.source
            group["angular_frequency"] = sweep.angular_frequency
            group["storage"], group["loss"] = sweep.storage, sweep.loss
            group["fitted_storage"], group["fitted_loss"] = fit.storage, fit.loss
            group["covariance"] = fit.uncertainty.covariance
            group["covariance"].attrs["order"] = list(fit.uncertainty.names)
