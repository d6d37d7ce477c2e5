"""Plane shear waves in a viscoelastic solid: phase velocity and attenuation from the complex modulus, and the modulus
from both.

A wave exp(i omega t - i k z) has k^2 = rho omega^2 / G* and k = omega / c - i alpha, with the density rho, the complex
modulus G*, the phase velocity c and the attenuation alpha (Catheline et al. 2004, J. Acoust. Soc. Am. 116, 3734).
"""

import numpy as np

from liverjax.core.struct import Array, Content, Number

#: Density of soft tissue [kg/m^3], used if no density is given.
DENSITY = 1060.0


def velocity_and_attenuation(storage: Number, loss: Number, omega: Number, density: Number) -> tuple[Array, Array]:
    """Return the phase velocity c [m/s] and the attenuation alpha [1/m] of the amplitude, for n moduli. The arrays may
    be NumPy or JAX arrays.

    Args:
        storage, loss: G' and G'' (n,) [Pa].
        omega: angular frequencies [rad/s].
        density: [kg/m^3].
    """
    size = (storage**2 + loss**2) ** 0.5
    # |G| - G' is computed as G''^2 / (|G| + G'), which has no cancellation error if the loss is small.
    velocity = size * (2 / (density * (size + storage))) ** 0.5
    return velocity, omega * loss * (density / (2 * (size + storage))) ** 0.5 / size


def moduli_of(velocity: Array, attenuation: Array, omega: Array, density: Number) -> tuple[Array, Array]:
    """Return the storage and loss moduli G' and G'' [Pa] from phase velocity [m/s] and attenuation [1/m] (the inverse
    of `velocity_and_attenuation`)."""
    real, imaginary = omega / velocity, attenuation
    square = (real**2 + imaginary**2) ** 2
    scale = density * omega**2 / square
    return scale * (real**2 - imaginary**2), scale * 2 * real * imaginary


def waves_of_moduli(storage: np.ndarray, loss: np.ndarray, omega: np.ndarray, density: float | None) -> Content:
    """Return the entry `shear_waves` of fit.json: velocity and attenuation of waves in a material with the fitted
    moduli (n,) [Pa]."""
    density = DENSITY if density is None else density
    velocity, attenuation = velocity_and_attenuation(storage, loss, omega, density)
    return {
        "density_kg_m3": density,
        "frequency_Hz": (omega / (2 * np.pi)).tolist(),
        "phase_velocity_m_s": velocity.tolist(),
        "attenuation_1_m": attenuation.tolist(),
    }
