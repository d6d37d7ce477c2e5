"""Inertia of a cylinder in oscillating torsion, in closed form: how it changes the modulus that a rheometer measures.

Shear waves run along the axis, with the wave number k = omega sqrt(rho/G*). The torque at the turning plate, divided by
its angle, gives G* k h cot(k h) in place of G* (Schrag 1977, Trans. Soc. Rheol. 21, 399).
"""

import numpy as np

from fitting.methods.host import Array, arrays_of
from fitting.readers.frequency_sweep import Sweep
from liverjax.core.errors import InputError

#: Maximum |k h| up to which the inertia is subtracted. At pi/2 the sample alone is in resonance, and its measured
#: storage modulus is 0. At pi, its measured modulus is infinite.
MOST = 2.5
#: If the inertia changes the modulus by more than this part, a note gives the change.
WORTH_A_NOTE = 0.001


def shown(G: Array, omega: Array, density: float, height: float) -> Array:
    """The modulus (n,) [Pa] that a rheometer measures on a sample of complex modulus G (n,) [Pa], in NumPy or JAX.

    Args:
        G: complex modulus (n,) [Pa].
        omega: angular frequency (n,) [rad/s].
        density: of the sample [kg/m^3]; of a compressed one `fitting.rigs.compression.torsional_density`.
        height: of the sample [m].
    """
    xp = arrays_of(G)
    x = omega * height * xp.sqrt(density / G)
    return G * x / xp.tan(x)


def rate_in_steps(omega: Array, steps: int) -> Array:
    """The frequency (n,) [rad/s] whose square multiplies the inertia in a steady cycle of Newmark's average
    acceleration method."""
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
    """The sweep with the moduli of the sample, from measured moduli that contain the inertia. A note gives the largest
    change.

    Raises:
        InputError: at one frequency, no positive modulus is left without the inertia.
    """
    seen = sweep.storage + 1j * sweep.loss
    G = modulus_of(seen, sweep.angular_frequency, density, height)
    hertz = sweep.angular_frequency / (2 * np.pi)
    lost = np.flatnonzero(~(np.isfinite(G) & (G.real > 0) & (G.imag > 0)))
    if lost.size:
        raise InputError(
            f"{sweep.source or 'sweep'}: at {hertz[lost[0]]:.3g} Hz the sample has more inertia than modulus: leave "
            "such frequencies out by --max-frequency, or check --density and --height"
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
    """The sweep as a rheometer measures it: the inverse of `taken_off`, without the note."""
    seen = shown(sweep.storage + 1j * sweep.loss, sweep.angular_frequency, density, height)
    return sweep._replace(storage=seen.real, loss=seen.imag)
