"""Warnings about a common fit of several tests."""

import numpy as np

from fitting.fits import viscoelastic
from fitting.fits.together.measured_tests import least_noise, name_of, reported_numbers, series_of, sizes_of
from fitting.fits.together.residuals_of_tests import Share, Together, criterion_of_all
from fitting.methods import kramers_kronig
from fitting.methods.noise.uneven_noise import weighted_by_sizes
from fitting.readers.time_tests import TimeTest

#: The tests contradict each other if the noise of a test in the common fit, divided by its noise in a fit to this test
#: alone, exceeds this ratio.
APART = 1.5
#: A warning is given if the relative misfit of a test exceeds this value.
MISSED = 0.05


#: The program warns if a fit with more modes lowers the information criterion by more than this value, but has
#: parameters that the tests do not determine (Burnham, Anderson 2002).
BETTER = 4.0


#: The program warns if a change of the load between two rows takes at least this fraction of the shortest relaxation
#: time.
_SHORT = 0.2


def disagreements(shares: list[Share], remedy: str = "try more modes") -> list[str]:
    """Return a warning for each test whose misfit is much larger in the common fit than in a fit to this test alone."""
    return [
        f"the tests do not agree. The misfit of {s.source or s.name} is {100 * s.misfit:.2g} % in the common fit, but "
        f"only {100 * s.misfit_alone:.2g} % in a fit to this test alone: check whether this test was made at another "
        f"temperature or strain, or on another sample; otherwise {remedy}"
        for s in shares
        if s.noise > APART * s.alone and s.misfit > 0.01
    ]


def missed(shares: list[Share]) -> list[str]:
    """Return a warning for each test with a large misfit both in the common fit and in a fit to this test alone."""
    return [
        f"{viscoelastic.MISSES} of {s.source or s.name} by {100 * s.misfit:.2g} %: if this is not noise, use another "
        "--model"
        for s in shares
        if s.misfit > MISSED and s.noise <= APART * s.alone
    ]


def of_better_fits(chosen: Together, undetermined: list[Together]) -> list[str]:
    """Return a warning if a fit with more modes follows the tests clearly better, but has parameters that the tests do
    not determine. `undetermined`: all fits with such parameters."""
    best = min(undetermined, key=criterion_of_all, default=chosen)
    lower = criterion_of_all(chosen) - criterion_of_all(best)
    if best.modes <= chosen.modes or not lower > BETTER:
        return []
    return [
        f"{best.modes} modes follow the tests better than {chosen.modes} (criterion lower by {lower:.3g}), but the "
        f"tests do not determine all of their parameters. With {best.modes} modes, shear_modulus would be "
        f"{best.model.shear_modulus:.4g} instead of {chosen.model.shear_modulus:.4g} Pa. The stated errors do not "
        "contain this difference: measure faster or slower processes too"
    ]


def of_rises(chosen: Together) -> list[str]:
    """Return a warning for each relaxation or creep test whose load changes between two rows of the file, if the
    shortest relaxation time is not much longer than this change (`_SHORT`). Only the first such change of a test is
    considered."""
    own = chosen.model.relaxation_times[np.asarray(chosen.model.ratios) > 0.01]
    out = []
    for test in (t for t in chosen.tests if isinstance(t, TimeTest)):
        row = test.jumps[:1].sum()
        if not row or not len(own) or test.time[row] - test.time[row - 1] < _SHORT * own.min():
            continue
        out.append(
            f"no row of {test.source} shows how the load changed between {test.time[row - 1]:.4g} and "
            f"{test.time[row]:.4g} s, so a linear change is assumed. If the change was a step, the moduli at "
            "high frequencies are wrong: add the rows measured during the change to the file"
        )
    return out


def _fitted_by_noise(fit: Together) -> list[np.ndarray]:
    """Return the predicted values of each test. If the two series of a test have different noise, the values are
    predicted by a fit with weights for this noise (`weighted_by_sizes`)."""
    J, r = np.asarray(fit.solution.jacobian), np.asarray(fit.solution.residuals)
    ends, groups = np.cumsum([s.points for s in fit.shares]), []
    for test, end, share in zip(fit.tests, ends, fit.shares, strict=True):
        if len(series_of(test)) == 2 and least_noise(test) < 1.0:
            groups.append(np.full(len(r), -1))
            groups[-1][end - share.points : end] = np.arange(share.points) >= share.points // 2
    moved = np.split((weighted_by_sizes(J, r, np.ones(len(r)), groups) - r)[: ends[-1]], ends[:-1])
    rows = zip(fit.tests, fit.fitted, moved, fit.shares, strict=True)
    return [fitted + own * share.noise * reported_numbers(test)[2] for test, fitted, own, share in rows]


def structured(fit: Together) -> list[str]:
    """Return a warning for each series of residuals (`series_of`) that changes sign too rarely."""
    out = []
    for test, fitted in zip(fit.tests, _fitted_by_noise(fit), strict=True):
        residuals, names = fitted - reported_numbers(test)[1], series_of(test)
        if np.max(np.abs(residuals) / sizes_of(test)) <= viscoelastic.EXACT:
            continue
        for part, what in zip(np.split(residuals, len(names)), names, strict=True):
            runs, chance = kramers_kronig.runs_probability(part)
            if chance < kramers_kronig.CHANCE:
                out.append(
                    f"structured misfit of {test.source or name_of(test)}{what}: the residuals change sign only "
                    f"{runs - 1} times in {len(part)} values (probability by chance {chance:.1g}). The model is "
                    "inadequate, or the tests do not agree"
                )
    return out
