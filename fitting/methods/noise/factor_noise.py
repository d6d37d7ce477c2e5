"""Standard errors of least squares if each series has an individual unknown factor, for example because the size of its
sample is not exactly known."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import scipy.linalg
import scipy.special

#: The residuals show that the series have different factors if such factors raise the logarithm of the restricted
#: likelihood by at least this value. Without factors, this happens in 1 of 140 cases.
_GAIN = 3.0
#: At the end of a 95 % interval of the factors' standard deviation, the logarithm of the restricted likelihood is below
#: its maximum by this value.
_FALL = 1.92
#: Upper bound of the standard deviation of factors if the residuals do not show them. The value is typical of the
#: errors of sample sizes.
HIDDEN = 0.1
#: F has one column for each factor. The part that the unknowns can compensate is removed from F. Then singular values
#: below this fraction of the norm of F are roundoff: the unknowns can compensate these factors completely.
_ROUNDOFF = 1e-8
#: Lower bound for the part of the squared residuals that the factors do not explain. If repeated measurements are
#: identical, this part is only roundoff.
_SAME = 1e-12


class FactorNoise(NamedTuple):
    """Unknown factors of K series with n residuals in all, and their effect on P parameters."""

    deviation: float  # most probable standard deviation of a factor [1], may be 0; at most `HIDDEN` if not `shown`
    root: np.ndarray  # (P, n + K) square root of the covariance of the parameters
    series: int  # K
    gain: float  # how much the factors raise the logarithm of the restricted likelihood
    hidden: float  # largest standard deviation of factors that the residuals do not exclude [1], at most `HIDDEN`
    moves: np.ndarray  # (P,) errors of the parameters due to factors with the standard deviation `hidden`

    @property
    def shown(self) -> bool:
        """Whether the residuals show factors: independent noise alone does not explain the residuals."""
        return self.gain >= _GAIN


def factors_of_groups(
    groupings: Sequence[list[str]],
    counts: list[int],
    J: np.ndarray,
    r: np.ndarray,
    fitted: np.ndarray,
    slope: np.ndarray,
) -> list[FactorNoise]:
    """Return the noise of factors (`factors_of_series`) for each possible grouping of the curves. The curves of one
    group have the same factor. If two groupings are equal, only the first is used.

    Args:
        groupings: name of the group of each curve, for each grouping.
        counts: number of rows of each curve.
        J, r, fitted, slope: as for `factors_of_series`.
    """
    groups = [np.repeat(np.unique(names, return_inverse=True)[1], counts) for names in groupings]
    out = []
    for k, group in enumerate(groups):
        if not any(np.array_equal(group, earlier) for earlier in groups[:k]):
            rows = np.argsort(group, kind="stable")
            out.append(factors_of_series(np.bincount(group).tolist(), J[rows], r[rows], fitted[rows], slope))
    return [own for own in out if own is not None]


def factors_of_series(
    counts: list[int], J: np.ndarray, r: np.ndarray, fitted: np.ndarray, slope: np.ndarray
) -> FactorNoise | None:
    """Fit noise with the covariance s^2 (I + q^2 f_k f_k^T) to the residuals of each series k. Here s is the standard
    deviation of the independent noise, q s the standard deviation of the factors, and f_k are the fitted values of the
    series. Returns None for a single series or too few residuals.

    There are few factors, so their standard deviation is uncertain. If the residuals show factors, their standard
    deviation is enlarged according to Student's t with K - 1 degrees of freedom. If noise alone may explain the
    factors, their standard deviation is not enlarged. If the unknowns can compensate most of the effect of the factors,
    the residuals hardly show the factors. Then `hidden` and `moves` describe the largest factors that the residuals do
    not exclude.

    Args:
        counts: number of rows of each of the K series.
        J: derivatives (n, p) of the residuals with respect to the unknowns u.
        r: residuals (n,).
        fitted: fitted values f (n,), divided by the scales of the residuals. A factor multiplies these values.
        slope: derivatives (P, p) of the P parameters with respect to u.
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
    gain = float(values[best] - values[0])
    shown = gain >= _GAIN
    deviation = float(levels[best] * qs[best]) if shown else min(HIDDEN, float(levels[best] * qs[best]))
    few = float(scipy.special.stdtrit(K - 1, 0.975) / scipy.special.ndtri(0.975)) if shown else 1.0
    root = np.hstack([slope @ inverse * levels[best], by_factors * (deviation * few)])
    likely = values >= values[best] - _FALL
    hidden = HIDDEN if likely[-1] else min(HIDDEN, float((levels * qs)[likely].max()))
    return FactorNoise(deviation, root, K, gain, hidden, hidden * np.linalg.norm(by_factors, axis=1))
