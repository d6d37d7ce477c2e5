"""Element stiffness without negative eigenvalues, computed from the singular values of F, without LAPACK.

Let F = U diag(s) V^T. In the axes of U and V, the second derivative of an isotropic energy has two kinds of blocks: one
3 x 3 matrix for the three stretches, and one 2 x 2 matrix [[a, b], [b, a]] for each pair of axes. The eigenvalues of
the 2 x 2 matrix are a - b (twist) and a + b (flip) (Smith, De Goes, Kim 2019, Analytic eigensystems for isotropic
distortion energies). Negative eigenvalues are replaced by their absolute values (Chen et al. 2024). Then the blocks are
rotated back to the coordinate axes.

The terms of fibres, of Green's strain and of the history variables of viscosity have other axes than U and V. For
Green's strain and viscosity, the geometric stiffness uses the stress S, with its eigenvalues replaced by their absolute
values. The negative part of the stiffness of a fibre is omitted. Then no term has a negative eigenvalue, so the sum of
the terms has no negative eigenvalue either.
"""

from typing import Any, NamedTuple

import jax.numpy as jnp

from liverjax.core.struct import Number
from liverjax.laws.base import Law
from liverjax.laws.derivatives import accumulate
from liverjax.laws.energies import fibre_invariants
from liverjax.laws.terms import green_terms, invariant_terms
from liverjax.laws.terms.invariant_terms import Scalars
from liverjax.tensors.directions import components
from liverjax.tensors.matrices import (
    Matrix,
    Vector,
    add,
    add_matrices,
    cross,
    dot,
    matmul,
    matvec,
    outer,
    scale,
    scale_matrix,
    transpose,
)
from liverjax.tensors.principal import principal, symmetric_axes
from liverjax.tensors.subsets import in_subset, put_together

_PAIRS = ((0, 1), (0, 2), (1, 2))


class Frame(NamedTuple):
    """Decomposition F = U diag(s) V^T with rotations U and V.

    The last singular value s is the smallest. It is negative if det F < 0.
    """

    U: Matrix
    s: Vector
    V: Matrix


def frame(F: Matrix) -> Frame:
    """Return the signed singular values of a tuple matrix F (the largest first) and their axes.

    If a singular value is 0, its axes are arbitrary.
    """
    _, axes = principal(F)
    n = list(transpose(axes))
    f = [matvec(F, a) for a in n]
    for i, j in ((0, 1), (1, 2), (0, 1)):  # a swap changes one sign, so that the axes stay right-handed
        swap = dot(f[j], f[j]) > dot(f[i], f[i])
        n[i], n[j] = _chosen(swap, n[j], n[i]), _chosen(swap, scale(-1.0, n[i]), n[j])
        f[i], f[j] = _chosen(swap, f[j], f[i]), _chosen(swap, scale(-1.0, f[i]), f[j])
    one, zero = jnp.ones_like(f[0][0]), jnp.zeros_like(f[0][0])
    u1 = _unit(f[0], (one, zero, zero))
    # A direction perpendicular to u1, from a coordinate axis that is not close to u1.
    small = abs(u1[0]) < 0.8
    aside = cross(u1, (jnp.where(small, one, zero), jnp.where(small, zero, one), zero))
    rest = add(f[1], scale(-dot(f[1], u1), u1))
    enough = dot(rest, rest) > 1e-24 * dot(f[0], f[0])
    u2 = _unit(_chosen(enough, rest, aside), (zero, one, zero))
    u: Matrix = (u1, u2, cross(u1, u2))
    return Frame(transpose(u), tuple(dot(a, b) for a, b in zip(u, f, strict=True)), transpose(tuple(n)))


def _chosen(where: Number, a: Vector, b: Vector) -> Vector:
    return tuple(jnp.where(where, x, y) for x, y in zip(a, b, strict=True))


def _unit(a: Vector, otherwise: Vector) -> Vector:
    size = jnp.sqrt(dot(a, a))
    return _chosen(size > 0, scale(1 / jnp.where(size > 0, size, 1.0), a), otherwise)


