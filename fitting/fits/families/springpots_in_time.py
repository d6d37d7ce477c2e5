"""Springpot models for relaxation and creep tests and for several tests together. Choice between all models.

The response of a springpot model is computed with many modes of its relaxation spectrum (`springpots.as_modes`). So the
response to any load is computed in the same way as for Prony modes. The fit varies and reports only the parameters of
the springpot model, not these modes.
"""

from collections.abc import Callable, Sequence
from functools import partial
from time import perf_counter
from typing import NamedTuple, TypeVar

import jax
import numpy as np

from fitting.fits import time_tests
from fitting.fits.families import choice, limits, models, spectrum_of_tests
from fitting.fits.honesty import common_factor
from fitting.fits.honesty.alike_answers import fitted_by_its_noise, with_offset_errors, with_own_noise
from fitting.fits.honesty.long_times import with_interval
from fitting.fits.honesty.rise_of_load import with_rise_of_load
from fitting.fits.honesty.short_times import with_short_times
from fitting.fits.time_tests import CONSTANT_NOISE, TimeFit
from fitting.fits.together import common_fit, contributions, doubts, measured_tests, residuals_of_tests
from fitting.fits.together.measured_tests import Measured
from fitting.fits.together.residuals_of_tests import Share, Together
from fitting.fits.viscoelastic import Kind
from fitting.methods import as_prony_modes, generalised_maxwell, host, springpots, uncertainty
from fitting.methods.estimate import Estimate, estimated
from fitting.methods.generalised_maxwell import Maxwell
from fitting.methods.host import Array
from fitting.methods.least_squares import Solution, from_starts
from fitting.methods.springpots import FRACTIONAL, Fractional
from fitting.readers.frequency_sweep import Sweep
from fitting.readers.time_tests import TimeTest
from liverjax.core.struct import Content

#: STARTS: number of starting points for each model. The first starting point is computed from Prony modes. AROUND:
#: standard deviation of the other, random starting points around the first. MOST_STEPS: maximum number of iterations.
STARTS, AROUND, MOST_STEPS = 10, 1.0, 80
#: An exponent is a logistic function of its variable. If the absolute value of this variable is above MOST_LOGIT, the
#: derivative of the exponent is too small for the first step of a search.
MOST_LOGIT = 2.0


class Spans(NamedTuple):
    """Relaxation times [s] of the modes that represent springpots, and the reference frequency [rad/s] of the variables
    of the springpots."""

    low: float  # shortest time [s] that the tests resolve
    high: float  # longest time [s] that the tests resolve
    times: np.ndarray  # relaxation times [s] of the modes
    reference: float  # [rad/s]


def spans_of(tests: Sequence[Measured]) -> Spans:
    """Return the relaxation times of the modes and the reference frequency. Both follow from the range of times that
    the tests resolve."""
    low, high = measured_tests.resolved_by(tests)
    return Spans(low, high, springpots.times_of_modes(low, high), float(1 / np.sqrt(low * high)))


def _dense_modes(case: Fractional, spans: Spans) -> Callable[[Array], Maxwell]:
    """Return a function for NumPy and JAX. It computes many Prony modes, which represent the relaxation spectrum of the
    model, from the variables u of the model."""

    def maxwell(u):
        return springpots.as_modes(springpots.full(case, u), case.switches, spans.times, spans.reference)

    return maxwell


def residuals_of_springpot(name: str, test: TimeTest) -> Callable[[jax.Array], jax.Array]:
    """Return a JAX function of the variables u of the springpot model `name`. The function computes the residuals (m,)
    of the m measured values of a relaxation or creep test."""
    (case,) = (c for c in FRACTIONAL if c.name == name)
    maxwell, (at, measured, scales) = _dense_modes(case, spans_of([test])), measured_tests.reported_numbers(test)

    def of(u):
        return (time_tests.response_in_time(test.kind, maxwell(u), *at) - measured) / scales

    return of


