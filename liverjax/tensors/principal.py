"""Principal stretches and sums of their powers, with derivatives that also exist if stretches are equal.

With the principal stretches lambda_m, the sum Xi(alpha) = sum_m lambda_m^alpha = tr C^(alpha/2) is a smooth function of
C, although the eigenvectors of C are not. So derivatives treat the eigenvectors as constants. In the axes of the
eigenvectors, C = diag(c) + X. The value of X is zero, but its derivatives are not. Then

    tr C^q = sum f(c_i) + sum g[c_i] X_ii + 1/2 sum g[c_i, c_j] X_ij^2 + 1/3 sum g[c_i, c_j, c_k] X_ij X_jk X_ki

with q = alpha/2, f(c) = c^q, g = f' and the divided differences g[...] of g (Daleckii and Krein 1965). This expansion
is exact up to the third derivative.
"""

import math
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from liverjax.core.struct import Number
from liverjax.tensors.material_axes import PAIRS, SIX, rotated, six_of, symmetric
from liverjax.tensors.matrices import Matrix, Vector, determinant, dot, matvec, right_cauchy_green, transpose

#: Number of cyclic Jacobi sweeps. In all tested matrices, the off-diagonal entries were only roundoff after four
#: sweeps.
SWEEPS = 5


class Stretches(NamedTuple):
    """Principal stretches of F. Derivatives treat `logs` as constants, but not `change` and `log_J`."""

    logs: Vector  # ln lambda_m
    change: tuple  # X of the module docstring: the result of the function `change`, in principal axes
    log_J: jax.Array  # ln J; NaN for J < 0, where isochoric stretches do not exist


def principal(F: Matrix) -> tuple[Vector, Matrix]:
    """Return the logarithms ln lambda_m of the principal stretches, and the principal directions as columns of a
    matrix.

    C = F^T F is diagonalised by Jacobi rotations, without LAPACK. The stretches are computed as |F n_m|, with the
    principal directions n_m. So the relative accuracy of a small stretch is good even if other stretches are large.
    """
    F = jax.lax.stop_gradient(F)
    axes = symmetric_axes(right_cauchy_green(F))
    stretched = [matvec(F, n) for n in transpose(axes)]
    return tuple(0.5 * jnp.log(dot(f, f)) for f in stretched), axes


def symmetric_axes(C: Matrix) -> Matrix:
    """Return the eigenvectors of a symmetric matrix as the columns of a rotation."""
    shape, dtype = jnp.shape(C[0][0]), jnp.result_type(C[0][0])
    one, zero = jnp.ones(shape, dtype), jnp.zeros(shape, dtype)
    columns = ((one, zero, zero), (zero, one, zero), (zero, zero, one))
    entries = {ij: jnp.broadcast_to(C[ij[0]][ij[1]], shape) for ij in SIX}

    def sweep(_, carry):
        entries, columns = carry
        for p, q in ((0, 1), (0, 2), (1, 2)):
            entries, columns = _rotate(entries, columns, p, q)
        return entries, columns

    _, columns = jax.lax.fori_loop(0, SWEEPS, sweep, (entries, columns))
    return transpose(columns)


def _rotate(entries: dict, columns: tuple, p: int, q: int) -> tuple[dict, tuple]:
    """Do one Jacobi rotation (Golub and Van Loan, section 8.5) that makes entry (p, q) of the matrix zero."""
    r = 3 - p - q
    rp, rq = (min(r, p), max(r, p)), (min(r, q), max(r, q))
    a, d = entries[p, q], entries[q, q] - entries[p, p]
    denominator = d + jnp.copysign(jnp.sqrt(d * d + 4 * a * a), d)
    t = 2 * a / jnp.where(denominator == 0, 1.0, denominator)
    c = 1 / jnp.sqrt(1 + t * t)
    s = t * c
    new = {
        (p, p): entries[p, p] - t * a,
        (q, q): entries[q, q] + t * a,
        (r, r): entries[r, r],
        (p, q): jnp.zeros_like(a),
        rp: c * entries[rp] - s * entries[rq],
        rq: s * entries[rp] + c * entries[rq],
    }
    turned = list(columns)
    turned[p] = tuple(c * x - s * y for x, y in zip(columns[p], columns[q], strict=True))
    turned[q] = tuple(s * x + c * y for x, y in zip(columns[p], columns[q], strict=True))
    return {ij: new[ij] for ij in SIX}, tuple(turned)


def stretches(F: Matrix) -> Stretches:
    """Return the principal stretches of F, in a form that `power_sum` can differentiate."""
    logs, axes = principal(F)
    X = rotated(symmetric(change(F, 3)), transpose(axes))
    return Stretches(logs, six_of(X), jnp.log(determinant(F)))


def change(F: Matrix, orders: int) -> tuple:
    """Return the six entries of C = F^T F minus their values.

    The results are zeros, but they can be differentiated `orders` times with respect to F.
    """
    C = right_cauchy_green(F)
    return _counted(orders, tuple(C[i][j] for i, j in SIX))


@partial(jax.custom_jvp, nondiff_argnums=(0,))
def _counted(left: int, C: tuple) -> tuple:
    return tuple(jnp.zeros_like(c) for c in C)


@_counted.defjvp
def _(left, primals, tangents):
    one = _counted_one(left - 1, primals[0])
    return _counted(left, *primals), tuple(one * t for t in tangents[0])


@partial(jax.custom_jvp, nondiff_argnums=(0,))
def _counted_one(left: int, C: tuple) -> jax.Array:
    """Return an array of ones with the shape of C[0]. JAX can differentiate it `left` times.

    A further derivative would be wrong, so it raises an error.
    """
    return jnp.ones_like(C[0])


