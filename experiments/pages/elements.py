"""Table of linear, quadratic and mixed elements: error, estimated error, run time."""

from experiments.pages.results import load, percent, short

MIXED = "quadratic, mixed"


def came_out() -> str:
    """One line on the fastest runs within 1 %, and on the quality of the estimates."""
    (data,) = load("elements")
    known = [r for r in data["rows"] if "error" in r]
    good = [r["effectivity"] for r in known if r["found"] and abs(r["error"]) > 0.005]
    parts = []
    for body, ratio in dict.fromkeys((r["body"], r["ratio"]) for r in known):
        own = [r for r in known if (r["body"], r["ratio"]) == (body, ratio)]
        ways = [_quickest(own, what, time, 0.01) for what, time in (("error", "run_s"), ("corrected", "corrected_s"))]
        name = body + (f" at K/mu = {ratio:g}" if ratio else "")
        parts.append(f"{name}: error below 1 % with {ways[0]}, or with {ways[1]} and correction")
    return "; ".join(parts) + (
        f"; where the true error is above 0.5 %, the estimated error is {min(good):.2g} to {max(good):.2g} times as "
        "large"
    )


def _quickest(rows: list[dict], what: str, time: str, limit: float) -> str:
    """Return elements and seconds of the fastest row within an error, or that there is none."""
    good = [r for r in rows if abs(r[what]) <= limit and (what == "error" or r["found"])]
    if not good:
        return "none here"
    best = min(good, key=lambda r: r.get(time, r["elements"]))
    return f"{best['elements']:,} {best['form']} elements" + (f" in {short(best[time])} s" if time in best else "")


def phantom() -> str:
    """One line with the results of the phantom's meshes."""
    (data,) = load("liver_mesh")
    said = [
        f"{r['largest_mm']:.1f} mm with {r['elements']:,} {'linear' if r['order'] == 1 else 'quadratic'} elements"
        for r in data["rows"]
        if r["steps"] > 1 and r["code"] == "converged"
    ]
    return "largest displacement, with the load in several steps: " + ", ".join(said)


def table() -> str:
    """Table of all rows."""
    (data,) = load("elements")
    beam = 1e3 * next(r["truth"] for r in data["rows"] if r["body"] == "Land's beam")
    rows = [
        "Static solutions in two load steps (the liver: one, the column: five). The estimate needs one linearised "
        "solve",
        "per step, in elements of the next higher order. Effectivity is the estimated error divided by the true error.",
        "Corrected is the error that remains with the estimate added. The reference solution for Cook's membrane comes",
        "from another program (scikit-fem, quadratic triangles with pressures, small cells near the corner of the "
        f"clamp). Its two finest grids differ by {percent(_last_step())} at most. Graded meshes have small cells near",
        "the upper corner of the clamp, where the stress is unbounded. For the twisted column, the reference solution "
        "is",
        "that of mixed elements on 5 x 5 x 15 cells with their estimate added. So mixed elements are compared with "
        "elements of the same kind.",
        f"For Land's beam it is that of 12,960 quadratic elements with their estimate added, {beam:.3f} mm. Run times "
        "are",
        "for one free core, without and with the estimate. Runs with an empty cell were not timed.",
        "",
        "| body, K/mu | elements | number of elements | error | effectivity | corrected | linear iterations | run | "
        "run with estimate |",
        "|---" * 9 + "|",
    ]
    for r in data["rows"]:
        if "error" in r:
            name = r["body"] + (f", {r['ratio']:g}" if r["ratio"] else "")
            judged = f"{100 * r['error']:+.2g} % | {r['effectivity']:.2f} | {100 * r['corrected']:+.2g} %"
            judged = judged if r["found"] else f"{100 * r['error']:+.2g} % | gives no valid state | |"
            times = f"{r['run_s']:.2g} s | " + (f"{r['corrected_s']:.2g} s" if "corrected_s" in r else "")
            rows.append(f"| {name} | {r['form']} | {r['elements']:,} | {judged} | {r['linear']} | {times} |")
    livers = [r for r in data["rows"] if "error" not in r]
    rows += [
        "",
        "Largest displacement of the liver phantom at rest under 2 m/s2 (the converged value is not known):",
        "",
    ]
    rows += ["| elements | number of elements | value | the estimate adds | run |", "|---|---|---|---|---|"]
    for r in livers:
        adds = f"{1e3 * r['change']:+.2g} mm" + ("" if r["found"] else ", with inverted corners of elements")
        rows.append(f"| {r['form']} | {r['elements']:,} | {1e3 * r['value']:.2f} mm | {adds} | {r['run_s']:.2g} s |")
    return "\n".join(
        [*rows, *_phantom(), *_cheapest(data["rows"]), *_iterations(data), *_sponge(data), *_thin_cells(data)]
    )


