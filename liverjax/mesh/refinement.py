"""Refine a mesh: cut every tetrahedron into eight of half its size, or cut only the tetrahedra near given nodes."""

import jax
import jax.numpy as jnp
import numpy as np

from liverjax.core.struct import Array, Indices, replace
from liverjax.mesh.adjacency import PAIRS, node_numbers
from liverjax.mesh.promotion import middles_of_set, nodes_of_face, quadratic
from liverjax.mesh.selection import boundary_triangles, check_nodes, face_codes
from liverjax.mesh.shape_functions import FACES
from liverjax.mesh.tetrahedra import FACES as OUTWARD
from liverjax.mesh.tetrahedra import TetMesh, tet_mesh

#: Three even permutations of the corners of an element. Each leads to a different inner diagonal (`corner_orders`).
_ORDERS = np.array([[0, 1, 2, 3], [0, 2, 3, 1], [0, 3, 1, 2]])


def refined(mesh: TetMesh, near: Indices | None = None) -> TetMesh:
    """Return the mesh with every tetrahedron cut into eight (Bey 1995). Quadratic elements stay quadratic.

    Four parts lie at the corners of the element. The octahedron between them is cut at its shortest diagonal, so that
    the elements do not become flatter with each refinement.

    The old vertices keep their numbers, and the middles of the edges follow in the order of `pattern.edges`. So the new
    vertices are the nodes of `quadratic(mesh)`, and a node set gets the same new nodes as in `quadratic(mesh)`. The
    eight parts of element e are the elements 8 e … 8 e + 7, and an element set contains the parts of its elements. The
    surface keeps its flat triangles, so refinement does not bring it nearer to the real surface of the organ. Positions
    may be unknown (inside jit, grad or vmap) if `near` is not given and the mesh has no triangle sets.

    Args:
        near: node numbers (n,). If given, only two kinds of edges are halved: edges at these nodes, and edges that must
            be halved to keep the mesh conforming. The result then has no element sets. An element is cut at its
            longest edge first (Rivara 1984), so elements do not become flatter. `rim` returns the nodes around a clamp,
            where most of the mesh error occurs.
    """
    if near is not None:
        check_nodes(near, mesh.number_of_nodes, "refined: near")
    V = mesh.number_of_vertices
    points: Array = mesh.points if isinstance(mesh.points, jax.core.Tracer) else np.asarray(mesh.points)
    points, (low, high) = points[:V], np.asarray(mesh.pattern.edges)
    halved = np.ones(len(low), bool) if near is None else _halved(mesh, np.asarray(near))
    middle = np.where(halved, V - 1 + np.cumsum(halved), -1)
    tets = _eighths(mesh, middle) if near is None else _bisected(mesh, middle)
    sets = {}
    for name, nodes in mesh.node_sets.items():
        nodes = np.asarray(nodes)
        own, old_middles = nodes[nodes < V], nodes[(nodes >= V) & (nodes < V + len(low))]
        new = middle[np.union1d(middles_of_set(mesh, name), old_middles) - V]
        sets[name] = np.concatenate([own, new[new >= 0]])
    elements = {} if near is not None else {name: parts_of(own) for name, own in mesh.element_sets.items()}
    stack = jnp.vstack if isinstance(points, jax.core.Tracer) else np.vstack
    made = tet_mesh(stack([points, 0.5 * (points[low] + points[high])[halved]]), tets, sets, elements)
    if mesh.triangle_sets:
        ends = np.hstack([np.tile(np.arange(V), (2, 1)), np.stack([low, high])[:, halved]])
        faces = _all_faces(made)
        groups = {name: _triangles_in(np.asarray(old), faces, ends) for name, old in mesh.triangle_sets.items()}
        made = replace(made, triangle_sets=groups)
    return quadratic(made) if mesh.order > 1 else made


def parts_of(elements: Indices) -> np.ndarray:
    """Return the numbers (8 n,) of the parts of elements (n,) in the refined mesh (`refined`)."""
    return (8 * np.asarray(elements)[:, None] + np.arange(8)).ravel()


