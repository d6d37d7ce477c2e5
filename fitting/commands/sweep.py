"""``python -m fitting SWEEP.csv``: a generalised Maxwell model from a rheometer's frequency sweep."""

import argparse
import math
import sys
from pathlib import Path
from typing import TYPE_CHECKING

from fitting.commands import shared_options
from fitting.commands.exit_codes import EXIT_CODES
from fitting.commands.progress import cost_bar
from liverjax import laws
from liverjax.core.errors import InputError
from liverjax.core.plotting import import_meanwhile
from liverjax.core.struct import Content

if TYPE_CHECKING:
    from fitting.commands.together import Measured
    from fitting.fits.posterior import Posterior
    from fitting.fits.simulated_rheometer import Simulation
    from fitting.fits.viscoelastic import Fit
    from fitting.readers.rheometer import Sweep


def parser(prog: str) -> argparse.ArgumentParser:
    """Return the option parser of the command. --help shows `prog` as the name of the command."""
    command = argparse.ArgumentParser(
        prog=prog,
        description="Identify a generalised Maxwell (Prony) or fractional model from a rheometer's frequency sweep.",
        epilog=f"Relaxation and creep tests: {prog} relaxation --help, {prog} creep --help. "
        f"Stress-stretch curves: {prog} curves --help. Displacements of a body: {prog} field --help. "
        f"Indentation: {prog} indentation --help. Strain sweeps: {prog} amplitude --help. "
        f"Waves on voxels: {prog} waves --help. " + EXIT_CODES,
    )
    command.add_argument(
        "sweep",
        type=Path,
        nargs="+",
        metavar="SWEEP.csv",
        help="frequency sweep: CSV or an export of a rheometer (fitting/README.md); several files are samples of one "
        "material",
    )
    command.add_argument(
        "--with",
        type=Path,
        nargs="+",
        dest="others",
        default=[],
        metavar="TEST",
        help="further tests of the same material (relaxation, creep, sweep, shear waves), all fitted together",
    )
    command.add_argument("--table", metavar="NAME", help="number, or part of the name, of the table to read")
    command.add_argument("--max-frequency", type=float, metavar="HZ", help="ignore points measured above this value")
    command.add_argument("--min-frequency", type=float, metavar="HZ", help="ignore points measured below this value")
    shared_options.add_modes(command)
    command.add_argument(
        "--model",
        choices=("prony", "fractional", "spectrum", "auto"),
        default="prony",
        help="free Prony modes (default), springpots, a smooth spectrum, or the best by the information criterion",
    )
    command.add_argument(
        "--method", choices=("torsion", "closed-form"), help="method (default torsion; several samples: closed-form)"
    )
    command.add_argument(
        "--master",
        nargs="?",
        type=_celsius,
        const=MIDDLE,
        metavar="C",
        help="sweeps at several temperatures are given: shift them to the one nearest to C degrees Celsius "
        "(default the middle one) and fit the master curve",
    )
    command.add_argument("--vertical", action="store_true", help="with --master: fit shift factors of the moduli too")
    _add_sample(command)
    _add_outputs(command)
    master = ("shift_factors.csv", "master_curve.csv", "shift.png")
    command.set_defaults(optional_files=("fit.h5", "posterior.csv", "cards", "report.pdf", *master))
    return command


#: Value of the option --master without a temperature: the middle temperature is the reference.
MIDDLE = "middle"


def _celsius(text: str) -> float | str:
    try:
        if text == MIDDLE or math.isfinite(float(text)):
            return text if text == MIDDLE else float(text)
    except ValueError:
        pass
    raise argparse.ArgumentTypeError(f"{text!r} is not a temperature in °C: give the files before --master")


