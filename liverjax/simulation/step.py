"""One load or time step of a scene: its equations, what solves them, and the state it hands to the next."""

from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from liverjax import laws
from liverjax.core import status
from liverjax.core.struct import replace
from liverjax.elements import mjed
from liverjax.laws.terms import invariant_terms
from liverjax.physics import boundary, nodal_volume, porosity, viscosity
from liverjax.scenes.scene import Scene, element_law
from liverjax.simulation import potential, tangent
from liverjax.solvers import continuation
from liverjax.solvers.block_matrix import columns, flat
from liverjax.solvers.continuation import Kept, StepOptions, StepStatistics
from liverjax.tensors.matrices import add_matrices, cofactor, deformation_gradient, determinant, scale_matrix


class State(NamedTuple):
    """What a step hands to the next; parts that the scene lacks are None."""

    x: jax.Array  # (V, 3) [m]
    velocity: jax.Array | None  # dynamic
    acceleration: jax.Array | None  # Newmark
    history: Any  # `viscosity.History` of a viscous scene
    fluid: Any  # `porosity.Fluid` of a porous one


def initial_state(scene: Scene, start: jax.Array | None = None) -> State:
    """At rest in the reference positions, or at positions `start` (V, 3) [m]."""
    x = scene.mesh.points if start is None else start
    dynamic = scene.solve.kind == "dynamic"
    acceleration = None
    if dynamic and scene.solve.integrator == "newmark":
        assert scene.body is not None
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


class Sizes(NamedTuple):
    """Of nodal forces at rest, the same for all steps; without derivatives."""

    unit_strain: jax.Array  # [N] of a stretch along x, per unit strain
    roundoff: jax.Array  # [N] of positions rounded to their digits


def force_sizes(scene: Scene) -> Sizes:
    """What forces are measured against where loads do not say: roundoff is a part of the first, and is the second."""
    mesh, law = scene.mesh, porosity.law_in_force(scene.porosity, scene.law)
    dtype = mesh.points.dtype
    along = mesh.points * jnp.array([[1.0, 0.0, 0.0]], dtype)
    rounded = 0.5 * float(jnp.finfo(dtype).eps) * jnp.abs(mesh.points)
    rounded = rounded * jax.random.rademacher(jax.random.key(0), mesh.points.shape, dtype)
    _, forces = jax.linearize(lambda x: mjed.internal_force(mesh, law, x), mesh.points)
    return Sizes(*(jax.lax.stop_gradient(jnp.linalg.norm(forces(v))) for v in (along, rounded)))


class Equations(NamedTuple):
    """The equations of one step and what is constant during it; parts that the scene lacks are None."""

    scene: Scene
    state: State
    k: Any  # number of the step, from 1
    mask: jax.Array  # (V, 3) 1 where free
    loads: jax.Array  # (V, 3) [N] dead
    noise: Any  # [N] below this, forces are roundoff: an unloaded equilibrium has converged
    roundoff: jax.Array  # [N] of positions rounded to their digits
    mass: jax.Array | None  # (V,) [kg]
    memory: Any  # `viscosity.Recall`
    flow: porosity.Flow | None  # where a fluid's pressure depends on where the step ends
    pressure: jax.Array | None  # (V,) [Pa] where it does not: solved for once


def equations(scene: Scene, state: State, k: Any, sizes: Sizes | None = None) -> Equations:
    """The equations of step k = 1 … steps from `state`; `sizes` is `force_sizes(scene)`, the same for all."""
    sizes = force_sizes(scene) if sizes is None else sizes
    mesh, sponge, dt = scene.mesh, scene.porosity, scene.solve.dt
    flow = pressure = mass = None
    if state.velocity is not None and scene.body is not None:
        mass = scene.body.density * boundary.nodal_volumes(mesh)
    if sponge is not None:
        F = deformation_gradient(mesh, state.x)
        flow = porosity.flow(sponge, mesh, state.fluid, F, dt, 1e-2 * jax.lax.stop_gradient(scene.solve.tolerance))
        if sponge.scheme != "implicit":
            pressure, flow = porosity.pressure(sponge, mesh, state.fluid, flow, determinant(F)), None
    return Equations(
        scene=scene,
        state=state,
        k=k,
        mask=boundary.free_degrees(mesh, scene.fixed, scene.displaced),
        loads=_loads(scene),
        noise=20 * float(np.finfo(np.float64).eps) / jax.lax.stop_gradient(scene.solve.tolerance) * sizes.unit_strain,
        roundoff=sizes.roundoff,
        mass=mass,
        memory=None if scene.viscosity is None else viscosity.recall(scene.viscosity, state.history, dt),
        flow=flow,
        pressure=pressure,
    )


