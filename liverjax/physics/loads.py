"""Loads: weight, dead tractions (fixed direction), and follower pressures (normal to the deformed surface)."""

from functools import partial
from typing import Any

import jax
import jax.numpy as jnp

from liverjax.core import history
from liverjax.core.struct import Indices, Number, Numbers, param, replace, static, struct
from liverjax.mesh import surface
from liverjax.mesh.nodal import weighing_masses
from liverjax.mesh.tetrahedra import TetMesh
from liverjax.physics.base import NodalForce, Physics, Step


@struct
class Traction:
    """A load on m triangles of the boundary: a dead load (`value`), or a pressure normal to the deformed triangles.

    Without a history and without time steps, the load grows linearly until the last load step. With time steps, the
    whole load acts from the end of the first step on; in dynamics, from time 0 on.
    """

    triangles: Indices = param("1", "node numbers (m, 3), in an order with outward normals", lower=0)
    value: Any = param("Pa", "force per reference area (3,), in a fixed direction", default=None)
    pressure: Number | None = param(
        "Pa", "force per current area, along the current normal; inwards if > 0", default=None
    )
    times: Numbers | None = param("s", "times of a history (T,)", default=None)
    history: Any = param(
        "1", "factors (T,) that multiply value or pressure, or the value itself (T, 3) [Pa]", default=None
    )

    def at(self, time: Number) -> "Traction":
        """Return this load at a time [s] as a constant load. A load without a history does not change."""
        if self.history is None:
            return self
        now = history.value_at(self.value if self.pressure is None else self.pressure, time, self.times, self.history)
        key = "value" if self.pressure is None else "pressure"
        return replace(self, times=None, history=None, **{key: now})


@partial(jax.jit, inline=True)
def nodal_tractions(mesh: TetMesh, tractions: tuple) -> jax.Array:
    """Return the nodal forces (V, 3) [N] of the dead loads: reference area times traction, distributed to the nodes.

    Histories are not used (see `Traction.at`).
    """
    force = jnp.zeros(mesh.points.shape, mesh.points.dtype)
    for load in tractions:
        if load.value is None:
            continue
        normal = surface.areas(mesh.points, load.triangles[:, :3])
        area = jnp.sqrt(jnp.sum(normal * normal, axis=1))
        whole = area[:, None] * jnp.asarray(load.value, force.dtype)[None]
        for nodes, part in surface.nodal_shares(mesh, load.triangles):
            force = force.at[nodes].add(part * whole)
    return force


def follows(tractions: tuple) -> bool:
    """Return whether one of the loads is a follower pressure. The tangent of such a load is not symmetric."""
    return any(load.pressure is not None for load in tractions)


def follower_forces(tractions: tuple, x: jax.Array, mesh: TetMesh | None = None) -> jax.Array:
    """Return the nodal forces (V, 3) [N] of the follower pressures p at positions x (V, 3) [m].

    These forces are integrals of -p n da, with the normal n and the area element da. Without `mesh`, linear elements
    are assumed.
    """
    force = jnp.zeros_like(x)
    for load in tractions:
        if load.pressure is not None:
            force = force + load.pressure * surface.pressure_forces(load.triangles, x, mesh)
    return force


def dead_loads(mesh: TetMesh, density: Number, gravity: Numbers, tractions: tuple, mass: str) -> jax.Array:
    """Return the nodal forces (V, 3) [N] of the dead loads: tractions, and the weight if `density` is not None.

    `mass` is the kind of mass matrix of the body, lumped or consistent (`weighing_masses`).
    """
    force = jnp.zeros(mesh.points.shape, mesh.points.dtype)
    if density is not None:
        masses = weighing_masses(mesh, density, mass)
        force = force + masses[:, None] * jnp.asarray(gravity, force.dtype)[None]
    return force + nodal_tractions(mesh, tractions) if tractions else force


