"""Inertia of a cylinder in oscillating torsion, in closed form: what it adds to the modulus that a rheometer shows.

Shear waves run along the axis, with the wave number k = omega sqrt(rho/G*). The torque at the plate that turns, over
its angle, shows G* k h cot(k h) in place of G* (Schrag 1977, Trans. Soc. Rheol. 21, 399).
"""

import numpy as np

from fitting.methods.host import Array, arrays_of
from fitting.readers.frequency_sweep import Sweep
from liverjax.core.errors import InputError

#: Most |k h| at which the inertia is taken off. At pi/2 the sample alone is in resonance and shows no storage modulus;
#: at pi it shows a modulus without bound.
MOST = 2.5
#: Part of the modulus from which a note states the inertia.
WORTH_A_NOTE = 0.001


def shown(G: Array, omega: Array, density: float, height: float) -> Array:
    """The modulus (n,) [Pa] that a rheometer shows of a sample of complex modulus G (n,) [Pa], of NumPy or JAX.

    Args:
        G: complex modulus (n,) [Pa].
        omega: angular frequency (n,) [rad/s].
        density: of the sample [kg/m^3].
        height: of the sample [m].
    """
    xp = arrays_of(G)
    x = omega * height * xp.sqrt(density / G)
    return G * x / xp.tan(x)


def rate_in_steps(omega: Array, steps: int) -> Array:
    """The frequency (n,) [rad/s] whose square inertia has in a steady cycle of Newmark's average accelerations."""
    half = np.pi / steps
    return np.tan(half) / half * omega


def modulus_of(seen: np.ndarray, omega: np.ndarray, density: float, height: float) -> np.ndarray:
    """The complex modulus (n,) [Pa] of a sample that shows `seen`: the inverse of `shown`, by Newton's method.

    NaN where |k h| is above `MOST`.
    """
    G = seen + density * (omega * height) ** 2 / 3
    for _ in range(20):
        x = omega * height * np.sqrt(density / G)
        cot = 1 / np.tan(x)
        slope = x * cot - x / 2 * (cot - x / np.sin(x) ** 2)
        G = G - (G * x * cot - seen) / slope
    good = np.isfinite(G) & (np.abs(omega * height * np.sqrt(density / G)) < MOST)
    good &= np.abs(shown(np.where(good, G, 1.0), omega, density, height) - seen) < 1e-9 * np.abs(seen)
    return np.where(good, G, np.nan)


def taken_off(sweep: Sweep, density: float, height: float) -> Sweep:
    """The sweep of the sample's own moduli, from one with the inertia in it; a note states the largest change.

    Raises:
        InputError: a frequency at which the inertia leaves nothing of the modulus.
    """
    seen = sweep.storage + 1j * sweep.loss
    G = modulus_of(seen, sweep.angular_frequency, density, height)
    hertz = sweep.angular_frequency / (2 * np.pi)
    lost = np.flatnonzero(~(np.isfinite(G) & (G.real > 0) & (G.imag > 0)))
    if lost.size:
        raise InputError(
            f"{sweep.source or 'sweep'}: at {hertz[lost[0]]:.3g} Hz a sample of {density:g} kg/m^3 and {height:g} m "
            "has more inertia than modulus: leave such frequencies out by --max-frequency, or check --density and "
            "--height"
        )
    change = np.abs(G / seen - 1)
    k, notes = int(change.argmax()), sweep.notes
    if change[k] > WORTH_A_NOTE:
        notes = (
            *notes,
            f"the inertia of the sample, {1e3 * height:.3g} mm high, is taken off: it changes the modulus by up to "
            f"{100 * change[k]:.2g} % (at {hertz[k]:.3g} Hz)",
        )
    return sweep._replace(storage=G.real, loss=G.imag, notes=notes)


def put_back(sweep: Sweep, density: float, height: float) -> Sweep:
    """The sweep as a rheometer shows it: the inverse of `taken_off`, without its note."""
    seen = shown(sweep.storage + 1j * sweep.loss, sweep.angular_frequency, density, height)
    return sweep._replace(storage=seen.real, loss=seen.imag)
