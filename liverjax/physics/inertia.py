"""Inertia of lumped or consistent masses, with implicit Euler or Newmark's method (average acceleration).

Newmark's method uses the mean of the forces at the beginning and at the end of a step. The forces of an obstacle with a
given position are an exception: only their value at the end of the step is used (Kane et al. 1999, Comput. Methods
Appl. Mech. Eng. 180, 1). Then an obstacle at rest never adds energy to the body. With the mean of the forces, the
obstacle would add energy if contact begins or ends within a step. The stored acceleration (`Motion`) does not contain
the part due to these obstacle forces.
"""

from typing import Any, ClassVar, NamedTuple

import jax
import jax.numpy as jnp

from liverjax.core.struct import Number, param, static, struct
from liverjax.mesh.nodal import element_density, mass_parts, nodal_volumes
from liverjax.mesh.tetrahedra import TetMesh
from liverjax.physics.base import End, Free, NodalForce, Physics, Start, Step, diagonal
from liverjax.solvers import attached
from liverjax.solvers.attached import Masses, masses
from liverjax.solvers.block_matrix import Block
from liverjax.tensors.places import given

#: Factor k for each method. The acceleration at the end of a step is k x/dt^2 plus known terms, with the positions x at
#: the end of the step and the time step dt.
FACTOR = {"euler": 1.0, "newmark": 4.0}
#: Relative tolerance of the linear solves for the accelerations.
_EXACT = 1e-12


class Motion(NamedTuple):
    """Internal variables of inertia: velocity and acceleration at the end of a step."""

    velocity: jax.Array  # (V, 3) [m/s]
    acceleration: jax.Array | None  # (V, 3) [m/s^2]; only for Newmark's method


@struct
class Inertia(Physics):
    """Mass of the body: lumped at its nodes, or consistent (integrals of products of the shape functions)."""

    density: Any = param("kg/m^3", "mass per reference volume, one number or one per node (V,)", above=0.0)
    integrator: str = static(default="euler", about="euler (first order) or newmark (second order)")
    mass: str = static(default="lumped", about="lumped (at the nodes) or consistent")

    def begin(self, start: Start) -> Motion:
        """Return velocity and acceleration of a body that is at rest at the beginning.

        For Newmark's method, the initial acceleration a is the solution of m a = f, with masses m and forces f. So the
        first step also has second-order accuracy.
        """
        acceleration = None
        if self.integrator == "newmark":
            (mass, shared), force = self.masses_on(start.mesh), start.force()
            if start.given is not None and shared is not None:
                force = force + inertia_forces(mass, shared, start.given)
            acceleration = _accelerations(mass, shared, start.free, -start.free.vectors(force))
        return Motion(jnp.zeros_like(start.x), acceleration)

    @classmethod
    def acts_without_memory(cls) -> bool:
        """Return True: if `memory` is None, the body is at rest, so its inertia force is 0."""
        return True

    def freeze(self, memory: Motion | None, step: Step) -> "Moving":
        """Return the force term of a step. It stores the masses and the motion at the beginning of the step."""
        if memory is None:
            still = jnp.zeros_like(step.x)
            memory = Motion(still, still if self.integrator == "newmark" else None)
        mass, shared = self.masses_on(step.mesh)
        mask, axes = step.free.mask, None
        for nodes in step.free.tied:
            mask, axes = nodes.not_given(mask, axes)
        own = {"x": step.x, "motion": memory, "dt": step.dt, "mask": mask, "integrator": self.integrator}
        own |= {"free": step.free if step.averaged else None, "given": step.given}
        return Moving(mass=mass, shared=shared, axes=axes, **own)

    def masses_on(self, mesh: TetMesh) -> tuple[jax.Array, Masses | None]:
        """Return the diagonal masses (V,) [kg] of the nodes, and the remaining part of the consistent mass matrix.

        The remaining part is the consistent mass matrix minus the diagonal masses. It is None if the mass is lumped. If
        the density is given per node, the consistent mass matrix of an element uses one density (`element_density`).
        """
        if self.mass == "lumped":
            return self.density * nodal_volumes(mesh), None
        density, (parts, matrix) = jnp.asarray(self.density), mass_parts(mesh.order)
        size = mesh.volumes * (density if density.ndim == 0 else element_density(mesh, density))
        shares = jnp.asarray(parts, size.dtype)[:, None] * size[None]
        mass = given(jnp.zeros(mesh.number_of_nodes, size.dtype), jnp.stack(mesh.element_nodes), shares)
        return mass, masses(mesh, matrix, size)

    def advance(self, memory: Motion, acting: "Moving", end: End) -> Motion:
        """Return velocity and acceleration at the end of the step."""
        velocity, acceleration = acting.kinematics(end.x)
        if end.by_end_forces is not None:
            acceleration = acceleration + end.by_end_forces
        for nodes in () if acting.free is None else acting.free.tied:
            velocity, acceleration = nodes.rigid(end.x, velocity, acceleration)
        return Motion(velocity, None if memory.acceleration is None else acceleration)


