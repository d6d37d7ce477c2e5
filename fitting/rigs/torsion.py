"""The rheometer as a differentiable simulation (chapter, sections 5.2 and 5.3).

The sample is a cylinder of tetrahedra. Its bottom is fixed, and its top turns rigidly about the axis by one angle. A
sinusoidal torque (as in the stress-controlled rheometer AR2000) or a sinusoidal angle drives the top. Every time step
is solved by Newton's method and differentiated implicitly. The moduli come from demodulation of the last cycle.

By default, the run starts on the steady cycle of the linearised problem with the same time steps. So there is no
transient in the linear range.
"""

import math
from collections.abc import Callable
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from fitting.rigs.linear_torsion import (  # noqa: F401  names that users import from here
    Held,
    Linearised,
    Response,
    about_held,
    exact_stiffness,
    geometry_factor,
    held,
    held_moduli,
    linear_moduli,
    linearised_rig,
    moving_response,
    steady_response,
    torque_for_strain,
)
from fitting.rigs.plates import (  # noqa: F401  names that users import from here
    HEIGHT,
    RADIUS,
    Rig,
    cell_size_for,
    coordinates,
    linear_cell_for,
    make_rig,
    number_of_coordinates,
    packed,
    rest_height,
    rig_from_mesh,
    sample_positions,
    work_conjugates,
)
from liverjax.core.errors import InputError
from liverjax.core.struct import Number, Numbers
from liverjax.elements import mjed
from liverjax.laws import Law
from liverjax.physics import viscosity
from liverjax.physics.base import End, Free, Physics, Step
from liverjax.physics.elasticity import Elasticity
from liverjax.physics.inertia import Inertia, Motion
from liverjax.physics.prescribed import Fixed, given_acceleration
from liverjax.physics.rigid_plate import RigidPlate
from liverjax.physics.viscosity import Prony, Viscoelasticity
from liverjax.scenes.scene import Body, Scene, Solve
from liverjax.solvers import newton
from liverjax.tensors.matrices import deformation_gradient


class Drive(NamedTuple):
    """Imposed load of the rig (the rheometer with its sample), and the number of steps. A change of any value compiles
    a new program.

    `steps`: time steps per cycle. `cycles`: cycles of a run; the last cycle is demodulated. `by`: imposed quantity,
    "torque" or "angle". `start`: initial state, "cycle" (the steady linear cycle) or "rest".

    The functions that use a drive raise `InputError` if `by` or `start` has another value.
    """

    steps: int = 50
    cycles: int = 1
    by: str = "torque"
    start: str = "cycle"
    options: newton.NewtonOptions = newton.NewtonOptions(tolerance=1e-9)


class Run(NamedTuple):
    """One oscillation of n steps: values (n + 1,) at the times 0, dt, …, and Newton's statistics for each step."""

    time: jax.Array  # [s]
    angle: jax.Array  # [rad]
    torque: jax.Array  # [N m]
    lift: jax.Array  # axial motion of the top plate [m]
    statistics: newton.NewtonStatistics


class Moduli(NamedTuple):
    """Result of a sweep, one entry per frequency or amplitude."""

    storage: jax.Array  # G' [Pa]
    loss: jax.Array  # G'' [Pa]
    strain: jax.Array  # amplitude at the rim, radius * angle / height
    defect: jax.Array  # |angle at the end - angle one period earlier| divided by the amplitude: the remaining transient
    bias: jax.Array  # bias of the mesh, complex; `geometry_factor` if the whole stress relaxes
    statistics: newton.NewtonStatistics  # largest value over the steps


