"""The liver under its full weight with time steps from 1 ms to 10 s: which steps reach equilibrium, and at what cost?

Twenty steps of each size are run for the hyperelastic, viscous and complete model. The solver follows the load; with
robust = "projected" it minimises the energy where following fails. Each step returns a status. The same runs are made
in float32, and their nodes are compared with those of float64 after the last step.
``python -m experiments stability_steps`` (14 minutes) writes results/stability_steps.json.
"""

import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np

import liverjax as lj
from experiments.common import either, save
from experiments.liver import models, timed_run
from liverjax.core import status
from liverjax.core.plotting import COLOURS
from liverjax.core.struct import replace
from liverjax.tensors.matrices import deformation_gradient, determinant

STEPS = either(20, 5)
SIZES = either((1e-3, 0.01, 0.05, 0.15, 0.3, 1.0, 3.0, 10.0), (0.05, 1.0))
SOLVERS = tuple((robust, precision) for precision in ("float64", "float32") for robust in ("off", "projected"))
TOLERANCE = {"float64": 1e-6, "float32": 1e-4}


def main() -> None:
    """Run every model, solver and step size."""
    rows, found = [], {}
    for name, scene in either(models(), {"hyperelastic": models()["hyperelastic"]}).items():
        body = lj.Body(density=1060.0, gravity=jnp.array([0.0, 9.81, 0.0]))
        for robust, precision in SOLVERS:
            chosen = {"robust": robust, "precision": precision, "tolerance": TOLERANCE[precision]}
            for dt in SIZES:
                solve = replace(scene.solve, dt=dt, steps=STEPS, **chosen)
                result, took = timed_run(replace(scene, body=body, solve=solve), rounds=1)
                keys = {"model": name, "robust": robust, "precision": precision, "dt": dt}
                found[name, robust, precision, dt] = result
                rows.append(keys | _row(scene.mesh, result) | {k: took[k] for k in ("steps_per_s", "compile_s")})
                rows[-1]["error"] = _apart(scene.mesh, result, found[name, robust, "float64", dt])
                print(rows[-1], flush=True)
                save("stability_steps", {"steps": STEPS, "tolerance": TOLERANCE, "rows": rows})
    save("stability_steps", {"steps": STEPS, "tolerance": TOLERANCE, "rows": rows}, _figure(rows))


def _row(mesh: lj.TetMesh, result: lj.Result) -> dict:
    """Return status and cost of a run."""
    codes, s = np.asarray(result.status), result.statistics
    least = [float(determinant(deformation_gradient(mesh, x)).min()) for x in np.asarray(result.positions, float)]
    return {
        "codes": {status.NAMES[c]: int((codes == c).sum()) for c in np.unique(codes).tolist()},
        "converged": int((codes == status.CONVERGED).sum()),
        "newton_a_step": float(s.iterations.mean()),
        "most_newton": int(s.iterations.max()),
        "linear_a_step": float(s.linear_iterations.mean()),
        "largest_residual": float(s.residual.max()) if np.isfinite(s.residual).all() else None,
        "least_J": min(least),
    }


def _apart(mesh: lj.TetMesh, result: lj.Result, of: lj.Result) -> float | None:
    """Return the largest distance of a node from another run after the last step, over the largest displacement there
    [1].

    Returns None if a step of either run did not reach equilibrium.
    """
    if not all((np.asarray(r.status) == status.CONVERGED).all() for r in (result, of)):
        return None
    x, exact = (np.asarray(r.positions[-1], float) for r in (result, of))
    moved = np.linalg.norm(exact - np.asarray(mesh.points), axis=1).max()
    return float(np.linalg.norm(x - exact, axis=1).max() / moved)


def _figure(rows: list[dict]) -> plt.Figure:
    figure, axes = plt.subplots(2, 2, figsize=(8, 6), layout="constrained", sharex=True, sharey=True)
    for axis, (robust, precision) in zip(axes.flat, SOLVERS, strict=True):
        for name, colour in zip(models(), COLOURS, strict=False):
            mine = [r for r in rows if (r["model"], r["robust"], r["precision"]) == (name, robust, precision)]
            x, y = [r["dt"] for r in mine], [r["newton_a_step"] for r in mine]
            axis.loglog(x, y, "-", color=colour, label=name)
            for good, marker in ((True, "o"), (False, "x")):
                part = [k for k, r in enumerate(mine) if (r["converged"] == STEPS) == good]
                axis.loglog([x[k] for k in part], [y[k] for k in part], marker, color=colour)
        axis.set_title(f"robust = {robust}, {precision}", fontsize=9)
    for axis in axes[1]:
        axis.set_xlabel("time step [s]")
    for axis in axes[:, 0]:
        axis.set_ylabel("Newton iterations a step")
    axes[0, 0].legend(title="cross: some step did not converge", title_fontsize=7, fontsize=7)
    return figure


if __name__ == "__main__":
    main()
