"""Noise of different size in G' and G'', or of one size in Pa: checks of the data and of the residuals."""

import numpy as np
import pytest

from fitting.fits import viscoelastic
from fitting.fits.honesty import edges
from fitting.fits.honesty.long_times import INTERVAL
from fitting.fits.together import common_fit
from fitting.methods import generalised_maxwell, uncertainty
from fitting.methods.estimate import wider
from fitting.methods.generalised_maxwell import Maxwell
from fitting.readers.rheometer import Sweep
from fitting.readers.time_tests import TimeTest

pytestmark = pytest.mark.quick_to_compile


def test_noise_with_one_size_in_pascal_is_no_fault_of_the_data_or_of_the_ends_of_the_band():
    """At low frequencies, this noise was taken for the smaller relative scatter of most points. The program warned
    about the ends of the band and about the data. The interval of the equilibrium modulus was narrower than ± one
    standard error.
    """
    omega, times, ratios = 2 * np.pi * np.geomspace(0.01, 100, 25), np.array([0.02, 0.5]), np.array([0.7, 0.295])
    model = Maxwell(np.float64(20000.0), ratios, times)
    G = np.stack(generalised_maxwell.moduli(model, omega))
    for seed in range(4):
        s = Sweep(omega, *(G + 5 * np.random.default_rng(seed).standard_normal((2, 25))))
        dense = generalised_maxwell.spectrum(s)
        fit = edges.honest(viscoelastic.closed_form(s, 2, dense), s, dense)
        assert not [w for w in fit.warnings if "leaving out" in w or "no material" in w or "Kramers" in w]
        interval, (_, error) = fit.details[INTERVAL], edges.values(fit)["equilibrium_modulus"]
        assert interval["low"] < 100 < interval["high"] and interval["high"] - interval["low"] > 2 * error


@pytest.mark.parametrize(("seed", "missed"), [(7, 0.0), (19, 0.0), (1, 0.01)])
def test_noise_of_the_loss_alone_is_no_structure_of_the_storage(seed, missed):
    """Large noise of G'' moves the model, so the residuals of G' with small noise kept their sign. A true misfit of G'
    is still reported."""
    sweep = _with_noisy_loss(seed, missed)
    fit = edges.honest(viscoelastic.closed_form(sweep, 2), sweep, generalised_maxwell.spectrum(sweep))
    assert fit.noise_root is not None
    assert any("structured" in w for w in fit.warnings) == (missed > 0)


@pytest.mark.parametrize(("seed", "missed"), [(19, 0.0), (0, 0.02)])
def test_noise_of_the_loss_is_no_structure_beside_another_test(seed, missed):
    """In a fit of two tests, the same noise of G'' was reported as a structured misfit of G'."""
    sweep, at = _with_noisy_loss(seed, missed), np.append(0.0, np.geomspace(0.02, 100, 30))
    answer = 1000 * (0.3 + 0.4 * np.exp(-at / 0.1) + 0.3 * np.exp(-at / 3))
    answer *= 1 + 0.02 * np.random.default_rng(seed).standard_normal(31)
    fit = common_fit.fit([sweep, TimeTest("relaxation", at, np.ones(31), answer, at > 0, source="relaxation.csv")], 2)
    assert any("structured" in w for w in fit.warnings) == (missed > 0)


def _with_noisy_loss(seed: int, missed: float) -> Sweep:
    """Return a sweep of two modes with a noise of 0.1 % in G' and of 2 % in G''. G' is wrong by the fraction `missed`
    at most, as a smooth curve."""
    omega, times, ratios = 2 * np.pi * np.geomspace(0.01, 31.6, 21), np.array([0.1, 3.0]), np.array([0.4, 0.3])
    model = Maxwell(np.float64(1000.0), ratios, times)
    noise = 1 + np.array([[0.001], [0.02]]) * np.random.default_rng(seed).standard_normal((2, 21))
    storage, loss = generalised_maxwell.moduli(model, omega) * noise
    return Sweep(omega, storage * (1 + missed * np.sin(np.log(omega))), loss)


def test_profile_intervals_have_the_noise_of_both_moduli():
    """With 3 % of noise in G' and 0.3 % in G'', the profile interval of a time was 2.4 times as wide as t times the
    standard error.
    """
    w, rng = np.geomspace(0.1, 100, 31), np.random.default_rng(3)
    storage, loss = generalised_maxwell.moduli(
        Maxwell(np.float64(1000.0), np.array([0.3, 0.4]), np.array([1, 0.05])), w
    )
    s = Sweep(w, storage * (1 + 0.03 * rng.normal(size=31)), loss * (1 + 0.003 * rng.normal(size=31)))
    fit = viscoelastic.closed_form(s, 2)
    assert fit.noise_root is not None
    u = fit.uncertainty
    found = uncertainty.profile_intervals(fit.solution, s, u)
    distances = np.abs(np.array([found[name] for name in u.names]) - u.values[:, None])
    assert np.allclose(distances / (u.quantile * u.standard_errors)[:, None], 1, atol=0.1)
    # An error common to all points still widens the interval.
    wide = uncertainty.profile_intervals(fit.solution, s, wider(u, 2 * u.standard_errors))
    further = np.abs(np.array([wide[name] for name in u.names]) - u.values[:, None])
    assert np.allclose(further / distances, np.sqrt(5), rtol=0.03)
