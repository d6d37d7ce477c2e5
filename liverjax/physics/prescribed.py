"""Prescribed motion: fixed nodes, and nodes with a given displacement."""

from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np

from liverjax.core.errors import InputError
from liverjax.core.history import entry_at
from liverjax.core.struct import Indices, Number, Numbers, param, static, struct
from liverjax.mesh.selection import AXES
from liverjax.mesh.tetrahedra import TetMesh
from liverjax.physics.base import Free


@struct
class Fixed:
    """Nodes that do not move along some axes."""

    nodes: Indices = param("1", "node numbers (n,)", lower=0)
    axes: str = static(default="xyz", about="held axes")


@struct
class Displaced:
    """Nodes with a prescribed displacement.

    The displacement grows linearly and reaches `by` at the last step, or it follows a history.
    """

    nodes: Indices = param("1", "node numbers (n,)", lower=0)
    by: Numbers | None = param("m", "displacement (3,), or one per node (n, 3), reached at the last step", default=None)
    times: Numbers | None = param("s", "times of a history (T,)", default=None)
    history: Numbers | None = param(
        "m", "displacements at these times (T, 3), or factors (T,) that multiply `by`; linear in between", default=None
    )
    axes: str = static(default="xyz", about="prescribed axes")


def check_axes(axes: object, name: str) -> None:
    """Check that a value names coordinate axes, for example "xy".

    Raises:
        InputError: the value is not a string of different letters x, y and z. The message begins with `name`.
    """
    if not isinstance(axes, str) or not axes or set(axes) - set(AXES) or len(set(axes)) != len(axes):
        raise InputError(f"{name} axes = {axes!r} is not known: give one or more of the letters x, y and z, each once")


def free_degrees(mesh: TetMesh, fixed: tuple, displaced: tuple) -> jax.Array:
    """Return a mask (V, 3) of the degrees of freedom: 1 if unknown, 0 if fixed or prescribed."""
    if not any(isinstance(condition.nodes, jax.core.Tracer) for condition in (*fixed, *displaced)):
        return jnp.asarray(free_places(mesh, fixed, displaced), mesh.points.dtype)  # with NumPy, JAX compiles nothing
    mask = jnp.ones(mesh.points.shape, mesh.points.dtype)
    for condition in (*fixed, *displaced):
        axes = np.array([AXES.index(axis) for axis in condition.axes])
        mask = mask.at[jnp.asarray(condition.nodes)[:, None], axes].set(0.0)
    return mask


def free_places(mesh: TetMesh, fixed: tuple, displaced: tuple) -> np.ndarray:
    """Return a mask (V, 3) of the degrees of freedom (NumPy array): True if unknown, False if fixed or prescribed."""
    free = np.ones(mesh.points.shape, bool)
    for condition in (*fixed, *displaced):
        for axis in condition.axes:
            free[np.asarray(condition.nodes), AXES.index(axis)] = False
    return free


def prescribed(mesh: TetMesh, displaced: tuple, time: Number, fraction: Number) -> jax.Array:
    """Return the displacements (V, 3) [m] of prescribed degrees of freedom, and 0 for the other degrees of freedom.

    Args:
        time: time [s], for motions with a history.
        fraction: completed fraction of the run, for motions without a history.
    """
    u = jnp.zeros(mesh.points.shape, mesh.points.dtype)
    for condition in displaced:
        axes = np.array([AXES.index(axis) for axis in condition.axes])
        if condition.by is not None:
            part = fraction if condition.history is None else entry_at(time, condition.times, condition.history)
            value = jnp.asarray(condition.by, u.dtype)[..., axes] * part
        else:
            history = jnp.asarray(condition.history)
            value = jnp.stack([jnp.interp(time, condition.times, history[:, k]) for k in axes])
        u = u.at[jnp.asarray(condition.nodes)[:, None], axes].set(value)
    return u


def given_acceleration(place: Callable[[Number], jax.Array], k: Number, steps: int, dt: Number) -> jax.Array:
    """Return the acceleration (V, 3) [m/s^2] of a given motion at the end of step k, with an error of order dt^2.

    It is the central second difference of the positions. At the last step, the next position is unknown, so the
    acceleration is extrapolated. For k = 0, the nodes are at rest before the motion begins. If the velocity jumps to v
    at the beginning, the result is 2 v/dt, so that Newmark's method applies the whole impulse in the first step.

    Args:
        place: function k -> positions (V, 3) [m] after k steps.
        k: number of the step.
        steps: number of steps of the run.
        dt: time step [s].
    """
    n = jnp.where(k == steps, k - 1, k)
    x = [place(jnp.maximum(n + i, 0)) for i in (1, 0, -1, -2)]
    now, before = x[0] - 2 * x[1] + x[2], x[1] - 2 * x[2] + x[3]
    # For n = 1, `before` contains the jump of the velocity at the beginning, so it is not used.
    change = jnp.where(n > 1, now - before, 0.0) if steps > 2 else jnp.zeros_like(now)
    # In a run of one step, the step k = 1 would contain the same jump once more.
    begin = jnp.where(k == 0, 2.0, 1.0 if steps > 1 else 0.0)
    return (begin * now + (k - n) * change) / dt**2


def strained_by_motion(free: Free, start: jax.Array, x: jax.Array) -> jax.Array:
    """Return whether fixed and prescribed nodes strain the body at positions x (V, 3) by more than roundoff.

    `start` (V, 3) is the reference shape. The nodes strain the body if the distances between them change. For nodes
    that are free along an axis, the displacements along the other axes are compared.
    """
    fixed = free.mask == 0
    held = jnp.all(fixed, axis=1)
    first = jnp.argmax(held)
    longer = jnp.linalg.norm(x - x[first][None], axis=1) - jnp.linalg.norm(start - start[first][None], axis=1)
    partly, moved = fixed & ~held[:, None], x - start
    low = jnp.min(moved, axis=0, initial=jnp.inf, where=partly)
    high = jnp.max(moved, axis=0, initial=-jnp.inf, where=partly)
    most = jnp.maximum(jnp.max(high - low), jnp.max(jnp.abs(longer), initial=0.0, where=held))
    return most > 8 * float(jnp.finfo(x.dtype).eps) * jnp.maximum(jnp.max(jnp.abs(x)), jnp.max(jnp.abs(start)))
