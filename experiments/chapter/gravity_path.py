"""Distance of a liver under its own weight from collapse: static load steps up to full gravity, for several laws.

rho g H is 1.7 kPa for 16 cm. This is between the instantaneous Young's modulus (3 G0 = 2.3 kPa by Table 2) and the
long-term one (1.0 kPa). In the body the organ is supported all around; here it hangs by two patches.

    python -m experiments gravity_path
"""

import jax.numpy as jnp
import numpy as np

import liverjax as lj
from experiments.common import either, plt, save
from experiments.liver import models, timed_run
from liverjax import laws
from liverjax.core import status
from liverjax.core.plotting import COLOURS
from liverjax.core.struct import replace
from liverjax.tensors.matrices import deformation_gradient, determinant

STEPS = either(20, 10)
RELAXED = 1 - 0.235 - 0.333


def main() -> None:
    """Compute the load path of three laws."""
    scene = models()["hyperelastic"]
    law = scene.law
    named = {
        "at once (G = 770 Pa)": law,
        "relaxed (G = 333 Pa)": laws.scaled(law, RELAXED),
        "relaxed, Veronda-Westmann": lj.laws.VerondaWestmann(c1=770 * RELAXED / 2, c2=2.0, bulk=2200.0 * RELAXED),
    }
    rows, fig = {}, plt.figure(figsize=(9, 3.3), layout="constrained")
    left, right = fig.subplots(1, 2)
    g = 9.81 * np.arange(1, STEPS + 1) / STEPS
    for (name, law), colour in zip(named.items(), COLOURS, strict=False):
        body = lj.Body(density=1060.0, gravity=jnp.array([0.0, 9.81, 0.0]))
        still = replace(scene, law=law, body=body, solve=lj.Solve(steps=STEPS, tolerance=1e-6))
        result, took = timed_run(still, rounds=1)
        good = np.asarray(result.status) == status.CONVERGED
        J = np.array([np.asarray(determinant(deformation_gradient(scene.mesh, x))).min() for x in result.positions])
        moved = np.linalg.norm(np.asarray(result.positions) - np.asarray(scene.mesh.points), axis=-1).max(axis=1)
        reached = int(np.argmin(good)) if not good.all() else STEPS
        rows[name] = {
            "gravity": g.tolist(),
            "largest_displacement_m": moved.tolist(),
            "least_J": J.tolist(),
            "status": np.asarray(result.status).tolist(),
            "newton": np.asarray(result.statistics.iterations).tolist(),
            "cuts": np.asarray(result.statistics.cuts).tolist(),
            "converged_to_m_s2": float(g[reached - 1]) if reached else 0.0,
            "residual": float(np.asarray(result.statistics.residual)[good].max()) if good.any() else None,
            "run_s": took["run_s"],
        }
        print(name, rows[name]["converged_to_m_s2"], moved[:reached][-1:], J[:reached][-1:], took["run_s"], flush=True)
        residual = rows[name]["residual"]
        label = f"{name}: {took['run_s']:.1f} s, residuals to {residual:.0e}"
        left.plot(g[:reached], 100 * moved[:reached], "o-", ms=3, color=colour, label=label)
        right.plot(g[:reached], J[:reached], "o-", ms=3, color=colour)
    left.set(xlabel="gravity [m/s$^2$]", ylabel="largest displacement [cm]", title="liver phantom, static load path")
    right.set(
        xlabel="gravity [m/s$^2$]", ylabel="least J of an element [1]", title="a line ends where no step converged"
    )
    left.legend(fontsize=7)
    save("gravity_path", {"rows": rows, "relaxed_part": RELAXED}, fig)


if __name__ == "__main__":
    main()
