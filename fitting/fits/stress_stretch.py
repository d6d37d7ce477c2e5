"""Hyperelastic laws, fitted to stress-stretch curves by least squares from many starting points. If the stress of the
law decreases while the sample is deformed further, a penalty is added to the residuals."""

import time
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import scipy.stats

from fitting.fits.families.hyperelastic import Candidate, ground_state_modulus, out_of_bounds
from fitting.fits.families.hyperelastic import candidates as candidates  # users import it from this module
from fitting.fits.honesty.other_minima import of_other_minima
from fitting.fits.viscoelastic import EXACT
from fitting.methods.estimate import LOST, covering_root, errors_and_correlation, noise_factor, spread
from fitting.methods.least_squares import Solution, levenberg_marquardt
from fitting.methods.noise.alike_noise import Alike, along_rows
from fitting.methods.noise.factor_noise import FactorNoise, factors_of_groups
from fitting.methods.noise.uneven_noise import growing_root, uneven_root
from fitting.readers.curves import Curve, check_curves
from liverjax import laws
from liverjax.core.errors import InputError
from liverjax.laws import Law, homogeneous
from liverjax.laws.stability_check import ellipticity

STARTS = 128
#: Weight of a decreasing stress in the residuals: a decrease by 1 % of the divisor of the residuals counts like a
#: misfit of 100 %.
STIFFNESS = 100.0


class LawFit(NamedTuple):
    """The fit of one law."""

    label: str
    names: tuple[str, ...]
    units: tuple[str, ...]
    values: np.ndarray
    standard_errors: np.ndarray
    correlation: np.ndarray
    law: Law
    shear_modulus: float
    cost: float  # half the sum of squared relative residuals
    curve_errors: dict[str, float]  # root mean square of the misfit / of the curve's stress
    mean_relative_error: float  # root mean square of the relative misfit over all points
    aicc: float
    bic: float
    converged: bool
    iterations: int
    starts_at_minimum: int
    warnings: list[str]
    run_time: float
    compile_time: float
    limits: dict[str, str]  # parameters that went to a limit, with the limit: 0 or infinity


#: The stresses of a test may all be multiplied by a wrong factor that the residuals do not show. Such factors are
#: reported if they change a parameter by more than _HIDDEN standard errors and by more than the fraction _MOVED of its
#: value.
_HIDDEN, _MOVED = 2.0, 0.05
#: A parameter ran into a limit of its law under two conditions. It ended above or below its typical size by more than
#: the factor RUNAWAY, and its standard error is at least FREE times its value. The second condition is needed because
#: typical sizes are valid for large strains. At small strains, coefficients of higher terms may be far larger, and the
#: data may still determine them.
RUNAWAY, FREE = 1e6, 30.0
#: The comparison with FREE assumes at least this relative noise, because no test is more accurate.
_LEAST_NOISE = 1e-3
#: _REPEATS: number of repeated fits whose residuals are divided by the law's stress. No fit is repeated if the law's
#: stress is below _LEAST_SIZE times the measured stress in a curve. If the stress of a curve differs by more than the
#: factor _FOREIGN from the stress of other curves of the same test, it may be wrong, e.g. in another unit.
_REPEATS, _LEAST_SIZE, _FOREIGN = 3, 0.05, 2.0
_tangents = jax.jit(lambda law, F: law.tangent(F))


def initial_modulus(curves: list[Curve]) -> float:
    """Return the scale of the shear modulus [Pa] for the starting points: the median of (measured stress) / (stress of
    a neo-Hookean law with mu = 1 Pa)."""
    unit = laws.NeoHookean(mu=1.0, bulk=None)  # type: ignore[arg-type]  # the sample is incompressible
    ratios = []
    for c in curves:
        model = np.asarray(homogeneous.nominal_stress(unit, jnp.asarray(c.F)))[:, c.component[0], c.component[1]]
        keep = np.abs(model) > 0.02 * np.abs(model).max()
        if keep.any():
            ratios.append(np.median(c.stress[keep] / model[keep]))
    positive = [r for r in ratios if r > 0]
    if not positive:
        raise InputError(
            "in every curve, the stresses have the wrong sign (they point against the strains): check signs and axes"
        )
    return float(np.median(positive))


