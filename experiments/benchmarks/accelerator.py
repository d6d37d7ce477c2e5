"""One GPU compared with the processor of the same machine, in both precisions: errors and run times of typical tasks.

Every case runs in float64 and float32, on the processor and on the accelerator. All errors are relative to the result
of the processor in float64. So they contain rounding and the order of summation, but no error of the mesh or the time
step.

* Force and stiffness of all elements, linear and quadratic.
* A static cube stretched by 20 % in one load step, solved to 1e-8 (float64) and 5e-4 (float32), and the gradient of its
  reaction.
* Time steps of the three models of the liver phantom.
* Many runs at once: the runs of a sweep.
* A reduced model, one run and a thousand runs at once. It is the model of a stretched cube or, with ``--model FILE``,
  the model of the phantom that ``python -m experiments.benchmarks.reduced --keep FILE`` wrote.

``python -m experiments accelerator`` (5 minutes) writes results/accelerator.json. Without a GPU the script prints a
message and ends; ``--platforms cpu`` prints the results of the processor alone. All programs are compiled first, in
parallel. Run times are medians without compilation.
"""

import argparse
import json
import os
import shutil
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

import liverjax as lj
from experiments.benchmarks.precision import cast
from experiments.benchmarks.reduced import loosely, pulled_phantom
from experiments.benchmarks.solve_benchmark import cube
from experiments.chapter.assembly_rivals import contracted
from experiments.common import QUICK, SKIPPED, either, save
from experiments.liver import models, with_solve
from liverjax.core import status
from liverjax.core.struct import replace
from liverjax.elements import mjed

PRECISIONS = {"float64": jnp.float64, "float32": jnp.float32}
#: Tolerance of Newton's method that can be reached in each precision.
TOLERANCES = {"float64": 1e-8, "float32": 5e-4}
#: Number of cells along the side of each cube.
ASSEMBLED, QUADRATIC, SOLVED = either(((15, 25, 55), (8, 20), (15, 25, 35)), ((6,), (3,), (6,)))
STEPS = either(40, 4)
LANES = either((1, 64, 1000), (1, 8))
#: Largest number of reduced models in one batch on the processor, which runs them one after the other.
FEW = 64


class Case(NamedTuple):
    """A program whose run time is measured."""

    part: str
    name: str
    precision: str
    size: int  # number of tetrahedra, time steps, or runs in the batch
    function: Callable
    arguments: tuple
    read: Callable[[Any], tuple[np.ndarray, dict]]  # the result that is compared, and further values for the table


def whole(found: Any) -> tuple[np.ndarray, dict]:
    """Return the result alone, as one array, without further values."""
    return np.concatenate([np.ravel(np.asarray(a, float)) for a in jax.tree.leaves(found)]), {}


def of_lanes(found: jax.Array) -> tuple[np.ndarray, dict]:
    """Return the results of all runs in the batch."""
    return np.asarray(found, float), {}


def of_run(result: lj.Result) -> tuple[np.ndarray, dict]:
    """Return the positions, and residual, status and iterations of Newton's method."""
    s, steps = result.statistics, len(result.times)
    worst = status.NAMES[int(status.most_severe(result.status))]
    told = {"residual": float(np.max(np.asarray(s.residual))), "code": worst}
    told |= {"linear_per_step": float(np.sum(np.asarray(s.linear_iterations))) / steps}
    return np.asarray(result.positions, float), told


def assembly(_: Path) -> Iterator[Case]:
    """Yield the cases for force and stiffness."""
    law = jax.tree.map(jnp.asarray, lj.laws.typical("neo_hookean"))
    for order, sizes in ((1, ASSEMBLED), (2, QUADRATIC)):
        for cells in sizes:
            mesh = lj.shapes.box((0.1, 0.1, 0.1), (cells,) * 3)
            mesh = lj.quadratic(mesh) if order == 2 else mesh
            x = mesh.points + 0.002 * jnp.sin(40 * mesh.points)
            for precision, dtype in PRECISIONS.items():
                given = tuple(cast(tree, dtype) for tree in (mesh, law, x))
                name, size = ("linear", "quadratic")[order - 1], mesh.number_of_elements
                yield Case("assembly", name, precision, size, contracted if order == 1 else of_points, given, whole)


def of_points(mesh: lj.TetMesh, law: lj.Law, x: jax.Array) -> tuple:
    """Return the nodal forces of quadratic elements, and the pulled-back stiffness at every integration point."""
    return mjed.internal_force(mesh, law, x), mjed.element_stiffness(mesh, law, x)


