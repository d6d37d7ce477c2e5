"""A hyperelastic solid: its law acts in every element, without memory."""

from typing import Any

import jax

from liverjax.core.struct import param, struct
from liverjax.laws.base import Law
from liverjax.laws.terms import invariant_terms
from liverjax.physics.base import Pairs, Physics, Solid, Step
from liverjax.tensors.matrices import Matrix, Vector


@struct
class Elasticity(Physics):
    """A law that acts element by element."""

    law: Law = param("1", "the law")

    def freeze(self, memory: None, step: Step) -> "Elastic":
        """The law, ready to act during a step."""
        return Elastic(law=self.law)


@struct
class Elastic(Solid):
    """The law during a step."""

    law: Law = param("1", "the law")

    def stress(self, F: Matrix) -> Matrix:
        """First Piola-Kirchhoff stress, from hand-derived terms."""
        return invariant_terms.first_piola(self.law, F)

    def blocks(self, F: Matrix, D: list[Vector], pairs: Pairs) -> list[Matrix]:
        """Blocks of the stiffness, from hand-derived terms."""
        return invariant_terms.blocks(invariant_terms.state(self.law, F), D, pairs)

    def energy(self, F: Matrix) -> jax.Array:
        """Strain energy."""
        return self.law.strain_energy(self.law.measures(F))

    def parts(self) -> tuple[list[tuple[Any, Any]], None]:
        """The law with weight 1, and no constant stress."""
        return [(1.0, self.law)], None
