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
from liverjax.waves import sparse
from liverjax.waves.operator import Operator, free_part, operator
from liverjax.waves.rest import under_its_weight, without_history

MASSES = ("consistent", "lumped")
#: Values of [solve] for the equations of one instant.
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
    """Amplitudes of small motion at F frequencies: the displacement is the real part of u exp(i omega t)."""

    frequencies_Hz: jax.Array = param("Hz", "(F,)")
    displacement: jax.Array = param("m", "u, complex (F, V, 3)")
    reactions: jax.Array = param("N", "complex (F, V, 3), force of the support on the body where motion is given")
    residual: jax.Array = param("1", "(F,) out-of-balance forces where the body is free, over the forces at work")
    pressure: jax.Array | None = param("Pa", "of the fluid, complex (F, V), of a porous scene", default=None)

    def check(self) -> "Harmonic":
        """The result itself, or `RuntimeError` with advice if a frequency has no answer; host side."""
        wrong = np.flatnonzero(~(np.asarray(self.residual) < 1e-6))
        if wrong.size:
            raise RuntimeError(
                f"{float(self.frequencies_Hz[wrong[0]]):g} Hz: {status.advice(status.NOT_FINITE)}; a body without "
                "viscosity has no answer at its resonances"
            )
        return self


def harmonic(
    scene: Scene,
    frequencies_Hz: Numbers | None = None,
    factors: Number | None = None,
    about: jax.Array | None = None,
    motion: Number | None = None,
    mass: str = "consistent",
) -> Harmonic:
    """Small motion of the scene at these frequencies, driven by its tractions, prescribed motions and inlets.

    Their numbers are amplitudes. Law, viscosity, porosity, density, gravity, supports, held nodes and regions act.
    Time steps and histories have no effect; an obstacle stays at its place at time 0. It may be differentiated in both
    modes and jitted; every derivative costs one more solve per frequency, without a new factorisation.

    Args:
        scene: `Scene`. The motion of `displaced` is an amplitude with phase 0.
        frequencies_Hz: (F,), above 0; default: those of scene.solve.
        factors: G*/G0 by which the part of the stress that relaxes is multiplied, complex (F,), or (F, E) by element;
            default: those of the scene's Prony series, 1 - sum g_k/(1 + i omega tau_k), or of its springpots; else 1.
            Pressures of nodes (volumetric "mixed", "nodal", or of a sponge) do not relax.
        about: positions (V, 3) [m] of an equilibrium that has rested for long, as in `simulate`; default: the state
            of rest under gravity, found by a static run, or the reference shape without gravity. The law's stress there
            stiffens the body. A fluid has flowed until its pressure is 0. If gravity is traced, its value is not known:
            the program then has this run even for a gravity of 0, unless `about` is given.
        motion: amplitudes of prescribed motion, complex (V, 3) or (F, V, 3) [m], in place of the scene's.
        mass: "consistent" (each element's integrals), or "lumped" as in runs in time.

    Returns:
        `Harmonic`. A matrix without an inverse leaves NaN at its frequency.

    Raises:
        InputError: parts that have no harmonic motion here (pressures that follow, friction, rigid plates), shapes and
            values that cannot be used; no state of rest under gravity.
    """
    weighed = scene
    omegas = 2 * jnp.pi * _frequencies(scene.solve.frequencies if frequencies_Hz is None else frequencies_Hz)
    if scene.springpots is not None:
        factors = springpot_factors(scene.springpots, omegas) if factors is None else factors
    scene = _small(scene, mass)
    about = under_its_weight(weighed) if about is None else about
    mesh = scene.mesh
    number, elements = len(omegas), mesh.number_of_elements
    factors = _factors(scene, omegas) if factors is None else jnp.asarray(factors, complex)
    if factors.shape not in ((number,), (number, elements)):
        raise InputError(f"factors have shape {factors.shape}: give ({number},) or ({number}, {elements})")
    if motion is None:
        motion = prescribed(mesh, tuple(replace(d, times=None, history=None) for d in scene.displaced), 0.0, 1.0)
    motion = jnp.asarray(motion, complex)
    if motion.shape not in (mesh.points.shape, (number, *mesh.points.shape)):
        raise InputError(f"motion has shape {motion.shape}: give {mesh.points.shape} or one more axis of frequencies")
    if about is not None and scene.porosity is not None and not _drains(scene.porosity):
        raise InputError(
            "a state under load (gravity, about) does not give the pressure that a sealed sponge keeps: give "
            "porosity.drained"
        )
    if about is not None and jnp.shape(about) != mesh.points.shape:
        raise InputError(f"about has shape {jnp.shape(about)}: give positions of shape {mesh.points.shape}")
    motion = jnp.broadcast_to(motion, (number, *mesh.points.shape))
    return _answer(scene, (factors, omegas), motion, about, mass)


def element_operator(scene: Scene, about: jax.Array | None = None, mass: str = "consistent") -> Operator:
    """The dynamic stiffness of `harmonic` by element, for programs that build their own equations with it.

    Args:
        scene, about, mass: as in `harmonic`.
    """
    small = _small(scene, mass)
    return _operator(small, under_its_weight(scene) if about is None else about, mass)


