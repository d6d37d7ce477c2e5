"""Sentences about a fit to waves that its user should know: they are printed, and are `warnings` in waves.json."""

import itertools

import numpy as np
import scipy.ndimage

from fitting.waves.elastography import Found, Organ
from fitting.waves.files import components
from fitting.waves.regions import Regions
from fitting.waves.shear_waves import velocity_and_attenuation
from fitting.waves.stiffness_map import FAR, WaveMap
from fitting.waves.wave_field import WaveField

#: Radius [voxels] below which the modulus of a region is a guess: cylinders of this radius came out within 8 %.
LEAST_RADIUS = 2.5
#: chi^2 per equation above which there is a warning that the model misses something.
TOO_FAR = 1.5
#: Standard deviations of the chi^2 of a map above which it is told, and the part of it that the noise's estimate costs.
BY_CHANCE, ROUGH = 5.0, 0.03
#: The same, above which the moduli themselves may be wrong.
WRONG = 10.0


def cautions_of_elastography(organ: Organ, found: Found, drawn: WaveMap | None) -> list[str]:
    """One sentence for each. The arguments are those of `fitting.reports.waves.report.write`."""
    told, each = _sign(organ, found), found.whole if found.parts is None else found.parts
    told += _of_scales(organ, found)
    any_coarse = False
    order = components.order_sentence(organ.field)
    if order is not None:
        told.insert(0, order)
    for f, hertz in enumerate(organ.field.frequencies):
        if not np.isfinite(organ.field.noise[f]):
            continue
        still = _of_no_motion(organ.field, f)
        if still:
            told += still
            continue
        coarse = _of_voxel_size(hertz, found, f)
        told += coarse + _of_residuals(hertz, each, f, "regions" if found.parts else "moduli", bool(coarse))
        any_coarse |= bool(coarse)
        told += _of_long_waves(hertz, found, f)
    if found.parts is not None and found.labels is not None:
        few = ~(found.parts.standard_errors.real < np.abs(found.parts.modulus)).all(axis=0)
        for label in found.labels[few]:
            told.append(f"region {label}: its standard error is larger than its modulus: it has too few voxels")
        told += _of_small_regions(organ.field, found.labels[~few])
        far = np.abs(found.parts.farther).max(axis=0) > 1
        if far.any():
            names = ", ".join(str(label) for label, beyond in zip(found.labels, far, strict=True) if beyond)
            told.append(
                f"regions {names}: the waves place their edges more than a voxel away from the edges of the labels "
                "(edges_farther_out_voxels): look at the labels"
            )
    if drawn is not None and not drawn.distance <= FAR:
        told.append(
            f"the map stopped {drawn.distance:.2g} standard deviations away from its minimum: compare it with regions"
        )
    # The mean of n squares scatters by the root of 2/n; the noise that divides them is an estimate.
    if drawn is not None and drawn.chi2 / drawn.components > 1 + ROUGH + BY_CHANCE * np.sqrt(2 / drawn.components):
        told.append(
            f"chi2 of the map is {drawn.chi2 / drawn.components:.3g} per equation: "
            f"{'coarse voxels (mesh_bias), ' if any_coarse else ''}edges sharper than the map, "
            "noise that is larger in a part of the organ, a ratio of the moduli at several frequencies that is not the "
            "same everywhere, or a body that does not move like a "
            "viscous solid; its deviations are too small then, so compare it with regions and with one frequency alone"
        )
    return told


def _of_small_regions(field: WaveField, labels: np.ndarray) -> list[str]:
    """A sentence on regions without a voxel that is `LEAST_RADIUS` from other regions; the organ's own end is none."""
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
        f"regions {', '.join(small)}: below {LEAST_RADIUS:g} voxels of radius a modulus is a guess, and its error does "
        "not contain this: measure with smaller voxels, or give the region the label of its surroundings"
    ]


