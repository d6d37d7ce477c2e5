"""Quadratic tetrahedra from linear ones, with a node at the middle of every edge; and additional cubic functions."""

import jax
import jax.numpy as jnp
import numpy as np

from liverjax.core.struct import Indices, replace
from liverjax.mesh.adjacency import PAIRS, Clusters, function_clusters, node_numbers
from liverjax.mesh.shape_functions import FACES
from liverjax.mesh.tetrahedra import TetMesh


def quadratic(mesh: TetMesh) -> TetMesh:
    """The mesh with 10 nodes in each element. A quadratic mesh is returned unchanged.

    The vertices keep their numbers. The middles of the edges follow in the order of `pattern.edges`. If a node set
    contains the three vertices of a face, the middles of the face's edges are added, so that a fixed face stays fixed.
    """
    if mesh.order > 1:
        return mesh
    points = _points_and_middles(mesh.points, mesh.pattern.edges)
    sets = {name: node_numbers(of_faces(mesh, np.asarray(nodes))) for name, nodes in mesh.node_sets.items()}
    made = replace(mesh, points=points, node_sets=sets, order=2)
    return replace(made, clusters=_all_clusters(made))


@jax.jit  # one program for all operations, not one for each
def _points_and_middles(points: jax.Array, edges: jax.Array) -> jax.Array:
    low, high = edges
    return jnp.concatenate([points, 0.5 * (points[low] + points[high])])


def of_faces(mesh: TetMesh, nodes: np.ndarray) -> np.ndarray:
    """Vertices `nodes` (n,) of a linear mesh, and the edge middles of all faces with only such vertices; host side."""
    inside = np.zeros(mesh.number_of_vertices, bool)
    inside[nodes] = True
    held = inside[np.asarray(mesh.tetrahedra)]
    middles = [
        np.asarray(mesh.pattern.element_edges)[k][held[:, face].all(axis=1)]
        for face in map(list, FACES)
        for k, pair in enumerate(PAIRS)
        if set(pair) <= set(face)
    ]
    return np.concatenate([nodes, mesh.number_of_vertices + np.unique(np.concatenate(middles))])


def cubic(mesh: TetMesh) -> TetMesh:
    """A quadratic mesh with additional functions of order 3. Their unknowns are 0 in the reference shape."""
    tets = np.asarray(mesh.tetrahedra)
    triples = np.concatenate([np.sort(tets[:, face], axis=1) for face in map(list, FACES)])
    _, number = np.unique(triples, axis=0, return_inverse=True)
    more = mesh.pattern.edges.shape[1] + int(number.max()) + 1
    points = jnp.concatenate([mesh.points, jnp.zeros((more, 3), mesh.points.dtype)])
    made = replace(mesh, points=points, faces=node_numbers(number.reshape(4, -1)), order=3)
    return replace(made, clusters=_all_clusters(made))


def _all_clusters(mesh: TetMesh) -> Clusters | None:
    """Clusters of all functions, with each at the middle of its edge or face; None if vertices have none; host side."""
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
    """Numbers (m,) of the faces of a mesh of order 3 with vertices (m, 3); host side."""
    tets, V = np.asarray(mesh.tetrahedra).astype(np.int64), mesh.number_of_vertices
    of_elements = np.concatenate([tets[:, face] for face in map(list, FACES)])
    code, wanted = (_code(np.sort(t.astype(np.int64), axis=1), V) for t in (of_elements, triangles))
    order = np.argsort(code, kind="stable")
    return np.asarray(mesh.faces).ravel()[order[np.searchsorted(code, wanted, sorter=order)]]


def with_faces(mesh: TetMesh, triangles: Indices) -> Indices:
    """Triangles (m, 3).

    In a mesh of order 3 (m, 4): vertices in increasing order, and number of the face; host side.
    """
    if mesh.order < 3:
        return triangles
    vertices = np.sort(np.asarray(triangles), axis=1)
    return node_numbers(np.column_stack([vertices, face_numbers(mesh, vertices)]))


def _code(triples: np.ndarray, V: int) -> np.ndarray:
    """A number for each sorted triple, different for different triples. It is below 2^63 up to two million vertices."""
    return (triples[:, 0] * V + triples[:, 1]) * V + triples[:, 2]


def with_functions(mesh: TetMesh, nodes: np.ndarray) -> np.ndarray:
    """Nodes (n,) of quadratic elements, then the functions of order 3 on edges and faces between them; host side."""
    inside = np.zeros(mesh.number_of_nodes, bool)
    inside[nodes] = True
    V, N = mesh.number_of_vertices, mesh.pattern.edges.shape[1]
    low, high = np.asarray(mesh.pattern.edges)
    edges = np.flatnonzero(inside[low] & inside[high] & inside[V : V + N])
    element = mesh.element_nodes_on_host[:10]
    faces = [
        np.asarray(mesh.faces[k])[np.all([inside[element[n]] for n in _nodes_of_face(face)], axis=0)]
        for k, face in enumerate(FACES)
    ]
    return np.concatenate([nodes, V + N + edges, V + 2 * N + np.unique(np.concatenate(faces))])


def _nodes_of_face(face: tuple[int, ...]) -> list[int]:
    return [*face, *(4 + k for k, pair in enumerate(PAIRS) if set(pair) <= set(face))]


def on_middles(mesh: TetMesh, values: jax.Array) -> jax.Array:
    """Values at vertices and middles of edges of a field that is linear along edges, from (..., V) at vertices."""
    if mesh.order == 1:
        return values
    low, high = mesh.pattern.edges
    return jnp.concatenate([values, 0.5 * (values[..., low] + values[..., high])], axis=-1)
