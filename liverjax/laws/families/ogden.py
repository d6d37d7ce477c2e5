"""Ogden: powers of the principal stretches.

Xi(alpha) = sum_m (J^(-1/3) lambda_m)^alpha, with the principal stretches lambda_m. The arguments X of the methods are
Xi - 3, computed without cancellation at rest.
"""

from collections.abc import Sequence
from typing import ClassVar

from liverjax.core.errors import InputError
from liverjax.core.struct import Array, Number, param, static, struct
from liverjax.laws.base import Law


@struct
class Ogden(Law):
    """W = sum_k mu_k/alpha_k (Xi(alpha_k) - 3) + U(J).

    Book chapter, Table 1; Ogden 1972. Some authors write mu_k/alpha_k^2. The mu_k of these authors is alpha_k times the
    mu_k of this law. The law is stable for every stretch if mu_k alpha_k > 0 for all k.
    """

    mu: Sequence[float] | Array = param("Pa", "mu_k, one for each term", each=True, typical=(700.0, -40.0))
    alpha: Sequence[float] | Array = param(
        "1", "alpha_k, one for each term", nonzero=True, each=True, typical=(2.5, -4.0)
    )
    bulk: Number = param("Pa", "bulk modulus", above=0.0, typical=7700.0)
    volumetric: str = static(default="quadratic", about="quadratic, log or simo")
    invariants: ClassVar = ("stretches", "J")

    def exponents(self):
        """Return the exponents alpha_k."""
        return tuple(self.alpha)

    def stretch_energy(self, *X):
        """Return the energy: the sum of mu_k/alpha_k X_k."""
        return sum(m / a * x for m, a, x in zip(self.mu, self.alpha, X, strict=True))

    def stretch_derivatives(self, *X):
        """Return the first derivatives mu_k/alpha_k. All second derivatives are zero."""
        return tuple(m / a for m, a in zip(self.mu, self.alpha, strict=True)), {}

    def shear_modulus(self):
        """Return the ground-state shear modulus: sum of mu_k alpha_k / 2 [Pa]."""
        return sum(m * a for m, a in zip(self.mu, self.alpha, strict=True)) / 2

    def check(self):
        """Raise `InputError` if mu and alpha have no terms, or different numbers of terms."""
        if len(self.mu) == len(self.alpha) == 0:
            raise InputError("law ogden has no terms (mu = [], alpha = []): give at least one term")
        if len(self.mu) != len(self.alpha):
            raise InputError(
                f"law ogden has {len(self.mu)} values of mu and {len(self.alpha)} values of alpha: give one mu and "
                "one alpha for each term"
            )
