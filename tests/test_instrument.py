"""Errors common to all points: the inertia that an instrument subtracted, and the gap."""

import json

import h5py
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.optimize

from fitting.__main__ import main
from fitting.fits import compressed_sample, instrument, simulated_rheometer, viscoelastic
from fitting.fits.families import models
from fitting.fits.honesty import moduli_errors
from fitting.methods import generalised_maxwell, uncertainty
from fitting.methods.generalised_maxwell import Maxwell
from fitting.readers.frequency_sweep import Sweep
from fitting.reports import sweep_report
from fitting.rigs import compression
from liverjax import laws
from liverjax.core.plotting import pyplot

pytestmark = pytest.mark.quick_to_compile

OMEGA = np.geomspace(0.1, 100, 31)
SHARE = 20 * OMEGA**2  # [Pa]: 200 kPa at the end, 200 times the sample's modulus
TRUTH = Maxwell(np.float64(800.0), np.array([0.3, 0.3]), np.array([2.0, 0.05]))


def sweep(off: float, seed: int, noise: float = 0.01) -> Sweep:
    """A sweep with two modes. The true inertia exceeds the subtracted one by the fraction `off`."""
    G = generalised_maxwell.moduli(TRUTH, OMEGA)
    factor = 1 + noise * np.random.default_rng(seed).standard_normal((2, len(OMEGA)))
    return Sweep(OMEGA, (G[0] - off * SHARE) * factor[0], G[1] * factor[1], inertia=SHARE)


def corrected(s: Sweep):
    return instrument.without_error_of_inertia(viscoelastic.closed_form(s, 2), s)


#: The second mode is faster than the band of the sweep.
HIDDEN = Maxwell(np.float64(1000.0), np.array([0.3, 0.2]), np.array([2.0, 0.02]))


def sweep_with_hidden_mode() -> Sweep:
    """A sweep of 18 points, 0.5 % noise of the raw torque. The true inertia is 2 % larger than the subtracted one."""
    omega = 2 * np.pi * np.logspace(-2, 0.45, 18)
    share = 2e-5 * omega**2 / (np.pi * 0.01**4 / 2 / 0.004)  # [Pa] at most 1.6 times the modulus
    rng = np.random.default_rng(31)
    storage, loss = generalised_maxwell.moduli(HIDDEN, omega)
    raw = storage + 1j * loss - 1.02 * share
    raw = raw * (1 + 0.005 * rng.standard_normal(18)) * np.exp(0.005j * rng.standard_normal(18))
    G = raw + share
    return Sweep(omega, G.real, G.imag, inertia=share)


@pytest.mark.ci
def test_the_number_of_modes_is_chosen_again_with_the_error_of_the_inertia():
    """An inertia that is 2 % too small made G' fall with the frequency. Two modes did not converge, one mode was kept,
    and G0 was 802 ± 15 Pa. The warning about this was lost.
    """
    s = sweep_with_hidden_mode()
    chosen = viscoelastic.choose_modes(s, generalised_maxwell.spectrum(s))[0]
    fit, _ = instrument.without_error_of_inertia(chosen, s)
    assert (chosen.modes, fit.modes) == (1, 2)
    told, u = fit.details["instrument"], fit.uncertainty
    assert abs(told["inertia_off_by"] - 0.02) < 2 * told["standard_error"] < 0.03
    assert abs(u.values[0] - 1000) < 2 * u.standard_errors[0] < 300
    assert [row["modes"] for row in fit.details["modes_tried"]] == [1, 2, 3]
    # A compressed sample keeps the factors of its compression, with the same modes.
    factors = compression.shares(laws.typical("neo_hookean"), 0.2)
    squeezed, _ = instrument.without_error_of_inertia(compressed_sample.of_compressed_sample(chosen, s, factors), s)
    same = compressed_sample.of_compressed_sample(fit, s, factors)
    assert np.allclose(squeezed.uncertainty.values, same.uncertainty.values, rtol=1e-6)


