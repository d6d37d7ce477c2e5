"""Measures of how well the data determine the parameters: covariance, profile likelihood and warnings."""

from collections.abc import Callable
from functools import partial
from typing import Protocol

import jax
import jax.numpy as jnp
import numpy as np

from fitting.methods import generalised_maxwell
from fitting.methods.estimate import Estimate, estimated, without_part
from fitting.methods.generalised_maxwell import Maxwell
from fitting.methods.host import Array, arrays_of
from fitting.methods.least_squares import Solution, levenberg_marquardt
from fitting.readers.frequency_sweep import SHARED
from fitting.readers.rheometer import Sweep
from liverjax.core.errors import InputError
from liverjax.core.struct import Content


def parameter_vector(u: Array, maxwell: Callable[[Array], Maxwell] = generalised_maxwell.natural) -> Array:
    """Return G0, ratios and relaxation times (2N + 1,) of the Prony modes that `maxwell` computes from u."""
    model = maxwell(u)
    xp = arrays_of(*model)
    return xp.concatenate([model.shear_modulus[..., None], model.ratios, model.relaxation_times], axis=-1)


def parameter_names(modes: int) -> tuple[str, ...]:
    """Return the names of the parameters in the order of `parameter_vector`."""
    ratios, times = ([f"{n}[{i}]" for i in range(modes)] for n in ("ratios", "relaxation_times"))
    return ("shear_modulus", *ratios, *times)


def estimate(
    found: Solution,
    deviations_given: bool,
    maxwell: Callable[[Array], Maxwell] = generalised_maxwell.natural,
    components: tuple[int, float | None] | None = None,
    fluid: bool = False,
) -> Estimate:
    """Return values, standard errors and correlation of G0, ratios and relaxation times at the minimum.

    Args:
        found: result of the search over u.
        deviations_given: whether the standard deviations of the data are given, see `estimate.noise_factor`.
        maxwell: function from u to Prony modes; by default `generalised_maxwell.natural`.
        components: number of measured residuals (default: all), and effective number of parameters (default: length of
            u).
        fluid: whether u has no equilibrium modulus, so that the ratios add up to 1.
    """
    count, effective = components or (len(found.residuals), None)

    modes = jax.eval_shape(maxwell, found.u).ratios.shape[0]
    vector = partial(parameter_vector, maxwell=maxwell)
    own = estimated(parameter_names(modes), vector, found, count, deviations_given, effective)
    if modes == 1 and fluid:  # the ratio is exactly 1
        own = own._replace(standard_errors=np.where(np.arange(len(own.values)) == 1, 0.0, own.standard_errors))
    return own


#: If 1 minus the sum of the ratios is below this value, the material is a fluid.
NO_REST = 1e-10


def equilibrium_error(u: Estimate) -> float:
    """Return the standard error [Pa] of the equilibrium modulus G0 (1 - sum g). It is infinite for a fluid."""
    modes = (len(u.values) - 1) // 2
    rest = 1 - u.values[1 : modes + 1].sum()
    # The square root of the covariance is used, so that the variance is never negative.
    slope = np.concatenate([[rest], np.full(modes, -u.values[0]), np.zeros(modes)])
    return float(np.linalg.norm(slope @ u.root)) if rest > NO_REST else np.inf


#: If the equilibrium modulus of a solid is below this fraction of G0, the solid is compared with a fluid.
_SOFT = 0.01


def may_be_fluid(u: Estimate) -> bool:
    """Return whether the equilibrium modulus is so small, or so uncertain, that a fluid may explain the data equally
    well."""
    return not _equilibrium(u) > max(2 * equilibrium_error(u), _SOFT * u.values[0])


def like_a_fluid(u: Estimate, remedy: str) -> list[str]:
    """Return a warning with the given remedy if the equilibrium modulus of a solid is below twice its standard
    error."""
    stays = _equilibrium(u)
    if stays > 2 * equilibrium_error(u):
        return []
    return [
        f"the ratios add up to {1 - stays / u.values[0]:.4g}: the equilibrium modulus {stays:.3g} Pa cannot be "
        f"distinguished from zero (a fluid); {remedy}"
    ]


