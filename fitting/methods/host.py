"""Helpers for formulas with few variables that run in NumPy and in JAX. In NumPy, nothing is compiled, and derivatives
are exact."""

from collections.abc import Callable
from typing import Any

import jax.numpy as jnp
import numpy as np

Array = Any  # a JAX or NumPy array; with a union type, every call would have to tell which
#: Imaginary part of a complex step. Its square is below any roundoff, so the derivative has no truncation error.
STEP = 1e-30


def arrays_of(*values: Any) -> Any:
    """The module to compute with: `numpy` if all values are NumPy arrays or plain numbers, else `jax.numpy`."""
    return np if all(isinstance(v, (np.ndarray, np.generic, float, int)) for v in values) else jnp


def exponential(u: Array) -> Array:
    """The exponential of u, in NumPy or JAX."""
    return arrays_of(u).exp(u)


def with_jacobian(function: Callable[..., Any], u: np.ndarray, *data: Any) -> tuple[np.ndarray, np.ndarray]:
    """Values (…, m) and derivatives (…, m, P) of a function of u (…, P), in NumPy, exact to roundoff.

    The derivative is Im f(u + i h) / h (Squire and Trapp 1998, SIAM Review 40, 110), so the function must consist of +,
    -, *, /, exp, log, sums and similar operations. It must accept complex u with additional leading axes.
    """
    steps = u[..., None, :] + 1j * STEP * np.eye(u.shape[-1])
    found = function(steps, *data)
    return found[..., 0, :].real.copy(), np.swapaxes(found.imag / STEP, -1, -2)
