"""Warnings about a fit to waves. They are printed, and written as `warnings` into waves.json."""

import itertools

import numpy as np
import scipy.ndimage

from fitting.waves.elastography import Found, Organ
from fitting.waves.files import components
from fitting.waves.regions import Regions
from fitting.waves.shear_waves import velocity_and_attenuation
from fitting.waves.stiffness_map import FAR, WaveMap
from fitting.waves.wave_field import WaveField

#: Below this radius [voxels], the modulus of a region is unreliable. In tests with cylinders of this radius, the errors
#: of the moduli were below 8 %.
LEAST_RADIUS = 2.5
#: Above this chi^2 per equation, the program warns that the model does not explain the data.
TOO_FAR = 1.5
#: Below this chi^2 per equation, the stated noise is too large, if there are FEW equations or more.
TOO_NEAR, FEW = 0.4, 50
#: The chi^2 of a map is reported if it exceeds 1 per equation by more than ROUGH plus BY_CHANCE standard deviations.
#: ROUGH allows for the error of the estimated noise.
BY_CHANCE, ROUGH = 5.0, 0.03
#: Correlated residuals of a map are reported if `noise_factor` exceeds this value times `white_factor`.
CORRELATED = 1.1
#: Above this chi^2 per equation, the moduli may be wrong by more than their errors.
WRONG = 10.0


def cautions_of_elastography(organ: Organ, found: Found, drawn: WaveMap | None) -> list[str]:
    """Return all warnings about a fit to waves. The arguments are the same as for
    `fitting.reports.waves.report.write`."""
    told, each = _sign(organ, found), found.whole if found.parts is None else found.parts
    moves = frequencies_with_motion(organ.field, found)
    told += _of_scales(organ, found, moves)
    any_coarse = False
    order = components.order_sentence(organ.field)
    if order is not None:
        told.insert(0, order)
    for f, hertz in enumerate(organ.field.frequencies):
        if not np.isfinite(organ.field.noise[f]):
            continue
        still = _of_no_motion(organ.field, f, found)
        if still:
            told += still
            continue
        coarse = _of_voxel_size(hertz, found, f)
        told += coarse + _of_residuals(hertz, each, f, "regions" if found.parts else "moduli", bool(coarse))
        any_coarse |= bool(coarse)
        told += _of_stopped_search(hertz, found, f) + (_of_long_waves(hertz, found, f) if each.converged[f] else [])
    told += _of_lost_labels(organ.field, found) + _of_sizes_and_edges(organ.field, found, moves)
    if drawn is not None and not drawn.distance <= FAR:
        told.append(
            f"the search for the map stopped {drawn.distance:.2g} standard deviations from the minimum: compare the "
            "map with regions"
        )
    if drawn is not None and np.any(alike := drawn.noise_factor > CORRELATED * drawn.white_factor):
        told.append(
            "map: the residuals at neighbouring voxels are correlated, so the standard deviations of the map are "
            f"enlarged {drawn.noise_factor[alike].max():.3g} times"
        )
    told += [] if drawn is None else _of_edges_in_map(drawn)
    # The mean of n squares has the standard deviation sqrt(2/n). ROUGH is added because the noise that divides the
    # residuals is only an estimate.
    if drawn is not None and drawn.chi2 / drawn.components > 1 + ROUGH + BY_CHANCE * np.sqrt(2 / drawn.components):
        told.append(
            f"chi2 of the map is {drawn.chi2 / drawn.components:.3g} per equation, so the standard deviations of "
            f"the map are too small. Possible causes: {'coarse voxels (mesh_bias), ' if any_coarse else ''}edges that "
            "are sharper than in the map, noise that is larger at a frequency or in a part of the organ, a ratio of "
            "the moduli at several frequencies that is not the same everywhere, or a body that does not move like a "
            "viscous solid. Compare the map with the moduli of regions, and with the map from one frequency alone"
        )
    return told


def _of_lost_labels(field: WaveField, found: Found) -> list[str]:
    """Return a warning about labels that no voxel of the elements has."""
    if field.labels is None or found.labels is None:
        return []
    lost = np.setdiff1d(field.labels[field.mask], found.labels)
    if not lost.size:
        return []
    return [
        f"regions {', '.join(map(str, lost))}: no voxel of these regions is in an element, so they have no modulus. An "
        "element needs 3 voxels along each axis: measure more voxels around these regions"
    ]


