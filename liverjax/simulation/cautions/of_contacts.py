"""Warnings about the obstacles of a run and about friction, computed after the run."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np

from liverjax.core import status
from liverjax.core.struct import replace
from liverjax.physics.base import Physics
from liverjax.physics.contact.friction import RoughObstacle
from liverjax.physics.contact.obstacle import Obstacle, missed_depth
from liverjax.physics.contact.passage import passed_in_step
from liverjax.physics.contact.pressed import PressedObstacle
from liverjax.scenes.checks.rigid_motion import loose_piece
from liverjax.scenes.scene import Scene, named_physics
from liverjax.simulation.obstacle_forces import obstacle_forces
from liverjax.simulation.run import Result

#: A warning is given if the depth of the obstacle in the body between the contact points exceeds this fraction of the
#: obstacle's approach (see `missed_depth`).
BETWEEN = 0.25


def _between_points(name: str, obstacle: Obstacle, scene: Scene, result: Result, moved: jax.Array) -> list[str]:
    """Warn if the obstacle overlaps the body between the contact points, at the largest or the last displacement.

    `moved` (T, 3) contains the displacements [m] of the obstacle at T steps.
    """
    last = len(moved) - 1
    for k in {int(jnp.argmax(jnp.linalg.norm(moved, axis=1))), last}:
        x = jnp.asarray(result.positions[k], scene.mesh.points.dtype)
        between, approach = missed_depth(obstacle, scene.mesh, x, moved[k])
        if between > BETWEEN * approach:
            return [
                f"{name} penetrates the body by {between:.2g} m between the points at which contact is tested "
                f"(approach of the obstacle: {approach:.2g} m), because the triangles are too large for the radius "
                "of the obstacle: refine the mesh there"
            ]
    return []


def _lost_contact(name: str, obstacle: Obstacle, scene: Scene, result: Result, moved: np.ndarray) -> str:
    """Warn if the obstacle passed through the body's surface within a step. `moved` (T + 1, 3): displacements [m] of
    the obstacle, from step 0 on."""
    ways, radius = np.linalg.norm(np.diff(moved, axis=0), axis=1), float(np.asarray(obstacle.radius))
    centres, axis = np.asarray(obstacle.position, float) + moved, np.asarray(obstacle.axis, float)
    if obstacle.shape == "cylinder":  # motion along the axis of a cylinder does not count
        ways = np.linalg.norm(np.diff(moved - np.outer(moved @ axis, axis), axis=0), axis=1)
    for k in np.flatnonzero(ways > radius) if radius > 0 else []:
        before = scene.mesh.points if k == 0 else result.positions[k - 1]
        both = np.stack([np.asarray(before), np.asarray(result.positions[k])])
        triangles = np.asarray(obstacle.triangles)
        what = passed_in_step(obstacle.shape, axis, scene.mesh, both, centres[k : k + 2], triangles)
        if what:
            return (
                f"{name} {what} the body in step {k + 1}. The obstacle moves {ways[k]:.2g} m in this step, and has a "
                f"radius of {radius:.2g} m, so it passed the surface between two steps. Contact forces are missing or "
                "have the wrong direction: use more steps"
            )
    return ""


def of_obstacles(scene: Scene, result: Result) -> list[str]:
    """Warn about obstacles (not planes) that passed through the surface, or overlap the body between contact points."""
    said, steps = [], len(result.times)
    obstacles = [(name, physics) for name, physics in named_physics(scene) if isinstance(physics, Obstacle)]
    pressed = any(isinstance(physics, PressedObstacle) for _, physics in obstacles)
    found = obstacle_forces(replace(scene, points_are="reference"), result).displacement if pressed else None
    for number, (name, physics) in enumerate(obstacles):
        if physics.shape == "plane":
            continue
        dt = 0.0 if scene.solve.dt is None else scene.solve.dt
        place = partial(physics.displacement, steps=scene.solve.steps, dt=dt)
        moved = jax.vmap(place)(jnp.arange(1, steps + 1)) if found is None else found[number]
        first = jnp.zeros(3) if isinstance(physics, PressedObstacle) else place(0)
        lost = _lost_contact(name, physics, scene, result, np.concatenate([first[None], moved]))
        said += [lost] if lost else _between_points(name, physics, scene, result, moved)
    return said


def of_friction_alone(scene: Scene, result: Result) -> list[str]:
    """Warn if a static run failed and only friction keeps the body, or a separate piece of it, from sliding."""
    rough = any(isinstance(physics, RoughObstacle) for physics in scene.physics)
    fine = (status.CONVERGED, status.ONE_STEP, status.STALLED)
    if not rough or scene.solve.kind != "static" or np.isin(result.statistics.status, fine).all():
        return []

    def without_friction(physics: Physics) -> tuple[np.ndarray, np.ndarray]:
        return Obstacle.holds(physics, scene.mesh) if isinstance(physics, RoughObstacle) else physics.holds(scene.mesh)

    loose = loose_piece(scene, without_friction)
    if not loose:
        return []
    return [
        f"the run failed, and only friction prevents sliding of {loose}: if the friction is too small for the sideways "
        "loads, no equilibrium exists; use a larger friction coefficient, [[fixed]], or kind = 'dynamic'"
    ]


def of_sharp_cones(scene: Scene, result: Result) -> list[str]:
    """Warn if a run with quadratic elements failed and a cone without a round tip is one of the obstacles."""
    sharp = [
        name
        for name, own in named_physics(scene)
        if isinstance(own, Obstacle) and own.shape == "cone" and not np.any(np.asarray(own.radius) > 0)
    ]
    fine = (status.CONVERGED, status.ONE_STEP)
    if not sharp or scene.mesh.order == 1 or np.isin(result.statistics.status, fine).all():
        return []
    return [
        f"the run failed, and {sharp[0]} is a cone with a sharp tip, under which quadratic elements may collapse: give "
        "the cone a round tip (radius), or use linear elements"
    ]
