"""Select nodes of a mesh by their position or by the name of a set, and triangles of the surface."""

import warnings
from collections.abc import Mapping

import numpy as np

from liverjax.core.bounds import finite
from liverjax.core.did_you_mean import as_word, hint
from liverjax.core.errors import InputError
from liverjax.core.struct import Indices
from liverjax.mesh.tetrahedra import FACES, TetMesh, tolerance_of_bounds

AXES = "xyz"
#: A bound may be in millimetres if it is larger than this multiple of the largest coordinate of the mesh.
FAR_OUTSIDE = 10.0
#: A warning is given if nodes lie beyond a bound by less than this fraction of the mesh's size.
_BARELY = 1e-6


def select(
    mesh: TetMesh, where: dict[str, float] | None = None, set: str | None = None, name: str = "where"
) -> np.ndarray:
    """Return the numbers of the nodes that satisfy all conditions of `where`, or that are in a node set of the mesh.

    Args:
        mesh: `TetMesh`.
        where: name of a bound (x_min, x_max, y_min, …) -> value [m]. Nodes on a bound are selected too, with the
            tolerance `tolerance_of_bounds`.
        set: name of a node set.
        name: name of the condition, for messages.

    Raises:
        InputError: `where` and `set` are both given or both missing, a key or set is unknown, or no node is found.
    """
    if (where is None) == (set is None):
        raise InputError(f'{name} needs either where = {{z_max = 0.0}} or set = "name": give one of them')
    if set is not None:
        if as_word(set, f"{name}: set") not in mesh.node_sets:
            there = ", ".join(mesh.node_sets) or "none"
            raise InputError(
                f"{name}: the mesh has no node set {set!r} (the node sets are: {there}); use one of these sets, or "
                "select the nodes with where"
            )
        nodes = np.asarray(mesh.node_sets[set])
        if not len(nodes):
            raise InputError(f"{name}: the node set {set!r} of the mesh contains no node; use another set or where")
        return nodes
    if not isinstance(where, Mapping):
        raise InputError(f"{name} = {where!r} is not a table of bounds: write where = {{z_max = 0.0}}")
    points = np.asarray(mesh.points)
    tolerance = tolerance_of_bounds(mesh)
    near = max(tolerance, _BARELY * float(np.linalg.norm(np.ptp(points, axis=0))))
    inside, beyond = np.ones(len(points), dtype=bool), np.full(len(points), -np.inf)
    known = [f"{a}_{end}" for a in AXES for end in ("min", "max")]
    for key, bound in where.items():
        if key not in known:
            raise InputError(f"{name}: {key!r} is not known: {hint(key, known)}")
        if isinstance(bound, bool) or not isinstance(bound, (int, float)) or not finite(bound):
            raise InputError(f"{name}: {key} = {bound!r} is not a length; give a number in metres")
        x = points[:, AXES.index(key[0])]
        _warn_of_millimetres(x, key, bound, name)
        inside &= x >= bound - tolerance if key.endswith("min") else x <= bound + tolerance
        beyond = np.maximum(beyond, bound - x if key.endswith("min") else x - bound)
    if not inside.any():
        low, high = points.min(axis=0), points.max(axis=0)
        box = ", ".join(f"{a} {lo:.4g} to {hi:.4g}" for a, lo, hi in zip(AXES, low, high, strict=True))
        raise InputError(f"{name} = {where} selects no node: choose bounds within the mesh, which spans {box} m")
    missed = beyond[~inside & (beyond <= near)]
    if missed.size:
        warnings.warn(
            f"{name} = {where} does not select {missed.size} nodes that lie up to {missed.max():.1g} m beyond a bound: "
            "give the bound with more digits, or a little wider",
            stacklevel=2,
        )
    return np.flatnonzero(inside)


def _warn_of_millimetres(x: np.ndarray, key: str, bound: float, name: str) -> None:
    """Warn if a bound excludes no node and is far outside of the mesh, but would lie within the mesh if it were in
    millimetres. The bounds 0.01, 0.1 and 1 m give no warning, because users write them to select all nodes."""
    low, high = x.min(), x.max()
    idle = bound > high if key.endswith("max") else bound < low
    far = abs(bound) > FAR_OUTSIDE * max(abs(low), abs(high)) and abs(bound) not in (0.01, 0.1, 1.0)
    if idle and far and low < 1e-3 * bound < high:
        warnings.warn(
            f"{name}: {key} = {bound:g} m excludes no node, since the mesh spans {low:.4g} to {high:.4g} m. Bounds are "
            f"in metres; write {1e-3 * bound:g} if you meant mm",
            stacklevel=3,
        )


def boundary_triangles(mesh: TetMesh, nodes: Indices | None = None) -> np.ndarray:
    """Return the surface triangles (m, 3), with outward normals. If `nodes` is given, return only the triangles with
    all corners in `nodes`."""
    tets = np.asarray(mesh.tetrahedra)
    faces = np.concatenate([tets[:, f] for f in FACES])
    codes = face_codes(np.sort(faces.astype(np.int64), axis=1), mesh.number_of_vertices)
    _, first, count = np.unique(codes, return_index=True, return_counts=True)
    outer = faces[np.sort(first[count == 1])]
    if nodes is None:
        return outer
    check_nodes(nodes, mesh.number_of_nodes, "boundary_triangles: nodes", least=0)
    return outer[np.isin(outer, np.asarray(nodes)).all(axis=1)]