def _add_sample(command: argparse.ArgumentParser) -> None:
    """Add the options for the sample between its plates, and for its simulation."""
    command.add_argument("--radius", type=float, metavar="M", help="plate radius [m] (default 0.01)")
    command.add_argument("--height", type=float, metavar="M", help="gap [m] (default 0.004)")
    command.add_argument(
        "--gap-error", type=float, metavar="M", help="standard deviation of the gap [m], included in errors"
    )
    command.add_argument(
        "--friction-error",
        type=float,
        metavar="NMS",
        help="standard deviation of the friction of the instrument's bearing [N m s], to fit the friction too",
    )
    command.add_argument(
        "--density", type=float, metavar="KG_M3", help="density of the sample, to subtract its inertia (default: none)"
    )
    command.add_argument(
        "--precompression",
        type=float,
        default=0.0,
        metavar="E",
        help="compression of the sample before the sweep, divided by its height (default 0); --height is the gap",
    )
    command.add_argument("--law", default="neo_hookean", metavar="NAME", help="law of the sample (default neo_hookean)")
    command.add_argument("--steps", type=int, default=50, help="time steps per cycle of the simulation (default 50)")
    command.add_argument(
        "--scheme", choices=("exponential", "backward_euler", "chapter"), default="exponential", help="Prony recursion"
    )
    command.add_argument("--optimizer", choices=("levenberg-marquardt", "bfgs"), default="levenberg-marquardt")


def _add_outputs(command: argparse.ArgumentParser) -> None:
    """Add the options for further output of a fit."""
    command.add_argument(
        "--predict",
        type=Path,
        nargs="+",
        default=[],
        metavar="TEST",
        help="tests that are not fitted; the fit predicts their results, for comparison",
    )
    command.add_argument("--profile", action="store_true", help="also compute 95 %% profile-likelihood intervals")
    shared_options.add_cards_and_samples(command)
    command.add_argument("--report", action="store_true", help="also write a page with pictures, report.pdf")
    command.add_argument(
        "--out", type=Path, default=Path("fit"), metavar="DIR", help="folder of the results (default fit)"
    )


def run(options: argparse.Namespace) -> int:
    """Fit the model. The exit code is 1 if the fit did not converge."""
    from fitting.methods import uncertainty
    from fitting.reports import sweep_report

    _check(options)
    if options.master is not None:
        options.method = options.method or "closed-form"  # shifted frequencies are not simulated by default
    elif len(options.sweep) > 1:
        from fitting.commands import samples

        return samples.run(options)
    if options.others:
        from fitting.commands import together

        return together.run(options)
    options.method = options.method or "torsion"
    shift: Content = {}
    tests = _tests_to_predict(options)  # read now, so that an error in a file does not discard a finished fit
    if options.master is None:
        sweep = shared_options.usable_sweep(options, options.sweep[0], shared_options.may_explain_the_mark(options))
        shifted = ""
    else:
        sweep, shift, shifted = _master(options)
    for note in sweep.notes:
        print(f"note: {note}", file=sys.stderr)
    import_meanwhile()
    fits, sweep = _fits(options, sweep)
    for fit in fits:
        fit.details.update(shift)
    profile = None
    if options.profile and not uncertainty.has_profile(fits[0].solution, fits[0].uncertainty):
        print("note: --profile has no effect, because it is for Prony modes of a solid", file=sys.stderr)
    elif options.profile:
        profile = uncertainty.profile_intervals(fits[0].solution, sweep, fits[0].uncertainty)
    posterior = _posterior(options, sweep, fits[-1])
    predictions = _predictions(tests, sweep, fits[-1], shift)
    content = sweep_report.write(options.out, sweep, fits, profile, posterior)
    print(sweep_report.table(sweep, fits))
    for told in predictions:
        print(told)
    if posterior is not None:
        from fitting.reports import posterior_report

        print(posterior_report.table(posterior))
    if options.cards:
        shared_options.write_cards_of_fit(options.out, fits[-1])
    if options.report:
        from fitting.reports import one_page

        one_page.write(options.out / "report.pdf", sweep, fits, content, shifted)
        print(f"written: {options.out}/report.pdf")
    for name, (low, high) in (profile or {}).items():
        ends = ["not found" if end is None else f"{end:.4g}" for end in (low, high)]
        print(f"95 % interval of {name} (profile likelihood, closed form): {ends[0]} to {ends[1]}")
    for sentence in content["warnings"]:
        print(f"warning: {sentence}", file=sys.stderr)
    print(f"written: {options.out}/fit.json, fit.png, fit.h5")
    return 0 if fits[-1].converged else 1


