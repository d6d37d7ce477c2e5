"""``python -m fitting SWEEP.csv --with RELAXATION.csv CREEP.csv …``: one Prony series for several tests."""

import argparse
import sys
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from fitting.commands import shared_options
from fitting.commands.progress import named_bar
from liverjax.core.errors import InputError

if TYPE_CHECKING:
    from fitting.fits.together.measured_tests import Measured


def run(options: argparse.Namespace) -> int:
    """Fit all tests in closed form. The exit code is 1 if the fit did not converge."""
    from fitting.fits.families import springpots_in_time
    from fitting.fits.together.measured_tests import name_of, reported_numbers
    from fitting.reports import together_report

    first = shared_options.usable_sweep(options, options.sweep[0])
    tests = [first, *(read_any(options, path) for path in options.others)]
    rows = [(t, *reported_numbers(t)[:2]) for t in tests]
    shared_options.refuse_equal_numbers([(t.source, (name_of(t), *at, values)) for t, at, values in rows])
    tests = without_sample_inertia(tests, options.density, options.height)
    for test in tests:
        for note in test.notes:
            print(f"note: {Path(test.source).name}: {note}", file=sys.stderr)
    shared_options.prepare_outputs(options, ("fit.json", "fit.png"), [*options.sweep, *options.others])
    relative = errors_of_sizes(options, tests)
    with named_bar(f"{len(tests)} tests") as told:
        found = springpots_in_time.choose_together(tests, options.model, options.modes, told, relative)
    together_report.write(options.out, found, relative, options.density)
    print(together_report.table(found, relative))
    if options.cards:
        shared_options.write_cards_of_fit(options.out, found)
    for sentence in found.warnings:
        print(f"warning: {sentence}", file=sys.stderr)
    print(f"written: {options.out}/fit.json, fit.png")
    return 0 if found.converged else 1


def errors_of_sizes(options: argparse.Namespace, tests: "list[Measured]") -> np.ndarray:
    """Return the relative errors (K,) of the moduli of the K tests due to the sizes of their samples. The error is 0
    for shear waves, because their moduli do not depend on the size of the sample."""
    from fitting.fits.honesty import total_error
    from fitting.fits.simulated_rheometer import Simulation
    from fitting.readers.time_tests import TimeTest
    from fitting.waves.dispersion import Dispersion

    default = Simulation()
    rig = Simulation(radius=options.radius or default.radius, height=options.height or default.height)

    def error_of(test: "Measured") -> float:
        if isinstance(test, Dispersion):
            return 0.0
        if isinstance(test, TimeTest) and test.described:
            return total_error.of_described_sizes(test.per_size)
        axial = test.axial if isinstance(test, TimeTest) else test.load == "tension"
        return total_error.of_geometry(rig, None, axial)

    return np.array(list(map(error_of, tests)))


def without_sample_inertia(tests: "list[Measured]", density: float | None, height: float | None) -> "list[Measured]":
    """Return the tests. The inertia of the sample is subtracted from the sweeps if the density and the height of the
    sample are given."""
    from fitting.fits import sample_inertia
    from fitting.readers.frequency_sweep import Sweep

    if density is None:
        return tests
    if height is None:
        print(
            "note: --density without --height subtracts no inertia from the sweeps: give the height of the sample [m]",
            file=sys.stderr,
        )
        return tests
    return [sample_inertia.taken_off(t, density, height) if isinstance(t, Sweep) else t for t in tests]


def read_any(options: argparse.Namespace, path: Path, whole: bool = False) -> "Measured":
    """Read a test from a file: a TOML description of a test rig, shear waves, a further sweep, or a relaxation or creep
    test.

    Points of a further sweep, or of shear waves, are ignored if they lie outside the band that the user gives. In a
    sweep, points at which the instrument dominates are ignored too. If `whole` is true (for a test that is only
    predicted), the limits of the band are not applied.
    """
    from fitting.readers import rheometer, time_tests
    from fitting.waves import dispersion

    if not path.exists():
        raise InputError(f"{path} does not exist: give the file of a test")
    if path.suffix.lower() == ".toml":
        from fitting.rigs.described import read_described

        return read_described(path)

    if dispersion.names_velocities(path):
        waves = dispersion.read_dispersion(path, options.density)
        return waves if whole else dispersion.in_band(waves, options.min_frequency, options.max_frequency)
    try:
        sweep = rheometer.read_sweep(path)
    except InputError as no_sweep:
        if "no header names" not in str(no_sweep) and "no column for" not in str(no_sweep):
            raise
    else:
        sweep = sweep if whole else rheometer.within(sweep, options.min_frequency, options.max_frequency)
        sweep = rheometer.without_inertia(sweep, options.radius, options.height)
        named = options.max_frequency and not whole
        return sweep if named else shared_options.without_instrument_or_sample(options, sweep)
    return time_tests.read_test_of_any_kind(path, time_tests.Sample(options.radius, options.height))