@pytest.mark.ci
def test_an_impossible_correction_of_the_inertia_is_no_error():
    """More modes are tried from an inertia that is wrong by 3 %. This made the moduli of a good sweep impossible."""
    omega = 2 * np.pi * np.logspace(-2, 1, 12)
    G = np.stack(generalised_maxwell.moduli(HIDDEN, omega))
    G *= 1 + 0.005 * np.random.default_rng(0).standard_normal(12)
    s = Sweep(omega, *G, inertia=22 * G[0, -1] * (omega / omega[-1]) ** 2)
    chosen = viscoelastic.choose_modes(s, generalised_maxwell.spectrum(s))[0]
    fit, _ = instrument.without_error_of_inertia(chosen, s)
    assert abs(fit.model.shear_modulus - 1000) < 5


@pytest.mark.ci
def test_the_error_of_the_inertia_is_found_and_its_standard_error_is_right():
    off = 5e-4
    found = [corrected(sweep(off, seed))[0].details["instrument"] for seed in range(16)]
    z = np.array([(f["inertia_off_by"] - off) / f["standard_error"] for f in found])
    assert abs(z.mean()) < 0.75 and 0.6 < z.std() < 1.5  # of 16: known to 0.25 and 18 %, three of these
    steady = [not f["moves_with_the_band"] for f in found]
    assert np.mean(steady) > 0.8  # two standard errors: 5 % by chance


@pytest.mark.ci
def test_what_is_corrected_comes_nearer_and_has_an_honest_error():
    values = np.array([800, 0.3, 0.3, 2.0, 0.05])
    plain, mended, z = [], [], []
    for seed in range(8):
        s = sweep(5e-4, seed)
        fit, better = corrected(s)
        if better is s:
            continue
        plain.append(np.abs(viscoelastic.closed_form(s, 2).uncertainty.values / values - 1))
        mended.append(np.abs(fit.uncertainty.values / values - 1))
        z.append((fit.uncertainty.values - values) / fit.uncertainty.standard_errors)
        assert (
            "larger than the value that was subtracted" in better.notes[-1]
            and "are corrected for this error" in better.notes[-1]
        )
    assert np.mean(mended) < 0.7 * np.mean(plain)
    assert 0.6 < np.sqrt(np.mean(np.square(z))) < 1.5


def test_a_fit_of_bfgs_has_the_same_errors_of_the_instrument():
    """They were not computed, without a message. BFGS returns its solution as JAX arrays."""
    s = sweep(5e-4, 0)
    found = viscoelastic.closed_form(s, 2)
    start = found._replace(solution=jax.tree.map(jnp.asarray, found.solution))
    fit, better = instrument.without_error_of_inertia(start, s)
    assert better is not s
    same = corrected(s)[0].details["instrument"]
    assert fit.details["instrument"]["inertia_off_by"] == pytest.approx(same["inertia_off_by"], rel=1e-6)


def test_the_other_models_are_fitted_again_after_a_correction():
    """A correction removed the other models, and with them their part of the errors of the moduli."""
    omega = np.geomspace(1, 100, 16)
    share, rng = 4000 * (omega / 100) ** 2, np.random.default_rng(3)
    G = generalised_maxwell.moduli(Maxwell(np.float64(2000.0), np.array([0.25, 0.2]), np.array([0.3, 0.03])), omega)
    storage, loss = (g * (1 + 0.02 * rng.standard_normal(16)) for g in G)
    s = Sweep(omega, storage - 0.03 * share, loss, inertia=share)
    dense = generalised_maxwell.spectrum(s)
    chosen = models.choose(s, "auto", viscoelastic.closed_form(s, 2, dense), dense)
    factors = compression.shares(laws.typical("neo_hookean"), 0.2)
    at_rest = compressed_sample.of_compressed_sample(chosen, s, factors)
    fit, better = instrument.without_error_of_inertia(at_rest, s, factors)
    told = fit.details["instrument"]
    assert abs(told["inertia_off_by"] - 0.03) < 2 * told["standard_error"] < 0.03 and better is not s
    assert [f.kind.name for f in fit.rivals] == [f.kind.name for f in chosen.rivals]
    rows = {row["model"]: row["information_criterion"] for row in fit.details["models_compared"]}
    spectrum = models.spectrum_fit(better)
    assert np.isclose(rows["spectrum"], viscoelastic.information_criterion(spectrum))
    same = compressed_sample.of_compressed_sample(spectrum, better, factors)
    assert np.isclose(fit.rivals[-1].model.shear_modulus, same.model.shear_modulus)
    assert 0.01 < moduli_errors.model_weights(fit)["spectrum"] < 0.5