def _master(options: argparse.Namespace) -> tuple["Sweep", dict, str]:
    """Write and print the master curve of the files. Return its sweep, its fit.json entry, and the printed table."""
    from fitting.master import master_curve, master_report, temperature_sweeps

    reference = None if options.master == MIDDLE else options.master + 273.15
    data = temperature_sweeps.read_temperatures(options.sweep)
    band = options.min_frequency, options.max_frequency
    data = temperature_sweeps.with_usable_points(data, band, options.radius, options.height)
    try:
        found = master_curve.master_curve(data, reference, options.vertical)
    except InputError as error:  # the notes say which temperatures are ignored
        raise InputError("; ".join([str(error), *data.sweeps[0].notes])) from None
    files = ("shift_factors.csv", "master_curve.csv", "shift.png", "fit.json", "fit.png", "fit.h5")
    shared_options.prepare_outputs(options, files, [*options.sweep, *options.predict])
    master_report.write_master_curve(options.out, found)
    table = master_report.shift_table(found)
    print(table)
    at = found.shifts.temperatures[found.shifts.reference]
    if reference is not None and abs(at - reference) > 0.5:
        nearest = f"the measured temperature nearest to {options.master:g} °C"
        print(f"note: the reference is {at - 273.15:.4g} °C, {nearest}", file=sys.stderr)
    print(f"written: {options.out}/shift_factors.csv, master_curve.csv, shift.png")
    return found.sweep, {"shift": master_curve.shift_numbers(found)}, table


def _tests_to_predict(options: argparse.Namespace) -> list["Measured"]:
    """Read the tests that the fit predicts (--predict). The inertia of the sample is subtracted as in the fit."""
    if not options.predict:
        return []
    from fitting.commands import together

    tests = [together.read_any(options, path, whole=True) for path in options.predict]
    tests = together.without_sample_inertia(tests, *(_simulation(options).inertia or (None, None)))
    for test in tests:
        for note in test.notes:
            print(f"note: {Path(test.source).name}: {note}", file=sys.stderr)
    return tests


def _predictions(tests: list["Measured"], sweep: "Sweep", fit: "Fit", shift: dict) -> list[str]:
    """Return sentences about each test that the fit predicts. `shift`: the fit.json entry from `_master`, or empty."""
    if not tests:
        return []
    from fitting.master import master_curve
    from fitting.reports import prediction

    tests, told = master_curve.at_reference(tests, shift["shift"]) if shift else (tests, [])
    return told + [prediction.sentence(prediction.predict(fit, sweep.resolved, test)) for test in tests]


def _check(options: argparse.Namespace) -> None:
    """Raise an error for impossible values of a sample or a simulation, and for options that cannot be combined."""
    for name in ("radius", "height"):
        value = getattr(options, name)
        if value is not None and not 0 < value <= 0.2:
            meant = f"{value / 1000:g}" if 0.2 < value <= 200 else "0.004"
            raise InputError(f"--{name} {value} cannot be a plate {name} in metres: give e.g. --{name} {meant}")
    if options.gap_error is not None and not (options.height and 0 <= options.gap_error < options.height):
        raise InputError(
            f"--gap-error {options.gap_error:g} must be 0 or more and below --height, both in metres: give both"
        )
    _check_friction(options)
    if options.density is not None and not 100 <= options.density <= 25000:
        raise InputError(f"--density {options.density} is not possible in kg/m^3: give e.g. --density 1060")
    if options.density is not None and options.method == "closed-form" and not (options.height or options.others):
        raise InputError(f"--density {options.density:g} needs --height too: give both, as the inertia depends on both")
    _check_precompression(options)
    _check_master(options)
    if len(options.sweep) > 1 and options.master is None:
        _check_samples(options)
    if options.others:
        _check_together(options)
    if not 4 <= options.steps <= 10000:
        raise InputError(f"--steps {options.steps} is out of range: give 4 to 10000 time steps per cycle, e.g. 50")
    if options.model in ("fractional", "spectrum") and options.modes != "auto":
        raise InputError(
            f"--modes {options.modes} works only with --model prony: remove this option for --model {options.model}"
        )
    if options.profile and options.model != "prony":
        raise InputError(f"--profile works only with --model prony: remove --profile for --model {options.model}")
    _note_idle(options)
    shared_options.refuse_copies([*options.sweep, *options.others])
    shared_options.check_samples(options.samples)
    if options.samples and options.model == "spectrum":
        raise InputError("--samples works only with models of a few parameters: remove --samples for --model spectrum")
    laws.find(options.law)


