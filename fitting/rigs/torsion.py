"""The rheometer as a differentiable simulation (chapter, sections 5.2 and 5.3).

A cylinder of tetrahedra, its bottom gripped, its top turning rigidly about the axis by one angle. A sinusoidal torque
(the stress-controlled AR2000) or angle drives it; every time step is solved by Newton's method and differentiated
implicitly; the moduli come from demodulating the last cycle.

The run starts on the steady cycle of the linearised discrete problem, so in the linear range no transient has to die.
"""

import math
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from liverjax.core.errors import InputError
from liverjax.core.struct import param, replace, static, struct
from liverjax.elements import mjed
from liverjax.laws import Law, isochoric_part, volumetric_part
from liverjax.mesh import shapes
from liverjax.mesh.tetrahedra import TetMesh, tet_mesh
from liverjax.physics import viscosity
from liverjax.physics.base import End, Free, Physics, Step
from liverjax.physics.elasticity import Elasticity
from liverjax.physics.inertia import Inertia, Motion
from liverjax.physics.prescribed import Fixed
from liverjax.physics.rigid_plate import RigidPlate
from liverjax.physics.viscosity import Prony, Viscoelasticity
from liverjax.scenes.scene import Body, Scene, Solve
from liverjax.solvers import newton
from liverjax.tensors.material_axes import symmetric
from liverjax.tensors.matrices import deformation_gradient, matmul

#: Chapter, section 5.3; its section 5.2 prints 41 mm for 4 mm +- 1 mm (at 41 mm inertia resonates inside the band).
RADIUS, HEIGHT = 0.010, 0.004


@struct
class Rig:
    """A sample between two plates; nodes are ordered bottom plate, free, top plate."""

    mesh: TetMesh = param("m", "the sample")
    radius: Any = param("m", "plate radius")
    height: Any = param("m", "gap")
    density: Any = param("kg/m^3", "None: no inertia, and no velocity is carried", default=None)
    bottom: int = static(about="number of nodes on the gripped plate")
    top: int = static(about="number of nodes on the turning plate")
    held: Any = param("m", "positions (V, 3) of the compressed sample; None: it is not (`compression`)", default=None)
    free_height: bool = static(default=False, about="the top plate may also move along the axis under no axial force")


class Drive(NamedTuple):
    """How the rig is driven and resolved; static under jit.

    `steps` a cycle, `cycles` run (the last is demodulated), `by` "torque" or "angle", `start` "cycle" or "rest".
    """

    steps: int = 50
    cycles: int = 1
    by: str = "torque"
    start: str = "cycle"
    options: newton.NewtonOptions = newton.NewtonOptions(tolerance=1e-9)


class Run(NamedTuple):
    """One oscillation: samples at times 0, dt, … (n + 1,), and what Newton did in each of the n steps."""

    time: jax.Array  # [s]
    angle: jax.Array  # [rad]
    torque: jax.Array  # [N m]
    lift: jax.Array  # axial motion of the top plate [m]
    statistics: newton.NewtonStatistics


class Moduli(NamedTuple):
    """Result of a sweep, one entry a frequency or amplitude."""

    storage: jax.Array  # G' [Pa]
    loss: jax.Array  # G'' [Pa]
    strain: jax.Array  # amplitude at the rim, radius * angle / height
    defect: jax.Array  # |angle at the end - one period earlier| / amplitude: what is left of the transient
    bias: jax.Array  # of the mesh, complex; `geometry_factor` where the whole stress relaxes
    statistics: newton.NewtonStatistics  # worst over the steps


def cell_size_for(radius: float, height: float) -> float:
    """Default cell [m]: 100 to 400 nodes for any shape; geometry_factor removes the error that leaves if linear."""
    return max((math.pi * radius**2 * height / 100) ** (1 / 3), radius / 6, height / 12)


def linear_cell_for(radius: float, height: float) -> float:
    """Cell [m] of about 100 nodes: enough for small strain without inertia, where `bias` holds all of the mesh's error.

    The rest of the error is of the order of the strain: at 1e-3 the moduli differ by 1e-5 from those of `cell_size_for`
    (experiments/benchmarks/torsion_speed.py).
    """
    return max((math.pi * radius**2 * height / 30) ** (1 / 3), radius / 4, height / 8)


