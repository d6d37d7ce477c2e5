"""``python -m fitting waves DATA --frequencies HZ …``: complex moduli of an organ from waves on voxels."""

import argparse
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from fitting.commands.exit_codes import EXIT_CODES
from fitting.commands.progress import cost_bar
from fitting.waves.shear_waves import DENSITY
from liverjax.core.errors import InputError
from liverjax.core.files import writable

if TYPE_CHECKING:
    from fitting.waves.elastography import Organ
    from fitting.waves.kept_regions import Keep
    from fitting.waves.voxels import VoxelBody
    from fitting.waves.wave_field import WaveField

FILES = ("waves.json", "waves.h5", "waves.vtu", "waves.png", "progress.h5", "progress_of_regions.h5")
#: MOST_MEMORY: maximum memory of one matrix factor [GB]. A body that needs more is divided into parts, or the grid is
#: made coarser. MOST_OF_MAP: maximum number of values of a map in a divided body, because the matrices of such a map
#: are dense.
MOST_MEMORY, MOST_OF_MAP = 4.0, 5000
#: Maximum correlation length of a map, divided by the size of the organ. With a larger length, the map would be
#: uniform.
LONGEST = 5.0


def parser(prog: str) -> argparse.ArgumentParser:
    """Return the option parser of the command. --help shows `prog` as the name of the command."""
    command = argparse.ArgumentParser(
        prog=prog,
        description="Find storage and loss modulus of an organ from harmonic waves on voxels (elastography). Results "
        "are for the whole organ, for regions, and as a map, each with standard deviations. The usual direct inversion "
        "is computed too.",
        epilog=EXIT_CODES,
    )
    command.add_argument(
        "data",
        type=Path,
        metavar="DATA",
        help="file of complex displacements: .npz, .npy, .h5, .mat, .csv, .nii, .nii.gz",
    )
    command.add_argument(
        "--frequencies", type=float, nargs="+", metavar="HZ", help="frequencies [Hz], if DATA contains none"
    )
    command.add_argument(
        "--mask", type=Path, metavar="FILE", help="file of the voxels of the organ, if DATA has no mask"
    )
    command.add_argument("--labels", type=Path, metavar="FILE", help="file with the number of the region of each voxel")
    command.add_argument("--unit", help="unit of the displacements: m, mm or um (default m)")
    command.add_argument(
        "--spacing", type=float, nargs=3, metavar="M", help="spacing of the voxels [m], if the file states no spacing"
    )
    command.add_argument(
        "--noise",
        type=float,
        metavar="M",
        help="standard deviation of one component (default: estimated from the data)",
    )
    command.add_argument(
        "--density",
        type=float,
        default=DENSITY,
        metavar="KG_M3",
        help=f"density of the organ [kg/m^3] (default {DENSITY:g})",
    )
    command.add_argument("--stride", type=int, metavar="N", help="use means of N x N x N voxels (default: as needed)")
    command.add_argument("--no-map", action="store_true", help="fit only the whole organ and the regions")
    command.add_argument(
        "--length", type=float, metavar="M", help="correlation length of the map [m] (default 4 voxels)"
    )
    command.add_argument(
        "--samples", type=int, default=20, metavar="N", help="number of maps drawn from the posterior (default 20)"
    )
    command.add_argument("--resume", action="store_true", help="continue from the last step written to --out")
    command.add_argument("--out", type=Path, default=Path("waves"), metavar="DIR", help="folder (default waves)")
    command.set_defaults(
        optional_files=(*FILES[2:4], "sweep_*.csv"), kept=lambda options: options.out.glob("progress*.h5")
    )
    return command


def run(options: argparse.Namespace) -> int:
    """Find the moduli of the organ and its regions, and a map. The exit code is 1 if a fit did not converge."""
    _check_waves(options)
    from fitting.reports.waves import report
    from fitting.waves import direct_inversion, elastography, stiffness_map, wave_field

    field = wave_field.read_waves(
        options.data, options.frequencies, options.mask, options.labels, options.unit, options.spacing
    )
    field = wave_field.with_noise(field, options.noise)
    inputs = [path for path in (options.data, options.mask, options.labels) if path]
    writable(options.out, (*FILES, "sweep_*.csv"), inputs=inputs)
    coarse, body = _coarse_and_body(options, field)
    if not options.no_map:
        _check_length_of_map(options.length, body)
    for note in field.notes:
        print(f"note: {note}", file=sys.stderr)
    bar, told = cost_bar("steps")
    with bar, _forces_that_balance(options.data):
        organ = elastography.organ_of(coarse, body, options.density)
        found = elastography.regions_of(organ, told, _kept_regions(options, organ))
        drawn = None
        if not options.no_map:
            length = options.length or float(4 * np.mean(organ.field.spacing))
            file = options.out / "progress.h5"
            problem = elastography.problem_of_map(organ, found, length)
            drawn = stiffness_map.map_of(problem, file, options.resume, options.samples, told)
    usual = direct_inversion.invert(organ.field, options.density)
    content = report.write(options.out, organ, found, drawn, usual)
    print(report.table(content))
    for sentence in content["warnings"]:
        print(f"warning: {sentence}", file=sys.stderr)
    files = FILES[:4] if drawn is not None else FILES[:2]
    print(f"written: {options.out}/{', '.join(files)}")
    good = np.all(found.whole.converged) and (found.parts is None or np.all(found.parts.converged))
    return 0 if good and (drawn is None or drawn.distance <= stiffness_map.FAR) else 1


