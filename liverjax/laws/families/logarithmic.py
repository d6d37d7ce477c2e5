"""Logarithm of a power of the principal stretches. The energy is infinite at a finite stretch."""

from typing import ClassVar

import jax.numpy as jnp

from liverjax.core.struct import Number, param, static, struct
from liverjax.laws.base import Law


@struct
class Logarithmic(Law):
    """W = -c1 ln(1 - c2 (Xi(alpha) - 3)) + U(J).

    Xi(alpha) = sum_m (J^(-1/3) lambda_m)^alpha, with the principal stretches lambda_m. Book chapter, Table 1. W tends
    to infinity at Xi(alpha) = 3 + 1/c2. There and for larger Xi, W is NaN.
    """

    c1: Number = param("Pa", "scale", above=0.0, typical=1925.0)
    c2: Number = param("1", "1 / (largest Xi - 3)", above=0.0, typical=0.05)
    alpha: Number = param("1", "exponent", nonzero=True, typical=4.0)
    bulk: Number = param("Pa", "bulk modulus", above=0.0, typical=7700.0)
    volumetric: str = static(default="quadratic", about="quadratic, log or simo")
    invariants: ClassVar = ("stretches", "J")

    def exponents(self):
        """Return the exponent alpha."""
        return (self.alpha,)

    def stretch_energy(self, X):
        """Return the energy, computed with log1p so that there is no cancellation at rest. X = Xi(alpha) - 3."""
        return -self.c1 * jnp.log1p(-self._filled(X))

    def _filled(self, X):
        """Return c2 X, or NaN if c2 X is 1 (the pole of the energy) or more."""
        return jnp.where(self.c2 * X < 1, self.c2 * X, jnp.nan)

    def stretch_derivatives(self, X):
        """Return the first and second derivative with respect to X: c1 c2/(1 - c2 X) and c1 c2^2/(1 - c2 X)^2."""
        pole = self.c2 / (1 - self._filled(X))
        return (self.c1 * pole,), {(0, 0): self.c1 * pole * pole}

    def shear_modulus(self):
        """Return the ground-state shear modulus c1 c2 alpha^2 / 2 [Pa]."""
        return self.c1 * self.c2 * self.alpha**2 / 2
