"""Exponential of a power of the principal stretches.

In this energy, Table 1 of the book chapter prints "- 1" instead of "- 3". With "- 1" the energy at rest would not be 0.
"""

from typing import ClassVar

import jax.numpy as jnp

from liverjax.core.struct import Number, param, static, struct
from liverjax.laws.base import Law


@struct
class Exponential(Law):
    """W = c1 (exp(c2 (Xi(alpha) - 3)) - 1) + U(J).

    Xi(alpha) = sum_m (J^(-1/3) lambda_m)^alpha, with the principal stretches lambda_m. Source: Table 1 of the book
    chapter, which prints - 1 where this formula has - 3.
    """

    c1: Number = param("Pa", "scale", above=0.0, typical=385.0)
    c2: Number = param("1", "exponent's factor", above=0.0, typical=0.25)
    alpha: Number = param("1", "exponent", nonzero=True, typical=4.0)
    bulk: Number = param("Pa", "bulk modulus", above=0.0, typical=7700.0)
    volumetric: str = static(default="quadratic", about="quadratic, log or simo")
    invariants: ClassVar = ("stretches", "J")

    def exponents(self):
        """Return the exponent alpha."""
        return (self.alpha,)

    def stretch_energy(self, X):
        """Return the energy, computed with expm1 so that there is no cancellation at rest. X = Xi(alpha) - 3."""
        return self.c1 * jnp.expm1(self.c2 * X)

    def stretch_derivatives(self, X):
        """Return the first and second derivative with respect to X: c1 c2 e and c1 c2^2 e, with e = exp(c2 X)."""
        slope = self.c1 * self.c2 * jnp.exp(self.c2 * X)
        return (slope,), {(0, 0): self.c2 * slope}

    def shear_modulus(self):
        """Return the ground-state shear modulus c1 c2 alpha^2 / 2 [Pa]."""
        return self.c1 * self.c2 * self.alpha**2 / 2