@pytest.mark.parametrize("modes, words", [(2, "explains the data better than"), (3, "explains the data about as well")])
def test_a_solid_is_named_beside_a_corrected_fluid(modes, words, monkeypatch):
    """The solid had at least as many modes as the fluid, and was never named. Its criterion was up to 55 lower."""
    true = Maxwell(np.float64(1000.0), np.array([0.59, 0.4]), np.array([2.0, 0.02]))
    omega = np.geomspace(0.1, 100, 24)
    storage, loss = generalised_maxwell.moduli(true, omega)
    noise = 1 + 0.005 * np.random.default_rng(0).standard_normal((2, 24))
    s = Sweep(omega, storage * noise[0], loss * noise[1])
    starts = models.starts_of_kind(viscoelastic.FLUID, s, modes, generalised_maxwell.spectrum(s))
    fluid = viscoelastic.modes_from(s, starts, viscoelastic.FLUID)
    fluid = fluid._replace(details={models.TABLE_OF_MODELS: [{"model": "prony", "modes": 2}]})
    monkeypatch.setattr(models, "every_model", lambda sweep, model, prony, dense: [prony])
    found = models.compared_again(fluid, s, lambda fit: fit)
    assert any(w.startswith(f"prony {words}") for w in found.warnings) and found.rivals[0].modes == 2


def test_the_fluid_is_corrected_if_it_is_preferred_to_the_solid():
    """The solid was always taken."""
    omega = np.geomspace(0.1, 100, 16)
    noise = 1 + 0.01 * np.random.default_rng(0).standard_normal((2, 16))
    storage, loss = generalised_maxwell.moduli(Maxwell(np.float64(1000.0), np.array([1.0]), np.array([0.1])), omega)
    s = Sweep(omega, storage * noise[0], loss * noise[1])
    starts = models.starts_of_kind(viscoelastic.FLUID, s, 1, generalised_maxwell.spectrum(s))
    fluid, solid = viscoelastic.modes_from(s, starts, viscoelastic.FLUID), viscoelastic.closed_form(s, 1)
    chosen = fluid._replace(rivals=(solid, fluid), details={models.TABLE_OF_MODELS: []})
    found = models.rival_modes(chosen)
    assert found is not None and found.kind.name == "prony_fluid"


@pytest.mark.parametrize("chosen", ["spectrum", pytest.param("prony_fluid", marks=pytest.mark.ci)])
def test_an_inertia_is_corrected_although_another_model_fits_it(chosen):
    """A spectrum fitted an inertia that was 3.5 % too small as a part of the material, and G0 was 959 ± 161 Pa. A fluid
    kept its single mode, and G0 was 672 ± 43 Pa."""
    omega = np.geomspace(0.1, 100, 24)
    share = (22000 if chosen == "spectrum" else 25000) * (omega / 100) ** 2
    storage, loss = generalised_maxwell.moduli(
        Maxwell(np.float64(1000.0), np.array([0.6, 0.4]), np.array([2.0, 0.02])), omega
    )
    noise = 1 + 0.005 * np.random.default_rng(0 if chosen == "spectrum" else 2).standard_normal((2, 24))
    s = Sweep(omega, (storage - 0.035 * share) * noise[0], loss * noise[1], inertia=share)
    dense = generalised_maxwell.spectrum(s)
    first = models.choose(s, "auto", viscoelastic.choose_modes(s, dense)[0], dense)
    fit, better = instrument.without_error_of_inertia(first, s)
    assert first.kind.name == chosen and better is not s and fit.modes == 2
    assert abs(fit.details["instrument"]["inertia_off_by"] - 0.035) < 1e-3
    assert abs(fit.uncertainty.values[0] - 1000) < 3 * fit.uncertainty.standard_errors[0] < 10
    assert {row["model"] for row in fit.details["models_compared"]} >= {"prony", "prony_fluid", "spectrum"}


def test_springpots_are_not_replaced_by_modes_with_a_false_inertia():
    omega = np.geomspace(0.1, 100, 24)
    G = 100 + 300 * (1j * omega) ** 0.25
    noise = 1 + 0.005 * np.random.default_rng(0).standard_normal((2, 24))
    s = Sweep(omega, G.real * noise[0], G.imag * noise[1], inertia=0.4 * omega**2)
    dense = generalised_maxwell.spectrum(s)
    first = models.choose(s, "auto", viscoelastic.closed_form(s, 3, dense), dense)
    fit, better = instrument.without_error_of_inertia(first, s)
    assert first.kind.name == "fractional_kelvin_voigt" and fit.solution is first.solution and better is s
    assert fit.run_time > first.run_time  # it contains the time of the rejected correction


