"""Sweeps: run one scene with many parameter sets. The process may be killed at any moment: finished results stay valid.

The table has one parameter set per row. The sets are run in chunks. A finished chunk is a separate file in
FILE.h5.parts. This file is written under a temporary name and then renamed. When all chunks are finished, they are
joined into FILE.h5. If a run is stopped, its finished chunks stay on disk, and `--resume` computes the other chunks.
Several processes may work on one sweep: each of n processes computes every n-th chunk. The last process joins all
parts.
"""

import csv
import errno
import json
import os
import shutil
from collections.abc import Callable, Sequence
from contextlib import suppress
from functools import cache, partial
from pathlib import Path
from typing import NamedTuple

import h5py
import jax
import jax.numpy as jnp
import numpy as np

from liverjax.core import status
from liverjax.core.errors import InputError
from liverjax.core.files import whole
from liverjax.core.versions import versions
from liverjax.elements.gradients import volume_ratios
from liverjax.jobs import resumable_parts
from liverjax.jobs.design import number_of
from liverjax.mesh.files import meshio_cells
from liverjax.mesh.tetrahedra import with_points
from liverjax.scenes.checks.choices import check_choices
from liverjax.scenes.checks.conflicts import check_motion_in_planes
from liverjax.scenes.checks.numbers import check_numbers
from liverjax.scenes.checks.rigid_motion import check_hold, holding
from liverjax.scenes.scene import Scene, numbers_at, with_parameters
from liverjax.scenes.scene_checks import check_physics
from liverjax.scenes.scene_file import load_scene
from liverjax.simulation.automatic import with_solver
from liverjax.simulation.batch import simulate_batch
from liverjax.simulation.cautions.of_run import LEAST_J, MOST_J

#: Name of an output that can be stored for every run -> function of the result and the reference positions (V, 3) [m].
OUTPUTS: dict[str, Callable] = {
    "final_positions": lambda result, reference: result.positions[-1],
    "positions": lambda result, reference: result.positions,
    "largest_displacement": lambda result, reference: jnp.max(
        jnp.linalg.norm(result.positions - reference[None], axis=-1)
    ),
    "final_reactions": lambda result, reference: result.reactions[-1],
    "largest_pressure": lambda result, reference: jnp.max(result.pressure),
}
_UNITS = {"final_reactions": "N", "largest_pressure": "Pa", "status": "1", "residual": "1", "volume_ratios": "1"}
#: Maximum number of names in an attribute. HDF5 allows 64 kB for an attribute, and each name takes 16 bytes.
_MOST_NAMES = 4000


class Sweep(NamedTuple):
    """The N runs to compute, with P parameters each. `identity` contains all input that determines the results."""

    scene: Scene
    names: tuple[str, ...]
    rows: np.ndarray  # (N, P) parameter sets
    numbers: np.ndarray  # (N,) row numbers of the sets in the file, from 1
    outputs: tuple[str, ...]
    probes: tuple[int, ...]  # nodes whose positions are stored at all steps
    chunk: int
    identity: dict[str, object]


class Done(NamedTuple):
    """The outcome of a sweep."""

    file: Path | None  # None: other processes still have chunks to compute
    failed: dict[int, int]  # row number -> status code
    computed: int  # number of runs that this process computed now
    crushed: dict[int, float]  # row number of a converged run -> final volume ratio J, if J is impossible in tissue


def _check_names(scene: Scene, parameters: Path, names: Sequence[str]) -> None:
    for name in names:
        if name.split(".")[0] == "mesh":
            raise InputError(
                f"{parameters}: parameter {name!r} would change the mesh, which is the same in all runs of a sweep: "
                "remove this column"
            )
        if name == "solve.reduced_tolerance":
            raise InputError(
                f"{parameters}: parameter {name!r} has no effect, because a sweep uses no reduced model: remove it"
            )
        try:
            shape = np.shape(numbers_at(scene, name))
        except InputError as error:
            raise InputError(f"{parameters}: {error}") from None
        if shape:
            raise InputError(
                f"{parameters}: parameter {name!r} is a list in the scene file: add an index to the name, e.g. {name}.0"
            )


