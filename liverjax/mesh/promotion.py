"""Make quadratic meshes (with a node at the middle of every edge) from linear meshes, and cubic meshes from quadratic
meshes. A cubic mesh has additional shape functions on edges and faces."""

import jax
import jax.numpy as jnp
import numpy as np

from liverjax.core.struct import Indices, replace
from liverjax.mesh.adjacency import PAIRS, Clusters, function_clusters, node_numbers
from liverjax.mesh.selection import boundary_triangles, face_codes
from liverjax.mesh.shape_functions import FACES
from liverjax.mesh.tetrahedra import TetMesh

#: Two adjacent surface triangles count as nearly parallel if the cosine of the angle between their normals is above
#: this value.
_ONE_PLACE = 0.7


def quadratic(mesh: TetMesh) -> TetMesh:
    """Return the mesh with 10 nodes in each element. A quadratic mesh is returned unchanged.

    The vertices keep their numbers. The middles of the edges follow in the order of `pattern.edges`. A node set also
    gets the middles of the edges of its faces (`middles_of_set`), so that a fixed face stays fixed.
    """
    if mesh.order > 1:
        return mesh
    points = _points_and_middles(mesh.points, mesh.pattern.edges)
    sets = {
        name: node_numbers(np.concatenate([np.asarray(nodes), middles_of_set(mesh, name)]))
        for name, nodes in mesh.node_sets.items()
    }
    made = replace(mesh, points=points, node_sets=sets, order=2)
    return replace(made, clusters=_all_clusters(made))


@jax.jit  # so that all operations are one compiled program
def _points_and_middles(points: jax.Array, edges: jax.Array) -> jax.Array:
    low, high = edges
    return jnp.concatenate([points, 0.5 * (points[low] + points[high])])


def middles_of_set(mesh: TetMesh, name: str) -> np.ndarray:
    """Return the node numbers (V + edge number) of the edge middles that belong to a node set of the mesh.

    If the mesh has a triangle set with the same name and the same vertices, the result contains the middles of all
    edges of these triangles. Otherwise `middles_of_places` finds the edge middles.
    """
    V, nodes = mesh.number_of_vertices, np.asarray(mesh.node_sets[name])
    nodes = nodes[nodes < V]
    triangles = np.asarray((mesh.triangle_sets or {}).get(name, np.zeros((0, 3)))).astype(np.int64)
    if len(triangles) and np.array_equal(np.unique(triangles), np.unique(nodes)):
        return V + np.unique(_edges_of(mesh, triangles))
    return middles_of_places(mesh, nodes)


def of_faces(mesh: TetMesh, nodes: np.ndarray) -> np.ndarray:
    """Return the vertices `nodes` (n,), and the edge middles that `middles_of_places` finds between them."""
    return np.concatenate([nodes, middles_of_places(mesh, nodes)])


def middles_of_places(mesh: TetMesh, nodes: np.ndarray) -> np.ndarray:
    """Return the node numbers (V + edge number) of the edge middles on the regions that the vertices `nodes` form.

    A region consists of element faces with all their vertices in `nodes`, for example a fixed side of the body. Two
    regions may meet at an edge of the body. A face at this edge may have all its vertices in `nodes`, but belong to
    neither of the two regions. On the surface, such a face is at an angle to the faces of the regions, and nearly
    parallel to a neighbouring face outside the regions. If the positions of the mesh are unknown (inside jit, grad or
    vmap), such faces are not excluded on the surface. Inside the body, a face belongs to a region only if one of its
    vertices is below the surface, or has an edge to a vertex of `nodes` below the surface. Where the body is only one
    element thick, no vertex is below the surface. There, all faces with all their vertices in `nodes` belong to a
    region.
    """
    V = mesh.number_of_vertices
    inside = np.zeros(V, bool)
    inside[nodes[nodes < V]] = True
    if inside.all():
        return V + np.arange(mesh.pattern.edges.shape[1])
    surface = boundary_triangles(mesh).astype(np.int64)
    outer = surface[inside[surface].all(axis=1)]
    inner = np.concatenate(_inner_faces(mesh, surface, inside))
    if not len(outer) and not len(inner):
        return np.zeros(0, np.int64)
    if not isinstance(mesh.points, jax.core.Tracer):
        outer = outer[_in_a_place(mesh, surface, inside)]
    return V + np.unique(np.concatenate([_edges_of(mesh, outer).ravel(), _edges_of(mesh, inner).ravel()]))


