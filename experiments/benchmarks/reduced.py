"""A reduced model of the viscous liver phantom: error, stated error, and run time, compared with the full model.

Free parameters are gravity, a load on a patch of the tip, the modulus, one ratio and one relaxation time. Most training
runs have parameters drawn at random in a box. The others are at corners of the box, where a first model stated the
largest errors. The test runs are drawn in a box 10 % wider. The reference is the full model on the same mesh, so no
error contains the mesh error. The run times are those of one core, without compilation.

Modulus, ratio and time are identified with the reduced model from five full test runs. For each of them, one more full
run gives an estimate of the bias.

``python -m experiments reduced`` (18 minutes) writes results/reduced.json.
"""

import argparse
import itertools
import os

# With matrices of 80 x 80, threads of the BLAS cost more than they gain.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import sys
import time
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

import liverjax as lj
from experiments.common import either, save, timed
from experiments.liver import models, with_solve
from liverjax.core.struct import replace
from liverjax.mesh.selection import boundary_triangles

SECONDS, DT = 1.2, 0.05
MM = 1e-3
#: Number of test runs.
UNSEEN = either(200, 6)
#: Number of test runs for which the error on the full mesh is computed too.
MESH_CHECKS = either(20, 1)
#: Newton's tolerance of the reduced runs; that of the full runs is 1e-6. It changes the result by at most 1e-4.
REDUCED_TOLERANCE = 1e-3
#: Number of test runs from which parameters are identified, and names of these parameters.
IDENTIFIED = either(5, 1)
NAMES = ("law.mu", "viscosity.ratios.0", "viscosity.relaxation_times.0")
#: Error, relative to the largest displacement, above which the full model would be run.
TOLERANCE = 0.01
#: Lowest and highest value of each parameter in the training runs.
RANGES = {
    "law.mu": (600.0, 900.0),
    "viscosity.ratios.0": (0.2, 0.3),
    "viscosity.relaxation_times.0": (0.2, 0.35),
    "body.gravity": ((-0.4, 0.4, -0.4), (0.4, 1.6, 0.4)),
    "traction.0.value": ((-60.0, -60.0, -60.0), (60.0, 60.0, 60.0)),
}


#: Corners of these ranges (of 512, in the order of `itertools.product`). For 72 of them, a model trained with the drawn
#: runs stated the largest errors; 8 are others.
CORNERS = (
    128,
    178,
    130,
    144,
    192,
    0,
    242,
    16,
    194,
    50,
    64,
    208,
    2,
    153,
    146,
    18,
    80,
    82,
    66,
    114,
    210,
    136,
    217,
    139,
    155,
    182,
    384,
    25,
    137,
    134,
    203,
    200,
    27,
    219,
    150,
    183,
    11,
    448,
    402,
    256,
    129,
    91,
    89,
    160,
    187,
    193,
    179,
    75,
    22,
    201,
    8,
    181,
    320,
    214,
    246,
    198,
    386,
    400,
    1,
    54,
    154,
    274,
    466,
    26,
    86,
    224,
    72,
    186,
    65,
    218,
    245,
    147,
    21,
    42,
    63,
    84,
    105,
    126,
    168,
    189,
)


def pulled_phantom() -> lj.Scene:
    """The viscous phantom with a load on a patch at its tip, 1.2 s in steps of 0.05 s."""
    scene = with_solve(models()["viscous"], SECONDS, DT)
    X = np.asarray(scene.mesh.points)
    held = np.concatenate([np.asarray(f.nodes) for f in scene.fixed])
    tip = np.linalg.norm(X[:, None] - X[held][None], axis=-1).min(axis=1).argmax()
    faces = np.asarray(boundary_triangles(scene.mesh))
    near = faces[np.linalg.norm(X[faces].mean(axis=1) - X[tip], axis=1) < 0.03]
    load = lj.Traction(triangles=jnp.asarray(near), value=jnp.zeros(3))
    return replace(scene, traction=(load,))


