"""Read complex displacements of a harmonic motion on voxels from files."""

import itertools
import os
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from fitting.waves.files import formats
from fitting.waves.files.unwrapping import unwrapped
from liverjax.core.errors import InputError
from liverjax.core.struct import Content, Numbers

#: Units of displacements, and the factors that convert them to metres. Phases in rad are not converted.
UNITS = {"m": 1.0, "cm": 1e-2, "mm": 1e-3, "um": 1e-6, "µm": 1e-6, "nm": 1e-9, "rad": 1.0}


class WaveField(NamedTuple):
    """Complex displacements U on the voxels of a box, at F frequencies. The displacement u(t) is the real part of U
    exp(i omega t)."""

    frequencies: np.ndarray  # (F,) [Hz], ascending
    displacement: np.ndarray  # (F, nx, ny, nz, 3) complex [m]; NaN where it is not measured
    spacing: np.ndarray  # (3,) [m]
    origin: np.ndarray  # (3,) [m], centre of the first voxel
    mask: np.ndarray  # (nx, ny, nz) bool: voxels of the organ
    labels: np.ndarray | None  # (nx, ny, nz) whole numbers: the region of each voxel; None if no labels are given
    noise: np.ndarray  # (F,) [m] standard deviation of the noise in real and imaginary part of one component
    source: str = ""
    notes: tuple[str, ...] = ()
    #: Position of the voxels in space (3, 4) [m], as `formats.PLACE`. None: the axes of the voxels are x, y and z.
    place: np.ndarray | None = None


def read_waves(
    path: str | os.PathLike,
    frequencies: list[float] | None = None,
    mask: str | os.PathLike | None = None,
    labels: str | os.PathLike | None = None,
    unit: str | None = None,
    spacing: list[float] | None = None,
) -> WaveField:
    """Read a wave field from a file (.npz, .npy, HDF5, MATLAB, CSV or NIfTI; see `formats`).

    Args:
        path: file of the displacements.
        frequencies: frequencies [Hz], if the file does not contain them.
        mask, labels: files with whole numbers on the same voxels, if the file of the displacements does not contain
            them.
        unit: unit of the displacements, one of `UNITS`. Default: the unit in the file, or m if the file has no unit.
        spacing: spacing of the voxels (3,) [m], if the file contains no spacing or a wrong spacing.

    Raises:
        InputError: the file cannot be used; the message states the file, the field, the value and what to do.
    """
    name, found, unit = str(path), formats.arrays(Path(path)), formats.with_micro_sign(unit or "")
    more = {"mask": mask, "labels": labels}
    if spacing is None and formats.CONFLICT in found:
        raise InputError(f"{found[formats.CONFLICT]}, or give --spacing")
    step = _lengths(name, "spacing", spacing if spacing is not None else found.get("spacing"), "--spacing")
    place = found.get(formats.PLACE)
    given = (step, place, spacing is not None)
    found |= {key: _on_the_same_voxels(Path(file), key, *given) for key, file in more.items() if file is not None}
    jumps: list[str] = []
    if found.get("wrapped") is not None:
        phases = _instants(name, "wrapped", found["wrapped"])
        only = _whole_numbers(name, "mask", found.get("mask"), phases.shape[2:5])
        if only is not None:
            phases = np.where((only != 0)[..., None], phases, np.nan)  # in air, the measured phase is only noise
        found["phases"], jumps = unwrapped(name, phases)
        found["unit"] = "rad"
    U, notes = _motion(name, found)
    notes += [*found.get(formats.NEARLY, []), *jumps, *_of_replaced(name, found, step, unit)]
    U = np.where(np.isfinite(U), U, np.nan) * _factor(name, unit or found.get("unit") or "m")
    notes += _leave_out_rest(U)
    hertz = _hertz(name, frequencies, found.get("frequencies"), len(U))
    origin = np.zeros(3) if found.get("origin") is None else _plain(name, "origin", found["origin"])
    if origin.shape != (3,) or not np.all(np.isfinite(origin)):
        raise InputError(f"{name}: origin {origin.tolist()} must be three coordinates in metres; correct the origin")
    shape = U.shape[1:4]
    measured = np.asarray(np.isfinite(U).any(axis=(0, 4)))
    chosen = _whole_numbers(name, "mask", found.get("mask"), shape)
    inside = measured if chosen is None else measured & (chosen != 0)
    if not inside.any():
        raise InputError(f"{name}: no voxel of the mask has a displacement; give a mask of voxels with displacements")
    now_and_then = inside & ~np.isfinite(U).any(axis=4).all(axis=0)
    if now_and_then.any() and np.isfinite(U).any(axis=(1, 2, 3, 4)).all():
        notes.append(
            f"{now_and_then.sum()} of {inside.sum()} voxels have no displacement at some frequencies and are not used"
        )
    regions = _whole_numbers(name, "labels", found.get("labels"), shape)
    order = np.argsort(hertz)
    field = WaveField(hertz[order], U[order], step, origin, inside, regions, np.zeros(len(U)), name, tuple(notes))
    return field._replace(noise=noise_of(field), place=_with_lengths(place, step, origin))