@_counted_one.defjvp
def _(left, primals, tangents):
    if left == 0:
        raise NotImplementedError(
            "derivatives of stretch-based laws with respect to positions exist only up to third order"
        )
    return _counted_one(left, *primals), 0.0 * _counted_one(left - 1, *primals) * sum(tangents[0])


# -- powers -----------------------------------------------------------------------------------------------------------


def power_sum(s: Stretches, alpha: Number) -> jax.Array:
    """Return the sum over m of (J^(-1/3) lambda_m)^alpha, minus 3, without cancellation near the undeformed state."""
    return _power_sum(jnp.asarray(alpha, jnp.result_type(s.log_J)), s.logs, s.change, s.log_J)


@jax.custom_jvp
def _power_sum(alpha, logs, change, log_J):
    return sum(jnp.expm1(alpha * (e - log_J / 3)) for e in logs)


@_power_sum.defjvp
def _(primals, tangents):
    value = _power_sum(*primals)
    return value, jax.jvp(expanded_power_sum, primals, tangents)[1]


_PAIRS_OF_NODES = ((0, 0, 1, 1, 2, 2), (1, 2, 0, 2, 0, 1))  # indices i and j of the divided differences g[i, i, j]


def expanded_power_sum(alpha: Number, logs: Vector, change: tuple, log_J: Any) -> jax.Array:
    """Return the sum over m of (J^(-1/3) lambda_m)^alpha, minus 3, computed with the expansion in the module docstring.

    JAX can differentiate this function with respect to alpha, X (argument `change`) and ln J.

    Divided differences of the same kind are computed as one array. So only a tenth of the operations must be compiled.
    """
    q, log_J0 = alpha / 2, jax.lax.stop_gradient(log_J)
    l = 2 * (jax.lax.stop_gradient(jnp.stack(logs)) - (log_J0 / 3)[None])
    scale = jnp.exp(-2 / 3 * log_J0)
    X = [x * scale for x in change]
    off = dict(zip(PAIRS, X[3:], strict=True))

    def g(*nodes):
        return q * divided_difference(q - 1, *(l[jnp.array(n)] for n in nodes))

    each, (i, j) = (0, 1, 2), _PAIRS_OF_NODES
    g1, gii, giii, gij = g(each), g(each, each), g(each, each, each), g(*zip(*PAIRS, strict=True))
    giij = dict(zip(zip(i, j, strict=True), g(i, i, j), strict=True))
    total = jnp.sum(jnp.exp(q * l), axis=0)
    for m in range(3):
        total = total + X[m] * (g1[m] + X[m] * (gii[m] / 2 + X[m] * giii[m] / 3))
    for k, (m, n) in enumerate(PAIRS):
        total = total + off[m, n] ** 2 * (gij[k] + X[m] * giij[m, n] + X[n] * giij[n, m])
    total = total + 2 * g((0,), (1,), (2,))[0] * off[0, 1] * off[0, 2] * off[1, 2]
    return total * jnp.exp(-alpha / 3 * (log_J - log_J0)) - 3


def divided_difference(p: Number, *logs: Number) -> jax.Array:
    """Return the divided difference of c^p at one, two or three nodes c = exp(log).

    The result is also accurate for nodes that are close to each other or equal.
    """
    if len(logs) == 1:
        return jnp.exp(p * logs[0])
    if len(logs) == 2:
        a, b = logs
        return jnp.exp(0.5 * (p - 1) * (a + b)) * sinh_ratio(p, 0.5 * (a - b))
    low, high = jnp.minimum(jnp.minimum(*logs[:2]), logs[2]), jnp.maximum(jnp.maximum(*logs[:2]), logs[2])
    middle = jnp.maximum(jnp.minimum(*logs[:2]), jnp.minimum(jnp.maximum(*logs[:2]), logs[2]))
    wide = high - low > 0.2
    span = jnp.where(wide, jnp.exp(high) - jnp.exp(low), 1.0)
    far = (divided_difference(p, middle, high) - divided_difference(p, low, middle)) / span
    centre = 0.5 * (low + high)
    return jnp.where(
        wide, far, jnp.exp((p - 2) * centre) * _divided_power(p, [jnp.expm1(x - centre) for x in (low, middle, high)])
    )


def _divided_power(p: Any, y: list) -> Number:
    """Return the divided difference of (1 + c)^p at the three values c in y, with |c| < 0.11.

    It is computed with the binomial series of the power. The neglected terms are of the order 0.11^16 = 5e-16.
    """
    # complete homogeneous symmetric polynomials h_k of y
    homogeneous = [jnp.ones_like(y[0]), *[jnp.zeros_like(y[0])] * 15]
    for node in y:
        for k in range(1, 16):
            homogeneous[k] = homogeneous[k] + node * homogeneous[k - 1]
    binomial, total = p * (p - 1) / 2, 0.0
    for k in range(16):
        total = total + binomial * homogeneous[k]
        binomial = binomial * (p - k - 2) / (k + 3)
    return total


def sinh_ratio(p: Number, delta: Number) -> jax.Array:
    """Return the ratio sinh(p delta) / sinh(delta), which is p at delta = 0."""
    return p * _sinhc(p * delta) / _sinhc(delta)


def _sinhc(x: Number) -> Any:
    """Return sinh(x)/x. For |x| < 1 its power series is used (last coefficient 1/19!)."""
    square = x * x
    near = square < 1
    small: jax.Array = jnp.where(near, square, 0.0)
    series: Number = 0.0
    for k in range(9, -1, -1):
        series = series * small + 1 / math.factorial(2 * k + 1)
    safe = jnp.where(near, 1.0, x)
    return jnp.where(near, series, jnp.sinh(safe) / safe)
