"""``python -m fitting field SCENE.toml DISPLACEMENTS.csv``: a stiffness map, or a few parameters, of a body."""

import argparse
import sys
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np

from fitting.commands.exit_codes import EXIT_CODES
from fitting.commands.progress import cost_bar
from fitting.fits import field, inclusion, scene_numbers
from fitting.fits.scene_numbers import Problem
from fitting.readers.displacements import read_displacements
from fitting.reports import field_report
from liverjax.core import status
from liverjax.core.errors import InputError
from liverjax.core.files import named_files, writable
from liverjax.core.struct import Content
from liverjax.scenes.scene import numbers_at
from liverjax.scenes.scene_file import load_scene
from liverjax.simulation import gradients

#: A note is given if the error of the mesh or of the time steps, divided by the noise, exceeds this value.
_TOLD = 0.3
#: Defaults of --name and --iterations.
_NAME, _ITERATIONS = "law.mu", 60


def parser(prog: str) -> argparse.ArgumentParser:
    """Return the option parser of the command. --help shows `prog` as the name of the command."""
    command = argparse.ArgumentParser(
        prog=prog,
        description="Find a map of stiffness, or a few parameters of a scene, from displacements measured at some "
        "points. For several loads on one body, give a scene and a file of displacements for each load.",
        epilog=EXIT_CODES,
    )
    command.add_argument(
        "files",
        type=Path,
        nargs="+",
        metavar="SCENE.toml DISPLACEMENTS.csv",
        help="scene, and CSV file with the columns x,y,z (or node),ux,uy,uz[,time][,sd]",
    )
    command.add_argument("--name", metavar="NAME", help=f"parameter to map (default {_NAME})")
    command.add_argument(
        "--length", type=float, metavar="M", help="correlation length [m] (default: length of the body / 10)"
    )
    command.add_argument(
        "--sphere", action="store_true", help="also fit a sphere of another stiffness; the map gives the starting point"
    )
    command.add_argument(
        "--parameters", metavar="NAME,…", help="fit these parameters instead of a map, e.g. law.mu,viscosity.ratios"
    )
    command.add_argument("--noise", type=float, metavar="M", help="standard deviation [m] if a file has no column sd")
    command.add_argument("--unit", default="m", help="unit of the lengths in the displacement files (default m)")
    command.add_argument(
        "--iterations", type=int, help=f"maximum number of iterations for each prior (default {_ITERATIONS})"
    )
    command.add_argument("--resume", action="store_true", help="continue from the last iteration written to --out")
    command.add_argument(
        "--out", type=Path, default=Path("field"), metavar="DIR", help="folder of the results (default field)"
    )
    command.set_defaults(
        optional_files=("field.vtu", "field.h5", "field.png"), kept=lambda options: options.out.glob("progress.h5")
    )
    return command


def _problem(options: argparse.Namespace) -> Problem:
    """Read and check the scenes and displacements of the command line."""
    for name, example in (("length", "0.02"), ("noise", "1e-5"), ("iterations", "30")):
        value = getattr(options, name)
        if value is not None and not (np.isfinite(value) and value > 0):
            raise InputError(f"--{name} {value:g} must be a finite number above 0: give e.g. --{name} {example}")
    if len(options.files) % 2:
        raise InputError(f"{len(options.files)} files were given: give a scene and its displacements, in pairs")
    scenes, data = [], []
    for scene_file, data_file in zip(options.files[::2], options.files[1::2], strict=True):
        scene = load_scene(scene_file)
        if scene.points_are == "loaded" and scene.solve.dt is None:
            raise InputError(
                f'{scene_file}: [mesh] is = "loaded" in a scene without dt: displacements count from this shape, so '
                "they are 0 for all parameters; give the mesh of the unloaded body, or dt and a load that changes"
            )
        scenes.append(scene)
        data.append(own := read_displacements(data_file, scene, options.noise, options.unit))
        if options.noise is not None and np.any(np.isfinite(own.sd) & (own.sd != options.noise)):
            print(f"note: {data_file} has a column sd: --noise is not used for this file", file=sys.stderr)
    return Problem(tuple(scenes), tuple(data))


def run(options: argparse.Namespace) -> int:
    """Find a stiffness map, or a few parameters, of the scenes. The exit code is 1 if a simulation or the fit did not
    converge."""
    return (_map if options.parameters is None else _fit_few_numbers)(options, _problem(options))


def _fit_few_numbers(options: argparse.Namespace, problem: Problem) -> int:
    names = options.parameters.split(",")
    for option in ("name", "length", "iterations", "sphere", "resume"):
        if getattr(options, option):
            raise InputError(f"--{option} is for maps and cannot be used with --parameters: remove one of them")
    for name in names:
        if name.startswith("solve."):
            raise InputError(f"--parameters {name} belongs to the solver, and not to the body: give e.g. law.mu")
        numbers_at(problem.scenes[0], name)
        if names.count(name) > 1:
            raise InputError(f"--parameters names {name} twice: remove one")
        if part := next((other for other in names if other.startswith(f"{name}.")), None):
            raise InputError(f"--parameters names {part}, which is a part of {name}: remove one")
    writable(options.out, ("field.json",), inputs=_inputs(options))
    bar, told = cost_bar("iterations")
    with bar, _unknown_effects() as unknown:
        found = scene_numbers.fit_numbers(problem, names, progress=told)
    print(field_report.table_of_numbers(found))
    _warn(field_report.misfit_sentence(found))
    content = field_report.of_numbers(found)
    content["warnings"] += unknown
    field_report.write(options.out, problem.scenes[0].mesh, _files(options) | content, None)
    print(f"written: {options.out}/field.json")
    return 0 if found.converged else 1


