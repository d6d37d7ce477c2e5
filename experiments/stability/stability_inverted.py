"""Inverted and crushed starting positions: which solver returns to rest, with how many iterations and how much time?

A block that hangs under a fifth of gravity starts from scrambled positions with 0, 5, 20 or 50 % of its elements
inverted (50 seeds each), or compressed to J = 0.05. The result is compared with that of a run from rest. Three groups
of solvers are tested:

* Minimisation of the energy with the projected stiffness, or with the chapter's regularised one, from the starting
  positions themselves. This is one step of motion of 10,000 s, which cannot use another starting point.
* Plain Newton with load steps.
* Both stiffnesses in a static run, where a starting position is only a guess. If it is inverted, the load is followed
  from the reference shape instead. So these rates show only that the reference shape is a good starting point.

``python -m experiments stability_inverted [LAW …]`` (40 minutes for all laws) writes results/stability_inverted.json,
or replaces the named laws in it.
"""

import json
import sys
import time

import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np
from mpl_toolkits.mplot3d.art3d import Poly3DCollection

import liverjax as lj
from experiments.common import RESULTS, either, save
from liverjax import laws
from liverjax.core import status
from liverjax.mesh import shapes
from liverjax.physics import boundary

MESH = shapes.box((0.1, 0.1, 0.1), (3, 3, 3))
PARTS, SEEDS, FLAT = (0.0, 0.05, 0.2, 0.5), either(50, 4), 0.05
SOLVERS = {
    "projected, from the start itself": lj.Solve(kind="dynamic", dt=1e4, robust="projected"),
    "regularised, from the start itself": lj.Solve(kind="dynamic", dt=1e4, robust="regularised"),
    "plain": lj.Solve(),
    "projected, guess left": lj.Solve(robust="projected"),
    "regularised, guess left": lj.Solve(robust="regularised"),
    "projected, guess left, float32": lj.Solve(robust="projected", precision="float32", tolerance=1e-4),
}
#: Laws for which a solver starts from the scrambled positions themselves. Compilation takes a minute per law.
MOVED = {
    "projected, from the start itself": (
        *("stable_neo_hookean", "neo_hookean", "arruda_boyce", "saint_venant_kirchhoff"),
        *("mooney_rivlin", "neo_hookean_compressible", "yeoh", "ogden"),
    ),
    "regularised, from the start itself": ("stable_neo_hookean", "neo_hookean", "arruda_boyce"),
}
#: Largest difference, relative to the size of the block, of equal results. A residual of 1e-8 allows about 1e-9, a
#: residual of 1e-4 about 1e-5.
SAME = {"float64": 1e-6, "float32": 1e-4}


def scene(law: lj.Law, solve: lj.Solve) -> lj.Scene:
    """The hanging block."""
    top = np.flatnonzero(np.asarray(MESH.points)[:, 2] > 0.0999)
    return lj.Scene(
        mesh=MESH,
        law=law,
        body=lj.Body(density=1060.0, gravity=jnp.array([0.0, 0.0, -2.0])),
        fixed=(lj.Fixed(nodes=top),),
        solve=solve,
    )


def volume_ratios(x: np.ndarray) -> np.ndarray:
    """Return J of every element."""
    return np.asarray(lj.tet_mesh(x, MESH.tetrahedra).volumes / MESH.volumes)


def scrambled(part: float, seed: int) -> np.ndarray:
    """Return positions in which about this fraction of the elements is inverted. With 0, the largest distortion without
    inversion.
    """
    points = np.asarray(MESH.points)
    noise = np.random.default_rng(seed).standard_normal(points.shape)
    low, high = 0.0, 0.3
    for _ in range(25):
        middle = 0.5 * (low + high)
        inverted = np.mean(volume_ratios(points + middle * noise) < 0)
        low, high = (low, middle) if inverted > part or (part > 0 and inverted == part) else (middle, high)
    return points + (low if part == 0 else high) * noise


def starts() -> dict[str, jax.Array]:
    """Return starting positions (N, V, 3) by name."""
    made = {f"{100 * p:g} % inverted": np.stack([scrambled(p, k) for k in range(SEEDS)]) for p in PARTS}
    crushed = np.asarray(MESH.points) * [1, 1, FLAT] + [0, 0, 0.1 * (1 - FLAT)]
    return {name: jnp.asarray(x) for name, x in made.items()} | {f"crushed to J = {FLAT}": jnp.asarray(crushed[None])}


def tried(law: lj.Law, solve: lj.Solve, all_starts: dict[str, jax.Array], rest: np.ndarray) -> dict[str, dict]:
    """Return the results of one solver from every starting position."""
    block = scene(law, solve)

    def one(x):
        result = lj.simulate(block, start=x)
        s = result.statistics
        return result.positions[-1], result.status[0], s.iterations[0]

    begin = time.perf_counter()
    program = jax.jit(one).lower(all_starts["0 % inverted"][0]).compile()
    compiling, table = time.perf_counter() - begin, {}
    for name, several in all_starts.items():
        begin = time.perf_counter()
        found = [jax.block_until_ready(program(x)) for x in several]
        seconds = (time.perf_counter() - begin) / len(found)
        x, codes, iterations = (np.stack([np.asarray(f[k]) for f in found]) for k in range(3))
        error = np.abs(x - rest).max(axis=(1, 2)) / 0.1
        right = (codes == status.CONVERGED) & (error < SAME[solve.precision])
        table[name] = {
            "right": int(right.sum()),
            "converged_elsewhere": int(((codes == status.CONVERGED) & ~right).sum()),
            "codes": {status.NAMES[c]: int((codes == c).sum()) for c in np.unique(codes).tolist()},
            "starts": len(codes),
            "median_iterations": float(np.median(iterations[right])) if right.any() else None,
            "most_iterations": int(iterations[right].max()) if right.any() else None,
            "largest_error_where_right": float(error[right].max()) if right.any() else None,
            "seconds_a_start": seconds,
            "compile_s": compiling,
        }
    return table


