"""A factor that each series has of its own, as by the size of its sample: errors of least squares that contain it."""

from typing import NamedTuple

import numpy as np
import scipy.linalg
import scipy.special

#: Gain in the logarithm of the restricted likelihood from which series have factors; chance reaches it in 1 of 140.
_GAIN = 3.0


class FactorNoise(NamedTuple):
    """FactorNoise of series that the residuals show."""

    deviation: float  # standard deviation of a factor [1]
    root: np.ndarray  # (P, n + K) square root of the covariance of the numbers


def factors_of_series(
    counts: list[int], J: np.ndarray, r: np.ndarray, fitted: np.ndarray, slope: np.ndarray
) -> FactorNoise | None:
    """Noise of variance s^2 (I + q^2 f_k f_k^T) of each series k; None if independent noise explains the residuals.

    The factors are few, so their deviation is not known well: it is enlarged by Student's t of K - 1 degrees of
    freedom.

    Args:
        counts: rows of each of K series.
        J: derivatives of the residuals by unknowns u (n, p).
        r: residuals (n,).
        fitted: the numbers f (n,) that a factor multiplies, over the scales of the residuals.
        slope: derivatives of P numbers by u (P, p).
    """
    (n, p), K = J.shape, len(counts)
    if K < 2 or n <= p + K or not (p and np.all(np.isfinite(J)) and np.all(np.isfinite(r))):
        return None
    F = fitted[:, None] * (np.repeat(np.arange(K), counts)[:, None] == np.arange(K))
    beside = scipy.linalg.null_space(J.T)
    U, S, _ = np.linalg.svd(beside.T @ F, full_matrices=False)
    y, m = beside.T @ r, beside.shape[1]
    along = (U.T @ y) ** 2
    rest = max(float(y @ y) - float(along.sum()), 0.0)
    if not (S[0] > 0 and rest + along.sum() > 0):
        return None

    def at(q: float) -> tuple[float, float]:
        stretched = 1 + (q * S) ** 2
        square = max(rest + float(np.sum(along / stretched)), 1e-300)
        return -0.5 * (float(np.sum(np.log(stretched))) + m * np.log(square / m)), square / m

    qs = np.concatenate([[0.0], np.geomspace(0.1, 1e4, 60) / S[0]])
    found = [at(q) for q in qs]
    best = int(np.argmax([value for value, _ in found]))
    if found[best][0] - found[0][0] < _GAIN:
        return None
    level, inverse = np.sqrt(found[best][1]), np.linalg.pinv(J)
    few = float(scipy.special.stdtrit(K - 1, 0.975) / scipy.special.ndtri(0.975))
    root = slope @ np.hstack([inverse * level, inverse @ F * (level * qs[best] * few)])
    return FactorNoise(float(level * qs[best]), root)
