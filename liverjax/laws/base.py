"""The base class of material laws: a strain energy and its derivatives.

A law is an immutable pytree, made with the decorator `liverjax.core.struct.struct`. I1, I2 and J are invariants of the
deformation, C is the right Cauchy-Green tensor, and lambda_m are the principal stretches. The energy of a law is the
sum of one or more of these terms:

* `isochoric_energy(Ibar1, Ibar2)`, a function of Ibar1 = J^(-2/3) I1 and Ibar2 = J^(-4/3) I2;
* `stretch_energy(X_1, …)`, a function of X_k = sum_m (J^(-1/3) lambda_m)^alpha_k - 3; `exponents()` gives all alpha_k;
* `green_energy(E)`, a function of Green's strain in the axes `fibre`, `sheet` and their normal. Without these fields
  the axes are the coordinate axes;
* the volumetric energy U(J), defined by the fields `bulk` and `volumetric`.

Alternatively, a law overrides `strain_energy(I)`, the complete energy. The argument I contains only the invariants that
the law lists in `invariants` (I1, I2, I4, J). I4 = a . C a, with the fibre direction a, needs a field `fibre`.
Derivatives are computed by scalar automatic differentiation, unless the law defines `isochoric_derivatives`,
`stretch_derivatives`, `green_derivatives` or `energy_derivatives`.
"""

import dataclasses
from collections.abc import Callable
from typing import Any, ClassVar

import jax
import jax.numpy as jnp
import numpy as np

from liverjax.core.errors import InputError
from liverjax.core.struct import Number, param, replace, static, struct, unnamed
from liverjax.laws.derivatives import accumulate
from liverjax.laws.energies import Energies, fibre_invariants
from liverjax.laws.terms import invariant_terms
from liverjax.laws.volumetric import volumetric
from liverjax.tensors.matrices import (
    pack,
    unpack,
)

#: Units that a parameter of a law must not have. Functions that multiply the moduli of a law look for the unit Pa.
_NOT_PASCAL = frozenset(("hPa", "kPa", "MPa", "GPa", "N/m^2", "N/m2", "N/mm^2", "N/mm2", "bar", "mbar", "psi", "mmHg"))


