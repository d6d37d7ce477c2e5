"""Find the nodes of a mesh that share an element, patches of nearby nodes, and clusters of near nodes.

These data are computed once per mesh, in NumPy (not in JAX).
"""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from liverjax.core.struct import Indices, param, static, struct

#: Pairs of an element's nodes, in the order of `Pattern.element_edges`.
PAIRS = ((0, 1), (0, 2), (0, 3), (1, 2), (1, 3), (2, 3))

#: Patches are groups of nearby nodes for the coarse space of the linear solver. A small mesh has patches of about
#: `PATCH_SIZE` nodes, and at most `FEW_PATCHES` patches. A large mesh has patches of about `LARGE_PATCH` nodes, so that
#: the solver does not need more iterations for a larger mesh. There are at most `MOST_PATCHES` patches, since the
#: coarse matrix is dense with 12 unknowns per patch.
PATCH_SIZE, FEW_PATCHES, LARGE_PATCH, MOST_PATCHES = 80, 32, 160, 192

#: Clusters are groups of near nodes in thin elements. Let r be the root mean square distance of a node from its
#: neighbours. Two neighbours are near if their distance is below `NEAR` r for both nodes. A cluster has at most
#: `LARGEST_CLUSTER` nodes. A mesh has clusters if at least the fraction `SHARE` of its vertices has a near neighbour.
NEAR, LARGEST_CLUSTER, SHARE = 1 / 3, 26, 0.1


@struct
class Clusters:
    """Groups (clusters) of near nodes in thin elements, and the pairs of nodes that are coupled within a cluster.

    There are G clusters with at most M nodes. The matrix of a cluster has M x M blocks, one for each pair of members.
    The block of the members a and b has the index a M + b. n is the number of coupled pairs of nodes. Clusters of
    vertices have one pair for each edge. In clusters of shape functions, a pair occurs once for each common element.
    """

    nodes: jax.Array = param("1", "members of every cluster (G, M), padded with 0")
    there: jax.Array = param("1", "1 for a member, 0 for padding (G, M)")
    places: jax.Array = param("1", "index (n,) of the block of each pair of nodes, among all blocks (G M M)")
    sources: tuple[jax.Array, ...] = param(
        "1",
        "arrays (n,), with one entry for each pair. Vertices: the number of the edge. Shape functions: the numbers of "
        "the element and of the two functions in it, and the sign of the product of both functions",
    )


@struct
class Pattern:
    """The N edges, and the neighbours of every node in rows of equal length W (ELL format).

    With these rows, the assembly of a matrix needs no search.
    """

    edges: jax.Array = param("1", "node numbers (2, N), the lower first")
    element_edges: jax.Array = param("1", "edge number of each node pair in `PAIRS` (6, E)")
    row_nodes: jax.Array = param("1", "neighbours of every node (W, V), padded with the node itself")
    row_edges: jax.Array = param("1", "the edges to these neighbours (W, V), padded with N")
    edge_slots: jax.Array = param("1", "index of each edge (N,) in the flattened rows, in the row of its lower node")
    patches: jax.Array = param("1", "number of the patch of every node (V,), for the coarse space")
    patch_functions: jax.Array = param("1", "for every node: 1, and its scaled position in its patch (-1 to 1), (V, 4)")
    patch_width: jax.Array = param("m", "largest extent of a patch along x, y or z, averaged over all patches")
    clusters: Any = param("1", "`Clusters` of the vertices, where elements are thin", default=None)
    number_of_patches: int = static(default=1, about="P")


def pattern(tetrahedra: Indices, points: jax.Array) -> Pattern:
    """Return the pattern of elements (E, 4) with points (V, 3) [m]. Equal meshes give equal patterns.

    The points may be unknown (inside jit, grad or vmap). Then all nodes are in one patch, and there are no clusters.
    """
    number_of_nodes = points.shape[0]
    traced = isinstance(points, jax.core.Tracer)
    near = np.zeros(number_of_nodes, dtype=np.int32) if traced else patches(np.asarray(points))
    functions, widest = _patch_functions(jax.lax.stop_gradient(points) if traced else points, near)
    tets = np.asarray(tetrahedra, dtype=int).reshape(-1, 4)
    if tets.size and (tets.min() < 0 or tets.max() >= number_of_nodes):
        tets = tets[:0]  # an empty pattern; `check_mesh` raises an error for this mesh
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
        edges=node_numbers(np.stack([low, high])),
        element_edges=node_numbers(inverse.reshape(both.shape[:2])),
        row_nodes=node_numbers(row_nodes),
        row_edges=node_numbers(row_edges),
        edge_slots=node_numbers(slots),
        patches=jax.device_put(near),
        patch_functions=functions,
        patch_width=widest,
        clusters=None if traced else vertex_clusters(np.asarray(points), np.stack([low, high])),
        number_of_patches=int(near.max(initial=0)) + 1,
    )


def node_numbers(of: Any) -> jax.Array:
    """Return a copy of an array as 32-bit integers. NumPy makes it, because JAX would compile a program for each shape.

    The numbers are known inside jit, too.
    """
    with jax.ensure_compile_time_eval():
        return jax.device_put(np.asarray(of).astype(np.int32))


