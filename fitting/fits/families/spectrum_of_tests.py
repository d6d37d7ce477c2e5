"""Fit a smooth relaxation spectrum on a fixed grid of relaxation times to one relaxation or creep test, or to several
tests together.

For sweeps and relaxation tests, the predicted values are linear in the strengths of the spectrum, so one linear problem
is enough (`relaxation_spectrum`). The strain in creep and the velocities of shear waves are not linear in the
strengths. For such tests the linearised problem is solved repeatedly.
"""

from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np

from fitting.fits import time_tests
from fitting.fits.families import limits
from fitting.fits.time_tests import TimeFit
from fitting.fits.together import contributions, measured_tests, residuals_of_tests
from fitting.fits.together.measured_tests import Measured
from fitting.fits.together.residuals_of_tests import Together
from fitting.fits.viscoelastic import Kind
from fitting.methods import as_prony_modes, generalised_maxwell, host, relaxation_spectrum, uncertainty
from fitting.methods.estimate import Estimate, estimated
from fitting.methods.generalised_maxwell import Maxwell, non_negative
from fitting.methods.least_squares import Solution
from fitting.methods.relaxation_spectrum import GridOfTimes, GridSpectrum
from fitting.readers.frequency_sweep import Sweep
from fitting.readers.time_tests import TimeTest
from liverjax.core.struct import Content
from liverjax.solvers.blas import one_blas_thread

#: WEIGHTS: weights of the smoothness term (second differences of the strengths) that are tried, largest first.
#: MOST_TANGENTS: maximum number of iterations for each weight.
WEIGHTS, MOST_TANGENTS = np.logspace(4, -6, 21), 30
#: STILL: the iterations end if the relative decrease of the cost, expected or achieved, is at most this value. NONE:
#: number that is added to every strength (divided by `grid.unit`), so that no strength is 0.
STILL, NONE = 1e-9, 1e-12


class SpectrumFit(NamedTuple):
    """A fitted spectrum, with all results that the reports of tests need."""

    kind: Kind
    model: Maxwell  # a small number of Prony modes that represent the spectrum
    solution: Solution
    spread: Estimate  # parameters of these modes, with standard errors
    own: Estimate  # equilibrium modulus and strengths of the spectrum, with standard errors
    details: Content
    sentences: tuple[str, ...]


def _modes_on_grid(grid: GridOfTimes) -> Callable[[np.ndarray], Maxwell]:
    """Return a NumPy function that computes Prony modes from x (…, 1 + K). x contains the equilibrium modulus and the
    strengths at the K times of the grid. All of them are divided by `grid.unit`."""

    def maxwell(x):
        strengths = grid.unit * (x + NONE)
        total, times = strengths.sum(axis=-1), np.broadcast_to(grid.times, strengths[..., 1:].shape)
        return Maxwell(total, strengths[..., 1:] / total[..., None], times)

    return maxwell


class _Minimum(NamedTuple):
    x: np.ndarray
    r: np.ndarray  # residuals of the data
    J: np.ndarray
    converged: bool


def _minimum(kinds: list[str], data: list, grid: GridOfTimes, x: np.ndarray) -> _Minimum:
    """Return the minimum of the cost for x >= 0 (see `_modes_on_grid`). The cost is the sum of the squared residuals
    plus the smoothness term of the grid. The Gauss-Newton iterations begin at the given x. Each step is halved until
    the cost falls."""
    L = relaxation_spectrum.second_differences(len(grid.times), grid.smoothing)
    kind = Kind("spectrum", _modes_on_grid(grid))

    def at(x):
        r, J = residuals_of_tests.tests_evaluated(kinds, kind, x, data)
        cost = r @ r + np.sum((L @ x) ** 2)
        return r, J, cost if np.isfinite(cost) and np.all(np.isfinite(J)) else np.inf

    r, J, cost = at(x)
    for _ in range(MOST_TANGENTS):
        target, _ = non_negative(np.vstack([J, L]), np.concatenate([J @ x - r, np.zeros(len(L))]))
        expected = np.sum((r + J @ (target - x)) ** 2) + np.sum((L @ target) ** 2)
        if cost - expected <= STILL * cost:
            return _Minimum(x, r, J, True)
        length, new = 1.0, None
        while length > 1e-4 and not (new and new[2] < cost):
            trial = x + length * (target - x)
            new, length = at(trial), 0.5 * length
        if new is None or not new[2] < cost:
            return _Minimum(x, r, J, True)  # no step lowers the cost: x is the minimum, up to roundoff
        still = cost - new[2] <= STILL * cost
        x, (r, J, cost) = trial, new
        if still:
            return _Minimum(x, r, J, True)
    return _Minimum(x, r, J, False)


