"""Prony modes from a relaxation or creep test, in closed form.

The driven quantity is the measured load: the strain in relaxation, the stress in creep. The response is the other
quantity: the stress in relaxation, the strain in creep. The fit describes the measured values of the response.
"""

from collections.abc import Callable
from functools import lru_cache, partial
from time import perf_counter
from typing import NamedTuple

import jax
import numpy as np

from fitting.fits import viscoelastic
from fitting.fits.families import choice
from fitting.fits.viscoelastic import FLUID, Kind
from fitting.methods import generalised_maxwell, kramers_kronig, time_response, uncertainty
from fitting.methods.estimate import Estimate, without_part
from fitting.methods.generalised_maxwell import Maxwell
from fitting.methods.host import Array, arrays_of
from fitting.methods.least_squares import Solution, from_starts
from fitting.readers.noise_of_series import noise_of_series, rounding_of_series
from fitting.readers.time_tests import TimeTest
from fitting.waves import shear_waves
from liverjax.core.errors import InputError
from liverjax.core.struct import Content

#: STILL: the load changes between two successive rows if they differ by more than this fraction of the maximum load.
#: MOST_LOADS: maximum number of loads that are treated separately.
STILL, MOST_LOADS = 0.01, 10
#: Maximum number of measured values in a fit. If a record has more values, only some of them are used, at about equal
#: steps of log time.
MOST = 300
#: Key in `TimeFit.details` if the noise of neighbouring values is correlated. Its value is a number N: N independent
#: values carry the same information.
INDEPENDENT = "independent_answers"
#: Key in `TimeFit.details`. Its value states whether the noise of all measured values has the same standard deviation.
CONSTANT_NOISE = "noise_of_constant_size"
#: Number of starting points of a fit.
STARTS = 12
#: A response has decayed if the fitted and the measured value are below two limits: the first number times the noise,
#: and the second number times the largest measured value.
_DECAYED = 10.0, 0.1


class TimeFit(NamedTuple):
    """The fit of m measured values of a relaxation or creep test."""

    kind: Kind
    model: Maxwell
    solution: Solution
    uncertainty: Estimate
    converged: bool
    time: np.ndarray  # times (m,) [s] of the measured values
    measured: np.ndarray  # (m,) stress [Pa], or strain [1] in creep
    fitted: np.ndarray
    scales: np.ndarray  # (m,) scales that divide the residuals
    warnings: tuple[str, ...]
    run_time: float
    compile_time: float
    details: Content
    parameters: Estimate | None = None  # parameters of another model; None: the modes are the parameters
    rounding: float = 0.0  # `TimeTest.rounding`

    @property
    def modes(self) -> int:
        """Number of Prony modes."""
        return len(self.model.ratios)

    @property
    def relative_errors(self) -> np.ndarray:
        """Relative errors (k,) of the k values that count: |fit - data|, divided by the finite `relative_sizes`."""
        sizes = relative_sizes(self.measured, self.fitted, self.scales, self.rounding)
        return (np.abs(self.fitted - self.measured) / sizes)[np.isfinite(sizes)]


def relative_sizes(measured: np.ndarray, fitted: np.ndarray, scales: np.ndarray, rounding: float = 0.0) -> np.ndarray:
    """Return the divisors (m,) of the relative errors of m values. A divisor is the root of the sum of two squares: the
    square of the fitted response, and the square of the median of |fit - data|.

    If the response changes sign, as in cycles, the divisors are the scales of the residuals. In other tests, these
    scales would hide noise, because the lower bound of the scales is 33 times the noise.

    A value does not count if the response has decayed into its noise (`_DECAYED`), because then its relative error is
    large for any model. The divisor of such a value is infinite.
    """
    largest = np.abs(measured).max(initial=0.0)
    if min(measured.max(initial=0.0), -measured.min(initial=0.0)) > 0.1 * largest:
        return scales
    off, size = fitted - measured, np.maximum(np.abs(fitted), np.abs(_median_of_five(measured)))
    decayed = size < _size_of_decayed(measured, off, rounding)
    return np.where(decayed, np.inf, np.hypot(fitted, max(float(np.median(np.abs(off))), 1e-300)))


