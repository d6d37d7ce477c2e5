"""Error of the parameters against run time: closed form or torsion simulation, optimizer, recursion, steps a cycle.

The porcine liver's sweep is computed from a model, so its parameters are known; with 1 % of (synthetic) noise on it the
noise, not the method, is the error of every way but the coarsest.

    python experiments/fit_methods.py [--quick]
"""

import sys
from pathlib import Path

import numpy as np
from common import plain_ticks, plt, save

from fitting import fit
from fitting.rheometer import Sweep, read_sweep
from liverjax.colours import BLUE, ORANGE

DATA = Path(__file__).parent.parent / "data" / "porcine_liver_frequency_sweep.csv"
TRUE = np.array([770.0, 0.235, 0.333, 0.27, 0.03])


def row(name: str, found: fit.Fit) -> dict:
    """Mean relative error of G0, ratios and times, and what the fit took."""
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
    """A row a way."""
    closed = fit.closed_form(sweep, 2)
    rows = [
        row("closed form, Levenberg-Marquardt", closed),
        row("closed form, BFGS", fit.closed_form(sweep, 2, optimizer="bfgs")),
    ]
    cases = [("exponential", n) for n in (10, 20, 50, 100)] + [("chapter", n) for n in (50, 100)]
    for scheme, steps in cases[:1] if quick else cases:
        simulation = fit.Simulation(scheme=scheme, steps=steps)
        rows.append(row(f"torsion, {scheme} recursion, {steps} steps", fit.through_torsion(sweep, closed, simulation)))
        print(rows[-1], flush=True)
    return rows


def figure(tables: dict[str, list[dict]]) -> plt.Figure:
    """Error against run time."""
    fig, axes = plt.subplots(figsize=(7, 4), layout="constrained")
    for (data, rows), colour, marker in zip(tables.items(), (BLUE, ORANGE), "os", strict=True):
        axes.loglog([r["run_s"] for r in rows], [100 * r["error"] for r in rows], marker, color=colour, label=data)
        for r in rows:
            if data == "exact":
                left = r["name"].startswith("torsion")
                place = dict(fontsize=7, xytext=(-6 if left else 6, -3), textcoords="offset points")
                place["ha"] = "right" if left else "left"
                axes.annotate(r["name"].removeprefix("torsion, "), (r["run_s"], 100 * r["error"]), **place)
    axes.set(xlabel="run time, compilation apart [s]", ylabel="mean error of the parameters [%]")
    axes.set_title("closed form, and the torsion simulation by recursion and steps a cycle")
    plain_ticks(axes.xaxis)
    axes.legend(title="sweep", loc="center left")
    return fig


def main(quick: bool) -> None:
    """Exact and noisy data."""
    exact = read_sweep(DATA)
    rng = np.random.default_rng(0)
    noisy = exact._replace(
        **{k: getattr(exact, k) * (1 + 0.01 * rng.normal(size=exact.storage.shape)) for k in ("storage", "loss")}
    )
    tables = {"exact": ways(exact, quick), "with 1 % of noise": ways(noisy, quick)}
    save("fit_methods", {"exact": tables["exact"], "noisy": tables["with 1 % of noise"]}, figure(tables))


if __name__ == "__main__":
    main("--quick" in sys.argv[1:])
