"""The closed form in NumPy: formulas, derivatives and minima agree with those in JAX."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from conftest import COMPILED, ROOT

from fitting.__main__ import main
from fitting.fits import time_tests
from fitting.methods import generalised_maxwell, host, springpots, time_response, uncertainty
from fitting.methods.least_squares import from_starts, levenberg_marquardt, with_jacobian
from fitting.readers.rheometer import read_sweep


@pytest.mark.ci
def test_numpy_and_jax_run_the_same_formula_and_its_derivative():
    """Derivatives by complex steps agree with forward mode. Leading axes are separate fits."""
    rng = np.random.default_rng(0)
    omega, u = 2 * np.pi * np.logspace(-2, 2, 9), rng.normal(0, 1, (3, 7))
    data = (omega, np.full(9, 300.0), np.full(9, 60.0), np.linspace(20, 90, 18))
    for residuals, v in ((generalised_maxwell.residuals, u), (generalised_maxwell.fluid_residuals, u[:, 1:])):
        r, J = host.with_jacobian(residuals, v, *data)
        for k in range(3):
            expected = with_jacobian(residuals)(jnp.asarray(v[k]), *map(jnp.asarray, data))
            assert np.allclose(r[k], expected[0], rtol=1e-13, atol=1e-13)
            assert np.allclose(J[k], expected[1], rtol=1e-12, atol=1e-13)
    values, slope = host.with_jacobian(uncertainty.parameter_vector, u[0])
    assert np.allclose(slope, jax.jacfwd(uncertainty.parameter_vector)(jnp.asarray(u[0])), rtol=1e-12, atol=1e-300)
    assert type(values) is np.ndarray


def test_the_fit_on_the_host_is_the_compiled_one():
    """Both have the same minimum and number of iterations. A starting point that leads nowhere is ignored."""
    s = read_sweep(ROOT / "data" / "porcine_liver_frequency_sweep.csv")
    data = (s.angular_frequency, s.storage, s.loss, np.concatenate(s.deviations))
    starts = generalised_maxwell.starts(s, 2, generalised_maxwell.spectrum(s), count=3)
    lost = np.concatenate([starts, [np.full(5, 1e3)]])  # exp(1e3) is infinite
    found = from_starts(partial(host.with_jacobian, generalised_maxwell.residuals), lost, *data)
    each = jax.vmap(lambda u: levenberg_marquardt(generalised_maxwell.residuals, u, *data))(jnp.asarray(starts))
    best = int(np.argmin(each.cost))
    assert bool(found.converged) and abs(int(found.iterations) - int(each.iterations[best])) <= 1
    assert np.allclose(found.u, each.u[best], rtol=1e-7)


@pytest.mark.parametrize("case", springpots.FRACTIONAL, ids=lambda case: case.name)
def test_springpots_have_the_derivatives_of_jax(case):
    """Moduli, residuals and reported numbers agree for complex steps and forward mode up to rounding, also for
    exponents near 0.
    """
    rng, reference = np.random.default_rng(0), 3.0
    omega, u = np.logspace(-3, 4, 9), rng.normal(0, 2, (3, len(case.free)))
    u[0] = np.where(np.isin(case.free, (1, 3, 5)), -8.0, u[0])
    data = (omega / reference, np.full(9, 300.0), np.full(9, 60.0), np.linspace(20, 90, 18))
    functions = (
        lambda v: springpots.springpot_residuals(springpots.full(case, v), case.switches, *data),
        lambda v: case.values(springpots.full(case, v), reference),
    )
    for function in functions:
        values, slope = host.with_jacobian(function, u)
        for k in range(3):
            expected, J = function(jnp.asarray(u[k])), jax.jacfwd(function)(jnp.asarray(u[k]))
            assert np.allclose(values[k], expected, rtol=1e-12, atol=1e-13)
            assert np.allclose(slope[k], J, rtol=1e-11, atol=1e-13 * np.abs(J).max())


@pytest.mark.parametrize("model", ["prony", "auto"])
def test_the_closed_form_compiles_nothing(tmp_path, model):
    """Compilation would take longer than the whole command, with results and picture."""
    file, before = ROOT / "data" / "porcine_liver_frequency_sweep.csv", len(COMPILED)
    assert main([str(file), "--method", "closed-form", "--model", model, "--out", str(tmp_path)]) == 0
    assert len(COMPILED) == before
    jax.jit(lambda x: x + 1)(1.0)
    assert len(COMPILED) > before  # the counter works


@pytest.mark.parametrize("kind", ["relaxation", pytest.param("creep", marks=pytest.mark.slow)])
def test_every_model_of_a_test_in_time_compiles_nothing(tmp_path, kind):
    """No model is compiled, springpots and spectra included. Before, a program for each of them took ten seconds."""
    time, file, before = np.geomspace(0.1, 100, 12), tmp_path / "test.csv", len(COMPILED)
    G = 300 + 200 * np.exp(-time / 0.5) + 150 * np.exp(-time / 20)
    name, answer = ("relaxation_modulus_Pa", G) if kind == "relaxation" else ("creep_compliance_1/Pa", 1 / G)
    np.savetxt(file, np.column_stack([time, answer]), delimiter=",", header=f"time_s,{name}", comments="")
    assert main([kind, str(file), "--model", "auto", "--out", str(tmp_path / "out")]) == 0
    assert len(COMPILED) == before


@pytest.mark.parametrize("kind", ["relaxation", "creep"])
@pytest.mark.parametrize("name", ["prony", "prony_fluid"])
def test_the_answers_of_a_test_in_time_have_the_derivatives_of_jax(kind, name):
    """Derivatives by hand agree with forward mode up to rounding. Steps of 1e-7 to 1e4 relaxation times reach all
    branches.
    """
    rng = np.random.default_rng(0)
    times = np.concatenate([[0.0], np.logspace(-6, 3, 70)])
    driven, rows = 0.02 + 0.1 * np.minimum(times / 0.5, 1), np.arange(3, 71, 2)
    data = (times, driven, rows, rng.standard_normal(len(rows)), rng.uniform(0.5, 2, len(rows)))
    maxwell = generalised_maxwell.natural if name == "prony" else generalised_maxwell.natural_fluid
    n = 3
    u = np.concatenate([0.5 * rng.standard_normal(n + (name == "prony")), [3.0, np.log(3.0), np.log(4.0)]])
    function = time_tests._residuals(kind, name)
    expected, slope = with_jacobian(function)(jnp.asarray(u), *map(jnp.asarray, data))
    found, J = time_response.residuals_with_jacobian(kind, maxwell, np.stack([u, u + 0.1]), *data)
    # Rounding of a rate is relative to the largest rate, and acts over the whole test.
    roundoff = 1e-15 if kind == "relaxation" else 2e-16 * times[-1] / maxwell(u).relaxation_times[-1]
    assert np.abs(found[0] - expected).max() < 10 * roundoff * np.abs(expected).max()
    assert np.abs(J[0] - slope).max() < 10 * roundoff * np.abs(slope).max()


@pytest.mark.parametrize("kind", ["relaxation", "creep"])
def test_a_test_in_time_compiles_nothing(tmp_path, kind):
    """There are four fits of modes. Compilation of each would take ten times as long as the rest."""
    t = np.geomspace(0.01, 30, 60)
    answer = 1 + np.exp(-t / 0.2) + np.exp(-t / 5) if kind == "relaxation" else 3 - np.exp(-t / 0.2) - np.exp(-t / 5)
    columns = "time_s,strain,stress_Pa" if kind == "relaxation" else "time_s,stress_Pa,strain"
    table = np.column_stack([t, np.full(60, 0.05), answer * (1 + 0.01 * np.random.default_rng(0).standard_normal(60))])
    np.savetxt(tmp_path / "test.csv", table, "%.10g", ",", header=columns, comments="")
    before = len(COMPILED)
    assert main([kind, str(tmp_path / "test.csv"), "--ramp", "0", "--out", str(tmp_path / "out")]) == 0
    assert len(COMPILED) == before