def make_rig(
    radius: float = RADIUS,
    height: float = HEIGHT,
    cell_size: float | None = None,
    free_height: bool = False,
    density: float | None = None,
) -> Rig:
    """A rig with a generated cylinder.

    Args:
        radius, height: of the sample [m].
        cell_size: edge length of the mesh [m]; default `cell_size_for`.
        free_height: let the top plate rise (Poynting effect) instead of holding the gap.
        density: [kg/m^3]; `None` leaves inertia out.

    Raises:
        InputError: lengths that are not positive.
    """
    for name, value in (("radius", radius), ("height", height)):
        if not (math.isfinite(value) and value > 0):
            raise InputError(f"{name} = {value} must be positive: give the plate {name} in metres")
    mesh = shapes.cylinder(radius, height, cell_size or cell_size_for(radius, height))
    return rig_from_mesh(mesh, radius, height, free_height, density)


def rig_from_mesh(
    mesh: TetMesh, radius: float, height: float, free_height: bool = False, density: float | None = None
) -> Rig:
    """A rig around any mesh whose axis is z and whose plates are its lowest and highest planes."""
    points, tets = np.asarray(mesh.points), np.asarray(mesh.tetrahedra)
    z = points[:, 2]
    near = 1e-9 * (z.max() - z.min())
    plate = np.where(z < z.min() + near, 0, np.where(z > z.max() - near, 2, 1))
    order = np.argsort(plate, kind="stable")
    number = np.argsort(order)
    return Rig(
        mesh=tet_mesh(points[order], number[tets]),
        radius=radius,
        height=height,
        density=density,
        bottom=int((plate == 0).sum()),
        top=int((plate == 2).sum()),
        free_height=free_height,
    )


# -- kinematics of the rig: generalised coordinates (u of free nodes, lift, arc = radius * angle) ----------------------


def _positions(rig: Rig, u: jax.Array, lift: Any, angle: Any) -> jax.Array:
    X = rig.mesh.points if rig.held is None else rig.held
    n = X.shape[0] - rig.top
    c, s = jnp.cos(angle), jnp.sin(angle)
    x, y, z = X[n:].T
    top = jnp.stack([c * x - s * y, s * x + c * y, z + lift], axis=-1)
    return jnp.concatenate([X[: rig.bottom], X[rig.bottom : n] + u.reshape(-1, 3), top])


def _generalised(rig: Rig, x: jax.Array, f: jax.Array) -> tuple[jax.Array, jax.Array, jax.Array]:
    """Work conjugates of (u, lift, arc): nodal forces, axial force, torque / radius [N]."""
    n = x.shape[0] - rig.top
    top, force = x[n:], f[n:]
    torque = jnp.sum(top[:, 0] * force[:, 1] - top[:, 1] * force[:, 0])
    return f[rig.bottom : n].ravel(), jnp.sum(force[:, 2]), torque / rig.radius


def _unpack(rig: Rig, q: jax.Array) -> tuple[jax.Array, jax.Array, jax.Array]:
    """(u, lift, angle) of the full vector of coordinates, angle last."""
    if rig.free_height:
        return q[:-2], q[-2], q[-1] / rig.radius
    return q[:-1], jnp.zeros((), q.dtype), q[-1] / rig.radius


def _pack(rig: Rig, u: jax.Array, axial: jax.Array, arc: jax.Array) -> jax.Array:
    return jnp.concatenate([u, axial[None], arc[None]] if rig.free_height else [u, arc[None]])


def _rest_stiffness(rig: Rig, law: Law) -> jax.Array:
    """Elastic tangent at rest in the rig's coordinates, dense (n, n) [N/m]."""
    mesh = rig.mesh
    V = mesh.points.shape[0]
    dofs = (3 * mesh.tetrahedra[:, :, None] + jnp.arange(3)[None, None]).reshape(-1, 12)
    entries = mjed.element_matrices(mesh, law, mesh.points).reshape(-1, 12, 12)
    dense = jnp.zeros((3 * V, 3 * V), mesh.points.dtype).at[dofs[:, :, None], dofs[:, None, :]].add(entries)
    first, n = 3 * rig.bottom, 3 * (V - rig.top)
    X = mesh.points[V - rig.top :]
    turn = jnp.stack([-X[:, 1], X[:, 0], jnp.zeros(rig.top)], axis=-1).ravel() / rig.radius
    columns = [turn]
    if rig.free_height:
        columns = [jnp.tile(jnp.array([0.0, 0.0, 1.0]), rig.top), turn]
    T = jnp.stack(columns, axis=-1)
    K_fp = dense[first:n, n:] @ T
    K_pp = T.T @ dense[n:, n:] @ T
    return jnp.block([[dense[first:n, first:n], K_fp], [K_fp.T, K_pp]])


