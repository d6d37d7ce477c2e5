"""Selection of points, and of non-negative weights with which these points give the reduced forces of the training
runs.

The contributions of all points to the reduced forces are a matrix G (rows, P). The forces are the sums of its rows. G
is reduced to its largest singular vectors. Then the least-squares problem G xi = G 1 with xi >= 0 is solved by the
method of Lawson and Hanson. Its solution has few entries above 0: at most as many points as singular vectors
(Hernandez, Caicedo, Ferrer 2017).
"""

from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from liverjax.core.errors import InputError
from liverjax.core.struct import replace
from liverjax.elements import mjed
from liverjax.physics.base import End, Free, Step
from liverjax.physics.registry import law_at_rest
from liverjax.physics.viscosity import initial_history
from liverjax.reduced.model import ReducedModel, as_matrix, solid_at_points
from liverjax.reduced.physics.fluid import (
    flowing,
    fluid_at_rest,
    porosity_at_points,
    reduced_sponge,
    storage_and_flow,
    volume_stress,
)
from liverjax.reduced.physics.supports import reduced_springs
from liverjax.reduced.run import prescribed_gradients
from liverjax.scenes.scene import Scene, with_parameters
from liverjax.tensors.matrices import determinant
from liverjax.tensors.principal_fields import principal_fields

#: Maximum number of states with forces that are used: memory and time grow with it.
MOST_STATES = 240
#: A state is left out if its forces cause a motion below this fraction of the largest coordinate: roundoff [1].
LEAST_MOTION = 1e-9


class Coordinates(NamedTuple):
    """Coordinates of R runs of T steps."""

    q: np.ndarray | jax.Array  # of the modes (R, T, n) [m]
    p: np.ndarray | jax.Array | None  # of the modes of the pressure (R, T, m) [Pa]


def sampled(
    whole: ReducedModel, scene: Scene, values: Mapping[str, Any], runs: Coordinates, tolerance: float
) -> ReducedModel:
    """The model with few points, from a model with all points and the coordinates of runs of R rows.

    States at rest are left out. States with an inverted element are left out, too, if the law has no force there.

    Args:
        whole: model from `with_all_points`.
        scene: `Scene`.
        values: dotted names -> values (R, …).
        runs: coordinates of these runs.
        tolerance: fraction of the motions that these forces cause that may be left out [1].
    """
    compliance, rows, q = _reduced_compliance(whole, scene), [], runs.q
    for r, times in states_of(*q.shape[:2]):
        own = with_parameters(scene, {name: jnp.asarray(v[r]) for name, v in values.items()})
        p = None if runs.p is None else jnp.asarray(runs.p[r])
        forces, volumes = _contributions(whole, own, (jnp.asarray(q[r]), p), jnp.asarray(times))
        # Forces are converted to motions, since forces of stiff modes are large but cause little motion.
        G = compliance @ np.asarray(forces)
        size = np.linalg.norm(G.sum(axis=2), axis=1)
        # If the modes invert an element, some laws have no force there. A state at rest has no forces.
        good = np.isfinite(G).all(axis=(1, 2)) & (size > LEAST_MOTION * np.abs(q).max())
        rows.append((G[good] / size[good, None, None]).reshape(-1, whole.weights.size))
        if volumes is not None:
            rows.append(_balances(np.asarray(volumes)[:, good], np.asarray(p)[times[good]]))
    xi = nonnegative_weights(np.concatenate(rows), np.asarray(whole.weights), tolerance)
    points = np.flatnonzero(xi)
    return _at(whole, points, whole.weights[points] * xi[points])


def _balances(volumes: np.ndarray, p: np.ndarray) -> np.ndarray:
    """Rows (…, P) of both sides of the fluid's balance (2, K, m, P), as pressures.

    They are divided by the norm of their sum over the points plus the norm of p (K, m).
    """
    size = np.linalg.norm(volumes[0].sum(axis=2), axis=1) + np.linalg.norm(p, axis=1)
    return (volumes / np.where(size > 0, size, 1.0)[:, None, None]).reshape(-1, volumes.shape[-1])


def _at(whole: ReducedModel, points: np.ndarray, weights: jax.Array) -> ReducedModel:
    """The model at some of its points, with other weights."""
    fluid = whole.pressures
    if fluid is not None:
        fluid = replace(
            fluid, values=fluid.values[points], parts=fluid.parts[:, :, points], slopes=fluid.slopes[:, :, points]
        )
    return replace(whole, slopes=whole.slopes[:, points], weights=weights, points=whole.points[points], pressures=fluid)