def read_sweep(
    scene_file: Path,
    parameters: Path,
    outputs: tuple[str, ...] = ("final_positions",),
    probes: tuple[int, ...] = (),
    chunk: int = 16,
    only: tuple[int, ...] = (),
) -> Sweep:
    """Read a sweep from a scene file and a table with a header of dotted names. All rows are checked before any run.

    Raises:
        InputError: the scene, the table or another argument cannot be used, a name is not in the scene, or a value is
            out of bounds.
    """
    scene = load_scene(scene_file)
    names, rows = read_table(parameters)
    _check_names(scene, parameters, names)
    parts = {".".join(name.split(".")[:2]) for name in names}
    held = holding(scene, parts)
    for k, row in enumerate(rows.tolist()):
        values = dict(zip(names, row, strict=True))
        try:
            own = with_parameters(scene, values)
            check_choices(own)
            check_numbers(own, parts)
            check_physics(own, parts)
            check_motion_in_planes(own)
            check_hold(own, held)
        except InputError as error:
            raise InputError(f"{parameters}: row {k + 1}: {error}") from None
    for name in outputs:
        if name not in OUTPUTS:
            raise InputError(f"--store {name} is not known: use {', '.join(OUTPUTS)}")
        if name == "largest_pressure" and scene.porosity is None:
            raise InputError("--store largest_pressure needs [porosity] in the scene: remove largest_pressure")
    for node in probes:
        if not 0 <= node < scene.mesh.number_of_nodes:
            raise InputError(f"--probe {node} is not a node of the mesh: give 0 to {scene.mesh.number_of_nodes - 1}")
    if chunk < 1:
        raise InputError(f"--chunk {chunk} must be above 0: give e.g. 16")
    numbers = np.arange(1, len(rows) + 1)
    for row in only:
        if not 1 <= row <= len(rows):
            raise InputError(f"--rows {row} is not a row of {parameters}: give 1 to {len(rows)}")
    if only:
        numbers = np.array(sorted(set(only)))
    chunk = min(chunk, len(numbers))
    more = [*(["reference"] if scene.points_are == "loaded" else []), "volume_ratios"]
    identity = {
        "scene": scene_file.read_text(encoding="utf-8-sig"),
        "numbers": resumable_parts.digest(*jax.tree.leaves(scene)),
        "parameters": resumable_parts.digest(rows) + " " + " ".join(names),
        "rows": resumable_parts.digest(numbers),
        "outputs": [*outputs, *(f"probe {p}" for p in probes), *more],
        "chunk": chunk,
        "versions": versions(),
    }
    scene = with_solver(scene, (dict(zip(names, row, strict=True)) for row in rows.tolist()))
    return Sweep(scene, names, rows[numbers - 1], numbers, outputs, probes, chunk, identity)


def read_table(file: Path) -> tuple[tuple[str, ...], np.ndarray]:
    """Read the header and the numbers (N, P) of a CSV file. Lines that begin with # are comments.

    Raises:
        InputError: the file cannot be read or has no rows, a name is missing or occurs twice, a row and the header
            differ in length, or a value is not a finite number.
    """
    try:
        text = file.read_text(encoding="utf-8-sig")
    except (OSError, UnicodeDecodeError) as error:
        reason = getattr(error, "strerror", None) or "not a text file"
        raise InputError(f"{file} cannot be read ({reason}): give a CSV file of parameters") from None
    lines = [line for line in text.splitlines() if line.strip() and not line.lstrip().startswith("#")]
    for mark, name in ((";", "semicolons"), ("\t", "tabs")):
        if lines and mark in lines[0] and "," not in lines[0]:
            raise InputError(f"{file} has {name} between its cells: write commas between cells, and decimal points")
    try:
        table = [[cell.strip() for cell in row] for row in csv.reader(lines)]
    except csv.Error as error:
        raise InputError(f"{file} is not a table ({error}): give a CSV file of parameters") from None
    if len(table) < 2:
        raise InputError(f"{file} has no rows: give a header of dotted names, e.g. law.mu, and one row per run")
    names = tuple(table[0])
    if "" in names:
        raise InputError(
            f"{file}: column {names.index('') + 1} has no name; give a name, or remove the comma of this column"
        )
    if len(set(names)) < len(names):
        raise InputError(f"{file} has two columns {max(names, key=names.count)}: remove one of them")
    rows = []
    for k, row in enumerate(table[1:]):
        if len(row) != len(names):
            raise InputError(
                f"{file}: row {k + 1} has {len(row)} values for {len(names)} names; give one value for each name"
            )
        for name, cell in zip(names, row, strict=True):
            try:
                finite = np.isfinite(number_of(cell))
            except ValueError:
                finite = False
            if not finite:
                raise InputError(f"{file}: row {k + 1}, {name} = {cell!r} is not a finite number; correct this cell")
        rows.append([number_of(cell) for cell in row])
    return names, np.array(rows)


# -- running ----------------------------------------------------------------------------------------------------------


