"""Find the tetrahedra of a mesh that contain points and lines, in NumPy (not in JAX)."""

from typing import NamedTuple

import numpy as np

from liverjax.core.errors import InputError
from liverjax.mesh.selection import boundary_triangles
from liverjax.mesh.shape_functions import functions
from liverjax.mesh.tetrahedra import OF_AN_EDGE, SIX_DIGITS, TetMesh, roundoff_of

#: A point is in a tetrahedron if all its barycentric coordinates are above minus this number.
_INSIDE = 1e-9
#: Two vertices coincide if their distance is below the limits of both vertices. The limit of a vertex is the roundoff
#: of coordinates with six digits (`SIX_DIGITS`), but at most the fraction `OF_AN_EDGE` of its shortest edge, and at
#: least the fraction `SAME_PLACE` of the body's size.
SAME_PLACE = 1e-9
#: A vertex lies on a face if its distance from the face is below a limit. The limit is the roundoff of coordinates with
#: six digits (`SIX_DIGITS`), but at least `_ON_FACE` times and at most 100 `_ON_FACE` times the size of the face.
_ON_FACE = 1e-5
#: Maximum number of vertices near a triangle, in the search for hanging nodes. Only needle-like triangles have more.
_MOST_NEAR = 200
#: A piece of a line is ignored if it is shorter than this fraction of the line.
_SHORTEST = 1e-9


class Pieces(NamedTuple):
    """Pieces of lines, each in one tetrahedron."""

    element: np.ndarray  # (m,) number of the tetrahedron
    line: np.ndarray  # (m,) number of the line
    begin: np.ndarray  # (m,) beginning of the piece as a fraction of the line, from 0 to 1
    end: np.ndarray  # (m,) end of the piece as a fraction of the line, from 0 to 1


def doubled_vertices(mesh: TetMesh) -> int:
    """Return the number of vertices that coincide with another vertex, up to the roundoff of their coordinates. At such
    vertices, the mesh is not connected."""
    from scipy.spatial import cKDTree  # slow to import

    points, (low, high) = np.asarray(mesh.points), np.asarray(mesh.pattern.edges)
    length, shortest = np.linalg.norm(points[high] - points[low], axis=1), np.full(mesh.number_of_vertices, np.inf)
    for end in (low, high):
        np.minimum.at(shortest, end, length)
    least = SAME_PLACE * float(np.ptp(points, axis=0).max())
    near = np.maximum(least, np.minimum(SIX_DIGITS * np.abs(points).max(), OF_AN_EDGE * shortest))  # for each vertex
    pairs = cKDTree(points[: mesh.number_of_vertices]).query_pairs(near.max(), output_type="ndarray")
    apart = np.linalg.norm(points[pairs[:, 1]] - points[pairs[:, 0]], axis=1)
    return len(np.unique(pairs[apart <= near[pairs].min(axis=1), 1]))


