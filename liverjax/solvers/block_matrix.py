"""Symmetric block matrices with one block for each pair of neighbouring nodes, assembled from element blocks.

All rows are padded to one length. The row of each node stores the numbers of its neighbours, so a matrix-vector product
needs no search for column indices. The block of each edge is assembled only once, for both nodes. Forces do not change
if the body is translated, so a diagonal block is minus the sum of the other blocks in its row. The calling function
adds other terms to the diagonal.
"""

from collections.abc import Iterable, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from liverjax.core.struct import Number
from liverjax.mesh.adjacency import PAIRS, Pattern
from liverjax.mesh.tetrahedra import TetMesh
from liverjax.tensors.matrices import cofactor, dot, stored
from liverjax.tensors.places import given, taken

#: An m x m matrix as nested tuples of arrays.
Block = tuple[tuple[Any, ...], ...]


class BlockMatrix(NamedTuple):
    """A symmetric matrix (V m, V m) of m x m blocks for V nodes. Each entry of a block is an array over the nodes."""

    rows: Block  # arrays (W, V): blocks between each node and its neighbours (at most W neighbours)
    diagonal: Block  # arrays (V,): diagonal blocks
    nodes: jax.Array  # (W, V) node numbers of the neighbours


def off_diagonal(mesh: TetMesh, blocks: dict[tuple[int, int], Block]) -> Block:
    """Assemble the blocks between nodes and their W neighbours: m x m arrays (W, V).

    Each block is the sum of the element blocks of `PAIRS`, m x m arrays (E,). An entry that is None in all element
    blocks stays None.
    """
    pattern: Pattern = mesh.pattern
    m = len(blocks[PAIRS[0]])
    # The blocks are stored as arrays. Otherwise XLA:CPU would compute every entry again in each scatter operation.
    blocks = stored(blocks)
    number = pattern.edges.shape[1]
    swapped = {(a, b): mesh.tetrahedra[:, a] > mesh.tetrahedra[:, b] for a, b in PAIRS}
    places = jnp.concatenate(list(pattern.element_edges))
    edge: list[list[Any]] = [[None] * m for _ in range(m)]
    for r in range(m):
        for c in range(m):
            if blocks[PAIRS[0]][r][c] is None:
                continue
            own = [blocks[pair] for pair in PAIRS]
            values = [
                K[r][c] if r == c else jnp.where(swapped[p], K[c][r], K[r][c]) for p, K in zip(PAIRS, own, strict=True)
            ]
            total = given(jnp.zeros(number + 1, mesh.points.dtype), places, jnp.concatenate(values))
            edge[r][c] = total
    gathered: list[list[Any]] = [[None if e is None else taken(e, pattern.row_edges) for e in row] for row in edge]
    upward = jnp.arange(mesh.number_of_vertices, dtype=jnp.int32)[None] < pattern.row_nodes
    return tuple(
        tuple(gathered[r][c] if r == c else jnp.where(upward, gathered[r][c], gathered[c][r]) for c in range(m))
        for r in range(m)
    )


def row_sums(rows: Block) -> Block:
    """Return the sums of the blocks over the neighbours of each node: m x m arrays (V,)."""
    return tuple(tuple(jnp.sum(entry, axis=0) for entry in row) for row in rows)


def force_matrix(mesh: TetMesh, blocks: dict[tuple[int, int], Block], own: Block | None = None) -> BlockMatrix:
    """Assemble the stiffness matrix from 3 x 3 element blocks between different nodes and from additional node blocks.

    Args:
        mesh: `TetMesh`.
        blocks: blocks of every element for the node pairs `PAIRS`, with entries (E,).
        own: blocks with entries (V,) that are added to the diagonal. An entry that is 0 may be None.
    """
    rows = off_diagonal(mesh, blocks)
    sums = row_sums(rows)
    diagonal = tuple(tuple(-sums[min(r, c)][max(r, c)] for c in range(3)) for r in range(3))
    return BlockMatrix(rows, diagonal if own is None else added(diagonal, own), mesh.pattern.row_nodes)