def sizes_of_prediction(
    measured: np.ndarray, predicted: np.ndarray, scales: np.ndarray, rounding: float = 0.0
) -> np.ndarray:
    """Return the divisors (m,) for the relative errors of a test that was predicted, not fitted. The divisors do not
    grow with the error of the prediction, unlike `relative_sizes`. A value does not count (infinite divisor) if both
    the measured and the predicted response have decayed into the noise."""
    largest = np.abs(measured).max(initial=0.0)
    if min(measured.max(initial=0.0), -measured.min(initial=0.0)) > 0.1 * largest:
        return scales
    typical = np.abs(_median_of_five(measured))
    least = _size_of_decayed(measured, predicted - measured, rounding)
    return np.where(np.maximum(typical, np.abs(predicted)) < least, np.inf, np.maximum(typical, max(least, 1e-300)))


def _median_of_five(values: np.ndarray) -> np.ndarray:
    from scipy.ndimage import median_filter

    return np.asarray(median_filter(values, min(5, len(values)), mode="nearest"))


def _size_of_decayed(measured: np.ndarray, off: np.ndarray, rounding: float) -> float:
    """Return the size below which a response has decayed (`_DECAYED`). `off`: fit minus data (m,)."""
    noise = max(noise_of_series(off), rounding_of_series(measured), rounding)
    return min(_DECAYED[0] * noise, _DECAYED[1] * float(np.abs(_median_of_five(measured)).max(initial=0.0)))


@lru_cache(maxsize=8)
def _residuals(kind: str, name: str) -> Callable[..., jax.Array]:
    """Return a function of (u, time, driven, rows, answer, scales). The function computes the residuals (m,) of m
    measured values, for relaxation or creep."""
    natural = generalised_maxwell.natural_fluid if name == FLUID.name else generalised_maxwell.natural

    def residuals(u, time, driven, rows, answer, scales):
        return (response_in_time(kind, natural(u), time, driven, rows) - answer) / scales

    return residuals


