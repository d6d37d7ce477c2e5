"""Write the results of a fit to stress-stretch curves: curves.json and curves.png, and a table on the terminal."""

import json
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import jax
import numpy as np

from fitting.fits.families.compared_laws import unfollowed
from fitting.fits.stress_stretch import LawFit, loaded_at_rest
from fitting.readers.curves import Curve
from fitting.reports.sweep_report import numbers
from liverjax.core.files import write_whole
from liverjax.core.plotting import COLOURS, GREY, pyplot, save
from liverjax.core.struct import Content
from liverjax.core.versions import versions
from liverjax.laws import homogeneous

if TYPE_CHECKING:
    from matplotlib.figure import Figure


#: Number of points at which the fitted stress of a curve is drawn.
FINE = 200
#: Function that computes the stresses of a law at the points of all curves of a figure. The function is compiled once
#: for each kind of law, because all laws of a figure are evaluated at the same points.
_stress = jax.jit(partial(homogeneous.nominal_stress, constant=True))


def best_first(fits: list[LawFit]) -> list[LawFit]:
    """Sort the laws by Akaike's criterion, corrected for few points, with the best law first. Laws that have too many
    parameters for this criterion are last."""
    return sorted(fits, key=lambda f: (f.aicc, f.bic))


def summary(fit: LawFit) -> Content:
    """Return the entry of one law in curves.json."""
    return {
        "law": fit.label,
        "parameters": dict(zip(fit.names, fit.values.tolist(), strict=True)),
        "units": dict(zip(fit.names, fit.units, strict=True)),
        "standard_errors": dict(zip(fit.names, fit.standard_errors.tolist(), strict=True)),
        "limits": fit.limits,
        "correlation": fit.correlation.tolist(),
        "ground_state_shear_modulus": fit.shear_modulus,
        "cost": fit.cost,
        "mean_relative_error": fit.mean_relative_error,
        "curve_errors": fit.curve_errors,
        "aicc": fit.aicc,
        "bic": fit.bic,
        "converged": fit.converged,
        "iterations": fit.iterations,
        "starts_at_minimum": fit.starts_at_minimum,
        "warnings": fit.warnings,
        "run_time_s": fit.run_time,
        "compile_time_s": fit.compile_time,
    }


def write(out: Path, curves: list[Curve], fits: list[LawFit], structured: Sequence[str] = ()) -> None:
    """Write curves.json and curves.png into the existing folder `out`. `structured`: warnings about structured misfits,
    in which the residuals have a pattern that noise does not explain."""
    ordered = best_first(fits)
    content = {
        "best": ordered[0].label,
        "error_is": "root mean square of (P - P_measured), divided by the root mean square of P_measured of the curve",
        "curves": [
            {"label": c.label, "test": c.test, "points": len(c.stress), "rms_stress_Pa": c.scale} for c in curves
        ],
        "not_followed": unfollowed(curves, fits),
        "loaded_at_rest": loaded_at_rest(curves),
        "structured_misfit": list(structured),
        "laws": [summary(f) for f in ordered],
        "versions": versions(),
    }
    write_whole(out / "curves.json", json.dumps(numbers(content), indent=1, allow_nan=False) + "\n")
    save(figure(curves, ordered), out / "curves.png")


