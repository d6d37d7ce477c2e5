"""Error of the parameters against run time for several fitting methods.

Compared are closed form and torsion simulation, optimizer, recursion (update of the viscous memory from step to step),
and steps per cycle. The porcine liver's sweep is computed from a model, so its true parameters are known. With 1 % of
synthetic noise, the noise dominates the error of every method except the coarsest.

    python -m experiments fit_methods [--quick]
"""

import sys

import numpy as np

from experiments.common import ROOT, plain_ticks, plt, save
from fitting.fits import simulated_rheometer, viscoelastic
from fitting.readers.rheometer import Sweep, read_sweep
from liverjax.core.plotting import BLUE, ORANGE

DATA = ROOT / "data" / "porcine_liver_frequency_sweep.csv"
TRUE = np.array([770.0, 0.235, 0.333, 0.27, 0.03])


def row(name: str, found: viscoelastic.Fit) -> dict:
    """Return the mean and largest relative error of G0, ratios and times, and the run time of the fit."""
    off = found.uncertainty.values / TRUE - 1
    return {
        "name": name,
        "error": float(np.abs(off).mean()),
        "largest_error": float(np.abs(off).max()),
        "run_s": found.run_time,
        "compile_s": found.compile_time,
        "converged": found.converged,
    }


def ways(sweep: Sweep, quick: bool) -> list[dict]:
    """Return one row for each method."""
    closed = viscoelastic.closed_form(sweep, 2)
    rows = [
        row("closed form, Levenberg-Marquardt", closed),
        row("closed form, BFGS", viscoelastic.closed_form(sweep, 2, optimizer="bfgs")),
    ]
    cases = [("exponential", n) for n in (10, 20, 50, 100)] + [("chapter", n) for n in (50, 100)]
    for scheme, steps in cases[:1] if quick else cases:
        simulation = simulated_rheometer.Simulation(scheme=scheme, steps=steps)
        found = simulated_rheometer.through_torsion(sweep, closed, simulation)
        rows.append(row(f"torsion, {scheme} recursion, {steps} steps", found))
        print(rows[-1], flush=True)
    return rows


MARKERS = {"closed form": "D", "torsion, exponential": "o", "torsion, chapter": "s"}


def figure(tables: dict[str, list[dict]]) -> plt.Figure:
    """Plot error against run time. Labels at the points show the steps per cycle, or the method."""
    fig, axes = plt.subplots(figsize=(7.5, 4), layout="constrained")
    for (data, rows), colour in zip(tables.items(), (BLUE, ORANGE), strict=True):
        for way, marker in MARKERS.items():
            mine = [r for r in rows if r["name"].startswith(way)]
            x, y = [r["run_s"] for r in mine], [100 * r["error"] for r in mine]
            line = "-" if way != "closed form" else "none"
            axes.loglog(x, y, marker, ls=line, lw=0.8, color=colour, label=f"{way}, {data}")
            for r in mine if data == "exact" else ():
                text = r["name"].removeprefix("closed form, ").split(" recursion, ")[-1].removesuffix(" steps")
                at = (r["run_s"], 100 * r["error"])
                place = dict(xytext=(8, -3)) if way == "closed form" else dict(xytext=(-4, -12), ha="center")
                axes.annotate(text, at, fontsize=8, textcoords="offset points", **place)
    axes.set(xlabel="run time, compilation apart [s]", ylabel="mean error of the parameters [%]")
    axes.set_title("a sweep fitted in closed form, and through the torsion simulation (numbers: its steps a cycle)")
    axes.title.set_fontsize(9)
    plain_ticks(axes.xaxis)
    axes.legend(fontsize=7, loc="center")
    return fig


def main(quick: bool) -> None:
    """Fit exact and noisy data."""
    exact = read_sweep(DATA)
    rng = np.random.default_rng(0)
    noisy = exact._replace(
        **{k: getattr(exact, k) * (1 + 0.01 * rng.normal(size=exact.storage.shape)) for k in ("storage", "loss")}
    )
    tables = {"exact": ways(exact, quick), "with 1 % of noise": ways(noisy, quick)}
    save("fit_methods", {"exact": tables["exact"], "noisy": tables["with 1 % of noise"]}, figure(tables))


if __name__ == "__main__":
    main("--quick" in sys.argv[1:])