def _minimum_of_case(case: Fractional, tests: Sequence[Measured], starts: np.ndarray, data: list) -> Solution:
    """Fit the springpot model `case` to one or more tests, from S starting points `starts` (S, P) of its P variables.
    Return the lowest minimum.

    `data`: for each test, three entries: the arrays from which the test is predicted, the measured values, and the
    divisors of the residuals.
    """
    kind = Kind(case.name, _dense_modes(case, spans_of(tests)))
    evaluate = partial(residuals_of_tests.tests_evaluated, list(map(measured_tests.name_of, tests)), kind)
    return from_starts(evaluate, starts, data, max_iterations=MOST_STEPS)


def _starts_near(model: Maxwell, spans: Spans) -> list[np.ndarray]:
    """Return starting points (STARTS, P) for each springpot model, with P variables. The first point is the fit of the
    springpot model to the moduli of the Prony modes `model`. The other points lie around the first."""
    omega = np.geomspace(1 / spans.high, 1 / spans.low, 24)
    like, rng = Sweep(omega, *generalised_maxwell.moduli(model, omega)), np.random.default_rng(0)
    first = [np.asarray(fit.solution.u) for fit in models.fractional(like)]
    return [np.vstack([u, _around(u, case, rng)]) for case, u in zip(FRACTIONAL, first, strict=True)]


def _around(u: np.ndarray, case: Fractional, rng: np.random.Generator) -> np.ndarray:
    """Return random starting points (STARTS - 1, P) around the variables u (P,) of a springpot model. If an exponent in
    u is near 0 or 1, the points lie around a less extreme value."""
    near = np.where(np.array(case.free) % 2 == 1, np.clip(u, -MOST_LOGIT, MOST_LOGIT), u)
    return near + AROUND * rng.standard_normal((STARTS - 1, len(u)))


class _Springpot(NamedTuple):
    """One springpot model with its fitted parameters."""

    case: Fractional
    kind: Kind
    model: Maxwell  # a small number of Prony modes that represent the springpot model
    solution: Solution
    spread: Estimate  # parameters of the Prony modes
    own: Estimate  # parameters of the springpot model
    sentences: tuple[str, ...]
    error: float  # largest relative error of `model` over the band


def _springpot_at(case: Fractional, solution: Solution, spans: Spans, over_noise: bool) -> _Springpot:
    """Return a springpot model with its parameters, errors and warnings at the minimum `solution`. `over_noise`:
    whether the residuals are already divided by their noise. If False, the noise is estimated from the residuals."""

    def at(u, omega):
        return springpots.moduli(springpots.full(case, u), case.switches, omega / spans.reference)

    def values(u):
        return case.values(springpots.full(case, u), spans.reference)

    def moduli(omega):
        storage, loss = at(solution.u, omega)
        return storage, np.maximum(loss, 1e-12 * np.hypot(storage, loss))  # the loss modulus of a diverged fit may be 0

    made = as_prony_modes.convert(moduli, 1 / spans.high, 1 / spans.low, case.solid)
    kind = Kind(case.name, lambda u: as_prony_modes.modes(made, at(u, made.omega)), case.names, case.units, values)
    sentences = []
    storage, loss = generalised_maxwell.moduli(_dense_modes(case, spans)(solution.u), made.omega)
    real, imaginary = moduli(made.omega)
    apart = float(np.max(np.abs((storage + 1j * loss) / (real + 1j * imaginary) - 1)))
    for error, what in ((made.error, f"{len(made.times)} Prony modes"), (apart, "the modes used in the fit")):
        if error > as_prony_modes.ALLOWED:
            sentences.append(
                f"{what} represent the model {case.name} only with errors of up to {100 * error:.2g} %: try another "
                "--model"
            )
    own = estimated(case.names, values, solution, len(solution.residuals), over_noise)
    spread = uncertainty.estimate(solution, over_noise, kind.maxwell)
    model = kind.maxwell(solution.u)
    sentences += limits.limit_sentences(case.name, spread, model, own)
    return _Springpot(case, kind, model, solution, spread, own, tuple(sentences), made.error)


