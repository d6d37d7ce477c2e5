"""Interval of the equilibrium modulus. It allows for parts of the material that relax only after the end of the test.

The standard error is a linear estimate at the minimum, for the chosen modes. If a mode has a relaxation time near the
length of the test or longer, the data hardly distinguish this mode from the equilibrium modulus. So the equilibrium
modulus is fixed at several values, and all other parameters are fitted again (a profile likelihood). Relaxation times
may be up to `BEYOND` times the longest time that the test resolves. If an additional mode makes the fit much closer,
the interval is computed with this mode.
"""

from collections.abc import Callable, Sequence
from typing import NamedTuple, TypeVar

import numpy as np
import scipy.special

from fitting.fits import time_tests
from fitting.fits.honesty import alike_points
from fitting.fits.time_tests import TimeFit
from fitting.fits.together import measured_tests, residuals_of_tests
from fitting.fits.together.measured_tests import Measured
from fitting.fits.together.residuals_of_tests import Together
from fitting.fits.viscoelastic import SHORT, Fit, Kind
from fitting.methods.estimate import freedom_of_alike, without_part
from fitting.methods.generalised_maxwell import Maxwell
from fitting.methods.host import Array, arrays_of
from fitting.methods.least_squares import Solution, from_starts
from fitting.methods.uncertainty import equilibrium_error
from liverjax.core.struct import Content

#: Relaxation times may be shorter than the shortest, or longer than the longest time that the test resolves, by at most
#: this factor.
BEYOND = 10.0
#: An additional mode is used if it lowers the sum of squares, divided by the variance of the noise, by more than this
#: value.
CLOSER = 10.0
#: Starting values of the relaxation time of the additional mode, divided by the longest time that the test resolves.
SLOW = (0.3, 1.0, 3.0)
#: Starting value of the strength of the additional mode in a fluid, divided by the sum of all strengths (G0).
SLOW_PART = 0.1
#: BISECTIONS: number of bisections for each end of the interval. ITERATIONS: maximum number of iterations of each fit.
BISECTIONS, ITERATIONS = 6, 60
#: The program warns about an interval if its farther end is far from the fitted equilibrium modulus. The distance must
#: exceed WIDER times the half width of the 95 % interval from the standard error, and LARGE times this modulus.
WIDER, LARGE = 2.0, 0.05
#: Half width of a 95 % interval, divided by the standard error, if there are many independent residuals.
NORMAL = 1.96


class Interval(NamedTuple):
    """The 95 % interval of an equilibrium modulus."""

    low: float  # [Pa]
    high: float
    longest: float  # [s] the interval is valid only if all relaxation times are at most this long
    modes: int  # number of modes of the model


class _Family(NamedTuple):
    """Fits of Prony modes with a fixed equilibrium modulus. The unknowns u (2 N,) of N modes are the logs of the N
    strengths, and N logits. The inverse of a logit (0 to 1) is the position of a log relaxation time between two
    bounds."""

    evaluate: Callable[[float, np.ndarray], Solution]  # (equilibrium modulus [Pa], starting points u) -> best fit
    ends: tuple[float, float]  # logs of the shortest and the longest relaxation time that is allowed

    def unknowns(self, strengths: np.ndarray, times: np.ndarray) -> np.ndarray:
        """Return u (2 N,) from strengths (N,) [Pa] and times (N,) [s]."""
        part = (np.log(times) - self.ends[0]) / (self.ends[1] - self.ends[0])
        return np.concatenate([np.log(strengths), scipy.special.logit(np.clip(part, 1e-3, 1 - 1e-3))])