class Law(Energies):
    """A hyperelastic law: energy per reference volume [Pa]. The module's docstring lists the methods to override."""

    def __init_subclass__(cls) -> None:
        """Raise `InputError` if a parameter of a new law, or of one of its base classes, has a unit of pressure other
        than Pa."""
        super().__init_subclass__()
        fields: dict[str, object] = {}
        for base in reversed(cls.__mro__):
            fields |= vars(base) | vars(base).get("__dataclass_fields__", {})
        for name, field in fields.items():
            unit = field.metadata.get("unit") if isinstance(field, dataclasses.Field) else None
            if unit in _NOT_PASCAL:
                raise InputError(f"{cls.__name__}.{name} has the unit {unit!r}: declare the unit Pa, with values in Pa")

    def shear_modulus(self) -> Any:
        """Return the ground-state shear modulus [Pa]. Raise `InputError` if the law does not define this method."""
        raise InputError(f"law {type(self).__name__} has no ground-state shear modulus: define shear_modulus(self)")

    def bulk_modulus(self) -> Any:
        """Return the ground-state bulk modulus `bulk` [Pa].

        Raise `InputError` if energies other than U(J) may contribute to the modulus.
        """
        if type(self).strain_energy is not Energies.strain_energy or self.green_energy is not None:
            raise InputError(f"law {type(self).__name__} has no ground-state bulk modulus: define bulk_modulus(self)")
        return 0.0 if self.bulk is None else self.bulk

    def check(self) -> None:
        """Raise `InputError` if the values of the fields contradict each other."""
        self.check_directions()

    def check_directions(self) -> None:
        """Raise `InputError` if a fibre has length 0. Fibres inside jit, grad or vmap are not checked."""
        if self.fibre is None or any(isinstance(v, jax.core.Tracer) for v in jax.tree.leaves(self.fibre)):
            return
        if not np.all(np.linalg.norm(np.asarray(self.fibre, float), axis=-1) > 0):
            raise InputError(f"law {type(self).__name__} has a fibre of length 0: give a direction that is not zero")

    # -- parts of a law -----------------------------------------------------------------------------------------------

    def each(self, change: Callable[["Law"], "Law"]) -> "Law":
        """Return `change(law)`. If the body has laws of several kinds, `change` is applied to each law."""
        return change(self)

    def isochoric_part(self) -> Any:
        """Return the law without its volumetric energy U(J).

        Returns None if the energy cannot be split or has no isochoric part.
        """
        if self.isochoric_energy is None and self.stretch_energy is None:
            return None
        return self if self.bulk is None else replace(self, bulk=None)

    def volumetric_part(self) -> Any:
        """Return the volumetric energy U(J) as a separate law. Returns None if the law has no volumetric energy."""
        return None if self.bulk is None else Volumetric(bulk=self.bulk, volumetric=self.volumetric)

    def without_volume(self) -> Any:
        """Return the law without its volumetric energy U(J). If U(J) is not a separate term, return the law itself.

        Laws whose only energy is U(J) return None.
        """
        split = self.isochoric_part()
        if split is not None:
            return split
        apart = self.bulk is not None and type(self).strain_energy is Law.strain_energy
        return replace(self, bulk=None) if apart else self

    # -- energy, stress and tangent ----------------------------------------------------------------------------------

    def energy(self, F: jax.Array) -> jax.Array:
        """Return the strain energy density [Pa], shape (...), at deformation gradients (..., 3, 3)."""
        return self.strain_energy(self.measures(unpack(_floating(F))))

    def first_piola(self, F: jax.Array) -> jax.Array:
        """Return the first Piola-Kirchhoff stress dW/dF [Pa], shape (..., 3, 3), from hand-derived terms."""
        return pack(invariant_terms.first_piola(self, unpack(_floating(F))))

    def tangent(self, F: jax.Array) -> jax.Array:
        """Return the tangent d2W/dF dF [Pa], shape (..., 3, 3, 3, 3).

        It is computed with the hand-derived formula for the stiffness between two nodes, with unit vectors instead of
        gradients of shape functions.
        """
        A = invariant_terms.tangent(invariant_terms.state(self, unpack(_floating(F))))
        rows = [[jnp.stack([pack(A[J][L]) for L in range(3)], axis=-1)] for J in range(3)]
        # `pack` returns (..., i, k). L is stacked as the last axis. Then J is stacked before k: (..., i, J, k, L).
        return jnp.stack([r[0] for r in rows], axis=-3)

    def __add__(self, other: "Law") -> "Sum":
        if not isinstance(other, Law):
            return NotImplemented
        return Sum(laws=self.summands() + other.summands())

    def __radd__(self, other: Number) -> "Law":
        """Return the law for 0 + law, so that Python's `sum` can add a list of laws."""
        return self if isinstance(other, int) and other == 0 else NotImplemented


def _floating(F: Number) -> jax.Array:
    """Return `F` as an array of floating-point numbers. Integers are converted to the default precision.

    Raises:
        InputError: the last two axes of `F` do not have the length 3.
    """
    F = jnp.asarray(F)
    if F.shape[-2:] != (3, 3):
        raise InputError(f"F has shape {F.shape}: give deformation gradients (..., 3, 3)")
    return F if jnp.issubdtype(F.dtype, jnp.floating) else F.astype(float)


