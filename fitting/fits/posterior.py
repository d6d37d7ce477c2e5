"""Samples of the posterior of a fit, from the data and a stated prior.

The likelihood is the same as in the fit: the errors are independent and normal, and their standard deviations are the
given scales times a common factor s. If G' and G'' have different relative noise, the scales are first adapted to this
noise. The factor s is integrated out, with the prior 1 / s. If the data have standard deviations, the prior is 1 / s
for s > 1 and 0 otherwise. So the standard deviations may be enlarged, but never reduced.

If errors of the instrument are fitted together with the modes of a sweep, the posterior contains these errors too, with
their priors. A sweep does not determine the gap. So the error of the gap is drawn independently of the data. It is one
factor for all moduli of a draw.
"""

import time
from collections.abc import Callable
from functools import partial
from typing import NamedTuple

import jax
import numpy as np
import scipy.special

from fitting.fits import instrument, simulated_rheometer, time_tests, viscoelastic
from fitting.fits.families import springpots_in_time
from fitting.fits.honesty import alike_points
from fitting.fits.instrument import Nuisance
from fitting.fits.simulated_rheometer import Simulation
from fitting.fits.time_tests import INDEPENDENT, TimeFit
from fitting.fits.viscoelastic import FLUID, Fit, Kind
from fitting.methods import generalised_maxwell, springpots
from fitting.methods.generalised_maxwell import Maxwell
from fitting.methods.sampling import tempering
from fitting.methods.sampling.diagnostics import r_hat
from fitting.methods.sampling.tempering import Chains, Density
from fitting.methods.springpots import FRACTIONAL, LARGER, Fractional
from fitting.methods.uncertainty import parameter_names
from fitting.readers.rheometer import Sweep
from fitting.readers.time_tests import TimeTest
from liverjax.core.compiled import compiled

#: The prior of relaxation times extends by this factor beyond the times that the data resolve.
BEYOND = 10.0
#: The prior of the moduli of a fractional model extends by this factor beyond the measured moduli.
MODULI_BEYOND = 1e3
PRIORS = {
    "prony": "G0 is log-uniform from the smallest measured modulus to 1000 times the largest; relaxation times are "
    "log-uniform from a tenth of the shortest to ten times the longest time that the data resolve; the ratios and "
    "the equilibrium fraction are uniform on the simplex (all values that add up to 1)",
    "fractional": "moduli at the middle of the band are log-uniform within a factor of 1000 of the measured moduli; "
    "exponents are uniform between 0 and 1; if there are two exponents, every pair with the first at least as large as "
    "the second is equally probable",
}
#: Replacements of words in `PRIORS` for a relaxation or creep test. There, the prior of moduli is relative to the
#: fitted G0 (`of_time_test`).
_OF_TIME_TESTS = {
    "from the smallest measured modulus to 1000 times the largest": "from 0.01 to 1000 times the fitted G0",
    "within a factor of 1000 of the measured moduli": "from 1e-5 to 1000 times the fitted G0",
}


class Posterior(NamedTuple):
    """Draws of K reported parameters from the posterior: N draws from each of several chains."""

    names: tuple[str, ...]
    draws: np.ndarray  # (chains, N, K)
    r_hat: np.ndarray  # (K,) R-hat of each parameter; it is near 1 if the chains agree
    chains: Chains  # the same draws in the coordinates of the fit, with details of the sampling
    prior: str  # description of the prior in words
    seconds: float
    simulated: dict[str, float] | None = None  # number of simulated draws, largest error of the log density
    times: tuple[float, float] | None = None  # shortest and longest time [s] in the prior of relaxation times

    def warnings(self) -> list[str]:
        """Return warnings if the chains do not agree, if the prior truncates the posterior, or if the linear rig
        (`of_simulation`) is not accurate enough.
        """
        worst = int(np.argmax(self.r_hat))
        out = self._cut_by_the_prior()
        if self.simulated and not self.simulated["largest_difference"] < DIFFERENT:
            out.append(
                "the posterior was computed for small strain (linear rig) instead of with the simulation. In "
                f"{SIMULATED} simulated draws, the log density is wrong by up to "
                f"{self.simulated['largest_difference']:.2g}, so the intervals of the posterior are only approximate"
            )
        if self.r_hat[worst] < AGREED:
            return out
        return [
            *out,
            f"the chains of the posterior do not agree on {self.names[worst]} (R-hat {self.r_hat[worst]:.3g}): give "
            "more --samples, fewer modes or another --model",
        ]

    def _cut_by_the_prior(self) -> list[str]:
        """Return a warning for each relaxation time with many draws near a bound of its prior."""
        out = []
        for k, name in enumerate(self.names):
            if self.times is None or not name.startswith("relaxation_times"):
                continue
            draws = self.draws[..., k]
            for end, near in (
                (self.times[0], draws < NEAR * self.times[0]),
                (self.times[1], draws * NEAR > self.times[1]),
            ):
                if near.mean() > CUT:
                    out.append(
                        f"the prior truncates the posterior of {name}: {100 * near.mean():.0f} % of the draws lie "
                        f"near the bound of {end:.3g} s. The data do not limit this time, so the intervals of this "
                        "time and of the moduli depend on the prior. Measure a wider band"
                    )
        return out


