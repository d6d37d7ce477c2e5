"""The liver phantom at rest as a function of three parameters: separated form, reduced basis and full model.

Modulus, bulk modulus and weight are free. The test runs are drawn in the same box. The reference is the full model on
the same mesh, so no number here contains the mesh error. Times are those of one core, without compilation.

``python -m experiments separated`` writes results/separated.json.
"""

import time
from typing import Any

import jax.numpy as jnp
import numpy as np

import liverjax as lj
from experiments.benchmarks.reduced import one_core
from experiments.common import either, save, timed
from experiments.liver import models
from liverjax.core.struct import replace

RANGES = {"law.mu": (600.0, 900.0), "law.bulk": (1800.0, 2600.0), "body.gravity.1": (0.2, 1.6)}
CHECKS = either(20, 2)


def phantom() -> lj.Scene:
    """The hyperelastic phantom with its weight in two load steps."""
    return replace(models()["hyperelastic"], solve=lj.Solve(steps=2))


def unseen(scene: lj.Scene) -> tuple[dict[str, np.ndarray], np.ndarray]:
    """Return parameter sets for tests, and the displacements (k, V, 3) [m] of the full model for them."""
    rng = np.random.default_rng(7)
    rows = {name: rng.uniform(*limits, CHECKS) for name, limits in RANGES.items()}
    result = lj.simulate_batch(scene, rows).result
    assert not np.any(np.asarray(result.status))
    return rows, np.asarray(result.positions[:, -1] - scene.mesh.points)


def errors(u: np.ndarray, exact: np.ndarray) -> dict[str, float]:
    """Return the largest error of a node divided by the largest displacement, for each run."""
    off = np.linalg.norm(u - exact, axis=-1).max(axis=1) / np.linalg.norm(exact, axis=-1).max(axis=1)
    return {"error_median": float(np.median(off)), "error_largest": float(off.max())}


def at(rows: dict[str, np.ndarray], k: int) -> dict[str, Any]:
    """Return the parameters of run k."""
    return {name: jnp.asarray(value[k]) for name, value in rows.items()}


def separated(scene: lj.Scene, points: int, rows: dict, exact: np.ndarray) -> dict[str, Any]:
    """Build and test a separated form with `points` grid points for each parameter."""
    begin = time.perf_counter()
    model = lj.separate(scene, RANGES, points=points, tolerance=1e-5, most_terms=100)
    training = time.perf_counter() - begin
    u = np.stack([lj.separated_displacement(model, at(rows, k)) for k in range(CHECKS)])
    _, took = timed(lambda values: lj.separated_displacement(model, values), at(rows, 0), rounds=99)
    return {
        "model": "separated",
        "runs": points ** len(RANGES) + 8,
        "terms": len(model.fields),
        "training_s": training,
        "answer_us": 1e6 * took.run,
        "stated_largest": float(model.error.max()),
        **errors(u, exact),
    }


def basis(scene: lj.Scene, runs: int, rows: dict, exact: np.ndarray) -> dict[str, Any]:
    """Build and test a reduced basis from `runs` full runs."""
    from scipy.stats import qmc

    limits = np.array(list(RANGES.values()))
    table = limits[:, 0] + qmc.LatinHypercube(len(limits), seed=1).random(runs) * np.ptp(limits, axis=1)
    begin = time.perf_counter()
    model = lj.reduce_scene(scene, {name: table[:, k] for k, name in enumerate(RANGES)}, 1e-5, 40, 1e-4)
    training = time.perf_counter() - begin

    def answer(values: dict[str, Any]) -> Any:
        own = lj.with_parameters(scene, values)
        return lj.reduced_positions(model, own, lj.simulate_reduced(model, own))[-1] - own.mesh.points

    u = np.stack([answer(at(rows, k)) for k in range(CHECKS)])
    _, took = timed(answer, at(rows, 0), rounds=9)
    row = {"model": "reduced basis", "runs": runs, "terms": model.number_of_modes, "training_s": training}
    return row | {"answer_us": 1e6 * took.run, "stated_largest": None, **errors(u, exact)}


def main() -> None:
    """Build the models and compare them."""
    back, scene = one_core(), phantom()
    rows, exact = unseen(scene)
    _, full = timed(lambda values: lj.simulate(lj.with_parameters(scene, values)).positions, at(rows, 0), rounds=3)
    found = [separated(scene, points, rows, exact) for points in either((2, 3, 4, 5), (2,))]
    found.append(basis(scene, found[-2 if len(found) > 1 else -1]["runs"], rows, exact))
    back()
    for row in found:
        print(row, flush=True)
    ranges = {name: list(limits) for name, limits in RANGES.items()}
    save("separated", {"ranges": ranges, "unseen": CHECKS, "full_us": 1e6 * full.run, "models": found})


if __name__ == "__main__":
    main()
