"""Integrals of fields times shape functions, and values of nodal fields at the integration points of elements."""

from functools import cache, partial
from itertools import product
from math import factorial

import jax
import jax.numpy as jnp
import numpy as np

from liverjax.core.struct import Number
from liverjax.mesh.adjacency import PAIRS
from liverjax.mesh.shape_functions import FACES, basis
from liverjax.mesh.tetrahedra import TetMesh
from liverjax.tensors.places import given, taken


def to_nodes(mesh: TetMesh, share: jax.Array) -> jax.Array:
    """Return sums (V,) at the vertices: each element adds its `share` (E,) to each of its vertices."""
    total = jnp.zeros(mesh.number_of_vertices, share.dtype)
    for a in range(4):
        total = given(total, mesh.tetrahedra[:, a], share)
    return total


def integrals(mesh: TetMesh, density: jax.Array) -> jax.Array:
    """Integrate a density times the linear shape function of every vertex over the reference volume. Returns (V,).

    Args:
        density: one number for each element (E,), or one for each of the Q integration points of each element (Q, E).
    """
    if density.ndim == 1:
        return to_nodes(mesh, mesh.volumes * density / 4)
    return gathered(mesh, mesh.weights * density)


def gathered(mesh: TetMesh, shares: jax.Array) -> jax.Array:
    """Multiply values at the integration points by the linear shape functions. Return the sums (V,) at the vertices.

    `shares`: values (Q, E) at Q points per element, or (E,) in linear elements. The function is the transpose of
    `interpolated`.
    """
    if mesh.order == 1:
        return to_nodes(mesh, shares / 4)
    parts = jnp.asarray(basis(mesh.order).L, shares.dtype) @ shares
    return given(jnp.zeros(mesh.number_of_vertices, shares.dtype), mesh.tetrahedra.T, parts)


def summed(mesh: TetMesh, values: jax.Array) -> jax.Array:
    """Return the sums (E,) over the integration points of every element."""
    return values if mesh.order == 1 else jnp.sum(values, axis=0)


def interpolated(mesh: TetMesh, values: jax.Array) -> jax.Array:
    """Interpolate a field that is linear in each element from the vertices (V,) to the integration points.

    Return values (E,) in linear elements, otherwise (Q, E) with Q integration points per element.
    """
    corner = [taken(values, mesh.tetrahedra[:, a]) for a in range(4)]
    if mesh.order == 1:
        return (corner[0] + corner[1] + corner[2] + corner[3]) / 4
    L = jnp.asarray(basis(mesh.order).L, values.dtype)
    return sum((L[a][:, None] * corner[a][None] for a in range(1, 4)), L[0][:, None] * corner[0][None])


#: Order of the elements -> fraction of an element's volume for each vertex, and for each middle of an edge. `_LUMPED`
#: is for the lumped mass (Hinton, Rock and Zienkiewicz 1976). These fractions are positive and proportional to the
#: integrals of the squared shape functions. `_INTEGRALS` is for the integrals of the shape functions.
_LUMPED = {1: (1 / 4,), 2: (1 / 36, 4 / 27)}
_INTEGRALS = {1: (1 / 4,), 2: (-1 / 20, 1 / 5), 3: (-1 / 20, 1 / 5)}


@partial(jax.jit, inline=True)
def nodal_volumes(mesh: TetMesh) -> jax.Array:
    """Return lumped mass divided by density (V,) [m^3]. In linear elements, a vertex gets a quarter of the volume."""
    return lumped_sums(mesh, mesh.volumes)


def lumped_sums(mesh: TetMesh, size: jax.Array) -> jax.Array:
    """Divide each element's `size` (E,) among its nodes like a lumped mass. Return the sums (V,) at the nodes."""
    return _weighted_parts(mesh, _LUMPED[min(mesh.order, 2)], size)


@partial(jax.jit, inline=True)
def load_volumes(mesh: TetMesh) -> jax.Array:
    """Return the integrals of the shape functions (V,) [m^3]: the nodal forces [N] of a uniform weight of 1 N/m^3."""
    return _shared_as_loads(mesh, mesh.volumes)


