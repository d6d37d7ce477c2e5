"""Runs of a reduced model: a step of Newton's method for n coordinates, with stresses at the sampled points alone."""

from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.custom_derivatives import SymbolicZero

from liverjax.core import status
from liverjax.core.errors import InputError
from liverjax.core.struct import Number, param, replace, struct
from liverjax.mesh.nodal import nodal_volumes
from liverjax.mesh.promotion import on_middles
from liverjax.physics.base import End, Free, Solid, Step
from liverjax.physics.elasticity import Elastic, Elasticity
from liverjax.physics.inertia import FACTOR
from liverjax.physics.loads import Loads, dead_loads
from liverjax.physics.prescribed import prescribed
from liverjax.physics.viscosity import initial_history
from liverjax.reduced.correction import correction_at, stated_at
from liverjax.reduced.fluid import (
    Flowing,
    ReducedFluid,
    advanced_fluid,
    flowing,
    fluid_at_rest,
    porosity_at_points,
    pressure_coordinates,
    stiffness_of_pressures,
    volume_blocks,
    volume_stress,
)
from liverjax.reduced.model import (
    ReducedModel,
    as_matrix,
    flat_gradient,
    refuse_another_scene,
    solid_at_points,
)
from liverjax.reduced.tangent import (
    ReducedTangent,
    SinglePrecision,
    in_single_precision,
    near_inverse,
    solved_by_tangent,
)
from liverjax.scenes.scene import Scene
from liverjax.scenes.scene_checks import check_before_run
from liverjax.tensors.matrices import IDENTITY, add_matrices, determinant

_PAIRS = ((0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2))


@struct
class ReducedResult:
    """Result of a reduced run: arrays over the T steps. `reduced_positions` gives the motion of the nodes."""

    times: jax.Array = param("s", "(T,); the number of the load step where there is no time")
    coordinates: jax.Array = param("m", "of the modes (T, n)")
    status: jax.Array = param("1", "(T,) result codes of `liverjax.core.status`")
    iterations: jax.Array = param("1", "(T,) of Newton's method")
    residual: jax.Array = param("1", "(T,) of the reduced equations over the forces at work")
    pressures: jax.Array | None = param("Pa", "coordinates of the pressure's modes (T, m)", default=None)
    error: jax.Array | None = param(
        "m", "(T,) estimated largest distance of a node from the full model, where asked for", default=None
    )
    reactions: jax.Array | None = param("N", "(T, V, 3) as of the full model, where error is", default=None)
    pressure_error: jax.Array | None = param(
        "Pa", "(T,) estimated largest error of the fluid's pressure, of a porous scene where error is", default=None
    )


class ReducedMotion(NamedTuple):
    """Velocity and acceleration of the coordinates (n,), and how the acceleration goes on."""

    velocity: jax.Array  # [m/s]
    acceleration: jax.Array  # [m/s^2]
    change: jax.Array  # of the acceleration in the last step [m/s^2]
    steady: jax.Array  # that change is nearer to the change before it than to zero


class _Given(NamedTuple):
    """Prescribed loads and motion at the end of every step."""

    load: jax.Array  # (T, n) [N]
    gradient: jax.Array  # deformation gradient of the prescribed motion (T, 9, S), or (1, 9, S) where nothing moves


class _Equations(NamedTuple):
    """The constants of a step."""

    model: ReducedModel
    acting: Solid
    load: jax.Array
    gradient: jax.Array
    mass: jax.Array | None  # (n, n) [kg]
    q: jax.Array  # at the beginning
    motion: ReducedMotion | None
    dt: jax.Array
    newmark: bool | None
    spread: jax.Array | None  # sizes of the slopes (9, S, n) [1/m] where a part of the body is moved
    noise: jax.Array  # size of forces whose roundoff is the tolerance [N]: no load leaves only these
    fluid: Flowing | None  # of a porous scene
    light: SinglePrecision