def _last_step() -> float:
    """Return the largest relative difference between the other program's two finest grids, for Cook's membrane."""
    (grids,) = load("cooks_membrane")
    return max(abs(by["32"] / by["64"] - 1) for by in grids.values())


def _phantom() -> list[str]:
    """Table of the phantom on two meshes, with the load in one or more steps."""
    (data,) = load("liver_mesh")
    rows = [
        "",
        "The phantom with its original mesh, and with every tetrahedron cut into eight. The load is applied in one "
        "step or in eight steps:",
        "",
    ]
    rows += [
        "| elements | number of elements | load steps | largest displacement | mean of 1,369 nodes | smallest J | "
        "status |",
        "|---" * 7 + "|",
    ]
    for r in data["rows"]:
        form = "linear" if r["order"] == 1 else "quadratic"
        values = f"{r['largest_mm']:.2f} mm | {r['mean_mm']:.2f} mm" if r["code"] == "converged" else "|"
        rows.append(f"| {form} | {r['elements']:,} | {r['steps']} | {values} | {r['smallest_J']:.2g} | {r['code']} |")
    if len(data.get("clamps", [])) < 3:
        return rows
    rows += [
        "",
        "Quadratic elements under a quarter of this load (0.5 m/s2). The mesh is refined only at the edges of the "
        "clamps:",
        "",
    ]
    rows += [
        "| refined | number of elements | largest displacement | mean of 1,369 nodes | difference from the limit | "
        "smallest J | CPU time |",
        "|---" * 7 + "|",
    ]
    limit = _limit([r["largest_mm"] for r in data["clamps"]])
    for r in data["clamps"]:
        off = f"{100 * (r['largest_mm'] / limit - 1):+.2g} %"
        rows.append(
            f"| {r['rims']} times | {r['elements']:,} | {r['largest_mm']:.3f} mm | {r['mean_mm']:.3f} mm | {off} "
            f"| {r['smallest_J']:.2g} | {r['cpu_s']:.2g} s |"
        )
    rows += ["", f"The limit of these displacements, extrapolated from the last two refinements, is {limit:.2f} mm."]
    return rows


def _limit(values: list[float]) -> float:
    """Return the limit of values whose differences fall by a constant factor, from the last two differences."""
    a, b = values[-2] - values[-3], values[-1] - values[-2]
    return values[-1] + b * (b / a) / (1 - b / a)


def _cheapest(rows: list[dict]) -> list[str]:
    """Return the fastest run of each form within 1 % and 0.1 %, without and with correction, where the solution is
    known.
    """
    found = [
        "",
        "Run time of the fastest run with an error below 1 % or 0.1 %, for each kind of elements. Corrected runs have "
        "the estimate added, and their time includes the estimate:",
        "",
    ]
    found += ["| body, K/mu | elements | 1 % | 0.1 % | 1 %, corrected | 0.1 %, corrected |", "|---" * 6 + "|"]
    judged = [r for r in rows if "error" in r]
    for body, ratio, form in dict.fromkeys((r["body"], r["ratio"], r["form"]) for r in judged):
        own = [r for r in judged if (r["body"], r["ratio"], r["form"]) == (body, ratio, form)]
        cells = []
        for what in ("error", "corrected"):
            for limit in (0.01, 0.001):
                time = "run_s" if what == "error" else "corrected_s"
                good = [r[time] for r in own if abs(r[what]) <= limit and (what == "error" or r["found"]) and time in r]
                cells.append(f"{min(good):.2g} s" if good else "none")
        found.append(f"| {body}{f', {ratio:g}' if ratio else ''} | {form} | " + " | ".join(cells) + " |")
    return found


def _iterations(data: dict) -> list[str]:
    """Table of linear iterations for a sheared cube on each mesh."""
    rows = [
        "",
        "A cube whose top is displaced sideways by a hundredth of its size, in one step, to a residual of 1e-8. Linear "
        "iterations are those of all Newton iterations together:",
        "",
    ]
    rows += [
        "| elements | K/mu | number of elements | unknown positions | Newton iterations | linear iterations | run |",
        "|---" * 7 + "|",
    ]
    for r in data["iterations"]:
        rows.append(
            f"| {r['form']} | {r['ratio']:g} | {r['elements']:,} | {r['unknowns']:,} | {r['newton']} | {r['linear']} "
            f"| {r['run_s']:.2g} s |"
        )
    return rows


