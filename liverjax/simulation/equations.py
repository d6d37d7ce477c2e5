"""The equations of one load step or time step: the sum of all force terms is 0 in the free directions.

Each physics object of the scene (elasticity, loads, contact, viscosity …) has at most one force term.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from liverjax.core.struct import Number, replace
from liverjax.elements import mjed
from liverjax.laws.base import isochoric_part
from liverjax.mesh.promotion import on_middles
from liverjax.mesh.tetrahedra import TetMesh
from liverjax.physics.base import End, Free, NodalForce, Physics, Solid, Start, Step, VolumeStress
from liverjax.physics.darcy import Guess
from liverjax.physics.inertia import Inertia
from liverjax.physics.prescribed import free_degrees, given_acceleration, prescribed, strained_by_motion
from liverjax.physics.registry import law_at_rest, physics_of
from liverjax.scenes.scene import Scene
from liverjax.solvers.block_matrix import columns, flat
from liverjax.solvers.step_cutting import ROUNDINGS
from liverjax.tensors.matrices import Matrix, add_matrices, deformation_gradient, determinant

#: If no load acts, and the sum of all force norms is below this multiple of `Sizes.of_material`, the forces are only
#: roundoff. In unloaded bodies this sum was between 0.2 and 0.6 times `of_material`.
_ONLY_ROUNDOFF = 2.0


class State(NamedTuple):
    """The state between two steps."""

    x: jax.Array  # (V, 3) [m] positions
    memories: tuple  # internal variables of each physics object, in order; None: the object has no such variables


class Sizes(NamedTuple):
    """Norms of nodal forces in the reference shape. They are constant over all steps and not differentiated."""

    unit_strain: jax.Array  # [N] norm of the linearised nodal forces at a uniform unit strain along x
    roundoff: jax.Array  # [N] norm of the nodal forces due to roundoff of the positions
    of_material: jax.Array  # [N] the same norm without the forces of springs and masses


class Equations(NamedTuple):
    """The data of the equations of one step. These data are constant during the step."""

    scene: Scene
    physics: tuple[Physics, ...]
    acting: tuple  # force term of each physics object in this step; None: the object has no force
    state: State  # state at the beginning of the step
    k: Number  # number of the step, from 1
    free: Free
    noise: Number  # [N] added to the sum of all force norms, so that iterations for an unloaded body converge
    roundoff: jax.Array  # [N] norm of the nodal forces due to roundoff of the positions
    of_material: jax.Array  # [N] the same norm without the forces of springs and masses
    moved: tuple[jax.Array, jax.Array] | None  # (V, 3) [m] prescribed displacements before and after the step

    @property
    def mesh(self) -> TetMesh:
        """Mesh of the body."""
        return self.scene.mesh

    @property
    def solids(self) -> list[Solid]:
        """Force terms with a stress that depends on the deformation gradient of the elements."""
        return [a for a in self.acting if isinstance(a, Solid)]

    @property
    def volume(self) -> VolumeStress | None:
        """Force term with a stress that depends on the volume ratio of the elements, or None."""
        return next((a for a in self.acting if isinstance(a, VolumeStress)), None)

    @property
    def mixed(self) -> Any:
        """Force term with pressures that are unknowns together with the positions, or None."""
        return self.volume if self.volume is not None and self.volume.unknown else None

    @property
    def nodal(self) -> list[NodalForce]:
        """Force terms with forces at nodes."""
        return [a for a in self.acting if isinstance(a, NodalForce)]

    @property
    def conservative(self) -> bool:
        """Whether all forces have an energy."""
        return all(a.conservative for a in self.nodal)


class Forces(NamedTuple):
    """Nodal forces for given unknowns at one instant within a step."""

    internal: jax.Array  # (V, 3) [N] forces from the stress in the elements
    nodal: list[jax.Array]  # (V, 3) [N] forces of each force term at nodes
    pressure: jax.Array | None  # (V,) [Pa] pressures at the nodes, or None
    x: jax.Array  # (V, 3) [m] positions
    F: Matrix  # deformation gradient
    isochoric: jax.Array | None = None  # (V, 3) [N] part of `internal` that pressure unknowns do not cause

    @property
    def total(self) -> jax.Array:
        """Sum of all forces (V, 3) [N]."""
        return sum(self.nodal, self.internal)


def free_directions(scene: Scene) -> Free:
    """Return the directions in which the nodes of the body can move."""
    free = Free(free_degrees(scene.mesh, scene.fixed, scene.displaced))
    for physics in scene.physics:
        free = physics.constrain(free)
    return free


def initial_state(scene: Scene, start: jax.Array | None = None) -> State:
    """Return the state at the beginning of a run: at rest in the reference positions, or at `start` (V, 3) [m]."""
    x = scene.mesh.points if start is None else start
    physics, free = physics_of(scene), free_directions(scene)

    def force() -> jax.Array:
        """Return the nodal forces at x without inertia. The initial acceleration follows from these forces."""
        if start is not None or (scene.porosity is not None and scene.porosity.initial_pressure is not None):
            return _forces_at_beginning(scene, x)
        # If the body is at rest in the reference positions, only nodal forces act.
        begin = _first_step(scene, x, free)
        acting = [p.freeze(None, begin) for p in physics if p.acts_without_memory()]
        forces = [a.force(scene.mesh, x, 0.0) for a in acting if isinstance(a, NodalForce) and not a.at_end]
        return sum(forces, jnp.zeros_like(x))

    free = _with_tied(physics, _first_step(scene, x, free)).free
    given = _prescribed_acceleration(scene, physics, _first_step(scene, x, free)._replace(k=0))
    begin = Start(scene.mesh, x, free, force, moved=start is not None and scene.solve.kind == "dynamic", given=given)
    return State(x, tuple(p.begin(begin) for p in physics))


def _forces_at_beginning(scene: Scene, x: jax.Array) -> jax.Array:
    """Return the forces (V, 3) [N] of all physics at positions x (V, 3), with the internal variables of a body at rest.

    Inertia and the forces that act only at the end of a step (`NodalForce.at_end`) are omitted. No time has passed, so
    no stress has relaxed and no fluid has flowed.
    """
    none = jnp.zeros((), x.dtype)
    scene = replace(scene, viscosity=None, solve=replace(scene.solve, dt=none))
    still = replace(scene, solve=replace(scene.solve, kind="static"))
    at_rest = initial_state(still)._replace(x=x)
    e = _of_physics(scene, physics_of(still), at_rest, jnp.ones((), x.dtype), Sizes(none, none, none))
    q = unknowns(e, x)
    f = forces(e, q if e.mixed is None else settled(e, q, none), none)
    return f.total - sum(_at_end(e, x, none), jnp.zeros_like(x))


def _first_step(scene: Scene, x: jax.Array, free: Free) -> Step:
    moving = scene.solve.kind == "dynamic"
    averaged = moving and scene.solve.integrator == "newmark"
    return Step(scene.mesh, x, 1, scene.solve.steps, scene.solve.dt, moving, None, free, averaged)


def _with_tied(physics: tuple[Physics, ...], step: Step) -> Step:
    """Return the step with its groups of nodes that move together."""
    tied = tuple(nodes for nodes in (p.tied(step) for p in physics) if nodes is not None)
    return step._replace(free=step.free._replace(tied=tied))


def _prescribed_acceleration(scene: Scene, physics: tuple[Physics, ...], step: Step) -> jax.Array | None:
    """Return the prescribed acceleration (V, 3) [m/s^2] at the end of a step of Newmark's method; 0 for free motion.

    Return None if no motion is prescribed, or for other methods, which do not need this acceleration. Also return None
    if `physics` has no inertia.
    """
    if not step.averaged or not any(isinstance(p, Inertia) for p in physics):
        return None
    if not scene.displaced and not any(nodes.linear for nodes in _with_tied(physics, step).free.tied):
        return None

    def place(k: Number) -> jax.Array:
        x = prescribed(step.mesh, scene.displaced, step.dt * k, k / step.steps)
        for nodes in _with_tied(physics, step._replace(k=k)).free.tied:
            x = nodes.placed(x, 1.0)
        return x

    return given_acceleration(place, step.k, step.steps, step.dt)


def force_sizes(scene: Scene) -> Sizes:
    """Return the norms [N] of the nodal forces due to a unit strain along x, and due to rounding of the positions.

    The tolerance uses these norms, so that the iterations for a body without loads converge in spite of roundoff.
    """
    mesh = scene.mesh
    # If pressures are unknowns, they do not follow from the positions. Then the bulk modulus does not amplify the
    # rounding of positions.
    law = isochoric_part(scene.law) if scene.solve.volumetric == "mixed" else law_at_rest(scene)
    dtype = mesh.points.dtype
    along = mesh.points * jnp.array([[1.0, 0.0, 0.0]], dtype)
    rounded = 0.5 * float(jnp.finfo(dtype).eps) * jnp.abs(mesh.points)
    rounded = rounded * jax.random.rademacher(jax.random.key(0), mesh.points.shape, dtype)

    def size(motion: jax.Array) -> jax.Array:
        return jnp.linalg.norm(mjed.linear_force(mesh, law, motion))

    # One loop computes both norms. Two separate products with the linearised force would make the compiled program
    # three times as large.
    unit_strain, roundoff = jax.lax.map(size, jnp.stack([along, rounded]))
    whole = roundoff + _roundoff_at_nodes(scene, rounded)
    return Sizes(*jax.lax.stop_gradient((unit_strain, whole, roundoff)))


def _roundoff_at_nodes(scene: Scene, rounded: jax.Array) -> jax.Array:
    """Return the norm [N] of the spring and mass forces due to a motion `rounded` (V, 3) [m] from the reference shape.

    Contact is omitted, because the contact points are not known before the step.
    """
    x = scene.mesh.points
    begin = _first_step(scene, x, free_directions(scene))
    acting = [p.freeze(None, begin) for p in physics_of(scene) if p.acts_without_memory()]
    springs = [a for a in acting if isinstance(a, NodalForce) and _is_spring(a) and not a.kinked]
    if not springs:
        return jnp.zeros((), x.dtype)

    def force(x: jax.Array) -> jax.Array:
        return sum((a.force(scene.mesh, x, 0.0) for a in springs), jnp.zeros_like(x))

    return jnp.linalg.norm(jax.jvp(force, (x,), (rounded,))[1])


def _is_spring(acting: NodalForce) -> bool:
    """Return whether the class of `acting` defines a stiffness. Then the force changes with the positions."""
    own = type(acting)
    return own.stiffness is not NodalForce.stiffness or own.attached is not NodalForce.attached


def equations(scene: Scene, state: State, k: Number, sizes: Sizes | None = None) -> Equations:
    """Return the equations of step k (from 1), which begins at `state`. `sizes` is `force_sizes(scene)`."""
    sizes = force_sizes(scene) if sizes is None else sizes
    return _of_physics(scene, physics_of(scene), state, k, sizes)


def _of_physics(scene: Scene, physics: tuple[Physics, ...], state: State, k: Number, sizes: Sizes) -> Equations:
    free = free_directions(scene)
    tolerance = jax.lax.stop_gradient(scene.solve.tolerance)
    step = _with_tied(physics, _first_step(scene, state.x, free)._replace(k=k, tolerance=tolerance))
    step = step._replace(given=_prescribed_acceleration(scene, physics, step))
    eps = float(np.finfo(np.float64).eps)
    free, noise = step.free, 20 * eps * sizes.unit_strain
    if scene.solve.volumetric == "mixed":
        # With volumetric = "mixed", inertia forces enter the sum of the force norms only with a weight of about shear
        # modulus / bulk modulus (`Mixed.counted`). In short time steps the roundoff of inertia forces exceeds the
        # tolerance that follows from this sum, so this roundoff is added. A run in single precision gets the same term
        # as a run in double precision. So if its residual stops at a larger value, this is reported.
        noise = noise + ROUNDINGS * sizes.roundoff * (eps / float(jnp.finfo(state.x.dtype).eps))
    moved, farther = _prescribed_motion(scene, k), jnp.ones((), state.x.dtype)
    if moved is not None:  # far from the reference shape the coordinates are larger, so their roundoff is larger too
        far = jnp.max(jnp.abs(jnp.stack(moved))) / jnp.max(jnp.abs(scene.mesh.points))
        farther = jax.lax.stop_gradient(1 + far)
    return Equations(
        scene=scene,
        physics=physics,
        acting=tuple(p.freeze(memory, step) for p, memory in zip(physics, state.memories, strict=True)),
        state=state,
        k=k,
        free=free,
        noise=noise / tolerance,
        roundoff=farther * sizes.roundoff,
        of_material=farther * sizes.of_material,
        moved=moved,
    )


def _prescribed_motion(scene: Scene, k: Number) -> tuple[jax.Array, jax.Array] | None:
    """Return the prescribed displacements (V, 3) [m] before and after step k, or None if none is prescribed."""
    if not scene.displaced:
        return None
    solve = scene.solve
    before, after = (
        prescribed(scene.mesh, scene.displaced, 0.0 if solve.dt is None else solve.dt * n, n / solve.steps)
        for n in (k - 1, k)
    )
    return before, after


def positions(e: Equations, q: jax.Array, s: Number) -> jax.Array:
    """Return the positions (V, 3) [m] for the unknowns q (3 V,) and the prescribed motion, at step fraction s."""
    held, free = e.mesh.points, e.free
    q = q[: 3 * e.mesh.number_of_nodes]
    if e.moved is not None:
        # Prescribed motion is linear within a step. Only the values of a history at the ends of the steps are used.
        before, after = e.moved
        held = held + before + s * (after - before)
    x = free.mask * jnp.stack(columns(q), axis=-1) + (1 - free.mask) * held
    if free.normals is not None:
        x = x - jnp.sum(free.normals * (x - e.mesh.points), axis=1, keepdims=True) * free.normals
    for nodes in free.tied:
        x = nodes.placed(x, s)
    return x


def unknowns(e: Equations, x: jax.Array, pressure: jax.Array | None = None) -> jax.Array:
    """Return the unknowns q of a step at positions x (V, 3): positions (3 V,), then pressures if they are unknowns.

    The unknown of a pressure is this pressure divided by `e.mixed.unit`.

    Args:
        pressure: pressures of the vertices (V,) [Pa] if they are unknowns; default: pressures at the beginning of the
            step.
    """
    field = e.free._replace(tied=()).vectors(x)
    for nodes in e.free.tied:
        field = nodes.unknown(field, x)
    q = flat(field)
    if e.mixed is None:
        return q
    pressure = e.mixed.before if pressure is None else pressure
    return jnp.concatenate([q, pressure / e.mixed.unit])


def in_directions_at(
    e: Equations, x: jax.Array | None, make: Callable[[Equations], Callable[[jax.Array], jax.Array]]
) -> Callable[[jax.Array], jax.Array]:
    """Return the function that `make` returns, with a change of directions if necessary. It maps flat vectors (3 V,).

    Nodes that rotate together move along circles, so the directions of their motions change during a step. Flat vectors
    use the directions at the beginning of the step. The function from `make` uses the directions at positions x (V, 3),
    so its argument and its result are converted.
    """
    if x is None or all(nodes.linear for nodes in e.free.tied):
        return make(e)
    there = tuple(nodes.at(x) for nodes in e.free.tied)
    function = make(e._replace(free=e.free._replace(tied=there)))

    def turned(vector: jax.Array, old: tuple, new: tuple) -> jax.Array:
        n = 3 * e.mesh.number_of_nodes
        field = jnp.stack(columns(vector[:n]), axis=-1)
        for own, other in zip(old, new, strict=True):
            field = own.turned(field, other)
        return jnp.concatenate([flat(field), vector[n:]])

    return lambda vector: turned(function(turned(vector, e.free.tied, there)), there, e.free.tied)


@jax.jit  # so that JAX traces this function only once for all its calls in a compiled program
def forces(
    e: Equations, q: jax.Array, s: Number, guess: Guess | None = None, pressure: jax.Array | None = None
) -> Forces:
    """Return the forces of all physics for the unknowns q (3 V,), at fraction s of the step.

    The pressures of a flowing fluid can be given as `pressure` (V,) [Pa]. Otherwise they are computed, starting at
    `guess` if it is given.
    """
    x = positions(e, q, s)
    F = deformation_gradient(e.mesh, x)
    first, *rest = [solid.stress(F) for solid in e.solids]
    P = first
    for other in rest:
        P = add_matrices(P, other)
    isochoric = None
    if e.mixed is not None:
        pressure, isochoric = _unknown_pressure(e, q), mjed.nodal_force(e.mesh, P)
    elif e.volume is not None and pressure is None:
        pressure = e.volume.pressure(e.mesh, determinant(F), guess)
    if e.volume is not None:
        assert pressure is not None
        P = add_matrices(P, e.volume.stress(e.mesh, pressure, F))
    return Forces(mjed.nodal_force(e.mesh, P), [a.force(e.mesh, x, s) for a in e.nodal], pressure, x, F, isochoric)


def forces_at(scene: Scene, x: jax.Array) -> jax.Array:
    """Return the external forces (V, 3) [N] that hold the nodes at the positions x (V, 3), in a scene without
    supports."""
    none = jnp.zeros(())
    e = equations(scene, initial_state(scene), 1.0, Sizes(none, none, none))
    q = unknowns(e, x)
    return forces(e, q if e.mixed is None else settled(e, q), 1.0).total


def _unknown_pressure(e: Equations, q: jax.Array) -> jax.Array:
    """Return the pressures (V,) [Pa] of the vertices from the unknowns q."""
    return e.mixed.unit * q[3 * e.mesh.number_of_nodes :]


def settled(e: Equations, q: jax.Array, s: Number | None = None) -> jax.Array:
    """Replace the pressures in q by the solution of the pressure equation at fraction s of the step (default: 1)."""
    n, x = 3 * e.mesh.number_of_nodes, positions(e, q, jnp.ones((), q.dtype) if s is None else s)
    pressure = e.mixed.settled(e.mesh, determinant(deformation_gradient(e.mesh, x)))
    return jnp.concatenate([q[:n], pressure / e.mixed.unit])


def flowing_pressure(e: Equations, q: jax.Array, s: Number, guess: Guess) -> jax.Array:
    """Return the pressures (V,) [Pa] of a flowing fluid for the unknowns q (3 V,). The solver starts at `guess`."""
    assert e.volume is not None
    return e.volume.pressure(e.mesh, determinant(deformation_gradient(e.mesh, positions(e, q, s))), guess)


def flowing_lack(e: Equations, q: jax.Array, pressure: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Return the out-of-balance forces (3 V,) [N] at the end of a step, and the residual (V,) of the pressure equation.

    `pressure` (V,) [Pa] contains the pressures at the end of the step.
    """
    volume: Any = e.volume
    f = forces(e, q, jnp.ones((), q.dtype), None, volume.in_force(pressure))
    return flat(_along_free(e, f)), volume.balance(e.mesh, pressure, determinant(f.F))


