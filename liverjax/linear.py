"""Linear solves inside jit: preconditioned conjugate gradients that check their true residual."""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp


class LinearStatistics(NamedTuple):
    """What a solve did."""

    iterations: jax.Array
    residual: jax.Array  # |b - A x| / |b|, recomputed at the end


def conjugate_gradients(
    matvec: Callable[[jax.Array], jax.Array],
    b: jax.Array,
    precondition: Callable[[jax.Array], jax.Array],
    tolerance: Any,
    max_iterations: int,
) -> tuple[jax.Array, LinearStatistics]:
    """Solve A x = b for symmetric positive definite A, both given as functions of a flat vector (n,).

    Args:
        matvec, precondition: A and an approximation of its inverse.
        tolerance: of the recursive residual relative to |b|.
        max_iterations: iterations after which what was reached is returned.

    Stops as well on a direction of no positive curvature. The statistics hold the true residual.
    """
    goal = tolerance * jnp.linalg.norm(b)

    def go_on(c):
        _, r, _, rz, k, positive = c
        return (jnp.sqrt(jnp.vdot(r, r)) > goal) & (k < max_iterations) & positive & (rz > 0)

    def step(c):
        x, r, p, rz, k, _ = c
        Ap = matvec(p)
        curvature = jnp.vdot(p, Ap)
        positive = curvature > 0
        alpha = jnp.where(positive, rz / jnp.where(positive, curvature, 1.0), 0.0)
        x, r = x + alpha * p, r - alpha * Ap
        z = precondition(r)
        rz_new = jnp.vdot(r, z)
        return x, r, z + rz_new / rz * p, rz_new, k + 1, positive

    z = precondition(b)
    start = (jnp.zeros_like(b), b, z, jnp.vdot(b, z), jnp.zeros((), jnp.int32), jnp.array(True))
    x, _, _, _, k, _ = jax.lax.while_loop(go_on, step, start)
    scale = jnp.linalg.norm(b)
    residual = jnp.linalg.norm(b - matvec(x)) / jnp.where(scale > 0, scale, 1.0)
    return x, LinearStatistics(k, residual)


def differentiable_solve(
    matvec: Callable[[jax.Array], jax.Array],
    b: jax.Array,
    precondition: Callable[[jax.Array], jax.Array],
    tolerance: Any,
    max_iterations: int,
) -> jax.Array:
    """`conjugate_gradients` as a linear map of `b`: its derivatives are further solves, not those of iterations."""

    def solve(matvec, b):
        return conjugate_gradients(matvec, b, precondition, tolerance, max_iterations)[0]

    return jax.lax.custom_linear_solve(matvec, b, solve=solve, symmetric=True)
