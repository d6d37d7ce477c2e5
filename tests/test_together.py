"""Several tests of one material in one fit: the common result, and the contribution of each test."""

import json
import re

import numpy as np
import pytest

import liverjax as lj
from fitting.__main__ import main
from fitting.fits import joint, viscoelastic
from fitting.fits.families import springpots_in_time
from fitting.fits.honesty import sizes_of_samples, total_error
from fitting.fits.together import common_fit, doubts, measured_tests, residuals_of_tests
from fitting.methods import generalised_maxwell, time_response
from fitting.methods.generalised_maxwell import Maxwell
from fitting.readers.frequency_sweep import Sweep
from fitting.readers.time_tests import TimeTest, kind_of
from fitting.reports import together_report
from fitting.waves import shear_waves
from fitting.waves.dispersion import Dispersion
from liverjax import InputError

pytestmark = pytest.mark.quick_to_compile

TRUTH = Maxwell(np.float64(800.0), np.array([0.3, 0.4]), np.array([30.0, 0.1]))
OMEGA, TIME = np.geomspace(0.5, 100, 15), np.geomspace(1, 300, 25)


def modulus(time: np.ndarray) -> np.ndarray:
    g, tau = TRUTH.ratios, TRUTH.relaxation_times
    return TRUTH.shear_modulus * (1 - (g * (1 - np.exp(-time[:, None] / tau))).sum(axis=1))


def sweep(noise: float) -> Sweep:
    factor = 1 + noise * np.random.default_rng(1).standard_normal((2, len(OMEGA)))
    G = generalised_maxwell.moduli(TRUTH, OMEGA)
    return Sweep(OMEGA, G[0] * factor[0], G[1] * factor[1], source="sweep.csv")


def relaxation(noise: float, scale: np.ndarray | float = 1.0) -> TimeTest:
    at = np.append(0.0, TIME)
    answer = scale * modulus(at) * (1 + noise * np.random.default_rng(2).standard_normal(len(at)))
    return TimeTest("relaxation", at, np.ones(len(at)), answer, at > 0, source="relaxation.csv")


@pytest.fixture(scope="module")
def found() -> residuals_of_tests.Together:
    return common_fit.fit([sweep(0.02), relaxation(0.005)], 2)


@pytest.mark.parametrize(
    ("tests", "start", "words"),
    [
        ([], TRUTH, "tests is empty"),
        (None, TRUTH._replace(shear_modulus=-1.0), "shear_modulus = -1"),
        (None, TRUTH._replace(ratios=np.array([0.7, 0.5])), "add up to less than 1"),
        (None, TRUTH._replace(relaxation_times=np.array([1.0])), "2 ratios and 1 relaxation_times"),
    ],
)
def test_a_start_from_which_no_joint_fit_begins_is_refused(tests, start, words):
    tests = [joint.sweep(sweep(0.02))] if tests is None else tests
    with pytest.raises(InputError, match=words):
        joint.fit(tests, start, lj.laws.create("neo_hookean", mu=770.0, bulk=7700.0))


@pytest.mark.ci
def test_the_noise_of_every_test_is_found_if_it_differs_a_thousandfold():
    """After three rounds, the weights of the tests had not settled: G0 was wrong by up to 5.1 standard errors."""
    truth = Maxwell(np.float64(2000.0), np.array([0.2, 0.3, 0.3]), np.array([0.01, 0.3, 10.0]))
    omega, at = 2 * np.pi * np.geomspace(0.1, 20, 20), np.append(0.0, np.geomspace(0.01, 100, 40))
    G, stress = generalised_maxwell.moduli(truth, omega), np.full(41, 50.0)
    relaxed = 2000 * (1 - (truth.ratios * (1 - np.exp(-at[:, None] / truth.relaxation_times))).sum(axis=1))
    strain = np.asarray(time_response.strain_response(truth, np.append(0.0, at + 1e-9), np.append(0.0, stress)))[1:]
    off = []
    for seed in range(4):
        one, two, three, four = np.random.default_rng(seed).standard_normal((4, 41))
        tests = [
            Sweep(omega, G[0] * (1 + 0.1 * one[:20]), G[1] * (1 + 0.1 * two[:20]), source="sweep.csv"),
            TimeTest("relaxation", at, np.ones(41), relaxed * (1 + 1e-4 * three), at > 0),
            TimeTest("creep", at, stress, strain * (1 + 0.1 * four), at > 0),
        ]
        fit = common_fit.fit(tests, 3)
        assert 0.6e-4 < fit.shares[1].misfit < 1.4e-4
        off.append((fit.uncertainty.values[0] - 2000) / fit.uncertainty.standard_errors[0])
    assert np.sqrt(np.mean(np.square(off))) < 2


