"""Options and steps of the commands: number of modes, draws of the posterior, material cards, reading a sweep, fitting
a sweep in closed form."""

import argparse
import contextlib
import math
import sys
from collections.abc import Iterable
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from fitting.commands.progress import named_bar
from liverjax.core.errors import InputError
from liverjax.core.files import named_files, writable

if TYPE_CHECKING:
    from numpy.typing import ArrayLike

    from fitting.fits.stress_stretch import LawFit
    from fitting.fits.time_tests import TimeFit
    from fitting.fits.together.residuals_of_tests import Together
    from fitting.fits.viscoelastic import Fit, Kind
    from fitting.methods.generalised_maxwell import Maxwell, Spectrum
    from fitting.readers.frequency_sweep import Sweep
    from fitting.rigs.compression import Shares


def add_modes(command: argparse.ArgumentParser) -> None:
    """Add the option --modes."""
    command.add_argument(
        "--modes", type=_whole_number_or_auto, default="auto", help="number of relaxation modes, or auto (default)"
    )


def refuse_copies(files: list[Path]) -> None:
    """Raise an error if two files have the same content, because one measurement would count twice."""
    seen: dict[bytes, Path] = {}
    for file in (file for file in files if file.is_file()):
        first = seen.setdefault(file.read_bytes(), file)
        if first is not file:
            raise InputError(f"{file} is the same measurement as {first}: give each measurement once")


def refuse_equal_numbers(measured: "list[tuple[str, tuple[ArrayLike, ...]]]") -> None:
    """Raise an error if two measurements have the same numbers, because one measurement would count twice. Their files
    may differ, for example in a comment. `measured`: name and arrays of each measurement."""
    for k, (name, arrays) in enumerate(measured):
        for earlier, others in measured[:k]:
            equal = (np.array_equal(a, b) for a, b in zip(arrays, others, strict=False))
            if len(arrays) == len(others) and all(equal):
                raise InputError(f"{name} has the same numbers as {earlier}: give each measurement once")


def laws_without_finite_stress(fits: "list[LawFit]", data: str) -> list[str]:
    """Return the names of the laws whose stress is not finite on the data, and warn that these laws are ignored.

    Raises:
        InputError: no law has a finite stress.
    """
    wrong = [f.label for f in fits if not np.isfinite(f.mean_relative_error)]
    told = f"{', '.join(wrong)}: the stress is not finite on {data}; check the law with python -m liverjax check"
    if wrong and len(wrong) == len(fits):
        raise InputError(told)
    if wrong:
        print(f"warning: {told}. These laws are ignored", file=sys.stderr)
    return wrong


def add_cards_and_samples(command: argparse.ArgumentParser) -> None:
    """Add the options --samples and --cards."""
    command.add_argument("--samples", type=int, metavar="N", help="write 4 chains of N posterior draws (posterior.csv)")
    command.add_argument(
        "--cards",
        action="store_true",
        help="also write material cards for liverjax, FEBio, Abaqus, Ansys and SOFA, in DIR/cards",
    )


def _whole_number_or_auto(text: str) -> int | str:
    try:
        return text if text == "auto" else int(text)
    except ValueError:
        raise argparse.ArgumentTypeError(f"{text!r} is neither a whole number nor auto") from None


def check_samples(count: int | None) -> None:
    """Raise an error if the number of draws (--samples) is too small or too large."""
    if count is not None and not 100 <= count <= 100000:
        raise InputError(f"--samples {count} is out of range: give 100 to 100000 draws of each chain, e.g. 1000")


def has_draws(kind: "Kind") -> bool:
    """Return whether the posterior of a fit with this kind of model can be drawn (--samples). If the model is the
    spectrum, the result is False, and a note is printed."""
    if kind.effective is None:
        return True
    print(
        "note: --samples works only with models of a few parameters; for the spectrum, use its standard errors",
        file=sys.stderr,
    )
    return False


