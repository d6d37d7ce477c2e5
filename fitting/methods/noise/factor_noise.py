"""A factor that each series has of its own, as by the size of its sample: errors of least squares that contain it."""

from typing import NamedTuple

import numpy as np
import scipy.linalg
import scipy.special

#: Gain in the logarithm of the restricted likelihood from which series have factors; chance reaches it in 1 of 140.
_GAIN = 3.0
#: Fall of this logarithm to the end of a 95 % interval of the factors' deviation.
_FALL = 1.92
#: The largest deviation of factors that is asked for where the residuals do not show it: sizes of samples.
HIDDEN = 0.1
#: Singular values below this part of the factors' size are roundoff: the unknowns take up all factors.
_ROUNDOFF = 1e-8
#: Least part of the squared residuals beside the factors: what exact repeats leave is roundoff, of any size.
_SAME = 1e-12


class FactorNoise(NamedTuple):
    """Factors of series."""

    deviation: (
        float  # the most probable standard deviation of a factor [1]; it may be 0, and at most `HIDDEN` if not shown
    )
    root: np.ndarray  # (P, n + K) square root of the covariance of the numbers
    shown: bool  # independent noise alone does not explain the residuals
    hidden: float  # deviation, at most `HIDDEN`, of factors that the residuals do not exclude [1]
    moves: np.ndarray  # (P,) standard deviations of the numbers by such factors


def factors_of_series(
    counts: list[int], J: np.ndarray, r: np.ndarray, fitted: np.ndarray, slope: np.ndarray
) -> FactorNoise | None:
    """Noise of variance s^2 (I + q^2 f_k f_k^T) of each series k; None for one series, or too few residuals.

    The factors are few, so a deviation that is shown is not known well: it is enlarged by Student's t of K - 1 degrees
    of freedom. One that chance may have made is not. If the unknowns can take up most of the factors, the residuals
    hardly show them: `hidden` and `moves` tell what they leave open.

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
    if not y @ y > 0:
        return None
    rest = max(float(y @ y) - float(along.sum()), _SAME * float(y @ y))
    S = np.where(_ROUNDOFF * np.linalg.norm(F) < S, S, 0.0)

    def at(q: float) -> tuple[float, float]:
        stretched = 1 + (q * S) ** 2
        square = max(rest + float(np.sum(along / stretched)), 1e-300)
        return -0.5 * (float(np.sum(np.log(stretched))) + m * np.log(square / m)), square / m

    qs = np.concatenate([[0.0], np.geomspace(0.1, 1e8, 110) / S[0]]) if S[0] > 0 else np.zeros(1)
    values, squares = np.array([at(q) for q in qs]).T
    best, levels, inverse = int(np.argmax(values)), np.sqrt(squares), np.linalg.pinv(J)
    by_factors = slope @ inverse @ F
    shown = bool(values[best] - values[0] >= _GAIN)
    deviation = float(levels[best] * qs[best]) if shown else min(HIDDEN, float(levels[best] * qs[best]))
    few = float(scipy.special.stdtrit(K - 1, 0.975) / scipy.special.ndtri(0.975)) if shown else 1.0
    root = np.hstack([slope @ inverse * levels[best], by_factors * (deviation * few)])
    likely = values >= values[best] - _FALL
    hidden = HIDDEN if likely[-1] else min(HIDDEN, float((levels * qs)[likely].max()))
    return FactorNoise(deviation, root, shown, hidden, hidden * np.linalg.norm(by_factors, axis=1))
