"""Run ``liverjax simulate SCENE.toml`` for a scene with kind = "harmonic"."""

import argparse
import sys
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from liverjax.core.errors import InputError
from liverjax.core.files import named_files, writable

if TYPE_CHECKING:
    from liverjax.jobs.waves import Waves
    from liverjax.scenes.scene import Scene


def run(options: argparse.Namespace, scene: "Scene", text: str) -> int:
    """Compute the scene's harmonic motion and write the results. Return 1 if a frequency has no solution."""
    from liverjax.core.versions import versions
    from liverjax.jobs import waves

    target = options.out / "result.h5"
    _refuse_options(options, target)
    files, folders = ((target.name, "vtu/frequency_*.vtu"), ("vtu",)) if options.vtu else ((target.name,), ())
    writable(options.out, files, folders, [options.scene, *named_files(options.scene)])
    ran = waves.solved_waves(scene, options.about, options.mesh_error)
    waves.write_waves(
        target, scene, ran, {"scene": text, "run_time_s": ran.seconds, "warnings": ran.cautions, "versions": versions()}
    )
    written = [str(target)]
    if options.vtu:
        written.append(str(waves.write_waves_vtu(options.out / "vtu", scene, ran.found)))
    _tell(scene, ran)
    print(f"written: {', '.join(written)}")
    try:
        ran.found.check()
    except RuntimeError as error:
        print(f"failed: {error}", file=sys.stderr)
        return 1
    return 0


def _refuse_options(options: argparse.Namespace, target: Path) -> None:
    given = {"fields": options.fields, "reactions": options.reactions, "png": options.png, "resume": options.resume}
    for name, value in (given | {"every": options.every is not None}).items():
        if value:
            raise InputError(f"--{name} cannot be used with [solve] kind = 'harmonic': remove this option")
    if options.about is not None and options.about.resolve() == target.resolve():
        raise InputError(f"--about {options.about} would be replaced by the results: give another --out")


def _tell(scene: "Scene", ran: "Waves") -> None:
    from liverjax.jobs.waves import missing_parts
    from liverjax.waves.harmonic import largest_in_period

    u = largest_in_period(np.asarray(ran.found.displacement))
    parts = None if ran.mesh_error is None else missing_parts(scene, ran)
    print(
        f"{scene.mesh.number_of_nodes} nodes, {scene.mesh.number_of_elements} tetrahedra, {len(u)} frequencies in "
        f"{ran.seconds:.3g} s including compilation"
    )
    for k, frequency in enumerate(np.asarray(ran.found.frequencies_Hz)):
        line = (
            f"{frequency:g} Hz: largest displacement {1e3 * u[k].max():.4g} mm, residual "
            f"{float(ran.found.residual[k]):.1e}"
        )
        if parts is not None:
            motion, force = (float(part[k]) for part in parts)
            line += (
                ", nothing moves"
                if np.isnan(motion)
                else f", mesh error about {motion:.2g} of the displacement (root mean square)"
            )
            line += "" if np.isnan(force) else f" and {force:.2g} of the reaction forces"
        print(line)
    for sentence in ran.cautions:
        print(f"caution: {sentence}")