def write_cards_of_fit(out: Path, fit: "Fit | TimeFit | Together") -> None:
    """Write the material cards of a fit (`write_cards`). The equilibrium modulus may be zero if its 95 % interval
    contains 0, also if its standard error is small."""
    from fitting.fits.honesty.long_times import INTERVAL
    from fitting.methods.uncertainty import equilibrium_error

    interval = (fit.details or {}).get(INTERVAL)
    error = math.inf if interval and interval["low"] <= 0 else equilibrium_error(fit.uncertainty)
    write_cards(out, fit.model, error)


def write_cards(out: Path, model: "Maxwell", error: float) -> None:
    """Write material cards, and print notes on all parts of the model that a simulation program cannot represent.
    `error`: standard error [Pa] of the equilibrium modulus; infinite if this modulus may be zero."""
    from fitting.reports import material_cards

    for sentence in material_cards.write(out / "cards", model, error):
        print(f"note: {sentence}", file=sys.stderr)
    print(f"written: {out}/cards")


def prepare_outputs(options: argparse.Namespace, files: tuple[str, ...], inputs: Iterable[Path]) -> None:
    """Make the folder of the results, and check that all result files can be written: `files`, and the files that
    --samples, --report and --cards request. No result may replace one of the `inputs`, or a file that a TOML file among
    them names."""
    read = list(inputs)
    read += [named for path in read if path.suffix.lower() == ".toml" for named in named_files(path)]
    asked = {"posterior.csv": options.samples, "report.pdf": getattr(options, "report", False)}
    names = (*files, *(name for name, wanted in asked.items() if wanted))
    writable(options.out, names, ("cards",) if options.cards else (), read)


def usable_sweep(options: argparse.Namespace, path: Path, error_is_fitted: bool = False) -> "Sweep":
    """Read a sweep, and ignore the points at which the instrument dominates. If --max-frequency is given, only two
    kinds of points are ignored: points outside the band, and points at which the raw torque or the raw phase shows too
    much inertia of the instrument (`without_inertia`). The same is true if the file shows the inertia and its error is
    fitted later (`error_is_fitted`), because this error may explain the mark of the instrument (see
    `kramers_kronig`)."""
    from fitting.readers import rheometer

    try:
        sweep = rheometer.read_sweep(path, options.table)
    except InputError as no_sweep:
        other = _other_command(path) if "no header names" in str(no_sweep) else None
        if other is None:
            raise
        raise InputError(f"{path} contains no frequency sweep: give it to `python -m fitting {other}`") from None
    sweep = rheometer.within(sweep, options.min_frequency, options.max_frequency)
    sweep = rheometer.without_inertia(sweep, options.radius, options.height)
    explained = error_is_fitted and sweep.inertia is not None
    return sweep if options.max_frequency or explained else without_instrument_or_sample(options, sweep)


def without_instrument_or_sample(options: argparse.Namespace, sweep: "Sweep") -> "Sweep":
    """Return the sweep without the points at which the instrument dominates. The returned moduli still contain the
    inertia of the sample. If density and height of the sample are known, the search for these points uses moduli
    without the inertia of the sample, so that it is not mistaken for the inertia of the instrument. With --method
    torsion, the default of --height is used, as in the fit."""
    from fitting.fits import sample_inertia
    from fitting.fits.simulated_rheometer import Simulation
    from fitting.methods import kramers_kronig
    from fitting.readers.rheometer import some
    from fitting.rigs import compression
    from liverjax import laws

    density, height = getattr(options, "density", None), options.height
    if height is None and getattr(options, "method", None) == "torsion":
        height = Simulation().height
    if density is None or height is None:
        return kramers_kronig.without_instrument(sweep)
    strain = getattr(options, "precompression", 0.0)
    try:
        if strain:
            density = compression.torsional_density(laws.typical(options.law), strain, density)
        bare = sample_inertia.taken_off(sweep, density, height)
    except InputError:  # a later step subtracts the inertia again, and raises this error with a remedy
        return kramers_kronig.without_instrument(sweep)
    kept = kramers_kronig.without_instrument(bare)
    told = tuple(note for note in kept.notes if note not in bare.notes)
    good = np.isin(sweep.angular_frequency, kept.angular_frequency)
    grey = np.column_stack([sweep.angular_frequency, sweep.storage, sweep.loss])[~good]
    grey = grey if sweep.grey is None else np.concatenate([sweep.grey, grey])
    whole = some(sweep, good)
    return whole._replace(grey=grey if len(grey) else None, notes=(*whole.notes, *told))