def scene_of(
    rig: Rig, law: Law, prony: Prony | None, omega: Number, amplitude: Number, drive: Drive = Drive()
) -> Scene:
    """Return the oscillation from rest as a scene with a rigid plate for `lj.simulate`. The arguments are the same as
    for `oscillate`.

    `oscillate` with `start="rest"` gives the same result in a fraction of the time. `oscillate` uses the inverse
    of the stiffness, which is possible because the mesh is small.

    Raises:
        InputError: the rig is compressed (`fitting.rigs.compression`), but a scene begins with an uncompressed sample.
    """
    _check_drive(drive)
    if rig.held is not None:
        raise InputError("a compressed rig cannot be converted to a scene: use the rig without its compression")
    steps, n = drive.steps * drive.cycles, rig.mesh.number_of_nodes
    dt = 2 * jnp.pi / (omega * drive.steps)
    times = dt * jnp.arange(steps + 1)
    turn = amplitude * jnp.sin(omega * times)
    plate = RigidPlate(nodes=jnp.arange(n - rig.top, n), turn=turn, times=times, by=drive.by, lifts=rig.free_height)
    return Scene(
        mesh=rig.mesh,
        law=law,
        viscosity=prony,
        body=None if rig.density is None else Body(density=rig.density),
        fixed=(Fixed(nodes=jnp.arange(rig.bottom)),),
        physics=(plate,),
        solve=Solve(
            dt=dt,
            steps=steps,
            kind="static" if rig.density is None else "dynamic",
            integrator="newmark",
            tolerance=drive.options.tolerance,
        ),
    )


class _Oscillation(NamedTuple):
    """One oscillation: the sample and its drive."""

    rig: Rig
    law: Law
    prony: Prony | None
    omega: Number  # [rad/s]
    amplitude: Number  # [N m] or [rad]
    drive: Drive

    @property
    def by_torque(self) -> bool:
        """Whether the torque is given and the angle is unknown."""
        return self.drive.by == "torque"

    @property
    def dt(self) -> Number:
        """Time step [s]."""
        return 2 * jnp.pi / (self.omega * self.drive.steps)

    @property
    def rate(self) -> Number:
        """Ratio of velocity to displacement [rad/s] in a steady cycle of Newmark's average acceleration method."""
        return 2 / self.dt * jnp.tan(self.omega * self.dt / 2)

    def positions(self, q: jax.Array) -> jax.Array:
        """Return the positions (V, 3) [m] for all coordinates q."""
        return sample_positions(self.rig, *coordinates(self.rig, q))

    def full(self, q: jax.Array, t: Number) -> jax.Array:
        """Return all coordinates at time t from the unknown coordinates q."""
        if self.by_torque:
            return q
        return jnp.append(q, self.rig.radius * self.amplitude * jnp.sin(self.omega * t))

    def solved_part(self, q: jax.Array) -> jax.Array:
        """Return the unknown coordinates from all coordinates."""
        return q if self.by_torque else q[:-1]


class _Cycle(NamedTuple):
    """The steady cycle of the linearised rig with the same time steps, and the preconditioner for the solution of a
    time step. The rig is linearised about rest."""

    steady: Response
    arc: Number | complex  # amplitude of the last coordinate [m]
    precondition: Callable[[jax.Array], jax.Array]  # approximate inverse of the tangent matrix of the unknowns
    twist: Number = 0.0  # [N] torque / radius at the angle 0 (see `_twist`), which is subtracted

    def at(self, omega: Number, t: Number) -> jax.Array:
        """Return the coordinates at time t [s]."""
        return jnp.real(self.steady.shape * (self.arc * jnp.exp(1j * omega * t)))


def _oscillate(o: _Oscillation, rest: Linearised) -> tuple[Run, jax.Array]:
    """Return the run, and the bias of the mesh at this frequency. The bias is complex if only the isochoric part
    relaxes."""
    rig, drive = o.rig, o.drive
    modulus = 1.0 if o.prony is None else 1 - jnp.sum(viscosity.complex_ratios(o.prony, o.omega, o.dt), axis=0)
    still = steady_response(rest, modulus)
    steady = still if rig.density is None else moving_response(rest, modulus, o.rate**2)
    # A sin(w t) = Re(-i A e^(i w t)). `arc` is the complex amplitude of the last coordinate in the linearised discrete
    # problem.
    arc = -1j * o.amplitude * (1 / (steady.stiffness * rig.radius) if o.by_torque else rig.radius)
    twist = 0.0 if rig.held is None else jax.lax.stop_gradient(_twist(o))
    cycle = _Cycle(steady, arc, _preconditioner(o, rest), twist)
    q, memories = _initial(o, steady.shape, arc)
    times = o.dt * jnp.arange(1, drive.steps * drive.cycles + 1)
    _, (angle, torque, lift, statistics) = jax.lax.scan(partial(_time_step, o, cycle), (q, memories), times)
    _, lift_0, angle_0 = coordinates(rig, q)
    torque_0 = 0.0 if o.by_torque else rig.radius * jnp.real(steady.stiffness * arc) * (drive.start == "cycle")
    run = Run(
        jnp.append(0.0, times),
        jnp.append(angle_0, angle),
        jnp.append(torque_0, torque),
        jnp.append(lift_0, lift),
        statistics,
    )
    if rest.held is None:
        bias = still.stiffness / (modulus * exact_stiffness(rig, o.law))
    else:
        bias = rest.held.bias_at(modulus, rest.stands)
    return run, bias


