"""What a material law is: a strain energy of invariants, and its scalar derivatives.

Two ways to write one, both a frozen pytree made with `liverjax.struct.struct`:

* override `strain_energy(I)`: the whole energy; derivatives come from scalar automatic differentiation, or from an
  `energy_derivatives(I)` written by hand;
* override `isochoric_energy(Ibar1, Ibar2)` and have fields `bulk` and `volumetric`: the base class adds U(J) and
  differentiates J^(-2/3) I1 and J^(-4/3) I2; `isochoric_derivatives` may be written by hand.
"""

from typing import Any, ClassVar

import jax
import jax.numpy as jnp

from liverjax import terms
from liverjax.errors import InputError
from liverjax.kinematics import Invariants, invariants, pack, right_cauchy_green, unpack
from liverjax.laws.volumetric import volumetric
from liverjax.struct import param, replace, static, struct

First = dict[str, Any]
Second = dict[tuple[str, str], Any]

#: Order of the invariants; keys of second derivatives are pairs in this order.
ORDER = ("I1", "I2", "J")


class Law:
    """A hyperelastic law per reference volume [Pa]; see the module for what to override."""

    invariants: ClassVar[tuple[str, ...]] = ("I1", "J")
    bulk: ClassVar[Any] = None

    # -- what a law states -------------------------------------------------------------------------------------------

    def strain_energy(self, I: Invariants) -> Any:
        """Energy density [Pa] of the invariants named in `invariants`."""
        W = self.isochoric_energy(*reduced(I))
        return W if self.bulk is None else W + volumetric(self.volumetric, self.bulk, I.J)[0]

    def energy_derivatives(self, I: Invariants) -> tuple[First, Second]:
        """dW/dI_a and d2W/dI_a dI_b; a missing key is a structural zero and costs nothing."""
        if hasattr(self, "isochoric_energy"):
            return _split_derivatives(self, I)
        return autodiff_derivatives(self, I)

    def shear_modulus(self) -> Any:
        """Ground-state shear modulus [Pa]."""
        raise InputError(f"law {type(self).__name__} states no ground-state shear modulus: define shear_modulus(self)")

    def bulk_modulus(self) -> Any:
        """Ground-state bulk modulus [Pa]."""
        return 0.0 if self.bulk is None else self.bulk

    # -- what a law can then do --------------------------------------------------------------------------------------

    def energy(self, F: jax.Array) -> jax.Array:
        """Strain energy density [Pa], shape (...), of deformation gradients (..., 3, 3)."""
        Fm = unpack(_floating(F))
        return self.strain_energy(invariants(self.invariants, Fm, right_cauchy_green(Fm)))

    def first_piola(self, F: jax.Array) -> jax.Array:
        """First Piola-Kirchhoff stress dW/dF [Pa], shape (..., 3, 3), by the hand-derived MJED terms."""
        return pack(terms.first_piola(self, unpack(_floating(F))))

    def tangent(self, F: jax.Array) -> jax.Array:
        """d2W/dF dF [Pa], shape (..., 3, 3, 3, 3), by the hand-derived MJED terms: the block of D = e_J, e_L."""
        A = terms.tangent(self, unpack(_floating(F)))
        rows = [[jnp.stack([pack(A[J][L]) for L in range(3)], axis=-1)] for J in range(3)]
        # pack gives (..., i, k); stacking L last then J second: (..., i, J, k, L).
        return jnp.stack([r[0] for r in rows], axis=-3)

    def __add__(self, other: "Law") -> "Sum":
        return Sum(laws=summands(self) + summands(other))


def _floating(F: Any) -> jax.Array:
    """`F` as an array of floating-point numbers; integers become the default precision."""
    F = jnp.asarray(F)
    return F if jnp.issubdtype(F.dtype, jnp.floating) else F.astype(float)


@struct
class Sum(Law):
    """Several laws acting in parallel: energies add."""

    laws: tuple = param("1", "laws that add up")

    @property
    def invariants(self) -> tuple[str, ...]:
        """Union of what the summands need."""
        return tuple(n for n in ORDER if any(n in law.invariants for law in self.laws))

    def strain_energy(self, I):
        """Sum of the energies."""
        return sum(law.strain_energy(I) for law in self.laws)

    def energy_derivatives(self, I):
        """Sum of the scalar derivatives: summed before anything is assembled, so a second law costs only scalars."""
        first, second = {}, {}
        for law in self.laws:
            for total, part in zip((first, second), law.energy_derivatives(I), strict=True):
                for key, value in part.items():
                    total[key] = total[key] + value if key in total else value
        return first, second

    def shear_modulus(self):
        """Sum of the summands'."""
        return sum(law.shear_modulus() for law in self.laws)

    def bulk_modulus(self):
        """Sum of the summands'."""
        return sum(law.bulk_modulus() for law in self.laws)


