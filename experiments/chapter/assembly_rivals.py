"""Other methods that compute the same numbers, for comparison: force and the 45 entries of every element's stiffness.

All use the layout of `liverjax.elements.mjed` (the element index last, every scalar written out), except the vmapped
Hessian. With `write`, a method writes intermediate results that several blocks need to memory
(`liverjax.tensors.matrices.stored`), as the contracted method does. Without it, the formulas are those of textbooks,
and the compiler decides. Which variant is faster depends on the method, so both are measured. The vmapped Hessian has
no intermediate results that could be written.
"""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp

from liverjax.elements import mjed
from liverjax.laws.terms import chapter_terms, green_terms, invariant_terms, stretch_terms
from liverjax.mesh.tetrahedra import TetMesh
from liverjax.tensors.material_axes import SIX, six_of, symmetric
from liverjax.tensors.matrices import (
    Matrix,
    add_matrices,
    cofactor,
    deformation_gradient,
    determinant,
    dot,
    matmul,
    matvec,
    right_cauchy_green,
    scale_matrix,
    stored,
    transpose,
)

#: The blocks that are written, for nodes 1 to 3 of an element, by indices of the shape vectors.
PAIRS = ((0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2))
ENTRIES = [(k, r, c) for k, (a, b) in enumerate(PAIRS) for r in range(3) for c in range(r if a == b else 0, 3)]


def _shape_vectors(mesh: TetMesh) -> list:
    return [tuple(mesh.shape_vectors[a]) for a in range(3)]


def _entries(mesh: TetMesh, blocks: list) -> list:
    return [mesh.volumes * blocks[k][r][c] for k, r, c in ENTRIES]


def contracted(mesh: TetMesh, law: Any, x: jax.Array) -> tuple:
    """The method of `liverjax`: all terms of the energy are added before the contraction with the shape vectors."""
    F = stored(deformation_gradient(mesh, x))
    shared = invariant_terms.state(law, F)
    force = mjed.nodal_force(mesh, invariant_terms.piola(F, shared.cof, invariant_terms.stress(shared)))
    return force, _entries(mesh, invariant_terms.blocks(shared, _shape_vectors(mesh), PAIRS))


def chapter(mesh: TetMesh, law: Any, x: jax.Array, constant: list | None = None, write: bool = False) -> tuple:
    """Six terms for every product, section 4.1.2. The `constant` matrices are stored, or computed on the fly."""
    F = _kept(write)(deformation_gradient(mesh, x))
    force = mjed.nodal_force(mesh, chapter_terms.first_piola(law, F))
    layout = chapter_terms.Layout(constant, write)
    return force, _entries(mesh, chapter_terms.blocks(law, F, _shape_vectors(mesh), PAIRS, False, layout))


def stored_matrices(mesh: TetMesh) -> list:
    """Return the constant matrices for `chapter`: 60 numbers per element."""
    return chapter_terms.constant_matrices(_shape_vectors(mesh), PAIRS)


def _kept(write: bool) -> Callable:
    return stored if write else lambda values: values


def standard(mesh: TetMesh, law: Any, x: jax.Array, write: bool = False) -> tuple:
    """Standard finite elements: B^T D B and D_a . S D_b, with C^-1 in S and D (Zienkiewicz and Taylor 2000)."""
    keep = _kept(write)
    F = keep(deformation_gradient(mesh, x))
    axes = law.material_axes(F[0][0])
    turned = law.fibre is not None
    FA = matmul(F, axes) if turned else F
    D = [matvec(transpose(axes), d) if turned else d for d in _shape_vectors(mesh)]
    S, moduli = keep(_elasticity(law, F, FA))
    SD = [matvec(S, d) for d in D]
    B = keep([_strain_displacement(FA, d) for d in D])
    DB = [[[_sum(moduli[p][q] * b[q][c] for q in range(6)) for c in range(3)] for p in range(6)] for b in B]
    blocks = []
    for i, j in PAIRS:
        geometric = dot(D[i], SD[j])
        blocks.append(
            [
                [_sum(B[i][p][r] * DB[j][p][c] for p in range(6)) + (geometric if r == c else 0.0) for c in range(3)]
                for r in range(3)
            ]
        )
    P = matmul(matmul(FA, S), transpose(axes)) if turned else matmul(FA, S)
    return mjed.nodal_force(mesh, P), _entries(mesh, blocks)


def _sum(values: Any) -> Any:
    first, *rest = values
    for v in rest:
        first = first + v
    return first


def _strain_displacement(F: Matrix, D: tuple) -> list:
    """Return the matrix (6, 3) from the displacement of a node to Green's strain, with doubled shear components."""
    return [[F[k][i] * D[i] if i == j else F[k][i] * D[j] + F[k][j] * D[i] for k in range(3)] for i, j in SIX]


