"""Forces of each support condition on the body over time: the table of `reactions.csv`."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from liverjax.mesh.selection import AXES
from liverjax.physics.attached.ligament import Ligament
from liverjax.physics.base import Free, Physics, Step
from liverjax.physics.elastic_support import ElasticSupport
from liverjax.physics.sliding_support import SlidingSupport
from liverjax.scenes.scene import Scene
from liverjax.simulation.obstacle_forces import obstacle_forces
from liverjax.simulation.run import Result, prepared


def reaction_table(scene: Scene, result: Result) -> tuple[list[str], np.ndarray]:
    """Return the column names and rows of a table with the time and the force of each support on the body.

    For obstacles, the table also contains their displacement, and the maximum penetration depth of the surface.
    """
    names, columns = ["time"], [np.asarray(result.times)]

    def add(name: str, vectors: Any, unit: str) -> None:
        names.extend(f"{name}.{axis}_{unit}" for axis in "xyz")
        columns.extend(np.asarray(vectors).T)

    for name, held in held_forces(scene, np.asarray(result.reactions)).items():
        add(name, held, "N")
    for name, force in spring_forces(scene, result).items():
        add(name, force, "N")
    if scene.named("obstacle"):
        contact = obstacle_forces(scene, result)
        for k in range(len(contact.force)):
            add(f"obstacle.{k}", 0.0 - np.asarray(contact.force[k]), "N")
            add(f"obstacle.{k}", contact.displacement[k], "m")
            names.append(f"obstacle.{k}.depth_m")
            columns.append(np.asarray(contact.depth[k]))
    return names, np.stack(columns, axis=1)


def held_forces(scene: Scene, reactions: np.ndarray) -> dict[str, np.ndarray]:
    """Return {name: force (T, 3) [N]} of each fixed, displaced or sliding condition. `reactions` (T, V, 3) [N] are the
    reactions of the nodes at T steps.

    The force of a fixed or displaced condition acts along the axes that it constrains. The force of a sliding support
    acts along its normal. If two conditions constrain the same axis of a node, the force along this axis counts only
    for the first condition. So the sum over all conditions is the total force on the body.
    """
    taken, found = np.zeros(reactions.shape[1:], bool), {}

    def along(nodes: np.ndarray, axes: list[int]) -> np.ndarray:
        own = np.zeros((len(nodes), 3), bool)
        own[:, axes] = ~taken[nodes][:, axes]
        taken[nodes] |= own
        return np.where(own, reactions[:, nodes], 0.0).sum(axis=1)

    for kind in ("fixed", "displaced"):
        for k, part in enumerate(getattr(scene, kind)):
            axes = [AXES.index(axis) for axis in part.axes]
            found[f"{kind}.{k}"] = along(np.unique(np.asarray(part.nodes)), axes)
    supports = [(f"support.{k}", scene.physics[place]) for k, place in enumerate(scene.named("support"))]
    slides = {name: physics for name, physics in supports if isinstance(physics, SlidingSupport)}
    for name, physics in slides.items():
        if physics.axis:
            found[name] = along(np.unique(np.asarray(physics.nodes)), [AXES.index(physics.axis)])
    for name, physics in slides.items():
        if physics.axis:
            continue
        # The normal has components along some axes. If other conditions already constrain a node along all of these
        # axes, the sliding support gets no force at this node.
        nodes, normal = np.unique(np.asarray(physics.nodes)), np.asarray(physics.normal)
        loose = nodes[~taken[nodes][:, np.abs(normal) > 1e-12].all(axis=1)]
        found[name] = (reactions[:, loose] @ normal).sum(axis=1)[:, None] * normal
    order = [name for name in found if name not in slides]
    return {name: found[name] for name in (*order, *slides)}


def spring_forces(scene: Scene, result: Result) -> dict[str, jax.Array]:
    """Return {name: force (T, 3) [N] on the body} of elastic supports, and of ligaments with an end outside the body.

    Args:
        scene: the scene that was run.
        result: `Result` of `liverjax.simulate` with all steps.
    """

    def holds(physics: Physics) -> bool:
        return isinstance(physics, ElasticSupport) or (isinstance(physics, Ligament) and physics.to is not None)

    places = {
        f"{section}.{k}": place
        for section in ("support", "ligament")
        for k, place in enumerate(scene.named(section))
        if holds(scene.physics[place])
    }
    if not places:
        return {}
    scene = prepared(scene)
    dt = 0.0 if scene.solve.dt is None else scene.solve.dt
    mesh, free = scene.mesh, Free(jnp.ones_like(scene.mesh.points))
    numbers = jnp.arange(1, len(result.positions) + 1)

    def pull(physics: Physics) -> jax.Array:
        def at(given: Any) -> jax.Array:
            k, x = given
            acting = physics.freeze(None, Step(mesh, x, k, scene.solve.steps, dt, False, None, free))
            return 0.0 - jnp.sum(acting.force(mesh, x, 1.0), axis=0)

        return jax.lax.map(at, (numbers, jnp.asarray(result.positions)))

    return {name: pull(scene.physics[place]) for name, place in places.items()}
