"""A static displacement as a sum of products. Each product is a field in space times one function of each parameter:

    u(x, p_1 ... p_n) = sum over m of w_m(x) f_m1(p_1) ... f_mn(p_n)

This is the form of proper generalised decomposition (chapter, section 3.3; Chinesta, Ladeveze, Cueto 2011, Arch.
Comput. Methods Eng. 18, 395). The equations of soft tissue cannot be separated into such products. So the terms are
computed from full runs at the points of a parameter grid. The terms are found one after another. Each term is fitted by
alternating least squares to the residual of the earlier terms. After each term all fields w_m are computed again by
least squares. The functions f of a parameter are sums of Chebyshev polynomials.
"""

import itertools
from collections.abc import Mapping
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from liverjax.core import status
from liverjax.core.errors import InputError
from liverjax.core.struct import param, replace, static, struct
from liverjax.mesh.nodal import nodal_volumes
from liverjax.reduced.training import refuse_rest
from liverjax.scenes.checks.numbers import check_numbers
from liverjax.scenes.scene import Scene, numbers_at, with_parameters
from liverjax.simulation.batch import simulate_batch

#: Maximum number of parameters, and maximum number of runs of the grid.
MOST_PARAMETERS, MOST_RUNS = 4, 2000
#: SWEEPS: maximum number of iterations of alternating least squares for a term. SETTLED: the iterations end if the
#: relative change of the norm of the term is at most this value.
SWEEPS, SETTLED = 50, 1e-6


@struct
class SeparatedModel:
    """The M terms of a static displacement that depends on n parameters."""

    fields: jax.Array = param("m", "fields w_m of the M terms (M, V, 3)")
    functions: tuple[jax.Array, ...] = param("1", "for each parameter, coefficients of k Chebyshev polynomials (M, k)")
    ranges: jax.Array = param("1", "lowest and highest value of each parameter (n, 2)")
    left_out: jax.Array = param(
        "1",
        "displacements that the terms do not describe, divided by all displacements (root mean square over nodes, "
        "weighted by volume, and over all runs of the grid)",
    )
    error: jax.Array = param(
        "1", "(c,) maximum error of a node divided by the largest displacement, in c runs not on the grid"
    )
    names: tuple[str, ...] = static(default=(), about="dotted names of the parameters")


def separate(
    scene: Scene,
    ranges: Mapping[str, tuple[float, float]],
    points: int = 5,
    tolerance: float = 1e-4,
    most_terms: int = 50,
    checks: int = 8,
) -> SeparatedModel:
    """Compute the displacement of a static scene as a sum of products, and the error of this sum for parameters that
    are not grid points.

    Args:
        scene: `Scene` without time. The displacement at the last load step is used.
        ranges: dotted names of one to four single numbers (see `with_parameters`) -> lowest and highest value.
        points: number of grid points for each parameter. For n parameters this needs points ** n full runs.
        tolerance: fraction of the displacements at the grid that the terms may neglect.
        most_terms: maximum number of terms.
        checks: number of runs at random parameters (seed 0) from which the error is computed.

    Raises:
        InputError: the scene has a time step, a range cannot be used, too many runs are needed, or a run did not
            converge, or no run of the grid moves the body.
    """
    names, limits = _names_and_limits(scene, ranges, points)
    t = np.cos(np.pi * (np.arange(points) + 0.5) / points)  # Chebyshev points in (-1, 1)
    axes = [low + (high - low) * 0.5 * (1 + t) for low, high in limits]
    grid = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, len(names))
    between = limits[:, 0] + np.random.default_rng(0).random((checks, len(names))) * np.ptp(limits, axis=1)
    u = _displacements(scene, names, np.concatenate([grid, between]))
    refuse_rest(scene, u[: len(grid)])
    roots = np.sqrt(np.repeat(np.asarray(nodal_volumes(scene.mesh)), 3))
    known, unseen = u[: len(grid)].reshape(len(grid), -1) * roots, u[len(grid) :]
    shape = (points,) * len(names)
    products, factors, left = _terms(known, shape, tolerance, most_terms)
    fields = np.linalg.lstsq(products, known, rcond=None)[0] / roots
    inverse = np.linalg.inv(np.polynomial.chebyshev.chebvander(t, points - 1))
    found = SeparatedModel(
        fields=jnp.asarray(fields.reshape(-1, *scene.mesh.points.shape)),
        functions=tuple(jnp.asarray(f @ inverse.T) for f in factors),
        ranges=jnp.asarray(limits),
        left_out=jnp.asarray(left),
        error=jnp.zeros(0),
        names=names,
    )
    at = {name: jnp.asarray(between[:, k]) for k, name in enumerate(names)}
    off = np.linalg.norm(np.asarray(jax.vmap(lambda p: separated_displacement(found, p))(at)) - unseen, axis=-1)
    largest = np.linalg.norm(unseen, axis=-1).max(axis=1)
    return replace(found, error=jnp.asarray(off.max(axis=1) / np.where(largest > 0, largest, 1.0)))