def _operator(scene: Scene, about: jax.Array | None, mass: str) -> Operator:
    solve = replace(scene.solve, volumetric="element")
    unmoved = tuple(replace(d, by=jnp.zeros(3)) for d in scene.displaced)
    still = replace(scene, viscosity=None, porosity=None, displaced=unmoved, solve=solve)
    none = jnp.zeros(())
    e = equations(still, initial_state(still), 1.0, Sizes(none, none))
    if e.free.tied:
        raise InputError("nodes that turn together (a rigid plate) have no harmonic motion: prescribe their motion")
    return operator(e._replace(scene=scene), scene.mesh.points if about is None else about, about is not None, mass)


@partial(jax.jit, static_argnames="mass")
def _answer(scene: Scene, at: tuple[jax.Array, jax.Array], motion: jax.Array, about: Any, mass: str) -> Harmonic:
    """Motion, reactions and residuals; `at` are factors and angular frequencies."""
    A, omegas = _operator(scene, about, mass), at[1]
    held, load = _prescribed_and_loads(A, omegas, motion, nodal_tractions(scene.mesh, scene.traction))
    moved = sparse.motions(A, *at, jax.tree.map(jnp.subtract, load, sparse.at_every(A, *at, held)))
    u, p = jax.tree.map(jnp.add, held, moved)
    f, balance = jax.tree.map(jnp.subtract, sparse.at_every(A, *at, (u, p)), load)
    out, unbalanced = jax.vmap(lambda *m: free_part(A, m))(f, balance)
    residual = _part(out, jnp.abs(f - out) + jnp.abs(load[0]))
    if unbalanced is not None and p is not None:
        # Volumes that the motion changes at the pressures' nodes, or the fluid that enters.
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
    """The prescribed amplitudes, and the loads, of every frequency."""
    number, own = len(omegas), A.pressures
    held = (1 - A.free.mask)[None] * motion
    force = jnp.broadcast_to(jnp.asarray(traction, complex)[None], motion.shape)
    if own is None:
        return (held, None), (force, None)
    pressure = jnp.broadcast_to(jnp.asarray(own.given, complex), (number, *own.given.shape))
    enters = jnp.zeros_like(pressure) if own.enters is None else -own.enters[None] / (1j * omegas[:, None])
    return (held, pressure), (force, enters)


def _part(out: jax.Array, work: jax.Array) -> jax.Array:
    """Norms (F,) of the forces out of balance, over those of the forces at work."""
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
            f"{HIGHEST_HZ:g}"
        )
    return found


def _factors(scene: Scene, omegas: jax.Array) -> jax.Array:
    """Factors G*/G0 (F,), or (F, E), of the scene's viscosity."""
    prony = scene.viscosity
    if prony is None:
        return jnp.ones(omegas.shape, complex)
    of = partial(viscosity.complex_ratios, omega=omegas)
    by_element = jnp.ndim(prony.ratios) == 2
    ratios = jax.vmap(of, in_axes=1, out_axes=-1)(prony) if by_element else of(prony)
    return 1 - jnp.sum(ratios, axis=0)


def _drains(porosity: Porosity) -> bool:
    """Whether the fluid can leave the sponge at a pressure of 0."""
    return porosity.drained is not None or any(inlet.nodes is not None for inlet in porosity.inlet)


def _small(scene: Scene, mass: str) -> Scene:
    """The scene without time and weight, for small motion. Physics that have no small motion are refused."""
    if mass not in MASSES:
        raise InputError(f"mass = {mass!r} is not known: use {' or '.join(MASSES)}")
    if scene.points_are == "loaded":
        raise InputError(
            '[mesh] is = "loaded" has no harmonic motion: take the scene of lj.unloaded(scene), and its run as about'
        )
    if any(isinstance(physics, RoughObstacle | PressedObstacle) for physics in scene.physics):
        raise InputError(
            "friction and pressed obstacles have no harmonic motion here: leave them out, or run the scene in time"
        )
    if follows(scene.traction):
        raise InputError("a pressure that follows the body has no harmonic motion here: give a traction as value")
    solve = replace(scene.solve, **_STILL)
    traction = tuple(replace(t, times=None, history=None) for t in scene.traction)
    body = None if scene.body is None else replace(scene.body, gravity=jnp.zeros(3), times=None, history=None)
    sponge = scene.porosity
    if sponge is not None:
        inlets = tuple(replace(inlet, times=None, history=None) for inlet in sponge.inlet)
        sponge = replace(sponge, inlet=inlets)
    physics = tuple(without_history(own) for own in scene.physics)
    scene = replace(scene, traction=traction, body=body, solve=solve, porosity=sponge, physics=physics)
    if scene.springpots is not None:
        for law in laws_of(scene.law, scene.region):
            check_springpots(scene.springpots, law, scene.viscosity)
        scene = replace(scene, viscosity=series_at_rest(scene.springpots), springpots=None)
    return prepared(scene)
