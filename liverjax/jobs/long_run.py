"""Run a scene in parts of several steps. Finished parts stay on disk, so that a killed run can continue.

A folder next to the output has one file per part. The file contains the results of the steps of this part, and the
state after the last of these steps. Every part begins with a new tangent matrix, also in a run that is not stopped. So
a resumed run gives exactly the same numbers.
"""

import time
import tomllib
from collections.abc import Callable, Mapping
from contextlib import suppress
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import h5py
import jax
import numpy as np

from liverjax.core.compiled import compiled
from liverjax.core.errors import InputError
from liverjax.core.struct import Content
from liverjax.core.versions import versions
from liverjax.jobs import resumable_parts
from liverjax.scenes.scene import Scene
from liverjax.simulation.equations import initial_state
from liverjax.simulation.run import Result, prepared, simulate_part
from liverjax.solvers.problem import StepStatistics

_ROWS = ("times", "positions", "reactions", "pressure", "status")


class Ran(NamedTuple):
    """A finished run and its computing time. This time does not include parts that were read from disk."""

    result: Result  # all arrays are NumPy arrays
    steps: int  # number of steps that were computed and not read from disk
    run_time: float  # computing time of these steps [s]
    compile_time: float  # time of the compilation [s]
    beside: Mapping[str, tuple[np.ndarray, str]] = {}  # additional datasets of the result: name -> values, unit


def refuse_unfinished(out: Path, resume: bool, text: str | None = None) -> None:
    """Raise `InputError` if a run would overwrite a stopped run, or would resume the result of another scene.

    Raises:
        InputError: there are parts on disk and `resume` is false; or `resume` is true and `out` is a finished result of
            a scene file with another content.
    """
    folder = resumable_parts.beside(out)
    if folder.exists() and not resume:
        raise InputError(
            f"{folder} contains an unfinished run: continue with --resume and the same --every, or remove this folder"
        )
    if resume and not folder.exists() and out.exists() and text is not None:
        try:
            with h5py.File(out) as file:
                before = tomllib.loads(str(file.attrs.get("scene", text)).lstrip("\ufeff"))
        except (OSError, tomllib.TOMLDecodeError):  # the file is not a result of a scene
            return
        if before != tomllib.loads(text):  # the two files may differ in comments
            raise InputError(f"{out} is the result of another scene: give another --out, or remove --resume")


def check_every(every: int) -> None:
    """Raise `InputError` if the number of steps per part is below 1."""
    if every < 1:
        raise InputError(f"--every {every} must be above 0: give e.g. 50")


def remove_parts(out: Path) -> None:
    """Remove the parts of the finished run `out`, if there are parts. If another process uses them, they stay, and that
    process removes them at its end."""
    folder = resumable_parts.beside(out)
    with suppress(InputError, FileNotFoundError), resumable_parts.locked(folder / "lock_0"):
        resumable_parts.remove(folder)


def run(
    scene: Scene,
    text: str,
    out: Path,
    every: int,
    resume: bool = False,
    report: Callable[[int], None] | None = None,
) -> Ran:
    """Run a scene in parts of `every` steps. A run with only one part makes no folder next to its output.

    Args:
        scene: `Scene`.
        text: content of the scene file; results of another scene file are not continued.
        out: file of the results. The caller writes it, and then calls `remove_parts`.
        every: number of steps per part.
        resume: whether to continue from the parts on disk.
        report: function that is called with the number of every finished step, including steps from disk. It is called
            at the end of each part, because JAX cannot store a compiled program on disk if this program calls Python
            functions.

    Raises:
        InputError: there are parts on disk and `resume` is false; the parts belong to another scene; another process
            uses the parts; or `every` is below 1.
        OSError: the disk is full; finished parts are kept.
    """
    steps, folder = scene.solve.steps, resumable_parts.beside(out)
    check_every(every)
    refuse_unfinished(out, resume)
    scene = prepared(scene)
    if steps <= every and not folder.exists():
        return _run_parts(scene, steps, None, report)
    resumable_parts.make_folder(folder)
    with resumable_parts.locked(folder / "lock_0"):
        # The scene file names other files (mesh, history). Their content may change, so all numbers are also compared.
        numbers = resumable_parts.digest(*jax.tree.leaves(scene))
        resumable_parts.same(
            {"scene": text, "numbers": numbers, "every": every, "versions": versions()}, folder / "run.json"
        )
        return _run_parts(scene, every, folder, report)


def _run_parts(scene: Scene, count: int, folder: Path | None, report: Callable[[int], None] | None) -> Ran:
    """Read the parts that are in the folder. Compute and write the other parts."""
    firsts = range(1, scene.solve.steps + 1, count)
    files = [None if folder is None else resumable_parts.part(folder, k) for k in range(len(firsts))]
    state, results, computed, run_time = initial_state(scene), [], 0, 0.0
    finished = [file is not None and resumable_parts.finished(file) for file in files]
    begin = time.perf_counter()
    program: Any = None if all(finished) else _compiled_part(scene, state, count)
    compile_time = time.perf_counter() - begin
    for first, file, there in zip(firsts, files, finished, strict=True):
        if file is not None and there:
            result, state = _read(file, state)
        else:
            begin = time.perf_counter()
            result, state = jax.block_until_ready(program(scene, state, float(first)))
            run_time += time.perf_counter() - begin
            done = min(count, scene.solve.steps - first + 1)
            result, computed = jax.tree.map(lambda a, n=done: np.asarray(a)[:n], result), computed + done
            if file is not None:
                resumable_parts.write(file, _content(result, state))
        results.append(result)
        if report is not None:
            for step in range(len(result.times)):
                report(first + step)
    whole = jax.tree.map(lambda *rows: np.concatenate(rows), *results)
    return Ran(whole, computed, run_time, compile_time)


#: A run takes about one second if the number of integration points times the number of steps has this value.
_SHORT = 100_000


def _compiled_part(scene: Scene, state: Any, count: int) -> Callable:
    short = scene.mesh.weights.size * scene.solve.steps < _SHORT
    return compiled(partial(simulate_part, count=count), scene, state, 1.0, short=short)


def _content(result: Result, state: Any) -> dict[str, np.ndarray]:
    rows = {name: getattr(result, name) for name in _ROWS if getattr(result, name) is not None}
    took = {f"statistics_{name}": value for name, value in result.statistics._asdict().items()}
    return rows | took | {f"state_{k}": np.asarray(leaf) for k, leaf in enumerate(jax.tree.leaves(state))}


def _read(file: Path, like: Any) -> tuple[Result, Any]:
    leaves, structure = jax.tree.flatten(like)
    with h5py.File(file) as part:
        rows: Content = {name: part[name][()] if name in part else None for name in _ROWS}
        took = StepStatistics(*(part[f"statistics_{name}"][()] for name in StepStatistics._fields))
        state = [part[f"state_{k}"][()] for k in range(len(leaves))]
    return Result(**rows, statistics=took), jax.tree.unflatten(structure, state)
