"""Hyperelastic laws from stress-stretch curves: least squares from many starts, kept stable over the fitted range."""

import time
from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import scipy.stats

from fitting.methods.least_squares import Solution, levenberg_marquardt
from fitting.methods.uncertainty import spread
from fitting.readers.curves import Curve
from liverjax import laws
from liverjax.core.errors import InputError
from liverjax.laws import Law, gradient_check, homogeneous
from liverjax.laws.gradient_check import ellipticity

STARTS = 128
#: Weight of a falling stress in the residuals: 1 % of a curve's stress weighs as much as all of its misfit.
STIFFNESS = 100.0


class Candidate(NamedTuple):
    """A law to be fitted: unconstrained numbers u to its parameters."""

    label: str
    names: tuple[str, ...]
    units: tuple[str, ...]
    values: Callable[[jax.Array, Any], jax.Array]  # (u, modulus scale [Pa]) -> parameters in the order of `names`
    law: Callable[[jax.Array], Law]  # of these values, without volumetric energy
    random: Callable[[np.random.Generator, int], np.ndarray]  # starts (n, len(u))


class LawFit(NamedTuple):
    """What was found for one law."""

    label: str
    names: tuple[str, ...]
    units: tuple[str, ...]
    values: np.ndarray
    standard_errors: np.ndarray
    correlation: np.ndarray
    law: Law
    shear_modulus: float
    cost: float  # half the sum of squared relative residuals
    curve_errors: dict[str, float]  # root mean square, relative to the curve's
    mean_relative_error: float  # root mean square over all points
    aicc: float
    bic: float
    converged: bool
    iterations: int
    starts_at_minimum: int
    warnings: list[str]
    run_time: float
    compile_time: float


def candidates(name: str, terms: int | None = None) -> list[Candidate]:
    """The law of that name, or of FILE.py:LAW; Ogden's with 1, 2 and 3 terms unless `terms` says; `all` shipped ones.

    Raises:
        InputError: unknown law, or one whose energy is no isochoric one plus U(J).
    """
    if terms is not None and name not in ("ogden", "all"):
        raise InputError(f"--terms {terms} is of ogden only, not of {name}: leave it out")
    if name == "all":
        singles = [c for n in laws.LAWS if n != "ogden" and incompressible_form(n) for c in candidates(n)]
        return singles + [_ogden(k) for k in ((2, 3) if terms is None else (terms,))]  # one term is bogen
    typical = gradient_check.load(name)
    if laws.isochoric_part(typical) is None:
        usable = ", ".join(n for n in laws.LAWS if incompressible_form(n))
        raise InputError(f"law {name} is not an isochoric energy plus U(J), so its curves need more: use {usable}")
    if isinstance(typical, laws.Ogden):
        return [_ogden(k) for k in ((1, 2, 3) if terms is None else (terms,))]
    return [_bogen() if isinstance(typical, laws.Bogen) else _single(name.rpartition(":")[2], typical)]


def incompressible_form(name: str) -> bool:
    """Whether a law is an isochoric energy plus U(J)."""
    return laws.isochoric_part(laws.typical(name)) is not None


def _single(label: str, typical: Law) -> Candidate:
    fields = [f for f in laws.parameters(type(typical)) if f.name != "bulk" and f.default is not None]
    names = tuple(f.name for f in fields)
    middle = np.array([float(getattr(typical, n)) for n in names])
    positive = np.array([f.metadata["above"] == 0 for f in fields])
    modulus = np.array([f.metadata["unit"] == "Pa" for f in fields])
    middle = middle / np.where(modulus, _shear_modulus(typical), 1.0)

    def values(u, scale):
        unit = jnp.where(modulus, scale, 1.0)
        return unit * jnp.where(positive, jnp.exp(jnp.where(positive, u, 0.0)), u)

    def random(rng, n):
        near = np.log(np.abs(middle)) + 1.5 * rng.standard_normal((n, len(names)))
        u = np.where(positive, near, middle * np.exp(rng.standard_normal((n, len(names)))))
        # An exponent alpha may have either sign; other free numbers are coefficients.
        alpha = np.array([m == "alpha" for m in names])
        return np.where(alpha, _exponents(rng, (n, len(names))), u)

    def law(p):
        return laws.replace(typical, **dict(zip(names, p, strict=True)), bulk=None)

    return Candidate(label, names, tuple("Pa" if m else "1" for m in modulus), values, law, random)


