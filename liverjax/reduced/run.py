"""Run a reduced model: loads, initial state, and the loop over the steps (`liverjax.reduced.step`)."""

from collections.abc import Callable
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp

from liverjax.core import status
from liverjax.core.errors import InputError
from liverjax.core.struct import Number, param, replace, struct
from liverjax.mesh.nodal import nodal_volumes
from liverjax.mesh.promotion import on_middles
from liverjax.mesh.tetrahedra import TetMesh
from liverjax.physics.base import End, Free, Step
from liverjax.physics.loads import Loads, dead_loads
from liverjax.physics.prescribed import prescribed
from liverjax.physics.viscosity import initial_history
from liverjax.reduced.correction import correction_at, size_at, stated_at
from liverjax.reduced.model import (
    ReducedModel,
    as_matrix,
    flat_gradient,
    refuse_another_scene,
    refuse_unseen_numbers,
    solid_at_points,
    without_rows,
)
from liverjax.reduced.physics.fluid import (
    ReducedFluid,
    advanced_fluid,
    flowing,
    fluid_at_rest,
    reduced_sponge,
    volume_stress,
)
from liverjax.reduced.physics.supports import forces_of_springs, has_springs, reduced_springs
from liverjax.reduced.step import (
    ReducedEquations,
    ReducedMotion,
    gradients_at,
    reduced_kinematics,
    reduced_noise,
    step_end,
)
from liverjax.reduced.tangent import in_single_precision
from liverjax.scenes.scene import Scene
from liverjax.scenes.scene_checks import check_before_run, check_time_and_mass
from liverjax.tensors.matrices import determinant


@struct
class ReducedResult:
    """Result of a reduced run: arrays over the T steps, for n modes of the motion and m modes of the pressure. The
    function `reduced_positions` returns the motion of the nodes."""

    times: jax.Array = param("s", "end of each step (T,); in a scene without time: number of the load step")
    coordinates: jax.Array = param("m^2.5", "coordinates of the modes (T, n): numbers that multiply the modes")
    status: jax.Array = param("1", "(T,) result codes of `liverjax.core.status`")
    iterations: jax.Array = param("1", "(T,) iterations of Newton's method")
    residual: jax.Array = param("1", "(T,) residual of the reduced equations, divided by the size of all forces")
    pressures: jax.Array | None = param("Pa m^1.5", "coordinates of the pressure modes (T, m)", default=None)
    error: jax.Array | None = param(
        "m", "(T,) estimated maximum distance of a corrected node from the full model; None if unknown", default=None
    )
    reactions: jax.Array | None = param("N", "(T, V, 3), as in the full model; None if error is None", default=None)
    pressure_error: jax.Array | None = param(
        "Pa",
        "(T,) estimated maximum error of the fluid pressure; None if error is None, or without a fluid",
        default=None,
    )


class _Given(NamedTuple):
    """Reduced loads and prescribed motion at the end of each of T steps, for n modes and S points."""

    load: jax.Array  # forces on the modes (T, n) [N m^-1.5]
    gradient: jax.Array  # deformation gradients (T, 9, S) of the prescribed motion; (1, 9, S) without such motion


def _given(model: ReducedModel, scene: Scene) -> tuple[_Given, jax.Array]:
    """Return the reduced loads and the prescribed motion of all steps. The second result is the reduced load (n,)
    [N m^-1.5] on the n modes at the beginning of the run."""
    mesh, solve, body = scene.mesh, scene.solve, scene.body
    weight = {} if body is None else {k: getattr(body, k) for k in ("density", "gravity", "times", "history", "mass")}
    loads = Loads(traction=scene.traction, **weight)
    numbers = jnp.arange(solve.steps + 1, dtype=mesh.points.dtype)

    def reduced(at: Loads) -> jax.Array:
        dead = dead_loads(mesh, at.density, at.gravity, at.traction, at.mass)
        return jnp.tensordot(model.modes, dead, axes=2)

    if loads.history is not None or any(load.history is not None for load in loads.traction):
        all_steps = jax.lax.map(lambda k: reduced(loads.at(k * solve.dt)), numbers)
        first, load = all_steps[0], all_steps[1:]
    else:
        first = reduced(loads)
        parts = numbers[1:] / solve.steps if solve.dt is None else jnp.ones_like(numbers[1:])
        load = parts[:, None] * first[None]

    if scene.displaced and has_springs(scene):
        held = _prescribed_steps(scene)
        load = load - jax.lax.map(lambda u: jnp.tensordot(model.modes, forces_of_springs(scene, u), axes=2), held)
    return _Given(load, prescribed_gradients(model, scene)), first


def _prescribed_steps(scene: Scene) -> jax.Array:
    """Return the prescribed displacements (T, V, 3) [m] at the end of every step."""
    mesh, solve = scene.mesh, scene.solve
    numbers = jnp.arange(1, solve.steps + 1, dtype=mesh.points.dtype)
    times = jnp.zeros_like(numbers) if solve.dt is None else solve.dt * numbers
    return jax.vmap(lambda k, t: prescribed(mesh, scene.displaced, t, k / solve.steps))(numbers, times)