def weighing_masses(mesh: TetMesh, density: Number, mass: str) -> jax.Array:
    """Return the weight of the body at its nodes, divided by gravity (V,) [kg].

    If the density is given per node, and the body has quadratic elements or consistent masses, each element gets one
    density (`element_density`). So its total weight is its total mass times gravity, and a free body with linear
    elements or with consistent masses falls without deformation.

    Args:
        density: one number, or one for each node (V,) [kg/m^3].
        mass: lumped or consistent.
    """
    if jnp.ndim(density) and (mesh.order > 1 or mass == "consistent"):
        return _shared_as_loads(mesh, element_density(mesh, jnp.asarray(density)) * mesh.volumes)
    return density * load_volumes(mesh)


def _shared_as_loads(mesh: TetMesh, size: jax.Array) -> jax.Array:
    """Divide each element's `size` (E,) among its nodes like a uniform load. Return the sums (V,) at the nodes."""
    total = _weighted_parts(mesh, _INTEGRALS[mesh.order], size)
    if mesh.order < 3:
        return total
    bubbles = jnp.stack(mesh.element_nodes[-4:])
    return given(total, bubbles, jnp.broadcast_to(9 / 40 * size, bubbles.shape))


def element_density(mesh: TetMesh, density: jax.Array) -> jax.Array:
    """Return the density (E,) [kg/m^3] of every element: the sum of its lumped masses, divided by its volume.

    `density`: one number for each node (V,).
    """
    vertex, *middle = _LUMPED[min(mesh.order, 2)]
    mean = jnp.mean(density[mesh.tetrahedra], axis=1)
    if not middle:
        return mean
    return 4 * vertex * mean + middle[0] * jnp.sum(density[jnp.stack(mesh.element_nodes[4:10])], axis=0)


def _weighted_parts(mesh: TetMesh, parts: tuple[float, ...], size: jax.Array) -> jax.Array:
    nodes = jnp.stack(mesh.element_nodes[: 4 if mesh.order == 1 else 10])
    own = jnp.array([parts[a >= 4] for a in range(len(nodes))], size.dtype)
    return given(jnp.zeros(mesh.number_of_nodes, size.dtype), nodes, own[:, None] * size[None])


@cache
def mass_parts(order: int) -> tuple[np.ndarray, np.ndarray]:
    """Split the consistent mass matrix of an element, divided by its mass, into a diagonal and a remainder.

    For n nodes of the element, the diagonal has the shape (n,) and the remainder has the shape (n, n). The diagonal is
    the lumped mass. Functions of order 3 have no lumped mass: they keep the diagonal entries of the consistent mass
    matrix.
    """
    whole = products(order)
    parts, lumped = np.diag(whole).copy(), _LUMPED[min(order, 2)]
    parts[:4], parts[4:10] = lumped[0], lumped[-1]
    return parts, whole - np.diag(parts)


@cache
def products(order: int) -> np.ndarray:
    """Return the exact integrals of products of two shape functions over an element, divided by its volume: a matrix
    (n, n) for n functions."""
    vertex = [tuple(int(k == a) for k in range(4)) for a in range(4)]
    if order == 1:
        functions: list[dict[tuple, float]] = [{v: 1.0} for v in vertex]
    else:
        functions = [{tuple(2 * n for n in v): 2.0, v: -1.0} for v in vertex]
        functions += [{_exponents(vertex, i, j): 4.0} for i, j in PAIRS]
    if order == 3:
        functions += [{_exponents(vertex, i, i, j): 1.0, _exponents(vertex, i, j, j): -1.0} for i, j in PAIRS]
        functions += [{_exponents(vertex, i, j, k): 27.0} for i, j, k in FACES]

    def integral(f: dict[tuple, float], g: dict[tuple, float]) -> float:
        total = 0.0
        for (p, a), (q, b) in product(f.items(), g.items()):
            powers = np.add(p, q)
            total += a * b * 6 * np.prod([factorial(n) for n in powers]) / factorial(int(powers.sum()) + 3)
        return total

    return np.array([[integral(f, g) for g in functions] for f in functions])


def _exponents(vertex: list[tuple], *which: int) -> tuple:
    """Return the exponents of the product of the linear functions with the indices `which`. `vertex`: exponents of each
    linear function."""
    return tuple(sum(v) for v in zip(*(vertex[k] for k in which), strict=True))
