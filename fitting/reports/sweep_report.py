"""What a fit leaves behind: fit.json, fit.png, fit.h5, and a table on the terminal."""

import json
import math
from pathlib import Path
from typing import Any

import jax.numpy as jnp
import numpy as np

from fitting.fits.viscoelastic import Fit
from fitting.methods.generalised_maxwell import moduli
from fitting.readers.rheometer import Sweep
from liverjax.core.plotting import BLUE, GREEN, GREY, ORANGE
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
            "equilibrium_modulus": u.equilibrium_error,
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
    _figure(out / "fit.png", sweep, fits)
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


def _figure(path: Path, sweep: Sweep, fits: list[Fit]) -> None:
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    fit, closed = fits[-1], fits[0]
    f = sweep.angular_frequency / (2 * np.pi)
    fig = plt.figure(figsize=(9, 5.2), layout="constrained")
    grid = fig.add_gridspec(3, 2, width_ratios=(3, 2), height_ratios=(3, 1, 0.001))
    top, rest = fig.add_subplot(grid[0, 0]), fig.add_subplot(grid[1:, 0])
    fine = np.geomspace(f[0], f[-1], 200)
    lines = [np.asarray(v) for v in moduli(closed.model, jnp.asarray(2 * np.pi * fine))]
    rows = (
        ("G'", "storage", sweep.storage, sweep.storage_sd, fit.storage, BLUE, lines[0], "o"),
        ("G''", "loss", sweep.loss, sweep.loss_sd, fit.loss, ORANGE, lines[1], "s"),
    )
    spread = sweep.storage_sd is not None
    for symbol, _, data, sd, simulated, colour, line, marker in rows:
        if sd is not None:  # a bar below zero has no place on a log axis
            low = np.minimum(sd, 0.9 * data)
            top.errorbar(f, data, yerr=[low, sd], fmt="none", ecolor=colour, alpha=0.35, capsize=2)
        top.plot(f, data, marker, color=colour, ms=4, label=f"{symbol} measured" + (" ± sd" if spread else ""))
        top.plot(fine, line, "-", color=colour, lw=1.2, label=f"{symbol} closed form")
        if fit.method == "torsion":
            top.plot(f, simulated, "x", color="black", ms=5, label=f"{symbol} simulated" if symbol == "G''" else None)
        rest.plot(f, 100 * (simulated / data - 1), marker + "-", color=colour, ms=3, lw=0.8, label=symbol)
    top.set(xscale="log", yscale="log", ylabel="modulus [Pa]")
    top.legend(fontsize=8, ncols=2)
    rest.axhline(0, color=GREY, lw=0.8)
    rest.set(xscale="log", xlabel="frequency [Hz]", ylabel="fit - data [%]")
    seconds = f"{fit.run_time:.2g} s run, {fit.compile_time:.2g} s compile"
    top.set_title(
        f"{fit.method}, {fit.modes} modes: mean error {100 * fit.relative_errors(sweep).mean():.2g} %, {seconds}",
        fontsize=9,
    )
    _time_constants(fig.add_subplot(grid[0, 1]), sweep, fits)
    _parameters(fig.add_subplot(grid[1:, 1]), fit)
    fig.savefig(path, dpi=150)
    plt.close(fig)


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
    axes.set_ylim(bottom=0)
    axes.legend(fontsize=8)


def _parameters(axes: Any, fit: Fit) -> None:
    axes.axis("off")
    axes.text(0, 1, "\n".join(_lines(fit)), family="monospace", fontsize=8, va="top", transform=axes.transAxes)


def _lines(fit: Fit) -> list[str]:
    u, n = fit.uncertainty, fit.modes

    def row(name, value, error, unit):
        return f"{name:5s} {value:11.5g} ± {error:<9.2g} {unit}".rstrip()

    equilibrium = float(fit.model.shear_modulus * (1 - fit.model.ratios.sum()))
    rows = [
        row("G0", u.values[0], u.standard_errors[0], "Pa"),
        row("G_inf", equilibrium, u.equilibrium_error, "Pa"),
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
