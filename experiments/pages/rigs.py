"""Tables of the rigs: error against run time of meshes, and the default mesh at every shape and K/mu."""

from experiments.pages.results import RESULTS, load, percent

TESTS = ("tension", "punch", "creep")


def rigs() -> str:
    """Table of meshes at one shape of the sample, then that of the default mesh."""
    if not _ran():
        return "The rigs have not been compared with an independent solver (`python -m experiments stability_rigs`)."
    (data,) = load("stability_rigs")
    rows = [
        "The forces and displacements of the rigs at small strain are compared with an axisymmetric solver that has "
        "no code in common with the project",
        "(`axisymmetric_reference.py`). Each cell contains the error and the run time of a step, for height = radius "
        "and K/mu = 20 or 1e4. A whole",
        "cylinder has cells of one size. A sector has smaller cells at the rims and at the edge of the punch. The "
        "default is in",
        "bold. Times are for one of two cores. The other core was busy:",
        "",
        "| mesh | elements (tension) | " + " | ".join(f"{t}, {k}" for t in TESTS for k in ("20", "1e4")) + " |",
        "|---" * (2 + 2 * len(TESTS)) + "|",
    ]
    kinds = dict.fromkeys((r["mesh"], _text(r["cells"])) for r in data["meshes"])
    for name, cells in kinds:
        mine = [r for r in data["meshes"] if (r["mesh"], _text(r["cells"])) == (name, cells)]
        found = {(r["test"], r["bulk_over_shear"]): r for r in mine}
        label = f"**{name}**" if cells == _text(data["default"][0]["cells"]) else f"{name}{_size(mine[0])}"
        shown = [_cell(found.get((t, k))) for t in TESTS for k in (20.0, 1e4)]
        rows.append(f"| {label} | {mine[0]['elements']:,} | " + " | ".join(shown) + " |")
    aspects = sorted({r["height_over_radius"] for r in data["default"]})
    rows += [
        "",
        "The default mesh for several heights (R is the radius). Each cell contains the error and the largest run "
        "time of a step:",
        "",
        "| test | K/mu | " + " | ".join(f"height {a:g} R" for a in aspects) + " |",
        "|---" * (2 + len(aspects)) + "|",
    ]
    for test in TESTS:
        for ratio in sorted({r["bulk_over_shear"] for r in data["default"]}):
            mine = [r for r in data["default"] if (r["test"], r["bulk_over_shear"]) == (test, ratio)]
            of = {r["height_over_radius"]: r for r in mine}
            rows.append(f"| {test} | {ratio:g} | " + " | ".join(_cell(of.get(a)) for a in aspects) + " |")
    return "\n".join(rows)


def came_out() -> str:
    """Sentence for the overview."""
    if not _ran():
        return "has not run"
    (data,) = load("stability_rigs")
    worst = {t: max(abs(r["error"]) for r in data["default"] if r["test"] == t) for t in TESTS}
    first = [r for r in data["meshes"] if r["mesh"] == "whole, order 1" and r["test"] == "tension"]
    coarse = min((r for r in first if r["bulk_over_shear"] == 20.0), key=lambda r: r["elements"])
    return (
        "largest errors for heights of 0.2 to 5 radii and K/mu of 3 to 1e4: "
        f"{', '.join(f'{t} {percent(w)}' for t, w in worst.items())}; a whole cylinder of {coarse['elements']} linear "
        f"elements has an error of {percent(coarse['error'])} in tension at K/mu = 20"
    )


def _ran() -> bool:
    return (RESULTS / "stability_rigs.json").exists()


def _text(cells: dict) -> str:
    return ", ".join(f"{k} {v}" for k, v in cells.items())


def _size(row: dict) -> str:
    size = row["cells"].get("size")
    return f", cells of R/{0.01 / size:.0f}" if size else f", rim {row['cells']['rim']:g} R"


def _cell(row: dict | None) -> str:
    if row is None:
        return ""
    found = f"{100 * row['error']:+.2g} %, {1e3 * row['run_s']:.2g} ms"
    return found if row["code"] == "converged" else f"{row['code']}: {found}"
