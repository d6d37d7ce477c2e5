"""Closed-form response of the generalised Maxwell model in time: stress for a given strain, strain for a given stress.

The input is linear between its points. For such an input, the convolution is exact. In relaxation, the stress is a sum
over the modes. In creep, the same equation is solved for the strain. With b_i = sqrt(g_i / tau_i), the eigenvalues -r_k
and eigenvectors q_k of

    S = b b^T - diag(1 / tau)

give the retardation modes, with rates r_k >= 0 and weights (q_k . b)^2 (Gross 1953, Mathematical structure of the
theories of viscoelasticity). For a fluid, one rate is 0, because a fluid flows without limit.

Fits compute the same responses in NumPy, with analytical derivatives (`residuals_with_jacobian`), so that nothing is
compiled. The recursion (the update of the history variables of viscosity from step to step) also computes its
derivatives in every step. The derivatives of the retardation modes are the first-order changes of eigenvalues and
eigenvectors of S. If all relaxation times are different, all eigenvalues of S are different.
"""

from collections.abc import Callable
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from fitting.methods import host
from fitting.methods.generalised_maxwell import Maxwell
from fitting.methods.host import Array, arrays_of
from fitting.methods.uncertainty import parameter_vector


def _phi(x: Array) -> tuple[Array, Array]:
    """Return phi_1 = (1 - e^-x) / x and phi_2 = (x - 1 + e^-x) / x^2, with their limits at x = 0."""
    xp = arrays_of(x)
    small = x < 1e-3
    # x is limited to 1e100, so that its powers stay finite.
    near, safe = xp.where(small, x, 0.0), xp.where(small, 1.0, xp.where(x > 1e100, 1e100, x))
    one = xp.where(small, 1 - near / 2 + near**2 / 6 - near**3 / 24, -xp.expm1(-safe) / safe)
    two = xp.where(small, 0.5 - near / 6 + near**2 / 24 - near**3 / 120, (safe + xp.expm1(-safe)) / safe**2)
    return one, two


def stress_response(model: Maxwell, time: jax.Array, strain: jax.Array) -> jax.Array:
    """Return the shear stress (n,) [Pa] for a strain (n,) that is linear between the times (n,) [s]. strain[0] is
    applied as a step at the first time."""
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
    """Return rates r (N,) [1/s] and weights w (N,) [1/s] of the creep compliance J: J(t) G0 = 1 + sum w_k (1 - exp(-r_k
    t)) / r_k."""
    xp = arrays_of(*model)
    b = xp.sqrt(model.ratios / model.relaxation_times)
    minus, q = xp.linalg.eigh(xp.outer(b, b) - xp.diag(1 / model.relaxation_times))
    return xp.maximum(-minus, 0.0), (q.T @ b) ** 2


def strain_response(model: Maxwell, time: jax.Array, stress: jax.Array) -> jax.Array:
    """Return the shear strain (n,) for a stress (n,) [Pa] that is linear between the times (n,) [s]. stress[0] is
    applied as a step at the first time."""
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
    """Return the relaxation modulus G(t) (n,) [Pa] after a step of strain."""
    decay = 1 - np.exp(-np.asarray(time)[:, None] / np.asarray(model.relaxation_times))
    return np.asarray(model.shear_modulus) * (1 - decay @ np.asarray(model.ratios))


def creep_compliance(model: Maxwell, time: np.ndarray) -> np.ndarray:
    """Return the creep compliance J(t) (n,) [1/Pa] after a step of stress."""
    rates, weights = retardation(Maxwell(*map(np.asarray, model)))
    one, _ = _phi(np.asarray(time)[:, None] * rates)
    return (1 + np.asarray(time) * (one @ weights)) / np.asarray(model.shear_modulus)


# -- in NumPy, with derivatives ----------------------------------------------------------------------------------------


