"""One Prony series for several tests of one material, fitted in closed form, and the contribution of each test.

The tests are frequency sweeps, relaxation tests, creep tests, and phase velocities of shear waves.

The noise of every test is different. Its size is estimated during the fit, from the residuals of the test.
"""

import time
from collections.abc import Callable, Sequence
from functools import partial
from typing import NamedTuple

import numpy as np

from fitting.fits import time_tests, viscoelastic
from fitting.fits.viscoelastic import FLUID, Kind
from fitting.methods import generalised_maxwell, host, kramers_kronig, time_response, uncertainty
from fitting.methods.estimate import Estimate, errors_and_correlation, spread
from fitting.methods.generalised_maxwell import Maxwell
from fitting.methods.least_squares import Solution, degrees_of_freedom, from_starts
from fitting.methods.noise.uneven_noise import weighted_by_sizes
from fitting.readers.frequency_sweep import Sweep, check_sweep
from fitting.readers.time_tests import TimeTest
from fitting.waves import shear_waves
from fitting.waves.dispersion import Dispersion
from liverjax.core.errors import InputError
from liverjax.core.struct import Content

#: ROUNDS: maximum number of rounds, each with a fit and then new weights of the tests. SETTLED: the rounds end if the
#: noise of no test changes by more than this fraction. QUIETEST: minimum relative noise of a test. FIRST: relative
#: noise in round 1. STARTS: number of starting points. LEAST_FREEDOM: degrees of freedom needed to estimate a noise.
ROUNDS, QUIETEST, STARTS, FIRST, SETTLED, LEAST_FREEDOM = 12, 1e-5, 6, 0.03, 0.01, 3.0
#: The tests contradict each other if the noise of a test in the common fit, divided by its noise in a fit to this test
#: alone, exceeds this ratio.
APART = 1.5
#: A warning is given if the relative misfit of a test exceeds this value.
MISSED = 0.05
#: MORE: maximum number of additional modes in a fit to one test. CLEARLY: minimum decrease of the information criterion
#: for an additional mode (Kass and Raftery 1995).
MORE, CLEARLY = 2, 10.0

Measured = Sweep | TimeTest | Dispersion


class ResolvedBand(NamedTuple):
    """The range of relaxation times [s] that the tests resolve together."""

    resolved: tuple[float, float]


class Share(NamedTuple):
    """The contribution of one test to the common parameters."""

    name: str  # sweep, dispersion, relaxation or creep
    source: str
    points: int  # number of measured values
    noise: float  # noise in the common fit, divided by the scales; at least 1 if standard deviations are given
    alone: float  # noise in a fit to this test alone, divided by the scales
    misfit: float  # relative misfit of this test in the common fit
    misfit_alone: float  # relative misfit of the fit to this test alone
    mean_relative_error: float
    errors_without: np.ndarray  # standard errors (P,) of the P common parameters if this test is left out


class Together(NamedTuple):
    """The common fit."""

    tests: list[Measured]
    kind: Kind
    model: Maxwell
    solution: Solution
    uncertainty: Estimate
    converged: bool
    shares: list[Share]
    fitted: list[np.ndarray]  # predictions of each test: G' then G'' [Pa], velocities then attenuations, or response
    tried: list[Content]
    warnings: tuple[str, ...]
    run_time: float
    compile_time: float
    parameters: Estimate | None = None  # parameters of another model; None: the modes are the parameters
    details: Content | None = None  # details of the model

    @property
    def modes(self) -> int:
        """Number of Prony modes."""
        return len(self.model.ratios)


def reported_numbers(test: Measured) -> tuple[tuple, np.ndarray, np.ndarray]:
    """Return the arrays from which a test is predicted, the measured values of the test, and the scales of these
    values."""
    if isinstance(test, Sweep):
        return (test.angular_frequency,), np.concatenate([test.storage, test.loss]), np.concatenate(test.deviations)
    if isinstance(test, Dispersion):
        measured = test.measured
        return (test.angular_frequency, test.density, np.arange(len(measured))), measured, test.scales
    at, driven, rows, answer, scales = time_tests.data_in_time(test)
    return (at, driven, rows), answer, scales