@pytest.mark.ci
@pytest.mark.parametrize("points", [4, pytest.param(8, marks=pytest.mark.slow)])
def test_the_noise_of_a_short_test_does_not_run_to_zero(points):
    """Parameters can fit a few values exactly. Their noise then fell in every round, and their weight grew without
    bound: a relaxation time was wrong by hundreds of standard errors."""
    at, off = np.append(0.0, np.geomspace(0.1, 100, points)), []
    for seed in range(6):
        noise = np.random.default_rng(seed).standard_normal((3, len(OMEGA)))
        loud = sweep(0.0)
        loud = loud._replace(storage=loud.storage * (1 + 0.1 * noise[0]), loss=loud.loss * (1 + 0.1 * noise[1]))
        few = TimeTest("relaxation", at, np.ones(len(at)), modulus(at) * (1 + 0.03 * noise[2, : len(at)]), at > 0)
        fit = common_fit.fit([loud, few], 2)
        assert fit.shares[1].noise > (0.029 if points == 4 else 0.005)
        off.append((fit.uncertainty.values - [800, 0.3, 0.4, 30, 0.1]) / fit.uncertainty.standard_errors)
    assert np.abs(off).max() < 4.5 and np.sqrt(np.mean(np.square(off))) < 1.5


def test_two_tests_find_what_neither_sees_alone(found):
    errors = found.uncertainty.standard_errors
    values = np.array([800, 0.3, 0.4, 30, 0.1])
    assert found.converged and np.all(np.abs(found.uncertainty.values - values) < 4 * errors)
    # The sweep ends at 2 s, the relaxation begins at 1 s. Each test alone does not determine one of the times.
    without_sweep, without_relaxation = (s.errors_without for s in found.shares)
    assert without_sweep[4] > 20 * errors[4] and without_relaxation[3] > 3 * errors[3]
    assert np.all(without_sweep >= errors * 0.99) and np.all(without_relaxation >= errors * 0.99)


def test_each_test_has_the_weight_of_its_own_noise(found):
    # Root mean squares of 30 and of 25 values, 5 parameters: known to 15 %.
    assert [s.noise for s in found.shares] == [pytest.approx(0.02, rel=0.4), pytest.approx(0.005, rel=0.4)]
    assert not any("do not agree" in w for w in found.warnings)


def of_the_same_times(scale: np.ndarray | float) -> list[Sweep | TimeTest]:
    """Return a sweep that covers the times of the relaxation, and the relaxation with its moduli multiplied by a
    factor.
    """
    omega, rng = OMEGA / 50, np.random.default_rng(1)
    storage, loss = (G * (1 + 0.02 * rng.standard_normal(len(omega))) for G in generalised_maxwell.moduli(TRUTH, omega))
    return [Sweep(omega, storage, loss, source="sweep.csv"), relaxation(0.005, scale)]


@pytest.mark.parametrize("scale", [1.0, 1.2, 0.8])
def test_a_factor_between_the_tests_is_named(scale):
    """Every modulus of one test is wrong by one factor, from another temperature or a wrong size. The test and the
    factor are named.
    """
    fit = springpots_in_time.choose_together(of_the_same_times(scale), "prony", 2)
    told = [w for w in fit.warnings if "the tests agree if" in w]
    if scale == 1:
        assert not told and not any("do not agree" in w for w in fit.warnings)
        return
    found, error = map(float, re.search(r"relaxation.csv are ([\d.]+) ± ([\d.e-]+) times", told[0]).groups())
    assert abs(found - scale) < 4 * error + 0.005 * scale and error < 0.02  # printed with three digits


