"""A hyperelastic solid. In every element, the law gives the stress as a function of the current deformation only."""

from typing import Any

import jax

from liverjax.core.struct import param, struct
from liverjax.laws.base import Law
from liverjax.laws.terms import invariant_terms
from liverjax.physics.base import Pairs, Physics, Solid, Step
from liverjax.tensors.matrices import Matrix, Vector


@struct
class Elasticity(Physics):
    """A hyperelastic law, evaluated in every element."""

    law: Law = param("1", "the law")

    def freeze(self, memory: None, step: Step) -> "Elastic":
        """Return the force term of the law for one step."""
        return Elastic(law=self.law)


@struct
class Elastic(Solid):
    """Force term of a hyperelastic law, for one step."""

    law: Law = param("1", "the law")

    def stress(self, F: Matrix) -> Matrix:
        """Return the first Piola-Kirchhoff stress [Pa].

        Its formulas were derived by hand (no automatic differentiation).
        """
        return invariant_terms.first_piola(self.law, F)

    def blocks(self, F: Matrix, D: list[Vector], pairs: Pairs) -> list[Matrix]:
        """Return the stiffness blocks for `pairs` of nodes, with gradients D of the shape functions."""
        return invariant_terms.blocks(invariant_terms.state(self.law, F), D, pairs)

    def energy(self, F: Matrix) -> jax.Array:
        """Return the strain energy density [Pa]."""
        return self.law.strain_energy(self.law.measures(F))

    def parts(self) -> tuple[list[tuple[Any, Any]], None]:
        """Return the law with weight 1, and None because there is no constant stress."""
        return [(1.0, self.law)], None
