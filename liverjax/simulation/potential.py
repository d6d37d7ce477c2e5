"""The energy that a step makes least: of strain, memory, sponge and fluid, inertia and loads.

Its gradient is the residual. All are incremental potentials: the memory of a viscosity and the fluid's pressure at the
beginning of a step are constants of it. A pressure that follows the body has none.
"""

from typing import Any

import jax
import jax.numpy as jnp

from liverjax.laws.base import volumetric_part
from liverjax.physics import nodal_volume, porosity, viscosity
from liverjax.scenes.scene import element_law
from liverjax.tensors.matrices import Matrix, determinant, right_cauchy_green


def strain(scene: Any, memory: Any, F: Matrix) -> jax.Array:
    """Energy density (E,) [Pa] of law and memory: (1 - sum a) W - past : C/2, and U in full where it does not relax."""
    law = element_law(scene)
    if memory is None:
        return law.strain_energy(law.measures(F))
    relaxing = viscosity.relaxing(scene.viscosity, law)
    C = right_cauchy_green(F)
    stored = sum(memory.past[i][j] * C[i][j] for i in range(3) for j in range(3))
    W = memory.now * relaxing.strain_energy(relaxing.measures(F)) - 0.5 * stored
    rest = volumetric_part(law) if scene.viscosity.part == "isochoric" else None
    return W if rest is None else W + rest.strain_energy(rest.measures(F))


def volume(scene: Any, fluid: Any, flow: Any, pressure: Any, J: jax.Array) -> jax.Array:
    """Energy [J] of sponge and fluid: `pressure` (V,) is that of the step where it does not depend on J, else None."""
    mesh, sponge = scene.mesh, scene.porosity
    density = porosity.volumetric_energy(sponge, J)
    if pressure is not None:
        return jnp.sum(mesh.volumes * (density - porosity.element_pressure(mesh, pressure) * J))
    return jnp.sum(mesh.volumes * density) + porosity.fluid_energy(sponge, mesh, fluid, flow, J)


def motion(mass: jax.Array, acceleration: jax.Array, dt: Any, integrator: str) -> jax.Array:
    """Energy [J] of which the inertial force is the gradient: a = k (x - …)/dt^2 gives m a . a dt^2/(2k)."""
    k = {"euler": 1.0, "newmark": 4.0}[integrator]
    return 0.5 * dt**2 / k * jnp.sum(mass[:, None] * acceleration * acceleration)


def total(e: Any, x: jax.Array, F: Matrix, acceleration: Any) -> jax.Array:
    """Energy [J] of `liverjax.simulation.step.Equations` at the end of a step, at positions x (V, 3) [m]."""
    scene = e.scene
    energy = jnp.sum(scene.mesh.volumes * strain(scene, e.memory, F)) - jnp.vdot(e.loads, x - scene.mesh.points)
    if scene.porosity is not None:
        energy = energy + volume(scene, e.state.fluid, e.flow, e.pressure, determinant(F))
    elif scene.solve.volumetric == "nodal":
        energy = energy + nodal_volume.energy(scene.mesh, scene.law, determinant(F))
    if e.mass is None:
        return energy
    return energy + motion(e.mass, acceleration, scene.solve.dt, scene.solve.integrator)