def _with_lengths(place: np.ndarray | None, step: np.ndarray, origin: np.ndarray) -> np.ndarray | None:
    """Return the position of the voxels in space (3, 4) [m], with the directions of `place` and the spacing `step`."""
    if place is None:
        return None
    axes = place[:, :3]
    return np.column_stack([axes / np.linalg.norm(axes, axis=0) * step, origin])


def _of_replaced(name: str, found: Content, step: np.ndarray, unit: str | None) -> list[str]:
    """Return notes if the unit in the file differs from the given `unit`, or if the spacing in the file differs from
    the spacing `step` [m] that is used."""
    stated = found.get("unit")
    told = []
    if unit and stated and unit != stated:
        told.append(f"the file states the unit {stated}, but --unit {unit} is used")
    return told + _of_another_spacing(name, found, step)


def _of_another_spacing(name: str, found: Content, step: np.ndarray) -> list[str]:
    if found.get("spacing") is None or formats.CONFLICT in found:
        return []
    stated = _plain(name, "spacing", found["spacing"])  # this spacing is not used, so it was not checked
    if len(stated) in (1, 3) and np.allclose(stated, step, rtol=1e-3):
        return []
    return [
        f"the file states a spacing of {stated.tolist()} m, but --spacing {step.tolist()} m is used: the moduli are "
        "proportional to the square of the spacing"
    ]


def _on_the_same_voxels(file: Path, key: str, spacing: np.ndarray, place: object, spacing_given: bool) -> np.ndarray:
    """Read the mask or the labels from a separate file, which must have the same voxels as the waves.

    `place`: position in space of the voxels of the waves (see `formats.PLACE`); None if the position is unknown.
    """
    values, own, elsewhere = formats.single(file, key, spacing_given)
    number = np.maximum((*values.shape, 1, 1, 1)[:3], 1)  # number of voxels along each axis; the shape is checked later
    if elsewhere is not None and place is not None:
        corners = np.array([(*at, 1) for at in itertools.product(*((0, n - 1) for n in number))])
        apart = np.linalg.norm(corners @ (np.asarray(elsewhere) - np.asarray(place)).T, axis=1).max()
        if apart > SAME_PLACE * float(np.min(spacing)):
            raise InputError(
                f"{file}: the voxels are not at the positions of the voxels of the waves, or the axes have different "
                f"directions; resample {key} to the voxels of the waves"
            )
    if own is not None:
        size = _lengths(str(file), "spacing", own, "its spacing")
        if np.any(np.abs(size / spacing - 1) > np.minimum(SAME_SIZE, HALF / number)):
            raise InputError(
                f"{file}: the voxel size is {size.tolist()} m, but the waves have voxels of {spacing.tolist()} m; give "
                f"{key} on the voxels of the waves"
            )
    return values


#: Two positions are regarded as equal if they differ by less than this (in voxels).
SAME_PLACE = 0.1
#: Two voxel sizes are regarded as equal if their relative difference is below `SAME_SIZE`, and if this difference
#: changes the length of the whole array by less than `HALF` a voxel.
SAME_SIZE, HALF = 0.01, 0.5
#: Components that are exactly 0 are reported if they occur in less than this fraction of the voxels.
FEW = 0.2


