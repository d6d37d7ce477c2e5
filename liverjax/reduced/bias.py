"""Bias of numbers that were identified with a reduced model, against those that the full model would give.

Data y are fitted by the reduced model: its answer u(p) is nearest to y at numbers p. The full model's answer there is
u(p) + d, and one full run gives d. The full model meets the same data at p - b, where to first order J b = d in the
least squares, with J the derivative of u. So b is the bias due to the reduced model, and p - b is free of it to first
order.
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
    """Bias of identified numbers, in their own units and shapes: subtract it from them. One full run; host side.

    Args:
        model, scene: as in `simulate_reduced`.
        values: dotted names -> numbers that were identified through the model.
        observed: the function of positions (T, V, 3) [m] that was fitted to data, with the weights of that fit.

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
    # Numbers have different units, so columns are scaled to length 1.
    size = np.linalg.norm(J, axis=0)
    size = np.where(size > 0, size, 1.0)
    found = np.linalg.lstsq(J / size, off, rcond=None)[0] / size
    return {name: np.asarray(value) for name, value in shaped(jnp.asarray(found)).items()}
