"""Estimate the error of a reduced run from the out-of-balance forces on the full mesh.

The equations of the full model are evaluated for the reduced motion, step by step, with the history variables of
viscosity in all elements. The out-of-balance forces r determine the error e of the motion. To first order, e is the
solution of the linearised equations of the body,

    M a(e) + K e - memory(e) = -r,

with the mass matrix M, the acceleration a(e), the stiffness K of the reference shape, and the forces memory(e) of the
history variables. These variables are updated from step to step as in the full model. The matrix of the left-hand side
is factorised once per run. So a step needs the forces of the full mesh and one linear solve, but no Newton iterations.
In statics the energy norm of e is the dual norm of r. The estimate neglects terms of second order in e. Near buckling,
the deformed body is much softer than the reference shape, and K then gives an error that is much too small. So in
statics without a fluid, the response to r is computed twice at the step with the largest error: with the stiffness of
the deformed body, and with the stiffness of the reference shape. If the first response is more than `SOFTER` times as
large, all errors are multiplied by the ratio of the two responses.

In a scene with a porous body, the fluid pressures on the full mesh are computed from the reduced motion. Then the
volume balance of the fluid is fulfilled, and only the forces are out of balance. These forces cause the errors of
motion and pressure (`liverjax.reduced.physics.fluid_error`). The error of the reduced pressure is the reduced pressure
minus the computed pressure, minus the change of pressure due to e.
"""

from collections.abc import Callable
from typing import TYPE_CHECKING, Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from liverjax.core.struct import replace
from liverjax.elements import mjed
from liverjax.laws.base import volumetric_part
from liverjax.mesh.nodal import nodal_volumes
from liverjax.physics.base import End
from liverjax.physics.inertia import FACTOR
from liverjax.physics.registry import law_at_rest
from liverjax.physics.viscosity import coefficients, relaxing
from liverjax.reduced.model import ReducedModel
from liverjax.reduced.physics.fluid_error import ErrorBefore, LinearFluid, coupled_solver, linear_fluid
from liverjax.reduced.physics.supports import has_springs, spring_matrix
from liverjax.reduced.run import ReducedResult, reduced_positions, reduced_pressure
from liverjax.scenes.scene import Scene
from liverjax.simulation.equations import (
    State,
    advanced,
    equations,
    force_sizes,
    forces,
    free_directions,
    initial_state,
    unknowns,
)
from liverjax.simulation.run import prepared

if TYPE_CHECKING:
    import scipy.sparse


#: The errors are multiplied by the result of `_softening` only if this result is above this value (module docstring).
SOFTER = 2.0


class _Body(NamedTuple):
    """Matrices (f, f) of the linear equations for the error, where f is the number of free degrees of freedom."""

    relaxing: jax.Array  # stiffness due to the stress that relaxes [N/m]; without viscosity: due to the whole stress
    rest: Any  # stiffness due to springs and to stress that does not relax [N/m]; None if there is neither
    mass: Any  # diagonal of the mass matrix (f,) [kg]; None without inertia


def reduced_error(model: ReducedModel, scene: Scene, result: ReducedResult) -> ReducedResult:
    """Add to the result the estimated errors (T,) of motion [m] and pressure [Pa], and the reactions (T, V, 3) [N].
    Return the new result.

    `result` must be the result of one run. The function cannot be used inside jit, grad or vmap.

    Args:
        model, scene, result: arguments and result of `simulate_reduced`.
    """
    own = prepared(scene)
    x = reduced_positions(model, scene, result)
    residuals, reactions, P = _out_of_balance(own, x)
    e, p = _errors(own, np.asarray(residuals))
    error = jnp.asarray(np.linalg.norm(e, axis=-1).max(axis=1))
    worst = int(np.argmax(error))
    if own.solve.kind == "static" and P is None:
        larger = _softening(own, np.asarray(residuals[worst]), x[worst])
        error = error * (larger if larger > SOFTER else 1.0)
    if P is None or p is None:
        return replace(result, error=error, reactions=reactions)
    off = np.abs(np.asarray(reduced_pressure(model, scene, result))[:, : P.shape[1]] - np.asarray(P) - p).max(axis=1)
    return replace(result, error=error, reactions=reactions, pressure_error=jnp.asarray(off))


def _softening(scene: Scene, r: np.ndarray, x: jax.Array) -> float:
    """Return a ratio: the largest nodal displacement that the forces r (V, 3) [N] cause with the stiffness at positions
    x (V, 3) [m], divided by the same quantity for the stiffness of the reference shape. Viscosity is not used. The
    ratio is infinite if one of the two stiffness matrices is singular or not finite."""
    from scipy.sparse.linalg import splu

    free = np.flatnonzero(np.asarray(free_directions(scene).mask).ravel())
    springs = spring_matrix(scene)[free][:, free] if has_springs(scene) else 0.0
    sizes = []
    for at in (scene.mesh.points, x):
        K = mjed.stiffness_matrix(scene.mesh, law_at_rest(scene), at)[free][:, free] + springs
        u = np.zeros(r.size)
        try:
            if not np.all(np.isfinite(K.data)):
                return np.inf
            u[free] = splu(K.tocsc()).solve(r.ravel()[free])
        except RuntimeError:  # SciPy's error for a singular matrix
            return np.inf
        sizes.append(float(np.linalg.norm(u.reshape(-1, 3), axis=1).max()))
    return sizes[1] / sizes[0] if sizes[0] > 0 else 1.0


