"""The tangent of a scene's forces, from hand-derived blocks, and linear solves with it.

What the scene has decides the matrix and the method: conjugate gradients, with the pressure of a fluid eliminated where
there is one; BiCGSTAB where loads follow the body. All with the same preconditioner: the inverse diagonal blocks and,
where slow motions hold them up, a coarse space.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from liverjax import assembly, boundary, direct, mjed, porosity, terms, viscosity
from liverjax.assembly import BlockMatrix
from liverjax.coarse import Coarse, coarse, corrected, worthwhile
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


class Setting(NamedTuple):
    """What is constant during a step."""

    scene: Scene
    memory: Any  # of the viscosity, or None
    flow: Any  # matrix of the fluid's pressure where that depends on x, or None
    inertia: Any  # (V,) [kg/s^2] what inertia adds to the diagonal, or None
    mask: jax.Array  # (V, 3) 1 where free


class Tangent(NamedTuple):
    """A tangent ready to be solved with: assembled at one point, good for some iterations near it."""

    matrix: BlockMatrix
    inverse: assembly.Block  # of its diagonal blocks
    slow: Coarse
    x: jax.Array | None  # (V, 3) where it was made, for loads that follow
    at: Any  # part of them that acts


def tangent(setting: Setting, pressure: Any, x: jax.Array, at: Any, near: tuple[Any, Tangent] | None = None) -> Tangent:
    """The derivative of the forces at positions x (V, 3) [m], of which the part `at` of the follower loads.

    `pressure` (V,) [Pa] is the fluid's, or None; `near` a flag and a tangent whose coarse space will do where the flag
    is set. Everything in the result is without derivative.
    """
    setting, pressure, x, at = jax.lax.stop_gradient((setting, pressure, x, at))
    scene, flow, mask = setting.scene, setting.flow, setting.mask
    if flow is None:
        A = stiffness(scene, setting.memory, pressure, setting.inertia, x)
        diagonal = A.diagonal
    else:
        F = deformation_gradient(scene.mesh, x)
        K = element_blocks(scene, setting.memory, pressure, F)
        A = porosity.coupled(scene.mesh, K, setting.inertia, F, flow)
        diagonal = porosity.undrained_diagonal(A, flow)
    inverse = assembly.inverse_blocks(diagonal, mask)

    def new():
        used = False if scene.solve.linear_solver == "direct" else worthwhile(A, setting.inertia)
        return coarse(scene.mesh, A, mask, used)

    slow = new() if near is None else jax.lax.cond(near[0], lambda: near[1].slow, new)
    following = boundary.follows(scene.traction)
    return Tangent(A, inverse, slow, x if following else None, at if following else None)


def preconditioner(setting: Setting, K: Tangent) -> Callable[[jax.Array], jax.Array]:
    """Inverse diagonal blocks, with the coarse solution added, as a function of flat vectors (3 V,)."""
    free = setting.mask.T

    def fine(columns):
        return assembly.applied(K.inverse, [m * r for m, r in zip(free, columns, strict=True)])

    both = corrected(setting.scene.mesh, K.slow, setting.mask, fine)
    return lambda r: free.ravel() * jnp.concatenate(both(assembly.columns(r)))


def product(setting: Setting, K: Tangent) -> Callable[[jax.Array], jax.Array]:
    """K as a function of flat vectors (3 V,); where pressure depends on motion, that of a nearly solved pressure."""
    A, free, loads = K.matrix, setting.mask.T, setting.scene.traction

    def apply(v):
        motion = [m * c for m, c in zip(free, assembly.columns(v), strict=True)]
        force = assembly.product(A, motion)
        if setting.flow is not None:
            force = porosity.with_flow(setting.scene.mesh, setting.flow, A, force)
        force = jnp.concatenate(force)
        if K.x is not None:
            dx = jnp.stack(motion, axis=-1)
            force = force - assembly.flat(
                jax.jvp(lambda x: K.at * boundary.follower_forces(loads, x), (K.x,), (dx,))[1]
            )
        return free.ravel() * force

    return apply


def solve(
    setting: Setting, K: Tangent, b: jax.Array, tolerance: Any, max_iterations: int
) -> tuple[jax.Array, jax.Array]:
    """Solution of K dq = b and the iterations it took, 0 of a factorisation; flat vectors (3 V,)."""
    if setting.scene.solve.linear_solver == "direct":
        return _factorised(setting, K, b), jnp.zeros((), jnp.int32)
    method = conjugate_gradients if K.x is None else stabilised_biconjugate_gradients
    dq, s = method(product(setting, K), b, preconditioner(setting, K), tolerance, max_iterations)
    return dq, s.iterations


def _factorised(setting: Setting, K: Tangent, b: jax.Array) -> jax.Array:
    """The same by a factorisation, of the coupled matrix where pressure depends on motion."""
    free, load = setting.mask.T, b.reshape(3, -1)
    if setting.flow is not None:
        free = jnp.concatenate([free, setting.flow.mask[None]])
        load = jnp.concatenate([load, jnp.zeros_like(load[:1])])
    return direct.solve(K.matrix, free, load)[:3].ravel()


def exact(setting: Setting) -> bool:
    """Whether `solve` is that of the symmetric derivative of the forces, and not of something near it."""
    whole = setting.flow is None or setting.scene.solve.linear_solver == "direct"
    return whole and not boundary.follows(setting.scene.traction)