class _Response(NamedTuple):
    """The linear answer of the rig: coordinates per unit arc length (real or complex), and force per arc length."""

    shape: jax.Array  # (n,), its last entry 1
    stiffness: jax.Array  # [N/m]


def _response(column: jax.Array) -> _Response:
    """The answer, from the coordinates (n,) that a unit force on the last of them causes."""
    return _Response(column / column[-1], 1 / column[-1])


def _exact_stiffness(rig: Rig, law: Law) -> Any:
    """Force per arc length of the true elastic cylinder, pi r^2 G / (2 h) [N/m]."""
    return jnp.pi * rig.radius**2 * law.shear_modulus() / (2 * rig.height)


@jax.jit
def geometry_factor(rig: Rig, law: Law) -> jax.Array:
    """Elastic torsional stiffness of the mesh over pi r^4 G / (2 h): what the polygon and the stiff elements add.

    Moduli divided by it are free of that bias in the linear range.
    """
    inverse = jnp.linalg.inv(_rest_stiffness(rig, law))
    return _response(inverse[:, -1]).stiffness / _exact_stiffness(rig, law)


class _Linearised(NamedTuple):
    """The rig as it is held, before any frequency is known."""

    inverse: jax.Array  # of the stiffness (n, n) against a motion too quick to relax
    relaxing: jax.Array | None  # the part of the stiffness that relaxes and the part that stands, where they differ
    standing: jax.Array | None
    bias: jax.Array | None = None  # of the mesh, where the sample is compressed: `geometry_factor` of its rest


def _linearise(rig: Rig, law: Law, prony: Prony | None) -> _Linearised:
    if rig.held is not None:
        relaxing, standing, bias = held(rig, law)
        standing = standing * (1.0 if prony is None else 1 - jnp.sum(jnp.asarray(prony.ratios)))
        return _Linearised(jnp.linalg.inv(relaxing + standing), relaxing, standing, bias)
    if prony is None or prony.part == "all":
        return _Linearised(jnp.linalg.inv(_rest_stiffness(rig, law)), None, None)
    isochoric, volumetric = (_rest_stiffness(rig, part(law)) for part in (isochoric_part, volumetric_part))
    return _Linearised(jnp.linalg.inv(isochoric + volumetric), isochoric, volumetric)


def _rest_height(rig: Rig) -> jax.Array:
    """Height of the sample before it is compressed [m]."""
    z = rig.mesh.points[:, 2]
    return jnp.max(z) - jnp.min(z)


def _coordinates(rig: Rig) -> int:
    """Number of coordinates."""
    return 3 * (rig.mesh.number_of_nodes - rig.top - rig.bottom) + 1 + rig.free_height


def about_held(rig: Rig, law: Law) -> tuple[jax.Array, jax.Array]:
    """Stiffness (n, n) [N/m] of a compressed sample in two parts: of changing stress, and of the stress that stands.

    A motion only turns a stress S that has stood for long; the second part is that of the unrelaxed S.
    """
    mesh = rig.mesh
    rest = jnp.zeros(_coordinates(rig), mesh.points.dtype)
    elastic = Prony(ratios=jnp.zeros(0), relaxation_times=jnp.zeros(0))

    def gradient(q):
        return deformation_gradient(mesh, _positions(rig, *_unpack(rig, q)))

    def stress(q):
        return viscosity.relaxing_stress(elastic, law, gradient(q))

    def forces(q, S):
        x = _positions(rig, *_unpack(rig, q))
        f = mjed.nodal_force(mesh, matmul(gradient(q), symmetric(tuple(S))))
        return _pack(rig, *_generalised(rig, x, f))

    S = stress(rest)
    standing = jax.jacfwd(forces)(rest, S)
    return jax.jacfwd(lambda q: forces(q, stress(q)))(rest) - standing, standing


def axial_force(rig: Rig, law: Law) -> jax.Array:
    """Force [N] with which a compressed sample, before it relaxes, pushes the plates apart."""
    x = _positions(rig, *_unpack(rig, jnp.zeros(_coordinates(rig), rig.mesh.points.dtype)))
    return -_generalised(rig, x, mjed.internal_force(rig.mesh, law, x))[1]


