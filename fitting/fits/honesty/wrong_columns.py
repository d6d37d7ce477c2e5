"""Errors in the columns of a stress-stretch curve. If the residuals keep their sign over many points, this module tests
whether the columns contain quantities other than stretch and nominal stress."""

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import scipy.optimize

from fitting.fits.stress_stretch import OWN_FACTORS, LawFit
from fitting.methods.kramers_kronig import CHANCE, runs_probability
from fitting.readers.curves import Curve
from liverjax.laws import Law, homogeneous

#: _FEWEST: minimum number of points of a curve whose residuals are tested. _EXACT: residuals below this value are
#: roundoff.
_FEWEST, _EXACT = 8, 1e-6
#: A cause is reported if it lowers Akaike's criterion by more than _BETTER and if the remaining residuals look random
#: (p-value of the runs test above _RANDOM).
_BETTER, _RANDOM = 10.0, 0.05
#: The best cause is named, and each cause whose value of Akaike's criterion is higher by less than this value (Burnham,
#: Anderson 2002).
_AS_GOOD = 6.0
_stress = jax.jit(homogeneous.nominal_stress)


class _Cause(NamedTuple):
    """A possible error in the columns of a curve: the columns contain quantities other than their names say. The driven
    quantity is the quantity that the test imposes, for example the stretch. The function `driven` computes the true
    driven quantity from (driven column, number). The function `column` computes the values in the stress column from
    (nominal stress, true driven quantity, number).

    `number` is the fitted offset, the same for all curves. The optimiser uses a dimensionless offset, in a unit from
    the first curve with a structured misfit. The unit is the stress scale of this curve if the offset is a stress,
    otherwise the range of the driven column.
    """

    words: str
    driven: Callable[[np.ndarray, float], np.ndarray]
    column: Callable[[np.ndarray, np.ndarray, float], np.ndarray]
    free: bool = False  # whether an offset is fitted
    of_stress: bool = False  # whether this offset is a stress


_CAUSES = (
    _Cause("if the zero of the {driven} were off by {number:.2g}", lambda d, q: d - q, lambda P, d, q: P, free=True),
    _Cause("if an offset of {number:.3g} Pa were in the stress", lambda d, q: d, lambda P, d, q: P + q, True, True),
    _Cause("if the stress were true stress (force over present area)", lambda d, q: d, lambda P, d, q: P * d),
    _Cause("if the stretch were 1 + logarithmic strain", lambda d, q: np.exp(d - 1), lambda P, d, q: P),
)


def structured_curves(curves: list[Curve], fit: LawFit, every: bool = False) -> list[str]:
    """Return a warning about the curves whose residuals keep their sign over many points. If an error in the columns
    explains these residuals, the warning states this cause.

    Args:
        curves: the curves.
        fit: the best fit of the curves.
        every: whether all laws were tried. If True, the warning does not advise to try other laws.
    """
    # If a warning of the fit already reports factors between the law and the curves, the stress of the law is
    # multiplied by its factor for each curve.
    named = any(sentence.startswith(OWN_FACTORS) for sentence in fit.warnings)
    misfit = [(c, (_model(fit.law, c) * _nearest_factor(fit.law, c, named) - c.stress) / c.scale) for c in curves]
    runs = {c.label: runs_probability(r) for c, r in misfit}
    odd = [c for c, r in misfit if len(r) >= _FEWEST and np.abs(r).max() > _EXACT and runs[c.label][1] < CHANCE]
    if not odd:
        return []
    curve = min(odd, key=lambda c: runs[c.label][1])
    (count, chance), names = runs[curve.label], ", ".join(c.label for c in odd)
    said = (
        f"{names}: structured misfit of {fit.label}. In the curve {curve.label}, the residuals change sign only "
        f"{count - 1} times in {len(curve.stress)} points (by chance, the probability of this is {chance:.1g})"
    )
    cause = _named_cause(curves, odd, fit)
    if cause:
        return [f"{said}; {cause}"]
    return [f"{said}; the law is inadequate" + ("" if every else ": try other laws (LAW = all)")]


def _model(law: Law, curve: Curve, F: np.ndarray | None = None) -> np.ndarray:
    P = np.asarray(_stress(law, jnp.asarray(curve.F if F is None else F)))
    return P[:, curve.component[0], curve.component[1]]


