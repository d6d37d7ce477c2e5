"""Harmonic motion of a scene: complex amplitudes at given frequencies."""

from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from liverjax.core import status
from liverjax.core.errors import InputError
from liverjax.core.struct import Content, Number, Numbers, param, replace, struct
from liverjax.mesh.promotion import on_middles
from liverjax.mesh.tetrahedra import TetMesh
from liverjax.physics import viscosity
from liverjax.physics.contact.friction import RoughObstacle
from liverjax.physics.contact.pressed import PressedObstacle
from liverjax.physics.loads import follows, nodal_tractions
from liverjax.physics.porosity import Porosity
from liverjax.physics.prescribed import prescribed
from liverjax.scenes.regions import laws_of
from liverjax.scenes.scene import HIGHEST_HZ, Scene
from liverjax.scenes.springpots import check_springpots, series_at_rest, springpot_factors
from liverjax.simulation.equations import Sizes, equations, initial_state
from liverjax.simulation.run import prepared
from liverjax.solvers.factors.memory import free_memory
from liverjax.waves import sparse
from liverjax.waves.operator import Operator, free_part, operator
from liverjax.waves.pressures import AtRest
from liverjax.waves.rest import under_its_weight, without_history

MASSES = ("consistent", "lumped")
#: Settings of [solve] for the equations of static equilibrium.
_STILL: Content = {
    "kind": "static",
    "frequencies": None,
    "dt": None,
    "steps": 1,
    "linear_solver": "cg",
    "robust": "off",
}


@struct
class Harmonic:
    """Complex amplitudes of a small motion at F frequencies. The displacement is the real part of u exp(i omega t)."""

    frequencies_Hz: jax.Array = param("Hz", "(F,)")
    displacement: jax.Array = param("m", "u, complex (F, V, 3)")
    reactions: jax.Array = param("N", "complex (F, V, 3), forces on the body at constrained nodes")
    residual: jax.Array = param("1", "(F,) out-of-balance forces at free nodes, divided by the size of all forces")
    pressure: jax.Array | None = param("Pa", "complex (F, V), fluid pressure in a porous body", default=None)

    def check(self) -> "Harmonic":
        """Return the result itself. Raise `RuntimeError` with advice if a frequency has no solution. Do not call this
        function inside jit, grad or vmap."""
        wrong = np.flatnonzero(~(np.asarray(self.residual) < 1e-6))
        if wrong.size:
            raise RuntimeError(
                f"{float(self.frequencies_Hz[wrong[0]]):g} Hz: {status.advice(status.NOT_FINITE)}; a body without "
                "viscosity has no solution at its resonance frequencies"
            )
        return self


def largest_in_period(amplitudes: np.ndarray) -> np.ndarray:
    """Return the largest norms (…) during a period of vectors with the complex amplitudes (…, 3).

    If the components have different phases, they do not reach their largest values at the same time.
    """
    squares = np.sum(np.abs(amplitudes) ** 2, axis=-1) + np.abs(np.sum(amplitudes**2, axis=-1))
    return np.sqrt(squares / 2)