def fit(candidate: Candidate, curves: list[Curve], starts: int = STARTS) -> LawFit:
    """Minimise the sum of squares of the relative misfit. The misfit is the difference between the nominal stress P of
    the law and the measured stress, divided by the root mean square of the curve's stress. If the stress decreases
    while the sample is deformed further, a penalty is added (`STIFFNESS`). Return the lowest minimum from many starting
    points.

    If several curves belong to one test, the divisor is the root mean square of the law's stress. With the measured
    stress as divisor, samples that are soft by chance would have more weight. The moduli would then be too low: by 8 %
    if samples scatter by 20 %.
    """
    check_curves(curves)
    scale = initial_modulus(curves)
    F, at = jnp.asarray(np.concatenate([c.F for c in curves])), np.cumsum([0] + [len(c.stress) for c in curves])
    i, j = (jnp.asarray(np.repeat([c.component[k] for c in curves], np.diff(at))) for k in (0, 1))
    stress = jnp.asarray(np.concatenate([c.stress for c in curves]))
    rows = jnp.arange(F.shape[0])
    inside = np.setdiff1d(np.arange(1, F.shape[0]), at)  # points whose previous point is on the same curve
    driven = np.concatenate([c.driven for c in curves])
    works = np.repeat([c.rises for c in curves], np.diff(at))[inside]
    rising = jnp.asarray(np.where(works, np.sign(driven[inside] - driven[inside - 1]), 0.0))

    def residuals(u, sizes):
        P = homogeneous.nominal_stress(candidate.law(candidate.values(u, scale)), F, constant=True)
        model = P[rows, i, j] / sizes
        falling = jnp.minimum(rising * (model[inside] - model[inside - 1]), 0.0)
        return jnp.concatenate([model - stress / sizes, STIFFNESS * falling])

    def searched(points, sizes):
        return jax.vmap(lambda u: levenberg_marquardt(lambda u: residuals(u, sizes), u))(points)

    begin = time.perf_counter()
    points = jnp.asarray(candidate.random(np.random.default_rng(0), starts))
    sizes = np.repeat([c.scale for c in curves], np.diff(at))
    program = jax.jit(searched).lower(points, jnp.asarray(sizes)).compile()
    compiled = time.perf_counter()
    found = jax.block_until_ready(program(points, jnp.asarray(sizes)))
    for _ in range(_REPEATS if len({(c.test, c.component) for c in curves}) < len(curves) else 0):
        each = _sizes_of_law(found, curves, sizes)
        if each is None:
            break
        curves = [c._replace(law_scale=size) for c, size in zip(curves, each, strict=True)]
        sizes = np.repeat(each, np.diff(at))
        found = jax.block_until_ready(program(points, jnp.asarray(sizes)))
    return assessed(candidate, curves, found, scale, (time.perf_counter() - compiled, compiled - begin))


def _sizes_of_law(found: Solution, curves: list[Curve], sizes: np.ndarray) -> list[float] | None:
    """Return the divisor [Pa] of the residuals of each curve for the best parameters in `found`. Return None if the
    stress of this law is far below the measured stress in a curve, or not finite.

    If no other curve belongs to the same test, the divisor is the root mean square of the measured stress. Otherwise,
    the divisor is the root mean square of the law's stress. If the ratio of measured stress and law's stress differs
    from the ratio of the other curves by more than the factor `_FOREIGN`, the divisor is the larger of both root mean
    squares. `sizes` (n,): divisors of the n residuals of `found`.
    """
    costs = np.where(np.isfinite(found.cost), np.asarray(found.cost), np.inf)
    off = np.asarray(found.residuals)[int(np.argmin(costs))][: len(sizes)] * sizes
    ends = np.cumsum([len(c.stress) for c in curves])[:-1]
    law = np.array([np.sqrt(np.mean((c.stress + d) ** 2)) for c, d in zip(curves, np.split(off, ends), strict=True)])
    measured = np.array([c.scale for c in curves])
    if not np.all(law > _LEAST_SIZE * measured):
        return None
    kinds = [(c.test, c.component) for c in curves]
    typical = [np.median([m / s for k, m, s in zip(kinds, measured, law, strict=True) if k == own]) for own in kinds]
    foreign = np.abs(np.log(measured / law / typical)) > np.log(_FOREIGN)
    alone = np.array([kinds.count(own) == 1 for own in kinds])
    return np.where(alone, measured, np.where(foreign, np.maximum(law, measured), law)).tolist()


