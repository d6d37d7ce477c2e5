"""What modes and points leave out, learnt from the full runs of the training: a closure of the reduced model.

The reduced model is run with the rows of its training, whose full runs are known. The difference is a sum of fields,
and the part of each field is a polynomial of the coordinates: linear in all, quadratic in the first few. Where there is
time, the rates of the coordinates count too. The numbers are those of least squares with a small ridge (closures of
reduced models: Ahmed, Pawar, San, Rasheed, Iliescu, Noack 2021, Phys. Fluids 33, 091301).

Groups of runs are left out in turn. The errors of these runs decide how many coordinates have products. Each group left
out gives other polynomials. The difference between their answers, times a factor found from the runs left out,
estimates the error of the corrected motion (the jackknife; Tukey 1958).
"""

from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from liverjax.core.struct import Number, param, static, struct

#: Groups of runs that are left out in turn, and the fewest runs that are corrected.
GROUPS, FEWEST_RUNS = 6, 6
#: Numbers of coordinates that have products; as many as `RATES` have products with rates.
PRODUCTS, RATES = (0, 6, 12, 20), 8
#: The ridge over the squares of the features; part of the differences outside of the fields, and the most fields.
RIDGE, OUTSIDE, MOST_FIELDS = 1e-6, 0.02, 150
#: Part of the runs left out whose errors the stated ones are above.
ABOVE = 0.9
#: The most differences from which fields are made.
FIELD_STATES = 1500


@struct
class Correction:
    """Polynomials with k terms for m fields, and the g that were made without a group of runs."""

    fields: jax.Array = param("1", "(m, V, 3), orthonormal with the lumped volumes of the nodes")
    factors: jax.Array = param("m^2.5", "of every term in every field (k, m)")
    committee: jax.Array = param("m^2.5", "the same without each group of runs (g, k, m)")
    scale: jax.Array = param("m", "size of the first coordinate")
    effectivity: jax.Array = param("1/m^1.5", "largest error of a node over the committee's spread")
    left: jax.Array = param("1", "error of each run left out, over its largest displacement (R,)")
    products: int = static(default=0, about="number of coordinates that have products")


class Learnt(NamedTuple):
    """Runs that a correction is learnt from."""

    q: np.ndarray  # coordinates of the reduced runs (R, T, n) [m]
    missing: np.ndarray  # full minus reduced motion (R, T, V, 3) [m]
    moved: np.ndarray  # largest displacement of each run (R,) [m]
    volumes: np.ndarray  # of the nodes (V,) [m^3]
    dt: Number | None  # [s], None without time


def terms(q: jax.Array, scale: Number, products: int, dt: Number | None) -> jax.Array:
    """The polynomial's terms at coordinates q (T, n) of a run from rest: (T, k)."""
    x = q / scale
    i, j = np.triu_indices(min(products, x.shape[-1]))
    found = [jnp.ones_like(x[:, :1]), x, x[:, i] * x[:, j]]
    if dt is not None:
        rates = jnp.diff(x, axis=0, prepend=jnp.zeros_like(x[:1])) / dt
        few = min(products, RATES, x.shape[-1])
        found += [rates, (x[:, :few, None] * rates[:, None, :few]).reshape(len(x), few * few)]
    return jnp.concatenate(found, axis=1)


def correction_at(own: Correction, q: jax.Array, dt: Number | None) -> jax.Array:
    """What is added to the motion of the nodes: (T, V, 3) [m]."""
    return jnp.tensordot(terms(q, own.scale, own.products, dt) @ own.factors, own.fields, axes=1)


def stated_at(own: Correction, q: jax.Array, dt: Number | None) -> jax.Array:
    """Stated largest distance of a node from the full model after the correction: (T,) [m]."""
    return own.effectivity * jackknife(terms(q, own.scale, own.products, dt), own.committee - own.factors[None])


