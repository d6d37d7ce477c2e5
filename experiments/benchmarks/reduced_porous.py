"""A reduced model of the complete liver phantom, porous and viscous: error, stated error, and run time.

Free parameters are gravity, a load on a patch of the tip, the modulus, one ratio and one relaxation time as in
`reduced.py`, and in addition permeability and bulk modulus of the porous body. The training runs are drawn in a box of
parameters and at some of its corners. The test runs are drawn in a box 10 % wider. The reference is the full model on
the same mesh.

``python -m experiments reduced_porous`` (25 minutes on one core) writes results/reduced_porous.json after each part,
and the trained model into out/reduced_porous.h5. If the script is interrupted, the next call continues from there.
Delete the model to run everything again. Times are processor times of one core, which depend less on other work than
wall times.
"""

import os

# With matrices of 72 x 72, threads of the BLAS cost more than they gain.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import json
import statistics
import time
from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np

import liverjax as lj
from experiments.benchmarks import reduced
from experiments.benchmarks.reduced import MM, farthest, loosely, one_core, pulled_phantom, ratios, row_of, summary
from experiments.common import RESULTS, ROOT, either, save
from experiments.liver import models
from liverjax.core.struct import replace

#: Lowest and highest value of each parameter in the training runs: those of `reduced.py` and two more.
RANGES = reduced.RANGES | {"porosity.permeability": (1e-5, 4e-5), "porosity.bulk": (300.0, 500.0)}
#: Number of drawn training runs, and of corners: those of `reduced.py`. The two porous parameters take the four pairs
#: of their limits in turn.
ROWS, CORNERS = either((420, 60), (8, 2))
#: Number of test runs, and of those for which the error on the full mesh is computed too.
UNSEEN, MESH_CHECKS = either((100, 6), (2, 1))
#: Largest number of modes, and error that the choice of integration points may cause.
MODES, POINT_TOLERANCE = either((72, 7e-3), (20, 1e-1))
#: Number of runs in one batch of vmap.
LANES = either(64, 4)
KEPT = ROOT / "out" / f"{either('', 'quick_')}reduced_porous.h5"


def pulled_sponge() -> lj.Scene:
    """The complete phantom with a load on a patch at its tip, 1.2 s in steps of 0.05 s."""
    return replace(pulled_phantom(), porosity=models()["complete"].porosity)


def trained(scene: lj.Scene) -> tuple[lj.ReducedModel, dict]:
    """Train the model. Return it and the cost of training."""
    corners = [4 * corner + k % 4 for k, corner in enumerate(reduced.CORNERS[:CORNERS])]
    rows, begin, cpu = reduced.with_corners(ROWS, corners, RANGES), time.perf_counter(), time.process_time()
    model = lj.reduce_scene(scene, rows, 1e-5, MODES, POINT_TOLERANCE)
    took = {"training_s": time.perf_counter() - begin, "training_cpu_s": time.process_time() - cpu}
    assert model.pressures is not None
    took |= {"rows": ROWS + CORNERS, "modes": model.number_of_modes, "points": len(model.points)}
    return model, took | {"pressures": len(model.pressures.modes), "elements": scene.mesh.number_of_elements}


