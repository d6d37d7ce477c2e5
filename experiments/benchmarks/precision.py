"""float32 compared with float64: force and stiffness of every law, a static cube, the liver's steps; error and floor.

The error of force and stiffness is the difference from float64 at the same positions, divided by the largest entry. The
floor is the smallest residual (relative to the acting forces) that Newton's method can reach. With a smaller tolerance
it reports that it has stalled.

    python -m experiments precision [--quick]
"""

import sys

import jax
import jax.numpy as jnp
import numpy as np

import liverjax as lj
from experiments.benchmarks.solve_benchmark import cube, medians
from experiments.chapter.assembly_rivals import contracted
from experiments.common import either, plain_ticks, plt, save
from experiments.liver import models, timed_run, with_solve
from liverjax.core import status
from liverjax.core.plotting import BLUE, ORANGE
from liverjax.core.struct import replace
from liverjax.elements import mjed

PRECISIONS = {"float64": jnp.float64, "float32": jnp.float32}


def cast(tree, dtype):
    """Return the tree with every floating-point array in another precision."""
    return jax.tree.map(lambda a: a.astype(dtype) if jnp.issubdtype(jnp.asarray(a).dtype, jnp.floating) else a, tree)


def force_and_stiffness(mesh: lj.TetMesh, law: lj.Law, x: jax.Array) -> tuple:
    """Return the force and stiffness of the elements that a Newton step needs."""
    return mjed.internal_force(mesh, law, x), jnp.stack(jnp.broadcast_arrays(*contracted(mesh, law, x)[1]))


def laws(cells: int, names: list[str]) -> list[dict]:
    """Return one row for each law: a cube stretched and sheared by up to 20 %, without inverted elements."""
    mesh = lj.shapes.box((0.1, 0.1, 0.1), (cells, cells, cells))
    X, rows = mesh.points, []
    F = jnp.array([[1.15, 0.1, 0.0], [0.0, 0.9, 0.05], [0.08, 0.0, 1.05]])
    x = X @ F.T + 0.002 * jnp.sin(40 * X)
    for name in names:
        law = jax.tree.map(jnp.asarray, lj.laws.typical(name))
        programs = {
            p: (force_and_stiffness, *(cast(tree, dtype) for tree in (mesh, law, x))) for p, dtype in PRECISIONS.items()
        }
        found, seconds = medians(programs)
        double, single = ([np.asarray(a, float) for a in found[p]] for p in PRECISIONS)
        off = [float(abs(b - a).max() / abs(a).max()) for a, b in zip(double, single, strict=True)]
        rows.append({"law": name, "tetrahedra": mesh.number_of_elements, "seconds": seconds})
        rows[-1] |= {"force_error": off[0], "stiffness_error": off[1]}
        print(rows[-1], flush=True)
    return rows


def static(cells: int) -> list[dict]:
    """Solve the cube stretched by 20 % to several tolerances. Return run time, and largest error of a node over the
    stretch.
    """
    exact, rows = np.asarray(lj.simulate(cube(cells, tolerance=1e-12)).positions[-1]), []
    for precision, tolerances in (
        ("float64", (1e-2, 1e-4, 1e-6, 1e-8, 1e-12)),
        ("float32", (1e-2, 1e-3, 1e-4, 3e-5, 1e-5, 3e-6)),
    ):
        for tolerance in tolerances:
            result, row = timed_run(cube(cells, tolerance=tolerance, precision=precision))
            off = float(np.abs(np.asarray(result.positions[-1]) - exact).max() / 0.02)
            row |= {"precision": precision, "tolerance": tolerance, "error": off, "dt": None}
            rows.append(row | {"residual": float(result.statistics.residual[-1]), "code": code(result)})
            print(rows[-1], flush=True)
    return rows


def code(result: lj.Result) -> str:
    """Return the worst status of all steps."""
    return status.NAMES[int(status.most_severe(result.status))]


def liver(steps: int) -> list[dict]:
    """Run the phantom's three models with steps of 0.05 s: float64 to 1e-6 and 1e-4, float32 to 1e-4.

    Returns run times and the largest error of a node.
    """
    rows = []
    for name, scene in either(models(), {"viscous": models()["viscous"]}).items():
        scene = with_solve(scene, 0.05 * steps, 0.05, tolerance=1e-6)
        exact = np.asarray(lj.simulate(replace(scene, solve=replace(scene.solve, tolerance=1e-10))).positions)
        size = np.abs(exact - np.asarray(scene.mesh.points)).max()
        for precision, tolerance in (("float64", 1e-6), ("float64", 1e-4), ("float32", 1e-4)):
            solve = replace(scene.solve, precision=precision, tolerance=tolerance)
            result, row = timed_run(replace(scene, solve=solve))
            off = float(np.abs(np.asarray(result.positions) - exact).max() / size)
            row |= {"model": name, "precision": precision, "tolerance": tolerance, "error": off, "code": code(result)}
            rows.append(row | {"residual": float(np.asarray(result.statistics.residual).max())})
            print(rows[-1], flush=True)
    return rows


def figure(rows: dict) -> plt.Figure:
    """Plot the time of force and stiffness, and error against run time of the cube."""
    fig, axes = plt.subplots(1, 2, figsize=(9, 3.6), layout="constrained")
    names = [r["law"] for r in rows["laws"]]
    for k, (precision, colour) in enumerate(zip(PRECISIONS, (BLUE, ORANGE), strict=True)):
        ms = [1e3 * r["seconds"][precision] for r in rows["laws"]]
        axes[0].barh(np.arange(len(names)) + 0.4 * k, ms, 0.4, color=colour, label=precision)
        of = [r for r in rows["cube"] if r["precision"] == precision and r["code"] == "converged" and r["error"] > 0]
        axes[1].loglog([r["run_s"] for r in of], [r["error"] for r in of], "o-", color=colour, label=precision)
    for k, r in enumerate(rows["laws"]):
        text = f"{max(r['force_error'], r['stiffness_error']):.0e}"
        axes[0].annotate(text, (1e3 * r["seconds"]["float32"], k + 0.4), fontsize=7, va="center")
    axes[0].set_yticks(np.arange(len(names)) + 0.2, names, fontsize=7)
    axes[0].set(xlabel="force and stiffness [ms] (error of float32 beside)", xscale="log")
    plain_ticks(axes[0].xaxis)
    axes[1].set(xlabel="run time [s]", ylabel="error of positions over the pull [1]", title="static cube, 20 %")
    plain_ticks(axes[1].xaxis)
    axes[0].legend()
    return fig


def main(quick: bool) -> None:
    """Compute three tables and one figure."""
    names = ["neo_hookean", "costa"] if quick else list(lj.laws.LAWS)
    cells = 6 if quick else 15
    rows = {"laws": laws(cells, names), "cube": static(cells), "liver": liver(4 if quick else 40)}
    save("precision", rows, figure(rows))


if __name__ == "__main__":
    main("--quick" in sys.argv[1:])