def added(a: Block, b: Block) -> Block:
    """Return the sum of two blocks. An entry that is None counts as 0."""

    def plus(x: Number, y: Number) -> Number:
        return y if x is None else x if y is None else x + y

    return tuple(tuple(map(plus, *rows)) for rows in zip(a, b, strict=True))


def inverse_blocks(diagonal: Block, mask: jax.Array, normals: jax.Array | None = None) -> Block:
    """Invert the 3 x 3 diagonal blocks. Where `mask` (V, 3) is 0, rows and columns are as in the identity matrix.

    If a block is not positive definite, the mean of the absolute values on its diagonal is inverted instead. `normals`
    (V, 3) are unit vectors or 0. Nodes do not move along their normals. So the coupling of a block with the normal
    direction is removed, and the entry along the normal becomes the mean of the block's diagonal (see `_across`).
    """
    if normals is not None:
        diagonal = _across(diagonal, normals)
    A = [
        [diagonal[r][c] * mask[:, r] * mask[:, c] + (1 - mask[:, r] if r == c else 0.0) for c in range(3)]
        for r in range(3)
    ]
    rows = tuple(map(tuple, A))
    cof = cofactor(rows)
    det = dot(rows[0], cof[0])
    positive = (A[0][0] > 0) & (cof[2][2] > 0) & (det > 0) & jnp.isfinite(det)
    size = jnp.abs(A[0][0]) + jnp.abs(A[1][1]) + jnp.abs(A[2][2])
    mean = jnp.where((size > 0) & jnp.isfinite(size), size / 3, 1.0)
    safe = jnp.where(positive, det, 1.0)
    return tuple(
        tuple(jnp.where(positive, cof[r][c] / safe, 1 / mean if r == c else 0.0) for c in range(3)) for r in range(3)
    )


def _across(A: Block, normals: jax.Array) -> Block:
    """Return (I - n n^T) A (I - n n^T) + mean n n^T, with the normals n and the mean of the diagonal of A."""
    n = normals.T
    mean = (A[0][0] + A[1][1] + A[2][2]) / 3
    An = [sum(A[r][c] * n[c] for c in range(3)) for r in range(3)]
    both = sum(n[r] * An[r] for r in range(3)) + mean
    return tuple(tuple(A[r][c] - n[r] * An[c] - An[r] * n[c] + both * n[r] * n[c] for c in range(3)) for r in range(3))


def applied(blocks: Block, columns: Sequence[jax.Array]) -> tuple[jax.Array, ...]:
    """Multiply the block of each node, m x k arrays (V,), by the k entries of the vector there. Return columns (V,)."""
    return tuple(_row(row, columns) for row in blocks)


def product(A: BlockMatrix, columns: Sequence[jax.Array]) -> tuple[jax.Array, ...]:
    """Return A v as m columns (V,), for v with k columns (V,). Only the first k columns of the blocks are used."""

    def add(slot, total):
        near = [taken(column, A.nodes[slot]) for column in columns]
        return tuple(t + _row([e[slot] for e in row], near) for t, row in zip(total, A.rows, strict=True))

    # With a loop over the neighbours, the gathered values stay in the cache of the processor.
    return jax.lax.fori_loop(0, A.nodes.shape[0], add, applied(A.diagonal, columns))


def _row(entries: Any, columns: Sequence[jax.Array]) -> jax.Array:
    return sum(entry * column for entry, column in zip(entries, columns, strict=False))


def sums(a: Sequence[jax.Array], b: Iterable[jax.Array]) -> tuple[jax.Array, ...]:
    """Return the sum of two nodal vectors, each given by its columns (V,)."""
    return tuple(x + y for x, y in zip(a, b, strict=True))


def columns(vector: jax.Array) -> tuple[jax.Array, ...]:
    """Return the columns x, y and z (V,) of a flat vector (3 V,): first all x, then all y, then all z."""
    return tuple(vector.reshape(3, -1))


def flat(field: jax.Array) -> jax.Array:
    """Return the flat vector (3 V,) of a field (V, 3): first all x, then all y, then all z."""
    return field.T.ravel()
