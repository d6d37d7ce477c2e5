"""The state of rest under gravity and pre-tension: a body in harmonic motion vibrates about this state."""

import jax
import jax.numpy as jnp
import numpy as np

from liverjax.core import status
from liverjax.core.errors import InputError
from liverjax.core.struct import Content, replace
from liverjax.physics.attached.ligament import Ligament
from liverjax.physics.base import Physics
from liverjax.physics.contact.obstacle import Obstacle
from liverjax.physics.porosity import Porosity
from liverjax.physics.prescribed import free_degrees
from liverjax.scenes.by_element import by_element
from liverjax.scenes.scene import Scene, Solve
from liverjax.scenes.springpots import check_spring_at_rest
from liverjax.simulation.automatic import is_one_step
from liverjax.simulation.equations import forces_at
from liverjax.simulation.run import prepared, simulate
from liverjax.simulation.unloaded import resting

#: Forces in the reference shape are regarded as 0 if they are below _NONE times the forces due to the strain _STRAIN.
_STRAIN, _NONE = 1e-6, 1e-3
#: A time [s] after which all flow has ended.
_FOR_LONG = 1e12


def under_its_weight(scene: Scene) -> jax.Array | None:
    """Return the positions (V, 3) [m] at rest under gravity and pre-tension, after the relaxation of the viscous
    stresses. Return None if there is neither gravity nor pre-tension.

    Pre-tension is a force that acts already in the reference shape, for example the force of a tight ligament.
    Tractions and inlets cause only the vibration, so they do not act here. Inside jit, grad or vmap, the positions are
    NaN if no state of rest is found.

    Raises:
        InputError: no state of rest was found (outside jit, grad and vmap), springpots without a spring leave no
            shear stiffness at rest, or `newton_iterations` is 1.
    """
    body = None if scene.body is None else replace(scene.body, times=None, history=None)
    changed: Content = {"body": body, "porosity": _without_inflow(scene.porosity)}
    changed["physics"] = tuple(without_history(own) for own in scene.physics)
    still = resting(replace(by_element(scene), traction=(), **changed))
    if not (_is_heavy(scene) or _is_pulled(still)):
        return None
    check_spring_at_rest(scene.springpots, "remove the gravity, or give a state of rest as the argument 'about'")
    if is_one_step(still.solve):
        raise InputError(
            "solve.newton_iterations = 1 cannot be used here, because the state of rest needs several iterations: give "
            "more iterations, or remove this key"
        )
    # In a porous body the time step is so long that the flow ends within one step.
    dt = None if scene.porosity is None else _FOR_LONG
    solve = replace(still.solve, dt=dt, steps=4, frequencies=None)
    found = simulate(replace(still, solve=solve))
    if isinstance(found.status, jax.core.Tracer):
        good = jnp.all(found.status == status.CONVERGED)
        return jnp.where(good, found.positions[-1], jnp.nan)
    try:
        return found.check().positions[-1]
    except RuntimeError as error:
        raise InputError(
            f"no state of rest under gravity or tension was found ({error}): fix the body, or give a state "
            "of rest as the argument 'about'"
        ) from None


def without_history(physics: Physics) -> Physics:
    """Return the physics object (support, obstacle, …) without its history. A support then has a constant stiffness,
    and an obstacle stays at its position at time 0."""
    changed: Content = {name: None for name in ("times", "history") if getattr(physics, name, None) is not None}
    if isinstance(physics, Obstacle):
        changed |= {"by": None, "position": jnp.asarray(physics.position) + physics.displacement(0, 1, 0.0)}
    return replace(physics, **changed) if changed else physics


def _without_inflow(sponge: Porosity | None) -> Porosity | None:
    """Return the porosity without prescribed inflow, and with a pressure of 0 where an inlet prescribes a pressure."""
    if sponge is None:
        return None
    open_ones = [inlet for inlet in sponge.inlet if inlet.nodes is not None]
    inlets = tuple(replace(inlet, pressure=0.0, times=None, history=None) for inlet in open_ones)
    return replace(sponge, inlet=inlets)


def _is_heavy(scene: Scene) -> bool:
    """Return whether gravity is not zero, or unknown (inside jit, grad or vmap)."""
    leaves = [] if scene.body is None else jax.tree.leaves(scene.body.gravity)
    return any(isinstance(leaf, jax.core.Tracer) or bool(np.any(np.asarray(leaf))) for leaf in leaves)


def _is_pulled(still: Scene) -> bool:
    """Return whether forces other than gravity act on free nodes in the reference shape. Inside jit, grad or vmap,
    return whether the scene has a ligament that is tight or may be tight."""
    if not still.physics:
        return False
    # The relaxed law may have no stiffness (springpots with spring = 0), so the law before relaxation is used.
    law = still.law if still.unrelaxed is None else still.unrelaxed
    alone = replace(still, law=law, unrelaxed=None, fixed=(), displaced=(), body=None, porosity=None)
    if any(isinstance(leaf, jax.core.Tracer) for leaf in jax.tree.leaves((alone, still.fixed))):
        return any(isinstance(own, Ligament) and own.is_tight(still.mesh) for own in still.physics)
    alone = prepared(replace(alone, solve=Solve(volumetric=still.solve.volumetric)))
    x = jnp.asarray(still.mesh.points)
    free = np.asarray(free_degrees(still.mesh, still.fixed, ()))
    program = jax.jit(forces_at)
    force, strained = (np.asarray(program(alone, x * stretch)) * free for stretch in (1.0, 1.0 + _STRAIN))
    return bool(np.linalg.norm(force) > _NONE * np.linalg.norm(strained - force))