def ends(ranges: dict = RANGES) -> tuple[np.ndarray, np.ndarray]:
    """Return the lowest and the highest values of all n numbers, each (n,)."""
    low, high = zip(*ranges.values(), strict=True)
    return np.concatenate([np.ravel(a) for a in low]), np.concatenate([np.ravel(b) for b in high])


def named(unit: np.ndarray, ranges: dict = RANGES) -> dict[str, np.ndarray]:
    """Return parameter sets by name, from positions (N, n) between 0 and 1 in the ranges."""
    low, high = ends(ranges)
    table, rows, k = low + unit * (high - low), {}, 0
    for name, (a, _) in ranges.items():
        n = np.size(a)
        rows[name] = table[:, k : k + n] if n > 1 else table[:, k]
        k += n
    return rows


def drawn(count: int, wider: float, seed: int, ranges: dict = RANGES) -> dict[str, np.ndarray]:
    """Return parameter sets from a Latin hypercube in the ranges, which are widened by a fraction about their
    middles.
    """
    from scipy.stats import qmc

    places = qmc.LatinHypercube(len(ends(ranges)[0]), seed=seed).random(count)
    return named(0.5 + (1 + wider) * (places - 0.5), ranges)


def with_corners(count: int, corners: Any, ranges: dict = RANGES) -> dict[str, np.ndarray]:
    """Return parameter sets from a Latin hypercube, followed by those of some corners of the ranges, given by
    number.
    """
    every = np.array(list(itertools.product((0.0, 1.0), repeat=len(ends(ranges)[0]))))
    more = named(every[np.asarray(corners, int)], ranges)
    return {name: np.concatenate([rows, more[name]]) for name, rows in drawn(count, 0.0, 1, ranges).items()}


def row_of(rows: dict[str, np.ndarray], k: int) -> dict[str, Any]:
    """Return the parameters of run k."""
    return {name: jnp.asarray(value[k]) for name, value in rows.items()}


def one_core() -> Callable[[], None]:
    """Put all threads of this process on one core, where the system supports it. The returned function undoes this."""
    if not hasattr(os, "sched_setaffinity"):
        return lambda: None
    before = os.sched_getaffinity(0)

    def put(cores: set[int]) -> None:
        for thread in os.listdir("/proc/self/task"):
            os.sched_setaffinity(int(thread), cores)

    put({max(before)})
    return lambda: put(before)


def truths(scene: lj.Scene, rows: dict) -> list[np.ndarray | None]:
    """Return positions (T, V, 3) [m] of full runs, one for each parameter set; None where a step failed."""
    found = []
    for k in range(len(rows["law.mu"])):
        full = lj.simulate(lj.with_parameters(scene, row_of(rows, k)))
        found.append(None if np.any(full.status) else np.asarray(full.positions))
    return found


def loosely(scene: lj.Scene) -> lj.Scene:
    """Return the scene with Newton's tolerance of the reduced runs."""
    return replace(scene, solve=replace(scene.solve, tolerance=REDUCED_TOLERANCE))


def farthest(u: Any) -> float:
    """Return the largest length of vectors (..., 3), in mm."""
    return float(np.linalg.norm(np.asarray(u), axis=-1).max()) / MM


