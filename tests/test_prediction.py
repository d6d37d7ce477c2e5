"""Tests that a fit predicts although they were not used in the fit."""

import numpy as np
import pytest
from conftest import SHARED

from fitting.__main__ import main
from fitting.fits import viscoelastic
from fitting.master import master_curve, temperature_sweeps
from fitting.methods import generalised_maxwell, time_response
from fitting.methods.generalised_maxwell import Maxwell
from fitting.readers.frequency_sweep import Sweep
from fitting.readers.rheometer import read_sweep
from fitting.readers.time_tests import TimeTest
from fitting.reports import prediction
from fitting.waves import shear_waves
from fitting.waves.dispersion import Dispersion

pytestmark = pytest.mark.quick_to_compile

TRUTH = Maxwell(np.float64(800.0), np.array([0.3, 0.4]), np.array([3.0, 0.1]))
OMEGA, TIME = np.geomspace(0.05, 100, 25), np.geomspace(0.02, 100, 30)


def sweep(noise: float, seed: int) -> Sweep:
    factor = 1 + noise * np.random.default_rng(seed).standard_normal((2, len(OMEGA)))
    G = generalised_maxwell.moduli(TRUTH, OMEGA)
    return Sweep(OMEGA, G[0] * factor[0], G[1] * factor[1])


def relaxation(factor: float = 1.0) -> TimeTest:
    at = np.append(0.0, TIME)
    g, tau = TRUTH.ratios, TRUTH.relaxation_times
    answer = factor * TRUTH.shear_modulus * (1 - (g * (1 - np.exp(-at[:, None] / tau))).sum(axis=1))
    return TimeTest("relaxation", at, np.ones(len(at)), answer, at > 0, source="relaxation.csv")


@pytest.mark.slow
def test_errors_of_the_prediction_cover_the_truth():
    """A relaxation test without noise is predicted from 20 sweeps with 2 %. The intervals contain 95 % of the
    points.
    """
    covered = []
    for seed in range(20):
        s = sweep(0.02, seed)
        found = prediction.predict(viscoelastic.closed_form(s, 2), s.resolved, relaxation())
        assert found.inside.sum() == np.sum((TIME >= 0.01) & (TIME <= 20.0))
        covered.append(found.covered)
    # The points of a sweep are correlated: 20 sweeps count, not 500 points.
    assert 0.8 < np.mean(covered) <= 1.0
    assert found.relative_errors[found.inside].mean() < 0.02


def test_a_test_at_another_temperature_is_shifted_to_the_reference():
    """A sweep at 20 °C was predicted at 40 °C without a note. Its error was 15 %."""
    shift = {"reference_temperature_C": 40.0, "temperatures_C": [20.0, 40.0], "log10_a": [1.0, 0.0]}
    shift["log10_b"] = [0.1, 0.0]
    one = sweep(0.0, 0)._replace(source="a.csv")
    tests = [one._replace(raw={"temperature": np.full(25, 273.15 + T)}) for T in (20.1, 30.0, 41.0)]
    tests, told = master_curve.at_reference([*tests, relaxation()], shift)
    assert np.allclose(tests[0].angular_frequency, 10 * OMEGA) and np.allclose(tests[0].loss, 10**0.1 * one.loss)
    assert told[0].startswith("a.csv: measured at 20.1 °C; its frequencies are multiplied by the shift factor 10")
    assert told[1].startswith("a.csv: measured at 30 °C, but predicted at 40 °C")
    assert all(np.array_equal(own.angular_frequency, OMEGA) for own in tests[1:3])
    assert len(told) == 3 and told[2].startswith("relaxation.csv: its temperature is not known")