def _elasticity(law: Any, F: Matrix, FA: Matrix) -> tuple[Matrix, list]:
    """Return the second Piola-Kirchhoff stress and dS/dE (6, 6), in the material axes."""
    first, second = law.energy_derivatives(law.measures(F))
    C = right_cauchy_green(FA)
    I1, J = C[0][0] + C[1][1] + C[2][2], determinant(FA)
    inverse = scale_matrix(1 / (J * J), cofactor(C))
    B = tuple(tuple((I1 if i == j else 0.0) - C[i][j] for j in range(3)) for i in range(3))
    one = (1.0, 1.0, 1.0, 0.0, 0.0, 0.0)
    slopes = {"I1": one, "I2": six_of(B), "J": tuple(J / 2 * c for c in six_of(inverse))}
    S = symmetric(tuple(_sum([2 * W * slopes[a][p] for a, W in first.items()] or [0.0 * J]) for p in range(6)))
    moduli = [[_sum(_parts(first, second, slopes, inverse, J, p, q)) for q in range(6)] for p in range(6)]
    for part in law.summands():
        if part.stretch_energy is not None:
            frame = stretch_terms.principal(F)
            S = add_matrices(S, stretch_terms.stress(part, F, frame))
            more = stretch_terms.moduli(part, F, frame)
            moduli = [[moduli[p][q] + more[p][q] for q in range(6)] for p in range(6)]
        if part.green_energy is not None:
            more, m = part.green_derivatives(green_terms.green_strain(FA))
            S, six = add_matrices(S, more), six_of(more)
            for p in range(6):
                for q in range(6):
                    same = m.shear[p - 3] if p == q >= 3 else m.normal[p][q] if p < 3 and q < 3 else 0.0
                    moduli[p][q] = moduli[p][q] + same + m.curvature * six[p] * six[q]
    return S, moduli


def _parts(first: dict, second: dict, slopes: dict, inverse: Matrix, J: Any, p: int, q: int) -> list:
    """Return the contributions to 4 d2W/dC_p dC_q."""
    (i, j), (k, l) = SIX[p], SIX[q]
    parts = [0.0 * J]
    for (a, b), W in second.items():
        product = slopes[a][p] * slopes[b][q]
        parts.append(4 * W * (product if a == b else product + slopes[b][p] * slopes[a][q]))
    if "I2" in first:
        identity = 1.0 if p == q < 3 else 0.5 if p == q else 0.0
        weight = (1.0 if p < 3 and q < 3 else 0.0) - identity
        parts += [4 * weight * first["I2"]] if weight else []
    if "J" in first:
        both = inverse[i][k] * inverse[j][l] + inverse[i][l] * inverse[j][k]
        parts.append(first["J"] * J * (inverse[i][j] * inverse[k][l] - both))
    return parts


def autodiff(mesh: TetMesh, law: Any, x: jax.Array, write: bool = False) -> tuple:
    """dP/dF, 9 x 9, by forward-over-reverse differentiation of the energy, then contracted with the shape vectors."""
    F, D = _kept(write)(deformation_gradient(mesh, x)), _shape_vectors(mesh)
    ones, zeros = jnp.ones_like(F[0][0]), jnp.zeros_like(F[0][0])

    def stress(F):
        return jax.grad(lambda F: jnp.sum(law.strain_energy(law.measures(F))))(F)

    def column(k, q):
        direction = tuple(tuple(ones if (r, c) == (k, q) else zeros for c in range(3)) for r in range(3))
        return jax.jvp(stress, (F,), (direction,))[1]

    A = _kept(write)([[column(k, q) for q in range(3)] for k in range(3)])
    blocks = []
    for i, j in PAIRS:
        half = [
            [[_sum(A[c][q][r][p] * D[j][q] for q in range(3)) for p in range(3)] for c in range(3)] for r in range(3)
        ]
        blocks.append([[_sum(half[r][c][p] * D[i][p] for p in range(3)) for c in range(3)] for r in range(3)])
    return mjed.nodal_force(mesh, stress(F)), _entries(mesh, blocks)


def vmapped(mesh: TetMesh, law: Any, x: jax.Array) -> tuple:
    """`jax.vmap(jax.hessian)` of an element's energy over (E, 4, 3) positions: force and (E, 4, 3, 4, 3)."""
    D = jnp.transpose(mesh.shape_vectors, (2, 0, 1))
    D = jnp.concatenate([-D.sum(axis=1, keepdims=True), D], axis=1)

    def energy(nodes, D, volume):
        return volume * law.energy(nodes.T @ D)

    elements = (x[mesh.tetrahedra], D, mesh.volumes)
    force = jnp.zeros_like(x).at[mesh.tetrahedra].add(jax.vmap(jax.grad(energy))(*elements))
    return force, jax.vmap(jax.hessian(energy))(*elements)


def entries_of(hessians: jax.Array) -> list:
    """Return the 45 entries (E,) of full element matrices (E, 4, 3, 4, 3)."""
    return [hessians[:, PAIRS[k][0] + 1, r, PAIRS[k][1] + 1, c] for k, r, c in ENTRIES]


def floor(mesh: TetMesh, law: Any, x: jax.Array) -> list:
    """Write the 45 entries and do nothing else: a lower bound of the run time."""
    return [mesh.volumes * (k + 1.0) for k in range(45)]
