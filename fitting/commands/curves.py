"""``python -m fitting curves LAW CURVES.csv …``: hyperelastic laws from stress-stretch curves."""

import argparse
import sys
from pathlib import Path

from fitting.commands import shared_options
from fitting.commands.exit_codes import EXIT_CODES
from liverjax import laws
from liverjax.core.files import writable


def parser(prog: str) -> argparse.ArgumentParser:
    """Return the option parser of the command. --help shows `prog` as the name of the command."""
    command = argparse.ArgumentParser(
        prog=prog,
        description="Fit hyperelastic laws to tension, compression, shear, equibiaxial and pure-shear curves together.",
        epilog=EXIT_CODES,
    )
    command.add_argument("law", metavar="LAW", help="name of a law, FILE.py:LAW for your own law, or all (every law)")
    command.add_argument(
        "files",
        type=Path,
        nargs="+",
        metavar="CURVES.csv",
        help="CSV files with columns F11 … P33, or test, stretch, …",
    )
    command.add_argument("--terms", type=int, choices=(1, 2, 3, 4), help="terms of Ogden's law (default 1, 2 and 3)")
    command.add_argument(
        "--unit", choices=("Pa", "kPa", "MPa"), help="unit of stress columns whose names contain no unit (default: Pa)"
    )
    command.add_argument(
        "--out", type=Path, default=Path("curves"), metavar="DIR", help="folder of the results (default curves)"
    )
    return command


def run(options: argparse.Namespace) -> int:
    """Fit one law, or all laws, to the curves. The exit code is 1 if the best fit did not converge."""
    from tqdm import tqdm

    from fitting.fits import stress_stretch
    from fitting.fits.families import compared_laws, hyperelastic
    from fitting.fits.honesty.wrong_columns import structured_curves
    from fitting.readers import curves
    from fitting.reports import curves_report

    shared_options.refuse_copies(options.files)
    candidates = hyperelastic.candidates(options.law, options.terms)
    found, notes = curves.read_curves(options.files, options.unit or "Pa")
    shared_options.refuse_equal_numbers([(c.label, (c.test, c.component, c.F, c.stress)) for c in found])
    if options.unit and not any("names no unit" in note for note in notes):
        notes.append(f"--unit {options.unit} has no effect, because the headings of the stress columns contain a unit")
    if options.law == "all":
        left = [n for n in laws.LAWS if not hyperelastic.incompressible_form(n)]
        notes.append(
            "some laws are not fitted, because their energy is not an isochoric energy plus U(J) (J: volume ratio): "
            f"{', '.join(left)}"
        )
    for note in [*notes, *(n for candidate in candidates for n in candidate.notes)]:
        print(f"note: {note}", file=sys.stderr)
    stress_stretch.initial_modulus(found)
    writable(options.out, ("curves.json", "curves.png"), inputs=options.files)
    bar = tqdm(candidates, unit=" laws", disable=None, leave=False)
    fits = [stress_stretch.fit(candidate, found) for candidate in bar]
    wrong = shared_options.laws_without_finite_stress(fits, "these curves")
    fits = [fit for fit in fits if fit.label not in wrong]
    structured = structured_curves(found, curves_report.best_first(fits)[0], options.law == "all")
    curves_report.write(options.out, found, fits, structured)
    print(curves_report.table(fits))
    for fit in curves_report.best_first(fits):
        for sentence in fit.warnings:
            print(f"warning: {fit.label}: {sentence}", file=sys.stderr)
    ordered = curves_report.best_first(fits)
    tied = compared_laws.tied_laws(ordered, "curves")
    tied += compared_laws.too_few_points(ordered, sum(len(c.stress) for c in found))
    told = (*compared_laws.unfollowed(found, fits), *stress_stretch.loaded_at_rest(found), *structured, *tied)
    for sentence in told:
        print(f"warning: {sentence}", file=sys.stderr)
    print(f"written: {options.out}/curves.json, curves.png")
    return 0 if curves_report.best_first(fits)[0].converged else 1