def sizes_of(test: Measured) -> np.ndarray:
    """Return the divisors for relative errors: the measured values, with a lower bound in relaxation and creep. If
    errors of the phase angle cause the scatter of G'', its divisor is |G*|."""
    _, measured, scales = reported_numbers(test)
    if isinstance(test, Sweep) and test.sd_estimated:
        return np.concatenate([test.storage, np.hypot(test.storage, test.loss)])
    return scales if isinstance(test, TimeTest) else measured


def sizes_beside(test: Measured, fitted: np.ndarray) -> np.ndarray:
    """Return the divisors for relative errors (`sizes_of`) of a test, if the fit predicts the values `fitted`. The
    divisor is infinite for a value that does not count (`time_tests.relative_sizes`)."""
    sizes = sizes_of(test)
    if not isinstance(test, TimeTest):
        return sizes
    return time_tests.relative_sizes(reported_numbers(test)[1], fitted, sizes, test.rounding)


def relative_errors_of(test: Measured, fitted: np.ndarray) -> np.ndarray:
    """Return the relative errors (k,) of the k values of a test that count, if the fit predicts the values `fitted`."""
    sizes = sizes_beside(test, fitted)
    return (np.abs(fitted - reported_numbers(test)[1]) / sizes)[np.isfinite(sizes)]


def least_noise(test: Measured) -> float:
    """Return the lower bound of the noise of a test, divided by its scales. The bound is 1 if standard deviations are
    given, because given standard deviations are not reduced."""
    return 1.0 if isinstance(test, Sweep) and test.noise_given else QUIETEST


def first_noise(test: Measured) -> float:
    """Return the noise of a test in round 1, divided by its scales. All tests begin with the relative noise `FIRST`."""
    return max(least_noise(test), FIRST * float(np.median(np.abs(sizes_of(test)) / reported_numbers(test)[2])))


