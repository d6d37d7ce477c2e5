"""The state of rest under gravity, about which a body moves harmonically."""

import jax
import jax.numpy as jnp
import numpy as np

from liverjax.core import status
from liverjax.core.errors import InputError
from liverjax.core.struct import replace
from liverjax.scenes.by_element import by_element
from liverjax.scenes.scene import Scene
from liverjax.simulation.run import simulate
from liverjax.simulation.unloaded import resting

#: A time [s] after which nothing flows any more.
_FOR_LONG = 1e12


def under_its_weight(scene: Scene) -> jax.Array | None:
    """Positions (V, 3) [m] at rest under gravity alone, with stresses that have relaxed; None without gravity.

    Traced: a body that finds no rest has NaN as positions.

    Raises:
        InputError: no state of rest was found.
    """
    if scene.body is None:
        return None
    gravity = scene.body.gravity
    traced = any(isinstance(leaf, jax.core.Tracer) for leaf in jax.tree.leaves(gravity))
    if not traced and not np.any(np.asarray(gravity)):
        return None
    still = resting(replace(by_element(scene), traction=(), body=replace(scene.body, times=None, history=None)))
    # With a sponge the steps are so long that its fluid has flowed.
    dt = None if scene.porosity is None else _FOR_LONG
    solve = replace(still.solve, dt=dt, steps=4, frequencies=None)
    found = simulate(replace(still, solve=solve))
    if isinstance(found.status, jax.core.Tracer):
        good = jnp.all(found.status == status.CONVERGED)
        return jnp.where(good, found.positions[-1], jnp.nan)
    try:
        return found.check().positions[-1]
    except RuntimeError as error:
        raise InputError(
            f"no state of rest under gravity was found ({error}): hold the body, or give a state as about"
        ) from None