def wide_and_long(factor: float, seed: int) -> list[Sweep | TimeTest]:
    """Return a sweep of three decades and a relaxation whose moduli are multiplied by a factor."""
    omega, rng = np.geomspace(0.05, 100, 25), np.random.default_rng(seed)
    storage, loss = (G * (1 + 0.02 * rng.standard_normal(25)) for G in generalised_maxwell.moduli(TRUTH, omega))
    test = relaxation(0.0, factor)
    noisy = test.answer * (1 + 0.01 * rng.standard_normal(len(test.answer)))
    return [Sweep(omega, storage, loss, source="sweep.csv"), test._replace(answer=noisy)]


@pytest.mark.slow
def test_total_errors_contain_the_sizes_of_the_samples():
    """Each test has a separate factor. Errors of noise covered G0 in 3 of 10 such fits, and the second ratio in 7."""
    hits, by_noise = [], []
    for seed in range(12):
        factor = 1 + 0.013 * np.random.default_rng(100 + seed).standard_normal()
        fit = common_fit.fit(wide_and_long(factor, seed), 2)
        shares, u = sizes_of_samples.shares_with_sizes(fit, 0.013), fit.uncertainty
        off, whole = np.abs(u.values - np.array([800, 0.3, 0.4, 30, 0.1])), total_error.root_of_squares(shares)
        rest = abs(float(fit.model.shear_modulus * (1 - fit.model.ratios.sum())) - 240)
        hits.append([*(off < u.quantile * np.array([whole[name] for name in u.names])), False])
        hits[-1][-1] = rest < u.quantile * whole["equilibrium_modulus"]
        by_noise.append(off < u.quantile * u.standard_errors)
    assert np.all(np.mean(hits, axis=0) >= 0.83) and np.mean(by_noise, axis=0).min() < 0.7
    # A factor common to both tests changes only G0 and the equilibrium modulus.
    assert shares["geometry"]["shear_modulus"] >= 0.0129 * fit.model.shear_modulus
    assert shares["geometry"]["equilibrium_modulus"] >= 0.0128 * 240


def test_a_factor_of_all_tests_is_one_of_the_shear_modulus_alone():
    """For a sweep and a creep test: a stiffer sample creeps less, so both change G0 equally and the ratios
    oppositely.
    """
    at, g = np.append(0.0, TIME), 0.4
    strain = (1 + g / (1 - g) * (1 - np.exp(-(1 - g) * at / 5.0))) / 1000  # one mode of 5 s, G0 = 1000 Pa
    creep = TimeTest("creep", at, np.ones(len(at)), strain, at > 0, source="creep.csv")
    x = 1j * OMEGA / 50 * 5.0
    G = 1000 * (1 - g + g * x / (1 + x))
    fit = common_fit.fit([Sweep(OMEGA / 50, G.real, G.imag, source="sweep.csv"), creep], 1)
    assert np.allclose(fit.uncertainty.values, [1000, g, 5.0], rtol=1e-3)
    moved = sizes_of_samples._by_sizes(fit)
    assert np.allclose(moved.sum(axis=1), [1000, 0, 0], atol=[5, 5e-3, 5e-2])


@pytest.mark.ci
def test_a_small_factor_between_the_tests_is_named_too():
    """A factor of 5 % is absorbed by the ratios. Each test is fitted nearly as well as alone."""
    fit = springpots_in_time.choose_together(wide_and_long(1.05, 0), "prony", 2)
    (told,) = [w for w in fit.warnings if "the tests agree if" in w]
    found, error = map(float, re.search(r"relaxation.csv are ([\d.]+) ± ([\d.e-]+) times", told).groups())
    assert abs(found - 1.05) < 4 * error + 0.005
    same = springpots_in_time.choose_together(wide_and_long(1.0, 1), "prony", 2)
    assert not any("the tests agree if" in w for w in same.warnings)


@pytest.mark.slow
@pytest.mark.parametrize("scale", [10.0, 50.0, 1e-3])
def test_a_wrong_unit_of_one_test_is_named(scale):
    """The common fit of such tests may have too few modes for either, and misses both by far."""
    fit = springpots_in_time.choose_together(wide_and_long(scale, 0), "prony")
    alone = [s.misfit_alone for s in fit.shares]
    assert alone == [pytest.approx(0.02, rel=0.4), pytest.approx(0.01, rel=0.4)]
    (told,) = [w for w in fit.warnings if "the tests agree if" in w]
    found, error = map(float, re.search(r"relaxation.csv are ([\de.-]+) ± ([\de.-]+) times", told).groups())
    assert abs(found - scale) < 4 * error + 0.005 * scale and error < 0.02 * scale
    assert not any("try another --model" in w for w in fit.warnings)


