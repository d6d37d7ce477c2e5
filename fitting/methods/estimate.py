"""The result of a fit: parameters, standard errors and correlation, computed from the Jacobian at the minimum."""

from collections.abc import Callable, Sequence
from typing import NamedTuple

import jax
import numpy as np
import scipy.special

from fitting.methods import host
from fitting.methods.least_squares import Solution

#: Value that replaces an infinite error in a covariance. The square of this value is still finite.
LOST = 1e140

#: Lower bound of the singular values of a square root of a covariance, divided by the largest singular value.
_NO_SPREAD = 1e-10


class Estimate(NamedTuple):
    """P parameters in the order of `names`, with standard errors and correlation. k is the number of independent
    errors, and s the number of systematic errors among them."""

    names: tuple[str, ...]
    values: np.ndarray  # (P,)
    root: np.ndarray  # (P, k) square root of the covariance; huge in directions that the data do not determine
    standard_errors: np.ndarray
    correlation: np.ndarray
    chi2: float  # sum of squares of the residuals, each divided by its given scale
    components: int  # number of measured values
    noise: float  # standard deviation of the data, divided by the given scales: 1, or estimated from the residuals
    freedom: float  # number of (independent) values minus the (effective) number of unknowns
    iterations: int
    converged: bool
    codes: tuple[int, ...] = ()  # most severe status code of each simulation
    seconds: float = 0.0
    mesh_bias: np.ndarray | None = None  # (P,) error of the values due to the mesh; None: unknown
    time_step_bias: np.ndarray | None = None  # (P,) error of the values due to the time steps
    shared: np.ndarray | None = None  # (P, s) columns of `root`: errors common to all points (gap, instrument)
    mesh_over_noise: float | None = None  # root mean square of the mesh error, divided by the noise
    warnings: tuple[str, ...] = ()  # warnings of the fit that do not follow from the other fields

    @property
    def covariance(self) -> np.ndarray:
        """Covariance (P, P) of the parameters."""
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
    """Return the estimate for a minimum that a search has found. The delta method converts the covariance of the
    unknowns u to the reported parameters.

    Args:
        names: names of the parameters to report.
        natural_of: function that computes these parameters (P,) from the unknowns u.
        found: result of the search over u. If `found` contains NumPy arrays, `natural_of` must work in
            `host.with_jacobian`.
        components: number of residuals that come from measured values. If u has no prior, all other residuals are 0.
        deviations_given: whether the standard deviations of the data are given, see `noise_factor`.
        effective: effective number of parameters that the data determine, if u has a prior. The residuals of the prior
            then follow the `components` residuals of the data.
    """
    u, jacobian, r = (np.asarray(v) for v in (found.u, found.jacobian, found.residuals))
    if effective is not None:
        r = r[:components]
    freedom = components - (len(u) if effective is None else effective)
    noise = noise_factor(r, freedom, deviations_given)
    values, to_natural = with_slope(natural_of, found.u)
    root, _ = spread(jacobian, noise, to_natural)
    errors, correlation = errors_and_correlation(root)
    # At a bound (a ratio of 0 or 1, a time of 0), the derivative of the parametrisation is 0. The error is then
    # unknown, not zero.
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
    """Return the reported parameters (P,) and their derivatives with respect to u. If u is a NumPy array, nothing is
    compiled."""
    if isinstance(u, np.ndarray):
        with np.errstate(over="ignore", invalid="ignore"):  # a diverged fit gets infinite errors
            return host.with_jacobian(natural_of, u)
    return np.asarray(natural_of(u)), np.asarray(jax.jacfwd(natural_of)(u))


def noise_factor(residuals: np.ndarray, freedom: float, deviations_given: bool) -> float:
    """Return the standard deviation of the noise, divided by the scales of the residuals.

    If no standard deviations are given, the noise is estimated from the residuals. Given standard deviations are used
    unchanged, unless the residuals are larger. In that case, the errors are multiplied by the ratio of the residuals to
    the deviations. The errors are never reduced (the rule of the Particle Data Group).
    """
    estimate = float(np.sqrt(np.sum(residuals**2) / max(1, freedom)))
    return max(1.0, estimate) if deviations_given else estimate


