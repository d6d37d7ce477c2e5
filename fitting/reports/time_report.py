"""Write the results of a fit to a relaxation or creep test: fit.json and fit.png, and a table on the terminal."""

import json
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from fitting.fits import time_tests
from fitting.fits.families import limits
from fitting.fits.honesty import total_error
from fitting.fits.honesty.long_times import INTERVAL
from fitting.fits.posterior import Posterior
from fitting.fits.time_tests import TimeFit
from fitting.methods import time_response
from fitting.methods.uncertainty import equilibrium_error
from fitting.readers.time_tests import TimeTest
from fitting.reports import posterior_report
from fitting.reports.sweep_report import by_stem, ends_of_interval, numbers, own_numbers, own_rows
from liverjax.core.files import write_whole
from liverjax.core.plotting import BLUE, GREY, ORANGE, pyplot, save
from liverjax.core.struct import Content
from liverjax.core.versions import versions

if TYPE_CHECKING:
    from matplotlib.figure import Figure


def write(out: Path, test: TimeTest, fit: TimeFit, posterior: Posterior | None = None) -> Content:
    """Write fit.json and fit.png into the folder `out`, and the draws of the posterior if there is one. Return the
    content of fit.json, which has the same keys as for a sweep."""
    out.mkdir(parents=True, exist_ok=True)
    u, n = fit.uncertainty, fit.modes
    e, errors = u.standard_errors, fit.relative_errors
    sampled: Content = {}
    if posterior is not None:
        sampled = {"posterior": posterior_report.summary(posterior)}
        posterior_report.write_draws(out / "posterior.csv", posterior)
    content = numbers(
        {
            "method": test.kind,
            "model": fit.kind.name,
            "converged": fit.converged,
            "modes": n,
            "shear_modulus": float(fit.model.shear_modulus),
            "equilibrium_modulus": limits.equilibrium_of(fit.model),
            "ratios": fit.model.ratios.tolist(),
            "relaxation_times": fit.model.relaxation_times.tolist(),
            "standard_errors": {
                **limits.limit_errors(u, fit.model, fit.parameters),
                "ratios": e[1 : n + 1].tolist(),
                "relaxation_times": e[n + 1 :].tolist(),
            },
            INTERVAL: ends_of_interval(fit.details),
            "interval_quantile_95": u.quantile,
            "correlation": u.correlation.tolist(),
            "correlation_names": list(u.names),
            "noise_factor": u.noise,
            "mean_relative_error": float(errors.mean()),
            "max_relative_error": float(errors.max()),
            "warnings": [*fit.warnings, *(posterior.warnings() if posterior else [])],
            "run_time_s": fit.run_time,
            "compile_time_s": fit.compile_time,
            "details": fit.details,
            "data": test.source,
            "notes": list(test.notes),
            "versions": versions(),
            **own_numbers(fit.parameters, fit.kind),
            **_total_errors_in_time(fit),
            **sampled,
        }
    )
    write_whole(out / "fit.json", json.dumps(content, indent=2, allow_nan=False) + "\n")
    save(figure(test, fit), out / "fit.png")
    return content


def _total_errors_in_time(fit: TimeFit) -> Content:
    """Return the total errors, and the contribution of each source of errors (see `total_error.error_shares`). The
    result is empty for a test that a TOML file describes."""
    if "geometry_error" not in fit.details:
        return {}
    shares = total_error.error_shares(fit)
    return {
        "total_errors": by_stem(total_error.root_of_squares(shares)),
        "error_shares": {source: by_stem(part) for source, part in shares.items()},
    }


def table(test: TimeTest, fit: TimeFit) -> str:
    """Return a table of parameters ± standard error, and the criterion of each model that was tried, with its number of
    modes."""
    rows = [f"{test.kind}, {fit.kind.name}{'' if fit.converged else ' (not converged)'}"]
    if time_tests.ELASTIC in fit.details:
        elastic = fit.details[time_tests.ELASTIC]
        rows.append(
            f"elastic, G {elastic['shear_modulus']:.5g} ± {elastic['standard_error']:.2g} Pa: no relaxation seen;"
        )
        rows.append("the modes below have no meaning")
    rows += _rows_of_modes(fit) if fit.parameters is None else own_rows(fit.parameters, fit.kind, fit.details)
    errors = fit.relative_errors
    rows.append(f"mean error {100 * errors.mean():.3g} %, largest {100 * errors.max():.3g} %")
    for row in fit.details["tried"] if len(fit.details["tried"]) > 1 else []:
        free = "" if row["identifiable"] else "   parameters left free"
        modes = f"{row['modes']:2d} modes, " if row["model"].startswith("prony") else 10 * " "
        rows.append(f"{row['model']:24s} {modes}criterion +{row['above_the_lowest']:.1f}{free}")
    return "\n".join(rows)


def _rows_of_modes(fit: TimeFit) -> list[str]:
    u, n, rows = fit.uncertainty, fit.modes, []
    rows.append(f"G0    {u.values[0]:11.5g} ± {u.standard_errors[0]:<9.2g} Pa")
    if fit.kind.name == "prony":
        rows.append(f"G_inf {limits.equilibrium_of(fit.model):11.5g} ± {equilibrium_error(u):<9.2g} Pa")
    if "geometry_error" in fit.details:
        whole = total_error.total_errors(fit)
        for k, name in enumerate(n for n in ("shear_modulus", "equilibrium_modulus") if n in whole):
            rows[k] += f" total ± {whole[name]:.2g}"
    for k in range(n):
        rows.append(f"g{k + 1:<4d} {u.values[1 + k]:11.5g} ± {u.standard_errors[1 + k]:<9.2g}".rstrip())
        rows.append(f"tau{k + 1:<2d} {u.values[1 + n + k]:11.5g} ± {u.standard_errors[1 + n + k]:<9.2g} s")
    return rows


def figure(test: TimeTest, fit: TimeFit) -> "Figure":
    """Plot the test and its fit (left), and G(t) and J(t) of the model (right)."""
    fig = pyplot().figure(figsize=(10, 4.6), layout="constrained")
    left, right = fig.subplots(1, 2)
    unit = "stress [Pa]" if test.kind == "relaxation" else "strain [1]"
    left.plot(fit.time, fit.measured, "o", color=BLUE, ms=3, mfc="none", label="measured")
    left.plot(fit.time, fit.fitted, "-", color=ORANGE, lw=1.2, label="fitted")
    left.set(xscale="log", yscale="log", xlabel="time [s]", ylabel=unit)
    left.legend(fontsize=8, frameon=False)
    low, high = test.resolved
    t = np.geomspace(low, high, 200)
    right.plot(t, time_response.relaxation_modulus(fit.model, t), color=BLUE, label="G(t) [Pa]")
    right.plot(t, 1 / time_response.creep_compliance(fit.model, t), "--", color=ORANGE, label="1 / J(t) [Pa]")
    for tau in fit.model.relaxation_times:
        right.axvline(tau, color=GREY, lw=0.8)
    right.set(xscale="log", yscale="log", xlabel="time [s]", ylabel="modulus [Pa]", xlim=(low / 1.1, high * 1.1))
    right.legend(fontsize=8, frameon=False)
    plural = "s" if fit.modes > 1 else ""
    mean = 100 * fit.relative_errors.mean()
    fig.suptitle(f"{test.kind}, {fit.kind.name}, {fit.modes} mode{plural}: mean error {mean:.2g} %", fontsize=10)
    return fig