@pytest.mark.slow
@pytest.mark.parametrize(("relative", "explained"), [(0.0, False), (0.03, True)])
def test_a_factor_that_sizes_of_samples_explain_is_no_alarm(relative, explained):
    fit = springpots_in_time.choose_together(wide_and_long(1.05, 0), "prony", relative=relative)
    (told,) = [w for w in fit.warnings if "the tests agree if" in w]
    assert ("errors in the sizes of the samples explain this" in told) == explained
    assert ("made at another temperature" in told) != explained


@pytest.mark.slow
def test_a_common_fit_with_too_few_modes_does_not_hide_the_factor():
    """The sweep shows the fast mode. The relaxation, ten times as stiff, shows the slow one. Both together allow one
    mode.
    """
    both = Maxwell(np.float64(1000.0), np.array([0.3, 0.3]), np.array([20.0, 0.05]))
    omega, time = 2 * np.pi * np.geomspace(0.1, 31.6, 20), np.append(0.0, np.geomspace(0.1, 316, 50))
    draws = np.random.default_rng(50).standard_normal((2, 20))
    storage, loss = (G * (1 + 0.01 * d) for G, d in zip(generalised_maxwell.moduli(both, omega), draws, strict=True))
    G = 1000 * (1 - (both.ratios * (1 - np.exp(-time[:, None] / both.relaxation_times))).sum(axis=1))
    noisy = 10 * G * (1 + 0.005 * np.random.default_rng(51).standard_normal(51))
    slow = TimeTest("relaxation", time, np.ones(51), noisy, time > 0, source="relaxation.csv")
    fit = springpots_in_time.choose_together([Sweep(omega, storage, loss, source="sweep.csv"), slow], "prony")
    assert fit.modes == 1 and [s.misfit_alone for s in fit.shares] == [
        pytest.approx(0.01, rel=0.4),
        pytest.approx(0.005, rel=0.4),
    ]
    (told,) = [w for w in fit.warnings if "the tests agree if" in w]
    assert "relaxation.csv are 10 ± " in told or "relaxation.csv are 9.9" in told


def test_tests_that_differ_by_more_than_a_factor_are_only_told_apart():
    fit = springpots_in_time.choose_together(of_the_same_times(np.append(1.0, (TIME / 10) ** 0.1)), "prony", 2)
    assert any("do not agree" in w for w in fit.warnings)
    assert not any("the tests agree if" in w for w in fit.warnings)


def test_the_errors_are_those_of_the_stacked_rows(found):
    """Compare with numerical derivatives of both tests' predictions, by hand."""
    p = found.uncertainty.values
    noise = [s.noise for s in found.shares]

    def predicted(p):
        model = Maxwell(p[0], p[1:3], p[3:])
        G = np.concatenate(generalised_maxwell.moduli(model, OMEGA))
        decay = p[0] * (1 - (p[1:3] * (1 - np.exp(-TIME[:, None] / p[3:]))).sum(axis=1))
        s = sweep(0.02)
        return np.concatenate([G / np.concatenate([s.storage, s.loss]) / noise[0], decay / scales / noise[1]])

    scales = relaxation(0.005).scales
    columns = []
    for k in range(5):
        step = 1e-5 * p[k] * np.eye(5)[k]
        columns.append((predicted(p + step) - predicted(p - step)) / (2e-5 * p[k]))
    errors = np.sqrt(np.diag(np.linalg.inv(np.array(columns) @ np.array(columns).T)))
    assert np.allclose(found.uncertainty.standard_errors, errors, rtol=0.05)


def test_tests_that_do_not_agree_are_named():
    told = common_fit.fit([sweep(0.02), relaxation(0.005, 1.4)], 2).warnings
    assert any("the tests do not agree" in w and "otherwise try more modes" in w for w in told)