def states_of(runs: int, steps: int) -> list[tuple[int, np.ndarray]]:
    """Runs, and for each run the steps of which forces are used.

    The steps are evenly spaced, with another first step in every run. So all times are used, even if each run gives few
    steps: the first steps of a run have no large motion.
    """
    chosen = np.unique(np.linspace(0, runs - 1, min(runs, MOST_STATES)).round().astype(int))
    each = min(steps, max(1, MOST_STATES // len(chosen)))
    golden = 0.5 * (np.sqrt(5) - 1)
    return [
        (int(r), ((np.arange(each) + (k + 1) * golden % 1) / each * steps).astype(int)) for k, r in enumerate(chosen)
    ]


def _reduced_compliance(whole: ReducedModel, scene: Scene) -> np.ndarray:
    """Inverse of the reduced stiffness of the reference shape (n, n) [m/N]."""
    modes = np.asarray(whole.modes).reshape(whole.number_of_modes, -1)
    K = mjed.stiffness_matrix(scene.mesh, law_at_rest(scene), scene.mesh.points)
    springs = reduced_springs(whole.modes, scene)
    return np.linalg.inv(modes @ (K @ modes.T) + (0.0 if springs is None else np.asarray(springs)))


@jax.jit
def _contributions(
    whole: ReducedModel, scene: Scene, run: tuple[jax.Array, jax.Array | None], times: jax.Array
) -> tuple[jax.Array, jax.Array | None]:
    """Contributions of each point to the reduced forces (K, n, P), at some times of a run.

    `run` has its coordinates (T, n) and (T, m). In a porous scene the second result is the one of `_balance`.
    """
    solve, points, solid = scene.solve, scene.mesh.points, solid_at_points(whole, scene)
    F0, (q, p) = prescribed_gradients(whole, scene), run
    step = Step(scene.mesh, points, 1, solve.steps, solve.dt, False, None, Free(jnp.ones_like(points)))
    memory = None if scene.viscosity is None else initial_history(scene.viscosity, whole.weights.size, q.dtype)
    sponge = None if p is None else porosity_at_points(whole, scene)

    def gradient(k: jax.Array) -> jax.Array:
        return F0[k if len(F0) > 1 else 0] + whole.slopes @ q[k]

    def advance(memory: Any, k: jax.Array) -> tuple:
        F = gradient(k)
        acting = solid.freeze(memory, step)
        P = jnp.stack([entry for row in acting.stress(as_matrix(F)) for entry in row])
        if sponge is not None and p is not None:
            P = P + volume_stress(whole, sponge, p[k], F)
        return solid.advance(memory, acting, End(points, as_matrix(F), None)), P

    P: jax.Array
    _, P = jax.lax.scan(advance, memory, jnp.arange(len(q)))
    forces = jnp.einsum("kip,ipn->knp", whole.weights[None, None] * P[times], whole.slopes)
    return forces, None if p is None else _balance(whole, scene, gradient, p, times)


def _balance(
    whole: ReducedModel, scene: Scene, gradient: Callable[[jax.Array], jax.Array], p: jax.Array, times: jax.Array
) -> jax.Array:
    """Contributions of each point to both sides of the fluid's balance, as pressures (2, K, m, P).

    One side is the change of volume, the other one storage and flow.

    Args:
        whole, scene: as in `sampled`.
        gradient: function (number of a step, from 0) -> deformation gradients (9, P) at the end of the step.
        p: coordinates of the pressure (T, m) [Pa].
        times: numbers of K steps.
    """
    sponge, rest, modes = porosity_at_points(whole, scene), fluid_at_rest(whole, scene), whole.pressures
    assert modes is not None
    dt = jnp.asarray(scene.solve.dt)
    inverse = flowing(whole, reduced_sponge(whole, scene), rest, dt).inverse

    def of_step(k: jax.Array) -> jax.Array:
        first, last = k == 0, jnp.maximum(k - 1, 0)
        F, F_before = gradient(k), jnp.where(first, rest.F, gradient(last))
        J, J_before = (determinant(as_matrix(each)) for each in (F, F_before))
        store, flow = storage_and_flow(whole, sponge, F_before, dt)
        more = p[k] - jnp.where(first, rest.pressure, p[last])
        stored = jnp.einsum("kas,as->ks", store, jnp.tensordot(more, store, axes=1))
        flows = jnp.einsum("kas,as->ks", flow, jnp.tensordot(p[k], flow, axes=1))
        change = (whole.weights * (J - J_before))[None] * modes.values.T
        return jnp.stack([inverse @ change, inverse @ (stored + flows)])

    return jnp.moveaxis(jax.lax.map(of_step, times), 0, 1)


def nonnegative_weights(G: np.ndarray, volumes: np.ndarray, tolerance: float) -> np.ndarray:
    """Factors xi (P,) with G xi close to G 1. Few of them are above 0, and the total volume is nearly kept.

    Args:
        G: contributions (rows, P).
        volumes: volumes of the points (P,).
        tolerance: fraction of G that may be left out [1].
    """
    from scipy.optimize import nnls

    if not len(G):
        raise InputError(
            "the runs give no forces from which points can be chosen: give at least two rows with different parameters"
        )
    # The rows have length 1, so small singular vectors have the same weight as large ones.
    V = principal_fields(G, tolerance)
    V = np.concatenate([V, volumes[None] / np.linalg.norm(volumes)])
    return nnls(V, V.sum(axis=1), maxiter=20 * V.shape[1])[0]