def test_a_temperature_in_the_name_of_the_table_counts(tmp_path):
    """Such a sweep was predicted without a shift and without a note."""
    shift = {"reference_temperature_C": 40.0, "temperatures_C": [20.0, 40.0], "log10_a": [1.0, 0.0]}
    shift["log10_b"] = [0.0, 0.0]
    rows = "".join(f"{f}\t{1 + f}\t{f}\n" for f in (1, 2, 3, 4))
    head = "frequency_Hz\tstorage_modulus_Pa\tloss_modulus_Pa\n"
    (tmp_path / "t.txt").write_text(f"[step]\nSweep 20 °C\n{head}{rows}")
    (tmp_path / "u.csv").write_text((head + rows).replace("\t", ","))
    named, unknown = (read_sweep(tmp_path / name) for name in ("t.txt", "u.csv"))
    several = unknown._replace(raw={"temperature": 273.15 + np.array([10.0, 20.0, 60.0, 70.0])})
    tests, told = master_curve.at_reference([named, unknown, several], shift)
    assert np.allclose(tests[0].angular_frequency, 10 * named.angular_frequency)
    assert np.array_equal(tests[2].angular_frequency, several.angular_frequency)
    assert "shift factor 10" in told[0] and "its temperature is not known" in told[1]
    # The mean of these temperatures is 40 °C. The note said: measured at 40 °C, but predicted at 40 °C.
    assert "it has several temperatures (10 to 70 °C)" in told[2] and len(told) == 3


def test_a_drift_is_not_several_temperatures_and_an_ignored_sweep_is_told(tmp_path):
    """A drift of 3 K was told to be several temperatures, and a name with two temperatures too. For an ignored
    temperature, the sentence said that no sweep at this temperature was given."""
    shift = {"reference_temperature_C": 40.0, "temperatures_C": [20.0, 40.0], "log10_a": [1.0, 0.0]}
    shift |= {"log10_b": [0.0, 0.0], "ignored_temperatures_C": [30.0]}
    one = sweep(0.0, 0)._replace(source="a.csv")
    drift, known = (one._replace(raw={"temperature": 273.15 + T}) for T in (np.linspace(20, 23, 25), np.full(25, 30.2)))
    stored = one._replace(table="25 °C batch, stored 4 °C")
    _, told = master_curve.at_reference([drift, stored, known], shift)
    assert "its temperature changes by 3 K (20 to 23 °C)" in told[0] and "constant temperature" in told[0]
    assert "its temperature is not known" in told[1]
    assert "because the sweep at its temperature is ignored" in told[2]
    few = "".join(f"{f},{1 + f},{f},{T}\n" for T, n in ((10, 4), (20, 4), (30, 2)) for f in range(1, n + 1))
    (tmp_path / "m.csv").write_text(f"frequency_Hz,storage_modulus_Pa,loss_modulus_Pa,temperature_C\n{few}")
    data = temperature_sweeps.read_temperatures([tmp_path / "m.csv"])
    assert np.allclose(master_curve.master_curve(data, None).ignored, 303.15)


def test_errors_of_a_sweep_with_deviations_are_relative_to_its_moduli():
    """With stated deviations of 2 %, an error of 10 % is 10 %, not 5."""
    G = np.concatenate(generalised_maxwell.moduli(TRUTH, OMEGA))
    storage, loss = np.split(1.1 * G, 2)
    stiffer = Sweep(OMEGA, storage, loss, 0.02 * storage, 0.02 * loss)
    found = prediction.predict(viscoelastic.closed_form(sweep(0.0, 0), 2), stiffer.resolved, stiffer)
    assert np.allclose(found.relative_errors, 0.1 / 1.1, rtol=1e-5) and np.isclose(found.factor, 1.1)
    assert "within 9.1 % on average" in prediction.sentence(found)


def test_the_interval_of_the_prediction_has_the_quantile_of_the_fit():
    """The interval had 1.96 standard errors of the fit. From four frequencies, it contained 89 % of the truth."""
    one, omega = Maxwell(np.float64(800.0), np.array([0.6]), np.array([1.0])), np.geomspace(0.3, 5, 4)
    noise = 1 + 0.02 * np.random.default_rng(0).standard_normal((2, 4))
    G = generalised_maxwell.moduli(one, omega)
    s = Sweep(omega, G[0] * noise[0], G[1] * noise[1])
    fit = viscoelastic.closed_form(s, 1)
    found = prediction.predict(fit, s.resolved, s)
    assert fit.uncertainty.quantile == pytest.approx(2.571, abs=1e-3)  # 8 values, 3 parameters
    for factor, covered in ((2.5, 1.0), (2.6, 0.0)):
        off = found._replace(measured=found.predicted + factor * found.standard_errors, noise=np.zeros(8))
        assert off.covered == covered