def able(fit: TimeFit | Together, data: uncertainty.Band) -> bool:
    """Return whether the fit converged and the data determine every parameter. For a spectrum, only the convergence is
    checked: its prior determines the parameters that the data do not determine."""
    if fit.parameters is not None:
        return fit.converged and (fit.kind.effective is not None or bool(np.all(models.determined(fit.parameters))))
    return fit.converged and not uncertainty.superfluous(data, fit.uncertainty)


def fractional_in_time(test: TimeTest, near: Maxwell) -> list[TimeFit]:
    """Fit every springpot model to a relaxation or creep test. `near`: Prony modes that give the starting points."""
    spans, data = spans_of([test]), [measured_tests.reported_numbers(test)]
    _, answer, scales = data[0]
    out = []
    for case, starts in zip(FRACTIONAL, _starts_near(near, spans), strict=True):
        begin = perf_counter()
        found = _springpot_at(case, _minimum_of_case(case, [test], starts, data), spans, over_noise=False)
        fitted = np.asarray(found.solution.residuals) * scales + answer
        where = (test.time[time_tests.thinned(test)], answer, fitted, scales)
        details = {"conversion": {"modes": len(found.model.ratios), "largest_relative_error": found.error}}
        own = (found.kind, found.model, found.solution, found.spread, bool(found.solution.converged))
        seconds = perf_counter() - begin
        out.append(TimeFit(*own, *where, found.sentences, seconds, 0.0, details, found.own, test.rounding))
    return out


def choose_in_time(test: TimeTest, model: str, modes: int | str = "auto") -> TimeFit:
    """Return the fit with the lowest information criterion among the models whose parameters the test determines.

    Args:
        test: data.
        model: one of `models.MODELS`.
        modes: number of Prony modes, or "auto".
    """
    test, prony = fitted_by_its_noise(test, modes)
    if model == "prony":
        return _with_ends_of_record(with_own_noise(prony), test, prony)
    tried = [prony] if model == "auto" else []
    tried += fractional_in_time(test, prony.model) if model in ("fractional", "auto") else []
    tried += [spectrum_of_tests.spectrum_in_time(test, prony.model)] if model in ("spectrum", "auto") else []
    fits = [f for f in tried if able(f, test)] or tried
    best = _preferred_of(fits, time_tests.criterion)
    rows = _compared_models(tried, time_tests.criterion, test)
    rows = _with_other_kind(rows, prony, prony.details["tried"]) if model == "auto" else rows
    sentences = best.warnings if best is prony else (*best.warnings, *_cautions_in_time(best))
    seconds = {n: sum(getattr(f, n) for f in {id(f): f for f in (*tried, prony)}.values()) for n in TIMES}
    whole = with_own_noise(best._replace(warnings=sentences, details=best.details | {"tried": rows}, **seconds))
    return _with_ends_of_record(whole, test, prony)


def _with_ends_of_record(fit: TimeFit, test: TimeTest, prony: TimeFit) -> TimeFit:
    fit = fit._replace(details=fit.details | {CONSTANT_NOISE: test.constant_noise})
    if time_tests.ELASTIC in fit.details and not fit.converged:
        return fit  # the modes of an elastic material have no meaning
    fit, of_offset = with_offset_errors(fit, [test], [1.0])
    fit = with_rise_of_load(fit, test, prony)
    return with_short_times(with_interval(fit, [test], [fit.uncertainty.noise], common=of_offset), test)


AFit = TypeVar("AFit", TimeFit, Together)


def _preferred_of(fits: Sequence[AFit], criterion: Callable[[AFit], float]) -> AFit:
    """Return the fit that `choice.preferred` selects."""
    return fits[choice.preferred([choice.label_of(f) for f in fits], list(map(criterion, fits)))]


