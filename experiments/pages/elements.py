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
        parts.append(f"{name}: 1 % by {ways[0]}, corrected by {ways[1]}")
    return "; ".join(parts) + f"; the estimate is {min(good):.2g} to {max(good):.2g} of errors above 0.5 %"


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
        f"{r['largest_mm']:.1f} mm by {r['elements']:,} {'linear' if r['order'] == 1 else 'quadratic'} elements"
        for r in data["rows"]
        if r["steps"] > 1 and r["code"] == "converged"
    ]
    return "largest displacement, the load followed: " + ", ".join(said)


def table() -> str:
    """Table of all rows."""
    (data,) = load("elements")
    beam = 1e3 * next(r["truth"] for r in data["rows"] if r["body"] == "Land's beam")
    rows = [
        "Static answers, two load steps (the liver: one, the column: five). The estimate is one linearised solve a",
        "step in the next richer elements. Effectivity: what it adds, over what is missing. Corrected: the error with",
        "it added. The truth of Cook's membrane is another program's (scikit-fem, quadratic triangles with pressures,",
        f"graded, whose two finest grids differ by {percent(_last_step())} at most); graded rows have small cells near",
        "the upper corner of the clamp, where the stress has no bound. The truth of the twisted column is that of",
        "mixed elements on 5 x 5 x 15 cells with their own estimate added: mixed rows are judged by their own kind.",
        f"That of Land's beam is 12,960 quadratic elements with theirs, {beam:.3f} mm. Run: on one free core, without",
        "and with the estimate; where the latter is empty it was not timed.",
        "",
        "| body, K/mu | elements | number | error | effectivity | corrected | iterations | run | corrected run |",
        "|---" * 9 + "|",
    ]
    for r in data["rows"]:
        if "error" in r:
            name = r["body"] + (f", {r['ratio']:g}" if r["ratio"] else "")
            judged = f"{100 * r['error']:+.2g} % | {r['effectivity']:.2f} | {100 * r['corrected']:+.2g} %"
            judged = judged if r["found"] else f"{100 * r['error']:+.2g} % | leads to no state | |"
            times = f"{r['run_s']:.2g} s | " + (f"{r['corrected_s']:.2g} s" if "corrected_s" in r else "")
            rows.append(f"| {name} | {r['form']} | {r['elements']:,} | {judged} | {r['linear']} | {times} |")
    livers = [r for r in data["rows"] if "error" not in r]
    rows += ["", "The liver phantom at rest under 2 m/s2, largest displacement; its converged value is not known:", ""]
    rows += ["| elements | number | value | the estimate adds | run |", "|---|---|---|---|---|"]
    for r in livers:
        adds = f"{1e3 * r['change']:+.2g} mm" + ("" if r["found"] else ", with corners inside out")
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
    rows = ["", "The phantom with its tetrahedra as they are and cut into eight, the load in one step or in eight:", ""]
    rows += [
        "| elements | number | load steps | largest | mean of 1,369 nodes | smallest J | ended |",
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
        "Under a quarter of that load, 0.5 m/s2, quadratic elements, refined at the edges of the clamps alone:",
        "",
    ]
    rows += [
        "| refined | number | largest | mean of 1,369 nodes | off the limit | smallest J | run (CPU) |",
        "|---" * 7 + "|",
    ]
    limit = _limit([r["largest_mm"] for r in data["clamps"]])
    for r in data["clamps"]:
        off = f"{100 * (r['largest_mm'] / limit - 1):+.2g} %"
        rows.append(
            f"| {r['rims']} times | {r['elements']:,} | {r['largest_mm']:.3f} mm | {r['mean_mm']:.3f} mm | {off} "
            f"| {r['smallest_J']:.2g} | {r['cpu_s']:.2g} s |"
        )
    rows += ["", f"Their limit, by what the last two refinements added, is {limit:.2f} mm."]
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
        "Quickest run within an error, by form (corrected: with the estimate added, and its time):",
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
    rows = ["", "A cube whose top moves aside by a hundredth, one step to 1e-8: linear iterations of all Newton's:", ""]
    rows += ["| elements | K/mu | number | unknowns of positions | Newton | linear | run |", "|---" * 7 + "|"]
    for r in data["iterations"]:
        rows.append(
            f"| {r['form']} | {r['ratio']:g} | {r['elements']:,} | {r['unknowns']:,} | {r['newton']} | {r['linear']} "
            f"| {r['run_s']:.2g} s |"
        )
    return rows


def _sponge(data: dict) -> list[str]:
    """Table of linear iterations for a saturated porous body, from no flow to fast flow."""
    rows = ["", "The same cube as a wet sponge, drained on top, two steps of 0.05 s, by permeability:", ""]
    rows += ["| elements | number | m^4/(N s) | Newton | linear | run |", "|---" * 6 + "|"]
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
        "Mixed elements in plates of 6 x 6 x 6 flat cells, glued below, the top moved aside and down, one step:",
        "",
    ]
    rows += ["| elements | K/mu | cells as wide as thick, times | Newton | linear | run |", "|---" * 6 + "|"]
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
            f"Land's beam: {quadratic['elements']:,} quadratic elements are {percent(abs(quadratic['error']))} off, "
            f"{linear['elements']:,} linear ones {percent(abs(linear['error']))}."
        )
    if liver:
        a, b = liver["linear"], liver["quadratic"]
        said.append(
            f"The liver phantom under 2 m/s2 sinks {1e3 * a['value']:.1f} mm with linear elements and "
            f"{1e3 * b['value']:.1f} mm with quadratic ones on the same mesh; the estimates add "
            f"{1e3 * a['change']:.2g} and {1e3 * b['change']:.2g} mm."
        )
    even, graded = (next(r for r in data["rows"] if _is_cook(r, form)) for form in (MIXED, f"{MIXED}, graded"))
    said.append(
        f"Cook's membrane at K/mu = 1e4, {even['elements']:,} quadratic mixed elements: equal cells are "
        f"{percent(abs(even['error']))} off in {short(even['run_s'])} s, as many cells that are small near the clamped "
        f"corner {percent(abs(graded['error']))} in {short(graded['run_s'])} s; with the estimate added "
        f"{percent(abs(even['corrected']))} in {short(even['corrected_s'])} s and "
        f"{percent(abs(graded['corrected']))} in {short(graded['corrected_s'])} s. So take the corrected number, and "
        f"small cells where a clamp ends."
    )
    known = [r for r in data["rows"] if "error" in r and r["found"] and abs(r["error"]) > 0.005]
    low, high = (f(r["effectivity"] for r in known) for f in (min, max))
    said.append(f"Where errors are above 0.5 %, the estimate is {low:.2g} to {high:.2g} of them.")
    return " ".join(said)


PARTS = {"elements": table}