def _inner_faces(mesh: TetMesh, surface: np.ndarray, inside: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the faces (m, 3) inside the body that belong to a region (see `middles_of_places`).

    The first array contains the faces near a vertex below the surface. The second array contains the faces where the
    body is only one element thick. A face may be in both arrays, and occurs once for each of its elements.
    """
    V, tets = mesh.number_of_vertices, np.asarray(mesh.tetrahedra).astype(np.int64)
    held = inside[tets]
    own = np.concatenate([tets[held[:, face].all(axis=1)][:, face] for face in map(list, FACES)])
    code, of_surface = (face_codes(np.sort(t, axis=1), V) for t in (own, surface))
    inner = own[~np.isin(code, of_surface)]
    deep = np.ones(V, bool)
    deep[surface.ravel()] = False
    beside = _and_neighbours(mesh, deep & inside)
    thin = ~_and_neighbours(mesh, _and_neighbours(mesh, deep))
    return inner[(deep | beside)[inner].any(axis=1)], inner[thin[inner].all(axis=1)]


def middles_between(mesh: TetMesh, groups: list[np.ndarray]) -> np.ndarray:
    """Return the node numbers (V + edge number) of the edge middles on faces between groups of vertices.

    Such a face has all its vertices in the groups, but not in one group. On the surface, it continues a region of one
    group (`middles_of_places`): it is nearly parallel to a neighbour in this region, or to a neighbour that already
    continues the region. Inside the body, one of its vertices is below the surface, or has an edge to a vertex of a
    group below the surface. Groups that contain no surface triangle, for example single rows of nodes, are joined to
    one group. The result also contains the edge middles on the regions of this joined group.
    """
    V = mesh.number_of_vertices
    inside = np.zeros((len(groups), V), bool)
    for own, nodes in zip(inside, groups, strict=True):
        own[nodes[nodes < V]] = True
    surface = boundary_triangles(mesh).astype(np.int64)
    small = np.array([not own[surface].all(axis=1).any() for own in inside])
    if small.any():
        inside = np.concatenate([inside[~small], inside[small].any(axis=0, keepdims=True)])
    middles = middles_of_places(mesh, np.flatnonzero(inside[-1])) if small.any() else np.zeros(0, np.int64)
    of_any = np.asarray(inside.any(axis=0))
    inner, _ = _inner_faces(mesh, surface, of_any)
    inner = inner[~np.any([own[inner].all(axis=1) for own in inside], axis=0)]
    outer = surface[_continued(mesh, surface, inside)]
    return np.union1d(middles, V + np.concatenate([_edges_of(mesh, outer).ravel(), _edges_of(mesh, inner).ravel()]))


def _continued(mesh: TetMesh, surface: np.ndarray, inside: np.ndarray) -> np.ndarray:
    """Return a mask (m,) of the surface triangles between groups with the vertices `inside` (n, V), see
    `middles_between`."""
    of_one = np.array([own[surface].all(axis=1) for own in inside])
    of_any = np.asarray(inside.any(axis=0))
    between = of_any[surface].all(axis=1) & ~of_one.any(axis=0)
    if not between.any():
        return np.asarray(between)
    for own, found in zip(inside, of_one, strict=True):
        found[found] = _in_a_place(mesh, surface, own)
    a, b = _pairs_at_edges(_edges_of(mesh, surface))
    parallel = _nearly_parallel(mesh, surface, a, b)
    a, b = a[parallel], b[parallel]
    region = np.asarray(of_one.any(axis=0))
    while True:
        more = np.zeros(len(surface), bool)
        more[a[region[b]]] = True
        more &= between & ~region
        if not more.any():
            return np.asarray(region & between)
        region |= more


def _and_neighbours(mesh: TetMesh, inside: np.ndarray) -> np.ndarray:
    """Return the mask `inside` (V,) of vertices, extended by all vertices with an edge to one of these vertices."""
    low, high = np.asarray(mesh.pattern.edges)
    found = inside.copy()
    found[low[inside[high]]] = True
    found[high[inside[low]]] = True
    return found


def _edges_of(mesh: TetMesh, faces: np.ndarray) -> np.ndarray:
    """Return the edge numbers (3, m) of faces (m, 3)."""
    low, high = np.asarray(mesh.pattern.edges).astype(np.int64)
    ends = np.sort(np.stack([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]]), axis=2)
    return np.searchsorted(low * mesh.number_of_vertices + high, ends[..., 0] * mesh.number_of_vertices + ends[..., 1])


def _in_a_place(mesh: TetMesh, surface: np.ndarray, inside: np.ndarray) -> np.ndarray:
    """Return which of the surface triangles with all vertices `inside` belong to a region (see `middles_of_places`).

    A neighbour is inside if all its vertices are `inside`. A triangle does not belong to a region if it has neighbours
    inside, is nearly parallel to none of them, and is nearly parallel to a neighbour that is not inside.
    """
    own = inside[surface].all(axis=1)
    a, b = _pairs_at_edges(_edges_of(mesh, surface))
    parallel = _nearly_parallel(mesh, surface, a, b)
    number = np.arange(len(surface))
    continued, outside = (np.isin(number, a[parallel & which]) for which in (own[b], ~own[b]))
    alone = ~np.isin(number, a[own[b]])
    return (continued | ~outside | alone)[own]


def _nearly_parallel(mesh: TetMesh, surface: np.ndarray, a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Return a mask (m,) of the pairs of triangles a (m,) and b (m,) that are nearly parallel."""
    normal = _normals(mesh, surface)
    return np.asarray(np.sum(normal[a] * normal[b], axis=1) > _ONE_PLACE)


def _normals(mesh: TetMesh, faces: np.ndarray) -> np.ndarray:
    corners = np.asarray(mesh.points)[faces]
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    return np.asarray(normal / np.linalg.norm(normal, axis=1, keepdims=True))


def _pairs_at_edges(edges: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return all ordered pairs of triangles with a common edge, from their edge numbers (3, m)."""
    triangle = np.tile(np.arange(edges.shape[1]), 3)
    order = np.argsort(edges.ravel(), kind="stable")
    first, last = (np.searchsorted(edges.ravel()[order], edges.ravel(), side) for side in ("left", "right"))
    number = last - first
    place = np.repeat(first - (np.cumsum(number) - number), number) + np.arange(number.sum())
    a, b = np.repeat(triangle, number), triangle[order[place]]
    return a[a != b], b[a != b]


def cubic(mesh: TetMesh) -> TetMesh:
    """Return a quadratic mesh with additional shape functions of order 3, on edges and faces.

    The unknowns of these functions are 0 in the reference shape.
    """
    tets = np.asarray(mesh.tetrahedra)
    triples = np.concatenate([np.sort(tets[:, face], axis=1) for face in map(list, FACES)])
    _, number = np.unique(triples, axis=0, return_inverse=True)
    more = mesh.pattern.edges.shape[1] + int(number.max()) + 1
    points = jnp.concatenate([mesh.points, jnp.zeros((more, 3), mesh.points.dtype)])
    made = replace(mesh, points=points, faces=node_numbers(number.reshape(4, -1)), order=3)
    return replace(made, clusters=_all_clusters(made))


def _all_clusters(mesh: TetMesh) -> Clusters | None:
    """Return the clusters of all shape functions. The position of a function is its vertex, or the middle of its edge
    or face.

    Returns None if the vertices have no clusters.
    """
    if mesh.pattern.clusters is None or isinstance(mesh.points, jax.core.Tracer):
        return None
    points, tets, (low, high) = (np.asarray(a) for a in (mesh.points, mesh.tetrahedra, mesh.pattern.edges))
    nodes = mesh.element_nodes_on_host
    signs, places = np.ones(nodes.shape), points
    if mesh.order == 3:
        first, V = 4 + len(PAIRS), mesh.number_of_vertices
        signs[first : first + len(PAIRS)] = [np.where(tets[:, i] < tets[:, j], 1, -1) for i, j in PAIRS]
        middles = (points[low] + points[high]) / 2
        centres = np.zeros((mesh.number_of_nodes - V - 2 * len(low), 3))
        for face, number in zip(FACES, np.asarray(mesh.faces), strict=True):
            centres[number] = points[tets[:, face]].mean(axis=1)
        places = np.concatenate([points[:V], middles, middles, centres])
    return function_clusters(nodes, places, signs)


def face_numbers(mesh: TetMesh, triangles: np.ndarray) -> np.ndarray:
    """Return the face numbers (m,) of triangles with vertices (m, 3), in a mesh of order 3."""
    tets, V = np.asarray(mesh.tetrahedra).astype(np.int64), mesh.number_of_vertices
    of_elements = np.concatenate([tets[:, face] for face in map(list, FACES)])
    code, wanted = (face_codes(np.sort(t.astype(np.int64), axis=1), V) for t in (of_elements, triangles))
    order = np.argsort(code, kind="stable")
    return np.asarray(mesh.faces).ravel()[order[np.searchsorted(code, wanted, sorter=order)]]


def with_faces(mesh: TetMesh, triangles: Indices) -> Indices:
    """Return triangles (m, 3). If the mesh has order 3, add a column with their face numbers.

    With this column, a triangle (m, 4) has three vertices in increasing order, followed by the number of its face.
    """
    if mesh.order < 3:
        return triangles
    vertices = np.sort(np.asarray(triangles), axis=1)
    return node_numbers(np.column_stack([vertices, face_numbers(mesh, vertices)]))


def with_functions(mesh: TetMesh, nodes: np.ndarray) -> np.ndarray:
    """Return the node numbers `nodes` (n,) of quadratic elements, followed by the numbers of functions of order 3.

    These functions belong to the edges and faces that have all their nodes in `nodes`.
    """
    inside = np.zeros(mesh.number_of_nodes, bool)
    inside[nodes] = True
    V, N = mesh.number_of_vertices, mesh.pattern.edges.shape[1]
    low, high = np.asarray(mesh.pattern.edges)
    edges = np.flatnonzero(inside[low] & inside[high] & inside[V : V + N])
    element = mesh.element_nodes_on_host[:10]
    faces = [
        np.asarray(mesh.faces)[k][np.all([inside[element[n]] for n in nodes_of_face(face)], axis=0)]
        for k, face in enumerate(FACES)
    ]
    return np.concatenate([nodes, V + N + edges, V + 2 * N + np.unique(np.concatenate(faces))])


def nodes_of_face(face: tuple[int, ...]) -> list[int]:
    """Return the local numbers of the six nodes of a face of a quadratic element."""
    return [*face, *(4 + k for k, pair in enumerate(PAIRS) if set(pair) <= set(face))]


def on_middles(mesh: TetMesh, values: jax.Array) -> jax.Array:
    """Append the values at the middles of edges to the vertex values (..., V) of a field that is linear along edges."""
    if mesh.order == 1:
        return values
    low, high = mesh.pattern.edges
    return jnp.concatenate([values, 0.5 * (values[..., low] + values[..., high])], axis=-1)
