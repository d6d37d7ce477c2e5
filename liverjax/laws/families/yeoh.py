"""Yeoh: a polynomial of the first invariant."""

from typing import ClassVar

from liverjax.core.struct import Number, param, static, struct
from liverjax.laws.base import Law


@struct
class Yeoh(Law):
    """W = sum_k c_k (Ibar1 - 3)^k + U(J), k = 1 … 3.

    Book chapter, Table 1 (reduced polynomial model).
    """

    c1: Number = param("Pa", "coefficient of (Ibar1 - 3)", above=0.0, typical=385.0)
    c2: Number = param("Pa", "coefficient of (Ibar1 - 3)^2", typical=150.0)
    c3: Number = param("Pa", "coefficient of (Ibar1 - 3)^3", typical=40.0)
    bulk: Number = param("Pa", "bulk modulus", above=0.0, typical=7700.0)
    volumetric: str = static(default="quadratic", about="quadratic, log or simo")
    invariants: ClassVar = ("I1", "J")

    def isochoric_energy(self, I1, I2):
        """Return the energy: a cubic polynomial in Ibar1 - 3, by Horner's rule."""
        a = I1 - 3
        return a * (self.c1 + a * (self.c2 + a * self.c3))

    def isochoric_derivatives(self, I1, I2):
        """Return the first and second derivative: c1 + 2 c2 a + 3 c3 a^2 and 2 c2 + 6 c3 a, with a = Ibar1 - 3."""
        a = I1 - 3
        return {"I1": self.c1 + a * (2 * self.c2 + 3 * self.c3 * a)}, {("I1", "I1"): 2 * self.c2 + 6 * self.c3 * a}

    def shear_modulus(self):
        """Return the ground-state shear modulus 2 c1 [Pa]."""
        return 2 * self.c1
