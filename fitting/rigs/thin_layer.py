"""A rigid indenter on an elastic layer that is bonded to a rigid base: small strains, no friction, no adhesion.

There is an exact solution for a layer of any thickness under a punch, a sphere or a cone. Under a pressure with wave
number xi, the surface of a layer of thickness h moves K(xi h) times as much as the surface of a half-space. This gives
one integral equation on the contact circle, which is solved at Gauss points. The force is linear in the modulus, so a
fit needs only one table of force over depth.

Sources: Lebedev and Ufliand 1958, J. Appl. Math. Mech. 22:442; Hayes et al. 1972, J. Biomech. 5:541 (the layer);
Dimitriadis et al. 2002, Biophys. J. 82:2798 (the series).
"""

from functools import lru_cache
from typing import NamedTuple

import numpy as np
import scipy.interpolate

from fitting.rigs.hertz import SHAPES, Indenter, half_space
from liverjax.core.errors import InputError

#: Largest contact radius in a table, divided by the thickness.
WIDEST = 8.0
#: Upper end of integrals over eta = xi h. For larger eta, 1 - K(eta) is below 1e-13 (falling as eta^2 exp(-2 eta)).
_LAST_WAVE = 20.0
#: _WAVES: number of Gauss points over eta. _POINTS: number of Gauss points over the contact radius. _ROWS: number of
#: contact radii in the table.
_WAVES, _POINTS, _ROWS = 160, 48, 48


class Factors(NamedTuple):
    """Table of the force on a layer divided by the force on a half-space at the same depth."""

    reach: (
        np.ndarray
    )  # (n,) ascending from 0: size of the contact on a half-space, divided by the thickness; see `reach`
    factor: np.ndarray  # (n,) force divided by the force on the half-space


def stiffening(eta: np.ndarray, poisson: float) -> np.ndarray:
    """Return 1 - K(eta). K is the surface motion of a bonded layer, divided by the surface motion of a half-space, at
    the wave number eta/h."""
    c = 3 - 4 * poisson
    # All terms are divided by exp(2 eta), so that no hyperbolic function overflows.
    e = np.exp(-2 * eta)
    above = c * (1 - e**2) - 4 * eta * e
    below = c * (1 + e**2) + (4 * eta**2 + 1 + c**2) * e
    return 1 - above / below


def _contact(width: float, poisson: float, shape: str) -> tuple[float, float]:
    """Return depth and force if the contact radius is `width` times the thickness. Both are divided by the values of a
    half-space with the same contact radius."""
    tau, w = np.polynomial.legendre.leggauss(_POINTS)
    # The last point is the edge of the contact. Its weight is 0.
    tau, w = np.append((tau + 1) / 2, 1.0), np.append(w / 2, 0.0)
    eta, v = np.polynomial.legendre.leggauss(_WAVES)
    eta, v = _LAST_WAVE * (eta + 1) / 2, _LAST_WAVE * v / 2
    waves = np.cos(width * np.outer(tau, eta))
    kernel = 2 / np.pi * width * (waves * (v * stiffening(eta, poisson))) @ waves.T
    profile = {"sphere": tau**2, "cone": np.pi / 2 * tau, "punch": 0 * tau}[shape]
    level, dented = np.linalg.solve(np.eye(len(tau)) - kernel * w, np.stack([np.ones_like(tau), profile], axis=1)).T
    if shape == "punch":
        return 1.0, float(w @ level)
    depth = dented[-1] / level[-1]  # at this depth, the pressure at the edge of the contact is 0
    alone = w @ (profile[-1] - profile)
    return float(depth / profile[-1]), float(w @ (depth * level - dented) / alone)


@lru_cache(maxsize=8)  # the table does not depend on the sizes of indenter and layer
def factors(poisson: float, shape: str) -> Factors:
    """Compute the table of force factors for a sphere or a cone, for contact radii from 0 to 8 times the thickness.

    Args:
        poisson: Poisson's ratio of the layer, 0 to 0.5.
        shape: "sphere" or "cone".
    """
    power = {"sphere": 1.5, "cone": 2.0}[shape]
    widths = np.geomspace(1e-3, WIDEST, _ROWS)
    depth, force = np.array([_contact(width, poisson, shape) for width in widths]).T
    size = widths * (np.sqrt(depth) if shape == "sphere" else np.pi / 2 * depth)
    return Factors(np.append(0.0, size), np.append(1.0, force / depth**power))


