"""Fung-Demiray: an exponential of the first invariant."""

from typing import ClassVar

import jax.numpy as jnp

from liverjax.core.struct import Number, param, static, struct
from liverjax.laws.base import Law


@struct
class FungDemiray(Law):
    """W = c1/(2 c2) (exp(c2 (Ibar1 - 3)) - 1) + U(J).

    Book chapter, Table 1; Demiray 1972.
    """

    c1: Number = param("Pa", "ground-state shear modulus", above=0.0, typical=770.0)
    c2: Number = param("1", "exponent", above=0.0, typical=1.0)
    bulk: Number = param("Pa", "bulk modulus", above=0.0, typical=7700.0)
    volumetric: str = static(default="quadratic", about="quadratic, log or simo")
    invariants: ClassVar = ("I1", "J")

    def isochoric_energy(self, I1, I2):
        """Return the energy, computed with expm1 so that there is no cancellation at rest."""
        return 0.5 * self.c1 / self.c2 * jnp.expm1(self.c2 * (I1 - 3))

    def isochoric_derivatives(self, I1, I2):
        """Return dW/dIbar1 = (c1/2) e and d2W/dIbar1^2 = (c1 c2/2) e, with e = exp(c2 (Ibar1 - 3))."""
        slope = 0.5 * self.c1 * jnp.exp(self.c2 * (I1 - 3))
        return {"I1": slope}, {("I1", "I1"): self.c2 * slope}

    def shear_modulus(self):
        """Return the ground-state shear modulus c1 [Pa]."""
        return self.c1