def thinned(test: TimeTest) -> np.ndarray:
    """Return the indices (m,) of the fitted rows of the test: all usable rows, or about `MOST` of them. The selected
    rows are spread over the log of the time since the load last began to change."""
    rows = np.flatnonzero(test.used)
    if len(rows) <= MOST:
        return rows
    begins = _begins_of_loads(test)
    # A row at the starting time of a load belongs to the previous load.
    of_load = np.searchsorted(begins, test.time[rows]) - 1
    picked: list[np.ndarray] = []
    left = MOST
    # Loads with few rows come first, so that the other loads can use more rows.
    for done, k in enumerate(np.argsort(np.bincount(of_load, minlength=len(begins)), kind="stable")):
        own = rows[of_load == k]
        picked.append(own[_spread_places(test.time[own] - begins[k], left // (len(begins) - done))])
        left -= len(picked[-1])
    return np.sort(np.concatenate(picked))


def _begins_of_loads(test: TimeTest) -> np.ndarray:
    """Return the times [s] at which the driven quantity begins to change, from `TimeTest.begun` on. If there are more
    than `MOST_LOADS` such times (for example in cycles), only the first of these times is returned.
    """
    driven = np.abs(test.driven)
    still = max(STILL * float(driven.max()), 8 * noise_of_series(test.driven))
    moves = np.abs(np.diff(test.driven)) > still
    first = np.flatnonzero(moves & ~np.concatenate([[False], moves[:-1]]))
    begins = np.union1d([test.begun], test.time[first][test.time[first] > test.begun])
    return begins if len(begins) <= MOST_LOADS else begins[:1]


def _spread_places(time: np.ndarray, number: int) -> np.ndarray:
    """Select about `number` of n increasing times (n,) [s] above 0, and return their indices. Times that are far apart
    in log time are all selected. From the other times, some at about equal distances in log time are selected.
    """
    if len(time) <= number:
        return np.arange(len(time))
    apart = np.diff(np.log(time))
    low, high = 0.0, max(float(apart.max()), float(apart.sum()) / (number - 1))
    for _ in range(60):
        step = 0.5 * (low + high)
        low, high = (step, high) if np.sum(np.minimum(apart / step, 1.0)) > number - 1 else (low, step)
    passed = np.concatenate([[0.0], np.cumsum(np.minimum(apart / high, 1.0))])
    return np.flatnonzero(np.diff(np.floor(passed + 1e-9), prepend=-1.0) > 0)


def fit(test: TimeTest, modes: int | str = "auto") -> TimeFit:
    """Choose the number of modes, and a solid or a fluid, by the information criterion. A fit can be chosen only if the
    test determines all its modes. A solid is chosen only with strong evidence against a fluid (`choice.preferred`).

    Args:
        test: data.
        modes: number of modes, or "auto".
    """
    rows = thinned(test)
    largest = (len(rows) - 2) // 2
    if modes != "auto" and not 1 <= viscoelastic.whole_number(modes) <= largest:
        raise InputError(
            f"{test.source}: --modes {modes} is out of range; give 1 to {largest} for {len(rows)} measured values"
        )
    top = min(uncertainty.supported_modes(test), largest)
    numbers = range(1, top + 1) if modes == "auto" else range(int(modes), int(modes) + 1)
    tried = _raised(test, rows, numbers, Kind())
    solid = min(tried, key=criterion)
    if uncertainty.may_be_fluid(solid.uncertainty):
        begin = max(numbers.start, solid.modes - 1)
        tried += _raised(test, rows, range(begin, numbers.stop), FLUID)
    return _told(_chosen_model(tried, test), test, tried)


def _raised(test: TimeTest, rows: np.ndarray, numbers: range, kind: Kind) -> list[TimeFit]:
    """Return fits with increasing numbers of modes. The search ends after two fits in a row that do not lower the
    criterion, do not converge, or have superfluous modes. It also ends after an exact fit."""
    tried: list[TimeFit] = []
    best, failures = np.inf, 0
    for n in numbers:
        tried.append(_one_model(test, rows, n, kind))
        lower = criterion(tried[-1]) < best and (len(tried) == 1 or identifiable(tried[-1], test))
        best, failures = (criterion(tried[-1]), 0) if lower else (best, failures + 1)
        if failures == 2 or np.max(tried[-1].relative_errors) < viscoelastic.EXACT:
            break
    return tried


def _chosen_model(tried: list[TimeFit], test: TimeTest) -> TimeFit:
    able = [f for f in tried if identifiable(f, test)] or tried
    return able[choice.preferred([choice.label_of(f) for f in able], list(map(criterion, able)))]


def criterion(fit: TimeFit) -> float:
    """Return the Bayesian information criterion (see `viscoelastic.information_criterion`)."""
    m, free = len(fit.measured), len(fit.solution.u) if fit.kind.effective is None else fit.kind.effective
    return float(m * np.log(max(2 * float(fit.solution.cost) / m, 1e-300)) + free * np.log(m))


def identifiable(fit: TimeFit, test: TimeTest) -> bool:
    """Return whether the fit converged and the test determines every mode."""
    return fit.converged and not uncertainty.superfluous(test, fit.uncertainty)


def _one_model(test: TimeTest, rows: np.ndarray, modes: int, kind: Kind) -> TimeFit:
    begin, data, scales = perf_counter(), data_in_time(test), _scales(test, rows)
    evaluate = partial(time_response.residuals_with_jacobian, test.kind, kind.maxwell)
    found = from_starts(evaluate, _starts(test, modes, kind), *data)
    running = perf_counter() - begin
    model = Maxwell(*(np.asarray(v) for v in kind.maxwell(found.u)))
    spread = uncertainty.estimate(found, False, kind.maxwell, fluid=kind.name == FLUID.name)
    fitted = np.asarray(found.residuals) * scales + test.answer[rows]
    at = (test.time[rows], test.answer[rows], fitted, scales)
    return TimeFit(kind, model, found, spread, bool(found.converged), *at, (), running, 0.0, {}, rounding=test.rounding)


def refitted(fit: TimeFit, test: TimeTest) -> TimeFit:
    """Fit Prony modes to `test`, with the same kind and number of modes as in `fit`. `test` is a changed version of the
    test that was fitted in `fit`."""
    return _one_model(test, thinned(test), fit.modes, fit.kind)


def residuals_in_time(test: TimeTest, kind: Kind) -> tuple[Callable[..., jax.Array], tuple]:
    """Return a function and its data. The function computes the residuals (m,) of m measured values from the variables
    u of the fit and these data.

    Args:
        test: data.
        kind: Prony modes of a solid or of a fluid.
    """
    return _residuals(test.kind, kind.name), data_in_time(test)


def data_in_time(test: TimeTest) -> tuple[np.ndarray, ...]:
    """Return five arrays: n times (n,), the driven quantity (n,) at these times, the indices (m,) of the times of the m
    measured values, the measured values (m,), and their scales (m,)."""
    rows = thinned(test)
    kept = _corners_in_time(test.time, test.driven)
    kept[rows] = True
    places = np.cumsum(kept)[rows] - 1
    return test.time[kept], test.driven[kept], places, test.answer[rows], _scales(test, rows)


def _corners_in_time(time: np.ndarray, driven: np.ndarray) -> np.ndarray:
    """Return a mask (n,) of the points at which the driven quantity has a corner. At a corner, the derivatives on both
    sides differ. The first and the last point count as corners."""
    kept = np.ones(len(time), bool)
    middle = driven[:-2] + (driven[2:] - driven[:-2]) * (time[1:-1] - time[:-2]) / (time[2:] - time[:-2])
    kept[1:-1] = np.abs(driven[1:-1] - middle) > 1e-12 * np.max(np.abs(driven))
    return kept


def _scales(test: TimeTest, rows: np.ndarray) -> np.ndarray:
    every = np.full(len(test.time), np.nan)
    every[test.used] = test.scales
    return every[rows]


def response_in_time(kind: str, model: Maxwell, at: Array, *drive: Array) -> Array:
    """Return predicted measurements: G' then G'' [Pa] at angular frequencies, velocities and attenuations of shear
    waves, or the response in a relaxation or creep test.

    The function works with JAX arrays. For a sweep and for dispersion, NumPy arrays work too (`fitting.methods.host`).

    Args:
        kind: "sweep", "dispersion", "relaxation" or "creep".
        model: Prony modes.
        at: angular frequencies (n,) [rad/s], or times (n,) [s].
        drive: for relaxation and creep, the driven quantity (n,) and the indices (m,) of the times of the measured
            values. For dispersion, the density and the indices (m,) of the measured values in an array that contains
            first the velocities [m/s] and then the attenuations [1/m].
    """
    xp = arrays_of(model.ratios)
    if kind == "sweep":
        return xp.concatenate(generalised_maxwell.moduli(model, at), axis=-1)
    if kind == "dispersion":
        density, measured = drive
        waves = shear_waves.velocity_and_attenuation(*generalised_maxwell.moduli(model, at), at, density)
        return xp.concatenate(waves, axis=-1)[..., measured]
    driven, rows = drive
    return (time_response.stress_response if kind == "relaxation" else time_response.strain_response)(
        model, at, driven
    )[rows]


def apparent(test: TimeTest) -> tuple[np.ndarray, np.ndarray]:
    """Return the ratio stress / strain (m,) [Pa] at the m measured values. It is roughly the relaxation modulus G(t).
    Also return the times (m,) [s] of these values since the last change of the load."""
    rows = thinned(test)
    driven, answer = np.abs(test.driven[rows]), np.maximum(np.abs(test.answer[rows]), 1e-3 * _scales(test, rows))
    ratio = answer / np.maximum(driven, 1e-6 * driven.max())
    return ratio if test.kind == "relaxation" else 1 / ratio, test.since_change[rows]


def apparent_equations(test: TimeTest, times: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the matrix and the right-hand side of a linear least-squares problem for the modulus of `apparent`, with
    relative residuals. The unknowns are the equilibrium modulus and the strengths of modes with the relaxation `times`
    [s]. Responses far below their scale are mostly noise, and have less weight."""
    modulus, at = apparent(test)
    rows = thinned(test)
    weights = np.minimum(np.abs(test.answer[rows]) / _scales(test, rows), 1.0)
    A = np.column_stack([np.ones(len(at)), np.exp(-at[:, None] / times)])
    return A * (weights / modulus)[:, None], weights


def _starts(test: TimeTest, modes: int, kind: Kind) -> np.ndarray:
    """Return starting points with relaxation times that are spread over the decades of the test. The strengths are
    fitted to the apparent modulus (`apparent`) by non-negative least squares."""
    each = generalised_maxwell.times_over(test.resolved, modes, STARTS)
    found = [generalised_maxwell.start_at_times(times, *apparent_equations(test, times)) for times in each]
    return np.stack([generalised_maxwell.fluid_of(u) if kind.name == FLUID.name else u for u in found])


def _told(chosen: TimeFit, test: TimeTest, tried: list[TimeFit]) -> TimeFit:
    """Return the chosen fit with the table of all tried fits, and with the warnings."""
    lowest = min(map(criterion, tried))
    table: list[Content] = [
        {
            "model": f.kind.name,
            "modes": f.modes,
            "above_the_lowest": criterion(f) - lowest,
            "identifiable": identifiable(f, test),
            "mean_relative_error": float(f.relative_errors.mean()),
        }
        for f in tried
    ]
    elastic = _without_relaxation(test, chosen)
    advice = "try fewer modes" if chosen.modes > 1 else "check the data file"
    out = [_told_of_elastic(elastic)] if elastic else []
    out += (
        []
        if chosen.converged or elastic
        else [f"the fit did not converge, and the parameters with the smallest misfit are given: {advice}"]
    )
    mean = float(chosen.relative_errors.mean())
    if mean > 0.05:
        out.append(f"the fit misses the data by {100 * mean:.2g} % on average: try more modes, or check the data")
    closer = min(tried, key=criterion)
    if lowest < criterion(chosen) - 10 and closer.modes != chosen.modes:
        errors = [float(f.relative_errors.mean()) for f in (closer, chosen)]
        out.append(viscoelastic.closer_but_not_chosen(closer.modes, errors, closer.converged))
    if not elastic:
        out += uncertainty.superfluous(test, chosen.uncertainty)
        out += choice.rival_kind(chosen, [f for f in tried if identifiable(f, test)], criterion)
    low, high = test.resolved
    for k, tau in enumerate(chosen.model.relaxation_times):
        if not elastic and not low <= tau <= high:
            out.append(f"relaxation_times[{k}] = {tau:.3g} s lies outside the range {low:.3g}-{high:.3g} s of the test")
    out += structured_misfit(chosen)
    runs, chance = kramers_kronig.runs_probability(chosen.fitted - chosen.measured)
    details = {"tried": sorted(table, key=lambda row: row["above_the_lowest"]), "answers_fitted": len(chosen.measured)}
    details["residuals"] = {"runs": runs, "probability": chance}
    details |= {ELASTIC: elastic} if elastic else {}
    seconds = {n: sum(getattr(f, n) for f in tried) for n in ("run_time", "compile_time")}
    return chosen._replace(warnings=tuple(out), details=details, **seconds)


#: Key in `TimeFit.details`. Its value is the modulus [Pa], with standard error, of an elastic material that explains
#: the test as well as the fit.
ELASTIC = "elastic"


def _without_relaxation(test: TimeTest, chosen: TimeFit) -> dict[str, float] | None:
    """Return the modulus of an elastic material with its errors, if this material explains the test as well as the
    chosen fit. Otherwise return None."""
    rows = thinned(test)
    x, y, s = test.driven[rows], test.answer[rows], _scales(test, rows)
    square = float(np.sum((x / s) ** 2))
    if not square > 0:
        return None
    ratio, m = float(np.sum(x * y / s**2)) / square, len(rows)
    rss = max(float(np.sum(((ratio * x - y) / s) ** 2)), 2e-300 * m)
    if ratio <= 0 or m * np.log(rss / m) + np.log(m) > criterion(chosen):
        return None
    modulus = ratio if test.kind == "relaxation" else 1 / ratio
    of_noise = modulus / ratio * float(np.sqrt(rss / max(m - 1, 1) / square))
    shifts = test.base_line_errors(rows) @ (x / s**2) / square
    of_offset = modulus / ratio * float(np.linalg.norm(shifts))
    error = float(np.hypot(of_noise, of_offset))
    return {"shear_modulus": modulus, "standard_error": error, "standard_error_of_base_line": of_offset}


def with_elastic_error(fit: TimeFit, factor: float) -> TimeFit:
    """Multiply the standard error of the elastic modulus (`ELASTIC`) due to noise by a factor. The error due to the
    subtracted base line does not change."""
    if ELASTIC not in fit.details:
        return fit
    before = fit.details[ELASTIC]
    of_offset = before["standard_error_of_base_line"]
    of_noise = factor * without_part(before["standard_error"], of_offset)
    after = before | {"standard_error": float(np.hypot(of_noise, of_offset))}
    old, new = _told_of_elastic(before), _told_of_elastic(after)
    warnings = tuple(new if sentence == old else sentence for sentence in fit.warnings)
    return fit._replace(details=fit.details | {ELASTIC: after}, warnings=warnings)


def _told_of_elastic(elastic: dict[str, float]) -> str:
    return (
        "the test shows no relaxation: an elastic material of {shear_modulus:.4g} ± {standard_error:.2g} Pa explains "
        "the test equally well. This modulus is both G0 and the equilibrium modulus; ratios and relaxation times have "
        "no meaning"
    ).format(**elastic)


def structured_misfit(fit: TimeFit) -> list[str]:
    """Return a warning if the residuals keep their sign over many values."""
    residuals = fit.fitted - fit.measured
    runs, chance = kramers_kronig.runs_probability(residuals)
    if chance >= kramers_kronig.CHANCE or fit.relative_errors.max() <= viscoelastic.EXACT:
        return []
    return [
        f"structured misfit: the residuals change sign only {runs - 1} times in {len(residuals)} values (probability "
        f"by chance {chance:.1g}). The model is inadequate, or the noise of neighbouring values is correlated"
    ]