def unseen(scene: lj.Scene, model: lj.ReducedModel, rows: dict) -> dict[str, Any]:
    """Return true and stated errors of runs with all parameter sets, with and without the correction."""
    found, mesh = [], []
    for k, full in enumerate(truths(scene, rows)):
        if full is None:
            continue
        own = loosely(lj.with_parameters(scene, row_of(rows, k)))
        reduced = lj.simulate_reduced(model, own)
        with_and_without = (True, False)
        true = [farthest(lj.reduced_positions(model, own, reduced, c) - full) for c in with_and_without]
        stated = [float(np.max(lj.stated_error(model, own, reduced, c))) / MM for c in with_and_without]
        found.append((*true, *stated, farthest(full - own.mesh.points), np.any(reduced.status)))
        if k < MESH_CHECKS:
            mesh.append(float(np.max(lj.reduced_error(model, own, reduced).error)) / MM / true[0])
    whole = np.array(found, float)
    good = np.isfinite(whole).all(axis=1) & (whole[:, 5] == 0)
    true, without, stated, change, moved, _ = whole[good].T
    row: dict[str, Any] = {"runs": len(whole), "failed": len(whole) - len(true)}
    row |= {"largest_displacement_mm": float(moved.max())}
    row |= {f"relative_{k}": v for k, v in summary(true / moved).items()}
    row |= {"within_half_percent": float(np.mean(true / moved <= 0.005))}
    row |= {f"uncorrected_{k}": v for k, v in summary(without / moved).items()}
    row |= {"uncorrected_within_half_percent": float(np.mean(without / moved <= 0.005))}
    row |= ratios(stated / true)
    row |= {f"change_{k}": v for k, v in ratios(change / without).items()}
    kept = stated / moved <= TOLERANCE
    row |= {"kept": int(kept.sum()), "kept_largest": float((true / moved)[kept].max()) if kept.any() else 0.0}
    row |= {"mesh_ratios": mesh, "relative": (true / moved).tolist(), "effectivity": (stated / true).tolist()}
    return row


def summary(errors: np.ndarray) -> dict[str, Any]:
    """Return median, 95 % quantile and maximum."""
    return {"median": float(np.median(errors)), "95": float(np.quantile(errors, 0.95)), "largest": float(errors.max())}


def ratios(found: np.ndarray) -> dict[str, Any]:
    """Summarise the ratios of stated to true errors."""
    return {
        "effectivity_median": float(np.median(found)),
        "effectivity_range": [float(found.min()), float(found.max())],
        "within_factor_2": float(np.mean((found > 0.5) & (found < 2))),
        "above_true": float(np.mean(found >= 1)),
    }


def tip_of(scene: lj.Scene, names: Iterable[str]) -> Callable[[list, lj.ReducedModel], jax.Array]:
    """Return a function for gradients: the sum of squares of the last coordinates, as a function of some parameters.

    The model is an argument of the function, because XLA evaluates constants of a closure during compilation.
    """

    def tip(values: list, model: lj.ReducedModel) -> jax.Array:
        own = lj.with_parameters(scene, dict(zip(names, values, strict=True)))
        return jnp.sum(lj.simulate_reduced(model, own).coordinates[-1] ** 2)

    return tip


def answer(scene: lj.Scene, model: lj.ReducedModel, corrected: bool = True) -> tuple[jax.Array, jax.Array]:
    """Return the motion of all nodes, and its stated error."""
    found = lj.simulate_reduced(model, scene)
    return lj.reduced_positions(model, scene, found, corrected), lj.stated_error(model, scene, found, corrected)


def times(scene: lj.Scene, model: lj.ReducedModel) -> dict[str, Any]:
    """Return milliseconds per step on one core: reduced run, its gradient, 64 runs at once, and the full run."""
    back, steps, small = one_core(), scene.solve.steps, loosely(scene)
    start = [jnp.asarray(v, float) for v in (715.0, 0.235, 0.27)]

    tip = tip_of(small, NAMES)
    lanes = [jnp.linspace(0.9, 1.1, 64) * v for v in start]
    result, run = timed(lambda s, model: lj.simulate_reduced(model, s), small, model, rounds=9)
    _, whole = timed(answer, small, model, rounds=9)
    _, plain = timed(tip, start, model, rounds=9)
    _, gradient = timed(jax.value_and_grad(tip), start, model, rounds=9)
    _, many = timed(jax.vmap(tip, in_axes=(0, None)), lanes, model, rounds=3)
    _, full = timed(lj.simulate, scene, rounds=2)
    back()
    return {
        "step_ms": 1e3 * run.run / steps,
        "answer_ms": 1e3 * whole.run / steps,
        "compile_s": run.compile,
        "iterations_per_step": float(np.mean(np.asarray(result.iterations))),
        "gradient_over_run": gradient.run / plain.run,
        "step_of_64_ms": 1e3 * many.run / steps / 64,
        "full_step_ms": 1e3 * full.run / steps,
    }


