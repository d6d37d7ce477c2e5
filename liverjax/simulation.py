"""Run a scene: load steps or time steps, each a Newton solve with implicit differentiation."""

from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from liverjax import boundary, continuation, mjed, porosity, status, tangent, terms, viscosity
from liverjax.continuation import StepOptions, StepStatistics
from liverjax.errors import InputError
from liverjax.kinematics import add_matrices, deformation_gradient, determinant
from liverjax.scene import Scene, check_choices
from liverjax.struct import param, struct


@struct
class Result:
    """What a run leaves; arrays over the T steps, all of them differentiable but the statistics."""

    times: jax.Array = param("s", "(T,); the number of the load step where there is no time")
    positions: jax.Array = param("m", "(T, V, 3)")
    reactions: jax.Array = param("N", "(T, V, 3), force of the support on the body, 0 where nothing is prescribed")
    status: jax.Array = param("1", "(T,) result codes of `liverjax.status`")
    pressure: jax.Array | None = param("Pa", "(T, V), of a porous scene", default=None)
    statistics: StepStatistics = param("1", "per step: Newton and CG iterations, cuts, residual")

    def check(self) -> "Result":
        """The result itself, or `RuntimeError` with advice where a step failed; host side."""
        codes = np.asarray(self.status)
        if np.any(codes != status.CONVERGED):
            step = int(np.argmax(codes != status.CONVERGED))
            raise RuntimeError(f"step {step + 1}: {status.advice(codes.ravel()[step])}")
        return self


class State(NamedTuple):
    """What a step hands to the next; parts that the scene lacks are None."""

    x: jax.Array  # (V, 3) [m]
    velocity: jax.Array | None  # dynamic
    acceleration: jax.Array | None  # Newmark
    history: viscosity.History | None  # viscosity
    fluid: porosity.Fluid | None  # porosity


def initial_state(scene: Scene) -> State:
    """At rest in the reference positions."""
    x = scene.mesh.points
    dynamic = scene.solve.kind == "dynamic"
    acceleration = None
    if dynamic and scene.solve.integrator == "newmark":
        # m a = f at rest: Newmark's method keeps its order from the first step.
        mass = scene.body.density * boundary.nodal_volumes(scene.mesh)
        mask = boundary.free_degrees(scene.mesh, scene.fixed, scene.displaced)
        follower = boundary.follower_forces(scene.traction, x)
        acceleration = mask * (_loads(scene) + follower) / mass[:, None]
    history = None
    if scene.viscosity is not None:
        history = viscosity.initial_history(scene.viscosity, scene.mesh.number_of_elements, x.dtype)
    fluid = None if scene.porosity is None else porosity.initial_fluid(scene.porosity, scene.mesh)
    return State(x, jnp.zeros_like(x) if dynamic else None, acceleration, history, fluid)


def _loads(scene: Scene) -> jax.Array:
    """Dead nodal forces (V, 3) [N]: weight and tractions."""
    force = jnp.zeros(scene.mesh.points.shape, scene.mesh.points.dtype)
    if scene.body is not None:
        mass = scene.body.density * boundary.nodal_volumes(scene.mesh)
        force = force + mass[:, None] * jnp.asarray(scene.body.gravity, force.dtype)[None]
    return force + boundary.nodal_tractions(scene.mesh, scene.traction) if scene.traction else force


def unit_strain_force(scene: Scene) -> jax.Array:
    """Size [N] of the nodal forces of a stretch along x, per unit strain, at rest: roundoff is a part of it."""
    mesh, law = scene.mesh, porosity.law_in_force(scene.porosity, scene.law)
    along = mesh.points * jnp.array([[1.0, 0.0, 0.0]], mesh.points.dtype)
    force = jax.jvp(lambda x: mjed.internal_force(mesh, law, x), (mesh.points,), (along,))[1]
    return jax.lax.stop_gradient(jnp.linalg.norm(force))


