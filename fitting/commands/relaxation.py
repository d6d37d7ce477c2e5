"""``python -m fitting relaxation FILE`` and ``… creep FILE``: Prony modes from a relaxation or creep test."""

import argparse
import sys
from pathlib import Path
from typing import TYPE_CHECKING

from fitting.commands import shared_options
from fitting.commands.exit_codes import EXIT_CODES
from liverjax.core.errors import InputError

if TYPE_CHECKING:
    from fitting.readers.time_tests import TimeTest

COLUMNS = """The file has a column of time and one of these: relaxation_modulus_Pa (creep: creep_compliance_1/Pa);
strain and stress_Pa; angle_rad and torque_N.m; displacement_m and force_N. With two columns, the measured load
is imposed on the model, including the ramp. Torque and force need the size of the sample. """


def parser(prog: str) -> argparse.ArgumentParser:
    """Return the option parser of the command. --help shows `prog` as the name of the command."""
    kind = prog.split()[-1]
    command = argparse.ArgumentParser(
        prog=prog,
        description=f"Identify a generalised Maxwell (Prony) model from a {kind} test, in closed form.",
        epilog=COLUMNS + EXIT_CODES,
    )
    command.set_defaults(kind=kind)
    command.add_argument(
        "file",
        type=Path,
        metavar="FILE",
        help="file of the test (CSV, TRIOS or RheoCompass text), or a TOML description of a test rig",
    )
    shared_options.add_modes(command)
    command.add_argument(
        "--model",
        choices=("prony", "fractional", "spectrum", "auto"),
        default="prony",
        help="free Prony modes (default), springpots, a smooth spectrum, or the best by the information criterion",
    )
    command.add_argument(
        "--ramp",
        type=float,
        metavar="S",
        help="duration [s] of the rise of the load before the first row under load, if no row shows it; 0: a step",
    )
    command.add_argument(
        "--min-time", type=float, default=0.0, metavar="S", help="ignore responses before this time of the file"
    )
    command.add_argument("--radius", type=float, metavar="M", help="radius of the sample [m], for torque and force")
    command.add_argument("--height", type=float, metavar="M", help="height of the sample [m], for torque and force")
    shared_options.add_cards_and_samples(command)
    command.add_argument(
        "--out", type=Path, default=Path(kind), metavar="DIR", help=f"folder of the results (default {kind})"
    )
    command.set_defaults(optional_files=("posterior.csv", "cards"))
    return command


def _in_its_rig(options: argparse.Namespace) -> "TimeTest":
    """Read the test that a TOML file describes. Raise an error for options that belong in the file."""
    from fitting.rigs.described import read_described

    for name in ("radius", "height", "ramp", "min_time"):
        if getattr(options, name) or (name == "ramp" and options.ramp is not None):
            option = f"--{name.replace('_', '-')}"
            raise InputError(f"{option} belongs in the file {options.file} that describes the test: remove the option")
    test = read_described(options.file)
    if test.kind != options.kind:
        raise InputError(
            f"{options.file} is a {test.kind} test: call python -m fitting {test.kind}, or give drive = "
            f"'{'displacement' if options.kind == 'relaxation' else 'force'}' in the file"
        )
    return test


def _said_of_rows(test: "TimeTest") -> list[str]:
    """Return a note if only some rows of a long record are fitted, and a note on the time before the first response."""
    from fitting.fits.time_tests import thinned

    number, every, told = len(thinned(test)), int(test.used.sum()), []
    if number < every:
        told.append(
            f"{number} of {every} points are fitted; they are spread about evenly over the logarithm of the time after "
            "each load change"
        )
    first, last = test.resolved
    if test.answers_at_once:
        return told
    told.append(
        f"the responses begin {first:.3g} s after the load, and end at {last:.3g} s: G0 does not contain the stress "
        "that relaxed before the first response"
    )
    return told


def run(options: argparse.Namespace) -> int:
    """Fit the test. The exit code is 1 if the fit did not converge although the test shows relaxation."""
    from fitting.fits import time_tests
    from fitting.fits.families import springpots_in_time as fits
    from fitting.fits.honesty import total_error
    from fitting.fits.simulated_rheometer import Simulation
    from fitting.readers import time_tests as reader
    from fitting.reports import time_report

    for name in ("radius", "height"):
        value = getattr(options, name)
        if value is not None and not 0 < value <= 0.2:
            raise InputError(f"--{name} {value:g} cannot be a sample's {name} in metres: give e.g. --{name} 0.004")
    shared_options.check_samples(options.samples)
    if options.modes != "auto" and options.model != "prony":
        raise InputError(f"--modes works only with --model prony: remove --modes for --model {options.model}")
    if options.samples is not None and options.model == "spectrum":
        raise InputError("--samples works only with models of a few parameters: remove --samples for --model spectrum")
    out = options.out
    sample = reader.Sample(options.radius, options.height)
    if options.file.suffix.lower() == ".toml":
        test = _in_its_rig(options)
    else:
        test = reader.read_time_test(options.file, options.kind, sample, options.ramp, options.min_time)
    for note in (*test.notes, *_said_of_rows(test)):
        print(f"note: {note}", file=sys.stderr)
    shared_options.prepare_outputs(options, ("fit.json", "fit.png"), [options.file])
    found = fits.choose_in_time(test, options.model, options.modes)
    if options.file.suffix.lower() != ".toml":  # only a test in a rheometer has this error
        default = Simulation()
        rig = Simulation(radius=options.radius or default.radius, height=options.height or default.height)
        found.details["geometry_error"] = total_error.of_geometry(rig, None, test.axial)
    posterior = None
    if options.samples and shared_options.has_draws(found.kind):
        from fitting.fits.posterior import of_time_test

        posterior = of_time_test(found, test, options.samples)
    content = time_report.write(out, test, found, posterior)
    print(time_report.table(test, found))
    if posterior is not None:
        from fitting.reports import posterior_report

        print(posterior_report.table(posterior))
    if options.cards:
        shared_options.write_cards_of_fit(out, found)
    for sentence in content["warnings"]:
        print(f"warning: {sentence}", file=sys.stderr)
    print(f"written: {out}/fit.json, fit.png")
    return 0 if found.converged or time_tests.ELASTIC in found.details else 1
