"""Integrals of fields over nodes, and values of nodal fields at the points of elements."""

import jax
import jax.numpy as jnp

from liverjax.mesh.basis import basis
from liverjax.mesh.tetrahedra import TetMesh
from liverjax.tensors.places import given, taken


def to_nodes(mesh: TetMesh, share: jax.Array) -> jax.Array:
    """Sum (V,) at every vertex: each element gives `share` (E,) to each of its vertices."""
    total = jnp.zeros(mesh.number_of_vertices, share.dtype)
    for a in range(4):
        total = given(total, mesh.tetrahedra[:, a], share)
    return total


def integrals(mesh: TetMesh, density: jax.Array) -> jax.Array:
    """Integrals over the reference volume of a density times the linear function of every vertex: (V,).

    Args:
        density: one number for each quadrature point, (E,) or (Q, E), or one for each element (E,).
    """
    if density.ndim == 1:
        return to_nodes(mesh, mesh.volumes * density / 4)
    return gathered(mesh, mesh.weights * density)


def gathered(mesh: TetMesh, shares: jax.Array) -> jax.Array:
    """The transpose of `interpolated`: sums (V,) at the vertices of values at the points (Q, E)."""
    if mesh.order == 1:
        return to_nodes(mesh, shares / 4)
    parts = jnp.asarray(basis(mesh.order).L, shares.dtype) @ shares
    return given(jnp.zeros(mesh.number_of_vertices, shares.dtype), mesh.tetrahedra.T, parts)


def summed(mesh: TetMesh, values: jax.Array) -> jax.Array:
    """Sums over the points of every element: (E,)."""
    return values if mesh.order == 1 else jnp.sum(values, axis=0)


def interpolated(mesh: TetMesh, values: jax.Array) -> jax.Array:
    """Values at the points, (E,) or (Q, E), of a field that is linear in every element, from the vertices (V,)."""
    corner = [taken(values, mesh.tetrahedra[:, a]) for a in range(4)]
    if mesh.order == 1:
        return (corner[0] + corner[1] + corner[2] + corner[3]) / 4
    L = jnp.asarray(basis(mesh.order).L, values.dtype)
    return sum((L[a][:, None] * corner[a][None] for a in range(1, 4)), L[0][:, None] * corner[0][None])


#: Parts of an element's volume at its vertices and at the middles of its edges: of a lumped mass (Hinton, Rock and
#: Zienkiewicz 1976: positive, in proportion to the integrals of squares), and integrals of the functions themselves.
_LUMPED = {1: (1 / 4,), 2: (1 / 36, 4 / 27)}
_INTEGRALS = {1: (1 / 4,), 2: (-1 / 20, 1 / 5), 3: (-1 / 20, 1 / 5)}


def nodal_volumes(mesh: TetMesh) -> jax.Array:
    """Lumped mass over density (V,) [m^3]: a quarter of every linear element at each of its nodes."""
    return _weighted_parts(mesh, _LUMPED[min(mesh.order, 2)])


def load_volumes(mesh: TetMesh) -> jax.Array:
    """Integrals of the shape functions (V,) [m^3]: the nodal forces of a uniform weight of 1 N/m^3."""
    total = _weighted_parts(mesh, _INTEGRALS[mesh.order])
    if mesh.order < 3:
        return total
    bubbles = jnp.stack(mesh.element_nodes[-4:])
    return given(total, bubbles, jnp.broadcast_to(9 / 40 * mesh.volumes, bubbles.shape))


def _weighted_parts(mesh: TetMesh, parts: tuple[float, ...]) -> jax.Array:
    nodes = jnp.stack(mesh.element_nodes[: 4 if mesh.order == 1 else 10])
    own = jnp.array([parts[a >= 4] for a in range(len(nodes))], mesh.volumes.dtype)
    return given(jnp.zeros(mesh.number_of_nodes, mesh.volumes.dtype), nodes, own[:, None] * mesh.volumes[None])