@pytest.mark.ci
def test_tests_that_do_not_agree_in_a_spectrum_need_another_model():
    """The advice was to try more modes, which the program refuses for --model spectrum."""
    told = springpots_in_time.choose_together([sweep(0.02), relaxation(0.005, 1.4)], "spectrum").warnings
    assert any("the tests do not agree" in w and "otherwise try another --model" in w for w in told)


def test_shear_waves_of_several_tests_have_the_given_density(tmp_path):
    """The density of water was used, although --density gave another one."""
    G = generalised_maxwell.moduli(
        TRUTH._replace(ratios=TRUTH.ratios[1:], relaxation_times=TRUTH.relaxation_times[1:]), OMEGA
    )
    for name, factor in (("a", 1.0), ("b", 1.001)):
        columns = np.column_stack([OMEGA, factor * G[0], G[1]])
        head = "angular_frequency_rad_s,storage_modulus_Pa,loss_modulus_Pa"
        np.savetxt(tmp_path / f"{name}.csv", columns, delimiter=",", header=head, comments="")
    files = [str(tmp_path / "a.csv"), "--with", str(tmp_path / "b.csv")]
    assert main([*files, "--modes", "1", "--density", "2000", "--out", str(tmp_path)]) == 0
    assert json.loads((tmp_path / "fit.json").read_text())["shear_waves"]["density_kg_m3"] == 2000


def test_the_largest_error_has_the_divisors_of_the_mean(found):
    """The stress of a cycle passes through 0. There, the largest error of a good fit was given as 80 %."""
    time = np.linspace(0, 20, 100)
    strain = 0.01 * np.sin(np.pi / 2 * time)
    stress = np.asarray(time_response.stress_response(TRUTH, time, strain))
    noisy = stress + 0.01 * stress.max() * np.random.default_rng(2).standard_normal(100)
    cycle = TimeTest("relaxation", time, strain, noisy, time > 0)
    largest = together_report._largest(found._replace(tests=[cycle], fitted=[stress[1:]]))
    assert largest == [measured_tests.relative_errors_of(cycle, stress[1:]).max()] and 0.02 < largest[0] < 0.1


def test_three_velocities_determine_nothing_alone_and_do_not_disagree():
    """Directions that no residual determines had no error, and a fit to three values alone seemed to have no noise."""
    omega, others = np.geomspace(0.2, 300, 25), 2 * np.pi * np.geomspace(50, 400, 3)
    velocity = shear_waves.velocity_and_attenuation(*generalised_maxwell.moduli(TRUTH, others), others, 1000.0)[0]
    told = 0
    for seed in range(4):
        noise = np.random.default_rng(seed).standard_normal((3, 25))
        G = [part * (1 + 0.02 * n) for part, n in zip(generalised_maxwell.moduli(TRUTH, omega), noise, strict=False)]
        waves = Dispersion(others, velocity * (1 + 0.03 * noise[2, :3]), None, 1000.0, "waves.csv")
        fit = common_fit.fit([Sweep(omega, *G, source="sweep.csv"), waves], 2)
        assert np.all(np.isinf(fit.shares[0].errors_without[1:]))  # velocities far above the times determine G0
        told += any("the tests do not agree. The misfit" in w for w in fit.warnings)
    assert not told


def test_what_no_fit_follows_is_told():
    """A test with a misfit of 63 % in the common fit and of 44 % alone does not disagree with the others."""
    share = residuals_of_tests.Share("sweep", "b.csv", 38, 1.2, 1.0, 0.63, 0.44, 0.3, np.ones(3))
    assert doubts.disagreements([share]) == []
    assert doubts.missed([share]) == [
        "the fit misses the data of b.csv by 63 %: if this is not noise, use another --model"
    ]
    assert doubts.missed([share._replace(misfit=0.04)]) == []


def test_the_driven_column_is_the_one_that_is_held(tmp_path):
    time = np.linspace(0, 10, 20)
    for kind, strain, stress in (
        ("relaxation", np.minimum(time, 1), 5 * np.exp(-time / 5)),
        ("creep", 0.1 + 0.02 * time, np.minimum(time, 1)),
    ):
        rows = np.column_stack([time, strain, stress])
        np.savetxt(tmp_path / "t.csv", rows, delimiter=",", header="time_s,strain,stress_Pa", comments="")
        assert kind_of(tmp_path / "t.csv") == kind