def step(scene: Scene, state: State, k: Any, stiff: Any | None = None) -> tuple[State, jax.Array, StepStatistics]:
    """Step k = 1 … steps: the next state, the reactions (V, 3) [N] and what the solve took.

    `stiff` is `unit_strain_force(scene)`, the same for every step.
    """
    stiff = unit_strain_force(scene) if stiff is None else stiff
    mesh, sponge, solve = scene.mesh, scene.porosity, scene.solve
    law = porosity.law_in_force(sponge, scene.law)
    dtype = mesh.points.dtype
    dt = solve.dt
    mask = boundary.free_degrees(mesh, scene.fixed, scene.displaced)
    loads = _loads(scene)
    memory = None if scene.viscosity is None else viscosity.recall(scene.viscosity, state.history, dt)
    mass = scene.body.density * boundary.nodal_volumes(mesh) if state.velocity is not None else None
    moving, follows = len(scene.displaced) > 0, boundary.follows(scene.traction)
    ramped = dt is None
    # Below this, forces are roundoff: an unloaded equilibrium has converged.
    noise = 20 * float(np.finfo(np.float64).eps) / solve.tolerance * stiff
    flow = None
    if sponge is not None:
        F_begin = deformation_gradient(mesh, state.x)
        flow = porosity.flow(sponge, mesh, state.fluid, F_begin, dt, 1e-2 * solve.tolerance)

    def fluid_pressure(F):
        return porosity.pressure(sponge, mesh, state.fluid, flow, determinant(F))

    # The chapter's pressure does not depend on where the step ends: solved for once.
    known = None if sponge is None or sponge.scheme == "implicit" else fluid_pressure(F_begin)

    def acting(s):
        """Part of the loads that acts: they grow with the load steps, or quasi-statically within the first step."""
        if ramped:
            return (k - 1 + s) / solve.steps
        return jnp.ones((), dtype) if mass is not None else jnp.where(k == 1, s, 1.0).astype(dtype)

    def conditions(s):
        """Positions of held degrees of freedom (V, 3), 0 elsewhere, and dead loads at part s of the step."""
        held = mesh.points
        if moving:
            # Straight from beginning to end: a history may bend within the step, and only its end counts.
            before, after = (
                boundary.prescribed(mesh, scene.displaced, 0.0 if dt is None else dt * n, n / solve.steps)
                for n in (k - 1, k)
            )
            held = held + before + s * (after - before)
        return (1 - mask) * held, acting(s) * loads

    def positions(q, s):
        return mask * q.reshape(-1, 3) + conditions(s)[0]

    def forces(q, s):
        """Internal, inertial and outer forces (V, 3), and the fluid's pressure."""
        x = positions(q, s)
        F = deformation_gradient(mesh, x)
        P = terms.first_piola(law, F) if memory is None else viscosity.first_piola(scene.viscosity, memory, law, F)
        fluid = None
        if sponge is not None:
            fluid = fluid_pressure(F) if known is None else known
            P = add_matrices(P, porosity.first_piola(sponge, mesh, fluid, F))
        internal = mjed.nodal_force(mesh, P)
        inertial = None if mass is None else mass[:, None] * _motion(solve.integrator, state, x, dt, mask)[1]
        outer = conditions(s)[1]
        if follows:
            outer = outer + acting(s) * boundary.follower_forces(scene.traction, x)
        return internal, inertial, outer, fluid

    def residual(q, s):
        internal, inertial, load, fluid = forces(q, s)
        total = internal - load if inertial is None else internal + inertial - load
        at_work = noise + jnp.linalg.norm(internal) + jnp.linalg.norm(load)
        if inertial is not None:
            at_work = at_work + jnp.linalg.norm(inertial)
        return (mask * total).ravel(), jax.lax.stop_gradient(at_work), fluid

    inertia = None if mass is None else {"euler": 1.0, "newmark": 4.0}[solve.integrator] / dt**2 * mass

    setting = tangent.Setting(scene, memory, flow if known is None else None, inertia, mask)
    method = continuation.Method(
        residual=residual,
        tangent=lambda q, s, fluid, near: tangent.tangent(setting, fluid, positions(q, s), acting(s), near),
        solve=partial(tangent.solve, setting),
        preconditioner=partial(tangent.preconditioner, setting),
        symmetric=not follows,
        moved=moving or mass is None,
    )
    options = StepOptions(tolerance=solve.tolerance, max_iterations=solve.newton_iterations)
    guess = None
    if mass is not None and not moving and solve.newton_iterations > 1:
        guess = (mask * (state.x + dt * state.velocity)).ravel()  # straight on; one iteration starts at x, as printed
    q, statistics = continuation.solve(method, (mask * state.x).ravel(), options, guess)
    one = jnp.ones((), dtype)
    x = positions(q, one)
    internal, inertial, load, pressed = forces(q, one)
    reactions = (1 - mask) * (internal - load if inertial is None else internal + inertial - load)
    velocity, acceleration = (None, None) if mass is None else _motion(solve.integrator, state, x, dt, mask)
    if state.acceleration is None:
        acceleration = None
    history, fluid = None, None
    if memory is not None or sponge is not None:
        F = deformation_gradient(mesh, x)
    if memory is not None:
        history = viscosity.advance(scene.viscosity, state.history, law, F, dt)
    if sponge is not None:
        fluid = porosity.advance(sponge, state.fluid, pressed, F)
    return State(x, velocity, acceleration, history, fluid), reactions, statistics