def quarters(mesh: TetMesh, triangles: Indices) -> jax.Array:
    """Return the four parts of each triangle (m, 3) as node numbers (4 m, 3) of the refined mesh (`refined`)."""
    low, high = np.asarray(mesh.pattern.edges).astype(np.int64)
    V, (a, b, c) = mesh.number_of_vertices, np.asarray(triangles).astype(np.int64).T
    ends = np.sort(np.stack([[a, b], [b, c], [c, a]]), axis=1)
    ab, bc, ca = V + np.searchsorted(low * V + high, ends[:, 0] * V + ends[:, 1])
    return node_numbers(
        np.stack([[a, ab, ca], [ab, b, bc], [ca, bc, c], [ab, bc, ca]]).transpose(2, 0, 1).reshape(-1, 3)
    )


def middles_of_whole_faces(mesh: TetMesh, fine: TetMesh, nodes: np.ndarray) -> np.ndarray:
    """Return the new nodes of `fine` = `refined(mesh)` on the edges and faces that have all their nodes in `nodes`.

    Both meshes are quadratic. An edge of `mesh` has three nodes, and a face has six nodes.
    """
    V, W = mesh.number_of_vertices, fine.number_of_vertices
    inside = np.zeros(mesh.number_of_nodes, bool)
    inside[nodes] = True
    low, high = np.asarray(mesh.pattern.edges).astype(np.int64)
    edge = np.flatnonzero(inside[low] & inside[high] & inside[V:])
    own = mesh.element_nodes_on_host
    faces = [own[list(face)][:, inside[own[nodes_of_face(face)]].all(axis=0)].T for face in FACES]
    parts = np.asarray(quarters(mesh, np.concatenate(faces))).astype(np.int64)
    ends = [np.stack([end[edge], V + edge], axis=1) for end in (low, high)]
    ends += [parts[:, side] for side in ([0, 1], [1, 2], [2, 0])]
    pairs = np.sort(np.concatenate(ends), axis=1)
    first, second = np.asarray(fine.pattern.edges).astype(np.int64)
    return W + np.flatnonzero(np.isin(first * W + second, pairs[:, 0] * W + pairs[:, 1]))


def places_in(mesh: TetMesh, fine: TetMesh) -> tuple[np.ndarray, np.ndarray]:
    """Locate the V' nodes of `fine` = `refined(mesh)` in the original mesh.

    Returns, for each node, an element (V',) that contains it, and its barycentric coordinates (4, V') in this element.
    """
    orders = corner_orders(mesh)
    corners = _places_of_parts()
    inside = np.concatenate([corners, corners[:, [i for i, _ in PAIRS]] / 2 + corners[:, [j for _, j in PAIRS]] / 2], 1)
    own = fine.element_nodes_on_host  # (n, 8 E)
    _, first = np.unique(own, return_index=True)
    slot, part = np.unravel_index(first, own.shape)
    element, places = part // 8, np.empty((4, len(part)))
    np.put_along_axis(places, orders[:, element], inside[part % 8, slot].T, axis=0)
    return element, places


def barycentric_in_parts(mesh: TetMesh, element: Indices, L: np.ndarray) -> np.ndarray:
    """Return the barycentric coordinates (4, m, 8) of m points in the eight parts of their elements (`refined`).

    Args:
        mesh: the mesh that is not refined.
        element: numbers (m,) of the elements that contain the points.
        L: barycentric coordinates (4, m) of the points in their elements.
    """
    ordered = np.take_along_axis(L, corner_orders(mesh)[:, np.asarray(element)], axis=0)
    return np.einsum("kca,cm->amk", np.linalg.inv(_places_of_parts()), ordered)