def spectrum_of(
    tests: Sequence[Measured], near: Maxwell, noise: np.ndarray
) -> tuple[GridSpectrum, GridOfTimes, _Minimum]:
    """Try several grids and several weights of the smoothness term. Return (spectrum, grid, minimum) for the grid and
    the weight with the highest restricted likelihood.

    Args:
        tests: one or more tests.
        near: Prony modes whose moduli are about the moduli of the tests. These moduli are the units of the strengths.
        noise: noise of each test, divided by its scales.
    """
    low, high = measured_tests.resolved_by(tests)
    kinds, data = list(map(measured_tests.name_of, tests)), _weighed_parts(tests, noise)
    best = None
    for per_decade in relaxation_spectrum.GRIDS:
        times = relaxation_spectrum.grid_of_times(low, high, per_decade)
        size = np.hypot(*generalised_maxwell.moduli(near, 1 / times))
        unit = np.concatenate([size[:1], np.maximum(size, 1e-6 * size.max())])
        x = np.concatenate([[0.5], np.full(len(times), 1 / per_decade)])
        for weight in WEIGHTS / np.exp(np.mean(np.log(noise))) ** 2:
            grid = GridOfTimes(times, unit, per_decade, float(weight))
            with one_blas_thread():  # small matrices are faster with one thread
                found = _minimum(kinds, data, grid, x)
            x, told = found.x, relaxation_spectrum.described(found.x, found.J, found.r, grid)
            if best is None or told.evidence < best[0].evidence:
                best = told, grid, found
    assert best is not None
    return best


def _weighed_parts(tests: Sequence[Measured], noise: np.ndarray) -> list:
    parts = map(measured_tests.reported_numbers, tests)
    return [(at, y, scales * s) for (at, y, scales), s in zip(parts, noise, strict=True)]


