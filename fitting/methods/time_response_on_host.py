"""`fitting.methods.time_response` in NumPy with derivatives by hand, for fits: nothing is compiled.

The derivatives follow the recursions. Those of the retardation modes are the first-order changes of eigenvalues and
eigenvectors of S, whose eigenvalues differ where the relaxation times do.
"""

from collections.abc import Callable
from functools import partial

import numpy as np

from fitting.methods import host
from fitting.methods.generalised_maxwell import Maxwell
from fitting.methods.uncertainty import parameter_vector


def residuals_with_jacobian(
    kind: str, maxwell: Callable[[np.ndarray], Maxwell], u: np.ndarray, *data: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Residuals (…, m) of a test in time and their derivative (…, m, P).

    Args:
        kind: "relaxation" or "creep".
        maxwell: u -> Prony modes.
        u: (…, P).
        data: times (n,) [s]; what is driven (n,); rows (m,) that are answered; answers (m,); their scales (m,).
    """
    time, driven, rows, answer, scales = data
    modes, slope = host.with_jacobian(partial(parameter_vector, maxwell=maxwell), u)
    n = modes.shape[-1] // 2
    model = Maxwell(modes[..., 0], modes[..., 1 : n + 1], modes[..., n + 1 :])
    values, by_modes = (_stress if kind == "relaxation" else _strain)(model, time, driven, rows)
    values, by_modes = np.moveaxis(values, 0, -1), np.moveaxis(by_modes, 0, -2)
    return (values - answer) / scales, by_modes @ slope / scales[:, None]


def _stress(model: Maxwell, time: np.ndarray, strain: np.ndarray, rows: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Stress (m, …) [Pa] of a driven strain, and its derivative by G0, ratios and times (m, …, 2N + 1)."""
    G0, g, tau = model.shear_modulus[..., None], model.ratios, model.relaxation_times
    rise = np.diff(strain)
    h, by_rate = _recursion(1 / tau, np.diff(time), strain[0], rise, np.zeros(len(rise)))
    h, by_rate = h[rows], by_rate[rows]
    driven = strain[rows].reshape(-1, *(1,) * g.ndim)
    relaxed = (1 - g.sum(axis=-1, keepdims=True)) * driven + np.sum(g * h, axis=-1, keepdims=True)
    slopes = [relaxed, G0 * (h - driven), -G0 * g / tau**2 * by_rate]
    return (G0 * relaxed)[..., 0], np.concatenate(slopes, axis=-1)


def _strain(model: Maxwell, time: np.ndarray, stress: np.ndarray, rows: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Strain (m, …) of a driven stress [Pa], and its derivative by G0, ratios and times (m, …, 2N + 1)."""
    G0 = model.shear_modulus[..., None]
    rates, weights, of_rates, of_weights = _retardation(model)
    dt = np.diff(time)
    y, by_rate = _recursion(rates, dt, 0.0, dt * stress[:-1], dt * np.diff(stress))
    y, by_rate = y[rows], by_rate[rows]
    driven = stress[rows].reshape(-1, *(1,) * weights.ndim)
    strain = (driven + np.sum(weights * y, axis=-1, keepdims=True)) / G0
    by_modes = np.einsum("m...k,...kp->m...p", y, of_weights) + np.einsum(
        "m...k,...kp->m...p", weights * by_rate, of_rates
    )
    return strain[..., 0], np.concatenate([-strain / G0, by_modes / G0], axis=-1)


def _recursion(
    rates: np.ndarray, dt: np.ndarray, start: float, step: np.ndarray, ramp: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """h (n, …, N) with h_(j+1) = e^-x h_j + phi_1(x) step_j + phi_2(x) ramp_j at x = rate dt_j, and dh/drate."""
    intervals = (-1, *(1,) * rates.ndim)
    dt, step, ramp = (a.reshape(intervals) for a in (dt, step, ramp))
    x = dt * rates
    decay, (one, two, of_one, of_two) = np.exp(-x), _phi(x)
    added, of_added = one * step + two * ramp, dt * (of_one * step + of_two * ramp)
    h, by_rate = np.empty((len(x) + 1, *rates.shape)), np.zeros((len(x) + 1, *rates.shape))
    h[0] = start
    for j in range(len(x)):
        h[j + 1] = decay[j] * h[j] + added[j]
        by_rate[j + 1] = decay[j] * (by_rate[j] - dt[j] * h[j]) + of_added[j]
    return h, by_rate


def _phi(x: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """(1 - e^-x) / x and (x - 1 + e^-x) / x^2, also at 0, and their derivatives."""
    small = x < 1e-2
    far = np.where(small, 1.0, x)
    one = -np.expm1(-far) / far
    two = (1 - one) / far
    of_one, of_two = (np.exp(-far) - one) / far, (one - 2 * two) / far
    series = [np.polynomial.polynomial.polyval(np.where(small, x, 0.0), c) for c in _SERIES]
    return tuple(np.where(small, near, own) for near, own in zip(series, (one, two, of_one, of_two), strict=True))


#: Coefficients of the Taylor series of `_phi`: below 1e-2 the first one left out is below 1e-16.
_SERIES = (
    [1, -1 / 2, 1 / 6, -1 / 24, 1 / 120, -1 / 720, 1 / 5040],
    [1 / 2, -1 / 6, 1 / 24, -1 / 120, 1 / 720, -1 / 5040, 1 / 40320],
    [-1 / 2, 1 / 3, -1 / 8, 1 / 30, -1 / 144, 1 / 840, -1 / 5760],
    [-1 / 6, 1 / 12, -1 / 40, 1 / 180, -1 / 1008, 1 / 6720, -1 / 51840],
)


def _retardation(model: Maxwell) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Rates and weights (…, N) [1/s], and the derivative of both by ratios and relaxation times (…, N, 2N)."""
    g, tau = model.ratios, model.relaxation_times
    b = np.sqrt(g / tau)
    n = np.arange(g.shape[-1])
    S = b[..., :, None] * b[..., None, :]
    S[..., n, n] -= 1 / tau
    known = np.all(np.isfinite(S), axis=(-2, -1), keepdims=True)  # a trial that overflows is a bad one, not an error
    eigenvalues, Q = np.linalg.eigh(np.where(known, S, 0.0))
    Q = np.where(known, Q, np.nan)
    c = np.einsum("...ik,...i->...k", Q, b)
    # Of every number p of mode i: db_i/dp, and what p changes in the diagonal of -1/tau.
    of_b = np.concatenate([b / (2 * g), -b / (2 * tau)], axis=-1)
    of_diagonal = np.concatenate([np.zeros_like(tau), 1 / tau**2], axis=-1)
    at = np.swapaxes(np.concatenate([Q, Q], axis=-2), -1, -2)  # (…, k, p): Q_ik of the mode of p
    # q_l . (dS/dp) q_k, (…, l, k, p).
    outer = at[..., :, None, :] * c[..., None, :, None] + c[..., :, None, None] * at[..., None, :, :]
    M = of_b[..., None, None, :] * outer + of_diagonal[..., None, None, :] * at[..., :, None, :] * at[..., None, :, :]
    apart = eigenvalues[..., None, :] - eigenvalues[..., :, None]  # (…, l, k)
    apart[..., n, n] = np.inf
    of_c = of_b[..., None, :] * at + np.einsum("...lkp,...lk,...l->...kp", M, 1 / apart, c)
    return np.maximum(-eigenvalues, 0.0), c**2, -M[..., n, n, :], 2 * c[..., None] * of_c
