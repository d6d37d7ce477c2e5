"""Fractional models in closed form, made of springs and springpots.

A springpot has the complex modulus V (i omega)^alpha. It lies between a spring (alpha = 0) and a dashpot (alpha = 1).
Sources: Bagley and Torvik (1983), J. Rheol. 27; Schiessel et al. (1995), J. Phys. A 28. All models here are special
cases of one model:

    G* = E (i omega)^gamma + 1 / (1 / (V (i omega)^alpha) + 1 / (W (i omega)^beta))     gamma, beta < alpha

A model may lack some of the six parameters E, V, W, alpha, beta and gamma. The code divides frequencies by the middle
of the band, x = omega / reference, so that all fits have similar starting points and scales. Real and imaginary parts
are computed separately, in NumPy or JAX. The vector u of the unknowns may have additional leading axes (see
`fitting.methods.host`).
"""

from collections.abc import Callable
from functools import partial
from typing import NamedTuple

import numpy as np

from fitting.methods import host
from fitting.methods.generalised_maxwell import Maxwell
from fitting.methods.host import Array, arrays_of
from fitting.methods.least_squares import Solution, from_starts
from fitting.readers.rheometer import Sweep

#: Number of entries of the vector u of unknowns: log E, logit(gamma / alpha), log V, logit(alpha), log W, logit(beta /
#: alpha).
SIZE = 6
#: Index of logit(alpha) in u. Alpha is the larger exponent if a model has two.
LARGER = 3


class Fractional(NamedTuple):
    """One fractional model: indices of the entries of u that are free, reported parameters, and formulas."""

    name: str
    free: tuple[int, ...]  # indices in u
    names: tuple[str, ...]
    units: tuple[str, ...]
    values: Callable[[Array, float], Array]  # (all six entries of u, reference frequency [rad/s]) -> parameters (P,)
    formula: Callable[..., np.ndarray]  # (i omega, parameters) -> G* [Pa], as in the literature

    @property
    def solid(self) -> bool:
        """Whether the model has an equilibrium modulus."""
        return 0 in self.free and 1 not in self.free

    @property
    def switches(self) -> np.ndarray:
        """Four numbers (4,), each 1 or 0: whether the model has E, gamma, W and beta."""
        return np.array([float(k in self.free) for k in (0, 1, 4, 5)])


def _orders(u: Array) -> tuple[Array, Array, Array]:
    """Return the exponents alpha, beta and gamma."""
    xp = arrays_of(u)
    alpha, beta, gamma = (0.5 * (1 + xp.tanh(0.5 * u[..., k])) for k in (3, 5, 1))
    return alpha, alpha * beta, alpha * gamma


def moduli(u: Array, switches: Array, x: Array, angle: float = 0.5 * np.pi) -> tuple[Array, Array]:
    """Return real and imaginary part (n,) [Pa] of G* at the complex frequency s, from all six entries of u.

    x (n,) is |s| / reference, and `angle` is the argument of s. `switches`: see `Fractional.switches`. The default
    angle means s = i omega, which gives G' and G''.
    """
    xp = arrays_of(u, x)
    alpha, beta, gamma = (exponent[..., None] for exponent in _orders(u))
    gamma, beta = switches[1] * gamma, switches[3] * beta
    # E, V and W are logarithms of absolute moduli. The compliance of each springpot is multiplied by the smaller of
    # both moduli to prevent overflow.
    E, V, W = (u[..., k, None] + n * xp.log(x) for k, n in ((0, gamma), (2, alpha), (4, beta)))
    least = xp.where(switches[2] > 0, xp.minimum(V.real, W.real), V.real)
    own, in_row = xp.exp(least - V), switches[2] * xp.exp(least - W)
    real = own * xp.cos(angle * alpha) + in_row * xp.cos(angle * beta)
    imaginary = own * xp.sin(angle * alpha) + in_row * xp.sin(angle * beta)
    row, beside = xp.exp(least) / (real * real + imaginary * imaginary), switches[0] * xp.exp(E)
    return beside * xp.cos(angle * gamma) + row * real, beside * xp.sin(angle * gamma) + row * imaginary


#: DENSE: number of relaxation times per decade in `as_modes`. BEYOND: number of decades by which these times extend
#: below the shortest and above the longest time of a response.
DENSE, BEYOND = 6, (3.0, 3.0)


def times_of_modes(low: float, high: float) -> np.ndarray:
    """Return K relaxation times (K,) [s], descending, for responses at times from `low` to `high` [s]."""
    decades = np.log10(high / low) + sum(BEYOND)
    return np.logspace(np.log10(high) + BEYOND[1], np.log10(low) - BEYOND[0], int(np.ceil(decades * DENSE)) + 1)