def _kinematics(e: _Equations, q: jax.Array) -> ReducedMotion:
    """As `liverjax.physics.inertia.Moving.kinematics`."""
    assert e.motion is not None
    velocity = (q - e.q) / e.dt
    acceleration = (velocity - e.motion.velocity) / e.dt
    if e.newmark:
        acceleration = 4 * acceleration - e.motion.acceleration
        velocity = e.motion.velocity + 0.5 * e.dt * (e.motion.acceleration + acceleration)
    change = acceleration - e.motion.acceleration
    steady = jnp.linalg.norm(change - e.motion.change) < jnp.linalg.norm(change)
    return ReducedMotion(velocity, acceleration, change, steady)


def _deformation(e: _Equations, q: jax.Array) -> jax.Array:
    return e.gradient + e.model.slopes @ q


def _stresses(solid: Solid, F: jax.Array) -> jax.Array:
    """First Piola-Kirchhoff stress (9, S) of deformation gradients (9, S)."""
    return jnp.stack([jnp.broadcast_to(entry, F.shape[1:]) for row in solid.stress(as_matrix(F)) for entry in row])


def _noise(model: ReducedModel, scene: Scene) -> jax.Array:
    """As `liverjax.simulation.equations.Equations.noise`: roundoff of a stretch along x, over the tolerance [N]."""
    own = solid_at_points(model, replace(scene, viscosity=None))
    assert isinstance(own, Elasticity)
    rest = jnp.tile(jnp.eye(3).reshape(9, 1), len(model.points)).astype(model.slopes.dtype)
    P = jax.jvp(lambda F: _stresses(Elastic(law=own.law), F), (rest,), (jnp.zeros_like(rest).at[0].set(1.0),))[1]
    force = jnp.linalg.norm(jnp.tensordot(model.weights[None] * P, model.slopes, axes=2))
    return jax.lax.stop_gradient(20 * float(np.finfo(np.float64).eps) / scene.solve.tolerance * force)


