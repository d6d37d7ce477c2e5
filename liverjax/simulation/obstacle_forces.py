"""Forces on the rigid obstacles of a run, and the depth of the body's surface in each obstacle."""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from liverjax.core.errors import InputError
from liverjax.physics.base import End, Free, Start, Step
from liverjax.physics.contact.obstacle import Obstacle, largest_depth
from liverjax.scenes.scene import Scene
from liverjax.simulation.run import Result, prepared
from liverjax.tensors.matrices import deformation_gradient


class ObstacleForces(NamedTuple):
    """Force, depth and displacement of each obstacle of a scene at each of T steps, in the order of the obstacles."""

    force: jax.Array  # (obstacles, T, 3) [N] force of the body on the obstacle
    depth: jax.Array  # (obstacles, T) [m] maximum depth of the surface in the obstacle
    displacement: jax.Array  # (obstacles, T, 3) [m] displacement of the obstacle, prescribed or due to a force


def obstacle_forces(scene: Scene, result: Result) -> ObstacleForces:
    """Compute three results for the obstacles of a scene: the forces on them, their displacements, and how deep the
    body's surface lies in them.

    All three results are differentiable.

    Args:
        scene: the scene that was run.
        result: `Result` of `liverjax.simulate`, with all steps, for a run from the reference positions.

    Raises:
        InputError: the result does not contain all steps.
    """
    if len(result.positions) != scene.solve.steps:
        raise InputError(
            f"the result has {len(result.positions)} steps, but the scene has {scene.solve.steps}: give the result of "
            "all steps"
        )
    scene = prepared(scene)  # as for the run: numbers per element, in the precision of the scene
    steps, dt = scene.solve.steps, 0.0 if scene.solve.dt is None else scene.solve.dt
    mesh, free = scene.mesh, Free(jnp.ones_like(scene.mesh.points))
    numbers = jnp.arange(1, len(result.positions) + 1)
    found = [p.in_body(scene.mesh, scene.law) for p in scene.physics if isinstance(p, Obstacle)]

    def one(obstacle: Obstacle) -> tuple[jax.Array, jax.Array, jax.Array]:
        # Friction has an internal variable (the slip), so the steps are computed in order.
        def at(carry: Any, given: Any) -> tuple[Any, tuple[jax.Array, jax.Array, jax.Array]]:
            (memory, before), (k, x) = carry, given
            acting = obstacle.freeze(memory, Step(mesh, before, k, steps, dt, False, None, free))
            push = jnp.sum(acting.force(mesh, x, 1.0), axis=0)
            place = acting.place(x, 1.0)
            found = (push, largest_depth(obstacle, mesh, x, place), place)
            return (obstacle.advance(memory, acting, End(x, deformation_gradient(mesh, x), None)), x), found

        start = obstacle.begin(Start(mesh, mesh.points, free, lambda: jnp.zeros_like(mesh.points)))
        return jax.lax.scan(at, (start, mesh.points), (numbers, jnp.asarray(result.positions)))[1]

    if not found:
        none = jnp.zeros((0, len(numbers), 3))
        return ObstacleForces(none, none[..., 0], none)
    each = [one(obstacle) for obstacle in found]
    return ObstacleForces(*(jnp.stack(a) for a in zip(*each, strict=True)))
