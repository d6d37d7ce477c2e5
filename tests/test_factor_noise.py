"""Factors that series have of their own: errors of linear fits that hold, and no alarm without factors."""

import numpy as np
import pytest
import scipy.stats

from fitting.methods.noise.factor_noise import factors_of_series

X = np.concatenate([np.linspace(0.0, 1.0, 20), np.linspace(0.2, 0.8, 15), np.linspace(-0.5, 0.9, 17)])
COUNTS, TRUE = [20, 15, 17], np.array([3.0, 2.0, -1.0])


def fitted_once(factor: float, noise: float, seed: int):
    """Residuals, derivatives and found numbers of a parabola, by least squares."""
    rng = np.random.default_rng(seed)
    J = np.vander(X, 3, increasing=True)
    y = (J @ TRUE) * np.repeat(1 + factor * rng.standard_normal(3), COUNTS) + noise * rng.standard_normal(len(X))
    found = np.linalg.pinv(J) @ y
    return J, J @ found - y, found


@pytest.mark.parametrize("noise", [0.01, 0.03])
def test_errors_contain_factors(noise):
    """Errors of independent noise held 30 to 60 % of the 95 % intervals."""
    held, plain = [], []
    for seed in range(200):
        J, r, found = fitted_once(0.03, noise, seed)
        factors, inverse = factors_of_series(COUNTS, J, r, J @ found, np.eye(3)), np.linalg.pinv(J)
        alone = np.sqrt(r @ r / (len(r) - 3)) * np.linalg.norm(inverse, axis=1)
        errors = alone if factors is None else np.maximum(alone, np.linalg.norm(factors.root, axis=1))
        t = scipy.stats.t.ppf(0.975, len(r) - 3)
        held.append(np.abs(found - TRUE) < t * errors)
        plain.append(np.abs(found - TRUE) < t * alone)
    # 200 draws: the binomial spread is 0.015 at 95 %; factors that stay below the noise are not seen.
    assert np.all(np.mean(held, axis=0) > 0.88), np.mean(held, axis=0)
    assert np.mean(plain, axis=0).min() < 0.75


def test_independent_noise_has_no_factors():
    """A gain of 3 is reached by chance in 1 of 140 fits."""
    seen = [
        factors_of_series(COUNTS, J, r, J @ f, np.eye(3)) for J, r, f in (fitted_once(0, 0.02, k) for k in range(200))
    ]
    assert sum(found is not None for found in seen) <= 6


def test_too_few_series_or_points_say_nothing():
    J, r, found = fitted_once(0.05, 0.001, 0)
    assert factors_of_series([len(X)], J, r, J @ found, np.eye(3)) is None
    few = slice(0, 5)
    assert factors_of_series([3, 2], J[few], r[few], (J @ found)[few], np.eye(3)) is None
    assert factors_of_series(COUNTS, J * np.nan, r, J @ found, np.eye(3)) is None
