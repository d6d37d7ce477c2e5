"""What a law defines: its energies and their derivatives with respect to scalar invariants.

The terms of stress and stiffness (`liverjax.laws.terms`) use these. `liverjax.laws.base.Law` adds what follows from
them, for example the stress.
"""

from typing import Any, ClassVar

from liverjax.core.struct import Content, Number, Numbers
from liverjax.laws.derivatives import First, Second, accumulate, autodiff_derivatives, reduced, split_derivatives
from liverjax.tensors.directions import components, orthogonal_axes
from liverjax.tensors.matrices import Invariants, Matrix, determinant, dot, green_strain, invariants, matmul, matvec
from liverjax.tensors.principal import power_sum, stretches


class Energies:
    """The energies of a law per reference volume [Pa]. `liverjax.laws.base` says which methods to override."""

    invariants: ClassVar[tuple[str, ...]] = ("I1", "J")
    #: Every law is a struct, so `dataclasses.replace` works on it.
    __dataclass_fields__: ClassVar[Content]
    #: The energies of a law; None: the law has no energy of this kind.
    isochoric_energy: Any = None
    stretch_energy: Any = None
    green_energy: Any = None
    #: Hand-derived derivatives of these energies; None: automatic differentiation.
    isochoric_derivatives: Any = None
    stretch_derivatives: Any = None
    green_derivatives: Any = None
    #: The powers of a `stretch_energy`.
    exponents: Any
    #: Fields of the volumetric energy U(J), and fields for directions; None: the law has no such energy or direction.
    bulk: Number | None = None
    volumetric: str
    fibre: Numbers | None = None
    sheet: Numbers
    #: Which elements have which law (`liverjax.tensors.subsets.Subsets`); None: one law everywhere.
    subsets: Any = None

    def strain_energy(self, I: Invariants) -> Any:
        """Energy density [Pa] at the invariants that the law names."""
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
        """dW/dI_a and d2W/dI_a dI_b for scalar invariants. A missing key means 0 and needs no computation."""
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
        """U(J) as a separate law; `None` if the law has no U(J)."""
        return None

    # -- parts of a law -----------------------------------------------------------------------------------------------

    def summands(self) -> tuple[Any, ...]:
        """The laws whose sum is this law: the law itself, unless it is a sum."""
        return (self,)

    def pieces(self) -> tuple[Any, ...]:
        """The laws of the parts of the body: the law itself, unless regions have laws of other kinds."""
        return (self,)

    def piece(self, k: int) -> Any:
        """The law of part k of the body, with the parameters of the elements of this part."""
        return self

    # -- its arguments -------------------------------------------------------------------------------------------------

    def measures(self, F: Matrix) -> Invariants:
        """The arguments of `strain_energy` at the tuple matrix F."""
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
        """Columns fibre, sheet and normal, in the precision of `like`. Without a fibre they are the coordinate axes."""
        return orthogonal_axes(self.fibre, None if self.fibre is None else self.sheet, like)


def fibre_invariants(laws: tuple) -> dict[str, Energies]:
    """Name of each invariant a . C a in a sum of laws -> law with this fibre a; fibres of laws may differ."""
    if len(laws) == 1:
        return {"I4": laws[0]} if "I4" in laws[0].invariants else {}
    return {f"I4.{k}": law for k, law in enumerate(laws) if "I4" in law.invariants}
