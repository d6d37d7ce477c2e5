"""Time-temperature superposition: find shift factors that move sweeps at several temperatures onto one smooth curve.

The modulus at temperature T and frequency omega is 1 / b_T times the modulus at the reference temperature and frequency
a_T omega. The curve is a cubic spline of log G' and of log G'' over log frequency. The curve and all factors are fitted
together by least squares. So no model of the material is needed, and every factor has a standard error. If the noise
differs between log G' and log G'', they get different weights. If the noise differs between the sweeps, the weights of
the sweeps stay equal, and the standard errors contain the noise of each sweep. The distance between the knots of the
spline is chosen from the data. With too many knots, the curve would follow the noise and be steeper than the true
curve. Then the errors of the factors, which depend on the slope of the curve, would be too small. Source: Ferry (1980),
Viscoelastic properties of polymers, chapter 11.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from scipy.interpolate import BSpline
from scipy.special import chdtrc

from fitting.readers.frequency_sweep import Sweep, merged, scatter
from fitting.readers.units import celsius
from liverjax.core.errors import InputError

#: KNOTS: distances between two knots [decades] that are tried. SMOOTH: weight of the penalty on third differences of
#: the spline coefficients. The penalty is needed for knots without data between them.
KNOTS, SMOOTH = (0.4, 0.6, 0.9, 1.35, 2.0, 3.0), 1e-3
#: LONGEST: maximum step of a factor in one iteration [decades]. The iteration ends if all steps are below CONVERGED, or
#: if a step reduces the sum of squares by less than the fraction FLAT.
#: DAMPING: first and largest damping of a step (Levenberg 1944). A step that increases the sum of squares is repeated
#: with ten times the damping.
LONGEST, CONVERGED, FLAT, DAMPING = 0.3, 1e-6, 1e-6, (1e-6, 1e3)
#: Settings for the first estimate of a shift. OVERLAP: two neighbouring sweeps must overlap over at least this fraction
#: of the largest possible overlap. REACH: shifts that are tried [decades].
OVERLAP, REACH = 0.25, np.linspace(-8.0, 8.0, 801)
#: CHANCE: significance level. G' and G'' get different weights if their distances from the curves differ significantly.
#: The standard errors contain the noise of each sweep if the noise of the sweeps differs significantly. LEAST_DEGREES:
#: degrees of freedom that are needed to estimate the noise of a sweep. ROUNDS: maximum number of fits, each followed by
#: new weights. SETTLED: the fits end if no weight changes by more than this fraction and no log a by more than this
#: number. MOST: largest ratio of the weights.
CHANCE, LEAST_DEGREES, ROUNDS, SETTLED, MOST = 1e-3, 3.0, 8, 0.02, 100.0
#: Two sweeps match within the noise if their mean square distance, divided by the variance of their noise, is at most
#: this value.
WITHIN = 2.0


class Shifts(NamedTuple):
    """Shift factors of K sweeps, in the order of their temperatures, and distances of the sweeps from the common
    curve."""

    temperatures: np.ndarray  # (K,) [K], ascending
    reference: int  # index of the sweep that is not shifted
    log_a: np.ndarray  # (K,) log10 of a_T
    log_a_errors: np.ndarray  # (K,) standard errors; 0 at the reference and for given factors
    log_b: np.ndarray  # (K,) log10 of b_T; 0 without vertical shifts
    log_b_errors: np.ndarray
    misfit: np.ndarray  # (K,) relative root mean square distance of each sweep from the curve
    points: np.ndarray  # (K,) number of points of each sweep
    covariance: np.ndarray  # (K, K) covariance of `log_a`; errors of neighbouring sweeps are correlated
    knots: float  # distance between two knots of the curve [decades]
    given: bool = False
    weights: tuple[float, float] = (1.0, 1.0)  # weights of the distances in log G' and in log G''

    @property
    def apart(self) -> float:
        """Relative root mean square distance of all points from the curve."""
        return float(np.sqrt(np.average(self.misfit**2, weights=self.points)))


def found(
    sweeps: Sequence[Sweep],
    temperatures: np.ndarray,
    reference: int,
    vertical: bool = False,
    tried: Sequence[float] = KNOTS,
) -> Shifts:
    """Find the shift factors and the common curve by least squares. Akaike's corrected information criterion chooses
    the distance between the knots of the curve.

    Args:
        sweeps: K sweeps.
        temperatures: (K,) [K], ascending.
        reference: index of the sweep that is not shifted.
        vertical: whether factors b_T that multiply the moduli are fitted too.
        tried: distances between two knots of the curve [decades] that are tried.

    Raises:
        InputError: two sweeps at neighbouring temperatures do not match at any shift, or do not overlap after the best
            shifts.
    """
    columns = _in_decades(sweeps)
    first = _first_shifts(columns, temperatures, reference), np.zeros(len(sweeps))
    free = np.ones((2, len(sweeps)), bool)
    free[:, reference] = False
    free[1] &= vertical
    every = [_at_knots(sweeps, (temperatures, reference), first, free, knots) for knots in tried]
    joined = [own for own in every if _gap(columns, own.log_a) is None]
    if not joined:
        _refuse_gap(columns, _best(sweeps, every, int(free.sum())))
    return _best(sweeps, joined, int(free.sum()))


def _in_decades(sweeps: Sequence[Sweep]) -> list[tuple[np.ndarray, np.ndarray, np.ndarray]]:
    """Return three arrays for each sweep: log10 of the angular frequencies [rad/s], of G' [Pa] and of G'' [Pa]."""
    return [(np.log10(s.angular_frequency), np.log10(s.storage), np.log10(s.loss)) for s in sweeps]


