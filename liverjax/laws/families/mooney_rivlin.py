"""Generalised Mooney-Rivlin law up to third order."""

from typing import Any, ClassVar

from liverjax.core.struct import Number, param, static, struct
from liverjax.laws.base import Law
from liverjax.laws.derivatives import accumulate

_POWERS = {"c10": (1, 0), "c01": (0, 1), "c20": (2, 0), "c11": (1, 1), "c02": (0, 2)} | {
    "c30": (3, 0),
    "c21": (2, 1),
    "c12": (1, 2),
    "c03": (0, 3),
}


def _monomial(coefficient: float, *factors: tuple[Any, int]) -> Number:
    """Compute coefficient * prod x^n by multiplication, since JAX's derivative of x**0 is NaN at x = 0."""
    value = coefficient
    for x, n in factors:
        for _ in range(n):
            value = value * x
    return value


@struct
class MooneyRivlin(Law):
    """W = sum c_ij (Ibar1 - 3)^i (Ibar2 - 3)^j + U(J), i + j <= 3.

    Book chapter, Table 1. A coefficient that is not given is 0. The term of this coefficient is not computed, and the
    coefficient cannot be fitted.
    """

    c10: Number = param("Pa", "coefficient of (Ibar1 - 3)", typical=300.0)
    c01: Number = param("Pa", "coefficient of (Ibar2 - 3)", typical=85.0)
    c20: Number | None = param("Pa", "coefficient of (Ibar1 - 3)^2", default=None)
    c11: Number | None = param("Pa", "coefficient of (Ibar1 - 3)(Ibar2 - 3)", default=None)
    c02: Number | None = param("Pa", "coefficient of (Ibar2 - 3)^2", default=None)
    c30: Number | None = param("Pa", "coefficient of (Ibar1 - 3)^3", default=None)
    c21: Number | None = param("Pa", "coefficient of (Ibar1 - 3)^2 (Ibar2 - 3)", default=None)
    c12: Number | None = param("Pa", "coefficient of (Ibar1 - 3)(Ibar2 - 3)^2", default=None)
    c03: Number | None = param("Pa", "coefficient of (Ibar2 - 3)^3", default=None)
    bulk: Number = param("Pa", "bulk modulus", above=0.0, typical=7700.0)
    volumetric: str = static(default="quadratic", about="quadratic, log or simo")
    invariants: ClassVar = ("I1", "I2", "J")

    def terms(self):
        """Return (c_ij, i, j) for every coefficient c_ij that is given."""
        return [(getattr(self, name), i, j) for name, (i, j) in _POWERS.items() if getattr(self, name) is not None]

    def isochoric_energy(self, I1, I2):
        """Return the energy: a polynomial in Ibar1 - 3 and Ibar2 - 3."""
        a, b = I1 - 3, I2 - 3
        return sum(c * _monomial(1.0, (a, i), (b, j)) for c, i, j in self.terms())

    def isochoric_derivatives(self, I1, I2):
        """Return the first and second derivatives of the polynomial, without derivatives that are always 0."""
        a, b = I1 - 3, I2 - 3
        first, second = {}, {}
        for c, i, j in self.terms():
            if i:
                accumulate(first, "I1", c * _monomial(i, (a, i - 1), (b, j)))
            if j:
                accumulate(first, "I2", c * _monomial(j, (a, i), (b, j - 1)))
            if i > 1:
                accumulate(second, ("I1", "I1"), c * _monomial(i * (i - 1), (a, i - 2), (b, j)))
            if i and j:
                accumulate(second, ("I1", "I2"), c * _monomial(i * j, (a, i - 1), (b, j - 1)))
            if j > 1:
                accumulate(second, ("I2", "I2"), c * _monomial(j * (j - 1), (a, i), (b, j - 2)))
        return first, second

    def shear_modulus(self):
        """Return the ground-state shear modulus 2 (c10 + c01) [Pa]."""
        return 2 * (self.c10 + self.c01)
