"""Stress and tangent of a law by automatic differentiation of its energy, as a reference for the hand-derived terms."""

from collections.abc import Callable

import jax
import jax.numpy as jnp

from liverjax.laws.base import Law


def first_piola(law: Law, F: jax.Array) -> jax.Array:
    """Return dW/dF [Pa] at one (3, 3) or many (..., 3, 3) deformation gradients, by reverse-mode differentiation."""
    return jax.grad(lambda F: jnp.sum(law.energy(F)))(F)


def tangent(law: Law, F: jax.Array) -> jax.Array:
    """Return d2W/dF dF [Pa], (..., 3, 3, 3, 3), at deformation gradients (..., 3, 3), by forward over reverse mode."""
    return derivative(lambda F: first_piola(law, F), F)


def derivative(function: Callable[[jax.Array], jax.Array], A: jax.Array) -> jax.Array:
    """Differentiate an element-wise function of matrices A (…, n, m), by forward mode.

    The result has the shape of the function's values, followed by (n, m). In each direction, all elements are
    differentiated at the same time, so a law may have one parameter value for each element.
    """
    n, m = A.shape[-2:]
    directions = jnp.eye(n * m, dtype=A.dtype).reshape(n * m, n, m)
    columns = jax.vmap(lambda d: jax.jvp(function, (A,), (jnp.broadcast_to(d, A.shape),))[1])(directions)
    return jnp.moveaxis(columns, 0, -1).reshape(*columns.shape[1:], n, m)
