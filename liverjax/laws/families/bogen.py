"""Bogen: one power of the principal stretches.

The chapter's Table 1 prints "- 1" instead of "- 3". With "- 1" the energy at rest would not be 0.
"""

from typing import ClassVar

from liverjax.core.struct import Number, param, static, struct
from liverjax.laws.base import Law


@struct
class Bogen(Law):
    """W = mu/alpha (Xi(alpha) - 3) + U(J).

    Chapter, Table 1 (with - 3 instead of - 1); Bogen 1987. It is one term of Ogden's law.
    """

    mu: Number = param("Pa", "mu; it must have alpha's sign for a stable law", typical=400.0)
    alpha: Number = param("1", "exponent", nonzero=True, typical=4.0)
    bulk: Number = param("Pa", "bulk modulus", above=0.0, typical=7700.0)
    volumetric: str = static(default="quadratic", about="quadratic, log or simo")
    invariants: ClassVar = ("stretches", "J")

    def exponents(self):
        """The exponent alpha."""
        return (self.alpha,)

    def stretch_energy(self, X):
        """mu/alpha X."""
        return self.mu / self.alpha * X

    def stretch_derivatives(self, X):
        """First derivative mu/alpha; the second is 0."""
        return (self.mu / self.alpha,), {}

    def shear_modulus(self):
        """mu alpha / 2 [Pa]."""
        return self.mu * self.alpha / 2
