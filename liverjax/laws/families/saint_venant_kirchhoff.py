"""Saint Venant-Kirchhoff: a quadratic energy of Green's strain."""

from typing import ClassVar

from liverjax.core.struct import Number, param, struct
from liverjax.laws.base import Law


@struct
class SaintVenantKirchhoff(Law):
    """W = lambda/2 (tr E)^2 + mu tr E^2.

    Book chapter, Table 1. With tr E = (I1 - 3)/2 and tr E^2 = (I1^2 - 2 I2 - 2 I1 + 3)/4, the energy does not depend on
    J. The law softens and collapses in compression (stretch below about 0.6).
    """

    mu: Number = param("Pa", "second Lame coefficient, the shear modulus", above=0.0, typical=770.0)
    lame_lambda: Number = param("Pa", "first Lame coefficient", lower=0.0, typical=7000.0)
    invariants: ClassVar = ("I1", "I2")

    def strain_energy(self, I):
        """Return the complete energy as a function of I1 - 3 and I2 - 3, so that there is no cancellation at rest."""
        a, b = I.I1 - 3, I.I2 - 3
        return self.lame_lambda / 8 * a * a + self.mu / 4 * (a * a + 4 * a - 2 * b)

    def energy_derivatives(self, I):
        """Return the derivatives W_1 = lambda/4 (I1 - 3) + mu/2 (I1 - 1), W_2 = -mu/2 and W_11 = lambda/4 + mu/2."""
        first = {"I1": 0.25 * self.lame_lambda * (I.I1 - 3) + 0.5 * self.mu * (I.I1 - 1), "I2": -0.5 * self.mu}
        return first, {("I1", "I1"): 0.25 * self.lame_lambda + 0.5 * self.mu}

    def shear_modulus(self):
        """Return the ground-state shear modulus mu [Pa]."""
        return self.mu

    def bulk_modulus(self):
        """Return the ground-state bulk modulus lambda + 2/3 mu [Pa]."""
        return self.lame_lambda + 2 / 3 * self.mu
