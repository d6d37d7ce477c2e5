"""Options and steps that several commands share: number of modes, draws of the posterior, material cards, reading a
sweep."""

import argparse
import contextlib
import sys
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from liverjax.core.errors import InputError

if TYPE_CHECKING:
    from fitting.fits.stress_stretch import LawFit
    from fitting.fits.viscoelastic import Kind
    from fitting.methods.estimate import Estimate
    from fitting.methods.generalised_maxwell import Maxwell
    from fitting.readers.frequency_sweep import Sweep


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
    """Return whether the posterior of a fit with this kind of model can be drawn (--samples). A note is printed if it
    cannot, because the model is the spectrum."""
    if kind.effective is None:
        return True
    print(
        "note: --samples works only with models of a few parameters; for the spectrum, use its standard errors",
        file=sys.stderr,
    )
    return False


def write_cards(out: Path, model: "Maxwell", of_fit: "Estimate | None" = None) -> None:
    """Write material cards, and print notes on everything that a program cannot represent. `of_fit`: the fitted Prony
    modes with their errors, if they are known."""
    from fitting.methods.uncertainty import equilibrium_error
    from fitting.reports import material_cards

    error = 0.0 if of_fit is None else equilibrium_error(of_fit)
    for sentence in material_cards.write(out / "cards", model, error):
        print(f"note: {sentence}", file=sys.stderr)
    print(f"written: {out}/cards")


def usable_sweep(options: argparse.Namespace, path: Path) -> "Sweep":
    """Read a sweep, and ignore the points at which the instrument dominates. If --max-frequency is given, only these
    points are ignored: points outside the band, and points at which the raw torque or the raw phase shows too much
    inertia of the instrument (`without_inertia`)."""
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
    return sweep if options.max_frequency else without_instrument_or_sample(options, sweep)


def without_instrument_or_sample(options: argparse.Namespace, sweep: "Sweep") -> "Sweep":
    """Return the sweep without the points at which the instrument dominates. The moduli still contain the inertia of
    the sample. If density and height of the sample are known, these points are searched in moduli without the inertia
    of the sample. So this inertia is not mistaken for the inertia of the instrument. With --method torsion, the default
    of --height is used, as in the fit."""
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
    except InputError:  # a later step subtracts the inertia, and raises the error with its remedy
        return kramers_kronig.without_instrument(sweep)
    kept = kramers_kronig.without_instrument(bare)
    told = tuple(note for note in kept.notes if note not in bare.notes)
    good = np.isin(sweep.angular_frequency, kept.angular_frequency)
    grey = np.column_stack([sweep.angular_frequency, sweep.storage, sweep.loss])[~good]
    grey = grey if sweep.grey is None else np.concatenate([sweep.grey, grey])
    whole = some(sweep, good)
    return whole._replace(grey=grey if len(grey) else None, notes=(*whole.notes, *told))


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
