"""One Prony series for several tests of one material, fitted in closed form, and the contribution of each test.

The tests are frequency sweeps, relaxation tests, creep tests, and phase velocities of shear waves.

Each test has its own noise level. It is estimated during the fit, from the residuals of the test.
"""

import time
from collections.abc import Callable, Sequence
from functools import partial

import numpy as np

from fitting.fits import viscoelastic
from fitting.fits.families import choice
from fitting.fits.together.contributions import shares_of
from fitting.fits.together.doubts import (
    disagreements,
    missed,
    of_better_fits,
    of_rises,
    structured,
)
from fitting.fits.together.measured_tests import (
    Measured,
    ResolvedBand,
    first_noise,
    name_of,
    reported_numbers,
    resolved_by,
)
from fitting.fits.together.residuals_of_tests import (
    Together,
    criterion_of_all,
    misfits,
    noises,
    over_own_noise,
    tests_evaluated,
)
from fitting.fits.together.starting_points import starts_of_all
from fitting.fits.viscoelastic import FLUID, Kind
from fitting.methods import uncertainty
from fitting.methods.generalised_maxwell import Maxwell
from fitting.methods.least_squares import from_starts
from fitting.readers.frequency_sweep import Sweep, check_sweep
from liverjax.core.errors import InputError

#: ROUNDS: maximum number of rounds. Each round is a fit, followed by new weights of the tests. SETTLED: the rounds end
#: if the noise of no test changes by more than this fraction.
ROUNDS, SETTLED = 12, 0.01


def fit(
    tests: Sequence[Measured], modes: int | str = "auto", progress: Callable[[str], None] = lambda text: None
) -> Together:
    """Choose the number of modes, and a solid or a fluid, by the information criterion (`choice.preferred`). A fit can
    be chosen only if the tests together determine all its modes.

    Args:
        tests: two or more tests.
        modes: number of modes, or "auto".
        progress: called with the name of each fit.

    Raises:
        InputError: `modes` is not a whole number or too large, or a sweep has invalid values.
    """
    tests = list(tests)
    for test in tests:
        if isinstance(test, Sweep):
            check_sweep(test)
    band = ResolvedBand(resolved_by(tests))
    largest = (sum(len(reported_numbers(t)[1]) for t in tests) - 2) // 2
    if modes != "auto" and not 1 <= viscoelastic.whole_number(modes) <= largest:
        raise InputError(f"--modes {modes} is out of range: give 1 to {largest} for these files, or auto")
    top = min(uncertainty.supported_modes(band), largest)
    numbers = range(1, top + 1) if modes == "auto" else range(int(modes), int(modes) + 1)
    tried = _raised_together(tests, band, numbers, Kind(), progress)
    solid = min(tried, key=criterion_of_all)
    if uncertainty.may_be_fluid(solid.uncertainty):
        tried += _raised_together(
            tests, band, range(max(numbers.start, solid.modes - 1), numbers.stop), FLUID, progress
        )
    able = [f for f in tried if _able(f, band)] or tried
    chosen = able[choice.preferred([choice.label_of(f) for f in able], list(map(criterion_of_all, able)))]
    progress("what each test adds")
    return _told_of_all(chosen, tried, band)


def _raised_together(
    tests: list[Measured], band: ResolvedBand, numbers: range, kind: Kind, progress: Callable
) -> list[Together]:
    """Return fits with increasing numbers of modes. The search ends after two fits in a row that do not lower the
    criterion, do not converge, or have superfluous modes."""
    tried: list[Together] = []
    best, failures = np.inf, 0
    for n in numbers:
        progress(f"{n} modes")
        tried.append(_one_test(tests, band, n, kind))
        lower = criterion_of_all(tried[-1]) < best and (len(tried) == 1 or _able(tried[-1], band))
        best, failures = (criterion_of_all(tried[-1]), 0) if lower else (best, failures + 1)
        if failures == 2:
            break
    return tried


def _able(fit: Together, band: ResolvedBand) -> bool:
    return fit.converged and not uncertainty.superfluous(band, fit.uncertainty)


def _one_test(tests: list[Measured], band: ResolvedBand, modes: int, kind: Kind) -> Together:
    """Fit a given number of modes to all tests, in several rounds. After each round, the tests get new weights from
    their residuals."""
    parts = [reported_numbers(t) for t in tests]
    begin, evaluate = time.perf_counter(), partial(tests_evaluated, list(map(name_of, tests)), kind)
    starts, noise = starts_of_all(tests, band, modes, kind), np.array([first_noise(t) for t in tests])
    for _ in range(ROUNDS):
        used = noise
        data = [(at, y, scales * s) for (at, y, scales), s in zip(parts, noise, strict=True)]
        found = from_starts(evaluate, starts, data)
        noise = noises(tests, parts, np.asarray(found.residuals), noise, np.asarray(found.jacobian))
        starts = np.asarray(found.u)[None]  # the next round begins near the minimum
        if np.all(np.abs(noise / used - 1) < SETTLED):
            break
    running = time.perf_counter() - begin
    shares, fitted = misfits(tests, data, np.asarray(found.residuals), noise, len(found.u))
    found = over_own_noise(found, shares, used / noise)
    spreads = uncertainty.estimate(found, True, kind.maxwell, fluid=kind.name == FLUID.name)
    model = Maxwell(*(np.asarray(v) for v in kind.maxwell(found.u)))
    return Together(tests, kind, model, found, spreads, bool(found.converged), shares, fitted, [], (), running, 0.0)


def _told_of_all(chosen: Together, tried: list[Together], band: ResolvedBand) -> Together:
    """Return the chosen fit with the contributions of the tests, the table of all tried fits, and the warnings."""
    begin = time.perf_counter()
    chosen = chosen._replace(shares=shares_of(chosen))
    lowest = min(map(criterion_of_all, tried))
    table = [
        {
            "model": f.kind.name,
            "modes": f.modes,
            "above_the_lowest": criterion_of_all(f) - lowest,
            "identifiable": _able(f, band),
        }
        for f in tried
    ]
    out: list[str] = []
    if not chosen.converged:
        out.append("the fit did not converge, and the parameters with the smallest misfit are given: try fewer modes")
    out += disagreements(chosen.shares)
    out += missed(chosen.shares)
    out += structured(chosen)
    out += uncertainty.superfluous(band, chosen.uncertainty)
    out += of_better_fits(chosen, [f for f in tried if not _able(f, band)])
    out += choice.rival_kind(chosen, [f for f in tried if _able(f, band)], criterion_of_all)
    out += of_rises(chosen)
    if chosen.kind.name == "prony":
        out += uncertainty.like_a_fluid(chosen.uncertainty, "measure longer, or at lower frequencies")
    low, high = band.resolved
    for k, tau in enumerate(chosen.model.relaxation_times):
        if not low <= tau <= high:
            out.append(
                f"relaxation_times[{k}] = {tau:.3g} s lies outside the range {low:.3g}-{high:.3g} s of all tests"
            )
    return chosen._replace(
        tried=sorted(table, key=lambda row: row["above_the_lowest"]),
        warnings=tuple(out),
        run_time=sum(f.run_time for f in tried) + time.perf_counter() - begin,
        compile_time=sum(f.compile_time for f in tried),
    )
