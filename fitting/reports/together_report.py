"""Write the results of a fit to several tests: fit.json and fit.png, and a table on the terminal."""

import json
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from fitting.fits.families import limits
from fitting.fits.honesty import sizes_of_samples, total_error
from fitting.fits.honesty.long_times import INTERVAL
from fitting.fits.time_tests import thinned
from fitting.fits.together.measured_tests import relative_errors_of
from fitting.fits.together.residuals_of_tests import Share, Together
from fitting.methods.generalised_maxwell import moduli
from fitting.methods.uncertainty import equilibrium_error
from fitting.readers.frequency_sweep import Sweep
from fitting.reports.sweep_report import by_stem, ends_of_interval, numbers, own_numbers, spectrum_rows
from fitting.waves import shear_waves
from fitting.waves.dispersion import Dispersion
from liverjax.core.files import write_whole
from liverjax.core.plotting import BLUE, GREY, ORANGE, pyplot, save
from liverjax.core.struct import Content
from liverjax.core.versions import versions

if TYPE_CHECKING:
    from matplotlib.figure import Figure


#: CURVES: names of the two curves of each test in the frequency domain. QUANTITIES: axis label for each kind of test.
CURVES = {"sweep": ("G'", "G''"), "dispersion": ("phase velocity [m/s]", "attenuation [1/m]")}
QUANTITIES = {
    "sweep": "modulus [Pa]",
    "dispersion": "shear waves",
    "relaxation": "stress [Pa]",
    "creep": "strain [1]",
}


def write(out: Path, found: Together, relative: float | np.ndarray, density: float | None = None) -> Content:
    """Write fit.json and fit.png. Return the content of fit.json, which has the same keys as for a sweep, and the key
    `tests`.

    Args:
        out: folder.
        found: the fit.
        relative: relative errors (K,) of the moduli of the K tests due to the errors of the sample sizes; or one number
            for all tests. Each error is common to all moduli of its test.
        density: density of the material [kg/m^3]; None: the density that belongs to the first test of shear waves, if
            there is such a test.
    """
    out.mkdir(parents=True, exist_ok=True)
    u, n = found.uncertainty, found.modes
    errors = np.array([s.mean_relative_error for s in found.shares])
    points = np.array([s.points for s in found.shares])
    content = numbers(
        {
            "method": "closed-form",
            "model": found.kind.name,
            "converged": found.converged,
            "modes": n,
            "shear_modulus": float(found.model.shear_modulus),
            "equilibrium_modulus": limits.equilibrium_of(found.model),
            "ratios": found.model.ratios.tolist(),
            "relaxation_times": found.model.relaxation_times.tolist(),
            "standard_errors": _by_name(u.standard_errors, n) | limits.limit_errors(u, found.model, found.parameters),
            INTERVAL: ends_of_interval(found.details or {}),
            "interval_quantile_95": u.quantile,
            "correlation": u.correlation.tolist(),
            "correlation_names": list(u.names),
            "mean_relative_error": float(errors @ points / points.sum()),
            "max_relative_error": max(_largest(found)),
            "shear_waves": _waves(found, density),
            **_total_errors(found, relative),
            "tests": [_share_of_test(s, found) for s in found.shares],
            "warnings": list(found.warnings),
            "run_time_s": found.run_time,
            "compile_time_s": found.compile_time,
            "details": {"tried": found.tried, **(found.details or {})},
            **own_numbers(found.parameters, found.kind),
            "versions": versions(),
        }
    )
    write_whole(out / "fit.json", json.dumps(content, indent=2, allow_nan=False) + "\n")
    save(figure(found), out / "fit.png")
    return content


def _total_errors(found: Together, relative: float | np.ndarray) -> Content:
    shares = sizes_of_samples.shares_with_sizes(found, relative)
    whole = total_error.root_of_squares(shares)
    return {"total_errors": by_stem(whole), "error_shares": {source: by_stem(part) for source, part in shares.items()}}


def _waves(found: Together, density: float | None) -> Content:
    """Return speed and attenuation of shear waves over the band of all tests, at four frequencies per decade."""
    high, low = 1 / min(t.resolved[0] for t in found.tests), 1 / max(t.resolved[1] for t in found.tests)
    omega = np.geomspace(low, high, max(2, 1 + int(4 * np.log10(high / low))))
    density = density or next((t.density for t in found.tests if isinstance(t, Dispersion)), None)
    return shear_waves.waves_of_moduli(*moduli(found.model, omega), omega, density)


def _by_name(values: np.ndarray, n: int) -> Content:
    return {
        "shear_modulus": float(values[0]),
        "ratios": values[1 : n + 1].tolist(),
        "relaxation_times": values[n + 1 :].tolist(),
    }


def _share_of_test(share: Share, found: Together) -> Content:
    own, without = found.parameters, share.errors_without
    named = _by_name(without, found.modes) if own is None else dict(zip(own.names, without.tolist(), strict=True))
    return {
        "test": share.name,
        "data": share.source,
        "measured_numbers": share.points,
        "mean_relative_error": share.mean_relative_error,
        "misfit": share.misfit,
        "misfit_by_itself": share.misfit_alone,
        "standard_errors_without_it": named,
    }


def _measured(found: Together, k: int) -> tuple[np.ndarray, np.ndarray]:
    """Return the abscissae [Hz or s] and measured values of test k, in the order of `Together.fitted`."""
    test = found.tests[k]
    if isinstance(test, Sweep):
        return test.angular_frequency / (2 * np.pi), np.concatenate([test.storage, test.loss])
    if isinstance(test, Dispersion):
        return test.angular_frequency / (2 * np.pi), test.measured
    rows = thinned(test)
    return test.time[rows], test.answer[rows]


