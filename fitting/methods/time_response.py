"""Stress of a driven strain and strain of a driven stress: the generalised Maxwell model in time, in closed form.

Between the points of the input both are linear, and there the convolution is exact. Relaxation is a sum over the modes.
Creep is the same model solved for the strain: with b_i = sqrt(g_i / tau_i) the modes of

    S = b b^T - diag(1 / tau)

are its retardation modes: rates r_k >= 0 and weights (q_k . b)^2 (Gross 1953, Mathematical structure of the theories of
viscoelasticity). A fluid has one rate 0: it flows.
"""

import jax
import jax.numpy as jnp
import numpy as np

from fitting.methods.generalised_maxwell import Maxwell
from fitting.methods.host import Array, arrays_of


def _phi(x: Array) -> tuple[Array, Array]:
    """(1 - e^-x) / x and (x - 1 + e^-x) / x^2, also at 0."""
    xp = arrays_of(x)
    small = x < 1e-3
    safe = xp.where(small, 1.0, x)
    one = xp.where(small, 1 - x / 2 + x**2 / 6 - x**3 / 24, -xp.expm1(-safe) / safe)
    two = xp.where(small, 0.5 - x / 6 + x**2 / 24 - x**3 / 120, (safe + xp.expm1(-safe)) / safe**2)
    return one, two


def stress_response(model: Maxwell, time: jax.Array, strain: jax.Array) -> jax.Array:
    """Shear stress (n,) [Pa] of a strain (n,) that is linear between `time` (n,) [s]; strain[0] is reached at once."""
    rates = 1 / model.relaxation_times

    def step(h, change):
        dt, rise = change
        one, _ = _phi(rates * dt)
        h = jnp.exp(-rates * dt) * h + one * rise
        return h, h

    start = jnp.full_like(rates, 1.0) * strain[0]
    _, h = jax.lax.scan(step, start, (jnp.diff(time), jnp.diff(strain)))
    h = jnp.concatenate([start[None], h])
    rest = 1 - jnp.sum(model.ratios)
    return model.shear_modulus * (rest * strain + h @ model.ratios)


def retardation(model: Maxwell) -> tuple[Array, Array]:
    """Rates (N,) [1/s] and weights (N,) [1/s] of J(t) G0 = 1 + sum w_k (1 - exp(-r_k t)) / r_k."""
    xp = arrays_of(*model)
    b = xp.sqrt(model.ratios / model.relaxation_times)
    minus, q = xp.linalg.eigh(xp.outer(b, b) - xp.diag(1 / model.relaxation_times))
    return xp.maximum(-minus, 0.0), (q.T @ b) ** 2


def strain_response(model: Maxwell, time: jax.Array, stress: jax.Array) -> jax.Array:
    """Shear strain (n,) of a stress (n,) [Pa] that is linear between `time` (n,) [s]; stress[0] is reached at once."""
    rates, weights = retardation(model)

    def step(y, change):
        dt, before, rise = change
        one, two = _phi(rates * dt)
        y = jnp.exp(-rates * dt) * y + dt * (one * before + two * rise)
        return y, y

    start = jnp.zeros_like(rates)
    _, y = jax.lax.scan(step, start, (jnp.diff(time), stress[:-1], jnp.diff(stress)))
    y = jnp.concatenate([start[None], y])
    return (stress + y @ weights) / model.shear_modulus


def relaxation_modulus(model: Maxwell, time: np.ndarray) -> np.ndarray:
    """G(t) (n,) [Pa] after a step of strain."""
    decay = 1 - np.exp(-np.asarray(time)[:, None] / np.asarray(model.relaxation_times))
    return np.asarray(model.shear_modulus) * (1 - decay @ np.asarray(model.ratios))


def creep_compliance(model: Maxwell, time: np.ndarray) -> np.ndarray:
    """J(t) (n,) [1/Pa] after a step of stress."""
    rates, weights = retardation(Maxwell(*map(np.asarray, model)))
    one, _ = _phi(np.asarray(time)[:, None] * rates)
    return (1 + np.asarray(time) * (one @ weights)) / np.asarray(model.shear_modulus)
