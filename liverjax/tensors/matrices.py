"""Deformation gradients and invariants. Every component is an array over the elements.

A vector is a tuple of three arrays (E,). A matrix is a tuple of three such rows (a "tuple matrix"). In this form XLA
vectorises over the elements. XLA does not vectorise batched products of arrays (E, 3, 3).
"""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from liverjax.core.errors import InputError
from liverjax.core.struct import Number, T

Vector = tuple[Any, ...]
Matrix = tuple[Vector, ...]

IDENTITY: Matrix = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))


class Invariants(NamedTuple):
    """Strain measures (E,) on which a strain energy depends. A measure is None if the law does not use it."""

    I1: Any = None  # tr C
    I2: Any = None  # (I1^2 - tr C^2) / 2
    I4: jax.Array | None = None  # a . C a, with the fibre direction a of the law
    J: Any = None  # det F
    stretches: Any = None  # `liverjax.tensors.principal.Stretches`
    E: Any = None  # Green's strain, a tuple matrix in the axes of the law


def dot(a: Vector, b: Vector) -> Any:
    """Return the scalar product a . b."""
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


def cross(a: Vector, b: Vector) -> Vector:
    """Return the vector product a x b."""
    return (a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0])


def add(*vectors: Vector) -> Vector:
    """Return the sum of vectors."""
    return tuple(sum(c[1:], c[0]) for c in zip(*vectors, strict=True))


def scale(s: Number, a: Vector) -> Vector:
    """Return the product of a scalar and a vector."""
    return (s * a[0], s * a[1], s * a[2])


def scale_matrix(w: Number, A: Matrix) -> Matrix:
    """Return the product of a scalar and a matrix."""
    return tuple(scale(w, row) for row in A)


def matvec(A: Matrix, v: Vector) -> Vector:
    """Return the product of a matrix and a vector."""
    return (dot(A[0], v), dot(A[1], v), dot(A[2], v))


def transpose(A: Matrix) -> Matrix:
    """Return the transposed matrix."""
    return tuple(zip(*A, strict=True))


def matmul(A: Matrix, B: Matrix) -> Matrix:
    """Return the product A B of two matrices."""
    columns = transpose(B)
    return tuple(tuple(dot(row, c) for c in columns) for row in A)


def cofactor(F: Matrix) -> Matrix:
    """Return the cofactor cof F = J F^-T, from cross products of the columns of F. It is also finite at J = 0."""
    c0, c1, c2 = transpose(F)
    return transpose((cross(c1, c2), cross(c2, c0), cross(c0, c1)))


def determinant(F: Matrix) -> jax.Array:
    """Return the determinant J = det F."""
    c0, c1, c2 = transpose(F)
    return dot(c0, cross(c1, c2))


def right_cauchy_green(F: Matrix) -> Matrix:
    """Return the right Cauchy-Green tensor C = F^T F. Only its six different entries are computed."""
    c = transpose(F)
    xx, yy, zz, xy, xz, yz = (dot(c[a], c[b]) for a, b in ((0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2)))
    return ((xx, xy, xz), (xy, yy, yz), (xz, yz, zz))


def invariants(names: tuple[str, ...], F: Matrix) -> Invariants:
    """Return the invariants of F whose names are in `names` (possible names: I1, I2 and J)."""
    values = {}
    if "I1" in names or "I2" in names:
        values["I1"] = sum(dot(row, row) for row in F)
    if "I2" in names:
        trace_C2 = sum(dot(row, row) for row in right_cauchy_green(F))
        values["I2"] = 0.5 * (values["I1"] * values["I1"] - trace_C2)
    if "J" in names:
        values["J"] = determinant(F)
    return Invariants(**{n: values[n] for n in names if n in values})


def green_strain(FA: Matrix) -> Matrix:
    """Return Green's strain E = (C - I) / 2 in axes A (the columns of a rotation), from the product F A."""
    C = right_cauchy_green(FA)
    return tuple(tuple(0.5 * (C[i][j] - (1.0 if i == j else 0.0)) for j in range(3)) for i in range(3))


def outer(a: Vector, b: Vector) -> Matrix:
    """Return the tensor product a (x) b."""
    return tuple(scale(x, b) for x in a)


def unit(a: Vector) -> Vector:
    """Return the unit vector a / |a|."""
    return scale(1 / jnp.sqrt(dot(a, a)), a)


def add_matrices(A: Matrix, B: Matrix) -> Matrix:
    """Return the sum A + B of two matrices."""
    return tuple(add(a, b) for a, b in zip(A, B, strict=True))


def unpack(F: jax.Array) -> Matrix:
    """Convert an array (..., 3, 3) to a tuple matrix of arrays (...)."""
    return tuple(tuple(F[..., i, j] for j in range(3)) for i in range(3))


def pack(A: Matrix) -> jax.Array:
    """Convert a tuple matrix of arrays (...) to an array (..., 3, 3)."""
    return jnp.stack([jnp.stack(jnp.broadcast_arrays(*row), axis=-1) for row in A], axis=-2)


def stored(values: T) -> T:
    """Return a pytree with the same values, stored in memory (RAM).

    Without the branch (`lax.cond`) in this function, XLA on the CPU would compute the values again for every use. The
    leaves are numbers or arrays. At least one leaf must not be empty.
    """
    values = jax.tree.map(jnp.asarray, values)
    number = max(jax.tree.leaves(values), key=jnp.size).ravel()[0]
    always = (number != -jnp.inf) | (number < 0)  # true for every number and for NaN; the compiler does not know this
    return jax.lax.cond(always, lambda v: v, lambda v: jax.tree.map(jnp.zeros_like, v), values)


def deformation_gradient(mesh: Any, x: jax.Array) -> Matrix:
    """Return the deformation gradient F = sum_a (x_a - x_0) (x) D_a over a = 1, 2, 3.

    x_a are the positions of the nodes of an element, and D_a the gradients of their shape functions. The sum of all
    D_a, including D_0, is 0. The entries of F are (E,), or (Q, E) if elements have Q integration points
    (`TetMesh.edges`).

    Args:
        mesh: `TetMesh`.
        x: current positions (V, 3) [m]. For another field (V, 3), the result is the gradient of that field.

    Raises:
        InputError: x does not have the shape (V, 3). Without this check, a node number that is too large would give the
            position of the last node, without an error.
    """
    if jnp.shape(x) != mesh.points.shape:
        raise InputError(
            f"the positions have shape {jnp.shape(x)}: give one row of 3 per node, shape {mesh.points.shape}"
        )
    edges = mesh.edges([x[:, c] for c in range(3)])
    D = mesh.gradients
    return tuple(tuple(sum(edges[a][i] * D[a, j] for a in range(3)) for j in range(3)) for i in range(3))