def solves(_: Path) -> Iterator[Case]:
    """Yield the cases of the static cube, and of the derivative of its reaction with respect to mu."""
    for cells in SOLVED:
        for precision, tolerance in TOLERANCES.items():
            scene = cube(cells, tolerance=tolerance, precision=precision)
            size = scene.mesh.number_of_elements
            yield Case("static cube", "run", precision, size, lj.simulate, (scene,), of_run)
    for precision, tolerance in TOLERANCES.items():
        scene = cube(SOLVED[1 if len(SOLVED) > 1 else 0], tolerance=tolerance, precision=precision)
        size = scene.mesh.number_of_elements
        yield Case("static cube", "reaction and gradient", precision, size, reaction_and_slope, (scene, 1000.0), whole)


def reaction_and_slope(scene: lj.Scene, mu: jax.Array) -> tuple:
    """Return the force on the upper end and its derivative with respect to mu."""

    def force(mu: jax.Array) -> jax.Array:
        result = lj.simulate(lj.with_parameters(scene, {"law.mu": mu}))
        return jnp.sum(result.reactions[-1, jnp.asarray(scene.mesh.node_sets["z_max"]), 2])

    return jax.value_and_grad(force)(mu)


def liver(_: Path) -> Iterator[Case]:
    """Yield the cases of the phantom's models, with time steps of 0.05 s."""
    for name, scene in models().items():
        for precision, tolerance in (("float64", 1e-6), ("float32", 1e-4)):
            own = with_solve(scene, 0.05 * STEPS, 0.05, tolerance=tolerance, precision=precision)
            yield Case("liver", name, precision, STEPS, lj.simulate, (own,), of_run)


def spread(lanes: int, low: float, high: float) -> jax.Array:
    """Return numbers (lanes,) that repeat after `FEW` entries, so that the results repeat too."""
    return low + (high - low) * (jnp.arange(lanes) % FEW) / (FEW - 1)


def sweeps(_: Path) -> Iterator[Case]:
    """Yield the cases of one scene with many parameter sets at once: 384 tetrahedra stretched in two load steps."""
    base = cube(4, steps=2)
    for lanes in LANES:
        for precision, tolerance in TOLERANCES.items():
            scene = replace(base, solve=replace(base.solve, precision=precision, tolerance=tolerance))
            rows = {"law.mu": spread(lanes, 500.0, 1500.0)}
            yield Case("sweep", "384 tetrahedra", precision, lanes, swept, (scene, rows), of_lanes)


def swept(scene: lj.Scene, rows: dict) -> jax.Array:
    """Return the last positions of the runs with all parameter sets."""
    return lj.simulate_batch(scene, rows).result.positions[:, -1]


def reduced(folder: Path) -> Iterator[Case]:
    """Yield the cases of a reduced model, run with one or many values of mu."""
    (kept,) = folder.glob("*.h5")
    model, name = lj.load_reduced(kept), kept.stem
    scene = loosely(pulled_phantom()) if name == "phantom" else cube(4, steps=2)
    for lanes in LANES:
        if lanes > FEW and jax.default_backend() == "cpu":
            continue
        own = spread(lanes, 600.0, 900.0)
        for function, said in ((lanes_of, "runs"), (slopes_of, "gradients")):
            yield Case("reduced", f"{name}, {said}", "float64", lanes, function, (scene, model, own), of_lanes)


def train(folder: Path) -> None:
    """Train and save the reduced model of the cube."""
    rows = {"law.mu": [600.0, 900.0, 700.0, 800.0], "law.bulk": [5e3, 1e4, 2e4, 8e3]}
    lj.save_reduced(lj.reduce_scene(cube(4, steps=2), rows, tolerance=1e-4), folder / "cube.h5")


def lanes_of(scene: lj.Scene, model: lj.ReducedModel, mu: jax.Array) -> jax.Array:
    """Return the last reduced coordinates of the runs with each mu."""

    def one(mu: jax.Array) -> jax.Array:
        return lj.simulate_reduced(model, lj.with_parameters(scene, {"law.mu": mu})).coordinates[-1]

    return jax.vmap(one)(mu)


def slopes_of(scene: lj.Scene, model: lj.ReducedModel, mu: jax.Array) -> jax.Array:
    """Return the derivative of the sum of the squared last coordinates with respect to each mu."""
    return jax.grad(lambda mu: jnp.sum(lanes_of(scene, model, mu) ** 2))(mu)


PARTS: dict[str, Callable[..., Iterator[Case]]] = {
    "assembly": assembly,
    "static": solves,
    "liver": liver,
    "sweep": sweeps,
    "reduced": reduced,
}


