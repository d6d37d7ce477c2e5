"""Laws of the principal stretches: Ogden, Bogen, logarithmic and exponential.

Xi(alpha) = sum_m (J^(-1/3) lambda_m)^alpha; the laws receive X = Xi - 3, which is exact at rest. The chapter's Table 1
prints "- 1" in place of "- 3" for Bogen and the exponential law: then neither energy nor stress would be right at rest.
"""

from typing import Any, ClassVar

import jax.numpy as jnp

from liverjax.core.errors import InputError
from liverjax.core.struct import param, static, struct
from liverjax.laws.base import Law


@struct
class Ogden(Law):
    """W = sum_k mu_k/alpha_k (Xi(alpha_k) - 3) + U(J).

    Chapter, Table 1; Ogden 1972. Others write mu_k/alpha_k^2: their mu_k is alpha_k times the one here. Stable for
    every stretch where each mu_k alpha_k > 0.
    """

    mu: Any = param("Pa", "mu_k, one a term", each=True, typical=(700.0, -40.0))
    alpha: Any = param("1", "alpha_k, one a term", nonzero=True, each=True, typical=(2.5, -4.0))
    bulk: Any = param("Pa", "bulk modulus", above=0.0, typical=7700.0)
    volumetric: str = static(default="quadratic", about="quadratic, log or simo")
    invariants: ClassVar = ("stretches", "J")

    def exponents(self):
        """alpha_k."""
        return tuple(self.alpha)

    def stretch_energy(self, *X):
        """Sum of the terms."""
        return sum(m / a * x for m, a, x in zip(self.mu, self.alpha, X, strict=True))

    def stretch_derivatives(self, *X):
        """mu_k/alpha_k; all second derivatives are zero."""
        return tuple(m / a for m, a in zip(self.mu, self.alpha, strict=True)), {}

    def shear_modulus(self):
        """sum mu_k alpha_k / 2 [Pa]."""
        return sum(m * a for m, a in zip(self.mu, self.alpha, strict=True)) / 2

    def check(self):
        """InputError where terms do not pair."""
        if len(self.mu) != len(self.alpha):
            raise InputError(f"law ogden has {len(self.mu)} mu and {len(self.alpha)} alpha: give one of each a term")


@struct
class Bogen(Law):
    """W = mu/alpha (Xi(alpha) - 3) + U(J).

    Chapter, Table 1 (with - 3 for its - 1); Bogen 1987. One term of Ogden's law.
    """

    mu: Any = param("Pa", "mu; of alpha's sign for a stable law", typical=400.0)
    alpha: Any = param("1", "exponent", nonzero=True, typical=4.0)
    bulk: Any = param("Pa", "bulk modulus", above=0.0, typical=7700.0)
    volumetric: str = static(default="quadratic", about="quadratic, log or simo")
    invariants: ClassVar = ("stretches", "J")

    def exponents(self):
        """alpha."""
        return (self.alpha,)

    def stretch_energy(self, X):
        """mu/alpha X."""
        return self.mu / self.alpha * X

    def stretch_derivatives(self, X):
        """mu/alpha, 0."""
        return (self.mu / self.alpha,), {}

    def shear_modulus(self):
        """mu alpha / 2 [Pa]."""
        return self.mu * self.alpha / 2


@struct
class Logarithmic(Law):
    """W = -c1 ln(1 - c2 (Xi(alpha) - 3)) + U(J).

    Chapter, Table 1. Infinite where Xi(alpha) = 3 + 1/c2: NaN beyond.
    """

    c1: Any = param("Pa", "scale", above=0.0, typical=1925.0)
    c2: Any = param("1", "1 / (largest Xi - 3)", above=0.0, typical=0.05)
    alpha: Any = param("1", "exponent", nonzero=True, typical=4.0)
    bulk: Any = param("Pa", "bulk modulus", above=0.0, typical=7700.0)
    volumetric: str = static(default="quadratic", about="quadratic, log or simo")
    invariants: ClassVar = ("stretches", "J")

    def exponents(self):
        """alpha."""
        return (self.alpha,)

    def stretch_energy(self, X):
        """By log1p: no cancellation at rest."""
        return -self.c1 * jnp.log1p(-self._filled(X))

    def _filled(self, X):
        """c2 X, the part of the way to the pole; NaN beyond it."""
        return jnp.where(self.c2 * X < 1, self.c2 * X, jnp.nan)

    def stretch_derivatives(self, X):
        """c1 c2/(1 - c2 X) and c1 c2^2/(1 - c2 X)^2."""
        pole = self.c2 / (1 - self._filled(X))
        return (self.c1 * pole,), {(0, 0): self.c1 * pole * pole}

    def shear_modulus(self):
        """c1 c2 alpha^2 / 2 [Pa]."""
        return self.c1 * self.c2 * self.alpha**2 / 2


@struct
class Exponential(Law):
    """W = c1 (exp(c2 (Xi(alpha) - 3)) - 1) + U(J).

    Chapter, Table 1 (with - 3 for its - 1).
    """

    c1: Any = param("Pa", "scale", above=0.0, typical=385.0)
    c2: Any = param("1", "exponent's factor", above=0.0, typical=0.25)
    alpha: Any = param("1", "exponent", nonzero=True, typical=4.0)
    bulk: Any = param("Pa", "bulk modulus", above=0.0, typical=7700.0)
    volumetric: str = static(default="quadratic", about="quadratic, log or simo")
    invariants: ClassVar = ("stretches", "J")

    def exponents(self):
        """alpha."""
        return (self.alpha,)

    def stretch_energy(self, X):
        """By expm1: no cancellation at rest."""
        return self.c1 * jnp.expm1(self.c2 * X)

    def stretch_derivatives(self, X):
        """c1 c2 e and c1 c2^2 e, e = exp(c2 X)."""
        slope = self.c1 * self.c2 * jnp.exp(self.c2 * X)
        return (slope,), {(0, 0): self.c2 * slope}

    def shear_modulus(self):
        """c1 c2 alpha^2 / 2 [Pa]."""
        return self.c1 * self.c2 * self.alpha**2 / 2