def learnt_correction(runs: Learnt) -> Correction | None:
    """The correction with the smallest errors in the runs left out; None if runs are too few or no correction helps."""
    R = len(runs.q)
    if R < FEWEST_RUNS or not np.any(runs.q):
        return None
    roots = np.sqrt(runs.volumes)[:, None]
    weighted = runs.missing * roots
    fields = _error_fields(weighted.reshape(-1, roots.size * 3))
    parts = weighted.reshape(R, -1, fields.shape[1]) @ fields.T
    scale = float(np.std(runs.q[..., 0])) or 1.0
    group = np.random.default_rng(0).permutation(R) % GROUPS
    best, least = None, float(np.median(_farthest(runs.missing) / runs.moved))
    for products in PRODUCTS:
        of_run = partial(terms, scale=scale, products=products, dt=runs.dt)
        A = np.asarray(jax.vmap(of_run)(jnp.asarray(runs.q)))
        if 2 * A.shape[2] > A.shape[0] * A.shape[1]:  # more terms than half of the states tell nothing
            break
        sums = _least_squares(A, parts, group)
        committee = np.stack([sums.without(g) for g in range(GROUPS)])
        guess = np.stack([a @ committee[g] for a, g in zip(A, group, strict=True)])
        off = _farthest(runs.missing - (guess @ fields).reshape(runs.missing.shape) / roots)
        if not (middle := float(np.median(off / runs.moved))) < least:
            continue
        ratios = off / np.maximum(_spreads(A, sums, committee, group), 1e-300)
        least = middle
        best = Correction(
            fields=jnp.asarray(fields.reshape(-1, *runs.missing.shape[2:]) / roots),
            factors=jnp.asarray(sums.without()),
            committee=jnp.asarray(committee),
            scale=jnp.asarray(scale),
            effectivity=jnp.asarray(np.quantile(ratios, ABOVE)),
            left=jnp.asarray(off / runs.moved),
            products=products,
        )
    return best


def _farthest(u: np.ndarray) -> np.ndarray:
    """Largest length of vectors (R, T, V, 3) of each run (R,)."""
    return np.linalg.norm(u, axis=-1).max(axis=(1, 2))


def _error_fields(weighted: np.ndarray) -> np.ndarray:
    """Orthonormal fields (m, 3 V) of differences (N, 3 V), both times the roots of the volumes."""
    some = weighted[:: max(1, len(weighted) // FIELD_STATES)]
    size, vectors = np.linalg.eigh(some @ some.T)
    size, vectors = np.maximum(size[::-1], 0.0), vectors[:, ::-1]
    outside = np.sqrt(np.maximum(size.sum() - np.cumsum(size), 0.0) / size.sum())
    m = min(int(np.sum(outside > OUTSIDE)) + 1, int(np.sum(size > 1e-12 * size[0])), MOST_FIELDS)
    return np.linalg.qr((vectors[:, :m].T @ some).T)[0].T


class _LeastSquares(NamedTuple):
    """Normal equations of factors, one set a group of runs."""

    squares: np.ndarray  # (g, k, k)
    products: np.ndarray  # (g, k, m)
    size: np.ndarray  # of the terms (k,)
    states: int

    def without(self, *groups: int) -> np.ndarray:
        """Factors (k, m) from all runs but those of some groups."""
        kept = np.setdiff1d(np.arange(GROUPS), groups)
        H = self.squares[kept].sum(axis=0) + RIDGE * self.states * np.eye(len(self.size))
        return np.linalg.solve(H, self.products[kept].sum(axis=0)) / self.size[:, None]


def _least_squares(A: np.ndarray, parts: np.ndarray, group: np.ndarray) -> _LeastSquares:
    """Of terms A (R, T, k) and parts (R, T, m) of runs in groups (R,)."""
    size = np.sqrt(np.mean(A**2, axis=(0, 1)))
    size = np.where(size > 0, size, 1.0)
    squares, products = [], []
    for g in range(GROUPS):
        own, y = (A[group == g] / size).reshape(-1, A.shape[2]), parts[group == g].reshape(-1, parts.shape[2])
        squares.append(own.T @ own)
        products.append(own.T @ y)
    return _LeastSquares(np.stack(squares), np.stack(products), size, A.shape[0] * A.shape[1])


def _spreads(A: np.ndarray, sums: _LeastSquares, committee: np.ndarray, group: np.ndarray) -> np.ndarray:
    """Largest spread along each run (R,) [m^2.5] of the polynomials made without its group, and without a second group
    too."""
    found = np.zeros(len(A))
    for g in range(GROUPS):
        apart = np.stack([sums.without(g, other) - committee[g] for other in range(GROUPS) if other != g])
        for r in np.flatnonzero(group == g):
            found[r] = float(jackknife(jnp.asarray(A[r]), jnp.asarray(apart)).max())
    return found


def jackknife(a: jax.Array, apart: jax.Array) -> jax.Array:
    """Standard error (T,) of polynomials with terms a (T, k), from those without a group less the whole (g, k, m)."""
    off = jnp.sum(jnp.einsum("tk,gkm->gtm", a, apart) ** 2, axis=2)
    return jnp.sqrt((len(apart) - 1) * jnp.mean(off, axis=0))
