"""Mesh error of the liver phantom at rest: finer meshes, elements of two orders, and the load in one or eight steps.

The phantom hangs under 2 m/s^2 (hyperelastic). Each of its 5,351 tetrahedra is cut into eight once. The load is applied
in eight steps, and in one. Both must end in the same equilibrium if they follow the same solution branch.

Under a quarter of that load, 0.5 m/s^2, its quadratic meshes are refined only at the edges of its clamps, where the
strain is singular. Each refinement changes the result by two to three fifths of the change before.

``python -m experiments liver_mesh`` (6 minutes) writes results/liver_mesh.json;
``python -m experiments.benchmarks.liver_mesh clamps`` runs the second part again.
"""

import json
import sys
import time
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

import liverjax as lj
from experiments.common import RESULTS, either, save
from experiments.liver import models
from liverjax.core import status
from liverjax.core.struct import replace
from liverjax.elements.gradients import volume_ratios
from liverjax.mesh.promotion import of_faces
from liverjax.mesh.refinement import refined
from liverjax.physics.prescribed import Fixed
from liverjax.scenes.enriched import enriched

MM = 1e-3


def phantom(level: int, order: int, steps: int) -> lj.Scene:
    """The scene on a mesh refined `level` times."""
    scene = models()["hyperelastic"]
    for _ in range(level):
        fixed = tuple(Fixed(nodes=jnp.asarray(of_faces(scene.mesh, np.asarray(f.nodes)))) for f in scene.fixed)
        scene = replace(scene, mesh=refined(scene.mesh), fixed=fixed)
    scene = replace(scene, solve=lj.Solve(linear_solver="cg", tolerance=1e-8, steps=steps))
    return enriched(scene) if order == 2 else scene


def row(level: int, order: int, steps: int, vertices: int) -> dict[str, Any]:
    """Run one case. Return displacements of the phantom's own vertices [mm], smallest J, and numbers of iterations."""
    scene = phantom(level, order, steps)
    begin = time.perf_counter()
    result = jax.block_until_ready(lj.simulate(scene))
    x = result.positions[:, :vertices]
    path = jnp.linalg.norm(x - scene.mesh.points[:vertices], axis=-1) / MM
    return {
        "level": level,
        "order": order,
        "steps": steps,
        "elements": scene.mesh.number_of_elements,
        "nodes": scene.mesh.number_of_nodes,
        "largest_mm": float(path[-1].max()),
        "mean_mm": float(path[-1].mean()),
        "path_mm": path.max(axis=1).tolist(),
        "smallest_J": float(volume_ratios(scene.mesh, result.positions[-1]).min()),
        "newton": np.asarray(result.statistics.iterations).tolist(),
        "linear": int(result.statistics.linear_iterations.sum()),
        "code": status.NAMES[int(np.asarray(result.status).max())],
        "first_s": time.perf_counter() - begin,
    }


def light(rims: int) -> lj.Scene:
    """Quadratic elements under 0.5 m/s^2, on a mesh refined `rims` times at the edges of the clamps."""
    scene = phantom(0, 1, 1)
    for _ in range(rims):
        mesh = scene.mesh
        held = {str(k): f.nodes for k, f in enumerate(scene.fixed)}
        near = np.concatenate([lj.rim(mesh, nodes) for nodes in held.values()])
        mesh = refined(replace(mesh, node_sets=held), near)
        fixed = tuple(replace(f, nodes=mesh.node_sets[str(k)]) for k, f in enumerate(scene.fixed))
        scene = replace(scene, mesh=mesh, fixed=fixed)
    body = replace(scene.body, gravity=jnp.asarray(scene.body.gravity) / 4)
    return enriched(replace(scene, body=body))


def clamps(vertices: int) -> list[dict[str, Any]]:
    """Return results [mm] and run times [s] of meshes refined at the clamps."""
    rows = []
    for rims in either((0, 1, 2, 3), (0, 1)):
        scene = light(rims)
        program = jax.jit(lj.simulate).lower(scene).compile()
        begin = time.process_time()
        result = jax.block_until_ready(program(scene))
        path = jnp.linalg.norm(result.positions[-1, :vertices] - scene.mesh.points[:vertices], axis=-1) / MM
        rows.append(
            {
                "rims": rims,
                "elements": scene.mesh.number_of_elements,
                "nodes": scene.mesh.number_of_nodes,
                "largest_mm": float(path.max()),
                "mean_mm": float(path.mean()),
                "smallest_J": float(volume_ratios(scene.mesh, result.positions[-1]).min()),
                "linear": int(result.statistics.linear_iterations.sum()),
                "code": status.NAMES[int(np.asarray(result.status).max())],
                "cpu_s": time.process_time() - begin,
            }
        )
        print(rows[-1], flush=True)
    return rows


def main(wanted: list[str]) -> None:
    """Run all cases."""
    vertices = models()["hyperelastic"].mesh.number_of_vertices
    if wanted == ["clamps"]:
        file = RESULTS / "liver_mesh.json"
        save("liver_mesh", json.loads(file.read_text()) | {"clamps": clamps(vertices)})
        return
    rows: list[dict] = []
    for level in either((0, 1), (0,)):
        for order in (1, 2):
            for steps in either((1, 8), (1,)):
                rows.append(row(level, order, steps, vertices))
                print(rows[-1], flush=True)
                save("liver_mesh", {"rows": rows})
    save("liver_mesh", {"rows": rows, "clamps": clamps(vertices)})


if __name__ == "__main__":
    main([a for a in sys.argv[1:] if not a.startswith("-")])
