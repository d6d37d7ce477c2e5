"""Accuracy of the estimated mesh error while a body moves.

* A free body falls. All its points move equally, so the exact result depends only on the time steps and has a closed
  form.
* A cantilever of 100 x 20 x 20 mm is released under a weight along its axis (it stretches) or perpendicular to it (it
  bends). Both motions are run with a small and a large weight. The reference has 864 quadratic elements with consistent
  masses and the same time steps, without correction. Quadratic elements on a coarser mesh show the error of this
  reference.

All bodies are released at t = 0. Errors are those of the middle of the free end along the weight, as root mean square
over all steps. Effectivity is the size of the estimate divided by the size of the true error. "Corrected" is the error
with the estimate added, divided by the error without it.

``python -m experiments moving_mesh`` (15 minutes beside other work) writes results/moving_mesh.json.
"""

import time
from typing import Any

import jax.numpy as jnp
import numpy as np

import liverjax as lj
from experiments.common import either, save
from liverjax.core.struct import replace

LENGTH, WIDTH, MU, DENSITY = 0.1, 0.02, 4000.0, 1000.0
#: Order of the elements, and cells along the body. The number of cells across it makes them nearly cubes.
MESHES = either(((1, 5), (1, 10), (2, 2), (2, 5)), ((1, 5), (2, 2)))
TRUTHS = either((10, 16), (8, 10))
#: Weight [m/s^2], its axis, integrator and time step [s]: at most a fortieth of the longest period.
CASES: dict[str, tuple[float, int, str, float]] = {
    "bends by 4 mm": (0.05, 2, "newmark", 0.01),
    "bends by 60 mm": (1.0, 2, "newmark", 0.01),
    "bends by 4 mm, implicit Euler": (0.05, 2, "euler", 0.01),
    "stretches by a tenth": (10.0, 0, "newmark", 0.004),
}
STEPS = either(100, 20)
FALLS = ((1, "lumped", "newmark"), (2, "lumped", "newmark"), (2, "lumped", "euler"), (2, "consistent", "newmark"))


def body(order: int, cells: int, case: str, mass: str = "lumped") -> lj.Scene:
    """The cantilever for one of the CASES."""
    weight, axis, integrator, dt = CASES[case]
    across = max(1, round(cells * WIDTH / LENGTH))
    mesh = lj.shapes.box((LENGTH, WIDTH, WIDTH), (cells, across, across))
    mesh = lj.quadratic(mesh) if order == 2 else mesh
    return lj.Scene(
        mesh=mesh,
        law=lj.laws.NeoHookean(mu=MU, bulk=2 * MU),
        body=lj.Body(density=DENSITY, gravity=weight * jnp.eye(3)[axis], mass=mass),
        fixed=(lj.Fixed(nodes=mesh.node_sets["x_min"]),),
        solve=lj.Solve(kind="dynamic", integrator=integrator, dt=dt, steps=STEPS),
    )


def end(scene: lj.Scene, u: np.ndarray, axis: int) -> np.ndarray:
    """Return the displacement (T,) [m] of the free end along an axis: the mean of its corners, from all `u` (T,
    V, 3).
    """
    points = np.asarray(scene.mesh.points)
    corners = [np.argmin(np.linalg.norm(points - (LENGTH, y, z), axis=1)) for y in (0, WIDTH) for z in (0, WIDTH)]
    return np.asarray(u)[:, corners, axis].mean(axis=1)


def moved(scene: lj.Scene, axis: int) -> np.ndarray:
    """Run a scene and return the displacement of its `end`."""
    return end(scene, lj.simulate(scene).check().positions - scene.mesh.points, axis)


def size(values: np.ndarray) -> float:
    """Return the root mean square."""
    return float(np.sqrt(np.mean(values**2)))


def judged(scene: lj.Scene, truth: np.ndarray, axis: int) -> dict[str, Any]:
    """Return the error of a run and the quality of its estimate."""
    begin = time.perf_counter()
    result = lj.simulate(scene, mesh_error=True).check()
    off = truth - end(scene, result.positions - scene.mesh.points, axis)
    change = end(scene, result.mesh_error.positions, axis)
    return {
        "order": scene.mesh.order,
        "elements": scene.mesh.number_of_elements,
        "mass": scene.body.mass,
        "error_m": size(off),
        "effectivity": size(change) / size(off),
        "left": size(off - change) / size(off),
        "found": float(np.mean(np.asarray(result.mesh_error.found))),
        "seconds": time.perf_counter() - begin,
    }


def moving(case: str) -> list[dict[str, Any]]:
    """Return the results of all meshes for one case."""
    axis = CASES[case][1]
    coarse, fine = (moved(body(2, cells, case, "consistent"), axis) for cells in TRUTHS)
    rows = []
    # Implicit Euler needs separately compiled programs, so it runs on every second mesh only.
    for order, cells in MESHES if CASES[case][2] == "newmark" else MESHES[::2]:
        row = judged(body(order, cells, case), fine, axis)
        rows.append({"case": case, "motion_m": size(fine), "truth_m": size(fine - coarse)} | row)
        print(rows[-1], flush=True)
    return rows


def falling(order: int, integrator: str, mass: str = "lumped") -> dict[str, Any]:
    """A free body of 2 x 1 x 1 cells falls."""
    held = body(order, 2, "bends by 4 mm", mass)
    solve = replace(held.solve, integrator=integrator, dt=0.002, steps=20)
    scene = replace(held, body=replace(held.body, gravity=jnp.array([0.0, 0.0, 9.81])), fixed=(), solve=solve)
    n = np.arange(1, solve.steps + 1)
    fallen = 9.81 * solve.dt**2 * (n**2 if integrator == "newmark" else n * (n + 1)) / 2
    return {"case": "falls freely", "integrator": integrator, "motion_m": size(fallen)} | judged(scene, fallen, 2)


def main() -> None:
    """Run all cases."""
    fall = []
    for order, mass, integrator in FALLS:
        fall.append(falling(order, integrator, mass))
        print(fall[-1], flush=True)
    rows = [row for case in CASES for row in moving(case)]
    save("moving_mesh", {"falling": fall, "moving": rows, "steps": STEPS})


if __name__ == "__main__":
    main()
