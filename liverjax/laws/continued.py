"""A law with another energy below a chosen volume ratio J, so that flat and inverted elements have a finite energy."""

import jax
import jax.numpy as jnp

from liverjax.core.errors import InputError
from liverjax.core.struct import Number, replace, static, struct, unnamed
from liverjax.laws.base import Law, Volumetric
from liverjax.tensors.matrices import determinant


@struct
class Continued(Law):
    """A law of I1, I2 and J that is unchanged above J = c. Energy and stress are continuous at J = c.

    Below c, the energy is evaluated at c^2/(2c - J) instead of J. This value is positive, so the isochoric invariants
    exist. This does not apply to a separate volumetric energy U(J): below c, its second-order Taylor series at c
    replaces U(J). The energy increases while an element is flattened and inverted.
    """

    law: Law = unnamed("the law that is continued")
    below: float = static(default=0.1, about="c, the J below which the law is continued")

    @property
    def invariants(self) -> tuple:  # type: ignore[override]  # the invariants of the original law
        """Names of the invariants of the original law, and J."""
        return self.law.invariants if "J" in self.law.invariants else (*self.law.invariants, "J")

    def isochoric_part(self) -> Law | None:
        """Return the continued law without its volumetric energy. Returns None if the energy cannot be split."""
        part = self.law.isochoric_part()
        return None if part is None else Continued(law=part, below=self.below)

    def volumetric_part(self) -> Law | None:
        """Return the continued volumetric energy, or None if the original law has no separate volumetric energy."""
        part = None if self.law.isochoric_part() is None else self.law.volumetric_part()
        return None if part is None else Volumetric(bulk=part.bulk, volumetric=part.volumetric, below=self.below)

    def without_volume(self) -> Law | None:
        """Return the continued law without its volumetric energy. Returns None if it has no other energy."""
        part = self.law.without_volume()
        return self if part is self.law else None if part is None else Continued(law=part, below=self.below)

    def measures(self, F):
        """Return the invariants of the original law, with the value of `_replaced` instead of J, and the true J."""
        J = determinant(F)
        return self._whole().measures(F)._replace(J=self._replaced(J)[0]), J

    def strain_energy(self, I):
        """Return the energy [Pa] of the original law at the replaced J, plus the continued volumetric energy at J."""
        I, J = I
        W, volume = self._whole().strain_energy(I), self.volumetric_part()
        return W if volume is None else W + volume.strain_energy(I._replace(J=J))

    def energy_derivatives(self, I):
        """Return the first and second derivatives of the energy, by the chain rule."""
        I, J = I
        _, slope, curvature = self._replaced(J)
        first, second = self._whole().energy_derivatives(I)
        if "J" in first:
            W_J = first["J"]
            first = first | {"J": W_J * slope}
            mixed = {key: W * slope if "J" in key else W for key, W in second.items()}
            second = mixed | {("J", "J"): second.get(("J", "J"), 0.0) * slope * slope + W_J * curvature}
        volume = self.volumetric_part()
        if volume is not None:
            more, curved = volume.energy_derivatives(I._replace(J=J))
            first = first | {"J": first.get("J", 0.0) + more["J"]}
            second = second | {("J", "J"): second.get(("J", "J"), 0.0) + curved["J", "J"]}
        return first, second

    def shear_modulus(self):
        """Return the ground-state shear modulus [Pa] of the original law."""
        return self.law.shear_modulus()

    def bulk_modulus(self):
        """Return the ground-state bulk modulus [Pa] of the original law."""
        return self.law.bulk_modulus()

    def _whole(self) -> Law:
        """Return the original law without its volumetric energy, or the whole law if its energy cannot be split."""
        part = self.law.isochoric_part()
        return self.law if part is None else part

    def _replaced(self, J: Number) -> tuple[jax.Array, jax.Array, jax.Array]:
        """Return the replaced J (c^2/(2c - J) below c, J above c), and its first two derivatives with respect to J."""
        c, lower = self.below, self.below > J
        inverse = 1 / (2 * c - jnp.minimum(J, c))
        squared = c * c * inverse * inverse
        return (
            jnp.where(lower, c * c * inverse, J),
            jnp.where(lower, squared, 1.0),
            jnp.where(lower, 2 * squared * inverse, 0.0),
        )


def continued(law: Law, below: float) -> Law:
    """Return the law, changed such that its energy is defined for every J in exact arithmetic (see `Continued`).

    Above J = c (argument `below`) it is the same law. Below c, the isochoric invariants grow while J decreases. So an
    exponential of them can exceed the largest floating-point number, for example in float32 at J = -1. Energy and
    forces are then infinite or NaN.

    Args:
        law: a law of I1, I2 and J, or a sum of such laws.
        below: volume ratio c below which the energy is replaced, between 0 and 1, e.g. 0.1.

    Raises:
        InputError: c is not between 0 and 1, or the law has an energy of principal stretches, of fibres or of Green's
            strain. (An energy of Green's strain is finite for every J, so it needs no change.)
    """
    if isinstance(below, bool) or not isinstance(below, (int, float)) or not 0 < below < 1:
        raise InputError(f"law continued_below = {below!r} must lie between 0 and 1: give e.g. 0.1")
    for part in law.summands():
        kinds = {"stretch_energy": "principal stretches", "green_energy": "Green's strain", "fibre": "fibres"}
        for attribute, kind in kinds.items():
            if getattr(part, attribute) is not None:
                raise InputError(
                    f"law continued_below needs an energy of I1, I2 and J, but {type(part).__name__} has an energy of "
                    f"{kind}: remove continued_below"
                )
    first, *others = (
        replace(part, below=float(below)) if isinstance(part, Volumetric) else Continued(law=part, below=float(below))
        for part in law.summands()
    )
    return sum(others, first)
