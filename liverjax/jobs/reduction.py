"""Reduced models of scene files: make a model from training runs, and use it for a run if the error is small."""

import time
from contextlib import suppress
from pathlib import Path
from typing import NamedTuple

import h5py
import jax
import jax.numpy as jnp
import numpy as np

from liverjax.core.errors import InputError
from liverjax.core.files import writable
from liverjax.core.struct import replace
from liverjax.jobs.long_run import Ran
from liverjax.jobs.sweep import read_sweep
from liverjax.reduced.estimate import reduced_error
from liverjax.reduced.files import load_reduced, save_reduced
from liverjax.reduced.model import ReducedModel, parameters_outside
from liverjax.reduced.run import ReducedResult, reduced_positions, reduced_pressure, simulate_reduced
from liverjax.reduced.training import reduce_scene
from liverjax.scenes.scene import Scene
from liverjax.simulation.run import Result
from liverjax.solvers.blas import one_blas_thread
from liverjax.solvers.problem import StepStatistics


def learnt(model: ReducedModel) -> str:
    """Return one sentence about the learnt correction of a model."""
    if model.correction is None:
        return "no correction, because there were too few training runs or no correction reduced the errors"
    left = np.asarray(model.correction.left)
    return (
        f"with a learnt correction; relative error in cross-validation: {np.median(left):.2g} (median), "
        f"{left.max():.2g} (largest)"
    )


class Tried(NamedTuple):
    """A run of a scene with its reduced model."""

    ran: Ran | None  # None: the estimated error is above the tolerance, or a step failed
    sentence: str  # a description of the outcome


def make(
    scene_file: Path, rows_file: Path, out: Path, tolerance: float, modes: int, runs: int | None = None
) -> ReducedModel:
    """Run the full model for each row of a table, and write the reduced model that is made from these runs.

    Raises:
        InputError: the scene, the table, the tolerance or the output cannot be used.
    """
    if modes < 1:
        raise InputError(f"--modes {modes} must be above 0: give e.g. 40")
    if not out.parent.is_dir():
        wrong = "is a file" if out.parent.exists() else "does not exist; make it first"
        raise InputError(f"--out {out} cannot be used, because the folder {out.parent} {wrong}")
    if out.is_dir():
        raise InputError(f"--out {out} is a folder: name a file for the model, e.g. {out / 'model.h5'}")
    _refuse_other_content(out)
    writable(out.parent, ())
    table = read_sweep(scene_file, rows_file)
    scene = replace(table.scene, solve=replace(table.scene.solve, reduced=""))
    rows = {name: table.rows[:, k] for k, name in enumerate(table.names)}
    model = reduce_scene(scene, rows, tolerance, modes, runs=runs)
    save_reduced(model, out, scene_file.read_text(encoding="utf-8-sig"))
    return model


def _refuse_other_content(out: Path) -> None:
    """Raise `InputError` if a file `out` exists and is no reduced model, for example the scene file.

    A damaged or incomplete model may be replaced if its modes and weights can be found.
    """
    if not out.exists():
        return
    with suppress(OSError), h5py.File(out, "r") as stored:  # OSError: this is not an HDF5 file
        if "modes" in stored and "weights" in stored:
            return
    raise InputError(
        f"--out {out} exists, and is not a reduced model: name another file for the model, or remove this file"
    )


def tried(scene: Scene) -> Tried:
    """Run a scene with the reduced model that is named in [solve] of the scene, and estimate the error.

    Raises:
        InputError: the model does not exist, or belongs to another scene.
    """
    solve = scene.solve
    model, plain = load_reduced(solve.reduced), replace(scene, solve=replace(solve, reduced=""))
    with one_blas_thread():
        begin = time.perf_counter()
        first = jax.block_until_ready(simulate_reduced(model, plain))
        again = time.perf_counter()
        found = jax.block_until_ready(simulate_reduced(model, plain))
        run_time = time.perf_counter() - again
    compile_time = max(again - begin - run_time, 0.0)  # short if the compiled program was found on disk
    x, found = reduced_positions(model, plain, found), reduced_error(model, plain, found)
    error = np.asarray(found.error)
    moved = float(np.linalg.norm(np.asarray(x) - np.asarray(scene.mesh.points), axis=-1).max())
    said = (
        f"reduced model: {model.number_of_modes} modes, {len(model.points)} of {scene.mesh.weights.size} points; "
        f"estimated error {error.max():.2g} m"
        + (f", {error.max() / moved:.2%} of the largest displacement" if moved else "")
    )
    outside = parameters_outside(model, plain)
    said += f". Outside of the training range: {', '.join(outside)}" if outside else ""
    small, beside = error.max() <= solve.reduced_tolerance * moved, {"reduced_error": (error, "m")}
    P = None if model.pressures is None else reduced_pressure(model, plain, found)
    if P is not None and found.pressure_error is not None:
        off, whole = np.asarray(found.pressure_error), float(np.abs(np.asarray(P)).max())
        said += f", and {off.max():.2g} Pa of pressure" + (f", {off.max() / whole:.2%} of the largest" if whole else "")
        small, beside["reduced_pressure_error"] = small and off.max() <= solve.reduced_tolerance * whole, (off, "Pa")
    failed = int(np.count_nonzero(np.asarray(first.status)))
    if failed or not small:
        limit = f"{100 * float(np.asarray(solve.reduced_tolerance)):.3g} %"
        why = f"{failed} steps of the reduced run failed" if failed else f"The error is above {limit}"
        return Tried(None, f"{said}. {why}, so the full model runs")
    ran = Ran(_as_result(found, x, P), len(found.times), run_time, compile_time, beside)
    return Tried(ran, said)


def _as_result(found: ReducedResult, x: jax.Array, P: jax.Array | None) -> Result:
    zeros = jnp.zeros(len(found.times), jnp.int32)
    values = {"iterations": found.iterations, "residual": found.residual, "status": found.status}
    took = StepStatistics(**{name: values.get(name, zeros) for name in StepStatistics._fields})
    assert found.reactions is not None
    result = Result(
        times=found.times,
        positions=x,
        reactions=found.reactions,
        pressure=P,
        status=found.status,
        statistics=took,
    )
    return jax.tree.map(np.asarray, result)
