"""The tangent of a scene's forces, from hand-derived blocks, and linear solves with it.

What the scene has decides the matrix and the method: conjugate gradients, with the pressure of a fluid eliminated where
there is one; BiCGSTAB where loads follow the body. All with the same preconditioner: the inverse diagonal blocks and,
where slow motions hold them up, a coarse space.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from liverjax.elements import mjed, projection
from liverjax.laws.terms import invariant_terms
from liverjax.mesh.adjacency import PAIRS
from liverjax.physics import boundary, nodal_volume, porosity, viscosity
from liverjax.scenes.scene import Scene, element_law
from liverjax.solvers import block_matrix, direct
from liverjax.solvers.block_matrix import BlockMatrix
from liverjax.solvers.krylov import conjugate_gradients, refined, stabilised_biconjugate_gradients, true_residual
from liverjax.solvers.preconditioner import Coarse, coarse, corrected, worthwhile
from liverjax.tensors.matrices import (
    Matrix,
    Vector,
    add_matrices,
    deformation_gradient,
    determinant,
    scale_matrix,
    stored,
)

_OWN = tuple((a, b) for a in range(3) for b in range(a, 3))


#: How the stiffness of elements is made: true, without negative eigenvalues, or as in the chapter's section 4.1.2 iii.
KINDS = ("true", "projected", "regularised")


def element_blocks(
    scene: Scene, memory: Any, pressure: Any, F: Matrix, kind: str = "true"
) -> dict[tuple[int, int], Matrix]:
    """K_ab [N/m] of `PAIRS` of every element: law, memory of the step and sponge at a given pressure."""
    mesh = scene.mesh
    law, F = element_law(scene), stored(F)
    D = [tuple(mesh.shape_vectors[a]) for a in range(3)]
    if kind != "true":
        K = _definite(scene, memory, pressure, law, F, D, kind)
    elif memory is None or scene.viscosity is None:
        K = invariant_terms.blocks(invariant_terms.state(law, F), D, _OWN)
    else:
        K = viscosity.blocks(scene.viscosity, memory, law, F, D, _OWN)
    volume = _volume(scene, pressure, F)
    if volume is not None and kind == "true":
        more = invariant_terms.blocks(invariant_terms.state(volume, F), D, _OWN)
        K = [add_matrices(a, b) for a, b in zip(K, more, strict=True)]
    own = {(a + 1, b + 1): scale_matrix(mesh.volumes, block) for (a, b), block in zip(_OWN, K, strict=True)}
    full = mjed.all_blocks(own)
    return {(a, b): full[a][b] for a, b in PAIRS}


def _volume(scene: Scene, pressure: Any, F: Matrix) -> porosity.Volume | None:
    """What acts on an element's volume at given nodal pressures, as a law."""
    if scene.porosity is not None:
        return porosity.sponge(scene.porosity, scene.mesh, pressure, F)
    if scene.solve.volumetric == "nodal":
        p = porosity.element_pressure(scene.mesh, pressure)
        return porosity.Volume(p, jnp.zeros_like(p))
    return None


def _definite(
    scene: Scene, memory: Any, pressure: Any, law: Any, F: Matrix, D: list[Vector], kind: str
) -> list[Matrix]:
    """Blocks that stand for the true ones where those have negative eigenvalues."""
    parts, S = [(1.0, law)], None
    if memory is not None and scene.viscosity is not None:
        parts, S = viscosity.summands(scene.viscosity, memory, law)
    volume = _volume(scene, pressure, F)
    if volume is not None:
        parts.append((1.0, volume))
    if kind == "projected":
        return projection.blocks(parts, S, F, D, _OWN)
    return projection.regularised(parts, S, F, D, _OWN)


def stiffness(scene: Scene, memory: Any, pressure: Any, inertia: Any, x: jax.Array, kind: str = "true") -> BlockMatrix:
    """Derivative of internal and inertial forces at positions x (V, 3) and a given pressure."""
    K = element_blocks(scene, memory, pressure, deformation_gradient(scene.mesh, x), kind)
    return block_matrix.force_matrix(scene.mesh, K, inertia)


class Setting(NamedTuple):
    """What is constant during a step."""

    scene: Scene
    memory: Any  # of the viscosity, or None
    flow: Any  # matrix of the fluid's pressure where that depends on x, or None
    inertia: Any  # (V,) [kg/s^2] what inertia adds to the diagonal, or None
    mask: jax.Array  # (V, 3) 1 where free


def _coupled(setting: Setting) -> bool:
    """Whether the unknowns of the matrix are motion and pressure."""
    return setting.flow is not None or setting.scene.solve.volumetric == "nodal"