def unseen(scene: lj.Scene, model: lj.ReducedModel, rows: dict) -> dict:
    """Return true and stated errors of runs with all parameter sets."""
    found, failed = [], 0
    mesh: list[tuple[float, float]] = []
    for k in range(UNSEEN):
        full = lj.simulate(lj.with_parameters(scene, row_of(rows, k)))
        own = loosely(lj.with_parameters(scene, row_of(rows, k)))
        small = lj.simulate_reduced(model, own)
        if np.any(full.status) or np.any(small.status):
            failed += 1
            continue
        P = np.asarray(lj.reduced_pressure(model, own, small))
        moved, most = farthest(full.positions - own.mesh.points), float(np.abs(full.pressure).max())
        true, without = (farthest(lj.reduced_positions(model, own, small, c) - full.positions) for c in (True, False))
        stated = [float(np.max(lj.stated_error(model, own, small, c))) / MM for c in (True, False)]
        off = float(np.abs(P - full.pressure).max())
        found.append((true, without, *stated, moved, off / most, most))
        if len(mesh) < MESH_CHECKS:
            asked = lj.reduced_error(model, own, small)
            mesh.append((float(asked.error.max()) / MM / true, float(asked.pressure_error.max()) / off))
    true, without, stated, change, moved, pressure, most = np.array(found).T
    row: dict = {"runs": UNSEEN, "failed": failed, "largest_displacement_mm": float(moved.max())}
    row |= {"largest_pressure": float(most.max()), "mesh_ratios": mesh}
    for kind, errors in (("relative", true / moved), ("uncorrected", without / moved), ("pressure", pressure)):
        row |= {f"{kind}_{k}": v for k, v in summary(errors).items()}
    row |= ratios(stated / true) | {f"change_{k}": v for k, v in ratios(change / without).items()}
    row |= {"within_one_percent": float(np.mean(true / moved <= 0.01))}
    return row | {"relative": (true / moved).tolist(), "effectivity": (stated / true).tolist()}


def times(scene: lj.Scene, model: lj.ReducedModel) -> dict:
    """Return milliseconds per step on one core: reduced run, its gradient, many runs at once, and the full run."""
    back, steps, small = one_core(), scene.solve.steps, loosely(scene)
    start = [jnp.asarray(v, float) for v in (715.0, 2e-5)]
    tip = reduced.tip_of(small, ("law.mu", "porosity.permeability"))
    result, run = processor_s(lambda s, model: lj.simulate_reduced(model, s), small, model, rounds=15)
    _, whole = processor_s(reduced.answer, small, model, rounds=15)
    _, plain = processor_s(tip, start, model, rounds=15)
    _, gradient = processor_s(jax.value_and_grad(tip), start, model, rounds=9)
    lanes = [jnp.linspace(0.9, 1.1, LANES) * v for v in start]
    _, many = processor_s(jax.vmap(tip, in_axes=(0, None)), lanes, model, rounds=1)
    _, full = processor_s(lj.simulate, scene, rounds=3)
    back()
    return {
        "step_ms": 1e3 * run / steps,
        "answer_ms": 1e3 * whole / steps,
        "iterations_per_step": float(np.mean(np.asarray(result.iterations))),
        "gradient_over_run": gradient / plain,
        "lanes": LANES,
        "step_of_a_lane_ms": 1e3 * many / steps / LANES,
        "full_step_ms": 1e3 * full / steps,
    }


def processor_s(function: Callable, *arguments: object, rounds: int) -> tuple:
    """Return the result and the processor time [s] of a jitted function: the median of some runs after a first one."""
    compiled = jax.jit(function).lower(*arguments).compile()
    result, seconds = jax.block_until_ready(compiled(*arguments)), []
    for _ in range(rounds):
        begin = time.process_time()
        jax.block_until_ready(compiled(*arguments))
        seconds.append(time.process_time() - begin)
    return result, statistics.median(seconds)


def main() -> None:
    """Run all parts whose results are not stored yet, and write after each."""
    scene, rows = pulled_sponge(), reduced.drawn(UNSEEN, 0.1, 2, RANGES)
    results = RESULTS / "reduced_porous.json"
    if KEPT.exists() and results.exists():
        model, content = lj.load_reduced(KEPT), json.loads(results.read_text())
    else:
        model, took = trained(scene)
        content = {"training": took}
        KEPT.parent.mkdir(exist_ok=True)
        lj.save_reduced(model, KEPT)
        save("reduced_porous", content)
    parts = {
        "unseen": lambda: unseen(scene, model, rows),
        "times": lambda: times(lj.with_parameters(scene, row_of(rows, 0)), model),
    }
    for name, part in parts.items():
        if name not in content:
            content[name] = part()
            save("reduced_porous", content)
        print({k: v for k, v in content[name].items() if not isinstance(v, list) or len(v) == 2}, flush=True)


if __name__ == "__main__":
    main()
