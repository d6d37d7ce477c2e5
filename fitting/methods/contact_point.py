"""Fit the modulus and the contact point of a force-depth curve, if the force is proportional to the modulus.

The force is F = E f(d - d0) at depth d, with the modulus E, the contact point d0 and the force f per unit modulus.
Before contact, F = 0. A straight base line may be added. For a given d0, the force is linear in all other unknowns. So
only d0 is searched, first on a grid, then between its points (variable projection; Golub and Pereyra 1973).
"""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
import scipy.optimize
import scipy.special

from fitting.methods.estimate import errors_and_correlation
from fitting.methods.noise.alike_noise import Alike, along_rows
from fitting.methods.noise.uneven_noise import uneven_root

_GRID = 200
#: The contact point is searched up to BEFORE times the range of the depths before the first depth. If the misfit is
#: smallest at this limit, the search continues up to _FARTHEST_BEFORE times this range.
BEFORE, _FARTHEST_BEFORE = 0.5, 30.0
#: Smallest distance of the contact point from the last depth in the search, divided by the range of the depths.
SHALLOWEST = 1e-3
#: Step of the contact point for a central difference, divided by the range of the depths.
_NEIGHBOUR = 1e-5
#: If the noise, divided by the largest fitted force, is below this value, the residuals are roundoff.
_NOISELESS = 1e-7


class ContactFit(NamedTuple):
    """Fitted modulus and contact point. Their standard errors are valid for noise that has the same size at all points,
    that grows with the force, or that is correlated between neighbouring points."""

    modulus: float  # E [Pa]
    contact_point: float  # d0 [m]
    standard_errors: np.ndarray  # (2,) of modulus [Pa] and contact point [m]
    correlation: float
    noise: float  # standard deviation of the force [N]
    residuals: np.ndarray  # (n,) [N]
    before: int  # number of points before contact
    offset: float = 0.0  # force reading without contact [N]
    offset_error: float = 0.0
    tilt: float = 0.0  # rise of the base line from the smallest to the largest depth [N]
    tilt_error: float = 0.0
    independent: float | None = None  # equivalent number of independent points; None: all points

    @property
    def quantile(self) -> float:
        """Quantile of Student's t for a 95 % interval."""
        points = len(self.residuals) if self.independent is None else self.independent
        unknowns = 2 + (self.offset_error > 0) + (self.tilt_error > 0)
        return float(scipy.special.stdtrit(max(1.0, points - unknowns), 0.975))


#: Kinds of base line (force without contact), with 0, 1 and 2 unknowns.
BASES = ("zero", "constant", "line")


def fit_contact(
    depth: np.ndarray,
    force: np.ndarray,
    unit_force: Callable[[np.ndarray], np.ndarray],
    base: str = "zero",
    deepest: float = np.inf,
) -> ContactFit:
    """Fit modulus and contact point by least squares of the force.

    Args:
        depth: (n,) [m].
        force: (n,) [N].
        unit_force: function that returns the force per unit modulus (n,) [N/Pa] for depths (n,) [m] that are measured
            from the contact point. Before contact, these depths are negative.
        base: model of the force without contact: "zero", "constant" (unknown offset of the sensor) or "line" (the
            sensor also drifts).
        deepest: largest depth [m] from the contact point for which `unit_force` is known. Contact points that give a
            larger depth are not tried. `deepest` must be larger than twice `SHALLOWEST` times the range of the depths.
    """
    span = float(np.ptp(depth))
    h = _NEIGHBOUR * span
    line = np.stack([np.ones(len(depth)), (depth - depth.mean()) / span], axis=1)[:, : BASES.index(base)]

    def linear(start: float) -> tuple[np.ndarray, np.ndarray]:
        f = unit_force(depth - start)
        size = max(float(np.linalg.norm(f)), 1e-300)
        A = np.column_stack([f / size, line])
        numbers = np.linalg.lstsq(A, force, rcond=None)[0]
        numbers[0] /= size
        return numbers, np.column_stack([f, line])

    def misfit(start: float) -> float:
        numbers, A = linear(start)
        return float(np.sum((force - A @ numbers) ** 2))

    low, high = _around_smallest_misfit(depth, depth.max() - deepest + 2 * h, misfit)
    start = float(
        scipy.optimize.minimize_scalar(misfit, bounds=(low, high), method="bounded", options={"xatol": 1e-9 * span}).x
    )
    numbers, A = linear(start)
    E = float(numbers[0])
    slope = (unit_force(depth - start - h) - unit_force(depth - start + h)) / (2 * h)
    # Derivatives with respect to ln E, d0 / span, and the base line's coefficients divided by the largest force.
    J = np.column_stack([A[:, 0] * E, E * slope * span, line * np.abs(force).max()])
    residuals = force - A @ numbers
    noise = float(np.sqrt(residuals @ residuals / (len(force) - J.shape[1])))
    sizes, correlation, alike = _errors_of_any_noise(J, residuals, noise)
    independent = None if alike is None else alike.independent
    # The two pairs are (offset, tilt) and their errors. A term that the chosen base line does not have is 0.
    (offset, tilt), (offset_error, tilt_error) = (
        np.append(v, np.zeros(2))[:2] for v in (numbers[1:], sizes[2:] * np.abs(force).max())
    )
    before = int(np.sum(depth <= start))
    errors = sizes[:2] * np.array([abs(E), span])  # E is negative if the force falls with the depth
    bases = float(offset), float(offset_error), float(tilt), float(tilt_error)
    return ContactFit(E, start, errors, correlation, noise, residuals, before, *bases, independent)