def separated_displacement(model: SeparatedModel, values: Mapping[str, Any]) -> jax.Array:
    """Return the displacements (V, 3) [m] of the model. `values`: dotted name of each parameter -> one value.

    The function may be used inside jit, grad and vmap. In these transformations, a value outside of the model's range
    gives NaN for the displacements and their derivatives.

    Raises:
        InputError: a parameter has no value, a name is not a parameter of the model, or a value is outside of the
            model's range.
    """
    wrong = sorted(set(model.names) ^ set(values))
    if wrong:
        raise InputError(
            f"the parameters of this model are {', '.join(model.names)}: add or remove the value of {wrong[0]}"
        )
    product = jnp.ones(model.fields.shape[0], model.fields.dtype)
    for name, function, (low, high) in zip(model.names, model.functions, model.ranges, strict=True):
        value = jnp.asarray(values[name], model.fields.dtype)
        if not isinstance(value, jax.core.Tracer) and not low <= value <= high:
            raise InputError(
                f"{name} = {float(value):g} is outside of the training range {float(low):g} to {float(high):g}: make "
                "the model with a wider range"
            )
        # Polynomials grow fast outside of the range, so values and derivatives would be wrong there.
        value = value * jnp.where((low <= value) & (value <= high), 1.0, jnp.nan)
        product = product * (function @ _chebyshev(2 * (value - low) / (high - low) - 1, function.shape[1]))
    return jnp.tensordot(product, model.fields, axes=1)


def _chebyshev(t: jax.Array, number: int) -> jax.Array:
    """Return the values (number,) of the first `number` Chebyshev polynomials at t."""
    out = [jnp.ones_like(t), t]
    for _ in range(number - 2):
        out.append(2 * t * out[-1] - out[-2])
    return jnp.stack(out[:number])


def _names_and_limits(
    scene: Scene, ranges: Mapping[str, tuple[float, float]], points: int
) -> tuple[tuple[str, ...], np.ndarray]:
    """Check the ranges. Return the names and the limits (n, 2) of the parameters."""
    if scene.solve.kind != "static" or scene.solve.dt is not None:
        raise InputError("a separated form needs a static solution: give a scene of kind 'static' without dt")
    if scene.points_are == "loaded":
        raise InputError('[mesh] is = "loaded" cannot have a separated form: use the scene of lj.unloaded(scene)')
    if not 1 <= len(ranges) <= MOST_PARAMETERS:
        raise InputError(f"ranges has {len(ranges)} parameters: give 1 to {MOST_PARAMETERS}")
    if points < 2 or points ** len(ranges) > MOST_RUNS:
        raise InputError(
            f"points = {points} needs {points ** len(ranges)} runs: give at least 2 points, and few enough that "
            f"at most {MOST_RUNS} runs are needed"
        )
    for name, limits in ranges.items():
        if np.ndim(numbers_at(scene, name)) != 0:
            raise InputError(f"{name} is a list of numbers: name one of these numbers, e.g. {name}.0")
        if np.shape(limits) != (2,) or not np.all(np.isfinite(limits)) or not limits[0] < limits[1]:
            raise InputError(f"ranges[{name!r}] = {limits!r} is not a range: give the lowest and the highest value")
    for corner in itertools.product(*ranges.values()):
        at = {name: float(value) for name, value in zip(ranges, corner, strict=True)}
        try:
            check_numbers(with_parameters(scene, at))
        except InputError as error:
            where = ", ".join(f"{name} = {value:g}" for name, value in at.items())
            raise InputError(f"the ranges contain {where}: {error}") from None
    return tuple(ranges), np.array([ranges[name] for name in ranges], float)


