"""Errors of fitted moduli: those of repeated measurements, including the choice of the model."""

import json

import numpy as np
import pytest

from fitting.__main__ import main
from fitting.fits import compressed_sample, instrument, viscoelastic
from fitting.fits.families import models
from fitting.fits.honesty import moduli_errors
from fitting.methods import generalised_maxwell
from fitting.methods.estimate import wider
from fitting.methods.generalised_maxwell import Maxwell
from fitting.readers.frequency_sweep import Sweep
from fitting.rigs import compression

pytestmark = pytest.mark.quick_to_compile

OMEGA, NOISE = np.geomspace(0.1, 100, 31), 0.02
MODE = Maxwell(np.float64(700.0), np.array([0.5]), np.array([0.3]))


def measured(G: np.ndarray, seed: int) -> Sweep:
    """A sweep with complex moduli and noise, without stated deviations."""
    halves = np.stack([G.real, G.imag])
    return Sweep(OMEGA, *(halves * (1 + NOISE * np.random.default_rng(seed).standard_normal(halves.shape))))


def one_mode(seed: int) -> Sweep:
    storage, loss = generalised_maxwell.moduli(MODE, OMEGA)
    return measured(storage + 1j * loss, seed)


@pytest.mark.slow
def test_of_one_model_they_are_those_of_repeated_measurements():
    at, repeats = np.array([0.1, 3.0, 300.0]), 80  # the last frequency is beyond the band
    found = [moduli_errors.fitted_moduli(viscoelastic.closed_form(one_mode(k), 1), at, False) for k in range(repeats)]
    spread = np.std([f.values for f in found], axis=0, ddof=1)
    stated = np.mean([f.standard_errors for f in found], axis=0)
    # A deviation from 80 draws has an error of 1 / sqrt(2 * 79). Four times this is allowed.
    assert np.all(np.abs(spread / stated - 1) < 4 / np.sqrt(2 * (repeats - 1)))


@pytest.fixture(scope="module")
def chosen() -> viscoelastic.Fit:
    """A solid whose equilibrium modulus is too small for the noise. A fluid and a spectrum fit the data, too."""
    model = Maxwell(np.float64(700.0), np.array([0.999]), np.array([3.0]))
    storage, loss = generalised_maxwell.moduli(model, OMEGA)
    sweep = measured(storage + 1j * loss, 3)
    dense = generalised_maxwell.spectrum(sweep)
    rivals = (models.fluid(sweep, dense), models.spectrum_fit(sweep))
    return viscoelastic.closed_form(sweep, 1)._replace(rivals=rivals)


def test_the_choice_of_the_model_is_among_them(chosen):
    """Compute Buckland's formula by hand: weighted variances and squared differences."""
    weights = moduli_errors.model_weights(chosen)
    assert len(weights) > 1 and sum(weights.values()) == pytest.approx(1, abs=1e-3)
    assert next(iter(weights)) == chosen.kind.name and all(0 < w < 1 for w in weights.values())
    alone = {f.kind.name: f._replace(rivals=()) for f in (chosen, *chosen.rivals)}
    each = {name: moduli_errors.fitted_moduli(alone[name], OMEGA, False) for name in weights}
    values = each[chosen.kind.name].values
    variance = sum(w * (each[n].standard_errors ** 2 + (each[n].values - values) ** 2) for n, w in weights.items())
    found = moduli_errors.fitted_moduli(chosen, OMEGA, False)
    np.testing.assert_array_equal(found.values, values)
    np.testing.assert_allclose(found.standard_errors, np.sqrt(variance), rtol=1e-10)
    # The criterion is corrected for few data, and uses sums of squares alone. It counts the size of the noise.
    rss = [np.sum(np.asarray(f.solution.residuals)[:62] ** 2) for f in alone.values()]
    k = [1 + (len(f.solution.u) if f.kind.effective is None else f.kind.effective) for f in alone.values()]
    aicc = np.array([62 * np.log(s / 62) + 2 * n + 2 * n * (n + 1) / (62 - n - 1) for s, n in zip(rss, k, strict=True)])
    by_hand = np.exp(-0.5 * (aicc - aicc.min()))
    by_hand = dict(zip(alone, by_hand / by_hand.sum(), strict=True))
    assert all(weights[name] == pytest.approx(by_hand[name], abs=1e-3) for name in weights)


def test_the_size_of_the_noise_counts_as_a_parameter():
    """Without it, models with many parameters had too much weight in short sweeps."""
    omega, rng = np.geomspace(0.3, 30, 5), np.random.default_rng(0)
    G = 300 + 500 * (1j * omega) ** 0.3
    noise = 1 + 0.02 * rng.standard_normal((2, 5))
    sweep = Sweep(omega, G.real * noise[0], G.imag * noise[1])
    rival, fit = (viscoelastic.closed_form(sweep, modes) for modes in (1, 2))
    rss = [float(np.sum(np.asarray(f.solution.residuals) ** 2)) for f in (fit, rival)]
    aicc = [10 * np.log(s / 10) + 2 * k + 2 * k * (k + 1) / (10 - k - 1) for s, k in zip(rss, (6, 4), strict=True)]
    assert moduli_errors._akaike(fit) - moduli_errors._akaike(rival) == pytest.approx(aicc[0] - aicc[1], rel=1e-9)


