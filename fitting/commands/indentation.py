"""``python -m fitting indentation CURVE.csv``: modulus and contact point from an indenter on a layer."""

import argparse
import sys
from pathlib import Path

from fitting.commands.exit_codes import EXIT_CODES

COLUMNS = """The file has columns of depth (or displacement, indentation) and force (or load) with their units, e.g.
depth_um,force_mN. Points after the deepest one are left out. """


def parser(prog: str) -> argparse.ArgumentParser:
    """Options of the command; --help shows `prog` as its name."""
    command = argparse.ArgumentParser(
        prog=prog,
        description="Identify Young's modulus and the contact point from an indentation curve: a rigid sphere, cone or "
        "flat punch on a layer that is bonded below. Small strains, no friction, no adhesion.",
        epilog=COLUMNS + EXIT_CODES,
    )
    command.add_argument("file", type=Path, metavar="CURVE.csv", help="depth and force")
    command.add_argument("--shape", choices=("sphere", "cone", "punch"), default="sphere", help="default sphere")
    command.add_argument("--radius", type=float, default=0.0, metavar="M", help="radius of sphere or punch [m]")
    command.add_argument("--half-angle", type=float, default=45.0, metavar="DEG", help="cone: from axis to side")
    command.add_argument("--thickness", type=float, required=True, metavar="M", help="thickness of the layer [m]")
    command.add_argument("--poisson", type=float, default=0.5, metavar="NU", help="Poisson's ratio (default 0.5)")
    command.add_argument(
        "--out", type=Path, default=Path("indentation"), metavar="DIR", help="folder of the results (indentation)"
    )
    return command


def run(options: argparse.Namespace) -> int:
    """Fit the curve; exit code 1 if the modulus is not positive."""
    from fitting.methods.contact_point import fit_contact
    from fitting.readers.indentation_curves import read_indentation
    from fitting.reports import indentation_report
    from fitting.rigs.thin_layer import Indenter, Layer
    from liverjax.core.files import writable

    rig = Indenter(options.shape, options.thickness, options.poisson, options.radius, options.half_angle)
    layer, curve = Layer(rig), read_indentation(options.file)
    for note in curve.notes:
        print(f"note: {note}", file=sys.stderr)
    writable(options.out, ("fit.json", "fit.png"))
    found = fit_contact(curve.depth, curve.force, layer.force)
    content = indentation_report.write(options.out, curve, rig, found)
    print(indentation_report.table(rig, found, content))
    for sentence in content["warnings"]:
        print(f"warning: {sentence}", file=sys.stderr)
    print(f"written: {options.out}/fit.json, fit.png")
    return 0 if found.modulus > 0 else 1