def _steady(rest: _Linearised, modulus: Any) -> _Response:
    """Response on the steady cycle where the relaxing stress is `modulus` times the elastic one (complex)."""
    if rest.relaxing is None:
        elastic = _response(rest.inverse[:, -1])
        return _Response(elastic.shape, elastic.stiffness * modulus)
    K = modulus * rest.relaxing + rest.standing
    return _response(jnp.linalg.solve(K, jnp.zeros(K.shape[0], K.dtype).at[-1].set(1.0)))


def torque_for_strain(rig: Rig, modulus: Any, strain: Any) -> Any:
    """Torque amplitude [N m] that gives about `strain` at the rim of a sample of dynamic modulus |G*| [Pa]."""
    return jnp.pi * rig.radius**3 / 2 * modulus * strain


def scene_of(rig: Rig, law: Law, prony: Prony | None, omega: Any, amplitude: Any, drive: Drive = Drive()) -> Scene:
    """The oscillation as a scene with a rigid plate, for `lj.simulate`, from rest. Arguments are those of `oscillate`.

    `oscillate` with `start="rest"` has the same answer in a fraction of the time: it knows the inverse of the small
    body's stiffness.
    """
    steps, n = drive.steps * drive.cycles, rig.mesh.number_of_nodes
    dt = 2 * jnp.pi / (omega * drive.steps)
    times = dt * jnp.arange(steps + 1)
    turn = amplitude * jnp.sin(omega * times)
    plate = RigidPlate(nodes=jnp.arange(n - rig.top, n), turn=turn, times=times, by=drive.by, lifts=rig.free_height)
    moves = rig.density is not None
    return Scene(
        mesh=rig.mesh,
        law=law,
        viscosity=prony,
        body=Body(density=rig.density) if moves else None,
        fixed=(Fixed(nodes=jnp.arange(rig.bottom)),),
        physics=(plate,),
        solve=Solve(
            dt=dt,
            steps=steps,
            kind="dynamic" if moves else "static",
            integrator="newmark",
            tolerance=drive.options.tolerance,
        ),
    )


# -- time stepping -----------------------------------------------------------------------------------------------------


class _Oscillation(NamedTuple):
    """One oscillation: the sample and its drive."""

    rig: Rig
    law: Law
    prony: Prony | None
    omega: Any  # [rad/s]
    amplitude: Any  # [N m] or [rad]
    drive: Drive

    @property
    def by_torque(self) -> bool:
        """Whether the torque is given and the angle unknown."""
        return self.drive.by == "torque"

    @property
    def dt(self) -> Any:
        """Time step [s]."""
        return 2 * jnp.pi / (self.omega * self.drive.steps)

    def positions(self, q: jax.Array) -> jax.Array:
        """Positions (V, 3) [m] of all coordinates."""
        return _positions(self.rig, *_unpack(self.rig, q))

    def full(self, q: jax.Array, t: Any) -> jax.Array:
        """All coordinates at time t, from the unknown ones."""
        if self.by_torque:
            return q
        return jnp.append(q, self.rig.radius * self.amplitude * jnp.sin(self.omega * t))

    def solved_part(self, q: jax.Array) -> jax.Array:
        """The unknown ones of all coordinates."""
        return q if self.by_torque else q[:-1]


class _Cycle(NamedTuple):
    """The steady cycle of the linearised discrete problem, and the inverse stiffness for its solution."""

    steady: _Response
    arc: Any  # complex amplitude of the last coordinate [m]
    inverse: jax.Array  # of the elastic stiffness of what is solved for
    twist: Any = (
        0.0  # force [N] with which a compressed mesh, never quite symmetric, turns of itself: no part of a test
    )

    def at(self, omega: Any, t: Any) -> jax.Array:
        """Coordinates at time t [s]."""
        return jnp.real(self.steady.shape * (self.arc * jnp.exp(1j * omega * t)))