def _leave_out_rest(U: np.ndarray) -> list[str]:
    """Replace the displacements U by NaN in voxels that do not move, and return notes. Many programs write 0 where
    nothing was measured."""
    notes, nothing = [], (U == 0) | np.isnan(U)
    still = np.all(nothing, axis=(0, 4))
    if np.any(still & np.any(U == 0, axis=(0, 4))):
        U[:, still] = np.nan
        notes.append(f"{still.sum()} voxels do not move at all, so they are treated as not measured")
    for f, u in enumerate(U):
        rests = np.all(u == 0, axis=-1)
        if rests.any() and np.any(np.isfinite(u) & (u != 0)):
            u[rests] = np.nan
            notes.append(
                f"{rests.sum()} voxels do not move in field {f + 1}, but move in other fields, so they are treated as "
                "not measured at all frequencies"
            )
        several = np.isfinite(u) & np.any(np.isfinite(u) & (u != 0), axis=-1, keepdims=True)
        zeros = (u == 0) & several
        zeros &= zeros.sum(axis=(0, 1, 2)) < FEW * several.sum(axis=(0, 1, 2))  # many zeros may be due to symmetry
        if zeros.any():
            notes.append(
                f"field {f + 1} has {zeros.sum()} components that are exactly 0 in voxels that move: write NaN where a "
                "component was not measured"
            )
    # The motion may be along one axis only, so a component that is zero everywhere is kept.
    resting = np.all(nothing, axis=(0, 1, 2, 3)) & np.any(U == 0, axis=(0, 1, 2, 3))
    for axis in np.array(list("xyz"))[resting]:
        notes.append(f"component {axis} is zero everywhere: write NaN if this component was not measured")
    return notes


def with_noise(field: WaveField, noise: float | None) -> WaveField:
    """Return the field with `noise` [m] as the standard deviation of its noise. If `noise` is None, the estimated noise
    of the field is kept. This estimate must be above 0 at every frequency."""
    if noise is not None:
        return field._replace(noise=np.full(len(field.frequencies), noise))
    unknown = ~(field.noise > 0)
    if unknown.any():
        hertz = ", ".join(f"{f:g}" for f in field.frequencies[unknown])
        blank = not np.isfinite(field.displacement[unknown]).any()
        remedy = "remove this displacement field, which contains no numbers" if blank else "give --noise, in metres"
        raise InputError(f"{field.source}: the noise at {hertz} Hz cannot be estimated from the data: {remedy}")
    return field


def _motion(name: str, found: Content) -> tuple[np.ndarray, list[str]]:
    """Return the complex displacements (F, nx, ny, nz, 3) in the unit of the file, and notes."""
    told: list[str] = []
    if found.get("phases") is not None:  # (F, T, nx, ny, nz, 3): instants of one period, equally spaced
        u = _instants(name, "phases", found["phases"])
        U, told = 2 * np.fft.fft(u, axis=-5)[..., 1, :, :, :, :] / u.shape[-5], _of_a_last_instant(u)
    elif found.get("displacement") is not None:
        U = _array_of_numbers(name, "displacement", found["displacement"])
    elif found.get("real") is not None and found.get("imag") is not None:
        parts = [_array_of_numbers(name, key, found[key]) for key in ("real", "imag")]
        if parts[0].shape != parts[1].shape:
            raise InputError(
                f"{name}: real has shape {parts[0].shape}, but imag has {parts[1].shape}; give both with one shape"
            )
        U = parts[0] + 1j * parts[1]
    else:
        if _is_image(name):
            raise InputError(f"{name}: the numbers are real, so they are read as labels; give waves as {_layout(name)}")
        known = ", ".join(sorted(k for k, v in found.items() if v is not None and k[0] != "(")) or "nothing"
        if "labels" in found and "displacement" not in found:
            known += " (real numbers are read as labels)"
        near = "".join(f" ({note})" for note in found.get(formats.NEARLY, []))
        raise InputError(
            f"{name}: the file contains {known}, but no waves; store the waves as displacement (complex), as real and "
            f"imag, or as phases{near}"
        )
    shape = U.shape
    if U.ndim == 4:
        U = U[None]
    if U.ndim != 5 or U.shape[-1] not in (1, 3):
        raise InputError(f"{name}: displacement has shape {shape}; give {_layout(name)}")
    if not np.any(np.isfinite(U) & (U != 0)):
        raise InputError(f"{name}: displacement is zero or NaN in every voxel; check the file")
    largest = float(np.max(np.abs(U[np.isfinite(U)])))
    if not 1e-100 < largest < 1e100:
        raise InputError(f"{name}: the largest displacement is {largest:.3g}; check the numbers and their unit")
    if not np.iscomplexobj(U) or not np.any(np.isfinite(U) & (U.imag != 0)):
        raise InputError(
            f"{name}: displacement has no imaginary part; give complex amplitudes, or phases over a period"
        )
    U = U.astype(complex)
    if U.shape[-1] == 3:
        return U, told
    blank = np.full(U.shape, np.nan + 0j)
    return np.concatenate([U, blank, blank], axis=-1), [*told, "one component is measured: the other two are unknown"]


def _is_image(name: str) -> bool:
    return name.lower().endswith((".nii", ".nii.gz"))


