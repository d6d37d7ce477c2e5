"""The liver phantom as it lies in a body: capsule, ligaments, vessels, a plane below it, and its unloaded shape.

The phantom is held at its vena cava and its suspensory ligament and lies on its back. Its weight is a fifth of gravity
as in Fig. 6. What each part changes in the largest displacement is told beside the run time; quadratic elements on the
same mesh tell what linear ones leave out. The motion of the viscous and the complete model is run with
all parts and without. The capsule's numbers (8 MPa, 50 um) are in the range of the literature; those of ligaments,
vessels and plane are chosen: no measurement of one liver has them all.

``python -m experiments liver_in_place`` (20 minutes) writes results/liver_in_place.json.
"""

import time
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

import liverjax as lj
from experiments.common import either, plt, save
from experiments.liver import models, timed_run, with_solve
from liverjax.core.plotting import BLUE, ORANGE
from liverjax.core.struct import replace
from liverjax.physics.attached import vessel
from liverjax.physics.attached.ligament import Ligament
from liverjax.physics.attached.membrane import Membrane
from liverjax.physics.base import Physics
from liverjax.scenes.enriched import enriched

#: Young's modulus [Pa] and thickness [m] of Glisson's capsule; of a vessel's wall; of a ligament [N/m], [N].
CAPSULE, VESSEL, LIGAMENT = (8e6, 5e-5), (3e5, 1e-3), (50.0, 0.05)
SECONDS, DT = either(1.5, 0.3), 0.05


def parts(mesh: lj.TetMesh) -> dict[str, tuple[Physics, ...]]:
    """What holds the phantom beside its two fixed places, by name."""
    surface = jnp.asarray(lj.boundary.boundary_triangles(mesh), jnp.int32)
    skin = Membrane(triangles=surface, thickness=CAPSULE[1], law=lj.laws.NeoHookean(mu=CAPSULE[0] / 3, bulk=None))
    cables = []
    for where, to in (({"x_max": -0.13}, (-0.16, -0.05, 0.02)), ({"x_min": 0.13}, (0.16, -0.05, 0.02))):
        nodes = jnp.asarray(lj.boundary.select(mesh, where), jnp.int32)
        cables.append(
            Ligament(
                nodes=nodes[None],
                weights=jnp.ones((1, len(nodes))),
                to=jnp.asarray(to),
                stiffness=LIGAMENT[0],
                pre_tension=LIGAMENT[1],
            )
        )
    wall = lj.laws.NeoHookean(mu=VESSEL[0] / 3, bulk=None)
    root = np.array([0.022, 0.055, 0.0])
    tubes = tuple(
        vessel.along(mesh, np.array([root, [0.4 * x, 0.02, 0.0], [x, -0.01, 0.0]]), 5e-3, wall, wall=VESSEL[1])
        for x in (-0.1, 0.1)
    )
    below = float(np.asarray(mesh.points)[:, 1].max())
    plane = lj.Obstacle(
        triangles=surface, shape="plane", position=jnp.array([0.0, below, 0.0]), axis=jnp.array([0.0, -1.0, 0.0])
    )
    return {"capsule": (skin,), "ligaments": tuple(cables), "vessels": tubes, "plane": (plane,)}


def at_rest(name: str, scene: lj.Scene) -> dict[str, Any]:
    """Largest displacement [m] of a scene, and run time."""
    lj.check_scene(scene)
    result, took = timed_run(scene)
    rest = np.asarray(scene.mesh.points)
    far = np.linalg.norm(np.asarray(result.positions[-1]) - rest, axis=1)
    row = {"name": name, "order": scene.mesh.order, "largest_m": float(far.max()), "mean_m": float(far.mean())} | took
    obstacle = lj.obstacle_forces(scene, result)
    if len(obstacle.force):
        row |= {"plane_N": float(obstacle.force[0, -1, 1]), "depth_m": float(obstacle.depth[0, -1])}
    print(row, flush=True)
    return row


def there_and_back(scene: lj.Scene) -> dict[str, Any]:
    """The shape without its weight, and how far the run from it ends from the given one."""
    begin = time.perf_counter()
    found = jax.block_until_ready(lj.unloaded(scene))
    first = time.perf_counter() - begin
    begin = time.perf_counter()
    found = jax.block_until_ready(lj.unloaded(scene))
    seconds = time.perf_counter() - begin
    given = np.asarray(scene.mesh.points)
    back = np.asarray(lj.simulate(found.scene).check().positions[-1])
    row = {
        "largest_m": float(np.linalg.norm(np.asarray(found.scene.mesh.points) - given, axis=1).max()),
        "back_m": float(np.abs(back - given).max()),
        "run_s": seconds,
        "compile_s": first - seconds,
    }
    print(row, flush=True)
    return row


def in_motion(name: str, scene: lj.Scene) -> dict[str, Any]:
    """Largest displacement of any node over the time of a run [m]."""
    result, took = timed_run(with_solve(scene, SECONDS, DT), rounds=1)
    far = np.linalg.norm(np.asarray(result.positions) - np.asarray(scene.mesh.points), axis=2)
    row = {"name": name, "peak_m": float(far.max())} | took
    print(row, flush=True)
    return row


def main() -> None:
    """All rows, and a figure of what each part changes."""
    livers = models()
    solve = lj.Solve(steps=4, tolerance=1e-8)
    bare = replace(livers["hyperelastic"], solve=solve)
    physics = parts(bare.mesh)
    everything = tuple(p for own in physics.values() for p in own)
    cases = {"held at two places": ()} | {f"with {name}": own for name, own in physics.items()}
    held = {name: replace(bare, physics=own) for name, own in (cases | {"with all": everything}).items()}
    rest = [at_rest(name, scene) for name, scene in held.items()]
    if either(True, False):
        rest += [at_rest(name, enriched(scene)) for name, scene in held.items()]
    unloaded = there_and_back(replace(bare, solve=replace(solve, tolerance=1e-10)))
    motion = [
        in_motion(f"{model}, {what}", replace(livers[model], physics=own))
        for model in either(("viscous", "complete"), ("viscous",))
        for what, own in (("held at two places", ()), ("with all", everything))
    ]
    figure, axes = plt.subplots(figsize=(6.5, 3), layout="constrained")
    names = [f"{r['name']}, {'linear' if r['order'] == 1 else 'quadratic'}" for r in rest]
    colours = [BLUE if r["order"] == 1 else ORANGE for r in rest]
    axes.barh(names, [1e3 * r["largest_m"] for r in rest], color=colours)
    axes.set_xlabel("largest displacement under 2 m/s2 [mm]")
    axes.invert_yaxis()
    save("liver_in_place", {"rest": rest, "unloaded": unloaded, "motion": motion}, figure)


if __name__ == "__main__":
    main()