def patches(points: np.ndarray) -> np.ndarray:
    """Return the patch number of every node (V,).

    The largest patch is halved at the median along its longest side, until there are enough patches.
    """
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
    # NumPy is used if the positions are known. JAX would need one second to compile these operations.
    xp: Any = jnp if isinstance(points, jax.core.Tracer) else np
    given: Any = points if xp is jnp else np.asarray(points)
    members = [given[patch == k] for k in range(int(patch.max(initial=0)) + 1)]
    low, high = (xp.stack([f(m, axis=0) if len(m) else xp.zeros(3) for m in members]) for f in (xp.min, xp.max))
    widest = xp.max(high - low, axis=1)
    half = xp.where(widest > 0, widest / 2, 1.0)
    place = (given - (low + high)[patch] / 2) / half[patch][:, None]
    functions = xp.concatenate([xp.ones_like(place[:, :1]), place], axis=1), xp.mean(widest)
    return functions if xp is jnp else jax.device_put(functions)


def vertex_clusters(points: np.ndarray, edges: np.ndarray) -> Clusters | None:
    """Return the clusters of vertices (V, 3) [m] with edges (2, N). Returns None if few elements are thin."""
    return _clustered(near_groups(points, edges), edges, (np.arange(edges.shape[1]),))


def function_clusters(nodes: np.ndarray, places: np.ndarray, signs: np.ndarray) -> Clusters | None:
    """Return the clusters of N shape functions (n functions in every element). Returns None if few elements are thin.

    `nodes`, `signs` (n, E): numbers and signs of the functions of every element. `places` (N, 3) [m]: their positions.
    """
    a, b = np.triu_indices(len(nodes), 1)
    pairs, elements = np.stack([nodes[a], nodes[b]]).reshape(2, -1), np.tile(np.arange(nodes.shape[1]), len(a))
    group = near_groups(places, np.unique(np.sort(pairs, axis=0), axis=1))
    each = (elements, np.repeat(a, nodes.shape[1]), np.repeat(b, nodes.shape[1]), (signs[a] * signs[b]).ravel())
    return _clustered(group, pairs, each)


def near_groups(places: np.ndarray, pairs: np.ndarray) -> np.ndarray:
    """Return the group number of every node (V,), from its position `places` (V, 3) [m] and neighbours `pairs` (2, N).

    Two nodes belong to one group if they are connected by a chain of near nodes (see `NEAR`). Groups that are too large
    are divided, and small groups are joined. If few nodes have a near neighbour, every group has only one node.
    """
    count, (one, other) = len(places), pairs
    square = np.sum((places[one] - places[other]) ** 2, axis=1)
    neighbours = np.maximum(np.bincount(pairs.ravel(), minlength=count), 1)
    mean = np.bincount(pairs.ravel(), np.tile(square, 2), count) / neighbours
    near = square < NEAR**2 * np.minimum(mean[one], mean[other])
    if len(np.unique(pairs[:, near])) < SHARE * count:
        return np.arange(count)
    import scipy.sparse.csgraph  # slow to import, and few meshes need it

    graph = scipy.sparse.coo_array((np.ones(near.sum()), (one[near], other[near])), shape=(count, count))
    number, group = scipy.sparse.csgraph.connected_components(graph, directed=False)
    for large in np.flatnonzero(np.bincount(group) > LARGEST_CLUSTER):
        left = [np.flatnonzero(group == large)]
        while left:
            nodes = left.pop()
            if len(nodes) <= LARGEST_CLUSTER:
                group[nodes], number = number, number + 1
                continue
            axis = int(np.argmax(np.ptp(places[nodes], axis=0)))
            order = nodes[np.argsort(places[nodes, axis], kind="stable")]
            left += [order[: len(order) // 2], order[len(order) // 2 :]]
    return _packed(np.asarray(group))


def _packed(group: np.ndarray) -> np.ndarray:
    """Join small groups until they are about as large as the largest group. Their matrices then need little padding."""
    size = np.bincount(group)
    largest, free, last = int(size.max()), 0, 0
    new = np.arange(len(size))
    for own in np.argsort(-size, kind="stable")[: int((size > 1).sum())]:
        if free < size[own]:
            free, last = largest, own
        new[own], free = last, free - size[own]
    return new[group]


def _clustered(group: np.ndarray, pairs: np.ndarray, sources: tuple[np.ndarray, ...]) -> Clusters | None:
    """Return clusters, from the group number of each node (V,) and pairs (2, n) of nodes.

    The arrays in `sources` have one entry for each pair. Returns None if every group has only one node.
    """
    size = np.bincount(group)
    if size.max(initial=0) < 2:
        return None
    number = np.cumsum(size > 1) - 1  # index of each group among the groups with several nodes
    order = np.argsort(group, kind="stable")
    place = np.empty(len(group), int)
    place[order] = np.arange(len(group)) - np.repeat(np.cumsum(size) - size, size)
    many, M = size[group] > 1, int(size.max())
    nodes, there = np.zeros((2, int((size > 1).sum()), M), int)
    own = np.flatnonzero(many)
    nodes[number[group[own]], place[own]], there[number[group[own]], place[own]] = own, 1
    one, other = pairs
    inside = np.flatnonzero((group[one] == group[other]) & (one != other))
    one, other = one[inside], other[inside]
    places = (number[group[one]] * M + place[one]) * M + place[other]
    return Clusters(
        nodes=node_numbers(nodes),
        there=jax.device_put(np.asarray(there, jnp.result_type(float))),
        places=node_numbers(places),
        sources=tuple(node_numbers(s[inside]) for s in sources),
    )
