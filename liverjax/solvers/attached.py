"""Stiffness of additional elements between nodes of the body (springs, contact …), and consistent element masses."""

from collections.abc import Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from liverjax.mesh.tetrahedra import TetMesh
from liverjax.solvers.block_matrix import Block, BlockMatrix, added
from liverjax.tensors.places import given, taken


class Attached(NamedTuple):
    """Stiffness matrices of m additional elements with n nodes each."""

    nodes: jax.Array  # (n, m) node numbers
    blocks: jax.Array  # (n, 3, n, 3, m) [N/m], symmetric unless there is friction


class GivesWay(NamedTuple):
    """Rank-one change -h h^T / size of the stiffness due to an eliminated unknown (e.g. the motion of an obstacle)."""

    h: jax.Array  # (V, 3) [N/m] forces on the nodes per unit of this unknown
    size: jax.Array  # () [N/m] stiffness of this unknown if the nodes do not move


class Masses(NamedTuple):
    """Consistent mass matrix minus lumped mass matrix of each element, or this difference times k/dt^2.

    The difference times k/dt^2 is a term of the effective stiffness of a time step dt. The number k depends on the time
    integration (see `liverjax.physics.inertia`). n is the number of nodes of an element.
    """

    nodes: jax.Array  # (n, E) node numbers
    signs: jax.Array  # (n, E) 1, or -1 for a shape function with reversed direction
    matrix: jax.Array  # (n, n) symmetric matrix, the same for all elements
    size: jax.Array  # (E,) [kg] or [N/m] factor of `matrix` in each element


#: Stiffness between nodes that is not part of the assembled matrix.
Between = Attached | GivesWay | Masses


def masses(mesh: TetMesh, matrix: np.ndarray, size: jax.Array) -> Masses:
    """Return `Masses` with the same `matrix` (n, n) for all elements, and one factor `size` (E,) for each element.

    n is the number of nodes of an element.
    """
    nodes = jnp.stack(mesh.element_nodes)
    signs = mesh.oriented(jnp.ones((len(nodes), 1, nodes.shape[1]), size.dtype))[:, 0]
    return Masses(nodes, signs, jnp.asarray(matrix, size.dtype), size)


def _shared(A: Masses, columns: Sequence[jax.Array]) -> tuple[jax.Array, ...]:
    moved = A.signs[:, None] * jnp.stack([taken(c, A.nodes) for c in columns], axis=1)
    force = (A.size[None] * A.signs)[:, None] * jnp.tensordot(A.matrix, moved, axes=(1, 0))
    return tuple(given(jnp.zeros_like(c), A.nodes, force[:, k]) for k, c in enumerate(columns))


def product(A: Between, columns: Sequence[jax.Array]) -> tuple[jax.Array, ...]:
    """Multiply A by a nodal motion, given by its columns (V,). Return the nodal forces as columns (V,)."""
    if isinstance(A, Masses):
        return _shared(A, columns)
    if isinstance(A, GivesWay):
        share = -sum(jnp.vdot(h, c) for h, c in zip(A.h.T, columns, strict=True)) / A.size
        return tuple(share * A.h.T)
    moved = jnp.stack([c[A.nodes] for c in columns], axis=1)
    force = jnp.sum(A.blocks * moved[None, None], axis=(2, 3))
    total = jnp.zeros((len(columns[0]), 3), force.dtype).at[A.nodes].add(jnp.swapaxes(force, 1, 2))
    return tuple(total.T)


def own_diagonal(A: Attached, number_of_nodes: int) -> Block:
    """Return the diagonal blocks of A at the nodes: 3 x 3 arrays (V,)."""
    # If a node occurs twice in an element, the block between both entries of the node is also on the diagonal.
    same = A.nodes[:, None] == A.nodes[None]
    own = jnp.sum(jnp.where(same[:, None, :, None], A.blocks, 0.0), axis=2)  # (n, 3, 3, m)
    own = jnp.zeros((number_of_nodes, 3, 3), own.dtype).at[A.nodes].add(jnp.transpose(own, (0, 3, 1, 2)))
    return tuple(tuple(own[:, r, c] for c in range(3)) for r in range(3))


def with_attached(mesh: TetMesh, A: BlockMatrix, attached: Sequence[Attached]) -> BlockMatrix:
    """Add the blocks `attached` to the matrix A of the vertices, except blocks of vertices that share no element."""
    if not attached:
        return A
    rows = jnp.stack([jnp.stack(row[:3]) for row in A.rows[:3]])
    total: Block = tuple(row[:3] for row in A.diagonal[:3])
    for one in attached:
        own = one if mesh.order == 1 else on_vertices(mesh, one)
        near, other = own.nodes[:, None], own.nodes[None]
        found = A.nodes[:, own.nodes][:, :, None] == other[None]  # (W, n, n, m)
        there = jnp.any(found, axis=0) & (near != other)
        values = jnp.where(there[:, None, :, None], own.blocks, 0.0)  # (n, 3, n, 3, m)
        near = jnp.broadcast_to(near, there.shape)
        rows = rows.at[:, :, jnp.argmax(found, axis=0), near].add(jnp.transpose(values, (1, 3, 0, 2, 4)))
        total = added(total, own_diagonal(own, mesh.number_of_vertices))
    return BlockMatrix(tuple(map(tuple, rows)), total, A.nodes)


def on_vertices(mesh: TetMesh, A: Attached) -> Attached:
    """Restrict A to motions that are linear along edges.

    In such a motion, the displacement of a midside node is the mean of the displacements at both ends of its edge.
    """
    V, (low, high) = mesh.number_of_vertices, mesh.pattern.edges
    edge = jnp.clip(A.nodes - V, 0, low.shape[0] - 1)
    is_vertex = A.nodes < V
    ends = [jnp.where(is_vertex, A.nodes, end[edge]) for end in (low, high)]
    quarter = 0.25 * A.blocks
    both = jnp.concatenate([quarter, quarter])
    return Attached(jnp.concatenate(ends), jnp.concatenate([both, both], axis=2))


def symmetric_part(A: Attached) -> Attached:
    """Replace the stiffness matrix of each additional element by its symmetric part."""
    return Attached(A.nodes, 0.5 * (A.blocks + jnp.transpose(A.blocks, (2, 3, 0, 1, 4))))


def definite(A: Attached) -> Attached:
    """Replace each element matrix by its symmetric part, with the negative eigenvalues set to 0."""
    n, m = A.nodes.shape
    K = jnp.moveaxis(A.blocks.reshape(3 * n, 3 * n, m), -1, 0)
    size, axes = jnp.linalg.eigh(0.5 * (K + jnp.swapaxes(K, 1, 2)))
    K = jnp.einsum("mik,mk,mjk->mij", axes, jnp.maximum(size, 0.0), axes)
    return Attached(A.nodes, jnp.moveaxis(K, 0, -1).reshape(A.blocks.shape))
