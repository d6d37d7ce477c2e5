"""Correction of the error of a reduced model (closure). The error comes from the few modes and the few sampled points.
It is learnt from the full training runs.

The reduced model is run with the parameter sets of its full training runs. The difference between the full and the
reduced motion is approximated by a sum of fields. The coefficient of each field is a polynomial of the reduced
coordinates: linear in all coordinates, and quadratic in the first few coordinates. In scenes with time, the polynomial
also has terms with the time derivatives of the coordinates, and with products of coordinates and time derivatives. The
factors of the terms are found by least squares with a small ridge penalty (closures of reduced models: Ahmed, Pawar,
San, Rasheed, Iliescu, Noack 2021, Phys. Fluids 33, 091301). The differences between full and reduced motion in each run
are divided by the largest displacement of this run.

In a cross-validation, the fit is repeated without one group of runs, for each group. The errors of the left-out runs
determine how many coordinates have quadratic terms. These errors also give a model of the error of the corrected motion
(the stated error). In this model, the logarithm of the relative error is linear in the logarithms of three numbers: the
correction divided by the displacement, the displacement, and the leverage of the terms. These numbers are known without
a full run. The leverage is the variance of the least-squares prediction, divided by the variance of the data (Hoaglin,
Welsch 1978).
"""

from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from liverjax.core.struct import Number, param, static, struct
from liverjax.tensors.principal_fields import principal_fields

#: GROUPS: number of groups of runs in the cross-validation. FEWEST_RUNS: minimum number of runs for a correction.
GROUPS, FEWEST_RUNS = 12, 6
#: PRODUCTS: values that are tried for the number of coordinates with quadratic terms. RATES: maximum number of
#: coordinates that are multiplied by time derivatives.
PRODUCTS, RATES = (0, 6, 12, 20), 8
#: RIDGE: ridge penalty, relative to the mean squares of the terms. OUTSIDE: fraction of the differences between full
#: and reduced motion that the fields may neglect. MOST_FIELDS: maximum number of fields.
RIDGE, OUTSIDE, MOST_FIELDS = 1e-6, 0.02, 150
#: The fields are computed from evenly spaced training states. The number of these states is less than twice this value.
FIELD_STATES = 1500
#: Prior values of the three exponents of the stated error. With few runs, the exponents stay close to these values.
#: With the prior values, the stated error of the motion is a constant times the square root of the leverage.
FEW_RUNS_EXPONENTS = np.array([0.0, -1.0, 0.5])
#: Weight of `FEW_RUNS_EXPONENTS`, expressed as a number of runs.
FEW_RUNS = 10.0


@struct
class Correction:
    """Polynomials with k terms for the coefficients of m fields, and numbers that determine the stated error (see the
    docstring of the module). Both are learnt from R training runs."""

    fields: jax.Array = param("m^-1.5", "(m, V, 3), orthonormal with the nodal volumes as weights")
    factors: jax.Array = param("m^2.5", "factor of each term in the coefficient of each field (k, m)")
    inverse: jax.Array = param("1", "inverse of the normal matrix of the terms (k, k)")
    scale: jax.Array = param("m^2.5", "standard deviation of the first coordinate in the training")
    statement: jax.Array = param("1", "constant and 3 exponents (4,) of the stated error, see `_logarithms`")
    left: jax.Array = param("1", "error of each left-out run, divided by its largest displacement (R,)")
    ratios: jax.Array = param("1", "stated error divided by true error of each left-out run (R,)")
    products: int = static(default=0, about="number of coordinates with quadratic terms")


class Learnt(NamedTuple):
    """R training runs with T steps, from which a correction is learnt. n is the number of reduced coordinates."""

    q: np.ndarray  # coordinates of the reduced runs (R, T, n) [m^2.5]
    missing: np.ndarray  # full minus reduced motion (R, T, V, 3) [m]
    moved: np.ndarray  # largest displacement of each run (R,) [m]
    volumes: np.ndarray  # lumped volumes of the nodes (V,) [m^3]
    dt: Number | None  # time step [s]; None if the scene has no time


def terms(q: jax.Array, scale: Number, products: int, dt: Number | None) -> jax.Array:
    """Return the values (T, k) of the k terms of the polynomial at every step of a run that begins at rest.

    Terms with a time derivative have the unit 1/s, the other terms have the unit 1.

    Args:
        q: the n reduced coordinates at T steps (T, n) [m^2.5].
        scale: standard deviation of the first coordinate in the training [m^2.5].
        products: number of coordinates with quadratic terms.
        dt: time step [s]; None if the scene has no time.
    """
    x = q / scale
    i, j = np.triu_indices(min(products, x.shape[-1]))
    found = [jnp.ones_like(x[:, :1]), x, x[:, i] * x[:, j]]
    if dt is not None:
        rates = jnp.diff(x, axis=0, prepend=jnp.zeros_like(x[:1])) / dt
        few = min(products, RATES, x.shape[-1])
        found += [rates, (x[:, :few, None] * rates[:, None, :few]).reshape(len(x), few * few)]
    return jnp.concatenate(found, axis=1)