def _largest(found: Together) -> list[float]:
    return [float(relative_errors_of(*pair).max()) for pair in zip(found.tests, found.fitted, strict=True)]


def table(found: Together, relative: float | np.ndarray) -> str:
    """Return a table of parameters ± standard error, the standard errors of fits that omit one test each, and the total
    error of the first parameter."""
    u, n, own = found.uncertainty, found.modes, found.parameters
    heads = [f"without {k}" for k in range(1, len(found.shares) + 1)]
    rows = [f"{k}: {s.name}, {s.points} numbers, {Path(s.source).name}" for k, s in enumerate(found.shares, 1)]
    units = ["Pa", *[""] * n, *["s"] * n]
    labels = ["G0", *(f"g{k + 1}" for k in range(n)), *(f"tau{k + 1}" for k in range(n))]
    if own is not None:
        u, labels, units = own, list(own.names), ["" if unit == "1" else unit for unit in found.kind.units]
    wide = max(6, *(len(label) + 1 for label in labels))
    rows.append(" " * (wide + 26) + "".join(f"{h:>12s}" for h in heads))
    for j, (label, unit) in enumerate(zip(labels, units, strict=True)):
        if label.startswith("strengths["):
            continue
        without = "".join(f"{_error(s.errors_without[j]):>12s}" for s in found.shares)
        value = f"{u.values[j]:11.5g} ± {_error(u.standard_errors[j]):8s} {unit}"
        rows.append(f"{label:{wide}s}{value:26s}{without}".rstrip())
    if found.kind.name == "prony":
        rows.append(f"G_inf {limits.equilibrium_of(found.model):11.5g} ± {_error(equilibrium_error(u))} Pa")
    if found.kind.effective is not None:
        rows.append(f"G0 {float(found.model.shear_modulus):.5g} Pa, of the {n} Prony modes that represent the spectrum")
    rows += spectrum_rows(found.details or {})
    rows += _with_sizes(found, relative)
    for k, s in enumerate(found.shares, 1):
        rows.append(f"{k}: misfit {100 * s.misfit:.2g} %, by itself {100 * s.misfit_alone:.2g} %")
    for row in found.tried if len(found.tried) > 1 else []:
        free = "" if row["identifiable"] else "   parameters left free"
        modes = f"{row['modes']:2d} modes, " if row["model"].startswith("prony") else 10 * " "
        rows.append(f"{row['model']:24s} {modes}criterion +{row['above_the_lowest']:.1f}{free}")
    return "\n".join(rows)


def _with_sizes(found: Together, relative: float | np.ndarray) -> list[str]:
    """Return a line with the total error of the first parameter. Another parameter is added if its error due to the
    sizes of the samples is not below its error due to noise. If there are several such parameters, the one with the
    largest ratio of these errors is added."""
    shares = sizes_of_samples.shares_with_sizes(found, relative)
    whole, names = total_error.root_of_squares(shares), list(shares["noise"])
    if not names or not np.isfinite(whole[names[0]]):
        return []
    sizes = dict.fromkeys(f"{100 * one:.2g}" for one in (np.min(relative), np.max(relative)))
    told = (
        f"{names[0]} with the errors of the sample sizes ({' to '.join(sizes)} % of a test's moduli): ± "
        f"{whole[names[0]]:.2g}"
    )
    known = [n for n in names[1:] if 0 < shares["noise"][n] < np.inf]
    worst = max(known, key=lambda n: shares["geometry"][n] / shares["noise"][n], default=None)
    if worst is None or shares["geometry"][worst] < shares["noise"][worst]:
        return [told]
    return [f"{told}; {worst}: ± {whole[worst]:.2g}"]


def _error(value: float) -> str:
    return f"{value:.2g}" if np.isfinite(value) else "free"


def figure(found: Together) -> "Figure":
    """Plot one panel per test, with measured and fitted values."""
    count = len(found.tests)
    fig = pyplot().figure(figsize=(max(6.0, 3.6 * count), 4.4), layout="constrained")
    axes = np.atleast_1d(fig.subplots(1, count))
    for k, (test, panel) in enumerate(zip(found.tests, axes, strict=True)):
        x, y = _measured(found, k)
        share = found.shares[k]
        labels = CURVES.get(share.name, ("measured",))[: len(y) // len(x)]
        for half, (label, colour) in enumerate(zip(labels, (BLUE, ORANGE), strict=False)):
            part = slice(half * len(x), (half + 1) * len(x))
            panel.plot(x, y[part], "o", color=colour, ms=3, mfc="none", label=label)
            panel.plot(x, found.fitted[k][part], "-", color=colour if len(labels) > 1 else ORANGE, lw=1.2)
        spectral = isinstance(test, (Sweep, Dispersion))
        panel.set(xscale="log", yscale="log", xlabel="frequency [Hz]" if spectral else "time [s]")
        panel.set_ylabel(QUANTITIES[share.name])
        panel.set_title(
            f"{share.name}: misfit {100 * share.misfit:.2g} %\nby itself {100 * share.misfit_alone:.2g} %", fontsize=9
        )
        panel.legend(fontsize=8, frameon=False)
        panel.grid(color=GREY, alpha=0.2)
    plural = "s" if found.modes > 1 else ""
    fig.suptitle(f"{count} tests, {found.kind.name}, {found.modes} mode{plural}", fontsize=10)
    return fig
