"""``python -m fitting SWEEP.csv``, ``… curves LAW FILES``, ``… field SCENE DISPLACEMENTS``: parameters, uncertainty."""

import argparse
import os
import sys
from pathlib import Path

from fitting.commands.exit_codes import EXIT_CODES
from liverjax.core.errors import InputError
from liverjax.core.files import writable


def _modes(text: str) -> int | str:
    if text == "auto":
        return text
    try:
        return int(text)
    except ValueError:
        raise argparse.ArgumentTypeError(f"{text!r} is neither a whole number nor auto") from None


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="python -m fitting",
        description="Identify a generalised Maxwell (Prony) model from a rheometer's frequency sweep.",
        epilog="Stress-stretch curves: python -m fitting curves --help. Displacements of a body: python -m fitting "
        "field --help. " + EXIT_CODES,
    )
    parser.add_argument("sweep", type=Path, metavar="SWEEP.csv", help="frequency sweep: CSV, TRIOS or RheoCompass text")
    parser.add_argument("--table", metavar="NAME", help="of a file with several tables: number, name or a part of it")
    parser.add_argument("--modes", type=_modes, default="auto", help="number of relaxation modes, or auto (default)")
    parser.add_argument("--method", choices=("torsion", "closed-form"), default="torsion", help="default torsion")
    parser.add_argument("--radius", type=float, metavar="M", help="plate radius [m] (default 0.01)")
    parser.add_argument("--height", type=float, metavar="M", help="gap [m] (default 0.004)")
    parser.add_argument(
        "--density", type=float, metavar="KG_M3", help="of the sample: simulate its inertia (default: none)"
    )
    parser.add_argument("--law", default="neo_hookean", metavar="NAME", help="law of the simulated sample")
    parser.add_argument("--steps", type=int, default=50, help="time steps a cycle of the simulation (default 50)")
    parser.add_argument(
        "--scheme", choices=("exponential", "backward_euler", "chapter"), default="exponential", help="Prony recursion"
    )
    parser.add_argument("--optimizer", choices=("levenberg-marquardt", "bfgs"), default="levenberg-marquardt")
    parser.add_argument("--profile", action="store_true", help="95 %% intervals by profile likelihood as well")
    parser.add_argument(
        "--out", type=Path, default=Path("fit"), metavar="DIR", help="folder of the results (default fit)"
    )
    return parser


def _curves_parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="python -m fitting curves",
        description="Fit hyperelastic laws to tension, compression, shear, equibiaxial and pure-shear curves at once.",
        epilog=EXIT_CODES,
    )
    parser.add_argument("law", metavar="LAW", help="name of a law, FILE.py:LAW of your own, or all")
    parser.add_argument("files", type=Path, nargs="+", metavar="CURVES.csv", help="F11 … P33, or test, stretch, …")
    parser.add_argument("--terms", type=int, choices=(1, 2, 3, 4), help="of Ogden's law (default 1, 2 and 3)")
    parser.add_argument("--unit", choices=("Pa", "kPa", "MPa"), default="Pa", help="of stress columns that name none")
    parser.add_argument(
        "--out", type=Path, default=Path("curves"), metavar="DIR", help="folder of the results (default curves)"
    )
    return parser


def _progress(sweep_size: int):
    """A bar on standard error, silent when that is not a terminal."""
    from tqdm import tqdm

    bar = tqdm(desc=f"torsion simulation of {sweep_size} frequencies", unit=" evaluations", disable=None, leave=False)

    def update(iteration: int, cost: float) -> None:
        bar.set_postfix(cost=f"{cost:.4g}")
        bar.update()

    return update, bar


