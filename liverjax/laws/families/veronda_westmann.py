"""Veronda-Westmann: an exponential of the first invariant, and a linear term in the second invariant."""

from typing import ClassVar

import jax.numpy as jnp

from liverjax.core.struct import Number, param, static, struct
from liverjax.laws.base import Law


@struct
class VerondaWestmann(Law):
    """W = c1 (exp(c2 (Ibar1 - 3)) - 1) - c1 c2/2 (Ibar2 - 3) + U(J).

    Veronda and Westmann 1970. In Table 1 of the book chapter, the second term does not have the unit of an energy.
    """

    c1: Number = param("Pa", "scale of the exponential", above=0.0, typical=350.0)
    c2: Number = param("1", "exponent", above=0.0, typical=2.2)
    bulk: Number = param("Pa", "bulk modulus", above=0.0, typical=7700.0)
    volumetric: str = static(default="quadratic", about="quadratic, log or simo")
    invariants: ClassVar = ("I1", "I2", "J")

    def isochoric_energy(self, I1, I2):
        """Return the energy, computed with expm1 so that there is no cancellation at rest."""
        return self.c1 * jnp.expm1(self.c2 * (I1 - 3)) - 0.5 * self.c1 * self.c2 * (I2 - 3)

    def isochoric_derivatives(self, I1, I2):
        """Return the derivatives W_1 = c1 c2 e, W_2 = -c1 c2/2 and W_11 = c1 c2^2 e, with e = exp(c2 (Ibar1 - 3))."""
        product = self.c1 * self.c2
        slope = product * jnp.exp(self.c2 * (I1 - 3))
        return {"I1": slope, "I2": -0.5 * product}, {("I1", "I1"): self.c2 * slope}

    def shear_modulus(self):
        """Return the ground-state shear modulus c1 c2 [Pa]."""
        return self.c1 * self.c2