def _sponge(data: dict) -> list[str]:
    """Table of linear iterations for a saturated porous body, from no flow to fast flow."""
    rows = [
        "",
        "The same cube as a porous body filled with fluid, drained at its top, in two steps of 0.05 s, for several "
        "permeabilities:",
        "",
    ]
    rows += [
        "| elements | number of elements | permeability [m^4/(N s)] | Newton iterations | linear iterations | run |",
        "|---" * 6 + "|",
    ]
    for r in data["sponge"]:
        rows.append(
            f"| {r['form']} | {r['elements']:,} | {r['permeability']:g} | {r['newton']} | {r['linear']} "
            f"| {r['run_s']:.2g} s |"
        )
    return rows


def _thin_cells(data: dict) -> list[str]:
    """Table of linear iterations for plates of flat cells."""
    if "flat cells" not in data:
        return []
    rows = [
        "",
        "Mixed elements in plates of 6 x 6 x 6 flat cells. The bottom is fixed. The top is displaced sideways and "
        "down in one step:",
        "",
    ]
    rows += [
        "| elements | K/mu | width of the cells divided by thickness | Newton iterations | linear iterations | run |",
        "|---" * 6 + "|",
    ]
    for r in data["flat cells"]:
        rows.append(
            f"| {r['form']} | {r['ratio']:g} | {r['aspect']:g} | {r['newton']} | {r['linear']} | {r['run_s']:.2g} s |"
        )
    return rows


def rows_of(body: str, ratio: float | None) -> list[dict]:
    """Return every mesh of a body at a K/mu, without and with correction: size of the error, run time and name."""
    (data,) = load("elements")
    found = []
    for r in data["rows"]:
        if (r["body"], r["ratio"]) == (body, ratio):
            name = f"{r['elements']:,} {r['form']} tetrahedra"
            found.append({"error": abs(r["error"]), "run_s": r["run_s"], "name": name})
            if r["found"] and "corrected_s" in r:
                found.append({"error": abs(r["corrected"]), "run_s": r["corrected_s"], "name": f"{name}, corrected"})
    return found


def _is_cook(row: dict, form: str) -> bool:
    """Return whether a row is Cook's membrane of 16 cells at K/mu = 1e4."""
    return (row["body"], row["ratio"], row["form"], row["cells"]) == ("Cook's membrane", 1e4, form, 16)


def sentences() -> str:
    """Sentences for the guide that compare linear with quadratic elements."""
    (data,) = load("elements")
    rows = {(r["body"], r["ratio"], r["form"], r["elements"]): r for r in data["rows"]}
    liver = {r["form"]: r for r in data["rows"] if r["body"] == "liver phantom"}
    beams = [r for (body, *_), r in rows.items() if body == "Land's beam"]
    said = []
    if beams:
        linear = max((r for r in beams if r["form"] == "linear"), key=lambda r: r["elements"])
        quadratic = min((r for r in beams if r["form"] == "quadratic"), key=lambda r: r["elements"])
        said.append(
            f"For Land's beam, the error is {percent(abs(quadratic['error']))} with {quadratic['elements']:,} "
            f"quadratic elements, and {percent(abs(linear['error']))} with {linear['elements']:,} linear elements."
        )
    if liver:
        a, b = liver["linear"], liver["quadratic"]
        said.append(
            f"Under gravity of 2 m/s2 the liver phantom sinks by {1e3 * a['value']:.1f} mm with linear elements, and "
            f"by {1e3 * b['value']:.1f} mm with quadratic elements on the same mesh. The estimates add "
            f"{1e3 * a['change']:.2g} mm and {1e3 * b['change']:.2g} mm."
        )
    even, graded = (next(r for r in data["rows"] if _is_cook(r, form)) for form in (MIXED, f"{MIXED}, graded"))
    said.append(
        f"Cook's membrane was computed at K/mu = 1e4 with {even['elements']:,} quadratic mixed elements. With equal "
        f"cells the error is {percent(abs(even['error']))} (run time {short(even['run_s'])} s). With the same "
        f"number of cells, but smaller ones near the corner of the clamp, the error is {percent(abs(graded['error']))} "
        f"({short(graded['run_s'])} s). With the estimate added, the errors are {percent(abs(even['corrected']))} "
        f"({short(even['corrected_s'])} s) and {percent(abs(graded['corrected']))} ({short(graded['corrected_s'])} s). "
        "So use the corrected result, and small cells at the edge of a clamp."
    )
    known = [r for r in data["rows"] if "error" in r and r["found"] and abs(r["error"]) > 0.005]
    low, high = (f(r["effectivity"] for r in known) for f in (min, max))
    said.append(
        f"Where the true error is above 0.5 %, the estimated error is {low:.2g} to {high:.2g} times the true error."
    )
    return " ".join(said)


PARTS = {"elements": table}
