"""A user-defined law in ten lines, without changes to the package.

``python -m liverjax check experiments/my_law.py:Gent`` checks it. ``python -m liverjax plot experiments/my_law.py:Gent
yeoh`` plots it. It simulates and differentiates like a law of the package, because its derivatives are computed from
its energy.
"""

import jax.numpy as jnp

import liverjax as lj


@lj.struct
class Gent(lj.Law):
    """W = -mu limit/2 ln(1 - (Ibar1 - 3)/limit) + U(J), Gent 1996: stiffens without bound at Ibar1 = 3 + limit."""

    mu: float = lj.param("Pa", "shear modulus", above=0.0, typical=770.0)
    limit: float = lj.param("1", "largest Ibar1 - 3", above=0.0, typical=20.0)
    bulk: float = lj.param("Pa", "bulk modulus", above=0.0, typical=7700.0)
    volumetric: str = lj.static("quadratic")

    def isochoric_energy(self, I1, I2):
        """Return the isochoric energy in the first line of the class docstring."""
        return -self.mu * self.limit / 2 * jnp.log1p(-(I1 - 3) / self.limit)
