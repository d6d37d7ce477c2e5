"""The energies that a law defines, and their derivatives with respect to scalar invariants.

The terms of stress and stiffness (`liverjax.laws.terms`) use these derivatives. `liverjax.laws.base.Law` adds the
quantities that follow from the energies, for example the stress.
"""

from typing import Any, ClassVar

from liverjax.core.struct import Content, Number, Numbers
from liverjax.laws.derivatives import First, Second, accumulate, autodiff_derivatives, reduced, split_derivatives
from liverjax.tensors.directions import components, orthogonal_axes
from liverjax.tensors.matrices import Invariants, Matrix, determinant, dot, green_strain, invariants, matmul, matvec
from liverjax.tensors.principal import power_sum, stretches


class Energies:
    """The energies of a law per reference volume [Pa]. `liverjax.laws.base` lists the methods to override."""

    invariants: ClassVar[tuple[str, ...]] = ("I1", "J")
    #: Every law is a struct, so `dataclasses.replace` works on it.
    __dataclass_fields__: ClassVar[Content]
    #: The energies of a law. None means that the law has no energy of this kind.
    isochoric_energy: Any = None
    stretch_energy: Any = None
    green_energy: Any = None
    #: Hand-derived derivatives of these energies. None means automatic differentiation.
    isochoric_derivatives: Any = None
    stretch_derivatives: Any = None
    green_derivatives: Any = None
    #: Method that returns the exponents alpha_k of a `stretch_energy`.
    exponents: Any
    #: Fields of the volumetric energy U(J), and fields for directions. None means that the law has no such energy or
    #: direction.
    bulk: Number | None = None
    volumetric: str
    fibre: Numbers | None = None
    sheet: Numbers
    #: Elements of each law (`liverjax.tensors.subsets.Subsets`). None means that the whole body has one law.
    subsets: Any = None

    def strain_energy(self, I: Invariants) -> Any:
        """Return the energy density [Pa] for the values `I` of the invariants that the law lists."""
        W = 0.0
        if self.isochoric_energy is not None:
            W = W + self.isochoric_energy(*reduced(I))
        if self.stretch_energy is not None:
            W = W + self.stretch_energy(*(power_sum(I.stretches, a) for a in self.exponents()))
        if self.green_energy is not None:
            W = W + self.green_energy(I.E)
        U = self.volumetric_part()
        return W if U is None else W + U.strain_energy(I)

    def energy_derivatives(self, I: Invariants) -> tuple[First, Second]:
        """Return dW/dI_a and d2W/dI_a dI_b for scalar invariants I_a. A derivative that is always 0 has no key."""
        if type(self).strain_energy is not Energies.strain_energy:
            return autodiff_derivatives(self, I)
        first, second = split_derivatives(self, I) if self.isochoric_energy is not None else ({}, {})
        U = self.volumetric_part()
        if U is not None:
            slope, curvature = U.energy_derivatives(I)
            accumulate(first, "J", slope["J"])
            accumulate(second, ("J", "J"), curvature["J", "J"])
        return first, second

    def volumetric_part(self) -> "Energies | None":
        """Return the volumetric energy U(J) as a separate law. Returns None if the law has no volumetric energy."""
        return None

    # -- parts of a law -----------------------------------------------------------------------------------------------

    def summands(self) -> tuple[Any, ...]:
        """Return the laws whose sum is this law. A law that is not a sum returns itself."""
        return (self,)

    def pieces(self) -> tuple[Any, ...]:
        """Return the laws of the body: only this law, unless the regions of the body have laws of different kinds."""
        return (self,)

    def piece(self, k: int) -> Any:
        """Return law k of `pieces`. Its parameters have values only for the elements of this law."""
        return self

    # -- arguments of the energies -------------------------------------------------------------------------------------

    def measures(self, F: Matrix) -> Invariants:
        """Return the arguments of `strain_energy` at the deformation gradient F, a tuple matrix."""
        I = invariants(self.invariants, F)
        if "I4" in self.invariants:
            Fa = matvec(F, components(self.fibre, F[0][0]))
            I = I._replace(I4=dot(Fa, Fa))
        if self.green_energy is not None:
            I = I._replace(E=green_strain(matmul(F, self.material_axes(F[0][0]))))
        if self.stretch_energy is not None:
            I = I._replace(stretches=stretches(F))
        return I if self.bulk is None else I._replace(J=determinant(F))

    def material_axes(self, like: Number) -> Matrix:
        """Return fibre, sheet and normal as columns, in the precision of `like`.

        If the law has no fibre, the columns are the coordinate axes.
        """
        return orthogonal_axes(self.fibre, None if self.fibre is None else self.sheet, like)


def fibre_invariants(laws: tuple) -> dict[str, Energies]:
    """Return {name of an invariant I4 = a . C a: law with the fibre direction a} for the laws of a sum."""
    if len(laws) == 1:
        return {"I4": laws[0]} if "I4" in laws[0].invariants else {}
    return {f"I4.{k}": law for k, law in enumerate(laws) if "I4" in law.invariants}