def _shear_modulus(law: Law) -> float:
    """Of the ground state [Pa]; where a law does not state it, dP12/dF12 there."""
    try:
        return float(law.shear_modulus())
    except InputError:
        return float(law.tangent(jnp.eye(3))[0, 1, 0, 1])


def _exponents(rng: np.random.Generator, shape: tuple) -> np.ndarray:
    return rng.choice([-1.0, 1.0], shape) * np.exp(rng.uniform(np.log(0.5), np.log(30.0), shape))


def _ogden_starts(rng: np.random.Generator, n: int, terms: int) -> np.ndarray:
    share = rng.dirichlet(np.ones(terms), n)
    return np.concatenate(
        [np.log(share + 1e-3) + 0.5 * rng.standard_normal((n, terms)), _exponents(rng, (n, terms))], 1
    )


def _ogden(terms: int) -> Candidate:
    """G_k = mu_k alpha_k / 2 > 0 in every term: stable for every stretch."""
    names = tuple(f"{n}[{k}]" for n in ("mu", "alpha") for k in range(terms))

    def values(u, scale):
        alpha = u[terms:]
        return jnp.concatenate([2 * scale * jnp.exp(u[:terms]) / alpha, alpha])

    def law(p):
        return laws.Ogden(mu=tuple(p[:terms]), alpha=tuple(p[terms:]), bulk=None)

    label = f"ogden, {terms} term{'s' if terms > 1 else ''}"
    return Candidate(label, names, ("Pa",) * terms + ("1",) * terms, values, law, partial(_ogden_starts, terms=terms))


def _bogen() -> Candidate:
    """One term of Ogden's law."""

    def law(p):
        return laws.Bogen(mu=p[0], alpha=p[1], bulk=None)

    return _ogden(1)._replace(label="bogen", names=("mu", "alpha"), law=law)


def initial_modulus(curves: list[Curve]) -> float:
    """Scale of the shear modulus [Pa] for starts: median of the stress over that of a unit neo-Hookean law."""
    unit = laws.NeoHookean(mu=1.0, bulk=None)
    ratios = []
    for c in curves:
        model = np.asarray(homogeneous.nominal_stress(unit, jnp.asarray(c.F)))[:, c.component[0], c.component[1]]
        keep = np.abs(model) > 0.02 * np.abs(model).max()
        if keep.any():
            ratios.append(np.median(c.stress[keep] / model[keep]))
    positive = [r for r in ratios if r > 0]
    if not positive:
        raise InputError("the stresses point against the stretches in every curve: check signs and axes")
    return float(np.median(positive))


def fit(candidate: Candidate, curves: list[Curve], starts: int = STARTS) -> LawFit:
    """Least squares of the relative misfit (P - P_measured) / rms of the curve, the best of many starts."""
    scale = initial_modulus(curves)
    F, at = jnp.asarray(np.concatenate([c.F for c in curves])), np.cumsum([0] + [len(c.stress) for c in curves])
    i, j = (jnp.asarray(np.repeat([c.component[k] for c in curves], np.diff(at))) for k in (0, 1))
    sizes = np.repeat([c.scale for c in curves], np.diff(at))
    measured = jnp.asarray(np.concatenate([c.stress for c in curves]) / sizes)
    rows = jnp.arange(F.shape[0])
    inside = np.setdiff1d(np.arange(1, F.shape[0]), at)  # neighbours within a curve
    driven = np.concatenate([c.driven for c in curves])
    works = np.repeat([c.rises for c in curves], np.diff(at))[inside]
    rising = jnp.asarray(np.where(works, np.sign(driven[inside] - driven[inside - 1]), 0.0))

    def relative_stress(u):
        P = homogeneous.nominal_stress(candidate.law(candidate.values(u, scale)), F, constant=True)
        return P[rows, i, j] / jnp.asarray(sizes)

    def residuals(u):
        model = relative_stress(u)
        falling = jnp.minimum(rising * (model[inside] - model[inside - 1]), 0.0)
        return jnp.concatenate([model - measured, STIFFNESS * falling])

    begin = time.perf_counter()
    points = jnp.asarray(candidate.random(np.random.default_rng(0), starts))
    program = jax.jit(jax.vmap(lambda u: levenberg_marquardt(residuals, u))).lower(points).compile()
    compiled = time.perf_counter()
    found = jax.block_until_ready(program(points))
    return _assessed(candidate, curves, found, scale, (time.perf_counter() - compiled, compiled - begin))


