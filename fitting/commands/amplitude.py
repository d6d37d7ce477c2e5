"""``python -m fitting amplitude LAW SWEEP``: a hyperelastic law from a strain sweep of a rheometer."""

import argparse
import sys
from pathlib import Path

from fitting.commands import shared_options
from fitting.commands.exit_codes import EXIT_CODES
from liverjax.core.errors import InputError
from liverjax.core.files import writable


def parser(prog: str) -> argparse.ArgumentParser:
    """Return the option parser of the command. --help shows `prog` as the name of the command."""
    command = argparse.ArgumentParser(
        prog=prog,
        description="Fit the parameters of a hyperelastic law to moduli that change with the strain amplitude, at "
        "one frequency, and show the third harmonic that the law predicts.",
        epilog="The errors (±) come from noise alone. An error of the gap is not included: 50 µm in 1 mm changes "
        f"every modulus and strain by 5 %. {EXIT_CODES}",
    )
    command.add_argument("law", metavar="LAW", help="name of a law, FILE.py:LAW for your own law, or all (every law)")
    command.add_argument(
        "sweep",
        type=Path,
        metavar="SWEEP",
        help="file with columns of frequency, moduli and strain: CSV, text or workbook",
    )
    command.add_argument("--terms", type=int, choices=(1, 2, 3, 4), help="terms of Ogden's law (default 1, 2 and 3)")
    command.add_argument(
        "--model",
        type=Path,
        metavar="fit.json",
        help="result of a frequency sweep, with the Prony series of the tissue",
    )
    command.add_argument("--plates", choices=("parallel", "cone"), help="plates (default parallel)")
    command.add_argument("--max-strain", type=float, metavar="X", help="ignore strains above this value; 0.1 is 10 %%")
    command.add_argument(
        "--table", metavar="NAME", help="name of the table to read, part of this name, or the number of the table"
    )
    command.add_argument(
        "--out", type=Path, default=Path("amplitude"), metavar="DIR", help="folder of the results (default amplitude)"
    )
    return command


def run(options: argparse.Namespace) -> int:
    """Fit one law, or all laws. The exit code is 1 if the best fit did not converge."""
    if options.max_strain is not None and not options.max_strain > 0:
        raise InputError(f"--max-strain {options.max_strain:g} must be above 0: give e.g. 0.1 for 10 %")
    from tqdm import tqdm

    from fitting.amplitude import law_fit
    from fitting.amplitude.strain_sweep import read_strain_sweep
    from fitting.fits.families import hyperelastic
    from fitting.reports import amplitude_report

    candidates = hyperelastic.candidates(options.law, options.terms)
    sweep = read_strain_sweep(options.sweep, options.table, options.max_strain)
    memory = law_fit.Memory() if options.model is None else law_fit.memory_from(options.model)
    plates = [] if options.plates else ["parallel plates are assumed; for cone and plate, give --plates cone"]
    for note in [*sweep.notes, *plates, *(n for candidate in candidates for n in candidate.notes)]:
        print(f"note: {note}", file=sys.stderr)
    read = [options.sweep] if options.model is None else [options.sweep, options.model]
    writable(options.out, ("fit.json", "fit.png"), inputs=read)
    bar = tqdm(candidates, unit=" laws", disable=None, leave=False)
    fits = [law_fit.fit_law(candidate, sweep, memory, options.plates or "parallel") for candidate in bar]
    wrong = shared_options.laws_without_finite_stress([fit.law for fit in fits], "this sweep")
    fits = sorted((fit for fit in fits if fit.law.label not in wrong), key=lambda f: f.law.aicc)
    outside = law_fit.outside_series(memory, sweep.angular_frequency)
    content = amplitude_report.write(options.out, sweep, fits, [outside] if outside else [])
    print(amplitude_report.table(sweep, fits))
    for sentence in content["warnings"]:
        print(f"warning: {sentence}", file=sys.stderr)
    print(f"written: {options.out}/fit.json, fit.png")
    return 0 if fits[0].law.converged else 1
