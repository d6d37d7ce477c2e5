"""The tangent of a scene's forces, from hand-derived blocks, and Newton's direction by it.

What the scene has decides the matrix and the method: conjugate gradients, with the pressure of a fluid eliminated where
there is one; BiCGSTAB where loads follow the body. All with the inverse diagonal blocks as preconditioner.
"""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp

from liverjax import assembly, boundary, mjed, porosity, terms, viscosity
from liverjax.assembly import BlockMatrix
from liverjax.kinematics import Matrix, add_matrices, deformation_gradient, scale_matrix
from liverjax.linear import conjugate_gradients, stabilised_biconjugate_gradients
from liverjax.pattern import PAIRS
from liverjax.scene import Scene

_OWN = tuple((a, b) for a in range(3) for b in range(a, 3))


def element_blocks(scene: Scene, memory: Any, pressure: Any, F: Matrix) -> dict[tuple[int, int], Matrix]:
    """K_ab [N/m] of `PAIRS` of every element: law, memory of the step and sponge at a given pressure."""
    mesh = scene.mesh
    law = porosity.law_in_force(scene.porosity, scene.law)
    D = [tuple(mesh.shape_vectors[a]) for a in range(3)]
    if memory is None:
        K = terms.blocks(terms.state(law, F), D, _OWN)
    else:
        K = viscosity.blocks(scene.viscosity, memory, law, F, D, _OWN)
    if scene.porosity is not None:
        more = porosity.blocks(scene.porosity, mesh, pressure, F, D, _OWN)
        K = [add_matrices(a, b) for a, b in zip(K, more, strict=True)]
    own = {(a + 1, b + 1): scale_matrix(mesh.volumes, block) for (a, b), block in zip(_OWN, K, strict=True)}
    full = mjed.all_blocks(own)
    return {(a, b): full[a][b] for a, b in PAIRS}


def stiffness(scene: Scene, memory: Any, pressure: Any, inertia: Any, x: jax.Array) -> BlockMatrix:
    """Derivative of internal and inertial forces at positions x (V, 3) and a given pressure."""
    K = element_blocks(scene, memory, pressure, deformation_gradient(scene.mesh, x))
    return assembly.force_matrix(scene.mesh, K, inertia)


def block_jacobi(A: BlockMatrix, mask: jax.Array) -> Callable[[jax.Array], jax.Array]:
    """Inverse diagonal blocks as a function of flat vectors (3 V,)."""
    inverse = assembly.inverse_blocks(A.diagonal, mask)
    return lambda r: _apply(inverse, mask * r.reshape(-1, 3), mask).ravel()


def _apply(inverse: Any, r: jax.Array, mask: jax.Array) -> jax.Array:
    return mask * jnp.stack([sum(inverse[i][j] * r[:, j] for j in range(3)) for i in range(3)], axis=-1)


def direction(
    scene: Scene, memory: Any, flow: Any, pressure: Any, inertia: Any, mask: jax.Array, x: jax.Array, at: Any
) -> Callable[[jax.Array, Any, int], tuple[jax.Array, jax.Array]]:
    """Function (b, tolerance, max_iterations) -> (solution of K dq = b, iterations), flat vectors (3 V,).

    Args:
        scene: the scene.
        memory, flow, pressure: of the step, where the scene has them; `flow` only where P depends on x.
        inertia: (V,) diagonal of the inertial forces, or None.
        mask: (V, 3) 1 where free.
        x: (V, 3) positions [m].
        at: part of the follower loads that acts.
    """
    loads = scene.traction if boundary.follows(scene.traction) else None

    def follower(dx):
        return jax.jvp(lambda x: at * boundary.follower_forces(loads, x), (x,), (dx,))[1]

    if flow is None:
        A = stiffness(scene, memory, pressure, inertia, x)

        def matvec(v):
            dx = mask * v.reshape(-1, 3)
            force = assembly.product(A, dx)
            return (mask * (force if loads is None else force - follower(dx))).ravel()

        method = conjugate_gradients if loads is None else stabilised_biconjugate_gradients
        precondition = block_jacobi(A, mask)

        def solve(b, tolerance, max_iterations):
            dq, s = method(matvec, b, precondition, tolerance, max_iterations)
            return dq, s.iterations

        return solve
    return _coupled_direction(scene, memory, flow, pressure, inertia, mask, x, None if loads is None else follower)


def _coupled_direction(scene, memory, flow, pressure, inertia, mask, x, follower):
    """The fluid's pressure eliminated by a polynomial near the inverse of its matrix: a fixed, symmetric operator."""
    F = deformation_gradient(scene.mesh, x)
    A = porosity.coupled(scene.mesh, element_blocks(scene, memory, pressure, F), inertia, F, flow)
    precondition = _undrained_jacobi(A, flow, mask)

    def matvec(v):
        dx = mask * v.reshape(-1, 3)
        both = assembly.product(A, dx)
        dP = porosity.nearly_solved(flow, both[:, 3])
        near = dP[A.nodes]
        pull = [jnp.sum(A.rows[r][3] * near, axis=0) + A.diagonal[r][3] * dP for r in range(3)]
        force = both[:, :3] + jnp.stack(pull, axis=-1)
        return (mask * (force if follower is None else force - follower(dx))).ravel()

    method = conjugate_gradients if follower is None else stabilised_biconjugate_gradients

    def solve(b, tolerance, max_iterations):
        dq, s = method(matvec, b, precondition, tolerance, max_iterations)
        return dq, s.iterations

    return solve


def _undrained_jacobi(A: BlockMatrix, flow: Any, mask: jax.Array) -> Callable[[jax.Array], jax.Array]:
    """Diagonal blocks of K + G^T D^-1 G, with D the diagonal of the pressure's matrix: right where nothing flows."""
    soft = flow.mask / flow.matrix.diagonal[0][0]
    near = soft[A.nodes]
    blocks = [list(A.diagonal[r][:3]) for r in range(3)]
    for r in range(3):
        for c in range(3):
            pull = jnp.sum(A.rows[r][3] * near * A.rows[c][3], axis=0)
            blocks[r][c] = blocks[r][c] + pull + A.diagonal[r][3] * soft * A.diagonal[c][3]
    inverse = assembly.inverse_blocks(blocks, mask)
    return lambda r: _apply(inverse, r.reshape(-1, 3), mask).ravel()
