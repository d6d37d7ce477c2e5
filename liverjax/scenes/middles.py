"""New nodes of a refined mesh that belong to the places of a scene, such as a drained face or a held plane."""

import jax
import numpy as np

from liverjax.mesh.selection import boundary_triangles
from liverjax.mesh.shape_functions import FACES
from liverjax.mesh.tetrahedra import TetMesh

#: Cosines of angles: two neighbours on the surface belong to one place if theirs is above the first. Two neighbours
#: inside the body lie in one plane if theirs is above the second.
_ONE_PLACE, _ONE_PLANE = 0.7, 0.999


def middles_of_places(mesh: TetMesh, nodes: np.ndarray) -> np.ndarray:
    """Numbers V + edge of the middles of edges between nodes (n,) that form a place on the surface or inside.

    Two places may meet at an edge of the body. A triangle there can have all its vertices in the two places without
    belonging to one of them: then no triangle of a place beside it has nearly its direction.
    """
    V = mesh.number_of_vertices
    inside = np.zeros(V, bool)
    inside[nodes[nodes < V]] = True
    low, high = np.asarray(mesh.pattern.edges).astype(np.int64)
    if inside.all():
        return V + np.arange(len(low))
    surface = np.asarray(boundary_triangles(mesh)).astype(np.int64)
    faces = np.asarray(mesh.tetrahedra)[:, np.array(FACES)].reshape(-1, 3).astype(np.int64)
    deep = np.ones(V, bool)
    deep[surface.ravel()] = False
    found = [np.zeros(0, np.int64)]
    for triangles, on_surface in ((surface, True), (faces, False)):
        own = triangles[inside[triangles].all(axis=1)]
        ends = np.sort(np.stack([own[:, [0, 1]], own[:, [1, 2]], own[:, [2, 0]]]), axis=2)
        edges = np.searchsorted(low * V + high, ends[..., 0] * V + ends[..., 1])
        # Inside the body, a face needs a vertex that is not on the surface, or it continues such a face.
        certain = np.zeros(len(own), bool) if on_surface else np.asarray(deep[own].any(axis=1))
        if not isinstance(mesh.points, jax.core.Tracer):  # the value of traced positions is not known
            certain = _in_one_place(np.asarray(mesh.points)[own], edges, certain, on_surface)
        elif on_surface:
            certain[:] = True
        found.append(edges[:, certain].ravel())
    return V + np.unique(np.concatenate(found))


def _in_one_place(corners: np.ndarray, edges: np.ndarray, certain: np.ndarray, on_surface: bool) -> np.ndarray:
    """Which triangles (m, 3, 3) with edges (3, m) belong to a place.

    On the surface: those with a neighbour of nearly the same direction, and those without a neighbour. Inside: the
    certain ones, and those in the plane of a certain neighbour.
    """
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    if on_surface:
        a, b = _pairs_at_edges(edges, np.ones(len(corners), bool))
        parallel = np.sum(normal[a] * normal[b], axis=1) > _ONE_PLACE
        return np.isin(np.arange(len(corners)), a[parallel]) | ~np.isin(np.arange(len(corners)), a)
    a, b = _pairs_at_edges(edges, certain)
    in_plane = np.abs(np.sum(normal[a] * normal[b], axis=1)) > _ONE_PLANE
    return certain | np.isin(np.arange(len(corners)), a[in_plane])


def _pairs_at_edges(edges: np.ndarray, others: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Pairs of a triangle and another one, one of `others` (m,), with a common edge; edges (3, m)."""
    m = edges.shape[1]
    triangle = np.tile(np.arange(m), 3)
    known = np.flatnonzero(others[triangle])
    known = known[np.argsort(edges.ravel()[known], kind="stable")]
    first, last = (np.searchsorted(edges.ravel()[known], edges.ravel(), side) for side in ("left", "right"))
    number = last - first
    place = np.repeat(first - (np.cumsum(number) - number), number) + np.arange(number.sum())
    a, b = np.repeat(triangle, number), triangle[known[place]]
    return a[a != b], b[a != b]
