"""The chapter's comparison of 10, 9 and 6 frames per second, repeated with all models at equal error.

The liver phantom falls into its supports for 1.2 s. It is hyperelastic, viscous or complete (porous and viscous). For
each method, the time step is halved until the error is below the smallest of three targets. Then all runs are timed in
turn, on one core. The run time at a target is interpolated between two runs, linearly in the logarithms. The reference
of a model is its own motion with steps of 1.25 ms. So the errors contain those of the time step, of Newton's method, of
a reduced basis, and of a linear or corotational body. They do not contain the errors of the mesh and of the law.

The reduced models are trained with other weights and moduli than those of the timed run.

    python -m experiments equal_error

takes 40 minutes and writes results/equal_error.json after each model, and results/equal_error.png.
"""

import os

# The matrices have only tens of rows: threads of the BLAS cost more than they gain.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import json
import statistics
import time
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

import liverjax as lj
from experiments.benchmarks.baselines import corotational, critical_step, explicit, linear, precomputed
from experiments.benchmarks.reduced import drawn, one_core
from experiments.common import RESULTS, either, plain_ticks, plt, save
from experiments.liver import ONE_STEP, models, with_solve
from liverjax.core.plotting import COLOURS
from liverjax.core.struct import replace

SECONDS = 1.2
#: Times [s] at which positions are compared. The longest time step is the first of them.
COMPARED = 0.3 * np.arange(1, 5)
TARGETS = (0.2, 0.05, 0.01)
#: Numbers of time steps in 0.3 s.
DIVISIONS = either((1, 2, 4, 8, 16, 32, 64, 128), (2, 6))
FINE = either(240, 12)
#: Newton's tolerance where more than one iteration is made. It changes the motion by less than 1e-3.
LOOSE = {"tolerance": 1e-3}
NEWMARK = {"integrator": "newmark"}
#: Parameter ranges for the training of reduced models. The training runs do not contain the timed run (715 Pa and 2
#: m/s^2 along y).
RANGES = {"law.mu": (600.0, 850.0), "body.gravity": ((-0.4, 1.2, -0.4), (0.4, 2.2, 0.4))}
#: Training runs, largest number of modes, steps in 0.3 s, and error that the choice of integration points may cause.
ROWS, MODES, TRAINED, POINT_TOLERANCE = either((60, 60, 24, 5e-3), (6, 20, 6, 1e-1))
#: Fractions of the weight at which linear and corotational bodies are compared with the hyperelastic one.
WEIGHTS = either((1.0, 0.5, 0.2, 0.1, 0.05, 0.02), (1.0, 0.1))
ROUNDS = either(3, 1)


class Way(NamedTuple):
    """A method to run a model: `at` gives, for a time step [s], a function and its arguments.

    The function returns positions (T, V, 3) [m].
    """

    name: str
    at: Callable[[float], tuple[Callable, tuple]]
    divisions: tuple[int, ...] = DIVISIONS


class Timed(NamedTuple):
    """A compiled run and its error."""

    dt: float  # [s]
    error: float  # [1]
    program: Callable[[], jax.Array]


def implicit(scene: lj.Scene, **solve: Any) -> Callable[[float], tuple[Callable, tuple]]:
    """Return the method `at` for `simulate`, with some settings of the solver."""
    return lambda dt: (lambda s: lj.simulate(s).positions, (with_solve(scene, SECONDS, dt, **solve),))


def at_compared(x: Any) -> np.ndarray:
    """Return the positions at the times that are compared, from positions (T, V, 3) at equal time steps."""
    every = len(x) // len(COMPARED)
    return np.asarray(x)[every - 1 :: every]


def off(x: Any, truth: np.ndarray, scene: lj.Scene) -> float:
    """Return the largest distance of a node from the reference, divided by the largest displacement [1]."""
    apart = np.linalg.norm(at_compared(x) - truth, axis=-1).max()
    return float(apart / np.linalg.norm(truth - np.asarray(scene.mesh.points), axis=-1).max())


def compiled(way: Way, dt: float) -> Callable[[], jax.Array]:
    """Return the compiled run as a function without arguments."""
    function, arguments = way.at(dt)
    program = jax.jit(function).lower(*arguments).compile()
    return lambda: jax.block_until_ready(program(*arguments))