@pytest.mark.ci
def test_a_stiffer_sample_is_a_factor_and_waves_are_predicted_too():
    s = sweep(0.0, 0)
    fit = viscoelastic.closed_form(s, 2)
    found = prediction.predict(fit, s.resolved, relaxation(1.3))
    assert np.isclose(found.factor, 1.3, rtol=1e-6) and "1.3 times the prediction" in prediction.sentence(found)
    c, a = shear_waves.velocity_and_attenuation(*generalised_maxwell.moduli(TRUTH, OMEGA), OMEGA, 1000.0)
    waves = prediction.predict(fit, s.resolved, Dispersion(OMEGA, c, a, 1000.0))
    assert np.allclose(waves.predicted, np.concatenate([c, a]), rtol=1e-6) and waves.inside.all()
    outside = prediction.predict(fit, s.resolved, Dispersion(OMEGA + 1e4, c, None, 1000.0))
    assert "outside the band" in prediction.sentence(outside)
    # The scatter of three values is unknown. It was taken as 0, so none of them was inside the interval.
    few = prediction.predict(fit, s.resolved, Dispersion(OMEGA[:3], 1.03 * c[:3], None, 1000.0))
    assert np.isnan(few.covered) and "on average" in (told := prediction.sentence(few)) and "interval" not in told
    moduli = (1.03 * G[:3] for G in generalised_maxwell.moduli(TRUTH, OMEGA))
    given = Sweep(OMEGA[:3], *moduli, *(0.03 * G[:3] for G in generalised_maxwell.moduli(TRUTH, OMEGA)))
    assert prediction.predict(fit, s.resolved, given).covered == 1.0


def test_three_frequencies_show_the_noise_of_both_moduli():
    """With three values per modulus in the band, the noise was unknown or contained the values outside the band."""
    s, rng = sweep(0.0, 0), np.random.default_rng(0)
    fit = viscoelastic.closed_form(s, 2)
    for omega in (OMEGA[10:13], np.append(OMEGA[10:13], 1e4)):
        noise = []
        for _ in range(30):
            G = generalised_maxwell.moduli(TRUTH, omega) * (1 + 0.03 * rng.standard_normal((2, len(omega))))
            G[:, 3:] *= 2
            found = prediction.predict(fit, s.resolved, Sweep(omega, *G))
            assert 0 <= found.covered <= 1
            noise.append(found.noise * found.scales / found.predicted)
        assert np.isclose(np.sqrt(np.mean(np.array(noise)[:, :3] ** 2)), 0.03, rtol=0.25)


def test_the_error_of_a_noisy_test_is_its_noise():
    """With 10 % of noise, the error was given as about 2 %, because the divisor grew with the noise."""
    test = relaxation()
    noise = 0.1 * np.random.default_rng(1).standard_normal(len(test.time))
    s = sweep(0.0, 0)
    found = prediction.predict(
        viscoelastic.closed_form(s, 2), s.resolved, test._replace(answer=test.answer + 400 * noise)
    )
    off = np.abs(found.predicted / found.measured - 1)[found.inside].mean()
    assert found.relative_errors[found.inside].mean() == pytest.approx(off, rel=0.2) and off > 0.05
    for factor in (0.5, 2.0, 3.0):  # the error of a wrong prediction is relative to the data
        other = s._replace(storage=factor * s.storage, loss=factor * s.loss)
        wrong = prediction.predict(viscoelastic.closed_form(other, 2), s.resolved, relaxation())
        assert wrong.relative_errors[wrong.inside].mean() == pytest.approx(abs(factor - 1), rel=1e-3)
        assert f"{1 / factor:.3g} times the prediction would fit" in prediction.sentence(wrong)
    tail = found._replace(sizes=np.full(len(found.sizes), np.inf))
    assert "in the band have decayed into the noise" in prediction.sentence(tail)


