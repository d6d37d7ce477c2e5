"""Noise, sizes and single wrong values of series: estimates against known noise, and series without wrong values."""

import numpy as np
import pytest

from fitting.fits import time_tests
from fitting.readers.noise_of_series import (
    far_values,
    noise_of_series,
    off_the_line,
    sizes_of_series,
    smooth_sizes,
    told_of_far_values,
)
from fitting.readers.time_tests import TimeTest, read_time_test

pytestmark = pytest.mark.quick_to_compile
TIME = np.geomspace(0.01, 100, 60)
MODULUS = 780 + 1040 * np.exp(-TIME / 12) + 780 * np.exp(-TIME / 0.8)


def test_the_noise_of_a_smooth_series_is_found():
    smooth = np.interp(np.linspace(0, 100, 400), TIME, MODULUS)
    found = noise_of_series(smooth + 5 * np.random.default_rng(0).normal(size=400))
    assert 4 < found < 6  # the median of 400 values has a standard deviation of 7 %, counting their correlation


@pytest.mark.parametrize("value", [0.0, 500.0, 20000.0, -2000.0])
@pytest.mark.parametrize("row", [2, 30, 57])
def test_a_single_wrong_value_is_found(value, row):
    noisy = MODULUS * (1 + 0.003 * np.random.default_rng(1).normal(size=60))
    assert far_values(noisy).size == 0
    noisy[row] = value
    assert far_values(noisy).tolist() == [row]


def test_true_courses_have_no_wrong_values():
    triangle = np.abs((np.linspace(0, 5, 101) + 1) % 2 - 1)
    steps = np.repeat([0.0, 1.0, 0.4, 2.0], 8)
    one_peak = np.concatenate([np.linspace(0, 1, 6), 0.7 + 0.3 * np.exp(-np.linspace(0.3, 3, 9))])
    for series in (triangle, steps, one_peak, np.sin(np.linspace(0, 20, 60)), MODULUS[::10]):
        assert far_values(series).size == 0
        assert np.all(sizes_of_series(series) >= np.abs(series))
    assert np.array_equal(sizes_of_series(steps), steps)


def test_a_wrong_value_of_a_rising_curve_is_found():
    """The neighbours of a row in a stress-stretch curve differ much, so it is compared with the line between them."""
    stretch, missed = np.linspace(1, 1.4, 30), []
    for seed in range(100):
        rng = np.random.default_rng(seed)
        stress = (stretch - stretch**-2) * np.exp(2 * stretch) * (1 + 0.02 * rng.standard_normal(30))
        assert off_the_line(stress).size == 0
        row = int(rng.integers(15, 27))
        stress[row] *= rng.choice([0.1, 10.0])
        missed.append(off_the_line(stress).tolist() != [row])
    assert sum(missed) <= 5
    triangle = np.abs((np.linspace(0, 5, 101) + 1) % 2 - 1)
    for series in (triangle, np.repeat([0.0, 1.0, 0.4, 2.0], 8), np.sin(np.linspace(0, 20, 60)), np.zeros(20)):
        assert off_the_line(series).size == 0


def test_a_peak_at_a_change_of_the_load_is_no_fault():
    """The response to a second step may relax within one row."""
    load, answer = np.repeat([1.0, 2.0], 10), np.full(20, 1.0)
    answer[10] = 50.0
    assert far_values(answer).tolist() == [10]
    assert told_of_far_values(np.arange(20.0), load, answer) == []
    assert len(told_of_far_values(np.arange(20.0), np.ones(20), answer)) == 1
    assert np.array_equal(sizes_of_series(np.array([0.0, 90.0, 80.0, 70.0])), [90.0, 90.0, 80.0, 70.0])


@pytest.mark.parametrize("value", [0.0, 100.0])
def test_a_row_near_zero_does_not_rule_a_fit(tmp_path, value):
    """The low value had more than 100 times the weight of its neighbours: G_inf was 400 Pa instead of 780 Pa."""
    answer = MODULUS * (1 + 0.003 * np.random.default_rng(2).normal(size=60))
    answer[30] = value
    rows = [f"{t:.7g},{g:.7g}" for t, g in zip(TIME, answer, strict=True)]
    (tmp_path / "r.csv").write_text("\n".join(["time [s],G(t) [Pa]", *rows]))
    test = read_time_test(tmp_path / "r.csv", "relaxation", ramp=0.0)
    assert any(f"the response {value:g} at {TIME[30]:.4g} s is far from its neighbours" in note for note in test.notes)
    model = time_tests.fit(test).model
    assert abs(model.equilibrium_modulus - 780) < 0.05 * 780 and abs(model.shear_modulus - 2600) < 0.05 * 2600


@pytest.mark.ci
def test_rounding_is_found_although_a_drift_is_subtracted(tmp_path):
    """After the drift was subtracted, no rows had the same response, so the rounding error was taken as 0. The tiny
    responses then ruled the fit: G0 was 417 Pa instead of 500 Pa, and the mean relative error was 71 %."""
    t = np.linspace(-12, 30, 421)
    since = np.clip(t, 0, None)
    stress = np.where(t > -1e-3, 6 * np.exp(-since / 0.5) + 4 * np.exp(-since / 3), 0) + 0.03 * (t + 12)
    rows = np.column_stack([t + 12, 0.02 * (t > -1e-3), 0.1 * np.round(stress / 0.1)])
    np.savetxt(tmp_path / "r.csv", rows, "%.9g", ",", header="time_s,strain,stress_Pa", comments="")
    test = read_time_test(tmp_path / "r.csv", "relaxation", ramp=0.0)
    assert any("the sensor drifts" in note for note in test.notes)
    assert np.isclose(test.rounding, 0.1 / np.sqrt(12))
    fit = time_tests.fit(test)
    assert abs(fit.model.shear_modulus - 500) < 10
    assert fit.relative_errors.mean() < 0.1


def test_values_that_are_low_by_chance_have_no_larger_weight():
    """The scales of a test in time were the measured values. So G0 was too low by 0.08 % for noise of 2 %, which is 0.3
    to 0.4 standard errors for 300 values.
    """
    time = np.geomspace(0.01, 100, 200)
    truth, off = 400 + 600 * np.exp(-time), []
    for seed in range(100):
        answer = truth * (1 + 0.02 * np.random.default_rng(seed).standard_normal(200))
        scales = TimeTest("relaxation", time, np.ones(200), answer, np.ones(200, bool)).scales
        # The factor of the truth that fits best, with these scales and with the true sizes.
        off.append(np.sum(answer * truth / scales**2) / np.sum((truth / scales) ** 2) - np.mean(answer / truth))
    assert abs(np.mean(off)) < 1.5e-4  # it was 5e-4


def test_smooth_sizes_keep_jumps():
    steps = np.repeat([10.0, 100.0, 1.0], 20)
    assert np.all(np.abs(smooth_sizes(steps) / steps - 1) <= 0.2)
    assert np.array_equal(smooth_sizes(steps[15:25]), steps[15:25])  # too few values
