"""The liver phantom as in a body: capsule, ligaments, vessels, a plane below it, and its unloaded shape.

The phantom is fixed at its vena cava and its suspensory ligament and lies on its back. Its weight is a fifth of gravity
as in Fig. 6. The table shows how each part changes the displacement of the tip (the node that moves most without these
parts), with run time and mesh error, and the same for quadratic elements on the same mesh. The motion of four models,
with and without viscosity and fluid, is run with all parts and without them. Its results are the tip's peak and the
fluid pressure.

For the complete model the mesh error is estimated. The linear solve for this estimate fails in some steps, because a
compressed capsule wrinkles between the vertices, as quadratic functions can. The model can be run with quadratic
elements as well (``finer``). If the phantom is fixed only at the two regions, these elements invert at the edges of the
clamps (``clamps`` shows where and why). Stiffness and thickness of the capsule (8 MPa, 50 um) are in the range of the
literature. The values for ligaments, vessels and plane are assumed, because no measurement of one liver has them all.

``python -m experiments liver_in_place`` (20 minutes) writes results/liver_in_place.json. ``python -m
experiments.chapter.liver_in_place motion`` (or ``rest``, ``unloaded``, ``clamps``, ``finer``) runs that part again and
keeps the results of the others.
"""

import json
import sys
import time
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

import liverjax as lj
from experiments.common import RESULTS, either, plt, save
from experiments.liver import models, timed_run, with_solve
from liverjax.core.plotting import BLUE, ORANGE
from liverjax.core.struct import replace
from liverjax.elements.gradients import volume_ratios
from liverjax.physics.attached import vessel
from liverjax.physics.attached.ligament import Ligament
from liverjax.physics.attached.membrane import Membrane
from liverjax.physics.base import Physics
from liverjax.physics.porosity import volumetric_stress
from liverjax.scenes.enriched import enriched
from liverjax.simulation.mesh_error import BAR, mesh_error_of
from liverjax.simulation.run import prepared

#: Young's modulus [Pa] and thickness [m] of Glisson's capsule; the same of a vessel's wall; stiffness [N/m] and
#: pre-tension [N] of a ligament.
CAPSULE, VESSEL, LIGAMENT = (8e6, 5e-5), (3e5, 1e-3), (50.0, 0.05)
SECONDS, DT = either(1.5, 0.3), 0.05


def parts(mesh: lj.TetMesh) -> dict[str, tuple[Physics, ...]]:
    """Return what supports the phantom in addition to its two fixed regions, by name."""
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


def with_mesh_error(scene: lj.Scene, result: lj.Result, tip: int, step: int) -> dict[str, Any]:
    """Return the displacement [m] of a node at a step, its correction for the mesh error, and the run time of the
    estimate.
    """
    begin = time.perf_counter()
    error = mesh_error_of(prepared(scene), result.positions, result.reactions)

    def moved(x: jax.Array, _: jax.Array) -> jax.Array:
        return jnp.linalg.norm(x[step, tip] - scene.mesh.points[tip])

    tip_m, change = error.change(moved, result)
    return {
        "tip_m": float(tip_m),
        "mesh_m": float(change),
        "mesh_found": bool(error.found[: step + 1].all()),
        "mesh_s": time.perf_counter() - begin,
    }


def at_rest(name: str, scene: lj.Scene, tip: int) -> dict[str, Any]:
    """Return displacements [m] and run time of a static scene, and for linear elements also the mesh error."""
    lj.check_scene(scene)
    result, took = timed_run(scene, rounds=1)
    rest = np.asarray(scene.mesh.points)
    far = np.linalg.norm(np.asarray(result.positions[-1]) - rest, axis=1)
    row = {"name": name, "order": scene.mesh.order, "largest_m": float(far.max()), "mean_m": float(far.mean())} | took
    if row["converged"] and scene.mesh.order == 1:
        row |= with_mesh_error(scene, result, tip, -1)
    obstacle = lj.obstacle_forces(scene, result)
    if len(obstacle.force):
        row |= {"plane_N": float(obstacle.force[0, -1, 1]), "depth_m": float(obstacle.depth[0, -1])}
    print(row, flush=True)
    return row


