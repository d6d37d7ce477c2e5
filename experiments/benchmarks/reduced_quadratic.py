"""A reduced model of the viscous liver phantom on quadratic elements: error, stated error, and run time.

The motion of the modes alone has an error of some thousandths, which the size of the learnt correction states well. The
corrected motion is more exact, and its error is known less well. Both are shown.

As `reduced.py`, but the truth is the full model of 10-node tetrahedra on the same mesh. Weight and pull are a tenth of
those of `reduced.py`: from an eighth on, quadratic elements at the clamps turn inside out in the softest rows, and the
full model refuses its own answer. The rows of the second part of the training are those for which a first model states
the largest errors. The unseen runs are drawn in a box 10 % wider.

``python -m experiments reduced_quadratic`` (50 minutes on two cores) writes results/reduced_quadratic.json after each
part, and the trained model into out/reduced_quadratic.h5. If the script is ended, it goes on from there; delete the
model to run all anew. Times of steps are the processor's, of one core: other work counts less than on a clock.
"""

import os

# Matrices of 70 x 70: threads of the BLAS cost more than they do.
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

#: Weight and pull, over those of `reduced.py`.
SHARE = 0.1
LOADS = ("body.gravity", "traction.0.value")
RANGES = {
    name: tuple(tuple(SHARE * np.asarray(end)) for end in ends) if name in LOADS else ends
    for name, ends in reduced.RANGES.items()
}
#: Rows, those of them that are run in full, and unseen runs.
ROWS, RUNS, UNSEEN = either((900, 160, 200), (12, 9, 3))
#: The most modes, and what the points may leave out.
MODES, POINT_TOLERANCE = either((70, 4e-3), (20, 1e-1))
#: Newton's tolerance of the training runs; the truth has 1e-6.
TRAINING_TOLERANCE = 1e-4
KEPT = ROOT / "out" / f"{either('', 'quick_')}reduced_quadratic.h5"


def trained(scene: lj.Scene) -> tuple[lj.ReducedModel, dict[str, Any]]:
    """The model, and what it took."""
    rows, begin, cpu = reduced.drawn(ROWS, 0.0, 1, RANGES), time.perf_counter(), time.process_time()
    scene = replace(scene, solve=replace(scene.solve, tolerance=TRAINING_TOLERANCE))
    model = lj.reduce_scene(scene, rows, 1e-5, MODES, POINT_TOLERANCE, runs=RUNS)
    took = {"training_s": time.perf_counter() - begin, "training_cpu_s": time.process_time() - cpu}
    size = {"modes": model.number_of_modes, "points": len(model.points), "of_points": scene.mesh.weights.size}
    return model, {"rows": ROWS, "runs": RUNS, "elements": scene.mesh.number_of_elements} | took | size


def times(scene: lj.Scene, model: lj.ReducedModel) -> dict[str, float]:
    """Milliseconds a step on one core: reduced run, with the motion of all nodes and its error, gradient, full run."""
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
    """All parts that are not there yet, written after each."""
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
