"""Tables of stiff and extreme cases."""

from typing import NamedTuple

from experiments.pages import rigs
from experiments.pages.results import load, percent


def stability() -> str:
    """Tables of inverted starting positions, the liver with any time step, locking, and rigs."""
    return "\n".join([*_inverted(), "", *_steps(), "", *_cost(), "", *_locking(), "", rigs.rigs()])


class Returned(NamedTuple):
    """Fractions of scrambled starting positions that end at the minimum reached from rest.

    `least` and `most` are the smallest and largest fraction over laws and kinds of starting positions.
    """

    least: float
    most: float
    laws: int
    folded: float  # fraction of the others that ends in another equilibrium


def returned(solver: str, cases: tuple[str, ...] | None = None) -> Returned:
    """Return the results for some kinds of starting positions (all if None), over all laws tested with a solver."""
    (data,) = load("stability_inverted")
    tables = [t[solver] for t in data["laws"].values() if solver in t]
    found = [r for t in tables for case, r in t.items() if cases is None or case in cases]
    parts = [r["right"] / r["starts"] for r in found]
    others = sum(r["starts"] - r["right"] for r in found)
    folded = sum(r["converged_elsewhere"] for r in found) / others if others else 0.0
    return Returned(min(parts), max(parts), len(tables), folded)


def _inverted() -> list[str]:
    (data,) = load("stability_inverted")
    cases = list(next(iter(data["laws"].values()))["plain"])
    rows = [
        f"A hanging block of {data['elements']} tetrahedra begins at {data['seeds']} random (scrambled) positions for "
        "each column. The table contains the percentage of runs",
        "that end at the minimum that is reached from rest, to 1e-6 of the size (float32: 1e-4). In brackets: the "
        "largest number of iterations; time per",
        "run. In the first rows, the minimiser begins at these positions themselves, in one time step of 10,000 s, in "
        "which they cannot be",
        "replaced. This was tried for some laws only. Then follow rows of plain Newton. The last rows are static "
        "runs, in which the positions are only a first guess.",
        "If elements are inverted, these runs begin at the reference shape instead. So their percentages show how "
        "often the load can be followed from there:",
        "",
        "| law | solver | " + " | ".join(cases) + " |",
        "|---" * (2 + len(cases)) + "|",
    ]

    def cell(r: dict) -> str:
        rate = f"{100 * r['right'] / r['starts']:.0f} %"
        return rate + (f" ({r['most_iterations']}; {1e3 * r['seconds_a_start']:.2g} ms)" if r["right"] else "")

    # Sorted by solver, so that runs from the starting positions themselves come first.
    for solver in next(iter(data["laws"].values())):
        for law, table in ((n, t[solver]) for n, t in data["laws"].items() if solver in t):
            rows.append(f"| `{law}` | {solver} | " + " | ".join(cell(table[case]) for case in cases) + " |")
    return rows


def _steps() -> list[str]:
    (data,) = load("stability_steps")
    sizes, wanted, tolerance = sorted({r["dt"] for r in data["rows"]}), data["steps"], data["tolerance"]
    rows = [
        f"The liver phantom under its full weight, {wanted} steps of each size. Each cell contains the number of steps "
        "in equilibrium (residual below",
        f"{tolerance['float64']:g}, in float32 {tolerance['float32']:g}), the Newton iterations per step and the steps "
        "per second.",
        "For float32 it also contains the largest distance of a node from the result of float64 at the end, divided "
        "by the largest displacement, if all",
        "steps of both runs are in equilibrium:",
        "",
        "| model | robust | precision | " + " | ".join(f"{dt:g} s" for dt in sizes) + " |",
        "|---" * (3 + len(sizes)) + "|",
    ]

    def cell(r: dict) -> str:
        found = f"{r['converged']}/{wanted}, {r['newton_a_step']:.3g}, {r['steps_per_s']:.3g}"
        return found if r["precision"] == "float64" or r["error"] is None else f"{found}, {r['error']:.0e}"

    for key in dict.fromkeys((r["model"], r["robust"], r["precision"]) for r in data["rows"]):
        mine = {r["dt"]: r for r in data["rows"] if (r["model"], r["robust"], r["precision"]) == key}
        rows.append("| " + " | ".join(key) + " | " + " | ".join(cell(mine[dt]) for dt in sizes) + " |")
    return rows


