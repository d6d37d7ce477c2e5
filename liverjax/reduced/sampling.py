"""Select a few integration points and their non-negative weights, so that they give the reduced forces of the training
runs.

The contributions of all P integration points to the reduced forces form a matrix G. G has one row for each reduced
force in each training state. The sum of the entries in a row is the reduced force. The rows of G are replaced by the
right singular vectors of G that have the largest singular values. Then the factors xi >= 0 of the points are the
least-squares solution of G xi = G 1, where 1 is the vector of ones (method of Lawson and Hanson). One more equation
preserves the total volume. The number of positive factors is at most the number of equations (Hernandez, Caicedo,
Ferrer 2017).
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
from liverjax.physics.inertia import FACTOR
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
from liverjax.reduced.run import prescribed_gradients, reduced_mass
from liverjax.scenes.by_element import by_element
from liverjax.scenes.scene import Scene, with_parameters
from liverjax.tensors.matrices import determinant
from liverjax.tensors.principal_fields import principal_fields

#: Maximum number of training states whose forces are used. The required memory and time increase with this number.
MOST_STATES = 240
#: A state is not used if its size (see `sampled`) is below this fraction [1] of the largest coordinate, because such a
#: motion is roundoff.
LEAST_MOTION = 1e-9


class Coordinates(NamedTuple):
    """Reduced coordinates of R runs with T steps each, for n modes of the motion and m modes of the pressure."""

    q: np.ndarray | jax.Array  # coordinates of the modes (R, T, n) [m^2.5]
    p: np.ndarray | jax.Array | None  # coordinates of the pressure modes (R, T, m) [Pa m^1.5]


def sampled(
    whole: ReducedModel, scene: Scene, values: Mapping[str, Any], runs: Coordinates, tolerance: float
) -> ReducedModel:
    """Select a few points from a model with all points, using the coordinates of R training runs. Return the model with
    these points.

    The size of a state is the norm of the motions that its forces cause, or the norm of its coordinates if this is
    larger. Each row of G is divided by the size of its state. States at rest are not used. States with an inverted
    element are not used if the law has no finite stress there.

    Args:
        whole: model with all points, from `with_all_points`.
        scene: `Scene`.
        values: dotted names of the parameters -> their values in the training runs (R, …).
        runs: coordinates of these runs.
        tolerance: the reduced forces are converted to the motions that they cause. The selected points may neglect this
            fraction of the motions [1].
    """
    compliance, rows, q = _reduced_compliance(whole, scene), [], runs.q
    for r, times in states_of(*q.shape[:2]):
        own = with_parameters(scene, {name: jnp.asarray(v[r]) for name, v in values.items()})
        p = None if runs.p is None else jnp.asarray(runs.p[r])
        forces, volumes = _contributions(whole, own, (jnp.asarray(q[r]), p), jnp.asarray(times))
        # Forces are converted to motions, because forces on stiff modes are large but cause little motion.
        G = compliance @ np.asarray(forces)
        # If only prescribed displacements act, the forces of the points cancel. Then only the coordinates show the size
        # of the motion.
        size = np.maximum(np.linalg.norm(G.sum(axis=2), axis=1), np.linalg.norm(np.asarray(q[r])[times], axis=1))
        # States are not used if some stress is not finite (inverted elements) or if the body is at rest.
        good = np.isfinite(G).all(axis=(1, 2)) & (size > LEAST_MOTION * np.abs(q).max())
        rows.append((G[good] / size[good, None, None]).reshape(-1, whole.weights.size))
        if volumes is not None:
            rows.append(_balances(np.asarray(volumes)[:, good], np.asarray(p)[times[good]]))
    xi = nonnegative_weights(np.concatenate(rows), np.asarray(whole.weights), tolerance)
    points = np.flatnonzero(xi)
    return _at(whole, points, whole.weights[points] * xi[points])


def _balances(volumes: np.ndarray, p: np.ndarray) -> np.ndarray:
    """Return the rows (2 K m, P) of the matrix G for the fluid's volume balance, with K states, m pressure modes and P
    points. `volumes` (2, K, m, P) [Pa m^1.5] contains both sides of the balance (see `_balance`).

    Each row is divided by the scale of its state. The scale is the norm of the pressures due to the change of volume,
    plus the norm of the pressure coordinates p (K, m) [Pa m^1.5].
    """
    size = np.linalg.norm(volumes[0].sum(axis=2), axis=1) + np.linalg.norm(p, axis=1)
    return (volumes / np.where(size > 0, size, 1.0)[:, None, None]).reshape(-1, volumes.shape[-1])


def _at(whole: ReducedModel, points: np.ndarray, weights: jax.Array) -> ReducedModel:
    """Return the model with only some of its points, and with new weights [m^3]."""
    fluid = whole.pressures
    if fluid is not None:
        fluid = replace(
            fluid, values=fluid.values[points], parts=fluid.parts[:, :, points], slopes=fluid.slopes[:, :, points]
        )
    return replace(whole, slopes=whole.slopes[:, points], weights=weights, points=whole.points[points], pressures=fluid)


def states_of(runs: int, steps: int) -> list[tuple[int, np.ndarray]]:
    """Choose the training states whose forces are used. Return a list of (number of a run, numbers of the chosen steps
    of this run).

    The chosen steps of a run are evenly spaced, and the first chosen step differs from run to run. So all times occur,
    even if only few steps of each run are used. The first steps of the runs alone would contain no large motion.
    """
    chosen = np.unique(np.linspace(0, runs - 1, min(runs, MOST_STATES)).round().astype(int))
    each = min(steps, max(1, MOST_STATES // len(chosen)))
    golden = 0.5 * (np.sqrt(5) - 1)
    return [
        (int(r), ((np.arange(each) + (k + 1) * golden % 1) / each * steps).astype(int)) for k, r in enumerate(chosen)
    ]


def _reduced_compliance(whole: ReducedModel, scene: Scene) -> np.ndarray:
    """Return the reduced compliance (n, n) [m^4/N] of n modes: the inverse of the reduced stiffness at the reference
    shape. In dynamics the stiffness includes the inertia in one time step, as in the tangent of a step."""
    modes = np.asarray(whole.modes).reshape(whole.number_of_modes, -1)
    K = mjed.stiffness_matrix(scene.mesh, law_at_rest(by_element(scene)), scene.mesh.points)
    springs = reduced_springs(whole.modes, scene)
    stiffness, solve = modes @ (K @ modes.T) + (0.0 if springs is None else np.asarray(springs)), scene.solve
    if solve.kind == "dynamic" and scene.body is not None:
        mass = np.asarray(reduced_mass(whole, scene.mesh, scene.body.density))
        stiffness = stiffness + FACTOR[solve.integrator] / float(np.asarray(solve.dt)) ** 2 * mass
    return np.linalg.inv(stiffness)


@jax.jit
def _contributions(
    whole: ReducedModel, scene: Scene, run: tuple[jax.Array, jax.Array | None], times: jax.Array
) -> tuple[jax.Array, jax.Array | None]:
    """Return (forces, balance). forces (K, n, P) [N m^-1.5] are the contributions of the P points to the n reduced
    forces at the K steps `times` of a run. balance is the result of `_balance`, or None if the scene has no fluid.

    `run` contains the coordinates of the modes of motion (T, n) [m^2.5] and of the m modes of pressure (T, m)
    [Pa m^1.5].
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
    """Return the contributions of the P points to both sides of the fluid's volume balance at K steps, as coordinates
    (2, K, m, P) [Pa m^1.5] of m pressure modes.

    The first side is the change of volume in a step. The second side is the fluid that is stored or flows away.

    Args:
        whole, scene: the same arguments as for `sampled`.
        gradient: function (number of a step, from 0) -> deformation gradients (9, P) at the end of this step.
        p: coordinates of the pressure (T, m) [Pa m^1.5].
        times: numbers of the K steps.
    """
    sponge, rest, modes = porosity_at_points(whole, scene), fluid_at_rest(whole, scene), whole.pressures
    assert modes is not None
    dt = jnp.asarray(scene.solve.dt)
    inverse = flowing(whole, reduced_sponge(whole, scene), rest, dt).inverse
    rate = jnp.broadcast_to(dt * sponge.permeability, whole.weights.shape)

    def of_step(k: jax.Array) -> jax.Array:
        first, last = k == 0, jnp.maximum(k - 1, 0)
        F, F_before = gradient(k), jnp.where(first, rest.F, gradient(last))
        J, J_before = (determinant(as_matrix(each)) for each in (F, F_before))
        store, slopes = storage_and_flow(whole, sponge, F_before)
        more = p[k] - jnp.where(first, rest.pressure, p[last])
        stored = jnp.einsum("kas,as->ks", store, jnp.tensordot(more, store, axes=1))
        flows = rate[None] * jnp.einsum("kas,as->ks", slopes, jnp.tensordot(p[k], slopes, axes=1))
        change = (whole.weights * (J - J_before))[None] * modes.values.T
        return jnp.stack([inverse @ change, inverse @ (stored + flows)])

    return jnp.moveaxis(jax.lax.map(of_step, times), 0, 1)


def nonnegative_weights(G: np.ndarray, volumes: np.ndarray, tolerance: float) -> np.ndarray:
    """Return non-negative factors xi (P,) of the points, with G xi close to G 1 (symbols: module docstring). Only a
    few factors are above 0, and the total volume is nearly unchanged.

    Args:
        G: contributions of the P points to each reduced force in each state (rows, P).
        volumes: volumes of the points (P,).
        tolerance: fraction of G that may be neglected [1].
    """
    from scipy.optimize import nnls

    if not len(G):
        raise InputError(
            "no state of the training runs has a motion with finite stresses, so no points can be selected: give other "
            "loads or prescribed motions"
        )
    # The rows of V have length 1, so singular vectors with small and with large singular values have the same weight.
    V = principal_fields(G, tolerance)
    V = np.concatenate([V, volumes[None] / np.linalg.norm(volumes)])
    return nnls(V, V.sum(axis=1), maxiter=20 * V.shape[1])[0]
