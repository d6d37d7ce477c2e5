"""Correlated noise of neighbouring points in relaxation and creep tests: standard errors, models, posterior."""

import math

import numpy as np
import pytest

from fitting.fits import posterior, time_tests
from fitting.fits.families.springpots_in_time import choose_in_time, choose_together
from fitting.fits.honesty.alike_answers import fitted_by_its_noise, with_alike_noise, with_own_noise
from fitting.fits.honesty.long_times import INTERVAL
from fitting.fits.time_tests import INDEPENDENT
from fitting.methods import time_response, uncertainty
from fitting.methods.estimate import LEAST_FREEDOM
from fitting.methods.generalised_maxwell import Maxwell
from fitting.readers import time_tests as reader
from fitting.readers.base_line import _straight_line, base_line
from fitting.readers.frequency_sweep import Sweep
from fitting.readers.time_tests import TimeTest

G0, RATIOS, TIMES, STRAIN = 1000.0, np.array([0.3, 0.25]), np.array([2.0, 40.0]), 0.05


def _relaxation(time: np.ndarray, noise: np.ndarray) -> TimeTest:
    """A relaxation test with a step at 0 s and two exact modes; `noise` (n,) is relative."""
    G = G0 * (1 - RATIOS.sum() + np.exp(-time[:, None] / TIMES) @ RATIOS)
    at = np.concatenate([[0.0, 1e-7], time])
    strain = np.concatenate([[0.0], np.full(len(time) + 1, STRAIN)])
    return TimeTest("relaxation", at, strain, np.concatenate([[0.0, 0.0], STRAIN * G * (1 + noise)]), at > 1e-6)


def _autoregression(rng: np.random.Generator, n: int, part: float) -> np.ndarray:
    own, out = rng.normal(size=n), np.empty(n)
    out[0] = own[0]
    for k in range(1, n):
        out[k] = part * out[k - 1] + np.sqrt(1 - part**2) * own[k]
    return out


@pytest.mark.ci
def test_errors_of_shared_noise_are_those_of_many_draws():
    """The errors under drifting noise are those of many draws. If the noise were taken as independent, the errors of
    ratios and times would be 2 to 5 times too small.
    """
    time, rng = np.arange(0.1, 300.0, 2.0), np.random.default_rng(0)
    values, before, after = [], [], []
    for _ in range(16):
        fit = time_tests.fit(_relaxation(time, 0.01 * _autoregression(rng, len(time), 0.9)), modes=2)
        wide = with_alike_noise(fit)
        assert INDEPENDENT in wide.details and "noise of neighbouring values is correlated" in wide.warnings[-1]
        values.append(fit.uncertainty.values)
        before.append(fit.uncertainty.standard_errors)
        after.append(wide.uncertainty.standard_errors)
    scatter = np.std(values, axis=0)
    assert np.all((np.median(before, axis=0) < 0.7 * scatter)[1:])
    # The scatter of 16 draws has an error of 18 %; the correlation length of the noise is known only roughly.
    assert np.all(np.median(after, axis=0) > 0.6 * scatter) and np.all(np.median(after, axis=0) < 2.5 * scatter)


def test_few_independent_values_have_three_degrees_of_freedom():
    """The quantile of such a test was 12.7, and that of a sweep 3.2."""
    noise = 0.01 * _autoregression(np.random.default_rng(0), 40, 0.97)
    fit = with_alike_noise(time_tests.fit(_relaxation(np.linspace(0.1, 300, 40), noise), modes=2))
    assert fit.details[INDEPENDENT] < 5 and fit.uncertainty.freedom == LEAST_FREEDOM


def test_a_dashpot_leaves_the_other_errors_those_of_correlated_noise():
    """The error of an exponent at its bound is infinite. The noise then counted as independent: 3042 ± 9 Pa s was found
    for the dashpot of 3000 Pa s, without a word on the correlated noise.
    """
    time = np.geomspace(0.1, 600, 80)
    creep = time / 3000 + time**0.3 / (300 * math.gamma(1.3))
    strain = 10 * creep * (1 + 0.01 * _autoregression(np.random.default_rng(3), 80, 0.85))
    at = np.concatenate([[0.0, 1e-7], time])
    stress = np.concatenate([[0.0], np.full(81, 10.0)])
    fit = choose_in_time(TimeTest("creep", at, stress, np.concatenate([[0.0, 0.0], strain]), at > 1e-6), "fractional")
    own = fit.parameters
    assert own.names[:2] == ("slow_springpot", "slow_exponent") and own.standard_errors[1] == np.inf
    assert INDEPENDENT in fit.details and any("neighbouring values is correlated" in w for w in fit.warnings)
    assert abs(own.values[0] - 3000) < 2 * own.standard_errors[0] < 600


