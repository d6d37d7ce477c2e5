"""Noise that is not the same at all points, as where it grows with the stress: errors of least squares that hold."""

import numpy as np
import scipy.linalg
import scipy.special

#: Smallest noise, over the largest, of noise in proportion to a size.
_LEAST = 1e-6
#: Least part of a residual that the fit cannot have taken up.
_LEFT = 0.05


def uneven_root(J: np.ndarray, r: np.ndarray, slope: np.ndarray) -> np.ndarray:
    """Square root (P, n) of the covariance of P numbers, each residual with its own variance (HC3: MacKinnon and White
    1985).

    Args:
        J: derivatives of the residuals by unknowns u (n, p), of full rank.
        r: residuals of the fit (n,).
        slope: derivatives of the numbers by u (P, p).
    """
    if not np.all(np.isfinite(J)) or J.size == 0:
        return np.zeros((len(slope), len(r)))
    inverse = np.linalg.pinv(J)
    leverage = np.einsum("kn,nk->n", inverse, J)
    return slope @ (inverse * (r / np.maximum(1 - leverage, _LEFT)))


def growing_root(J: np.ndarray, r: np.ndarray, size: np.ndarray, slope: np.ndarray) -> np.ndarray:
    """Square root (P, n) of the covariance of P numbers for noise in proportion to `size` (n,); 0 if the residuals make
    equal noise more probable, by restricted likelihood.

    `uneven_root` does not see the noise of a point with a leverage near 1: the fit goes through it.
    """
    (n, p), largest, none = J.shape, np.abs(size).max(initial=0.0), np.zeros((len(slope), len(r)))
    if not (np.all(np.isfinite(J)) and np.all(np.isfinite(r)) and p and n > p + 1 and largest > 0):
        return none
    growing = np.maximum(np.abs(size) / largest, _LEAST)
    (equal, _), (better, level) = (probability_of_sizes(J, r, own) for own in (np.ones(n), growing))
    return slope @ (np.linalg.pinv(J) * level * growing) if better > equal else none


def probability_of_sizes(J: np.ndarray, r: np.ndarray, size: np.ndarray) -> tuple[float, float]:
    """Restricted likelihood of independent noise with deviations in proportion to `size` (n,), and their factor."""
    beside = scipy.linalg.null_space(J.T)
    try:
        L = np.linalg.cholesky(beside.T @ (size[:, None] ** 2 * beside))
    except np.linalg.LinAlgError:
        return -np.inf, 1.0
    level = float(np.sqrt(np.mean(scipy.linalg.solve_triangular(L, beside.T @ r, lower=True) ** 2)))
    return -float(np.sum(np.log(np.diagonal(L)))) - len(L) * np.log(max(level, 1e-300)), level


#: Chance below which two groups of residuals have noise of their own; smallest condition of J at which it is tried.
_CHANCE, _CONDITION = 1e-3, 1e-8


def grouped_root(J: np.ndarray, r: np.ndarray, second: np.ndarray, slope: np.ndarray) -> np.ndarray | None:
    """Square root (P, n) of the covariance of P numbers with the noise of `grouped_sizes`; None if that is None.

    Args:
        J, r, slope: as in `uneven_root`.
        second: which residuals are of the second group (n,).
    """
    sizes, scale = grouped_sizes(J, r, second), np.linalg.norm(J, axis=0)
    return None if sizes is None else slope @ (np.linalg.pinv(J / scale) / scale[:, None] * sizes)


def grouped_sizes(J: np.ndarray, r: np.ndarray, second: np.ndarray) -> np.ndarray | None:
    """Deviations (n,) of two groups of residuals, G' and G'' say, that have noise of their own; None if they differ no
    more than by chance, or if some combination of u is hardly determined. Arguments as in `grouped_root`.
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