def _note_idle(options: argparse.Namespace) -> None:
    """Print a note on each option that has no effect, because it is for the simulation or for a single sweep."""
    several = len(options.sweep) > 1 or bool(options.others) or options.master is not None
    if options.method == "torsion" or (options.method is None and not several):
        return
    idle = {"--steps": options.steps != 50, "--scheme": options.scheme != "exponential"}
    idle["--law"] = options.law != "neo_hookean" and not options.precompression
    for name in (name for name, changed in idle.items() if changed):
        print(f"note: {name} is for the simulation, and has no effect on the closed form", file=sys.stderr)
    if several and options.master is None and options.optimizer != "levenberg-marquardt":
        print(f"note: --optimizer {options.optimizer} is for a single sweep, and has no effect here", file=sys.stderr)


def _check_friction(options: argparse.Namespace) -> None:
    """Raise an error for --friction-error if the size of the sample is missing, or if the fit cannot use the option."""
    error = options.friction_error
    if error is None:
        return
    if not (options.radius and options.height and 0 < error <= 1e-3):
        raise InputError(
            f"--friction-error {error:g} is the standard deviation of the bearing's friction in N m s: give a positive "
            "number, e.g. 1e-7, and --radius and --height"
        )
    for name, asked in (
        (f"--model {options.model}", options.model != "prony"),
        ("--with", bool(options.others)),
        ("--master", options.master is not None),
        ("all samples but one", len(options.sweep) > 1),
    ):
        if asked:
            raise InputError(f"--friction-error needs the Prony modes of one sample: remove this option, or {name}")


def _check_precompression(options: argparse.Namespace) -> None:
    """Raise an error for an impossible compression, and for options that cannot be combined with a compression."""
    if options.precompression == 0:
        return
    from fitting.rigs import compression

    compression.check_strain(options.precompression)
    for name, asked in (("--with", bool(options.others)), ("all samples but one", len(options.sweep) > 1)):
        if asked:
            raise InputError(f"--precompression works only for a single sweep: remove {name}, or --precompression")
    uncompressed = {"--profile": options.profile, "--samples": options.samples is not None}
    for name, asked in (*uncompressed.items(), ("--predict", bool(options.predict))):
        if asked:
            raise InputError(
                f"{name} works only for a sample that is not compressed: remove {name}, or --precompression"
            )
    if options.model != "prony" and options.method != "closed-form":
        raise InputError(
            f"--precompression with --model {options.model} needs --method closed-form. A simulation represents this "
            "model by Prony modes, and these do not distinguish the equilibrium stress from slowly relaxing stress"
        )


def _check_master(options: argparse.Namespace) -> None:
    """Raise an error for options that cannot be combined with a master curve."""
    if options.master is None:
        if options.vertical:
            raise InputError("--vertical works only for a master curve: also give --master")
        return
    for name, asked in (
        ("--with", bool(options.others)),
        ("--table", options.table is not None),
        ("--density", options.density is not None),
        ("--precompression", options.precompression != 0),
    ):
        if asked:
            raise InputError(f"--master uses the sweeps at all temperatures of the files: remove {name}")


def _check_samples(options: argparse.Namespace) -> None:
    """Raise an error for options that need a single sweep."""
    for name, asked, instead in (
        ("--method torsion", options.method == "torsion", "remove the option, or give one file"),
        ("--profile", options.profile, "remove the option, or give one file"),
        ("--samples", options.samples is not None, "remove the option, or give one file"),
        ("--report", options.report, "remove the option, or give one file"),
        ("--predict", bool(options.predict), "remove the option, or give one file"),
        ("--gap-error", options.gap_error is not None, "remove the option, or give one file"),
        ("--density", options.density is not None, "remove the option, or give one file"),
    ):
        if asked:
            raise InputError(f"{name} works only for one sample, and {len(options.sweep)} files are given: {instead}")


def _check_together(options: argparse.Namespace) -> None:
    """Raise an error for options that cannot be combined with several tests."""
    for name, asked in (
        ("--method torsion", options.method == "torsion"),
        ("--profile", options.profile),
        ("--samples", options.samples is not None),
        ("--report", options.report),
        ("--predict", bool(options.predict)),
        ("--gap-error", options.gap_error is not None),
        ("all samples but one", len(options.sweep) > 1),
    ):
        if asked:
            raise InputError(f"--with fits modes or springpots to one sample in closed form: remove {name}")


