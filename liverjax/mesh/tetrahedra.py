"""Meshes of straight tetrahedra: positions, constant shape vectors, and sets of nodes and elements.

An element has 4 nodes, or 10 nodes: its vertices and the middles of its edges (`liverjax.mesh.promotion`).
"""

import dataclasses
from collections.abc import Mapping, Sequence
from typing import Any, TypeVar

import jax
import jax.numpy as jnp
import numpy as np

from liverjax.core.errors import InputError
from liverjax.core.struct import Indices, Numbers, param, static, struct
from liverjax.mesh.adjacency import PAIRS, Pattern, node_numbers, pattern
from liverjax.mesh.shape_functions import basis
from liverjax.tensors.matrices import stored
from liverjax.tensors.places import given, taken

T = TypeVar("T")

UNITS = {"m": 1.0, "cm": 1e-2, "mm": 1e-3, "um": 1e-6}


@struct
class TetMesh:
    """Straight tetrahedra with their reference geometry: a pytree with arrays as leaves.

    `tet_mesh` makes a mesh. `tet_mesh` and `with_points` compute `shape_vectors` and `volumes` from points and
    tetrahedra. JAX can differentiate these functions with respect to the points.
    With `order` 2 the nodes are the vertices, followed by the middles of the edges in the order of `pattern.edges`.
    """

    points: jax.Array = param("m", "reference positions (V, 3)")
    tetrahedra: jax.Array = param("1", "vertices of every element (E, 4), positively oriented")
    shape_vectors: jax.Array = param(
        "1/m", "gradients D_a of the linear functions of corners a = 1, 2, 3, shape (3, 3, E); D_0 is minus their sum"
    )
    volumes: jax.Array = param("m^3", "reference volumes (E,)")
    node_sets: dict[str, Any] = param("1", "named arrays of node numbers")
    element_sets: dict[str, Any] = param("1", "named arrays of element numbers")
    pattern: Pattern = param("1", "which vertices share an element")
    triangle_sets: dict[str, jax.Array] | None = param(
        "1", "named arrays of triangles' vertices (m, 3); None if the file has no triangle sets", default=None
    )
    faces: Any = param("1", "numbers of the four faces of every element (4, E), only for order 3", default=None)
    clusters: Any = param("1", "`Clusters` of all nodes, if elements are thin and the order is above 1", default=None)
    order: int = static(default=1, about="order of the shape functions: 1 linear, 2 quadratic", lower=1)

    @property
    def number_of_nodes(self) -> int:
        """Number V of nodes. The nodes are the vertices and, in order 2, the middles of edges.

        In order 3 the additional functions are counted too.
        """
        return self.points.shape[0]

    @property
    def number_of_vertices(self) -> int:
        """Number of vertices (corners of elements). The vertices are the first nodes."""
        return self.pattern.row_nodes.shape[1]

    @property
    def number_of_elements(self) -> int:
        """Number of elements, E."""
        return self.tetrahedra.shape[0]

    @property
    def weights(self) -> jax.Array:
        """Reference volume [m^3] of every integration point: (E,) for linear elements, otherwise (Q, E) with Q points
        per element."""
        if self.order == 1:
            return self.volumes
        return jnp.asarray(basis(self.order).weights, self.volumes.dtype)[:, None] * self.volumes[None]

    @property
    def gradients(self) -> jax.Array:
        """Shape vectors [1/m] with an axis for the integration points: (3, 3, 1, E). Linear elements: (3, 3, E)."""
        return self.shape_vectors if self.order == 1 else self.shape_vectors[:, :, None]

    def at_points(self, numbers: T) -> T:
        """Return the pytree `numbers`, for example a law, for use at the integration points.

        If the order is above 1, arrays (E,) and (E, 3) get a new first axis of length 1.
        """
        if self.order == 1:
            return numbers
        by_element = ((self.number_of_elements,), (self.number_of_elements, 3))
        return jax.tree.map(lambda a: a[None] if jnp.shape(a) in by_element else a, numbers)

    @property
    def element_nodes(self) -> list[jax.Array]:
        """Node numbers of every element, as a list of arrays (E,): 4 vertices; in quadratic meshes also the middles of
        the 6 edges `PAIRS`; in order 3 also the indices of the additional functions."""
        return self._nodes(self.tetrahedra, self.pattern.element_edges, self.faces)

    @property
    def element_nodes_on_host(self) -> np.ndarray:
        """Return `element_nodes` as one NumPy array (n, E), with n nodes in each element.

        With JAX arrays, JAX would compile a program for each of the n rows.
        """
        faces = None if self.faces is None else np.asarray(self.faces)
        return np.stack(self._nodes(np.asarray(self.tetrahedra), np.asarray(self.pattern.element_edges), faces))

    def _nodes(self, tetrahedra: Indices, edges: Indices, faces: Indices | None) -> list:
        vertices = [tetrahedra[:, a] for a in range(4)]
        if self.order == 1:
            return vertices
        V, N = self.number_of_vertices, self.pattern.edges.shape[1]
        middles = [V + edge for edge in edges]
        if self.order == 2:
            return vertices + middles
        more = () if faces is None else faces
        return vertices + middles + [N + m for m in middles] + [V + 2 * N + face for face in more]

    def edges(self, columns: Sequence[jax.Array]) -> list[tuple[jax.Array, ...]]:
        """Return the differences y_k - y_0 (k = 1, 2, 3) of the corner values of a nodal field with `columns` (V,).

        There is one array for each k and each column: (E,), or (Q, E) with Q integration points per element. The corner
        values y_k are defined in `liverjax.mesh.shape_functions`. The gradient of the field is the sum of
        (y_k - y_0) D_k with the shape vectors D_k.
        """
        if self.order == 1:
            corners = [taken(column, self.tetrahedra.T) for column in columns]
            return [tuple(own[k] - own[0] for own in corners) for k in (1, 2, 3)]
        nodes = jnp.stack(self.element_nodes)
        values = self.oriented(jnp.stack([taken(column, nodes) for column in columns], axis=1))
        y = jnp.tensordot(self._slopes(), values, axes=(1, 0)).reshape(3, -1, *values.shape[1:])
        return [tuple(y[k, :, i] for i in range(len(columns))) for k in range(3)]

    def spread(self, forces: Sequence[Sequence[jax.Array]]) -> list[jax.Array]:
        """Return nodal forces, one column (V,) per component, from `forces` at corners 1, 2, 3 of the elements.

        The force at corner 0 is minus the sum of the forces at the other corners. This function is the transpose of
        `edges`.
        """
        count = len(forces[0])
        if self.order == 1:
            forces = [[-(forces[0][i] + forces[1][i] + forces[2][i]) for i in range(count)], *forces]
            shares = [[force[i] for force in forces] for i in range(count)]
        else:
            whole = jnp.stack([jnp.stack(force, axis=1) for force in forces])
            values = jnp.tensordot(self._slopes().T, whole.reshape(-1, *whole.shape[2:]), axes=(1, 0))
            values = self.oriented(values)
            shares = [[values[:, i]] for i in range(count)]
        nodes = jnp.concatenate(self.element_nodes)
        columns = []
        for own in stored(shares):
            values = jnp.concatenate(own) if self.order == 1 else own[0].ravel()
            columns.append(given(jnp.zeros(self.number_of_nodes, values.dtype), nodes, values))
        return columns

    def _slopes(self) -> jax.Array:
        """Return the differences c_ak - c_a0 as a matrix (3 Q, n), for n nodes and Q integration points of an element.

        c_ak is the derivative of the shape function a with respect to the barycentric coordinate k. With one matrix
        product, the compiled program of `edges` is small.
        """
        c = basis(self.order).c
        return jnp.asarray((c[:, 1:] - c[:, :1]).reshape(len(c), -1).T, self.volumes.dtype)

    def oriented(self, values: jax.Array) -> jax.Array:
        """Multiply values (n, C, E) of n functions and C components by the signs of the functions.

        A function of order 3 on an edge has a direction, towards the vertex with the higher number. If this vertex is
        the first end of the edge in the local numbering of the element, the sign of the function in this element is -1.
        """
        if self.order < 3:
            return values
        t, first = self.tetrahedra, 4 + len(PAIRS)
        signs = jnp.stack([jnp.where(t[:, i] < t[:, j], 1.0, -1.0) for i, j in PAIRS]).astype(values.dtype)
        return values.at[first : first + len(PAIRS)].multiply(signs[:, None])


