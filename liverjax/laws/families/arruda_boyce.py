"""Arruda-Boyce: the eight-chain law that the book chapter uses for liver."""

from typing import ClassVar

from liverjax.core.struct import Number, param, static, struct
from liverjax.laws.base import Law

#: Series coefficients from the inverse Langevin function. The printed chapter lacks the numerators (11, 19, 519).
COEFFICIENTS = (1 / 2, 1 / 20, 11 / 1050, 19 / 7000, 519 / 673750)


@struct
class ArrudaBoyce(Law):
    """W = mu sum_k c_k / N^(k-1) (Ibar1^k - 3^k) + U(J), k = 1 … 5.

    Book chapter, Table 1 with corrected numerators; Arruda and Boyce 1993. c_k are the `COEFFICIENTS`, and N is
    `chain_length`. mu = n k_B Theta, with n chains per volume, Boltzmann's constant k_B and the temperature Theta.
    """

    mu: Number = param("Pa", "n k_B Theta", above=0.0, typical=730.0)
    chain_length: Number = param("1", "number N of rigid links in a chain", above=0.0, typical=8.0)
    bulk: Number = param("Pa", "bulk modulus", above=0.0, typical=7700.0)
    volumetric: str = static(default="quadratic", about="quadratic, log or simo")
    invariants: ClassVar = ("I1", "J")

    def isochoric_energy(self, I1, I2):
        """Return the energy: the series, written as a multiple of (Ibar1 - 3) to avoid cancellation at rest."""
        total = 0.0
        for k, c in enumerate(COEFFICIENTS, start=1):
            # (I^k - 3^k) = (I - 3) sum_m I^m 3^(k-1-m), by Horner's rule.
            quotient = 1.0
            for m in range(1, k):
                quotient = quotient * I1 + 3.0**m
            total = total + c / self.chain_length ** (k - 1) * quotient
        return self.mu * (I1 - 3) * total

    def isochoric_derivatives(self, I1, I2):
        """Return the first and second derivative with respect to Ibar1, by Horner's rule."""
        t = I1 / self.chain_length
        slope, curvature = 0.0, 0.0
        for k, c in reversed(list(enumerate(COEFFICIENTS, start=1))):
            slope = slope * t + k * c
            if k > 1:
                curvature = curvature * t + k * (k - 1) * c
        return {"I1": self.mu * slope}, {("I1", "I1"): self.mu / self.chain_length * curvature}

    def shear_modulus(self):
        """Return the shear modulus mu (1 + 3/(5 N) + 99/(175 N^2) + …) [Pa]: twice dW/dIbar1 at rest."""
        return 2 * self.isochoric_derivatives(3.0, None)[0]["I1"]