def may_explain_the_mark(options: argparse.Namespace) -> bool:
    """Return whether the fit of the instrument's errors is tried before points with the mark of the instrument are
    excluded. These points determine the error of the inertia best. The fit needs Prony modes. If the inertia of the
    sample is subtracted too, the points are excluded first, because the subtraction may fail at such points. With
    --max-frequency, no such points are excluded."""
    return options.model in ("prony", "auto") and options.density is None and not options.max_frequency


def corrected_fit(
    options: argparse.Namespace, sweep: "Sweep", factors: "Shares | None"
) -> tuple["Fit", "Sweep", "Spectrum"]:
    """Return the fit in closed form, the corrected sweep and its spectrum.

    If the sweep has points with the mark of the instrument, and the fitted error of the inertia does not explain this
    mark, these points are excluded and the fit is repeated.

    Args:
        options: options of the command.
        sweep: usable points, without the inertia of the sample.
        factors: as for `of_compressed_sample`; None: the sample is not compressed.
    """
    from fitting.methods import generalised_maxwell, kramers_kronig

    fit, corrected = _with_instrument(options, sweep, factors)
    if sweep.inertia is not None and may_explain_the_mark(options):
        rest = kramers_kronig.without_instrument(sweep)
        unexplained = corrected is sweep or kramers_kronig.onset_of(corrected) is not None
        if rest is not sweep and unexplained:
            fit, corrected = _with_instrument(options, rest, factors)
    return fit, corrected, generalised_maxwell.refuse_impossible(corrected)


def _with_instrument(options: argparse.Namespace, sweep: "Sweep", factors: "Shares | None") -> tuple["Fit", "Sweep"]:
    """Return the fit and the sweep, both corrected for the errors of the instrument."""
    from fitting.fits import compressed_sample, instrument, viscoelastic

    if options.modes != "auto":
        viscoelastic.check_modes(sweep, options.modes)
    dense = instrument.spectrum_before_correction(sweep)
    prepare_outputs(options, ("fit.json", "fit.png", "fit.h5"), [*options.sweep, *options.predict])
    fit = _uncorrected(options, sweep, dense)
    if factors is not None:
        fit = compressed_sample.of_compressed_sample(fit, sweep, factors)
    return instrument.without_error_of_inertia(fit, sweep, factors)


def _uncorrected(options: argparse.Namespace, sweep: "Sweep", dense: "Spectrum") -> "Fit":
    """Return the fit of the chosen model in closed form."""
    from fitting.fits import viscoelastic
    from fitting.fits.families import models

    prony = None
    if options.model in ("prony", "auto"):
        if options.modes == "auto":
            with named_bar("closed form") as told:
                prony = viscoelastic.choose_modes(sweep, dense, options.optimizer, told)[0]
        else:
            prony = viscoelastic.closed_form(sweep, options.modes, dense, options.optimizer)
    if options.model == "prony":
        assert prony is not None
        return prony
    return models.choose(sweep, options.model, prony, dense)


def _other_command(path: Path) -> str | None:
    """Return the command for the test in this file, or None if no reader can read the file."""
    from fitting.readers import curves, indentation_curves, time_tests

    readers = (
        time_tests.kind_of,
        lambda path: indentation_curves.read_indentation(path) and "indentation",
        lambda path: curves.read_curves([path]) and "curves",
    )
    for command_of in readers:
        with contextlib.suppress(InputError):
            return command_of(path)
    return None
