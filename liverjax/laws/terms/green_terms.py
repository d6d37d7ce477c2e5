"""Hand-derived stress and stiffness of energies w(E) of Green's strain in the axes of the material."""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from liverjax.laws.energies import Energies
from liverjax.tensors.material_axes import (
    SIX,
    anisotropic,
    half_contracted,
    orthotropic,
    pushed,
    rotated,
    six_of,
    symmetric,
)
from liverjax.tensors.matrices import (
    Matrix,
    Vector,
    add_matrices,
    green_strain,
    matmul,
    matvec,
    outer,
    scale,
    stored,
    transpose,
)


class GreenModuli(NamedTuple):
    """Moduli dS/dE of the stress S, in the axes of the material: orthotropic moduli plus `curvature` times S (x) S."""

    normal: Matrix  # C_mmnn
    shear: Vector  # C_mnmn of the pairs 12, 13, 23
    curvature: jax.Array


def stress(law: Energies, F: Matrix) -> Matrix:
    """Return the second Piola-Kirchhoff stress [Pa] of the energy w(E) only."""
    A = law.material_axes(F[0][0])
    return rotated(_stress_of_strain(law, green_strain(matmul(F, A))), A)


def blocks(law: Energies, F: Matrix, D: list[Vector], pairs: tuple) -> list[Matrix]:
    """Return the part of the stiffness d2w/dx_i dx_j per reference volume that contains the moduli.

    The result has one matrix for each pair (i, j) of nodes with shape vectors D.
    """
    A = law.material_axes(F[0][0])
    FA = matmul(F, A)
    E, turned = green_strain(FA), [matvec(transpose(A), d) for d in D]
    if law.green_derivatives is None:
        half = [half_contracted(_autodiff_moduli(law, E), d) for d in turned]
        return [pushed(FA, anisotropic(half[j], turned[i])) for i, j in pairs]
    S, moduli = stored(law.green_derivatives(E))
    r = stored([matvec(FA, matvec(S, d)) for d in turned])
    return [
        add_matrices(
            pushed(FA, orthotropic(moduli.normal, moduli.shear, turned[i], turned[j])),
            outer(scale(moduli.curvature, r[i]), r[j]),
        )
        for i, j in pairs
    ]


def _stress_of_strain(law: Energies, E: Matrix) -> Matrix:
    if law.green_derivatives is not None:
        return law.green_derivatives(E)[0]
    return symmetric(tuple(_slopes(lambda six: law.green_energy(symmetric(six)), six_of(E))))


def _slopes(function: Any, six: tuple) -> list:
    """Differentiate with respect to the six entries of a symmetric E. For a shear, E_ij and E_ji each change by 1/2."""
    result = []
    for k, (i, j) in enumerate(SIX):
        weight = 1.0 if i == j else 0.5
        tangents = tuple(jnp.full_like(v, weight if k == m else 0.0) for m, v in enumerate(six))
        result.append(jax.jvp(function, (six,), (tangents,))[1])
    return result


def _autodiff_moduli(law: Energies, E: Matrix) -> list[list]:
    six = six_of(E)
    return [
        _slopes(lambda six, a=a: _slopes(lambda six: law.green_energy(symmetric(six)), six)[a], six) for a in range(6)
    ]