def repeated(seed: int) -> Sweep:
    """Four repeats at each of 12 frequencies. The error of 5 % is common to the repeats; 0.3 % is independent."""
    rng, omega = np.random.default_rng(seed), np.repeat(OMEGA[::3][:10], 4)
    halves = np.stack(generalised_maxwell.moduli(MODE, omega))
    common = np.repeat(1 + 0.05 * rng.standard_normal((2, 10)), 4, axis=1)
    return Sweep(omega, *(halves * common * (1 + 0.003 * rng.standard_normal((2, 40)))))


def uneven(seed: int) -> Sweep:
    """The noise of G' is 0.2 %, and that of G'' is 5 %."""
    halves = np.stack(generalised_maxwell.moduli(MODE, OMEGA))
    size = np.array([0.002, 0.05])[:, None]
    return Sweep(OMEGA, *(halves * (1 + size * np.random.default_rng(seed).standard_normal((2, 31)))))


@pytest.mark.parametrize("made", [repeated, uneven])
def test_noise_that_the_residuals_show_is_in_them(made):
    """Only the errors of the parameters contained this noise. The errors of the moduli were half as large as their
    scatter, or twice as large."""
    found = []
    for k in range(30):
        s = made(k)
        found.append(moduli_errors.fitted_moduli(viscoelastic.closed_form(s, 1), OMEGA[::10], s.noise_given))
    scatter = np.std([f.values for f in found], axis=0, ddof=1)
    ratio = scatter / np.median([f.standard_errors for f in found], axis=0)
    # A deviation from 30 draws has an error of 1 / sqrt(58) = 13 %. The errors contain Student's t of 10 series.
    assert np.all((ratio > 0.6) & (ratio < 1.5)), ratio


def test_factors_of_a_compressed_sample_that_change_nothing_keep_the_errors():
    """The errors for independent noise replaced the errors for the noise that the residuals show."""
    s = repeated(0)
    fit = viscoelastic.closed_form(s, 1)
    same = compressed_sample.of_compressed_sample(fit, s, compression.Shares(1.0, 1.0))
    np.testing.assert_allclose(same.uncertainty.standard_errors, fit.uncertainty.standard_errors, rtol=1e-6)


def test_the_ratio_of_a_compressed_fluid_with_one_mode_is_exactly_one():
    """Its error became infinite, and a warning advised to measure more."""
    model = Maxwell(np.float64(700.0), np.array([1.0]), np.array([0.3]))
    storage, loss = generalised_maxwell.moduli(model, OMEGA)
    s = measured(storage + 1j * loss, 1)
    fit = viscoelastic.modes_from(s, np.log([[700.0, 0.3]]), viscoelastic.FLUID)
    at_rest = compressed_sample.of_compressed_sample(fit, s, compression.Shares(1.1, 0.9))
    assert at_rest.uncertainty.values[1] == 1 and at_rest.uncertainty.standard_errors[1] == 0
    assert not any("ratios[0]" in told for told in at_rest.warnings)
    np.testing.assert_allclose(at_rest.uncertainty.values[0], fit.uncertainty.values[0] / 1.1)


def test_the_error_of_the_gap_is_in_all_of_them(chosen):
    alone, wide = chosen, instrument.with_gap_error(chosen, 0.03)
    a, b = (moduli_errors.fitted_moduli(fit, OMEGA, False) for fit in (alone, wide))
    np.testing.assert_allclose(b.standard_errors, np.hypot(a.standard_errors, 0.03 * a.values), rtol=1e-12)


def test_errors_of_the_instrument_are_those_of_the_modes():
    """A systematic error shifts all modes at once. The moduli change by as much as the shifted modes change them."""
    fit, move = viscoelastic.closed_form(one_mode(0), 1), np.array([7.0, 0.01, -0.02])
    wide = fit._replace(uncertainty=wider(fit.uncertainty, move))
    a, b = (moduli_errors.fitted_moduli(f, OMEGA, False).standard_errors for f in (fit, wide))
    ends = [
        np.concatenate(generalised_maxwell.moduli(Maxwell(p[0], p[1:2], p[2:]), OMEGA))
        for p in (fit.uncertainty.values + sign * 1e-4 * move for sign in (1, -1))
    ]
    # Central differences have an error of the step squared, 1e-8, and of rounding over the step.
    np.testing.assert_allclose(np.sqrt(b**2 - a**2), np.abs(ends[0] - ends[1]) / 2e-4, rtol=1e-6, atol=1e-6)


def test_fit_json_has_them(tmp_path):
    sweep = one_mode(0)
    rows = [f"{w:.12g},{a:.12g},{b:.12g}" for w, a, b in zip(*sweep[:3], strict=True)]
    (tmp_path / "a.csv").write_text("\n".join(["angular_frequency_rad/s,storage_Pa,loss_Pa", *rows]) + "\n")
    asked = ["--method", "closed-form", "--modes", "1", "--out", str(tmp_path / "out")]
    assert main([str(tmp_path / "a.csv"), *asked]) == 0
    content = json.loads((tmp_path / "out" / "fit.json").read_text())["moduli"]
    exact = generalised_maxwell.moduli(MODE, np.array(content["angular_frequency"]))
    for name, true in zip(("storage", "loss"), exact, strict=True):
        off = np.abs(np.array(content[name]) - true) / np.array(content["standard_errors"][name])
        assert 0 < off.max() < 5
    assert content["weights_of_models"] == {}
