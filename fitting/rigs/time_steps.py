"""Error of simulated tests due to their time steps, from a second run with half the step (Richardson 1911, Phil. Trans.
R. Soc. A 210, 307)."""

from collections.abc import Callable

import jax
import numpy as np

import liverjax as lj
from liverjax.core import status
from liverjax.core.history import entry_at
from liverjax.core.struct import replace
from liverjax.mesh.selection import AXES
from liverjax.physics.contact.obstacle import Obstacle
from liverjax.physics.contact.pressed import PressedObstacle
from liverjax.physics.elastic_support import ElasticSupport
from liverjax.physics.prescribed import Displaced
from liverjax.physics.rigid_plate import RigidPlate
from liverjax.scenes.scene import Scene, histories


def order_of_steps(scene: Scene) -> int:
    """Return the order p of the error of a run: the error is proportional to (time step)^p. If parts of the scene have
    different orders, the smallest order is returned."""
    dynamic_euler = scene.solve.kind == "dynamic" and scene.solve.integrator == "euler"
    old_recursion = scene.viscosity is not None and scene.viscosity.scheme == "backward_euler"
    jump = scene.viscosity is not None and scene.solve.kind == "static" and _begins_with_load(scene)
    return 1 if dynamic_euler or old_recursion or jump or scene.porosity is not None else 2


def _begins_with_load(scene: Scene) -> bool:
    """Return whether a load or a prescribed motion is not 0 at the beginning. Such a load rises during the first step,
    so in a run with half the time step, the rise is also half as long."""
    loads = [own.value for own in scene.traction if own.times is None]
    if scene.body is not None and scene.body.times is None:
        loads.append(scene.body.gravity)
    for part in histories(scene).values():
        begin = np.asarray(entry_at(0.0, getattr(part, "times", None), getattr(part, "history", np.zeros(0))))
        # These parts begin without a load: a support with changing stiffness has no tension then, and a moved obstacle
        # may be far away.
        if isinstance(part, ElasticSupport) and begin.ndim == 0:
            continue
        if isinstance(part, Obstacle) and not isinstance(part, PressedObstacle):
            continue
        if isinstance(part, Displaced):
            moved = begin if part.by is None else np.asarray(part.by) * begin
            begin = moved[..., [AXES.index(axis) for axis in part.axes]]
        loads.append(begin)
    for plate in scene.physics:
        if isinstance(plate, RigidPlate):
            loads.append(plate.turn if plate.times is None else entry_at(0.0, plate.times, plate.turn))
    return any(np.any(np.asarray(load) != 0) for load in loads)


def change_with_small_steps(
    scene: Scene, readings: Callable[[lj.Result], jax.Array], run: lj.Result | None = None
) -> np.ndarray:
    """Estimate how each reading of a run would change with infinitely small time steps.

    Args:
        scene: a scene with time steps, with known numbers (not inside jit, grad or vmap).
        readings: function from a run of T steps to its readings, with any shape (T, …).
        run: the run of this scene, if it is known already. The run may come from another scene that has the same loads
            at the ends of the time steps.

    Returns:
        The change, in the shape of the readings. It is NaN if a run fails.
    """
    run = lj.simulate(scene) if run is None else run
    coarse = np.asarray(readings(run))
    fine = lj.simulate(replace(scene, solve=replace(scene.solve, dt=scene.solve.dt / 2, steps=2 * scene.solve.steps)))
    if np.any(np.concatenate([run.status, fine.status]) != status.CONVERGED):
        return np.full(coarse.shape, np.nan)
    # Every field of a result has one row for each step, except the mesh error, which is not computed here.
    every_second = jax.tree.map(lambda rows: rows[1::2], fine)
    order = order_of_steps(scene)
    return (np.asarray(readings(every_second)) - coarse) * 2**order / (2**order - 1)
