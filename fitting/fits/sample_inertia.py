"""Inertia of a cylinder in oscillating torsion or tension, in closed form. This inertia changes the modulus that an
instrument measures.

Shear waves run along the axis of the sample, with the wave number k = omega sqrt(rho/G*) for the angular frequency
omega and the density rho. A rheometer divides the torque at the turning plate by the angle of this plate. So it
measures G* k h cot(k h) instead of G*, for the sample height h (Schrag 1977, Trans. Soc. Rheol. 21, 399).

In tension, the same formula is valid for Young's modulus 3 G* of a slender sample, with the wave number omega
sqrt(rho/3G*). So the formula for torsion, with a third of the density, gives the G* of tension.
"""

import numpy as np

from fitting.methods.host import Array, arrays_of
from fitting.readers.frequency_sweep import Sweep
from liverjax.core.errors import InputError

#: The inertia is subtracted only if |k h| is below this value, for the wave number k and the height h of the sample. At
#: |k h| = pi/2, the sample is in resonance, and its measured storage modulus is 0. At |k h| = pi, its measured modulus
#: is infinite.
MOST = 2.5
#: If the inertia changes the modulus by more than this fraction, a note gives the change.
WORTH_A_NOTE = 0.001


def shown(G: Array, omega: Array, density: float, height: float) -> Array:
    """Return the complex modulus (n,) [Pa] that a rheometer measures at n frequencies on a sample with the true complex
    modulus G, in NumPy or JAX.

    Args:
        G: complex modulus (n,) [Pa].
        omega: angular frequency (n,) [rad/s].
        density: density of the sample [kg/m^3]; for a compressed sample, `fitting.rigs.compression.torsional_density`.
        height: height of the sample [m].
    """
    xp = arrays_of(G)
    x = omega * height * xp.sqrt(density / G)
    return G * x / xp.tan(x)


def rate_in_steps(omega: Array, steps: int) -> Array:
    """Newmark's average acceleration method computes a steady cycle in `steps` time steps. Return the angular frequency
    (n,) [rad/s] that replaces omega in the inertial forces of this cycle."""
    half = np.pi / steps
    return np.tan(half) / half * omega


def modulus_of(seen: np.ndarray, omega: np.ndarray, density: float, height: float) -> np.ndarray:
    """Return the true complex modulus (n,) [Pa] of a sample with the measured complex modulus `seen` (n,) [Pa].
    Newton's method inverts `shown`.

    The modulus is NaN at frequencies where |k h| (module docstring) is above `MOST` or Newton's method did not
    converge.
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


def _as_in_torsion(sweep: Sweep, density: float) -> float:
    """Return the density for the formulas of torsion: with it, they describe the inertia in the test of the sweep."""
    if sweep.load == "bending":
        raise InputError(
            f"{sweep.source or 'sweep'}: the moduli are of bending, where the inertia of the sample is not known: "
            "remove --density"
        )
    return density / 3 if sweep.tensile else density


def taken_off(sweep: Sweep, density: float, height: float) -> Sweep:
    """Return the sweep with the true moduli of the sample. The measured moduli contain the effect of the inertia, which
    this function subtracts. A note gives the largest change.

    Raises:
        InputError: at some frequency, no modulus can be computed, or G' or G'' without the inertia is not positive; or
            the moduli were measured in bending.
    """
    seen = sweep.storage + 1j * sweep.loss
    G = modulus_of(seen, sweep.angular_frequency, _as_in_torsion(sweep, density), height)
    hertz = sweep.angular_frequency / (2 * np.pi)
    lost = np.flatnonzero(~(np.isfinite(G) & (G.real > 0) & (G.imag > 0)))
    if lost.size:
        raise InputError(
            f"{sweep.source or 'sweep'}: at {hertz[lost[0]]:.3g} Hz the inertia of the sample is too large to compute "
            "the modulus; exclude such frequencies with --max-frequency, or check --density and --height"
        )
    change = np.abs(G / seen - 1)
    k, notes = int(change.argmax()), sweep.notes
    if change[k] > WORTH_A_NOTE:
        notes = (
            *notes,
            f"the inertia of the sample, {1e3 * height:.3g} mm high, is subtracted, which changes the modulus by up to "
            f"{100 * change[k]:.2g} % (at {hertz[k]:.3g} Hz)",
        )
    return sweep._replace(storage=G.real, loss=G.imag, notes=notes)


def put_back(sweep: Sweep, density: float, height: float) -> Sweep:
    """Return the sweep with the moduli that the instrument measures, which contain the effect of the inertia. This is
    the inverse of `taken_off`, but it adds no note."""
    density = _as_in_torsion(sweep, density)
    seen = shown(sweep.storage + 1j * sweep.loss, sweep.angular_frequency, density, height)
    return sweep._replace(storage=seen.real, loss=seen.imag)
