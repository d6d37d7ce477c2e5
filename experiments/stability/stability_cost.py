"""Cost of a robust solver where robustness is not needed: the liver under a fifth of gravity, with both options.

``python -m experiments stability_cost`` (4 minutes) writes results/stability_cost.json: steps per second with robust =
"off" and "projected" in alternating rounds, as medians, and the largest difference of the positions.
"""

import statistics
import time

import jax
import numpy as np

import liverjax as lj
from experiments.common import either, save
from experiments.liver import models, with_solve

SECONDS, DT, ROUNDS = 2.0, 0.05, either(7, 1)


def main() -> None:
    """Run every model."""
    rows = []
    for name, scene in either(models(), {"hyperelastic": models()["hyperelastic"]}).items():
        programs, compiling, results = {}, {}, {}
        scenes = {robust: with_solve(scene, SECONDS, DT, robust=robust) for robust in ("off", "projected")}
        for robust, given in scenes.items():
            begin = time.perf_counter()
            programs[robust] = jax.jit(lj.simulate).lower(given).compile()
            compiling[robust] = time.perf_counter() - begin
        seconds: dict[str, list[float]] = {robust: [] for robust in scenes}
        for _ in range(ROUNDS):
            for robust, given in scenes.items():
                begin = time.perf_counter()
                results[robust] = jax.block_until_ready(programs[robust](given)).check()
                seconds[robust].append(time.perf_counter() - begin)
        off, on = (statistics.median(seconds[robust]) for robust in scenes)
        apart = np.abs(np.asarray(results["off"].positions) - np.asarray(results["projected"].positions)).max()
        ratios = [b / a for a, b in zip(*seconds.values(), strict=True)]
        rows.append(
            {
                "model": name,
                "steps_per_s": {"off": SECONDS / DT / off, "projected": SECONDS / DT / on},
                "time_over_off": statistics.median(ratios),
                "largest_difference_m": float(apart),
                "compile_s": compiling,
            }
        )
        print(rows[-1], flush=True)
        save("stability_cost", {"dt": DT, "rounds": ROUNDS, "rows": rows})


if __name__ == "__main__":
    main()