def correction_at(own: Correction, q: jax.Array, dt: Number | None) -> jax.Array:
    """Return the correction (T, V, 3) [m] of the node positions at T steps, for the n reduced coordinates q (T, n)
    [m^2.5] and the time step dt [s]."""
    return jnp.tensordot(terms(q, own.scale, own.products, dt) @ own.factors, own.fields, axes=1)


def size_at(own: Correction, q: jax.Array, dt: Number | None) -> jax.Array:
    """For each of T steps, return the largest correction (T,) [m] of a node position up to this step."""
    return jax.lax.cummax(_largest_of_steps(correction_at(own, q, dt)))


def stated_at(own: Correction, q: jax.Array, moved: jax.Array, dt: Number | None) -> jax.Array:
    """Return the stated error (T,) [m] of the corrected motion: an estimate of the maximum distance of a node from its
    position in the full model. The value for a step is the maximum over all steps up to this step.

    Args:
        own: `Correction`.
        q: the n reduced coordinates at T steps (T, n) [m^2.5].
        moved: corrected displacements of the nodes (T, V, 3) [m].
        dt: time step [s]; None if the scene has no time.
    """
    a = terms(q, own.scale, own.products, dt)
    numbers = (
        _largest_of_steps(jnp.tensordot(a @ own.factors, own.fields, axes=1)),
        _largest_of_steps(moved),
        _leverage(a, own.inverse),
    )
    corrected, far, leverage = (jax.lax.cummax(number) for number in numbers)
    still = far == 0
    x = _logarithms(corrected, jnp.where(still, 1.0, far), leverage)
    return jnp.where(still, 0.0, far * jnp.exp(own.statement[0] + x @ own.statement[1:]))


def _largest_of_steps(u: jax.Array) -> jax.Array:
    """Return the maximum length (T,) of the vectors u (T, V, 3) at each step."""
    square = jnp.max(jnp.sum(u**2, axis=-1), axis=-1)
    # The square root has no derivative at 0, so the length 0 is treated separately.
    return jnp.where(square > 0, jnp.sqrt(jnp.where(square > 0, square, 1.0)), 0.0)


def _leverage(a: jax.Array, inverse: jax.Array) -> jax.Array:
    """Return the leverage (T,) [1] of the k terms a (T, k) at T steps: the variance of the least-squares prediction,
    divided by the variance of the data."""
    return jnp.sum((a @ inverse) * a, axis=1)


def _logarithms(corrected: jax.Array, moved: jax.Array, leverage: jax.Array) -> jax.Array:
    """Return three logarithms (R, 3) for R runs or steps: of the correction divided by the displacement, of the
    displacement `moved` [m], and of the leverage. The stated error is computed from these logarithms."""
    tiny = jnp.finfo(moved.dtype).tiny
    return jnp.log(jnp.maximum(jnp.stack([corrected / moved, moved, leverage], axis=1), tiny))


class _LeftOut(NamedTuple):
    """Maxima (R,) over the steps of each of R runs. For each run, the correction is learnt without the group of this
    run."""

    off: np.ndarray  # maximum error [m]
    corrected: np.ndarray  # maximum correction [m]
    leverage: np.ndarray  # maximum leverage [1]


def learnt_correction(runs: Learnt) -> Correction | None:
    """Learn corrections with different numbers of quadratic terms, and return the correction with the smallest errors
    in the left-out runs. Return None if there are too few runs, or if no correction reduces these errors."""
    R = len(runs.q)
    if R < FEWEST_RUNS or not np.any(runs.q):
        return None
    roots = np.sqrt(runs.volumes)[:, None]
    weighted = runs.missing * roots
    fields = _error_fields(weighted.reshape(-1, roots.size * 3))
    parts = weighted.reshape(R, -1, fields.shape[1]) @ fields.T
    scale = float(np.std(runs.q[..., 0])) or 1.0
    group = np.random.default_rng(0).permutation(R) % min(GROUPS, R)
    best, least = None, float(np.median(_farthest(runs.missing) / runs.moved))
    for products in PRODUCTS:
        of_run = partial(terms, scale=scale, products=products, dt=runs.dt)
        A = np.asarray(jax.vmap(of_run)(jnp.asarray(runs.q)))
        if 2 * A.shape[2] > A.shape[0] * A.shape[1]:  # too many terms for this number of training states
            break
        sums = _least_squares(A, parts, runs.moved, group)
        out = _left_out(A, sums, group, runs.missing, fields.reshape(-1, *runs.missing.shape[2:]) / roots)
        if not (middle := float(np.median(out.off / runs.moved))) < least:
            continue
        least = middle
        statement, ratios = _statement(out, runs.moved)
        factors, inverse = sums.without()
        best = Correction(
            fields=jnp.asarray(fields.reshape(-1, *runs.missing.shape[2:]) / roots),
            factors=jnp.asarray(factors),
            inverse=jnp.asarray(inverse),
            scale=jnp.asarray(scale),
            statement=jnp.asarray(statement),
            left=jnp.asarray(out.off / runs.moved),
            ratios=jnp.asarray(ratios),
            products=products,
        )
    return best