def _places_of_parts() -> np.ndarray:
    """Return the barycentric coordinates (8, 4, 4) of the four corners of each part, if the element's corners are in
    the order of `corner_orders`."""
    return _corners_of_parts(*np.eye(4), *(np.eye(4)[[i, j]].mean(axis=0) for i, j in PAIRS))


def _all_faces(mesh: TetMesh) -> np.ndarray:
    """Return the faces (m, 3) of all elements, each face once. Normals of faces on the surface point outward."""
    tets = np.asarray(mesh.tetrahedra)
    faces = np.concatenate([tets[:, f] for f in OUTWARD])
    codes = face_codes(np.sort(faces.astype(np.int64), axis=1), mesh.number_of_vertices)
    return faces[np.sort(np.unique(codes, return_index=True)[1])]


def _triangles_in(triangles: np.ndarray, faces: np.ndarray, ends: np.ndarray) -> jax.Array:
    """Return the new faces (n, 3) that lie in old triangles (m, 3). Old triangles may lie inside the body.

    `ends` (2, V): for each new vertex, the two ends of the old edge with this vertex at its middle. For an old vertex,
    both entries are the vertex itself.
    """
    old = {tuple(corners) for corners in np.sort(triangles, axis=1).tolist()}
    near = faces[np.isin(ends[:, faces], triangles).all(axis=(0, 2))]
    of_each = np.moveaxis(ends[:, near], 0, 1).reshape(len(near), 6).tolist()
    return node_numbers(near[np.array([tuple(sorted(set(own))) in old for own in of_each], bool)])


def rim(mesh: TetMesh, nodes: Indices) -> np.ndarray:
    """Return the nodes (m,) at the border of the surface region with nodes (n,).

    If the region is clamped, the strain is largest at this border. Vertices that belong to no triangle of the region
    (single nodes, nodes inside the body) are returned too.
    """
    check_nodes(nodes, mesh.number_of_nodes, "rim: nodes", least=0)
    held = np.asarray(nodes)[np.asarray(nodes) < mesh.number_of_vertices]
    triangles = boundary_triangles(mesh, held)
    sides = np.sort(np.concatenate([triangles[:, pair] for pair in ([0, 1], [1, 2], [0, 2])]), axis=1)
    sides, count = np.unique(sides, axis=0, return_counts=True)
    return np.union1d(sides[count == 1], np.setdiff1d(held, triangles)).astype(int)


def _eighths(mesh: TetMesh, middle: np.ndarray) -> np.ndarray:
    """Cut each element into eight, and return the new elements (8 E, 4). `middle` (N,): number of the node at the
    middle of each edge."""
    orders = corner_orders(mesh)
    corners = np.take_along_axis(np.asarray(mesh.tetrahedra).T, orders, axis=0)
    slots = {pair: k for k, pair in enumerate(PAIRS)}
    slot = np.array([[slots.get((min(i, j), max(i, j)), -1) for j in range(4)] for i in range(4)])
    edges = np.stack([slot[orders[i], orders[j]] for i, j in PAIRS])
    middles = middle[np.take_along_axis(np.asarray(mesh.pattern.element_edges), edges, axis=0)]
    return _corners_of_parts(*corners, *middles).transpose(2, 0, 1).reshape(-1, 4)


def corner_orders(mesh: TetMesh) -> np.ndarray:
    """Return the local numbers (4, E) of the corners a, b, c, d of each element, in the order that `_eighths` needs.

    The inner diagonal joins the middles of the edges a c and b d. In this order it is the shortest of the three inner
    diagonals. If the positions are unknown (inside jit, grad or vmap), the order is the order in the mesh.
    """
    E = mesh.number_of_elements
    if isinstance(mesh.points, jax.core.Tracer):
        return np.tile(_ORDERS[0][:, None], E)
    a, b, c, d = np.asarray(mesh.points)[np.asarray(mesh.tetrahedra)].transpose(1, 0, 2)
    diagonals = np.linalg.norm([a + c - b - d, a + d - b - c, a + b - c - d], axis=2)
    # If diagonals have equal lengths up to the roundoff of float32, the first one is used, so that all machines agree.
    shortest = diagonals <= (1 + 1e-5) * diagonals.min(axis=0)
    return _ORDERS[shortest.argmax(axis=0)].T


