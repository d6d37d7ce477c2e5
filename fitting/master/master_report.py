"""Output of a master curve: shift_factors.csv, master_curve.csv, shift.png, and a table on the terminal."""

from pathlib import Path
from typing import Any

import numpy as np

from fitting.master.master_curve import MasterCurve
from fitting.master.temperature_laws import reasons_for_missing_laws
from fitting.readers.units import celsius
from liverjax.core.files import write_rows
from liverjax.core.plotting import BLUE, GREY, ORANGE, pyplot, save

HEAD = "frequency_Hz,storage_modulus_Pa,loss_modulus_Pa"
#: Names of the columns that are added if standard deviations were measured.
SD_HEAD = "storage_modulus_sd_Pa,loss_modulus_sd_Pa"


def write_master_curve(out: Path, found: MasterCurve) -> None:
    """Write shift_factors.csv, master_curve.csv and shift.png to the folder `out`. The file master_curve.csv contains
    the standard deviations of the moduli if they were measured."""
    out.mkdir(parents=True, exist_ok=True)
    s = found.shifts
    rows = [celsius(s.temperatures), 10**s.log_a, s.log_a_errors, 10**s.log_b, s.log_b_errors, s.misfit]
    head = "temperature_C,shift_factor,sd_of_log10_shift_factor,vertical_factor,sd_of_log10_vertical_factor,distance"
    write_rows(out / "shift_factors.csv", np.column_stack(rows), head, "%.8g")
    whole, names = found.sweep, HEAD
    columns = [whole.angular_frequency / (2 * np.pi), whole.storage, whole.loss]
    weights = any(part.sd_estimated or part.sd_before for part in found.parts)
    if whole.storage_sd is not None and whole.loss_sd is not None and not weights:
        columns, names = [*columns, whole.storage_sd, whole.loss_sd], f"{HEAD},{SD_HEAD}"
    write_rows(out / "master_curve.csv", np.column_stack(columns), names, "%.10g")
    save(shift_figure(found), out / "shift.png")


def shift_table(found: MasterCurve) -> str:
    """Return a text table with the shift factors at each temperature, one line for each law, and a note if a law is
    missing."""
    s, moved = found.shifts, bool(np.any(found.shifts.log_b))
    lines = [
        f"{'temperature':>12s} {'log10 a_T':>18s}{'log10 b_T':>18s}" if moved else f"{'temperature':>12s} log10 a_T"
    ]
    for k, T in enumerate(celsius(s.temperatures)):
        vertical = f" {s.log_b[k]:9.4f} ± {s.log_b_errors[k]:<6.2g}" if moved else ""
        mark = "  reference" if k == s.reference else ""
        error = "  given" if s.given else f" ± {s.log_a_errors[k]:<7.2g}"
        lines.append(f"{T:9.2f} °C {s.log_a[k]:9.4f}{error}{vertical}{mark}".rstrip())
    for law in found.laws:
        numbers = ", ".join(f"{n} {v:.5g} ± {e:.2g}" for n, (v, e) in law.numbers.items())
        lines.append(f"{law.name}: {numbers}; root mean square distance from the shift factors {law.apart:.2g} decades")
    lines += [f"note: {reason}" for reason in reasons_for_missing_laws(s, found.laws)]
    return "\n".join(lines)


def shift_figure(found: MasterCurve) -> Any:
    """Draw two plots. Left: the master curve, coloured by temperature. Right: the shift factors with their laws."""
    plt, s = pyplot(), found.shifts
    fig, (left, right) = plt.subplots(1, 2, figsize=(10, 4.5), layout="constrained", width_ratios=(6, 4))
    colours = plt.get_cmap("coolwarm")(np.linspace(0, 1, len(found.parts)))
    for part, colour in zip(found.parts, colours, strict=True):
        f = part.angular_frequency / (2 * np.pi)
        left.plot(f, part.storage, "o", ms=3, color=colour, mfc="none")
        left.plot(f, part.loss, "s", ms=3, color=colour, alpha=0.6)
    T = celsius(s.temperatures)
    left.plot([], [], "o", color=GREY, mfc="none", ms=4, label="G'")
    left.plot([], [], "s", color=GREY, ms=4, label=f"G'', blue {T[0]:.4g} °C to red {T[-1]:.4g} °C")
    shifted = f"frequency at {T[s.reference]:.4g} °C [Hz]"
    left.set(xscale="log", yscale="log", xlabel=shifted, ylabel="modulus [Pa]")
    left.legend(fontsize=8, frameon=False, loc="lower left", bbox_to_anchor=(0, 1), ncols=2)
    right.errorbar(T, s.log_a, yerr=2 * s.log_a_errors, fmt="o", ms=4, color="black", capsize=2, label="a, 95 %")
    fine = np.linspace(s.temperatures[0], s.temperatures[-1], 200)
    for law, colour in zip(found.laws, (BLUE, ORANGE), strict=False):
        right.plot(fine - 273.15, law.at(fine), color=colour, lw=1.2, label=law.name)
    right.set(xlabel="temperature [°C]", ylabel="log10 of the shift factor")
    right.legend(fontsize=8, frameon=False)
    return fig