#: NEAR: a draw lies near a bound of the prior if their ratio is below this factor. CUT: the program warns if the
#: fraction of draws near a bound is larger than this value.
NEAR, CUT = 1.25, 0.025
#: AGREED: chains agree if R-hat is below this value. QUIETEST: lower bound of the relative error of the data. Without
#: this bound, the posterior of exact data would be a single point.
AGREED, QUIETEST = 1.01, 1e-6


class Target(NamedTuple):
    """A posterior density of the P coordinates u, and the parameters to report. W is the number of vectors u that are
    evaluated together, and m is the number of residuals."""

    residuals: Callable[[np.ndarray], np.ndarray]  # function of u (W, P): residuals (W, m) divided by their scales
    prior: "Modes | Springpots | WithInstrument"
    deviations_given: bool
    weight: float = 1.0  # number of independent residuals, divided by the number of residuals
    log_scales: float = 0.0  # half the log determinant of the covariance of the data if s is 1

    def log_likelihood(self, u: np.ndarray) -> np.ndarray:
        """Return the log likelihood (W,) of W vectors u (W, P), up to a constant. The common factor s of the errors is
        integrated out. The constant is the same for all fits of the same data with the same `weight`."""
        with np.errstate(all="ignore"):  # if numbers overflow, the likelihood is 0
            r = self.residuals(u)
            found = log_likelihood(np.sum(r * r, axis=-1), r.shape[-1], self.deviations_given)
            return self.weight * found - self.log_scales


def log_likelihood(square: np.ndarray, count: int, deviations_given: bool) -> np.ndarray:
    """Return the logarithm of the integral of s^-m exp(-square / (2 s^2)) ds / s over all s, up to a constant. Here s
    is the common factor of the errors, m = `count` is the number of residuals, and `square` is the sum of their squares
    (at least m times `QUIETEST`^2). If `deviations_given`, the integral is only over s >= 1."""
    a, half = 0.5 * count, 0.5 * np.maximum(square, QUIETEST**2 * count)
    out = -a * np.log(half)
    return out + _log_gammainc(a, half) if deviations_given else out


#: If the incomplete gamma function is below this value, its logarithm is computed from a series. At slightly smaller
#: values, the function underflows to 0.
_TINY = 1e-290


def _log_gammainc(a: float, x: np.ndarray) -> np.ndarray:
    """Return the logarithm of the regularised lower incomplete gamma function P(a, x). The result is finite even where
    P underflows."""
    direct, low = scipy.special.gammainc(a, x), np.minimum(x, a)  # P underflows only where x is far below a
    # P(a, x) is x^a exp(-x) / Gamma(a + 1) times the series 1 + x/(a + 1) + x^2/((a + 1)(a + 2)) + ...
    series = np.log(scipy.special.hyp1f1(1.0, a + 1, low))
    series += a * np.log(low) - low - scipy.special.gammaln(a + 1)
    return np.where(direct > _TINY, np.log(np.maximum(direct, _TINY)), series)


