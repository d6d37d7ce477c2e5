"""Error against run time for the liver phantom: time step and integrator, recursion, Newton's tolerance, porous scheme,
explicit against implicit; and the mesh.

The error is the largest distance of a node from a fine run at 0.6, 1.2 and 1.8 s, relative to the largest displacement.
The fine run has the same mesh, but for the last question: there it has quadratic elements, and linear ones are compared
to it at the vertices, so their error is that of the mesh and of the step.

    python -m experiments liver_choices

``python -m experiments.benchmarks.liver_choices mesh`` answers the last question again.
"""

import json
import sys
import time

import jax
import numpy as np

from experiments.benchmarks.baselines import corotational, critical_step, explicit
from experiments.common import RESULTS, either, plain_ticks, plt, save
from experiments.liver import ONE_STEP, error, models, timed_run, with_solve
from liverjax.core.plotting import COLOURS
from liverjax.core.struct import replace
from liverjax.scenes.enriched import enriched

SECONDS, AT = either((1.8, (0.6, 1.2, 1.8)), (0.6, (0.6,)))


class Table:
    """Rows of one question, with the fine run they are compared to."""

    def __init__(self, scene, fine):
        self.scene, self.fine, self.series = scene, fine, {}

    def add(self, name, scene, rounds=2):
        """One more run."""
        result, row = timed_run(scene, rounds)
        off = error(result.times, result.positions[:, : self.fine[1].shape[1]], *self.fine, AT)
        self.series.setdefault(name, []).append({"error": off} | row)
        print(name, {k: round(v, 5) for k, v in self.series[name][-1].items()}, flush=True)


def fine_run(scene, dt):
    """Newmark with small steps."""
    result, _ = timed_run(with_solve(scene, SECONDS, dt, integrator="newmark", tolerance=1e-8), rounds=1)
    return np.asarray(result.times), np.asarray(result.positions)


def time_steps(scene) -> Table:
    """Viscous: implicit Euler and Newmark, and the chapter's recursion."""
    table = Table(scene, fine_run(scene, either(0.0025, 0.01)))
    chapter = replace(scene, viscosity=replace(scene.viscosity, scheme="chapter"))
    for dt in either((0.3, 0.15, 0.05, 0.02, 0.01), (0.05,)):
        table.add("implicit Euler", with_solve(scene, SECONDS, dt))
        table.add("Newmark", with_solve(scene, SECONDS, dt, integrator="newmark"))
        if dt < 0.3:
            table.add("Newmark, chapter's recursion", with_solve(chapter, SECONDS, dt, integrator="newmark"))
    return table


def newton(scene) -> Table:
    """Against the same time step solved to 1e-10."""
    exact, _ = timed_run(with_solve(scene, SECONDS, 0.05, tolerance=1e-10), rounds=1)
    table = Table(scene, (np.asarray(exact.times), np.asarray(exact.positions)))
    for tolerance in either((1e-2, 1e-4, 1e-6, 1e-8), (1e-2,)):
        table.add("to a tolerance", with_solve(scene, SECONDS, 0.05, tolerance=tolerance))
    table.add("one iteration", with_solve(scene, SECONDS, 0.05, **ONE_STEP))
    return table


def porous(scene) -> Table:
    """Complete: the implicit pressure and the chapter's."""
    table = Table(scene, fine_run(scene, either(0.005, 0.02)))
    chapter = replace(scene, porosity=replace(scene.porosity, scheme="chapter"))
    for dt in either((0.15, 0.05, 0.02), (0.05,)):
        table.add("implicit", with_solve(scene, SECONDS, dt))
        table.add("chapter's", with_solve(chapter, SECONDS, dt))
    return table


def explicit_or_implicit(scene) -> Table:
    """Hyperelastic: total Lagrangian explicit at 0.9 of its critical step, corotational, and `simulate`."""
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


def meshes(scene) -> Table:
    """Viscous, Newmark: linear and quadratic elements on the phantom's tetrahedra, against quadratic ones."""
    vertices, rich = scene.mesh.number_of_vertices, enriched(scene)
    times, x = fine_run(rich, either(0.01, 0.05))
    table = Table(scene, (times, x[:, :vertices]))
    for dt in either((0.05, 0.02), (0.1,)):
        for name, own in (("linear elements", scene), ("quadratic elements", rich)):
            table.add(name, with_solve(own, SECONDS, dt, integrator="newmark"), rounds=1)
    return table


QUESTIONS = {
    "time step, integrator, recursion (viscous)": (time_steps, "viscous"),
    "Newton's tolerance (viscous, 0.05 s)": (newton, "viscous"),
    "porous scheme (complete)": (porous, "complete"),
    "explicit against implicit (hyperelastic)": (explicit_or_implicit, "hyperelastic"),
}
MESH = "mesh (viscous, Newmark)"


def main(wanted: list[str]) -> None:
    """Five questions, one figure."""
    scenes, content = models(), {}
    if wanted == ["mesh"]:
        content = json.loads((RESULTS / "liver_choices.json").read_text())
    else:
        for title, (question, model) in QUESTIONS.items():
            table = question(scenes[model])
            content[title] = _finite(table)
            if hasattr(table, "limit"):
                content["critical_step_s"] = table.limit
    content[MESH] = _finite(meshes(scenes["viscous"]))
    save("liver_choices", content, _figure(content))


def _finite(table: Table) -> dict[str, list[dict]]:
    """The rows, without numbers that JSON has not."""
    return {
        name: [{k: (v if np.isfinite(v) else None) for k, v in r.items()} for r in rows]
        for name, rows in table.series.items()
    }


def _figure(content: dict) -> plt.Figure:
    """Error against run time, a panel a question."""
    fig, all_axes = plt.subplots(2, 3, figsize=(12, 7), layout="constrained")
    for axes, title in zip(all_axes.ravel(), (*QUESTIONS, MESH), strict=False):
        for (name, rows), colour in zip(content[title].items(), COLOURS, strict=False):
            shown = [r for r in rows if r["error"] is not None and r["error"] < 10]
            axes.loglog([r["run_s"] for r in shown], [100 * r["error"] for r in shown], "o-", color=colour, label=name)
        axes.set(title=title, xlabel=f"run time of {SECONDS} s [s]", ylabel="error of positions [%]")
        plain_ticks(axes.xaxis)
        axes.legend(fontsize=7)
    all_axes[1, 2].set_visible(False)
    return fig


if __name__ == "__main__":
    main([a for a in sys.argv[1:] if not a.startswith("-")])