def _layout(name: str) -> str:
    """Return a phrase for messages: the array layout that waves must have in this kind of file."""
    if _is_image(name):
        return "complex numbers (nx, ny, nz, 3), or (nx, ny, nz, F, 3) for several frequencies"
    return "(F, nx, ny, nz, 3), frequencies first, components last"


def _instants(name: str, field: str, values: Numbers) -> np.ndarray:
    """Check an array with the motion at T instants of one period, and return the array with the shape (F, T, nx, ny,
    nz, 3)."""
    u = _array_of_numbers(name, field, values)
    if u.ndim not in (5, 6) or u.shape[-5] < 3 or u.shape[-1] not in (1, 3) or np.iscomplexobj(u):
        raise InputError(
            f"{name}: {field} has shape {u.shape}; give real numbers (F, T, nx, ny, nz, 3) with 3 instants or more"
        )
    return u if u.ndim == 6 else u[None]


#: T instants are fitted with a period of T steps, and with a period of T - 1 steps. A note is given if the residual of
#: the second fit is below this fraction of the residual of the first fit.
_REPEATED = 0.5


def _of_a_last_instant(u: np.ndarray) -> list[str]:
    """Return a note if the last of the T instants u (F, T, nx, ny, nz, 3) seems to be the end of the period."""
    T = u.shape[1]
    if T < 5:  # with 4 instants, a mean and one harmonic may fit all values by chance
        return []
    values = u.reshape(len(u), T, -1)
    values = np.concatenate([one[:, np.isfinite(one).all(axis=0)] for one in values], axis=1)

    def missed(steps: int) -> float:
        angle = 2 * np.pi * np.arange(T) / steps
        basis = np.linalg.qr(np.stack([np.ones(T), np.cos(angle), np.sin(angle)], axis=1))[0]
        return float(np.linalg.norm(values - basis @ (basis.T @ values)))

    if not missed(T - 1) < _REPEATED * missed(T):
        return []
    return [
        f"a period of {T - 1} steps fits the {T} instants better than {T} steps. If the last instant is the "
        "end of the period, this instant repeats the first one: remove the last instant"
    ]


def _array_of_numbers(name: str, field: str, values: Numbers) -> np.ndarray:
    a = np.asarray(values)
    if a.dtype.kind not in "fciu":
        raise InputError(f"{name}: {field} contains {a.dtype}, not numbers; store complex numbers")
    return a


def _plain(name: str, field: str, values: object) -> np.ndarray:
    """Return real numbers as a flat array."""
    try:
        return np.asarray(values, float).ravel()
    except (TypeError, ValueError):
        raise InputError(
            f"{name}: {field} = {str(values)[:40]!r} does not contain numbers; correct this value"
        ) from None


def _factor(name: str, unit: str) -> float:
    if unit not in UNITS:
        raise InputError(f"{name}: unit {unit!r} is not known; use {', '.join(UNITS)}")
    return UNITS[unit]


def _hertz(name: str, asked: list[float] | None, held: Any, number: int) -> np.ndarray:
    if asked is None and held is None:
        raise InputError(f"{name}: the file contains no frequencies; give {number} in Hz, e.g. --frequencies 60")
    hertz = _plain(name, "frequencies", held if asked is None else asked)
    own = hertz if held is None else _plain(name, "frequencies", held)
    if asked is not None and (len(own) != len(hertz) or not np.allclose(hertz, own)):
        raise InputError(f"{name}: the file states {np.ravel(held).tolist()} Hz; remove --frequencies")
    if len(hertz) != number:
        raise InputError(
            f"{name}: there are {len(hertz)} frequencies for {number} displacement fields; give {number} frequencies"
        )
    if not np.all(np.isfinite(hertz) & (hertz > 0)):
        raise InputError(f"{name}: frequencies {hertz.tolist()} must be above 0 Hz; correct the frequencies")
    if len(np.unique(hertz)) < number:
        raise InputError(
            f"{name}: frequencies {hertz.tolist()} are not all different; give one frequency for each field"
        )
    return hertz


def _lengths(name: str, field: str, given: object, option: str) -> np.ndarray:
    if given is None:
        raise InputError(f"{name}: the file contains no {field}; give {option} in metres, e.g. 0.002 0.002 0.002")
    values = _plain(name, field, given)
    values = np.repeat(values, 3) if len(values) == 1 else values
    if len(values) != 3 or not np.all(np.isfinite(values) & (values > 0)):
        raise InputError(f"{name}: {field} {values.tolist()} must be three lengths above 0 m; correct these lengths")
    if np.any(values > 0.1):
        raise InputError(f"{name}: {field} {values.tolist()} m is too large for a voxel; give metres, not mm")
    return values