def test_white_noise_changes_nothing():
    """White noise is also in the scales of the residuals, and must not be taken for a correlation."""
    rng = np.random.default_rng(1)
    for time in (np.geomspace(0.1, 600, 120), np.arange(0.1, 300.0, 1.0)):
        fit = time_tests.fit(_relaxation(time, 0.01 * rng.normal(size=len(time))), modes=2)
        assert with_alike_noise(fit) is fit
    assert with_alike_noise(exact := time_tests.fit(_relaxation(time, 0.0 * time), modes=2)) is exact


@pytest.mark.parametrize("model", ["prony", pytest.param("fractional", marks=pytest.mark.slow)])
def test_the_posterior_counts_independent_answers(model, monkeypatch):
    """The log likelihood is that of fewer points, so the posterior intervals are as wide as the standard errors."""
    time, rng = np.geomspace(0.1, 600, 100), np.random.default_rng(2)
    test = _relaxation(time, 0.01 * _autoregression(rng, len(time), 0.9))
    fit = choose_in_time(test, model, 2 if model == "prony" else "auto")
    assert fit.details[INDEPENDENT] < 40
    seen = []
    monkeypatch.setattr(posterior, "sample", lambda own, *rest: seen.append(own))
    for each in (fit, fit._replace(details={})):
        posterior.of_time_test(each, test, 10)
    u = np.asarray(fit.solution.u)[None] + 0.01 * rng.normal(size=(3, len(fit.solution.u)))
    few, all_of_them = (own.log_likelihood(u) for own in seen)
    assert np.allclose(few, all_of_them * fit.details[INDEPENDENT] / len(time), rtol=1e-12)
    own = fit.parameters or fit.uncertainty
    assert np.all(np.isfinite(own.standard_errors)) and own.freedom < 40


@pytest.mark.slow
def test_a_spectrum_keeps_its_own_errors():
    time, rng = np.geomspace(0.1, 600, 100), np.random.default_rng(2)
    fit = choose_in_time(_relaxation(time, 0.01 * _autoregression(rng, len(time), 0.9)), "spectrum")
    assert with_alike_noise(fit) is fit and INDEPENDENT not in fit.details


def test_noise_of_constant_size_is_neither_shared_nor_in_proportion():
    """Such noise is small relative to early values and large relative to late ones. It was once taken for a
    correlation, and the errors were 25 times too large.
    """
    time, values, errors = np.geomspace(0.1, 300, 100), [], []
    for seed in range(12):
        rng = np.random.default_rng(seed)
        test = _relaxation(time, np.zeros(100))
        noisy = test.answer + np.where(test.used, 1e-4 * G0 * rng.normal(size=len(test.answer)), 0.0)
        fit = with_alike_noise(time_tests.fit(test._replace(answer=noisy), modes=2))
        assert INDEPENDENT not in fit.details
        values.append(fit.uncertainty.values)
        errors.append(fit.uncertainty.standard_errors)
    ratio = np.median(errors, axis=0) / np.std(values, axis=0)
    assert np.all((ratio > 0.6) & (ratio < 1.7)), ratio  # the scatter of 12 draws has an error of 21 %


@pytest.mark.slow
def test_noise_that_grows_with_time_is_in_the_errors():
    """Without this noise in the errors, the interval of G_inf contained the truth in 16 of 20 draws. Now the errors are
    at most 1.3 times too small.
    """
    time = np.concatenate([[0.0], np.arange(0.5, 100.1, 0.5)])
    G = 400 + 300 * np.exp(-time) + 300 * np.exp(-time / 20)
    off = {with_own_noise: [], with_alike_noise: []}
    for seed in range(16):
        noise = np.random.default_rng(seed).standard_normal(len(time))
        answer = np.where(time > 0, G * (1 + 0.002 * (1 + time / 10) * noise), np.nan)
        test = TimeTest("relaxation", time, np.ones(len(time)), answer, time > 0)
        fit = time_tests.fit(test, modes=2)
        for errors, found in off.items():
            own = errors(fit).uncertainty
            stays = own.values[0] * (1 - own.values[1:3].sum())
            found.append((stays - 400) / uncertainty.equilibrium_error(own))
    new, old = (float(np.sqrt(np.mean(np.square(found)))) for found in off.values())
    assert new < 1.3 < old