def run(
    sweep: Sweep,
    out: Path,
    resume: bool = False,
    process: tuple[int, int] = (0, 1),
    report: Callable[[int], None] = lambda rows: None,
) -> Done:
    """Run the unfinished parameter sets of a sweep, and write the results to `out`.

    Args:
        sweep: `Sweep`.
        out: file for the results. The parts stay next to it until all parts are finished.
        resume: whether to continue from the parts on disk.
        process: index of this process, and number of processes that share the work.
        report: function that is called after each chunk with the number of runs in it.

    Raises:
        InputError: the results exist already (with one process, and without `resume`), belong to another sweep, or are
            in use by another process.
        OSError: the disk is full; finished chunks are kept.
    """
    folder = resumable_parts.beside(out)
    if out.exists():
        done = _already(sweep, out, resume or process[1] > 1)
        _remove_left(sweep, folder)
        return done
    if folder.exists() and not resume and process[1] == 1:
        raise InputError(f"{folder} contains an unfinished sweep: continue with --resume, or remove this folder")
    resumable_parts.make_folder(folder)
    with resumable_parts.locked(folder / f"lock_{process[0]}"):
        resumable_parts.same(sweep.identity, folder / "sweep.json")
        program, computed = _program(sweep.outputs, sweep.probes), 0
        for k in list(_chunks(sweep))[process[0] :: process[1]]:
            file = resumable_parts.part(folder, k)
            if not resumable_parts.finished(file):
                _write_part(file, sweep, k, program)
                computed += len(_of(sweep, k))
            report(len(_of(sweep, k)))
    return _joined(sweep, out, folder, computed)


