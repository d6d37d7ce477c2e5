"""Error of a reduced run with a porous body: the response of the linearised body to the out-of-balance forces.

To first order, the error e of the motion and the error p of the pressure are the solution of linear equations at the
reference shape,

    (K + K_p) e - B^T p = load,    A p + B (e - e_before) = S p_before,

with the matrix K of stiffness and inertia of the solid, and the volumetric stiffness K_p of the drained body. `load` is
the sum of the negative out-of-balance forces and the forces from earlier steps. B e is the change of volume at the
vertices. A and S are the matrices of `liverjax.reduced.physics.fluid`, here on the full mesh. The index `before` means
the end of the previous step. In the lagged scheme, B (e - e_before) is replaced by its value in the previous step.
"""

from collections.abc import Callable
from typing import TYPE_CHECKING, NamedTuple

import jax.numpy as jnp
import numpy as np

from liverjax.core.struct import Number
from liverjax.mesh.shape_functions import basis
from liverjax.mesh.tetrahedra import TetMesh
from liverjax.physics.darcy import unknown_pressures
from liverjax.physics.porosity import volumetric_slope
from liverjax.scenes.scene import Scene

if TYPE_CHECKING:
    import scipy.sparse


class LinearFluid(NamedTuple):
    """Sparse matrices of the linearised porous body. f: number of free degrees of freedom; v: number of unknown
    pressures."""

    stiffness: "scipy.sparse.csr_array"  # K_p, volumetric stiffness of the drained body (f, f) [N/m]
    volumes: "scipy.sparse.csr_array"  # B, change of the volume at the vertices (v, f) [m^2]
    storage: "scipy.sparse.csr_array"  # S, diagonal (v, v) [m^3/Pa]
    flow: "scipy.sparse.csr_array"  # dt D (v, v) [m^3/Pa]
    unknown: np.ndarray  # numbers of the vertices with an unknown pressure (v,)
    lagged: bool


class ErrorBefore(NamedTuple):
    """Errors of motion and pressure at the ends of earlier steps (f free degrees of freedom, v unknown pressures)."""

    motion: np.ndarray  # error of motion at the end of the last step (f,) [m]
    motion_before: np.ndarray  # error of motion one step earlier (f,) [m]
    pressure: np.ndarray  # error of pressure at the end of the last step (v,) [Pa]


def linear_fluid(scene: Scene, free: np.ndarray) -> LinearFluid:
    """Return the matrices of the poroelastic equations, linearised at the reference shape. Each parameter of the scene
    must be one number, or have one value for each element. `free`: numbers of the free degrees of freedom."""
    import scipy.sparse

    mesh, porosity, dt = scene.mesh, scene.porosity, scene.solve.dt
    assert porosity is not None
    values, slopes, vertex_slopes = _point_operators(mesh)

    def at_points(number: Number) -> "scipy.sparse.dia_array":
        return scipy.sparse.diags(np.broadcast_to(np.asarray(number) * np.asarray(mesh.weights), shape).ravel())

    shape = mesh.weights.shape
    J = scipy.sparse.hstack([slopes[i] for i in range(3)]).tocsc()
    # Until here, the columns are ordered by component: first all x, then all y, then all z. Now component c of node k
    # gets the column 3 k + c.
    J = J[:, np.arange(3 * mesh.number_of_nodes).reshape(3, -1).T.ravel()][:, free]
    unknown = np.flatnonzero(np.asarray(unknown_pressures(porosity, mesh, mesh.points.dtype)))
    values, vertex_slopes = values[:, unknown], [g[:, unknown] for g in vertex_slopes]
    store = values.T @ at_points(1 / np.asarray(porosity.limit_bulk)) @ np.ones(values.shape[0])
    rate = at_points(np.asarray(dt) * np.asarray(porosity.permeability))
    return LinearFluid(
        stiffness=J.T @ at_points(volumetric_slope(porosity, jnp.ones(()))) @ J,
        volumes=values.T @ at_points(1.0) @ J,
        storage=scipy.sparse.diags(store),
        flow=sum(g.T @ rate @ g for g in vertex_slopes),
        unknown=unknown,
        lagged=porosity.scheme == "lagged",
    )


def _point_operators(mesh: TetMesh) -> "tuple[scipy.sparse.csr_array, list, list]":
    """Return sparse matrices for the integration points: one for the values of a vertex field, three for the
    derivatives of a nodal field, and three for the derivatives of a vertex field."""
    import scipy.sparse

    E, D = mesh.number_of_elements, np.asarray(mesh.shape_vectors)
    D = np.concatenate([-D.sum(axis=0, keepdims=True), D])
    L, c = (np.full((4, 1), 0.25), np.eye(4)[:, :, None]) if mesh.order == 1 else (basis(2).L, basis(2).c)
    Q = L.shape[1]
    rows = np.arange(Q * E).reshape(Q, E)

    def matrix(entries: np.ndarray, count: int) -> "scipy.sparse.csr_array":
        """Assemble a sparse matrix with one row per integration point and `count` columns. `entries` (n, Q, E): n nodes
        and Q integration points in each of E elements."""
        nodes = np.broadcast_to(mesh.element_nodes_on_host[: len(entries), None], entries.shape)
        at = (np.broadcast_to(rows, entries.shape).ravel(), nodes.ravel())
        return scipy.sparse.csr_matrix((entries.ravel(), at), shape=(Q * E, count))

    values = matrix(np.broadcast_to(L[:, :, None], (4, Q, E)), mesh.number_of_vertices)
    slopes = [matrix(np.einsum("akq,ke->aqe", c, D[:, i]), mesh.number_of_nodes) for i in range(3)]
    corners = np.broadcast_to(D[:, :, None], (4, 3, Q, E))
    return values, slopes, [matrix(corners[:, i], mesh.number_of_vertices) for i in range(3)]


def coupled_solver(
    K: "scipy.sparse.csr_array", fluid: LinearFluid
) -> Callable[[np.ndarray, ErrorBefore], tuple[np.ndarray, np.ndarray]]:
    """Return a function for one step: (load (f,) [N], `ErrorBefore`) -> errors of motion (f,) [m] and pressure (v,)
    [Pa] at the end of the step. The body has f free degrees of freedom and v unknown pressures.

    Args:
        K: matrix of stiffness and inertia of the solid (f, f) [N/m], without the porous part.
        fluid: matrices of the porous part.
    """
    import scipy.sparse
    from scipy.sparse.linalg import splu

    K, A, B, f = K + fluid.stiffness, fluid.storage + fluid.flow, fluid.volumes, K.shape[0]
    if fluid.lagged:
        motion, pressure = splu(K.tocsc()).solve, splu(A.tocsc()).solve

        def lagged(load: np.ndarray, last: ErrorBefore) -> tuple[np.ndarray, np.ndarray]:
            p = pressure(fluid.storage @ last.pressure - B @ (last.motion - last.motion_before))
            return motion(load + B.T @ p), p

        return lagged
    both = splu(scipy.sparse.block_array([[K, -B.T], [-B, -A]]).tocsc()).solve

    def implicit(load: np.ndarray, last: ErrorBefore) -> tuple[np.ndarray, np.ndarray]:
        found = both(np.concatenate([load, -(fluid.storage @ last.pressure + B @ last.motion)]))
        return found[:f], found[f:]

    return implicit