def searched(way: Way, truth: np.ndarray, scene: lj.Scene) -> list[Timed]:
    """Run with shorter and shorter steps until the error is below the smallest target."""
    runs: list[Timed] = []
    for n in way.divisions:
        program = compiled(way, COMPARED[0] / n)
        error = off(program(), truth, scene)
        runs.append(Timed(COMPARED[0] / n, error if np.isfinite(error) else float("inf"), program))
        print(f"    {way.name}: step {1e3 * runs[-1].dt:.3g} ms, error {100 * runs[-1].error:.3g} %", flush=True)
        if runs[-1].error <= min(TARGETS):
            break
    return runs


def reduced_way(scene: lj.Scene) -> tuple[Way, dict[str, Any]]:
    """Train a reduced model with Newmark runs. Return it as a method, with the cost of its training."""
    trained = with_solve(scene, SECONDS, COMPARED[0] / TRAINED, **NEWMARK, **LOOSE)
    begin = time.perf_counter()
    model = lj.reduce_scene(trained, drawn(ROWS, 0.0, 1, RANGES), 1e-5, MODES, POINT_TOLERANCE)
    took = {"training_s": time.perf_counter() - begin, "rows": ROWS, "modes": model.number_of_modes}

    def run(model: lj.ReducedModel, own: lj.Scene) -> jax.Array:
        found = lj.simulate_reduced(model, own)
        return lj.reduced_positions(model, own, found, corrected=False)

    def at(dt: float) -> tuple[Callable, tuple]:
        return run, (model, with_solve(scene, SECONDS, dt, **NEWMARK, **LOOSE))

    return Way("reduced, Newmark", at), took | {"points": len(model.points)}