def _nearest_factor(law: Law, curve: Curve, named: bool) -> float:
    """Return the factor that brings the stress of the law nearest to the curve, or 1 if `named` is false (the fit
    reported no factors)."""
    P = _model(law, curve) / curve.scale
    return float(P @ (curve.stress / curve.scale) / (P @ P)) if named and P @ P > 0 else 1.0


def _named_cause(curves: list[Curve], odd: list[Curve], fit: LawFit) -> str:
    """Return a text with the causes that lower Akaike's criterion most, and whose remaining residuals are random. The
    text is empty if there is no such cause."""
    found: list[tuple[_Refit, str]] = []
    limit = _criterion(fit.law, curves, odd, None).value - _BETTER
    for cause in _CAUSES:
        sheared = any(c.test not in ("uniaxial", "equibiaxial", "pure_shear") for c in odd)
        if sheared and not cause.of_stress:
            continue
        refit = _criterion(fit.law, curves, odd, cause)
        if refit.value < limit and refit.chance > _RANDOM:
            words = cause.words.format(driven="stretch", number=refit.number)
            found.append((refit, f"{words} (G0 {_slope_at_rest(refit.law):.4g} Pa)"))
    if not found:
        return ""
    found.sort(key=lambda each: each[0].value)
    as_good = [words for refit, words in found if refit.value < found[0][0].value + _AS_GOOD]
    return f"the same law would fit the curve {', or '.join(as_good)}: check the columns"


class _Refit(NamedTuple):
    value: float  # Akaike's criterion, corrected for few points
    chance: float  # smallest p-value of the runs test of residuals, for all curves with a structured misfit
    number: float  # fitted offset of the cause, in the unit of its column; 0 if no offset is fitted
    law: Law


def _criterion(law: Law, curves: list[Curve], odd: list[Curve], cause: _Cause | None) -> _Refit:
    """Fit the law again, starting from its fitted parameters, and return Akaike's criterion and other results. `cause`
    is an error in the columns of the curves `odd`. If `cause` is None, the columns contain what their names say."""
    leaves, tree = jax.tree.flatten(law)
    every = np.array([float(leaf) for leaf in leaves])
    start = every[every != 0]
    free = cause is not None and cause.free
    labels = {c.label for c in odd}
    unit = odd[0].scale if cause is not None and cause.of_stress else np.ptp(odd[0].driven)

    def law_of(x: np.ndarray) -> Law:
        values = every.copy()
        values[every != 0] = x[: len(start)] * start
        return jax.tree.unflatten(tree, list(values))

    def parts(x: np.ndarray) -> list[np.ndarray]:
        own, out = law_of(x), []
        for c in curves:
            if cause is None or c.label not in labels:
                out.append((_model(own, c) - c.stress) / c.scale)
                continue
            q = float(x[-1]) * unit if free else 0.0
            driven = cause.driven(c.driven, q)
            F = c.F if cause.of_stress else np.asarray(homogeneous.deformation_gradient(c.test, driven))
            out.append((cause.column(_model(own, c, F), driven, q) - c.stress) / c.scale)
        return out

    def residuals(x: np.ndarray) -> np.ndarray:
        return np.nan_to_num(np.concatenate(parts(x)), nan=1e3, posinf=1e3, neginf=-1e3)

    begin = np.append(np.ones(len(start)), np.zeros(int(free)))
    least = np.append(np.full(len(start), 1e-6), np.full(int(free), -np.inf))  # parameters keep their signs
    found = scipy.optimize.least_squares(residuals, begin, bounds=(least, np.inf))
    n, k = len(found.fun), len(begin) + 1
    value = n * np.log(max(2 * found.cost / n, 1e-300)) + 2 * k * n / max(n - k - 1, 1)
    own = [r for c, r in zip(curves, parts(found.x), strict=True) if c.label in labels]
    chance = min(runs_probability(r)[1] for r in own)
    return _Refit(float(value), chance, float(found.x[-1] * unit) if free else 0.0, law_of(found.x))


def _slope_at_rest(law: Law) -> float:
    return float(law.tangent(jnp.eye(3))[0, 1, 0, 1])