def _map(options: argparse.Namespace, problem: Problem) -> int:
    mesh, name = problem.scenes[0].mesh, options.name or _NAME
    field.start_of(problem, name)
    given = int(field.given_by_regions(problem, name)[0].sum())
    if given:
        print(
            f"note: {given} of {mesh.number_of_elements} elements keep the {name} of their [[region]]: the map "
            "has no value there; to map these elements too, remove this parameter from the region",
            file=sys.stderr,
        )
    files = ("field.json", "field.vtu", "field.h5", "field.png", "progress.h5")
    writable(options.out, files, inputs=_inputs(options))
    kept = sum(gradients.memory(scene) for scene in problem.scenes) / 1e6
    print(f"gradients need about {kept:.0f} MB of memory", file=sys.stderr)
    length = options.length or float(np.ptp(np.asarray(mesh.points), axis=0).max()) / 10
    file = options.out / "progress.h5"
    bar, told = cost_bar("iterations")
    how = field.MapOptions(
        max_iterations=options.iterations or _ITERATIONS, file=file, resume=options.resume, progress=told
    )
    with _unknown_effects() as unknown:
        problem, beside = scene_numbers.with_discretisation_as_noise(problem)
    _tell_sizes(problem, beside)
    if not options.resume:
        file.unlink(missing_ok=True)  # this file is from an earlier run
    with bar, warnings.catch_warnings():
        warnings.filterwarnings("ignore", message="the effect of the (mesh error|time step)")  # already given
        found = field.estimate(problem, name, length, how)
    good = all(c == status.CONVERGED for c in found.codes) and found.distance <= field.FAR
    print(field_report.table_of_field(mesh, found))
    kinds = dict.fromkeys(("mesh", *beside[0]))
    sizes = {f"{kind}_error_over_noise": [each.get(kind, np.nan) for each in beside] for kind in kinds}
    content = _files(options) | {"map": field_report.of_field(mesh, found) | sizes}
    content["map"]["warnings"] += unknown
    for sentence in field_report.map_sentences(mesh, found):
        _warn(sentence)
    if options.sphere:
        with_mesh = any(size > _TOLD for each in beside for size in each.values())
        content["sphere"], converged = _sphere(problem, found, with_mesh)
        good = good and converged
    field_report.write(options.out, mesh, content, found)
    print(f"written: {options.out}/field.json, field.vtu, field.h5, field.png")
    return 0 if good else 1


def _sphere(problem: Problem, found: field.Field, with_mesh: bool) -> tuple[Content, bool]:
    """Fit a sphere that begins at the map. Return its entries in field.json, and whether the fit converged."""
    try:
        start = inclusion.start_from(problem, found)
    except InputError as e:  # the map is complete, so it is written without a sphere
        _warn(str(e))
        return {"warnings": [str(e)]}, False
    with _unknown_effects() as unknown:
        sphere = inclusion.estimate(problem, found.name, start)
    print(field_report.table_of_numbers(sphere))
    small = inclusion.size_sentence(problem.scenes[0].mesh, sphere)
    _warn(field_report.misfit_sentence(sphere, with_mesh))
    _warn(small)
    content = field_report.of_numbers(sphere, with_mesh)
    content["warnings"] += [*unknown, *([small] if small else [])]
    return content, sphere.converged


@contextmanager
def _unknown_effects() -> Iterator[list[str]]:
    """Yield a list. At the end of the context, it contains the warnings that an effect of the mesh or of the time steps
    is unknown. All warnings are given at the end of the context."""
    found: list[str] = []
    with warnings.catch_warnings(record=True) as given:
        warnings.simplefilter("always")
        yield found
    for one in given:
        warnings.warn_explicit(one.message, one.category, one.filename, one.lineno)
    sentences = dict.fromkeys(str(one.message) for one in given)
    found += [sentence for sentence in sentences if sentence.startswith("the effect of the ")]


def _tell_sizes(problem: Problem, beside: list[dict[str, float]]) -> None:
    """Print a note if the errors of the meshes or the time steps are large compared with the noise. `beside`: for each
    scene, the size of each error divided by the noise."""
    linear = any(scene.mesh.order == 1 for scene in problem.scenes)
    remedies = {"mesh": "a finer mesh, or order = 2," if linear else "a finer mesh", "time_step": "smaller time steps"}
    for kind in beside[0]:
        size = max(each[kind] for each in beside)
        if size > _TOLD:
            finer = f"; {remedies[kind]} would give more information" if size > 1 else ""
            print(
                f"note: the error of the {kind.replace('_', ' ')} is {size:.2g} times the noise, and is treated as "
                f"noise{finer}",
                file=sys.stderr,
            )


def _warn(sentence: str | None) -> None:
    if sentence is not None:
        print(f"warning: {sentence}", file=sys.stderr)


def _inputs(options: argparse.Namespace) -> list[Path]:
    """Return the scenes, the files that they name, and the displacements."""
    return [*options.files, *(named for scene in options.files[::2] for named in named_files(scene))]


def _files(options: argparse.Namespace) -> dict:
    return {"files": [str(f) for f in options.files]}