def tet_mesh(
    points: Numbers,
    tetrahedra: Indices,
    node_sets: Mapping[str, object] | None = None,
    element_sets: Mapping[str, object] | None = None,
) -> TetMesh:
    """Make a mesh from positions (V, 3) [m] and node numbers (E, 4). The geometry is not checked (see `check_mesh`).

    A set contains the numbers of its nodes or elements, or it is a mask (V,) or (E,).

    The positions may be unknown (inside jit, grad or vmap), but the node numbers must be known.
    """
    if isinstance(tetrahedra, jax.core.Tracer):
        raise InputError(
            "tet_mesh: the node numbers are unknown inside jit, grad or vmap; make the mesh outside of these functions"
        )
    # `asarray` may share memory with the given arrays, so copies are made. NumPy needs no compiled program for a copy.
    points = jnp.array(points, float) if isinstance(points, jax.core.Tracer) else _float_copy(points)
    neighbours = pattern(tetrahedra, points)
    tetrahedra = node_numbers(tetrahedra)
    shape_vectors, volumes = _geometry(points, tetrahedra)
    nodes, elements = (
        {name: node_numbers(_numbers_of_set(own, name)) for name, own in (sets or {}).items()}
        for sets in (node_sets, element_sets)
    )
    return TetMesh(
        points=points,
        tetrahedra=tetrahedra,
        shape_vectors=shape_vectors,
        volumes=volumes,
        node_sets=nodes,
        element_sets=elements,
        pattern=neighbours,
    )


