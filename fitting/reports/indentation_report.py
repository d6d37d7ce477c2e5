"""Write the results of a fit to an indentation curve: fit.json and fit.png, and a table on the terminal."""

import json
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from fitting.methods.contact_point import BEFORE, ContactFit, fit_with_offset
from fitting.methods.kramers_kronig import runs_probability
from fitting.readers.indentation_curves import IndentationCurve
from fitting.readers.noise_of_series import noise_of_series, rounding_of_series
from fitting.reports.sweep_report import numbers
from fitting.rigs.thin_layer import Indenter, half_space
from liverjax.core.files import write_whole
from liverjax.core.plotting import BLUE, GREY, pyplot, save
from liverjax.core.struct import Content
from liverjax.core.versions import versions

if TYPE_CHECKING:
    from matplotlib.figure import Figure


#: The strains may not be small if the contact radius exceeds _WIDE times the radius of the sphere, or if the depth
#: exceeds _DEEP times the thickness.
_WIDE, _DEEP = 0.4, 0.2


def write(
    out: Path, curve: IndentationCurve, rig: Indenter, fit: ContactFit, level: ContactFit | None = None
) -> Content:
    """Write fit.json and fit.png into the folder `out`. Return the content of fit.json.

    `level`: a second fit with a sloping base line (force before contact), which removes a drift of the sensor. It is
    None if the data show no drift.
    """
    out.mkdir(parents=True, exist_ok=True)
    G, errors = fit.modulus / (2 * (1 + rig.poisson)), fit.standard_errors
    alone = fit_with_offset(curve.depth, curve.force, partial(half_space, rig))
    content = numbers(
        {
            "method": "indentation",
            "shape": rig.shape,
            "young_modulus": fit.modulus,
            "shear_modulus": G,
            "contact_point": fit.contact_point,
            "standard_errors": {
                "young_modulus": errors[0],
                "shear_modulus": errors[0] * G / fit.modulus if fit.modulus else None,
                "contact_point": errors[1],
            },
            "interval_quantile_95": fit.quantile,
            "correlation": fit.correlation,
            "noise_N": fit.noise,
            "independent_points": fit.independent,
            "mean_relative_error": float(np.mean(np.abs(fit.residuals)) / np.max(np.abs(curve.force))),
            "max_relative_error": float(np.max(np.abs(fit.residuals)) / np.max(np.abs(curve.force))),
            "half_space_young_modulus": alone.modulus,
            "poisson": rig.poisson,
            "thickness": rig.thickness,
            "points_before_contact": fit.before,
            "force_offset_N": fit.offset if fit.offset_error else None,
            "force_offset_standard_error_N": fit.offset_error if fit.offset_error else None,
            "without_tilt": None if level is None else _of_level(level),
            "warnings": indentation_warnings(curve, rig, fit, level),
            "data": curve.source,
            "notes": list(curve.notes),
            "versions": versions(),
        }
    )
    write_whole(out / "fit.json", json.dumps(content, indent=2, allow_nan=False) + "\n")
    save(figure(curve, rig, fit), out / "fit.png")
    return content


def _of_level(level: ContactFit) -> Content:
    E, d0 = level.standard_errors
    errors = {"young_modulus": E, "contact_point": d0}
    return {"young_modulus": level.modulus, "contact_point": level.contact_point, "standard_errors": errors}


