"""One number of several samples: its mean, its spread between samples, and the interval of a new sample.

The logarithm y_i of sample i has the mean mu, a spread s between samples and an error e_i: y_i ~ N(mu, s^2 + e_i^2).
s is estimated by restricted maximum likelihood, the interval of mu after Hartung and Knapp (2001), Statistics in
Medicine 20, the one of a new sample after Higgins, Thompson and Spiegelhalter (2009), J. R. Stat. Soc. A 172.
"""

from typing import NamedTuple

import numpy as np
import scipy.optimize
import scipy.stats


class Population(NamedTuple):
    """The population of one positive number; intervals are of 95 %."""

    mean: float  # geometric
    spread: float  # standard deviation of the logarithms between samples
    mean_interval: tuple[float, float]
    new_interval: tuple[float, float]  # of a further sample
    pooled: np.ndarray  # (n,) values of the samples, moved towards the mean according to their errors
    pooled_errors: np.ndarray  # (n,) standard deviations of their logarithms


def population(values: np.ndarray, errors: np.ndarray) -> Population | None:
    """Mean and spread of positive values (n,) with standard errors (n,); None if the data determine fewer than two."""
    values, errors = np.asarray(values, float), np.asarray(errors, float)
    known = (values > 0) & np.isfinite(values) & np.isfinite(errors) & (errors < 10 * values)
    if known.sum() < 2:
        return None
    y, v = np.log(values[known]), np.maximum((errors / values)[known] ** 2, 1e-24)
    variance = _variance_between(y, v)
    mean, sd = _weighted_mean(y, v, variance)
    n = len(y)
    half = float(scipy.stats.t.ppf(0.975, n - 1)) * sd
    half_new = float(scipy.stats.t.ppf(0.975, max(1, n - 2))) * float(np.hypot(np.sqrt(variance), sd))
    pooled, pooled_errors = np.full(len(values), mean), np.full(len(values), np.sqrt(variance))
    trust = variance / (variance + v)
    pooled[known], pooled_errors[known] = mean + trust * (y - mean), np.sqrt(trust * v)
    return Population(
        mean=float(np.exp(mean)),
        spread=float(np.sqrt(variance)),
        mean_interval=(float(np.exp(mean - half)), float(np.exp(mean + half))),
        new_interval=(float(np.exp(mean - half_new)), float(np.exp(mean + half_new))),
        pooled=np.exp(pooled),
        pooled_errors=pooled_errors,
    )


def _variance_between(y: np.ndarray, v: np.ndarray) -> float:
    """Variance between samples at the largest restricted likelihood."""
    top = 10 * float(np.var(y, ddof=1)) + 1e-24

    def minus(variance):
        w = 1 / (v + variance)
        mean = np.sum(w * y) / np.sum(w)
        return 0.5 * (np.sum(w * (y - mean) ** 2) - np.sum(np.log(w)) + np.log(np.sum(w)))

    grid = np.concatenate([[0.0], np.geomspace(1e-6 * top, top, 60)])
    k = int(np.argmin([minus(g) for g in grid]))
    if k == 0:
        return 0.0
    ends = grid[k - 1], grid[min(k + 1, len(grid) - 1)]
    return float(scipy.optimize.minimize_scalar(minus, bounds=ends, method="bounded", options={"xatol": 1e-9 * top}).x)


def _weighted_mean(y: np.ndarray, v: np.ndarray, variance: float) -> tuple[float, float]:
    """Weighted mean and its standard error from the scatter, but not below that from the errors."""
    w = 1 / (v + variance)
    mean = float(np.sum(w * y) / np.sum(w))
    q = float(np.sum(w * (y - mean) ** 2) / (len(y) - 1))
    return mean, float(np.sqrt(max(q, 1.0) / np.sum(w)))
