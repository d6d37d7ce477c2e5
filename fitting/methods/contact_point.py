"""Modulus and contact point of a force-depth curve whose force is linear in the modulus.

F = E f(d - d0), 0 before contact. For a given contact point d0 the best modulus is a quotient of sums, so the search is
for d0 alone: on a grid, then between grid points (variable projection; Golub and Pereyra 1973).
"""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
import scipy.optimize
import scipy.special

_GRID = 200


class ContactFit(NamedTuple):
    """Modulus and contact point. Their standard errors come from the noise of the residuals."""

    modulus: float  # E [Pa]
    contact_point: float  # d0 [m]
    standard_errors: np.ndarray  # of both (2,)
    correlation: float
    noise: float  # standard deviation of the force [N]
    residuals: np.ndarray  # (n,) [N]
    before: int  # points before contact

    @property
    def quantile(self) -> float:
        """Quantile of Student's t for a 95 % interval."""
        return float(scipy.special.stdtrit(len(self.residuals) - 2, 0.975))


def fit_contact(depth: np.ndarray, force: np.ndarray, unit_force: Callable[[np.ndarray], np.ndarray]) -> ContactFit:
    """Fit modulus and contact point by least squares of the force.

    Args:
        depth: (n,) [m].
        force: (n,) [N].
        unit_force: depths after contact (n,) [m], negative before -> force per unit modulus (n,) [N/Pa].
    """
    span = float(np.ptp(depth))

    def modulus(start: float) -> tuple[float, np.ndarray]:
        f = unit_force(depth - start)
        return float(f @ force / max(float(f @ f), 1e-300)), f

    def misfit(start: float) -> float:
        E, f = modulus(start)
        return float(np.sum((force - E * f) ** 2))

    # The contact may lie before the first point, but not after the last.
    grid = np.linspace(depth.min() - 0.5 * span, depth.max() - 1e-3 * span, _GRID)
    k = int(np.argmin([misfit(start) for start in grid]))
    low, high = grid[max(k - 1, 0)], grid[min(k + 1, _GRID - 1)]
    start = float(
        scipy.optimize.minimize_scalar(misfit, bounds=(low, high), method="bounded", options={"xatol": 1e-9 * span}).x
    )
    E, f = modulus(start)
    h = 1e-5 * span
    slope = (unit_force(depth - start - h) - unit_force(depth - start + h)) / (2 * h)
    J = np.stack([f * E, E * slope * span], axis=1)  # by ln E and by d0 over the span
    residuals = force - E * f
    noise = float(np.sqrt(residuals @ residuals / (len(force) - 2)))
    covariance = noise**2 * np.linalg.pinv(J.T @ J)
    sizes = np.sqrt(np.diag(covariance))
    correlation = float(covariance[0, 1] / max(sizes[0] * sizes[1], 1e-300))
    return ContactFit(E, start, sizes * np.array([E, span]), correlation, noise, residuals, int(np.sum(depth <= start)))