def _residual(e: _Equations, q: jax.Array, F: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Out-of-balance forces (n,) and the size of all forces, with the deformation gradients F (9, S) of q."""
    P = _stresses(e.acting, F)
    if e.fluid is not None:
        p = pressure_coordinates(e.fluid, determinant(as_matrix(F)))
        P = P + volume_stress(e.model, e.fluid.porosity, p, F)
    internal = jnp.tensordot(e.model.weights[None] * P, e.model.slopes, axes=2)
    r, size = internal - e.load, jnp.linalg.norm(internal) + jnp.linalg.norm(e.load) + e.noise
    if e.spread is not None:
        # Without loads the forces of the points cancel at the solution: their sizes are what is at work.
        size = size + jnp.linalg.norm(jnp.tensordot(e.model.weights[None] * jnp.abs(P), e.spread, axes=2))
    if e.mass is not None:
        inertia = e.mass @ _kinematics(e, q).acceleration
        r, size = r + inertia, size + jnp.linalg.norm(inertia)
    return r, size


def _reduced_tangent(e: _Equations, q: jax.Array) -> ReducedTangent:
    """Derivative of the residual: the elements' own blocks, with the axes for shape vectors."""
    F = _deformation(e, q)
    blocks = e.acting.blocks(as_matrix(F), list(IDENTITY), _PAIRS)
    if e.fluid is not None:
        more = volume_blocks(e.model, e.fluid, as_matrix(F), _PAIRS)
        blocks = [add_matrices(a, b) for a, b in zip(blocks, more, strict=True)]
    A: list[list[Any]] = [[None] * 9 for _ in range(9)]
    for (i, j), K in zip(_PAIRS, blocks, strict=True):
        for r in range(3):
            for c in range(3):
                A[3 * r + i][3 * c + j] = A[3 * c + j][3 * r + i] = jnp.broadcast_to(K[r][c], F.shape[1:])
    moduli = e.model.weights[None, None] * jnp.stack([jnp.stack(row) for row in A])
    rest = jnp.zeros((len(q), len(q)), q.dtype)
    if e.fluid is not None:
        rest = rest + stiffness_of_pressures(e.model, e.fluid, as_matrix(F))
    if e.mass is not None:
        rest = rest + FACTOR["newmark" if e.newmark else "euler"] / e.dt**2 * e.mass
    return ReducedTangent(e.model.slopes, moduli, rest)


class _Found(NamedTuple):
    """The end of a step, and the inverse that the next step begins with."""

    q: jax.Array
    residual: jax.Array
    iterations: jax.Array | np.ndarray
    inverse: jax.Array


class _ReducedIterate(NamedTuple):
    """State of the iterations of a step."""

    q: jax.Array
    F: jax.Array  # (9, S)
    r: jax.Array
    size: jax.Array  # of r, relative to the forces at work
    inverse: jax.Array  # of the tangent, or near it (n, n) [m/N]
    fresh: jax.Array  # the inverse is that of the tangent at q
    slow: jax.Array  # the last iteration gained little
    iterations: jax.Array
    tangents: jax.Array


#: An iteration that leaves more than this part of the residual calls for the tangent at hand, which costs ten of them.
_LITTLE_GAIN = 0.95


def _updated(inverse: jax.Array, moved: jax.Array, change: jax.Array) -> jax.Array:
    """The inverse that fits the change of the forces along the last motion; it stays symmetric, and positive if it was.

    Broyden, Fletcher, Goldfarb, Shanno (1970). Where forces fall along the motion, no positive one fits: it is kept.
    """
    work, towards = moved @ change, inverse @ change
    seen = work > 1e-8 * jnp.linalg.norm(moved) * jnp.linalg.norm(change)
    per_work = jnp.where(seen, 1 / jnp.where(seen, work, 1.0), 0.0)
    half = jnp.outer(moved, per_work * (towards - 0.5 * (1 + per_work * (change @ towards)) * moved))
    return inverse - half - half.T


def _judged(e: _Equations, q: jax.Array, F: jax.Array) -> tuple[jax.Array, jax.Array]:
    r, size = _residual(e, q, F)
    return r, jnp.linalg.norm(r) / jnp.maximum(size, jnp.finfo(r.dtype).tiny)


def _upright(F: jax.Array) -> jax.Array:
    return jnp.min(determinant(as_matrix(F))) > 0


def _corrected(e: _Equations, at: _ReducedIterate) -> _ReducedIterate:
    """One iteration with the inverse at hand, which is then updated with the new forces."""
    dq = at.inverse @ at.r
    dF = e.model.slopes @ dq
    # Halved until no sampled point is inverted, six times at most.
    part = jax.lax.while_loop(
        lambda part: (part > 0.02) & ~_upright(at.F - part * dF), lambda part: 0.5 * part, jnp.ones((), dq.dtype)
    )
    q, F = at.q - part * dq, at.F - part * dF
    r, size = _judged(e, q, F)
    inverse = _updated(at.inverse, -part * dq, r - at.r)
    # An old inverse may lead astray: such a step is not taken.
    before, after = jnp.linalg.norm(at.r), jnp.linalg.norm(r)
    good = at.fresh | (after < before)
    new = _ReducedIterate(q, F, r, size, inverse, jnp.array(False), jnp.array(False), at.iterations, at.tangents)
    new = jax.tree.map(lambda a, b: jnp.where(good, a, b), new, at)
    return new._replace(slow=~(after < _LITTLE_GAIN * before), fresh=jnp.array(False), iterations=at.iterations + 1)


@partial(jax.custom_jvp, nondiff_argnums=(0, 1))
def _newton(newmark: bool, most: int, e: _Equations, tolerance: Number, inverse: jax.Array) -> _Found:
    """The coordinates at the end of a step, from the inverse of the step before (zeros: none yet).

    Derivatives are those of the solution.
    """
    arrays, tree = jax.tree.flatten((e, tolerance, inverse))

    def solve(*arrays: jax.Array) -> _Found:
        return _solved(newmark, most, *jax.tree.unflatten(tree, arrays))

    found: _Found = _lane_by_lane(solve)(*arrays) if jax.default_backend() == "cpu" else solve(*arrays)
    return found


def _lane_by_lane(function: Callable) -> Callable:
    """The function of arrays, with lanes of vmap one by one: on a CPU all of them would wait for the slowest, and for
    the tangent that any one needs. As `jax.custom_batching.sequential_vmap`, which fails in second derivatives."""
    own = jax.custom_batching.custom_vmap(function)

    @own.def_vmap
    def lanes(size: int, batched: list[bool], *arrays: jax.Array) -> tuple[Any, Any]:
        with_lanes = [a for a, b in zip(arrays, batched, strict=True) if b]

        def one(lane: list[jax.Array]) -> Any:
            left = iter(lane)
            return own(*(next(left) if b else a for a, b in zip(arrays, batched, strict=True)))

        out = jax.lax.map(one, with_lanes) if with_lanes else function(*arrays)
        return out, jax.tree.map(lambda _: bool(with_lanes), out)

    return own


def _solved(newmark: bool, most: int, e: _Equations, tolerance: Number, inverse: jax.Array) -> _Found:
    """Newton's method with an inverse that is kept; the tangent is taken anew only where the iterations gain little."""
    e = e._replace(newmark=newmark)

    def unfinished(at: _ReducedIterate) -> jax.Array:
        return (at.size > tolerance) & (at.tangents < most)

    def inner(at: _ReducedIterate) -> _ReducedIterate:
        going = lambda at: (at.size > tolerance) & ~at.slow  # noqa: E731
        return jax.lax.while_loop(going, lambda at: _corrected(e, at), at._replace(slow=jnp.array(False)))

    def refreshed(at: _ReducedIterate) -> _ReducedIterate:
        own = near_inverse(_reduced_tangent(e, at.q), e.light)
        return at._replace(inverse=own, fresh=jnp.array(True), tangents=at.tangents + 1)

    start = e.q if e.motion is None else e.q + e.dt * e.motion.velocity
    if e.motion is not None and not newmark:
        # A parabola or a cubic through the last coordinates: that which would have foretold the step before better.
        # Accelerations of Newmark's method ring: they foretell nothing.
        more = jnp.where(e.motion.steady, e.motion.change, 0.0)
        start = start + e.dt**2 * (e.motion.acceleration + more)
    foretold, none = _deformation(e, start), jnp.zeros((), jnp.int32)
    good = _upright(foretold)
    start = jnp.where(good, start, e.q)
    F = jax.lax.cond(good, lambda: foretold, lambda: _deformation(e, e.q))
    r, size = _judged(e, start, F)
    begin = _ReducedIterate(start, F, r, size, inverse, jnp.array(False), jnp.array(False), none, none)
    at = inner(begin)
    # Where the old inverse does not lead to the end, the step begins again.
    begin = begin._replace(iterations=at.iterations)
    at = jax.tree.map(lambda old, new: jnp.where(at.size > tolerance, new, old), at, begin)
    at = jax.lax.while_loop(unfinished, lambda at: inner(refreshed(at)), at)
    # One more correction costs no forces.
    return _Found(at.q - at.inverse @ at.r, at.size, at.iterations, at.inverse)


@partial(_newton.defjvp, symbolic_zeros=True)
def _newton_derivative(newmark: bool, most: int, primals: tuple, tangents: tuple) -> tuple[_Found, _Found]:
    e, de = primals[0]._replace(newmark=newmark), tangents[0]
    found = _newton(newmark, most, *primals)
    without = e._replace(newmark=None)

    # Derivatives by what is differentiated alone: those by the slopes would take longer than all the others.
    numbers, tree = jax.tree.flatten(without)
    changes = jax.tree.leaves(de)
    live = [k for k, change in enumerate(changes) if not isinstance(change, SymbolicZero)]

    def forces(values: list[jax.Array]) -> jax.Array:
        own = dict(zip(live, values, strict=True))
        e = jax.tree.unflatten(tree, [own.get(k, number) for k, number in enumerate(numbers)])
        return _residual(e._replace(newmark=newmark), found.q, _deformation(e, found.q))[0]

    change = jax.jvp(forces, ([numbers[k] for k in live],), ([changes[k] for k in live],))[1]
    dq = -solved_by_tangent(_reduced_tangent(e, found.q), e.light, change)
    whole = np.zeros((), jax.dtypes.float0)
    return found, _Found(dq, jnp.zeros_like(found.residual), whole, jnp.zeros_like(found.inverse))


def _given(model: ReducedModel, scene: Scene) -> tuple[_Given, jax.Array]:
    """Loads and prescribed motion of every step, and the load (n,) at the beginning of the run."""
    mesh, solve, body = scene.mesh, scene.solve, scene.body
    weight = {} if body is None else {k: getattr(body, k) for k in ("density", "gravity", "times", "history")}
    loads = Loads(traction=scene.traction, **weight)
    numbers = jnp.arange(solve.steps + 1, dtype=mesh.points.dtype)

    def reduced(at: Loads) -> jax.Array:
        dead = dead_loads(mesh, at.density, at.gravity, at.traction)
        return jnp.tensordot(model.modes, dead, axes=2)

    if loads.history is not None or any(load.history is not None for load in loads.traction):
        all_steps = jax.lax.map(lambda k: reduced(loads.at(k * solve.dt)), numbers)
        first, load = all_steps[0], all_steps[1:]
    else:
        first = reduced(loads)
        parts = numbers[1:] / solve.steps if solve.dt is None else jnp.ones_like(numbers[1:])
        load = parts[:, None] * first[None]

    return _Given(load, prescribed_gradients(model, scene)), first


def prescribed_gradients(model: ReducedModel, scene: Scene) -> jax.Array:
    """Deformation gradients of the prescribed motion at the points: (T, 9, S), or (1, 9, S) where nothing moves."""
    mesh, solve = scene.mesh, scene.solve

    def moved(k: jax.Array) -> jax.Array:
        time = 0.0 if solve.dt is None else solve.dt * k
        u = prescribed(mesh, scene.displaced, time, k / solve.steps)
        return flat_gradient(mesh, mesh.points + u)[:, model.points]

    if not scene.displaced:
        return moved(jnp.zeros((), mesh.points.dtype))[None]
    return jax.lax.map(moved, jnp.arange(1, solve.steps + 1, dtype=mesh.points.dtype))


def _begin(model: ReducedModel, scene: Scene, load: jax.Array) -> tuple:
    """What a run begins with: coordinates, memory, fluid, motion at rest, an empty inverse, mass matrix. Without
    inertia motion and mass are None."""
    n, S = model.number_of_modes, model.weights.shape[0]
    q = jnp.zeros(n, model.modes.dtype)
    inverse = jnp.zeros((n, n), q.dtype)
    memory = None if scene.viscosity is None else initial_history(scene.viscosity, S, q.dtype)
    fluid = None if scene.porosity is None else fluid_at_rest(model, scene)
    if scene.solve.kind != "dynamic" or scene.body is None:
        return q, memory, fluid, None, inverse, None
    nodal = jnp.asarray(scene.body.density) * nodal_volumes(scene.mesh)
    mass = jnp.tensordot(model.modes * nodal[None, :, None], model.modes, axes=((1, 2), (1, 2)))
    newmark = scene.solve.integrator == "newmark"
    if newmark and fluid is not None and scene.porosity is not None and scene.porosity.initial_pressure is not None:
        load = load - _forces_of_fluid(model, scene, fluid)
    motion = ReducedMotion(q, jnp.linalg.solve(mass, load) if newmark else q, q, jnp.array(False))
    return q, memory, fluid, motion, inverse, mass


def _forces_of_fluid(model: ReducedModel, scene: Scene, fluid: ReducedFluid) -> jax.Array:
    """Forces (n,) [N] of a given pressure at rest, as of `liverjax.simulation.equations.initial_state`."""
    sponge = porosity_at_points(model, scene)
    flow = flowing(model, sponge, fluid, jnp.asarray(scene.solve.dt))
    p = pressure_coordinates(flow, flow.J)
    return jnp.tensordot(model.weights[None] * volume_stress(model, sponge, p, fluid.F), model.slopes, axes=2)


def _advance(model: ReducedModel, scene: Scene, mass: jax.Array | None) -> Callable:
    """One step: from (coordinates, memory, motion) before it and its loads to the same after it, and a row of the
    result."""
    solve, solid = scene.solve, solid_at_points(model, scene)
    points = scene.mesh.points
    spread = jax.lax.stop_gradient(jnp.abs(model.slopes)) if scene.displaced else None
    light = in_single_precision(model.slopes)
    noise, sponge = _noise(model, scene), None if scene.porosity is None else porosity_at_points(model, scene)
    step = Step(scene.mesh, points, 1, solve.steps, solve.dt, mass is not None, None, Free(jnp.ones_like(points)))

    def advance(carry: tuple, given: tuple) -> tuple:
        q, memory, fluid, motion, inverse = carry
        acting = solid.freeze(memory, step)
        newmark = solve.integrator == "newmark"
        load, gradient = given
        flow = None if sponge is None else flowing(model, sponge, fluid, solve.dt)
        e = _Equations(model, acting, load, gradient, mass, q, motion, solve.dt, None, spread, noise, flow, light)
        found = _newton(newmark, solve.newton_iterations, e, solve.tolerance, inverse)
        e = e._replace(newmark=newmark)
        flat = _deformation(e, found.q)
        F = as_matrix(flat)
        memory = solid.advance(memory, acting, End(points, F, None))
        motion = None if motion is None else _kinematics(e, found.q)
        fluid = None if flow is None else advanced_fluid(flow, flat)
        code = jnp.where(found.residual <= solve.tolerance, status.CONVERGED, status.STALLED)
        code = jnp.where(jnp.min(determinant(F)) <= 0, status.INVERTED, code)
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
    """Run a scene by its reduced model; may be differentiated, vmapped and jitted.

    Args:
        model: `ReducedModel`, from `reduce_scene` or `load_reduced`.
        scene: the scene it was made for; numbers of law, regions, viscosity, body, loads and time step may differ.

    Raises:
        InputError: another scene, or numbers that `simulate` refuses too.
    """
    refuse_another_scene(model, scene)
    check_before_run(scene)
    # What the run does not need: models that differ in it alone share one program.
    return _reduced_run(replace(model, correction=None, ranges={}), scene)


def reduced_positions(model: ReducedModel, scene: Scene, result: ReducedResult) -> jax.Array:
    """Positions (T, V, 3) [m] of the nodes, with the correction that the model has learnt."""
    mesh, solve = scene.mesh, scene.solve
    u = _free_motion(model, scene, result)
    if scene.displaced:
        numbers = jnp.arange(1, solve.steps + 1, dtype=u.dtype)
        u = u + jax.vmap(lambda k, t: prescribed(mesh, scene.displaced, t, k / solve.steps))(numbers, result.times)
    return mesh.points[None] + u


def reduced_pressure(model: ReducedModel, scene: Scene, result: ReducedResult) -> jax.Array:
    """Pressure (T, V) [Pa] of the fluid at the nodes of a porous scene.

    Raises:
        InputError: a scene without porosity.
    """
    if model.pressures is None or result.pressures is None:
        raise InputError("this reduced model has no pressures: its scene has no [porosity]")
    return jax.vmap(partial(on_middles, scene.mesh))(result.pressures @ model.pressures.modes)


def _free_motion(model: ReducedModel, scene: Scene, result: ReducedResult) -> jax.Array:
    """Displacements (T, V, 3) [m] of the nodes by modes and correction, without prescribed ones."""
    u = jnp.tensordot(result.coordinates, model.modes, axes=1)
    if model.correction is not None:
        u = u + correction_at(model.correction, result.coordinates, scene.solve.dt)
    return u


def stated_error(model: ReducedModel, scene: Scene, result: ReducedResult) -> jax.Array:
    """Estimated largest distance of a node from the full model (T,) [m], learnt from the runs left out.

    It needs no full mesh, and may be differentiated, vmapped and jitted. `reduced_error` uses the full mesh.

    Args:
        model, scene, result: as of `simulate_reduced`.

    Raises:
        InputError: a model without a correction: made from few rows, or none made its errors smaller.
    """
    if model.correction is None:
        raise InputError("this reduced model has no correction: make it from more rows, or take lj.reduced_error")
    moved = _free_motion(model, scene, result)
    return stated_at(model.correction, result.coordinates, moved, scene.solve.dt)
