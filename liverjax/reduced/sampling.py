"""Points and weights that give the reduced forces of the training runs, none of them negative.

The contributions of all points to the reduced forces are a matrix G (rows, P); the forces are the sums of its rows.
Weights xi >= 0 with few entries above 0 are the least-squares solution of G xi = G 1 by Lawson and Hanson's method, on
the largest singular vectors of G alone: there are at most as many points as vectors (Hernandez, Caicedo, Ferrer 2017).
"""

from collections.abc import Mapping
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from liverjax.core.struct import replace
from liverjax.elements import mjed
from liverjax.physics.base import End, Free, Step
from liverjax.physics.registry import law_at_rest
from liverjax.physics.viscosity import initial_history
from liverjax.reduced.model import ReducedModel, as_matrix, solid_at_points
from liverjax.reduced.principal_fields import principal_fields
from liverjax.reduced.run import prescribed_gradients
from liverjax.scenes.scene import Scene, with_parameters

#: The most states whose forces are taken: memory and time grow with them.
MOST_STATES = 240
#: States whose forces move less than this part of the largest coordinate are left out: roundoff [1].
LEAST_MOTION = 1e-9


def sampled(
    whole: ReducedModel, scene: Scene, values: Mapping[str, Any], q: jax.Array, tolerance: float
) -> ReducedModel:
    """The model with few points, from one of all points and coordinates q (R, T, n) of runs with R rows of values.

    States are left out if they are at rest, or if an element is inside out there and its law then has no force.

    Args:
        whole: as `with_all_points` makes it.
        scene: `Scene`.
        values: dotted names -> (R, …).
        q: coordinates [m].
        tolerance: part of the motions by these forces that may be left out [1].
    """
    compliance, rows = _reduced_compliance(whole, scene), []
    for r, times in states_of(*q.shape[:2]):
        own = with_parameters(scene, {name: jnp.asarray(v[r]) for name, v in values.items()})
        # As motions: forces of stiff modes are large and move little.
        G = compliance @ np.asarray(_contributions(whole, own, q[r], jnp.asarray(times)))
        size = np.linalg.norm(G.sum(axis=2), axis=1)
        # Where modes alone turn an element inside out, some laws have no force; a state at rest has none to share.
        good = np.isfinite(G).all(axis=(1, 2)) & (size > LEAST_MOTION * np.abs(q).max())
        rows.append((G[good] / size[good, None, None]).reshape(-1, whole.weights.size))
    xi = nonnegative_weights(np.concatenate(rows), np.asarray(whole.weights), tolerance)
    points = np.flatnonzero(xi)
    return replace(
        whole,
        slopes=whole.slopes[:, points],
        weights=whole.weights[points] * xi[points],
        points=whole.points[points],
    )


def states_of(runs: int, steps: int) -> list[tuple[int, np.ndarray]]:
    """Runs, and the steps of each whose forces are used. Steps are evenly spaced and begin at another place in every
    run. So all times are used, also if each run gives few steps; the first steps alone have no large motion.
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
    return np.linalg.inv(modes @ (K @ modes.T))


@jax.jit
def _contributions(whole: ReducedModel, scene: Scene, q: jax.Array, times: jax.Array) -> jax.Array:
    """Contribution of each point to each reduced force along a run, at some times: (K, n, P)."""
    solve, points, solid = scene.solve, scene.mesh.points, solid_at_points(whole, scene)
    F0 = prescribed_gradients(whole, scene)
    step = Step(scene.mesh, points, 1, solve.steps, solve.dt, False, None, Free(jnp.ones_like(points)))
    memory = None if scene.viscosity is None else initial_history(scene.viscosity, whole.weights.size, q.dtype)

    def advance(memory: Any, given: tuple) -> tuple:
        k, own = given
        F = as_matrix(F0[k if len(F0) > 1 else 0] + whole.slopes @ own)
        acting = solid.freeze(memory, step)
        P = jnp.stack([entry for row in acting.stress(F) for entry in row])
        return solid.advance(memory, acting, End(points, F, None)), P

    P: jax.Array
    _, P = jax.lax.scan(advance, memory, (jnp.arange(len(q)), q))
    return jnp.einsum("kip,ipn->knp", whole.weights[None, None] * P[times], whole.slopes)


def nonnegative_weights(G: np.ndarray, volumes: np.ndarray, tolerance: float) -> np.ndarray:
    """Factors xi (P,), few of them above 0, with G xi = G 1 nearly, and the sum of volumes kept.

    Args:
        G: contributions (rows, P).
        volumes: of the points (P,).
        tolerance: part of G that may be left out [1].
    """
    from scipy.optimize import nnls

    # Rows of length 1: small vectors count as much as large ones.
    V = principal_fields(G, tolerance)
    V = np.concatenate([V, volumes[None] / np.linalg.norm(volumes)])
    return nnls(V, V.sum(axis=1), maxiter=20 * V.shape[1])[0]
