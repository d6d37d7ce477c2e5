"""Stable neo-Hookean law. The energy is finite for every deformation gradient, even for inverted elements."""

import math
from typing import ClassVar

import jax.numpy as jnp

from liverjax.core.struct import Number, param, struct
from liverjax.laws.base import Law


@struct
class StableNeoHookean(Law):
    """W = m/2 (I1 - 3) - m/2 ln((I1 + 1)/4) + l/2 [(J - a)^2 - (1 - a)^2], a = 1 + 3 m/(4 l),
    m = 4/3 mu, l = lame_lambda + 5/6 mu.

    Smith, De Goes, Kim 2018 (eq. 14, shifted to 0 at rest). With these m and l, mu and lame_lambda are the Lame
    coefficients of the ground state (section 3.4 of the paper).
    """

    mu: Number = param("Pa", "shear modulus", above=0.0, typical=770.0)
    lame_lambda: Number = param("Pa", "first Lame coefficient", lower=0.0, typical=7000.0)
    invariants: ClassVar = ("I1", "J")

    def _constants(self):
        return 4 / 3 * self.mu, self.lame_lambda + 5 / 6 * self.mu

    def strain_energy(self, I):
        """Return the complete energy, computed with l/2 [(J - a)^2 - (1 - a)^2] = l/2 (J - 1)^2 - 3 m/4 (J - 1)."""
        m, l = self._constants()
        shift = I.J - 1
        return 0.5 * m * (I.I1 - 3 - jnp.log(I.I1 + 1) + math.log(4)) + shift * (0.5 * l * shift - 0.75 * m)

    def energy_derivatives(self, I):
        """Return the derivatives W_1 = m/2 I1/(I1 + 1), W_J = l (J - 1) - 3 m/4, W_11 = m/2/(I1 + 1)^2 and W_JJ = l."""
        m, l = self._constants()
        inverse = 1 / (I.I1 + 1)
        first = {"I1": 0.5 * m * I.I1 * inverse, "J": l * (I.J - 1) - 0.75 * m}
        return first, {("I1", "I1"): 0.5 * m * inverse * inverse, ("J", "J"): l}

    def shear_modulus(self):
        """Return the ground-state shear modulus mu [Pa]."""
        return self.mu

    def bulk_modulus(self):
        """Return the ground-state bulk modulus lambda + 2/3 mu [Pa]."""
        return self.lame_lambda + 2 / 3 * self.mu