def there_and_back(name: str, scene: lj.Scene) -> dict[str, Any]:
    """Compute the shape without weight, and the distance of the loaded shape from the given one after a run back."""
    lj.check_scene(replace(scene, points_are="loaded"))
    begin = time.perf_counter()
    found = jax.block_until_ready(lj.unloaded(scene))
    first = time.perf_counter() - begin
    begin = time.perf_counter()
    found = jax.block_until_ready(lj.unloaded(scene))
    seconds = time.perf_counter() - begin
    given = np.asarray(scene.mesh.points)
    back = np.asarray(lj.simulate(found.scene).check().positions[-1])
    row = {
        "name": name,
        "largest_m": float(np.linalg.norm(np.asarray(found.scene.mesh.points) - given, axis=1).max()),
        "back_m": float(np.abs(back - given).max()),
        "run_s": seconds,
        "compile_s": first - seconds,
    }
    print(row, flush=True)
    return row


def in_motion(name: str, scene: lj.Scene, tip: int) -> dict[str, Any]:
    """Return the largest displacement of any node in a run [m], that of the tip with its mesh error, and pressures
    [Pa].
    """
    scene = with_solve(scene, SECONDS, DT)
    result, took = timed_run(scene, rounds=1)
    far = np.linalg.norm(np.asarray(result.positions) - np.asarray(scene.mesh.points), axis=2)
    row = {"name": name, "order": scene.mesh.order, "peak_m": float(far.max())} | took
    peak = int(far[:, tip].argmax())
    row["tip_m"] = float(far[peak, tip])
    if row["converged"] and scene.mesh.order == 1 and scene.viscosity is not None and scene.porosity is not None:
        row |= with_mesh_error(scene, result, tip, peak)
    if result.pressure is not None:
        row |= {"least_Pa": float(result.pressure.min()), "greatest_Pa": float(result.pressure.max())}
    print(row, flush=True)
    return row


def pressed_at_clamps(name: str, scene: lj.Scene) -> dict[str, Any]:
    """Return the time at which the first element inverts, and its distance from a fixed node [m].

    Two pressures [Pa] follow: the mean pressure on a fixed region, and the pressure at which the law's volume is zero.
    """
    scene = with_solve(scene, SECONDS / 3, DT)
    result, held = lj.simulate(scene), np.unique(np.concatenate([np.asarray(f.nodes) for f in scene.fixed]))
    rest, tets = np.asarray(scene.mesh.points), np.asarray(scene.mesh.tetrahedra)
    inverted = [np.any(np.asarray(volume_ratios(scene.mesh, x)) <= 0, axis=0) for x in result.positions]
    k = next(k for k, own in enumerate(inverted) if own.any())
    middles = rest[tets[inverted[k]]].mean(axis=1)
    away = np.linalg.norm(middles[:, None] - rest[held][None], axis=2).min(axis=1)
    corners = [rest[lj.boundary.boundary_triangles(scene.mesh, np.asarray(f.nodes))[:, :3]] for f in scene.fixed]
    areas = [np.linalg.norm(np.cross(c[:, 1] - c[:, 0], c[:, 2] - c[:, 0]), axis=1).sum() / 2 for c in corners]
    forces = [np.linalg.norm(np.asarray(result.reactions[k])[np.asarray(f.nodes)].sum(axis=0)) for f in scene.fixed]
    sponge = scene.porosity
    gone = scene.law.bulk if sponge is None else -volumetric_stress(sponge, jnp.zeros(()))
    row = {
        "name": name,
        "time_s": float(result.times[k]),
        "elements": int(inverted[k].sum()),
        "away_m": float(away.max()),
        "mean_Pa": float(max(f / a for f, a in zip(forces, areas, strict=True))),
        "gone_Pa": float(gone),
    }
    print(row, flush=True)
    return row


