"""Tension, indentation and creep of a cylinder as differentiable experiments.

Each is a scene whose law and viscosity are filled in, and a reading of its run. The sample is glued to its plates: that
is part of the simulation, so no factor of shape has to correct for it.
"""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

import liverjax as lj
from liverjax.core.errors import InputError
from liverjax.core.struct import param, replace, static, struct
from liverjax.laws import Law
from liverjax.mesh import shapes
from liverjax.physics import boundary
from liverjax.physics.viscosity import Prony

READINGS = ("force", "displacement")


@struct
class Rig:
    """A scene without its law, and what is read of it along z."""

    scene: lj.Scene = param("1", "with a law that `read` replaces")
    nodes: Any = param("1", "node numbers (n,) that are read")
    reading: str = static(default="force", about="force [N] on the nodes, or their mean displacement [m]")


def read(rig: Rig, law: Law, prony: Prony | None) -> tuple[jax.Array, jax.Array]:
    """What the rig shows at every step (T,) [N] or [m], and the steps' codes (T,)."""
    result = lj.simulate(replace(rig.scene, law=law, viscosity=prony))
    if rig.reading == "force":
        return jnp.sum(result.reactions[:, rig.nodes, 2], axis=1), result.status
    rest = rig.scene.mesh.points[rig.nodes, 2]
    return jnp.mean(result.positions[:, rig.nodes, 2] - rest[None], axis=1), result.status


def tension(radius: float, height: float, dt: float, strains: Any, cell_size: float | None = None) -> Rig:
    """A cylinder pulled (or pressed) between glued plates; the force is read.

    Args:
        radius, height: of the sample [m].
        dt: time step [s].
        strains: nominal strain at the end of every step (T,).
        cell_size: of the mesh [m]; default a third of the radius.

    Raises:
        InputError: lengths or times that are not positive, strains that are not finite or flatten the sample.
    """
    strains = _finite("strains", strains)
    if strains.min() <= -0.9:
        raise InputError(f"strains reach {strains.min():g}: keep them above -0.9")
    mesh = _sample(radius, height, dt, cell_size)
    return _driven(mesh, mesh.node_sets["top"], dt, height * strains)


def indentation(
    radius: float, height: float, punch: float, dt: float, depths: Any, cell_size: float | None = None
) -> Rig:
    """A glued flat punch of radius `punch` [m] pressed into a cylinder by `depths` (T,) [m]; the force on it.

    Args:
        radius, height, dt, cell_size: as of `tension`; the punch's edge is as sharp as the mesh is fine.

    Raises:
        InputError: as of `tension`; a punch wider than the sample or narrower than its mesh.
    """
    depths = _finite("depths", depths)
    mesh = _sample(radius, height, dt, cell_size)
    top = np.asarray(mesh.node_sets["top"])
    under = top[np.hypot(*np.asarray(mesh.points)[top, :2].T) <= punch * (1 + 1e-9)]
    if not (0 < punch < radius) or len(under) < 4:
        raise InputError(f"punch = {punch:g} m must be below the radius {radius:g} and above a cell: mend one of them")
    return _driven(mesh, jnp.asarray(under), dt, -depths)


def creep(radius: float, height: float, dt: float, steps: int, stress: float, cell_size: float | None = None) -> Rig:
    """A cylinder under a constant pull `stress` [Pa] on its top from time 0 on; the mean displacement of the top.

    The pull comes up over the first step, as it does in a rheometer over some time.
    """
    mesh = _sample(radius, height, dt, cell_size)
    triangles = boundary.boundary_triangles(mesh, mesh.node_sets["top"])
    pull = lj.Traction(triangles=jnp.asarray(triangles), value=jnp.array([0.0, 0.0, float(stress)]))
    return Rig(scene=_scene(mesh, dt, steps, traction=(pull,)), nodes=mesh.node_sets["top"], reading="displacement")


def _finite(name: str, values: Any) -> np.ndarray:
    values = np.atleast_1d(np.asarray(values, float))
    if values.ndim != 1 or not len(values) or not np.all(np.isfinite(values)):
        raise InputError(f"{name} must be finite numbers, one a step: mend the list")
    return values


def _sample(radius: float, height: float, dt: float, cell_size: float | None) -> lj.TetMesh:
    if not (np.isfinite(dt) and dt > 0):
        raise InputError(f"dt = {dt} must be positive: give the time step in seconds")
    return shapes.cylinder(radius, height, cell_size or radius / 3)


def _driven(mesh: lj.TetMesh, nodes: jax.Array, dt: float, lift: np.ndarray) -> Rig:
    history = np.zeros((len(lift) + 1, 3))
    history[1:, 2] = lift
    times = dt * np.arange(len(lift) + 1)
    moved = lj.Displaced(nodes=nodes, times=jnp.asarray(times), history=jnp.asarray(history))
    return Rig(scene=_scene(mesh, dt, len(lift), displaced=(moved,)), nodes=nodes)


def _scene(mesh: lj.TetMesh, dt: float, steps: int, **loads: Any) -> lj.Scene:
    return lj.Scene(
        mesh=mesh,
        law=lj.laws.NeoHookean(mu=1.0, bulk=1.0),
        fixed=(lj.Fixed(nodes=mesh.node_sets["bottom"]),),
        solve=lj.Solve(dt=dt, steps=steps, tolerance=1e-9),
        **loads,
    )
