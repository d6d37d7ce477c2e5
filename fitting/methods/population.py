"""One parameter of several samples: its mean, its spread between samples, and the interval for a new sample.

The logarithm y_i of the parameter of sample i is normally distributed: y_i ~ N(mu, s^2 + e_i^2). Here, mu is the mean,
s the standard deviation between samples (the spread) and e_i the error of y_i. The spread s is estimated by restricted
maximum likelihood. The interval of mu follows Hartung and Knapp (2001), Statistics in Medicine 20. The interval of a
new sample uses Student's t with n - 1 degrees of freedom. This interval is exact if the errors e_i are small. (Higgins,
Thompson and Spiegelhalter (2009), J. R. Stat. Soc. A 172, use n - 2.) If the errors e_i are so large that s is
uncertain, a second interval is computed as an average over all possible s. Then the interval of a new sample is
extended until it contains both intervals.

The values of the samples are moved towards the mean (shrinkage). Few samples determine s poorly, so the moved values
are averages over all possible s. The weight of each s is the restricted likelihood times a half-Cauchy prior of scale 1
(Gelman 2006, Bayesian Analysis 1, 515). The standard deviations of the moved values contain the errors of s and mu. The
interval of Hartung and Knapp is too narrow if a few samples have most of the weight. Then both intervals are extended
until they contain the intervals that are averaged over all possible s.
"""

from typing import NamedTuple

import numpy as np
import scipy.optimize
import scipy.stats

from liverjax.core.errors import InputError

#: The interval of Hartung and Knapp is too narrow if the effective number of samples, divided by the real number, is
#: below this value.
EVEN = 0.8
#: If the mean variance of the errors, divided by the variance between samples, exceeds this value, the estimated
#: variance between samples is not reliable.
UNSURE = 0.25
#: A sample is not part of the population if its data do not determine its value, and the fitted value is below this
#: fraction of the mean.
BELOW = 1e-3
#: A value with an additive error is near 0 if it is below three times its error, and below this fraction of the median.
NEAR_ZERO = 0.1
#: A value near 0 is part of the population only if it may be larger than `NEAR_ZERO` times the median (within two
#: errors), or if its error, divided by the median, exceeds this value.
MAY_BE_ZERO = 0.2
#: A value with an additive error is certainly above 0 if it exceeds this number of standard errors.
ABOVE_ZERO = 3.0
#: Values with additive errors are together compatible with 0 if their weighted sum exceeds the sum that is expected
#: from errors alone by less than this number of standard deviations (`_compatible_with_zero`).
ZERO_BY_CHANCE = 2.0
#: Largest number of rounds in which the moved values and the population are computed in turn.
ROUNDS_OF_MOVING = 50


class Population(NamedTuple):
    """The population of one positive parameter, with 95 % intervals."""

    mean: float  # geometric mean
    spread: float  # standard deviation of the logarithms between samples
    mean_interval: tuple[float, float]
    new_interval: tuple[float, float]  # interval of a new sample
    pooled: np.ndarray  # (n,) values of the samples, moved towards the mean; NaN: see `BELOW`, `NEAR_ZERO`
    pooled_errors: np.ndarray  # (n,) standard deviations of the logarithms of `pooled`
    mean_error: float  # standard error of the logarithm of the mean: half of `mean_interval` over Student's quantile