def residuals_with_jacobian(
    kind: str, maxwell: Callable[[np.ndarray], Maxwell], u: np.ndarray, *data: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return the residuals (…, m) of a relaxation or creep test and their derivatives (…, m, P) with respect to u.

    Args:
        kind: "relaxation" or "creep".
        maxwell: function from u to Prony modes.
        u: unknowns (…, P).
        data: times (n,) [s]; imposed strain or stress (n,); indices (m,) of the times with a measured response;
            measured responses (m,); their scales (m,).
    """
    time, driven, rows, answer, scales = data
    modes, slope = host.with_jacobian(partial(parameter_vector, maxwell=maxwell), u)
    n = modes.shape[-1] // 2
    model = Maxwell(modes[..., 0], modes[..., 1 : n + 1], modes[..., n + 1 :])
    driven_by = _driven_stress if kind == "relaxation" else _driven_strain
    values, by_u = driven_by(Slopes(model, slope), time, driven, rows)
    values, by_u = np.moveaxis(values, 0, -1), np.moveaxis(by_u, 0, -2)
    return (values - answer) / scales, by_u / scales[:, None]


class Slopes(NamedTuple):
    """Prony modes, and the derivatives (…, 2N + 1, P) of G0, ratios and times with respect to u."""

    model: Maxwell
    by_u: np.ndarray


def _driven_stress(at: Slopes, time: np.ndarray, strain: np.ndarray, rows: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the stress (m, …) [Pa] at the m times `time[rows]` for a given strain, and its derivatives (m, …, P) with
    respect to u."""
    model = at.model
    G0, g, tau = model.shear_modulus[..., None], model.ratios, model.relaxation_times
    rise = np.diff(strain)
    h, by_rate = _memory_of_modes(1 / tau, np.diff(time), strain[0], rise, np.zeros(len(rise)))
    h, by_rate = h[rows], by_rate[rows]
    driven = strain[rows].reshape(-1, *(1,) * g.ndim)
    relaxed = (1 - g.sum(axis=-1, keepdims=True)) * driven + np.sum(g * h, axis=-1, keepdims=True)
    by_modes = np.concatenate([relaxed, G0 * (h - driven), -G0 * g / tau**2 * by_rate], axis=-1)
    return (G0 * relaxed)[..., 0], (by_modes[..., None, :] @ at.by_u)[..., 0, :]


def _driven_strain(at: Slopes, time: np.ndarray, stress: np.ndarray, rows: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the strain (m, …) at the m times `time[rows]` for a given stress [Pa], and its derivatives (m, …, P) with
    respect to u."""
    G0 = at.model.shear_modulus[..., None]
    rates, weights, of_rates, of_weights = _retardation(at)
    dt = np.diff(time)
    y, by_rate = _memory_of_modes(rates, dt, 0.0, dt * stress[:-1], dt * np.diff(stress))
    y, by_rate = y[rows], by_rate[rows]
    driven = stress[rows].reshape(-1, *(1,) * weights.ndim)
    strain = (driven + np.sum(weights * y, axis=-1, keepdims=True)) / G0
    by_modes = y[..., None, :] @ of_weights + (weights * by_rate)[..., None, :] @ of_rates
    return strain[..., 0], (by_modes[..., 0, :] - strain * at.by_u[..., 0, :]) / G0


def _memory_of_modes(
    rates: np.ndarray, dt: np.ndarray, start: float, step: np.ndarray, ramp: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return the history variable h (n, …, N) of N modes at n times, and its derivative dh/drate. The recursion is
    h_(j+1) = e^-x h_j + phi_1(x) step_j + phi_2(x) ramp_j, with x = rate dt_j and phi_1, phi_2 of `_phi`."""
    intervals = (-1, *(1,) * rates.ndim)
    dt, step, ramp = (a.reshape(intervals) for a in (dt, step, ramp))
    x = dt * rates
    decay, (one, two) = np.exp(-x), _phi(x)
    of_one, of_two = _slopes_of_phi(x, one, two)
    added, of_added = one * step + two * ramp, dt * (of_one * step + of_two * ramp)
    h, by_rate = np.empty((len(x) + 1, *rates.shape)), np.zeros((len(x) + 1, *rates.shape))
    h[0] = start
    for j in range(len(x)):
        h[j + 1] = decay[j] * h[j] + added[j]
        by_rate[j + 1] = decay[j] * (by_rate[j] - dt[j] * h[j]) + of_added[j]
    return h, by_rate


def _slopes_of_phi(x: np.ndarray, one: np.ndarray, two: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the derivatives of phi_1 and phi_2 (`_phi`) with respect to x, with their limits at x = 0."""
    small = x < 1e-2
    far, near = np.where(small, 1.0, x), [np.polynomial.polynomial.polyval(np.where(small, x, 0.0), c) for c in _SLOPES]
    of_one, of_two = (np.exp(-far) - one) / far, (one - 2 * two) / far
    return np.where(small, near[0], of_one), np.where(small, near[1], of_two)


#: Coefficients of the Taylor series of the derivatives of phi_1 and phi_2. For x below 1e-2, the first omitted term is
#: below 1e-16.
_SLOPES = (
    [-1 / 2, 1 / 3, -1 / 8, 1 / 30, -1 / 144, 1 / 840, -1 / 5760],
    [-1 / 6, 1 / 12, -1 / 40, 1 / 180, -1 / 1008, 1 / 6720, -1 / 51840],
)


def _retardation(at: Slopes) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Return retardation rates and weights (…, N) [1/s], and the derivatives (…, N, P) of both with respect to u."""
    g, tau = at.model.ratios, at.model.relaxation_times
    of_g, of_tau = np.split(at.by_u[..., 1:, :], 2, axis=-2)
    b = np.sqrt(g / tau)
    n = np.arange(g.shape[-1])
    S = b[..., :, None] * b[..., None, :]
    S[..., n, n] -= 1 / tau
    known = np.all(np.isfinite(S), axis=(-2, -1), keepdims=True)  # overflow occurs only at a bad trial point
    eigenvalues, Q = np.linalg.eigh(np.where(known, S, 0.0))
    Q = np.where(known, Q, np.nan)
    c = np.einsum("...ik,...i->...k", Q, b)
    # Derivatives with respect to every unknown u_p: of b, of the components of b along the eigenvectors, and of -1/tau.
    of_b = b[..., None] * (of_g / (2 * g[..., None]) - of_tau / (2 * tau[..., None]))
    along, of_diagonal = np.swapaxes(Q, -1, -2) @ of_b, np.swapaxes(of_tau / tau[..., None] ** 2, -1, -2)
    # M: q_l . (dS/du_p) q_k, with the axes (…, p, l, k).
    a = np.swapaxes(along, -1, -2)
    M = np.swapaxes(Q, -1, -2)[..., None, :, :] @ (of_diagonal[..., None] * Q[..., None, :, :])
    M += a[..., :, None] * c[..., None, None, :] + c[..., None, :, None] * a[..., None, :]
    apart = eigenvalues[..., None, :] - eigenvalues[..., :, None]  # differences of the eigenvalues (…, l, k)
    apart[..., n, n] = np.inf
    of_c = a + (c[..., None, None, :] @ (M / apart[..., None, :, :]))[..., 0, :]
    of_rates = -np.swapaxes(M[..., n, n], -1, -2)
    return np.maximum(-eigenvalues, 0.0), c**2, of_rates, 2 * c[..., None] * np.swapaxes(of_c, -1, -2)