def _oscillate(o: _Oscillation, rest: _Linearised) -> tuple[Run, jax.Array]:
    """The run, and the bias of the mesh at this frequency (complex where only the isochoric part relaxes)."""
    rig, drive = o.rig, o.drive
    modulus = 1.0 if o.prony is None else 1 - jnp.sum(viscosity.complex_ratios(o.prony, o.omega, o.dt), axis=0)
    steady = _steady(rest, modulus)
    # A sin(w t) = Re(-i A e^(i w t)); the complex arc of the linearised discrete problem.
    arc = -1j * o.amplitude * (1 / (steady.stiffness * rig.radius) if o.by_torque else rig.radius)
    inverse = jax.lax.stop_gradient(rest.inverse if o.by_torque else _without_last(rest.inverse))
    twist = 0.0 if rig.held is None else jax.lax.stop_gradient(_twist(o))
    cycle = _Cycle(steady, arc, inverse, twist)
    q, memories = _initial(o, steady.shape, arc)
    times = o.dt * jnp.arange(1, drive.steps * drive.cycles + 1)
    _, (angle, torque, lift, statistics) = jax.lax.scan(partial(_time_step, o, cycle), (q, memories), times)
    _, lift_0, angle_0 = _unpack(rig, q)
    torque_0 = 0.0 if o.by_torque else rig.radius * jnp.real(steady.stiffness * arc) * (drive.start == "cycle")
    run = Run(
        jnp.append(0.0, times),
        jnp.append(angle_0, angle),
        jnp.append(torque_0, torque),
        jnp.append(lift_0, lift),
        statistics,
    )
    bias = steady.stiffness / (modulus * _exact_stiffness(rig, o.law)) if rest.bias is None else rest.bias + 0j
    return run, bias


def _twist(o: _Oscillation) -> jax.Array:
    """Torque of the held sample over the radius [N], relaxed."""
    standing = 1.0 if o.prony is None else 1 - jnp.sum(jnp.asarray(o.prony.ratios))
    x = o.positions(jnp.zeros(_coordinates(o.rig), o.rig.mesh.points.dtype))
    return standing * _generalised(o.rig, x, mjed.internal_force(o.rig.mesh, o.law, x))[2]


def _time_step(o: _Oscillation, cycle: _Cycle, carry: tuple, t: jax.Array) -> tuple[tuple, tuple]:
    """One time step: coordinates and memories, then angle, torque, lift and what Newton did."""
    (q_old, memories), rig, mesh = carry, o.rig, o.rig.mesh
    physics, free = _sample_physics(rig, o.law, o.prony), Free(jnp.ones_like(mesh.points))
    steps, tolerance = o.drive.steps * o.drive.cycles, o.drive.options.tolerance
    begin = Step(mesh, o.positions(q_old), 1, steps, o.dt, True, tolerance, free)
    solid, *nodal = (p.freeze(memory, begin) for p, memory in zip(physics, memories, strict=True))

    def forces(q):
        x = o.positions(q)
        f = mjed.nodal_force(mesh, solid.stress(deformation_gradient(mesh, x)))
        f = sum((a.force(mesh, x, 1.0) for a in nodal), f)
        return _pack(rig, *_generalised(rig, x, f)).at[-1].add(-cycle.twist)

    load = jnp.zeros_like(q_old)
    if o.by_torque:
        load = load.at[-1].set(o.amplitude * jnp.sin(o.omega * t) / rig.radius)
    # The linear solution moves on; what the last step deviated from it is kept.
    guess = cycle.at(o.omega, t) + (q_old - cycle.at(o.omega, t - o.dt))
    q, statistics = newton.newton_root(
        lambda v: o.solved_part(forces(o.full(v, t)) - load),
        o.solved_part(guess),
        lambda r: cycle.inverse @ r,
        jnp.abs(cycle.steady.stiffness * cycle.arc),
        o.drive.options,
    )
    q = o.full(q, t)
    torque = load[-1] * rig.radius if o.by_torque else forces(q)[-1] * rig.radius
    x = o.positions(q)
    end, each = End(x, deformation_gradient(mesh, x), None), zip(physics, memories, (solid, *nodal), strict=True)
    memories = tuple(p.advance(memory, acting, end) for p, memory, acting in each)
    _, lift, angle = _unpack(rig, q)
    return (q, memories), (angle, torque, lift, statistics)


def _without_last(inverse: jax.Array) -> jax.Array:
    """Inverse of a symmetric matrix without its last row and column, from the whole inverse (Schur complement)."""
    b = inverse[:-1, -1]
    return inverse[:-1, :-1] - jnp.outer(b, b) / inverse[-1, -1]


