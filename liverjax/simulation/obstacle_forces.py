"""What rigid obstacles feel of a run: the force on each, and how deep the surface is in it."""

from typing import NamedTuple

import jax
import jax.numpy as jnp

from liverjax.physics.contact.obstacle import Obstacle, contact_force, largest_depth
from liverjax.scenes.scene import Scene
from liverjax.simulation.run import Result, unloaded


class ObstacleForces(NamedTuple):
    """Of each obstacle of a scene, in their order, at every step."""

    force: jax.Array  # (obstacles, T, 3) [N] of the body on the obstacle
    depth: jax.Array  # (obstacles, T) [m] largest depth of the surface in it


def obstacle_forces(scene: Scene, result: Result) -> ObstacleForces:
    """Forces on the obstacles of a scene, and the depths that the contact leaves; differentiable.

    Args:
        scene: as it was run.
        result: `Result` of `liverjax.simulate`, all steps stored.
    """
    scene = unloaded(scene).scene if scene.points_are == "loaded" else scene
    steps, dt = scene.solve.steps, 0.0 if scene.solve.dt is None else scene.solve.dt
    numbers = jnp.arange(1, len(result.positions) + 1)
    found = [p.in_body(scene.mesh, scene.law) for p in scene.physics if isinstance(p, Obstacle)]

    def one(obstacle: Obstacle) -> tuple[jax.Array, jax.Array]:
        def at(k: jax.Array, x: jax.Array) -> tuple[jax.Array, jax.Array]:
            moved = obstacle.displacement(k, steps, dt)
            push = contact_force(obstacle, scene.mesh, x, moved)
            return jnp.sum(push, axis=0), largest_depth(obstacle, scene.mesh, x, moved)

        return jax.lax.map(lambda given: at(*given), (numbers, result.positions))

    if not found:
        return ObstacleForces(jnp.zeros((0, len(numbers), 3)), jnp.zeros((0, len(numbers))))
    each = [one(obstacle) for obstacle in found]
    return ObstacleForces(*(jnp.stack(a) for a in zip(*each, strict=True)))