def scenes() -> tuple[dict[str, lj.Scene], dict[str, lj.Scene], dict[str, lj.Scene]]:
    """Return three groups of scenes: at rest with each support; loaded; moving, for each model with and without
    supports.
    """
    livers = models()
    livers["porohyperelastic"] = replace(livers["complete"], viscosity=None)
    solve = lj.Solve(steps=4, tolerance=1e-8)
    bare = replace(livers["hyperelastic"], solve=solve)
    physics = parts(bare.mesh)
    everything = tuple(p for own in physics.values() for p in own)
    cases = {"held at two places": ()} | {f"with {name}": own for name, own in physics.items()}
    rest = {name: replace(bare, physics=own) for name, own in (cases | {"with all": everything}).items()}
    exact = replace(solve, tolerance=1e-10)
    loaded = {name: replace(rest[name], solve=exact) for name in ("held at two places", "with all")}
    motion = {
        f"{model}, {what}": replace(livers[model], physics=own)
        for model in either(tuple(livers), ("viscous",))
        for what, own in (("held at two places", ()), ("with all", everything))
    }
    return rest, loaded, motion


def tip_of(scene: lj.Scene) -> int:
    """Return the node with the largest displacement."""
    result = lj.simulate(scene).check()
    return int(np.linalg.norm(np.asarray(result.positions[-1] - scene.mesh.points), axis=1).argmax())


def main() -> None:
    """Run all parts, or those on the command line, and plot what each support changes."""
    held, loaded, moved = scenes()
    asked = [part for part in ("rest", "unloaded", "motion", "clamps", "finer") if part in sys.argv[1:]]
    file = RESULTS / "liver_in_place.json"
    rows: dict[str, list[dict]] = json.loads(file.read_text()) if asked else {}
    rows.pop("environment", None)
    tip = tip_of(held["held at two places"])
    if not asked or "rest" in asked:
        rows["rest"] = [at_rest(name, scene, tip) for name, scene in held.items()]
        if either(True, False):
            rows["rest"] += [at_rest(name, enriched(scene), tip) for name, scene in held.items()]
    if not asked or "unloaded" in asked:
        rows["unloaded"] = [there_and_back(name, scene) for name, scene in loaded.items()]
    if not asked or "motion" in asked:
        rows["motion"] = [in_motion(name, scene, tip) for name, scene in moved.items()]
    if (not asked and either(True, False)) or "clamps" in asked:
        names = [f"{model}, held at two places" for model in ("hyperelastic", "complete")]
        rows["clamps"] = [pressed_at_clamps(name, enriched(moved[name])) for name in names]
    if (not asked and either(True, False)) or "finer" in asked:
        complete = {name: scene for name, scene in moved.items() if name.startswith("complete")}
        rows["finer"] = [in_motion(name, enriched(scene), tip) for name, scene in complete.items()]
    shown(rows)


def shown(rows: dict[str, list[dict]]) -> None:
    """Write the results, with their figure."""
    rest = rows["rest"]
    figure, axes = plt.subplots(figsize=(6.5, 3), layout="constrained")
    names = [f"{r['name']}, {'linear' if r['order'] == 1 else 'quadratic'}" for r in rest]
    colours = [BLUE if r["order"] == 1 else ORANGE for r in rest]
    far = [1e3 * r["largest_m"] if r["converged"] else 0.0 for r in rest]
    bars = [1e3 * BAR * abs(r.get("mesh_m", 0.0)) for r in rest]
    axes.barh(names, far, xerr=bars, color=colours)
    axes.set_xlabel("largest displacement under 2 m/s2, with the mesh's bar [mm]")
    axes.invert_yaxis()
    save("liver_in_place", rows, figure)


if __name__ == "__main__":
    main()