def _sample_physics(rig: Rig, law: Law, prony: Prony | None) -> tuple[Physics, ...]:
    """The sample: its solid, and its mass where the rig has a density."""
    solid = Elasticity(law=law) if prony is None else Viscoelasticity(law=law, prony=prony)
    return (solid,) if rig.density is None else (solid, Inertia(density=rig.density, integrator="newmark"))


def _initial(o: _Oscillation, shape: jax.Array, arc: Any) -> tuple[jax.Array, tuple]:
    """Coordinates at time 0, and what the physics remember: at rest, or on the cycle of the linearised problem."""
    rig, prony, on_cycle, mesh = o.rig, o.prony, o.drive.start == "cycle", o.rig.mesh
    q = jnp.real(shape * arc) if on_cycle else jnp.zeros(shape.shape, mesh.points.dtype)
    history = None if prony is None else viscosity.initial_history(prony, mesh.volumes.shape[0], q.dtype)

    def S(q):
        return viscosity.relaxing_stress(prony, o.law, deformation_gradient(mesh, o.positions(q)))

    if prony is not None and rig.held is not None:  # it has been held until nothing relaxes any more
        stands = S(jnp.zeros_like(q))
        history = viscosity.relaxed_history(prony, stands)
    if prony is not None and on_cycle:
        _, slope = jax.linearize(S, jnp.zeros_like(q))
        S_shape = slope(jnp.real(shape)) * arc
        if jnp.iscomplexobj(shape):  # a real shape needs the slope once: it is a fifth of the program
            S_shape += slope(jnp.imag(shape)) * 1j * arc
        ratios = viscosity.complex_ratios(prony, o.omega, o.dt)
        gamma = jnp.real(ratios[:, None, None] * S_shape[None])
        moving = viscosity.History(gamma, None if prony.scheme == "backward_euler" else jnp.real(S_shape))
        history = jax.tree.map(jnp.add, history, moving)
    if rig.density is None:
        return q, (history,)
    _, field = jax.linearize(o.positions, jnp.zeros_like(q))
    on = 1.0 if on_cycle else 0.0
    return q, (history, Motion(*(field(on * jnp.real(c * shape * arc)) for c in (1j * o.omega, -(o.omega**2)))))


@partial(jax.jit, static_argnames="drive")
def oscillate(rig: Rig, law: Law, prony: Prony | None, omega: Any, amplitude: Any, drive: Drive = Drive()) -> Run:
    """Drive the rig by amplitude * sin(omega t).

    Args:
        rig: `make_rig`.
        law: any law: the instantaneous response.
        prony: its relaxation, or `None`.
        omega: angular frequency [rad/s].
        amplitude: [N m] if driven by torque, [rad] if by angle.
        drive: static.
    """
    return _oscillate(_Oscillation(rig, law, prony, omega, amplitude, drive), _linearise(rig, law, prony))[0]


def demodulate(run: Run, omega: Any, drive: Drive) -> tuple[jax.Array, jax.Array]:
    """Complex amplitudes of torque [N m] and angle [rad] over the last cycle."""
    carrier = 2 / drive.steps * jnp.exp(-1j * omega * run.time[-drive.steps :])
    return jnp.sum(carrier * run.torque[-drive.steps :]), jnp.sum(carrier * run.angle[-drive.steps :])


@partial(jax.jit, static_argnames=("drive", "corrected"))
def moduli(
    rig: Rig,
    law: Law,
    prony: Prony | None,
    omega: jax.Array,
    amplitude: jax.Array,
    drive: Drive = Drive(),
    corrected: bool = True,
) -> Moduli:
    """G* = 2 h / (pi r^4) M / theta of many oscillations at once (section 5.3), one compiled program for all.

    Args:
        omega, amplitude: (n,) or numbers, broadcast; see `oscillate`.
        corrected: divide by the bias of the mesh, `geometry_factor` (at each frequency its own where only the
            isochoric part relaxes, since the bulk then weighs more as the modulus falls). With a density the
            inertial part is divided as well: refine the mesh there instead.
    """
    rest = _linearise(rig, law, prony)
    omega, amplitude = jnp.broadcast_arrays(jnp.asarray(omega, float), jnp.asarray(amplitude, float))

    def one(omega, amplitude):
        run, bias = _oscillate(_Oscillation(rig, law, prony, omega, amplitude, drive), rest)
        torque, angle = demodulate(run, omega, drive)
        G = 2 * rig.height / (jnp.pi * rig.radius**4) * torque / angle / (bias if corrected else 1.0)
        defect = jnp.abs(run.angle[-1] - run.angle[-1 - drive.steps]) / jnp.abs(angle)
        worst = newton.NewtonStatistics(*(jnp.max(field) for field in run.statistics))
        return Moduli(jnp.real(G), jnp.imag(G), jnp.abs(angle) * rig.radius / rig.height, defect, bias, worst)

    lanes = jnp.atleast_1d(omega), jnp.atleast_1d(amplitude)
    # One lane after another stays in a CPU's cache (1.7 times faster for the Jacobian); a GPU wants them side by side.
    return jax.lax.map(lambda lane: one(*lane), lanes) if jax.default_backend() == "cpu" else jax.vmap(one)(*lanes)