def harmonic(
    scene: Scene,
    frequencies_Hz: Numbers | None = None,
    factors: Number | None = None,
    about: jax.Array | AtRest | None = None,
    motion: Number | None = None,
    mass: str = "consistent",
) -> Harmonic:
    """Compute the small harmonic motion that is caused by the tractions, prescribed motions and inlets of the scene.

    The values of these loads are amplitudes. The equations include law, viscosity, porosity, density, gravity,
    supports, fixed nodes and regions. Time steps and histories have no effect. An obstacle stays at its position at
    time 0. The function works inside jit and in both modes of differentiation. A derivative needs one more solve per
    frequency.

    Args:
        scene: `Scene`. The motion of `displaced` is an amplitude with phase 0.
        frequencies_Hz: F frequencies (F,), above 0; default: the frequencies of scene.solve.
        factors: complex factors G*/G0 that multiply the relaxing part of the stress, (F,), or (F, E) with one value for
            each element. Default: 1 - sum g_k/(1 + i omega tau_k) with the ratios g_k and relaxation times tau_k of the
            scene's Prony series, or the factors of its springpots; 1 without viscosity. Nodal pressures (volumetric
            "mixed" or "nodal", or a porous body) do not relax.
        about: positions (V, 3) [m] about which the body vibrates: an equilibrium after a long time, for example from
            `simulate`. The stress in this state changes the stiffness; the fluid pressure is 0. Default: the state of
            rest under gravity and pre-tension, from a static run. In a scene without gravity and pre-tension, this run
            is not done and the reference shape is used. If the components of gravity are JAX tracers (inside jit, grad
            or vmap), the run is always done, so a porous body must then be able to drain. An `AtRest` may replace the
            positions: it also contains the stress of mixed elements.
        motion: complex amplitudes (V, 3) or (F, V, 3) [m] that replace the prescribed motion of the scene.
        mass: "consistent" (mass matrix of each element), or "lumped". `[body] mass` has no effect.

    Returns:
        `Harmonic`. The result is NaN at a frequency with a singular matrix.

    Raises:
        InputError: the scene contains something that harmonic motion cannot have (for example a pressure that follows
            the surface, friction, or a rigid plate); wrong shapes or values; too little memory; no state of rest.
    """
    weighed = scene
    omegas = 2 * jnp.pi * _frequencies(scene.solve.frequencies if frequencies_Hz is None else frequencies_Hz)
    if scene.springpots is not None:
        factors = relative_moduli(scene, omegas) if factors is None else factors
    scene = _small(scene, mass)
    about = _at_rest(weighed) if about is None else about
    mesh = scene.mesh
    number, elements = len(omegas), mesh.number_of_elements
    factors = relative_moduli(scene, omegas) if factors is None else jnp.asarray(factors, complex)
    if factors.shape not in ((number,), (number, elements)):
        raise InputError(
            f"the argument 'factors' has shape {factors.shape}: give ({number},) or ({number}, {elements})"
        )
    motion = jnp.asarray(_amplitudes_of_motion(scene) if motion is None else motion, complex)
    if motion.shape not in (mesh.points.shape, (number, *mesh.points.shape)):
        raise InputError(
            f"the argument 'motion' has shape {motion.shape}: give {mesh.points.shape}, or one such array per frequency"
        )
    _check_about(scene, about)
    motion = jnp.broadcast_to(motion, (number, *mesh.points.shape))
    return _answer(scene, (factors, omegas), motion, about, mass)


def _at_rest(scene: Scene) -> jax.Array | None:
    """Return the positions of `under_its_weight`.

    Raises:
        InputError: gravity is unknown (inside jit, grad or vmap), and a porous body cannot drain; or there is no state
            of rest.
    """
    gravity = [] if scene.body is None else jax.tree.leaves(scene.body.gravity)
    closed = scene.porosity is not None and not _drains(scene.porosity)
    if closed and any(isinstance(leaf, jax.core.Tracer) for leaf in gravity):
        raise InputError(
            "body.gravity is unknown inside jit, grad or vmap, so it counts as a load, which does not determine the "
            "pressure in a porous body that cannot drain: do not make body.gravity an argument of the transformed "
            "function, or give porosity.drained"
        )
    return under_its_weight(scene)


def _amplitudes_of_motion(scene: Scene) -> jax.Array:
    """Return the amplitudes (V, 3) [m] of the prescribed motions. Raise InputError if a motion has only a history."""
    for k, moved in enumerate(scene.displaced):
        if moved.by is None:
            raise InputError(f"displaced.{k} has a history but no amplitude: give by, or the argument 'motion'")
    return prescribed(scene.mesh, tuple(replace(d, times=None, history=None) for d in scene.displaced), 0.0, 1.0)


def _check_about(scene: Scene, about: jax.Array | AtRest | None) -> None:
    """Raise InputError if `about` has a wrong shape, or is given for a porous body that cannot drain."""
    if about is None:
        return
    if scene.porosity is not None and not _drains(scene.porosity):
        raise InputError(
            "a loaded state (gravity, about) does not determine the pressure in a porous body that cannot drain: give "
            "porosity.drained"
        )
    shape = jnp.shape(about.positions if isinstance(about, AtRest) else about)
    if shape != scene.mesh.points.shape:
        raise InputError(f"the argument 'about' has shape {shape}: give positions of shape {scene.mesh.points.shape}")


def element_operator(scene: Scene, about: jax.Array | None = None, mass: str = "consistent") -> Operator:
    """Return the dynamic stiffness that `harmonic` uses, as element matrices. Other programs can build their own
    equations from these matrices.

    Args:
        scene, about, mass: the same arguments as for `harmonic`.
    """
    small = _small(scene, mass)
    return _operator(small, under_its_weight(scene) if about is None else about, mass)