def assessed(
    candidate: Candidate, curves: list[Curve], found: Solution, scale: float, times: tuple, of_tests: bool = True
) -> LawFit:
    """Return the fit from the best starting point, with measures of its quality and with warnings for the user.

    `of_tests`: whether each curve is one test, and the residuals are stress differences, divided by `Curve.divisor`.
    """
    costs = np.where(np.isfinite(found.cost), np.asarray(found.cost), np.inf)
    best = int(np.argmin(costs))
    lowest = costs[best] * (1 + 1e-6) + 1e-20  # searches with a cost up to this value reached the minimum
    u, J, r = (np.asarray(v)[best] for v in (found.u, found.jacobian, found.residuals))
    n, p = sum(len(c.stress) for c in curves), len(u)
    misfit, k = r[:n], p + 1
    split = _relative_to_measured(curves, misfit)
    square = max(float(np.mean(np.concatenate(split) ** 2)), 1e-300)
    values = np.asarray(jax.jit(candidate.values)(u, scale))
    noise = noise_factor(misfit, n - p, deviations_given=False)
    slope = np.asarray(jax.jit(jax.jacfwd(candidate.values))(u, scale))
    every, _ = errors_and_correlation(spread(J[:n], max(noise, _LEAST_NOISE), slope)[0])
    limits = _run_away(candidate, values, every, scale)
    # A parameter at its limit gets no standard error. The other errors are valid for the law at this limit.
    known = np.array([name not in limits for name in candidate.names])
    own_J, own_slope = _with_products_of_limits(J[:n], slope, known)
    half, s = spread(own_J, noise, own_slope)
    errors, correlation = np.full(p, np.nan), np.full((p, p), np.nan)
    residuals = own_J, misfit, noise
    its_errors, its_correlation, alike, factors = _errors_of_law(curves, residuals, own_slope, half, of_tests)
    if n > p:
        errors[known] = its_errors
    if np.all(np.isfinite(half)):
        correlation[np.ix_(known, known)] = its_correlation
    law = candidate.law(jnp.asarray(values))
    result = LawFit(
        label=candidate.label,
        names=candidate.names,
        units=candidate.units,
        values=values,
        standard_errors=errors,
        correlation=correlation,
        law=law,
        shear_modulus=ground_state_modulus(law),
        cost=float(costs[best]),
        curve_errors={c.label: float(np.sqrt(np.mean(v**2))) for c, v in zip(curves, split, strict=True)},
        mean_relative_error=float(np.sqrt(square)),
        aicc=float(n * np.log(square) + 2 * k + 2 * k * (k + 1) / (n - k - 1)) if n > k + 1 else np.inf,
        bic=float(n * np.log(square) + k * np.log(n)),
        converged=bool(found.converged[best]),
        iterations=int(found.iterations[best]),
        starts_at_minimum=int(np.sum(costs <= lowest)),
        warnings=[],
        run_time=times[0],
        compile_time=times[1],
        limits=limits,
    )
    told = [*_warnings(result, curves, s, bool(np.any(r[n:] < 0))), *out_of_bounds(candidate, values, limits)]
    told += _of_noise(alike, factors, n, len({c.sample or c.label for c in curves}))
    told += _of_hidden_factors(factors, curves, np.array(candidate.names)[known], values[known], errors[known])
    if of_tests and not limits:
        told += _of_other_minima(candidate, values, np.asarray(found.u)[costs <= lowest], scale, curves)
    return result._replace(warnings=told)