def _as_a_fit(
    tests: Sequence[Measured], grid: GridOfTimes, found: _Minimum, told: GridSpectrum, over: Callable | None = None
) -> SpectrumFit:
    """Return the spectrum `told` as a fit. `over`: function that divides the residuals of a `Solution` by their noise.
    If `over` is None, the noise is estimated from the residuals."""
    low, high = measured_tests.resolved_by(tests)
    kept = found.x[1:] > 1e-10 * found.x.max()
    solid = told.equilibrium > 0
    free = np.concatenate([[solid], kept])
    strengths = np.concatenate([[told.equilibrium], told.strengths])[1 - int(solid) :]
    slopes = (found.J / grid.unit)[:, free] * strengths  # derivatives with respect to the logs of the strengths
    prior = told.prior[:, 1 - int(solid) :] * strengths

    def moduli(u, omega):
        return relaxation_spectrum.moduli_of_logarithms(u, omega, told.times, bool(solid))

    u = np.log(strengths)
    made = as_prony_modes.convert(lambda omega: moduli(u, omega), 1 / high, 1 / low, bool(solid))
    names = ("equilibrium_modulus",) * int(solid) + tuple(f"strengths[{k}]" for k in told.places)
    kind = Kind(
        name="spectrum",
        maxwell=lambda u: as_prony_modes.modes(made, moduli(u, made.omega)),
        names=names,
        units=("Pa",) * len(names),
        values=host.exponential,
        effective=told.effective,
    )
    r = np.concatenate([found.r, prior @ np.ones(len(strengths))])
    J = np.concatenate([slopes, prior])
    solution = Solution(u, r, J, 0.5 * found.r @ found.r, np.array(1), np.array(0.0), np.array(found.converged))
    solution = over(solution) if over else solution
    spread = uncertainty.estimate(solution, over is not None, kind.maxwell, (len(found.r), told.effective))
    own = estimated(names, host.exponential, solution, len(found.r), over is not None, told.effective)
    sentences = []
    if made.error > as_prony_modes.ALLOWED:
        sentences.append(
            f"{len(made.times)} Prony modes represent the spectrum with errors of up to {100 * made.error:.2g} %"
        )
    details: Content = {
        "conversion": {"modes": len(spread.values) // 2, "largest_relative_error": made.error},
        "spectrum": {
            "relaxation_times": told.times.tolist(),
            "times_per_decade": told.per_decade,
            "smoothing": told.smoothing,
            "effective_parameters": told.effective,
            "decades_carried": told.decades,
        },
    }
    model = Maxwell(*(np.asarray(v) for v in kind.maxwell(u)))
    sentences += limits.limit_sentences("spectrum", spread, model, own) + relaxation_spectrum.gap_sentences(told)
    return SpectrumFit(kind, model, solution, spread, own, details, tuple(sentences))


def _relative_scale(test: Measured) -> float:
    """Divide the scales of a test by its measured values (`sizes_of`), and return the median. For a sweep, use the
    values of G' only."""
    _, y, scales = measured_tests.reported_numbers(test)
    count = len(y) // 2 if isinstance(test, Sweep) else len(y)
    return float(np.median((scales / measured_tests.sizes_of(test))[:count]))


def _still_relaxing(tests: Sequence[Measured], told: GridSpectrum, noises: np.ndarray) -> tuple[str, ...]:
    """Return a warning if G' of the spectrum still decreases at the lowest frequency that the tests resolve. `noises`:
    noise of each test, divided by its scales."""
    longest = int(np.argmax([t.resolved[1] for t in tests]))
    lowest = 1 / tests[longest].resolved[1] * np.sqrt(10.0) ** np.arange(3)
    columns = generalised_maxwell.mode_columns(lowest, told.times)[:3, 1:]
    storage, slowest = told.equilibrium + columns @ told.strengths, float(np.max(told.times, initial=0.0))
    sweeps = any(isinstance(t, Sweep) for t in tests)
    remedy = "measure longer, or at lower frequencies" if sweeps else "measure longer"
    found = limits.still_relaxing(storage, float(noises[longest]) * _relative_scale(tests[longest]), slowest, remedy)
    return tuple(found) if told.equilibrium > 0 else ()


def spectrum_in_time(test: TimeTest, near: Maxwell) -> TimeFit:
    """Fit a smooth spectrum to a relaxation or creep test. `near`: Prony modes with about the same moduli as the
    test."""
    told, grid, found = spectrum_of([test], near, np.ones(1))
    fit = _as_a_fit([test], grid, found, told)
    _, answer, scales = measured_tests.reported_numbers(test)
    where = (test.time[time_tests.thinned(test)], answer, found.r * scales + answer, scales)
    own = (fit.kind, fit.model, fit.solution, fit.spread, found.converged)
    sentences = (*fit.sentences, *_still_relaxing([test], told, np.array([fit.spread.noise])))
    return TimeFit(*own, *where, sentences, 0.0, 0.0, fit.details, fit.own, test.rounding)


def spectrum_together(tests: list[Measured], near: Maxwell, noise: np.ndarray) -> Together:
    """Fit one smooth spectrum to several tests. Each test has its own noise level. `near` and `noise` are the same as
    in `spectrum_of`."""
    parts = [measured_tests.reported_numbers(t) for t in tests]
    for _ in range(2):
        told, grid, found = spectrum_of(tests, near, noise)
        used, noise = noise, residuals_of_tests.noises(tests, parts, found.r, noise, told.effective)
    data = _weighed_parts(tests, used)
    shares, fitted = residuals_of_tests.misfits(tests, data, found.r, noise, told.effective)
    fit = _as_a_fit(
        tests, grid, found, told, lambda whole: residuals_of_tests.over_own_noise(whole, shares, used / noise)
    )
    own = (tests, fit.kind, fit.model, fit.solution, fit.spread, found.converged)
    sentences = (*fit.sentences, *_still_relaxing(tests, told, noise))
    first = Together(*own, shares, fitted, [], sentences, 0.0, 0.0, fit.own, fit.details)
    kinds = list(map(measured_tests.name_of, tests))

    def alone(k: int) -> np.ndarray:
        without = [(at, y, s if j == k else np.full(len(y), np.inf)) for j, (at, y, s) in enumerate(parts)]
        quiet = [(at, y, s * noise[k]) for at, y, s in without]
        return noise[k] * _minimum(kinds, quiet, grid, found.x).r

    slope = np.diag(fit.own.values)
    return first._replace(
        shares=contributions.shares_by_rows(first, np.asarray(fit.solution.jacobian), slope, fit.own.values, alone)
    )
