"""Noise that two numbers of a reading have in common, G' and G'' of a frequency say, as that of the torque."""

import numpy as np
import scipy.optimize

#: Gain in the logarithm of the restricted likelihood from which pairs have noise in common; chance reaches it in 1 of
#: 100.
_GAIN = 3.3
#: Largest size of a correlation, and of the logarithm of the ratio of the two deviations. A lower limit of the
#: correlation, as 0.9, would give a wrong level to noise that is wholly in common.
_MOST, _RATIO = 1 - 1e-9, 5.0
#: Pairs beyond the number of unknowns from which it is tried: with few pairs independent noise looks shared. Smallest
#: condition of J.
_BEYOND, _CONDITION = 8, 1e-8


def paired_root(J: np.ndarray, r: np.ndarray, slope: np.ndarray) -> np.ndarray | None:
    """Square root (P, n) of the covariance of P numbers; None if the noise of pairs has nothing in common but chance.

    Deviations and correlation of the two noises are those that make the residuals most probable (restricted maximum
    likelihood: Patterson and Thompson 1971). The numbers remain those of the fit.

    Args:
        J: derivatives of the residuals by unknowns u (n, p).
        r: residuals (n,) of the fit; those of a pair are n/2 apart.
        slope: derivatives of the numbers by u (P, p).
    """
    (n, p), scale = J.shape, np.linalg.norm(J, axis=0)
    if n % 2 or n // 2 < p + _BEYOND or not (np.all(np.isfinite(J)) and np.all(np.isfinite(r)) and np.all(scale > 0)):
        return None
    J = J / scale
    values = np.linalg.svd(J, compute_uv=False)
    if values[-1] < _CONDITION * values[0] or not np.any(r):
        return None

    def lacking(x: np.ndarray) -> float:
        return -_probability(J, r, x[0], x[1])[0]

    own, common = (
        scipy.optimize.minimize(lacking, np.zeros(2), bounds=[(-_RATIO, _RATIO), (-most, most)], method="L-BFGS-B")
        for most in (0.0, _MOST)
    )
    if not own.fun - common.fun > _GAIN:
        return None
    level = _probability(J, r, *common.x)[1]
    L = level * _of_a_pair(*common.x)
    inverse = np.linalg.pinv(J) / scale[:, None]
    first, second = inverse[:, : n // 2], inverse[:, n // 2 :]
    return slope @ np.hstack([L[0, 0] * first + L[1, 0] * second, L[1, 1] * second])


def _of_a_pair(ratio: float, correlation: float) -> np.ndarray:
    """Lower root (2, 2) of the covariance of a pair, of determinant 1 but for the correlation."""
    a, b = np.exp(0.5 * ratio), np.exp(-0.5 * ratio)
    return np.array([[a, 0.0], [correlation * b, np.sqrt(1 - correlation**2) * b]])


def _probability(J: np.ndarray, r: np.ndarray, ratio: float, correlation: float) -> tuple[float, float]:
    """Logarithm of the restricted likelihood, up to a constant, and the level of the noise."""
    (n, p), L = J.shape, _of_a_pair(ratio, correlation)
    inverse = np.linalg.inv(L)
    white = np.einsum("ab,bmk->amk", inverse, np.column_stack([J, r]).reshape(2, n // 2, p + 1)).reshape(n, p + 1)
    # The last diagonal entry of R is the norm of what the unknowns leave of the residuals.
    diagonal = np.maximum(np.abs(np.diagonal(np.linalg.qr(white, mode="r"))), 1e-300)
    determinants = 0.5 * n * np.log(np.linalg.det(L)) + np.sum(np.log(diagonal[:p]))
    return float(-determinants - (n - p) * np.log(diagonal[p])), float(diagonal[p] / np.sqrt(n - p))
