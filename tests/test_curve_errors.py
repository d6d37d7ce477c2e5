"""Errors of laws fitted to curves: uneven noise, individual factors of tests, and parameters that are not
determined.
"""

import numpy as np
import pytest
from test_curves import KNOWN, synthetic

import liverjax as lj
from fitting.fits import stress_stretch
from fitting.fits.families import compared_laws
from fitting.fits.honesty.wrong_columns import structured_curves
from fitting.methods.estimate import covering_root, spread
from fitting.methods.noise.uneven_noise import growing_root, uneven_root
from fitting.readers import curves
from fitting.reports import curves_report
from liverjax.laws import homogeneous

pytestmark = pytest.mark.quick_to_compile


@pytest.mark.slow
def test_standard_errors_are_the_scatter_of_repeated_fits():
    law = lj.laws.FungDemiray(c1=500.0, c2=2.0, bulk=None)
    (candidate,) = stress_stretch.candidates("fung_demiray")
    fits = [stress_stretch.fit(candidate, synthetic(law, 0.03, seed), starts=4) for seed in range(20)]
    values = np.stack([f.values for f in fits])
    stated = np.mean([f.standard_errors for f in fits], axis=0)
    # A standard deviation from 20 draws has an error of 1/sqrt(38) = 16 %. Three of these are allowed.
    assert np.allclose(values.std(axis=0, ddof=1), stated, rtol=0.49)
    assert np.all(np.abs(values.mean(axis=0) - [500.0, 2.0]) < 3.5 * stated / np.sqrt(20))


def test_errors_hold_where_noise_grows_with_the_stress():
    """In a least-squares fit of y = a x + b x^2 with noise proportional to y, the error of b is 1.2 times that of equal
    noise.
    """
    x, rng, true = np.linspace(0.05, 1.0, 25), np.random.default_rng(0), np.array([1.0, 20.0])
    J = np.stack([x, x**2], axis=1)
    sd = 0.05 * (J @ true)
    exact = np.sqrt(np.diag(np.linalg.pinv(J) @ np.diag(sd**2) @ np.linalg.pinv(J).T))
    errors, held = [], []
    for _ in range(400):
        y = J @ true + sd * rng.standard_normal(25)
        p = np.linalg.pinv(J) @ y
        errors.append(np.linalg.norm(uneven_root(J, y - J @ p, np.eye(2)), axis=1))
        held.append(np.abs(p - true) < 2.07 * errors[-1])
    # HC3 exceeds the exact error because of the leverage of few points, here by a tenth.
    assert np.all(np.sqrt(np.mean(np.square(errors), axis=0)) / exact < 1.25)
    assert np.all(np.mean(held, axis=0) > 0.91)
    equal = np.sqrt(np.mean(sd**2) * np.diag(np.linalg.inv(J.T @ J)))
    assert exact[1] > 1.2 * equal[1]  # this would be the error for equal noise


@pytest.mark.slow
def test_errors_of_a_law_contain_uneven_noise():
    """Fit the law of Fung and Demiray with noise of 5 % of each stress. With errors for equal noise, only 36 and 32 %
    of the 95 % intervals contained the truth.
    """
    stretch, rng = np.linspace(1.02, 1.5, 15), np.random.default_rng(1)
    law = lj.laws.FungDemiray(c1=500.0, c2=10.0, bulk=None)
    exact = np.asarray(homogeneous.response(law, "uniaxial", stretch))
    (candidate,) = stress_stretch.candidates("fung_demiray")
    F = np.asarray(homogeneous.deformation_gradient("uniaxial", stretch, stretch))
    z = []
    for _ in range(6):
        noisy = exact * (1 + 0.05 * rng.standard_normal(15))
        found = stress_stretch.fit(candidate, [curves.Curve("a", "uniaxial", F, (0, 0), noisy, 0)])
        z.append((found.values - [500.0, 10.0]) / found.standard_errors)
    assert np.sqrt(np.mean(np.square(z))) < 2.0, z


