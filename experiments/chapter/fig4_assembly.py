"""The chapter's Fig. 4: force and stiffness of a cube of 20,250 tetrahedra, for every law and every method.

``python -m experiments fig4_assembly`` (25 minutes) writes results/fig4_assembly.json and .png; with ``--laws NAME …``
it replaces only these laws in the results. For each method, the results contain the median time of interleaved rounds,
the error against the vmapped Hessian, and the compile time. Two lower bounds are listed too: the time to write the 45
entries and do nothing else, and the time to copy as many bytes as the chapter's full matrices have.
"""

import argparse
import json
import statistics
import time
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np

import liverjax as lj
from experiments.chapter import assembly_rivals
from experiments.common import RESULTS, either, plain_ticks, plt, save
from liverjax import laws
from liverjax.core.errors import InputError
from liverjax.core.plotting import BLUE, COLOURS, GREY
from liverjax.elements import mjed
from liverjax.simulation import tangent
from liverjax.simulation.equations import equations, initial_state

WAYS = {
    "contracted": assembly_rivals.contracted,
    "chapter, on the fly": assembly_rivals.chapter,
    "chapter, parts written": partial(assembly_rivals.chapter, write=True),
    "chapter, L and U stored": assembly_rivals.chapter,
    "standard FEM": assembly_rivals.standard,
    "standard FEM, parts written": partial(assembly_rivals.standard, write=True),
    "autodiff 9 x 9": assembly_rivals.autodiff,
    "autodiff 9 x 9, parts written": partial(assembly_rivals.autodiff, write=True),
    "vmapped Hessian": assembly_rivals.vmapped,
}
#: Methods in the comparison. Each has a textbook variant, and one that writes intermediate results; the faster one
#: counts.
RIVALS = {
    "chapter": ("chapter, on the fly", "chapter, parts written"),
    "standard FEM": ("standard FEM", "standard FEM, parts written"),
    "autodiff 9 x 9": ("autodiff 9 x 9", "autodiff 9 x 9, parts written"),
    "vmapped Hessian": ("vmapped Hessian",),
}
COLOUR = dict(zip(["contracted", *RIVALS, "chapter, L and U stored"], COLOURS, strict=False))
COPIED = 23_000_000  # bytes: about 20,250 full matrices of 144 numbers


def programs(mesh: lj.mesh.TetMesh, law: lj.laws.Law, x: jax.Array, stored: list) -> tuple[dict, dict]:
    """Compile all methods. Return the programs with their arguments, and the compile times.

    A method that does not support the law is left out.
    """
    made, compiling = {}, {}
    every = WAYS | {"force only": mjed.internal_force, "into the solver's rows": into_rows}
    for name, function in every.items():
        arguments = (mesh, law, x, stored) if "stored" in name else (mesh, law, x)
        begin = time.perf_counter()
        try:
            made[name] = jax.jit(function).lower(*arguments).compile(), arguments
        except InputError:
            continue
        compiling[name] = time.perf_counter() - begin
    return made, compiling


def into_rows(mesh: lj.mesh.TetMesh, law: lj.laws.Law, x: jax.Array) -> tuple:
    """Return the force, and the stiffness assembled into the padded rows that the solver multiplies with."""
    scene = lj.Scene(mesh=mesh, law=law)
    return mjed.internal_force(mesh, law, x), tangent.stiffness(equations(scene, initial_state(scene), 1.0), None, x)


def medians(made: dict, rounds: int) -> dict[str, float]:
    """Return the median seconds of each program. Each round contains all programs.

    In each round a program runs twice, and the second run counts, as in a loop. The first run must request the memory
    that the program before has released.
    """
    seconds = {name: [] for name in made}
    for _ in range(rounds + 1):
        for name, (program, arguments) in made.items():
            jax.block_until_ready(program(*arguments))
            begin = time.perf_counter()
            jax.block_until_ready(program(*arguments))
            seconds[name].append(time.perf_counter() - begin)
    return {name: statistics.median(values[1:]) for name, values in seconds.items()}