def _acting(e: Equations, s: Any) -> Any:
    """Part of the loads that acts: they grow with the load steps, or quasi-statically within the first step."""
    if e.scene.solve.dt is None:
        return (e.k - 1 + s) / e.scene.solve.steps
    dtype = e.loads.dtype
    return jnp.ones((), dtype) if e.mass is not None else jnp.where(e.k == 1, s, 1.0).astype(dtype)


def _positions(e: Equations, q: jax.Array, s: Any) -> jax.Array:
    """Positions (V, 3) of unknowns q (3 V,) and of what is held at part s of the step."""
    held, solve = e.scene.mesh.points, e.scene.solve
    if e.scene.displaced:
        # Straight from beginning to end: a history may bend within the step, and only its end counts.
        before, after = (
            boundary.prescribed(
                e.scene.mesh, e.scene.displaced, 0.0 if solve.dt is None else solve.dt * n, n / solve.steps
            )
            for n in (e.k - 1, e.k)
        )
        held = held + before + s * (after - before)
    return e.mask * jnp.stack(columns(q), axis=-1) + (1 - e.mask) * held


def _forces(e: Equations, q: jax.Array, s: Any) -> tuple[jax.Array, jax.Array | None, jax.Array, Any]:
    """Internal, inertial and outer forces (V, 3), and the fluid's pressure."""
    scene = e.scene
    law = element_law(scene)
    x = _positions(e, q, s)
    F = deformation_gradient(scene.mesh, x)
    if scene.viscosity is None:
        P = invariant_terms.first_piola(law, F)
    else:
        P = viscosity.first_piola(scene.viscosity, e.memory, law, F)
    fluid: Any = e.pressure
    if scene.porosity is not None:
        if e.flow is not None:
            fluid = porosity.pressure(scene.porosity, scene.mesh, e.state.fluid, e.flow, determinant(F))
        P = add_matrices(P, porosity.first_piola(scene.porosity, scene.mesh, fluid, F))
    elif scene.solve.volumetric == "nodal":
        fluid = nodal_volume.pressure(scene.mesh, scene.law, determinant(F))
        P = add_matrices(P, scale_matrix(porosity.element_pressure(scene.mesh, fluid), cofactor(F)))
    outer = _acting(e, s) * e.loads
    if boundary.follows(scene.traction):
        outer = outer + _acting(e, s) * boundary.follower_forces(scene.traction, x)
    inertial = None if e.mass is None else e.mass[:, None] * _motion(e, x)[1]
    return mjed.nodal_force(scene.mesh, P), inertial, outer, fluid


def residual(e: Equations, q: jax.Array, s: Any) -> tuple[jax.Array, jax.Array, Any]:
    """Out of balance forces (3 V,) [N] at part s of the step, the size of those at work, and the fluid's pressure."""
    internal, inertial, outer, fluid = _forces(e, q, s)
    at_work = e.noise + jnp.linalg.norm(internal) + jnp.linalg.norm(outer)
    if inertial is not None:
        at_work = at_work + jnp.linalg.norm(inertial)
    total = internal - outer if inertial is None else internal + inertial - outer
    return flat(e.mask * total), jax.lax.stop_gradient(at_work), fluid


def method_of(e: Equations) -> continuation.Method:
    """How `continuation.solve` finds the end of the step: only what the scene has."""
    solve, follows = e.scene.solve, boundary.follows(e.scene.traction)
    inertia = None if e.mass is None else {"euler": 1.0, "newmark": 4.0}[solve.integrator] / solve.dt**2 * e.mass
    setting = tangent.Setting(e.scene, e.memory, e.flow, inertia, e.mask)

    def made(kind, q, s, fluid, near):
        return tangent.tangent(setting, fluid, _positions(e, q, s), _acting(e, s), near, kind)

    robust: dict[str, Any] = {}
    if solve.robust != "off":
        robust = {
            "energy": partial(energy, e),
            "definite": partial(made, solve.robust),
            "volume": lambda q, s: jnp.min(determinant(deformation_gradient(e.scene.mesh, _positions(e, q, s)))),
            "surrogate": None if isinstance(e.scene.law, laws.StableNeoHookean) else method_of(_finite(e)),
            "rest": _rest(e) if e.state.velocity is None else None,
        }
    return continuation.Method(
        residual=partial(residual, e),
        tangent=partial(made, "true"),
        solve=partial(tangent.solve, setting),
        preconditioner=partial(tangent.preconditioner, setting),
        adjoint=None if follows else partial(tangent.adjoint, setting),
        symmetric=not follows,
        moved=len(e.scene.displaced) > 0 or e.mass is None,
        roundoff=e.roundoff,
        **robust,
    )


