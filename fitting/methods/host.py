"""Formulas of a few numbers that run in NumPy and in JAX. In NumPy nothing is compiled, and derivatives are exact."""

from collections.abc import Callable
from typing import Any

import jax.numpy as jnp
import numpy as np

Array = Any  # of JAX or of NumPy; with a union type every call would have to say which one
#: Imaginary part of a complex step. Its square is below roundoff of anything, so the step has no truncation error.
STEP = 1e-30


def arrays_of(*values: Any) -> Any:
    """The module to compute with: `numpy` if all values are NumPy's or plain numbers, else `jax.numpy`."""
    return np if all(isinstance(v, (np.ndarray, np.generic, float, int)) for v in values) else jnp


def exponential(u: Array) -> Array:
    """Numbers whose logarithms are u."""
    return arrays_of(u).exp(u)


def with_jacobian(function: Callable[..., Any], u: np.ndarray, *data: Any) -> tuple[np.ndarray, np.ndarray]:
    """Values (…, m) and derivative (…, m, P) of a function of u (…, P), in NumPy, to roundoff.

    The derivative is Im f(u + i h) / h (Squire and Trapp 1998, SIAM Review 40, 110), so the function must consist of +,
    -, *, /, exp, log, sums and the like, and must accept complex u with more axes in front.
    """
    steps = u[..., None, :] + 1j * STEP * np.eye(u.shape[-1])
    found = function(steps, *data)
    return found[..., 0, :].real.copy(), np.swapaxes(found.imag / STEP, -1, -2)