def _numbers_of_set(members: object, name: str) -> np.ndarray:
    """Return the numbers of the nodes or elements of a set. The user may also give a mask (True for each member)."""
    own = np.asarray(members)
    if own.dtype.kind == "b":
        return np.flatnonzero(own)
    if own.size and own.dtype.kind not in "iu":
        raise InputError(f"tet_mesh: the set {name!r} has numbers of type {own.dtype}: give whole numbers, or a mask")
    return own


def _float_copy(points: Numbers) -> jax.Array:
    return jax.device_put(np.array(points, jnp.result_type(float)))


def with_points(mesh: TetMesh, points: Numbers) -> TetMesh:
    """Return the mesh with other reference positions (V, 3) [m]. The patches of nodes (`Pattern`) do not change.

    The positions may be unknown (inside jit, grad or vmap). Edges stay straight: in a quadratic mesh the middles of
    edges are computed from the vertices.
    """
    points = jnp.array(points, mesh.points.dtype)
    if points.shape != mesh.points.shape:
        raise InputError(f"mesh.points has shape {points.shape}: give positions of shape {mesh.points.shape}")
    if mesh.order > 1:
        vertices, (low, high) = points[: mesh.number_of_vertices], mesh.pattern.edges
        points = jnp.concatenate([vertices, 0.5 * (vertices[low] + vertices[high])])
    shape_vectors, volumes = _geometry(points, mesh.tetrahedra)
    return dataclasses.replace(mesh, points=points, shape_vectors=shape_vectors, volumes=volumes)