def face_codes(triples: np.ndarray, V: int) -> np.ndarray:
    """Return an integer for each sorted triple of vertex numbers below V. Different triples have different integers.

    For V up to two million vertices, each integer is below 2^63, so it fits in 64 bits.
    """
    return (triples[:, 0] * V + triples[:, 1]) * V + triples[:, 2]


def surface_of(mesh: TetMesh, nodes: Indices | None, set: str | None = None) -> np.ndarray:
    """Return surface triangles (m, 3) with all vertices in `nodes`. If `set` is a triangle set, return only its
    triangles.

    Args:
        mesh: `TetMesh`.
        nodes: nodes of a region of the surface, from `select`. None means the whole surface.
        set: name of the set that selected the region, if any.
    """
    triangles, groups = boundary_triangles(mesh, nodes), mesh.triangle_sets or {}
    if set is None or set not in groups:
        return triangles
    group = {tuple(corners) for corners in np.sort(np.asarray(groups[set]), axis=1).tolist()}
    kept = triangles[[tuple(corners) in group for corners in np.sort(triangles, axis=1).tolist()]]
    if 0 < len(kept) < len(group):
        warnings.warn(
            f"{len(group) - len(kept)} of {len(group)} triangles of {set!r} are not on the surface and are ignored: "
            "define the set only with triangles of the surface",
            stacklevel=2,
        )
    return kept


def check_nodes(nodes: Indices, count: int, name: str, least: int = 1, once: bool = False) -> None:
    """Raise `InputError` if `nodes` is not a list (n,) of node numbers below `count`, with `least` or more numbers. If
    `once` is true, no number may occur twice.

    Raises:
        InputError: `nodes` is not such a list. The message begins with `name`.
    """
    numbers = np.asarray(nodes)
    if numbers.ndim != 1 or (numbers.size and numbers.dtype.kind not in "iu"):
        found = f"shape {numbers.shape}" if numbers.ndim != 1 else f"numbers of type {numbers.dtype}"
        raise InputError(f"{name} has {found}: give a list (n,) of whole node numbers")
    if numbers.size < least:
        raise InputError(f"{name} contains no node: give node numbers from 0 to {count - 1}")
    wrong = numbers[(numbers < 0) | (numbers >= count)]
    if wrong.size:
        raise InputError(
            f"{name} contains node {wrong[0]}, but the mesh has only the nodes 0 to {count - 1}: give node numbers in "
            "this range (node numbers start at 0)"
        )
    values, times = np.unique(numbers, return_counts=True) if once else (numbers, np.ones(1))
    if np.any(times > 1):
        raise InputError(f"{name} contains node {values[times > 1][0]} more than once: give each node once")


def check_triangles(mesh: TetMesh, triangles: Indices, name: str, outward: bool = False) -> None:
    """Raise `InputError` if triangles (m, 3) are not faces of elements.

    Args:
        mesh: `TetMesh`.
        triangles: node numbers (m, 3).
        name: name of the triangles, at the beginning of the message.
        outward: whether the triangles must lie on the surface, in an order with outward normals.

    Raises:
        InputError: `triangles` has another shape, a node does not exist, a triangle occurs twice or is not a face, or
            (if `outward`) it points inward or lies inside the body.
    """
    numbers = np.asarray(triangles)
    if numbers.ndim != 2 or numbers.shape[1] != 3:
        raise InputError(f"{name} has shape {numbers.shape}: give three node numbers per triangle (m, 3)")
    check_nodes(numbers.ravel(), mesh.number_of_vertices, name)
    V, touched = mesh.number_of_vertices, np.zeros(mesh.number_of_vertices, bool)
    touched[numbers] = True
    tets = np.asarray(mesh.tetrahedra)
    near = tets[touched[tets].sum(axis=1) >= 3]
    faces = np.sort(np.concatenate([near[:, f] for f in FACES]), axis=1)
    own = np.sort(numbers, axis=1)
    code = np.array([V * V, V, 1])
    lost = np.flatnonzero(~np.isin(own @ code, faces @ code))
    if len(lost):
        first = numbers[lost[0]].tolist()
        raise InputError(
            f"{name} contains the triangle {first}, which is not a face of an element: use the triangles from "
            "boundary_triangles(mesh)"
        )
    _, once, times = np.unique(own @ code, return_index=True, return_counts=True)
    if np.any(times > 1):
        first = numbers[once[times > 1][0]].tolist()
        raise InputError(f"{name} contains the triangle {first} more than once: give each triangle once")
    if outward:
        way = np.concatenate([near[:, f] for f in FACES])
        inner = np.isin(_turned(numbers[:, ::-1]) @ code, _turned(way) @ code)
        if np.any(inner):
            first = numbers[np.flatnonzero(inner)[0]].tolist()
            raise InputError(
                f"{name}: the triangle {first} points inward or lies inside the body, so its pressure has the wrong "
                "sign: use the triangles from boundary_triangles(mesh)"
            )


def _turned(triangles: np.ndarray) -> np.ndarray:
    """Return triangles (m, 3) that begin with their smallest node number, in the same direction of rotation."""
    first = triangles.argmin(axis=1)[:, None]
    return np.take_along_axis(triangles, (first + np.arange(3)) % 3, axis=1).astype(np.int64)