def population(values: np.ndarray, errors: np.ndarray, additive: bool = False) -> Population | None:
    """Estimate mean and spread of the population from values (n,), which are not negative, with standard errors (n,).
    Returns None if fewer than two values are determined. `additive`: the errors do not grow with the values, and a
    value may be 0 (`_as_logarithms`). Then the result is also None if all values together are compatible with 0."""
    values, errors = np.asarray(values, float), np.asarray(errors, float)
    if values.ndim != 1 or values.shape != errors.shape or np.any(errors < 0):
        raise InputError(
            f"values have the shape {values.shape} and errors the shape {errors.shape}: give values (n,), and for each "
            "value one error, 0 or more"
        )
    known = (values > 0) & np.isfinite(values) & np.isfinite(errors) & (errors < 10 * values)
    if known.sum() < 2:
        return None
    unsure = ~known
    if additive:
        unsure &= ~np.isfinite(errors)
        errors = _with_errors_of_zeros(values, errors, known)
        known = (values >= 0) & np.isfinite(values) & np.isfinite(errors)
        if known.sum() < 2 or _compatible_with_zero(values[known], errors[known]):
            return None
        y, v = _as_logarithms(values[known], errors[known])
    else:
        y, v = np.log(values[known]), np.maximum((errors / values)[known] ** 2, 1e-24)
    variance = _variance_between(y, v)
    mean, sd = _weighted_mean(y, v, variance)
    n = len(y)
    quantile = float(scipy.stats.t.ppf(0.975, n - 1))
    half, half_new = quantile * sd, quantile * float(np.hypot(np.sqrt(variance), sd))
    intervals = (mean - half, mean + half), (mean - half_new, mean + half_new)
    over = _over_spreads(y, v)
    w = 1 / (v + variance)
    if np.sum(w) ** 2 / np.sum(w**2) < EVEN * n:
        intervals = _hull(intervals[0], over.interval(0.0)), _hull(intervals[1], over.interval(1.0))
    elif np.mean(v) > UNSURE * variance:
        intervals = intervals[0], _hull(intervals[1], over.interval(1.0))
    pooled, pooled_errors = np.full((2, len(values)), np.nan)
    # A sample whose data do not determine its value is treated like a new sample. But if this value is far below the
    # mean, the sample is of another material and is excluded.
    silent = unsure & ~known & (values > BELOW * np.exp(mean))
    pooled[silent], pooled_errors[silent] = over.moved(np.zeros(silent.sum()), np.full(silent.sum(), 1e12))
    pooled[known], pooled_errors[known] = over.moved(y, v)
    mean_interval, new_interval = ((float(np.exp(a)), float(np.exp(b))) for a, b in intervals)
    return Population(
        mean=float(np.exp(mean)),
        spread=float(np.sqrt(variance)),
        mean_interval=mean_interval,
        new_interval=new_interval,
        pooled=np.exp(pooled),
        pooled_errors=pooled_errors,
        mean_error=(intervals[0][1] - intervals[0][0]) / (2 * quantile),
    )


def _compatible_with_zero(values: np.ndarray, errors: np.ndarray) -> bool:
    """Return whether the values (n,) may all be 0 except for their errors. Negative values were replaced by 0. So each
    value has the distribution of max(0, e z), where e is the error and z is a standard normal variable."""
    errors = np.maximum(errors, 1e-300)
    if np.any(values > ABOVE_ZERO * errors):
        return False
    mean = 1 / np.sqrt(2 * np.pi)  # of max(0, z)
    excess = np.sum((values / errors - mean) / errors)
    return bool(excess < ZERO_BY_CHANCE * np.sqrt((0.5 - mean**2) * np.sum(errors**-2.0)))


def _with_errors_of_zeros(values: np.ndarray, errors: np.ndarray, known: np.ndarray) -> np.ndarray:
    """Return the errors (n,) of values with additive errors. The error is infinite if a value is not used.

    A value of 0 without a finite error gets the median error of the values that are `known`. A value near 0 is used
    only if its error is so large that a sample of this population may have this value. Otherwise, the sample is of
    another material."""
    clear = known & (values > 2 * errors)
    typical = min(np.median(values[part]) for part in (known, clear) if part.any())
    of_zero = np.where(values <= BELOW * typical, np.median(errors[known]), np.inf)
    own = np.where(np.isfinite(errors), errors, of_zero)
    away = known & (values > np.minimum(3 * errors, NEAR_ZERO * typical))
    possible = (own > MAY_BE_ZERO * typical) | (known & (values + 2 * own > NEAR_ZERO * typical))
    return np.where(away | possible, own, np.inf)