def _left_out(
    A: np.ndarray, sums: "_LeastSquares", group: np.ndarray, missing: np.ndarray, fields: np.ndarray
) -> _LeftOut:
    """Return the error, the correction and the leverage of every run. For each run, the correction is learnt without
    the group of this run.

    Args:
        A: values of the k terms of the polynomial in R runs (R, T, k).
        sums: normal equations of each group of runs.
        group: index of the group of each run (R,).
        missing: full minus reduced motion (R, T, V, 3) [m].
        fields: the m fields of the correction (m, V, 3).
    """
    found = np.zeros((3, len(A)))
    for g in range(len(sums.squares)):
        own = group == g
        factors, inverse = sums.without(g)
        correction = np.tensordot(A[own] @ factors, fields, axes=1)
        leverage = np.sum((A[own] @ inverse) * A[own], axis=2).max(axis=1)
        found[:, own] = _farthest(missing[own] - correction), _farthest(correction), leverage
    return _LeftOut(*found)


def _statement(out: _LeftOut, moved: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the constant and the exponents (4,) of the stated error, and the stated error divided by the true error
    (R,) for the R left-out runs.

    The exponents come from a least-squares fit of the logarithms. With few runs the exponents stay close to
    `FEW_RUNS_EXPONENTS`. The constant is chosen for the ratio of the stated error to the true error: the product of the
    1 % and 99 % quantiles of this ratio over the runs is 1.
    """
    x = np.asarray(_logarithms(*(jnp.asarray(a) for a in (out.corrected, moved, out.leverage))))
    y = np.log(np.maximum(out.off / moved, np.finfo(float).tiny)) - x @ FEW_RUNS_EXPONENTS
    middle, size = x.mean(axis=0), np.maximum(x.std(axis=0), 1e-6)
    z = (x - middle) / size
    more = np.linalg.solve(z.T @ z + FEW_RUNS * np.eye(3), z.T @ (y - y.mean())) / size
    low, high = np.quantile(y - x @ more, [0.01, 0.99])
    constant = 0.5 * (low + high)
    return np.concatenate([[constant], FEW_RUNS_EXPONENTS + more]), np.exp(constant + x @ more - y)


def _farthest(u: np.ndarray) -> np.ndarray:
    """Return the maximum length (R,) of the vectors u (R, T, V, 3) in each run."""
    return np.linalg.norm(u, axis=-1).max(axis=(1, 2))


def _error_fields(weighted: np.ndarray) -> np.ndarray:
    """Return m orthonormal fields (m, 3 V) that approximate N differences `weighted` (N, 3 V) between full and
    reduced motion. Fields and differences are multiplied by the square roots of the nodal volumes."""
    return principal_fields(weighted[:: max(1, len(weighted) // FIELD_STATES)], OUTSIDE)[:MOST_FIELDS]


class _LeastSquares(NamedTuple):
    """Normal equations for the factors of k terms in the coefficients of m fields. There is one set of equations for
    each of g groups of runs."""

    squares: np.ndarray  # normal matrices (g, k, k)
    products: np.ndarray  # right-hand sides (g, k, m)
    size: np.ndarray  # root mean square of each term (k,)
    states: int  # number of states in all runs

    def without(self, *groups: int) -> tuple[np.ndarray, np.ndarray]:
        """Return the factors (k, m) from all runs except the given groups, and the inverse (k, k) of the normal matrix
        of the runs that are used."""
        kept = np.setdiff1d(np.arange(len(self.squares)), groups)
        H = self.squares[kept].sum(axis=0) + RIDGE * self.states * np.eye(len(self.size))
        inverse = np.linalg.inv(H) / np.outer(self.size, self.size)
        return np.linalg.solve(H, self.products[kept].sum(axis=0)) / self.size[:, None], inverse


def _least_squares(A: np.ndarray, parts: np.ndarray, moved: np.ndarray, group: np.ndarray) -> _LeastSquares:
    """Return the normal equations of the k terms A (R, T, k) for the coefficients `parts` (R, T, m) of m fields. Each
    of the R runs is weighted by the inverse of its largest displacement `moved` (R,)."""
    size = np.sqrt(np.mean(A**2, axis=(0, 1)))
    size = np.where(size > 0, size, 1.0)
    weight = (1 / moved / np.sqrt(np.mean(1 / moved**2)))[:, None, None]
    squares, products = [], []
    for g in range(group.max() + 1):
        in_group = group == g
        own = (weight[in_group] * A[in_group] / size).reshape(-1, A.shape[2])
        squares.append(own.T @ own)
        products.append(own.T @ (weight[in_group] * parts[in_group]).reshape(-1, parts.shape[2]))
    return _LeastSquares(np.stack(squares), np.stack(products), size, A.shape[0] * A.shape[1])
