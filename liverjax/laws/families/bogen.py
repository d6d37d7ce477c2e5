"""Bogen: one power of the principal stretches.

In this energy, Table 1 of the book chapter prints "- 1" instead of "- 3". With "- 1" the energy at rest would not be 0.
"""

from typing import ClassVar

from liverjax.core.struct import Number, param, static, struct
from liverjax.laws.base import Law


@struct
class Bogen(Law):
    """W = mu/alpha (Xi(alpha) - 3) + U(J).

    Xi(alpha) = sum_m (J^(-1/3) lambda_m)^alpha, with the principal stretches lambda_m. Book chapter, Table 1 (with - 3
    instead of - 1); Bogen 1987. This law is one term of Ogden's law.
    """

    mu: Number = param("Pa", "mu; the law is stable only if mu and alpha have the same sign", typical=400.0)
    alpha: Number = param("1", "exponent", nonzero=True, typical=4.0)
    bulk: Number = param("Pa", "bulk modulus", above=0.0, typical=7700.0)
    volumetric: str = static(default="quadratic", about="quadratic, log or simo")
    invariants: ClassVar = ("stretches", "J")

    def exponents(self):
        """Return the exponent alpha."""
        return (self.alpha,)

    def stretch_energy(self, X):
        """Return the energy mu/alpha X with X = Xi(alpha) - 3."""
        return self.mu / self.alpha * X

    def stretch_derivatives(self, X):
        """Return the first derivative mu/alpha. The second derivative is 0."""
        return (self.mu / self.alpha,), {}

    def shear_modulus(self):
        """Return the ground-state shear modulus mu alpha / 2 [Pa]."""
        return self.mu * self.alpha / 2