def test_points_on_a_straight_drive_are_not_needed():
    """A ramp, a constant part and a ramp down are described by their corners and ends."""
    from fitting.fits.time_tests import _corners_in_time

    time = np.sort(np.concatenate([np.linspace(0, 10, 101), [3.33]]))
    driven = np.interp(time, [0, 2, 6, 10], [0, 1, 1, 0.5])
    assert np.allclose(time[_corners_in_time(time, driven)], [0, 2, 6, 10])


#: A band that shows both modes.
WIDE = np.geomspace(0.01, 100, 25)


def with_deviations(stated: float, noise: float, springpot: bool = False) -> Sweep:
    """Return a sweep whose stated deviations, as fractions of the moduli, are not its noise."""
    G = np.array(generalised_maxwell.moduli(TRUTH, WIDE))
    if springpot:
        G = 400 + 300 * (1j * WIDE) ** 0.3
        G = np.array([G.real, G.imag])
    noisy = G * (1 + noise * np.random.default_rng(1).standard_normal(G.shape))
    return Sweep(WIDE, *noisy, *(stated * noisy), source="stated.csv")


@pytest.mark.ci
@pytest.mark.parametrize(
    "model", ["prony", *(pytest.param(m, marks=pytest.mark.slow) for m in ("fractional", "spectrum"))]
)
def test_given_deviations_are_believed_beside_another_test(model):
    """Stated are 5 %, the scatter is 1 %. The same file twice has errors smaller by sqrt(2), and agrees with itself."""
    from fitting.fits.families.springpots_in_time import choose_together

    data = with_deviations(0.05, 0.01, springpot=model == "fractional")
    two = choose_together([data, data], model, 2 if model == "prony" else "auto")
    assert not any("do not agree" in w for w in two.warnings)
    for share in two.shares:
        assert share.noise == 1 and share.alone == 1
        # The reported misfit is relative to the moduli. It is the scatter, not the deviations.
        assert 0.005 < share.misfit < 0.015 and 0.005 < share.misfit_alone < 0.015
        assert share.mean_relative_error < share.misfit < 2 * share.mean_relative_error
    if model == "prony":
        errors = viscoelastic.closed_form(data, 2).uncertainty.standard_errors
        assert np.allclose(two.uncertainty.standard_errors, errors / np.sqrt(2), rtol=0.02)
    # The residuals are relative to 5 %, not to the scatter, so no factor reduces the errors.
    assert two.uncertainty.noise == pytest.approx(1, abs=1e-9)


def test_the_mean_error_is_not_above_the_largest_one(tmp_path):
    found = common_fit.fit([with_deviations(0.02, 0.02), relaxation(0.005)], 2)
    content = together_report.write(tmp_path, found, 0.013)
    assert (
        0.005 < content["mean_relative_error"] < 0.03 and content["mean_relative_error"] < content["max_relative_error"]
    )
    assert content["tests"][0]["misfit"] == pytest.approx(0.02, rel=0.4)
    assert content["tests"][0]["misfit_by_itself"] == pytest.approx(0.02, rel=0.4)


@pytest.mark.ci
def test_a_joint_fit_of_one_sweep_has_the_errors_of_its_closed_form():
    """Without stated deviations, the noise is the residual of the closed form, not the size of the moduli."""
    data = with_deviations(0.05, 0.02)._replace(storage_sd=None, loss_sd=None)
    closed = viscoelastic.closed_form(data, 2)
    found = joint.fit([joint.sweep(data)], closed.model, lj.laws.create("neo_hookean", mu=770.0, bulk=7700.0))
    assert found.converged and np.allclose(found.values, closed.uncertainty.values, rtol=1e-4)
    assert np.allclose(found.standard_errors, closed.uncertainty.standard_errors, rtol=0.01)
    given = with_deviations(0.05, 0.01)
    assert np.array_equal(joint.sweep(given).sd, np.concatenate(given.deviations))


def test_a_number_of_modes_beyond_the_tests_is_refused():
    with pytest.raises(InputError, match="give 1 to"):
        common_fit.fit([sweep(0.02), relaxation(0.005)], 60)
