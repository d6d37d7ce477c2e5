"""The continuous spectrum of relaxation times: found, weighed and told."""

import numpy as np
import pytest
import scipy.optimize
from conftest import ROOT
from test_models import GIVEN, OMEGA, fractional_sweep, maxwell_fluid

from fitting.fits.families import models
from fitting.methods import generalised_maxwell, relaxation_spectrum
from fitting.readers.rheometer import Sweep, read_sweep

pytestmark = pytest.mark.quick_to_compile


def box_spectrum(omega: np.ndarray, low: float, high: float, noise: float = 0.0) -> Sweep:
    """H = 100 Pa per e-fold between two times, and an equilibrium modulus of 50 Pa. The moduli are exact (Tobolsky's
    box).
    """
    storage = 50 + 50 * np.log((1 + (omega * high) ** 2) / (1 + (omega * low) ** 2))
    loss = 100 * (np.arctan(omega * high) - np.arctan(omega * low))
    factor = 1 + noise * np.random.default_rng(0).standard_normal((2, len(omega)))
    return Sweep(omega, storage * factor[0], loss * factor[1])


def test_a_box_spectrum_is_found_inside_the_box():
    s = box_spectrum(np.geomspace(1e-3, 1e3, 61), 1e-2, 1e2, 0.01)
    found = relaxation_spectrum.fit(s)
    step = np.log(10) / found.per_decade
    inside = (found.times > 0.1) & (found.times < 10)
    assert inside.sum() >= 2 * found.per_decade - 1
    # With 1 % of noise, and smoothing over two steps of the grid, the level of 100 Pa is found to a tenth.
    assert np.allclose(found.strengths[inside], 100 * step, rtol=0.1)
    assert found.strengths[(found.times > 1e3) | (found.times < 1e-3)].sum() < 0.05 * found.strengths.sum()
    assert 3 < found.decades <= 6 and found.effective < len(s.storage) / 2


@pytest.mark.parametrize(("longest", "told"), [(1e4, True), (30.0, False), (1.0, False)])
def test_a_spectrum_says_that_more_may_relax_after_the_test(longest, told):
    """Relaxation continues for four decades below the band, or ends two decades inside it."""
    fit = models.spectrum_fit(box_spectrum(np.geomspace(1e-2, 1e2, 31), 1e-3, longest, 0.01))
    assert any("is unknown how much of this modulus relaxes later" in w for w in fit.warnings) == told


@pytest.mark.parametrize("sd", [None, 0.01, 0.15])
def test_relaxation_after_the_test_is_told_whatever_the_weights(sd):
    s = box_spectrum(np.geomspace(1e-2, 1e2, 31), 1e-3, 1e4, 0.01)
    if sd:
        s = s._replace(storage_sd=sd * s.storage, loss_sd=sd * s.loss)
    assert any("is unknown how much of this modulus relaxes later" in w for w in models.spectrum_fit(s).warnings)


def test_no_start_of_scipy_is_below_the_spectrum():
    s = read_sweep(ROOT / "data" / GIVEN["lion's mane"])
    found = relaxation_spectrum.fit(s)
    scales, data = np.concatenate(s.deviations), np.concatenate([s.storage, s.loss])
    A = generalised_maxwell.mode_columns(s.angular_frequency, found.times) / scales[:, None]
    A, b = np.vstack([A, found.prior]), np.concatenate([data / scales, np.zeros(len(found.prior))])
    ours = 0.5 * np.sum((A @ np.concatenate([[found.equilibrium], found.strengths]) - b) ** 2)
    rng = np.random.default_rng(0)
    for _ in range(10):  # from anywhere to the same minimum, because the problem is convex
        start = rng.uniform(0, 2 * s.storage.max(), A.shape[1])
        bounded = scipy.optimize.least_squares(
            lambda x: A @ x - b, start, lambda x: A, bounds=(0, np.inf), x_scale="jac"
        )
        assert ours <= bounded.cost * (1 + 1e-9)


def test_a_spectrum_has_as_many_parameters_as_the_data_give_it():
    s = box_spectrum(np.geomspace(1e-2, 1e2, 41), 1e-3, 1e3, 0.02)
    stiff, free = (relaxation_spectrum.at(s, 3, w) for w in (1e4, 1e-6))
    assert stiff.effective < 4 < free.effective and stiff.decades > free.decades


def test_evidence_is_the_restricted_likelihood():
    """Compare with Patterson and Thompson (1971, Biometrika 58): strengths are random effects, their straight line is
    fixed.
    """
    rng = np.random.default_rng(0)
    times, m = np.logspace(2, -2, 9), 30
    A = rng.normal(size=(m, 10))
    y = A @ np.linspace(1.0, 3.0, 10) + rng.normal(size=m)
    found, exact = [], []
    for weight in (1e-2, 1.0, 1e3):
        L = relaxation_spectrum.second_differences(9, weight)
        x = np.linalg.solve(A.T @ A + L.T @ L, A.T @ y)
        grid = relaxation_spectrum.GridOfTimes(times, np.ones(10), 2, weight)
        found.append(relaxation_spectrum.described(x, A, A @ x - y, grid).evidence)
        line = np.column_stack([np.eye(10)[:, 0], np.r_[0, np.ones(9)], np.r_[0, np.arange(9.0)]])
        X, Z = A @ line, A @ np.linalg.pinv(L)  # directions without a prior, and effects of unit variance
        V = np.eye(m) + Z @ Z.T
        inner = X.T @ np.linalg.solve(V, X)
        left = y - X @ np.linalg.solve(inner, X.T @ np.linalg.solve(V, y))
        square = left @ np.linalg.solve(V, left)
        exact.append((m - 3) * np.log(square) + np.linalg.slogdet(V)[1] + np.linalg.slogdet(inner)[1])
    assert np.allclose(np.diff(found), np.diff(exact), rtol=1e-9)


def test_intervals_have_the_degrees_of_freedom_of_the_numbers_that_are_fitted():
    """The number of Prony modes that replace the model does not count. Quantiles are those of tables of Student's t."""
    s = fractional_sweep("springpot", 0.01, omega=OMEGA[::2])
    (fit,) = (f for f in models.fractional(s) if f.kind.name == "springpot")
    assert len(s.storage) == 8 and fit.modes > 7  # 16 moduli minus 2 parameters
    assert fit.uncertainty.quantile == fit.parameters.quantile == pytest.approx(2.1448, abs=1e-4)
    fluid = maxwell_fluid(0.01)
    found = models.fluid(fluid, generalised_maxwell.spectrum(fluid))
    assert found.modes == 2 and found.uncertainty.quantile == pytest.approx(2.0017, abs=1e-4)  # 62 minus 4, not 5
