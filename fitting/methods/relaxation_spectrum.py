"""A spectrum on a fixed grid of relaxation times. Strengths are not negative, and they are smooth where the data say
nothing.

For fixed times the moduli are linear in the strengths, so the minimum is the only one. Strengths are measured in the
size of the data at omega = 1 / tau, and their second differences are held down by a weight that the information
criterion chooses. Method: Honerkamp and Weese (1989), Macromolecules 22, with that criterion in place of theirs.
"""

from typing import NamedTuple

import numpy as np

from fitting.methods.generalised_maxwell import non_negative
from fitting.readers.rheometer import Sweep

#: Grids tried [times a decade], decades beyond the band on either side, weights tried.
GRIDS, MARGIN, WEIGHTS = (2, 3), 1.0, np.logspace(-6, 4, 31)
#: Relative standard error below which a strength counts as carried by the data.
CARRIED = 0.5


class GridSpectrum(NamedTuple):
    """Strengths at fixed times, with the weight and the criterion."""

    times: np.ndarray  # (K,) [s], descending; those with a strength above zero
    strengths: np.ndarray  # (K,) [Pa]
    equilibrium: float  # [Pa], 0 for a fluid
    per_decade: int
    smoothing: float  # weight of the second differences
    prior: np.ndarray  # (R, 1 + K): its rows are the penalty, in equilibrium and strengths [1/Pa]
    effective: float  # number of parameters that the data determine
    criterion: float
    decades: float  # of relaxation times whose strengths the data carry


def mode_columns(omega: np.ndarray, times: np.ndarray) -> np.ndarray:
    """Moduli G' then G'' (2n, 1 + K) of an equilibrium modulus and of modes of 1 Pa."""
    x = omega[:, None] * times
    bottom = np.column_stack([np.zeros(len(omega)), x / (1 + x**2)])
    return np.vstack([np.column_stack([np.ones(len(omega)), x**2 / (1 + x**2)]), bottom])


def fit(sweep: Sweep) -> GridSpectrum:
    """The spectrum of lowest criterion over grids and weights."""
    return min((at(sweep, grid, w) for grid in GRIDS for w in WEIGHTS), key=lambda found: found.criterion)


def at(sweep: Sweep, per_decade: int, smoothing: float) -> GridSpectrum:
    """The spectrum of one grid and one weight; a convex problem, solved exactly."""
    omega = sweep.angular_frequency
    low, high = -np.log10(omega[-1]) - MARGIN, -np.log10(omega[0]) + MARGIN
    times = np.logspace(high, low, int(np.ceil((high - low) * per_decade)) + 1)
    size = np.exp(np.interp(-np.log(times), np.log(omega), np.log(np.hypot(sweep.storage, sweep.loss))))
    scales = np.concatenate(sweep.deviations)
    unit = np.concatenate([[sweep.storage.min()], size])
    A = mode_columns(omega, times) * unit / scales[:, None]
    b = np.concatenate([sweep.storage, sweep.loss]) / scales
    L = np.sqrt(smoothing) * np.column_stack([np.zeros(len(times) - 2), np.diff(np.eye(len(times)), 2, axis=0)])
    x, _ = non_negative(np.vstack([A, L]), np.concatenate([b, np.zeros(len(L))]))
    m, free = len(b), x > 1e-10 * x.max()
    r = A @ x - b
    covariance = np.linalg.pinv(A[:, free].T @ A[:, free] + L[:, free].T @ L[:, free])
    effective = float(np.trace(covariance @ A[:, free].T @ A[:, free]))
    mean_square = max(float(r @ r) / m, 1e-300)
    errors = np.full(len(x), np.inf)
    errors[free] = np.sqrt(np.diag(covariance) * float(r @ r) / max(1.0, m - effective))
    carried = (errors[1:] < CARRIED * x[1:]).sum() / per_decade
    kept = free[1:]
    prior = (L / unit)[:, np.concatenate([[True], kept])]
    return GridSpectrum(
        times=times[kept],
        strengths=(x * unit)[1:][kept],
        equilibrium=float(x[0] * unit[0]) if free[0] else 0.0,
        per_decade=per_decade,
        smoothing=float(smoothing),
        prior=prior,
        effective=effective,
        criterion=float(m * np.log(mean_square) + effective * np.log(m)),
        decades=float(carried),
    )
