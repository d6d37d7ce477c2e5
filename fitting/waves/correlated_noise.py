"""Estimate the factor by which the errors of moduli are larger for correlated noise than for white noise. "Correlated"
means: correlated between neighbouring voxels.

Scanners and filters smooth the data, so the noise of neighbouring voxels is correlated. Then the data contain fewer
independent values, and the estimate of the noise from fourth differences is too small. The residual motion d - u
(measured minus fitted) shows both effects. The residual is a projection of the noise, so even white noise leaves
residuals with a small negative correlation between neighbours. Therefore simulated noise, white or smoothed, is
projected in the same way. The comparison shows which width of a Gaussian filter gives the observed correlation along
each axis, and which fraction of the noise remains in the residuals.

The error of a modulus is the sum v^H n / H over the voxels, with the noise n, v = C^H S^-1 C' u and H = (C' u)^H S^-1
C' u. The other symbols are explained in `fitting.waves.balance`. So the variance for white noise is multiplied by

    sum_l R(l) sum_x conj(v(x)) v(x + l) / sum_x |v(x)|^2,

where R(l) is the autocorrelation of the noise for two voxels x and x + l.
"""

from typing import NamedTuple

import numpy as np
import scipy.linalg
import scipy.ndimage
import scipy.sparse

from fitting.waves.balance import Balanced

#: WIDTHS: standard deviations [voxels] of the Gaussian filters that are tried. DRAWS: number of random draws for each
#: width in a body of SMALL voxels. In a body of n voxels, this number is DRAWS SMALL / n, but at least 1. REACH: half
#: length of a filter [voxels].
WIDTHS = (0.0, 0.35, 0.45, 0.55, 0.65, 0.75, 0.9, 1.1, 1.4, 1.8)
DRAWS, SMALL, REACH = 6, 1500, 6
#: The noise is regarded as correlated if the correlation of neighbouring residuals exceeds the correlation for white
#: noise by more than SEEN, and by more than BY_CHANCE standard deviations.
SEEN, BY_CHANCE = 0.04, 4.0


class Correlation(NamedTuple):
    """The correlation of the noise at one frequency, estimated from the residuals."""

    beyond: float  # correlation of neighbouring residuals minus its value for white noise; largest of 3 axes
    seen: bool  # whether this difference is larger than expected from white noise
    # (R,) error of each modulus, divided by its error for white noise. The sd of this white noise is the given sd if
    # `seen`, otherwise the sd of the noise itself.
    enlarged: np.ndarray
    level: float = 0.0  # [m] sd of the noise, estimated from the residuals if `seen`; otherwise 0


class _Projection(NamedTuple):
    """Data for the residuals of fits at fixed moduli: the matrix C of the force balance, the most probable motion, and
    the voxels of the nodes."""

    C: scipy.sparse.csr_array
    here: Balanced
    voxel: np.ndarray  # (V, 3)

    @property
    def measured(self) -> int:
        return 3 * len(self.voxel)

    def grid(self, values: np.ndarray) -> np.ndarray:
        """Return nodal values (3 V,) as an array over the voxels (nx, ny, nz, 3), with 0 outside the body."""
        out = np.zeros((*(self.voxel.max(axis=0) + 1), 3), complex)
        out[tuple(self.voxel.T)] = values[: self.measured].reshape(-1, 3)
        return out

    def residual(self, noise: np.ndarray) -> np.ndarray:
        """Return the residuals (nx, ny, nz, 3) if the most probable motion plus `noise` (nx, ny, nz, 3) is fitted."""
        n = np.zeros(self.C.shape[1], complex)
        n[: self.measured] = noise[tuple(self.voxel.T)].ravel()
        q = scipy.linalg.cho_solve_banded((self.here.factor, True), self.C @ n, check_finite=False)
        return self.grid(self.C.conj().T @ q)


