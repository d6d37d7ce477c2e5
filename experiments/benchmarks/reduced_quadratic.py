"""A reduced model of the viscous liver phantom on quadratic elements: error, stated error, and run time.

The motion computed with the modes alone has an error of some thousandths. The size of the learnt correction is a good
estimate of this error. The corrected motion is more accurate, but its error is known less well. Both are shown.

The script follows `reduced.py`, but the reference is the full model of 10-node tetrahedra on the same mesh. Weight and
load are a tenth of those of `reduced.py`. From an eighth on, quadratic elements at the clamps invert in the softest
bodies, and the full model reports a failure. In the second part of the training, the parameter sets are those for which
a first model states the largest errors. The test runs are drawn in a box 10 % wider.

``python -m experiments reduced_quadratic`` (50 minutes on two cores) writes results/reduced_quadratic.json after each
part, and the trained model into out/reduced_quadratic.h5. If the script is interrupted, the next call continues from
there. Delete the model to run everything again. Times of steps are processor times of one core, which depend less on
other work than wall times.
"""

import os

# With matrices of 70 x 70, threads of the BLAS cost more than they gain.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import json
import time
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

import liverjax as lj
from experiments.benchmarks import reduced
from experiments.benchmarks.reduced import NAMES, loosely, one_core, pulled_phantom, row_of
from experiments.benchmarks.reduced_porous import processor_s
from experiments.common import RESULTS, ROOT, either, save
from liverjax.core.struct import replace
from liverjax.scenes.enriched import enriched

#: Weight and load as a fraction of those of `reduced.py`.
SHARE = 0.1
LOADS = ("body.gravity", "traction.0.value")
RANGES = {
    name: tuple(tuple(SHARE * np.asarray(end)) for end in ends) if name in LOADS else ends
    for name, ends in reduced.RANGES.items()
}
#: Number of parameter sets, of those that are run in full, and of test runs.
ROWS, RUNS, UNSEEN = either((900, 160, 200), (12, 9, 3))
#: Largest number of modes, and error that the choice of integration points may cause.
MODES, POINT_TOLERANCE = either((70, 4e-3), (20, 1e-1))
#: Newton's tolerance of the training runs; that of the reference runs is 1e-6.
TRAINING_TOLERANCE = 1e-4
KEPT = ROOT / "out" / f"{either('', 'quick_')}reduced_quadratic.h5"


def trained(scene: lj.Scene) -> tuple[lj.ReducedModel, dict[str, Any]]:
    """Train the model. Return it and the cost of training."""
    rows, begin, cpu = reduced.drawn(ROWS, 0.0, 1, RANGES), time.perf_counter(), time.process_time()
    scene = replace(scene, solve=replace(scene.solve, tolerance=TRAINING_TOLERANCE))
    model = lj.reduce_scene(scene, rows, 1e-5, MODES, POINT_TOLERANCE, runs=RUNS)
    took = {"training_s": time.perf_counter() - begin, "training_cpu_s": time.process_time() - cpu}
    size = {"modes": model.number_of_modes, "points": len(model.points), "of_points": scene.mesh.weights.size}
    return model, {"rows": ROWS, "runs": RUNS, "elements": scene.mesh.number_of_elements} | took | size


def times(scene: lj.Scene, model: lj.ReducedModel) -> dict[str, float]:
    """Return milliseconds per step on one core: reduced run, with motion and error of all nodes, gradient, full run."""
    back, steps, small = one_core(), scene.solve.steps, loosely(scene)
    start = [jnp.asarray(v, float) for v in (715.0, 0.235, 0.27)]
    tip = reduced.tip_of(small, NAMES)
    result, run = processor_s(lambda s, model: lj.simulate_reduced(model, s), small, model, rounds=15)
    _, whole = processor_s(reduced.answer, small, model, rounds=15)
    _, modes_alone = processor_s(lambda s, model: reduced.answer(s, model, corrected=False), small, model, rounds=15)
    _, plain = processor_s(tip, start, model, rounds=15)
    _, gradient = processor_s(jax.value_and_grad(tip), start, model, rounds=15)
    _, full = processor_s(lj.simulate, scene, rounds=2)
    back()
    return {
        "step_ms": 1e3 * run / steps,
        "answer_ms": 1e3 * whole / steps,
        "uncorrected_answer_ms": 1e3 * modes_alone / steps,
        "iterations_per_step": float(np.mean(np.asarray(result.iterations))),
        "gradient_over_run": gradient / plain,
        "full_step_ms": 1e3 * full / steps,
    }


def main() -> None:
    """Run all parts whose results are not stored yet, and write after each."""
    scene, rows = enriched(pulled_phantom()), reduced.drawn(UNSEEN, 0.1, 2, RANGES)
    results = RESULTS / "reduced_quadratic.json"
    if KEPT.exists() and results.exists():
        model, content = lj.load_reduced(KEPT), json.loads(results.read_text())
    else:
        model, took = trained(scene)
        content = {"training": took}
        KEPT.parent.mkdir(exist_ok=True)
        lj.save_reduced(model, KEPT)
        save("reduced_quadratic", content)
    print(content["training"], flush=True)
    parts = {
        "times": lambda: times(lj.with_parameters(scene, row_of(rows, 0)), model),
        "unseen": lambda: reduced.unseen(scene, model, rows),
    }
    for name, part in parts.items():
        if name not in content:
            content[name] = part()
            save("reduced_quadratic", content)
        print({k: v for k, v in content[name].items() if not isinstance(v, list) or len(v) == 2}, flush=True)


if __name__ == "__main__":
    main()