def target(
    kind: Kind,
    residuals: Callable[[np.ndarray], np.ndarray],
    resolved: tuple[float, float],
    size: np.ndarray,
    given: bool,
) -> Target:
    """Return the posterior density of a model, without errors of the instrument.

    Args:
        kind: the meaning of u: Prony modes or a fractional model.
        residuals: function from W vectors u (W, P) to their m residuals (W, m), divided by their scales.
        resolved: shortest and longest relaxation time [s] that the data resolve.
        size: measured moduli (n,) [Pa].
        given: whether standard deviations of the data are given.
    """
    smallest, largest = float(size.min()), float(size.max())
    if kind.values is None:
        times = (np.log(resolved[0] / BEYOND), np.log(resolved[1] * BEYOND))
        modulus = (np.log(smallest), np.log(largest * MODULI_BEYOND))
        fluid, words = kind.name == FLUID.name, PRIORS["prony"]
        words = words.replace("the ratios and the equilibrium fraction", "the ratios") if fluid else words
        return Target(residuals, Modes(fluid, modulus, times, words), given)
    (model,) = (m for m in FRACTIONAL if m.name == kind.name)
    moduli = np.log(smallest / MODULI_BEYOND), np.log(largest * MODULI_BEYOND)
    return Target(residuals, Springpots(model, moduli, kind.values), given)