def _displacements(scene: Scene, names: tuple[str, ...], rows: np.ndarray) -> np.ndarray:
    """Return the displacements (N, V, 3) [m] of the full model at the last step, for N parameter sets `rows` (N, n)."""
    result = simulate_batch(scene, {name: rows[:, k] for k, name in enumerate(names)}).result
    bad = np.flatnonzero(np.any(np.asarray(result.status) != status.CONVERGED, axis=1))
    if len(bad):
        at = ", ".join(f"{name} = {value:.4g}" for name, value in zip(names, rows[bad[0]], strict=True))
        code = int(status.most_severe(result.status[bad[0]]))
        raise InputError(
            f"{len(bad)} of {len(rows)} runs failed, first at {at}: {status.advice(code)}; narrow the ranges"
        )
    return np.asarray(result.positions[:, -1] - scene.mesh.points[None])


def _terms(
    known: np.ndarray, shape: tuple[int, ...], tolerance: float, most: int
) -> tuple[np.ndarray, list[np.ndarray], float]:
    """Return (products, factors, left). products (N, M): product of the functions of each term, at the N grid points;
    factors: values (M, points) of these functions for each parameter; left: fraction of the displacements that
    the terms do not describe.

    Args:
        known: displacements at the grid (N, 3 V), times the square roots of the nodal volumes.
        shape: shape of the grid.
        tolerance, most: `tolerance` and `most_terms` of `separate`.
    """
    # The displacements of the N runs are expressed in a basis of their span, so each run has at most N coordinates.
    U, S, _ = np.linalg.svd(known, full_matrices=False)
    data = U * S
    size, left = np.linalg.norm(data), data
    factors: list[list[np.ndarray]] = [[] for _ in shape]
    products = np.zeros((len(data), 0))
    while len(factors[0]) < most and np.linalg.norm(left) > tolerance * size:
        own = _rank_one(left.reshape(*shape, -1))
        for kept, f in zip(factors, own, strict=True):
            kept.append(f)
        product = own[0]
        for f in own[1:]:
            product = np.multiply.outer(product, f)
        products = np.column_stack([products, product.ravel()])
        left = data - products @ np.linalg.lstsq(products, data, rcond=None)[0]
    return products, [np.array(f) for f in factors], float(np.linalg.norm(left) / size)


def _rank_one(tensor: np.ndarray) -> list[np.ndarray]:
    """Find the rank-one tensor that is closest to a given tensor. A rank-one tensor is a product of one vector for each
    axis. Return the unit vectors of all axes except the last."""
    n = tensor.ndim
    # For each axis, the tensor is unfolded to a matrix with one row per index of this axis. The iteration begins with
    # the first left singular vectors of these matrices.
    factors = [np.linalg.svd(np.moveaxis(tensor, a, 0).reshape(tensor.shape[a], -1))[0][:, 0] for a in range(n - 1)]
    last, size = tensor.shape[-1], 0.0
    w = np.zeros(last)
    for _ in range(SWEEPS):
        before = size
        w = _against(tensor, [*factors, None])
        w = w / max(float(np.linalg.norm(w)), 1e-300)
        for a in range(n - 1):
            f = _against(tensor, [*(None if b == a else factors[b] for b in range(n - 1)), w])
            size = float(np.linalg.norm(f))
            factors[a] = f / max(size, 1e-300)
        if abs(size - before) <= SETTLED * size:
            break
    return factors


def _against(tensor: np.ndarray, factors: list[np.ndarray | None]) -> np.ndarray:
    """Return the contraction of a tensor with one vector for each axis. Axes with None are not contracted."""
    out = tensor
    for a in reversed(range(tensor.ndim)):
        f = factors[a]
        if f is not None:
            out = np.tensordot(out, f, axes=(a, 0))
    return out