def _check_length_of_map(length: float | None, body: "VoxelBody") -> None:
    size = float(np.ptp(np.asarray(body.mesh.points), axis=0).max())
    if length is not None and length > LONGEST * size:
        raise InputError(
            f"--length {length:g} m is much longer than the organ ({size:.2g} m), so the map would be uniform: give "
            f"metres, e.g. {size / 4:.1g}, or --no-map"
        )


def _kept_regions(options: argparse.Namespace, organ: "Organ") -> "Keep":
    from fitting.waves import kept_regions

    marks = kept_regions.marks_of(
        *organ.waves, organ.body.voxel, spacing=organ.field.spacing, labels=organ.field.labels, density=organ.density
    )
    progress = [options.out / name for name in FILES[4:]]
    if not options.resume:
        for file in progress:  # these files are from an earlier run
            file.unlink(missing_ok=True)
    elif not any(file.is_file() for file in progress):
        print(f"note: {options.out} contains no files to resume, so a new search begins", file=sys.stderr)
    return kept_regions.kept_in(progress[1], options.resume, marks)


@contextmanager
def _forces_that_balance(data: Path) -> Iterator[None]:
    """Raise an `InputError` if the equations of the fit inside the `with` block have no solution."""
    try:
        yield
    except np.linalg.LinAlgError:
        raise InputError(
            f"{data}: no modulus balances the forces of these waves; check the mask, the spacing, the units and the "
            "noise"
        ) from None


def _coarse_and_body(options: argparse.Namespace, field: "WaveField") -> tuple["WaveField", "VoxelBody"]:
    """Return the field to fit and the body of its voxels. A body that is too large is divided into parts. If this is
    not enough, the voxels are made coarser."""
    from fitting.waves import elastography, wave_field

    stride = options.stride or 1
    while True:
        coarse = wave_field.coarsened(field, stride)
        body = elastography.body_that_fits(coarse, MOST_MEMORY, None if options.no_map else MOST_OF_MAP)
        if body is not None:
            break
        if options.stride:
            raise InputError(
                f"--stride {stride} needs more than {MOST_MEMORY:g} GB for each of {len(field.frequencies)} "
                f"frequencies, or for the map: give --stride {stride + 1}, or a smaller --mask"
            )
        stride += 1
    if stride > 1:
        print(f"note: means over {stride} x {stride} x {stride} voxels are used", file=sys.stderr)
    parts = int(body.part.max()) + 1
    if parts > 1:
        print(
            f"note: the organ is divided into {parts} parts. Forces are not balanced where parts meet, so errors are "
            "larger than without this division",
            file=sys.stderr,
        )
    for note in (*elastography.notes_on_gaps(coarse), *elastography.notes_on_layers(coarse)):
        print(f"note: {note}", file=sys.stderr)
    return coarse, body


def _check_waves(options: argparse.Namespace) -> None:
    """Raise an error for values that are impossible in a measurement."""
    for name in ("length", "noise"):
        value = getattr(options, name)
        if value is not None and not (np.isfinite(value) and value > 0):
            example = {"length": "0.004", "noise": "2e-7"}[name]
            raise InputError(f"--{name} {value:g} must be above 0: give a length in metres, e.g. {example}")
    if not 100 <= options.density <= 25000:
        raise InputError(
            f"--density {options.density:g} cannot be the density of an organ in kg/m^3: give e.g. --density 1060"
        )
    if options.stride is not None and options.stride < 1:
        raise InputError(f"--stride {options.stride} is the number of voxels in a mean: give 1 or more")
    if options.samples < 0:
        raise InputError(f"--samples {options.samples}: the number of sampled maps must be 0 or more")
    for hertz in options.frequencies or ():
        if not (np.isfinite(hertz) and 0 < hertz <= 1e5):
            raise InputError(f"--frequencies {hertz:g} must be above 0 Hz: give e.g. --frequencies 60")
