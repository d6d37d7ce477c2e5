"""What a fit leaves behind: fit.json, fit.png, fit.h5, and a table on the terminal."""

import json
import math
from pathlib import Path
from typing import Any

import numpy as np

from fitting.fits.viscoelastic import Fit
from fitting.methods.generalised_maxwell import moduli
from fitting.methods.uncertainty import equilibrium_error
from fitting.readers.rheometer import Sweep
from liverjax.core.plotting import BLUE, GREEN, GREY, ORANGE, pyplot, save
from liverjax.core.versions import versions


def numbers(values: Any) -> Any:
    """JSON numbers; what is not finite becomes null."""
    if isinstance(values, dict):
        return {k: numbers(v) for k, v in values.items()}
    if isinstance(values, (list, tuple)):
        return [numbers(v) for v in values]
    if isinstance(values, (float, np.floating)):
        return float(values) if math.isfinite(values) else None
    return values.item() if isinstance(values, np.generic) else values


def summary(fit: Fit, sweep: Sweep) -> dict[str, Any]:
    """The content of fit.json for one method."""
    u, n = fit.uncertainty, fit.modes
    errors = fit.relative_errors(sweep)
    e = u.standard_errors
    return {
        "method": fit.method,
        "converged": fit.converged,
        "modes": n,
        "shear_modulus": float(fit.model.shear_modulus),
        "equilibrium_modulus": float(fit.model.shear_modulus * (1 - fit.model.ratios.sum())),
        "ratios": fit.model.ratios.tolist(),
        "relaxation_times": fit.model.relaxation_times.tolist(),
        "standard_errors": {
            "shear_modulus": e[0],
            "equilibrium_modulus": equilibrium_error(u),
            "ratios": e[1 : n + 1].tolist(),
            "relaxation_times": e[n + 1 :].tolist(),
        },
        "interval_quantile_95": u.quantile,
        "correlation": u.correlation.tolist(),
        "correlation_names": list(u.names),
        "noise_factor": u.noise,
        "mean_relative_error": float(errors.mean()),
        "max_relative_error": float(errors.max()),
        "warnings": list(fit.warnings),
        "run_time_s": fit.run_time,
        "compile_time_s": fit.compile_time,
        "details": fit.details,
    }


def write(out: Path, sweep: Sweep, fits: list[Fit], profile: dict[str, Any] | None) -> dict[str, Any]:
    """Write fit.json, fit.png and fit.h5 of the last of `fits` (the others stand beside it); returns the JSON."""
    out.mkdir(parents=True, exist_ok=True)
    main = fits[-1]
    content = summary(main, sweep) | {"data": sweep.source, "notes": list(sweep.notes), "versions": versions()}
    if len(fits) > 1:
        content["closed_form"] = summary(fits[0], sweep)
    if profile is not None:  # of the closed form, whichever method leads
        content.get("closed_form", content)["profile_intervals_95"] = profile
    content = numbers(content)
    (out / "fit.json").write_text(json.dumps(content, indent=2, allow_nan=False) + "\n")
    save(figure(sweep, fits), out / "fit.png")
    _store(out / "fit.h5", sweep, fits, content)
    return content


def _store(path: Path, sweep: Sweep, fits: list[Fit], content: dict[str, Any]) -> None:
    import h5py

    with h5py.File(path, "w") as file:
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