def _equilibrium(u: Estimate) -> float:
    return float(u.values[0] * (1 - u.values[1 : 1 + (len(u.values) - 1) // 2].sum()))


def equilibrium_change(values: np.ndarray, moved: np.ndarray) -> np.ndarray:
    """Return the first-order change [Pa] of the equilibrium modulus G0 (1 - sum g). `moved` (1 + 2N, ...): changes of
    G0, ratios and times."""
    ratios = slice(1, 1 + (len(values) - 1) // 2)
    return moved[0] * (1 - values[ratios].sum()) - values[0] * moved[ratios].sum(axis=0)


def has_profile(found: Solution, uncertainty: Estimate) -> bool:
    """Return whether the fitted parameters are the Prony modes of a solid. `profile_intervals` needs such a fit."""
    if len(found.u) < 3 or len(found.u) % 2 == 0:
        return False
    known = parameter_names((len(found.u) - 1) // 2)
    return tuple(uncertainty.names[: len(known)]) == tuple(known)


def profile_intervals(found: Solution, sweep: Sweep, uncertainty: Estimate, points: int = 21) -> Content:
    """Compute 95 % intervals by profile likelihood, for a closed-form fit of Prony modes of a solid. One parameter is
    fixed at several values, and all other parameters are fitted again for each value.

    The likelihood contains only noise of the same relative size in G' and G''. If `uncertainty` has errors of the gap
    or the instrument too, or larger errors of the noise, these errors widen the interval. The squares of both half
    widths are added. If `uncertainty` has a smaller error of the noise (for example because G' has more noise than
    G''), the half widths are multiplied by the ratio of both errors. Both changes are right to first order.

    Returns:
        [low, high] for each name. An end is None if the likelihood does not fall to the limit of the interval within
            about four standard errors.

    Raises:
        InputError: the fitted model is a fluid, or does not consist of Prony modes.
    """
    if not has_profile(found, uncertainty):
        raise InputError("profile intervals are for Prony modes of a solid: use the standard errors or the posterior")
    data = (jnp.asarray(sweep.angular_frequency), sweep.storage, sweep.loss, np.concatenate(sweep.deviations))
    best = 2 * float(found.cost)
    by_noise = estimate(found, sweep.noise_given).standard_errors

    def held(u, j, value, weight, *data):
        penalty = weight * (parameter_vector(u)[j] - value)
        return jnp.append(generalised_maxwell.residuals(u, *data), penalty)

    @jax.jit
    def along(j, values, weight):
        def one(value):
            s = levenberg_marquardt(held, found.u, j, value, weight, *data)
            return parameter_vector(s.u)[j], jnp.sum(s.residuals[:-1] ** 2)

        return jax.vmap(one)(values)

    intervals: dict[str, list] = {}
    for j, name in enumerate(uncertainty.names):
        center, error = uncertainty.values[j], by_noise[j]
        if not np.isfinite(error) or error == 0:
            intervals[name] = [None, None]
            continue
        grid = center + error * np.linspace(-4, 4, points) * uncertainty.quantile / 2
        # The penalty keeps the parameter only near its grid value. So each result is the constrained optimum for the
        # value `reached`, not for the grid value.
        reached, chi2 = (
            np.asarray(v) for v in along(j, jnp.maximum(grid, 1e-3 * center), 1e3 * uncertainty.noise / error)
        )
        rise = (chi2 - best) / uncertainty.noise**2 - uncertainty.quantile**2
        middle, whole = points // 2, float(uncertainty.standard_errors[j])
        common = 0.0 if uncertainty.shared is None else float(np.linalg.norm(uncertainty.shared[j]))
        ratio = min(1.0, without_part(whole, common) / error)
        half = uncertainty.quantile * without_part(whole, ratio * error)
        ends = _crossing(reached[middle::-1], rise[middle::-1]), _crossing(reached[middle:], rise[middle:])
        intervals[name] = [_farther(end, center, ratio, half) for end in ends]
    return intervals


def _farther(end: float | None, center: float, ratio: float, half: float) -> float | None:
    """Return the end of an interval around `center`, if its distance from the center is multiplied by `ratio` and one
    more independent error is added. `half`: half width of the interval that this error alone gives."""
    if end is None:
        return None
    return float(center + np.copysign(np.hypot(ratio * (end - center), half), end - center))


def _crossing(x: np.ndarray, rise: np.ndarray) -> float | None:
    """Return the first position along x at which `rise` passes 0, by linear interpolation. Returns None if `rise` does
    not pass 0."""
    above = np.flatnonzero(rise > 0)
    if not len(above) or above[0] == 0:
        return None
    k = above[0]
    return float(x[k - 1] + (x[k] - x[k - 1]) * rise[k - 1] / (rise[k - 1] - rise[k]))


#: Two neighbouring relaxation times act as one mode if their ratio is below this value.
MERGED = 1.5


class Band(Protocol):
    """Data that resolve relaxation times: a frequency sweep, or a relaxation or creep test."""

    @property
    def resolved(self) -> tuple[float, float]:
        """Shortest and longest resolved relaxation time [s]."""


def _decades(data: Band) -> float:
    low, high = data.resolved
    return float(np.log10(high / low))


def supported_modes(data: Band) -> int:
    """Return the number of modes that the band supports: about one for each decade, plus one."""
    return max(1, int(_decades(data) + 1 + 1e-9))  # so that roundoff does not remove a mode


def superfluous(data: Band, u: Estimate) -> list[str]:
    """Return warnings that advise against some of the modes. The list is empty if the data support all modes of `u`."""
    modes = (len(u.values) - 1) // 2
    kind, measured = ("sweep", "measured frequencies") if isinstance(data, Sweep) else ("test", "measured times")
    fewer = f"use fewer modes or a wider {kind}" if modes > 1 else f"use a wider {kind}"
    g, tau = u.values[1 : modes + 1], u.values[modes + 1 :]
    g_err, tau_err = u.standard_errors[1 : modes + 1], u.standard_errors[modes + 1 :]
    low, high = data.resolved
    out = []
    for k in range(modes):
        if not low / 100 <= tau[k] <= 100 * high:
            product = f"G0 * ratios[{k}] {'*' if tau[k] < low else '/'} relaxation_times[{k}]"
            out.append(
                f"relaxation_times[{k}] = {tau[k]:.3g} s lies far outside the {low:.3g}-{high:.3g} s that the "
                f"{measured} resolve. Only {product} is determined: "
                f"{'use fewer modes or another band' if modes > 1 else 'use another band'}"
            )
        if not g_err[k] < 0.5 * g[k]:
            out.append(
                f"ratios[{k}] = {g[k]:.3g} has a standard error of {_percent(g_err[k], g[k])}: "
                + (
                    "the data do not need this mode; use fewer modes"
                    if modes > 1
                    else f"the data do not determine this ratio; {fewer}"
                )
            )
        elif not tau_err[k] < 0.5 * tau[k]:
            out.append(
                f"relaxation_times[{k}] = {tau[k]:.3g} s has a standard error of {_percent(tau_err[k], tau[k])}: the "
                f"data hardly determine this time; {fewer}"
            )
    for k in range(modes - 1):
        if tau[k] < MERGED * tau[k + 1]:
            out.append(
                f"relaxation times {tau[k]:.3g} s and {tau[k + 1]:.3g} s have merged, so they act as one mode; use "
                f"{modes - 1} mode{'s' if modes > 2 else ''}"
            )
    if modes > supported_modes(data) or _decades(data) < 0.3:
        out.append(
            f"the {kind} spans {_decades(data):.2g} decades, which is too short for {modes} "
            f"mode{'s' if modes > 1 else ''} (the limit is about one mode per decade, plus one): {fewer}"
        )
    return out


#: Remedy in a warning if a sweep does not show the equilibrium modulus.
LOWER = "measure at lower frequencies"

#: If the relative scatter of the points is below this value, the points were computed and not measured.
_SMALL = 1e-4


def cautions(sweep: Sweep, u: Estimate, model: str = "prony") -> list[str]:
    """Return warnings about parameters that the data do not determine and about the standard deviations in the file,
    each with a remedy."""
    modes = (len(u.values) - 1) // 2
    tau, tau_err = u.values[modes + 1 :], u.standard_errors[modes + 1 :]
    low, high = 1 / sweep.angular_frequency[-1], 1 / sweep.angular_frequency[0]
    out = superfluous(sweep, u)
    for k in range(modes):
        if low / 100 <= tau[k] <= 100 * high and not low <= tau[k] <= high:
            out.append(
                f"relaxation_times[{k}] = {tau[k]:.3g} s lies outside the {low:.3g}-{high:.3g} s that the measured "
                f"frequencies resolve, so this time is extrapolated (standard error {_percent(tau_err[k], tau[k])}): "
                f"measure at {'higher' if tau[k] < low else 'lower'} frequencies to determine it"
            )
    if model == "prony":
        out += like_a_fluid(u, LOWER)
    if sweep.storage_sd is not None and not (sweep.noise_given or sweep.sd_estimated or sweep.sd_before):
        out.append(
            f"the deviations in the file ({100 * sweep.relative_deviation:.2g} %) are not noise: the points scatter by "
            f"only {100 * sweep.point_scatter:.2g} %. The deviations are used as weights, and as the spread between "
            "samples (one sample may differ from these moduli by as much as the deviations). To fit each sample, give "
            "one file per sample"
        )
    elif sweep.noise_given and _SMALL < sweep.point_scatter < sweep.relative_deviation / SHARED:
        out.append(
            f"the points scatter by {100 * sweep.point_scatter:.2g} %, but the deviations in the file are "
            f"{100 * sweep.relative_deviation:.2g} %. If these are the spread between samples, the errors of ratios "
            "and times are too large, and the fit of this curve is not reliable. In that case, give one file "
            "per sample"
        )
    elif sweep.noise_given and u.noise > 1.5:
        out.append(
            f"the residuals are {u.noise:.2g} times the given deviations, so the model misses something, or the "
            "deviations are too small. The standard errors are enlarged by this factor"
        )
    return out


def _percent(error: float, value: float) -> str:
    with np.errstate(over="ignore"):
        ratio = 100 * error / abs(value) if value else np.inf
    return f"{ratio:.3g} %" if ratio < 1e4 else "more than 10000 %"