@struct
class Volumetric(Law):
    """U(J) alone.

    W = K/2 (J - 1)^2 ("quadratic"), K/2 ln^2 J ("log") or K/4 (J^2 - 1 - 2 ln J) ("simo").
    """

    bulk: Any = param("Pa", "bulk modulus K", lower=0.0, typical=7700.0)
    volumetric: str = static("quadratic", "quadratic, log or simo")
    invariants: ClassVar = ("J",)

    def strain_energy(self, I):
        """U(J)."""
        return volumetric(self.volumetric, self.bulk, I.J)[0]

    def energy_derivatives(self, I):
        """U' and U''."""
        _, U1, U2 = volumetric(self.volumetric, self.bulk, I.J)
        return {"J": U1}, {("J", "J"): U2}

    def shear_modulus(self):
        """A fluid has none."""
        return 0.0


def summands(law: Law) -> tuple[Law, ...]:
    """The laws of a sum, or the law alone."""
    return law.laws if isinstance(law, Sum) else (law,)


def reduced(I: Invariants) -> tuple[Any, Any]:
    """Isochoric invariants Ibar1 = J^(-2/3) I1 and Ibar2 = J^(-4/3) I2; NaN for J <= 0, where they do not exist."""
    m = I.J ** (-2 / 3)
    return (None if I.I1 is None else m * I.I1), (None if I.I2 is None else m * m * I.I2)


def _split_derivatives(law: Law, I: Invariants) -> tuple[First, Second]:
    """Chain rule from w(Ibar1, Ibar2) + U(J) to I1, I2, J (mathematics of the chapter's section 4.1.2, contracted)."""
    m = I.J ** (-2 / 3)
    inverse_J = 1 / I.J
    Ibar = {"I1": m * I.I1} if "I1" in law.invariants else {}
    if "I2" in law.invariants:
        Ibar["I2"] = m * m * I.I2
    power = {"I1": m, "I2": m * m}
    p = {"I1": -2 / 3, "I2": -4 / 3}
    w1, w2 = law.isochoric_derivatives(Ibar.get("I1"), Ibar.get("I2"))
    slope_J = {a: p[a] * Ibar[a] * inverse_J for a in w1}  # dIbar_a/dJ

    first = {a: w * power[a] for a, w in w1.items()}
    first["J"] = sum(w * slope_J[a] for a, w in w1.items())
    second = {key: w * power[key[0]] * power[key[1]] for key, w in w2.items()}
    second["J", "J"] = sum(w * (p[a] - 1) * slope_J[a] * inverse_J for a, w in w1.items())
    for a, w in w1.items():
        second[a, "J"] = w * power[a] * p[a] * inverse_J
    for (a, b), w in w2.items():
        second[a, "J"] = second[a, "J"] + w * power[a] * slope_J[b]
        if a != b:
            second[b, "J"] = second[b, "J"] + w * power[b] * slope_J[a]
        second["J", "J"] = second["J", "J"] + (1 if a == b else 2) * w * slope_J[a] * slope_J[b]
    if law.bulk is not None:
        _, U1, U2 = volumetric(law.volumetric, law.bulk, I.J)
        first["J"], second["J", "J"] = first["J"] + U1, second["J", "J"] + U2
    return first, second


def autodiff_derivatives(law: Law, I: Invariants) -> tuple[First, Second]:
    """The scalar derivatives of `law.strain_energy` by forward mode: what a law gets that states only its energy."""
    names = [n for n in ORDER if n in law.invariants]
    values = tuple(getattr(I, n) for n in names)
    ones = [
        tuple(jnp.ones_like(v) if k == j else jnp.zeros_like(v) for k, v in enumerate(values))
        for j in range(len(names))
    ]

    def W(*v):
        return law.strain_energy(Invariants(**dict(zip(names, v, strict=True))))

    def slope(j):
        return lambda *v: jax.jvp(W, v, ones[j])[1]

    first = {n: slope(j)(*values) for j, n in enumerate(names)}
    second = {
        (names[a], names[b]): jax.jvp(slope(a), values, ones[b])[1]
        for a in range(len(names))
        for b in range(a, len(names))
    }
    return first, second


def isochoric_part(law: Law) -> Law | None:
    """The law without its volumetric energy, or `None` where an energy has no such split (or is only volumetric)."""
    parts = [replace(s, bulk=None) if hasattr(s, "isochoric_energy") else None for s in summands(law)]
    if any(p is None and not isinstance(s, Volumetric) for p, s in zip(parts, summands(law), strict=True)):
        return None
    kept = tuple(p for p in parts if p is not None)
    return None if not kept else kept[0] if len(kept) == 1 else Sum(laws=kept)


def volumetric_part(law: Law) -> Law | None:
    """U(J) of a split law as a law of its own, or `None` where there is none."""
    kept = tuple(Volumetric(bulk=s.bulk, volumetric=s.volumetric) for s in summands(law) if s.bulk is not None)
    return None if not kept else kept[0] if len(kept) == 1 else Sum(laws=kept)