def indentation_warnings(
    curve: IndentationCurve, rig: Indenter, fit: ContactFit, level: ContactFit | None = None
) -> list[str]:
    """Return warnings for the user about the fitted modulus and contact point."""
    told, deepest = [], float(curve.depth.max() - fit.contact_point)
    if fit.before < 3:
        told.append(f"{fit.before} points are before contact: measure the approach too, to find the contact point")
    ahead = float(curve.depth.min() - fit.contact_point)
    if ahead > BEFORE * np.ptp(curve.depth):
        told.append(
            f"the fitted contact point lies {ahead:.3g} m before the first depth, outside the measured curve. A "
            "force that is not 0 without contact has the same effect: begin the curve before contact, or subtract this "
            "force"
        )
    if level is not None:
        told.append(
            "the force rises or falls steadily before contact. The sensor drifts, and this drift changes modulus and "
            f"contact point. If a straight line through these points is subtracted, E = {level.modulus:.5g} ± "
            f"{level.standard_errors[0]:.2g} Pa and d0 = {level.contact_point:.5g} ± {level.standard_errors[1]:.2g} m"
        )
    width = np.sqrt(deepest / rig.radius) if rig.shape == "sphere" else 0.0
    if width > _WIDE or deepest > _DEEP * rig.thickness:
        far = (
            f"the radius of the contact is {width:.0%} of the radius of the sphere"
            if width > _WIDE
            else f"the indentation depth is {deepest:.3g} m, which is {deepest / rig.thickness:.0%} of the thickness"
        )
        told.append(
            f"{far}, but the theory is for small strains: also fit only the less deep part of the curve, and compare"
        )
    if fit.modulus <= 0:
        told.append("the modulus is not positive, because the force does not rise with the depth: check their signs")
    # The points before contact contain only noise. If they were included, a misfit in contact would look like noise.
    touching = fit.residuals[curve.depth > fit.contact_point]
    runs, chance = runs_probability(touching)
    if chance < 1e-3:
        told.append(
            f"structured misfit: residuals in contact change sign only {runs - 1} times in {len(touching)} points "
            f"(probability by chance {chance:.1g}). Possible causes: another indenter shape, a layer, another material "
            "law, relaxation during the test, or correlated noise"
        )
    if fit.independent is not None:
        told.append(
            "neighbouring residuals are correlated, because the noise is correlated, or because the model is "
            f"incomplete. The {len(fit.residuals)} points carry the information of {fit.independent:.0f} independent "
            "points; the standard errors include this effect"
        )
    # The noise is estimated from neighbouring points, because the residuals contain the adhesion.
    noise = max(noise_of_series(curve.force), rounding_of_series(curve.force))
    if curve.force.min() - min(fit.offset, 0.0) < -5 * noise:
        told.append(
            "some forces are clearly negative: this is probably adhesion, which the model does not contain, or an "
            "error of the zero of the force"
        )
    return told


def table(rig: Indenter, fit: ContactFit, content: Content) -> str:
    """Return a table with modulus and contact point ± standard error."""
    e, offset = content["standard_errors"], []
    if fit.offset_error:
        offset = [f"F0  {fit.offset:11.5g} ± {fit.offset_error:<9.2g} N, remaining force before contact"]
    return "\n".join(
        [
            f"{rig.shape} on a bonded layer of {1e3 * rig.thickness:g} mm, Poisson's ratio {rig.poisson:g}",
            f"E   {fit.modulus:11.5g} ± {e['young_modulus']:<9.2g} Pa",
            f"G   {content['shear_modulus']:11.5g} ± {e['shear_modulus']:<9.2g} Pa",
            f"d0  {fit.contact_point:11.5g} ± {e['contact_point']:<9.2g} m",
            *offset,
            f"if the layer is treated as a half-space, the fit gives E = {content['half_space_young_modulus']:.5g} Pa. "
            "Both models contain no friction and no adhesion",
        ]
    )


def figure(curve: IndentationCurve, rig: Indenter, fit: ContactFit) -> "Figure":
    """Plot the curve and its residuals."""
    fig, (above, below) = pyplot().subplots(
        2, 1, figsize=(6, 5), sharex=True, height_ratios=(3, 1), layout="constrained"
    )
    depth = 1e3 * (curve.depth - fit.contact_point)
    above.plot(depth, 1e3 * curve.force, ".", color=GREY, label="measured")
    above.plot(depth, 1e3 * (curve.force - fit.residuals), "-", color=BLUE, label=f"E = {fit.modulus:.3g} Pa")
    above.set(ylabel="force [mN]", title=f"{rig.shape} on a layer")
    above.legend()
    below.plot(depth, 1e3 * fit.residuals, ".", color=GREY)
    below.axhline(0.0, color=BLUE, lw=1)
    below.set(xlabel="depth after contact [mm]", ylabel="residual [mN]")
    return fig
