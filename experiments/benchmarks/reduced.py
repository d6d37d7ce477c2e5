"""A reduced model of the viscous liver phantom: error, stated error, and run time, beside the full model.

Gravity, a pull on a patch of the tip, the modulus, one ratio and one relaxation time are free. The training rows are
drawn in a box of them, the unseen runs in a box 10 % wider. The full model on the same mesh is the truth: what the
mesh leaves out is in neither. The tables give one core's times, compilation apart.

``python -m experiments reduced`` (20 minutes) writes results/reduced.json.
"""

import os

# Matrices of 40 x 40: threads of the BLAS cost more than they do.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

import liverjax as lj
from experiments.benchmarks.baselines import corotational, explicit
from experiments.common import either, save, timed
from experiments.liver import models, with_solve
from liverjax.core.struct import replace
from liverjax.mesh.selection import boundary_triangles

SECONDS, DT = 1.2, 0.05
MM = 1e-3
#: Number of unseen runs.
UNSEEN = either(200, 6)
#: Lowest and highest number of the training rows.
RANGES = {
    "law.mu": (600.0, 900.0),
    "viscosity.ratios.0": (0.2, 0.3),
    "viscosity.relaxation_times.0": (0.2, 0.35),
    "body.gravity": ((-0.4, 0.4, -0.4), (0.4, 1.6, 0.4)),
    "traction.0.value": ((-60.0, -60.0, -60.0), (60.0, 60.0, 60.0)),
}


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


def drawn(count: int, wider: float, seed: int) -> dict[str, np.ndarray]:
    """Rows of all numbers: a Latin hypercube in the ranges, stretched by a part about their middles."""
    from scipy.stats import qmc

    low = np.concatenate([np.ravel(a) for a, _ in RANGES.values()])
    high = np.concatenate([np.ravel(b) for _, b in RANGES.values()])
    unit = 0.5 + (1 + wider) * (qmc.LatinHypercube(len(low), seed=seed).random(count) - 0.5)
    table, rows, k = low + unit * (high - low), {}, 0
    for name, (a, _) in RANGES.items():
        n = np.size(a)
        rows[name] = table[:, k : k + n] if n > 1 else table[:, k]
        k += n
    return rows


def row_of(rows: dict[str, np.ndarray], k: int) -> dict[str, Any]:
    """The numbers of one run."""
    return {name: jnp.asarray(value[k]) for name, value in rows.items()}


def one_core() -> Callable[[], None]:
    """Put all threads of this process on one core, where the system can; the function puts them back."""
    if not hasattr(os, "sched_setaffinity"):
        return lambda: None
    before = os.sched_getaffinity(0)

    def put(cores: set[int]) -> None:
        for thread in os.listdir("/proc/self/task"):
            os.sched_setaffinity(int(thread), cores)

    put({max(before)})
    return lambda: put(before)


def unseen(scene: lj.Scene, model: lj.ReducedModel, rows: dict) -> dict[str, Any]:
    """True and stated errors [mm] of runs with the rows."""
    found = []
    for k in range(len(rows["law.mu"])):
        own = lj.with_parameters(scene, row_of(rows, k))
        full = lj.simulate(own)
        if np.any(full.status):
            continue
        reduced = lj.reduced_error(model, own, lj.simulate_reduced(model, own))
        x = lj.reduced_positions(model, own, reduced)
        true = np.linalg.norm(np.asarray(x - full.positions), axis=-1).max()
        moved = np.linalg.norm(np.asarray(full.positions - own.mesh.points), axis=-1).max()
        failed = bool(np.any(reduced.status))
        found.append((true / MM, float(np.max(reduced.error)) / MM, moved / MM, failed))
    whole = np.array(found, float)
    # Where a step failed, or its error could not be estimated, the full model would run.
    good = np.isfinite(whole).all(axis=1) & (whole[:, 3] == 0)
    true, stated, moved, _ = whole[good].T
    ratio = stated / true
    return {
        "runs": len(whole),
        "failed": len(whole) - len(true),
        "relative": (true / moved).tolist(),
        "effectivity": ratio.tolist(),
        "relative_median": float(np.median(true / moved)),
        "relative_95": float(np.quantile(true / moved, 0.95)),
        "relative_largest": float((true / moved).max()),
        "largest_displacement_mm": float(moved.max()),
        "effectivity_median": float(np.median(ratio)),
        "effectivity_range": [float(ratio.min()), float(ratio.max())],
        "within_factor_2": float(np.mean((ratio > 0.5) & (ratio < 2))),
    }


def times(scene: lj.Scene, model: lj.ReducedModel) -> dict[str, Any]:
    """Milliseconds a step on one core: reduced run, its gradient, 64 at once, and the full run."""
    back, steps = one_core(), scene.solve.steps
    names = ["law.mu", "viscosity.ratios.0", "viscosity.relaxation_times.0"]
    start = [jnp.asarray(v, float) for v in (715.0, 0.235, 0.27)]

    def tip(values: list) -> jax.Array:
        own = lj.with_parameters(scene, dict(zip(names, values, strict=True)))
        return jnp.sum(lj.simulate_reduced(model, own).coordinates[-1] ** 2)

    lanes = [jnp.linspace(0.9, 1.1, 64) * v for v in start]
    result, run = timed(lambda s: lj.simulate_reduced(model, s), scene, rounds=9)
    _, plain = timed(tip, start, rounds=9)
    _, gradient = timed(jax.value_and_grad(tip), start, rounds=9)
    _, many = timed(jax.vmap(tip), lanes, rounds=3)
    _, full = timed(lj.simulate, scene, rounds=2)
    back()
    return {
        "step_ms": 1e3 * run.run / steps,
        "compile_s": run.compile,
        "iterations_per_step": float(np.mean(np.asarray(result.iterations))),
        "gradient_over_run": gradient.run / plain.run,
        "step_of_64_ms": 1e3 * many.run / steps / 64,
        "full_step_ms": 1e3 * full.run / steps,
    }