def test_a_prior_holds_what_the_data_do_not_say():
    s = sweep(0.0, 1)._replace(inertia=1e-9 * SHARE)
    (told,) = [note for note in corrected(s)[1].notes if "inertia" in note]  # this once said "corrected for it"
    assert told.startswith("the data do not determine the instrument's inertia: its standard error is 3")
    found = corrected(s)[0].details["instrument"]
    assert found["standard_error"] == pytest.approx(0.03, rel=1e-6) and abs(found["inertia_off_by"]) < 1e-4


def test_a_misfit_that_poses_as_inertia_is_not_corrected():
    """Two modes cannot follow a springpot. The inertia term would absorb their misfit, more of it in a shorter band."""
    G = 300 + 200 * (1j * OMEGA) ** 0.5
    s = Sweep(OMEGA, G.real, G.imag, inertia=SHARE)
    fit, same = corrected(s)
    assert same is s and fit.details["instrument"]["moves_with_the_band"]
    assert "poses as inertia, and this error is not corrected" in fit.warnings[-1]


FRICTION = 0.4 * OMEGA  # [Pa] for one standard deviation: 40 Pa at the end, half of the loss modulus


@pytest.mark.slow
def test_friction_and_inertia_are_found_together():
    """Both are found within their errors, which are those of least squares with the priors as additional rows."""
    z = []
    for seed in range(8):
        s = sweep(5e-4, seed)._replace(friction=FRICTION, friction_error=2e-7)
        # the friction of the bearing exceeds the subtracted one by 0.7 deviations
        s = s._replace(loss=s.loss + 0.7 * FRICTION)
        fit, _ = corrected(s)
        found = fit.details["instrument"]
        z.append(
            [
                (found["inertia_off_by"] - 5e-4) / found["standard_error"],
                (found["friction_off_by_N_m_s"] - 1.4e-7) / found["friction_standard_error"],
            ]
        )
    assert np.all(np.abs(np.mean(z, axis=0)) < 1.1) and 0.5 < np.std(z) < 1.6
    assert 0 < found["friction_standard_error"] < 0.2 * found["friction_prior_standard_deviation"] == 4e-8


def test_the_error_of_friction_is_that_of_scipy():
    s = sweep(0.0, 3)._replace(inertia=None, friction=FRICTION, friction_error=2e-7)
    s = s._replace(loss=s.loss + 0.7 * FRICTION)
    found, better = corrected(s)
    noise = found.uncertainty.noise

    def rows(v):
        storage, loss = generalised_maxwell.moduli(generalised_maxwell.natural(v[:-1]), OMEGA)
        off = (storage - s.storage) / better.storage_sd, (loss + v[-1] * FRICTION - s.loss) / better.loss_sd
        return np.append(np.concatenate(off) / noise, v[-1])

    start = np.append(np.asarray(found.solution.u), 0.0)
    best = scipy.optimize.least_squares(rows, start, x_scale="jac", xtol=1e-14, ftol=1e-14)
    error = np.sqrt(np.linalg.inv(best.jac.T @ best.jac)[-1, -1])
    numbers = found.details["instrument"]
    assert numbers["friction_off_by_N_m_s"] == pytest.approx(2e-7 * best.x[-1], abs=0.01 * 2e-7 * error)
    assert numbers["friction_standard_error"] == pytest.approx(2e-7 * error, rel=0.01)
    assert (
        "the instrument's friction is 1" in better.notes[-1]
        and "larger than the value that was subtracted" in better.notes[-1]
    )