def _operator(scene: Scene, about: jax.Array | AtRest | None, mass: str) -> Operator:
    solve = replace(scene.solve, volumetric="element")
    unmoved = tuple(replace(d, by=jnp.zeros(3), times=None, history=None) for d in scene.displaced)
    still = replace(scene, viscosity=None, porosity=None, displaced=unmoved, solve=solve)
    none = jnp.zeros(())
    e = equations(still, initial_state(still), 1.0, Sizes(none, none, none))
    if e.free.tied:
        raise InputError("a rigid plate cannot be used in harmonic motion: prescribe the motion of its nodes")
    e = e._replace(scene=scene)
    if isinstance(about, AtRest):
        return operator(e, about.positions, True, mass, about.stress)
    return operator(e, scene.mesh.points if about is None else about, about is not None, mass)


@partial(jax.jit, static_argnames="mass")
def _answer(scene: Scene, at: tuple[jax.Array, jax.Array], motion: jax.Array, about: Any, mass: str) -> Harmonic:
    """Solve the equations, and return motion, reactions and residuals. `at`: factors G*/G0 and angular frequencies
    [rad/s]."""
    A, omegas = _operator(scene, about, mass), at[1]
    held, load = _prescribed_and_loads(A, omegas, motion, nodal_tractions(scene.mesh, scene.traction))
    moved = sparse.motions(A, *at, jax.tree.map(jnp.subtract, load, sparse.at_every(A, *at, held)))
    u, p = jax.tree.map(jnp.add, held, moved)
    f, balance = jax.tree.map(jnp.subtract, sparse.at_every(A, *at, (u, p)), load)
    out, unbalanced = jax.vmap(lambda *m: free_part(A, m))(f, balance)
    residual = _part(out, jnp.abs(f - out) + jnp.abs(load[0]))
    if unbalanced is not None and p is not None:
        # The residual of the volume balance is divided by the sizes of the volume changes and of the inflow.
        taken: Any = sparse.at_every(A, *at, (u, jnp.zeros_like(p)))[1]
        residual = jnp.maximum(residual, _part(unbalanced, jnp.abs(taken) + jnp.abs(load[1])))
    return Harmonic(
        frequencies_Hz=omegas / (2 * jnp.pi),
        displacement=u,
        reactions=f - out,
        residual=jax.lax.stop_gradient(residual),
        pressure=None if scene.porosity is None else jax.vmap(lambda own: on_middles(scene.mesh, own))(p),
    )


def _prescribed_and_loads(
    A: Operator, omegas: jax.Array, motion: jax.Array, traction: jax.Array
) -> tuple[sparse.Motions, Any]:
    """Return (prescribed amplitudes of displacements and pressures, right-hand sides of the equations), both at every
    frequency."""
    number, own = len(omegas), A.pressures
    held = (1 - A.free.mask)[None] * motion
    force = jnp.broadcast_to(jnp.asarray(traction, complex)[None], motion.shape)
    if own is None:
        return (held, None), (force, None)
    pressure = jnp.broadcast_to(jnp.asarray(own.given, complex), (number, *own.given.shape))
    enters = jnp.zeros_like(pressure) if own.enters is None else -own.enters[None] / (1j * omegas[:, None])
    return (held, pressure), (force, enters)


def _part(out: jax.Array, work: jax.Array) -> jax.Array:
    """Return the relative residuals (F,) at F frequencies: norms of the out-of-balance forces `out`, divided by the
    norms of all forces `work`."""
    sizes = [jnp.linalg.norm(a.reshape(len(a), -1), axis=1) for a in (out, work)]
    return sizes[0] / jnp.where(sizes[1] > 0, sizes[1], 1.0)


def _frequencies(frequencies_Hz: Any) -> jax.Array:
    if frequencies_Hz is None:
        raise InputError("harmonic motion needs frequencies_Hz: give e.g. [60.0]")
    found = jnp.atleast_1d(jnp.asarray(frequencies_Hz, float))
    if not isinstance(found, jax.core.Tracer) and not (
        found.ndim == 1 and found.size and np.all((np.asarray(found) > 0) & (np.asarray(found) <= HIGHEST_HZ))
    ):
        raise InputError(
            f"frequencies_Hz = {np.asarray(frequencies_Hz).tolist()} must be a list of numbers above 0, at most "
            f"{HIGHEST_HZ:g}: correct these numbers"
        )
    return found


