"""The residuals of several tests in a common fit, and the noise and the misfit of each test."""

from typing import NamedTuple

import numpy as np

from fitting.fits import time_tests
from fitting.fits.together.measured_tests import Measured, first_noise, least_noise, name_of, relative_errors_of
from fitting.fits.viscoelastic import Kind
from fitting.methods import host, time_response
from fitting.methods.estimate import Estimate
from fitting.methods.generalised_maxwell import Maxwell
from fitting.methods.least_squares import Solution, degrees_of_freedom
from liverjax.core.struct import Content

#: Degrees of freedom that are needed to estimate the noise of a test.
LEAST_FREEDOM = 3.0


class Share(NamedTuple):
    """The contribution of one test to the common parameters."""

    name: str  # sweep, dispersion, relaxation or creep
    source: str
    points: int  # number of measured values
    noise: float  # noise in the common fit / scales; at least 1 if standard deviations are given
    alone: float  # noise in a fit to this test alone, divided by the scales
    misfit: float  # relative misfit of this test in the common fit
    misfit_alone: float  # relative misfit of the fit to this test alone
    mean_relative_error: float
    errors_without: np.ndarray  # standard errors (P,) of the P common parameters if this test is left out


class Together(NamedTuple):
    """The common fit."""

    tests: list[Measured]
    kind: Kind
    model: Maxwell
    solution: Solution
    uncertainty: Estimate
    converged: bool
    shares: list[Share]
    fitted: list[np.ndarray]  # predicted: G' and then G'' [Pa], velocities and then attenuations, or response
    tried: list[Content]
    warnings: tuple[str, ...]
    run_time: float
    compile_time: float
    parameters: Estimate | None = None  # parameters of another model; None: the modes are the parameters
    details: Content | None = None  # details of the model

    @property
    def modes(self) -> int:
        """Number of Prony modes."""
        return len(self.model.ratios)


def tests_evaluated(kinds: list[str], kind: Kind, u: np.ndarray, data: list) -> tuple[np.ndarray, np.ndarray]:
    """Return the m residuals (…, m) of all tests, in the order of the tests, and their derivatives (…, m, P) with
    respect to the P variables u (…, P), in NumPy."""

    def one(name: str, at: tuple, measured: np.ndarray, scales: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        if name in ("relaxation", "creep"):
            return time_response.residuals_with_jacobian(name, kind.maxwell, u, *at, measured, scales)
        return host.with_jacobian(
            lambda u: (time_tests.response_in_time(name, kind.maxwell(u), *at) - measured) / scales, u
        )

    found = [one(name, *own) for name, own in zip(kinds, data, strict=True)]
    residuals, jacobians = zip(*found, strict=True)
    return np.concatenate(residuals, axis=-1), np.concatenate(jacobians, axis=-2)


def misfits(
    tests: list[Measured], data: list, residuals: np.ndarray, noise: np.ndarray, free: float
) -> tuple[list[Share], list[np.ndarray]]:
    """Return the misfit of each test (`Share`), and the values that the fit predicts for each test.

    Args:
        tests: K tests.
        data: for each test, three entries: the arrays from which the test is predicted, the measured values, and the
            divisors of the residuals.
        residuals: residuals of all tests; rows of a prior may follow.
        noise: noise (K,) of the tests, divided by their scales.
        free: number of parameters that the data determine.
    """
    counts = [len(y) for _, y, _ in data]
    left = np.split(residuals[: sum(counts)], np.cumsum(counts)[:-1])
    shares, fitted = [], []
    for test, (_, y, scales), r, s in zip(tests, data, left, noise, strict=True):
        errors = relative_errors_of(test, y + r * scales)
        misfit = size_of_noise(errors, len(errors) * (1 - free / sum(counts)))
        own = (name_of(test), test.source, len(y), float(s), np.nan, misfit, np.nan, float(errors.mean()))
        shares.append(Share(*own, errors_without=np.array([])))
        fitted.append(r * scales + y)
    return shares, fitted


def over_own_noise(found: Solution, shares: list[Share], ratio: np.ndarray) -> Solution:
    """Divide the residuals of each test by the noise that was found for this test, and return the solution. `ratio`
    (K,): noise that was used in the fit, divided by the noise that was found.

    Residuals of a prior are multiplied by the geometric mean of the ratios, because the weight of a prior refers to the
    mean noise.
    """
    factor = np.repeat(ratio, [s.points for s in shares])
    prior = np.full(len(found.residuals) - len(factor), np.exp(np.mean(np.log(ratio))))
    rows = np.concatenate([factor, prior])
    return found._replace(residuals=rows * found.residuals, jacobian=rows[:, None] * found.jacobian)


def size_of_noise(residuals: np.ndarray, freedom: float) -> float:
    """Return the standard deviation of residuals with the given degrees of freedom (at least 1)."""
    return float(np.sqrt(np.sum(residuals**2) / max(1.0, freedom)))


def noises(
    tests: list[Measured], parts: list, residuals: np.ndarray, used: np.ndarray, taken: np.ndarray | float
) -> np.ndarray:
    """Return the noise of each test, divided by its scales: the root of (sum of the squared residuals / degrees of
    freedom). With fewer than `LEAST_FREEDOM` degrees of freedom, the result is at least `first_noise`. `used`: noise
    that was used in the fit. `taken`: Jacobian of the residuals, or effective number of parameters."""
    counts = np.array([len(y) for _, y, _ in parts])
    left = np.split(residuals[: counts.sum()], np.cumsum(counts)[:-1])
    freedoms = degrees_of_freedom(np.asarray(taken), counts) if np.ndim(taken) else counts * (1 - taken / counts.sum())
    known = freedoms >= LEAST_FREEDOM
    found = [s * size_of_noise(r, f) for r, s, f in zip(left, used, np.where(known, freedoms, counts), strict=True)]
    return np.maximum(found, [least_noise(t) if k else first_noise(t) for t, k in zip(tests, known, strict=True)])


def criterion_of_all(fit: Together) -> float:
    """Return the Bayesian information criterion of a common fit. The noise of each test is estimated from the fit."""
    total = sum(s.points for s in fit.shares)
    free = len(fit.solution.u) if fit.kind.effective is None else fit.kind.effective
    return float(sum(s.points * 2 * np.log(s.noise) for s in fit.shares) + free * np.log(total))
