"""Standard errors for noise that is correlated between neighbouring points.

Registration and image correlation smooth the data. So the noise of neighbouring points is correlated, and there are
fewer independent values than points. Consider two residuals of the same group (direction, instant and scene) at points
with the distance d. Their covariance is assumed to be s^2 (a k(d / l) + (1 - a) delta), where delta is 1 for a residual
and itself, and otherwise 0. k is the Matérn function of order 3/2 (smoothed noise) or 1/2 (drifting noise). The order,
the length l, the correlated part a and the level s are chosen so that the residuals are most probable (restricted
maximum likelihood: Patterson and Thompson 1971). The likelihood is restricted because the fitted parameters absorb a
part of the noise, which is then missing in the residuals. The fitted parameters do not change. With the Jacobian J and
the covariance C of the residuals, the covariance of the parameters is J^+ C (J^+)^T instead of s^2 J^+ (J^+)^T.
"""

import itertools
from typing import NamedTuple

import numpy as np
import scipy.linalg
import scipy.signal
import scipy.spatial

from liverjax.solvers.blas import one_blas_thread

#: PARTS: values of the correlated part a that are tried. LENGTHS: number of correlation lengths that are tried. They
#: range from a third of the distance between neighbours to the size of the body.
PARTS, LENGTHS = (0.3, 0.6, 0.9, 0.99), 8
#: Orders of the Matérn function: for smoothed noise, and for drifting noise.
ORDERS = ("3/2", "1/2")
#: FEW: maximum number of groups for which the likelihood is computed. MOST: maximum number of points in each group.
#: Half of these points are near each other, half are scattered over the body.
FEW, MOST = 12, 400
#: Noise counts as correlated if the correlation raises the log likelihood by more than this value. With uncorrelated
#: noise, this happens once in a thousand cases.
GAIN = 7.0
#: If the root mean square of the residuals is below this value, the data do not contain the stated noise, for example
#: because they are synthetic data without noise.
LEAST = 0.2
#: Residuals are clipped at this many robust standard deviations, so that a single wrong point does not look like
#: correlated noise.
OUTLIER = 5.0
#: The likelihood uses an unknown only if the residuals of the chosen groups depend on it: the norm of their
#: derivatives, divided by the norm for all groups, must exceed this value.
SHOWN = 1e-9
#: If a singular value of the scaled derivatives, divided by the largest one, is below this value, the direction of this
#: singular value is ignored.
LOST = 1e-6
#: Number of rows of the covariance C that are computed at once.
ROWS = 500


class Alike(NamedTuple):
    """Correlated noise of neighbouring points, estimated from the residuals of a fit with p unknowns."""

    length: float  # correlation length [m]; in results of `along_rows`, the unit is one row
    part: float  # correlated part a of the variance
    level: float  # level s: standard deviation divided by the stated standard deviation
    root: np.ndarray  # (p, p) square root of the covariance of the unknowns
    gain: float  # gain of the log likelihood compared with independent noise
    independent: float  # equivalent number of independent residuals


def alike_noise(
    places: np.ndarray, group: np.ndarray, r: np.ndarray, J: np.ndarray, inverse: np.ndarray | None = None
) -> Alike | None:
    """Estimate the noise that is correlated between neighbouring points. Returns None if uncorrelated noise may explain
    the residuals.

    Args:
        places: position of each residual (n, 3) [m].
        group: index (n,) of the group of each residual. The noise of different groups (directions, instants, scenes) is
            uncorrelated.
        r: residuals (n,) of a fit, divided by the stated standard deviations.
        J: derivatives of the residuals (n, p), of full rank.
        inverse: derivatives (p, n) of the unknowns with respect to r; default J^+.
    """
    with one_blas_thread():  # the matrices are small
        return _alike_noise(places, group, r, J, np.linalg.pinv(J) if inverse is None else inverse)


def _alike_noise(
    places: np.ndarray, group: np.ndarray, r: np.ndarray, J: np.ndarray, inverse: np.ndarray
) -> Alike | None:
    groups = [np.flatnonzero(group == g) for g in np.unique(group)]
    some = np.unique(np.linspace(0, len(groups) - 1, FEW).round().astype(int))
    chosen = [_subset(places[groups[k]], groups[k]) for k in some]
    far = [scipy.spatial.distance.cdist(places[own], places[own]) for own in chosen]
    neighbour = np.median([_to_neighbours(d) for d in far])
    size = float(np.ptp(places, axis=0).max())
    if not 0 < neighbour < size or len(r) <= 2 * J.shape[1]:
        return None
    lengths = np.geomspace(neighbour / 3, size, LENGTHS)
    # If the residuals of the chosen groups do not depend on an unknown, this unknown absorbs none of their noise.
    shown = np.linalg.norm(J[np.concatenate(chosen)], axis=0) > SHOWN * np.linalg.norm(J, axis=0)
    if not 0 < shown.sum() < sum(map(len, chosen)):
        return None
    basis = _determined(J[np.ix_(np.concatenate(chosen), shown)])
    limit = OUTLIER * 1.4826 * float(np.median(np.abs(r)))
    clipped = np.clip(r, -limit, limit) if limit > 0 else r
    data = [(clipped[own], J[np.ix_(own, shown)] @ basis) for own in chosen]
    alone, _ = _probability_at(data, far, "3/2", 1.0, 0.0)
    choices = itertools.product(ORDERS, lengths, PARTS)
    tried = [(*_probability_at(data, far, order, l, a), order, l, a) for order, l, a in choices]
    best, level, order, length, part = max(tried)
    # The test is written as `not best > ...`, so that it is also right if both values are -inf. The level `level` has
    # no lower limit here, because it is also small if the noise is smoother than the Matérn function.
    if not np.isfinite(alone) or not best > alone + GAIN or np.sqrt(np.mean(r**2)) < LEAST:
        return None
    parts = [_of_unknowns(places[own], (order, length, part), inverse[:, own]) for own in groups]
    values, vectors = np.linalg.eigh(sum(middle for middle, _ in parts))
    root = max(1.0, level) * vectors * np.sqrt(np.maximum(values, 0.0))
    return Alike(float(length), part, max(1.0, level), root, best - alone, sum(count for _, count in parts))


