"""Standard errors of least squares that remain valid if the noise differs between points, for example if the noise
grows with the stress."""

from collections.abc import Sequence

import numpy as np
import scipy.special

#: For noise proportional to a size: lower bound of the noise, divided by the largest noise.
_LEAST = 1e-6
#: Maximum number of repeated fits with weights from the noise of two groups of residuals.
_ROUNDS = 6
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
    U, values, _ = np.linalg.svd(J, full_matrices=False)
    U = U[:, values > max(J.shape) * np.finfo(float).eps * values.max(initial=0.0)] / size[:, None]
    Q, R = np.linalg.qr(U)
    left, diagonal = r / size - Q @ (Q.T @ (r / size)), np.abs(np.diagonal(R))
    freedom = len(r) - len(R)
    if freedom < 1 or not (np.all(np.isfinite(left)) and np.all(diagonal > 0)):
        return -np.inf, 1.0
    level = float(np.linalg.norm(left) / np.sqrt(freedom))
    return -float(np.sum(np.log(size)) + np.sum(np.log(diagonal))) - freedom * np.log(max(level, 1e-300)), level


#: The noise of two groups of residuals counts as different in size if equal noise would give such a difference with a
#: probability below _CHANCE. The test is made only if the smallest singular value of the scaled Jacobian, divided by
#: the largest one, is at least _CONDITION.
_CHANCE, _CONDITION = 1e-3, 1e-8
#: Noise with one size in Pa is assumed only if its log-likelihood exceeds that of relative noise by this value.
_LIKELIER = 5.0
#: Residuals are smooth if the correlation of neighbours, times the square root of the number of residuals, exceeds this
#: value.
_ALIKE = 2.0


def root_of_sizes(J: np.ndarray, sizes: np.ndarray, slope: np.ndarray) -> np.ndarray:
    """Return the square root (P, n) of the covariance of P parameters for residuals with standard deviations `sizes`
    (n,). `J`, `slope`: see `uneven_root`."""
    scale = np.linalg.norm(J, axis=0)
    return slope @ (np.linalg.pinv(J / scale) / scale[:, None] * sizes)


def weighted_by_sizes(J: np.ndarray, r: np.ndarray, sizes: np.ndarray, groups: Sequence[np.ndarray]) -> np.ndarray:
    """Return the residuals (n,) of a second fit, which is weighted by the inverse standard deviations (first-order
    estimate).

    In the first fit, the values with large noise shift the model. So all residuals of the values with small noise may
    have the same sign, and exceed their noise. Therefore the standard deviations of the groups are estimated again from
    the second fit, up to `_ROUNDS` times.

    Args:
        J, r: see `uneven_root`. They belong to the first fit, with equal weights.
        sizes: first estimate of the standard deviations (n,).
        groups: for each pair of groups of residuals, the argument `group` of `grouped_sizes`.
    """
    if not _well_conditioned(J):
        return r
    columns, left = J / np.linalg.norm(J, axis=0), r
    for _ in range(_ROUNDS):
        if np.any(sizes != 1):
            left = r - columns @ (np.linalg.pinv(columns / sizes[:, None]) @ (r / sizes))
        found = [grouped_sizes(columns / sizes[:, None], left / sizes, group) for group in groups]
        if all(own is None for own in found):
            break
        sizes = sizes * np.prod([own for own in found if own is not None], axis=0)
    return left


def sizes_shown(J: np.ndarray, r: np.ndarray, scales: np.ndarray) -> np.ndarray | None:
    """Return the standard deviations (2m,) of the residuals of m values of G' and of m values of G'', if the residuals
    show that these standard deviations differ. Returns None if they may be equal.

    There are two alternatives to equal noise. G' and G'' may have relative noise of different size (`grouped_sizes`).
    Or the noise of all values may have one size in Pa, for example because of the resolution of the torque.

    Args:
        J, r: see `uneven_root`.
        scales: divisors (2m,) of the residuals [Pa].
    """
    if not _well_conditioned(J) or len(r) <= J.shape[1] + 1:
        return None
    grouped = grouped_sizes(J, r, (np.arange(len(r)) >= len(r) // 2).astype(int))
    if _are_smooth(r):  # a misfit of the model, not noise
        return grouped
    constant = np.median(scales) / scales
    others = [np.ones(len(r))] + ([] if grouped is None else [grouped])
    best, level = probability_of_sizes(J, r, constant)
    if best > max(probability_of_sizes(J, r, own)[0] for own in others) + _LIKELIER:
        return level * constant
    return grouped


def grouped_sizes(J: np.ndarray, r: np.ndarray, group: np.ndarray) -> np.ndarray | None:
    """Return the standard deviation of each residual (n,) if two groups of residuals (for example of G' and G'') have
    noise of different size. Returns None if the difference may be random, or if the data hardly determine some
    combination of the unknowns.

    Args:
        J, r: see `uneven_root`.
        group: group of each residual (n,), 0 or 1. Other residuals have the number -1, and their result is 1.
    """
    if not _well_conditioned(J):
        return None
    scale = np.linalg.norm(J, axis=0)
    leverage = np.einsum("kn,nk->n", np.linalg.pinv(J / scale), J / scale)
    freedom, square = (np.array([v[group == k].sum() for k in (0, 1)]) for v in (1 - leverage, r**2))
    if not (np.all(freedom > 1) and np.all(square > 0)):
        return None
    variance = square / freedom
    large, small = int(np.argmax(variance)), int(np.argmin(variance))
    chance = scipy.special.fdtrc(freedom[large], freedom[small], variance[large] / variance[small])
    if large == small or 2 * chance > _CHANCE:
        return None
    return np.where(group < 0, 1.0, np.sqrt(variance)[group])


def _are_smooth(r: np.ndarray) -> bool:
    """Return whether neighbouring residuals of G', or of G'' (second half of r), are more alike than chance explains.
    Residuals are neighbours if their frequencies are consecutive."""
    first, second = r[: len(r) // 2], r[len(r) // 2 :]
    alike = (first[1:] @ first[:-1] + second[1:] @ second[:-1]) / max(float(r @ r), 1e-300)
    return bool(alike > _ALIKE / np.sqrt(len(r)))


def _well_conditioned(J: np.ndarray) -> bool:
    """Return whether residuals with the derivatives J (n, p) determine all combinations of the p unknowns."""
    scale = np.linalg.norm(J, axis=0)
    if not (np.all(np.isfinite(J)) and np.all(scale > 0)):
        return False
    values = np.linalg.svd(J / scale, compute_uv=False)
    return bool(values[-1] >= _CONDITION * values[0])