def hanging_vertices(mesh: TetMesh) -> int:
    """Return the number of hanging nodes: vertices on a face or an edge of the boundary that are not corners of this
    face or edge. There, the mesh is not connected, because the vertex is a corner only of the elements on one side.
    Needle-like triangles with more than `_MOST_NEAR` vertices nearby are not searched."""
    from scipy.spatial import cKDTree  # slow to import

    points, triangles = np.asarray(mesh.points), np.asarray(boundary_triangles(mesh))
    corners, vertices = points[triangles], np.unique(triangles)
    middles = corners.mean(axis=1)
    radii = np.linalg.norm(corners - middles[:, None], axis=2).max(axis=1)
    tree, found = cKDTree(points[vertices]), []
    few = np.flatnonzero(tree.query_ball_point(middles, radii, return_length=True) <= _MOST_NEAR)
    for chunk in np.array_split(few, len(few) // 10_000 + 1):
        near = tree.query_ball_point(middles[chunk], radii[chunk])
        pair = np.repeat(chunk, [len(one) for one in near])
        vertex = vertices[np.concatenate([*near, []]).astype(int)]
        away = np.clip(SIX_DIGITS * np.abs(points).max() / radii[pair], _ON_FACE, 100 * _ON_FACE)
        found.append(vertex[_on_triangle(points[vertex], corners[pair], away)])
    return len(np.unique(np.concatenate(found)))


def _on_triangle(p: np.ndarray, corners: np.ndarray, away: np.ndarray) -> np.ndarray:
    """Return for each point p (n, 3) whether it lies on its triangle, but not at a corner. `corners` (n, 3, 3): corners
    of the triangles. `away` (n,): allowed distance, divided by the size of the triangle."""
    a, b, c = np.moveaxis(corners, 1, 0)
    normal = np.cross(b - a, c - a)
    square = np.sum(normal**2, axis=1)
    size = np.linalg.norm(corners - corners.mean(axis=1)[:, None], axis=2).max(axis=1)
    flat = np.abs(np.sum(normal * (p - a), axis=1)) <= away * size * np.sqrt(square)
    parts = [np.sum(normal * np.cross(y - x, p - x), axis=1) for x, y in ((b, c), (c, a), (a, b))]
    inside = (np.min(parts, axis=0) >= -away * square) & (np.max(parts, axis=0) < (1 - away) * square)
    return flat & inside


def barycentric(mesh: TetMesh, points: np.ndarray) -> np.ndarray:
    """Return the barycentric coordinates (4, n, E) of points (n, 3) [m] in every tetrahedron."""
    corners = np.asarray(mesh.points)[np.asarray(mesh.tetrahedra)]
    inverse = np.linalg.inv(np.swapaxes(corners[:, 1:] - corners[:, :1], 1, 2))
    rest = np.einsum("eij,nej->ine", inverse, points[:, None] - corners[None, :, 0])
    return np.concatenate([1 - rest.sum(axis=0)[None], rest])


def elements_at(mesh: TetMesh, points: np.ndarray, name: str) -> tuple[np.ndarray, np.ndarray]:
    """Return the elements (n,) that contain points (n, 3) [m], and the barycentric coordinates (4, n) of the points.

    A point on the surface may lie outside of the body by the roundoff of the coordinates (`roundoff_of`).

    Raises:
        InputError: a point is outside the mesh.
    """
    L = barycentric(mesh, points)
    least = L.min(axis=0)
    element = least.argmax(axis=1)
    D = np.asarray(mesh.shape_vectors)[..., element]
    slope = np.linalg.norm(np.concatenate([D, -D.sum(axis=0, keepdims=True)]), axis=1).max(axis=0)
    beyond = least.max(axis=1) + np.maximum(_INSIDE, roundoff_of(mesh) * slope)
    worst = int(beyond.argmin())
    if beyond[worst] < 0:
        raise InputError(
            f"{name}: the point {points[worst].tolist()} m is outside the body; move this point into the body"
        )
    return element, L[:, np.arange(len(points)), element]


def around_a_point(corners: np.ndarray) -> np.ndarray:
    """Return, for each of E tetrahedra, whether it contains the origin. `corners` (E, 4, 3): corners of the
    tetrahedra."""
    a, b, c, d = np.moveaxis(corners, 1, 0)

    def volume(p: np.ndarray, q: np.ndarray, r: np.ndarray) -> np.ndarray:
        return np.einsum("ei,ei->e", p, np.cross(q, r))

    parts = np.stack([volume(b, c, d), -volume(a, c, d), volume(a, b, d), -volume(a, b, c)])
    return _all_alike(parts)


def around_a_point_in_plane(corners: np.ndarray) -> np.ndarray:
    """Return, for each of E tetrahedra, whether its projection onto a plane contains the origin of the plane.

    `corners` (E, 4, 2): positions of the corners in the plane.
    """
    met = np.zeros(len(corners), bool)
    for face in ([1, 2, 3], [0, 2, 3], [0, 1, 3], [0, 1, 2]):
        a, b, c = np.moveaxis(corners[:, face], 1, 0)
        parts = np.stack([p[:, 0] * q[:, 1] - p[:, 1] * q[:, 0] for p, q in ((b, c), (c, a), (a, b))])
        met |= _all_alike(parts)
    return met


#: Local node numbers of the eight straight tetrahedra that together fill a 10-node element.
_EIGHTHS = np.array(
    [[0, 4, 5, 6], [1, 4, 7, 8], [2, 5, 7, 9], [3, 6, 8, 9], [5, 8, 4, 6], [5, 8, 6, 9], [5, 8, 9, 7], [5, 8, 7, 4]]
)


def straight_corners(mesh: TetMesh, x: np.ndarray) -> np.ndarray:
    """Return the corners (E, 4, 3) [m] of the elements at positions x (V, 3) [m].

    A 10-node element is replaced by eight straight tetrahedra. The result is then (8 E, 4, 3).
    """
    if mesh.order == 1:
        return x[np.asarray(mesh.tetrahedra)]
    nodes = mesh.element_nodes_on_host[:10].T
    return x[nodes[:, _EIGHTHS].reshape(-1, 4)]


def _all_alike(parts: np.ndarray) -> np.ndarray:
    """Return, for each of E elements, whether its n numbers in `parts` (n, E) have the same sign, except for roundoff.

    The result is False if the sum of these numbers is 0.
    """
    whole = parts.sum(axis=0)
    return (whole != 0) & ((np.sign(whole) * parts).min(axis=0) >= -_INSIDE * np.abs(whole))


def weights(mesh: TetMesh, element: np.ndarray, L: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the nodes (n, m) of m elements, and the values (n, m) of their shape functions at one point per element.

    `L` (4, m): barycentric coordinates of the points.
    """
    nodes = mesh.element_nodes_on_host[: 4 if mesh.order == 1 else 10, element]
    return nodes, L if mesh.order == 1 else functions(2, L)[0]


def pieces(mesh: TetMesh, begin: np.ndarray, end: np.ndarray) -> Pieces:
    """Cut straight lines from `begin` to `end` (n, 3) [m] at the faces of tetrahedra.

    Pieces outside the mesh are removed.
    """
    return cut_lines(barycentric(mesh, begin), barycentric(mesh, end))


def cut_lines(first: np.ndarray, last: np.ndarray) -> Pieces:
    """Cut n straight lines at the faces of E tetrahedra. Pieces outside of the tetrahedra are removed.

    Args:
        first, last: barycentric coordinates (4, n, E) of the beginning and of the end of each line in all tetrahedra.
    """
    found = []
    for line in range(first.shape[1]):
        a, b = first[:, line], last[:, line] - first[:, line]
        with np.errstate(divide="ignore", invalid="ignore"):
            cut = -a / b
        cuts = np.unique(np.concatenate([[0.0, 1.0], cut[(cut > 0) & (cut < 1)]]))
        cuts = cuts[np.concatenate([[True], np.diff(cuts) > _SHORTEST])]
        cuts[-1] = 1.0
        middle = 0.5 * (cuts[1:] + cuts[:-1])
        least = (a[:, None] + b[:, None] * middle[None, :, None]).min(axis=0)
        element = least.argmax(axis=1)
        inside = least[np.arange(len(middle)), element] > -_INSIDE
        # The lines were also cut at the planes of distant elements, so neighbouring pieces in the same element are
        # joined.
        start = np.flatnonzero(inside & ~np.concatenate([[False], (element[1:] == element[:-1]) & inside[:-1]]))
        for k in start:
            stop = k
            while stop + 1 < len(middle) and inside[stop + 1] and element[stop + 1] == element[k]:
                stop += 1
            found.append((element[k], line, cuts[k], cuts[stop + 1]))
    table = np.array(found, float).reshape(-1, 4)
    return Pieces(table[:, 0].astype(int), table[:, 1].astype(int), table[:, 2], table[:, 3])