@pytest.mark.slow
@pytest.mark.parametrize("size", [2.0, 40.0])
def test_a_friction_above_the_loss_modulus_is_found(size):
    """The first linear step is far too long. The noise is 0.4 % of the measured values with friction."""
    z = []
    for seed in range(6):
        draws = 1 + 0.004 * np.random.default_rng(seed).standard_normal((2, len(OMEGA)))
        storage, loss = generalised_maxwell.moduli(TRUTH, OMEGA)
        s = Sweep(OMEGA, storage * draws[0], (loss + size * OMEGA) * draws[1])
        fit, _ = corrected(s._replace(friction=size * OMEGA, friction_error=2e-5))
        found = fit.details["instrument"]
        assert not found["moves_with_the_band"] and found["friction_off_by_N_m_s"] == pytest.approx(2e-5, rel=0.1)
        z.append((fit.uncertainty.values - [800, 0.3, 0.3, 2.0, 0.05]) / fit.uncertainty.standard_errors)
    assert 0.5 < np.sqrt(np.mean(np.square(z))) < 1.6


def test_exact_data_have_exact_errors_of_the_instrument():
    storage, loss = generalised_maxwell.moduli(TRUTH, OMEGA)
    for size in (0.0, 0.3):
        s = Sweep(OMEGA, storage, loss + size * FRICTION, friction=FRICTION, friction_error=2e-7)
        fit, _ = corrected(s)
        found = fit.details["instrument"]
        assert found["friction_off_by_N_m_s"] == pytest.approx(size * 2e-7, abs=1e-12)
        assert not any("was not found" in w for w in fit.warnings)


def test_a_misfit_is_told_after_a_correction_too():
    """G'' keeps its weight. A corrected sweep is not one whose phase scatters."""
    G = 300 + 100 * (1j * OMEGA) ** 0.4
    s = Sweep(OMEGA, G.real, G.imag, friction=1e-3 * FRICTION, friction_error=1e-9)
    fit, better = corrected(s)
    plain = viscoelastic.closed_form(s._replace(friction=None), 2)
    assert not better.sd_estimated and not better.noise_given
    for f in (plain, fit):
        assert any(w.startswith(viscoelastic.MISSES) for w in f.warnings) == any(
            w.startswith(viscoelastic.MISSES) for w in plain.warnings
        )
    assert fit.uncertainty.noise == pytest.approx(plain.uncertainty.noise, rel=0.2)


def test_errors_of_the_instrument_that_are_not_found_are_not_called_zero(monkeypatch):
    monkeypatch.setattr(instrument, "ROUNDS", 1)
    s = sweep(5e-4, 0)._replace(friction=FRICTION, friction_error=2e-7)
    fit, same = corrected(s)
    assert same is s and "inertia and friction was not found together with the modes" in fit.warnings[-1]
    known = instrument.InstrumentErrors(np.ones(1), np.eye(1), np.ones(1), np.ones(1), True)
    assert known.steady.all() and not known._replace(found=False).steady.any()


@pytest.mark.ci
def test_the_command_fits_friction_and_refuses_it_without_a_size(tmp_path, capsys):
    s = sweep(0.0, 3)
    head = "angular_frequency_rad_s,storage_modulus_Pa,loss_modulus_Pa"
    np.savetxt(tmp_path / "s.csv", np.column_stack(s[:3]), delimiter=",", header=head, comments="")
    words = [str(tmp_path / "s.csv"), "--method", "closed-form", "--friction-error", "1e-6", "--out", str(tmp_path)]
    assert main([*words, "--radius", "0.01", "--height", "0.004"]) == 0
    found = json.loads((tmp_path / "fit.json").read_text())["details"]["instrument"]
    assert found["friction_prior_standard_deviation"] == 1e-6
    assert abs(found["friction_off_by_N_m_s"]) < 4 * found["friction_standard_error"]
    assert main(words) == 2 and "give a positive number, e.g. 1e-7, and --radius" in capsys.readouterr().err
    sized = [*words, "--radius", "0.01", "--height", "0.004"]
    assert main([*sized, "--model", "auto"]) == 2 and "or --model auto" in capsys.readouterr().err