def _along_free(e: Equations, f: Forces) -> jax.Array:
    """Return the forces (V, 3) [N] in the directions in which the nodes can move.

    The rounding of the first projection leaves a small part of each reaction in the directions that are not free. No
    motion can balance this part, and a linear solve for a very small derivative would never converge. So the forces
    are projected twice.
    """
    along = e.free.vectors(f.total, f.x)
    return along if e.free.normals is None and not e.free.tied else e.free.vectors(along)


def residual(
    e: Equations, q: jax.Array, s: Number, guess: Guess | None = None
) -> tuple[jax.Array, jax.Array, jax.Array | None]:
    """Return out-of-balance forces (3 V,) [N] at fraction s of the step, the sum of all force norms, and the pressures.

    The sum [N] also contains `e.noise`. If the forces are only roundoff, `e.noise` and a further term make the sum so
    large that the iterations end: a body without loads is in equilibrium, also in single precision. If pressures are
    unknowns, the residual of the pressure equation, times `e.mixed.unit` [N], is appended to the forces. The sum then
    contains the isochoric forces with weight 1, and the other forces with a weight of about shear modulus / bulk
    modulus (see `Mixed.counted`).
    """
    f = forces(e, q, s, guess)
    at_work = jnp.linalg.norm(f.internal)
    for force in f.nodal:
        at_work = at_work + jnp.linalg.norm(force)
    nothing = at_work <= _ONLY_ROUNDOFF * e.of_material
    for acting, force in zip(e.nodal, f.nodal, strict=True):
        nothing = nothing if _is_spring(acting) else nothing & jnp.all(force == 0)  # small loads are not roundoff
    if f.x.dtype == jnp.float32:
        nothing = nothing & ~strained_by_motion(e.free, e.mesh.points, f.x)
    noise = e.noise + jnp.where(nothing, ROUNDINGS * e.of_material / e.scene.solve.tolerance, 0.0)
    if f.isochoric is not None:
        at_work = (1 - e.mixed.counted) * jnp.linalg.norm(f.isochoric) + e.mixed.counted * at_work
    r, at_work = flat(_along_free(e, f)), jax.lax.stop_gradient(noise + at_work)
    if e.mixed is not None:
        r = jnp.concatenate([r, e.mixed.unit * e.mixed.balance(e.mesh, f.pressure, determinant(f.F))])
    return r, at_work, f.pressure


