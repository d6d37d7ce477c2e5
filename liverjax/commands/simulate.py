"""``liverjax simulate SCENE.toml``: run a scene file."""

import argparse
import sys
from pathlib import Path
from typing import TYPE_CHECKING

from liverjax.commands import harmonic
from liverjax.commands.arguments import add_out
from liverjax.core.errors import InputError
from liverjax.core.files import named_files, writable

if TYPE_CHECKING:
    from liverjax.jobs.long_run import Ran
    from liverjax.scenes.scene import Scene

#: Default of --every.
_EVERY = 50


def add(parsers: argparse._SubParsersAction) -> None:
    """Add the command to the parser."""
    command = parsers.add_parser("simulate", help="run a scene file", description="Run a scene file.")
    command.add_argument("scene", type=Path, metavar="SCENE.toml")
    command.add_argument("--vtu", action="store_true", help="also write a series of files for ParaView")
    command.add_argument("--png", action="store_true", help="also draw the last state")
    command.add_argument(
        "--every", type=int, metavar="N", help=f"write the results after each N steps (default {_EVERY})"
    )
    command.add_argument("--resume", action="store_true", help="continue a run that was stopped")
    command.add_argument(
        "--fields", metavar="NAMES", help="fields to write, separated by commas: cauchy_stress,volume_ratio,…"
    )
    command.add_argument(
        "--reactions", action="store_true", help="write the reaction forces at all steps as a CSV file"
    )
    command.add_argument("--mesh-error", action="store_true", help="estimate the error of the result due to the mesh")
    command.add_argument(
        "--about",
        type=Path,
        metavar="RESULT.h5",
        help="only for kind = 'harmonic': the body vibrates about the last state of this run",
    )
    add_out(command)
    command.set_defaults(
        run=run,
        optional_files=("reactions.csv", "result.png", "vtu"),
        kept=lambda options: options.out.glob("result.h5.parts/*"),
    )


def run(options: argparse.Namespace) -> int:
    """Simulate the scene and write the results of all steps. Return 1 if a step failed."""
    import numpy as np
    from tqdm import tqdm

    from liverjax.core import status
    from liverjax.core.struct import replace
    from liverjax.jobs import fields, long_run, output
    from liverjax.scenes import scene_file
    from liverjax.simulation.cautions.of_run import cautions_of_run
    from liverjax.simulation.run import unloaded

    scene, text = scene_file.load_scene(options.scene), options.scene.read_text(encoding="utf-8-sig")
    names, reactions = _asked_for(options, scene, text)
    if scene.solve.kind == "harmonic":
        return harmonic.run(options, scene, text)
    _check_before_steps(options, scene)
    target = options.out / "result.h5"
    _check_outputs(options, target, reactions)
    long_run.refuse_unfinished(target, options.resume, text)
    given = scene.points_are
    if given == "loaded":
        scene = unloaded(scene).scene
    bar = tqdm(total=scene.solve.steps, unit="step", disable=None, leave=False)  # tqdm shows it only on a terminal
    report = None if bar.disable else lambda _: bar.update()
    try:
        ran, scene = _reduced(scene)
        in_parts = ran is None
        if ran is None:
            ran = long_run.run(scene, text, target, _steps_per_part(options), options.resume, report)
    except OSError as error:
        print(
            f"stopped, because {target} cannot be written ({error.strerror}): free disk space, then use --resume",
            file=sys.stderr,
        )
        return 1
    finally:
        bar.close()
    ran, unknown = _with_mesh_error(scene, ran) if options.mesh_error else (ran, [])
    found = fields.fields(scene, ran.result, names) if names else {}
    said = [*cautions_of_run(replace(scene, points_are=given), ran.result), *unknown]
    _write_and_tell((scene, text, said), ran, target, found)
    written = [str(target)]
    if reactions:
        output.write_reactions(options.out / "reactions.csv", scene, ran.result)
        written.append(str(options.out / "reactions.csv"))
    if options.vtu:
        written.append(str(output.write_vtu(options.out / "vtu", scene, ran.result, found)))
    if options.png:
        output.picture(options.out / "result.png", scene, ran.result)
        written.append(str(options.out / "result.png"))
    if in_parts:
        long_run.remove_parts(target)
    print(f"written: {', '.join(written)}")
    codes = np.asarray(ran.result.status)
    for step in np.flatnonzero(codes != status.CONVERGED)[:5]:
        print(f"failed: step {step + 1}: {status.advice(codes[step])}", file=sys.stderr)
    return 1 if np.any(codes != status.CONVERGED) else 0


def _asked_for(options: argparse.Namespace, scene: "Scene", text: str) -> tuple[list[str], bool]:
    """Return the names of the fields to write, and whether reactions are written, from the command line and from
    [output]."""
    import tomllib

    from liverjax.jobs import fields
    from liverjax.scenes.scene_file import output_of

    names, reactions = output_of(tomllib.loads(text))
    if options.fields:
        names = list(dict.fromkeys([*names, *options.fields.split(",")]))
    fields.check(names, scene)
    return names, reactions or options.reactions