def _shifted_places(columns: list, log_a: np.ndarray) -> np.ndarray:
    """Return log10 of the shifted angular frequencies of all points (n,)."""
    return np.concatenate([c[0] + a for c, a in zip(columns, log_a, strict=True)])


def _points_of(sweeps: Sequence[Sweep]) -> np.ndarray:
    return np.array([len(s.storage) for s in sweeps])


def _best(sweeps: Sequence[Sweep], every: list[Shifts], factors: int) -> Shifts:
    """Return the result with the lowest corrected information criterion. If there are too few data to compute this
    criterion for any result, return the result with the largest distance between knots. `factors`: number of fitted
    factors.
    """
    data, least = 2 * sum(len(s.storage) for s in sweeps), np.finfo(float).tiny
    differ = any(own.weights != (1.0, 1.0) for own in every)  # whether the noise of the two moduli differs

    def criterion(own: Shifts) -> float:
        numbers = 2 * size_of_curve(sweeps, own.log_a, own.knots) + factors + 1 + differ
        if data < numbers + 2:
            return np.inf
        squares = _squares_of_moduli(sweeps, own) if differ else np.array([own.apart**2])
        fit = data * float(np.mean(np.log(np.maximum(squares, least))))
        return fit + 2 * numbers * (1 + (numbers + 1) / (data - numbers - 1))

    return min(reversed(every), key=criterion)


def _squares_of_moduli(sweeps: Sequence[Sweep], own: Shifts) -> np.ndarray:
    """Return the mean squared relative distances (2,) of G' and of G'' from their curves."""
    distances = _distances_of_moduli(sweeps, own.log_a, own.log_b, own.knots)
    return np.mean(distances**2, axis=1) * np.log(10) ** 2


def weighted_distance(sweeps: Sequence[Sweep], own: Shifts, weights: tuple[float, float]) -> float:
    """Return the relative root mean square distance of all points from the curve. `weights` (2,) multiply the distances
    in log G' and in log G''. With equal weights, the result is `Shifts.apart`."""
    return float(np.sqrt(np.average(_squares_of_moduli(sweeps, own), weights=np.square(weights))))


def _at_knots(
    sweeps: Sequence[Sweep],
    at: tuple[np.ndarray, int],
    first: tuple[np.ndarray, np.ndarray],
    free: np.ndarray,
    knots: float,
) -> Shifts:
    """Fit the factors for a curve with a given distance between knots.

    Args:
        sweeps: K sweeps.
        at: temperatures (K,) [K], and the index of the sweep that is not shifted.
        first: starting values of log a (K,) and log b (K,).
        free: mask (2, K) of the fitted factors: first row log a, second row log b.
        knots: distance between two knots [decades].
    """
    columns, counts = _in_decades(sweeps), _points_of(sweeps)
    points = int(counts.sum())
    log_a, log_b, weights = *first, np.ones(2)
    for _ in range(ROUNDS):
        before = log_a
        log_a, log_b, A, b = _by_least_squares(columns, (log_a, log_b), free, knots, weights)
        own = _weights_of_moduli(b[: 2 * points].reshape(2, points) / weights[:, None], points - A.shape[1] / 2)
        settled, weights = np.abs(np.log(own / weights)).max() < SETTLED, own
        if settled and np.abs(log_a - before).max() < SETTLED:
            break
    covariance = np.zeros((2 * len(sweeps),) * 2)
    found = _covariance(A, b, counts)[: free.sum(), : free.sum()]
    covariance[np.ix_(free.ravel(), free.ravel())] = found
    spread = np.sqrt(np.diag(covariance)).reshape(2, -1)
    misfit = distances_from_curve(sweeps, log_a, log_b, knots)
    of_a = covariance[: len(sweeps), : len(sweeps)]
    found_weights = (float(weights[0]), float(weights[1]))
    return Shifts(*at, log_a, spread[0], log_b, spread[1], misfit, counts, of_a, knots, weights=found_weights)