def punch_factor(radius: float, thickness: float, poisson: float) -> float:
    """Return the force of a flat punch on a layer, divided by its force on a half-space. Hayes et al. tabulate this
    factor.

    Raises:
        InputError: a length is not above 0, the punch is wider than 8 times the thickness, or Poisson's ratio is out of
            range.
    """
    check_indenter(Indenter("punch", thickness, poisson, radius))
    return _contact(radius / thickness, poisson, "punch")[1]


def reach(rig: Indenter, depth: np.ndarray) -> np.ndarray:
    """Return the size of the contact on a half-space, divided by the thickness h: sqrt(R d)/h for a sphere of radius R,
    d tan(angle)/h for a cone."""
    depth = np.maximum(depth, 0.0)
    if rig.shape == "sphere":
        return np.sqrt(rig.radius * depth) / rig.thickness
    return depth * np.tan(np.deg2rad(rig.half_angle)) / rig.thickness


def check_indenter(rig: Indenter) -> None:
    """Check that the force on an indenter can be computed.

    Raises:
        InputError: the shape is not known, a length is not above 0, Poisson's ratio or the angle is out of range, or a
            punch is too wide.
    """
    if rig.shape not in SHAPES:
        raise InputError(f"shape = {rig.shape!r} is not known: use {', '.join(SHAPES)}")
    for name in ("thickness",) if rig.shape == "cone" else ("thickness", "radius"):
        value = getattr(rig, name)
        if not 0 < value < np.inf:
            raise InputError(f"{name} = {value} of the indenter or layer must be above 0: give a length in metres")
    if not 0 <= rig.poisson <= 0.5:
        raise InputError(f"poisson = {rig.poisson} must be from 0 to 0.5: give 0.5 for an incompressible layer")
    if rig.shape == "cone" and not 0 < rig.half_angle < 90:
        raise InputError(
            f"half_angle = {rig.half_angle} of the cone must be between 0 and 90: give the angle in degrees"
        )
    if rig.shape == "punch" and rig.radius > WIDEST * rig.thickness:
        raise InputError(
            f"radius = {rig.radius} m of the punch is over {WIDEST:g} times the thickness: use a smaller punch"
        )


class Layer:
    """Force of an indenter on its layer. The table of forces is computed once, when the object is made.

    Raises:
        InputError: the indenter cannot be computed, or a depth is beyond `deepest`.
    """

    def __init__(self, rig: Indenter) -> None:
        check_indenter(rig)
        self.rig = rig
        if rig.shape == "punch":
            self._punch, self.deepest = punch_factor(rig.radius, rig.thickness, rig.poisson), np.inf
            return
        table = factors(float(rig.poisson), rig.shape)  # arrays cannot be keys of the cache
        self._factor = scipy.interpolate.CubicSpline(table.reach, table.factor)
        unit = reach(rig, np.ones(1))[0]
        #: Largest depth [m] in the table.
        self.deepest = float((table.reach[-1] / unit) ** (2 if rig.shape == "sphere" else 1))

    def force(self, depth: np.ndarray) -> np.ndarray:
        """Return the force [N] for a Young's modulus of 1 Pa, at depths [m] up to `deepest`. The force is 0 before
        contact."""
        largest = float(np.max(depth, initial=0.0))
        if not largest <= self.deepest:
            raise InputError(
                f"depth = {largest:.4g} m is not within the {self.deepest:.4g} m that the table of the layer covers: "
                "remove all deeper points"
            )
        alone = half_space(self.rig, depth)
        return alone * (self._punch if self.rig.shape == "punch" else self._factor(reach(self.rig, depth)))


def series(chi: np.ndarray, poisson: float) -> np.ndarray:
    """Return the force of a sphere, divided by its force on a half-space, for small chi = sqrt(R d)/h (radius R, depth
    d, thickness h). The series has terms up to chi^3. It is derived from the integral equation of this file."""
    eta, v = np.polynomial.legendre.leggauss(_WAVES)
    eta, v = _LAST_WAVE * (eta + 1) / 2, _LAST_WAVE * v / 2
    missing = v * stiffening(eta, poisson)
    c, b = 2 / np.pi * np.sum(missing), np.sum(missing * eta**2) / np.pi
    return 1 + c * chi + 7 / 6 * c**2 * chi**2 + (40 / 27 * c**3 - 8 / 15 * b) * chi**3


def dimitriadis(chi: np.ndarray) -> np.ndarray:
    """Return the force of a sphere on an incompressible layer, divided by its force on a half-space, for small chi =
    sqrt(R d)/h (radius R, depth d, thickness h). The formula is from Dimitriadis et al. (equation 12)."""
    return 1 + 1.133 * chi + 1.283 * chi**2 + 0.769 * chi**3 + 0.0975 * chi**4