@jax.jit
def _out_of_balance(scene: Scene, x: jax.Array) -> tuple[jax.Array, jax.Array, jax.Array | None]:
    """Return out-of-balance forces (T, V, 3) [N], reactions (T, V, 3) [N] and fluid pressure (T, V) [Pa] of the full
    model for given positions x (T, V, 3) [m].

    The pressure is None if the scene has no fluid.
    """
    sizes = force_sizes(scene)

    def advance(state: State, given: tuple) -> tuple[State, tuple]:
        k, own = given
        e = equations(scene, state, k, sizes)
        f = forces(e, unknowns(e, own), jnp.ones((), own.dtype))
        r = e.free.vectors(f.total, f.x)
        return advanced(e, End(f.x, f.F, f.pressure)), (r, f.total - r, f.pressure)

    numbers = jnp.arange(1, len(x) + 1, dtype=x.dtype)
    found: tuple = jax.lax.scan(advance, initial_state(scene), (numbers, x))[1]
    return found


def _linear_body(scene: Scene, free: np.ndarray) -> _Body:
    mesh, law, prony = scene.mesh, law_at_rest(scene), scene.viscosity

    def stiffness(law: Any) -> jax.Array:
        return mjed.stiffness_matrix(mesh, law, mesh.points)[free][:, free].tocsc()

    rest = None
    if prony is not None and prony.part == "isochoric":
        own = volumetric_part(law)
        rest, law = None if own is None else stiffness(own), relaxing(prony, law)
    if has_springs(scene):  # springs do not relax
        springs = spring_matrix(scene)[free][:, free].tocsc()
        rest = springs if rest is None else rest + springs
    mass = None
    if scene.solve.kind == "dynamic" and scene.body is not None:
        nodal = np.broadcast_to(np.asarray(scene.body.density) * np.asarray(nodal_volumes(mesh)), len(mesh.points))
        mass = np.repeat(nodal, 3)[free]
    return _Body(stiffness(law), rest, mass)


def _errors(scene: Scene, residuals: np.ndarray) -> tuple[np.ndarray, np.ndarray | None]:
    """Return the errors of displacement (T, V, 3) [m] and pressure (T, V) [Pa]: the response of the linearised body to
    the forces -residuals (T, V, 3) [N]. The pressures are None if the scene has no fluid."""
    import scipy.sparse

    free = np.flatnonzero(np.asarray(free_directions(scene).mask).ravel())
    body, dt = _linear_body(scene, free), scene.solve.dt
    fluid = None if scene.porosity is None else linear_fluid(scene, free)
    a, b, c = _recursion(scene)
    factor = FACTOR[scene.solve.integrator]
    inertia = 0.0 if body.mass is None else scipy.sparse.diags(factor / dt**2 * body.mass)
    still = 0.0 if body.rest is None else body.rest
    solve = _solver((1 - a.sum()) * body.relaxing + still + inertia, fluid)
    e, v, acceleration, stress, before = (np.zeros(len(free)) for _ in range(5))
    gamma, p = np.zeros((len(a), len(free))), np.zeros(0 if fluid is None else len(fluid.unknown))
    found = np.zeros((len(residuals), residuals[0].size))
    pressures = None if fluid is None else np.zeros((len(residuals), scene.mesh.number_of_vertices))
    for k, r in enumerate(residuals):
        load = -r.ravel()[free] + b @ gamma + c.sum() * stress
        if body.mass is not None:
            carried = acceleration if scene.solve.integrator == "newmark" else 0.0
            load = load + body.mass * (factor / dt**2 * (e + dt * v) + carried)
        new, p = solve(load, ErrorBefore(e, before, p))
        if body.mass is not None:
            now = factor * ((new - e) / dt - v) / dt - carried
            v = v + 0.5 * dt * (acceleration + now) if scene.solve.integrator == "newmark" else (new - e) / dt
            acceleration = now
        S = np.asarray(body.relaxing @ new)
        gamma = a[:, None] * S + b[:, None] * gamma + c[:, None] * stress
        e, before, stress = new, e, S
        found[k, free] = e
        if fluid is not None and pressures is not None:
            pressures[k, fluid.unknown] = p
    return found.reshape(residuals.shape), pressures


def _solver(
    K: "scipy.sparse.csr_array", fluid: LinearFluid | None
) -> Callable[[np.ndarray, ErrorBefore], tuple[np.ndarray, np.ndarray]]:
    """Return a function that solves the linear equations of one step. With a fluid, it is the function that
    `coupled_solver` returns. Without a fluid, the matrix of the equations is K."""
    from scipy.sparse.linalg import splu

    if fluid is not None:
        return coupled_solver(K, fluid)
    solve = splu(K.tocsc()).solve
    return lambda load, last: (solve(load), last.pressure)


def _recursion(scene: Scene) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the coefficients a, b, c (N,) [1] of the recursion gamma_new = a S + b gamma + c S_before for the history
    variables gamma of N Prony terms.

    S is the stress at the end of the step, and S_before the stress at the beginning of the step. The arrays are empty
    if the scene has no viscosity.
    """
    if scene.viscosity is None:
        return np.zeros(0), np.zeros(0), np.zeros(0)
    a, b, c = coefficients(scene.viscosity, scene.solve.dt)
    return np.asarray(a), np.asarray(b), np.asarray(c)
