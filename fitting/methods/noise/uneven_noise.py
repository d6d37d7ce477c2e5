"""Standard errors of least squares that remain valid if the noise differs between points, for example if the noise
grows with the stress."""

import numpy as np
import scipy.linalg
import scipy.special

#: For noise proportional to a size: lower bound of the noise, divided by the largest noise.
_LEAST = 1e-6
#: Lower bound of 1 - leverage, the part of the noise of a point that stays in its residual.
_LEFT = 0.05


def uneven_root(J: np.ndarray, r: np.ndarray, slope: np.ndarray) -> np.ndarray:
    """Return the square root (P, n) of the covariance of P parameters if each residual has a separate variance (HC3:
    MacKinnon and White 1985).

    Args:
        J: derivatives (n, p) of the residuals with respect to the unknowns u, of full rank.
        r: residuals of the fit (n,).
        slope: derivatives (P, p) of the parameters with respect to u.
    """
    if not np.all(np.isfinite(J)) or J.size == 0:
        return np.zeros((len(slope), len(r)))
    inverse = np.linalg.pinv(J)
    leverage = np.einsum("kn,nk->n", inverse, J)
    return slope @ (inverse * (r / np.maximum(1 - leverage, _LEFT)))


def growing_root(J: np.ndarray, r: np.ndarray, size: np.ndarray, slope: np.ndarray) -> np.ndarray:
    """Return the square root (P, n) of the covariance of P parameters for noise proportional to `size` (n,). The result
    is 0 if noise of equal size at all points has a higher restricted likelihood.

    `uneven_root` cannot determine the noise of a point with a leverage near 1, because the fit passes through this
    point. So this function is needed.
    """
    (n, p), largest, none = J.shape, np.abs(size).max(initial=0.0), np.zeros((len(slope), len(r)))
    if not (np.all(np.isfinite(J)) and np.all(np.isfinite(r)) and p and n > p + 1 and largest > 0):
        return none
    growing = np.maximum(np.abs(size) / largest, _LEAST)
    (equal, _), (better, level) = (probability_of_sizes(J, r, own) for own in (np.ones(n), growing))
    return slope @ (np.linalg.pinv(J) * level * growing) if better > equal else none


def probability_of_sizes(J: np.ndarray, r: np.ndarray, size: np.ndarray) -> tuple[float, float]:
    """Return the logarithm of the restricted likelihood of independent noise with standard deviations proportional to
    `size` (n,), and the most probable factor of proportionality."""
    beside = scipy.linalg.null_space(J.T)
    try:
        L = np.linalg.cholesky(beside.T @ (size[:, None] ** 2 * beside))
    except np.linalg.LinAlgError:
        return -np.inf, 1.0
    level = float(np.sqrt(np.mean(scipy.linalg.solve_triangular(L, beside.T @ r, lower=True) ** 2)))
    return -float(np.sum(np.log(np.diagonal(L)))) - len(L) * np.log(max(level, 1e-300)), level


#: The noise of two groups of residuals counts as different in size if equal noise would give such a difference with a
#: probability below _CHANCE. The test is made only if the smallest singular value of the scaled Jacobian, divided by
#: the largest one, is at least _CONDITION.
_CHANCE, _CONDITION = 1e-3, 1e-8


def grouped_root(J: np.ndarray, r: np.ndarray, second: np.ndarray, slope: np.ndarray) -> np.ndarray | None:
    """Return the square root (P, n) of the covariance of P parameters if two groups of residuals have noise of
    different size. Returns None if `grouped_sizes` returns None.

    Args:
        J, r, slope: see `uneven_root`.
        second: whether each residual (n,) belongs to the second group.
    """
    sizes, scale = grouped_sizes(J, r, second), np.linalg.norm(J, axis=0)
    return None if sizes is None else slope @ (np.linalg.pinv(J / scale) / scale[:, None] * sizes)


def grouped_sizes(J: np.ndarray, r: np.ndarray, second: np.ndarray) -> np.ndarray | None:
    """Return the standard deviation of each residual (n,) if two groups of residuals (for example of G' and G'') have
    noise of different size. Returns None if the difference may be random, or if the data hardly determine some
    combination of the unknowns. Arguments: see `grouped_root`.
    """
    scale = np.linalg.norm(J, axis=0)
    if not (np.all(np.isfinite(J)) and np.all(scale > 0)):
        return None
    values = np.linalg.svd(J / scale, compute_uv=False)
    if values[-1] < _CONDITION * values[0]:
        return None
    leverage = np.einsum("kn,nk->n", np.linalg.pinv(J / scale), J / scale)
    freedom, square = (np.array([v[~second].sum(), v[second].sum()]) for v in (1 - leverage, r**2))
    if not (np.all(freedom > 1) and np.all(square > 0)):
        return None
    variance = square / freedom
    large, small = int(np.argmax(variance)), int(np.argmin(variance))
    chance = scipy.special.fdtrc(freedom[large], freedom[small], variance[large] / variance[small])
    if large == small or 2 * chance > _CHANCE:
        return None
    return np.sqrt(variance)[second.astype(int)]