def identified(scene: lj.Scene, model: lj.ReducedModel, rows: dict) -> dict[str, Any]:
    """Return errors of parameters identified with the reduced model, before and after subtraction of the stated
    bias.
    """
    from scipy.optimize import least_squares

    low, high = (np.array([RANGES[name][k] for name in NAMES]) for k in (0, 1))
    middle = 0.5 * (low + high)
    size = jnp.asarray(middle)

    def seen(x: jax.Array) -> jax.Array:
        return x[:, ::40]

    def answer(parts: jax.Array, own: lj.Scene) -> jax.Array:
        own = loosely(lj.with_parameters(own, dict(zip(NAMES, parts * size, strict=True))))
        return jnp.ravel(seen(lj.reduced_positions(model, own, lj.simulate_reduced(model, own))))

    value, slope = jax.jit(answer), jax.jit(jax.jacfwd(answer))
    found = []
    for k in range(IDENTIFIED):
        own = lj.with_parameters(scene, row_of(rows, k))
        data = np.ravel(seen(lj.simulate(own).check().positions))
        best = least_squares(
            lambda p, own, data: np.asarray(value(jnp.asarray(p), own)) - data,
            np.ones(3),
            jac=lambda p, own, data: np.asarray(slope(jnp.asarray(p), own)),
            args=(own, data),
        )
        numbers, true = best.x * middle, np.array([rows[name][k] for name in NAMES])
        bias = lj.reduced_bias(model, own, dict(zip(NAMES, numbers, strict=True)), seen)
        stated = np.array([float(bias[name]) for name in NAMES])
        found.append([numbers / true - 1, (numbers - stated) / true - 1, [best.nfev] * 3])
    before, after, calls = np.moveaxis(np.array(found), 1, 0)
    return {
        "identified": list(NAMES),
        "identified_error": np.abs(before).max(axis=0).tolist(),
        "identified_error_without_bias": np.abs(after).max(axis=0).tolist(),
        "identified_runs": int(calls.max()),
    }


def trained(
    scene: lj.Scene, drawn_rows: int, corners: Any, modes: int, tolerance: float
) -> tuple[lj.ReducedModel, dict[str, Any]]:
    """Train a model with drawn parameter sets and corners. Return the model and the cost of training."""
    rows, begin, cpu = with_corners(drawn_rows, corners), time.perf_counter(), time.process_time()
    model = lj.reduce_scene(scene, rows, 1e-5, modes, tolerance)
    took = {"training_s": time.perf_counter() - begin, "training_cpu_s": time.process_time() - cpu}
    size = {"modes": model.number_of_modes, "points": len(model.points), "of_points": scene.mesh.weights.size}
    return model, {"rows": len(rows["law.mu"])} | took | size


def main() -> None:
    """Run all parts, and write the results after each model."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("--keep", type=Path, help="file for the model, as `accelerator.py` takes it")
    parser.add_argument("--quick", action="store_true", help="fewer runs")
    options = parser.parse_args()
    scene, rows = pulled_phantom(), drawn(UNSEEN, 0.1, 2)
    content: dict[str, Any] = {"elements": scene.mesh.number_of_elements, "order": scene.mesh.order, "models": []}
    for count, corners, modes, tolerance in either(((840, CORNERS, 80, 5e-3),), ((6, CORNERS[:2], 40, 1e-1),)):
        model, row = trained(scene, count, corners, modes, tolerance)
        print(row, flush=True)
        if options.keep is not None:
            lj.save_reduced(model, options.keep)
        example = lj.with_parameters(scene, row_of(rows, 0))
        row |= times(example, model)
        print(row, flush=True)
        row |= unseen(scene, model, rows) | identified(scene, model, rows)
        print({k: v for k, v in row.items() if not isinstance(v, list) or len(v) == 2}, flush=True)
        content["models"].append(row)
        save("reduced", content)


if __name__ == "__main__":
    sys.path.insert(0, str(Path(__file__).parents[2]))
    main()
