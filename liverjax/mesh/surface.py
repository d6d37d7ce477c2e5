"""Integrate over triangles of the surface, to distribute tractions, pressures and springs to nodes."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import DTypeLike

from liverjax.core.struct import Indices
from liverjax.mesh.shape_functions import FACES, triangle_rule
from liverjax.mesh.tetrahedra import TetMesh

#: Edges of a triangle. Middle nodes are listed in this order.
_EDGES = ((0, 1), (1, 2), (2, 0))
#: The same edges. If the vertices of the triangle are in increasing order, each edge leads from its lower to its higher
#: vertex. This is the direction of the shape function of order 3 on the edge.
_THIRD = ((0, 1), (1, 2), (0, 2))


def triangle_nodes(mesh: TetMesh, triangles: Indices) -> list[Indices]:
    """Return the node numbers (m,) of triangles (m, 3): their vertices and, in quadratic meshes, middles of edges.

    For triangles (m, 4) of a mesh of order 3, the numbers of the functions of order 3 on edges and face follow.
    """
    vertices = [triangles[:, a] for a in range(3)]
    if mesh.order == 1:
        return vertices
    middles = [_middle(mesh, triangles[:, a], triangles[:, b]) for a, b in _EDGES]
    if triangles.shape[1] == 3:
        return vertices + middles
    edges = mesh.pattern.edges.shape[1]
    return [*vertices, *middles, *(n + edges for n in middles), mesh.number_of_vertices + 2 * edges + triangles[:, 3]]


def _middle(mesh: TetMesh, a: Indices, b: Indices) -> jax.Array:
    """Return the numbers (m,) of the nodes at the middle of edges between vertices a and b (m,)."""
    pattern = mesh.pattern
    edge = jnp.where(pattern.row_nodes[:, a] == b[None], pattern.row_edges[:, a], 0)
    return mesh.number_of_vertices + jnp.sum(edge, axis=0)


# If this function is called outside a compiled program, jit compiles all its operations as one program.
@partial(jax.jit, inline=True)
def areas(points: jax.Array, triangles: Indices) -> jax.Array:
    """Return area times unit normal (m, 3) [m^2] of flat triangles."""
    corner = points[triangles]
    return 0.5 * jnp.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0])


@partial(jax.jit, inline=True)
def elements_of_faces(mesh: TetMesh, triangles: Indices) -> jax.Array:
    """Return, for each triangle (m, 3) of the surface, the number (m,) of the element with this face.

    All node numbers may be unknown (inside jit).
    """
    faces = jnp.concatenate([mesh.tetrahedra[:, list(face)] for face in FACES])  # number f E + e: face f of element e
    ordered = jnp.sort(jnp.concatenate([faces, triangles[:, :3]]), axis=1)
    order = jnp.lexsort(ordered.T)  # a triangle comes directly after the equal face
    places = jnp.where(order < len(faces), jnp.arange(len(order)), 0)
    face = order[jax.lax.cummax(places)]
    return jnp.zeros_like(order).at[order].set(face)[len(faces) :] % mesh.number_of_elements


def nodal_shares(mesh: TetMesh, triangles: Indices) -> list[tuple[Indices, float]]:
    """Return the nodes (m,) of flat triangles that carry a uniform load, and the share of the load of each node.

    In a linear mesh, each vertex carries a third of the load. In a quadratic mesh, the integrals of the vertices' shape
    functions are 0, and the middle node of each edge carries a third. Triangles (m, 4) of a mesh of order 3 have the
    number of their face in the last column; the function of this face gets 9/20 of the load.
    """
    nodes = triangle_nodes(mesh, triangles)
    if mesh.order == 1:
        return [(n, 1 / 3) for n in nodes]
    found = [(n, 1 / 3) for n in nodes[3:6]]
    return [*found, (nodes[-1], 9 / 20)] if triangles.shape[1] == 4 else found


def pressure_forces(triangles: Indices, x: jax.Array, mesh: TetMesh | None = None) -> jax.Array:
    """Return nodal forces (V, 3) [N] of a pressure of 1 Pa on the triangles at positions x (V, 3) [m].

    The forces are the integrals of -N n da with the shape functions N and the normal n.
    """
    if mesh is None or mesh.order == 1:
        corner = x[triangles]
        twice = jnp.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0])
        nodes, own = triangles.T, jnp.broadcast_to(-1 / 6 * twice, (3, *twice.shape))
    else:
        nodes = jnp.stack(triangle_nodes(mesh, triangles))
        # The integrals are exact if the positions are quadratic functions. At the reference shape, the derivatives of
        # the integrals with respect to the positions are also exact.
        weights, l = triangle_rule(4 if mesh.order == 2 else 5)
        N, along = (_quadratic if mesh.order == 2 else _ten_functions)(l)
        signs = None if mesh.order == 2 else _signs_of_functions(triangles, x.dtype)
        at = x[nodes] if signs is None else signs * x[nodes]
        first, second = (jnp.tensordot(jnp.asarray(slope.T, x.dtype), at, axes=1) for slope in along)
        own = jnp.tensordot(jnp.asarray(-0.5 * weights * N, x.dtype), jnp.cross(first, second), axes=1)
        own = own if signs is None else signs * own
    return jnp.zeros_like(x).at[nodes].add(own)


def _signs_of_functions(triangles: Indices, dtype: DTypeLike) -> jax.Array:
    """Return signs (10, m, 1) of the ten functions of triangles (m, 4) with outward normals.

    A function of order 3 on an edge points to the vertex with the higher number. If the edge in `_THIRD` leads to the
    vertex with the lower number, the sign is -1.
    """
    signs = jnp.ones((10, len(triangles), 1), dtype)
    for k, (a, b) in enumerate(_THIRD):
        signs = signs.at[6 + k, :, 0].set(jnp.where(triangles[:, a] < triangles[:, b], 1, -1))
    return signs


def triangle_slopes(mesh: TetMesh) -> tuple[np.ndarray, np.ndarray]:
    """Return weights (Q,) of Q points on a triangle, and derivatives (2, Q, n) of its n functions at these points.

    The directions of the derivatives are from the first vertex to the second and to the third vertex.
    """
    if mesh.order == 1:
        return np.ones(1), np.array([[[-1.0, 1.0, 0.0]], [[-1.0, 0.0, 1.0]]])
    weights, l = triangle_rule()
    along = (_quadratic if mesh.order == 2 else _ten_functions)(l)[1]
    return weights, np.swapaxes(np.stack(along), 1, 2)


def triangle_functions(mesh: TetMesh, l: np.ndarray) -> np.ndarray:
    """Return the n shape functions (n, Q) of a triangle's nodes (`triangle_nodes`) at barycentric coordinates l (3, Q).

    In a mesh of order 3 the functions on edges point to the vertex with the higher number. So the vertices of triangles
    must be in increasing order (`liverjax.mesh.promotion.with_faces`).
    """
    return l if mesh.order == 1 else (_quadratic if mesh.order == 2 else _ten_functions)(l)[0]


def _quadratic(l: np.ndarray) -> tuple[np.ndarray, list[np.ndarray]]:
    """Return the six quadratic functions (6, Q) at barycentric coordinates l (3, Q) of Q points, and two derivatives.

    The derivatives (6, Q) are in the directions from the first vertex to the second and to the third vertex.
    """
    N = [l[k] * (2 * l[k] - 1) for k in range(3)] + [4 * l[a] * l[b] for a, b in _EDGES]
    zero = np.zeros_like(l[0])
    by = [[4 * l[k] - 1 if m == k else zero for m in range(3)] for k in range(3)]
    by += [[4 * l[b] if m == a else 4 * l[a] if m == b else zero for m in range(3)] for a, b in _EDGES]
    slopes = np.array(by)
    return np.stack(N), [slopes[:, m] - slopes[:, 0] for m in (1, 2)]


def _ten_functions(l: np.ndarray) -> tuple[np.ndarray, list[np.ndarray]]:
    """Return ten functions (10, Q) and their derivatives: the functions of `_quadratic`, then the functions of order 3
    on the edges and on the face. The argument and the form of the result are the same as for `_quadratic`."""
    N, slopes = _quadratic(l)
    zero = np.zeros_like(l[0])
    more, by = [], []
    for a, b in _THIRD:
        more.append(l[a] * l[b] * (l[a] - l[b]))
        own = {a: (2 * l[a] - l[b]) * l[b], b: (l[a] - 2 * l[b]) * l[a]}
        by.append([own.get(m, zero) for m in range(3)])
    more.append(27 * l[0] * l[1] * l[2])
    by.append([27 * l[1] * l[2], 27 * l[0] * l[2], 27 * l[0] * l[1]])
    along = np.array(by)
    return np.concatenate([N, more]), [
        np.concatenate([slope, along[:, m] - along[:, 0]]) for slope, m in zip(slopes, (1, 2), strict=True)
    ]