def _accelerations(mass: jax.Array, shared: Masses | None, free: Free, force: jax.Array) -> jax.Array:
    """Solve m a = f in the free directions, with masses m and forces f (V, 3) [N].

    Returns the accelerations a (V, 3) [m/s^2]. They are 0 in directions that are not free.
    """
    if shared is None and not free.tied:
        return force / mass[:, None]

    # In reverse-mode differentiation, the right-hand side may have components in fixed directions. So the matrix must
    # be invertible in these directions too.
    mean = jnp.mean(mass)

    def product(a: jax.Array) -> jax.Array:
        own = free.vectors(a)
        return free.vectors(inertia_forces(mass, shared, own)) + mean * (a - own)

    def nearly_solved(r: jax.Array) -> jax.Array:
        own = free.vectors(r)
        return free.vectors(own / mass[:, None]) + (r - own) / mean

    found = jax.scipy.sparse.linalg.cg(product, force, tol=_EXACT, M=nearly_solved)[0]
    return free.vectors(found)


def inertia_forces(mass: jax.Array, shared: Masses | None, a: jax.Array) -> jax.Array:
    """Return the inertia forces (V, 3) [N]: mass times accelerations a (V, 3) [m/s^2]."""
    force = mass[:, None] * a
    return force if shared is None else force + jnp.stack(attached.product(shared, tuple(a.T)), axis=1)


@struct
class Moving(NodalForce):
    """Force term of inertia, for one step."""

    mass: jax.Array = param("kg", "(V,)")
    x: jax.Array = param("m", "positions at the beginning of the step (V, 3)")
    motion: Motion = param("1", "velocity and acceleration at the beginning of the step")
    dt: jax.Array = param("s", "time step")
    mask: jax.Array = param("1", "(V, 3) 1 where the motion is unknown, 0 where it is given")
    integrator: str = static(default="euler")
    shared: Masses | None = param("kg", "remaining part of the consistent mass matrix; None: lumped", default=None)
    axes: jax.Array | None = param(
        "1", "(V, 3) axis along which a plate with a given angle can move; 0 at other nodes", default=None
    )

    free: Free | None = param("1", "free directions; None for implicit Euler", default=None)
    given: jax.Array | None = param(
        "m/s^2", "(V, 3) acceleration where the motion is given; None: it is 0", default=None
    )

    everywhere: ClassVar[bool] = True

    def kinematics(self, x: jax.Array) -> tuple[jax.Array, jax.Array]:
        """Return velocity and acceleration (V, 3) at the end of the step, for positions x (V, 3)."""
        before, dt = self.motion, self.dt
        velocity = (x - self.x) / dt
        acceleration = (velocity - before.velocity) / dt
        if before.acceleration is not None:
            # Newmark's formula is used only in free directions. With a prescribed motion, the acceleration from this
            # formula would oscillate forever.
            average = 4 * acceleration - before.acceleration
            given = jnp.zeros_like(x) if self.given is None else self.given
            velocity = self._where_free(
                before.velocity + 0.5 * dt * (before.acceleration + average), velocity + 0.5 * dt * given
            )
            acceleration = self._where_free(average, given)
        return velocity, acceleration

    def _where_free(self, own: jax.Array, given: jax.Array) -> jax.Array:
        """Return a field (V, 3): `own` in free directions, and `given` in directions with a given motion."""
        out = jnp.where(self.mask > 0, own, given)
        return out if self.axes is None else out + jnp.sum(self.axes * (own - given), axis=1, keepdims=True) * self.axes

    def predicted(self) -> jax.Array:
        """Return the positions (V, 3) [m] at the end of the step after a motion at constant velocity."""
        return self.x + self.dt * self.motion.velocity

    def force(self, mesh: TetMesh, x: jax.Array, s: Number) -> jax.Array:
        """Return the inertia forces (V, 3) [N] at positions x (V, 3): mass times acceleration."""
        return inertia_forces(self.mass, self.shared, self.kinematics(x)[1])

    def accelerations(self, force: jax.Array, x: jax.Array) -> jax.Array | None:
        """Return the accelerations a (V, 3) [m/s^2] in the free directions due to forces (V, 3) [N].

        They are the solution of m a = f, with masses m and the forces f in the free directions.
        """
        assert self.free is not None
        return _accelerations(self.mass, self.shared, self.free, self.free.vectors(force, x))

    def inertial(self, acceleration: jax.Array) -> jax.Array:
        """Return the inertia forces (V, 3) [N]: mass times acceleration."""
        return inertia_forces(self.mass, self.shared, acceleration)

    def energy(self, mesh: TetMesh, x: jax.Array) -> jax.Array:
        """Return the incremental energy m a . a dt^2/(2k) [J], whose gradient is the inertia force.

        m are the masses, a the accelerations, dt is the time step, and k is from `FACTOR`.
        """
        a = self.kinematics(x)[1]
        return 0.5 * self.dt**2 / FACTOR[self.integrator] * jnp.sum(inertia_forces(self.mass, self.shared, a) * a)

    def stiffness(self) -> Block:
        """Return the stiffness k m/dt^2 [N/m] of every node, equal for all axes.

        m is the mass of the node, dt the time step, and k is from `FACTOR`.
        """
        return diagonal(FACTOR[self.integrator] / self.dt**2 * self.mass)

    def attached(self, mesh: TetMesh, x: jax.Array, s: Number) -> Masses | None:
        """Return k/dt^2 (see `stiffness`) times the remaining part of the consistent mass matrix.

        Returns None if the mass is lumped.
        """
        if self.shared is None:
            return None
        return self.shared._replace(size=FACTOR[self.integrator] / self.dt**2 * self.shared.size)