def _preconditioner(o: _Oscillation, rest: Linearised) -> Callable[[jax.Array], jax.Array]:
    """Return an approximate inverse of the tangent matrix of a time step: the inverse of the elastic stiffness. If
    there is inertia, the masses times 4 / dt^2 (Newmark's method) are added to the stiffness."""
    if rest.modes is None:
        inverse = jax.lax.stop_gradient(rest.inverse if o.by_torque else _without_last(rest.inverse))
        return lambda r: inverse @ r
    modes, heavy = rest.modes, jax.lax.stop_gradient(4 / o.dt**2)
    if o.by_torque:
        return lambda r: modes.solve(r, 1.0, heavy)
    own = modes.solve(jnp.zeros(len(modes.values)).at[-1].set(1.0), 1.0, heavy)

    def without_last(r: jax.Array) -> jax.Array:
        x = modes.solve(jnp.append(r, 0.0), 1.0, heavy)
        return (x - own * x[-1] / own[-1])[:-1]

    return without_last


def _twist(o: _Oscillation) -> jax.Array:
    """Return torque / radius [N] of the compressed, relaxed sample at the angle 0. It is not exactly 0, because the
    mesh is not quite symmetric."""
    standing = 1.0 if o.prony is None else 1 - jnp.sum(jnp.asarray(o.prony.ratios))
    x = o.positions(jnp.zeros(number_of_coordinates(o.rig), o.rig.mesh.points.dtype))
    return standing * work_conjugates(o.rig, x, mjed.internal_force(o.rig.mesh, o.law, x))[2]


def _time_step(o: _Oscillation, cycle: _Cycle, carry: tuple, t: jax.Array) -> tuple[tuple, tuple]:
    """Solve one time step. Returns the new coordinates and internal variables, then angle, torque, lift and
    Newton's statistics."""
    (q_old, memories), rig, mesh = carry, o.rig, o.rig.mesh
    mask, given = jnp.ones_like(mesh.points), None
    steps, tolerance = o.drive.steps * o.drive.cycles, o.drive.options.tolerance
    if not o.by_torque and o.drive.start == "rest":
        # The velocity of the top plate jumps at the start, so its acceleration would oscillate in the average
        # acceleration method. Therefore this acceleration is computed from the given angle.
        mask = mask.at[len(mask) - rig.top :, :2].set(0.0)
        still = jnp.zeros_like(o.solved_part(q_old))
        place = lambda k: o.positions(o.full(still, k * o.dt))  # noqa: E731
        given = given_acceleration(place, jnp.round(t / o.dt), steps, o.dt) if rig.density is not None else None
    physics, free = _sample_physics(rig, o.law, o.prony), Free(mask)
    begin = Step(mesh, o.positions(q_old), 1, steps, o.dt, True, tolerance, free, given=given)
    solid, *nodal = (p.freeze(memory, begin) for p, memory in zip(physics, memories, strict=True))

    def forces(q):
        x = o.positions(q)
        f = mjed.nodal_force(mesh, solid.stress(deformation_gradient(mesh, x)))
        f = sum((a.force(mesh, x, 1.0) for a in nodal), f)
        return packed(rig, *work_conjugates(rig, x, f)).at[-1].add(-cycle.twist)

    load = jnp.zeros_like(q_old)
    if o.by_torque:
        load = load.at[-1].set(o.amplitude * jnp.sin(o.omega * t) / rig.radius)
    # The guess is the linear solution at this time, plus the deviation of the last step from the linear solution.
    guess = cycle.at(o.omega, t) + (q_old - cycle.at(o.omega, t - o.dt))
    q, statistics = newton.newton_root(
        lambda v: o.solved_part(forces(o.full(v, t)) - load),
        o.solved_part(guess),
        cycle.precondition,
        jnp.abs(cycle.steady.stiffness * cycle.arc),
        o.drive.options,
    )
    q = o.full(q, t)
    torque = load[-1] * rig.radius if o.by_torque else forces(q)[-1] * rig.radius
    x = o.positions(q)
    end, each = End(x, deformation_gradient(mesh, x), None), zip(physics, memories, (solid, *nodal), strict=True)
    memories = tuple(p.advance(memory, acting, end) for p, memory, acting in each)
    _, lift, angle = coordinates(rig, q)
    return (q, memories), (angle, torque, lift, statistics)


