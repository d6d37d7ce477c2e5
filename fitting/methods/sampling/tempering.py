"""Sampling of a posterior by tempering: particles (parameter vectors) are drawn from the prior and moved to the
posterior in steps.

The likelihood is raised to a power that grows from 0 to 1. Each step gives weights to the particles and resamples them
by these weights. Then differential evolution moves the particles until they are nearly independent of their earlier
positions (Del Moral, Doucet and Jasra 2006, J. R. Stat. Soc. B 68, 411; ter Braak and Vrugt 2008, Statistics and
Computing 18, 435). Every run begins at the prior. So the runs agree only if each has found the whole posterior, with
its tails and all its maxima. The method needs only a density that can be computed at many points at once. It needs no
derivatives, no tuning and no compilation.
"""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
import scipy.special

#: Number of independent runs, and smallest number of particles in each.
CHAINS, FEWEST = 4, 500
#: In each step, the power of the likelihood rises until the effective sample size is this fraction of the number of
#: particles.
EFFECTIVE = 0.5
#: The moves of a step end if the correlation between the positions of the particles now and before the step is below
#: FORGOTTEN, or in the last step below FORGOTTEN_LAST. MOST: maximum number of moves in a step.
FORGOTTEN, FORGOTTEN_LAST, MOST = 0.6, 0.2, 30
#: Fraction of the moves that use the whole difference of two particles. Such moves can lead from one maximum to
#: another.
LONG = 0.1


class Density(NamedTuple):
    """A posterior density. The argument u (W, P) of its functions contains the P parameters of W points."""

    log_likelihood: Callable[[np.ndarray], np.ndarray]  # u -> logarithms (W,), up to a constant
    log_prior: Callable[[np.ndarray], np.ndarray]  # u -> logarithms (W,); -inf where the prior is 0
    from_prior: Callable[[np.random.Generator, int], np.ndarray]  # (generator, W) -> (W, P)


class Chains(NamedTuple):
    """N draws of P parameters from each of the independent runs."""

    draws: np.ndarray  # (CHAINS, N, P)
    log_evidence: np.ndarray  # (CHAINS,) log of the evidence (the mean likelihood under the prior)
    steps: int  # number of increases of the power, in all runs together
    moves: int  # number of moves of each particle, in all runs together
    acceptance: float  # accepted fraction of the last moves
    remembered: float  # largest correlation of the particles with their positions before the last moves


class _Particles(NamedTuple):
    u: np.ndarray  # (N, P)
    likelihood: np.ndarray  # (N,) logarithm of the likelihood
    prior: np.ndarray  # (N,) logarithm of the prior density

    def at(self, places: np.ndarray) -> "_Particles":
        return _Particles(*(field[places] for field in self))


def run(density: Density, count: int, seed: int = 0) -> Chains:
    """Sample the posterior in `CHAINS` independent runs with `count` draws each.

    Args:
        density: the posterior.
        count: draws that each run keeps.
        seed: seed of the random generators; the same seed gives the same draws.
    """
    found = [
        _run_particles(density, max(FEWEST, count + count % 2), np.random.default_rng([seed, k])) for k in range(CHAINS)
    ]
    draws, evidence, steps, moves, accepted, remembered = zip(*found, strict=True)
    kept = np.stack([u[:count] for u in draws])
    return Chains(kept, np.array(evidence), sum(steps), sum(moves), float(np.mean(accepted)), max(remembered))


def _run_particles(
    density: Density, count: int, rng: np.random.Generator
) -> tuple[np.ndarray, float, int, int, float, float]:
    u = density.from_prior(rng, count)
    now = _Particles(u, _finite_only(density.log_likelihood(u)), density.log_prior(u))
    power, evidence, steps, moves = 0.0, 0.0, 0, 0
    accepted = remembered = 0.0
    while power < 1:
        rise = _rise(now.likelihood, 1 - power)
        log_weights = rise * now.likelihood
        evidence += float(scipy.special.logsumexp(log_weights) - np.log(count))
        now = now.at(rng.permutation(_resampled(log_weights, rng)))
        power = 1.0 if rise >= 1 - power else power + rise
        limit = FORGOTTEN_LAST if power == 1 else FORGOTTEN
        now, own, accepted, remembered = _moved(density, now, power, limit, rng)
        steps, moves = steps + 1, moves + own
    return now.u[rng.permutation(count)], evidence, steps, moves, accepted, remembered


