"""Bias of parameters that were identified with a reduced model, relative to an identification with the full model.

The reduced model is fitted to data y: at the parameters p its result u(p) is closest to y. At p the full model has the
result u(p) + d, and one full run gives d. The full model fits the same data at p - b. To first order J b = d in the
least-squares sense, with the derivative J of u. So b is the bias that the reduced model causes, and p - b has no such
bias to first order.
"""

from collections.abc import Callable, Mapping
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree

from liverjax.reduced.model import ReducedModel
from liverjax.reduced.run import reduced_positions, simulate_reduced
from liverjax.scenes.scene import Scene, with_parameters
from liverjax.simulation.run import simulate


def reduced_bias(
    model: ReducedModel, scene: Scene, values: Mapping[str, Any], observed: Callable[[jax.Array], jax.Array]
) -> dict[str, np.ndarray]:
    """Bias of identified parameters, in their units and shapes.

    Subtract it from them. It needs one full run; host side.

    Args:
        model, scene: as in `simulate_reduced`.
        values: dotted names -> values that were identified with the model.
        observed: the function of positions (T, V, 3) [m] that was fitted to data, with the weights of the fit.

    Raises:
        InputError: as `simulate_reduced`; a full run that fails.
    """
    flat, shaped = ravel_pytree({name: jnp.asarray(value, float) for name, value in values.items()})

    def answer(numbers: jax.Array) -> jax.Array:
        own = with_parameters(scene, shaped(numbers))
        return jnp.ravel(observed(reduced_positions(model, own, simulate_reduced(model, own))))

    full = simulate(with_parameters(scene, shaped(flat))).check()
    off = np.asarray(jnp.ravel(observed(full.positions)) - jax.jit(answer)(flat))
    J = np.asarray(jax.jit(jax.jacfwd(answer))(flat))
    # The parameters have different units, so the columns are scaled to length 1.
    size = np.linalg.norm(J, axis=0)
    size = np.where(size > 0, size, 1.0)
    found = np.linalg.lstsq(J / size, off, rcond=None)[0] / size
    return {name: np.asarray(value) for name, value in shaped(jnp.asarray(found)).items()}