#: Creep for 30 s and recovery for 60 s.
_RECOVERY = np.concatenate(
    [np.linspace(0, 0.1, 3), 0.1 + np.geomspace(0.05, 29.9, 40), 30.1 + np.geomspace(0.05, 60, 40)]
)


def _recovery(noise: np.ndarray) -> TimeTest:
    """Strain of two exact modes under a stress of 50 Pa that ends after 30 s.

    `noise` (n,) is relative to the largest strain.
    """
    stress = np.interp(_RECOVERY, [0, 0.1, 30, 30.1, 1e3], [0, 50, 50, 0, 0])
    strain = np.asarray(time_response.strain_response(Maxwell(G0, RATIOS, TIMES / 4), _RECOVERY, stress))
    return TimeTest("creep", _RECOVERY, stress, strain + noise * strain.max(), _RECOVERY > 0)


def test_noise_of_constant_size_sets_the_weights_of_fit_interval_and_posterior(monkeypatch):
    """With weights proportional to the values, the interval of G_inf was half as wide as its standard error requires,
    and contained the truth in 72 of 100 draws. With a sweep fitted together, the errors were 2.2 times too small.
    """
    test = _recovery(0.005 * np.random.default_rng(0).normal(size=len(_RECOVERY)))
    fit = choose_in_time(test, "prony", 2)
    assert fit.details[time_tests.CONSTANT_NOISE] and np.ptp(fit.scales) == 0
    own, error = fit.details["equilibrium_modulus_interval_95"], uncertainty.equilibrium_error(fit.uncertainty)
    half = (own["high"] - own["low"]) / 2
    assert 0.8 < half / (1.96 * error) < 1.5 and own["low"] < G0 * (1 - RATIOS.sum()) < own["high"]
    seen = []
    monkeypatch.setattr(posterior, "sample", lambda target, *rest: seen.append(target))
    posterior.of_time_test(fit, test, 10)
    # The likelihood has the weights of the fit, so both have the same minimum.
    u = np.asarray(fit.solution.u)
    near = u + 0.003 * np.random.default_rng(1).normal(size=(20, len(u)))
    assert np.all(seen[0].log_likelihood(near) < seen[0].log_likelihood(u[None]))
    # Noise proportional to the values, and exact values, keep their weights.
    clean = _recovery(np.zeros(len(_RECOVERY)))
    some = clean.answer * (1 + 0.01 * np.random.default_rng(2).normal(size=len(_RECOVERY)))
    for other in (clean, clean._replace(answer=some)):
        assert not fitted_by_its_noise(other, 2)[0].constant_noise


def test_white_noise_of_constant_size_is_not_shared_noise():
    """With equal weights the estimated noise contained the residuals, and 100 points counted as one."""
    test = _relaxation(np.geomspace(0.1, 600, 100), np.zeros(100))
    for seed in (0, 1, 3):  # the residuals of seed 2 do not show this kind of noise
        noise = 0.005 * STRAIN * G0 * np.random.default_rng(seed).normal(size=102)
        fit = choose_in_time(test._replace(answer=test.answer + np.where(test.used, noise, 0.0)), "prony", 2)
        assert fit.details[time_tests.CONSTANT_NOISE] and INDEPENDENT not in fit.details


@pytest.mark.slow
def test_noise_of_constant_size_sets_the_weights_beside_a_sweep():
    test = _recovery(0.005 * np.random.default_rng(0).normal(size=len(_RECOVERY)))
    omega = np.geomspace(0.3, 30, 12)
    G = G0 * (
        1 - RATIOS.sum() + (RATIOS * 1j * omega[:, None] * TIMES / 4 / (1 + 1j * omega[:, None] * TIMES / 4)).sum(1)
    )
    noisy = [a * (1 + 0.03 * np.random.default_rng(k).normal(size=12)) for k, a in enumerate((G.real, G.imag))]
    both = choose_together([Sweep(omega, *noisy, source="sweep.csv"), test], "prony", 2)
    assert both.tests[1].constant_noise and both.shares[1].noise < 0.05


