"""Volume ratios J of elements, and their derivatives with respect to the positions of nodes."""

import jax
import jax.numpy as jnp
import numpy as np

from liverjax.mesh.shape_functions import functions
from liverjax.mesh.tetrahedra import TetMesh
from liverjax.tensors.matrices import Matrix, Vector, cofactor, deformation_gradient, determinant, matvec


def volume_gradients(mesh: TetMesh, F: Matrix) -> list[Vector]:
    """Return dJ/dx_a = cof(F) D_a [1/m] at integration points for the corners a, with shape function gradients D_a."""
    cof = cofactor(F)
    g = [matvec(cof, tuple(mesh.gradients[a])) for a in range(3)]
    return [tuple(-(x + y + z) for x, y, z in zip(*g, strict=True)), *g]


def volume_ratios(mesh: TetMesh, x: jax.Array) -> jax.Array:
    """Return the volume ratios J of every element at positions x (V, 3) [m].

    The shape is (1, E) for linear elements. For elements of higher order it is (Q + 4, E): Q integration points and 4
    vertices. Such an element can be inverted between its integration points although it is not inverted at these
    points. Inversion usually begins at a vertex, so J is also computed at the vertices.
    """
    J = determinant(deformation_gradient(mesh, x))
    if mesh.order == 1:
        return J[None]
    c, D = functions(mesh.order, np.eye(4))[1], mesh.gradients
    values = mesh.oriented(jnp.stack([x[n].T for n in mesh.element_nodes]))  # (n, 3, E)
    corners = []
    for column in (values[:, i] for i in range(3)):
        y = [sum(c[a, k][:, None] * v[None] for a, v in enumerate(column) if c[a, k].any()) for k in range(4)]
        corners.append([y[k] - y[0] for k in (1, 2, 3)])
    F = tuple(tuple(sum(y[a] * D[a, j] for a in range(3)) for j in range(3)) for y in corners)
    return jnp.concatenate([J, determinant(F)])
