"""``python -m fitting indentation CURVE.csv``: modulus and contact point from an indenter on a layer."""

import argparse
import sys
from pathlib import Path

from fitting.commands.exit_codes import EXIT_CODES
from liverjax.core.errors import InputError

COLUMNS = """The file has columns of depth (or displacement, indentation) and force (or load) with their units, e.g.
depth_um,force_mN. Points after the deepest one are ignored. """


def parser(prog: str) -> argparse.ArgumentParser:
    """Return the option parser of the command. --help shows `prog` as the name of the command."""
    command = argparse.ArgumentParser(
        prog=prog,
        description="Identify Young's modulus and the contact point from an indentation curve: a rigid sphere, cone "
        "or flat punch on a layer that is bonded to its base. Small strains, no friction, no adhesion.",
        epilog=COLUMNS + EXIT_CODES,
    )
    command.add_argument("file", type=Path, metavar="CURVE.csv", help="depth and force")
    command.add_argument("--shape", choices=("sphere", "cone", "punch"), default="sphere", help="default sphere")
    command.add_argument("--radius", type=float, default=0.0, metavar="M", help="radius of sphere or punch [m]")
    command.add_argument("--half-angle", type=float, metavar="DEG", help="cone: angle from axis to side (default 45)")
    command.add_argument("--thickness", type=float, required=True, metavar="M", help="thickness of the layer [m]")
    command.add_argument("--poisson", type=float, default=0.5, metavar="NU", help="Poisson's ratio (default 0.5)")
    command.add_argument(
        "--out",
        type=Path,
        default=Path("indentation"),
        metavar="DIR",
        help="folder of the results (default indentation)",
    )
    return command


#: LARGEST: largest radius [m] that is accepted. THICK: a layer thickness [m] above this is probably a mistake.
LARGEST, THICK = 0.2, 1.0
#: Half-angle [degrees] of a cone if none is given.
HALF_ANGLE = 45.0


def _notes_on_shape(options: argparse.Namespace) -> list[str]:
    """Return notes on an assumed angle, on options without effect for this shape, and on a very large thickness."""
    cone, told = options.shape == "cone", []
    if cone and options.half_angle is None:
        told.append(
            f"a half-angle of {HALF_ANGLE:g} degrees is assumed; --half-angle sets another value. E is proportional "
            "to 1/tan(half-angle)"
        )
    if not cone and options.half_angle is not None:
        told.append(f"--half-angle is for a cone, and has no effect for a {options.shape}")
    if cone and options.radius:
        told.append("--radius is for a sphere or a punch, and has no effect for a cone")
    if options.thickness > THICK:
        told.append(f"--thickness is in metres: a layer of {options.thickness:g} m acts as a half-space")
    return told


def run(options: argparse.Namespace) -> int:
    """Fit the curve. The exit code is 1 if the modulus is not positive."""
    from fitting.methods.contact_point import SHALLOWEST, beyond, fit_with_offset, fit_without_tilt
    from fitting.readers.indentation_curves import read_indentation
    from fitting.reports import indentation_report
    from fitting.rigs.thin_layer import Indenter, Layer
    from liverjax.core.files import writable

    if options.shape != "cone" and options.radius == 0:
        raise InputError(f"the radius of a {options.shape} must be above 0: give it in metres, e.g. --radius 0.001")
    if options.shape != "cone" and options.radius > LARGEST:
        raise InputError(
            f"--radius {options.radius:g} must be in metres, and at most 0.2: give e.g. --radius "
            f"{options.radius / 1000:g}"
        )
    angle = HALF_ANGLE if options.half_angle is None else options.half_angle
    rig = Indenter(options.shape, options.thickness, options.poisson, options.radius, angle)
    layer, curve = Layer(rig), read_indentation(options.file)
    for note in (*_notes_on_shape(options), *curve.notes):
        print(f"note: {note}", file=sys.stderr)
    writable(options.out, ("fit.json", "fit.png"), inputs=[options.file])
    found = None
    if layer.deepest > 2 * SHALLOWEST * (curve.depth.max() - curve.depth.min()):
        found = fit_with_offset(curve.depth, curve.force, layer.force, layer.deepest)
    if found is None or beyond(found, curve.depth, layer.deepest):
        raise InputError(
            f"{options.file}: the deepest point is {layer.deepest:.4g} m or more after contact, but for this layer and "
            f"indenter only depths up to {layer.deepest:.4g} m can be computed: remove the deepest points"
        )
    level = fit_without_tilt(curve.depth, curve.force, layer.force, found, layer.deepest)
    level = None if level is None or beyond(level, curve.depth, layer.deepest) else level
    content = indentation_report.write(options.out, curve, rig, found, level)
    print(indentation_report.table(rig, found, content))
    for sentence in content["warnings"]:
        print(f"warning: {sentence}", file=sys.stderr)
    print(f"written: {options.out}/fit.json, fit.png")
    return 0 if found.modulus > 0 else 1
