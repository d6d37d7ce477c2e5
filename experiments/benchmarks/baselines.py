"""Two solvers to compare with, elastic only: total Lagrangian explicit dynamics, and corotational linear elasticity.

They take a `Scene` with a body and fixed nodes, and share meshes, laws and assembly with `simulate`; nothing else is
supported, nothing is differentiable.
"""

import jax
import jax.numpy as jnp

import liverjax as lj
from liverjax.core.struct import replace
from liverjax.elements import mjed
from liverjax.mesh.adjacency import PAIRS
from liverjax.physics import boundary
from liverjax.physics.base import diagonal
from liverjax.simulation import tangent
from liverjax.simulation.equations import Equations, equations, initial_state
from liverjax.solvers import block_matrix
from liverjax.solvers.krylov import conjugate_gradients
from liverjax.tensors import matrices


def _mass_and_weight(scene: lj.Scene) -> tuple[jax.Array, jax.Array]:
    mass = (scene.body.density * boundary.nodal_volumes(scene.mesh))[:, None]
    return mass, mass * jnp.asarray(scene.body.gravity)[None]


def at_rest(scene: lj.Scene) -> Equations:
    """What acts on elements at rest: no inertia, no loads."""
    plain = replace(scene, body=None, traction=(), solve=replace(scene.solve, kind="static"))
    return equations(plain, initial_state(plain), 1.0)


@jax.jit
def critical_step(scene: lj.Scene) -> jax.Array:
    """2 / omega_max [s] of the rest state by power iteration: above it central differences blow up."""
    mass, _ = _mass_and_weight(scene)
    A = tangent.stiffness(at_rest(scene), None, scene.mesh.points)
    mask = boundary.free_degrees(scene.mesh, scene.fixed, ())

    def stiffness(v):
        return jnp.stack(block_matrix.product(A, v.T), axis=-1)

    def iterate(_, v):
        w = mask * stiffness(mask * v) / mass
        return w / jnp.linalg.norm(w)

    v = jax.lax.fori_loop(0, 200, iterate, mask * jax.random.normal(jax.random.key(0), mask.shape))
    return 2 / jnp.sqrt(jnp.vdot(v, mask * stiffness(v) / mass))


def explicit(scene: lj.Scene, dt: float, steps: int, keep: int) -> jax.Array:
    """Central differences with a lumped mass (Miller et al. 2007): every `keep`-th of the positions (T, V, 3)."""
    mesh = scene.mesh
    mass, weight = _mass_and_weight(scene)
    mask = boundary.free_degrees(mesh, scene.fixed, ())

    def advance(state, _):
        x, v = state
        v = v + dt * mask * (weight - mjed.internal_force(mesh, scene.law, x)) / mass
        return (x + dt * v, v), None

    def block(state, _):
        state, _ = jax.lax.scan(advance, state, length=keep)
        return state, state[0]

    # Velocities live half a step apart from positions.
    v = -0.5 * dt * mask * weight / mass
    return jax.lax.scan(block, (mesh.points, v), length=steps // keep)[1]


def _rotation(F: matrices.Matrix) -> matrices.Matrix:
    """The rotation of a polar decomposition: nine of Higham's iterations R <- (R + R^-T) / 2."""
    for _ in range(9):
        cof = matrices.cofactor(F)
        det = matrices.determinant(F)
        F = tuple(tuple(0.5 * (F[i][j] + cof[i][j] / det) for j in range(3)) for i in range(3))
    return F


def corotational(scene: lj.Scene, dt: float, steps: int) -> jax.Array:
    """Linear elasticity in rotated frames, implicit Euler, one linear solve a step: positions (T, V, 3).

    The element stiffness is that of the law at rest (Mueller and Gross 2004).
    """
    mesh = scene.mesh
    mass, weight = _mass_and_weight(scene)
    mask = boundary.free_degrees(mesh, scene.fixed, ())
    rest = tangent.element_blocks(at_rest(scene), None, matrices.deformation_gradient(mesh, mesh.points))
    own = mjed.element_stiffness(mesh, scene.law, mesh.points)
    full = mjed.all_blocks(own)
    corners = [tuple(mesh.points[mesh.tetrahedra[:, a]].T) for a in range(4)]

    def rotated(R, K):
        return matrices.matmul(matrices.matmul(R, K), matrices.transpose(R))

    def advance(state, _):
        x, v = state
        R = _rotation(matrices.deformation_gradient(mesh, x))
        turned_back = [
            matrices.add(
                matrices.matvec(matrices.transpose(R), tuple(x[mesh.tetrahedra[:, a]].T)),
                matrices.scale(-1.0, corners[a]),
            )
            for a in range(4)
        ]
        force = jnp.zeros_like(x)
        for a in range(4):
            f = (0.0, 0.0, 0.0)
            for b in range(4):
                f = matrices.add(f, matrices.matvec(full[a][b], turned_back[b]))
            force = force.at[mesh.tetrahedra[:, a]].add(jnp.stack(matrices.matvec(R, f), axis=-1))
        A = block_matrix.force_matrix(mesh, {p: rotated(R, rest[p]) for p in PAIRS}, diagonal(mass[:, 0] / dt**2))
        inverse = block_matrix.inverse_blocks(A.diagonal, mask)

        def precondition(r):
            return jnp.concatenate(block_matrix.applied(inverse, block_matrix.columns(r)))

        def matvec(u):
            return mask.T.ravel() * jnp.concatenate(block_matrix.product(A, block_matrix.columns(mask.T.ravel() * u)))

        b = mask * (weight - force + mass * v / dt)
        dx, _ = conjugate_gradients(matvec, block_matrix.flat(b), precondition, 1e-4, 2000)
        dx = jnp.stack(block_matrix.columns(dx), axis=-1)
        return (x + dx, dx / dt), x + dx

    return jax.lax.scan(advance, (mesh.points, jnp.zeros_like(mesh.points)), length=steps)[1]