def _corners_of_parts(a: Array, b: Array, c: Array, d: Array, *middles: Array) -> np.ndarray:
    """Return the corners (8, 4, …) of the eight parts of an element, from its corners a, b, c, d and edge middles.

    The corners of each part are in the order of Bey, so that repeated refinement makes at most three different shapes
    of each element. Where this order has a negative volume, the first and the third corner are exchanged.
    """
    ab, ac, ad, bc, bd, cd = middles
    return np.array(
        [
            *([a, ab, ac, ad], [ab, b, bc, bd], [ac, bc, c, cd], [ad, bd, cd, d]),
            *([ab, ac, ad, bd], [bc, ac, ab, bd], [ac, ad, bd, cd], [bd, bc, ac, cd]),
        ]
    )


def _by_length(mesh: TetMesh) -> np.ndarray:
    """Rank the edges (N,) by length. All ranks differ, so two elements cut their common face in the same way."""
    low, high = np.asarray(mesh.pattern.edges)
    points = np.asarray(mesh.points)
    # Lengths are rounded, so that edges of equal length are ordered by their number on all machines.
    lengths = np.linalg.norm(points[low] - points[high], axis=1).astype(np.float32)
    place = np.empty(len(low), int)
    place[np.argsort(lengths, kind="stable")] = np.arange(len(low))
    return place


def _halved(mesh: TetMesh, near: np.ndarray) -> np.ndarray:
    """Return a mask (N,) of the edges that are halved.

    First, edges at the nodes `near` are halved. If an element or a face has a halved edge, its longest edge is halved
    too. This rule is applied until no edge is added.
    """
    edges, place = np.asarray(mesh.pattern.element_edges), _by_length(mesh)
    groups = [edges, *(edges[[k for k, pair in enumerate(PAIRS) if set(pair) <= set(face)]] for face in FACES)]
    longest = [np.take_along_axis(g, place[g].argmax(axis=0)[None], axis=0)[0] for g in groups]
    halved = np.logical_or(*np.isin(np.asarray(mesh.pattern.edges), near))
    while True:
        before = halved.sum()
        for group, first in zip(groups, longest, strict=True):
            halved[first[halved[group].any(axis=0)]] = True
        if halved.sum() == before:
            return halved


def _bisected(mesh: TetMesh, middle: np.ndarray) -> np.ndarray:
    """Cut elements in two at their longest halved edge, until no element has a halved edge. Return elements (m, 4).

    `middle` (N,): number of the node at the middle of each edge, negative for edges that are not halved.
    """
    V, place = mesh.number_of_vertices, _by_length(mesh)
    low, high = np.asarray(mesh.pattern.edges).astype(np.int64)
    code = low * V + high  # ascending, because the edges are sorted by their end nodes
    tets, done = np.asarray(mesh.tetrahedra).astype(np.int64), []
    while len(tets):
        ends = np.stack([np.sort(tets[:, pair], axis=1) for pair in map(list, PAIRS)])
        wanted = np.where((ends < V).all(axis=2), ends[..., 0] * V + ends[..., 1], -1)
        edge = np.minimum(np.searchsorted(code, wanted), len(code) - 1)
        rank = np.where((code[edge] == wanted) & (middle[edge] >= 0), place[edge], -1)
        slot, every = rank.argmax(axis=0), np.arange(len(tets))
        whole = rank[slot, every] < 0
        done.append(tets[whole])
        tets, edge, slot = tets[~whole], edge[slot, every][~whole], slot[~whole]
        halves = []
        for end in np.array(PAIRS)[slot].T:
            half = tets.copy()
            half[np.arange(len(half)), end] = middle[edge]
            halves.append(half)
        tets = np.concatenate(halves)
    return np.concatenate(done)