def _finite_only(values: np.ndarray) -> np.ndarray:
    return np.where(np.isnan(values), -np.inf, values)


def _rise(likelihood: np.ndarray, left: float) -> float:
    """Return the largest increase of the power of the likelihood, at most `left`, at which the effective sample size is
    at least the fraction `EFFECTIVE` of the number of particles. The increase is found by bisection."""

    def effective(rise: float) -> float:
        w = np.exp(rise * (likelihood - likelihood.max()))
        return float(w.sum() ** 2 / np.sum(w * w) / len(w))

    if effective(left) >= EFFECTIVE:
        return left
    low, high = 0.0, left
    for _ in range(50):
        middle = 0.5 * (low + high)
        low, high = (middle, high) if effective(middle) > EFFECTIVE else (low, middle)
    return high


def _resampled(log_weights: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Return the indices of the particles that are kept (systematic resampling)."""
    w = np.cumsum(np.exp(log_weights - log_weights.max()))
    ticks = (np.arange(len(w)) + rng.random()) / len(w) * w[-1]
    return np.minimum(np.searchsorted(w, ticks), len(w) - 1)


def _moved(
    density: Density, start: _Particles, power: float, limit: float, rng: np.random.Generator
) -> tuple[_Particles, int, float, float]:
    """Return the particles after moves that do not change the tempered density. Also return the number of moves, the
    accepted fraction, and the correlation with the positions before the moves."""
    half = len(start.u) // 2
    halves = slice(0, half), slice(half, 2 * half)
    now = _Particles(*(field.copy() for field in start))
    accepted, remembered, moves = 0.0, 1.0, 0
    while moves < MOST and remembered >= limit:
        parts = [_half_moved(density, now, power, pair, rng) for pair in (halves, halves[::-1])]
        accepted, moves = float(np.mean(parts)), moves + 1
        remembered = _correlation(start.u, now.u)
    return now, moves, accepted, remembered


def _half_moved(
    density: Density, now: _Particles, power: float, halves: tuple[slice, slice], rng: np.random.Generator
) -> float:
    """Move the particles `halves[0]` in place, using differences between the particles `halves[1]`. Return the accepted
    fraction of the moves.

    The differences do not depend on the moved particles, so the moves do not change the density.
    """
    own, other = now.u[halves[0]], now.u[halves[1]]
    half, size = own.shape
    first = rng.integers(half, size=half)
    second = (first + rng.integers(1, half, size=half)) % half
    usual = 2.38 / np.sqrt(2 * size) * np.exp(rng.uniform(-1.5, 0.3, half))
    reach = np.where(rng.random(half) < LONG, 1.0, usual)[:, None]
    trial = own + reach * (other[first] - other[second]) + 1e-6 * rng.standard_normal(own.shape)
    prior, likelihood = density.log_prior(trial), _finite_only(density.log_likelihood(trial))
    with np.errstate(invalid="ignore"):  # -inf minus -inf gives NaN; such a point is rejected
        gain = power * (likelihood - now.likelihood[halves[0]]) + prior - now.prior[halves[0]]
    take = np.log(rng.random(half)) < np.where(np.isnan(gain), -np.inf, gain)
    for field, value in zip(now, (trial, likelihood, prior), strict=True):
        field[halves[0]][take] = value[take]
    return float(take.mean())


def _correlation(before: np.ndarray, after: np.ndarray) -> float:
    """Return the largest correlation between a coordinate of the particles and its value before the moves."""
    a, b = before - before.mean(axis=0), after - after.mean(axis=0)
    size = np.sqrt(np.sum(a * a, axis=0) * np.sum(b * b, axis=0))
    return float(np.max(np.sum(a * b, axis=0) / np.maximum(size, 1e-300)))