def explicit_way(scene: lj.Scene) -> Way:
    """Central differences, with steps below the critical step of the body at rest."""
    limit = float(critical_step(replace(scene, viscosity=None)))

    def at(dt: float) -> tuple[Callable, tuple]:
        steps = round(SECONDS / dt)
        return lambda s: explicit(s, dt, steps, steps // len(COMPARED)), (scene,)

    stable = tuple(n for n in either((64, 128, 256, 384, 512), (128,)) if COMPARED[0] / n < limit)
    return Way("explicit, total Lagrangian", at, stable)


def linear_ways(scene: lj.Scene) -> dict[str, list[Way]]:
    """The linear body with a precomputed inverse, and the corotational one, grouped by their time integrator.

    With one linear solve per step, the corotational body is stable under implicit Euler only.
    """
    few = tuple(n for n in DIVISIONS if n <= 32)

    def by_inverse(dt: float) -> tuple[Callable, tuple]:
        own = with_solve(scene, SECONDS, dt, **NEWMARK)
        return lambda s, made: linear(s, made, dt, round(SECONDS / dt)), (own, precomputed(own, dt))

    def turned(integrator: str) -> Callable[[float], tuple[Callable, tuple]]:
        def at(dt: float) -> tuple[Callable, tuple]:
            own = with_solve(scene, SECONDS, dt, integrator=integrator)
            return lambda s: corotational(s, dt, round(SECONDS / dt)), (own,)

        return at

    return {
        "newmark": [
            Way("linear, precomputed inverse, Newmark", by_inverse, few),
            Way("corotational, Newmark", turned("newmark"), few),
        ],
        "euler": [Way("corotational, implicit Euler", turned("euler"), few)],
    }


def ways_of(name: str, scene: lj.Scene) -> tuple[list[Way], dict[str, Any]]:
    """Return all methods for a model, and how the reduced model was trained."""
    ways = [
        Way("implicit Euler, one iteration (the chapter's)", implicit(scene, **ONE_STEP)),
        Way("Newmark, one iteration", implicit(scene, **NEWMARK, **ONE_STEP)),
        Way("Newmark, Newton to 1e-3", implicit(scene, **NEWMARK, **LOOSE)),
    ]
    if scene.porosity is None:
        ways.append(explicit_way(scene))
    if name == "hyperelastic":
        ways += [way for own in linear_ways(scene).values() for way in own]
    own, made = reduced_way(scene)
    return [*ways, own], made


def in_turn(chosen: list[Timed]) -> list[float]:
    """Return the median run times [s] of some runs on one core. Each round contains all runs."""
    back = one_core()
    seconds: list[list[float]] = [[] for _ in chosen]
    for _ in range(ROUNDS):
        for run, own in zip(chosen, seconds, strict=True):
            begin = time.perf_counter()
            run.program()
            own.append(time.perf_counter() - begin)
    back()
    return [statistics.median(own) for own in seconds]


def one_model(name: str, scene: lj.Scene) -> dict[str, Any]:
    """Return the error and run time of every method for each time step, for one model."""
    exact = Way("truth", implicit(scene, **NEWMARK, tolerance=1e-6))
    fine, coarser = (at_compared(compiled(exact, COMPARED[0] / n)()) for n in (FINE, FINE // 2))
    content: dict[str, Any] = {"truth_halved": off(coarser, fine, scene)}
    print(name, content, flush=True)
    ways, content["reduced"] = ways_of(name, scene)
    found = [(way.name, run) for way in ways for run in searched(way, fine, scene)]
    took = in_turn([run for _, run in found])
    content["runs"] = [
        {"way": way, "dt": run.dt, "error": run.error if np.isfinite(run.error) else None, "run_s": seconds}
        for (way, run), seconds in zip(found, took, strict=True)
    ]
    return content


def model_errors(scene: lj.Scene) -> list[dict[str, float]]:
    """Compare linear and corotational bodies with the hyperelastic one, with equal steps and integrator, at each
    weight.
    """
    dt, rows = COMPARED[0] / either(32, 6), []
    for part in WEIGHTS:
        assert scene.body is not None
        lighter = replace(scene, body=replace(scene.body, gravity=part * jnp.asarray(scene.body.gravity)))
        row = {"weight": part}
        for integrator, ways in linear_ways(lighter).items():
            truth = at_compared(compiled(Way("", implicit(lighter, integrator=integrator, tolerance=1e-6)), dt)())
            row |= {way.name: off(compiled(way, dt)(), truth, scene) for way in ways}
        rows.append({name: value if np.isfinite(value) else None for name, value in row.items()})
        print(rows[-1], flush=True)
    return rows


def figure(content: dict[str, Any]) -> plt.Figure:
    """Plot error against run time per simulated second, with one panel for each model."""
    fig, panels = plt.subplots(1, 3, figsize=(12, 4.4), sharey=True, layout="constrained")
    names = list(dict.fromkeys(run["way"] for own in content["models"].values() for run in own["runs"]))
    for axes, (model, own) in zip(panels, content["models"].items(), strict=True):
        for k, way in enumerate(names):
            colour, style = COLOURS[k % len(COLOURS)], "o-" if k < len(COLOURS) else "s--"
            runs = [r for r in own["runs"] if r["way"] == way and r["error"] is not None and r["error"] < 2]
            if runs:
                seconds, errors = [r["run_s"] / SECONDS for r in runs], [100 * r["error"] for r in runs]
                axes.loglog(seconds, errors, style, ms=3, color=colour, label=way)
        axes.axvline(1.0, color="black", lw=0.8)
        axes.set(title=model, xlabel="run time of a simulated second [s], one core")
        plain_ticks(axes.xaxis, axes.yaxis)
    panels[0].set_ylabel("error of positions [%]")
    handles, labels = panels[0].get_legend_handles_labels()
    fig.legend(handles, labels, loc="outside lower center", ncols=3, fontsize=8)
    return fig


def main() -> None:
    """Run three models and write after each, then compare linear and corotational bodies at each weight. Results that
    an earlier run of the script has written are kept. Delete results/equal_error.json to run everything again.
    """
    file = RESULTS / "equal_error.json"
    content = json.loads(file.read_text()) if file.exists() else {"models": {}}
    content |= {"targets": TARGETS, "seconds": SECONDS}
    for name, scene in models().items():
        if name not in content["models"]:
            content["models"][name] = one_model(name, scene)
            save("equal_error", content)
    content["models"] = {name: content["models"][name] for name in models()}
    if "weights" not in content:
        content["weights"] = model_errors(models()["hyperelastic"])
    save("equal_error", content, figure(content))


if __name__ == "__main__":
    main()
