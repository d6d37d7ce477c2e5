"""Write the results of a fit to a strain sweep: fit.json and fit.png, and a table on the terminal."""

import json
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from fitting.amplitude.law_fit import StrainFit, said_of
from fitting.amplitude.strain_sweep import StrainSweep
from fitting.reports import curves_report
from fitting.reports.sweep_report import numbers
from liverjax.core.files import write_whole
from liverjax.core.plotting import BLUE, COLOURS, ORANGE, pyplot, save
from liverjax.core.struct import Content
from liverjax.core.versions import versions

if TYPE_CHECKING:
    from matplotlib.figure import Figure


def write(out: Path, sweep: StrainSweep, fits: list[StrainFit], warnings: Sequence[str] = ()) -> Content:
    """Write fit.json and fit.png into the existing folder `out`, and return the content of fit.json. `fits` begins with
    the best fit. `warnings`: sentences that fit.json lists before the warnings about the fits.
    """
    content = {
        "error_is": "mean_relative_error: root mean square of the misfits of G' and G'', both divided by |G*|. "
        "curve_errors: root mean square of the misfit of each modulus, divided by this modulus",
        "data": sweep.source,
        "notes": list(sweep.notes),
        "frequency_Hz": sweep.angular_frequency / (2 * np.pi),
        "strain": sweep.strain.tolist(),
        "laws": [
            curves_report.summary(f.law)
            | {
                "storage_Pa": f.storage.tolist(),
                "loss_Pa": f.loss.tolist(),
                "third_harmonic_over_first": f.third.tolist(),
            }
            for f in fits
        ],
        "warnings": [*warnings, *said_of(sweep, fits)],
        "versions": versions(),
    }
    content = numbers(content)
    write_whole(out / "fit.json", json.dumps(content, indent=1, allow_nan=False) + "\n")
    save(figure(sweep, fits), out / "fit.png")
    return content


def table(sweep: StrainSweep, fits: list[StrainFit]) -> str:
    """Return the table of the laws (best law first), and a line with the third harmonic of the best law at the largest
    strain."""
    most, third = 100 * sweep.strain[-1], round(100 * fits[0].third[-1], 9)
    said = f"{fits[0].law.label}: at a strain of {most:.3g} % the third harmonic is {third:.2g} % of the first"
    return "\n".join([curves_report.table([f.law for f in fits]), said])


def figure(sweep: StrainSweep, fits: list[StrainFit]) -> "Figure":
    """Plot the measured moduli and the moduli of the best laws over the strain (left), and the third harmonics that
    these laws predict (right)."""
    fig = pyplot().figure(figsize=(10, 4.2), layout="constrained")
    left, right = fig.subplots(1, 2)
    percent = 100 * sweep.strain
    left.plot(percent, sweep.storage, "o", color=BLUE, ms=4, mfc="none", label="G' measured")
    left.plot(percent, sweep.loss, "s", color=ORANGE, ms=4, mfc="none", label="G'' measured")
    for k, f in enumerate(fits[:4]):
        style, width = ("-", 1.4) if k == 0 else ("--", 0.9)
        name = f"{f.law.label}, {100 * f.law.mean_relative_error:.2g} %"
        left.plot(percent, f.storage, style, color=COLOURS[k % len(COLOURS)], lw=width, label=name)
        left.plot(percent, f.loss, style, color=COLOURS[k % len(COLOURS)], lw=width)
        right.plot(percent, 100 * f.third, style, color=COLOURS[k % len(COLOURS)], lw=width, label=f.law.label)
    left.set(xscale="log", yscale="log", xlabel="strain at the rim [%]", ylabel="modulus of the first harmonic [Pa]")
    right.set(xscale="log", yscale="log", xlabel="strain at the rim [%]", ylabel="third harmonic over the first [%]")
    # Values below the axis are roundoff, or below any instrument's resolution. A law without a third harmonic has only
    # such values, so the upper end does not follow from the values alone.
    largest = 100 * max(float(f.third.max()) for f in fits[:4])
    right.set_ylim(1e-4, max(1e-3, 2 * largest))
    for axes in (left, right):
        axes.legend(fontsize=8, frameon=False)
        axes.grid(alpha=0.3)
    return fig
