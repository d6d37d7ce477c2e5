"""Laws as sums of products g(I1, I2) h(J), and functions of such sums (book chapter, section 4.1.2 i)."""

from collections.abc import Callable
from math import comb
from typing import NamedTuple

import jax
import jax.numpy as jnp

from liverjax.core.errors import InputError
from liverjax.core.struct import Number
from liverjax.laws.base import Law, Volumetric
from liverjax.laws.families.arruda_boyce import COEFFICIENTS, ArrudaBoyce
from liverjax.laws.families.fung_demiray import FungDemiray
from liverjax.laws.families.mooney_rivlin import MooneyRivlin
from liverjax.laws.families.neo_hookean import NeoHookean, NeoHookeanCompressible
from liverjax.laws.families.saint_venant_kirchhoff import SaintVenantKirchhoff
from liverjax.laws.families.veronda_westmann import VerondaWestmann
from liverjax.laws.families.yeoh import Yeoh
from liverjax.tensors.matrices import Invariants


class Product(NamedTuple):
    """One product W^k = c I1^i I2^j J^p of an energy."""

    c: Number
    i: int
    j: int
    p: float


class Group(NamedTuple):
    """A function phi(s) of the sum s of products W^k. `slopes` returns phi'(s) and phi''(s); None means phi(s) = s."""

    products: list[Product]
    slopes: Callable[[Number], tuple[Number, Number]] | None = None


def _isochoric(c: Number, i: int, j: int) -> list[Product]:
    """Expand c (Ibar1 - 3)^i (Ibar2 - 3)^j into products by the binomial theorem, without the constant term."""
    return [
        Product(c * comb(i, a) * comb(j, b) * (-3.0) ** (i - a + j - b), a, b, -2 * a / 3 - 4 * b / 3)
        for a in range(i + 1)
        for b in range(j + 1)
        if a + b
    ]


def groups(law: Law) -> list[Group]:
    """Return groups of products whose sum is the energy of a law, without constants and terms that depend only on J.

    `law` must not be a sum of laws.

    Raises:
        InputError: the energy is not a function of such products.
    """
    match law:
        case NeoHookean():
            return [Group(_isochoric(law.mu / 2, 1, 0))]
        case NeoHookeanCompressible():
            return [Group([Product(law.mu / 2, 1, 0, 0.0)])]
        case SaintVenantKirchhoff():
            a, m = law.lame_lambda / 8 + law.mu / 4, law.mu
            linear = -3 / 4 * law.lame_lambda - m / 2
            return [Group([Product(a, 2, 0, 0.0), Product(linear, 1, 0, 0.0), Product(-m / 2, 0, 1, 0.0)])]
        case MooneyRivlin():
            return [Group([p for c, i, j in law.terms() for p in _isochoric(c, i, j)])]
        case Yeoh():
            return [Group([p for k, c in enumerate((law.c1, law.c2, law.c3), 1) for p in _isochoric(c, k, 0)])]
        case ArrudaBoyce():
            N = law.chain_length
            return [
                Group([Product(law.mu * c / N ** (k - 1), k, 0, -2 * k / 3) for k, c in enumerate(COEFFICIENTS, 1)])
            ]
        case FungDemiray():
            return [_exponential(law.c1 / (2 * law.c2), law.c2)]
        case VerondaWestmann():
            return [_exponential(law.c1, law.c2), Group([Product(-law.c1 * law.c2 / 2, 0, 1, -4 / 3)])]
        case Volumetric():
            return []
    raise InputError(f"law {type(law).__name__} is not a sum of products g(I1, I2) h(J): use terms = 'contracted'")


def _exponential(scale: Number, factor: Number) -> Group:
    """Return the group for the energy scale exp(factor (Ibar1 - 3))."""

    def slopes(s: Number) -> tuple[Number, Number]:
        e = scale * factor * jnp.exp(factor * (s - 3))
        return e, factor * e

    return Group([Product(1.0, 1, 0, -2 / 3)], slopes)


def functions_of_volume(law: Law, J: Number) -> list[tuple[jax.Array, jax.Array]]:
    """Return the derivatives h' and h'' of the products with g = 1, which depend only on J."""
    if isinstance(law, NeoHookeanCompressible):
        first, second = law.energy_derivatives(Invariants(J=J))
        return [(first["J"], second["J", "J"])]
    volume = law.volumetric_part()
    if volume is None:
        return []
    first, second = volume.energy_derivatives(Invariants(J=J))
    return [(first["J"], second["J", "J"])]
