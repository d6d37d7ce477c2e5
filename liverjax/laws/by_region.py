"""A body with laws of several kinds. In each element, only the law of its region is evaluated."""

from collections.abc import Callable
from typing import Any

import jax

from liverjax.core.errors import InputError
from liverjax.core.struct import param, struct, unnamed
from liverjax.laws.base import Law, Volumetric
from liverjax.tensors.matrices import Matrix
from liverjax.tensors.subsets import Subsets, in_subset, put_together


@struct
class ByRegion(Law):
    """Several laws, one for each subset of the elements.

    A parameter of a law may have one value for each of the E elements of the whole body. The law uses only the values
    of the elements in its subset.
    """

    laws: tuple[Law, ...] = unnamed("one law for each subset")
    subsets: Subsets = param("1", "the elements of each law")  # type: ignore[assignment]

    def pieces(self) -> tuple[Law, ...]:
        """Return the laws. Parameters with one value per element have values for all elements of the body."""
        return self.laws

    def piece(self, k: int) -> Law:
        """Return law k. Parameters with one value per element have values only for the elements of this law."""
        return in_subset(self.subsets, k, self.laws[k])

    def each(self, change: Callable[[Law], Law]) -> "ByRegion":
        """Return a copy with `change` applied to every law."""
        return ByRegion(laws=tuple(change(law) for law in self.laws), subsets=self.subsets)

    def check(self) -> None:
        """Check every law."""
        for law in self.laws:
            law.check()

    def isochoric_part(self) -> Any:
        """Return the isochoric parts of all laws. Returns None if one of the laws has no isochoric part."""
        if any(law.isochoric_part() is None for law in self.laws):
            return None
        return self.each(lambda law: law.isochoric_part())

    def volumetric_part(self) -> Any:
        """Return the volumetric parts of all laws, with K = 0 for a law without this part.

        Returns None if no law has a volumetric part.
        """
        if all(law.volumetric_part() is None for law in self.laws):
            return None
        return self.each(lambda law: law.volumetric_part() or Volumetric(bulk=0.0))

    def measures(self, F: Matrix) -> tuple:  # type: ignore[override]
        """Return the invariants of each law in the elements of its subset."""
        return tuple(self.piece(k).measures(in_subset(self.subsets, k, F)) for k in range(len(self.laws)))

    def strain_energy(self, I: tuple) -> jax.Array:  # type: ignore[override]
        """Return the energy density (…, E) [Pa] of every element, from the law of its region."""
        return put_together(self.subsets, [self.piece(k).strain_energy(i) for k, i in enumerate(I)])

    def energy_derivatives(self, I: Any) -> Any:
        """Raise an error: laws of several kinds have no common invariants."""
        raise InputError("laws of several kinds have no common derivatives: use the derivatives of each law")

    def shear_modulus(self) -> jax.Array:
        """Return the ground-state shear modulus (E,) [Pa]."""
        return put_together(self.subsets, [self.piece(k).shear_modulus() for k in range(len(self.laws))])

    def bulk_modulus(self) -> jax.Array:
        """Return the ground-state bulk modulus (E,) [Pa]."""
        return put_together(self.subsets, [self.piece(k).bulk_modulus() for k in range(len(self.laws))])
