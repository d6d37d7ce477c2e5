"""The result of every fit: numbers, their standard errors and correlation, from the Jacobian at the minimum."""

from collections.abc import Callable, Sequence
from typing import NamedTuple

import jax
import numpy as np
import scipy.special

from fitting.methods import host
from fitting.methods.least_squares import Solution

#: Replaces an unbounded error in a covariance; its square is still a finite number.
LOST = 1e140


class Estimate(NamedTuple):
    """Numbers in the order of `names`, and how well the data determine them."""

    names: tuple[str, ...]
    values: np.ndarray  # (P,)
    root: np.ndarray  # (P, k) square root of the covariance; huge in directions that the data leave free
    standard_errors: np.ndarray
    correlation: np.ndarray
    chi2: float  # sum of squared residuals over the noise
    components: int  # measured numbers
    noise: float  # factor on the given scales: 1, or estimated from the residuals
    freedom: float  # components minus the numbers that the data determine, not always those of `names`
    iterations: int
    converged: bool
    codes: tuple[int, ...] = ()  # worst code of each simulation
    seconds: float = 0.0
    mesh_bias: np.ndarray | None = None  # (P,) part of the values that the simulation's mesh causes; None: not known
    time_step_bias: np.ndarray | None = None  # (P,) part of the values that its time steps cause
    shared: np.ndarray | None = None  # (P, s) columns of `root` from errors common to all points: gap, instrument
    mesh_over_noise: float | None = None  # root mean square of the mesh's error in the data, over their noise

    @property
    def covariance(self) -> np.ndarray:
        """Covariance of the numbers (P, P)."""
        return self.root @ self.root.T

    @property
    def quantile(self) -> float:
        """Quantile of Student's t for a 95 % interval."""
        return float(scipy.special.stdtrit(max(1, self.freedom), 0.975))


def estimated(
    names: Sequence[str],
    natural_of: Callable[[jax.Array], jax.Array],
    found: Solution,
    components: int,
    deviations_given: bool = True,
    effective: float | None = None,
) -> Estimate:
    """The estimate at a minimum: covariance of u, transformed to the reported numbers by the delta method.

    Args:
        names: of the numbers to report.
        natural_of: u -> these numbers (P,).
        found: minimum over u; if its arrays are NumPy's, `natural_of` must work in `host.with_jacobian`.
        components: number of residuals that are measured; the others are 0 and have no effect.
        deviations_given: as in `noise_factor`.
        effective: number of parameters that the data determine, if u has a prior. The rows of the prior then follow the
            `components` rows of the data.
    """
    u, jacobian, r = (np.asarray(v) for v in (found.u, found.jacobian, found.residuals))
    if effective is not None:
        r = r[:components]
    freedom = components - (len(u) if effective is None else effective)
    noise = noise_factor(r, freedom, deviations_given)
    values, to_natural = with_slope(natural_of, found.u)
    root, _ = spread(jacobian, noise, to_natural)
    errors, correlation = errors_and_correlation(root)
    # At a bound (a ratio of 0 or 1, a time of 0) the parametrisation has no slope: the error is unknown, not zero.
    stuck = np.abs(to_natural).max(axis=1) <= 1e-10 * np.maximum(np.abs(values), 1e-300)
    return Estimate(
        names=tuple(names),
        values=values,
        root=root,
        standard_errors=np.where(stuck | (errors > 1e-10 * LOST), np.inf, errors),
        correlation=correlation,
        chi2=float(r @ r),
        components=components,
        noise=noise,
        freedom=freedom,
        iterations=int(found.iterations),
        converged=bool(found.converged),
    )


def with_slope(natural_of: Callable[[jax.Array], jax.Array], u: host.Array) -> tuple[np.ndarray, np.ndarray]:
    """The reported numbers (P,) and their derivative by u. If u is a NumPy array, nothing is compiled."""
    if isinstance(u, np.ndarray):
        with np.errstate(over="ignore", invalid="ignore"):  # the errors show that a fit diverged
            return host.with_jacobian(natural_of, u)
    return np.asarray(natural_of(u)), np.asarray(jax.jacfwd(natural_of)(u))


def noise_factor(residuals: np.ndarray, freedom: float, deviations_given: bool) -> float:
    """Noise divided by the scales of the residuals.

    Without given deviations it is estimated from the residuals. Given deviations are used as they are, unless the
    residuals are larger: then the errors are enlarged by the misfit. They are never reduced (the rule of the Particle
    Data Group).
    """
    estimate = float(np.sqrt(np.sum(residuals**2) / max(1, freedom)))
    return max(1.0, estimate) if deviations_given else estimate