def energy(e: Equations, q: jax.Array, start: jax.Array) -> jax.Array:
    """Return the energy [J] of a step for the unknowns q: the sum of the incremental potentials of all force terms.

    At `start` the gradient of the energy is the residual. If all forces have an energy, this holds at every q.
    """
    x, begin = positions(e, q, 1.0), positions(e, start, 1.0)
    F = deformation_gradient(e.mesh, x)
    total = jnp.sum(e.mesh.weights * sum(solid.energy(F) for solid in e.solids))
    if e.volume is not None:
        total = total + e.volume.energy(e.mesh, determinant(F))  # with optimal pressures if pressures are unknowns
    return sum((a.energy_from(e.mesh, x, begin) for a in e.nodal), total)


def advanced(e: Equations, end: End, by_end_forces: jax.Array | None = None) -> State:
    """Return the state after an accepted step. `by_end_forces` (V, 3) is the second result of `reported_forces`."""
    end = end._replace(by_end_forces=by_end_forces)
    each = zip(e.physics, e.state.memories, e.acting, strict=True)
    return State(end.x, tuple(p.advance(memory, acting, end) for p, memory, acting in each))


def reported_forces(e: Equations, total: jax.Array, x: jax.Array) -> tuple[jax.Array, jax.Array | None]:
    """Return (f, a): f (V, 3) [N] is the sum of all forces, from which the reactions follow.

    Terms with `NodalForce.at_end` act only at the end of a step. Their forces are doubled in `total`. In directions
    that are not free, f contains these forces only once. The array a (V, 3) [m/s^2] is minus the accelerations due to
    the doubled forces, or None if there are no such forces.

    Args:
        total: sum of all forces (V, 3) [N] in the step's equations, at positions x (V, 3).
    """
    doubled = _at_end(e, x, 1.0)
    if not doubled:
        return total, None
    force = sum(doubled[1:], doubled[0])
    (mass, a) = next((part, a) for part in e.nodal if (a := part.accelerations(force, x)) is not None)
    return total - 0.5 * (force - mass.inertial(a)), a


def _at_end(e: Equations, x: jax.Array, s: Number) -> list[jax.Array]:
    """Return the doubled forces (V, 3) [N], at step fraction s, of each term that acts only at the end of a step."""
    return [a.force(e.mesh, x, s) for a in e.nodal if a.at_end]


def outputs(scene: Scene, state: State) -> dict[str, jax.Array]:
    """Return additional results at a state, by name, for example the pressures of a fluid at the nodes."""
    shown: dict[str, jax.Array] = {}
    for physics, memory in zip(physics_of(scene), state.memories, strict=True):
        shown |= {name: on_middles(scene.mesh, field) for name, field in physics.output(memory).items()}
    return shown