def _without_last(inverse: jax.Array) -> jax.Array:
    """Return the inverse of a symmetric matrix without its last row and column (Schur complement). `inverse`: inverse
    of the matrix with this row and column."""
    b = inverse[:-1, -1]
    return inverse[:-1, :-1] - jnp.outer(b, b) / inverse[-1, -1]


def _sample_physics(rig: Rig, law: Law, prony: Prony | None) -> tuple[Physics, ...]:
    """Return the physics objects of the sample: its solid, and its inertia if the rig has a density."""
    solid = Elasticity(law=law) if prony is None else Viscoelasticity(law=law, prony=prony)
    return (solid,) if rig.density is None else (solid, Inertia(density=rig.density, integrator="newmark"))


def _initial(o: _Oscillation, shape: jax.Array, arc: Number | complex) -> tuple[jax.Array, tuple]:
    """Return the coordinates at time 0 and the internal variables of the physics objects (here `memories`), either at
    rest or on the cycle of the linearised problem."""
    rig, prony, on_cycle, mesh = o.rig, o.prony, o.drive.start == "cycle", o.rig.mesh
    q = jnp.real(shape * arc) if on_cycle else jnp.zeros(shape.shape, mesh.points.dtype)
    history = None if prony is None else viscosity.initial_history(prony, mesh.volumes.shape[0], q.dtype)

    def S(q):
        return viscosity.relaxing_stress(prony, o.law, deformation_gradient(mesh, o.positions(q)))

    if prony is not None and rig.held is not None:  # the sample stayed compressed until its stress had relaxed
        stands = S(jnp.zeros_like(q))
        history = viscosity.relaxed_history(prony, stands)
    if prony is not None and on_cycle:
        _, slope = jax.linearize(S, jnp.zeros_like(q))
        S_shape = slope(jnp.real(shape)) * arc
        # If the shape is real, the derivative along its imaginary part is not needed. This derivative would be a fifth
        # of the compiled program.
        if jnp.iscomplexobj(shape):
            S_shape += slope(jnp.imag(shape)) * 1j * arc
        ratios = viscosity.complex_ratios(prony, o.omega, o.dt)
        gamma = jnp.real(ratios[:, None, None] * S_shape[None])
        moving = viscosity.History(gamma, None if prony.scheme == "backward_euler" else jnp.real(S_shape))
        history = jax.tree.map(jnp.add, history, moving)
    if rig.density is None:
        return q, (history,)
    _, field = jax.linearize(o.positions, jnp.zeros_like(q))
    on = 1.0 if on_cycle else 0.0
    return q, (history, Motion(*(field(on * jnp.real(c * shape * arc)) for c in (1j * o.rate, -(o.rate**2)))))


@partial(jax.jit, static_argnames="drive")
def oscillate(rig: Rig, law: Law, prony: Prony | None, omega: Number, amplitude: Number, drive: Drive = Drive()) -> Run:
    """Drive the rig with amplitude * sin(omega t).

    Args:
        rig: the rig, from `make_rig`.
        law: any law of the instantaneous response.
        prony: relaxation of the law, or None.
        omega: angular frequency [rad/s].
        amplitude: amplitude of the torque [N m] or of the angle [rad].
        drive: see `Drive`; a change compiles a new program.
    """
    _check_drive(drive)
    return _oscillate(_Oscillation(rig, law, prony, omega, amplitude, drive), linearised_rig(rig, law, prony))[0]


def _check_drive(drive: Drive) -> None:
    for key, words in (("by", ("torque", "angle")), ("start", ("cycle", "rest"))):
        if getattr(drive, key) not in words:
            raise InputError(f"drive {key} = {getattr(drive, key)!r} is not known: use {' or '.join(words)}")