def test_a_covariance_that_covers_two_others():
    rng = np.random.default_rng(0)
    for lost in (1.0, 1e140):
        first, second = rng.standard_normal((3, 5)), rng.standard_normal((3, 8)) * np.array([[10.0], [1.0], [0.1]])
        first[2] *= lost
        own = covering_root(first, second)
        for combination in rng.standard_normal((50, 3)) * [1.0, 1.0, 1 / lost]:
            sizes = [np.linalg.norm(combination @ root) for root in (own, first, second)]
            assert (1 - 1e-9) * max(sizes[1:]) < sizes[0] < 1.5 * np.hypot(*sizes[1:])
    same = covering_root(second, 0.5 * second)
    assert np.allclose(same @ same.T, second @ second.T, rtol=1e-9)
    assert covering_root(0 * first, second) is second and covering_root(first[:0], second[:0]).shape[0] == 0


def test_a_covariance_covers_others_of_another_size_or_with_few_columns():
    """One parameter of `second` with a factor of 1e9 gave other parameters a quarter of their error. Directions outside
    the span of `first` were lost."""
    for seed in range(20):
        rng = np.random.default_rng(seed)
        for columns, size in ((3, 1e9), (1, 1.0), (2, 1e5)):
            first, second = rng.standard_normal((3, columns)), rng.standard_normal((3, 5))
            second[2] *= size
            for one, other in ((first, second), (second, first)):
                errors = np.linalg.norm(covering_root(one, other), axis=1)
                largest = np.maximum(np.linalg.norm(one, axis=1), np.linalg.norm(other, axis=1))
                assert np.all(errors > (1 - 1e-4) * largest), (seed, columns, size, errors / largest)


def test_errors_of_the_stress_contain_the_scatter_of_samples():
    """The correlation belonged to another kind of noise than the standard errors. The stress at the largest stretch had
    two thirds of its error. The factors of the four samples scatter by 10 %, so the error of their mean is 5 %.
    """
    stretch = np.linspace(1.0, 1.5, 20)
    J = np.tile(np.stack([2 * (stretch - stretch**-2), 2 * (1 - stretch**-3)], axis=1), (4, 1))  # of Mooney's law
    exact, F = J[:20] @ np.array([300.0, 200.0]), np.broadcast_to(np.eye(3), (20, 3, 3))
    errors = []
    for seed in range(20):
        rng = np.random.default_rng(seed)
        stresses = exact * (1 + 0.1 * rng.standard_normal((4, 1))) + 0.02 * exact.mean() * rng.standard_normal((4, 20))
        size = float(np.sqrt(np.mean(exact**2)))
        four = [curves.Curve(f"{k}", "uniaxial", F, (0, 0), P, law_scale=size) for k, P in enumerate(stresses)]
        r = (J @ (np.linalg.pinv(J) @ stresses.ravel()) - stresses.ravel()) / size
        noise = float(np.sqrt(r @ r / 78))
        half, _ = spread(J / size, noise, np.eye(2))
        own, correlation, *_ = stress_stretch._errors_of_law(four, (J / size, r, noise), np.eye(2), half, True)
        root = J[19] * own
        errors.append(np.sqrt(root @ correlation @ root) / exact[-1])
    assert 0.05 < np.mean(errors) < 0.1, np.mean(errors)


@pytest.mark.slow
def test_factors_of_two_tests_are_in_the_errors_or_told():
    """Fit Mooney's law to uniaxial and equibiaxial tension, with a factor of 10 % on each test and 2 % of noise. With
    errors of the noise alone, 45 % of the intervals contained the truth, and there was no warning.
    """
    stretch, rng, true = np.linspace(1.02, 1.4, 12), np.random.default_rng(3), np.array([300.0, 200.0])
    law = lj.laws.MooneyRivlin(c10=300.0, c01=200.0, bulk=None)
    (candidate,) = stress_stretch.candidates("mooney_rivlin")
    missed, shown = [], 0
    for _ in range(6):
        two = []
        for test in ("uniaxial", "equibiaxial"):
            exact = np.asarray(homogeneous.response(law, test, stretch)) * (1 + 0.1 * rng.standard_normal())
            noisy = exact + 0.02 * np.abs(exact).mean() * rng.standard_normal(12)
            F = np.asarray(homogeneous.deformation_gradient(test, stretch, stretch))
            two.append(curves.Curve(test, test, F, (0, 0), noisy, 0))
        found = stress_stretch.fit(candidate, two)
        held = np.abs(found.values - true) < 2.07 * found.standard_errors
        told = any("the stress of each test" in sentence for sentence in found.warnings)
        missed.append((not held.all(), not held.all() and not told))
        shown += any(
            "each test seems to be multiplied by an individual factor" in sentence for sentence in found.warnings
        )
    assert np.sum(missed, axis=0)[0] <= 3 and np.sum(missed, axis=0)[1] == 0 and shown, missed


