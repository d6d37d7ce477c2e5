"""Unwrap phases that a scanner has wrapped into (-pi, pi]. Unwrapped phases are continuous in space and in time."""

import numpy as np
from scipy import ndimage

from liverjax.core.errors import InputError

#: If the phases of two neighbouring voxels differ by more than _STEEP times pi, a jump may be hidden. A note is given
#: if the fraction of such pairs of neighbours is above _MANY.
_STEEP, _MANY = 0.8, 0.01


def unwrapped(name: str, phases: np.ndarray) -> tuple[np.ndarray, list[str]]:
    """Return phases [rad] without jumps, and notes. Phases are NaN where they are not measured. A note is given if
    jumps are left, or if phases change so fast from voxel to voxel that jumps cannot be distinguished from waves.

    In space, pairs of neighbouring voxels are unwrapped in the order of their reliability (Herraez et al. 2002, Appl.
    Opt. 41, 7437). After this, a multiple of 2 pi may still be missing in the phase of a whole part of the volume. A
    part is a set of connected voxels, for example one of two organs. The missing multiple of a part is found under the
    assumption that the median phase of the part changes by less than pi from one instant of the period to the next.

    Args:
        name: name of the file, for the messages.
        phases: (F, T, nx, ny, nz, 3) [rad], at F frequencies and T instants of a period.

    Raises:
        InputError: phases are outside of [-pi, pi], or scikit-image is not installed.
    """
    measured = phases[np.isfinite(phases)]
    if not measured.size or np.abs(measured).max() > np.pi * (1 + 1e-3):
        largest = np.abs(measured).max() if measured.size else np.nan
        raise InputError(f"{name}: wrapped phases reach {largest:.3g}; give radians between -pi and pi")
    try:
        from skimage.restoration import unwrap_phase
    except ImportError:
        raise InputError(
            f"{name}: wrapped phases need scikit-image; pip install '.[unwrap]', or unwrap the phases first"
        ) from None
    out = np.full(phases.shape, np.nan)
    for f, t, c in np.ndindex(phases.shape[0], phases.shape[1], phases.shape[-1]):
        one = phases[f, t, ..., c]
        volume = np.ma.masked_array(np.nan_to_num(one), np.isnan(one))  # with NaN, `unwrap_phase` would run forever
        out[f, t, ..., c] = np.ma.filled(unwrap_phase(volume, rng=0), np.nan)
    left = sum(int(np.sum(np.abs(np.diff(out, axis=a)) > np.pi)) for a in (2, 3, 4))
    notes = _of_steep_phases(phases)
    note = (
        f"{left} pairs of neighbouring voxels still differ by more than pi after unwrapping, so the waves are wrong "
        "there. Remove these voxels from the mask"
    )
    return _continuous_in_time(out), notes + ([note] if left else [])


def _continuous_in_time(phases: np.ndarray) -> np.ndarray:
    """Return phases (F, T, nx, ny, nz, 3) [rad] whose median is continuous in time, in every connected part of the
    volume. A voxel belongs to a part if it is measured at all T instants."""
    out = phases.copy()
    for f, c in np.ndindex(phases.shape[0], phases.shape[-1]):
        one = phases[f, ..., c]
        part, count = ndimage.label(np.all(np.isfinite(one), axis=0))
        levels = np.array([ndimage.median(each, part, np.arange(count + 1)) for each in one])  # (T, parts + 1)
        shift = np.unwrap(levels, axis=0) - levels
        shift[:, 0] = 0.0  # voxels that belong to no part
        out[f, ..., c] += shift[:, part]
    return out


def _of_steep_phases(phases: np.ndarray) -> list[str]:
    """Return a note for each frequency at which the phases of many neighbouring voxels differ by nearly pi. Wrapped
    phases cannot show a difference above pi."""
    notes = []
    for f, one in enumerate(phases):
        steps = [np.diff(one, axis=a) for a in (1, 2, 3)]
        apart = np.concatenate([np.abs(np.angle(np.exp(1j * s[np.isfinite(s)]))) for s in steps])
        steep = float(np.mean(apart > _STEEP * np.pi)) if apart.size else 0.0
        if steep > _MANY:
            notes.append(
                f"frequency {f + 1} of {len(phases)}: {100 * steep:.2g} % of neighbouring voxels differ by nearly pi "
                "in phase. There, jumps cannot be distinguished from waves, so the motion may be wrong. Use a "
                "weaker motion encoding (fewer radians per micrometre), or smaller voxels"
            )
    return notes