@pytest.mark.slow
def test_errors_contain_the_error_of_a_subtracted_offset(tmp_path):
    """Four rows at rest determine the offset of the sensor. Without its error, the equilibrium modulus scattered by 3.5
    standard errors, and a quarter of the intervals contained the truth.
    """
    time, off, inside = np.geomspace(0.1, 300.0, 120), [], []
    exact = np.asarray(_relaxation(time, np.zeros(len(time))).answer[2:])
    for seed in range(12):
        noise = 0.9 * np.random.default_rng(seed).standard_normal(len(time) + 6)
        at = np.concatenate([[0.0, 0.2, 0.4, 0.6, 0.8, 0.8 + 1e-7], 0.8 + time])
        strain = np.concatenate([np.zeros(5), np.full(len(time) + 1, STRAIN)])
        stress = 5.0 + noise + np.concatenate([np.zeros(5), [STRAIN * G0], exact])
        rows = np.delete(np.column_stack([at, strain, stress]), 5, axis=0)
        np.savetxt(tmp_path / "t.csv", rows, delimiter=",", header="time_s,strain,stress_Pa", comments="")
        test = reader.read_time_test(tmp_path / "t.csv", "relaxation", ramp=0.0)
        assert 0.1 < test.offset_error < 1.5
        fit = choose_in_time(test, "prony", 2)
        truth, found = G0 * (1 - RATIOS.sum()), fit.model.shear_modulus * (1 - np.sum(fit.model.ratios))
        off.append((found - truth) / uncertainty.equilibrium_error(fit.uncertainty))
        ends = fit.details[INTERVAL]
        inside.append(ends["low"] <= truth <= ends["high"])
    assert 0.6 < np.sqrt(np.mean(np.square(off))) < 1.6 and np.mean(inside) > 0.8
    # The posterior is as wide as the standard error. Without the error of the offset, it was 3.5 times narrower.
    drawn = posterior.of_time_test(fit, test, 500)
    rest = drawn.draws[..., drawn.names.index("equilibrium_modulus")]
    assert 0.85 < np.std(rest) / uncertainty.equilibrium_error(fit.uncertainty) < 1.2
    # Two such tests together: the errors of their offsets are independent.
    both = choose_together([test, test], "prony", 2)
    one, two = (uncertainty.equilibrium_error(f.uncertainty) for f in (fit, both))
    assert np.isclose(two, one / np.sqrt(2), rtol=0.05)


@pytest.mark.parametrize("case", ["short rest", "settling"])
def test_a_drift_that_may_not_continue_is_not_continued(case):
    """A straight line through such rows would change the last response by 26 or 970 Pa."""
    rng = np.random.default_rng(1)
    if case == "short rest":  # 0.2 s of slow noise, then a hold of 1000 s
        time, end = np.arange(-0.2, 0, 0.01), 1000.0
        answer = 0.1 * np.cumsum(rng.standard_normal(20)) / 4
    else:
        time, end = np.arange(-10.0, 0, 0.5), 160.0
        answer = 2 * np.exp(-(time + 10) / 5)
    found = base_line(time, answer, 50.0, end)
    assert found is None or (found.slope == 0 and abs(found.level - answer.mean()) < 1e-12)
    if case == "settling":
        assert found.left < 0 and found.level_error > 0.5


@pytest.mark.parametrize("end", [100.0, 200.0])
def test_a_clear_drift_is_told_however_large_it_becomes(end):
    """A drift that reaches 40 % of the largest response gave no note, although one of 20 % did."""
    time = np.linspace(-1.1, 0, 12)
    answer = 0.02 * time + 1e-4 * np.random.default_rng(1).standard_normal(12)
    found = base_line(time, answer, 10.0, end)
    assert found.slope == 0 and np.isclose(found.left, 0.02, rtol=0.02)


def test_a_drift_with_a_mean_near_zero_is_not_called_an_offset(tmp_path):
    """The note said that the mean is 0 % of the largest stress, and called it a sensor offset."""
    time = np.arange(0.0, 200.0, 0.5)
    strain = np.where(time > 5.75, 0.1, 0.0)
    stress = strain * (600 + 400 * np.exp(-(time - 6) / 5)) + 0.05 * (time - 2.625)
    stress += 1e-3 * np.random.default_rng(1).standard_normal(len(time))
    table = np.column_stack([time, strain, stress])
    np.savetxt(tmp_path / "t.csv", table, delimiter=",", header="time_s,strain,stress_Pa", comments="")
    (note,) = (n for n in reader.read_time_test(tmp_path / "t.csv", "relaxation").notes if "rows at rest" in n)
    assert "This mean is subtracted. But the stress changes during these rows" in note and "sensor offset" not in note


