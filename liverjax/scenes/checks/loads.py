"""Check that all loads, weight, motions and supports are given once and in the right shape. Values are not checked."""

import jax
import numpy as np

from liverjax.core import bounds, history
from liverjax.core.errors import InputError
from liverjax.physics.loads import Traction
from liverjax.physics.porosity import check_inlets
from liverjax.physics.prescribed import Displaced, check_axes
from liverjax.scenes.scene import Body, Scene

#: Allowed values of [body] mass.
MASSES = ("lumped", "consistent")


def check_loads(scene: Scene) -> None:
    """Check that loads and motions are given once and in the right shape, and that the names of axes are known.

    Raises:
        InputError: an entry is wrong. The message begins with the name of the load, motion or support.
    """
    for k, load in enumerate(scene.traction):
        _check_traction(load, f"traction.{k}")
    if scene.porosity is not None:
        check_inlets(scene.porosity)
    if scene.body is not None:
        _check_body(scene.body, scene.mesh.number_of_nodes)
    for k, hold in enumerate(scene.fixed):
        check_axes(hold.axes, f"fixed.{k}")
    for k, motion in enumerate(scene.displaced):
        _check_motion(motion, f"displaced.{k}")


def _check_traction(load: Traction, name: str) -> None:
    history.check_times(load.times, load.history, name)
    if np.ndim(load.history) == 2:
        if load.value is not None or load.pressure is not None:
            raise InputError(f"{name} has a value or pressure, and also a history of vectors: remove one of them")
        return
    if (load.value is None) == (load.pressure is None):
        raise InputError(f"{name} needs either value (3,) or pressure, in Pa: give one of them")
    key, shape = ("pressure", ()) if load.value is None else ("value", (3,))
    if bounds.shape_of(getattr(load, key)) != shape:
        wanted = f"shape {shape}" if shape else "one number"
        raise InputError(f"{name} {key} has shape {bounds.shape_of(getattr(load, key))}: give {wanted}")


def _check_motion(motion: Displaced, name: str) -> None:
    history.check_times(motion.times, motion.history, name, (3,) if motion.by is None else (1,))
    check_axes(motion.axes, name)
    by, shape = motion.by, bounds.shape_of(motion.by)
    if by is not None and shape not in ((3,), (*np.shape(motion.nodes), 3)):
        raise InputError(f"{name} 'by' has shape {shape}: give three numbers in m, or three per node")
    if motion.by is None and motion.history is None:
        raise InputError(f"{name} needs either 'by' (3,), or times and history: give one of them")


def _check_body(body: Body, nodes: int) -> None:
    if body.mass not in MASSES:
        raise InputError(f"[body] mass = {body.mass!r} is not known: use {' or '.join(MASSES)}")
    gravity = bounds.shape_of(body.gravity)
    density = np.shape(body.density)
    if density not in ((), (nodes,)):
        raise InputError(f"[body] density has shape {density}: give one number or one per node ({nodes},), in kg/m^3")
    history.check_times(body.times, body.history, "body")
    if gravity != (3,):
        raise InputError(f"[body] gravity has shape {gravity}: give three numbers in m/s^2")
    if getattr(body.history, "ndim", 1) == 2 and not _unknown(body.gravity) and np.any(np.asarray(body.gravity) != 0):
        raise InputError("[body] has gravity, and also a history of gravity: remove one of them")


def _unknown(value: object) -> bool:
    return any(isinstance(leaf, jax.core.Tracer) for leaf in jax.tree.leaves(value))