def _check_before_steps(options: argparse.Namespace, scene: "Scene") -> None:
    """Raise `InputError` if a static or dynamic scene and the options cannot be used together."""
    from liverjax.jobs.long_run import check_every
    from liverjax.simulation.mesh_error import refuse

    if options.about:
        raise InputError("--about can be used only with [solve] kind = 'harmonic': remove --about")
    check_every(_steps_per_part(options))
    if scene.solve.reduced and scene.points_are == "loaded":
        from liverjax.reduced.model import refuse_unknown_physics

        refuse_unknown_physics(scene)
    if options.mesh_error:
        refuse(scene)


def _check_outputs(options: argparse.Namespace, target: Path, reactions: bool) -> None:
    """Raise `InputError` if one of the results cannot be written."""
    asked = {target.name: True, "reactions.csv": reactions, "result.png": options.png, "vtu/step_*.vtu": options.vtu}
    files = tuple(name for name, wanted in asked.items() if wanted)
    writable(options.out, files, ("vtu",) if options.vtu else (), [options.scene, *named_files(options.scene)])


def _reduced(scene: "Scene") -> tuple["Ran | None", "Scene"]:
    """Return (run, scene): the run with the reduced model, or None if the full model has to run; and the scene without
    the reduced model."""
    if not scene.solve.reduced:
        return None, scene
    from liverjax.core.struct import replace
    from liverjax.jobs import reduction

    ran, said = reduction.tried(scene)
    print(said)
    return ran, replace(scene, solve=replace(scene.solve, reduced=""))


def _steps_per_part(options: argparse.Namespace) -> int:
    return _EVERY if options.every is None else options.every


def _with_mesh_error(scene: "Scene", ran: "Ran") -> tuple["Ran", list[str]]:
    """Return the run with its estimated mesh error. If this error cannot be estimated, also return the reason."""
    from liverjax.core.compiled import compiled
    from liverjax.core.struct import replace
    from liverjax.simulation.mesh_error import estimated_error, richer
    from liverjax.simulation.run import prepared

    scene, result = prepared(scene), ran.result
    try:
        arguments = (scene, richer(scene), result.positions, result.reactions, result.pressure)
        error = compiled(estimated_error, *arguments)(*arguments)
    except InputError as e:  # the result of the run is still written, without its mesh error
        return ran, [str(e)]
    return ran._replace(result=replace(result, mesh_error=error)), []


def _sizes_of_places(scene: "Scene") -> list[str]:
    """Return one line per traction with its area, and one line per region with its share of the volume. The user
    should check these sizes, because only whole triangles and whole elements are selected."""
    import numpy as np

    from liverjax.mesh.surface import areas

    out, volumes = [], np.asarray(scene.mesh.volumes)
    for k, load in enumerate(scene.traction):
        area = float(np.linalg.norm(np.asarray(areas(scene.mesh.points, load.triangles)), axis=1).sum())
        out.append(f"traction.{k} acts on {area:.4g} m^2")
    for k, region in enumerate(scene.region):
        out.append(
            f"region.{k} is {100 * volumes[np.asarray(region.elements)].sum() / volumes.sum():.3g} % of the volume"
        )
    return out


def _write_and_tell(given: tuple["Scene", str, list[str]], ran: "Ran", target: Path, found: dict) -> None:
    """Write the results with the content of the scene file and the warnings. Print the warnings and the statistics of
    the run."""
    import numpy as np

    from liverjax.core.versions import versions
    from liverjax.jobs import output
    from liverjax.physics import porosity
    from liverjax.scenes.by_element import by_element
    from liverjax.simulation.cautions.of_mesh import mesh_sentence

    scene, text, said = given
    attributes = {"scene": text, "run_time_s": ran.run_time, "compile_time_s": ran.compile_time}
    if scene.porosity is not None:
        own = by_element(scene)
        assert own.porosity is not None
        attributes["bulk"] = porosity.bulk_in_force(own.porosity, own.law)
        print(attributes["bulk"])
    attributes |= {"warnings": said, "versions": versions()}
    output.write_hdf5(target, scene, ran.result, attributes, found, ran.beside)
    s, steps = ran.result.statistics, len(ran.result.times)
    print(
        f"{scene.mesh.number_of_nodes} nodes, {scene.mesh.number_of_elements} tetrahedra, {steps} steps: "
        f"{int(np.sum(s.iterations))} Newton and {int(np.sum(s.linear_iterations))} linear iterations, "
        f"largest residual {float(np.max(np.asarray(s.residual))):.1e} of the forces\n"
        + (f"run {ran.run_time:.3g} s ({ran.steps / ran.run_time:.3g} steps per second), " if ran.steps else "")
        + f"compile {ran.compile_time:.3g} s"
        + (f"; {steps - ran.steps} steps found on disk" if ran.steps < steps else "")
    )
    for line in _sizes_of_places(scene):
        print(line)
    for sentence in said:
        print(f"caution: {sentence}")
    if ran.result.mesh_error is not None:
        print(mesh_sentence(scene, ran.result))