def identify(options: argparse.Namespace) -> int:
    """Run the fit that the options ask for; the exit code."""
    from fitting.fits import viscoelastic
    from fitting.methods import generalised_maxwell, uncertainty
    from fitting.readers import rheometer
    from fitting.reports import sweep_report
    from liverjax import laws

    for name in ("radius", "height"):
        value = getattr(options, name)
        if value is not None and not 0 < value <= 0.2:
            meant = f"{value / 1000:g}" if 0.2 < value <= 200 else "0.004"
            raise InputError(f"--{name} {value} cannot be a plate {name} in metres: give e.g. --{name} {meant}")
    if options.density is not None and not 100 <= options.density <= 25000:
        raise InputError(f"--density {options.density} cannot be a sample's in kg/m^3: give e.g. --density 1060")
    if options.density is not None and options.method == "closed-form":
        raise InputError(f"--density {options.density:g} is of the simulation: leave it out or give --method torsion")
    if not 4 <= options.steps <= 10000:
        raise InputError(f"--steps {options.steps} is out of range: give 4 to 10000 time steps a cycle, e.g. 50")
    laws.find(options.law)
    sweep = rheometer.read_sweep(options.sweep, options.table)
    for note in sweep.notes:
        print(f"note: {note}", file=sys.stderr)
    if options.modes != "auto":
        viscoelastic.check_modes(sweep, options.modes)
    dense = generalised_maxwell.refuse_impossible(sweep)
    writable(options.out, ("fit.json", "fit.png", "fit.h5"))
    if options.modes == "auto":
        closed = viscoelastic.choose_modes(sweep, dense, options.optimizer)[0]
    else:
        closed = viscoelastic.closed_form(sweep, options.modes, dense, options.optimizer)
    fits = [closed]
    if options.method == "torsion":
        simulation = viscoelastic.Simulation(
            radius=options.radius or viscoelastic.Simulation().radius,
            height=options.height or viscoelastic.Simulation().height,
            law=options.law,
            scheme=options.scheme,
            steps=options.steps,
            density=options.density,
        )
        update, bar = _progress(len(sweep.angular_frequency))
        with bar:
            fits.append(viscoelastic.through_torsion(sweep, closed, simulation, options.optimizer, update))
    profile = None
    if options.profile:
        profile = uncertainty.profile_intervals(closed.solution, sweep, closed.uncertainty)
    sweep_report.write(options.out, sweep, fits, profile)
    print(sweep_report.table(sweep, fits))
    if profile is not None:
        for name, (low, high) in profile.items():
            ends = ("below reach" if low is None else f"{low:.4g}", "beyond reach" if high is None else f"{high:.4g}")
            print(f"profile 95 % (closed form): {name} from {ends[0]} to {ends[1]}")
    for sentence in fits[-1].warnings:
        print(f"warning: {sentence}", file=sys.stderr)
    print(f"written: {options.out}/fit.json, fit.png, fit.h5")
    return 0 if fits[-1].converged else 1


def identify_laws(options: argparse.Namespace) -> int:
    """Fit one law, or all, to the curves; the exit code."""
    from tqdm import tqdm

    from fitting.fits import stress_stretch
    from fitting.readers import curves
    from fitting.reports import curves_report
    from liverjax import laws

    candidates = stress_stretch.candidates(options.law, options.terms)
    found, notes = curves.read_curves(options.files, options.unit)
    if options.law == "all":
        left = [n for n in laws.LAWS if not stress_stretch.incompressible_form(n)]
        notes.append(f"left out, being no isochoric energy plus U(J): {', '.join(left)}")
    for note in [*notes, *(n for candidate in candidates for n in candidate.notes)]:
        print(f"note: {note}", file=sys.stderr)
    stress_stretch.initial_modulus(found)
    writable(options.out, ("curves.json", "curves.png"))
    bar = tqdm(candidates, unit=" laws", disable=None, leave=False)
    fits = [stress_stretch.fit(candidate, found) for candidate in bar]
    curves_report.write(options.out, found, fits)
    print(curves_report.table(fits))
    for fit in curves_report.best_first(fits):
        for sentence in fit.warnings:
            print(f"warning: {fit.label}: {sentence}", file=sys.stderr)
    for sentence in stress_stretch.unfollowed(found, fits):
        print(f"warning: {sentence}", file=sys.stderr)
    print(f"written: {options.out}/curves.json, curves.png")
    return 0 if curves_report.best_first(fits)[0].converged else 1


def main(arguments: list[str] | None = None) -> int:
    """Entry point; returns the exit code."""
    arguments = sys.argv[1:] if arguments is None else arguments
    try:
        if arguments[:1] == ["curves"]:
            return identify_laws(_curves_parser().parse_args(arguments[1:]))
        if arguments[:1] == ["field"]:
            from fitting.commands import field_command

            return field_command.identify(field_command.parser().parse_args(arguments[1:]))
        return identify(_parser().parse_args(arguments))
    except InputError as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    except BrokenPipeError:  # the reader of a pipe has seen enough
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 0


if __name__ == "__main__":
    sys.exit(main())