def test_the_advice_for_one_test_of_two_samples_is_possible():
    """The advice was to measure one test on several samples, although the user had done this."""
    law, rng, two = lj.laws.NeoHookean(mu=1000.0, bulk=None), np.random.default_rng(11), []
    stretch = np.linspace(1.05, 1.6, 12)
    F = np.asarray(homogeneous.deformation_gradient("uniaxial", stretch, stretch))
    exact = np.asarray(homogeneous.response(law, "uniaxial", stretch))
    for name in ("a", "b"):
        noisy = exact * (1 + 0.03 * rng.standard_normal(12))
        two.append(curves.Curve(name, "uniaxial", F, (0, 0), noisy, file=f"{name}.csv"))
    (candidate,) = stress_stretch.candidates("neo_hookean")
    (said,) = (w for w in stress_stretch.fit(candidate, two, starts=4).warnings if "wrong by an individual factor" in w)
    assert said.endswith("Measure more samples in this test")


@pytest.mark.slow
def test_numbers_of_the_other_sign_that_shear_cannot_tell_apart_are_told():
    """For Ogden's law with alpha = 6, simple shear is the same with alpha = -6. In tension the stress is 0.3 times as
    large.
    """
    law = lj.laws.Ogden(mu=(333.3,), alpha=(6.0,), bulk=None)
    (shear,) = (c for c in synthetic(law, 0.02, 0) if c.label.startswith("simple"))
    (candidate,) = stress_stretch.candidates("ogden", terms=1)
    told = [
        s for s in stress_stretch.fit(candidate, [shear], 32).warnings if s.startswith("other parameter values fit")
    ]
    assert len(told) == 1 and "add a test in tension or compression" in told[0]
    every = stress_stretch.fit(candidate, synthetic(law, 0.02, 0), 32).warnings
    assert not [s for s in every if s.startswith("other parameter values fit")]


@pytest.mark.ci
def test_a_parameter_without_data_is_told():
    law = lj.laws.NeoHookean(mu=770.0, bulk=None)
    (candidate,) = stress_stretch.candidates("fung_demiray")
    small = [c for c in synthetic(law, 0.02) if c.test == "simple_shear"]
    assert any("do not determine c2" in w for w in stress_stretch.fit(candidate, small).warnings)


def test_errors_hold_at_a_point_through_which_the_law_goes():
    """The law stiffens, so the last point has a leverage near 1, and its residual does not show its noise."""
    x, rng, true = np.linspace(0.1, 1.0, 10), np.random.default_rng(0), np.array([1.0, 1.0])
    J = np.stack([x, x * np.exp(16 * (x - 0.5))], axis=1)
    size, held, alone = J @ true, [], []
    for _ in range(200):
        y = size * (1 + 0.05 * rng.standard_normal(10))
        p = np.linalg.pinv(J) @ y
        roots = [of(J, J @ p - y, *more, np.eye(2)) for of, more in ((uneven_root, ()), (growing_root, (J @ p,)))]
        errors = [np.linalg.norm(root, axis=1) for root in roots]
        held.append(np.abs(p - true) < 2.31 * np.maximum(*errors))
        alone.append(np.abs(p - true) < 2.31 * errors[0])
    # 200 draws: the binomial standard deviation is 0.016 at 95 %.
    assert np.all(np.mean(held, axis=0) > 0.9) and np.mean(alone, axis=0)[1] < 0.8, (
        np.mean(held, 0),
        np.mean(alone, 0),
    )
    even = [growing_root(J, J @ (np.linalg.pinv(J) @ e) - e, size, np.eye(2)) for e in rng.standard_normal((100, 10))]
    assert np.mean([np.any(root) for root in even]) < 0.3  # equal noise is recognised


