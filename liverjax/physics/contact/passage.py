"""A sphere or a cylinder that passes the surface of the body within a step.

Contact knows how far the surface is from the obstacle, and no more: a sphere deep in the body touches nothing, and one
that is half inside is pushed out to the wrong side.
"""

import numpy as np

from liverjax.mesh.locate import around_a_point, around_a_point_in_plane, straight_corners
from liverjax.mesh.tetrahedra import TetMesh

#: Most places along the way of a step that are looked at.
_MOST = 256


def in_body(
    shape: str, axis: np.ndarray, mesh: TetMesh, x: np.ndarray, centres: np.ndarray, triangles: np.ndarray
) -> np.ndarray:
    """Whether the centre of a sphere, or a part of a cylinder's axis, is in the body: (n,). Others have no centre.

    Args:
        shape: of the obstacle.
        axis: of a cylinder (3,).
        mesh: its elements.
        x: positions (V, 3) [m] of its nodes.
        centres: places (n, 3) [m].
        triangles: surface (m, 3) that may touch the obstacle; other bodies in the mesh do not count.
    """
    found = np.zeros(len(centres), bool)
    if shape not in ("sphere", "cylinder"):
        return found
    across = np.eye(3) if shape == "sphere" else np.linalg.svd(axis[None])[2][1:]  # a cylinder, seen along its axis
    places, nodes = centres @ across.T, x @ across.T
    if np.any(places.min(axis=0) > nodes.max(axis=0)) or np.any(places.max(axis=0) < nodes.min(axis=0)):
        return found
    holds = around_a_point if shape == "sphere" else around_a_point_in_plane
    corners = straight_corners(mesh, nodes)
    near = np.all((corners.max(axis=1) >= places.min(axis=0)) & (corners.min(axis=1) <= places.max(axis=0)), axis=1)
    own = np.flatnonzero(near)
    for k, place in enumerate(places):
        met = own[holds(corners[own] - place)]
        found[k] = met.size > 0 and _of_touching_body(mesh, met // (len(corners) // mesh.number_of_elements), triangles)
    return found


def _of_touching_body(mesh: TetMesh, elements: np.ndarray, triangles: np.ndarray) -> bool:
    """Whether some of the elements (n,) belong to a body with triangles (m, 3)."""
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components

    tets, V = np.asarray(mesh.tetrahedra), mesh.number_of_vertices
    rows, columns = np.tile(tets[:, 0], 3), tets[:, 1:].T.ravel()
    label = connected_components(coo_array((np.ones(len(rows)), (rows, columns)), shape=(V, V)), directed=False)[1]
    return bool(np.isin(label[tets[elements, 0]], label[triangles[:, 0]]).any())


def passed_in_step(
    shape: str, axis: np.ndarray, mesh: TetMesh, positions: np.ndarray, centres: np.ndarray, triangles: np.ndarray
) -> str:
    """What an obstacle does in the body within a long step: "has its centre in", "went through", or nothing.

    It went through if a place on its way is in the body at the beginning and at the end of the step: a body follows an
    obstacle that leaves it, and goes before one that pushes it.

    Args:
        positions: (2, V, 3) [m] at the beginning and at the end of the step.
        centres: of the obstacle there (2, 3) [m].
        shape, axis, mesh, triangles: as in `in_body`.
    """
    way = centres[1] - centres[0]
    size = float(np.cbrt(np.median(np.abs(np.asarray(mesh.volumes)))))
    count = int(np.clip(np.ceil(np.linalg.norm(way) / (0.5 * size)), 2, _MOST))
    places = centres[0] + np.arange(1, count + 1)[:, None] / count * way
    after = in_body(shape, axis, mesh, positions[1], places, triangles)
    if after[-1]:
        return "has its centre in"
    if not after.any():
        return ""
    before = in_body(shape, axis, mesh, positions[0], places[after], triangles)
    return "went through" if before.any() else ""