def _assessed(candidate: Candidate, curves: list[Curve], found: Solution, scale: float, times: tuple) -> LawFit:
    """The best start, what it is worth, and what the user should know."""
    costs = np.where(np.isfinite(found.cost), np.asarray(found.cost), np.inf)
    best = int(np.argmin(costs))
    u, J, r = (np.asarray(v[best]) for v in (found.u, found.jacobian, found.residuals))
    n, p = sum(len(c.stress) for c in curves), len(u)
    misfit = r[:n]
    values = np.asarray(candidate.values(jnp.asarray(u), scale))
    noise = float(np.sqrt(np.sum(misfit**2) / max(1, n - p)))
    slope = np.asarray(jax.jacfwd(candidate.values)(jnp.asarray(u), scale))
    half, s = spread(J[:n], noise, slope)
    errors = np.linalg.norm(half, axis=1) if n > p else np.full(p, np.nan)
    law = candidate.law(jnp.asarray(values))
    split = np.split(misfit, np.cumsum([len(c.stress) for c in curves])[:-1])
    criterion = n * np.log(np.sum(misfit**2) / n)
    k = p + 1
    result = LawFit(
        label=candidate.label,
        names=candidate.names,
        units=candidate.units,
        values=values,
        standard_errors=errors,
        correlation=(half @ half.T) / np.maximum(np.outer(errors, errors), 1e-300),
        law=law,
        shear_modulus=_shear_modulus(law),
        cost=float(costs[best]),
        curve_errors={c.label: float(np.sqrt(np.mean(v**2))) for c, v in zip(curves, split, strict=True)},
        mean_relative_error=float(np.sqrt(np.mean(misfit**2))),
        aicc=float(criterion + 2 * k + 2 * k * (k + 1) / (n - k - 1)) if n > k + 1 else np.inf,
        bic=float(criterion + k * np.log(n)),
        converged=bool(found.converged[best]),
        iterations=int(found.iterations[best]),
        starts_at_minimum=int(np.sum(costs < costs[best] * (1 + 1e-6) + 1e-20)),
        warnings=[],
        run_time=times[0],
        compile_time=times[1],
    )
    return result._replace(warnings=_warnings(result, curves, s, bool(np.any(r[n:] < 0))))


def _warnings(fit: LawFit, curves: list[Curve], singular: np.ndarray, held: bool) -> list[str]:
    told = []
    if sum(len(c.stress) for c in curves) <= len(fit.values):
        told.append(f"as many parameters as points ({len(fit.values)}): nothing can be said of their errors")
    if not fit.converged:
        told.append("the fit did not converge from its best start")
    quantile = scipy.stats.t.ppf(0.975, max(1, sum(len(c.stress) for c in curves) - len(fit.values)))
    for name, value, error in zip(fit.names, fit.values, fit.standard_errors, strict=True):
        if not error * quantile < abs(value):
            told.append(f"the data leave {name} free: {value:.3g} with a standard error of {error:.2g}")
    if singular[-1] < 1e-7 * singular[0]:
        told.append("some combination of the parameters is not determined at all")
    if fit.starts_at_minimum == 1:
        told.append("only one start reached the minimum: there may be a better one")
    if held:
        told.append("the stress would fall within the fitted range: held at the edge of stability")
    solid = laws.replace(fit.law, bulk=1e3 * abs(fit.shear_modulus))
    lost = [c.label for c in curves if not np.all(ellipticity(np.asarray(solid.tangent(jnp.asarray(c.F)))) > 0)]
    if lost:
        told.append(f"strong ellipticity is lost within {', '.join(lost)}: do not simulate with these parameters there")
    return told
