"""Nodes of a mesh that share an element, and patches of near nodes. They are made once for a mesh, on the host."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from liverjax.core.struct import Indices, param, static, struct

#: Pairs of an element's nodes, in the order of `Pattern.element_edges`.
PAIRS = ((0, 1), (0, 2), (0, 3), (1, 2), (1, 3), (2, 3))

#: Nodes a patch up to so many patches; nodes a patch of larger meshes, so that iterations do not grow with the mesh;
#: the most patches: the coarse matrix is dense, with 12 unknowns a patch.
PATCH_SIZE, FEW_PATCHES, LARGE_PATCH, MOST_PATCHES = 80, 32, 160, 192


@struct
class Pattern:
    """Edges, and the neighbours of every node in rows padded to one length W (ELL): no search when assembling."""

    edges: jax.Array = param("1", "node numbers (2, N), the lower first")
    element_edges: jax.Array = param("1", "number of the edge of each of `PAIRS` (6, E)")
    row_nodes: jax.Array = param("1", "neighbours of every node (W, V), padded with the node itself")
    row_edges: jax.Array = param("1", "the edges to them (W, V), padded with N")
    edge_slots: jax.Array = param("1", "place of an edge in the flattened rows, that of its lower node (N,)")
    patches: jax.Array = param("1", "number of the patch of every node (V,), for the coarse space")
    patch_functions: jax.Array = param("1", "1 and the place in its patch, about 1 in size, of every node (V, 4)")
    patch_width: jax.Array = param("m", "mean of the patches' widest extents")
    number_of_patches: int = static(default=1, about="P")


def pattern(tetrahedra: Indices, points: jax.Array) -> Pattern:
    """The pattern of elements (E, 4) on points (V, 3) [m]; host side, equal meshes give equal patterns.

    The points may be traced (derivatives by the shape): then all nodes are one patch.
    """
    number_of_nodes = points.shape[0]
    traced = isinstance(points, jax.core.Tracer)
    near = np.zeros(number_of_nodes, dtype=np.int32) if traced else patches(np.asarray(points))
    functions, widest = _patch_functions(jax.lax.stop_gradient(points), near)
    tets = np.asarray(tetrahedra, dtype=int).reshape(-1, 4)
    if tets.size and (tets.min() < 0 or tets.max() >= number_of_nodes):
        tets = tets[:0]  # a mesh that `check_mesh` refuses
    both = np.stack([np.sort(tets[:, p], axis=1) for p in PAIRS])  # (6, E, 2)
    code, inverse = np.unique(both[..., 0].astype(np.int64) * number_of_nodes + both[..., 1], return_inverse=True)
    low, high = np.divmod(code, number_of_nodes)
    number = len(code)
    rows, columns = np.concatenate([low, high]), np.concatenate([high, low])
    edge = np.tile(np.arange(number), 2)
    order = np.lexsort((columns, rows))
    rows, columns, edge = rows[order], columns[order], edge[order]
    count = np.bincount(rows, minlength=number_of_nodes)
    slot = np.arange(len(rows)) - np.repeat(np.cumsum(count) - count, count)
    width = max(int(count.max(initial=0)), 1)
    row_nodes = np.tile(np.arange(number_of_nodes), (width, 1))
    row_edges = np.full((width, number_of_nodes), number)
    row_nodes[slot, rows], row_edges[slot, rows] = columns, edge
    slots = np.zeros(number, dtype=int)
    upward = rows < columns
    slots[edge[upward]] = slot[upward] * number_of_nodes + rows[upward]
    return Pattern(
        edges=jnp.asarray(np.stack([low, high]), jnp.int32),
        element_edges=jnp.asarray(inverse.reshape(both.shape[:2]), jnp.int32),
        row_nodes=jnp.asarray(row_nodes, jnp.int32),
        row_edges=jnp.asarray(row_edges, jnp.int32),
        edge_slots=jnp.asarray(slots, jnp.int32),
        patches=jnp.asarray(near),
        patch_functions=functions,
        patch_width=widest,
        number_of_patches=int(near.max(initial=0)) + 1,
    )


def patches(points: np.ndarray) -> np.ndarray:
    """Number of the patch of every node (V,): boxes halved at the median of their longest side; host side."""
    groups = [np.arange(len(points))]
    few = min(-(-len(points) // PATCH_SIZE), FEW_PATCHES)
    while len(groups) < max(few, min(len(points) // LARGE_PATCH, MOST_PATCHES)):
        nodes = groups.pop(max(range(len(groups)), key=lambda k: len(groups[k])))
        axis = int(np.argmax(np.ptp(points[nodes], axis=0)))
        order = nodes[np.argsort(points[nodes, axis], kind="stable")]
        groups += [order[: len(order) // 2], order[len(order) // 2 :]]
    number = np.zeros(len(points), dtype=np.int32)
    for k, nodes in enumerate(groups):
        number[nodes] = k
    return number


def _patch_functions(points: jax.Array, patch: np.ndarray) -> tuple[jax.Array, jax.Array]:
    # On the host where positions are known: small programs of their own would take a second to compile.
    xp: Any = jnp if isinstance(points, jax.core.Tracer) else np
    given: Any = points if xp is jnp else np.asarray(points)
    members = [given[patch == k] for k in range(int(patch.max(initial=0)) + 1)]
    low, high = (xp.stack([f(m, axis=0) if len(m) else xp.zeros(3) for m in members]) for f in (xp.min, xp.max))
    widest = xp.max(high - low, axis=1)
    half = xp.where(widest > 0, widest / 2, 1.0)
    place = (points - (low + high)[patch] / 2) / half[patch][:, None]
    return jnp.asarray(xp.concatenate([xp.ones_like(place[:, :1]), place], axis=1)), jnp.asarray(xp.mean(widest))
