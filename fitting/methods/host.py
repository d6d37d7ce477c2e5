"""Helpers for formulas with few variables that run in NumPy and in JAX. In NumPy, nothing is compiled, and derivatives
are exact."""

from collections.abc import Callable
from typing import Any

import jax.numpy as jnp
import numpy as np

Array = Any  # a JAX or NumPy array; a union type would need a type check at every call
#: Imaginary part of a complex step. The square of the step is below any roundoff, so the derivative has no truncation
#: error.
STEP = 1e-30


def arrays_of(*values: Any) -> Any:
    """Return the module to compute with: `numpy` if all values are NumPy arrays or plain numbers, otherwise
    `jax.numpy`."""
    return np if all(isinstance(v, (np.ndarray, np.generic, float, int)) for v in values) else jnp


def exponential(u: Array) -> Array:
    """Return the exponential of u, in NumPy or JAX."""
    return arrays_of(u).exp(u)


def with_jacobian(function: Callable[..., Any], u: np.ndarray, *data: Any) -> tuple[np.ndarray, np.ndarray]:
    """Return the m values (…, m) of a function of P unknowns u (…, P), and their derivatives (…, m, P), in NumPy. The
    derivatives are exact to roundoff.

    The derivative is Im f(u + i h) / h with a tiny step h (Squire and Trapp 1998, SIAM Review 40, 110). So the function
    must consist of +, -, *, /, exp, log, sums and similar operations. It must accept complex u with additional leading
    axes.
    """
    steps = u[..., None, :] + 1j * STEP * np.eye(u.shape[-1])
    found = function(steps, *data)
    return found[..., 0, :].real.copy(), np.swapaxes(found.imag / STEP, -1, -2)