def _rest(e: Equations) -> tuple[jax.Array, jax.Array]:
    """The reference shape, and whether the first step begins at another one, which without inertia is a guess."""
    points = e.scene.mesh.points
    return flat(e.mask * points), (e.k == 1) & jnp.any(e.mask * (e.state.x - points) != 0)


def _finite(e: Equations) -> Equations:
    """The same body of stable neo-Hookean material, neither viscous nor porous."""
    scene, law = e.scene, e.scene.law
    mu = law.shear_modulus()
    bulk = law.bulk_modulus() if scene.porosity is None else scene.porosity.bulk
    stable = laws.StableNeoHookean(mu=mu, lame_lambda=jnp.maximum(bulk - 2 / 3 * mu, mu))
    plain = replace(scene, law=stable, viscosity=None, porosity=None, solve=replace(scene.solve, volumetric="element"))
    return e._replace(scene=plain, memory=None, flow=None, pressure=None)


def energy(e: Equations, q: jax.Array) -> jax.Array:
    """What a step makes least [J]."""
    x = _positions(e, q, 1.0)
    loaded = e._replace(loads=_acting(e, jnp.ones((), x.dtype)) * e.loads)
    acceleration = None if e.mass is None else _motion(e, x)[1]
    return potential.total(loaded, x, deformation_gradient(e.scene.mesh, x), acceleration)


def step(e: Equations, kept: Kept | None = None, near: Any = None) -> tuple[State, jax.Array, StepStatistics, Kept]:
    """The next state, the reactions (V, 3) [N], what the solve took and the tangent for the next step.

    `kept` is the tangent of the last step, `near` one whose coarse space will do for derivatives.
    """
    scene, state, solve = e.scene, e.state, e.scene.solve
    options = StepOptions(
        tolerance=jax.lax.stop_gradient(solve.tolerance),
        max_iterations=solve.newton_iterations,
        one_step=solve.newton == "one_step",
    )
    guess = None
    if e.mass is not None and not scene.displaced and not options.one_step:
        # Straight on; one step of Newton starts at x, as printed.
        guess = flat(e.mask * (state.x + solve.dt * state.velocity))
    q, statistics, kept = continuation.solve(method_of(e), flat(e.mask * state.x), options, guess, kept, near)
    one = jnp.ones((), state.x.dtype)
    x = _positions(e, q, one)
    internal, inertial, outer, fluid = _forces(e, q, one)
    reactions = (1 - e.mask) * (internal - outer if inertial is None else internal + inertial - outer)
    velocity, acceleration = (None, None) if e.mass is None else _motion(e, x)
    if state.acceleration is None:
        acceleration = None
    history, F = None, deformation_gradient(scene.mesh, x)
    if scene.viscosity is not None:
        history = viscosity.advance(scene.viscosity, state.history, element_law(scene), F, solve.dt)
    flowed = None if scene.porosity is None else porosity.advance(scene.porosity, state.fluid, fluid, F)
    found = (statistics.status == status.CONVERGED) | (statistics.status == status.ONE_STEP)
    inverted = found & jnp.any(determinant(F) <= 0)
    statistics = statistics._replace(status=jnp.where(inverted, status.INVERTED, statistics.status))
    return State(x, velocity, acceleration, history, flowed), reactions, statistics, kept


def _motion(e: Equations, x: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Velocity and acceleration at the end of the step: implicit Euler, or Newmark's average acceleration."""
    state, dt = e.state, e.scene.solve.dt
    velocity = (x - state.x) / dt
    acceleration = (velocity - state.velocity) / dt
    if e.scene.solve.integrator == "newmark":
        # Free degrees only: where motion is prescribed the average acceleration would swing without end.
        average = 4 * acceleration - state.acceleration
        free = e.mask > 0
        velocity = jnp.where(free, state.velocity + 0.5 * dt * (state.acceleration + average), velocity)
        acceleration = jnp.where(free, average, acceleration)
    return velocity, acceleration