#: Root mean square of the motion over the noise, below which nothing but noise is seen: the two add up as squares, so
#: that the motion itself is smaller than two thirds of the noise.
NO_MOTION = 1.2


def _of_no_motion(field: WaveField, f: int) -> list[str]:
    """A sentence if the displacements at this frequency are hardly larger than their noise."""
    u = field.displacement[f][field.mask]
    size = float(np.sqrt(np.nanmean(np.abs(u) ** 2) / 2))
    if not size < NO_MOTION * field.noise[f]:
        return []
    return [
        f"{field.frequencies[f]:g} Hz: the displacements ({size:.2g} m) are hardly larger than their noise "
        f"({field.noise[f]:.2g} m): nothing is known of the waves there; leave this frequency out"
    ]


#: Relative standard error of a modulus above which its interval is not symmetric.
SKEW = 0.15


def _of_long_waves(hertz: float, found: Found, f: int) -> list[str]:
    """The interval of each modulus that is known so badly that its error is not the same on both sides.

    Waves that are long beside the organ determine the compliance 1/G, whose error is symmetric.
    """
    each, told = found.whole if found.parts is None else found.parts, []
    for r, (G, e) in enumerate(zip(np.abs(each.modulus[f]), each.standard_errors[f].real, strict=True)):
        told_already = found.parts is not None and e >= G  # a region has a sentence of its own
        if told_already or not (np.isfinite(e) and e > SKEW * G):
            continue
        half = 2 * e / G**2
        top = f"{1 / (1 / G - half):.3g} Pa" if half < 1 / G else "any value above"
        told.append(
            f"{hertz:g} Hz: {_modulus_named(found, r)} has an error of {100 * e / G:.2g} %. Where waves are long "
            f"beside the organ the data determine 1/G, so its size may be {1 / (1 / G + half):.3g} Pa to {top} "
            "(95 %): measure at a higher frequency"
        )
    return told


def _of_voxel_size(hertz: float, found: Found, f: int) -> list[str]:
    """A sentence if the size of the voxels changes a modulus by more than its standard error."""
    each, biases = found.whole, found.mesh_bias[:, None]
    if found.parts is not None and found.parts_bias is not None:
        each, biases = found.parts, found.parts_bias
    bias, error = np.abs(biases[f]), each.standard_errors[f].real / np.abs(each.modulus[f])
    r = int(np.argmax(bias / np.maximum(error, 1e-12)))
    if not bias[r] > error[r]:
        return []
    return [
        f"{hertz:g} Hz: the size of the voxels changes {_modulus_named(found, r)} by {100 * bias[r]:.2g} % (standard "
        f"error {100 * error[r]:.2g} %): subtract mesh_bias, or measure smaller voxels"
    ]


def _modulus_named(found: Found, r: int) -> str:
    if found.parts is None or found.labels is None:
        return "the modulus"
    return f"the modulus of region {found.labels[r]}"


def _of_residuals(hertz: float, each: Regions, f: int, uniform: str, coarse: bool) -> list[str]:
    """Sentences on residuals that are too large, or alike in neighbouring voxels.

    `coarse`: the size of the voxels changes a modulus by more than its error. Then it comes first among the causes.
    """
    told, ratio = [], each.chi2[f] / each.components
    alike = f < len(each.correlations) and each.correlations[f].seen
    if alike:
        told.append(
            f"{hertz:g} Hz: neighbouring voxels share their residuals (correlation {each.correlations[f].beyond:.2g} "
            f"above that of independent noise): {'the voxels are coarse (mesh_bias), ' if coarse else ''}the data are "
            "smoothed, or the organ is less uniform than its "
            f"{uniform}; standard errors are enlarged {each.noise_factor[f].max():.3g} times, those of a map are not"
        )
    if ratio > WRONG:
        told.append(
            f"{hertz:g} Hz: chi2 = {ratio:.3g} per equation with uniform {uniform}: unless the data are smoothed"
            f"{' or the voxels coarse' if coarse else ''}, the "
            "moduli may be wrong by more than their errors; look for voxels that were not measured or are noisier, and "
            "at the labels"
        )
    elif ratio > TOO_FAR and not alike:
        told.append(
            f"{hertz:g} Hz: chi2 = {ratio:.3g} per equation with uniform {uniform}: the organ is less uniform, or the "
            "noise larger; the standard errors are enlarged by its root"
        )
    return told