@struct
class Sum(Law):
    """Several laws acting in parallel. The energy is the sum of their energies.

    If one of the `laws` is a sum, the laws of this sum replace it. So no law of a `Sum` is a `Sum`.
    """

    laws: tuple = unnamed("laws whose energies are added")

    def __post_init__(self):
        flat = tuple(part for law in self.laws for part in (law.laws if isinstance(law, Sum) else (law,)))
        object.__setattr__(self, "laws", flat)

    def summands(self):
        """Return the laws of the sum."""
        return self.laws

    def isochoric_part(self):
        """Return the sum of the isochoric parts.

        Laws with only a volumetric energy do not contribute. Returns None if one of the other laws has no isochoric
        part.
        """
        parts = [law.isochoric_part() for law in self.laws if not isinstance(law, Volumetric)]
        return None if any(part is None for part in parts) else _added(parts)

    def volumetric_part(self):
        """Return the sum of the laws' volumetric parts. Returns None if no law has a volumetric part."""
        return _added([part for part in (law.volumetric_part() for law in self.laws) if part is not None])

    def without_volume(self):
        """Return the sum of the laws without their volumetric energies. Returns None if no other energy is left."""
        return _added([part for part in (law.without_volume() for law in self.laws) if part is not None])

    def check(self):
        """Check every law of the sum."""
        for law in self.laws:
            law.check()

    def measures(self, F):
        """Return one set of invariants for each law of the sum. The compiler removes computations that occur twice."""
        return tuple(law.measures(F) for law in self.laws)

    def strain_energy(self, I):
        """Return the sum of the laws' energies [Pa]."""
        return sum(law.strain_energy(i) for law, i in zip(self.laws, I, strict=True))

    def energy_derivatives(self, I):
        """Return the sum of the laws' derivatives with respect to the invariants.

        The derivatives are added before stress and stiffness are computed, so each additional law needs only scalar
        operations.
        """
        first, second = {}, {}
        fibres = fibre_invariants(self.laws)
        names = iter(fibres)  # in the order of the laws that have a fibre
        for law, i in zip(self.laws, I, strict=True):
            own = {"I4": next(names)} if "I4" in law.invariants else {}
            slopes, curvatures = law.energy_derivatives(i)
            for a, value in slopes.items():
                accumulate(first, own.get(a, a), value)
            for (a, b), value in curvatures.items():
                accumulate(second, (own.get(a, a), own.get(b, b)), value)
        return first, second

    def shear_modulus(self):
        """Return the sum of the ground-state shear moduli of the laws [Pa]."""
        return sum(law.shear_modulus() for law in self.laws)

    def bulk_modulus(self):
        """Return the sum of the ground-state bulk moduli of the laws [Pa]."""
        return sum(law.bulk_modulus() for law in self.laws)


@struct
class Volumetric(Law):
    """A law whose only energy is the volumetric energy U(J).

    U = K/2 (J - 1)^2 ("quadratic"), K/2 ln^2 J ("log") or K/4 (J^2 - 1 - 2 ln J) ("simo").
    """

    bulk: Number = param("Pa", "bulk modulus K", lower=0.0, typical=7700.0)
    volumetric: str = static(default="quadratic", about="quadratic, log or simo")
    below: float | None = static(default=None, about="J below which U is replaced by its second-order Taylor series")
    invariants: ClassVar = ("J",)

    def volumetric_part(self):
        """Return the law itself."""
        return self

    def without_volume(self):
        """Return None, since this law has no other energy than U(J)."""
        return None

    def strain_energy(self, I):
        """Return the volumetric energy U(J) [Pa]."""
        if self.below is None:
            return volumetric(self.volumetric, self.bulk, I.J)[0]
        above = jnp.maximum(I.J, self.below)
        U, U1, U2 = volumetric(self.volumetric, self.bulk, above)
        return U + (U1 + 0.5 * U2 * (I.J - above)) * (I.J - above)

    def energy_derivatives(self, I):
        """Return the first and second derivative of U with respect to J."""
        above = I.J if self.below is None else jnp.maximum(I.J, self.below)
        _, U1, U2 = volumetric(self.volumetric, self.bulk, above)
        return {"J": U1 if self.below is None else U1 + U2 * (I.J - above)}, {("J", "J"): U2}

    def shear_modulus(self):
        """Return zero, since U(J) does not resist shear."""
        return 0.0

    def bulk_modulus(self):
        """Return the bulk modulus K [Pa]. At rest, the second derivative of every form of U is K."""
        return self.bulk


def _added(parts: list) -> Any:
    """Return the sum of the laws. Returns None if the list is empty."""
    return sum(parts) if parts else None


def summands(law: Law) -> tuple[Law, ...]:
    """Return the laws whose sum is `law`."""
    return law.summands()


def isochoric_part(law: Law) -> Any:
    """Return the law without its volumetric energy U(J).

    Returns None if the energy cannot be split or has no isochoric part.
    """
    return law.isochoric_part()


def volumetric_part(law: Law) -> Any:
    """Return the volumetric energy U(J) as a separate law. Returns None if the law has no volumetric energy."""
    return law.volumetric_part()
