"""The usual direct inversion of waves (algebraic Helmholtz), as a baseline for the balance of forces.

Where G is uniform, the curl q of the displacement fulfils G laplace(q) = - density omega^2 q, since the curl contains
no pressure. Least squares over the three components and a window of voxels give

    G = - density omega^2 sum(conj(laplace q) q) / sum(|laplace q|^2)

(Oliphant et al. 2001, Magn. Reson. Med. 45, 299; Papazoglou et al. 2008, Phys. Med. Biol. 53, 3147). The denominator
contains the square of the noise of laplace(q), so noise makes the modulus too small. A window over an edge mixes both
sides. Both are known faults of the method; they are not corrected here.
"""

import math

import numpy as np
from scipy import ndimage

from fitting.waves.wave_field import WaveField
from liverjax.core.errors import InputError

#: Standard deviation of the Gaussian that smooths displacements before they are differentiated [voxels].
SMOOTHING = 1.0
#: Side of the window of least squares [voxels].
WINDOW = 3


def invert(field: WaveField, density: float, smoothing: float = SMOOTHING, window: int = WINDOW) -> np.ndarray:
    """Complex modulus (F, nx, ny, nz) [Pa]. It is NaN outside of the mask, and where derivatives or smoothing reach the
    edge of the mask.

    Args:
        field: measured waves. If not all three components are measured, the result is NaN everywhere.
        density: [kg/m^3].
        smoothing: standard deviation of the Gaussian [voxels]. Along an axis that is too short for it, nothing is
            smoothed.
        window: side of the window [voxels], an odd number.
    """
    if not density > 0 or window < 1 or window % 2 == 0 or smoothing < 0:
        raise InputError(
            f"density {density:g}, smoothing {smoothing:g}, window {window}: give a density above 0, a smoothing not "
            "below 0 and an odd window"
        )
    omega = 2 * np.pi * field.frequencies
    ratios = [_one(field, U, smoothing, window) for U in field.displacement]
    return -density * omega[:, None, None, None] ** 2 * np.stack(ratios)


def _one(field: WaveField, U: np.ndarray, smoothing: float, window: int) -> np.ndarray:
    inside = field.mask & np.all(np.isfinite(U), axis=-1)
    # A derivative and a second difference reach one voxel each, the Gaussian three of its standard deviations.
    reach = [2 + math.ceil(3 * smoothing)] * 3
    ends = [np.flatnonzero(inside.any(axis=tuple(b for b in range(3) if b != a))) for a in range(3)]
    widths = [0.0] * 3
    for a, found in enumerate(ends):
        if len(found) and found[-1] - found[0] + 1 > 2 * reach[a]:
            widths[a] = smoothing
        else:
            reach[a] = 2
    whole = ndimage.binary_erosion(inside, np.ones([2 * n + 1 for n in reach]))
    u = [_smooth(U[..., c], inside, widths) for c in range(3)]
    d = [np.gradient(c, *field.spacing) if min(c.shape) > 1 else [np.full_like(c, np.nan)] * 3 for c in u]
    curl = (d[2][1] - d[1][2], d[0][2] - d[2][0], d[1][0] - d[0][1])
    above, below = np.zeros(inside.shape, complex), np.zeros(inside.shape)
    for q in curl:
        L = sum(_second(q, a, h) for a, h in enumerate(field.spacing))
        above = above + np.conj(L) * q
        below = below + np.abs(L) ** 2
    size = np.ones((window,) * 3)
    blank = np.where(whole, 1.0, 0.0)
    above, below = (ndimage.convolve(np.where(whole, a, 0.0), size, mode="constant") for a in (above, below))
    near = ndimage.convolve(blank, size, mode="constant")
    return np.where(whole & (near > 0) & (below > 0), above / np.where(below > 0, below, 1.0), np.nan)


def _smooth(u: np.ndarray, inside: np.ndarray, widths: list[float]) -> np.ndarray:
    """Mean over the voxels inside, weighted by a Gaussian. `widths`: its standard deviation along each axis."""
    known = np.where(inside, u, 0.0)
    if not any(widths):
        return known
    weight = ndimage.gaussian_filter(inside.astype(float), widths)
    sums = ndimage.gaussian_filter(known.real, widths) + 1j * ndimage.gaussian_filter(known.imag, widths)
    return sums / np.maximum(weight, 1e-12)


def _second(q: np.ndarray, axis: int, h: float) -> np.ndarray:
    """Second difference along an axis, 0 at its ends."""
    out = np.zeros_like(q)
    rows, to = np.moveaxis(q, axis, 0), np.moveaxis(out, axis, 0)
    to[1:-1] = (rows[2:] - 2 * rows[1:-1] + rows[:-2]) / h**2
    return out