class Tangent(NamedTuple):
    """A tangent ready to be solved with: assembled at one point, good for some iterations near it."""

    matrix: BlockMatrix
    inverse: block_matrix.Block  # of its diagonal blocks
    slow: Coarse
    x: jax.Array | None  # (V, 3) where it was made, for loads that follow
    at: Any  # part of them that acts


def tangent(
    setting: Setting,
    pressure: Any,
    x: jax.Array,
    at: Any,
    near: tuple[Any, Tangent] | None = None,
    kind: str = "true",
) -> Tangent:
    """The derivative of the forces at positions x (V, 3) [m], of which the part `at` of the follower loads.

    `pressure` (V,) [Pa] is the fluid's, or None; `near` a flag and a tangent whose coarse space will do where the flag
    is set; `kind` is one of `KINDS`. Everything in the result is without derivative.
    """
    setting, pressure, x, at = jax.lax.stop_gradient((setting, pressure, x, at))
    scene, flow, mask = setting.scene, setting.flow, setting.mask
    if not _coupled(setting):
        A = stiffness(scene, setting.memory, pressure, setting.inertia, x, kind)
        diagonal = A.diagonal
    else:
        F = deformation_gradient(scene.mesh, x)
        K = element_blocks(scene, setting.memory, pressure, F, kind)
        if flow is None:
            pressures = nodal_volume.compliance(scene.mesh, scene.law, determinant(F), positive=kind != "true")
        else:
            pressures = flow.matrix
        A = porosity.coupled(scene.mesh, K, setting.inertia, F, pressures)
        diagonal = porosity.undrained_diagonal(A, 1.0 if flow is None else flow.mask)
    inverse = block_matrix.inverse_blocks(diagonal, mask)

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
        return block_matrix.applied(K.inverse, [m * r for m, r in zip(free, columns, strict=True)])

    both = corrected(setting.scene.mesh, K.slow, setting.mask, fine)
    return lambda r: free.ravel() * jnp.concatenate(both(block_matrix.columns(r)))


def product(setting: Setting, K: Tangent, exactly: bool = False) -> Callable[[jax.Array], jax.Array]:
    """K as a function of flat vectors (3 V,); pressure that depends on motion is nearly solved for, or `exactly`."""
    A, free, loads = K.matrix, setting.mask.T, setting.scene.traction

    def apply(v):
        motion = [m * c for m, c in zip(free, block_matrix.columns(v), strict=True)]
        force = block_matrix.product(A, motion)
        if _coupled(setting):
            force = porosity.with_flow(setting.scene.mesh, setting.flow, A, force, exactly)
        force = jnp.concatenate(force)
        if K.x is not None:
            dx = jnp.stack(motion, axis=-1)
            force = force - block_matrix.flat(
                jax.jvp(lambda x: K.at * boundary.follower_forces(loads, x), (K.x,), (dx,))[1]
            )
        return free.ravel() * force

    return apply


def solve(
    setting: Setting, K: Tangent, b: jax.Array, tolerance: Any, max_iterations: int
) -> tuple[jax.Array, jax.Array, jax.Array]:
    """Solution of K dq = b, the iterations it took (0 of a factorisation), and whether K was seen to be positive."""
    if setting.scene.solve.linear_solver == "direct":
        dq = _factorised(setting, K, b)
        return dq, jnp.zeros((), jnp.int32), jnp.vdot(dq, b) >= 0
    method = conjugate_gradients if K.x is None else stabilised_biconjugate_gradients
    dq, s = method(product(setting, K), b, preconditioner(setting, K), tolerance, max_iterations)
    return dq, s.iterations, s.positive


def _factorised(setting: Setting, K: Tangent, b: jax.Array) -> jax.Array:
    """The same by a factorisation, of the coupled matrix where pressure depends on motion."""
    free, load = setting.mask.T, b.reshape(3, -1)
    if _coupled(setting):
        known = jnp.ones_like(free[:1]) if setting.flow is None else setting.flow.mask[None]
        free = jnp.concatenate([free, known])
        load = jnp.concatenate([load, jnp.zeros_like(load[:1])])
    return direct.solve(K.matrix, free, load)[:3].ravel()


def adjoint(
    setting: Setting, K: Tangent, b: jax.Array, tolerance: Any, max_iterations: int
) -> tuple[jax.Array, jax.Array]:
    """Solution of K x = b with pressures solved for, for derivatives, and its residual over |b|; no load follows."""
    if setting.scene.solve.linear_solver == "direct":
        x = _factorised(setting, K, b)
        return x, true_residual(product(setting, K, exactly=True), b, x)
    if setting.flow is None:
        x, s = conjugate_gradients(product(setting, K), b, preconditioner(setting, K), tolerance, max_iterations)
        return x, s.residual

    def nearly(r, tolerance):
        return solve(setting, K, r, tolerance, max_iterations)[0]

    return refined(nearly, tolerance, product(setting, K, exactly=True), b)