def equilibrium_interval(
    tests: Sequence[Measured], noises: Sequence[float], model: Maxwell, error: float, independent: float = 1.0
) -> Interval | None:
    """Return the 95 % interval of the equilibrium modulus of Prony modes. Returns None if no fit succeeded.

    Args:
        tests: the fitted tests, one or more.
        noises: for each test, a factor: scales times this factor are standard deviations.
        model: the chosen Prony modes.
        error: standard error [Pa] of the equilibrium modulus; it may be infinite.
        independent: effective number of independent residuals, divided by the number of residuals.
    """
    low, high = measured_tests.resolved_by(tests)
    family = _family(tests, noises, (low / BEYOND, high * BEYOND))
    rest = float(model.shear_modulus * (1 - np.sum(model.ratios)))
    whole = float(model.shear_modulus)
    rest = rest if rest > 1e-9 * whole else 0.0
    strengths = np.maximum(np.asarray(model.shear_modulus * model.ratios), 1e-6 * whole)
    times = np.asarray(model.relaxation_times)
    found = family.evaluate(rest, family.unknowns(strengths, times)[None])
    best = _with_one_more(family, (rest, strengths, times), high, found)
    least, (modulus, found) = 2 * float(best[1].cost), best
    if not np.isfinite(least):
        return None
    points = len(found.residuals)
    freedom = max(1.0, points - len(found.u) - 1)
    spread = max(1.0, least / freedom)
    quantile = float(scipy.special.stdtrit(freedom_of_alike(freedom, points, independent * points), 0.975))
    limit = least + quantile**2 * spread / independent
    first = min(quantile * error, 0.1 * whole) if error > 0 else 0.01 * whole
    ends = [_end(family, modulus, found, limit, sign * first, whole) for sign in (-1, 1)]
    return Interval(min(ends[0], rest), max(ends[1], rest), high * BEYOND, len(found.u) // 2)


def _family(tests: Sequence[Measured], noises: Sequence[float], times: tuple[float, float]) -> _Family:
    ends = (float(np.log(times[0])), float(np.log(times[1])))
    parts = [measured_tests.reported_numbers(test) for test in tests]
    data = [(at, y, scales * s) for (at, y, scales), s in zip(parts, noises, strict=True)]
    names = list(map(measured_tests.name_of, tests))

    def evaluate(modulus: float, starts: np.ndarray) -> Solution:
        def maxwell(u: Array) -> Maxwell:
            xp, n = arrays_of(u), u.shape[-1] // 2
            strengths = xp.exp(u[..., :n])
            whole = modulus + strengths.sum(axis=-1)
            times = xp.exp(ends[0] + (ends[1] - ends[0]) / (1 + xp.exp(-u[..., n:])))
            return Maxwell(whole, strengths / whole[..., None], times)

        def at(u: np.ndarray, *_: object) -> tuple[np.ndarray, np.ndarray]:
            return residuals_of_tests.tests_evaluated(names, Kind("prony", maxwell), u, data)

        return from_starts(at, starts, max_iterations=ITERATIONS)

    return _Family(evaluate, ends)


def _with_one_more(
    family: _Family, model: tuple[float, np.ndarray, np.ndarray], longest: float, found: Solution
) -> tuple[float, Solution]:
    """Return the equilibrium modulus and the fit at the minimum. An additional mode with a long relaxation time is used
    if it lowers the sum of squares enough (`CLOSER`). `longest`: longest time [s] that the test resolves."""
    rest, strengths, times = model
    noise = max(1.0, 2 * float(found.cost) / max(1, len(found.residuals) - len(found.u) - 1))
    best = (rest, found)
    # In a solid, a part of the equilibrium modulus becomes the strength of the slow mode. A fluid has no equilibrium
    # modulus.
    slow = rest or SLOW_PART * float(np.sum(strengths))
    for part in (0.8, 0.5, 0.2, 0.0):  # fraction of the equilibrium modulus that remains
        more = np.append(strengths, (1 - part) * slow)
        starts = np.stack([family.unknowns(more, np.append(times, k * longest)) for k in SLOW])
        trial = family.evaluate(part * rest, starts)
        if float(trial.cost) < float(best[1].cost) - 0.5 * CLOSER * noise:
            best = (part * rest, trial)
    return best


def _end(family: _Family, modulus: float, found: Solution, limit: float, step: float, whole: float) -> float:
    """Return one end of the interval: the equilibrium modulus at which the sum of squares reaches `limit`. The search
    begins at the minimum (`modulus`). The sign of the first step `step` [Pa] selects the lower or the upper end. The
    search also ends at 0, and above 10 times `whole` (G0)."""
    u, inside, outside = np.asarray(found.u), modulus, None
    while outside is None:
        trial = max(0.0, inside + step)
        again = family.evaluate(trial, u[None])
        if not 2 * float(again.cost) <= limit:
            outside = trial
        elif trial == 0.0 or trial > 10 * whole:
            return trial
        else:
            inside, step, u = trial, 2 * step, np.asarray(again.u)
    for _ in range(BISECTIONS):
        middle = 0.5 * (inside + outside)
        again = family.evaluate(middle, u[None])
        if 2 * float(again.cost) <= limit:
            inside, u = middle, np.asarray(again.u)
        else:
            outside = middle
    return outside


#: Key of the 95 % interval of the equilibrium modulus in the `details` of a fit.
INTERVAL = "equilibrium_modulus_interval_95"
AFit = TypeVar("AFit", Fit, TimeFit, Together)


def with_interval(
    fit: AFit, tests: Sequence[Measured], noises: Sequence[float], factor: float = 1.0, common: float = 0.0
) -> AFit:
    """Add the interval of the equilibrium modulus to a fit of Prony modes. A warning is added if this interval is much
    wider than the interval from the standard error. Fits of other models are returned unchanged.

    Args:
        fit: the fit of these tests.
        tests, noises: see `equilibrium_interval`.
        factor: reported equilibrium modulus, divided by the equilibrium modulus that fits the data. The factor is 1,
            except for a compressed sample.
        common: standard error [Pa] of the equilibrium modulus due to an error that is common to all measured values.
    """
    if fit.parameters is not None or not fit.converged:
        return fit
    model = fit.model._replace(shear_modulus=np.asarray(fit.model.shear_modulus) / factor)
    error = equilibrium_error(fit.uncertainty)
    details: Content = fit.details or {}
    points = sum(len(measured_tests.reported_numbers(test)[1]) for test in tests)
    known = (details[key] for key in (time_tests.INDEPENDENT, alike_points.INDEPENDENT) if key in details)
    independent = float(next(known, points)) / points
    found = equilibrium_interval(tests, noises, model, error / factor, independent)
    if found is None:
        return fit
    low, high = factor * found.low, factor * found.high
    rest = max(0.0, float(fit.model.shear_modulus * (1 - np.sum(fit.model.ratios))))
    # A common error widens both the interval and the standard error. So their comparison does not contain this error.
    alone = without_part(error, common)
    half = max(rest - low, high - rest)
    wider = half > max(WIDER * NORMAL * alone, LARGE * rest)
    beyond = without_part(half / NORMAL, alone)
    low = max(0.0, rest - float(np.hypot(rest - low, NORMAL * common)))
    high = rest + float(np.hypot(high - rest, NORMAL * common))
    whole = float(fit.model.shear_modulus)
    told: list[str] = _told_interval((low, rest, high), error, found, whole, wider)
    numbers = {"low": low, "high": high, "longest_relaxation_time": found.longest, "modes": found.modes}
    numbers |= {"beyond_standard_error": beyond, "wider_than_standard_error": bool(told)}
    details = details | {INTERVAL: numbers}
    return fit._replace(details=details, warnings=(*fit.warnings, *told))


def _told_interval(
    ends: tuple[float, float, float], error: float, found: Interval, whole: float, wider: bool
) -> list[str]:
    """Return a warning if the interval is much wider than the interval from the standard error (`wider`). `ends`: (low,
    value, high). For a fluid, a warning is given if `high` is at least `LARGE` times `whole` (G0).

    The comparison always uses the factor `NORMAL`. For few independent residuals, Student's t would be larger. But
    readers understand the number after ± as a standard error, and expect two standard errors as the half width.
    """
    low, rest, high = ends
    where = f"if parts of the material have relaxation times of up to {found.longest:.3g} s"
    if rest <= 1e-9 * whole:
        if high < LARGE * whole:
            return []
        return [
            f"a solid fits the data as well as the fluid. The equilibrium modulus of the solid may be 0 to "
            f"{high:.3g} Pa (95 %), {where}: only a longer test can decide"
        ]
    if not wider:
        return []
    return [
        f"{SHORT}: the equilibrium modulus may be {low:.3g} to {high:.3g} Pa (95 %), {where}. The value {rest:.4g} ± "
        f"{error:.2g} Pa is valid only for the chosen modes"
    ]
