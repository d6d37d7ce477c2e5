"""Individual factors of series in linear fits: correct errors with factors, and no alarm without factors."""

import numpy as np
import pytest
import scipy.stats

from fitting.methods.noise.factor_noise import factors_of_series

X = np.concatenate([np.linspace(0.0, 1.0, 20), np.linspace(0.2, 0.8, 15), np.linspace(-0.5, 0.9, 17)])
COUNTS, TRUE = [20, 15, 17], np.array([3.0, 2.0, -1.0])


def fitted_once(factor: float, noise: float, seed: int):
    """Return derivatives, residuals and fitted coefficients of a parabola, by least squares."""
    rng = np.random.default_rng(seed)
    J = np.vander(X, 3, increasing=True)
    y = (J @ TRUE) * np.repeat(1 + factor * rng.standard_normal(3), COUNTS) + noise * rng.standard_normal(len(X))
    found = np.linalg.pinv(J) @ y
    return J, J @ found - y, found


@pytest.mark.parametrize("noise", [0.01, 0.03])
def test_errors_contain_factors(noise):
    """With errors of independent noise, only 30 to 60 % of the 95 % intervals contained the truth."""
    held, plain = [], []
    for seed in range(200):
        J, r, found = fitted_once(0.03, noise, seed)
        factors, inverse = factors_of_series(COUNTS, J, r, J @ found, np.eye(3)), np.linalg.pinv(J)
        alone = np.sqrt(r @ r / (len(r) - 3)) * np.linalg.norm(inverse, axis=1)
        errors = np.maximum(alone, np.linalg.norm(factors.root, axis=1))
        t = scipy.stats.t.ppf(0.975, len(r) - 3)
        held.append(np.abs(found - TRUE) < t * errors)
        plain.append(np.abs(found - TRUE) < t * alone)
    # 200 draws: the binomial standard deviation is 0.015 at 95 %.
    assert np.all(np.mean(held, axis=0) > 0.91), np.mean(held, axis=0)
    assert np.mean(plain, axis=0).min() < 0.75


def test_independent_noise_has_no_factors():
    """By chance, 1 of 140 fits gains a factor of 3."""
    seen = [
        factors_of_series(COUNTS, J, r, J @ f, np.eye(3)) for J, r, f in (fitted_once(0, 0.02, k) for k in range(200))
    ]
    assert sum(found.shown for found in seen) <= 6
    plain = [np.linalg.norm(np.linalg.pinv(fitted_once(0, 0.02, 0)[0]), axis=1) * 0.02]
    assert np.all(np.median([np.linalg.norm(f.root, axis=1) for f in seen], axis=0) < 1.3 * plain[0])


def of_two_tests(factor: float, noise: float, seed: int):
    """A law with two parameters, measured by two different tests. The parameters can absorb the factors of the
    tests.
    """
    rng = np.random.default_rng(seed)
    x = np.linspace(0.05, 0.5, 12)
    J = np.concatenate([np.stack([x, x - 0.5 * x**2], 1), np.stack([2 * x, x + 3 * x**2], 1)])
    true = np.array([300.0, 200.0])
    y = J @ true
    y = y * np.repeat(1 + factor * rng.standard_normal(2), 12) + noise * np.abs(y).mean() * rng.standard_normal(24)
    found = np.linalg.pinv(J) @ y
    return J, J @ found - y, found, found - true


@pytest.mark.parametrize("noise", [0.01, 0.03])
def test_factors_that_the_numbers_take_up_are_in_the_errors_or_told(noise):
    """For factors of 10 %, errors of independent noise cover 4 to 17 % of the 95 % intervals. With noise above 3 % the
    residuals show too little, and the fits that miss the truth give a warning.
    """
    held, told = [], []
    for seed in range(200):
        J, r, found, off = of_two_tests(0.1, noise, seed)
        own = factors_of_series([12, 12], J, r, J @ found, np.eye(2))
        alone = np.sqrt(r @ r / 22) * np.linalg.norm(np.linalg.pinv(J), axis=1)
        errors = np.maximum(alone, np.linalg.norm(own.root, axis=1))
        held.append(np.abs(off) < scipy.stats.t.ppf(0.975, 22) * errors)
        told.append(not own.shown and np.any(own.moves > 2 * errors))
        assert own.hidden <= 0.1
    held, told = np.array(held), np.array(told)
    assert np.all(held.mean(axis=0) > 0.7), held.mean(axis=0)
    assert np.mean(~held.all(axis=1) & ~told) < 0.05


def test_two_tests_without_factors_keep_their_errors_and_no_factor_is_claimed():
    """Student's t for one degree of freedom is 12.7. When it was used, errors were 3 times too large on average."""
    growth, claimed = [], 0
    for seed in range(200):
        J, r, found, _ = of_two_tests(0.0, 0.02, seed)
        own = factors_of_series([12, 12], J, r, J @ found, np.eye(2))
        alone = np.sqrt(r @ r / 22) * np.linalg.norm(np.linalg.pinv(J), axis=1)
        growth.append(np.max(np.maximum(alone, np.linalg.norm(own.root, axis=1)) / alone))
        claimed += own.shown
    assert claimed <= 5 and np.median(growth) < 1.2 and np.mean(growth) < 2


def test_factors_that_never_show():
    """Each test has a separate parameter. The factor of the test changes this parameter and no residual."""
    x, none = np.linspace(0.1, 1.0, 10)[:, None], np.zeros((10, 1))
    J = np.block([[x, none], [none, x]])
    y = J @ np.array([2.0, 5.0]) + 0.01 * np.random.default_rng(0).standard_normal(20)
    found = np.linalg.pinv(J) @ y
    own = factors_of_series([10, 10], J, J @ found - y, J @ found, np.eye(2))
    assert not own.shown and own.deviation == 0 and own.hidden == 0.1
    assert np.allclose(own.moves, 0.1 * found, rtol=1e-9)


def test_too_few_series_or_points_say_nothing():
    J, r, found = fitted_once(0.05, 0.001, 0)
    assert factors_of_series([len(X)], J, r, J @ found, np.eye(3)) is None
    few = slice(0, 5)
    assert factors_of_series([3, 2], J[few], r[few], (J @ found)[few], np.eye(3)) is None
    assert factors_of_series(COUNTS, J * np.nan, r, J @ found, np.eye(3)) is None


@pytest.mark.parametrize("repeats", [2, 3])
def test_exact_repeats_add_nothing(repeats):
    """A line that appears twice in a file counts as one measurement. In half of the files, rounding reduced the errors
    to 0.7 of this.
    """
    for seed in range(6):
        rng = np.random.default_rng(seed)
        J = np.vander(np.linspace(0.0, 1.0, 20), 3, increasing=True)
        y, once = J @ TRUE + 0.02 * rng.standard_normal(20), np.linalg.pinv(J)
        r = J @ (once @ y) - y
        errors = np.sqrt(r @ r / 17) * np.linalg.norm(once, axis=1)
        many, of_many = np.repeat(J, repeats, axis=0), np.repeat(r, repeats)
        found = factors_of_series([repeats] * 20, many, of_many, np.ones(20 * repeats), np.eye(3))
        # Deviations are tested on a grid of a fifth of their size. Student's t of 19 degrees of freedom increases them
        # by 7 %.
        assert found.shown
        assert np.all(np.abs(np.linalg.norm(found.root, axis=1) / errors - 1.07) < 0.1)