def _motion(integrator: str, state: State, x: jax.Array, dt: Any, mask: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Velocity and acceleration at the end of the step: implicit Euler, or Newmark's average acceleration."""
    velocity = (x - state.x) / dt
    acceleration = (velocity - state.velocity) / dt
    if integrator == "newmark":
        # Free degrees only: where motion is prescribed the average acceleration would swing without end.
        average = 4 * acceleration - state.acceleration
        free = mask > 0
        velocity = jnp.where(free, state.velocity + 0.5 * dt * (state.acceleration + average), velocity)
        acceleration = jnp.where(free, average, acceleration)
    return velocity, acceleration


@partial(jax.jit, static_argnames="report")
def _run(scene: Scene, report: Callable[[int], None] | None) -> Result:
    steps = scene.solve.steps
    dtype = scene.mesh.points.dtype

    def advance(state, k):
        new, reactions, statistics = step(scene, state, k, stiff)
        # A state that is not finite spoils nothing further: the run stays where it last was.
        finite = jnp.array([jnp.all(jnp.isfinite(leaf)) for leaf in jax.tree.leaves((new, reactions))]).all()
        good = finite & (statistics.status != status.NOT_FINITE)
        statistics = statistics._replace(status=jnp.where(finite, statistics.status, status.NOT_FINITE))
        new = jax.tree.map(lambda a, b: jnp.where(good, a, b), new, state)
        P = None if new.fluid is None else new.fluid.pressure
        if report is not None:
            jax.debug.callback(report, k)
        return new, (new.x, jnp.where(good, reactions, 0.0), P, statistics)

    numbers, stiff = jnp.arange(1, steps + 1, dtype=dtype), unit_strain_force(scene)
    _, (x, reactions, P, statistics) = jax.lax.scan(advance, initial_state(scene), numbers)
    times = numbers * (1.0 if scene.solve.dt is None else scene.solve.dt)
    code = statistics.status
    return Result(times=times, positions=x, reactions=reactions, pressure=P, status=code, statistics=statistics)


def simulate(scene: Scene, report: Callable[[int], None] | None = None) -> Result:
    """Run a scene; may be differentiated, vmapped and jitted. See `Result` and `Result.check`.

    Args:
        scene: `Scene`.
        report: called on the host with the number of every finished step, for progress.

    Raises:
        InputError: choices that mean nothing; precision "float64" where JAX's 64-bit mode is off. Numbers are checked
            by `check_scene`, which reading a scene file calls.
    """
    check_choices(scene)
    if scene.solve.precision == "float32":
        scene = jax.tree.map(partial(_cast, dtype=jnp.float32), scene)
    elif not jax.config.jax_enable_x64:
        raise InputError("precision = 'float64' needs JAX's 64-bit mode: unset JAX_ENABLE_X64 or ask for float32")
    return _run(scene, report)


def _cast(value: Any, dtype: Any) -> Any:
    return jnp.asarray(value, dtype) if jnp.issubdtype(jnp.result_type(value), jnp.floating) else value