def figure(curves: list[Curve], ordered: list[LawFit]) -> "Figure":
    """Plot each measured curve with the stresses of the best laws. A bar chart below shows the error and the number of
    parameters of each law."""
    shown = ordered[: len(COLOURS)]
    columns = min(4, len(curves))
    rows = -(-len(curves) // columns)
    size = (max(7.0, 3.4 * columns), 2.8 * rows + 0.26 * len(ordered) + 1.3)
    fig = pyplot().figure(figsize=size, layout="constrained")
    halves: Any = fig.subfigures(2, 1, height_ratios=(2.8 * rows, 0.26 * len(ordered) + 1.3))
    top, bottom = halves
    axes = np.atleast_1d(top.subplots(rows, columns)).ravel()
    dense = [fine(curve) for curve in curves]
    F = np.concatenate([curve.F for curve in dense])
    stresses = [np.split(np.asarray(_stress(f.law, F)), len(curves)) for f in shown]
    for k, (axis, curve) in enumerate(zip(axes, curves, strict=False)):
        _curve(axis, curve, dense[k], [P[k] for P in stresses])
    for axis in axes[len(curves) :]:
        axis.axis("off")
    bars = bottom.subplots()
    at = np.arange(len(ordered))
    colours = [COLOURS[k] if k < len(COLOURS) else GREY for k in at]
    bars.barh(at, [100 * f.mean_relative_error for f in ordered], color=colours, height=0.7)
    for k, f in enumerate(ordered):
        text = f" {100 * f.mean_relative_error:.3g} %, {len(f.values)} parameters, {1000 * f.run_time:.0f} ms"
        bars.text(100 * f.mean_relative_error, k, text, va="center", fontsize=8)
    bars.set(yticks=at, yticklabels=[f.label for f in ordered], xlabel="error, relative to a curve's stress [%]")
    bars.set_xlim(0, 145 * max(f.mean_relative_error for f in ordered))
    bars.invert_yaxis()
    return fig


def fine(curve: Curve) -> Curve:
    """Return the curve with `FINE` interpolated deformations, at which fitted stresses are drawn. All stresses of the
    returned curve are 0.

    Between two measured points, the shears and the logarithms of the diagonal of F change linearly. So in a tension
    test the lateral stretch stays lambda^(-1/2). F33 is scaled so that det F = 1.
    """
    at, places = np.linspace(0, len(curve.stress) - 1, FINE), np.arange(len(curve.stress))
    F = np.zeros((FINE, 3, 3))
    for i in range(3):
        for j in range(3):
            values = np.log(curve.F[:, i, i]) if i == j else curve.F[:, i, j]
            F[:, i, j] = np.interp(at, places, values)
    F[:, [0, 1, 2], [0, 1, 2]] = np.exp(F[:, [0, 1, 2], [0, 1, 2]])
    F[:, 2, 2] /= np.linalg.det(F)
    return curve._replace(F=F, stress=np.zeros(FINE))


def _curve(axis: Any, curve: Curve, dense: Curve, stresses: list[np.ndarray]) -> None:
    unit, name = (1e6, "MPa") if curve.scale > 1e5 else (1e3, "kPa") if curve.scale > 1e2 else (1.0, "Pa")
    i, j = curve.component
    for colour, P in reversed(list(zip(COLOURS, stresses, strict=False))):
        axis.plot(dense.driven, P[:, i, j] / unit, color=colour, lw=1.2)
    axis.plot(curve.driven, curve.stress / unit, "o", color="black", ms=3, mfc="none")
    label = "amount of shear" if curve.test == "simple_shear" else "stretch"
    axis.set(title=curve.label.replace("_", " "), xlabel=label, ylabel=f"nominal stress [{name}]")
    axis.title.set_fontsize(8)
    axis.grid(alpha=0.3)


def table(fits: list[LawFit]) -> str:
    """Return a table with one line per law, best law first: error, run time, compile time, Akaike's criterion, G0, and
    parameters ± standard error."""
    lines = [f"{'law':18s} {'error':>7s} {'run':>8s} {'compile':>8s} {'AICc':>8s}  G0 [Pa]    parameters"]
    for f in best_first(fits):
        parameters = ", ".join(
            f"{n} → {f.limits[n]}" if n in f.limits else f"{n} {v:.4g} ± {e:.2g}{'' if u == '1' else ' ' + u}"
            for n, v, e, u in zip(f.names, f.values, f.standard_errors, f.units, strict=True)
        )
        lines.append(
            f"{f.label:18s} {100 * f.mean_relative_error:5.2f} % {1000 * f.run_time:5.0f} ms {f.compile_time:6.1f} s "
            f"{f.aicc:8.1f}  {f.shear_modulus:<9.4g}  {parameters}"
        )
    return "\n".join(lines)