def _relative_to_measured(curves: list[Curve], misfit: np.ndarray) -> list[np.ndarray]:
    """Return the misfit of each curve, divided by the root mean square of its measured stress, so that laws can be
    compared. `misfit` (n,): misfit of all n points, divided by `Curve.divisor`."""
    ends = np.cumsum([len(c.stress) for c in curves])[:-1]
    return [part * c.divisor / c.scale for c, part in zip(curves, np.split(misfit, ends), strict=True)]


def _of_other_minima(
    candidate: Candidate, values: np.ndarray, us: np.ndarray, scale: float, curves: list[Curve]
) -> list[str]:
    """Return a warning if searches ended at the same cost, but with other parameter values (see `of_other_minima`).
    `us` (S, p): p unknowns at the end of the S searches with this cost."""
    every = np.asarray(jax.vmap(lambda u: candidate.values(u, scale))(jnp.asarray(us)))
    return of_other_minima(candidate.names, candidate.law, values, every, np.concatenate([c.F for c in curves]))


#: First words of the warning about factors that multiply the stress of each test, or of all tests of a file.
OWN_FACTORS = ("the stress of each test seems", "the stress of each file seems")
#: If the residuals show factors of tests or of files, the standard errors contain the more likely of both kinds. They
#: contain the other kind too if its log likelihood is lower by less than this value.
_AS_LIKELY = 2.0


def _of_noise(alike: Alike | None, factors: list[FactorNoise], n: int, tests: int) -> list[str]:
    """Return warnings about correlated noise of the n points, and about factors that multiply the stress of each
    test. If factors of tests and factors of files both explain the residuals, only the more probable kind is
    reported."""
    told = []
    if alike is not None:
        told.append(
            "the residuals of neighbouring points are correlated. Possible causes: drift of the instrument, a "
            f"calibration factor or offset of one test, or an inadequate law. The {n} points carry the information of "
            f"{alike.independent:.0f} independent points; the standard errors include this effect"
        )
    own = max((f for f in factors if f.shown), key=lambda f: f.gain, default=None)
    if own is not None:
        of_tests = own.series == tests
        told.append(
            f"{OWN_FACTORS[0 if of_tests else 1]} to be multiplied by an individual factor. These factors scatter by "
            f"{100 * own.deviation:.2g} %, for example due to different samples or wrong sizes of the samples. The "
            f"standard errors contain this scatter (estimated from {own.series} {'tests' if of_tests else 'files'})"
        )
    return told


def _of_hidden_factors(
    every: list[FactorNoise], curves: list[Curve], names: np.ndarray, values: np.ndarray, errors: np.ndarray
) -> list[str]:
    """Return a warning about factors that may multiply the stress of each test, but that the residuals do not show. The
    parameters compensate such factors."""
    tests = len({c.sample or c.label for c in curves})
    if not every or every[0].series != tests or any(own.shown for own in every):
        return []
    factors = every[0]
    much = (factors.moves > _HIDDEN * errors) & (factors.moves > _MOVED * np.abs(values))
    if not np.any(much):
        return []
    remedy = "Measure all tests on one sample, or one test on several samples"
    if len({(c.test, c.component) for c in curves}) == 1:
        remedy = "Measure more samples in this test"
    worst = int(np.argmax(np.where(much, factors.moves / np.maximum(errors, 1e-300), 0.0)))
    return [
        "the stress of each test may be wrong by an individual factor, for example due to another sample or a wrong "
        f"size of the sample. The residuals hardly show such factors, but factors of {100 * factors.hidden:.2g} % "
        f"change {names[worst]} by about {factors.moves[worst]:.2g}, and {values[worst]:.4g} ± {errors[worst]:.2g} "
        f"does not contain this change. {remedy}"
    ]


