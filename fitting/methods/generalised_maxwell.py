"""The generalised Maxwell model: its closed-form moduli, an unconstrained parametrisation, and starting points.

The relaxation modulus is G(t) = G0 (1 - sum_i g_i (1 - exp(-t/tau_i))), see section 5.2 of the chapter. The g_i are
ratios [1] to G0 (Table 2 of the chapter prints the unit Pa). The formulas work with NumPy and JAX arrays, also with
additional leading axes (see `fitting.methods.host`).
"""

from typing import NamedTuple

import numpy as np
import scipy.optimize

from fitting.methods.host import Array, arrays_of
from fitting.readers.frequency_sweep import check_sweep
from fitting.readers.rheometer import WARM, Sweep
from liverjax.core.errors import InputError


class Maxwell(NamedTuple):
    """Parameters of a generalised Maxwell solid with N modes. Relaxation times are in descending order."""

    shear_modulus: Array  # G0, instantaneous [Pa]
    ratios: Array  # g_i (N,)
    relaxation_times: Array  # tau_i (N,) [s]

    @property
    def equilibrium_modulus(self) -> Array:
        """Equilibrium modulus G0 (1 - sum g_i) [Pa]."""
        return self.shear_modulus * (1 - self.ratios.sum(axis=-1))


def moduli(model: Maxwell, omega: Array) -> tuple[Array, Array]:
    """Return storage modulus G' and loss modulus G'' (n,) [Pa] at angular frequencies omega (n,) [rad/s]."""
    xp = arrays_of(model.ratios, omega)
    x = omega[:, None] * model.relaxation_times[..., None, :]
    ratios = model.ratios[..., None, :]
    loss = xp.sum(ratios * x / (1 + x * x), axis=-1)
    storage = 1 - xp.sum(ratios / (1 + x * x), axis=-1)
    shear_modulus = xp.asarray(model.shear_modulus)[..., None]
    return shear_modulus * storage, shear_modulus * loss


def weighed(model: Maxwell, relaxing: float, equilibrium: float) -> Maxwell:
    """Return the model with the moduli of its modes multiplied by `relaxing` and its equilibrium modulus multiplied by
    `equilibrium`."""
    xp = arrays_of(*model)
    G0 = xp.asarray(model.shear_modulus)
    each = relaxing * G0[..., None] * model.ratios
    whole = equilibrium * G0 * (1 - xp.sum(model.ratios, axis=-1)) + xp.sum(each, axis=-1)
    return Maxwell(whole, each / whole[..., None], model.relaxation_times)


def natural(u: Array) -> Maxwell:
    """Return the model from unconstrained parameters u (2N + 1,).

    u contains, in this order: log G0; log(g_i / (1 - sum g)) for the N ratios g_i; the log of the longest time; the
    logs of the N - 1 differences between neighbouring log times. The softmax makes every ratio positive and the sum of
    the ratios smaller than 1. The differences are positive, so the times descend.
    """
    n = (u.shape[-1] - 1) // 2
    return Maxwell(
        arrays_of(u).exp(u[..., 0]), _softmax_shares(u[..., 1 : n + 1])[..., :n], _times_of_gaps(u[..., n + 1 :])
    )


def _softmax_shares(logits: Array) -> Array:
    """Return the softmax (N + 1,) of the logits (N,) and one more logit, which is 0."""
    xp = arrays_of(logits)
    logits = xp.concatenate([logits, xp.zeros((*logits.shape[:-1], 1), logits.dtype)], axis=-1)
    share = xp.exp(logits - xp.max(logits.real, axis=-1, keepdims=True))  # the largest exponential is exp(0)
    return share / xp.sum(share, axis=-1, keepdims=True)


#: Upper bound of the log of the difference between two log times. For larger differences the shorter time is
#: practically 0. The bound prevents an overflow of the exponential.
_FARTHEST = 30.0


def _times_of_gaps(u: Array) -> Array:
    """Return descending relaxation times (N,) [s]. u contains the log of the longest time, then the logs of the
    differences between neighbouring log times."""
    xp = arrays_of(u)
    apart = xp.exp(xp.minimum(u[..., 1:], _FARTHEST))
    gaps = xp.concatenate([xp.zeros_like(u[..., :1]), xp.cumsum(apart, axis=-1)], axis=-1)
    return xp.exp(u[..., :1] - gaps)


