"""Error against run time for the liver phantom, for several choices: time step and integrator, update of the viscous
memory (recursion), Newton's tolerance, porous scheme, and explicit against implicit integration.

The error is the largest distance of a node from a fine run at 0.6, 1.2 and 1.8 s, divided by the largest displacement.

    python -m experiments liver_choices
"""

import time

import jax
import numpy as np

from experiments.benchmarks.baselines import corotational, critical_step, explicit
from experiments.common import either, plain_ticks, plt, save
from experiments.liver import ONE_STEP, error, models, timed_run, with_solve
from liverjax.core.plotting import COLOURS
from liverjax.core.struct import replace

SECONDS, AT = either((1.8, (0.6, 1.2, 1.8)), (0.6, (0.6,)))


class Table:
    """The runs for one question, and the fine run that they are compared with."""

    def __init__(self, scene, fine):
        self.scene, self.fine, self.series = scene, fine, {}

    def add(self, name, scene):
        """Add one run to the table."""
        result, row = timed_run(scene)
        off = error(result.times, result.positions, self.fine[0], self.fine[1], AT)
        self.series.setdefault(name, []).append({"error": off} | row)
        print(name, {k: round(v, 5) for k, v in self.series[name][-1].items()}, flush=True)


def fine_run(scene, dt):
    """Return times and positions of a run with Newmark and small steps."""
    result, _ = timed_run(with_solve(scene, SECONDS, dt, integrator="newmark", tolerance=1e-8), rounds=1)
    return np.asarray(result.times), np.asarray(result.positions)


def time_steps(scene) -> Table:
    """Viscous model: implicit Euler and Newmark, and Newmark with the chapter's recursion."""
    table = Table(scene, fine_run(scene, either(0.0025, 0.01)))
    chapter = replace(scene, viscosity=replace(scene.viscosity, scheme="chapter"))
    for dt in either((0.3, 0.15, 0.05, 0.02, 0.01), (0.05,)):
        table.add("implicit Euler", with_solve(scene, SECONDS, dt))
        table.add("Newmark", with_solve(scene, SECONDS, dt, integrator="newmark"))
        if dt < 0.3:
            table.add("Newmark, chapter's recursion", with_solve(chapter, SECONDS, dt, integrator="newmark"))
    return table


def newton(scene) -> Table:
    """Newton's tolerance: error relative to the same time step solved to 1e-10."""
    exact, _ = timed_run(with_solve(scene, SECONDS, 0.05, tolerance=1e-10), rounds=1)
    table = Table(scene, (np.asarray(exact.times), np.asarray(exact.positions)))
    for tolerance in either((1e-2, 1e-4, 1e-6, 1e-8), (1e-2,)):
        table.add("to a tolerance", with_solve(scene, SECONDS, 0.05, tolerance=tolerance))
    table.add("one iteration", with_solve(scene, SECONDS, 0.05, **ONE_STEP))
    return table


def porous(scene) -> Table:
    """Complete model: the implicit pressure and the chapter's scheme."""
    table = Table(scene, fine_run(scene, either(0.005, 0.02)))
    chapter = replace(scene, porosity=replace(scene.porosity, scheme="chapter"))
    for dt in either((0.15, 0.05, 0.02), (0.05,)):
        table.add("implicit", with_solve(scene, SECONDS, dt))
        table.add("chapter's", with_solve(chapter, SECONDS, dt))
    return table


def explicit_or_implicit(scene) -> Table:
    """Hyperelastic model: total Lagrangian explicit with 0.9 of its critical step, corotational, and `simulate`."""
    limit = float(critical_step(scene))
    steps = int(np.ceil(SECONDS / (0.9 * limit) / 90)) * 90
    dt, keep = SECONDS / steps, steps // 90
    run = jax.jit(lambda s, dt: explicit(s, dt, 4 * steps, 4 * keep))
    fine = np.asarray(run(scene, dt / 4))
    table = Table(scene, (0.02 * np.arange(1, 91), fine))

    def measure(name, function, times, dt):
        program = jax.jit(function).lower(scene).compile()
        x = np.asarray(program(scene))
        begin = time.perf_counter()
        jax.block_until_ready(program(scene))
        seconds = time.perf_counter() - begin
        row = {"error": error(times, x, *table.fine, AT), "dt": dt, "run_s": seconds}
        table.series.setdefault(name, []).append(row)
        print(name, row, flush=True)

    every = 0.02 * np.arange(1, 91)
    measure("explicit, total Lagrangian", lambda s: explicit(s, dt, steps, keep), every, dt)
    for coarse in either((0.15, 0.05, 0.02, 0.01), (0.05,)):
        n = round(SECONDS / coarse)
        measure("corotational", lambda s, c=coarse, n=n: corotational(s, c, n), coarse * np.arange(1, n + 1), coarse)
        table.add("implicit Euler", with_solve(scene, SECONDS, coarse))
        table.add("Newmark", with_solve(scene, SECONDS, coarse, integrator="newmark"))
    table.limit = limit
    return table


def main() -> None:
    """Run four tables and plot one figure."""
    scenes = models()
    tables = {
        "time step, integrator, recursion (viscous)": time_steps(scenes["viscous"]),
        "Newton's tolerance (viscous, 0.05 s)": newton(scenes["viscous"]),
        "porous scheme (complete)": porous(scenes["complete"]),
        "explicit against implicit (hyperelastic)": explicit_or_implicit(scenes["hyperelastic"]),
    }
    fig, all_axes = plt.subplots(2, 2, figsize=(9, 7), layout="constrained")
    for axes, (title, table) in zip(all_axes.ravel(), tables.items(), strict=True):
        for (name, rows), colour in zip(table.series.items(), COLOURS, strict=False):
            shown = [r for r in rows if np.isfinite(r["error"]) and r["error"] < 10]
            axes.loglog([r["run_s"] for r in shown], [100 * r["error"] for r in shown], "o-", color=colour, label=name)
        axes.set(title=title, xlabel=f"run time of {SECONDS} s [s]", ylabel="error of positions [%]")
        plain_ticks(axes.xaxis)
        axes.legend(fontsize=7)
    content = {
        title: {
            name: [{k: (v if np.isfinite(v) else None) for k, v in r.items()} for r in rows]
            for name, rows in table.series.items()
        }
        for title, table in tables.items()
    }
    save("liver_choices", content | {"critical_step_s": tables["explicit against implicit (hyperelastic)"].limit}, fig)


if __name__ == "__main__":
    main()