def as_modes(u: Array, switches: Array, times: Array, reference: float) -> Maxwell:
    """Return many Prony modes that represent the relaxation spectrum of the model, for responses in the time domain.

    The spectrum is H(tau) = Im G*(s) / pi at s = e^(i pi) / tau (Gross 1953). The trapezium rule in ln tau converts the
    spectrum to modes, and converges exponentially. An equilibrium modulus replaces the modes that are slower than
    `times`. One fast mode replaces the modes that are faster than `times`. The equilibrium modulus and the strength of
    this fast mode are chosen so that G* is exact at one small and one large real s.

    Args:
        u, switches: see `moduli`.
        times: (K,) [s], descending, with a constant ratio, see `times_of_modes`.
        reference: reference frequency [rad/s]. u describes the model for frequencies divided by this value.
    """
    xp = arrays_of(u, times)
    step = xp.log(times[0] / times[1])
    H = step * moduli(u, switches, 1 / (times * reference), np.pi)[1] / np.pi
    # At these two values of s, modes slower than `times` act as springs, and faster modes as dashpots.
    ends = xp.stack([1e3 / times[0], 1e-2 / times[-1]])
    fast = times[-1] / 3

    x = xp.outer(ends, times)
    left = moduli(u, switches, ends / reference, 0.0)[0] - H @ (x / (1 + x)).T
    share = ends * fast / (1 + ends * fast)
    lump = (left[..., 1] - left[..., 0]) / (share[1] - share[0])
    rest = xp.maximum(left[..., 0] - lump * share[0], 0.0)
    strengths = xp.concatenate([H, xp.maximum(lump, 1e-12 * xp.sum(H, axis=-1))[..., None]], axis=-1)
    total = rest + xp.sum(strengths, axis=-1)
    every = xp.concatenate([times, xp.atleast_1d(fast)])
    return Maxwell(total, strengths / total[..., None], xp.broadcast_to(every, strengths.shape))


def springpot_residuals(
    u: Array, switches: Array, x: Array, storage: np.ndarray, loss: np.ndarray, scales: np.ndarray
) -> Array:
    """Return the residuals (2n,) at n frequencies: (model - data) / scale, first of G', then of G''. `scales` (2n,)
    [Pa]."""
    found = arrays_of(u).concatenate(moduli(u, switches, x), axis=-1)
    return (found - np.concatenate([storage, loss])) / scales


def _strength(log_size: Array, exponent: Array, reference: float) -> Array:
    """Return the strength [Pa s^exponent] of a springpot. `log_size`: log of its |modulus| [Pa] at the reference
    frequency."""
    return arrays_of(log_size).exp(log_size - exponent * np.log(reference))


def _springpot(u: Array, reference: float) -> Array:
    alpha, _, _ = _orders(u)
    return arrays_of(u).stack([_strength(u[..., 2], alpha, reference), alpha], axis=-1)


def _kelvin_voigt(u: Array, reference: float) -> Array:
    xp = arrays_of(u)
    return xp.concatenate([xp.exp(u[..., :1]), _springpot(u, reference)], axis=-1)


def _zener(u: Array, reference: float) -> Array:
    xp, (alpha, _, _) = arrays_of(u), _orders(u)
    time = xp.exp((u[..., 2] - u[..., 4]) / alpha) / reference
    return xp.stack([xp.exp(u[..., 0]), xp.exp(u[..., 4]), time, alpha], axis=-1)


def _maxwell(u: Array, reference: float) -> Array:
    xp, (_, beta, _) = arrays_of(u), _orders(u)
    fast = xp.stack([_strength(u[..., 4], beta, reference), beta], axis=-1)
    return xp.concatenate([_springpot(u, reference), fast], axis=-1)


def _parallel(u: Array, reference: float) -> Array:
    xp, (_, _, gamma) = arrays_of(u), _orders(u)
    slow = xp.stack([_strength(u[..., 0], gamma, reference), gamma], axis=-1)
    return xp.concatenate([slow, _springpot(u, reference)], axis=-1)


_POT, _SLOW, _FAST = (
    ((f"{name}springpot", f"{name}exponent"), (f"Pa s^{name}exponent", "1")) for name in ("", "slow_", "fast_")
)
_REST = (("equilibrium_modulus",), ("Pa",))


def _case(name, free, parts, values, formula) -> Fractional:
    names, units = (sum((part[k] for part in parts), ()) for k in (0, 1))
    return Fractional(name, free, names, units, values, formula)


