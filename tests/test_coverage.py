"""The study of coverage fits thousands of sweeps at once. Its fits and intervals are those of the program. The study of
a posterior runs the liver with the moduli of the fit.
"""

from types import SimpleNamespace

import numpy as np
import pytest

import liverjax as lj
from experiments.identification import coverage, propagate_posterior
from experiments.liver import models
from fitting.fits import viscoelastic
from fitting.methods import generalised_maxwell, springpots, uncertainty
from fitting.readers.frequency_sweep import Sweep

TRUTH = coverage.truths(np.random.default_rng(0), 6)
DATA = coverage.measured(np.random.default_rng(1), TRUTH, 0)


@pytest.mark.parametrize("modes", [2, 3])
def test_fits_and_intervals_are_those_of_the_program(modes):
    def vector(u):
        return uncertainty.parameter_vector(u, generalised_maxwell.natural)

    found = coverage.fitted(f"prony {modes}", DATA, coverage.OMEGA)
    _, half = coverage.intervals(f"prony {modes}", found, vector)
    for k in (0, 3):
        fit = viscoelastic.closed_form(Sweep(coverage.OMEGA, *np.split(DATA[k], 2)), modes)
        assert found.square[k] == pytest.approx(2 * float(fit.solution.cost), rel=1e-8)
        u = fit.uncertainty
        assert np.allclose(half[k], u.quantile * u.standard_errors, rtol=2e-3)


def test_its_springpot_is_that_of_the_program():
    u = np.array([5.5, 4.5, -0.4])
    (model,) = (m for m in springpots.FRACTIONAL if m.name == "fractional_kelvin_voigt")
    alpha = 1 / (1 + np.exp(0.4))
    G = model.formula(1j * coverage.OMEGA, np.exp(5.5), np.exp(4.5), alpha)
    assert np.allclose(coverage.kelvin_voigt(u, coverage.OMEGA), np.concatenate([G.real, G.imag]), rtol=1e-12)


def test_truths_without_disturbance_are_measured_as_they_are():
    G = TRUTH.moduli(coverage.OMEGA)
    apart = DATA / np.concatenate([G.real, G.imag], axis=1) - 1
    assert apart.std() == pytest.approx(coverage.NOISE, rel=0.15)  # of 372 numbers: known to 4 %


def test_the_liver_of_the_posterior_has_the_fitted_modulus(monkeypatch):
    """Its ground-state shear modulus was 0.8 % above the fitted G0."""
    scene = models()["viscous"]
    points = scene.mesh.points

    def mu_as_motion(_, values):
        """Return runs whose points move by mu."""
        moved = points[None, None] + values["law.mu"][:, None, None, None] * np.array([[[[1.0, 0.0, 0.0]]]])
        return SimpleNamespace(result=SimpleNamespace(positions=moved, status=np.zeros((len(moved), 1), int)))

    rest = SimpleNamespace(check=lambda: SimpleNamespace(positions=points[None]))
    monkeypatch.setattr(propagate_posterior.lj, "simulate", lambda _: rest)
    monkeypatch.setattr(propagate_posterior.lj, "simulate_batch", mu_as_motion)
    run, _, _ = propagate_posterior.liver()
    mu = float(run(np.array([[771.5, 0.2, 0.3, 0.3, 0.03]]))[0, 0])
    law = lj.with_parameters(scene, {"law.mu": mu}).law
    assert float(law.shear_modulus()) == pytest.approx(771.5, rel=1e-9)