def _errors_of_law(
    curves: list[Curve],
    residuals: tuple[np.ndarray, np.ndarray, float],
    slope: np.ndarray,
    half: np.ndarray,
    of_tests: bool,
) -> tuple[np.ndarray, np.ndarray, Alike | None, list[FactorNoise]]:
    """Return four results: the standard errors of the P parameters, their correlation, the noise that is correlated
    between neighbouring points, and the factors that multiply the stress of each test and of each file. A file may
    contain the tests of one sample, or of several samples. The standard errors and the correlation are computed from
    one covariance, which covers the covariances for several kinds of noise (`covering_root`).

    Args:
        curves: the fitted curves.
        residuals: at n points: derivatives J (n, p) of the misfit, misfit (n,) and its standard deviation.
        slope: derivatives (P, p) of the parameters with respect to the p unknowns.
        half: square root of the covariance of the parameters, for equal and independent noise.
        of_tests: see `assessed`. If False, factors that multiply a test, and noise that grows with the stress, are not
            considered.
    """
    J, misfit, noise = residuals
    if not (np.all(np.isfinite(misfit)) and np.all(np.isfinite(half))):
        return *errors_and_correlation(half), None, []
    fitted = np.concatenate([c.stress / c.divisor for c in curves]) + misfit
    roots = [uneven_root(J, misfit, slope)]
    if of_tests:
        roots.append(growing_root(J, misfit, fitted, slope))
    alike, counts = None, [len(c.stress) for c in curves]
    factors: list[FactorNoise] = []
    groupings = [c.sample or c.label for c in curves], [c.file or c.sample or c.label for c in curves]
    if J.size and noise > EXACT:  # otherwise the residuals are roundoff
        alike = along_rows(counts, misfit, J, noise, np.linalg.pinv(J))
        factors = factors_of_groups(groupings, counts, J, misfit, fitted, slope) if of_tests else []
    if alike is not None:
        roots.append(slope @ alike.root)
    shown = [own.gain for own in factors if own.shown]
    used = [own for own in factors if own.gain > max(shown, default=0.0) - _AS_LIKELY or not shown]
    for root in [*roots, *(own.root for own in used)]:
        half = covering_root(half, np.clip(np.where(np.isfinite(root), root, LOST), -LOST, LOST))
    return *errors_and_correlation(half), alike, factors


def _warnings(fit: LawFit, curves: list[Curve], singular: np.ndarray, held: bool) -> list[str]:
    told = []
    if sum(len(c.stress) for c in curves) <= len(fit.values):
        told.append(
            f"the law has at least as many parameters ({len(fit.values)}) as there are points, so the errors of the "
            "parameters are unknown: use a law with fewer parameters"
        )
    if not fit.converged:
        told.append("the fit did not converge from its best starting point, so its parameters are not reliable")
    quantile = scipy.stats.t.ppf(0.975, max(1, sum(len(c.stress) for c in curves) - len(fit.values)))
    if fit.limits:
        ran = ", ".join(f"{name} to {end}" for name, end in fit.limits.items())
        told.append(
            f"the fit is best at a limit of the law ({ran}). The given misfit and G0 hold for this limit. The value of "
            "such a parameter has no meaning: use a law without this parameter"
        )
    for name, value, error in zip(fit.names, fit.values, fit.standard_errors, strict=True):
        if name not in fit.limits and not error * quantile < abs(value):
            told.append(
                f"the data do not determine {name}: its value is {value:.3g}, with a standard error of {error:.2g}"
            )
    if not fit.limits and singular[-1] < 1e-7 * singular[0]:
        told.append("the data do not determine at least one combination of the parameters")
    if fit.starts_at_minimum == 1:
        told.append("only one starting point led to this minimum, so there may be a better minimum")
    if held:
        told.append(
            "without a constraint, the stress of the law would decrease within the range of the data, so the fit "
            "stays at the edge of stability"
        )
    solid = fit.law + laws.Volumetric(bulk=jnp.asarray(1e3 * abs(fit.shear_modulus)))
    firm = ellipticity(np.asarray(_tangents(solid, jnp.asarray(np.concatenate([c.F for c in curves]))))) > 0
    parts = np.split(firm, np.cumsum([len(c.stress) for c in curves])[:-1])
    lost = [c.label for c, part in zip(curves, parts, strict=True) if not np.all(part)]
    if lost:
        told.append(
            f"the law loses strong ellipticity within the range of {', '.join(lost)}: do not simulate such "
            "deformations with these parameters"
        )
    return told