def _by_least_squares(
    columns: list, first: tuple[np.ndarray, np.ndarray], free: np.ndarray, knots: float, weights: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Fit the factors by the method of Levenberg and Marquardt. Return log a (K,), log b (K,), and the matrix and the
    right-hand side of the last linear problem. The matrix has columns only for the fitted factors and for the curves.
    `weights` (2,) multiply the distances in log G' and in log G''. The other arguments are the same as for
    `_at_knots`."""
    factors, damping = np.stack(first), DAMPING[0]
    # The knots do not move during the iteration, because the sum of squares would change with their places.
    grid = _knot_grid(_shifted_places(columns, first[0]), knots)
    A, b = _linear_problem(columns, factors[0], factors[1], grid, weights)
    for _ in range(60):
        step = _damped_step(A, b, free, damping)
        if np.abs(step).max() < CONVERGED:
            break
        further = _linear_problem(columns, factors[0] + step[0], factors[1] + step[1], grid, weights)
        before, after = b @ b, further[1] @ further[1]
        if after < before:
            factors, (A, b), damping = factors + step, further, max(damping / 10, DAMPING[0])
            if after > (1 - FLAT) * before:
                break
        elif damping < DAMPING[1]:
            damping *= 10
        else:
            break
    return factors[0], factors[1], _free_columns(A, free), b


def _free_columns(A: np.ndarray, free: np.ndarray) -> np.ndarray:
    """Return the columns of the matrix A that belong to fitted factors or to the curves. `free`: see `_at_knots`."""
    return A[:, np.concatenate([free.ravel(), np.ones(A.shape[1] - free.size, bool)])]


def _damped_step(A: np.ndarray, b: np.ndarray, free: np.ndarray, damping: float) -> np.ndarray:
    """Return the step (2, K) of the factors for the linear problem with matrix A and right-hand side b. No entry of the
    step is larger than `LONGEST`."""
    own, step = _free_columns(A, free), np.zeros(free.shape)
    damp = np.sqrt(damping) * np.eye(int(free.sum()), own.shape[1])
    step[free] = np.linalg.lstsq(np.vstack([own, damp]), np.append(b, np.zeros(len(damp))), rcond=None)[0][: len(damp)]
    return step * min(1.0, LONGEST / max(np.abs(step).max(), LONGEST))


def _weights_of_moduli(distances: np.ndarray, degrees: float) -> np.ndarray:
    """Return the weights (2,) of log G' and of log G'', from the distances (2, n) of n points from their curves. The
    weights are 1 unless the noise of the two moduli differs significantly (F-test, `CHANCE`).

    `degrees`: degrees of freedom of the distances of one modulus.
    """
    from scipy.stats import f  # slow to import

    size = np.sqrt(np.mean(distances**2, axis=1))
    if degrees < 2 or not size.min() > 0 or (size.max() / size.min()) ** 2 < f.isf(CHANCE, degrees, degrees):
        return np.ones(2)
    ratio = min(size[1] / size[0], MOST) if size[1] > size[0] else max(size[1] / size[0], 1 / MOST)
    return np.array([np.sqrt(ratio), 1 / np.sqrt(ratio)])


def known_shifts(sweeps: Sequence[Sweep], temperatures: np.ndarray, reference: int, log_a: np.ndarray) -> Shifts:
    """Return `Shifts` for given factors, whose standard errors are 0. `log_a`: log10 of a_T (K,). The other arguments
    are the same as for `found`."""
    none, exact = np.zeros(len(sweeps)), np.zeros((len(sweeps),) * 2)
    every = [
        Shifts(temperatures, reference, log_a, none, none, none, misfit, _points_of(sweeps), exact, knots, given=True)
        for knots in KNOTS
        for misfit in (distances_from_curve(sweeps, log_a, none, knots),)
    ]
    return _best(sweeps, every, 0)


def _gap(columns: list, log_a: np.ndarray) -> list[int] | None:
    """Return the indices of two sweeps with a gap between them: no shifted sweep has frequencies in the gap. Return
    None if there is no gap. The data do not determine a shift across such a gap."""
    ends = [(c[0][0] + a, c[0][-1] + a) for c, a in zip(columns, log_a, strict=True)]
    order = sorted(range(len(ends)), key=lambda k: ends[k][0])
    last = order[0]
    for k in order[1:]:
        if ends[k][0] > ends[last][1]:
            return [last, k]
        last = k if ends[k][1] > ends[last][1] else last
    return None


def _refuse_gap(columns: list, shifts: Shifts) -> None:
    T, other = sorted(celsius(shifts.temperatures[_gap(columns, shifts.log_a) or [0, 1]]))
    raise InputError(
        f"the sweeps at {T:.4g} and {other:.4g} °C do not overlap after the best shifts, so the data do not determine "
        "the shift between them: measure at a temperature between these two or at more frequencies, or give the "
        "factors in a column shift_factor"
    )


def distances_from_curve(sweeps: Sequence[Sweep], log_a: np.ndarray, log_b: np.ndarray, knots: float) -> np.ndarray:
    """Return the relative root mean square distance (K,) of each of K shifted sweeps from their common curve."""
    place = np.repeat(np.arange(len(sweeps)), [len(s.storage) for s in sweeps])
    square = 0.5 * np.sum(_distances_of_moduli(sweeps, log_a, log_b, knots) ** 2, axis=0)
    return np.sqrt(np.bincount(place, square) / np.bincount(place)) * np.log(10)


def _distances_of_moduli(sweeps: Sequence[Sweep], log_a: np.ndarray, log_b: np.ndarray, knots: float) -> np.ndarray:
    """Return the distances (2, n) [decades] of all n points of the shifted sweeps from the curves of G' and of G''."""
    columns = _in_decades(sweeps)
    x = _shifted_places(columns, log_a)
    B = _basis(x, _knot_grid(x, knots))[0]
    every = [np.concatenate([c[j] + b for c, b in zip(columns, log_b, strict=True)]) for j in (1, 2)]
    return np.stack([B @ _smooth_coefficients(B, y) - y for y in every])


def size_of_curve(sweeps: Sequence[Sweep], log_a: np.ndarray, knots: float) -> int:
    """Return the number of spline coefficients of the curve of G' for shifted sweeps. The curve of G'' has the same
    number of coefficients."""
    x = np.concatenate([np.log10(s.angular_frequency) + a for s, a in zip(sweeps, log_a, strict=True)])
    return _basis(x, _knot_grid(x, knots))[0].shape[1]


def _knot_grid(x: np.ndarray, apart: float) -> tuple[float, float]:
    """Return the place of the first knot, and the distance between two knots (at most `apart`) [decades]. The first and
    the last of the points x (n,) lie on knots (up to 1e-6)."""
    low, high = x.min() - 1e-6, x.max() + 1e-6
    return low, (high - low) / max(1, int(np.ceil((high - low) / apart)))


def _basis(x: np.ndarray, grid: tuple[float, float]) -> tuple[np.ndarray, np.ndarray]:
    """Return the values (n, C) and derivatives (n, C) of C cubic B-splines at n points x (n,). `grid`: see
    `_knot_grid`."""
    place, apart = grid
    first, last = int(np.floor((x.min() - place) / apart)), int(np.floor((x.max() - place) / apart)) + 1
    knots = place + apart * np.arange(first - 3, last + 4)
    spline = BSpline(knots, np.eye(len(knots) - 4), 3)
    return spline(x), spline.derivative()(x)


def _smooth_coefficients(B: np.ndarray, y: np.ndarray, weight: float = 1.0) -> np.ndarray:
    rows = _smoothness(B.shape[1])
    A, b = np.vstack([weight * B, rows]), np.concatenate([weight * y, np.zeros(len(rows))])
    return np.linalg.lstsq(A, b, rcond=None)[0]


def _smoothness(size: int) -> np.ndarray:
    return SMOOTH * np.diff(np.eye(size), min(3, size - 1), axis=0)


def _linear_problem(
    columns: list, log_a: np.ndarray, log_b: np.ndarray, grid: tuple[float, float], weights: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return the matrix and the right-hand side of a Gauss-Newton step. The unknowns are log a and log b of the K
    sweeps, and the coefficients of the curves of G' and G''. `weights` (2,) multiply the rows of G' and of G''."""
    K, counts = len(columns), [len(c[0]) for c in columns]
    x = _shifted_places(columns, log_a)
    own = np.repeat(np.eye(K), counts, axis=0)
    B, slope = _basis(x, grid)
    size, rows, right, penalty = B.shape[1], [], [], []
    for j in (1, 2):
        y = np.concatenate([c[j] + b for c, b in zip(columns, log_b, strict=True)])
        c = _smooth_coefficients(B, y, weights[j - 1])
        part = [np.zeros((len(x), size)), np.zeros((len(x), size))]
        part[j - 1] = B
        rows.append(weights[j - 1] * np.hstack([(slope @ c)[:, None] * own, -own, *part]))
        right.append(weights[j - 1] * (y - B @ c))
        penalty.append(-_smoothness(size) @ c)
    smooth = np.kron(np.eye(2), _smoothness(size))
    A = np.vstack([*rows, np.hstack([np.zeros((len(smooth), 2 * K)), smooth])])
    return A, np.concatenate([*right, *penalty])


def _covariance(A: np.ndarray, b: np.ndarray, counts: np.ndarray) -> np.ndarray:
    """Return the covariance of all unknowns. The first rows of A and b belong to G' of all K sweeps, and the next rows
    to G''. The other rows are the penalty that keeps the curve smooth. If the noise of the sweeps differs significantly
    (`_differ`), each sweep has its own noise. `counts` (K,): number of points of each sweep."""
    data, place = 2 * counts.sum(), np.tile(np.repeat(np.arange(len(counts)), counts), 2)
    inverse, squares = np.linalg.pinv(A)[:, :data], b[:data] ** 2
    leverages = np.einsum("nc,cn->n", A[:data], inverse)
    degrees = 2 * counts - np.bincount(place, leverages)
    variances = np.full(len(counts), np.sum(squares) / max(1, data - A.shape[1]))
    known = degrees >= LEAST_DEGREES
    own = np.bincount(place, squares)[known] / degrees[known]
    if _differ(own, degrees[known]):
        variances[known] = own
    return inverse * variances[place] @ inverse.T


def _differ(variances: np.ndarray, degrees: np.ndarray) -> bool:
    """Return whether variances (k,) with the given degrees of freedom (k,) differ significantly (test of Bartlett 1937,
    `CHANCE`)."""
    if len(variances) < 2 or not variances.min() > 0:
        return False
    ratio = degrees.sum() * np.log(np.average(variances, weights=degrees)) - degrees @ np.log(variances)
    correction = 1 + (np.sum(1 / degrees) - 1 / degrees.sum()) / (3 * (len(degrees) - 1))
    return bool(chdtrc(len(degrees) - 1, ratio / correction) < CHANCE)


def _first_shifts(columns: list, temperatures: np.ndarray, reference: int) -> np.ndarray:
    """Return starting values of the shifts of the K sweeps (K,) [decades]. Each sweep is shifted onto the sweep at the
    neighbouring temperature, beginning at the reference temperature."""
    log_a = np.zeros(len(columns))
    for way in (range(reference + 1, len(columns)), range(reference - 1, -1, -1)):
        before = reference
        for k in way:
            s = _over(columns[before], columns[k])
            if s is None:
                raise InputError(
                    f"the sweeps at {celsius(temperatures[before]):.4g} and {celsius(temperatures[k]):.4g} °C do not "
                    "match at any shift of frequency: remove the temperatures on one side of this gap, or give "
                    "the factors in a column shift_factor"
                )
            log_a[k], before = log_a[before] + s, k
    return log_a


def _over(fixed: tuple, moving: tuple) -> float | None:
    """Return the shift [decades] of the sweep `moving` at which this sweep is nearest to the neighbouring sweep
    `fixed`. Return None if the sweeps match at no shift.

    If the sweeps match within the noise at several shifts, the shift with the longest overlap is used. At a wrong
    shift, a few points may match by chance.
    """
    best, where = (np.inf, 0), None
    noise = WITHIN * sum(_variance(c) for c in (fixed, moving))
    places = [moving[0] + s for s in REACH]
    insides = [(x >= fixed[0][0] - 1e-9) & (x <= fixed[0][-1] + 1e-9) for x in places]
    least = max(2, OVERLAP * max(inside.sum() for inside in insides))
    for s, x, inside in zip(REACH, places, insides, strict=True):
        if inside.sum() < least:
            continue
        apart = [moving[j][inside] - np.interp(x[inside], fixed[0], fixed[j]) for j in (1, 2)]
        score = max(float(np.mean(np.square(apart))), noise), -int(inside.sum())
        if score < best:
            best, where = score, float(s)
    return where if best[0] < 0.25 else None  # no match if the distance is half a decade or more


def _variance(columns: tuple) -> float:
    """Return the mean noise variance of log10 G' and log10 G''. The result is 0 if there are too few points."""
    each = [scatter(*merged(10.0 ** columns[0], 10.0 ** columns[j])) / np.log(10) for j in (1, 2)]
    return float(np.mean(np.square(each))) if np.all(np.isfinite(each)) else 0.0