@jax.jit
def _geometry(points: jax.Array, tetrahedra: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Compute shape vectors and volumes. A shape vector is a cross product of edges divided by six times the volume."""
    corner = points[tetrahedra]
    e = corner[:, 1:] - corner[:, :1]
    normals = jnp.stack([jnp.cross(e[:, 1], e[:, 2]), jnp.cross(e[:, 2], e[:, 0]), jnp.cross(e[:, 0], e[:, 1])])
    six_volumes = (e[:, 0] * normals[0]).sum(-1)
    return jnp.transpose(normals / six_volumes[None, :, None], (0, 2, 1)), six_volumes / 6


def check_mesh(mesh: TetMesh, name: str = "mesh") -> None:
    """Raise `InputError` for a mesh that no simulation can use. Nothing is compiled.

    Raises:
        InputError: the mesh has no elements, node numbers out of range or positions that are not finite. Other causes
            are flat or inverted elements, elements that occur twice or lie on the same side of a common face, and
            vertices without an element.
    """
    points, tets = np.asarray(mesh.points), np.asarray(mesh.tetrahedra)
    if tets.size == 0:
        raise InputError(f"{name}: there are no tetrahedra; export a volume mesh, not a surface")
    if tets.min() < 0 or tets.max() >= len(points):
        raise InputError(
            f"{name}: tetrahedra contain node numbers that do not exist (largest number {tets.max()}, number of nodes "
            f"{len(points)}); number the nodes from 0"
        )
    if not np.all(np.isfinite(points)):
        bad = int(np.argwhere(~np.isfinite(points).all(axis=1))[0, 0])
        raise InputError(f"{name}: the position of node {bad} is {points[bad]}; give finite coordinates")
    volumes = np.asarray(mesh.volumes)
    edge = np.linalg.norm(points[tets[:, 1:]] - points[tets[:, :1]], axis=-1).max(axis=1)
    flat = np.flatnonzero(~(volumes > 1e-12 * edge**3))
    if len(flat):
        raise InputError(
            f"{name}: {len(flat)} of {len(tets)} tetrahedra are flat or inverted (first: {flat[0]}, volume "
            f"{volumes[flat[0]]:.3g} m^3); swap two nodes of each inverted tetrahedron, or remesh the body"
        )
    _, first, copies = np.unique(np.sort(tets, axis=1), axis=0, return_index=True, return_counts=True)
    if np.any(copies > 1):
        again = int(first[copies > 1].min())
        raise InputError(
            f"{name}: {int((copies - 1).sum())} tetrahedra occur twice (first: {again}, nodes "
            f"{tets[again].tolist()}); remove the copies"
        )
    _refuse_overlaps(tets, name)
    unused = np.setdiff1d(np.arange(mesh.number_of_vertices), tets)
    if len(unused):
        raise InputError(
            f"{name}: {len(unused)} nodes belong to no tetrahedron (first: {unused[0]}); remove these nodes"
        )


#: Relative roundoff of coordinates with six digits, and an upper bound of the roundoff in single precision.
SIX_DIGITS, SINGLE_PRECISION = 5e-6, 1.2e-7
#: The roundoff of the coordinates is regarded as at most this fraction of an edge.
OF_AN_EDGE = 1e-3


def roundoff_of(mesh: TetMesh, relative: float = SIX_DIGITS) -> float:
    """Return a tolerance [m]: two places in a mesh are regarded as the same place if their distance is below it.

    The tolerance is the fraction `relative` of the largest coordinate, but at most the fraction `OF_AN_EDGE` of the
    shortest edge, and at least 1e-9 of the mesh's size.
    """
    points, (low, high) = np.asarray(mesh.points), np.asarray(mesh.pattern.edges)
    shortest = np.linalg.norm(points[high] - points[low], axis=1).min()
    size = np.linalg.norm(np.ptp(points, axis=0))
    return float(max(1e-9 * size, min(relative * np.abs(points).max(), OF_AN_EDGE * shortest)))


def tolerance_of_bounds(mesh: TetMesh) -> float:
    """Return the maximum distance [m] between a bound and a node on this bound: 1e-9 of the mesh's size.

    If the coordinates are single-precision numbers in one of the `UNITS`, and not short decimals, it is the roundoff.
    """
    points = np.asarray(mesh.points, float)[: mesh.number_of_vertices]  # not midside nodes: they may be computed

    def are(rounded: np.ndarray) -> bool:
        return bool(np.all(np.abs(rounded - points) <= 1e-15 * np.abs(points)))

    # Decimal numbers of few digits may also be exact in single precision. They have no roundoff.
    short = are(np.round(points, 9))
    single = not short and any(are((points / unit).astype(np.float32).astype(float) * unit) for unit in UNITS.values())
    return roundoff_of(mesh, SINGLE_PRECISION if single else 0.0)


#: The faces of a tetrahedron, counterclockwise if seen from outside.
FACES = ((1, 2, 3), (0, 3, 2), (0, 1, 3), (0, 2, 1))


def _refuse_overlaps(tets: np.ndarray, name: str) -> None:
    """Raise `InputError` if two elements lie on the same side of a common face: such elements overlap."""
    faces = tets[:, FACES].reshape(-1, 3)
    first = faces.argmin(axis=1)[:, None]
    turned = np.take_along_axis(faces, (first + np.arange(3)) % 3, axis=1).astype(np.int64)
    nodes = int(tets.max()) + 1
    keys = (turned[:, 0] * nodes + turned[:, 1]) * nodes + turned[:, 2]
    _, place, copies = np.unique(keys, return_index=True, return_counts=True)
    if np.any(copies > 1):
        own = int(place[copies > 1].min())
        raise InputError(
            f"{name}: tetrahedra overlap, since {int((copies > 1).sum())} faces have two tetrahedra on the same side "
            f"(first face: nodes {faces[own].tolist()} of element {own // 4}); remesh the body, or remove one "
            "tetrahedron of each pair"
        )
