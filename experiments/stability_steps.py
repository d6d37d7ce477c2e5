"""The liver under its full weight at time steps from 1 ms to 10 s: which steps end in equilibrium, and what they take.

Twenty steps of each size, hyperelastic, viscous and complete, as the solver follows the load and with
robust = "projected", which makes the energy least where following fails; a code a step, in words.
``python experiments/stability_steps.py`` (15 minutes) writes results/stability_steps.json.
"""

import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np
from common import either, save
from liver import models, timed_run

import liverjax as lj
from liverjax import status
from liverjax.colours import COLOURS
from liverjax.kinematics import deformation_gradient, determinant
from liverjax.struct import replace

STEPS = either(20, 5)
SIZES = either((1e-3, 0.01, 0.05, 0.15, 0.3, 1.0, 3.0, 10.0), (0.05, 1.0))
SOLVERS = ("off", "projected")


def main() -> None:
    """Every model, solver and step."""
    rows = []
    for name, scene in either(models(), {"hyperelastic": models()["hyperelastic"]}).items():
        body = lj.Body(density=1060.0, gravity=jnp.array([0.0, 9.81, 0.0]))
        for robust in SOLVERS:
            for dt in SIZES:
                solve = replace(scene.solve, dt=dt, steps=STEPS, robust=robust)
                result, took = timed_run(replace(scene, body=body, solve=solve), rounds=1)
                codes, s = np.asarray(result.status), result.statistics
                least = [float(determinant(deformation_gradient(scene.mesh, x)).min()) for x in result.positions]
                rows.append(
                    {
                        "model": name,
                        "robust": robust,
                        "dt": dt,
                        "codes": {status.NAMES[c]: int((codes == c).sum()) for c in np.unique(codes).tolist()},
                        "converged": int((codes == status.CONVERGED).sum()),
                        "newton_a_step": float(s.iterations.mean()),
                        "most_newton": int(s.iterations.max()),
                        "linear_a_step": float(s.linear_iterations.mean()),
                        "largest_residual": float(s.residual.max()) if np.isfinite(s.residual).all() else None,
                        "least_J": min(least),
                        "steps_per_s": took["steps_per_s"],
                        "compile_s": took["compile_s"],
                    }
                )
                print(rows[-1], flush=True)
                save("stability_steps", {"steps": STEPS, "rows": rows})
    save("stability_steps", {"steps": STEPS, "rows": rows}, _figure(rows))


def _figure(rows: list[dict]) -> plt.Figure:
    figure, axes = plt.subplots(1, 2, figsize=(8, 3.2), layout="constrained", sharey=True)
    for axis, robust in zip(axes, SOLVERS, strict=True):
        for name, colour in zip(models(), COLOURS, strict=False):
            mine = [r for r in rows if (r["model"], r["robust"]) == (name, robust)]
            x, y = [r["dt"] for r in mine], [r["newton_a_step"] for r in mine]
            axis.loglog(x, y, "-", color=colour, label=name)
            for good, marker in ((True, "o"), (False, "x")):
                part = [k for k, r in enumerate(mine) if (r["converged"] == STEPS) == good]
                axis.loglog([x[k] for k in part], [y[k] for k in part], marker, color=colour)
        axis.set(xlabel="time step [s]", title=f"robust = {robust}; cross: some step did not converge")
    axes[0].set_ylabel("Newton iterations a step")
    axes[0].legend()
    return figure


if __name__ == "__main__":
    main()