def _fits(options: argparse.Namespace, sweep: "Sweep") -> tuple[list["Fit"], "Sweep"]:
    """Return a list of fits and the corrected sweep. The list contains the closed-form fit and, by default, the fit of
    the simulation."""
    from fitting.fits import compressed_sample, instrument, sample_inertia
    from fitting.fits.honesty import edges, total_error
    from fitting.readers import frequency_sweep
    from fitting.rigs import compression

    simulation = _simulation(options)._replace(tensile=sweep.tensile)
    if simulation.inertia is not None:
        sweep, noted = sample_inertia.taken_off(sweep, *simulation.inertia), sweep.notes
        for note in sweep.notes[len(noted) :]:
            print(f"note: {note}", file=sys.stderr)
    if options.friction_error:
        sweep = frequency_sweep.with_friction(sweep, options.friction_error, simulation.radius, simulation.height)
    factors = None
    if options.precompression:
        factors = compression.shares(laws.typical(options.law), options.precompression)
    closed, corrected, dense = shared_options.corrected_fit(options, sweep, factors)
    for note in corrected.notes[len(sweep.notes) :]:
        print(f"note: {note}", file=sys.stderr)
    # The error of the gap is included before the warnings are made, because the warnings use the errors.
    if options.gap_error:
        closed = instrument.with_gap_error(closed, options.gap_error / simulation.height)
    fits = [edges.honest(closed, corrected, dense)]
    heavy = {} if options.density is None else {"density_kg_m3": options.density}
    fits[0].details.update(heavy)
    if options.method != "closed-form":
        fits.append(_simulated(options, corrected, fits[0], simulation.run))
        fits[1].details.update(heavy)
    for fit in fits:
        fit.details["geometry_error"] = total_error.of_geometry(simulation, options.gap_error, sweep.load == "tension")
    for fit in fits if options.precompression else ():  # `compression_numbers` uses `geometry_error`
        fit.details["precompression"] = compressed_sample.compression_numbers(fit, simulation)
    return fits, corrected


def _simulated(options: argparse.Namespace, sweep: "Sweep", closed: "Fit", simulation: "Simulation") -> "Fit":
    """Return the fit of the torsion simulation. If the simulation has a density, its moduli are compared with moduli
    that contain the inertia of the sample."""
    from fitting.fits import sample_inertia, simulated_rheometer

    inertia = simulation.inertia
    if inertia is not None:
        sweep = sample_inertia.put_back(sweep, *inertia)
    bar, told = cost_bar("evaluations", f"torsion simulation of {len(sweep.angular_frequency)} frequencies")
    with bar:
        fit = simulated_rheometer.through_torsion(sweep, closed, simulation, options.optimizer, told)
    if inertia is None:
        return fit
    G = sample_inertia.modulus_of(fit.storage + 1j * fit.loss, sweep.angular_frequency, *inertia)
    return fit._replace(storage=G.real, loss=G.imag)


def _simulation(options: argparse.Namespace) -> "Simulation":
    from fitting.fits.simulated_rheometer import Simulation

    return Simulation(
        radius=options.radius or Simulation().radius,
        height=options.height or Simulation().height,
        law=options.law,
        scheme=options.scheme,
        steps=options.steps,
        density=options.density,
        precompression=options.precompression,
    )


def _posterior(options: argparse.Namespace, sweep: "Sweep", fit: "Fit") -> "Posterior | None":
    """Draw from the posterior of the last fit, if the user asks for this and the model has only a few parameters."""
    from fitting.fits import posterior, sample_inertia

    if not options.samples or not shared_options.has_draws(fit.kind):
        return None
    if fit.method == "torsion":
        simulation = _simulation(options)._replace(tensile=sweep.tensile).run
        inertia = simulation.inertia
        if inertia is not None:  # the simulated moduli contain the inertia
            G = sample_inertia.shown(fit.storage + 1j * fit.loss, sweep.angular_frequency, *inertia)
            fit, sweep = fit._replace(storage=G.real, loss=G.imag), sample_inertia.put_back(sweep, *inertia)
        return posterior.of_simulation(fit, sweep, simulation, options.samples)
    return posterior.of_sweep(fit, sweep, options.samples)
