"""Check whether a sphere or a cylinder passes through the surface of the body within a step.

Contact forces depend only on the distance between the surface of the body and the obstacle. So there is no contact
force on a sphere deep inside the body. If the centre of a sphere is inside the body, the contact forces have the wrong
direction.
"""

import numpy as np

from liverjax.mesh.locate import around_a_point, around_a_point_in_plane, straight_corners
from liverjax.mesh.tetrahedra import TetMesh

#: Maximum number of positions that are checked along the path of the obstacle in a step.
_MOST = 256


def in_body(
    shape: str, axis: np.ndarray, mesh: TetMesh, x: np.ndarray, centres: np.ndarray, triangles: np.ndarray
) -> np.ndarray:
    """Return, for each position of an obstacle, whether the obstacle is in the body (n,).

    A sphere is in the body if its centre is in the body. A cylinder is in the body if a part of its axis is in the
    body. For other shapes, the result is False.

    Args:
        shape: shape of the obstacle.
        axis: axis of a cylinder (3,).
        mesh: mesh of the body.
        x: positions (V, 3) [m] of the nodes.
        centres: n positions (n, 3) [m] of the obstacle.
        triangles: node numbers (m, 3) of the triangles that may touch the obstacle. Connected parts of the mesh without
            such triangles are ignored.
    """
    found = np.zeros(len(centres), bool)
    if shape not in ("sphere", "cylinder"):
        return found
    across = np.eye(3) if shape == "sphere" else np.linalg.svd(axis[None])[2][1:]  # cylinder: project along its axis
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
    """Return whether one of the elements (n,) is connected through the mesh to one of the triangles (m, 3)."""
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components

    tets, V = np.asarray(mesh.tetrahedra), mesh.number_of_vertices
    rows, columns = np.tile(tets[:, 0], 3), tets[:, 1:].T.ravel()
    label = connected_components(coo_array((np.ones(len(rows)), (rows, columns)), shape=(V, V)), directed=False)[1]
    return bool(np.isin(label[tets[elements, 0]], label[triangles[:, 0]]).any())


def passed_in_step(
    shape: str, axis: np.ndarray, mesh: TetMesh, positions: np.ndarray, centres: np.ndarray, triangles: np.ndarray
) -> str:
    """Return how an obstacle entered or passed the body in a step: "has its centre in", "went through", or "".

    The obstacle went through if a position on its path is inside the body both at the beginning and at the end of the
    step. If the obstacle only leaves the body, the body fills the space behind it: positions there are inside only at
    the end. If it pushes the body, the body moves away in front of it: positions there are inside only at the
    beginning.

    Args:
        positions: nodal positions (2, V, 3) [m] at the beginning and at the end of the step.
        centres: positions (2, 3) [m] of the obstacle at these two times.
        shape, axis, mesh, triangles: the same arguments as for `in_body`.
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