def errors(made: dict) -> dict[str, float | None]:
    """Return the largest difference of the 45 entries from those of the vmapped Hessian, divided by the largest entry.

    The value is None if it is not finite. If the Hessian itself is not finite, the contracted method is the reference.
    """

    def entries(name):
        program, arguments = made[name]
        K = program(*arguments)[1]
        K = assembly_rivals.entries_of(K) if name == "vmapped Hessian" else K
        return np.stack([np.broadcast_to(k, arguments[0].volumes.shape) for k in K])

    every = {n: entries(n) for n in made if n in WAYS}
    exact = every["vmapped Hessian"]
    exact = exact if np.isfinite(exact).all() else every["contracted"]
    found = {n: float(abs(K - exact).max() / abs(exact).max()) for n, K in every.items()}
    return {n: e if np.isfinite(e) else None for n, e in found.items()}


def main() -> None:
    """Measure all laws and write the table and the figure."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--rounds", type=int, default=either(15, 3))
    parser.add_argument("--laws", nargs="*", default=either(list(laws.LAWS), ["neo_hookean", "mooney_rivlin", "costa"]))
    parser.add_argument("--quick", action="store_true", help="three laws, three rounds")
    options = parser.parse_args()
    mesh = lj.shapes.box((1.0, 1.0, 1.0), (15, 15, 15))
    x = mesh.points + 0.004 * jnp.asarray(np.random.default_rng(0).standard_normal(mesh.points.shape))
    stored = jax.jit(assembly_rivals.stored_matrices)(mesh)
    block = jnp.zeros(COPIED // 8)
    kept = RESULTS / "fig4_assembly.json"
    rows = json.loads(kept.read_text())["laws"] if kept.exists() else {}  # laws that are not named stay
    for name in options.laws:
        made, compiling = programs(mesh, laws.typical(name), x, stored)
        made["floor"] = jax.jit(assembly_rivals.floor), (mesh, laws.typical(name), x)
        made["copy"] = jax.jit(lambda a: a + 1.0), (block,)
        rows[name] = {"seconds": medians(made, options.rounds), "compile_s": compiling, "errors": errors(made)}
        ms = {key: round(1e3 * s, 2) for key, s in rows[name]["seconds"].items()}
        print(f"{name:26s} {ms} {rows[name]['errors']}", flush=True)
        jax.clear_caches()
        compared(rows)
        save("fig4_assembly", {"elements": mesh.number_of_elements, "rounds": options.rounds, "laws": rows}, draw(rows))


def compared(rows: dict) -> None:
    """Add to each row the run time of every method over that of contracted terms, also for the faster variant of each
    rival.
    """
    neo = rows.get("neo_hookean", next(iter(rows.values())))["seconds"]["contracted"]
    for row in rows.values():
        s = row["seconds"]
        row["times_faster"] = {way: s[way] / s["contracted"] for way in WAYS if way in s}
        best = {r: [row["times_faster"][w] for w in ways if w in s] for r, ways in RIVALS.items()}
        row["best_rival"] = {r: min(found) for r, found in best.items() if found}
        row["over_neo_hookean"] = s["contracted"] / neo


def draw(rows: dict) -> plt.Figure:
    """Plot the run time of every method on the left, and its ratio to that of contracted terms on the right."""
    fig, (left, right) = plt.subplots(1, 2, figsize=(10, 7.5), sharey=True, layout="constrained")
    at = np.arange(len(rows))
    for k, way in enumerate(WAYS):
        written = way.endswith(", parts written")  # hollow symbol
        family = next((r for r, ways in RIVALS.items() if way in ways), way)
        look = {"ms": 5, "color": COLOUR[family], "mfc": "none" if written else COLOUR[family]}
        for j, row in enumerate(rows.values()):
            if way in row["seconds"]:
                y, label = at[j] + 0.09 * (k - 4), way if j == 0 else None
                left.plot(1e3 * row["seconds"][way], y, "o", label=label, **look)
                right.plot(row["times_faster"][way], y, "o", **look)
    floor = 1e3 * statistics.median(r["seconds"]["floor"] for r in rows.values())
    left.axvline(floor, color=GREY, ls=":", label="45 rows written, nothing else")
    worst = max(e for r in rows.values() for e in r["errors"].values() if e is not None)
    left.set(yticks=at, yticklabels=[n.replace("_", " ") for n in rows], xscale="log", xlabel="20,250 tetrahedra [ms]")
    left.set_title(f"force and stiffness; all agree to {worst:.0e}")
    right.set(xscale="log", xlabel="time over that of contracted terms [1]")
    right.axvline(1.0, color=BLUE)
    left.invert_yaxis()
    plain_ticks(left.xaxis, right.xaxis)
    fig.legend(loc="outside lower center", ncols=4, fontsize=8)
    return fig


if __name__ == "__main__":
    main()