def unconstrained(model: Maxwell) -> Array:
    """Return the unconstrained parameters u (2N + 1,) of a model: the inverse of `natural`. Relaxation times are
    sorted. Ratios must be positive, with a sum below 1."""
    xp = arrays_of(*model)
    order = xp.argsort(-xp.asarray(model.relaxation_times))
    g, log_tau = xp.asarray(model.ratios)[order], xp.log(xp.asarray(model.relaxation_times)[order])
    gaps = xp.log(xp.maximum(-xp.diff(log_tau), 1e-3))
    top = xp.log(xp.atleast_1d(model.shear_modulus))
    return xp.concatenate([top, xp.log(g / (1 - g.sum())), log_tau[:1], gaps])


def residuals(u: Array, omega: Array, storage: Array, loss: Array, scales: Array) -> Array:
    """Return the residuals (2n,) at n frequencies: (model - data) / scale, first of G', then of G''. `scales` (2n,)
    [Pa]."""
    xp = arrays_of(u)
    return (xp.concatenate(moduli(natural(u), omega), axis=-1) - xp.concatenate([storage, loss])) / scales


def natural_fluid(u: Array) -> Maxwell:
    """Return the model without an equilibrium modulus from u (2N,). The computation is the same as in `natural`, but
    the ratio of the last mode replaces the equilibrium part."""
    n = u.shape[-1] // 2
    return Maxwell(arrays_of(u).exp(u[..., 0]), _softmax_shares(u[..., 1:n]), _times_of_gaps(u[..., n:]))


def fluid_residuals(u: Array, omega: Array, storage: Array, loss: Array, scales: Array) -> Array:
    """Return the residuals (2n,) of a model without an equilibrium modulus, in the same form as `residuals`."""
    xp = arrays_of(u)
    return (xp.concatenate(moduli(natural_fluid(u), omega), axis=-1) - xp.concatenate([storage, loss])) / scales


def fluid_of(u: np.ndarray) -> np.ndarray:
    """Convert u of `natural` (2N + 1,) to u of `natural_fluid` (2N,). The equilibrium part is removed."""
    n = (len(u) - 1) // 2
    ratios = natural(u).ratios
    return np.concatenate([u[:1], np.log(ratios[:-1] / ratios[-1]), u[n + 1 :]])


def largest_number_of_modes(sweep: Sweep) -> int:
    """Return the largest number N of modes whose 2N + 1 parameters are fewer than the 2n moduli at n different
    frequencies."""
    return len(np.unique(sweep.angular_frequency)) - 1


def mode_columns(omega: np.ndarray, times: np.ndarray) -> np.ndarray:
    """Return the moduli (2n, 1 + K) at n frequencies for K relaxation times, first G', then G''. The first column is
    for an equilibrium modulus of 1 Pa. Each other column is for one mode with a strength of 1 Pa."""
    x = omega[:, None] * times
    bottom = np.column_stack([np.zeros(len(omega)), x / (1 + x**2)])
    return np.vstack([np.column_stack([np.ones(len(omega)), x**2 / (1 + x**2)]), bottom])


class Spectrum(NamedTuple):
    """The best fit of the data with any number of Maxwell modes."""

    times: np.ndarray
    strengths: np.ndarray  # [Pa], >= 0
    equilibrium: float  # [Pa]
    misfit: float  # root mean square of |G* - data| / |data| over the frequencies


def spectrum(sweep: Sweep, per_decade: int = 12) -> Spectrum:
    """Fit a spectrum to a sweep: strengths of modes on a dense grid of relaxation times, by non-negative least squares.
    The grid is two decades wider than the band on each side."""
    omega = sweep.angular_frequency
    low, high = np.log10(1 / omega[-1]) - 2, np.log10(1 / omega[0]) + 2
    times = np.logspace(low, high, int((high - low) * per_decade) + 1)
    size = np.tile(np.hypot(sweep.storage, sweep.loss), 2)
    A, b = mode_columns(omega, times) / size[:, None], np.concatenate([sweep.storage, sweep.loss]) / size
    weights, rest = non_negative(A, b)
    return Spectrum(times, weights[1:], float(weights[0]), float(rest / np.sqrt(len(omega))))


def non_negative(A: np.ndarray, b: np.ndarray) -> tuple[np.ndarray, float]:
    """Return the x >= 0 for which A x is nearest to b, and the distance |A x - b|.

    If relaxation times are close, columns of A are nearly equal, and the active-set method may cycle. Then SciPy's
    bounded least squares is used, which always returns a result.
    """
    norm = np.linalg.norm(A, axis=0)  # with columns of equal length, the active-set method needs few iterations
    norm = np.where(norm > 0, norm, 1.0)
    try:
        x, rest = scipy.optimize.nnls(A / norm, b, maxiter=50 * A.shape[1])
    except RuntimeError:
        x = np.maximum(scipy.optimize.lsq_linear(A / norm, b, bounds=(0, np.inf)).x, 0.0)
        rest = float(np.linalg.norm(A / norm @ x - b))
    return x / norm, float(rest)