def _compared_models(tried: Sequence, criterion: Callable, data: uncertainty.Band) -> list[Content]:
    """Return a table with the information criterion of each compared model, best model first."""
    best = min(map(criterion, tried))
    rows: list[Content] = [
        {
            "model": f.kind.name,
            "modes": f.modes,
            "above_the_lowest": criterion(f) - best,
            "identifiable": able(f, data),
        }
        for f in tried
    ]
    return sorted(rows, key=lambda row: row["above_the_lowest"])


def _with_other_kind(rows: list[Content], prony: AFit, tried: list[Content]) -> list[Content]:
    """Add one row to the table of compared models: the best fluid if `prony` is a solid, or the best solid if `prony`
    is a fluid. No row is added if no such fit was tried, or if the data do not determine the parameters of any such
    fit. `tried`: the table of all fits that were tried before `prony` was chosen."""
    others = [row for row in tried if row["model"] != prony.kind.name and row["identifiable"]]
    if not others:
        return rows
    (own,) = (row for row in tried if (row["model"], row["modes"]) == (prony.kind.name, prony.modes))
    (here,) = (row for row in rows if row["model"] == prony.kind.name)
    other = min(others, key=lambda row: row["above_the_lowest"])
    above = here["above_the_lowest"] + other["above_the_lowest"] - own["above_the_lowest"]
    rows = [*rows, {key: other[key] for key in here} | {"above_the_lowest": above}]
    lowest = min(row["above_the_lowest"] for row in rows)
    rows = [row | {"above_the_lowest": row["above_the_lowest"] - lowest} for row in rows]
    return sorted(rows, key=lambda row: row["above_the_lowest"])


#: A test with fewer measured values is not checked for noise with a constant standard deviation.
_ENOUGH = 10
#: Names of the fields of a fit that contain computing times [s].
TIMES = ("run_time", "compile_time")


def _cautions_in_time(fit: TimeFit) -> list[str]:
    out = (
        []
        if fit.converged
        else ["the fit did not converge, and the parameters with the smallest misfit are given: try another --model"]
    )
    assert fit.parameters is not None
    mean = float(fit.relative_errors.mean())
    if mean > 0.05:
        out.append(f"the fit misses the data by {100 * mean:.2g} % on average: try another --model")
    out += models.undetermined(fit)
    return out + time_tests.structured_misfit(fit)


def fractional_together(tests: list[Measured], near: Maxwell) -> list[Together]:
    """Fit every springpot model to several tests. Each test has its own noise level. `near`: Prony modes that give the
    starting points."""
    spans, parts = spans_of(tests), [measured_tests.reported_numbers(t) for t in tests]
    out = []
    for case, starts in zip(FRACTIONAL, _starts_near(near, spans), strict=True):
        begin, noise = perf_counter(), np.array([measured_tests.first_noise(t) for t in tests])
        for _ in range(common_fit.ROUNDS):
            used, data = noise, [(at, y, scales * s) for (at, y, scales), s in zip(parts, noise, strict=True)]
            minimum = _minimum_of_case(case, tests, starts, data)
            noise = residuals_of_tests.noises(
                tests, parts, np.asarray(minimum.residuals), noise, np.asarray(minimum.jacobian)
            )
            starts = np.asarray(minimum.u)[None]  # the next round begins near the minimum
            if np.all(np.abs(noise / used - 1) < common_fit.SETTLED):
                break
        shares, fitted = residuals_of_tests.misfits(tests, data, np.asarray(minimum.residuals), noise, len(case.free))
        found = _springpot_at(
            case, residuals_of_tests.over_own_noise(minimum, shares, used / noise), spans, over_noise=True
        )
        own = (tests, found.kind, found.model, found.solution, found.spread, bool(found.solution.converged))
        out.append(Together(*own, shares, fitted, [], found.sentences, perf_counter() - begin, 0.0, found.own))
    return out