def baselines(model: lj.ReducedModel, scene: lj.Scene) -> list[dict[str, Any]]:
    """Every model that the chapter names, in the viscous phantom's place: error [1] and time a step [ms], one core.

    The load is the weight alone. Linear and corotational bodies and the explicit run have no viscosity.
    """
    plain = replace(scene, traction=(replace(scene.traction[0], value=jnp.zeros(3)),))
    elastic = replace(plain, viscosity=None)
    back = one_core()
    full, _ = timed(lj.simulate, plain, rounds=1)
    hyper, hyper_time = timed(lj.simulate, elastic, rounds=1)
    step = 0.001
    keep, fine = round(DT / step), round(SECONDS / step)
    rivals = {
        "explicit, total Lagrangian, elastic": timed(lambda s: explicit(s, step, fine, keep), elastic, rounds=1),
        "corotational, elastic": timed(lambda s: corotational(s, DT, s.solve.steps), elastic, rounds=1),
        "linear, precomputed inverse": _precomputed(elastic),
    }
    small, small_time = timed(lambda s: lj.simulate_reduced(model, s), plain, rounds=5)
    back()
    rivals["hyperelastic, full"] = (hyper.positions, hyper_time)
    rivals["viscous, reduced"] = (lj.reduced_positions(model, plain, small), small_time)
    rest = np.asarray(plain.mesh.points)
    moved = np.linalg.norm(np.asarray(full.positions) - rest, axis=-1).max()
    found = []
    for name, (x, took) in rivals.items():
        error = np.linalg.norm(np.asarray(x) - np.asarray(full.positions), axis=-1).max() / moved
        own = np.linalg.norm(np.asarray(x) - np.asarray(hyper.positions), axis=-1).max() / moved
        ms = 1e3 * took.run / scene.solve.steps
        found.append({"model": name, "error": float(error), "error_to_hyperelastic": float(own), "step_ms": ms})
    return found


def _precomputed(scene: lj.Scene) -> tuple[jax.Array, Any]:
    """Implicit Euler of the linear body: one product with the inverse of (M / dt^2 + K) a step."""
    from liverjax.elements import mjed
    from liverjax.mesh.nodal import nodal_volumes

    mesh = scene.mesh
    free = np.setdiff1d(np.arange(mesh.number_of_nodes), np.concatenate([np.asarray(f.nodes) for f in scene.fixed]))
    free = (3 * free[:, None] + np.arange(3)).ravel()
    K = mjed.stiffness_matrix(mesh, scene.law, mesh.points)[free][:, free].toarray()
    assert scene.body is not None
    mass = np.repeat(np.asarray(scene.body.density * nodal_volumes(mesh)), 3)[free]
    weight = jnp.asarray(mass * np.tile(np.asarray(scene.body.gravity), mesh.number_of_nodes)[free])
    inverse, m = jnp.asarray(np.linalg.inv(K + np.diag(mass / DT**2))), jnp.asarray(mass / DT**2)

    def run(inverse: jax.Array) -> jax.Array:
        def advance(state: tuple, _: None) -> tuple:
            u, before = state
            new = inverse @ (weight + m * (2 * u - before))
            return (new, u), new

        return jax.lax.scan(advance, (jnp.zeros(len(free)), jnp.zeros(len(free))), length=scene.solve.steps)[1]

    u, took = timed(run, inverse, rounds=3)
    whole = jnp.zeros((len(u), mesh.points.size)).at[:, free].set(u)
    return mesh.points + whole.reshape(len(u), -1, 3), took


def trained(scene: lj.Scene, count: int, modes: int, tolerance: float) -> tuple[lj.ReducedModel, dict[str, Any]]:
    """A model from `count` rows, and what it took."""
    begin = time.perf_counter()
    model = lj.reduce_scene(scene, drawn(count, 0.0, 1), 1e-5, modes, tolerance)
    seconds = time.perf_counter() - begin
    size = {"modes": model.number_of_modes, "points": len(model.points), "of_points": scene.mesh.weights.size}
    return model, {"rows": count, "training_s": seconds} | size


def main() -> None:
    """All of it, written after each model."""
    scene, rows = pulled_phantom(), drawn(UNSEEN, 0.1, 2)
    content: dict[str, Any] = {"elements": scene.mesh.number_of_elements, "order": scene.mesh.order, "models": []}
    for count, modes, tolerance in either(((160, 40, 3e-3),), ((3, 5, 1e-1),)):
        model, row = trained(scene, count, modes, tolerance)
        print(row, flush=True)
        example = lj.with_parameters(scene, row_of(rows, 0))
        row |= times(example, model)
        print(row, flush=True)
        row |= unseen(scene, model, rows)
        print({k: v for k, v in row.items() if not isinstance(v, list) or len(v) == 2}, flush=True)
        content["models"].append(row)
        save("reduced", content)
    content["rivals"] = baselines(model, scene)
    print(content["rivals"], flush=True)
    save("reduced", content)


if __name__ == "__main__":
    sys.path.insert(0, str(Path(__file__).parents[2]))
    main()