def _around_smallest_misfit(depth: np.ndarray, limit: float, misfit: Callable[[float], float]) -> tuple[float, float]:
    """Return two contact points [m] between which the misfit is smallest. No contact point before `limit` [m] is tried.

    The contact point may lie before the first measured depth, but not after the last one.
    """
    first, span = float(depth.min()), float(np.ptp(depth))
    grid = np.linspace(max(first - BEFORE * span, limit), depth.max() - SHALLOWEST * span, _GRID)
    misfits = [misfit(start) for start in grid]
    farthest = max(first - _FARTHEST_BEFORE * span, limit)
    if np.argmin(misfits) == 0 and farthest < grid[0]:
        far = (first - np.geomspace(first - farthest, BEFORE * span, _GRID))[:-1]
        grid, misfits = np.append(far, grid), [*map(misfit, far), *misfits]
    k = int(np.argmin(misfits))
    return float(grid[max(k - 1, 0)]), float(grid[min(k + 1, len(grid) - 1)])


def _errors_of_any_noise(J: np.ndarray, residuals: np.ndarray, noise: float) -> tuple[np.ndarray, float, Alike | None]:
    """Return the standard errors of all unknowns, the correlation of the first two unknowns, and the correlated noise
    of neighbouring points (None: not correlated). Each error is the largest of the errors for several kinds of noise.
    J: derivatives of the force with respect to the unknowns."""
    equal = noise * np.linalg.pinv(J)
    roots = [equal, uneven_root(J, residuals, np.eye(J.shape[1]))]
    alike = None
    if noise > _NOISELESS * np.abs(J[:, 0]).max():  # the residuals are more than roundoff
        alike = along_rows([len(J)], residuals, J, noise, np.linalg.pinv(J))
    if alike is not None:
        roots.append(alike.root)
    errors, correlations = zip(*(errors_and_correlation(root) for root in roots), strict=True)
    largest = int(np.argmax([e[0] for e in errors]))
    return np.max(errors, axis=0), float(correlations[largest][0, 1]), alike


#: _FREE: only this fraction of the depths before the fitted contact point certainly lies before contact, because a tilt
#: of the base line moves the fitted contact point. _FEWEST: minimum number of points in this part.
_FREE, _FEWEST = 0.7, 8
#: A tilt is used only if |tilt| / standard error exceeds _SEEN in a fit of the part before contact, and _CLEAR in the
#: fit of the whole curve.
_SEEN, _CLEAR = 2.0, 4.0
#: The force before contact also counts as constant if it rises or falls by less than this fraction of the offset.
_LEVEL = 0.1


def beyond(fit: ContactFit, depth: np.ndarray, deepest: float) -> bool:
    """Return whether the contact point lies at the limit that `deepest` sets (see `fit_contact`)."""
    return bool(depth.max() - fit.contact_point > deepest - 3 * _NEIGHBOUR * np.ptp(depth))


def fit_with_offset(
    depth: np.ndarray,
    force: np.ndarray,
    unit_force: Callable[[np.ndarray], np.ndarray],
    deepest: float = np.inf,
) -> ContactFit:
    """Fit modulus and contact point. If enough points are before contact, the offset of the sensor is fitted too.

    The zero of a force sensor is never exact. The error of this zero moves the contact point more than the noise does.
    Without points before contact, offset and contact point cannot be distinguished. Then the offset is assumed to be 0.
    Arguments: see `fit_contact`.
    """
    plain, free = (fit_contact(depth, force, unit_force, base, deepest) for base in BASES[:2])
    if free.before < _FEWEST or not free.modulus > 0:
        return plain
    # If the offset is large, the fit without an offset treats it as a contact force, and finds no points before
    # contact. Then the offset is used only if it improves the fit clearly and the force before contact is constant.
    better = np.sum(plain.residuals**2) - np.sum(free.residuals**2) > _CLEAR**2 * free.noise**2
    slope, error = _slope_and_error(depth[depth <= free.contact_point], force[depth <= free.contact_point])
    before = depth[depth <= free.contact_point]
    flat = abs(slope) < max(_SEEN * error, _LEVEL * abs(free.offset) / max(float(np.ptp(before)), 1e-300))
    return free if plain.before >= _FEWEST or (better and flat) else plain


def _slope_and_error(depth: np.ndarray, force: np.ndarray) -> tuple[float, float]:
    """Return the slope [N/m] of a straight line fitted to force over depth, and the standard error of this slope."""
    x, y = depth - depth.mean(), force - force.mean()
    square = max(float(x @ x), 1e-300)
    slope = float(x @ y / square)
    return slope, float(np.sqrt(np.sum((y - slope * x) ** 2) / max(len(x) - 2, 1) / square))


def fit_without_tilt(
    depth: np.ndarray,
    force: np.ndarray,
    unit_force: Callable[[np.ndarray], np.ndarray],
    plain: ContactFit,
    deepest: float = np.inf,
) -> ContactFit | None:
    """Fit the curve with a tilted base line if the force rises or falls before contact and the fit of the whole curve
    confirms this tilt. Otherwise return None.

    Args:
        depth, force, unit_force, deepest: see `fit_contact`.
        plain: fit without a tilt of the base line.
    """
    free = depth < depth.min() + _FREE * (plain.contact_point - depth.min())
    if free.sum() < _FEWEST or not np.ptp(depth[free]) > 0:
        return None
    slope, error = _slope_and_error(depth[free], force[free])
    level = fit_contact(depth, force, unit_force, "line", deepest)
    seen = abs(slope) > _SEEN * error and slope * level.tilt > 0
    return level if seen and abs(level.tilt) > _CLEAR * level.tilt_error else None