def relative_moduli(scene: Scene, omegas: jax.Array) -> jax.Array:
    """Return the complex factors G*/G0 of springpots or viscosity: (F,), or (F, E) with one value per element.

    Args:
        scene: a scene without regions (`by_element`).
        omegas: F angular frequencies [rad/s].
    """
    if scene.springpots is not None:
        return springpot_factors(scene.springpots, omegas)
    prony = scene.viscosity
    if prony is None:
        return jnp.ones(omegas.shape, complex)
    of = partial(viscosity.complex_ratios, omega=omegas)
    by_element = jnp.ndim(prony.ratios) == 2
    ratios = jax.vmap(of, in_axes=1, out_axes=-1)(prony) if by_element else of(prony)
    return 1 - jnp.sum(ratios, axis=0)


def _drains(porosity: Porosity) -> bool:
    """Return whether fluid can leave the porous body, because the pressure is given at some nodes."""
    return porosity.drained is not None or any(inlet.nodes is not None for inlet in porosity.inlet)


#: For elements of order 1, 2 and 3: number of nodes of an element, and the maximum memory while element matrices are
#: computed, divided by the memory of these matrices (measured for order 1 and 2).
_NODES, _TEMPORARY = (4, 10, 20), (4, 6, 6)


def _check_memory(mesh: TetMesh) -> None:
    """Raise InputError if the element matrices need more memory than the computer has left. Without this check, the
    operating system would end the program without a message."""
    if jax.default_backend() != "cpu":
        return
    bytes_of_one = 8 * (3 * _NODES[mesh.order - 1]) ** 2
    needed, free = _TEMPORARY[mesh.order - 1] * bytes_of_one * mesh.number_of_elements, free_memory()
    if needed > free:
        raise InputError(
            f"the element matrices of {mesh.number_of_elements} elements of order {mesh.order} need about "
            f"{needed / 1e9:.3g} GB of memory, but only {free / 1e9:.3g} GB are free: use a coarser mesh, "
            f"{'order = 1, ' if mesh.order > 1 else ''}or a machine with more memory"
        )


def refuse_not_harmonic(scene: Scene) -> None:
    """Raise InputError if the scene contains something that harmonic motion cannot have.

    Raises:
        InputError: the scene has a mesh of the loaded body, friction, a pressed obstacle, or a pressure that follows
            the surface.
    """
    if scene.points_are == "loaded":
        raise InputError(
            '[mesh] is = "loaded" cannot be used in harmonic motion: in Python, use the scene of lj.unloaded(scene); '
            "with the command, first do a static run with --vtu and with the law at rest, then give its "
            "vtu/step_00001.vtu as [mesh] file, without unit and is"
        )
    if any(isinstance(physics, RoughObstacle | PressedObstacle) for physics in scene.physics):
        raise InputError(
            "friction and pressed obstacles cannot be used in harmonic motion: remove friction and force, or do a "
            "transient run"
        )
    if follows(scene.traction):
        raise InputError(
            "a pressure that follows the body cannot be used in harmonic motion: give traction.value instead"
        )


def _small(scene: Scene, mass: str) -> Scene:
    """Return the scene without histories, time steps and gravity. Raise InputError if it contains something that is not
    implemented for harmonic motion."""
    if mass not in MASSES:
        raise InputError(f"mass = {mass!r} is not known: use {' or '.join(MASSES)}")
    _check_memory(scene.mesh)
    refuse_not_harmonic(scene)
    solve = replace(scene.solve, **_STILL)
    traction = tuple(replace(t, times=None, history=None) for t in scene.traction)
    body = None if scene.body is None else replace(scene.body, gravity=jnp.zeros(3), times=None, history=None)
    sponge = scene.porosity
    if sponge is not None:
        inlets = tuple(replace(inlet, times=None, history=None) for inlet in sponge.inlet)
        sponge = replace(sponge, inlet=inlets)
    physics = tuple(without_history(own) for own in scene.physics)
    scene = replace(scene, traction=traction, body=body, solve=solve, porosity=sponge, physics=physics)
    if scene.springpots is None:
        return prepared(scene)
    for law in laws_of(scene.law, scene.region):
        check_springpots(scene.springpots, law, scene.viscosity)
    # The ratio 1 - spring may be 1 or negative, which `prepared` does not accept. So this ratio is set afterwards.
    series = series_at_rest(scene.springpots)
    scene = prepared(replace(scene, viscosity=replace(series, ratios=jnp.zeros(1)), springpots=None))
    return replace(scene, viscosity=replace(series, ratios=series.ratios.astype(scene.mesh.points.dtype)))