def _run_away(candidate: Candidate, values: np.ndarray, errors: np.ndarray, scale: float) -> dict[str, str]:
    """Return the parameters that the data do not determine and that ended far from their typical size. The value of
    each is its limit, 0 or infinity. `errors` (p,): standard errors of the p parameters, computed as if no parameter
    were at its limit. The typical size is a median over the starting points.
    """
    starts = jnp.asarray(candidate.random(np.random.default_rng(0), STARTS))
    typical = np.median(np.abs(jax.vmap(lambda u: candidate.values(u, scale))(starts)), axis=0)
    ends = {}
    free = ~(errors < np.minimum(FREE * np.abs(values), LOST))
    for name, ratio, lost in zip(candidate.names, np.abs(values) / typical, free, strict=True):
        if lost and not 1 / RUNAWAY < ratio < RUNAWAY:
            ends[name] = "0" if ratio < 1 else "infinity"
    return ends


#: A direction is a combination of the parameters that are at their limits. The data determine a direction if the
#: derivative of the misfit along it exceeds this fraction of the largest derivative of all parameters.
_DETERMINED = 1e-3


def _with_products_of_limits(J: np.ndarray, slope: np.ndarray, known: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the derivatives (n, k + q) of the misfit with respect to the unknowns of the k known parameters and to q
    directions (`_DETERMINED`). Also return the derivatives (k, k + q) of the known parameters.

    For example, one parameter goes to infinity and another to 0, and the data determine only their product, a modulus.
    This product is then one of the q directions. Without it, the errors of the other parameters would be valid only for
    a known modulus.

    Args:
        J: derivatives (n, p) of the misfit with respect to the p unknowns.
        slope: derivatives (p, p) of the parameters with respect to the unknowns.
        known: (p,) False for parameters at their limits.
    """
    own, own_slope = J[:, known], slope[np.ix_(known, known)]
    if np.count_nonzero(~known) < 2 or not np.all(np.isfinite(J)):
        return own, own_slope
    U, s, _ = np.linalg.svd(J[:, ~known], full_matrices=False)
    shown = np.flatnonzero(s[:-1] > _DETERMINED * np.linalg.norm(J, axis=0).max())
    return np.column_stack([own, (U * s)[:, shown]]), np.pad(own_slope, ((0, 0), (0, len(shown))))


#: The program warns if the stress of the undeformed sample, divided by the root mean square of the curve's stress,
#: exceeds this value.
_PRELOAD = 0.05
#: The sample counts as undeformed if no in-plane component of F - I exceeds this fraction of the range of the driven
#: component.
_UNDEFORMED = 0.02


def loaded_at_rest(curves: list[Curve]) -> list[str]:
    """Return a warning for each curve whose stress is not 0 when the sample is not deformed. A curve without a row near
    the undeformed sample, such as the shear of a stretched sample, gets no warning."""
    told = []
    for curve in curves:
        driven = curve.driven - (0.0 if np.ptp(curve.F[:, 0, 1]) > 0 else 1.0)
        near = np.argsort(np.abs(driven), kind="stable")[:3]
        strain = np.abs(curve.F[near[0], :2, :2] - np.eye(2)).max()
        far = strain > _UNDEFORMED * np.ptp(driven) or np.abs(driven[near]).max() > 0.2 * np.ptp(driven)
        if curve.test == "general" or far:
            continue
        # The stress at rest is computed from a straight line through the three points nearest to rest.
        offset = np.polyfit(driven[near], curve.stress[near], 1)[1] if np.ptp(driven[near]) > 0 else 0.0
        if abs(offset) > _PRELOAD * curve.scale:
            told.append(
                f"{curve.label}: the stress is {offset:.3g} Pa where the sample is not deformed. Every law has a "
                "stress of 0 there; subtract the preload, or compute the stretch with the unloaded length"
            )
    return told