@pytest.mark.parametrize("off", [0.0, 0.06])
def test_an_error_that_cannot_be_checked_is_in_the_standard_errors(off):
    """The band of half a decade allows no shorter fit. A warning said that a misfit poses as inertia, even for an
    error of 0. For an error of 6 %, G0 was 1409 ± 43 Pa."""
    omega = np.geomspace(5, 15, 10)
    storage, loss = generalised_maxwell.moduli(Maxwell(np.float64(1600.0), np.array([0.375]), np.array([0.1])), omega)
    share = 8000 * (omega / 15) ** 2
    noise = 1 + 0.005 * np.random.default_rng(0).standard_normal((2, 10))
    s = Sweep(omega, (storage - off * share) * noise[0], loss * noise[1], inertia=share)
    fit, same = instrument.without_error_of_inertia(viscoelastic.closed_form(s, 1), s)
    told = fit.details["instrument"]
    assert same is s and told["could_not_be_checked"] and not told["moves_with_the_band"]
    assert abs(fit.uncertainty.values[0] - 1600) < 2 * fit.uncertainty.standard_errors[0]
    assert ["cannot check this error" in w for w in fit.warnings if "inertia" in w] == ([True] if off else [])
    known, values = instrument.used_errors(fit, s)  # a posterior contains this error, too
    assert [n.name for n in known] == ["inertia"] and np.all(values == 0)


@pytest.mark.parametrize(("inertia", "friction"), [(0.01, 1.0), (-0.02, 3.0), (0.06, -1.0)])
def test_two_errors_of_exact_data_are_in_the_standard_errors(inertia, friction):
    """Their covariance is singular except for rounding, and its Cholesky decomposition ended in LinAlgError."""
    omega = np.geomspace(5, 15, 10)
    storage, loss = generalised_maxwell.moduli(Maxwell(np.float64(1600.0), np.array([0.375]), np.array([0.1])), omega)
    share, rubbing = 8000 * (omega / 15) ** 2, 10 * omega / 15
    s = Sweep(omega, storage - inertia * share, loss + friction * rubbing, inertia=share)
    s = s._replace(friction=rubbing, friction_error=2e-7)
    fit, _ = instrument.without_error_of_inertia(viscoelastic.closed_form(s, 1), s)
    assert fit.details["instrument"]["could_not_be_checked"]
    assert abs(fit.uncertainty.values[0] - 1600) < 1.5 * fit.uncertainty.standard_errors[0] < 400


def test_without_raw_columns_nothing_happens():
    s = sweep(5e-4, 0)._replace(inertia=None)
    fit = viscoelastic.closed_form(s, 2)
    assert instrument.without_error_of_inertia(fit, s) == (fit, s)


def test_the_error_of_the_gap_is_that_of_the_moduli_alone():
    fit = viscoelastic.closed_form(sweep(0.0, 0), 2)
    wide = instrument.with_gap_error(fit, 0.05)
    old, new = fit.uncertainty.standard_errors, wide.uncertainty.standard_errors
    assert new[0] == pytest.approx(np.hypot(old[0], 0.05 * fit.uncertainty.values[0]))
    assert np.allclose(new[1:], old[1:])
    assert np.allclose(np.diag(wide.uncertainty.correlation), 1)


@pytest.mark.slow
def test_the_simulation_has_the_errors_of_gap_and_instrument_too():
    """Mesh and steps change nothing by more than a tenth of an error, so the errors are those of the closed form."""
    s = sweep(5e-4, 3, noise=0.03)._replace(friction=FRICTION, friction_error=2e-7)
    fit, better = corrected(s)
    alone = uncertainty.estimate(fit.solution, False).standard_errors
    closed = instrument.with_gap_error(fit, 0.03)
    simulation = simulated_rheometer.Simulation(cell_size=0.004, steps=100)
    found = simulated_rheometer.through_torsion(better, closed, simulation)
    assert closed.uncertainty.standard_errors[-1] > 1.4 * alone[-1]  # by the instrument: the gap does not change a time
    assert found.uncertainty.standard_errors == pytest.approx(closed.uncertainty.standard_errors, rel=0.02)
    assert found.details["gap_error"] == 0.03