def correlation(
    C: scipy.sparse.csr_array, here: Balanced, columns: np.ndarray, d: np.ndarray, sd: float, voxel: np.ndarray
) -> Correlation:
    """Estimate the correlation of the noise from the residuals at the fitted moduli.

    Args:
        C: matrix of the force balance (I, U) at these moduli, with I equations and U unknowns.
        here: the most probable motion.
        columns: derivatives (I, R) of the nodal forces C u with respect to the R moduli.
        d: measured motion (3 V,) [m], x, y, z of a node together.
        sd: assumed standard deviation of real and imaginary part of one component [m].
        voxel: voxel index of each node (V, 3).
    """
    own = _Projection(C, here, voxel - voxel.min(axis=0))
    left = own.grid(d - here.motion[: own.measured])
    seen, draws = _of_neighbours(left), max(1, round(DRAWS * SMALL / len(voxel)))
    rows = [_drawn(own, 0.0, draws)]
    beyond = float(np.max(seen - rows[0][0]))
    if beyond <= max(SEEN, BY_CHANCE / np.sqrt(2 * own.measured)):
        white = np.zeros(3)
        return Correlation(beyond, False, np.array([_enlargement(own, column, white) for column in columns.T]))
    for width in WIDTHS[1:]:
        rows.append(_drawn(own, width, draws))
        if np.mean(rows[-1][0]) > np.max(seen):
            break
    means, parts = np.array([np.mean(r) for r, _ in rows]), np.array([part for _, part in rows])
    widths = np.interp(seen, means, WIDTHS[: len(rows)])
    level = np.sqrt(_mean_square(own, left)) / np.interp(np.mean(seen), means, parts)
    enlarged = level / sd * np.array([_enlargement(own, column, widths) for column in columns.T])
    return Correlation(beyond, True, enlarged, float(level))


def _mean_square(own: _Projection, values: np.ndarray) -> float:
    """Return the mean square of the values' real and imaginary parts over the measured components."""
    return float(np.sum(np.abs(values) ** 2)) / (2 * own.measured)


def _of_neighbours(values: np.ndarray) -> np.ndarray:
    """Return the correlation (3,) between neighbours along each axis, for values (nx, ny, nz, 3)."""
    rows = [np.moveaxis(values, a, 0) for a in range(3)]
    whole = max(float(np.sum(np.abs(values) ** 2)), 1e-300)
    return np.array([np.sum(r[1:].conj() * r[:-1]).real / whole for r in rows])


def _drawn(own: _Projection, width: float, draws: int) -> tuple[np.ndarray, float]:
    """Simulate random noise that is smoothed by a Gaussian with the standard deviation `width` [voxels]. Return the
    correlation (3,) of neighbouring residuals, and the root mean square of the residuals divided by that of the
    noise."""
    rng, shape = np.random.default_rng(0), tuple(own.voxel.max(axis=0) + 1 + 2 * REACH)
    inside = (slice(REACH, -REACH),) * 3
    found, parts = [], []
    for _ in range(draws):
        noise = rng.standard_normal((*shape, 3)) + 1j * rng.standard_normal((*shape, 3))
        if width:
            kernel = _filter(width)
            for axis in range(3):
                noise = scipy.ndimage.convolve1d(noise, kernel, axis=axis)
        noise = noise[inside] / np.sqrt(np.mean(np.abs(noise[inside]) ** 2) / 2)
        left = own.residual(noise)
        found.append(_of_neighbours(left))
        parts.append(np.sqrt(_mean_square(own, left)))
    return np.mean(found, axis=0), float(np.mean(parts))


def _filter(width: float) -> np.ndarray:
    """Return the weights (2 `REACH` + 1,) of a Gaussian filter with this standard deviation [voxels]."""
    weights = np.exp(-0.5 * (np.arange(-REACH, REACH + 1) / width) ** 2)
    return weights / weights.sum()


def _enlargement(own: _Projection, column: np.ndarray, widths: np.ndarray) -> float:
    """Return the error of one modulus for noise smoothed with `widths` (3,) [voxels] along x, y and z, divided by the
    error for white noise with the same standard deviation at each node. Nodes of different parts of the body at the
    same voxel have the same noise."""
    q = scipy.linalg.cho_solve_banded((own.here.factor, True), column, check_finite=False)
    each = (own.C.conj().T @ q)[: own.measured]
    v = np.zeros((*(own.voxel.max(axis=0) + 1), 3), complex)
    np.add.at(v, tuple(own.voxel.T), each.reshape(-1, 3))
    smooth = v
    for axis, width in enumerate(widths):
        if width > 0:
            kernel = _filter(width)
            both = np.correlate(kernel, kernel, "full")  # autocorrelation of the filtered noise
            smooth = scipy.ndimage.convolve1d(smooth, both / both.max(), axis=axis, mode="constant")
    return float(np.sqrt(max(np.sum(v.conj() * smooth).real, 0.0) / max(np.sum(np.abs(each) ** 2), 1e-300)))
