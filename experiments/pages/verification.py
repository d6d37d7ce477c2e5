"""Problems with known solutions: rows that the tests wrote, and the meshes of `known_answers.py`."""

from experiments.pages.results import load


def tests() -> str:
    """Table with one row for each benchmark of the tests."""
    (found,) = load("verification")
    rows = ["| benchmark | known from | difference | allowed | observed order | test |", "|---" * 6 + "|"]
    for r in found["rows"]:
        order = "" if r["order"] is None else f"{r['order']:.2f}"
        file, name = r["test"].split("::")
        off = f"{r['difference']:.1e}" + (f" (error bar of the mesh {r['bar']:.1e})" if "bar" in r else "")
        cells = (r["benchmark"], r["source"], off, _allowed(r["allowed"]), order)
        rows.append("| " + " | ".join(cells) + f" | `{file.removeprefix('tests/')}` `{name.split('[')[0]}` |")
    return "\n".join(rows)


def meshes() -> str:
    """Table of Cook, Land and the cantilever on each mesh."""
    (known,) = load("known_answers")
    rows = ["| body | tetrahedra | liverjax | known value | difference | run time |", "|---" * 6 + "|"]

    def row(body: str, r: dict, ours: float, known: str, exact: float) -> None:
        off = f"{100 * (ours / exact - 1):+.2g} %"
        rows.append(f"| {body} | {r['tetrahedra']:,} | {ours:.4g} mm | {known} | {off} | {r['run_s']:.2g} s |")

    for r in known["cook"]:
        row("Cook's membrane, rise", r, r["rise_mm"], "14.74 mm, Miehe 1994", 14.74)
    for r in known["land"]:
        row("Land's beam, end", r, r["end_mm"], "4.0-4.2 mm, Land et al. 2015 (difference from 4.1)", 4.1)
    for r in known["cantilever"]:
        if r["mazier_y_m"] is None:
            continue
        theirs = -1e3 * r["mazier_y_m"]
        body = "silicone cantilever" + (", volumes at the nodes" if r["volumetric"] == "nodal" else "")
        row(
            body,
            r,
            -1e3 * r["tip_m"][0],
            f"{theirs:.1f} mm, Mazier et al. 2021 with as many elements; measured 116 mm",
            theirs,
        )
    for r in known.get("cantilever, quadratic", []):
        said = (
            f"{-1e3 * (r['tip_m'][0] + r['change_m']):.4g} mm, the same with the estimated error added; measured 116 mm"
        )
        row(
            "silicone cantilever, quadratic mixed",
            r,
            -1e3 * r["tip_m"][0],
            said,
            -1e3 * (r["tip_m"][0] + r["change_m"]),
        )
    land = known["land"]
    ratio = (land[-1]["cells"] / land[-2]["cells"]) ** 2
    limit = land[-1]["end_mm"] + (land[-1]["end_mm"] - land[-2]["end_mm"]) / (ratio - 1)
    rows += [
        "",
        f"Second-order extrapolation from the two finest meshes gives {limit:.2f} mm for the end of Land's beam.",
    ]
    return "\n".join(rows)


PARTS = {"tests": tests, "meshes": meshes}


def _allowed(tolerance: float) -> str:
    """Return a tolerance with one digit, or with two if one digit would change its value."""
    short = f"{tolerance:.0e}"
    return short if abs(float(short) / tolerance - 1) < 0.01 else f"{tolerance:.1e}"