def prescribed_gradients(model: ReducedModel, scene: Scene) -> jax.Array:
    """Return the deformation gradients (T, 9, S) of the prescribed motion at the S points, at the end of each of T
    steps. Without prescribed motion, return unit matrices (1, 9, S)."""
    mesh, solve = scene.mesh, scene.solve

    def moved(k: jax.Array) -> jax.Array:
        time = 0.0 if solve.dt is None else solve.dt * k
        u = prescribed(mesh, scene.displaced, time, k / solve.steps)
        return flat_gradient(mesh, mesh.points + u)[:, model.points]

    if not scene.displaced:  # no prescribed motion
        return jnp.tile(jnp.eye(3, dtype=mesh.points.dtype).reshape(9, 1), len(model.points))[None]
    return jax.lax.map(moved, jnp.arange(1, solve.steps + 1, dtype=mesh.points.dtype))


def _begin(model: ReducedModel, scene: Scene, load: jax.Array) -> tuple:
    """Return the initial state: reduced coordinates, history variables of viscosity, state of the fluid, velocity and
    acceleration, and a zero matrix for the inverse tangent, which is not yet known. The last result is the reduced mass
    matrix (n, n) [kg m^-3] of the n modes.

    Velocity, acceleration and mass are None without inertia. `load` (n,) [N m^-1.5]: reduced load at the beginning.
    """
    n, S = model.number_of_modes, model.weights.shape[0]
    q = jnp.zeros(n, model.modes.dtype)
    inverse = jnp.zeros((n, n), q.dtype)
    memory = None if scene.viscosity is None else initial_history(scene.viscosity, S, q.dtype)
    fluid = None if scene.porosity is None else fluid_at_rest(model, scene)
    if scene.solve.kind != "dynamic" or scene.body is None:
        return q, memory, fluid, None, inverse, None
    mass = reduced_mass(model, scene.mesh, scene.body.density)
    newmark = scene.solve.integrator == "newmark"
    if newmark and fluid is not None and scene.porosity is not None and scene.porosity.initial_pressure is not None:
        load = load - _forces_of_fluid(model, scene, fluid)
    motion = ReducedMotion(q, jnp.linalg.solve(mass, load) if newmark else q, q, jnp.array(False))
    return q, memory, fluid, motion, inverse, mass


def reduced_mass(model: ReducedModel, mesh: TetMesh, density: Number) -> jax.Array:
    """Return the reduced mass matrix (n, n) [kg m^-3] of the n modes, for one density or one per node (V,) [kg/m^3]."""
    given = jnp.asarray(density)
    if given.ndim == 0:  # the mass matrix is a multiple of the identity, because the modes are orthonormal
        return given * jnp.eye(model.number_of_modes, dtype=model.modes.dtype)
    nodal = given * nodal_volumes(mesh)
    return jnp.tensordot(model.modes * nodal[None, :, None], model.modes, axes=((1, 2), (1, 2)))


def _forces_of_fluid(model: ReducedModel, scene: Scene, fluid: ReducedFluid) -> jax.Array:
    """Return the reduced forces (n,) [N m^-1.5] on the n modes due to a given initial pressure (see
    `liverjax.simulation.equations.initial_state`)."""
    stress = volume_stress(model, reduced_sponge(model, scene).porosity, fluid.pressure, fluid.F)
    return jnp.tensordot(model.weights[None] * stress, model.slopes, axes=2)


def _advance(model: ReducedModel, scene: Scene, mass: jax.Array | None) -> Callable:
    """Return a function for one step: (state before the step, loads) -> (state after the step, results of the step).

    The state consists of the reduced coordinates, the history variables of viscosity, the state of the fluid, velocity
    and acceleration, and the inverse tangent.
    """
    solve, solid = scene.solve, solid_at_points(model, scene)
    points = scene.mesh.points
    spread = jax.lax.stop_gradient(jnp.abs(model.slopes)) if scene.displaced else None
    light = in_single_precision(model.slopes)
    steepest = jax.lax.stop_gradient(jnp.linalg.norm(model.slopes))
    noise, sponge = reduced_noise(model, scene), None if scene.porosity is None else reduced_sponge(model, scene)
    springs = reduced_springs(model.modes, scene)
    step = Step(scene.mesh, points, 1, solve.steps, solve.dt, mass is not None, None, Free(jnp.ones_like(points)))

    def advance(carry: tuple, given: tuple) -> tuple:
        q, memory, fluid, motion, inverse = carry
        acting = solid.freeze(memory, step)
        newmark = solve.integrator == "newmark"
        load, gradient = given
        flow = None if sponge is None else flowing(model, sponge, fluid, solve.dt)
        e = ReducedEquations(
            model, acting, load, gradient, mass, q, motion, solve.dt, None, spread, noise, flow, light, steepest
        )._replace(springs=springs)
        found = step_end(newmark, solve.newton_iterations, e, solve.tolerance, inverse)
        e = e._replace(newmark=newmark)
        flat = gradients_at(e, found.q)
        F = as_matrix(flat)
        memory = solid.advance(memory, acting, End(points, F, None))
        motion = None if motion is None else reduced_kinematics(e, found.q)
        fluid = None if flow is None else advanced_fluid(flow, flat)
        code = jnp.where(found.residual <= solve.tolerance, status.CONVERGED, status.STALLED)
        code = jnp.where((code == status.CONVERGED) & (jnp.min(determinant(F)) <= 0), status.INVERTED, code)
        code = jnp.where(jnp.all(jnp.isfinite(found.q)), code, status.NOT_FINITE)
        row = found.q, code, found.iterations, found.residual, None if fluid is None else fluid.pressure
        return (found.q, memory, fluid, motion, found.inverse), row

    return advance


