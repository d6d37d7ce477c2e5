"""The same two programs with different releases of jax: size of the compiled program, compile time, and run time.

An earlier form of the torsion program ran 1.8 times slower with jax 0.12 than with 0.10. XLA had inserted 577
transposes and 654 copies, where the program as written had 32. Therefore the columns of positions are now separate
arrays.

    python -m experiments jax_releases          run once with each release; the results of other releases are kept
"""

import json
import re
import time
from collections.abc import Callable

import jax
import numpy as np

import liverjax as lj
from experiments.common import RESULTS, either, save, timed
from experiments.liver import models, timed_run, with_solve
from fitting.rigs import torsion

ROUNDS = either(7, 2)


def program_size(function: Callable, *arguments: object) -> dict[str, int]:
    """Return the number of transposes in the program as written, and of transposes and copies in the compiled
    program.
    """
    lowered = jax.jit(function).lower(*arguments)
    text, compiled = lowered.as_text(), lowered.compile().as_text()
    found = {"written_transposes": len(re.findall(r"stablehlo\.transpose", text))}
    for kind in ("transpose", "copy"):
        found[f"compiled_{kind}"] = len(re.findall(rf"= \S+ {kind}\(", compiled))
    return found


def oscillations() -> dict:
    """Sixteen oscillations of the default rheometer sample."""
    rig, law = torsion.make_rig(), lj.laws.typical("neo_hookean")
    prony = lj.Prony(ratios=np.array([0.235, 0.333]), relaxation_times=np.array([0.27, 0.03]))
    omega = 2 * np.pi * np.logspace(-1, 1.2, 16)
    torque = np.asarray(torsion.torque_for_strain(rig, np.full(16, 800.0), 1e-3))
    arguments = (rig, law, prony, omega, torque)
    _, timing = timed(torsion.moduli, *arguments, rounds=ROUNDS)
    size = program_size(torsion.moduli, *arguments)
    return size | {"run_s": timing.run, "compile_s": timing.compile, "nodes": rig.mesh.number_of_nodes}


def complete_liver() -> dict:
    """One second of the complete liver in steps of 0.05 s."""
    scene = with_solve(models()["complete"], 1.0, 0.05)
    _, row = timed_run(scene, ROUNDS)
    return {key: row[key] for key in ("run_s", "compile_s", "steps_per_s")}


def main() -> None:
    """Measure with the installed release."""
    file = RESULTS / "jax_releases.json"
    rows = json.loads(file.read_text())["rows"] if file.exists() else []
    begin = time.perf_counter()
    new = {"jax": jax.__version__, "torsion": oscillations(), "liver": complete_liver()}
    print(new, f"{time.perf_counter() - begin:.0f} s", flush=True)
    rows = [row for row in rows if row["jax"] != jax.__version__] + [new]
    rows.sort(key=lambda row: [int(part) for part in re.findall(r"\d+", row["jax"])])
    save("jax_releases", {"rows": rows})


if __name__ == "__main__":
    main()