@pytest.mark.ci
def test_as_many_parameters_as_points_is_told():
    curve = synthetic(KNOWN["yeoh"], 0.05)[0]
    three = curve._replace(F=curve.F[[0, 13, 26]], stress=curve.stress[[0, 13, 26]])
    (candidate,) = stress_stretch.candidates("yeoh")
    found = stress_stretch.fit(candidate, [three])
    assert np.isnan(found.standard_errors).all() and any("as many parameters" in w for w in found.warnings)


@pytest.mark.ci
def test_laws_that_tie_are_named_with_their_moduli():
    (candidate,) = stress_stretch.candidates("neo_hookean")
    best = stress_stretch.fit(candidate, synthetic(KNOWN["neo_hookean"], 0.01))
    other, far = (
        best._replace(aicc=best.aicc + d, label=n, shear_modulus=m) for d, n, m in ((2, "b", 900.0), (9, "c", 5.0))
    )
    (told,) = compared_laws.tied_laws([best, other, far], "curves")
    assert told.startswith("b fits the curves as well as neo_hookean does") and "with G0 from 7" in told
    assert "to 900 Pa" in told and not compared_laws.tied_laws([best, far], "curves")


@pytest.mark.ci
def test_soft_samples_have_no_larger_weight():
    """Each curve was divided by its own stress: ten samples with a mean of 1000 Pa and a scatter of 21 % gave 917."""
    moduli = np.array([700.0, 750, 800, 900, 950, 1050, 1100, 1200, 1250, 1300])
    each = [synthetic(lj.laws.NeoHookean(mu=mu, bulk=None), 0.005, k)[0] for k, mu in enumerate(moduli)]
    same = [c._replace(label=f"{k}", sample=f"{k}") for k, c in enumerate(each)]
    assert len({c.test for c in same}) == 1
    (candidate,) = stress_stretch.candidates("neo_hookean")
    found = stress_stretch.fit(candidate, same)
    assert np.isclose(found.values[0], 1000.0, rtol=2e-3)
    # The errors of the table are relative to the measured stress.
    assert np.isclose(found.curve_errors["0"], 1000 / 700 - 1, rtol=0.02)
    told = compared_laws.unfollowed(same, [found])
    assert told[0].startswith(
        "0: the stress is 0.7 times that of neo_hookean, with the same course. If this is not another"
    )


def test_laws_with_too_many_parameters_for_the_points_are_told():
    """Four points: the criterion of laws with two parameters is infinite, so a law with 20 % of error came first, and
    the others were in the order of the registry, without a message."""
    (candidate,) = stress_stretch.candidates("neo_hookean")
    first = stress_stretch.fit(candidate, synthetic(KNOWN["neo_hookean"], 0.01))
    best = first._replace(mean_relative_error=0.2, bic=-9.0)
    near, far = (
        first._replace(label=n, aicc=np.inf, bic=b, values=np.ones(2), mean_relative_error=0.001)
        for n, b in (("near", -30.0), ("far", -5.0))
    )
    ordered = curves_report.best_first([far, near, best])
    assert [f.label for f in ordered] == ["neo_hookean", "near", "far"]
    (told,) = compared_laws.too_few_points(ordered, 4)
    assert told.startswith("4 points are too few to compare laws with 2 or more parameters by AICc, so neo_hookean")
    assert "20 %, although near has 0.1 %" in told and not compared_laws.too_few_points([best, far], 4)
    exact = near._replace(values=np.ones(4))
    assert not compared_laws.too_few_points([best, exact], 4)