def blocks(
    parts: list[tuple[Number, Law]],
    S: Matrix | None,
    F: Matrix,
    D: list[Vector],
    pairs: tuple[tuple[int, int], ...],
    volume: Scalars | None = None,
) -> list[Matrix]:
    """Return the blocks of `invariant_terms.blocks`, changed such that the element matrix has no negative eigenvalue.

    Args:
        parts: pairs (weight, law). The energy is the weighted sum of the energies of the laws.
        S: constant second Piola-Kirchhoff stress that is added, or None.
        F: deformation gradient, a tuple matrix.
        D: gradients of the shape functions of the nodes.
        pairs: node pairs of the blocks, as indices into D.
        volume: derivatives of a volumetric energy that is added, or None.
    """
    if any(law.subsets is not None for _, law in parts):
        return _by_subset(parts, S, F, D, pairs, volume)
    first: dict[str, object] = {}
    second: dict[tuple[str, str], object] = {}
    stretched, added = [], []
    metric = None if S is None else projected(S)
    for weight, law in parts:
        slopes, curvatures = law.energy_derivatives(law.measures(F))
        fibres = fibre_invariants(law.summands())
        for key, part in fibres.items():
            a = components(part.fibre, F[0][0])
            added.append(_fibre(weight * slopes[key], weight * curvatures.get((key, key), 0.0), a, F, D, pairs))
        _gather(first, weight, {k: v for k, v in slopes.items() if k not in fibres})
        _gather(second, weight, {k: v for k, v in curvatures.items() if not set(k) & set(fibres)})
        for part in law.summands():
            if part.stretch_energy is not None:
                stretched.append((weight, part.isochoric_part()))
            if part.green_energy is not None:
                added.append([scale_matrix(weight, block) for block in green_terms.blocks(part, F, D, pairs)])
                own = projected(scale_matrix(weight, green_terms.stress(part, F)))
                metric = own if metric is None else add_matrices(metric, own)
    if volume is not None:
        _gather(first, 1.0, volume.first)
        _gather(second, 1.0, volume.second)
    result = _isotropic(Scalars(first, second), stretched, F, D, pairs)
    if metric is not None:
        added.append([_diagonal_matrix(dot(D[i], matvec(metric, D[j]))) for i, j in pairs])
    for more in added:
        result = [add_matrices(a, b) for a, b in zip(result, more, strict=True)]
    return result


def _by_subset(
    parts: list[tuple[Number, Law]], S: Matrix | None, F: Matrix, D: list[Vector], pairs: tuple, volume: Scalars | None
) -> list[Matrix]:
    """Return the result of `blocks` for a body whose regions have laws of different kinds. Each law is evaluated only
    in the elements of its region."""
    groups = next(law.subsets for _, law in parts if law.subsets is not None)

    def own(k: int) -> list[Matrix]:
        weights = [(in_subset(groups, k, weight), law.piece(k)) for weight, law in parts]
        inner, here, corners, scalars = in_subset(groups, k, (S, F, D, volume))
        return blocks(weights, inner, here, corners, pairs, scalars)

    return put_together(groups, [own(k) for k in range(len(groups.elements))])


def regularised(
    parts: list[tuple[Number, Law]],
    S: Matrix | None,
    F: Matrix,
    D: list[Vector],
    pairs: tuple[tuple[int, int], ...],
    volume: Scalars | None = None,
) -> list[Matrix]:
    """Return stiffness blocks with the chapter's regularisation. Eigenvalues may still be negative (see `blocks`)."""
    result = [_diagonal_matrix(jnp.zeros_like(F[0][0]) if S is None else dot(D[i], matvec(S, D[j]))) for i, j in pairs]

    def with_more(weight: Number, state: invariant_terms.State | invariant_terms.Pieces) -> list[Matrix]:
        K = invariant_terms.blocks(state, D, pairs, regularised=True)
        return [add_matrices(a, scale_matrix(weight, b)) for a, b in zip(result, K, strict=True)]

    for weight, law in parts:
        result = with_more(weight, invariant_terms.state(law, F))
    return result if volume is None else with_more(1.0, invariant_terms.state_of(volume, F))