def _of_sizes_and_edges(field: WaveField, found: Found, moves: list[int]) -> list[str]:
    """Return warnings about regions that are too small, and about regions whose edges are not where the labels place
    them.

    `moves`: indices of the frequencies with motion. At the other frequencies, the data contain only noise and say
    nothing about a region.
    """
    if found.parts is None or found.labels is None:
        return []
    few = ~(found.parts.standard_errors.real < np.abs(found.parts.modulus))[moves].all(axis=0)
    told = [
        f"region {label}: the standard error of its modulus exceeds this modulus, because the region has too few voxels"
        for label in found.labels[few]
    ]
    told += _of_small_regions(field, found.labels[~few])
    far = np.abs(found.parts.farther[moves]).max(axis=0, initial=0.0) > 1
    if far.any():
        names = ", ".join(str(label) for label, beyond in zip(found.labels, far, strict=True) if beyond)
        told.append(
            f"regions {names}: from the waves, the edges of these regions are more than a voxel away from the edges of "
            "the labels (edges_farther_out_voxels): check the labels"
        )
    return told


#: The map shows an edge if ln |G| changes over the correlation length by more than this number of standard deviations.
STEEP = 5.0


def _of_edges_in_map(drawn: WaveMap) -> list[str]:
    """Return a warning if the map shows an edge between two materials.

    The map smooths the edge. The error due to this smoothing also changes the map at some distance from the edge, but
    `WaveMap.sd` contains only the error near the edge.
    """
    if not np.any(drawn.change > STEEP * drawn.posterior_sd.min(axis=0)):
        return []
    return [
        f"the modulus in the map changes by a factor of {np.exp(drawn.change.max()):.2g} within "
        f"{1e3 * drawn.length:.3g} mm (or within an element, if the elements are longer). Near such an edge, the "
        "standard deviations of the map may be too small, also several voxels away from the edge. Compare the map with "
        "the moduli of regions"
    ]


def _of_small_regions(field: WaveField, labels: np.ndarray) -> list[str]:
    """Return a warning about regions in which every voxel is less than `LEAST_RADIUS` voxels away from another region.
    The surface of the organ does not count as another region."""
    assert field.labels is not None
    small = []
    for label in labels:
        own, others = field.mask & (field.labels == label), field.mask & (field.labels != label)
        away = scipy.ndimage.distance_transform_edt(~others)[own].max(initial=0.0)
        if others.any() and away < LEAST_RADIUS:
            small.append(f"{label} ({int(own.sum())} voxels)")
    if not small:
        return []
    return [
        f"regions {', '.join(small)}: below a radius of {LEAST_RADIUS:g} voxels, a modulus is not reliable, although "
        "its standard error may be small. Measure with smaller voxels, or give the region the label of its surroundings"
    ]


#: Below this ratio of the measured motion (root mean square) to the noise, the data contain hardly more than noise. The
#: squares of motion and noise add up, so the true motion is then below two thirds of the noise.
NO_MOTION = 1.2
#: The same limit for noise that is estimated from correlated residuals. The fit follows a part of such noise, so this
#: estimate is often 20 to 30 % too small for noise alone.
NO_MOTION_IN_RESIDUALS = 1.5
#: The noise that follows from residuals is believed up to this multiple of the estimate from fourth differences: for
#: smoothed noise the ratio is 2.5 to 7. Above it, the residuals show an inadequate model, for example other regions.
SMOOTHED = 8.0


def frequencies_with_motion(field: WaveField, found: Found) -> list[int]:
    """Return the indices of the frequencies whose displacements are larger than their noise."""
    noise = field.noise
    return [f for f in range(len(noise)) if np.isfinite(noise[f]) and not _of_no_motion(field, f, found)]


def _of_no_motion(field: WaveField, f: int, found: Found | None = None) -> list[str]:
    """Return a warning if the displacements at this frequency are hardly larger than their noise.

    The noise of smoothed data is larger than the estimate from fourth differences. So if the residuals of the fits
    `found` are correlated, the displacements are also compared with the noise that follows from these residuals.
    """
    u = field.displacement[f][field.mask]
    size, noise, most = float(np.sqrt(np.nanmean(np.abs(u) ** 2) / 2)), float(field.noise[f]), NO_MOTION
    each = None if found is None else found.whole if found.parts is None else found.parts
    seen = each is not None and f < len(each.correlations) and each.correlations[f].seen
    if each is not None and seen and most * noise <= size < SMOOTHED * noise:
        noise, most = each.correlations[f].level, NO_MOTION_IN_RESIDUALS
    if not size < most * noise:
        return []
    return [
        f"{field.frequencies[f]:g} Hz: the displacements ({size:.2g} m) are hardly larger than their noise "
        f"({noise:.2g} m), so the waves are unknown; remove the data of this frequency"
    ]


