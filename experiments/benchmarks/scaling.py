"""Growth of time and memory with the size of the mesh: cubes of 1,000 to 1,000,000 tetrahedra.

``python -m experiments scaling`` (5 minutes) writes results/scaling.json and .png. Measured are force and stiffness of
all elements, and a dynamic step and a static load step, with iterations and residual, and the memory that XLA plans for
a step. Exponents are those of a straight line through the logarithms.
"""

import argparse
import resource
import time

import jax
import jax.numpy as jnp
import numpy as np

import liverjax as lj
from experiments.chapter.assembly_rivals import contracted
from experiments.common import either, plain_ticks, plt, save
from liverjax.core import status
from liverjax.core.plotting import BLUE, GREEN, ORANGE

CELLS = either((6, 9, 15, 25, 44, 55), (6, 9))
SIZE = 0.1


def scenes(cells: int) -> dict[str, lj.Scene]:
    """Return two scenes: a cube that hangs and oscillates, five steps of 0.05 s; and a cube stretched by 10 % in one
    load step.
    """
    mesh = lj.shapes.box((SIZE, SIZE, SIZE), (cells, cells, cells))
    top = (lj.Fixed(nodes=mesh.node_sets["z_max"]),)
    law = lj.laws.NeoHookean(mu=1000.0, bulk=10000.0)
    body = lj.Body(density=1060.0, gravity=jnp.array([0.0, 0.0, -9.81]))
    pull = (lj.Displaced(nodes=mesh.node_sets["z_min"], by=jnp.array([0.0, 0.0, -0.1 * SIZE])),)
    dynamic = lj.Solve(kind="dynamic", dt=0.05, steps=5, tolerance=1e-6)
    return {
        "dynamic step": lj.Scene(mesh=mesh, law=law, body=body, fixed=top, solve=dynamic),
        "static step": lj.Scene(mesh=mesh, law=law, fixed=top, displaced=pull, solve=lj.Solve(tolerance=1e-6)),
    }


def fastest(program, *arguments, rounds: int) -> tuple:
    """Return the result and the shortest time [s] of some runs after a first one."""
    result, seconds = jax.block_until_ready(program(*arguments)), []
    for _ in range(rounds):
        begin = time.perf_counter()
        jax.block_until_ready(program(*arguments))
        seconds.append(time.perf_counter() - begin)
    return result, min(seconds)


def measure(cells: int) -> dict:
    """Measure one size."""
    begin = time.perf_counter()
    made = scenes(cells)
    mesh = made["dynamic step"].mesh
    row = {"tetrahedra": mesh.number_of_elements, "nodes": mesh.number_of_nodes, "mesh_s": time.perf_counter() - begin}
    rounds = 3 if mesh.number_of_elements < 2e5 else 1
    terms = jax.jit(contracted).lower(mesh, made["static step"].law, mesh.points).compile()
    row["force and stiffness"] = {"seconds": fastest(terms, mesh, made["static step"].law, mesh.points, rounds=5)[1]}
    for name, scene in made.items():
        begin = time.perf_counter()
        program = jax.jit(lj.simulate).lower(scene).compile()
        compiling = time.perf_counter() - begin
        result, seconds = fastest(program, scene, rounds=rounds)
        steps, s = len(result.times), result.statistics
        plan = program.memory_analysis()
        row[name] = {
            "seconds": seconds / steps,
            "compile_s": compiling,
            "linear_per_step": float(s.linear_iterations.sum()) / steps,
            "residual": float(np.max(np.asarray(s.residual))),
            "converged": bool((np.asarray(result.status) == status.CONVERGED).all()),
            "bytes": plan.argument_size_in_bytes + plan.output_size_in_bytes + plan.temp_size_in_bytes,
        }
    row["peak_memory_bytes"] = 1024 * resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return row


def exponent(rows: list[dict], name: str, least: float = 5e3, most: float = 5.2e5) -> float:
    """Return the exponent of time against the number of tetrahedra, between these sizes."""
    chosen = [r for r in rows if least <= r["tetrahedra"] <= most or r["tetrahedra"] == 4374]
    n, t = (np.log([f(r) for r in chosen]) for f in (lambda r: r["tetrahedra"], lambda r: r[name]["seconds"]))
    return float(np.polyfit(n, t, 1)[0])


def main() -> None:
    """Measure all sizes, compute the exponents, and plot the figure."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--cells", type=int, nargs="*", default=list(CELLS))
    parser.add_argument("--quick", action="store_true", help="two small sizes")
    rows = []
    for cells in parser.parse_args().cells:
        rows.append(measure(cells))
        print(rows[-1], flush=True)
        jax.clear_caches()
    names = ("force and stiffness", "dynamic step", "static step")
    exponents = {name: exponent(rows, name) for name in names}
    print(exponents)
    save("scaling", {"sizes": rows, "exponents": exponents}, draw(rows, exponents))


def draw(rows: list[dict], exponents: dict):
    """Plot time on the left, with residuals and iterations; on the right the memory per element."""
    fig, (left, right) = plt.subplots(1, 2, figsize=(10, 4), layout="constrained")
    n = [r["tetrahedra"] for r in rows]
    for (name, e), colour in zip(exponents.items(), (GREEN, BLUE, ORANGE), strict=True):
        left.loglog(n, [r[name]["seconds"] for r in rows], "o-", color=colour, label=f"{name}: n^{e:.2f}")
        if name == "force and stiffness":
            continue
        for r in rows:
            text = f"{r[name]['linear_per_step']:.0f} it., {r[name]['residual']:.0e}"
            at = (r["tetrahedra"], r[name]["seconds"])
            left.annotate(text, at, fontsize=6, xytext=(3, -8), textcoords="offset points")
        right.semilogx(n, [r[name]["bytes"] / r["tetrahedra"] / 1000 for r in rows], "o-", color=colour, label=name)
    left.set(xlabel="tetrahedra", ylabel="time [s]", title="beside: linear iterations and residual")
    right.set(xlabel="tetrahedra", ylabel="memory planned [kB an element]", ylim=(0, None))
    plain_ticks(left.yaxis)
    for axis in (left, right):
        axis.legend(fontsize=8)
    return fig


if __name__ == "__main__":
    main()