def figure(sweep: Sweep, fits: list[Fit]) -> Any:
    """Moduli and residuals on the left; time constants and the table of parameters on the right.

    Lengths are inches: the picture grows with the table, so that no panel shrinks and no line is lost.
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
    _moduli(top, rest, sweep, fits)
    _time_constants(times, sweep, fits)
    table.axis("off")
    text = table.text(0, 1, "\n".join(lines), family="monospace", fontsize=8, va="top", transform=table.transAxes)
    text.set_in_layout(False)  # its axes are as large as it is
    seconds = f"{fit.run_time:.2g} s run, {fit.compile_time:.2g} s compile"
    plural = "s" if fit.modes > 1 else ""
    mean = 100 * fit.relative_errors(sweep).mean()
    fig.suptitle(f"{fit.method}, {fit.modes} mode{plural}: mean error {mean:.2g} %, {seconds}", fontsize=10)
    return fig


def _moduli(top: Any, rest: Any, sweep: Sweep, fits: list[Fit]) -> None:
    """Data, the closed form as a fine line, what was simulated, and the relative difference below."""
    fit, closed = fits[-1], fits[0]
    f = sweep.angular_frequency / (2 * np.pi)
    fine = np.geomspace(f[0], f[-1], 400)
    lines = [np.asarray(v) for v in moduli(closed.model, 2 * np.pi * fine)]
    rows = (
        ("G'", sweep.storage, sweep.storage_sd, fit.storage, BLUE, lines[0], "o", "x"),
        ("G''", sweep.loss, sweep.loss_sd, fit.loss, ORANGE, lines[1], "s", "+"),
    )
    for symbol, data, sd, fitted, colour, line, marker, cross in rows:
        if sd is not None:  # a bar below zero has no place on a log axis
            low = np.minimum(sd, 0.9 * data)
            top.errorbar(f, data, yerr=[low, sd], fmt="none", ecolor=colour, alpha=0.35, capsize=2)
        measured = f"{symbol} measured" + ("" if sd is None else " ± sd")
        top.plot(f, data, marker, color=colour, ms=4, mfc="none", label=measured)
        top.plot(fine, line, "-", color=colour, lw=1.2, label=f"{symbol} closed form")
        if fit.method == "torsion":
            top.plot(f, fitted, cross, color="black", ms=5, label=f"{symbol} simulated")
        rest.plot(f, 100 * (fitted / data - 1), marker, color=colour, ms=3, label=symbol)
    top.set(xscale="log", yscale="log", ylabel="modulus [Pa]")
    _legend_above(top, 2)
    rest.axhline(0, color=GREY, lw=0.8)
    rest.set(xscale="log", xlabel="frequency [Hz]", ylabel="fit - data [%]")


def _legend_above(axes: Any, columns: int) -> None:
    """Outside of the axes, where it covers nothing."""
    axes.legend(loc="lower left", bbox_to_anchor=(0, 1), borderaxespad=0.3, fontsize=8, ncols=columns, frameon=False)


def _time_constants(axes: Any, sweep: Sweep, fits: list[Fit]) -> None:
    """Strength against time constant with 95 % intervals, and the band that the frequencies resolve."""
    low, high = 1 / sweep.angular_frequency[-1], 1 / sweep.angular_frequency[0]
    axes.axvspan(low, high, color=GREY, alpha=0.12, label="resolved by the data")
    for fit, colour, marker in zip(fits, (GREEN, "black"), "ox", strict=False):
        n, u = fit.modes, fit.uncertainty
        tau, g = u.values[n + 1 :], u.values[1 : n + 1]
        half = np.where(np.isfinite(u.standard_errors), u.quantile * u.standard_errors, 0)
        x = np.vstack([np.minimum(half[n + 1 :], 0.95 * tau), np.minimum(half[n + 1 :], 50 * tau)])
        y = np.minimum(half[1 : n + 1], 1)
        axes.errorbar(
            tau, g, xerr=x, yerr=y, fmt=marker, color=colour, ms=5, capsize=2, lw=1, label=f"{fit.method}, 95 %"
        )
    axes.set(xscale="log", xlabel="relaxation time [s]", ylabel="ratio of G0 [1]")
    axes.set_ylim(0, 1.05 * axes.get_ylim()[1])  # room above the largest
    _legend_above(axes, 2)


def _parameter_rows(fit: Fit) -> list[str]:
    """The moduli, and one line a mode."""
    u, n = fit.uncertainty, fit.modes
    equilibrium = float(fit.model.shear_modulus * (1 - fit.model.ratios.sum()))
    rows = [
        f"G0    {u.values[0]:9.4g} ± {u.standard_errors[0]:.2g} Pa",
        f"G_inf {equilibrium:9.4g} ± {equilibrium_error(u):.2g} Pa",
        "",
        f"{'mode':4s} {'ratio [1]':>20s} {'relaxation time [s]':>22s}",
    ]
    for k in range(n):
        ratio, time = (f"{u.values[j]:.4g} ± {u.standard_errors[j]:.2g}" for j in (1 + k, 1 + n + k))
        rows.append(f"{k + 1:4d} {ratio:>20s} {time:>22s}")
    return rows


def _lines(fit: Fit) -> list[str]:
    u, n = fit.uncertainty, fit.modes

    def row(name, value, error, unit):
        return f"{name:5s} {value:11.5g} ± {error:<9.2g} {unit}".rstrip()

    equilibrium = float(fit.model.shear_modulus * (1 - fit.model.ratios.sum()))
    rows = [
        row("G0", u.values[0], u.standard_errors[0], "Pa"),
        row("G_inf", equilibrium, equilibrium_error(u), "Pa"),
    ]
    for i in range(n):
        rows.append(row(f"g{i + 1}", u.values[1 + i], u.standard_errors[1 + i], ""))
        rows.append(row(f"tau{i + 1}", u.values[1 + n + i], u.standard_errors[1 + n + i], "s"))
    return rows


def table(sweep: Sweep, fits: list[Fit]) -> str:
    """Parameters ± standard error of every method side by side, errors and times below."""
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
    return "\n".join("".join(f"{c:{width}s}" for c in row).rstrip() for row in zip(*columns, strict=True))