def _of_stopped_search(hertz: float, found: Found, f: int) -> list[str]:
    searches = {"the modulus of the whole organ": found.whole, "the moduli of the regions": found.parts}
    return [
        f"{hertz:g} Hz: the search for {what} did not converge, so these values and their errors are not reliable: "
        "remove this frequency, or join small or stiff regions with their surroundings"
        for what, own in searches.items()
        if own is not None and not own.converged[f]
    ]


#: Above this relative standard error, the interval of a modulus is not symmetric.
SKEW = 0.15


def _of_long_waves(hertz: float, found: Found, f: int) -> list[str]:
    """Return a warning with the interval of each modulus whose error is so large that the interval is not symmetric.

    Waves much longer than the organ determine the compliance 1/G, and the error of 1/G is symmetric.
    """
    each, told = found.whole if found.parts is None else found.parts, []
    for r, (G, e) in enumerate(zip(np.abs(each.modulus[f]), each.standard_errors[f].real, strict=True)):
        told_already = found.parts is not None and e >= G  # another warning is given for this region
        if told_already or not (np.isfinite(e) and e > SKEW * G):
            continue
        half = 2 * e / G**2
        top = f"{1 / (1 / G - half):.3g} Pa" if half < 1 / G else "any value above"
        told.append(
            f"{hertz:g} Hz: {_modulus_named(found, r)} has an error of {100 * e / G:.2g} %. Waves much longer than the "
            f"organ determine 1/G rather than G. From the error of 1/G, the size of G is {1 / (1 / G + half):.3g} Pa "
            f"to {top} (95 %); measure at a higher frequency"
        )
    return told


def _of_voxel_size(hertz: float, found: Found, f: int) -> list[str]:
    """Return a warning if the size of the voxels changes a modulus by more than the standard error of this modulus."""
    each, biases = found.whole, found.mesh_bias[:, None]
    if found.parts is not None and found.parts_bias is not None:
        each, biases = found.parts, found.parts_bias
    bias, error = np.abs(biases[f]), each.standard_errors[f].real / np.abs(each.modulus[f])
    r = int(np.argmax(np.nan_to_num(bias / np.maximum(error, 1e-12))))
    if not bias[r] > error[r]:
        return []
    return [
        f"{hertz:g} Hz: the size of the voxels changes {_modulus_named(found, r)} by {100 * bias[r]:.2g} % (standard "
        f"error {100 * error[r]:.2g} %); subtract mesh_bias, or measure with smaller voxels"
    ]


def _modulus_named(found: Found, r: int) -> str:
    if found.parts is None or found.labels is None:
        return "the modulus"
    return f"the modulus of region {found.labels[r]}"


def _of_residuals(hertz: float, each: Regions, f: int, uniform: str, coarse: bool) -> list[str]:
    """Return warnings about residuals that are too large, or that are correlated between neighbouring voxels.

    `coarse`: the size of the voxels changes a modulus by more than its error. The size of the voxels is then named
    first among the causes.
    """
    told, ratio = [], each.chi2[f] / each.components
    alike = f < len(each.correlations) and each.correlations[f].seen
    if alike:
        told.append(
            f"{hertz:g} Hz: the residuals of neighbouring voxels are correlated ({each.correlations[f].beyond:.2g} "
            f"above independent noise). Possible causes: {'the voxels are coarse (mesh_bias), ' if coarse else ''}the "
            f"data are smoothed, or the organ is less uniform than its {uniform}; "
            f"{_enlarged(each.noise_factor[f].max())}"
        )
    if ratio < TOO_NEAR and each.components >= FEW:
        told.append(
            f"{hertz:g} Hz: chi2 is {ratio:.3g} per equation. The motion scatters {np.sqrt(ratio):.2g} times as much "
            "as the stated noise, and the standard errors are too large; give a smaller --noise, or remove this option"
        )
    if ratio > WRONG:
        told.append(
            f"{hertz:g} Hz: the fit with uniform {uniform} is poor (chi2 = {ratio:.3g} per equation). Unless the data "
            f"are smoothed{' or the voxels coarse' if coarse else ''}, the moduli may be wrong by more than their "
            "errors. Check the labels, and exclude voxels that were not measured or are very noisy"
        )
    elif ratio > TOO_FAR and not alike:
        told.append(
            f"{hertz:g} Hz: chi2 is {ratio:.3g} per equation with uniform {uniform}, so the organ is less uniform than "
            "this, or the noise is larger than assumed. The standard errors are multiplied by the square root of this "
            "chi2"
        )
    return told


