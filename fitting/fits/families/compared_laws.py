"""Warnings from the comparison of several laws that were fitted to the same curves or the same sweep."""

from collections.abc import Sequence

import jax.numpy as jnp
import numpy as np

from fitting.fits.stress_stretch import LawFit
from fitting.methods.generalised_maxwell import HOPELESS
from fitting.readers.curves import Curve
from liverjax import laws
from liverjax.laws import homogeneous


def unfollowed(curves: list[Curve], fits: list[LawFit]) -> list[str]:
    """Return a warning for each curve that no law fits."""
    told = []
    for curve in curves:
        best = min(fits, key=lambda f: f.curve_errors[curve.label])
        error, factor = best.curve_errors[curve.label], _only_a_factor(best.law, curve, curves)
        if not error < HOPELESS and factor is not None:
            told.append(
                f"{curve.label}: the stress is {factor:.2g} times that of {best.label}, with the same course. "
                "If this is not another sample, check the unit and the size of the sample"
            )
        elif not error < HOPELESS:
            told.append(
                f"{curve.label}: no law fits this curve. The nearest law ({best.label}) misses the curve by "
                f"{100 * error:.0f} % of the stress; check unit, signs and axes, or fit this curve alone"
            )
    return told


#: A curve and a law have the same course if their stresses differ only by a constant factor. The relative misfit that
#: remains with this factor must be below this value.
_SAME_COURSE = 0.1


def _only_a_factor(law: laws.Law, curve: Curve, curves: list[Curve]) -> float | None:
    """Return the factor between the measured stress of a curve and the stress of a law. Return None if the curve and
    the law do not have the same course (`_SAME_COURSE`), or if no other curve in `curves` belongs to the same test."""
    if sum((c.test, c.component) == (curve.test, curve.component) for c in curves) == 1:
        return None
    model = np.asarray(homogeneous.nominal_stress(law, jnp.asarray(curve.F), constant=True))[:, *curve.component]
    factor = float(model @ curve.stress) / max(float(model @ model), 1e-300)
    off = float(np.sqrt(np.mean((curve.stress - factor * model) ** 2)))
    return factor if factor > 0 and off < _SAME_COURSE * curve.scale else None


#: Two laws describe the data equally well if their AICc differs by less than this value.
TIE = 4.0


def tied_laws(fits: Sequence[LawFit], data: str) -> list[str]:
    """Return a warning if other laws fit the `data` ("sweep", "curves") as well as the best law. The best law comes
    first in `fits`."""
    best = fits[0]
    others = [f for f in fits[1:] if f.aicc - best.aicc < TIE]
    if not others:
        return []
    which = ", ".join(f.label for f in others[:4]) + (f" and {len(others) - 4} more" if len(others) > 4 else "")
    moduli = [f.shear_modulus for f in (best, *others)]
    return [
        f"{which} {'fit' if len(others) > 1 else 'fits'} the {data} as well as {best.label} does (AICc within "
        f"{TIE:g}), with G0 from {min(moduli):.4g} "
        f"to {max(moduli):.4g} Pa. The {data} cannot decide between these laws, which differ beyond the measured "
        "strains"
    ]


def too_few_points(fits: Sequence[LawFit], points: int) -> list[str]:
    """Return a warning if laws with more parameters may describe the curves better than the best law, but the curves
    have too few points to compute the criterion (AICc) of these laws. The best law comes first in `fits`. Laws with as
    many parameters as points do not count, because they follow any data."""
    best = fits[0]
    closer = [f for f in fits if not np.isfinite(f.aicc) and f.bic < best.bic and len(f.values) < points]
    if not closer:
        return []
    nearest = min(closer, key=lambda f: f.bic)
    return [
        f"{points} points are too few to compare laws with {min(len(f.values) for f in closer)} or more parameters by "
        f"AICc, so {best.label} comes first with an error of {100 * best.mean_relative_error:.2g} %, although "
        f"{nearest.label} has {100 * nearest.mean_relative_error:.2g} %: give more points"
    ]
