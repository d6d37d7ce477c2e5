"""The closed form in NumPy: the formulas, derivatives and minima that JAX has."""

import jax
import jax.numpy as jnp
import numpy as np
from conftest import COMPILED, ROOT

from fitting.__main__ import main
from fitting.methods import generalised_maxwell, host, uncertainty
from fitting.methods.least_squares import from_starts, levenberg_marquardt, with_jacobian
from fitting.readers.rheometer import read_sweep


def test_numpy_and_jax_run_the_same_formula_and_its_derivative():
    """Derivatives by complex steps are those of forward mode; axes in front are fits side by side."""
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
    """Same minimum, same number of iterations, and a start that leads nowhere is left aside."""
    s = read_sweep(ROOT / "data" / "porcine_liver_frequency_sweep.csv")
    data = (s.angular_frequency, s.storage, s.loss, np.concatenate(s.deviations))
    starts = generalised_maxwell.starts(s, 2, generalised_maxwell.spectrum(s), count=3)
    lost = np.concatenate([starts, [np.full(5, 1e3)]])  # exp(1e3) is infinite
    found = from_starts(generalised_maxwell.residuals, lost, *data)
    each = jax.vmap(lambda u: levenberg_marquardt(generalised_maxwell.residuals, u, *data))(jnp.asarray(starts))
    best = int(np.argmin(each.cost))
    assert bool(found.converged) and abs(int(found.iterations) - int(each.iterations[best])) <= 1
    assert np.allclose(found.u, each.u[best], rtol=1e-7)


def test_the_closed_form_compiles_nothing(tmp_path):
    """Compiling would take longer than all the rest; results and picture included."""
    file, before = ROOT / "data" / "porcine_liver_frequency_sweep.csv", len(COMPILED)
    assert main([str(file), "--method", "closed-form", "--out", str(tmp_path)]) == 0
    assert len(COMPILED) == before
    jax.jit(lambda x: x + 1)(1.0)
    assert len(COMPILED) > before  # it does count