def linear_moduli(law: Law, prony: Prony, omega: jax.Array, steps: int | None) -> jax.Array:
    """The limit of `moduli` as the strain goes to zero: complex moduli [Pa] (n,) of the recursion itself.

    The rig is linear there, and its bias is divided out, so they hold neither mesh nor plates. They give the
    derivatives of `moduli` by the parameters to the order of the strain, without a derivative of the simulation. They
    have no inertia.

    Args:
        law: scaled to G0, its modulus at rest.
        prony: how it relaxes.
        omega: angular frequencies (n,) [rad/s].
        steps: time steps a cycle; None: those of continuous time.
    """
    ratios = viscosity.complex_ratios(prony, omega, None if steps is None else 2 * jnp.pi / (omega * steps))
    return law.shear_modulus() * (1 - jnp.sum(ratios, axis=0))


class Held(NamedTuple):
    """A compressed sample of a law, before any relaxation is known."""

    relaxing: jax.Array  # (n, n) [N/m]: `about_held`
    standing: jax.Array
    bias: jax.Array  # of its mesh at rest: `geometry_factor`


def held(rig: Rig, law: Law) -> Held:
    """Input of `held_moduli` from a rig of `compression.compressed`."""
    return Held(*about_held(rig, law), geometry_factor(replace(rig, held=None, height=_rest_height(rig)), law))


def held_moduli(of: Held, rig: Rig, prony: Prony, omega: jax.Array, steps: int | None) -> jax.Array:
    """`linear_moduli` of the compressed sample `of`: complex moduli [Pa] (n,) of its mesh.

    Args:
        of, rig: the sample.
        prony: how it relaxes.
        omega: angular frequencies (n,) [rad/s].
        steps: time steps a cycle; None: those of continuous time.
    """
    ratios = viscosity.complex_ratios(prony, omega, None if steps is None else 2 * jnp.pi / (omega * steps))
    stands = 1 - jnp.sum(jnp.asarray(prony.ratios))
    parts = _Linearised(of.relaxing, of.relaxing, stands * of.standing)
    stiffness = jax.lax.map(lambda modulus: _steady(parts, modulus).stiffness, 1 - jnp.sum(ratios, axis=0))
    return 2 * rig.height / (jnp.pi * rig.radius**2) * stiffness / of.bias


def strain_sweep(
    rig: Rig, law: Law, prony: Prony | None, strains: Any, omega: float = 2 * math.pi, drive: Drive | None = None
) -> Moduli:
    """Dynamic strain sweep (section 5.2): moduli at rim strain amplitudes, driven by angle, three cycles each.

    Args:
        strains: amplitudes at the rim, e.g. 1e-4 … 0.2.
        omega: angular frequency [rad/s], default 1 Hz.
    """
    drive = drive or Drive(cycles=3, by="angle")
    return moduli(rig, law, prony, omega, jnp.asarray(strains) * rig.height / rig.radius, drive)


def linearity_limit(strains: Any, storage: Any, deviation: float = 0.05) -> float:
    """Strain at which G' has moved by `deviation` from its value at the smallest strain; infinity if it never does.

    A modulus that is not finite (a diverged run) counts as moved: the last good strain is returned.
    """
    strains, change = np.asarray(strains), np.abs(np.asarray(storage) / np.asarray(storage)[0] - 1)
    beyond = np.flatnonzero(~(change <= deviation))
    if not len(beyond):
        return math.inf
    k = beyond[0]
    if not np.isfinite(change[k]):
        return float(strains[k - 1])
    return float(np.exp(np.interp(deviation, change[k - 1 : k + 1], np.log(strains[k - 1 : k + 1]))))
