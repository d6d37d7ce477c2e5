"""Symmetric matrices of quadratic elements, stored as blocks at their integration points.

A matrix-vector product needs no assembled matrix. At every integration point, an element behaves like a linear element
with other corners (see `liverjax.mesh.shape_functions`). So the symmetric stiffness at a point has 45 different
numbers. A product interpolates the motion to these corners, multiplies it by the blocks, and distributes the forces to
the nodes. The second level of the preconditioner is an assembled matrix of linear elements on the vertices.
"""

from collections.abc import Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from liverjax.core.struct import Number
from liverjax.elements import mjed
from liverjax.mesh.adjacency import PAIRS
from liverjax.mesh.nodal import gathered, interpolated, summed
from liverjax.mesh.promotion import on_middles
from liverjax.mesh.shape_functions import basis
from liverjax.mesh.tetrahedra import TetMesh
from liverjax.solvers import block_matrix
from liverjax.solvers.block_matrix import Block, BlockMatrix
from liverjax.tensors.matrices import Matrix, Vector, dot, stored, transpose
from liverjax.tensors.places import given


class PointMatrix(NamedTuple):
    """Matrix of the linearised equations. It contains the stiffness of the nodal forces. If the vertices have
    pressures, it also contains the derivatives of the volumes with respect to the positions, and the block of the
    pressures.

    Each of E elements has Q integration points.
    """

    blocks: dict[tuple[int, int], Matrix]  # stiffness K_ab for corners 1 <= a <= b <= 3, arrays (Q, E) [N/m]
    own: Block | None  # stiffness of forces at nodes, 3 x 3 arrays (V,); entries that are 0 are None
    border: list[Vector] | None  # (Q, E) [m^2] derivatives of a point's volume with respect to corners 1, 2, 3
    pressures: BlockMatrix | None  # block of the vertex pressures [m^3/Pa]


class Levels(NamedTuple):
    """The matrices of the two levels of the preconditioner."""

    diagonal: Block  # diagonal blocks of the matrix, 3 x 3 arrays (V,)
    vertices: BlockMatrix  # the matrix for motions that are linear in every element


def product(mesh: TetMesh, A: PointMatrix, columns: Sequence[jax.Array]) -> tuple[jax.Array, ...]:
    """Return the nodal forces, as columns (V,), due to a motion with columns (V,) at constant pressures."""
    moved = stored(mesh.edges(columns))
    forces = [_force(A.blocks, k, moved) for k in (1, 2, 3)]
    result = mesh.spread(forces)
    if A.own is None:
        return tuple(result)
    return tuple(
        f + sum(entry * c for entry, c in zip(row, columns, strict=True) if entry is not None)
        for f, row in zip(result, A.own, strict=True)
    )


def _force(blocks: dict[tuple[int, int], Matrix], k: int, moved: list[Vector]) -> Vector:
    rows = [blocks[k, b] if k <= b else transpose(blocks[b, k]) for b in (1, 2, 3)]
    return tuple(sum(dot(row[r], d) for row, d in zip(rows, moved, strict=True)) for r in range(3))


def volume_changes(mesh: TetMesh, A: PointMatrix, columns: Sequence[jax.Array]) -> jax.Array:
    """Return the change (V,) [m^3] of the volumes that belong to the vertices, for a motion with columns (V,)."""
    assert A.border is not None
    moved = stored(mesh.edges(columns))
    return gathered(mesh, sum(dot(g, d) for g, d in zip(A.border, moved, strict=True)))


def pull(mesh: TetMesh, A: PointMatrix, pressures: jax.Array) -> tuple[jax.Array, ...]:
    """Return nodal forces, as columns (V,), due to vertex pressures (V,) [Pa]: the transpose of `volume_changes`."""
    assert A.border is not None
    p = interpolated(mesh, pressures)
    return tuple(mesh.spread([tuple(p * g for g in border) for border in A.border]))


def levels(mesh: TetMesh, A: PointMatrix, bulk: Number | None = None) -> Levels:
    """Return the diagonal blocks of A, and the matrix of linear elements on the vertices.

    Args:
        bulk: additional stiffness (Q, E) [Pa/m^3] against volume changes at the integration points, or None.
    """
    blocks = A.blocks
    if bulk is not None and A.border is not None:
        g = A.border
        blocks = {
            (a, b): tuple(tuple(K[r][c] + bulk * g[a - 1][r] * g[b - 1][c] for c in range(3)) for r in range(3))
            for (a, b), K in blocks.items()
        }
    blocks = stored(blocks)
    diagonal = _diagonal(mesh, blocks)
    whole = {pair: tuple(tuple(summed(mesh, e) for e in row) for row in K) for pair, K in blocks.items()}
    corners = mjed.all_blocks(whole)
    own = None if A.own is None else _on_vertices(mesh, A.own)
    vertices = block_matrix.force_matrix(mesh, {pair: corners[pair[0]][pair[1]] for pair in PAIRS}, own)
    return Levels(diagonal if A.own is None else block_matrix.added(diagonal, A.own), vertices)


def _diagonal(mesh: TetMesh, blocks: dict[tuple[int, int], Matrix]) -> Block:
    """Return the diagonal blocks of the matrix with the given blocks at the integration points: 3 x 3 arrays (V,).

    The block of node a is the sum of c_ak K_kl c_al over elements, integration points and k, l = 1, 2, 3. K_kl are the
    given blocks. c_ak is the derivative of shape function a with respect to the barycentric coordinate k, minus its
    derivative with respect to coordinate 0.
    """
    c = basis(mesh.order).c
    slopes = c[:, 1:] - c[:, :1]
    weights = np.stack([slopes[:, a - 1] * slopes[:, b - 1] * (1 if a == b else 2) for a, b in sorted(blocks)], axis=1)
    matrix = jnp.asarray(weights.reshape(len(c), -1), mesh.points.dtype)
    entries = [(r, s) for r in range(3) for s in range(r, 3)]
    # The symmetric part of a block K_kl, with weight 2, replaces K_kl + K_lk.
    symmetric = [
        jnp.stack([0.5 * (blocks[pair][r][s] + blocks[pair][s][r]) for r, s in entries], axis=1)
        for pair in sorted(blocks)
    ]
    values = jnp.tensordot(matrix, jnp.concatenate(symmetric), axes=(1, 0))
    nodes, zero = jnp.stack(mesh.element_nodes), jnp.zeros(mesh.number_of_nodes, mesh.points.dtype)
    six = {entry: given(zero, nodes, values[:, k]) for k, entry in enumerate(entries)}
    return tuple(tuple(six[min(r, s), max(r, s)] for s in range(3)) for r in range(3))


def _on_vertices(mesh: TetMesh, own: Block) -> Block:
    """Lump the blocks of all nodes to the vertices: each end of an edge gets half of the block of the midside node."""
    return tuple(tuple(None if e is None else restricted(mesh, e) for e in row) for row in own)


def restricted(mesh: TetMesh, column: jax.Array) -> jax.Array:
    """Map values at all nodes (V,) to the vertices, by the transpose of `prolonged`."""
    V, (low, high) = mesh.number_of_vertices, mesh.pattern.edges
    half = 0.5 * column[V : V + low.shape[0]]
    return given(given(column[:V], low, half), high, half)


def prolonged(mesh: TetMesh, column: jax.Array) -> jax.Array:
    """Map values at the vertices (V,) to all nodes, for a field that is linear in every element."""
    nodes = on_middles(mesh, column)
    more = mesh.number_of_nodes - len(nodes)
    return nodes if more == 0 else jnp.concatenate([nodes, jnp.zeros(more, column.dtype)])