def _as_logarithms(values: np.ndarray, errors: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return logarithms (n,) and their error variances (n,) for values with errors that do not grow with the values.

    The error of log(x) is e / x. With the measured x, a value that is too high by chance would get too much weight. So
    the logarithm is linearised at the moved value m of the sample: log(m) + (x - m) / m has the error e / m. This also
    holds for x = 0. The moved values follow from the population, so both are computed in turn."""
    at = np.log(np.maximum(values, np.median(values[values > 0])))
    for _ in range(ROUNDS_OF_MOVING):
        m = np.exp(at)
        y, v = at + (values - m) / m, np.maximum((errors / m) ** 2, 1e-24)
        variance = _variance_between(y, v)
        mean, _ = _weighted_mean(y, v, variance)
        step = mean + variance / (variance + v) * (y - mean) - at
        if np.max(np.abs(step)) < 1e-6:
            break
        at = at + step / 2  # with whole steps, the iteration may alternate between two populations
    return y, v


def _hull(a: tuple[float, float], b: tuple[float, float]) -> tuple[float, float]:
    return min(a[0], b[0]), max(a[1], b[1])


class _Spreads(NamedTuple):
    """K possible spreads s (K,) with their weights, and for each spread the mean and the variance of this mean."""

    s: np.ndarray
    weight: np.ndarray
    mean: np.ndarray
    variance: np.ndarray

    def moved(self, y: np.ndarray, v: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the values y (n,) with error variances v (n,), moved towards the mean, and the standard deviations of
        the moved values."""
        trust = self.s[:, None] ** 2 / (self.s[:, None] ** 2 + v)
        at = self.mean[:, None] + trust * (y - self.mean[:, None])
        variances = trust * v + (1 - trust) ** 2 * self.variance[:, None]
        middle = self.weight @ at
        return middle, np.sqrt(self.weight @ (variances + (at - middle) ** 2))

    def interval(self, share: float) -> tuple[float, float]:
        """Return the 95 % interval of the mean. `share`: fraction of the variance between samples that is added to the
        variance of the mean; 1 gives the interval of a new sample."""
        sd = np.sqrt(self.variance + share * self.s**2)
        ends = float(np.min(self.mean - 40 * sd)), float(np.max(self.mean + 40 * sd))

        def quantile(q: float) -> float:
            return float(
                scipy.optimize.brentq(lambda x: self.weight @ scipy.stats.norm.cdf((x - self.mean) / sd) - q, *ends)
            )

        return quantile(0.025), quantile(0.975)


def _over_spreads(y: np.ndarray, v: np.ndarray) -> _Spreads:
    """Return a grid of standard deviations s between samples. The weight of each s is the restricted likelihood times
    the prior."""
    size = float(np.sqrt(np.var(y) + np.mean(v)))
    s = np.concatenate([[0.0], np.geomspace(1e-4 * size, max(100 * size, 30.0), 400)])
    w = 1 / (v + s[:, None] ** 2)
    total = np.sum(w, axis=1)
    mean = np.sum(w * y, axis=1) / total
    log = -0.5 * (np.sum(w * (y - mean[:, None]) ** 2 - np.log(w), axis=1) + np.log(total))
    weight = np.exp(log - log.max()) / (1 + s**2) * np.gradient(s)
    return _Spreads(s, weight / weight.sum(), mean, 1 / total)


def _variance_between(y: np.ndarray, v: np.ndarray) -> float:
    """Return the variance between samples with the highest restricted likelihood."""
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
    """Return the weighted mean and its standard error. The standard error comes from the scatter of the values. It is
    at least as large as the standard error that follows from the variances `v` and `variance`."""
    w = 1 / (v + variance)
    mean = float(np.sum(w * y) / np.sum(w))
    q = float(np.sum(w * (y - mean) ** 2) / (len(y) - 1))
    return mean, float(np.sqrt(max(q, 1.0) / np.sum(w)))