def _cost() -> list[str]:
    (data,) = load("stability_cost")
    times = [f"{r['model']} {r['time_over_off']:.2f}" for r in data["rows"]]
    compiles = [f"{r['compile_s']['off']:.0f} to {r['compile_s']['projected']:.0f} s" for r in data["rows"]]
    apart = max(r["largest_difference_m"] for r in data["rows"])
    return [
        "Under a fifth of gravity, `robust` is not needed. The run time with `robust` divided by the run time without "
        "it is:",
        f"{', '.join(times)} (positions differ by {apart:.0e} m). The compilation time grows from",
        f"{', '.join(compiles)}.",
    ]


def _locking() -> list[str]:
    (data,) = load("stability_bulk")
    kinds = [(v, p) for p in ("float64", "float32") for v in ("element", "nodal")]
    rows = [
        "The next table shows errors due to locking and bending. The reference is a finer mesh of quadratic elements",
        "with pressure unknowns in float64, and matrices are factorised. The table also gives Newton iterations and "
        "run time.",
        '"Stalled" means that the precision of the numbers allows no residual below the tolerance of 1e-4. The best '
        "result was kept:",
        "",
        "| body | cells | K/mu | volumes of elements | volumes averaged at nodes | volumes of elements, float32 | "
        "volumes averaged at nodes, float32 |",
        "|---" * 7 + "|",
    ]

    def cell(r: dict) -> str:
        found = f"{100 * abs(r['error']):.2g} %, {r['newton']} iterations, {r['run_s']:.2g} s"
        # Stalled: the residual is at, or near, the limit of the number format.
        return {"converged": found, "stalled": f"stalled: {found}"}.get(r["code"], r["code"])

    direct = [r for r in data["rows"] if r["linear_solver"] == "direct"]
    finest = {body: max(r["cells"] for r in direct if r["body"] == body) for body in {r["body"] for r in direct}}
    for body, ratio in dict.fromkeys((r["body"], r["ratio"]) for r in direct):
        mine = [r for r in direct if (r["body"], r["ratio"], r["cells"]) == (body, ratio, finest[body])]
        of = {(r["volumetric"], r["precision"]): cell(r) for r in mine}
        rows.append(f"| {body} | {finest[body]} | {ratio:g} | " + " | ".join(of[kind] for kind in kinds) + " |")
    return rows


def inverted_came_out() -> str:
    """Sentence for the overview."""
    solver = "projected, from the start itself"
    half, fifth = returned(solver, ("50 % inverted",)), returned(solver, ("20 % inverted",))
    left = returned("projected, guess left")

    def part(found: Returned) -> str:
        return "all" if found.least == 1 else f"at least {percent(found.least)}"

    return (
        f"in a time step from such positions, `projected` finds the right equilibrium in {percent(half.least)} to "
        f"{percent(half.most)} of the runs if half of the elements are inverted ({half.laws} laws; "
        f"{percent(half.folded)} of the other runs end folded, in another equilibrium), and in {part(fifth)} if 20 % "
        f"are inverted; in static runs it is {part(left)}, because the run then begins at the reference shape"
    )


def steps_came_out() -> str:
    """Sentence for the overview."""
    (data,) = load("stability_steps")

    def good(precision: str) -> str:
        kind = ("complete", "projected", precision)
        mine = [r for r in data["rows"] if (r["model"], r["robust"], r["precision"]) == kind]
        return f"{sum(r['converged'] == data['steps'] for r in mine)} of {len(mine)}"

    return (
        f"with `robust` the complete model converges with {good('float64')} step sizes from 1 ms to 10 s, in float32 "
        f"with {good('float32')}"
    )


def bulk_came_out() -> str:
    """Sentence for the overview."""
    (data,) = load("stability_bulk")
    key = ("Cook's membrane", 1e4, 16, "direct", "float64")
    rows = [
        r for r in data["rows"] if tuple(r[k] for k in ("body", "ratio", "cells", "linear_solver", "precision")) == key
    ]
    off = {r["volumetric"]: abs(r["error"]) for r in rows}
    return (
        f"error of Cook's membrane at K/mu = 1e4: {percent(off['element'])} with volumes of elements, "
        f"{percent(off['nodal'])} with volumes averaged at the nodes"
    )


def cost_came_out() -> str:
    """Sentence for the overview."""
    (data,) = load("stability_cost")
    over = ", ".join(f"{r['model']} {r['time_over_off']:.2f}" for r in data["rows"])
    return f"run time with `robust` divided by run time without it: {over}"


PARTS = {"stability": stability}