def test_an_offset_needs_more_than_noise_of_similar_neighbours():
    """The noise was taken as independent. With a correlation of 0.8, offsets that did not exist were found in 32 %."""
    time = np.arange(-2.0, 0, 0.1)
    for part, most in ((0.0, 0.03), (0.8, 0.15)):
        rng = np.random.default_rng(0)
        found = [base_line(time, 0.01 * _autoregression(rng, 20, part), 1.0, 1000.0) for _ in range(500)]
        assert np.mean([line is not None and line.left == line.slope == 0 for line in found]) < most
        lines = [base_line(time, 0.1 + 0.01 * _autoregression(rng, 20, part), 1.0, 1000.0) for _ in range(500)]
        z = [(line.level - 0.1) / line.level_error for line in lines if line.left == line.slope == 0]
        assert 0.8 < np.std(z) < (2.3 if part else 1.2)  # the old errors gave 3.5 and 1.1


def test_errors_of_a_drift_contain_the_correlation_of_few_rows():
    """The correlation of residuals is too small by (2 + 4 r) / n: 81 % of the slopes were within two errors."""
    rng, time = np.random.default_rng(0), np.arange(20) / 20
    lines = [_straight_line(time, _autoregression(rng, 20, 0.6)) for _ in range(2000)]
    assert np.mean([abs(slope) < 2 * error for _, slope, _, error in lines]) > 0.84


def test_the_error_of_equal_rows_at_rest_is_their_rounding(tmp_path):
    """The error of an offset was 0 if the sensor repeated one value."""
    time = np.arange(0.0, 40.0, 0.5)
    strain = np.where(time > 9.75, 0.1, 0.0)
    stress = np.round(0.5 + strain * (600 + 400 * np.exp(-(time - 10) / 5)) * 2) / 2
    table = np.column_stack([time, strain, np.where(strain > 0, stress, 0.5)])
    np.savetxt(tmp_path / "t.csv", table, delimiter=",", header="time_s,strain,stress_Pa", comments="")
    assert np.isclose(reader.read_time_test(tmp_path / "t.csv", "relaxation").offset_error, 0.5 / np.sqrt(12))


@pytest.mark.ci
@pytest.mark.parametrize("rate", [0.01, pytest.param(-0.01, marks=pytest.mark.slow)])
def test_a_drift_of_the_sensor_is_subtracted(rate, tmp_path):
    """The mean of the rows before the load was subtracted as an offset, although the sensor drifted. The equilibrium
    modulus was then wrong by 2.8 standard errors.
    """
    time = np.geomspace(0.1, 160.0, 200)
    exact = np.asarray(_relaxation(time, np.zeros(len(time))).answer[2:])
    before = np.arange(0.0, 100.0, 0.5)
    at = np.concatenate([before, [100.0], 100.0 + time])
    strain = np.concatenate([np.zeros(len(before) + 1), np.full(len(time), STRAIN)])
    noise = 0.2 * np.random.default_rng(5).standard_normal(len(at))
    stress = np.concatenate([np.zeros(len(before) + 1), exact]) + rate * at + noise
    np.savetxt(
        tmp_path / "t.csv", np.column_stack([at, strain, stress]), delimiter=",", header="time_s,strain,stress_Pa"
    )
    test = reader.read_time_test(tmp_path / "t.csv", "relaxation", ramp=0.0)
    assert any("the sensor drifts" in note for note in test.notes)
    left = test.answer[test.used] - exact
    # The standard error of the line at 160 s after the load: 0.2 / sqrt(200) * sqrt(1 + 3 * 4.2^2) = 0.1.
    assert np.abs(left - noise[len(before) + 1 :]).max() < 0.4
    assert np.isclose(test.drift_error, 0.005, rtol=0.1)
    fit = choose_in_time(test, "prony", 2)
    truth, found = G0 * (1 - RATIOS.sum()), fit.model.shear_modulus * (1 - np.sum(fit.model.ratios))
    error = uncertainty.equilibrium_error(fit.uncertainty)
    assert abs(found - truth) < 2 * error
    # The posterior contains the error of the drift as well (without it, the ratio is 0.15). It is narrower than the
    # standard error, because a steady drift differs from relaxation.
    drawn = posterior.of_time_test(fit, test, 500)
    rest = drawn.draws[..., drawn.names.index("equilibrium_modulus")]
    assert 0.4 < np.std(rest) / error < 1.25