def test_a_factor_of_a_test_is_no_misfit_of_the_law():
    """The second sample is 1.3 times as stiff. In addition to its factor, a misfit of the law was once reported."""
    rng, stretch = np.random.default_rng(5), np.linspace(1.02, 1.4, 25)
    law = lj.laws.NeoHookean(mu=1000.0, bulk=None)
    (candidate,) = stress_stretch.candidates("neo_hookean")
    several = []
    for k, factor in enumerate((1.0, 1.3, 0.95)):
        exact = factor * np.asarray(homogeneous.response(law, "uniaxial", stretch))
        F = np.asarray(homogeneous.deformation_gradient("uniaxial", stretch, stretch))
        noisy = exact + 2.0 * rng.standard_normal(25)
        several.append(curves.Curve(f"sample {k}", "uniaxial", F, (0, 0), noisy, 0))
    found = stress_stretch.fit(candidate, several)
    assert any(w.startswith(stress_stretch.OWN_FACTORS) for w in found.warnings)
    assert not structured_curves(several, found)
    assert structured_curves(several, found._replace(warnings=[]))


def test_curves_of_one_sample_need_not_be_neighbours():
    """The curves of four samples were ordered by their component. They counted as eight samples, and the error of the
    modulus was half as large."""
    rng, stretch = np.random.default_rng(0), np.linspace(1.05, 1.4, 12)
    law = lj.laws.NeoHookean(mu=1000.0, bulk=None)
    (candidate,) = stress_stretch.candidates("neo_hookean")
    F = np.eye(3) * np.stack([stretch, stretch**0.2, stretch**-1.2], axis=1)[:, :, None]
    P = np.asarray(homogeneous.nominal_stress(law, F))
    by_sample = []
    for k, factor in enumerate((0.8, 0.95, 1.1, 1.2)):
        for i in (0, 1):
            noisy = factor * P[:, i, i] * (1 + 0.005 * rng.standard_normal(12))
            by_sample.append(curves.Curve(f"{k}, {i}", "general", F, (i, i), noisy, sample=f"{k}"))
    by_component = by_sample[::2] + by_sample[1::2]
    errors = []
    for each in (by_sample, by_component):
        found = stress_stretch.fit(candidate, each, starts=2)
        errors.append(found.standard_errors[0])
        assert any("(estimated from 4 tests)" in told for told in found.warnings)
    assert errors[1] == pytest.approx(errors[0], rel=1e-6)


def test_all_tests_of_one_sample_in_a_file_may_have_one_factor(tmp_path):
    """Three samples with two tests each counted as six samples. The error of the modulus was a third of this error."""
    rng, stretch, shear = np.random.default_rng(0), np.linspace(1.03, 1.3, 10), np.linspace(0.03, 0.3, 10)
    files, (candidate,) = [], stress_stretch.candidates("neo_hookean")
    for k, mu in enumerate((1000.0, 1300.0, 1100.0)):
        tension = mu * (stretch - stretch**-2) * (1 + 0.01 * rng.standard_normal(10))
        rows = [f"uniaxial,{x:.6f},,{P:.6g}" for x, P in zip(stretch, tension, strict=True)]
        sheared = mu * shear * (1 + 0.01 * rng.standard_normal(10))
        rows += [f"simple_shear,,{x:.6f},{P:.6g}" for x, P in zip(shear, sheared, strict=True)]
        files.append(tmp_path / f"s{k}.csv")
        files[-1].write_text("\n".join(["test,stretch,shear,nominal_stress_Pa", *rows]) + "\n")
    by_file, _ = curves.read_curves(files)
    of_one_sample = [c._replace(sample=c.file) for c in by_file]
    of_tests = [c._replace(file="") for c in by_file]  # the program cannot know which tests belong together
    own, same, other = (stress_stretch.fit(candidate, each, starts=2) for each in (by_file, of_one_sample, of_tests))
    assert own.standard_errors[0] == pytest.approx(same.standard_errors[0], rel=1e-6)
    assert own.standard_errors[0] > 2 * other.standard_errors[0]
    assert any("(estimated from 3 files" in told for told in own.warnings)
    assert any("(estimated from 6 tests)" in told for told in other.warnings)