class Modes(NamedTuple):
    """Prior and parameters of Prony modes, in the coordinates of `generalised_maxwell.natural` or `natural_fluid`."""

    fluid: bool
    modulus: tuple[float, float]  # lower and upper bound of log G0
    times: tuple[float, float]  # lower and upper bound of the logs of the relaxation times
    words: str = PRIORS["prony"]

    def log_prior(self, u: np.ndarray) -> np.ndarray:
        """Return the log prior (W,) of W vectors u (W, P), up to a constant."""
        with np.errstate(all="ignore"):
            model = self._model(u)
            rest = np.zeros((len(u), 0)) if self.fluid else 1 - model.ratios.sum(axis=-1, keepdims=True)
            shares = np.concatenate([model.ratios, rest], axis=-1)
            log_time = np.log(model.relaxation_times)
            inside = (log_time[:, -1] > self.times[0]) & (log_time[:, 0] < self.times[1])
            inside &= (u[:, 0] > self.modulus[0]) & (u[:, 0] < self.modulus[1])
            # Log Jacobian determinants of two changes of variables: from ratios to logits (softmax), and from log times
            # to the logs of their differences.
            gaps = u[:, u.shape[-1] - model.ratios.shape[-1] + 1 :]
            found = np.log(shares).sum(axis=-1) + gaps.sum(axis=-1)
        return np.where(inside & np.isfinite(found), found, -np.inf)

    def from_prior(self, rng: np.random.Generator, count: int, parameters: int) -> np.ndarray:
        """Draw u (count, parameters) from the prior."""
        modes = parameters // 2
        # The vector `share`, divided by the sum of its entries, is uniform on the simplex.
        share = rng.standard_exponential((count, modes + (not self.fluid)))
        log_time = -np.sort(-rng.uniform(*self.times, (count, modes)), axis=1)
        top = rng.uniform(*self.modulus, (count, 1))
        gaps = np.log(-np.diff(log_time, axis=1))
        return np.concatenate([top, np.log(share[:, :-1] / share[:, -1:]), log_time[:, :1], gaps], axis=1)

    def _model(self, u: np.ndarray) -> Maxwell:
        return (generalised_maxwell.natural_fluid if self.fluid else generalised_maxwell.natural)(u)

    def names(self, parameters: int) -> tuple[str, ...]:
        """Return the names of the reported parameters, for `parameters` coordinates."""
        first, *others = parameter_names(parameters // 2)
        return (first, *others) if self.fluid else (first, "equilibrium_modulus", *others)

    def numbers(self, u: np.ndarray) -> np.ndarray:
        """Return the K reported parameters (moduli, ratios and relaxation times) (n, K) of n draws u (n, P)."""
        model = self._model(u)
        moduli = [model.shear_modulus] if self.fluid else [model.shear_modulus, model.equilibrium_modulus]
        return np.concatenate([np.stack(moduli, axis=-1), model.ratios, model.relaxation_times], axis=-1)


class Springpots(NamedTuple):
    """Prior and parameters of a fractional model. The coordinates u are the free variables of the model (see
    `fitting.methods.springpots`): logs of moduli, and the logit of the larger exponent. In models with two springpots,
    one more variable is the logit of the ratio of both exponents."""

    model: Fractional
    moduli: tuple[float, float]  # bounds of the log moduli
    values: Callable  # function from u to the reported parameters
    words: str = PRIORS["fractional"]

    @property
    def _moduli(self) -> np.ndarray:
        """Whether each entry of u is the log of a modulus. The other entries are logits."""
        return np.array([k % 2 == 0 for k in self.model.free])

    @property
    def _larger(self) -> np.ndarray:
        """For each entry of u: 1 if it is the logit of the larger exponent of two, otherwise 0. If both exponents have
        a uniform density, the density of the larger exponent is proportional to this exponent."""
        return np.array([float(k == LARGER and len(self.model.free) - self._moduli.sum() > 1) for k in self.model.free])

    def log_prior(self, u: np.ndarray) -> np.ndarray:
        """Return the log prior (W,) of W vectors u (W, P), up to a constant."""
        moduli, exponents = u[:, self._moduli], u[:, ~self._moduli]
        inside = np.all((moduli > self.moduli[0]) & (moduli < self.moduli[1]), axis=-1)
        slopes = -np.logaddexp(0, exponents) - (1 + self._larger[~self._moduli]) * np.logaddexp(0, -exponents)
        return np.where(inside, slopes.sum(axis=-1), -np.inf)

    def from_prior(self, rng: np.random.Generator, count: int, parameters: int) -> np.ndarray:
        """Draw u (count, parameters) from the prior."""
        moduli = rng.uniform(*self.moduli, (count, parameters))
        shares = rng.random((count, parameters)) ** (1 / (1 + self._larger))
        return np.where(self._moduli, moduli, scipy.special.logit(shares))

    def names(self, parameters: int) -> tuple[str, ...]:
        """Return the names of the reported parameters."""
        return self.model.names

    def numbers(self, u: np.ndarray) -> np.ndarray:
        """Return the K parameters (n, K) of the fractional model for n draws u (n, P)."""
        return self.values(u)


class WithInstrument(NamedTuple):
    """Prior and parameters of Prony modes and of errors of the instrument. The last entries of u are the errors of the
    instrument, in standard deviations of their priors."""

    modes: Modes
    errors: list[Nuisance]

    @property
    def words(self) -> str:
        """Description of the prior in words."""
        each = [
            f"the error of the {n.name} is normal around 0 with a standard deviation of {n.told(1.0)}"
            for n in self.errors
        ]
        return "; ".join([self.modes.words, *each])

    def apart(self, u: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Split u (..., P) into the coordinates of the modes and the errors of the instrument."""
        return u[..., : -len(self.errors)], u[..., -len(self.errors) :]

    def log_prior(self, u: np.ndarray) -> np.ndarray:
        """Return the log prior (W,) of W vectors u (W, P), up to a constant."""
        modes, errors = self.apart(u)
        return self.modes.log_prior(modes) - 0.5 * np.sum(errors**2, axis=-1)

    def from_prior(self, rng: np.random.Generator, count: int, parameters: int) -> np.ndarray:
        """Draw u (count, parameters) from the prior."""
        modes = self.modes.from_prior(rng, count, parameters - len(self.errors))
        return np.concatenate([modes, rng.standard_normal((count, len(self.errors)))], axis=1)

    def names(self, parameters: int) -> tuple[str, ...]:
        """Return the names of the reported parameters, for `parameters` coordinates."""
        return (*self.modes.names(parameters - len(self.errors)), *(n.reported for n in self.errors))

    def numbers(self, u: np.ndarray) -> np.ndarray:
        """Return the K reported parameters (n, K) of n draws u (n, P): moduli, ratios, relaxation times and errors of
        the instrument."""
        modes, errors = self.apart(u)
        return np.concatenate([self.modes.numbers(modes), errors * [n.unit for n in self.errors]], axis=1)


def sample(at: Target, parameters: int, count: int, seed: int = 0) -> Posterior:
    """Sample the posterior with independent chains, and return `count` draws from each chain.

    Args:
        at: the posterior density.
        parameters: number of coordinates (length of u).
        count: number of draws from each chain.
        seed: seed of the random generators; the same seed gives the same draws.
    """
    begin, prior = time.perf_counter(), at.prior
    density = Density(at.log_likelihood, prior.log_prior, lambda rng, n: prior.from_prior(rng, n, parameters))
    chains = tempering.run(density, count, seed)
    draws = prior.numbers(chains.draws.reshape(-1, parameters)).reshape(*chains.draws.shape[:2], -1)
    known = np.array([r_hat(draws[..., k]) for k in range(draws.shape[-1])])
    modes = prior.modes if isinstance(prior, WithInstrument) else prior
    ends = (float(np.exp(modes.times[0])), float(np.exp(modes.times[1]))) if isinstance(modes, Modes) else None
    seconds = time.perf_counter() - begin
    return Posterior(prior.names(parameters), draws, known, chains, prior.words, seconds, times=ends)


def _with_gap(found: Posterior, fit: Fit, seed: int) -> Posterior:
    """Add the error of the gap to the draws, if the fit contains this error. The error of the gap multiplies all moduli
    of a draw by one random factor. The factor is log-normal, so that no modulus is negative."""
    relative, kind = fit.details.get("gap_error"), fit.kind
    if not relative:
        return found
    moduli = {"shear_modulus", "equilibrium_modulus"}
    if kind.values is not None:
        moduli = {name for name, unit in zip(kind.names, kind.units, strict=True) if unit.startswith("Pa")}
    factor = np.exp(relative * np.random.default_rng((seed, 1)).standard_normal((*found.draws.shape[:2], 1)))
    draws = np.where([name in moduli for name in found.names], found.draws * factor, found.draws)
    known = np.array([r_hat(draws[..., k]) for k in range(draws.shape[-1])])
    prior = f"{found.prior}; the gap is log-normal with a standard deviation of {100 * relative:.2g} %"
    return found._replace(draws=draws, r_hat=known, prior=prior)


def of_sweep(fit: Fit, sweep: Sweep, count: int, seed: int = 0) -> Posterior:
    """Sample the posterior of a closed-form fit of Prony modes or of a fractional model."""
    sweep = alike_points.with_weights_shown(fit, sweep)
    data = (sweep.angular_frequency, sweep.storage, sweep.loss, np.concatenate(sweep.deviations))
    if fit.kind.values is None:
        function = viscoelastic.residuals_of(fit.kind)
        own, parameters = _beside_instrument(fit, sweep, lambda u: function(u, *data))
        return _with_gap(sample(own, parameters, count, seed), fit, seed)
    (model,) = (m for m in FRACTIONAL if m.name == fit.kind.name)
    x = data[0] / springpots.reference_frequency(sweep)

    def residuals(u):
        return springpots.springpot_residuals(springpots.full(model, u), model.switches, x, *data[1:])

    own = _sweep_target(fit.kind, sweep, residuals)
    return _with_gap(sample(own, len(fit.solution.u), count, seed), fit, seed)


def _beside_instrument(fit: Fit, sweep: Sweep, residuals: Callable[[np.ndarray], np.ndarray]) -> tuple[Target, int]:
    """Return the posterior density of the Prony modes and of the instrument errors that the fit contains, and the
    number of coordinates u."""
    own, parameters = _sweep_target(fit.kind, sweep, residuals), len(fit.solution.u)
    known, corrected_by = instrument.used_errors(fit, sweep)
    if not known or not isinstance(own.prior, Modes):
        return own, parameters
    prior, moved = WithInstrument(own.prior, known), instrument.directions(sweep, known)

    def beside(u: np.ndarray) -> np.ndarray:
        modes, errors = prior.apart(u)
        return residuals(modes) - (errors - corrected_by) @ moved.T

    return own._replace(residuals=beside, prior=prior), parameters + len(known)


def _sweep_target(kind: Kind, sweep: Sweep, residuals: Callable[[np.ndarray], np.ndarray]) -> Target:
    size = np.hypot(sweep.storage, sweep.loss)
    # The scales may depend on the residuals of the fit (`with_weights_shown`), so they differ between fits.
    log_scales = float(np.sum(np.log(np.concatenate(sweep.deviations))))
    return target(kind, residuals, sweep.resolved, size, sweep.noise_given)._replace(log_scales=log_scales)


#: SIMULATED: number of draws that are simulated. DIFFERENT: the program warns if the approximate log density of one of
#: these draws is wrong by more than this value.
SIMULATED, DIFFERENT = 12, 0.1


def of_simulation(fit: Fit, sweep: Sweep, simulation: Simulation, count: int, seed: int = 0) -> Posterior:
    """Sample the posterior of Prony modes that were fitted with the torsion simulation.

    The density is computed with the linear rig: the same test for small strain, which needs no time integration. For
    each frequency, the moduli of the linear rig are multiplied by a complex factor. With this factor, they agree with
    the simulation at the minimum. A few draws are simulated in full. `Posterior.simulated` contains the largest
    difference between the simulated and the approximate log likelihood of these draws. This difference shows how good
    the approximation is.
    """
    sweep = alike_points.with_weights_shown(fit, sweep)
    data, scales = simulated_rheometer.simulation_data(sweep, simulation), np.concatenate(sweep.deviations)
    rig, law, omega, _, measured, _ = data

    @jax.jit
    @jax.vmap
    def linear(u):
        return simulated_rheometer.small_strain_moduli(rig, fit.kind.maxwell(u), law, omega, simulation)

    added = (fit.storage + 1j * fit.loss) / np.asarray(linear(fit.solution.u[None]))[0]

    def residuals(u: np.ndarray) -> np.ndarray:
        G = added * np.asarray(linear(u))
        return (np.concatenate([G.real, G.imag], axis=-1) - measured) / scales

    own, parameters = _beside_instrument(fit, sweep, residuals)
    found = _with_gap(sample(own, parameters, count, seed), fit, seed)
    begin = time.perf_counter()
    draws = found.chains.draws.reshape(-1, parameters)
    some = draws[np.linspace(0, len(draws) - 1, SIMULATED).astype(int)]
    modes = some[:, : len(fit.solution.u)]
    program = compiled(
        partial(simulated_rheometer.with_jacobian, simulation=simulation, kind=fit.kind), modes[0], data, short=True
    )
    exact = np.stack([np.asarray(program(jax.numpy.asarray(u), data)[0]) for u in modes])
    exact += own.residuals(some) - residuals(modes)  # add the effect of the errors of the instrument
    likelihood = own._replace(residuals=lambda _: exact).log_likelihood(some)
    apart = float(np.max(np.abs(likelihood - own.log_likelihood(some))))
    checked = {"draws": float(SIMULATED), "largest_difference": apart}
    return found._replace(simulated=checked, seconds=found.seconds + time.perf_counter() - begin)


def of_time_test(fit: TimeFit, test: TimeTest, count: int, seed: int = 0) -> Posterior:
    """Sample the posterior of Prony modes or of a fractional model, fitted in closed form to a relaxation or creep
    test.

    If the noise of neighbouring measured values is correlated, the log likelihood is multiplied by the fraction of
    independent values. The error of a subtracted base line is common to all values (`_beside_base_line`).
    """
    test = test._replace(constant_noise=fit.details.get(time_tests.CONSTANT_NOISE, False))
    if fit.kind.values is None:
        one, data = time_tests.residuals_in_time(test, fit.kind)
        residuals = jax.jit(jax.vmap(lambda u: one(u, *data)))
    else:
        residuals = jax.jit(jax.vmap(springpots_in_time.residuals_of_springpot(fit.kind.name, test)))
    size = np.abs(fit.model.shear_modulus) * np.array([1e-2, 1.0])
    weight = fit.details.get(INDEPENDENT, len(fit.measured)) / len(fit.measured)
    scales = time_tests.data_in_time(test)[-1]
    noise = scales * max(fit.uncertainty.noise, QUIETEST)
    base_line = np.sqrt(weight) * test.base_line_errors(time_tests.thinned(test)) / noise
    common = np.linalg.slogdet(np.eye(len(base_line)) + base_line @ base_line.T)[1]
    log_scales = weight * float(np.sum(np.log(scales))) + 0.5 * float(common)
    own = target(fit.kind, _beside_base_line(residuals, base_line), test.resolved, size, False)
    assert not isinstance(own.prior, WithInstrument)
    prior = own.prior._replace(words=_of_time_test(own.prior.words))
    return sample(own._replace(weight=weight, log_scales=log_scales, prior=prior), len(fit.solution.u), count, seed)


def _of_time_test(words: str) -> str:
    """Return the description `words` of a prior, changed for moduli that are relative to the fitted G0."""
    for measured, fitted in _OF_TIME_TESTS.items():
        words = words.replace(measured, fitted)
    return words


def _beside_base_line(residuals: Callable, changes: np.ndarray) -> Callable[[np.ndarray], np.ndarray]:
    """Return a function from u (W, P) to uncorrelated residuals (W, m). The measured values contain common errors of
    the base line, so their residuals are correlated. The function makes them uncorrelated.

    The covariance of m residuals is s^2 (I + D^T D) with the noise s. `changes`: D (k, m). Row j of D is the change of
    all residuals due to one standard error of error j of k independent errors, divided by s. The residuals are
    multiplied by (I + D^T D)^(-1/2).
    """
    if not len(changes):
        return lambda u: np.asarray(residuals(u))
    _, sizes, axes = np.linalg.svd(changes, full_matrices=False)
    reduced = (1 - 1 / np.sqrt(1 + sizes**2))[:, None] * axes

    def uncorrelated(u: np.ndarray) -> np.ndarray:
        r = np.asarray(residuals(u))
        return r - (r @ axes.T) @ reduced

    return uncorrelated