def end_of_profile(fit: viscoelastic.Fit, better: Sweep, gap: float, side: int) -> float:
    """Return one end of the 95 % interval of G0. SciPy fits all other numbers, with the gap and the inertia and their
    priors.
    """
    noise, names = fit.uncertainty.noise, ("inertia_off_by", "prior_standard_deviation")
    told = fit.details.get("instrument")
    before = 0.0 if told is None else told[names[0]] / told[names[1]]
    moved = np.zeros(len(OMEGA)) if told is None else told[names[1]] * better.inertia
    scales = better.deviations

    def rows(v, G0):
        *others, inertia, off = v
        u = np.array([np.log(G0 / (1 + gap * off)), *others])
        storage, loss = generalised_maxwell.moduli(generalised_maxwell.natural(u), OMEGA)
        apart = (storage - better.storage - inertia * moved) / scales[0], (loss - better.loss) / scales[1]
        return np.concatenate([*apart, noise * np.array([inertia + before, off])]) / noise

    def cost(G0):
        start = np.append(np.asarray(fit.solution.u)[1:], [0.0, 0.0])
        return 2 * scipy.optimize.least_squares(rows, start, args=(G0,), x_scale="jac", xtol=1e-12, ftol=1e-12).cost

    G0, error = fit.uncertainty.values[0], fit.uncertainty.standard_errors[0]
    best, q = cost(G0), fit.uncertainty.quantile
    return scipy.optimize.brentq(lambda x: cost(x) - best - q**2, G0, G0 + 2 * side * q * error, rtol=1e-6)


@pytest.mark.parametrize(("gap", "share"), [(0.05, 1e-9), (1e-12, 0.3), (0.003, 0.3)])
def test_a_profile_has_the_error_of_the_gap_and_of_the_inertia(gap, share):
    s = sweep(0.0, 3)._replace(inertia=share * SHARE)
    fit, better = corrected(s)
    fit = instrument.with_gap_error(fit, gap)
    low, high = uncertainty.profile_intervals(fit.solution, better, fit.uncertainty)["shear_modulus"]
    for side, end in ((-1, low), (1, high)):
        exact = end_of_profile(fit, better, gap, side) - fit.uncertainty.values[0]
        # The chords of the grid leave 0.5 % of the half width. The rest is of second order in the errors (of 1 %).
        assert end - fit.uncertainty.values[0] == pytest.approx(exact, rel=0.02), (end, exact)


def test_weights_are_no_standard_deviations_of_the_data(tmp_path):
    """For a sweep without standard deviations, fit.png showed bars of 100 %, and fit.h5 contained these weights. The
    run time was that of the last fit alone.
    """
    s = sweep(0.0, 0)._replace(inertia=None, friction=FRICTION, friction_error=2e-7)
    start = viscoelastic.closed_form(s, 2)._replace(run_time=100.0)
    fit, better = instrument.without_error_of_inertia(start, s)
    assert better.sd_before and fit.run_time > 100
    sweep_report.write(tmp_path, better, [fit], None)
    with h5py.File(tmp_path / "fit.h5") as file:
        assert set(file["data"]) == {"angular_frequency", "storage", "loss"}
    (top, rest), known = pyplot().figure().subplots(2, 1), better._replace(sd_before=False)
    for data, label in ((better, "G' measured"), (known, "G' measured ± sd")):
        sweep_report.draw_moduli(top, rest, data, [fit])
        assert top.get_legend_handles_labels()[1].count(label) == 1


def test_the_command_widens_the_errors_by_the_gap(tmp_path, capsys):
    s = sweep(0.0, 0)
    head = "angular_frequency_rad_s,storage_modulus_Pa,loss_modulus_Pa"
    np.savetxt(tmp_path / "s.csv", np.column_stack(s[:3]), delimiter=",", header=head, comments="")
    plain = [str(tmp_path / "s.csv"), "--method", "closed-form", "--modes", "2", "--height", "0.004"]
    errors = []
    for more in ([], ["--gap-error", "4e-4"]):
        assert main([*plain, *more, "--out", str(tmp_path)]) == 0
        content = json.loads((tmp_path / "fit.json").read_text())
        errors.append(content["standard_errors"])
    low, high = content["equilibrium_modulus_interval_95"]  # it did not contain the error of the gap
    assert (high - low) / 2 == pytest.approx(1.96 * errors[1]["equilibrium_modulus"], rel=0.05)
    assert errors[1]["shear_modulus"] == pytest.approx(np.hypot(errors[0]["shear_modulus"], 80), rel=0.02)
    assert errors[1]["equilibrium_modulus"] == pytest.approx(np.hypot(errors[0]["equilibrium_modulus"], 32), rel=0.05)
    assert errors[1]["ratios"] == pytest.approx(errors[0]["ratios"])
    for wrong in ("0.005", "-1"):
        assert main([*plain, "--gap-error", wrong, "--out", str(tmp_path)]) == 2
        assert "must be 0 or more and below --height" in capsys.readouterr().err