@jax.jit
def _reduced_run(model: ReducedModel, scene: Scene) -> ReducedResult:
    given, load = _given(model, scene)
    *begin, mass = _begin(model, scene, load)
    T = scene.solve.steps
    advance = _advance(model, scene, mass)
    if scene.displaced:
        _, out = jax.lax.scan(advance, tuple(begin), (given.load, given.gradient))
    else:
        F = given.gradient[0]
        _, out = jax.lax.scan(lambda carry, load: advance(carry, (load, F)), tuple(begin), given.load)
    q, code, iterations, residual, p = out
    times = jnp.arange(1, T + 1, dtype=q.dtype) * (1.0 if scene.solve.dt is None else scene.solve.dt)
    took = {"status": code, "iterations": iterations, "residual": residual}
    return ReducedResult(times=times, coordinates=q, pressures=p, **took)


def simulate_reduced(model: ReducedModel, scene: Scene) -> ReducedResult:
    """Run a scene with its reduced model. This function may be used inside jit, grad and vmap.

    Args:
        model: `ReducedModel`, from `reduce_scene` or `load_reduced`.
        scene: the scene for which the model was made. Its loads, its time step, and the parameters of law, regions,
            viscosity, porosity, supports and body may be changed.

    Raises:
        InputError: the model was made for another scene, the scene has numbers that `simulate` does not allow, or a
            time step or a mass is missing.
    """
    refuse_another_scene(model, scene)
    check_before_run(scene)
    check_time_and_mass(scene)
    return _reduced_run(without_rows(model), scene)


def reduced_positions(model: ReducedModel, scene: Scene, result: ReducedResult, corrected: bool = True) -> jax.Array:
    """Return the positions (T, V, 3) [m] of the nodes. `corrected`: whether the learnt correction of the model is
    added.

    Raises:
        InputError: the model was made for another scene.
    """
    refuse_another_scene(model, scene)
    u = _free_motion(model if corrected else replace(model, correction=None), scene, result)
    if scene.displaced:
        u = u + _prescribed_steps(scene)
    return scene.mesh.points[None] + u


def reduced_pressure(model: ReducedModel, scene: Scene, result: ReducedResult) -> jax.Array:
    """Return the fluid pressure (T, V) [Pa] at the nodes of a porous body.

    Raises:
        InputError: the scene has no porosity, or the model was made for another scene.
    """
    refuse_another_scene(model, scene)
    if model.pressures is None or result.pressures is None:
        raise InputError("this reduced model has no pressures, because its scene has no [porosity]")
    return jax.vmap(partial(on_middles, scene.mesh))(result.pressures @ model.pressures.modes)


def _free_motion(model: ReducedModel, scene: Scene, result: ReducedResult) -> jax.Array:
    """Return the displacements (T, V, 3) [m] of the nodes due to the modes and the correction, without the prescribed
    motion."""
    u = jnp.tensordot(result.coordinates, model.modes, axes=1)
    if model.correction is not None:
        u = u + correction_at(model.correction, result.coordinates, scene.solve.dt)
    return u


def stated_error(model: ReducedModel, scene: Scene, result: ReducedResult, corrected: bool = True) -> jax.Array:
    """Estimate the maximum distance (T,) [m] of a node from its position in the full model. The value for a step is the
    maximum over all steps up to this step.

    Unlike `reduced_error`, this function does not solve equations on the full mesh, and it may be used inside jit, grad
    and vmap. The error of the corrected motion is learnt from training runs, by cross-validation. The error of the
    uncorrected motion is larger. It is estimated by the size of the correction. `experiments/TABLES.md` compares the
    two estimates.

    Args:
        model, scene, result: arguments and result of `simulate_reduced`.
        corrected: whether the estimate is for `reduced_positions` with the correction.

    Raises:
        InputError: the model has no correction (too few training runs, or no correction reduced the errors); the scene
            has numbers that do not occur in the training runs (inside jit, grad or vmap this is not checked).
    """
    if model.correction is None:
        raise InputError(
            "this reduced model has no correction: train the model with more runs, or use lj.reduced_error"
        )
    refuse_unseen_numbers(model, scene)
    if not corrected:
        return size_at(model.correction, result.coordinates, scene.solve.dt)
    moved = _free_motion(model, scene, result)
    return stated_at(model.correction, result.coordinates, moved, scene.solve.dt)
