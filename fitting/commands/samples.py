"""``python -m fitting SAMPLE1.csv SAMPLE2.csv …``: one fit for each sample, and the population of the samples."""

import argparse
import sys
from typing import TYPE_CHECKING

from fitting.commands import shared_options
from fitting.commands.progress import named_bar
from liverjax.core.errors import InputError

if TYPE_CHECKING:
    from fitting.readers.frequency_sweep import Sweep


def run(options: argparse.Namespace) -> int:
    """Fit all samples with one model in closed form. The exit code is 1 if one of the fits did not converge."""
    import numpy as np

    from fitting.fits import samples
    from fitting.fits.honesty import total_error
    from fitting.fits.simulated_rheometer import Simulation
    from fitting.reports import samples_report

    sweeps: list[Sweep] = []
    for path in options.sweep:
        sweeps.append(shared_options.usable_sweep(options, path))
        for earlier in sweeps[:-1]:
            if all(np.array_equal(*own) for own in zip(sweeps[-1][:3], earlier[:3], strict=True)):
                raise InputError(f"{path} has the same moduli as {earlier.source}: give each measurement once")
        for note in sweeps[-1].notes:
            print(f"note: {path.name}: {note}", file=sys.stderr)
    shared_options.prepare_outputs(options, ("fit.json", "fit.png", "fit.h5"), options.sweep)
    with named_bar(f"{len(sweeps)} samples") as told:
        found = samples.fit(sweeps, options.model, options.modes, told)
    for path, sweep, corrected in zip(options.sweep, sweeps, found.sweeps, strict=True):
        for note in corrected.notes[len(sweep.notes) :]:
            print(f"note: {path.name}: {note}", file=sys.stderr)
    usual = Simulation()
    rig = Simulation(radius=options.radius or usual.radius, height=options.height or usual.height)
    for fit, sweep in zip(found.fits, found.sweeps, strict=True):
        fit.details["geometry_error"] = total_error.of_geometry(rig, None, sweep.load == "tension")
    content = samples_report.write(options.out, found)
    print(samples_report.table(found))
    if options.cards:
        shared_options.write_cards(options.out, found.typical, np.inf if found.mostly_fluids else 0.0)
    for sentence in content["warnings"]:
        print(f"warning: {sentence}", file=sys.stderr)
    print(f"written: {options.out}/fit.json, fit.png, fit.h5")
    return 0 if content["converged"] else 1
