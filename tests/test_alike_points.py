"""Correlated noise of neighbouring frequencies in a sweep: intervals contain the truth; independent noise is
unchanged.
"""

import json

import numpy as np
import pytest

from fitting.__main__ import main
from fitting.fits import viscoelastic
from fitting.fits.honesty import alike_points, edges
from fitting.fits.honesty.long_times import INTERVAL
from fitting.fits.honesty.moduli_errors import fitted_moduli
from fitting.fits.instrument import with_gap_error
from fitting.methods import generalised_maxwell, kramers_kronig
from fitting.methods.estimate import LEAST_FREEDOM, freedom_of_alike
from fitting.methods.generalised_maxwell import Maxwell
from fitting.methods.uncertainty import equilibrium_error
from fitting.readers.frequency_sweep import Sweep

pytestmark = pytest.mark.quick_to_compile

OMEGA = 2 * np.pi * np.geomspace(0.01, 30, 30)
TRUTH = Maxwell(np.float64(1500.0), np.array([0.2, 0.45]), np.array([0.5, 0.03]))
NUMBERS = np.array([1500, 0.2, 0.45, 0.5, 0.03])


def drifting(seed: int, length: float) -> Sweep:
    """A sweep with 3 % of noise whose correlation falls as exp(-rows / length); G' and G'' have independent draws."""
    rows = np.arange(len(OMEGA))
    C = np.exp(-np.abs(rows[:, None] - rows) / length) if length else np.eye(len(OMEGA))
    noise = 0.03 * np.linalg.cholesky(C) @ np.random.default_rng(seed).standard_normal((len(OMEGA), 2))
    storage, loss = generalised_maxwell.moduli(TRUTH, OMEGA)
    return Sweep(OMEGA, storage * (1 + noise[:, 0]), loss * (1 + noise[:, 1]))


@pytest.mark.slow
def test_errors_of_a_drift_hold_the_truth():
    """Test 24 sweeps. With errors of independent noise, only half of the intervals contained the parameters."""
    before, after = [], []
    for seed in range(24):
        s = drifting(seed, 5.0)
        plain = viscoelastic.closed_form(s, 2)
        for hits, fit in ((before, plain), (after, alike_points.with_alike_points(plain, s))):
            u = fit.uncertainty
            hits.append(np.abs(u.values - NUMBERS) < u.quantile * u.standard_errors)
    assert np.mean(before) < 0.7 and np.mean(after) > 0.82
    assert fit.warnings[-1].startswith(alike_points.SHARED) and fit.details[alike_points.INDEPENDENT] < 30


def test_quantiles_are_those_of_independent_moduli():
    """The degrees of freedom were those of all moduli, so four of five parameters were too often outside."""
    found = []
    for seed in range(4):
        s = drifting(seed, 10.0)
        fit = alike_points.with_alike_points(viscoelastic.closed_form(s, 2), s)
        found.append((fit.details[alike_points.INDEPENDENT], fit.uncertainty.freedom))
        assert fitted_moduli(fit, OMEGA[:2], False).freedom == fit.uncertainty.freedom
    independent, freedom = np.array(found).T
    assert np.array_equal(freedom, np.maximum(independent - 5, LEAST_FREEDOM))
    assert freedom.min() == 3 and 3 < freedom.max() < 40
    assert freedom_of_alike(2.0, 7, 6.0) == 2.0  # never more than with independent noise


@pytest.mark.slow
def test_independent_noise_and_exact_data_change_nothing():
    for seed in range(20):
        s = drifting(seed, 0.0)
        fit = viscoelastic.closed_form(s, 2)
        assert alike_points.with_alike_points(fit, s) is fit
    storage, loss = generalised_maxwell.moduli(TRUTH, OMEGA)
    fit = viscoelastic.closed_form(Sweep(OMEGA, storage, loss), 2)
    assert alike_points.with_alike_points(fit, Sweep(OMEGA, storage, loss)) is fit