def demodulate(run: Run, omega: Number, drive: Drive) -> tuple[jax.Array, jax.Array]:
    """Return the complex amplitudes of torque [N m] and angle [rad] over the last cycle."""
    carrier = 2 / drive.steps * jnp.exp(-1j * omega * run.time[-drive.steps :])
    return jnp.sum(carrier * run.torque[-drive.steps :]), jnp.sum(carrier * run.angle[-drive.steps :])


@partial(jax.jit, static_argnames=("drive",))
def moduli(
    rig: Rig, law: Law, prony: Prony | None, omega: jax.Array, amplitude: jax.Array, drive: Drive = Drive()
) -> Moduli:
    """Return G* = 2 h M / (pi r^4 theta) of many oscillations (chapter, section 5.3). One compiled program computes all
    of them. The sample has height h and radius r, M is the torque, and theta is the angle.

    The moduli are divided by the bias of the mesh, `geometry_factor`. If only the isochoric part relaxes, the bias
    depends on the frequency, because the bulk modulus has more effect when the shear modulus has relaxed. If the rig
    has a density, the inertial part of the torque is divided by the bias too. This is not exact, so refine the mesh.
    Multiply the moduli by `Moduli.bias` to get the moduli of the mesh without this correction.

    Args:
        omega, amplitude: arrays (n,) or single values, which are broadcast; see `oscillate`.
    """
    _check_drive(drive)
    rest = linearised_rig(rig, law, prony)
    omega, amplitude = jnp.broadcast_arrays(jnp.asarray(omega, float), jnp.asarray(amplitude, float))

    def one(omega, amplitude):
        run, bias = _oscillate(_Oscillation(rig, law, prony, omega, amplitude, drive), rest)
        torque, angle = demodulate(run, omega, drive)
        G = 2 * rig.height / (jnp.pi * rig.radius**4) * torque / angle / bias
        defect = jnp.abs(run.angle[-1] - run.angle[-1 - drive.steps]) / jnp.abs(angle)
        worst = newton.NewtonStatistics(*(jnp.max(field) for field in run.statistics))
        return Moduli(jnp.real(G), jnp.imag(G), jnp.abs(angle) * rig.radius / rig.height, defect, bias, worst)

    lanes = jnp.atleast_1d(omega), jnp.atleast_1d(amplitude)
    # On a CPU, the oscillations run one after another, because the data of one oscillation fit into the cache (1.7
    # times faster for the Jacobian). A GPU runs all of them at once.
    return jax.lax.map(lambda lane: one(*lane), lanes) if jax.default_backend() == "cpu" else jax.vmap(one)(*lanes)


def strain_sweep(
    rig: Rig, law: Law, prony: Prony | None, strains: Numbers, omega: float = 2 * math.pi, drive: Drive | None = None
) -> Moduli:
    """Return the moduli of a dynamic strain sweep (chapter, section 5.2) for strain amplitudes at the rim. By default,
    the angle is imposed, for three cycles at each amplitude.

    Args:
        strains: amplitudes at the rim, e.g. 1e-4 … 0.2.
        omega: angular frequency [rad/s], default 1 Hz.
        drive: see `Drive`; the angle must be imposed.

    Raises:
        InputError: the drive imposes the torque.
    """
    drive = drive or Drive(cycles=3, by="angle")
    if drive.by != "angle":
        raise InputError(f"drive by = {drive.by!r} cannot impose strains: use by = 'angle'")
    return moduli(rig, law, prony, omega, jnp.asarray(strains) * rig.height / rig.radius, drive)


def linearity_limit(strains: Numbers, storage: Numbers, deviation: float = 0.05) -> float:
    """Return the strain at which G' differs by the fraction `deviation` from its value at the smallest strain.
    Returns infinity if G' never differs that much. The strains may have any order.

    If a modulus is not finite (a diverged run) before this strain, the last strain with a finite modulus is returned,
    or NaN if the first modulus is not finite.
    """
    order = np.argsort(np.asarray(strains))
    strains, storage = np.asarray(strains)[order], np.asarray(storage)[order]
    change = np.abs(storage / storage[0] - 1)
    beyond = np.flatnonzero(~(change <= deviation))
    if not len(beyond):
        return math.inf
    k = beyond[0]
    if not np.isfinite(change[k]):
        return float(strains[k - 1]) if k else math.nan
    return float(np.exp(np.interp(deviation, change[k - 1 : k + 1], np.log(strains[k - 1 : k + 1]))))