def _whole_numbers(name: str, field: str, values: object, shape: tuple[int, ...]) -> np.ndarray | None:
    if values is None:
        return None
    a = np.asarray(values)
    if a.shape != shape:
        raise InputError(f"{name}: {field} has shape {a.shape}, but the waves have {shape}; use the same voxels")
    if a.dtype.kind not in "biuf" or not np.all(np.isfinite(a)) or np.any(a != np.rint(a)):
        raise InputError(f"{name}: {field} must be whole numbers; correct this array")
    return a.astype(int)


#: Weights of the fourth difference. The sum of their squares is 70.
_FOURTH = np.array([1.0, -4.0, 6.0, -4.0, 1.0])


def noise_of(field: WaveField) -> np.ndarray:
    """Estimate the standard deviation (F,) [m] of the noise in the real and the imaginary part of one component.

    The estimate is the scaled median of fourth differences along the axis with the smallest differences. A few bad
    voxels hardly change a median. A real or imaginary part of a component that is exactly 0 in all voxels is not used,
    because its zeros contain no noise. A smooth wave contributes only (k h)^4 / 8 of its amplitude, with the wave
    number k and the voxel spacing h. This is 0.12 % for 20 voxels per wavelength, and 4 % for 8. The result is NaN if
    the mask has too few rows of five voxels.
    """
    out = np.full(len(field.frequencies), np.nan)
    for f, U in enumerate(field.displacement):
        known = field.mask[..., None] & np.isfinite(U)
        every = np.concatenate([np.where(known, part, np.nan) for part in (U.real, U.imag)], axis=-1)
        every = every[..., np.any(np.nan_to_num(every) != 0, axis=(0, 1, 2))]
        best = np.nan
        for a in range(3):
            if every.shape[a] < 5:
                continue
            rows = np.moveaxis(every, a, 0)
            n = len(rows) - 4
            d = sum(w * rows[k : k + n] for k, w in enumerate(_FOURTH))
            d = d[np.isfinite(d)]
            if d.size >= 40:
                own = np.median(np.abs(d)) / 0.6745 / np.sqrt(np.sum(_FOURTH**2))
                best = own if np.isnan(best) else min(best, own)  # the wave contributes least along this axis
        out[f] = best
    return out


def coarsened(field: WaveField, stride: int) -> WaveField:
    """Return a field with fewer voxels: the means over blocks of stride^3 voxels. A block is in the new mask if all its
    voxels are in the mask. In a uniform organ, the means form a wave with the same wavelength."""
    if stride == 1:
        return field
    n = np.array(field.mask.shape) // stride
    if n.min() < 1:
        raise InputError(f"a stride of {stride} leaves no voxel of {field.mask.shape}: give a smaller --stride")
    cut = tuple(slice(0, k * stride) for k in n)
    blocks = (n[0], stride, n[1], stride, n[2], stride)
    mask = np.asarray(field.mask[cut].reshape(blocks).all(axis=(1, 3, 5)))
    U = np.where(
        mask[None, ..., None], field.displacement[(slice(None), *cut)].reshape(-1, *blocks, 3).mean((2, 4, 6)), np.nan
    )
    labels = None if field.labels is None else _most_frequent(field.labels[cut], stride, blocks)
    place, middle = field.place, 0.5 * (stride - 1)  # centre of the first block, in voxels
    if place is not None:
        first = place[:, 3] + middle * place[:, :3].sum(axis=1)
        place = np.column_stack([place[:, :3] * stride, first])
    return field._replace(
        place=place,
        displacement=U,
        mask=mask,
        labels=labels,
        spacing=field.spacing * stride,
        origin=field.origin + middle * field.spacing if place is None else place[:, 3],
        noise=field.noise / stride**1.5,
    )


def _most_frequent(labels: np.ndarray, stride: int, blocks: tuple[int, ...]) -> np.ndarray:
    """Return the most frequent label in each block. If two labels are equally frequent, the lower and the higher label
    are used alternately from block to block."""
    known = np.unique(labels)
    turn = np.where(np.indices(blocks[::2]).sum(axis=0) % 2, 1.0, -1.0)
    counts = [
        (labels == label).reshape(blocks).sum(axis=(1, 3, 5)) + 0.5 * turn * k / len(known)
        for k, label in enumerate(known)
    ]
    return np.asarray(known[np.argmax(counts, axis=0)])