def _determined(J: np.ndarray) -> np.ndarray:
    """Return the k directions (p, k) of the unknowns that the derivatives J (n, p) determine. If a parameter is at its
    bound, one direction is not determined. With this direction, the determinant in the likelihood would be only
    roundoff."""
    size = np.linalg.norm(J, axis=0)
    size = np.where(size > 0, size, 1.0)
    _, values, directions = np.linalg.svd(J / size, full_matrices=False)
    return directions[values > LOST * values[0]].T / size[:, None]


def along_rows(counts: list[int], r: np.ndarray, J: np.ndarray, deviation: float, inverse: np.ndarray) -> Alike | None:
    """Estimate correlated noise (see `alike_noise`) for series that were measured one row after the other. The unit of
    the correlation length is one row.

    Args:
        counts: number of rows of each series. The noise of different series is uncorrelated.
        r, J: residuals (n,) and their derivatives (n, p) with respect to the unknowns.
        deviation: standard deviation of a residual.
        inverse: derivatives (p, n) of the unknowns with respect to r.
    """
    if not (deviation > 0 and np.all(np.isfinite(J))):
        return None
    places = np.concatenate([np.arange(n) for n in counts])[:, None] * np.array([1.0, 0.0, 0.0])
    # Noise of the imposed quantity (depth, stretch) is in J and in the residuals, and would look like correlated noise.
    # So J is smoothed.
    parts = np.split(J, np.cumsum(counts)[:-1])
    smooth = [scipy.signal.savgol_filter(p, max(3, len(p) // 10 | 1), 1, axis=0) if len(p) > 3 else p for p in parts]
    group = np.repeat(np.arange(len(counts)), counts)
    return alike_noise(places, group, r / deviation, np.concatenate(smooth) / deviation, inverse * deviation)


def _to_neighbours(distance: np.ndarray) -> float:
    """Return the mean distance from a position to the nearest different position. Several residuals may have the same
    position."""
    nearest = np.where(distance > 0, distance, np.inf).min(axis=1)
    known = np.isfinite(nearest)
    return float(nearest[known].mean()) if known.any() else 0.0


def _subset(places: np.ndarray, own: np.ndarray) -> np.ndarray:
    """Choose at most `MOST` of the residuals with the indices `own` (m,), and return their indices: half of them are
    near one point, the other half comes from the whole body."""
    if len(own) <= MOST:
        return own
    rng = np.random.default_rng(0)
    near = np.argsort(np.linalg.norm(places - places[rng.integers(len(own))], axis=1))[: MOST // 2]
    rest = np.setdiff1d(np.arange(len(own)), near)
    return own[np.concatenate([near, rng.choice(rest, MOST - len(near), replace=False)])]


def _matern(distance: np.ndarray, order: str, length: float) -> np.ndarray:
    """Return the Matérn function of order 3/2 or 1/2, with the length scale `length`, at the distances `distance`."""
    if order == "1/2":
        return np.exp(-distance / length)
    x = np.sqrt(3) * distance / length
    return (1 + x) * np.exp(-x)


def _probability_at(data: list, far: list[np.ndarray], order: str, length: float, part: float) -> tuple[float, float]:
    """Return the logarithm of the restricted likelihood, up to a constant, and the most probable level s. `data`:
    residuals and their derivatives for each group. `far`: distances between the points of each group."""
    p = data[0][1].shape[1]
    determinant, squares, b, A = 0.0, 0.0, np.zeros(p), np.zeros((p, p))
    for (r, J), distance in zip(data, far, strict=True):
        L = np.linalg.cholesky(part * _matern(distance, order, length) + (1 - part) * np.eye(len(r)))
        white = scipy.linalg.solve_triangular(L, np.column_stack([r, J]), lower=True, check_finite=False)
        determinant += 2 * float(np.sum(np.log(np.diagonal(L))))
        squares += float(white[:, 0] @ white[:, 0])
        b, A = b + white[:, 1:].T @ white[:, 0], A + white[:, 1:].T @ white[:, 1:]
    freedom = sum(len(r) for r, _ in data) - p
    left = max(squares - float(b @ np.linalg.pinv(A) @ b), 1e-300)
    sign, of_unknowns = np.linalg.slogdet(A)
    value = -0.5 * (determinant + of_unknowns + freedom * np.log(left / freedom))
    return (value if sign > 0 else -np.inf), float(np.sqrt(left / freedom))


def _of_unknowns(places: np.ndarray, shape: tuple[str, float, float], inverse: np.ndarray) -> tuple[np.ndarray, float]:
    """Return the contribution J^+ C (J^+)^T (p, p) of one group of n residuals to the covariance of the p unknowns. C
    is the correlation matrix of the group. Also return the number of independent residuals of the group, n^2 / sum(C).
    Only a few rows of C are computed at a time.

    `shape`: order, correlation length and correlated part of the noise.
    """
    order, length, part = shape
    total, sum_of_C = (1 - part) * inverse @ inverse.T, (1 - part) * len(places)
    for a in range(0, len(places), ROWS):
        C = _matern(scipy.spatial.distance.cdist(places[a : a + ROWS], places), order, length)
        total = total + part * inverse[:, a : a + ROWS] @ C @ inverse.T
        sum_of_C += part * float(C.sum())
    return total, len(places) ** 2 / sum_of_C