def _enlarged(factor: float) -> str:
    if factor < 1.005:
        return "standard errors do not contain this effect"
    return f"standard errors are enlarged {factor:.3g} times"


#: Range of the speeds [m/s] of shear waves in soft tissue.
SLOW, FAST = 0.4, 15.0


def _in_radians(hertz: np.ndarray) -> bool:
    """Return whether every frequency is a whole number times 2 pi, but no frequency is itself a whole number (within
    rounding errors)."""

    def whole(x: np.ndarray) -> np.ndarray:
        return np.abs(x - np.round(x)) < 5e-4

    return bool(np.all(whole(hertz / (2 * np.pi)) & ~whole(hertz)))


def _of_scales(organ: Organ, found: Found, moves: list[int]) -> list[str]:
    """Return warnings about wave speeds outside the range of soft tissue, and about moduli that change with frequency
    in a way that no material allows.

    The balance of forces does not depend on the units, so chi^2 does not show a wrong unit. `moves`: indices of the
    frequencies with motion. At the other frequencies, the moduli are fitted to noise, so they are not checked.
    """
    if not moves:
        return []
    told, omega = [], organ.waves.omega[moves]
    G, errors = found.whole.modulus[moves, 0], np.abs(found.whole.standard_errors[moves, 0])
    speeds = velocity_and_attenuation(G.real, G.imag, omega, organ.density)[0]
    odd = np.flatnonzero(~((speeds > SLOW) & (speeds < FAST)))
    if odd.size:
        told.append(
            f"waves of {omega[odd[0]] / (2 * np.pi):g} Hz run at {speeds[odd[0]]:.2g} m/s, but waves in soft tissue "
            f"run at {SLOW:g} to {FAST:g} m/s: check the spacing (metres) and the frequencies (Hz, not rad/s)"
        )
    elif _in_radians(omega / (2 * np.pi)):
        told.append(
            f"the frequencies {', '.join(f'{f:.6g}' for f in omega / (2 * np.pi))} are whole numbers times 2 pi: if "
            "the given numbers are in rad/s, the moduli are 39 times too large; give frequencies in Hz"
        )
    for a, b in itertools.pairwise(range(len(omega))):
        span = np.log(omega[b] / omega[a])
        slope = np.log(np.abs(G[b]) / np.abs(G[a])) / span
        error = 3 * float(np.hypot(errors[a] / np.abs(G[a]), errors[b] / np.abs(G[b]))) / span
        if slope + error < -0.1 or slope - error > 1.1:
            told.append(
                f"from {omega[a] / (2 * np.pi):g} to {omega[b] / (2 * np.pi):g} Hz |G*| changes as the frequency to "
                f"the power of {slope:.2g}, but this power is 0 to 1 in all materials: check that the frequencies are "
                "in the order of the displacement fields"
            )
    return told


def _sign(organ: Organ, found: Found) -> list[str]:
    """Return a warning if, at some frequency, every loss modulus that the data determine is negative. No passive
    material has a negative loss modulus.

    If regions are given, only the moduli of the regions are checked. The reason: the fitted loss modulus of the whole
    organ may be negative if the organ consists of several materials.
    """
    wrong, each = [], found.whole if found.parts is None else found.parts
    for f, (hertz, G, error) in enumerate(
        zip(organ.field.frequencies, each.modulus, each.standard_errors, strict=True)
    ):
        known = np.abs(G.imag) > 3 * error.imag
        if known.any() and not _of_no_motion(organ.field, f, found) and np.all(G.imag[known] < 0):
            wrong.append(f"{hertz:g} Hz")
    if not wrong:
        return []
    return [
        f"the loss modulus is negative at {', '.join(wrong)}, which no tissue has. Here the motion is the real part of "
        "U exp(+i omega t): if your waves have the other sign, use the complex conjugate of the displacements"
    ]


def chi2_text(chi2: float) -> str:
    """Return chi^2 as a string with two decimals; from 1e4 on in scientific notation."""
    return f"{chi2:.2f}" if chi2 < 1e4 else f"{chi2:.1e}"