def test_later_times_of_cycles_are_in_the_band_of_the_sweep_but_not_those_of_steps():
    """Times were counted from the first load. So the values of a cyclic test after 20 s did not count, although the
    sweep contained its frequency, and their stress was 1.3 times too large without a sign of it. Then times were
    counted from the last change. So values after a load of 50 s did count, although the sweep resolved only 20 s."""
    time, fit, s = np.arange(0, 60, 0.04), viscoelastic.closed_form(sweep(0.0, 0), 2), sweep(0.0, 0)
    strain = 1 - np.cos(2 * np.pi * time)
    stress = np.asarray(time_response.stress_response(TRUTH, time, strain)) * np.where(time > 25, 1.3, 1.0)
    cycles = TimeTest("relaxation", time, strain, stress, time > 0, source="cycles.csv")
    found = prediction.predict(fit, s.resolved, cycles)
    assert found.inside.all() and found.factor > 1.03 and "not counted" not in prediction.sentence(found)
    time = np.concatenate([[0.0], np.arange(1, 51), 50 + np.geomspace(0.005, 5, 20)])
    twice = TimeTest("relaxation", time, 1.0 * (time > 0) + (time > 50), 1 + time, time > 0)
    assert np.array_equal(prediction.predict(fit, s.resolved, twice).inside, time[1:] <= 20)
    # A second load after 10 s: its first value comes too soon after the change.
    soon = twice._replace(time=np.where(time > 50, time - 40, time / 5))
    place = np.append(soon.time[1:51], soon.time[51:] - 10)
    assert np.array_equal(prediction.predict(fit, s.resolved, soon).inside, place >= 0.01)
    # A load of 25 s after cycles.
    time = np.arange(0, 70, 0.25)
    cycle = 1 - np.cos(2 * np.pi * time)
    held = TimeTest("relaxation", time, np.where(abs(time - 42.5) < 12.5, 2.0, cycle), cycle + 1, time > 0)
    inside = prediction.predict(fit, s.resolved, held).inside
    assert inside[time[1:] < 49].all() and not inside[time[1:] > 50.1].any()


def test_decayed_values_are_not_in_the_percentage():
    """Of a relaxation test that is 1.3 times too stiff, 61 % of 120 values were in the interval: the decayed ones."""
    rng, omega, at = np.random.default_rng(3), 2 * np.pi * np.geomspace(0.005, 10, 40), np.linspace(0, 30, 121)
    fluid = Maxwell(np.float64(1000.0), np.array([0.5, 0.5]), np.array([2.0, 0.1]))
    G = generalised_maxwell.moduli(fluid, omega) * (1 + 0.01 * rng.standard_normal((2, 40)))
    stress = 1300 * (0.5 * np.exp(-at / 0.1) + 0.5 * np.exp(-at / 2)) + rng.standard_normal(121)
    fitted = Sweep(omega, *G)
    test = TimeTest("relaxation", at, np.ones(121), stress, at > 0, source="relaxation.csv")
    found = prediction.predict(viscoelastic.closed_form(fitted, 2), fitted.resolved, test)
    assert found.inside.sum() == 120 and 20 < found.counted.sum() < 50 and found.covered < 0.2
    assert f"of {found.counted.sum()} numbers lie in the 95 % interval" in prediction.sentence(found)


def test_storage_and_loss_of_a_predicted_sweep_have_noise_of_their_own():
    """One noise between those of G' and of G'' was used for both, so a correct prediction missed a fifth of the
    values."""
    G, covered = np.stack(generalised_maxwell.moduli(TRUTH, OMEGA)), []
    for seed in range(4):
        noise = np.array([[0.001], [0.02]]) * np.random.default_rng(seed).standard_normal((2, 2, len(OMEGA)))
        fitted, predicted = (Sweep(OMEGA, *(G * (1 + own))) for own in noise)
        found = prediction.predict(viscoelastic.closed_form(fitted, 2), fitted.resolved, predicted)
        of_storage, of_loss = np.median(np.split(found.noise, 2), axis=1)
        assert of_storage < 0.003 and 0.01 < of_loss < 0.04
        covered.append(found.covered)
    assert np.mean(covered) > 0.9


@pytest.mark.slow
def test_polystyrene_relaxes_and_creeps_alike_and_softer_than_it_swings(capsys, tmp_path):
    """The tests are of one material from one laboratory. Relaxation and creep agree with each other, but not with the
    sweep.
    """
    folder = SHARED / "data" / "rheology" / "pyrheo"
    if not folder.is_dir():
        pytest.skip("measured data are not here")
    tests = [str(folder / f"{kind}_ps190_data.csv") for kind in ("stressrelaxation", "creep")]
    data = str(folder / "oscillation_ps190_data.csv")
    arguments = ["--method", "closed-form", "--model", "spectrum", "--predict", *tests, "--out", str(tmp_path)]
    assert main([data, *arguments]) == 0
    told = [line for line in capsys.readouterr().out.splitlines() if "predicted within" in line]
    softer, longer = (float(line.split(" times the prediction")[0].split()[-1]) for line in told)
    # 0.715 times the stress, 1.32 times the strain.
    assert 0.65 < softer < 0.8 and abs(softer * longer - 1) < 0.1
