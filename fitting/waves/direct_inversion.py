"""The usual direct inversion of waves (algebraic Helmholtz inversion), for comparison with the balance of forces.

Where the modulus G is uniform, the curl q of the displacement fulfils G laplace(q) = - density omega^2 q. The pressure
does not occur in this equation. Least squares over the three components and a window of voxels give

    G = - density omega^2 sum(conj(laplace q) q) / sum(|laplace q|^2)

(Oliphant et al. 2001, Magn. Reson. Med. 45, 299; Papazoglou et al. 2008, Phys. Med. Biol. 53, 3147). The denominator
contains the square of the noise of laplace(q), so noise makes the modulus too small. In a window that contains an edge,
the moduli of both sides are mixed. Both errors of the method are well known, and are not corrected here.
"""

import math

import numpy as np
from scipy import ndimage

from fitting.waves.wave_field import WaveField
from liverjax.core.errors import InputError

#: Standard deviation of the Gaussian that smooths displacements before they are differentiated [voxels].
SMOOTHING = 1.0
#: Side of the window of voxels for the least-squares fit [voxels].
WINDOW = 3


def invert(field: WaveField, density: float, smoothing: float = SMOOTHING, window: int = WINDOW) -> np.ndarray:
    """Return the complex modulus (F, nx, ny, nz) [Pa] at F frequencies. The modulus is NaN outside the mask, and also
    near the edge of the mask, where derivatives or smoothing would need voxels outside the mask.

    Args:
        field: measured waves. If not all three components are measured, the result is NaN everywhere.
        density: [kg/m^3].
        smoothing: standard deviation of the Gaussian [voxels]. An axis that is too short for the Gaussian is not
            smoothed.
        window: side of the window of the least-squares fit [voxels], an odd number.
    """
    if not density > 0 or window < 1 or window % 2 == 0 or smoothing < 0:
        raise InputError(
            f"density = {density:g}, smoothing = {smoothing:g}, window = {window}: density must be above 0, smoothing "
            "must be 0 or more, and window must be odd"
        )
    omega = 2 * np.pi * field.frequencies
    ratios = [_one(field, U, smoothing, window) for U in field.displacement]
    return -density * omega[:, None, None, None] ** 2 * np.stack(ratios)


def _one(field: WaveField, U: np.ndarray, smoothing: float, window: int) -> np.ndarray:
    inside = field.mask & np.all(np.isfinite(U), axis=-1)
    # The first and the second derivative each use one voxel more on each side; the Gaussian uses 3 standard deviations.
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
    """Return u, smoothed by a Gaussian. Only voxels in the mask `inside` are used. `widths`: standard deviation of the
    Gaussian along each axis [voxels]."""
    known = np.where(inside, u, 0.0)
    if not any(widths):
        return known
    weight = ndimage.gaussian_filter(inside.astype(float), widths)
    sums = ndimage.gaussian_filter(known.real, widths) + 1j * ndimage.gaussian_filter(known.imag, widths)
    return sums / np.maximum(weight, 1e-12)


def _second(q: np.ndarray, axis: int, h: float) -> np.ndarray:
    """Return the second derivative of q along an axis, from differences with the spacing h. The result is 0 at the ends
    of the axis."""
    out = np.zeros_like(q)
    rows, to = np.moveaxis(q, axis, 0), np.moveaxis(out, axis, 0)
    to[1:-1] = (rows[2:] - 2 * rows[1:-1] + rows[:-2]) / h**2
    return out