def spread(jacobian: np.ndarray, noise: float, to_natural: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Square root A of the covariance A A^T of natural parameters (delta method), and scaled singular values.

    Args:
        jacobian: of the residuals by unconstrained parameters u.
        noise: standard deviation of a residual.
        to_natural: derivative of the natural parameters by u.
    """
    if not (np.all(np.isfinite(jacobian)) and np.any(jacobian)):  # nothing is known: a fit that could not begin
        return np.full((len(to_natural), jacobian.shape[1]), np.inf), np.zeros(min(jacobian.shape))
    scale = np.maximum(np.linalg.norm(jacobian, axis=0), 1e-300)
    _, s, Vt = np.linalg.svd(jacobian / scale, full_matrices=False)
    # A direction that the data leave free gets an error of 1e14 times the best known one, not infinity times zero.
    with np.errstate(over="ignore", invalid="ignore"):  # a number that diverged has no finite error
        root = noise * ((to_natural / scale) @ Vt.T) / np.maximum(s, 1e-14 * s[0])
    return np.clip(np.where(np.isfinite(root), root, LOST), -LOST, LOST), s


def errors_and_correlation(root: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Standard errors (P,) and correlation (P, P) from the square root of a covariance."""
    with np.errstate(over="ignore", invalid="ignore"):  # infinite where nothing is known
        covariance = root @ root.T
        errors = np.sqrt(np.diag(covariance))
        return errors, covariance / np.maximum(np.outer(errors, errors), 1e-300)


def wider(estimate: Estimate, direction: np.ndarray) -> Estimate:
    """The estimate with one more error (P,) that all points share, independent of the others."""
    root = np.column_stack([estimate.root, direction])
    errors, correlation = errors_and_correlation(root)
    lost = ~np.isfinite(estimate.standard_errors)
    shared = np.column_stack([*([] if estimate.shared is None else [estimate.shared]), direction])
    return estimate._replace(
        root=root, standard_errors=np.where(lost, np.inf, errors), correlation=correlation, shared=shared
    )


def with_shared_errors(estimate: Estimate, other: Estimate) -> Estimate:
    """The estimate with the shared errors of `other`; each keeps its size relative to the value of its number."""
    if other.shared is None:
        return estimate
    known = other.values != 0
    part = np.divide(estimate.values, other.values, out=np.ones_like(other.values), where=known)
    for direction in other.shared.T:
        estimate = wider(estimate, part * direction)
    return estimate


#: Largest relative change of a number by the mesh at which the first-order estimate `mesh_bias` is used.
LARGEST_BIAS = 0.3
#: Standard error over the value from which the data do not determine a number.
UNKNOWN = 100.0


def mesh_bias(found: Solution, natural_of: Callable[[jax.Array], jax.Array], missing: np.ndarray) -> np.ndarray:
    """Change of the numbers (P,) by meshes: J^+ times `missing` (n,), their errors of the data over the noise.

    It is of first order. It is accurate if the meshes' errors are below a quarter and the numbers are not nearly
    dependent. Subtract it once to correct.
    """
    J, (_, to_natural) = np.asarray(found.jacobian), with_slope(natural_of, found.u)
    if not (np.all(np.isfinite(J)) and np.all(np.isfinite(missing))):
        return np.full(len(to_natural), np.nan)
    return to_natural @ (np.linalg.pinv(J) @ missing)


def bias_sentences(estimate: Estimate) -> list[str]:
    """Warnings if the mesh moves a number by more than its standard error, or by too much for an estimate."""
    bias, values = estimate.mesh_bias, np.asarray(estimate.values)
    if bias is None:
        return []
    errors = estimate.standard_errors
    unknown = np.flatnonzero(np.isfinite(errors) & (errors > UNKNOWN * np.abs(values)))
    if len(unknown):  # their bias is roundoff, as much enlarged
        names = ", ".join(estimate.names[k] for k in unknown)
        return [
            f"the data do not determine {names}: the standard errors are more than {UNKNOWN:g} times the values, and "
            "another mesh does not help; motions without a force determine ratios of moduli alone: give a traction or "
            "a measured force, or fit fewer numbers"
        ]
    lost = np.flatnonzero(~(np.abs(bias) <= LARGEST_BIAS * np.abs(values)) & ~(np.abs(bias) <= errors))
    if len(lost):
        names = ", ".join(estimate.names[k] for k in lost)
        return [f"the mesh moves {names} by a third or more: the data do not determine them on this mesh; refine it"]
    more = np.flatnonzero(np.abs(bias) > estimate.standard_errors)
    if not len(more):
        return []
    each = ", ".join(f"{estimate.names[k]} by {bias[k]:.2g}" for k in more)
    return [f"the mesh moves {each}, more than the standard error: subtract mesh_bias, or refine the mesh"]
