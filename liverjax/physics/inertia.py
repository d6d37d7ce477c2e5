"""Inertia of lumped masses, by implicit Euler or by Newmark's average acceleration."""

from typing import Any, ClassVar, NamedTuple

import jax
import jax.numpy as jnp

from liverjax.core.struct import Number, param, static, struct
from liverjax.mesh.nodal import nodal_volumes
from liverjax.mesh.tetrahedra import TetMesh
from liverjax.physics.base import End, NodalForce, Physics, Start, Step, diagonal
from liverjax.solvers.block_matrix import Block

#: k of the acceleration k (x - ...)/dt^2 at the end of a step.
FACTOR = {"euler": 1.0, "newmark": 4.0}


class Motion(NamedTuple):
    """Velocity and acceleration, handed from step to step."""

    velocity: jax.Array  # (V, 3) [m/s]
    acceleration: jax.Array | None  # (V, 3) [m/s^2], of Newmark's method


@struct
class Inertia(Physics):
    """Mass of the body, a quarter of every element at each of its nodes."""

    density: Any = param("kg/m^3", "per reference volume, one number or one a node (V,)", above=0.0)
    integrator: str = static(default="euler", about="euler (first order) or newmark (second order)")

    def begin(self, start: Start) -> Motion:
        """Begin at rest, with the acceleration m a = f: Newmark's method keeps its order from the first step."""
        acceleration = None
        if self.integrator == "newmark":
            mass = self.density * nodal_volumes(start.mesh)
            # Functions of order 3, of the mesh's estimate, have no mass: they follow the others at once.
            has_mass = (mass > 0)[:, None]
            forces = start.free.vectors(-start.force())
            acceleration = jnp.where(has_mass, forces / jnp.where(has_mass, mass[:, None], 1.0), 0.0)
        return Motion(jnp.zeros_like(start.x), acceleration)

    def freeze(self, memory: Motion, step: Step) -> "Moving":
        """Masses, and the motion at the beginning of the step."""
        mass = self.density * nodal_volumes(step.mesh)
        return Moving(mass=mass, x=step.x, motion=memory, dt=step.dt, mask=step.free.mask, integrator=self.integrator)

    def advance(self, memory: Motion, acting: "Moving", end: End) -> Motion:
        """Velocity and acceleration at the end of the step."""
        velocity, acceleration = acting.kinematics(end.x)
        return Motion(velocity, None if memory.acceleration is None else acceleration)


@struct
class Moving(NodalForce):
    """Inertia during a step."""

    mass: jax.Array = param("kg", "(V,)")
    x: jax.Array = param("m", "positions at the beginning (V, 3)")
    motion: Motion = param("1", "velocity and acceleration there")
    dt: jax.Array = param("s", "time step")
    mask: jax.Array = param("1", "(V, 3) 1 where free")
    integrator: str = static(default="euler")

    everywhere: ClassVar[bool] = True

    def kinematics(self, x: jax.Array) -> tuple[jax.Array, jax.Array]:
        """Velocity and acceleration (V, 3) at the end of the step."""
        before, dt = self.motion, self.dt
        velocity = (x - self.x) / dt
        acceleration = (velocity - before.velocity) / dt
        if before.acceleration is not None:
            # Free degrees only: where motion is prescribed the average acceleration would swing without end.
            average = 4 * acceleration - before.acceleration
            free = self.mask > 0
            velocity = jnp.where(free, before.velocity + 0.5 * dt * (before.acceleration + average), velocity)
            acceleration = jnp.where(free, average, acceleration)
        return velocity, acceleration

    def predicted(self) -> jax.Array:
        """Straight on."""
        return self.x + self.dt * self.motion.velocity

    def force(self, mesh: TetMesh, x: jax.Array, s: Number) -> jax.Array:
        """Mass times acceleration."""
        return self.mass[:, None] * self.kinematics(x)[1]

    def energy(self, mesh: TetMesh, x: jax.Array) -> jax.Array:
        """m a . a dt^2/(2k); the force is its gradient."""
        a = self.kinematics(x)[1]
        return 0.5 * self.dt**2 / FACTOR[self.integrator] * jnp.sum(self.mass[:, None] * a * a)

    def stiffness(self) -> Block:
        """k m/dt^2 along every axis."""
        return diagonal(FACTOR[self.integrator] / self.dt**2 * self.mass)
