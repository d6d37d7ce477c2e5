"""A rigid indenter on an elastic half-space: small strains, no friction, no adhesion.

Sources: Hertz 1882, J. Reine Angew. Math. 92:156 (the sphere); Sneddon 1965, Int. J. Eng. Sci. 3:47 (cone and punch).
"""

from typing import NamedTuple

import numpy as np

from liverjax.core.errors import InputError

SHAPES = ("sphere", "cone", "punch")


class Indenter(NamedTuple):
    """An indenter on a layer. `half_space` does not use the thickness."""

    shape: str  # one of `SHAPES`
    thickness: float  # [m]
    poisson: float
    radius: float = 0.0  # radius [m] of sphere or punch
    half_angle: float = 45.0  # [deg] angle of the cone between axis and side


def half_space(rig: Indenter, depth: np.ndarray) -> np.ndarray:
    """Return the force [N] for a Young's modulus of 1 Pa at depths [m] (formulas of Hertz and Sneddon). The force is 0
    before contact.

    Raises:
        InputError: the shape of the indenter is not known.
    """
    if rig.shape not in SHAPES:
        raise InputError(f"shape = {rig.shape!r} is not known: use {', '.join(SHAPES)}")
    depth, plane = np.maximum(depth, 0.0), 1 / (1 - rig.poisson**2)
    if rig.shape == "sphere":
        return 4 / 3 * plane * np.sqrt(rig.radius) * depth**1.5
    if rig.shape == "cone":
        return 2 / np.pi * plane * np.tan(np.deg2rad(rig.half_angle)) * depth**2
    return 2 * plane * rig.radius * depth