#: Speeds [m/s] of shear waves in soft tissue.
SLOW, FAST = 0.4, 15.0


def _in_radians(hertz: np.ndarray) -> bool:
    """Whether no frequency is a whole number, and all are whole numbers times 2 pi, to the digits of a table."""

    def whole(x: np.ndarray) -> np.ndarray:
        return np.abs(x - np.round(x)) < 5e-4

    return bool(np.all(whole(hertz / (2 * np.pi)) & ~whole(hertz)))


def _of_scales(organ: Organ, found: Found) -> list[str]:
    """Sentences on speeds that no soft tissue has, and on moduli that change with frequency as no material's do.

    The balance of forces has no scale of its own, so that a wrong unit leaves its chi^2 as it is.
    """
    told, omega = [], organ.waves.omega
    G, errors = found.whole.modulus[:, 0], np.abs(found.whole.standard_errors[:, 0])
    speeds = velocity_and_attenuation(G.real, G.imag, omega, organ.density)[0]
    odd = np.flatnonzero(~((speeds > SLOW) & (speeds < FAST)))
    if odd.size:
        told.append(
            f"waves of {omega[odd[0]] / (2 * np.pi):g} Hz run at {speeds[odd[0]]:.2g} m/s, and in soft tissue at "
            f"{SLOW:g} to {FAST:g} m/s: check the spacing (metres) and the frequencies (Hz, not rad/s)"
        )
    elif _in_radians(omega / (2 * np.pi)):
        told.append(
            f"the frequencies {', '.join(f'{f:.6g}' for f in omega / (2 * np.pi))} are whole numbers times 2 pi: if "
            "they are in rad/s, moduli are 39 times too large; give them in Hz"
        )
    for a, b in itertools.pairwise(range(len(omega))):
        span = np.log(omega[b] / omega[a])
        slope = np.log(np.abs(G[b]) / np.abs(G[a])) / span
        error = 3 * float(np.hypot(errors[a] / np.abs(G[a]), errors[b] / np.abs(G[b]))) / span
        if slope + error < -0.1 or slope - error > 1.1:
            told.append(
                f"from {omega[a] / (2 * np.pi):g} to {omega[b] / (2 * np.pi):g} Hz |G*| changes as the frequency to "
                f"the power of {slope:.2g}, which is 0 to 1 in all materials: check that the frequencies are in the "
                "order of the fields"
            )
    return told


def _sign(organ: Organ, found: Found) -> list[str]:
    """A sentence if every loss modulus that the data determine is negative, which no passive material has.

    Where regions are given, theirs count: one modulus for several materials may have any loss.
    """
    wrong, each = [], found.whole if found.parts is None else found.parts
    for hertz, G, error in zip(organ.field.frequencies, each.modulus, each.standard_errors, strict=True):
        known = np.abs(G.imag) > 3 * error.imag
        if known.any() and np.all(G.imag[known] < 0):
            wrong.append(f"{hertz:g} Hz")
    if not wrong:
        return []
    return [
        f"the loss modulus is negative at {', '.join(wrong)}, which no tissue has: here the motion is the real part of "
        "U exp(+i omega t), so take the complex conjugate of waves of the other sign"
    ]


def chi2_text(chi2: float) -> str:
    """chi^2 as text with two decimals; in scientific form from 1e4 on."""
    return f"{chi2:.2f}" if chi2 < 1e4 else f"{chi2:.1e}"