def choose_together(
    tests: list[Measured],
    model: str,
    modes: int | str = "auto",
    progress: Callable[[str], None] = lambda text: None,
    relative: float | np.ndarray = 0.0,
) -> Together:
    """Return the fit of several tests with the lowest information criterion. `model` and `modes` are the same as in
    `choose_in_time`, and `progress` is the same as in `common_fit.fit`.

    `relative`: relative errors (K,) of the moduli of the K tests, caused by errors in the sizes of the samples. One
    number means the same error for all tests.
    """
    tests = [_by_its_noise(test) for test in tests]
    prony = common_fit.fit(tests, modes, progress)
    fit = prony if model == "prony" else _best_of_models(tests, model, prony, progress)
    fit = fit._replace(warnings=(*fit.warnings, *common_factor.told(fit, relative)))
    noises = [s.noise for s in fit.shares]
    fit, of_offsets = with_offset_errors(fit, fit.tests, noises)
    return with_interval(fit, fit.tests, noises, common=of_offsets)


def _by_its_noise(test: Measured) -> Measured:
    """Return the test. For a relaxation or creep test with enough values, set `constant_noise` to True if the noise has
    a constant standard deviation."""
    if not isinstance(test, TimeTest) or np.sum(test.used) < _ENOUGH:
        return test
    return fitted_by_its_noise(test)[0]


def _best_of_models(tests: list[Measured], model: str, prony: Together, progress: Callable[[str], None]) -> Together:
    """Return the fit with the lowest information criterion among `prony` and the other models that `model` selects."""
    band = measured_tests.ResolvedBand(spans_of(tests)[:2])
    tried = [prony] if model == "auto" else []
    if model in ("fractional", "auto"):
        progress("springpots")
        tried += fractional_together(tests, prony.model)
    if model in ("spectrum", "auto"):
        progress("spectrum")
        noise = np.array([s.noise for s in prony.shares])
        tried.append(spectrum_of_tests.spectrum_together(tests, prony.model, noise))
    fits = [f for f in tried if able(f, band)] or tried
    best = _preferred_of(fits, residuals_of_tests.criterion_of_all)
    rows = _compared_models(tried, residuals_of_tests.criterion_of_all, band)
    rows = _with_other_kind(rows, prony, prony.tried) if model == "auto" else rows
    seconds = {n: sum(getattr(f, n) for f in {id(f): f for f in (*tried, prony)}.values()) for n in TIMES}
    if best is prony:
        return best._replace(tried=rows, **seconds)
    if best.kind.effective is None:
        progress("what each test adds")
        best = best._replace(shares=_shares_of_springpots(best))
    out = [*best.warnings] if best.converged else ["the fit did not converge: try another --model", *best.warnings]
    out += doubts.disagreements(best.shares, "try another --model")
    out += doubts.missed(best.shares)
    out += doubts.of_rises(prony)  # the relaxation times of `prony` show whether the material relaxes during the rise
    out += doubts.structured(best)
    out += models.undetermined(best)
    return best._replace(tried=rows, warnings=tuple(out), **seconds)


def _shares_of_springpots(fit: Together) -> list[Share]:
    """Return the contribution of each test to the common fit. It contains the standard errors of the springpot
    parameters without this test, and the misfit of a fit to this test alone."""
    (case,) = (c for c in FRACTIONAL if c.name == fit.kind.name)
    parts = [measured_tests.reported_numbers(t) for t in fit.tests]
    assert fit.kind.values is not None and fit.parameters is not None
    u = np.asarray(fit.solution.u)
    _, slope = host.with_jacobian(fit.kind.values, u)
    starts = np.vstack([u, _around(u, case, np.random.default_rng(1))])

    def alone(k: int) -> np.ndarray:
        data = [(at, y, scales if j == k else np.full(len(y), np.inf)) for j, (at, y, scales) in enumerate(parts)]
        return np.asarray(_minimum_of_case(case, fit.tests, starts, data).residuals)

    return contributions.shares_by_rows(fit, np.asarray(fit.solution.jacobian), slope, fit.parameters.values, alone)
