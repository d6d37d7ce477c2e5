"""Exact motion of plane shear waves that meet stiff cylinders, in an unbounded incompressible medium (NumPy, SciPy).

The motion is in the plane: u = grad(phi) + curl(psi e_z). On both sides, phi is harmonic and psi satisfies Helmholtz's
equation (Ewing, Jardetzky and Press 1957, Elastic Waves in Layered Media, chapter 2). Outside, the solution consists of
the plane waves and of outgoing modes about every cylinder. Inside, the modes are regular. Motion and traction are
continuous at points of the circles, in the sense of least squares. No code of this project is imported.
"""

from typing import NamedTuple

import numpy as np
from scipy.special import h2vp, hankel2, jv, jvp

#: Modes -MODES to MODES about every cylinder, and number of points on its circle.
MODES, POINTS = 18, 80
KINDS = ("phi outside", "psi outside", "phi inside", "psi inside")
#: Angle of the direction of propagation [rad], and amplitude [m].
Wave = tuple[float, complex]


class Medium(NamedTuple):
    """Complex shear moduli inside and outside the cylinders at one angular frequency [rad/s], and density."""

    outside: complex  # [Pa]
    inside: complex  # [Pa]
    omega: float
    density: float

    def number(self, outside: bool) -> complex:
        """Return the wave number [1/m]."""
        return self.omega * np.sqrt(self.density / (self.outside if outside else self.inside))


class Mode(NamedTuple):
    """A function proportional to exp(i n t), with the angle t about a cylinder."""

    cylinder: int
    kind: str
    n: int

    @property
    def outside(self) -> bool:
        """Whether the mode is a motion of the medium around the cylinder."""
        return self.kind.endswith("outside")


def motion(
    points: np.ndarray, cylinders: list[tuple[tuple[float, float], float]], medium: Medium, waves: list[Wave]
) -> np.ndarray:
    """Return the motion (n, 2) at points (n, 2) [m].

    Args:
        points: positions.
        cylinders: centre and radius of each cylinder [m].
        medium: moduli outside and inside.
        waves: angle of the direction [rad] and amplitude at the origin [m] of each wave; polarised perpendicular to it.

    Raises:
        ValueError: the jump of motion or traction is above a millionth.
    """
    modes = [
        Mode(c, kind, n)
        for c in range(len(cylinders))
        for kind in KINDS
        for n in range(-MODES, MODES + 1)
        if (kind, n) != ("phi outside", 0)
    ]
    blocks, arriving, scale = [], [], medium.omega * np.sqrt(medium.density * abs(medium.outside))
    for j, (centre, radius) in enumerate(cylinders):
        t = 2 * np.pi * (np.arange(POINTS) + 0.5) / POINTS
        normal = np.stack([np.cos(t), np.sin(t)], axis=-1)
        on = np.array(centre) + radius * normal
        block = np.zeros((4 * POINTS, len(modes)), complex)
        for column, mode in enumerate(modes):
            if mode.outside or mode.cylinder == j:
                sign = 1 if mode.outside else -1
                block[:, column] = sign * _flat(_mode(mode, on, cylinders, medium), normal, scale)
        blocks.append(block)
        arriving.append(sum(size * _flat(_plane(angle, on, medium), normal, scale) for angle, size in waves))
    A, b = np.concatenate(blocks), -np.concatenate(arriving)
    amplitudes = np.linalg.lstsq(A, b, rcond=1e-14)[0]
    if np.abs(A @ amplitudes - b).max() > 1e-6 * np.abs(b).max():
        raise ValueError("the cylinders are too near each other, or too large, for so few modes: take more")
    inside = np.array([np.hypot(*(points - np.array(c)).T) < a for c, a in cylinders])
    out = sum(size * _plane(angle, points, medium)[0] for angle, size in waves)
    out = np.where(inside.any(axis=0)[:, None], 0, out)
    for amplitude, mode in zip(amplitudes, modes, strict=True):
        place = ~inside.any(axis=0) if mode.outside else inside[mode.cylinder]
        if place.any():
            out[place] += amplitude * _mode(mode, points[place], cylinders, medium)[0]
    return out


def _flat(both: tuple[np.ndarray, np.ndarray], normal: np.ndarray, scale: float) -> np.ndarray:
    u, stress = both
    return np.concatenate([u.ravel(), (np.einsum("nij,nj->ni", stress, normal) / scale).ravel()])


def _plane(angle: float, points: np.ndarray, medium: Medium) -> tuple[np.ndarray, np.ndarray]:
    k, n = medium.number(True), np.array([np.cos(angle), np.sin(angle)])
    a, phase = np.array([-n[1], n[0]]), np.exp(-1j * k * (points @ n))
    stress = -1j * k * medium.outside * (np.outer(a, n) + np.outer(n, a))
    return phase[:, None] * a, phase[:, None, None] * stress


def _mode(mode: Mode, points: np.ndarray, cylinders: list, medium: Medium) -> tuple[np.ndarray, np.ndarray]:
    """Return motion (n, 2) and stress (n, 2, 2) of a mode with amplitude 1."""
    centre, radius = cylinders[mode.cylinder]
    at, n, G = points - np.array(centre), mode.n, medium.outside if mode.outside else medium.inside
    r, t = np.hypot(*at.T), np.arctan2(at[:, 1], at[:, 0])
    if mode.kind.startswith("phi"):
        power = -abs(n) if mode.outside else abs(n)
        f = (r / radius) ** power
        ur, ut = power / r * f, 1j * n / r * f
        urr, utr = power * (power - 1) / r**2 * f, 1j * n * (power - 1) / r**2 * f
        p = medium.density * medium.omega**2 * f
    else:
        k, (kind, slope) = medium.number(mode.outside), (hankel2, h2vp) if mode.outside else (jv, jvp)
        size = kind(n, k * radius)
        f, df = kind(n, k * r) / size, k * slope(n, k * r) / size
        ddf = -df / r - (k**2 - n**2 / r**2) * f
        ur, ut, p = 1j * n / r * f, -df, 0.0
        urr, utr = 1j * n * (df / r - f / r**2), -ddf
    rr, tt = -p + 2 * G * urr, -p + 2 * G * (1j * n * ut + ur) / r
    rt = G * (1j * n * ur / r + utr - ut / r)
    R = np.stack([np.stack([np.cos(t), -np.sin(t)], -1), np.stack([np.sin(t), np.cos(t)], -1)], 1)
    turn = np.exp(1j * n * t)
    u = np.einsum("nij,nj->ni", R, np.stack([ur, ut], -1) * turn[:, None])
    stress = np.stack([np.stack([rr, rt], -1), np.stack([rt, tt], -1)], 1) * turn[:, None, None]
    return u, np.einsum("nia,nab,njb->nij", R, stress, R)