FRACTIONAL = (
    _case("springpot", (2, 3), (_POT,), _springpot, lambda s, v, a: v * s**a),
    _case("fractional_kelvin_voigt", (0, 2, 3), (_REST, _POT), _kelvin_voigt, lambda s, e, v, a: e + v * s**a),
    _case(
        "fractional_zener",
        (0, 2, 3, 4),
        (_REST, (("relaxing_modulus", "relaxation_time", "exponent"), ("Pa", "s", "1"))),
        _zener,
        lambda s, e, m, tau, a: e + m * (s * tau) ** a / (1 + (s * tau) ** a),
    ),
    # Two springpots in series form a fluid. The springpot with the larger exponent deforms most at low frequencies.
    _case(
        "fractional_maxwell",
        (2, 3, 4, 5),
        (_SLOW, _FAST),
        _maxwell,
        lambda s, v, a, w, b: 1 / (1 / (v * s**a) + 1 / (w * s**b)),
    ),
    # Two springpots in parallel form a fluid. The springpot with the larger exponent dominates at high frequencies.
    _case(
        "fractional_parallel",
        (0, 1, 2, 3),
        (_SLOW, _FAST),
        _parallel,
        lambda s, w, b, v, a: v * s**a + w * s**b,
    ),
)


def full(model: Fractional, u: Array) -> Array:
    """Return all six entries (…, 6) of u from the P free entries (…, P). Entries that the model does not have are 0."""
    xp = arrays_of(u)
    nothing = xp.zeros_like(u[..., 0])
    return xp.stack([u[..., model.free.index(k)] if k in model.free else nothing for k in range(SIZE)], axis=-1)


def best_minimum(model: Fractional, sweep: Sweep, starts: np.ndarray, scales: np.ndarray | None = None) -> Solution:
    """Return the best minimum over the P free entries of u that is found from S starting points (S, P).

    Args:
        model: the fractional model.
        sweep: data.
        starts: starting points (S, P).
        scales: scales of the residuals (2n,) [Pa] at n frequencies; by default the standard deviations of the sweep.
    """
    x = sweep.angular_frequency / reference_frequency(sweep)
    scales = np.concatenate(sweep.deviations) if scales is None else scales

    def residuals(u):
        return springpot_residuals(full(model, u), model.switches, x, sweep.storage, sweep.loss, scales)

    return from_starts(partial(host.with_jacobian, residuals), starts)


def reference_frequency(sweep: Sweep) -> float:
    """Return the middle of the band [rad/s] on the log axis."""
    return float(np.sqrt(sweep.angular_frequency[0] * sweep.angular_frequency[-1]))


def starting_points(sweep: Sweep, count: int = 24, seed: int = 0) -> np.ndarray:
    """Return starting points u (count, SIZE). In the first points, two springpots have equal moduli at a frequency
    inside or near the band. The other points are random."""
    rng = np.random.default_rng(seed)
    size = np.log(np.hypot(sweep.storage, sweep.loss))
    half = 0.5 * np.log(sweep.angular_frequency[-1] / sweep.angular_frequency[0])
    typical = float(np.clip(2 / np.pi * np.arctan(np.median(sweep.loss / sweep.storage)), 0.02, 0.6))
    ordered = [_softer_pot(np.median(size), typical, alpha, c * half) for alpha in (0.95, 0.65) for c in _CROSSINGS]
    k = max(0, count - len(ordered))
    alpha, other = rng.uniform(0.05, 0.95, k), rng.uniform(0.02, 0.9, (2, k))
    pot = np.log(np.median(sweep.loss)) - np.log(np.sin(0.5 * np.pi * alpha)) + rng.uniform(-1, 1, k)
    rest, row = rng.uniform(size.min() - 2, size.min(), k), rng.uniform(size.min(), size.max() + 2, k)
    spread = np.column_stack([rest, _logit(other[0]), pot, _logit(alpha), row, _logit(other[1])])
    return np.concatenate([np.array(ordered), spread])[:count]


#: Frequencies at which both springpots have equal moduli. Each number is the logarithmic distance from the middle of
#: the band, divided by half of the width of the band.
_CROSSINGS = (-1.5, -0.75, 0.0, 0.75, 1.5)


def _logit(p: np.ndarray | float) -> np.ndarray:
    return np.log(p / (1 - np.asarray(p)))


def _softer_pot(level: float, smaller: float, alpha: float, log_x: float) -> list[float]:
    """Return the starting point u of two springpots with exponents `alpha` and `smaller` and equal moduli at log x =
    `log_x`."""
    ratio = float(_logit(min(smaller / alpha, 0.95)))
    return [level, ratio, level - (alpha - smaller) * log_x, float(_logit(alpha)), level, ratio]