def test_healthy_fluids_share_no_noise():
    """At an equilibrium modulus of 0, the derivatives lose one direction. Without a treatment of this case, 12 of 40
    such sweeps were classified as correlated.
    """
    w = 2 * np.pi * np.geomspace(0.01, 10, 25)
    G = sum(g * 1j * w * tau / (1 + 1j * w * tau) for g, tau in ((600.0, 1.0), (400.0, 0.05)))
    for seed in range(10):
        noise = 1 + 0.01 * np.random.default_rng(seed).standard_normal((2, 25))
        s = Sweep(w, G.real * noise[0], G.imag * noise[1])
        for kind in (None, viscoelastic.FLUID):
            fit = viscoelastic.closed_form(s, 2)
            if kind is not None:
                start = generalised_maxwell.fluid_of(np.asarray(fit.solution.u))[None]
                fit = viscoelastic.modes_from(s, start, kind)
            assert alike_points.with_alike_points(fit, s) is fit, (seed, kind)


def test_what_is_written_agrees(tmp_path):
    """The warning on structured residuals, the interval, and the errors of the moduli all include the
    correlated noise.
    """
    s = drifting(3, 5.0)
    fit = edges.honest(viscoelastic.closed_form(s, 2), s, generalised_maxwell.spectrum(s))
    plain = viscoelastic.closed_form(s, 2)
    wider = fit.uncertainty.standard_errors[0] / plain.uncertainty.standard_errors[0]
    assert wider > 1.2
    told = [w for w in fit.warnings if w.startswith((alike_points.SHARED, "structured misfit"))]
    assert len(told) == 1 and not any(kramers_kronig.NOT_CONTAINED in w for w in fit.warnings)
    ends = fit.details[INTERVAL]
    assert ends["high"] - ends["low"] > 2 * equilibrium_error(fit.uncertainty)
    moduli = [fitted_moduli(f, OMEGA, False).standard_errors for f in (fit, plain)]
    assert np.mean(moduli[0] / moduli[1]) > 1.2 and np.all(moduli[0] >= 0.999 * moduli[1])


def test_the_error_of_the_gap_is_added_as_before():
    s = drifting(1, 5.0)
    plain = alike_points.with_alike_points(viscoelastic.closed_form(s, 2), s).uncertainty
    wide = alike_points.with_alike_points(with_gap_error(viscoelastic.closed_form(s, 2), 0.1), s).uncertainty
    G0 = plain.values[0]
    assert wide.standard_errors[0] == pytest.approx(np.hypot(plain.standard_errors[0], 0.1 * G0), rel=1e-9)
    np.testing.assert_allclose(wide.standard_errors[1:], plain.standard_errors[1:], rtol=1e-9)


@pytest.mark.slow
def test_a_posterior_says_that_it_takes_noise_as_independent(tmp_path):
    s = drifting(3, 5.0)
    head = "angular_frequency_rad_s,storage_modulus_Pa,loss_modulus_Pa"
    np.savetxt(tmp_path / "s.csv", np.column_stack(s[:3]), delimiter=",", header=head, comments="")
    words = [str(tmp_path / "s.csv"), "--method", "closed-form", "--modes", "2", "--samples", "100"]
    main([*words, "--out", str(tmp_path)])
    content = json.loads((tmp_path / "fit.json").read_text())
    assert content["details"][alike_points.INDEPENDENT] < 40
    assert any("assumes independent noise of all moduli" in w for w in content["warnings"])


def test_one_repeated_frequency_keeps_the_correction():
    """Before, one repeated frequency switched off the correction and its warning."""
    s = drifting(3, 5.0)
    s = s._replace(**{q: np.insert(v, 10, 0.98 * v[10]) for q, v in zip(Sweep._fields[1:3], s[1:3], strict=True)})
    s = s._replace(angular_frequency=np.insert(OMEGA, 10, OMEGA[10]))
    plain = viscoelastic.closed_form(s, 2)
    fit = alike_points.with_alike_points(plain, s)
    assert fit.warnings[-1].startswith(alike_points.SHARED)
    assert fit.uncertainty.standard_errors[0] > 1.5 * plain.uncertainty.standard_errors[0]
