"""The tangent of a reduced step: products with the tangent, and an approximate inverse that needs half the time of the
exact inverse.

The tangent is K = sum_p B_p^T A_p B_p + R, with the gradients B_p of the modes and the moduli A_p at the points p. R
contains the terms that do not come from the points. The assembly of K needs as much time as ten products with K, or
half of this time in single precision. The inverse N of the single-precision matrix is close to the inverse of K.
Newton's method uses N. If K x = b must be solved accurately, x is replaced a few times by x + N (b - K x), with
products in double precision (iterative refinement: Wilkinson 1963).
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp

#: LEFT: the corrections end if the relative residual is at most this value. CORRECTIONS: maximum number of corrections.
LEFT, CORRECTIONS = 1e-12, 20
#: If the relative residual after the corrections is above this value, K is assembled and factorised in double
#: precision.
TOO_FAR = 1e-10


class SinglePrecision(NamedTuple):
    """Gradients of the n modes at the S points in single precision, in two array layouts. Matrix products are a third
    faster if no matrix has to be transposed."""

    slopes: jax.Array  # gradients (9, S, n) [m^-2.5]
    flat: jax.Array  # the same gradients as a matrix (n, 9 S)


class ReducedTangent(NamedTuple):
    """The arrays B, A and R of the tangent (n, n) [N m^-4] (module docstring), for n modes and S points."""

    slopes: jax.Array  # B: gradients of the modes (9, S, n) [m^-2.5]
    moduli: jax.Array  # A: moduli times weights (9, 9, S) [N m]
    rest: jax.Array  # R: inertia, springs and pressures (n, n) [N m^-4]


def in_single_precision(slopes: jax.Array) -> SinglePrecision:
    """Return the gradients of the n modes at the S points (9, S, n) [m^-2.5] in single precision."""
    light = jax.lax.stop_gradient(slopes).astype(jnp.float32)
    return SinglePrecision(light, light.reshape(-1, light.shape[-1]).T)


def tangent_times(K: ReducedTangent, x: jax.Array) -> jax.Array:
    """Return the product K x (n,) [N m^-1.5] of the tangent K and the n reduced coordinates x (n,) [m^2.5]."""
    stress = jnp.sum(K.moduli * (K.slopes @ x)[None], axis=1)
    return jnp.tensordot(stress, K.slopes, axes=2) + K.rest @ x


def tangent_matrix(K: ReducedTangent) -> jax.Array:
    """Return the tangent K of n modes as an assembled matrix (n, n) [N m^-4]."""
    AB = jnp.sum(K.moduli[..., None] * K.slopes[None], axis=1)
    return jnp.tensordot(K.slopes, AB, axes=((0, 1), (0, 1))) + K.rest


def near_inverse(K: ReducedTangent, light: SinglePrecision) -> jax.Array:
    """Return an approximate inverse (n, n) [m^4/N] of the tangent K of n modes. K is assembled in single precision."""
    AB = jnp.sum(K.moduli.astype(jnp.float32)[..., None] * light.slopes[None], axis=1)
    near = light.flat @ AB.reshape(-1, AB.shape[-1])
    return jnp.linalg.inv(near.astype(K.rest.dtype) + K.rest)


def solved_by_tangent(K: ReducedTangent, light: SinglePrecision, b: jax.Array) -> jax.Array:
    """Return the accurate solution x (n,) [m^2.5] of K x = b, with n unknowns. The function may be differentiated."""

    def solve(_: object, b: jax.Array) -> jax.Array:
        near, limit = near_inverse(K, light), jnp.linalg.norm(b)

        def going(at: tuple) -> jax.Array:
            _, r, before, count = at
            size = jnp.linalg.norm(r)
            # The corrections end if the last one did not halve r. Then r is roundoff, or the inverse is not accurate.
            return (size > LEFT * limit) & (size < 0.5 * before) & (count < CORRECTIONS)

        def corrected(at: tuple) -> tuple:
            x, r, _, count = at
            x = x + near @ r
            return x, b - tangent_times(K, x), jnp.linalg.norm(r), count + 1

        begin = jnp.zeros_like(b), b, jnp.full_like(limit, jnp.inf), 0
        x, r, _, _ = jax.lax.while_loop(going, corrected, begin)
        far = ~(jnp.linalg.norm(r) <= TOO_FAR * limit)
        return jax.lax.cond(far, lambda: jnp.linalg.solve(tangent_matrix(K), b), lambda: x)

    return jax.lax.custom_linear_solve(lambda x: tangent_times(K, x), b, solve, symmetric=True)
