"""Three solvers for comparison: total Lagrangian explicit dynamics, corotational and linear elasticity.

They need a `Scene` with a body and fixed nodes, and share meshes, laws and assembly with `simulate`. The explicit
solver also supports a Prony series. No other feature is supported, and the results are not differentiable.
"""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

import liverjax as lj
from liverjax.core.struct import replace
from liverjax.elements import mjed
from liverjax.mesh.adjacency import PAIRS
from liverjax.physics import boundary, viscosity
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
    """Return the equations of the elements at rest, without inertia and loads."""
    plain = replace(scene, body=None, traction=(), solve=replace(scene.solve, kind="static"))
    return equations(plain, initial_state(plain), 1.0)


@jax.jit
def critical_step(scene: lj.Scene) -> jax.Array:
    """Return the critical time step 2 / omega_max [s] of the rest state, by power iteration.

    Central differences with a larger step are unstable.
    """
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
    """Central differences with a lumped mass (Miller et al. 2007), and with a Prony series if the scene has one (Taylor
    et al. 2009). Returns every `keep`-th of the positions (T, V, 3).
    """
    mesh, law, prony = scene.mesh, scene.law, scene.viscosity
    mass, weight = _mass_and_weight(scene)
    mask = boundary.free_degrees(mesh, scene.fixed, ())

    def force(x, memory):
        """Return the nodal forces of the elements, and the viscous memory after the step."""
        if prony is None:
            return mjed.internal_force(mesh, law, x), None
        F = matrices.deformation_gradient(mesh, x)
        P = viscosity.first_piola(prony, viscosity.recall(prony, memory, dt), law, F)
        return mjed.nodal_force(mesh, P), viscosity.advance(prony, memory, law, F, dt)

    def advance(state, _):
        x, v, memory = state
        f, memory = force(x, memory)
        v = v + dt * mask * (weight - f) / mass
        return (x + dt * v, v, memory), None

    def block(state, _):
        state, _ = jax.lax.scan(advance, state, length=keep)
        return state, state[0]

    # The velocities belong to the middles of the time steps, the positions to the ends.
    v = -0.5 * dt * mask * weight / mass
    memory = None if prony is None else viscosity.initial_history(prony, mesh.weights.shape)
    return jax.lax.scan(block, (mesh.points, v, memory), length=steps // keep)[1]


def _rotation(F: matrices.Matrix) -> matrices.Matrix:
    """Return the rotation of the polar decomposition, by nine of Higham's iterations R <- (R + R^-T) / 2."""
    for _ in range(9):
        cof = matrices.cofactor(F)
        det = matrices.determinant(F)
        F = tuple(tuple(0.5 * (F[i][j] + cof[i][j] / det) for j in range(3)) for i in range(3))
    return F


class Inertia(NamedTuple):
    """Implicit Euler or Newmark's average acceleration, chosen by the scene's `integrator`.

    The inertia force in a step is m a = m (now u - push), with the displacement u in the step.
    """

    newmark: bool
    dt: float  # [s]

    @property
    def now(self) -> float:
        """Derivative of the acceleration at the end of the step with respect to the displacement in the step
        [1/s^2].
        """
        return (4 if self.newmark else 1) / self.dt**2

    def push(self, v, a):
        """Return the part of the acceleration that comes from the motion before the step, with opposite sign
        [m/s^2].
        """
        return 4 * v / self.dt + a if self.newmark else v / self.dt

    def moved(self, u, v, a):
        """Return velocity and acceleration at the end of a step with displacement u."""
        if self.newmark:
            return 2 * u / self.dt - v, 4 / self.dt**2 * (u - self.dt * v) - a
        return u / self.dt, a


def _inertia(scene: lj.Scene, dt: float) -> Inertia:
    return Inertia(scene.solve.integrator == "newmark", dt)


def corotational(scene: lj.Scene, dt: float, steps: int) -> jax.Array:
    """Linear elasticity in frames that rotate with the elements, with one linear solve per step. Returns positions (T,
    V, 3).

    The element stiffness is the stiffness of the law at rest (Mueller and Gross 2004).
    """
    mesh, inertia = scene.mesh, _inertia(scene, dt)
    mass, weight = _mass_and_weight(scene)
    mask = boundary.free_degrees(mesh, scene.fixed, ())
    rest = tangent.element_blocks(at_rest(scene), None, matrices.deformation_gradient(mesh, mesh.points))
    own = mjed.element_stiffness(mesh, scene.law, mesh.points)
    full = mjed.all_blocks(own)
    corners = [tuple(mesh.points[mesh.tetrahedra[:, a]].T) for a in range(4)]

    def rotated(R, K):
        return matrices.matmul(matrices.matmul(R, K), matrices.transpose(R))

    def advance(state, _):
        x, v, a = state
        R = _rotation(matrices.deformation_gradient(mesh, x))
        turned_back = [
            matrices.add(
                matrices.matvec(matrices.transpose(R), tuple(x[mesh.tetrahedra[:, i]].T)),
                matrices.scale(-1.0, corners[i]),
            )
            for i in range(4)
        ]
        force = jnp.zeros_like(x)
        for i in range(4):
            f = (0.0, 0.0, 0.0)
            for j in range(4):
                f = matrices.add(f, matrices.matvec(full[i][j], turned_back[j]))
            force = force.at[mesh.tetrahedra[:, i]].add(jnp.stack(matrices.matvec(R, f), axis=-1))
        A = block_matrix.force_matrix(mesh, {p: rotated(R, rest[p]) for p in PAIRS}, diagonal(inertia.now * mass[:, 0]))
        inverse = block_matrix.inverse_blocks(A.diagonal, mask)

        def precondition(r):
            return jnp.concatenate(block_matrix.applied(inverse, block_matrix.columns(r)))

        def matvec(u):
            return mask.T.ravel() * jnp.concatenate(block_matrix.product(A, block_matrix.columns(mask.T.ravel() * u)))

        b = mask * (weight - force + mass * inertia.push(v, a))
        dx, _ = conjugate_gradients(matvec, block_matrix.flat(b), precondition, 1e-4, 2000)
        dx = jnp.stack(block_matrix.columns(dx), axis=-1)
        return (x + dx, *inertia.moved(dx, v, a)), x + dx

    begin = (mesh.points, jnp.zeros_like(mesh.points), mask * weight / mass)
    return jax.lax.scan(advance, begin, length=steps)[1]


def precomputed(scene: lj.Scene, dt: float) -> Any:
    """Prepare the matrices for `linear`.

    Returns the inverse (n, n) [m/N] of the system matrix of one time step of the linear body, the indices of its n free
    degrees of freedom, and their masses and weights.
    """
    mesh = scene.mesh
    held = np.concatenate([np.asarray(f.nodes) for f in scene.fixed])
    free = (3 * np.setdiff1d(np.arange(mesh.number_of_nodes), held)[:, None] + np.arange(3)).ravel()
    K = mjed.stiffness_matrix(mesh, scene.law, mesh.points)[free][:, free].toarray()
    mass, weight = _mass_and_weight(scene)
    m, w = np.repeat(np.asarray(mass)[:, 0], 3)[free], np.asarray(weight).ravel()[free]
    inverse = np.linalg.inv(K + np.diag(_inertia(scene, dt).now * m))
    return tuple(jnp.asarray(each) for each in (inverse, free, m, w))


def linear(scene: lj.Scene, made: Any, dt: float, steps: int) -> jax.Array:
    """Linear elasticity with one product with a precomputed inverse per step (James and Pai 1999).

    Args:
        scene: body, mesh and fixed nodes.
        made: `precomputed(scene, dt)`.
        dt: time step [s].
        steps: number of steps T.

    Returns:
        positions (T, V, 3) [m].
    """
    inverse, free, m, w = made
    mesh, inertia = scene.mesh, _inertia(scene, dt)

    def advance(state, _):
        u, v, a = state
        new = inverse @ (w + m * (inertia.now * u + inertia.push(v, a)))
        return (new, *inertia.moved(new - u, v, a)), new

    begin = (jnp.zeros_like(m), jnp.zeros_like(m), w / m)
    u = jax.lax.scan(advance, begin, length=steps)[1]
    return mesh.points[None] + jnp.zeros((steps, mesh.points.size)).at[:, free].set(u).reshape(steps, -1, 3)
