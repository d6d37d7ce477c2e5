"""Bias of parameters that were identified with a reduced model instead of the full model.

Let p be the parameters for which the result u(p) of the reduced model is closest to the data. For the same parameters,
the result of the full model is u(p) + d. The difference d is known from one full run. The full model fits the same data
best at p - b. To first order, b is the least-squares solution of J b = d, with the derivative J of u with respect to p.
So b is the bias that the reduced model causes, and p - b has no such bias to first order.
"""

from collections.abc import Callable, Mapping
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree

from liverjax.core import status
from liverjax.reduced.model import ReducedModel
from liverjax.reduced.run import reduced_positions, simulate_reduced
from liverjax.scenes.scene import Scene, with_parameters
from liverjax.simulation.run import simulate


def reduced_bias(
    model: ReducedModel, scene: Scene, values: Mapping[str, Any], observed: Callable[[jax.Array], jax.Array]
) -> dict[str, np.ndarray]:
    """Return the bias of identified parameters, in the units and shapes of the parameters.

    Subtract the bias from the identified parameters to correct them. The function runs the full model once. It cannot
    be used inside jit, grad or vmap.

    Args:
        model, scene: the same arguments as for `simulate_reduced`.
        values: dotted names of the parameters -> values that were identified with the reduced model.
        observed: function of the positions (T, V, 3) [m] of the nodes. It returns the quantities that were fitted to
            the data, multiplied by the weights of the fit.

    Raises:
        InputError: `simulate_reduced` cannot run this scene.
        RuntimeError: the full run or the reduced run does not converge.
    """
    flat, shaped = ravel_pytree({name: jnp.asarray(value, float) for name, value in values.items()})

    def answer(numbers: jax.Array) -> tuple[jax.Array, jax.Array]:
        own = with_parameters(scene, shaped(numbers))
        run = simulate_reduced(model, own)
        return jnp.ravel(observed(reduced_positions(model, own, run))), run.status

    found_by_model, codes = jax.jit(answer)(flat)
    failed = np.flatnonzero(np.asarray(codes) != status.CONVERGED)
    if failed.size:
        raise RuntimeError(f"the reduced run did not converge in step {failed[0] + 1}: use the full model")
    full = simulate(with_parameters(scene, shaped(flat))).check()
    off = np.asarray(jnp.ravel(observed(full.positions)) - found_by_model)
    J = np.asarray(jax.jit(jax.jacfwd(lambda numbers: answer(numbers)[0]))(flat))
    # The parameters have different units, so the columns of J are scaled to length 1.
    size = np.linalg.norm(J, axis=0)
    size = np.where(size > 0, size, 1.0)
    found = np.linalg.lstsq(J / size, off, rcond=None)[0] / size
    return {name: np.asarray(value) for name, value in shaped(jnp.asarray(found)).items()}
