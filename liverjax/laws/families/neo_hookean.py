"""Neo-Hookean laws: the form in Table 1 of the book chapter (C1 = mu/2), and a compressible form of the literature."""

from typing import ClassVar

import jax.numpy as jnp

from liverjax.core.struct import Number, param, static, struct
from liverjax.laws.base import Law


@struct
class NeoHookean(Law):
    """W = mu/2 (Ibar1 - 3) + U(J).

    Book chapter, Table 1 (C1 = mu/2). Here Ibar1 is used instead of I1, because the tetrahedra can change volume.
    """

    mu: Number = param("Pa", "shear modulus", above=0.0, typical=770.0)
    bulk: Number = param("Pa", "bulk modulus", above=0.0, typical=7700.0)
    volumetric: str = static(default="quadratic", about="quadratic, log or simo")
    invariants: ClassVar = ("I1", "J")

    def isochoric_energy(self, I1, I2):
        """Return the energy mu/2 (Ibar1 - 3)."""
        return 0.5 * self.mu * (I1 - 3)

    def isochoric_derivatives(self, I1, I2):
        """Return the first derivative mu/2. The second derivative is 0."""
        return {"I1": 0.5 * self.mu}, {}

    def shear_modulus(self):
        """Return the ground-state shear modulus mu [Pa]."""
        return self.mu


@struct
class NeoHookeanCompressible(Law):
    """W = mu/2 (I1 - 3) - mu ln J + lambda/2 ln^2 J.

    This is a compressible form from the literature (Bonet and Wood 2008, eq. 6.27). W is infinite at J = 0.
    """

    mu: Number = param("Pa", "shear modulus", above=0.0, typical=770.0)
    lame_lambda: Number = param("Pa", "first Lame coefficient", lower=0.0, typical=7000.0)
    invariants: ClassVar = ("I1", "J")

    def strain_energy(self, I):
        """Return the complete strain energy density [Pa]."""
        ln = jnp.log(I.J)
        return 0.5 * self.mu * (I.I1 - 3) - self.mu * ln + 0.5 * self.lame_lambda * ln**2

    def energy_derivatives(self, I):
        """Return the derivatives W_1 = mu/2, W_J = (lambda ln J - mu)/J and W_JJ = (lambda (1 - ln J) + mu)/J^2."""
        ln = jnp.log(I.J)
        inverse_J = 1 / I.J
        slope = (self.lame_lambda * ln - self.mu) * inverse_J
        curvature = (self.lame_lambda * (1 - ln) + self.mu) * inverse_J * inverse_J
        return {"I1": 0.5 * self.mu, "J": slope}, {("J", "J"): curvature}

    def shear_modulus(self):
        """Return the ground-state shear modulus mu [Pa]."""
        return self.mu

    def bulk_modulus(self):
        """Return the ground-state bulk modulus lambda + 2/3 mu [Pa]."""
        return self.lame_lambda + 2 / 3 * self.mu