#: If the misfit exceeds this value, no number of modes describes the data even roughly: columns or units are wrong.
HOPELESS = 0.3


def refuse_impossible(sweep: Sweep) -> Spectrum:
    """Return the spectrum on the dense grid. Raises `InputError` if no generalised Maxwell solid describes the data
    even roughly."""
    check_sweep(sweep)
    dense = spectrum(sweep)
    if dense.misfit > HOPELESS:
        above = np.median(sweep.loss / sweep.storage)
        warm = next((note for note in sweep.notes if WARM in note), None)
        hint = warm or (
            f"loss_modulus is {above:.1f} times storage_modulus (perhaps the two columns are exchanged, or in "
            "different units)"
            if above > 1
            else "check columns and units"
        )
        raise InputError(
            f"{sweep.source or 'sweep'}: no Maxwell model, with any number of modes, comes closer than "
            f"{100 * dense.misfit:.0f} % to these moduli; {hint}"
        )
    return dense


def starts(sweep: Sweep, modes: int, dense: Spectrum, count: int = 24, seed: int = 0) -> np.ndarray:
    """Return starting points u (count, 2N + 1) of a search for N modes. The relaxation times of the first point are
    evenly spread on the log axis. For the second point, the dense spectrum is divided into N parts of equal strength,
    and each part gives one time. The other points have random log-uniform times.

    For given times, the problem is linear in the strengths, so non-negative least squares gives the strengths.
    """
    omega = sweep.angular_frequency
    low, high = -np.log(omega[-1]) - 0.5, -np.log(omega[0]) + 0.5
    rng = np.random.default_rng(seed)
    times = [np.linspace(low, high, modes + 2)[1:-1], _grouped(dense, modes, low, high)]
    times += [np.sort(rng.uniform(low - 1, high + 1, modes)) for _ in range(count - len(times))]
    return np.stack([_start(sweep, np.exp(np.sort(t)[::-1])) for t in times])


def _grouped(dense: Spectrum, modes: int, low: float, high: float) -> np.ndarray:
    """Divide the spectrum into N = `modes` parts of equal strength. Return the logarithm of one relaxation time for
    each part, or equally spaced logarithms if all strengths are 0."""
    if dense.strengths.sum() <= 0:
        return np.linspace(low, high, modes)
    share = np.cumsum(dense.strengths) / dense.strengths.sum()
    return np.interp((np.arange(modes) + 0.5) / modes, share, np.log(dense.times))


def _start(sweep: Sweep, times: np.ndarray) -> np.ndarray:
    for k in range(1, len(times)):  # keep neighbouring times apart, so that the logs of their differences are finite
        times[k] = min(times[k], times[k - 1] * np.exp(-0.05))
    scale = np.concatenate(sweep.deviations)
    A = mode_columns(sweep.angular_frequency, times) / scale[:, None]
    return start_at_times(times, A, np.concatenate([sweep.storage, sweep.loss]) / scale)


def start_at_times(times: np.ndarray, A: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Return the starting point u (2N + 1,) with the given times (N,) [s]. The equilibrium modulus and the strengths x
    solve A x = b by non-negative least squares."""
    strengths, _ = non_negative(A, b)
    total = strengths.sum()
    share = np.maximum(strengths / total, 0.01)  # a softmax cannot represent zero
    share = share / share.sum()
    return np.asarray(unconstrained(Maxwell(total, share[1:], times)))


def times_over(resolved: tuple[float, float], modes: int, count: int) -> list[np.ndarray]:
    """Return relaxation times (N,) [s], descending, for `count` starting points. The times of the first point are
    evenly spread on the log axis. The times of the other points are random. `resolved`: shortest and longest relaxation
    time [s] that the data resolve."""
    low, high = np.log(resolved)
    rng = np.random.default_rng(0)
    grids = [np.linspace(low, high, modes + 2)[1:-1]]
    grids += [np.sort(rng.uniform(low - 1, high + 1, modes)) for _ in range(count - 1)]
    found = [np.exp(np.sort(grid)[::-1]) for grid in grids]
    for times in found:
        for k in range(1, modes):
            times[k] = min(times[k], 0.9 * times[k - 1])
    return found
