"""Intervals of a sweep alone, and of a sweep fitted together with a creep or tension test (synthetic data).

The material is a soft tissue with three modes (30, 1 and 0.05 s). The sweep covers 0.1 to 10 Hz, so the slow mode is
outside its band. A creep test of 120 s shows the slow mode. It does not show the fast mode, and determines G0 less
well, because it gives only one number for it. The third test is a stretch held for 30 s. Noise is 2 % of every reading.
The data are computed with half the time step of the fit and on a finer mesh.

    python -m experiments creep_and_sweep [--quick]
"""

import sys

import jax.numpy as jnp
import numpy as np

import liverjax as lj
from experiments.common import plt, save
from fitting.fits import joint
from fitting.methods import generalised_maxwell
from fitting.readers.rheometer import Sweep
from fitting.rigs import glued
from liverjax.core.plotting import COLOURS

TRUE = generalised_maxwell.Maxwell(jnp.asarray(770.0), jnp.array([0.2, 0.2, 0.25]), jnp.array([30.0, 1.0, 0.05]))
LAW = lj.laws.NeoHookean(mu=1.0, bulk=20.0)
RADIUS, HEIGHT, NOISE = 0.01, 0.01, 0.02
#: Mesh of the data: cells half as large at the rims, with slower growth, and a polygon with more corners.
FINE = glued.Cells(rim=0.02, edge=0.01, growth=0.5, corners=32)


def sweep(rng: np.random.Generator) -> joint.Test:
    """A sweep with seventeen frequencies."""
    omega = 2 * np.pi * np.logspace(-1, 1, 17)
    pure = [np.asarray(m) for m in generalised_maxwell.moduli(TRUE, jnp.asarray(omega))]
    noisy = [m * (1 + NOISE * rng.normal(size=m.shape)) for m in pure]
    return joint.sweep(Sweep(omega, *noisy, *(NOISE * m for m in pure), "synthetic"))


def readings(fine: glued.Rig, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """Return noisy readings and their standard deviations: every second step of a rig with half the time step."""
    viscosity = lj.Prony(ratios=TRUE.ratios, relaxation_times=TRUE.relaxation_times)
    pure = np.asarray(glued.read(fine, lj.laws.scaled(LAW, TRUE.shear_modulus), viscosity)[0])[1::2]
    return pure + NOISE * abs(pure) * rng.normal(size=pure.shape), NOISE * abs(pure)


def creep(rng: np.random.Generator, seconds: float, dt: float = 1.0) -> joint.Test:
    """A creep test with a tensile stress of 20 Pa."""
    made = [glued.creep(RADIUS, HEIGHT, h, round(seconds / h), 20.0, c) for h, c in ((dt, None), (dt / 2, FINE))]
    return joint.through("creep", made[0], *readings(made[1], rng))


def pull(rng: np.random.Generator, seconds: float, dt: float = 0.5) -> joint.Test:
    """A tension test: 5 % within one step, then constant."""
    made = [
        glued.tension(RADIUS, HEIGHT, h, 0.05 * np.minimum(1, h / dt * np.arange(1, round(seconds / h) + 1)), c)
        for h, c in ((dt, None), (dt / 2, FINE))
    ]
    return joint.through("pull", made[0], *readings(made[1], rng))


def known(values: np.ndarray) -> list[float | None]:
    """Return the values. Infinite values, of parameters that the data do not determine, become None."""
    return [value if np.isfinite(value) else None for value in values.tolist()]


def main(quick: bool) -> None:
    """Fit each combination of tests, and plot the intervals."""
    rng = np.random.default_rng(0)
    tests = {"sweep": sweep(rng), "creep": creep(rng, 10 if quick else 120), "pull": pull(rng, 5 if quick else 30)}
    start = generalised_maxwell.Maxwell(jnp.asarray(700.0), jnp.array([0.25, 0.2, 0.2]), jnp.array([20.0, 1.5, 0.08]))
    true = np.asarray([float(TRUE.shear_modulus), *np.asarray(TRUE.ratios), *np.asarray(TRUE.relaxation_times)])
    rows = []
    for names in (("sweep",), ("creep",), ("sweep", "creep"), ("sweep", "pull"), ("sweep", "creep", "pull")):
        found = joint.fit([tests[n] for n in names], start, LAW)
        rows.append(
            {
                "tests": " + ".join(names),
                "parameters": dict(zip(found.names, found.values.tolist(), strict=True)),
                "standard_errors": dict(zip(found.names, known(found.standard_errors), strict=True)),
                "off_in_standard_errors": known((found.values - true) / found.standard_errors),
                "mesh_bias": None if found.mesh_bias is None else known(found.mesh_bias),
                "time_step_bias": None if found.time_step_bias is None else known(found.time_step_bias),
                "chi2_per_reading": found.chi2 / found.components,
                "readings": found.components,
                "iterations": found.iterations,
                "converged": found.converged,
                "seconds": found.seconds,
            }
        )
        print(rows[-1], flush=True)
    save("creep_and_sweep", {"noise": NOISE, "true": true.tolist(), "rows": rows}, figure(rows, true))


def figure(rows: list[dict], true: np.ndarray) -> plt.Figure:
    """Plot standard errors over true values. Errors of undetermined parameters are cut off at 1."""
    fig, axis = plt.subplots(figsize=(8, 3.4), layout="constrained")
    shown = [r for r in rows if r["tests"] != "creep"]
    for k, (row, colour) in enumerate(zip(shown, COLOURS, strict=False)):
        height = np.fmin(np.array(list(row["standard_errors"].values()), float) / true, 1.0)
        label = f"{row['tests']} ({row['seconds']:.0f} s)"
        axis.bar(np.arange(len(true)) + 0.2 * (k - 1.5), height, 0.2, color=colour, label=label)
    names = ["G0", "g (30 s)", "g (1 s)", "g (0.05 s)", "30 s", "1 s", "0.05 s"]
    axis.set_xticks(np.arange(len(true)), names)
    axis.set(ylabel="standard error / true value [1] (1: not determined)", yscale="log")
    axis.legend(fontsize=8)
    return fig


if __name__ == "__main__":
    main("--quick" in sys.argv[1:])
