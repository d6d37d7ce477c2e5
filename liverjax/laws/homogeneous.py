"""Homogeneous tests of an incompressible sample: deformation gradients and nominal stresses."""

from typing import Any

import jax
import jax.numpy as jnp

from liverjax.core.errors import InputError
from liverjax.core.struct import Number
from liverjax.laws.base import Law
from liverjax.laws.terms.stretch_terms import stress_at_constant
from liverjax.tensors.matrices import pack, unpack

#: Test -> prescribed quantity: a stretch, or the amount of shear.
TESTS = {"uniaxial": "stretch", "equibiaxial": "stretch", "pure_shear": "stretch", "simple_shear": "shear"}


def deformation_gradient(test: str, driven: Number, stretch: Any = 1.0) -> jax.Array:
    """Return deformation gradients F (..., 3, 3) with det F = 1, for a sample without traction along axis 3.

    Args:
        test: one of `TESTS`.
        driven: stretches along axis 1 (in `equibiaxial` also along axis 2) or amounts of shear, any shape (...).
        stretch: uniaxial stretch along axis 1 before the shear, only for `simple_shear`.
    """
    v = jnp.asarray(driven, float)
    zero, one = jnp.zeros_like(v), jnp.ones_like(v)
    if test == "uniaxial":
        side = v**-0.5
        rows = ((v, zero, zero), (zero, side, zero), (zero, zero, side))
    elif test == "equibiaxial":
        rows = ((v, zero, zero), (zero, v, zero), (zero, zero, v**-2))
    elif test == "pure_shear":
        rows = ((v, zero, zero), (zero, one, zero), (zero, zero, 1 / v))
    elif test == "simple_shear":
        side = stretch**-0.5 * one
        rows = ((stretch * one, v, zero), (zero, side, zero), (zero, zero, side))
    else:
        raise InputError(f"test {test!r} is not known: use one of {', '.join(TESTS)}")
    return jnp.stack([jnp.stack(row, axis=-1) for row in rows], axis=-2)


def nominal_stress(law: Law, F: jax.Array, constant: bool = False) -> jax.Array:
    """Return the first Piola-Kirchhoff stress (..., 3, 3) [Pa] of an incompressible sample, traction-free along axis 3.

    P = dW/dF - p cof F, with the pressure p for which P_33 = 0. The volumetric energy of a law does not contribute. A
    law without a separate volumetric energy is evaluated at det F = 1. `constant` = True is allowed only if no
    derivative with respect to F is needed, for example if F is measured. For a law of principal stretches, the
    derivatives with respect to its parameters then need much less time.
    """
    split = law.isochoric_part()
    if constant and split is not None and split.stretch_energy is not None:
        P = F @ pack(stress_at_constant(split, unpack(F)))
    else:
        P = (law if split is None else split).first_piola(F)
    cofactor = jnp.stack([jnp.cross(F[..., k - 2, :], F[..., k - 1, :]) for k in range(3)], axis=-2)
    return P - (P[..., 2, 2] / cofactor[..., 2, 2])[..., None, None] * cofactor


def measured(test: str, P: jax.Array) -> jax.Array:
    """Return the component of P that a test measures: P_11, or P_12 in simple shear."""
    return P[..., 0, 1] if test == "simple_shear" else P[..., 0, 0]


def response(law: Law, test: str, driven: Number, stretch: Number = 1.0) -> jax.Array:
    """Return the nominal stress [Pa] that a test measures, at stretches or amounts of shear `driven` (...)."""
    return measured(test, nominal_stress(law, deformation_gradient(test, driven, stretch)))