def tests_evaluated(kinds: list[str], kind: Kind, u: np.ndarray, data: list) -> tuple[np.ndarray, np.ndarray]:
    """Return the m residuals (…, m) of all tests, in the order of the tests, and their derivatives (…, m, P) with
    respect to the P variables u (…, P), in NumPy."""

    def one(name: str, at: tuple, measured: np.ndarray, scales: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        if name in ("relaxation", "creep"):
            return time_response.residuals_with_jacobian(name, kind.maxwell, u, *at, measured, scales)
        return host.with_jacobian(
            lambda u: (time_tests.response_in_time(name, kind.maxwell(u), *at) - measured) / scales, u
        )

    found = [one(name, *own) for name, own in zip(kinds, data, strict=True)]
    residuals, jacobians = zip(*found, strict=True)
    return np.concatenate(residuals, axis=-1), np.concatenate(jacobians, axis=-2)


def name_of(test: Measured) -> str:
    """Return the kind of test: sweep, dispersion, relaxation or creep."""
    if isinstance(test, TimeTest):
        return test.kind
    return "sweep" if isinstance(test, Sweep) else "dispersion"


def fit(
    tests: Sequence[Measured], modes: int | str = "auto", progress: Callable[[str], None] = lambda text: None
) -> Together:
    """Choose the number of modes by the lowest information criterion. A fit can be chosen only if the tests together
    determine all its modes.

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
    chosen = min(able, key=criterion_of_all)
    progress("what each test adds")
    return _told_of_all(chosen, tried, band)


def resolved_by(tests: Sequence[Measured]) -> tuple[float, float]:
    """Return the shortest and the longest relaxation time [s] that at least one of the tests resolves."""
    ends = np.array([t.resolved for t in tests])
    return float(ends[:, 0].min()), float(ends[:, 1].max())


def _raised_together(
    tests: list[Measured], band: ResolvedBand, numbers: range, kind: Kind, progress: Callable
) -> list[Together]:
    """Return fits with more and more modes. The search ends after two fits in a row that do not lower the criterion, do
    not converge, or have superfluous modes."""
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


def criterion_of_all(fit: Together) -> float:
    """Return the Bayesian information criterion of a common fit. The noise of each test is estimated from the fit."""
    total = sum(s.points for s in fit.shares)
    free = len(fit.solution.u) if fit.kind.effective is None else fit.kind.effective
    return float(sum(s.points * 2 * np.log(s.noise) for s in fit.shares) + free * np.log(total))


def _one_test(tests: list[Measured], band: ResolvedBand, modes: int, kind: Kind) -> Together:
    """Fit a given number of modes to all tests. After each fit, the tests get new weights from their residuals."""
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


def misfits(
    tests: list[Measured], data: list, residuals: np.ndarray, noise: np.ndarray, free: float
) -> tuple[list[Share], list[np.ndarray]]:
    """Return the misfit of each test (`Share`), and the values that the fit predicts for each test.

    Args:
        tests: K tests.
        data: for each test, the arrays from which it is predicted, its measured values, and the divisors of its
            residuals.
        residuals: residuals of all tests; rows of a prior may follow.
        noise: noise (K,) of the tests, relative to their scales.
        free: number of parameters that the data determine.
    """
    counts = [len(y) for _, y, _ in data]
    left = np.split(residuals[: sum(counts)], np.cumsum(counts)[:-1])
    shares, fitted = [], []
    for test, (_, y, scales), r, s in zip(tests, data, left, noise, strict=True):
        errors = relative_errors_of(test, y + r * scales)
        misfit = _size_of_noise(errors, len(errors) * (1 - free / sum(counts)))
        own = (name_of(test), test.source, len(y), float(s), np.nan, misfit, np.nan, float(errors.mean()))
        shares.append(Share(*own, errors_without=np.array([])))
        fitted.append(r * scales + y)
    return shares, fitted


def over_own_noise(found: Solution, shares: list[Share], ratio: np.ndarray) -> Solution:
    """Return the solution with the residuals of each test divided by the noise found for this test. `ratio` (K,): noise
    that was used in the fit, divided by the noise that was found.

    Residuals of a prior are multiplied by the geometric mean of the ratios, because the weight of a prior refers to the
    mean noise.
    """
    factor = np.repeat(ratio, [s.points for s in shares])
    prior = np.full(len(found.residuals) - len(factor), np.exp(np.mean(np.log(ratio))))
    rows = np.concatenate([factor, prior])
    return found._replace(residuals=rows * found.residuals, jacobian=rows[:, None] * found.jacobian)


def _size_of_noise(residuals: np.ndarray, freedom: float) -> float:
    return float(np.sqrt(np.sum(residuals**2) / max(1.0, freedom)))


def noises(
    tests: list[Measured], parts: list, residuals: np.ndarray, used: np.ndarray, taken: np.ndarray | float
) -> np.ndarray:
    """Return the noise of each test, relative to its scales: the root of its squared residuals per degree of freedom.
    With fewer than `LEAST_FREEDOM` degrees, the result is at least `first_noise`. `used`: noise in the fit. `taken`:
    Jacobian of the residuals, or effective number of parameters."""
    counts = np.array([len(y) for _, y, _ in parts])
    left = np.split(residuals[: counts.sum()], np.cumsum(counts)[:-1])
    freedoms = degrees_of_freedom(np.asarray(taken), counts) if np.ndim(taken) else counts * (1 - taken / counts.sum())
    known = freedoms >= LEAST_FREEDOM
    found = [s * _size_of_noise(r, f) for r, s, f in zip(left, used, np.where(known, freedoms, counts), strict=True)]
    return np.maximum(found, [least_noise(t) if k else first_noise(t) for t, k in zip(tests, known, strict=True)])


def starts_of_all(tests: list[Measured], band: ResolvedBand, modes: int, kind: Kind) -> np.ndarray:
    """Return S starting points (S, P) of the P variables, with relaxation times that are spread over the decades of the
    tests. The strengths come from non-negative least squares on the moduli of the tests."""
    out = []
    for times in generalised_maxwell.times_over(band.resolved, modes, STARTS):
        A, b = (np.concatenate(rows) for rows in zip(*(_apparent(t, times) for t in tests), strict=True))
        u = generalised_maxwell.start_at_times(times, A, b)
        out.append(generalised_maxwell.fluid_of(u) if kind.name == FLUID.name else u)
    return np.stack(out)


def _apparent(test: Measured, times: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the matrix and the right-hand side of a linear least-squares problem for the moduli of a test, with
    relative residuals. The unknowns are the equilibrium modulus and the strengths of modes with the relaxation `times`
    [s]."""
    if isinstance(test, TimeTest):
        return time_tests.apparent_equations(test, times)
    b = np.concatenate(_moduli_of(test))
    A = generalised_maxwell.mode_columns(test.angular_frequency, times)[: len(b)]
    return A / b[:, None], np.ones(len(b))


def _moduli_of(test: Sweep | Dispersion) -> tuple[np.ndarray, ...]:
    """Return G' and G'' [Pa]. Velocities alone give only one modulus, about |G*|."""
    if isinstance(test, Sweep):
        return test.storage, test.loss
    if test.attenuation is None:
        return (test.density * test.velocity**2,)
    found = shear_waves.moduli_of(test.velocity, test.attenuation, test.angular_frequency, test.density)
    # Noise can make moduli negative, and a fit cannot begin from negative moduli. Small positive moduli replace them.
    return tuple(np.maximum(G, 1e-2 * np.abs(found[0]).max()) for G in found)


def _told_of_all(chosen: Together, tried: list[Together], band: ResolvedBand) -> Together:
    """Return the chosen fit with the contributions of the tests, the table of all tried fits, and the warnings."""
    begin = time.perf_counter()
    chosen = chosen._replace(shares=_shares(chosen))
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
    out += _of_better_fits(chosen, tried)
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


def _of_better_fits(chosen: Together, tried: list[Together]) -> list[str]:
    """Return a warning if a fit with more modes follows the tests clearly better, although the tests do not determine
    all of its parameters."""
    best = min(tried, key=criterion_of_all)
    lower = criterion_of_all(chosen) - criterion_of_all(best)
    if best.modes <= chosen.modes or not lower > BETTER:
        return []
    return [
        f"{best.modes} modes follow the tests better than {chosen.modes} (criterion lower by {lower:.3g}), but the "
        f"tests do not determine all of their parameters. With {best.modes} modes, shear_modulus would be "
        f"{best.model.shear_modulus:.4g} instead of {chosen.model.shear_modulus:.4g} Pa. The stated errors do not "
        "contain this difference: measure faster or slower processes too"
    ]


#: The program warns if a fit with more modes lowers the information criterion by more than this value, but has
#: parameters that the tests do not determine (Burnham, Anderson 2002).
BETTER = 4.0


#: The program warns if a change of the load between two rows takes at least this fraction of the shortest relaxation
#: time.
_SHORT = 0.2


def of_rises(chosen: Together) -> list[str]:
    """Return a warning for each relaxation or creep test whose load changes between two rows of the file, if modes
    relax during this time. Only the first such change of a test is considered."""
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


def disagreements(shares: list[Share], remedy: str = "try more modes") -> list[str]:
    """Return a warning for each test that the common fit misses by much more than a fit to this test alone does."""
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


def series_of(test: Measured) -> tuple[str, ...]:
    """Return the names of the series of measured values of a test, in parentheses. The series have equal lengths. The
    name is empty if there is only one series."""
    if isinstance(test, Sweep):
        return (" (G')", " (G'')")
    waves = isinstance(test, Dispersion) and test.attenuation is not None
    return (" (velocity)", " (attenuation)") if waves else ("",)


def _fitted_by_noise(fit: Together) -> list[np.ndarray]:
    """Return the predictions of each test. If the two series of a test have noise of different size, the predictions
    are those of a fit with weights for this noise (`weighted_by_sizes`)."""
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


def _shares(fit: Together) -> list[Share]:
    """Return the contribution of each test: the standard errors if this test is left out, and the misfit of a fit to
    this test alone."""
    u = np.asarray(fit.solution.u)
    vector = host.with_jacobian(partial(uncertainty.parameter_vector, maxwell=fit.kind.maxwell), u)[1]
    rows = np.asarray(fit.solution.jacobian)
    return shares_by_rows(fit, rows, vector, fit.uncertainty.values, partial(_residuals_alone, fit))


def _residuals_alone(fit: Together, k: int) -> np.ndarray:
    """Return the residuals of all tests, divided by their scales, from a fit to test k alone. The residuals of the
    other tests are 0.

    This fit has as many modes as the common fit, or more if additional modes fit the test better. If tests contradict
    each other, their common fit may have too few modes.
    """
    parts = [reported_numbers(t) for t in fit.tests]
    # Infinite standard deviations exclude a test.
    data = [(at, y, scales if j == k else np.full(len(y), np.inf)) for j, (at, y, scales) in enumerate(parts)]
    evaluate = partial(tests_evaluated, list(map(name_of, fit.tests)), fit.kind)
    count, u = len(parts[k][1]), np.asarray(fit.solution.u)[None]
    every, own = (ResolvedBand(resolved_by(tests)) for tests in (fit.tests, [fit.tests[k]]))
    starts = np.concatenate([u, starts_of_all(fit.tests, every, fit.modes, fit.kind)[1:]])
    best = np.asarray(from_starts(evaluate, starts, data).residuals)
    free, share = starts.shape[1], fit.shares[k]
    noise = _size_of_noise(best, count - min(free, count / 2))
    if share.noise <= APART * noise and share.misfit < MISSED:
        return best
    lowest = _criterion_alone(best, count, free)
    for modes in range(fit.modes, fit.modes + MORE + 1):
        # If the moduli of this test are far from the moduli of the others, the starting points for all tests are not
        # good for this test.
        starts = starts_of_all([fit.tests[k]], own, modes, fit.kind)
        r, free = np.asarray(from_starts(evaluate, starts, data).residuals), starts.shape[1]
        criterion = _criterion_alone(r, count, free)
        if free <= count / 2 and criterion < lowest - CLEARLY:
            best, lowest = r, criterion
    return best


def _criterion_alone(r: np.ndarray, count: int, free: int) -> float:
    """Return the Bayesian information criterion of a fit with `free` parameters to the `count` values of one test."""
    return float(2 * count * np.log(max(_size_of_noise(r, count), QUIETEST)) + free * np.log(count))


def shares_by_rows(
    fit: Together, jacobian: np.ndarray, slope: np.ndarray, values: np.ndarray, alone: Callable[[int], np.ndarray]
) -> list[Share]:
    """Return the contribution of each test: the standard errors from the residuals of the other tests only, and the
    misfit of a fit to this test alone.

    Args:
        fit: the common fit.
        jacobian: derivatives of the residuals of all tests with respect to u; rows of a prior may follow.
        slope: derivatives of the reported parameters with respect to u.
        values: the reported parameters.
        alone: function from the index of a test to the residuals, divided by their scales, of a fit to this test alone.
            The rows are in the order of the common fit.
    """
    counts = [s.points for s in fit.shares]
    free = jacobian.shape[1] if fit.kind.effective is None else fit.kind.effective
    place = np.repeat(np.arange(len(counts)), counts)
    place = np.concatenate([place, np.full(len(jacobian) - len(place), -1)])
    out = []
    for k, share in enumerate(fit.shares):
        root, _ = spread(jacobian[place != k], 1.0, slope)
        without = errors_and_correlation(root)[0]
        r, (_, y, scales) = alone(k)[: sum(counts)][place[: sum(counts)] == k], reported_numbers(fit.tests[k])
        freedom, errors = counts[k] - min(free, counts[k] / 2), relative_errors_of(fit.tests[k], y + r * scales)
        unknown = ~(without < 1e3 * np.abs(values))
        # A fit with as many parameters as values follows the noise, so its residuals do not show the noise.
        least = least_noise if counts[k] - free >= LEAST_FREEDOM else first_noise
        out.append(
            share._replace(
                alone=max(least(fit.tests[k]), _size_of_noise(r, freedom)),
                misfit_alone=_size_of_noise(errors, freedom * len(errors) / counts[k]),
                errors_without=np.where(unknown, np.inf, without),
            )
        )
    return out