def _gather(total: dict, weight: Number, values: dict) -> None:
    for key, value in values.items():
        accumulate(total, key, weight * value)


def _diagonal_matrix(value: Any) -> Matrix:
    zero = jnp.zeros_like(value)
    return ((value, zero, zero), (zero, value, zero), (zero, zero, value))


def _fibre(W4: Number, W44: Number, a: Vector, F: Matrix, D: list[Vector], pairs: tuple) -> list[Matrix]:
    """Return the stiffness (a.D_i)(a.D_j) (2 W_4 I + 4 W_44 Fa (x) Fa) of a fibre. Negative eigenvalues are set to 0.

    W_4 and W_44 are derivatives with respect to the invariant I4, a is the fibre direction, and D_i are the gradients
    of the shape functions.
    """
    Fa = matvec(F, a)
    across = jnp.maximum(2 * W4, 0.0)
    along = jnp.maximum(2 * W4 + 4 * W44 * dot(Fa, Fa), 0.0)
    size = dot(Fa, Fa)
    line = scale_matrix((along - across) / jnp.where(size > 0, size, 1.0), outer(Fa, Fa))
    both = add_matrices(_diagonal_matrix(across), line)
    return [scale_matrix(dot(D[i], a) * dot(D[j], a), both) for i, j in pairs]


def projected(A: Matrix) -> Matrix:
    """Replace the eigenvalues of a symmetric tuple matrix by their absolute values."""
    axes = symmetric_axes(A)
    n = transpose(axes)
    return _from_axes([abs(dot(a, matvec(A, a))) for a in n], n)


def _from_axes(values: list, n: Matrix) -> Matrix:
    total = scale_matrix(values[0], outer(n[0], n[0]))
    for value, a in zip(values[1:], n[1:], strict=True):
        total = add_matrices(total, scale_matrix(value, outer(a, a)))
    return total


def _isotropic(scalars: Scalars, stretched: list, F: Matrix, D: list[Vector], pairs: tuple) -> list[Matrix]:
    at = frame(F)
    zero = jnp.zeros_like(at.s[0])
    diagonal = tuple(tuple(at.s[i] if i == j else zero for j in range(3)) for i in range(3))
    tangents = [(1.0, invariant_terms.tangent(invariant_terms.state_of(scalars, diagonal)))]
    for weight, law in stretched:
        tangents.append((weight, invariant_terms.tangent(invariant_terms.state(law, diagonal))))

    def entry(i, J, k, L):
        return sum((weight * A[J][L][i][k] for weight, A in tangents), 0.0)

    H = tuple(tuple(entry(min(i, k), min(i, k), max(i, k), max(i, k)) for k in range(3)) for i in range(3))
    H = projected(H)
    own, crossed = {}, {}
    for i, j in _PAIRS:
        a = 0.5 * (entry(i, j, i, j) + entry(j, i, j, i))
        b = entry(i, j, j, i)
        flip, twist = abs(a + b), abs(a - b)
        own[i, j] = own[j, i] = 0.5 * (flip + twist)
        crossed[i, j] = crossed[j, i] = 0.5 * (flip - twist)
    turned = [matvec(transpose(at.V), d) for d in D]
    result = []
    for p, q in pairs:
        d, e = turned[p], turned[q]
        K = [[H[i][k] * d[i] * e[k] for k in range(3)] for i in range(3)]
        for i in range(3):
            for j in range(3):
                if i != j:
                    K[i][i] = K[i][i] + own[i, j] * d[j] * e[j]
                    K[i][j] = K[i][j] + crossed[i, j] * d[j] * e[i]
        result.append(matmul(matmul(at.U, tuple(map(tuple, K))), transpose(at.U)))
    return result