@struct
class Loads(Physics):
    """The loads of a body: weight and tractions."""

    density: Any = param("kg/m^3", "None: no weight", default=None)
    gravity: Any = param("m/s^2", "(3,)", default=None)
    times: Numbers | None = param("s", "times of a history of gravity (T,)", default=None)
    history: Numbers | None = param(
        "1", "factors (T,) that multiply gravity, or gravity itself (T, 3) [m/s^2]", default=None
    )
    traction: tuple[Traction, ...] = param("1", "on the surface", default=())
    mass: str = static(default="lumped", about="masses of the same body: lumped or consistent")

    def freeze(self, memory: None, step: Step) -> "Loading":
        """Return the force term of the loads for one step. It stores the sum of all dead loads."""
        if self.history is not None or any(load.history is not None for load in self.traction):
            begin, end = (self.at(n * step.dt)._loading(step, "none") for n in (step.k - 1, step.k))
            return replace(end, before=begin)
        return self._loading(step, "steps" if step.dt is None else "none" if step.inertia else "first")

    def at(self, time: Number) -> "Loads":
        """Return these loads at a time [s] as constant loads, without histories."""
        traction = tuple(load.at(time) for load in self.traction)
        gravity = history.value_at(self.gravity, time, self.times, self.history)
        return replace(self, gravity=gravity, traction=traction, times=None, history=None)

    def _loading(self, step: Step, growth: str) -> "Loading":
        dead = dead_loads(step.mesh, self.density, self.gravity, self.traction, self.mass)
        return Loading(dead=dead, traction=self.traction, k=step.k, steps=step.steps, growth=growth)


@struct
class Loading(NodalForce):
    """Force term of the loads, for one step."""

    dead: jax.Array = param("N", "(V, 3)")
    traction: tuple[Traction, ...] = param("1", "tractions and follower pressures on the surface")
    k: Number = param("1", "number of the step")
    steps: int = static(default=1, about="of the run")
    growth: str = static(
        default="none", about="the loads grow with the load steps (steps), in the first step (first), or never (none)"
    )
    before: "Loading | None" = param("1", "loads at the beginning of the step, if there is a history", default=None)

    @property
    def conservative(self) -> bool:  # type: ignore[override]
        """Return whether the loads have an energy. This is true if there are no follower pressures."""
        return not follows(self.traction)

    def fraction(self, s: Number) -> Any:
        """Return the fraction of the loads that acts at fraction s of the step (0: beginning, 1: end of the step)."""
        if self.growth == "steps":
            return (self.k - 1 + s) / self.steps
        dtype = self.dead.dtype
        return jnp.ones((), dtype) if self.growth == "none" else jnp.where(self.k == 1, s, 1.0).astype(dtype)

    def force(self, mesh: TetMesh, x: jax.Array, s: Any) -> jax.Array:
        """Return the loads (V, 3) [N], times -1, at positions x (V, 3) and fraction s of the step.

        If there is a history, the loads change linearly from the beginning to the end of the step.
        """
        if self.before is not None:
            end = replace(self, before=None)
            return s * end.force(mesh, x, s) + (1 - s) * self.before.force(mesh, x, s)
        outer = self.fraction(s) * self.dead
        if follows(self.traction):
            outer = outer + self.fraction(s) * follower_forces(self.traction, x, mesh)
        return -outer

    def energy(self, mesh: TetMesh, x: jax.Array) -> jax.Array:
        """Return the energy [J] of the dead loads: their work, times -1."""
        return -jnp.vdot(self.fraction(jnp.ones((), x.dtype)) * self.dead, x - mesh.points)

    def energy_from(self, mesh: TetMesh, x: jax.Array, start: jax.Array) -> jax.Array:
        """Return the energy [J] of the loads. The nodal forces of follower pressures keep their values at `start`."""
        if self.conservative:
            return self.energy(mesh, x)
        return jnp.vdot(self.force(mesh, start, jnp.ones((), x.dtype)), x - start)

    def product(self, mesh: TetMesh, x: jax.Array, s: Any, dx: jax.Array) -> jax.Array:
        """Return the change (V, 3) [N] of `force` due to the follower pressures for a displacement dx (V, 3) [m]."""
        if self.before is not None:
            end = replace(self, before=None)
            return s * end.product(mesh, x, s, dx) + (1 - s) * self.before.product(mesh, x, s, dx)
        return -jax.jvp(lambda x: self.fraction(s) * follower_forces(self.traction, x, mesh), (x,), (dx,))[1]
