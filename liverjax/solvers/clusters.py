"""Dense inverse blocks for clusters of near nodes: a part of the preconditioner for meshes with thin elements.

In a thin element, nodes are coupled much more strongly through the thickness than along the element. In one iteration
with a block-Jacobi preconditioner, a motion spreads through the thickness by only one node. So each cluster of near
nodes (`liverjax.mesh.adjacency.Clusters`) is treated as one block.
"""

from collections.abc import Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp

from liverjax.mesh.adjacency import Clusters
from liverjax.mesh.shape_functions import basis
from liverjax.solvers import block_matrix
from liverjax.solvers.block_matrix import Block, BlockMatrix
from liverjax.solvers.point_matrix import PointMatrix
from liverjax.tensors.places import given, taken

#: Number of stiffness blocks that are computed at the same time, for quadratic elements.
_AT_ONCE = 2048


class Inverses(NamedTuple):
    """Inverse blocks of single nodes (0 for nodes in clusters), and of G clusters of at most M nodes."""

    nodes: Block  # inverse blocks of single nodes, 3 x 3 arrays (V,)
    clusters: jax.Array | None = None  # (G, 3 M, 3 M) inverse blocks of clusters; None if there are no clusters


def inverses(
    clusters: Clusters | None, entries: jax.Array | None, diagonal: Block, mask: jax.Array, single: Block
) -> Inverses:
    """Compute the inverse blocks of clusters and of single nodes.

    If the matrix of a cluster is not positive definite, its nodes are treated as single nodes.

    Args:
        clusters: clusters of the mesh, or None if the mesh has no clusters.
        entries: blocks (n, 3, 3) of the matrix, one for each of the n entries of `clusters.sources`.
        diagonal: diagonal blocks of the matrix, 3 x 3 arrays (V,).
        mask: (V, 3) 1 for free directions, else 0.
        single: inverse blocks of single nodes, 3 x 3 arrays (V,).
    """
    if clusters is None or entries is None:
        return Inverses(single)
    G, M = clusters.nodes.shape
    above = given(jnp.zeros((G * M * M, 3, 3), entries.dtype), clusters.places, entries).reshape(G, M, M, 3, 3)
    own = jnp.stack([jnp.stack(row, axis=-1) for row in diagonal], axis=-2)
    own = taken(own, clusters.nodes)[:, :, None] * jnp.eye(M, dtype=own.dtype)[None, :, :, None, None]
    K = jnp.transpose(above + jnp.transpose(above, (0, 2, 1, 4, 3)) + own, (0, 1, 3, 2, 4)).reshape(G, 3 * M, 3 * M)
    free = (taken(mask, clusters.nodes) * clusters.there[..., None]).reshape(G, 3 * M).astype(K.dtype)
    K = K * free[:, :, None] * free[:, None, :] + jax.vmap(jnp.diag)(1 - free)
    factor = jnp.linalg.cholesky(K)
    half = jax.vmap(lambda L: jax.scipy.linalg.solve_triangular(L, jnp.eye(3 * M, dtype=L.dtype), lower=True))(factor)
    inverse = jnp.einsum("gki,gkj->gij", half, half)
    good = jnp.all(jnp.isfinite(inverse), axis=(1, 2))
    inverse = jnp.where(good[:, None, None], inverse, 0.0) * free[:, :, None] * free[:, None, :]
    inside = clusters.there * good[:, None]
    outside = 1 - given(jnp.zeros(len(mask), inside.dtype), clusters.nodes, inside)
    return Inverses(tuple(tuple(outside * entry for entry in row) for row in single), inverse)


def smoothed(clusters: Clusters | None, A: Inverses, columns: Sequence[jax.Array]) -> tuple[jax.Array, ...]:
    """Multiply a nodal vector, given by its columns (V,), by the inverse blocks. Return columns (V,)."""
    single = block_matrix.applied(A.nodes, columns)
    if clusters is None or A.clusters is None:
        return single
    shape = (*clusters.nodes.shape, 3)
    near = (taken(jnp.stack(columns, axis=-1), clusters.nodes) * clusters.there[..., None]).reshape(shape[0], -1)
    moved = jnp.einsum("gij,gj->gi", A.clusters, near).reshape(shape)
    total = given(jnp.stack(single, axis=-1), clusters.nodes, moved)
    return tuple(total[:, k] for k in range(3))


def of_rows(clusters: Clusters | None, edge_slots: jax.Array, A: BlockMatrix) -> jax.Array | None:
    """Return blocks (n, 3, 3) of the matrix A of the vertices, one for each of the n entries of `clusters.sources`."""
    if clusters is None:
        return None
    slots = taken(edge_slots, clusters.sources[0])
    entries = [jnp.stack([taken(entry.ravel(), slots) for entry in row[:3]], axis=-1) for row in A.rows[:3]]
    return jnp.stack(entries, axis=-2)


def of_points(clusters: Clusters | None, order: int, A: PointMatrix) -> jax.Array | None:
    """Return blocks (n, 3, 3) of A between two shape functions a and b, for the n entries of `clusters.sources`.

    A block is the sum of c_ak K_kl c_bl over the integration points of the element and over k, l = 1, 2, 3. c_ak is the
    derivative of function a with respect to the barycentric coordinate k, minus its derivative with respect to
    coordinate 0. K_kl are the blocks of A.
    """
    if clusters is None:
        return None
    c = basis(order).c
    slopes = jnp.asarray(c[:, 1:] - c[:, :1], A.blocks[1, 1][0][0].dtype)  # (n, 3, Q)
    pairs = sorted(A.blocks)
    # The first axis counts the elements, so that the numbers of one element are close together in memory.
    K = jnp.stack([jnp.stack([jnp.stack(row) for row in A.blocks[pair]]) for pair in pairs])
    K = jnp.moveaxis(K, -1, 0)  # (E, 6, 3, 3, Q)

    def entry(source):
        element, one, other, sign = source
        a, b, own = slopes[one], slopes[other], K[element]
        block = jnp.zeros((3, 3), K.dtype)
        for place, (k, m) in enumerate(pairs):
            block = block + own[place] @ (a[k - 1] * b[m - 1])
            if k != m:
                block = block + (own[place] @ (a[m - 1] * b[k - 1])).T
        return sign * block

    return jax.lax.map(entry, clusters.sources, batch_size=_AT_ONCE)