#: Lower bound of the degrees of freedom for correlated noise. Three is the smallest whole number for which Student's t
#: has a finite variance. With one degree of freedom, the 95 % quantile would be 12.7 instead of 3.2. But the intervals
#: of simulated sweeps would contain the true value hardly more often.
LEAST_FREEDOM = 3.0


def freedom_of_alike(freedom: float, components: int, independent: float) -> float:
    """Return the degrees of freedom if the noise of neighbouring values is correlated.

    Args:
        freedom: degrees of freedom for independent noise.
        components: number of measured values.
        independent: number of independent values that carry the same information.
    """
    return min(freedom, max(LEAST_FREEDOM, independent - (components - freedom)))


def spread(jacobian: np.ndarray, noise: float, to_natural: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the square root A of the covariance A A^T of the reported parameters (delta method), and the singular
    values of the scaled Jacobian.

    Args:
        jacobian: derivatives of the residuals with respect to the unconstrained parameters u.
        noise: standard deviation of a residual.
        to_natural: derivatives of the reported parameters with respect to u.
    """
    if not (np.all(np.isfinite(jacobian)) and np.any(jacobian)):  # the fit could not begin: all errors are infinite
        return np.full((len(to_natural), jacobian.shape[1]), np.inf), np.zeros(min(jacobian.shape))
    scale = np.maximum(np.linalg.norm(jacobian, axis=0), 1e-300)
    # If there are fewer residuals than unknowns, rows of zeros are added, so that the SVD returns all directions.
    missing = np.zeros((max(0, jacobian.shape[1] - len(jacobian)), jacobian.shape[1]))
    _, s, Vt = np.linalg.svd(np.vstack([jacobian / scale, missing]), full_matrices=False)
    # A direction that the data do not determine gets 1e14 times the error of the best determined direction. An infinite
    # error would give infinity times zero.
    with np.errstate(over="ignore", invalid="ignore"):  # a parameter that diverged has no finite error
        root = noise * ((to_natural / scale) @ Vt.T) / np.maximum(s, 1e-14 * s[0])
    return np.clip(np.where(np.isfinite(root), root, LOST), -LOST, LOST), s


def errors_and_correlation(root: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return standard errors (P,) and correlation (P, P) from the square root of a covariance."""
    with np.errstate(over="ignore", invalid="ignore"):  # errors may be infinite
        covariance = root @ root.T
        errors = np.sqrt(np.diag(covariance))
        return errors, covariance / np.maximum(np.outer(errors, errors), 1e-300)


def covering_root(first: np.ndarray, second: np.ndarray) -> np.ndarray:
    """Return the square root (P, P) of a covariance that is at least as large as two given covariances of P parameters:
    every linear combination of the parameters has at least the variance that each given covariance gives.

    Args:
        first, second: square roots (P, k) of the two covariances; k may differ.
    """
    all_directions = np.zeros((len(first), len(first)))  # these zeros give P axes for any k
    sizes = np.maximum(np.linalg.norm(first, axis=1), np.linalg.norm(second, axis=1))
    sizes = np.where(sizes > 0, sizes, 1.0)[:, None]
    U, s, _ = np.linalg.svd(np.hstack([first / sizes, all_directions]), full_matrices=False)
    if not np.any(s):
        return second
    # In the coordinates with the axes U s, the first covariance is the unit matrix.
    s = np.maximum(s, _NO_SPREAD * s.max())
    M = np.hstack([(U / s).T @ (second / sizes), all_directions])
    axes, ratios, _ = np.linalg.svd(M, full_matrices=False)  # roundoff would destroy the small ratios in M M^T
    return sizes * ((U * s) @ axes * np.maximum(ratios, 1.0))


def wider(estimate: Estimate, direction: np.ndarray) -> Estimate:
    """Return the estimate with one more systematic error, common to all points. `direction` (P,): change of the
    parameters if this error is one standard deviation. The added error is independent of the other errors."""
    root = np.column_stack([estimate.root, direction])
    errors, correlation = errors_and_correlation(root)
    lost = ~np.isfinite(estimate.standard_errors)
    shared = np.column_stack([*([] if estimate.shared is None else [estimate.shared]), direction])
    return estimate._replace(
        root=root, standard_errors=np.where(lost, np.inf, errors), correlation=correlation, shared=shared
    )


def without_part(error: float, part: float) -> float:
    """Return a standard error after one of its independent parts is subtracted (difference of squares). Return 0 if the
    part is larger."""
    return float(np.sqrt(np.maximum(0.0, (error - part) * (error + part))))


def with_shared_errors(estimate: Estimate, other: Estimate) -> Estimate:
    """Return the estimate with the systematic errors (`shared`) of `other` added. The ratio of each error to the value
    of its parameter is the same as in `other`."""
    if other.shared is None:
        return estimate
    known = other.values != 0
    part = np.divide(estimate.values, other.values, out=np.ones_like(other.values), where=known)
    for direction in other.shared.T:
        estimate = wider(estimate, part * direction)
    return estimate


#: The first-order estimate `mesh_bias` is trusted if the relative change of a parameter due to the mesh is at most this
#: value.
LARGEST_BIAS = 0.3
#: If the standard error exceeds this many times the value, the data do not determine the parameter.
UNKNOWN = 100.0


def mesh_bias(found: Solution, natural_of: Callable[[jax.Array], jax.Array], missing: np.ndarray) -> np.ndarray:
    """Return the change (P,) of the parameters due to the errors of the meshes, to first order. `missing` (n,): errors
    of the n simulated data due to the meshes, divided by the noise. The same function is used for errors of time steps.

    The change of the unknowns u is J^+ `missing`, with the Jacobian J of the residuals. This estimate is accurate if
    the errors are below 25 % and the parameters are not nearly dependent. To correct the parameters, subtract the
    result only once.
    """
    J, (_, to_natural) = np.asarray(found.jacobian), with_slope(natural_of, found.u)
    if not (np.all(np.isfinite(J)) and np.all(np.isfinite(missing))):
        return np.full(len(to_natural), np.nan)
    return to_natural @ (np.linalg.pinv(J) @ missing)


def bias_sentences(estimate: Estimate) -> list[str]:
    """Return warnings if the mesh or the time step changes a parameter by more than its standard error, or by too much
    for a first-order estimate. Another warning is returned if the data do not determine a parameter."""
    of_mesh = _sentences_of(estimate, estimate.mesh_bias, ("the mesh", "mesh_bias", "refine the mesh"))
    steps = ("the time step", "time_step_bias", "use smaller time steps")
    return list(dict.fromkeys([*of_mesh, *_sentences_of(estimate, estimate.time_step_bias, steps)]))


def _sentences_of(estimate: Estimate, bias: np.ndarray | None, source: tuple[str, str, str]) -> list[str]:
    """Return warnings about one kind of bias. `source`: cause of the bias, name of the bias, and a remedy."""
    if bias is None:
        return []
    values, errors, (what, name, remedy) = np.asarray(estimate.values), estimate.standard_errors, source
    unknown = np.flatnonzero(np.isfinite(errors) & (errors > UNKNOWN * np.abs(values)))
    if len(unknown):  # the bias of these parameters is only amplified roundoff
        names = ", ".join(estimate.names[k] for k in unknown)
        return [
            f"the data do not determine {names}: the standard errors are more than {UNKNOWN:g} times the values, and "
            "another mesh or step does not help. Displacements without a force determine only ratios of moduli. Give a "
            "traction or a measured force, or fit fewer parameters"
        ]
    if np.any(np.isnan(bias)):
        return [f"the effect of {what} on the fit is unknown, because a run or its estimate failed: {remedy}"]
    lost = np.flatnonzero(~(np.abs(bias) <= LARGEST_BIAS * np.abs(values)) & ~(np.abs(bias) <= errors))
    if len(lost):
        names = ", ".join(estimate.names[k] for k in lost)
        return [
            f"the error of {what} changes {names} by more than {LARGEST_BIAS:.0%}, so the data do not determine "
            f"these parameters in this simulation: {remedy}"
        ]
    more = np.flatnonzero(np.abs(bias) > estimate.standard_errors)
    if not len(more):
        return []
    each = ", ".join(f"{estimate.names[k]} by {bias[k]:.2g}" for k in more)
    return [
        f"the error of {what} changes fitted values by more than their standard errors ({each}): subtract {name}, or "
        f"{remedy}"
    ]