def _chunks(sweep: Sweep) -> range:
    return range(-(-len(sweep.rows) // sweep.chunk))


def _of(sweep: Sweep, k: int) -> range:
    return range(k * sweep.chunk, min((k + 1) * sweep.chunk, len(sweep.rows)))


@cache
def _program(outputs: tuple, probes: tuple) -> Callable:
    return jax.jit(partial(_rows, outputs, probes))


def _rows(outputs: tuple, probes: tuple, scene: Scene, values: dict[str, jax.Array]) -> dict[str, jax.Array]:
    batch = simulate_batch(scene, values)
    result, reference = batch.result, batch.reference
    loaded = reference is not None
    every = jax.vmap(lambda r, own, name: OUTPUTS[name](r, own), in_axes=(0, 0 if loaded else None, None))
    stored = {name: every(result, reference if loaded else scene.mesh.points, name) for name in outputs}
    if loaded:
        stored["reference"] = reference
    if probes:
        stored["probes"] = result.positions[:, :, np.array(probes, dtype=int)]
    ratios = jax.vmap(partial(_volume_ratios, scene), in_axes=(0, 0 if loaded else None, 0))
    stored["volume_ratios"] = ratios(values, reference, result.positions[:, -1])
    return stored | {"status": result.status, "residual": result.statistics.residual}


def _volume_ratios(scene: Scene, values: dict[str, jax.Array], reference: jax.Array | None, x: jax.Array) -> jax.Array:
    """Return the minimum and maximum volume ratio J (2,) of a run at positions x (V, 3) [m]."""
    mesh = with_parameters(scene, values).mesh
    J = volume_ratios(mesh if reference is None else with_points(mesh, reference), x.astype(mesh.points.dtype))
    return jnp.stack([jnp.min(J), jnp.max(J)])


def _write_part(file: Path, sweep: Sweep, k: int, program: Callable) -> None:
    chosen = _of(sweep, k)
    # The last chunk is filled with copies of its last row, so that all chunks use the same compiled program.
    filled = np.minimum(chosen.start + np.arange(sweep.chunk), chosen[-1])
    values = {name: sweep.rows[filled, j] for j, name in enumerate(sweep.names)}
    result = program(sweep.scene, values)
    resumable_parts.write(file, {name: np.asarray(value)[: len(chosen)] for name, value in result.items()})


def _already(sweep: Sweep, out: Path, resume: bool) -> Done:
    if not resume:
        raise InputError(f"{out} exists already: give another --out, or remove this file")
    try:
        with h5py.File(out) as file:
            other = _differing(sweep, dict(json.loads(file.attrs["sweep"])))
            if other:
                raise InputError(
                    f"{out} belongs to another sweep (not the same {', '.join(other)}): give another --out, or remove "
                    "this file"
                )
            codes, J = file["status"][:], file["volume_ratios"][:]
    except InputError:
        raise
    except (OSError, KeyError, ValueError, TypeError):
        raise InputError(f"{out} is not the result of a sweep: give another --out, or remove this file") from None
    return Done(out, _failures(sweep, codes), 0, _crushed(sweep, codes, J))


def _differing(sweep: Sweep, stored: dict) -> list[str]:
    """Return the names of the inputs that differ from the input `stored` of existing results. Chunk size, versions and
    order of outputs are not compared."""
    own = json.loads(json.dumps(sweep.identity))
    other = [key for key in ("scene", "numbers", "parameters", "rows") if stored[key] != own[key]]
    return other + ["outputs"] * (set(stored["outputs"]) != set(own["outputs"]))


def _remove_left(sweep: Sweep, folder: Path) -> None:
    """Remove the parts of a finished sweep. Such parts exist if a process was killed before it removed them."""
    with suppress(InputError, OSError), resumable_parts.locked(folder / "lock_join"):
        resumable_parts.same(sweep.identity, folder / "sweep.json")
        resumable_parts.remove(folder)


def _joined(sweep: Sweep, out: Path, folder: Path, computed: int) -> Done:
    """Join all parts into one file if all parts are finished. The process that finishes last does this."""
    files = [resumable_parts.part(folder, k) for k in _chunks(sweep)]
    try:
        with resumable_parts.locked(folder / "lock_join"):
            there = out.exists()
            if not there and not all(f.exists() for f in files):
                return Done(None, {}, computed, {})
            if not there:
                codes, J = _join(sweep, out, files)
    except (InputError, FileNotFoundError):  # another process is joining the parts, or has joined and removed them
        there = out.exists()
        if not there:
            return Done(None, {}, computed, {})
    done = _already(sweep, out, True) if there else Done(out, _failures(sweep, codes), 0, _crushed(sweep, codes, J))
    _remove_left(sweep, folder)
    return done._replace(computed=computed)


#: Number of bytes that HDF5 needs in addition to the datasets.
_HEADERS = 100_000


def _join(sweep: Sweep, out: Path, files: list[Path]) -> tuple[np.ndarray, np.ndarray]:
    """Write the complete file. Return the status codes and `volume_ratios` of all runs."""
    mesh = sweep.scene.mesh
    needed = (
        sum(f.stat().st_size for f in files) + mesh.points.nbytes + meshio_cells(mesh)[1].nbytes + sweep.rows.nbytes
    )
    if shutil.disk_usage(out.parent).free < needed + _HEADERS:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
    n = len(sweep.rows)
    with whole(out) as new, h5py.File(new, "w") as joined:
        for k, file in enumerate(files):
            with h5py.File(file) as part:
                for name, value in part.items():
                    if name not in joined:
                        joined.create_dataset(name, (n, *value.shape[1:]), value.dtype)
                        joined[name].attrs["unit"] = _UNITS.get(name, "m")
                    joined[name][_of(sweep, k).start : _of(sweep, k).stop] = value[:]
        joined["row"], joined["parameters"] = sweep.numbers, sweep.rows
        if len(sweep.names) <= _MOST_NAMES:
            joined["parameters"].attrs["names"] = list(sweep.names)
        else:
            joined["names"] = list(sweep.names)
        if sweep.probes:
            joined["probe_nodes"] = np.array(sweep.probes, dtype=int)
        if "reference" not in joined:  # with a loaded mesh every run has a different reference shape
            joined["reference"] = np.asarray(sweep.scene.mesh.points)
        joined["reference"].attrs["unit"] = "m"
        joined["tetrahedra"] = meshio_cells(sweep.scene.mesh)[1]
        joined.attrs["sweep"] = json.dumps(sweep.identity)
        return joined["status"][:], joined["volume_ratios"][:]


def _failures(sweep: Sweep, codes: np.ndarray) -> dict[int, int]:
    """Return {row number: most severe code} of the runs that failed."""
    worst = np.asarray(status.most_severe(codes, axis=1))
    return {int(sweep.numbers[k]): int(worst[k]) for k in np.flatnonzero(worst != status.CONVERGED)}


def _crushed(sweep: Sweep, codes: np.ndarray, J: np.ndarray) -> dict[int, float]:
    """Return {row number: final J} of the converged runs with a volume ratio J below `LEAST_J` or above `MOST_J`."""
    J = np.where(J[:, :1] < LEAST_J, J[:, :1], J[:, 1:])[:, 0]
    beyond = ((J < LEAST_J) | (J > MOST_J)) & np.all(codes == status.CONVERGED, axis=1)
    return {int(sweep.numbers[k]): float(J[k]) for k in np.flatnonzero(beyond)}
