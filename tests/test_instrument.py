"""Errors that all points share: the inertia that an instrument subtracted, and the gap."""

import json

import numpy as np
import pytest
import scipy.optimize

from fitting.__main__ import main
from fitting.fits import instrument, viscoelastic
from fitting.methods import generalised_maxwell
from fitting.methods.generalised_maxwell import Maxwell
from fitting.readers.frequency_sweep import Sweep

pytestmark = pytest.mark.quick_to_compile

OMEGA = np.geomspace(0.1, 100, 31)
SHARE = 20 * OMEGA**2  # [Pa]: 200 kPa at the end, 200 times the sample
TRUTH = Maxwell(np.float64(800.0), np.array([0.3, 0.3]), np.array([2.0, 0.05]))


def sweep(off: float, seed: int, noise: float = 0.01) -> Sweep:
    """Two modes, measured where the inertia is really larger by `off` than what was subtracted."""
    G = generalised_maxwell.moduli(TRUTH, OMEGA)
    factor = 1 + noise * np.random.default_rng(seed).standard_normal((2, len(OMEGA)))
    return Sweep(OMEGA, (G[0] - off * SHARE) * factor[0], G[1] * factor[1], inertia=SHARE)


def corrected(s: Sweep):
    return instrument.without_error_of_inertia(viscoelastic.closed_form(s, 2), s)


def test_the_error_of_the_inertia_is_found_and_its_standard_error_is_right():
    off = 5e-4
    found = [corrected(sweep(off, seed))[0].details["instrument"] for seed in range(16)]
    z = np.array([(f["inertia_off_by"] - off) / f["standard_error"] for f in found])
    assert abs(z.mean()) < 0.75 and 0.6 < z.std() < 1.5  # of 16: 0.25 and 18 %, three of them
    steady = [not f["moves_with_the_band"] for f in found]
    assert np.mean(steady) > 0.8  # two standard errors: 5 % by chance


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
        assert "are corrected for it" in better.notes[-1]
    assert np.mean(mended) < 0.7 * np.mean(plain)
    assert 0.6 < np.sqrt(np.mean(np.square(z))) < 1.5


def test_a_prior_holds_what_the_data_do_not_say():
    s = sweep(0.0, 1)._replace(inertia=1e-9 * SHARE)
    found = corrected(s)[0].details["instrument"]
    assert found["standard_error"] == pytest.approx(0.03, rel=1e-6) and abs(found["inertia_off_by"]) < 1e-4


def test_a_misfit_that_poses_as_inertia_is_not_corrected():
    """A springpot followed by two modes: the term would take up what they miss, more of it the shorter the band."""
    G = 300 + 200 * (1j * OMEGA) ** 0.5
    s = Sweep(OMEGA, G.real, G.imag, inertia=SHARE)
    fit, same = corrected(s)
    assert same is s and fit.details["instrument"]["moves_with_the_band"]
    assert "poses as inertia, so it is not corrected" in fit.warnings[-1]


FRICTION = 0.4 * OMEGA  # [Pa] by one standard deviation: 40 Pa at the end, half of the loss modulus


def test_friction_and_inertia_are_found_together():
    """Both within their errors, which are those of least squares with the priors as rows."""
    z = []
    for seed in range(8):
        s = sweep(5e-4, seed)._replace(friction=FRICTION, friction_error=2e-7)
        s = s._replace(loss=s.loss + 0.7 * FRICTION)  # the bearing has 0.7 deviations more than what was subtracted
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
        off = (storage - s.storage) / better.storage, (loss + v[-1] * FRICTION - s.loss) / better.loss
        return np.append(np.concatenate(off) / noise, v[-1])

    start = np.append(np.asarray(found.solution.u), 0.0)
    best = scipy.optimize.least_squares(rows, start, x_scale="jac", xtol=1e-14, ftol=1e-14)
    error = np.sqrt(np.linalg.inv(best.jac.T @ best.jac)[-1, -1])
    numbers = found.details["instrument"]
    # The scales follow the correction in the one, and stay in the other: of second order, some percent.
    assert numbers["friction_off_by_N_m_s"] == pytest.approx(2e-7 * best.x[-1], abs=0.2 * 2e-7 * error)
    assert numbers["friction_standard_error"] == pytest.approx(2e-7 * error, rel=0.05)
    assert "the friction that the instrument subtracted" in better.notes[-1]


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
    assert main([*sized, "--model", "auto"]) == 2 and "leave out --model auto" in capsys.readouterr().err


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


def test_the_command_widens_the_errors_by_the_gap(tmp_path, capsys):
    s = sweep(0.0, 0)
    head = "angular_frequency_rad_s,storage_modulus_Pa,loss_modulus_Pa"
    np.savetxt(tmp_path / "s.csv", np.column_stack(s[:3]), delimiter=",", header=head, comments="")
    plain = [str(tmp_path / "s.csv"), "--method", "closed-form", "--modes", "2", "--height", "0.004"]
    errors = []
    for more in ([], ["--gap-error", "4e-4"]):
        assert main([*plain, *more, "--out", str(tmp_path)]) == 0
        errors.append(json.loads((tmp_path / "fit.json").read_text())["standard_errors"])
    assert errors[1]["shear_modulus"] == pytest.approx(np.hypot(errors[0]["shear_modulus"], 80), rel=0.02)
    assert errors[1]["equilibrium_modulus"] == pytest.approx(np.hypot(errors[0]["equilibrium_modulus"], 32), rel=0.05)
    assert errors[1]["ratios"] == pytest.approx(errors[0]["ratios"])
    for wrong in ("0.005", "-1"):
        assert main([*plain, "--gap-error", wrong, "--out", str(tmp_path)]) == 2
        assert "is the gap's standard deviation in metres" in capsys.readouterr().err