def measured(part: str, folder: Path) -> list[dict]:
    """Measure all cases of a part on the platform of this process, after it receives a line on its standard input.

    The processor saves its results in float64. All other results are compared with them.
    """
    cases = list(PARTS[part](folder))
    compiled, rows = [_compiled(case) for case in cases], []
    print("compiled", flush=True)
    sys.stdin.readline()
    for case, (program, compiling) in zip(cases, compiled, strict=True):
        row = {"part": case.part, "name": case.name, "precision": case.precision, "size": case.size}
        row |= {"platform": jax.default_backend(), "compile_s": compiling}
        try:
            row |= {"failed": "not compiled"} if program is None else _timed(case, program, folder)
        except jax.errors.JaxRuntimeError as error:
            row |= {"failed": "out of memory" if "RESOURCE_EXHAUSTED" in str(error) else str(error)[:80]}
        print(json.dumps(row), flush=True)
        rows.append(row)
    return rows


def _compiled(case: Case) -> tuple[Any, float]:
    begin = time.perf_counter()
    try:
        return jax.jit(case.function).lower(*case.arguments).compile(), time.perf_counter() - begin
    except Exception as error:  # a case that a platform cannot run must not stop the other cases
        print(case.part, case.name, case.precision, case.size, repr(error)[:300], flush=True)
        return None, time.perf_counter() - begin


def _timed(case: Case, program: Any, folder: Path) -> dict:
    given = jax.device_put(case.arguments)
    found, seconds = jax.block_until_ready(program(*given)), []
    while sum(seconds) < 6 and (len(seconds) < 3 or (sum(seconds) < 1 and len(seconds) < 30)):
        begin = time.perf_counter()
        jax.block_until_ready(program(*given))
        seconds.append(time.perf_counter() - begin)
    answer, told = case.read(found)
    place = folder / f"{case.part} {case.name} {'' if case.read is of_lanes else case.size}.npy"
    if jax.default_backend() == "cpu" and case.precision == "float64":
        np.save(place, answer)
    row = {"run_s": statistics.median(seconds), "fastest_s": min(seconds)} | told
    if place.exists():
        exact = np.load(place)
        exact = exact[np.arange(len(answer)) % len(exact)]  # the results of the batch repeat
        size = np.abs(exact).max()
        if case.read is of_run:
            size = np.abs(exact - np.asarray(case.arguments[0].mesh.points)).max()
        row["error"] = float(np.abs(answer - exact).max() / size)
    return row


def own_process(platform: str, part: str, folder: Path) -> subprocess.Popen:
    """Start a process that compiles, prints "compiled", waits for a line, and then measures."""
    own = os.environ | {"JAX_PLATFORMS": platform}
    call = [sys.executable, "-m", "experiments.benchmarks.accelerator", "--folder", str(folder), "--parts", part]
    call += ["--quick"] if QUICK else []
    return subprocess.Popen(call, env=own, text=True, stdin=subprocess.PIPE, stdout=subprocess.PIPE)


def rows_of(process: subprocess.Popen) -> list[dict]:
    """Let a waiting process measure, and return its results."""
    assert process.stdin is not None and process.stdout is not None
    if process.poll() is not None:  # the process ended before it had compiled, and has printed the reason
        return []
    process.stdin.write("go\n")
    process.stdin.flush()
    rows = []
    for line in process.stdout:
        print(line, end="", flush=True)
        rows += [json.loads(line)] if line.startswith("{") else []
    return rows


def wait_until_compiled(process: subprocess.Popen) -> None:
    """Read and print the output of a process until it prints "compiled"."""
    assert process.stdout is not None
    for line in process.stdout:
        if line == "compiled\n":
            return
        print(line, end="", flush=True)


def main() -> None:
    """Run all parts on all platforms in separate processes. All compile in parallel, then each measures alone."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("--parts", nargs="*", default=list(PARTS), choices=list(PARTS))
    parser.add_argument("--platforms", nargs="*", help="as JAX names them; default: cpu and cuda")
    parser.add_argument("--model", type=Path, help="reduced model of the phantom")
    parser.add_argument("--folder", type=Path, help="for the processes of this script")
    parser.add_argument("--quick", action="store_true", help="small cases")
    options = parser.parse_args()
    if options.folder is not None:
        measured(options.parts[0], options.folder)
        return
    # If a process (this one too) reserved most of the memory, none would be left for the others.
    os.environ["XLA_PYTHON_CLIENT_PREALLOCATE"] = "false"
    if options.platforms is None and jax.default_backend() == "cpu":
        print("this machine has no GPU that JAX finds: nothing is measured")
        sys.exit(SKIPPED)
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        if options.model is not None:
            shutil.copy(options.model, folder / "phantom.h5")
        elif "reduced" in options.parts:
            train(folder)
        platforms = options.platforms or ["cpu", "cuda"]
        every = [own_process(platform, part, folder) for platform in platforms for part in options.parts]
        for process in every:
            wait_until_compiled(process)
        rows = []
        for process in every:
            rows += rows_of(process)
            if jax.default_backend() != "cpu":
                save("accelerator", {"devices": [d.device_kind for d in jax.devices()], "rows": rows})


if __name__ == "__main__":
    main()