def main(names: list[str]) -> None:
    """Run every law with every solver."""
    kept = RESULTS / "stability_inverted.json"
    all_starts, content = starts(), {"elements": MESH.number_of_elements, "seeds": SEEDS, "laws": {}}
    if kept.exists():  # laws that are stored already stay
        content["laws"] = json.loads(kept.read_text())["laws"]
    for name in names:
        law = laws.typical(name)
        rest = np.asarray(lj.simulate(scene(law, SOLVERS["plain"])).check().positions[-1])
        mine = {n: solve for n, solve in SOLVERS.items() if name in MOVED.get(n, (name,))}
        content["laws"][name] = {n: tried(law, solve, all_starts, rest) for n, solve in mine.items()}
        for solver, table in content["laws"][name].items():
            print(name, solver, [(row["right"], row["most_iterations"]) for row in table.values()], flush=True)
        save("stability_inverted", content, _figure(content))
    _pictures(all_starts)


def _figure(content: dict) -> plt.Figure:
    figure, axes = plt.subplots(
        1, len(SOLVERS), figsize=(15, 1.1 + 0.28 * len(content["laws"])), layout="constrained", sharey=True
    )
    for axis, solver in zip(axes, SOLVERS, strict=True):
        cases = list(next(iter(content["laws"].values()))["plain"])
        for i, table in enumerate(content["laws"].values()):
            for j, c in enumerate(cases if solver in table else ()):
                rate = 100 * table[solver][c]["right"] / table[solver][c]["starts"]
                axis.imshow([[rate]], extent=(j - 0.5, j + 0.5, i + 0.5, i - 0.5), vmin=0, vmax=100, cmap="cividis")
                most = table[solver][c]["most_iterations"]
                text = f"{rate:.0f}" + (f" ({most})" if most is not None else "")
                axis.text(j, i, text, ha="center", va="center", fontsize=6, color="k" if rate > 50 else "w")
        axis.set(xlim=(-0.5, len(cases) - 0.5), ylim=(len(content["laws"]) - 0.5, -0.5), aspect="auto")
        axis.set_xticks(range(len(cases)), [c.replace(" inverted", "").replace("to J", "\nto J") for c in cases])
        axis.tick_params(labelsize=6)
        axis.set_yticks(range(len(content["laws"])), [n.replace("_", " ") for n in content["laws"]])
        axis.set_title(solver.replace(", ", ",\n", 1), fontsize=9)
        axis.grid(False)
    figure.supxlabel("elements inverted at the start", fontsize=9)
    figure.suptitle("% of starts that end at the minimum reached from rest (most iterations)", fontsize=9)
    return figure


def _pictures(all_starts: dict[str, jax.Array]) -> None:
    """Plot a starting position of the worst kind, its end, and an end in another equilibrium: a folded one, if there is
    any.
    """
    law, several = laws.typical("stable_neo_hookean"), all_starts["50 % inverted"]
    block = scene(law, SOLVERS["projected, from the start itself"])
    program = jax.jit(lambda x: lj.simulate(block, start=x).positions[-1])
    rest = np.asarray(lj.simulate(scene(law, SOLVERS["plain"])).positions[-1])
    found = [np.asarray(program(x)) for x in several[:10]]
    wrong = [np.abs(x - rest).max() > 0.1 * SAME["float64"] for x in found]
    right = wrong.index(False)
    panels = [(several[right], "start, half inverted"), (found[right], "its end")]
    if any(wrong):  # with few starting positions, none may fold
        panels.append((found[wrong.index(True)], "end of another start"))
    figure = plt.figure(figsize=(9.5, 3.6))
    for k, (x, title) in enumerate(panels):
        axis = figure.add_subplot(1, 3, k + 1, projection="3d")
        surface = Poly3DCollection(np.asarray(x)[boundary.boundary_triangles(MESH)], edgecolor="k", lw=0.3, alpha=0.8)
        surface.set_facecolor("#56b4e9")
        axis.add_collection3d(surface)
        for direction in "xyz":
            getattr(axis, f"set_{direction}lim")(-0.1, 0.2)
            getattr(axis, f"set_{direction}ticks")((-0.1, 0.0, 0.1, 0.2))
            getattr(axis, f"set_{direction}label")(f"{direction} [m]")
        axis.tick_params(labelsize=6)
        axis.set_box_aspect((1, 1, 1), zoom=0.8)
        axis.set_title(title)
    figure.savefig(RESULTS / "stability_worst.png")


if __name__ == "__main__":
    main([a for a in sys.argv[1:] if a != "--quick"] or either(list(laws.LAWS), ["stable_neo_hookean"]))
