"""Formulas of a few numbers that run in NumPy and in JAX. In NumPy nothing is compiled, and derivatives are exact."""

from collections.abc import Callable
from typing import Any

import jax.numpy as jnp
import numpy as np

Array = Any  # of JAX or of NumPy; written out, the type checker asks which one at every call
#: Imaginary part of a complex step. Its square is below roundoff of anything, so the step has no truncation error.
STEP = 1e-30


def arrays_of(*values: Any) -> Any:
    """The functions for these values: `numpy` if all of them are NumPy's or plain numbers, else `jax.numpy`."""
    return np if all(isinstance(v, (np.ndarray, np.generic, float, int)) for v in values) else jnp


def with_jacobian(function: Callable[..., Any], u: np.ndarray, *data: Any) -> tuple[np.ndarray, np.ndarray]:
    """Values (…, m) and derivative (…, m, P) of a function of u (…, P), in NumPy, to roundoff.

    The derivative is Im f(u + i h) / h (Squire and Trapp 1998, SIAM Review 40, 110), so the function is made of +, -,
    *, /, exp, log, sums and the like, and takes complex u with axes in front.
    """
    steps = u[..., None, :] + 1j * STEP * np.eye(u.shape[-1])
    found = function(steps, *data)
    return found[..., 0, :].real.copy(), np.swapaxes(found.imag / STEP, -1, -2)
