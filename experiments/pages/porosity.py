"""The chapter's claim that porosity prevents large deformations: results, and conditions under which it holds."""

from typing import Any

from experiments.pages.results import load

#: Parameters that are varied: name on the page, and unit.
NAMES = {
    "bulk": ("K0 of", " Pa"),
    "limit_bulk": ("K_lim of", " Pa"),
    "permeability": ("a permeability of", " m^4/(N s)"),
    "ramp_s": ("gravity that grows over", " s"),
}


def _shown(name: str, value: float) -> str:
    title, unit = NAMES[name]
    return f"{title} {value:,g}{unit}"


def holding(data: dict[str, Any]) -> dict[str, list[str]]:
    """Return, for each varied parameter, the values between which the claim begins to hold.

    Parameters for which no tested value is enough are listed separately.
    """
    found: dict[str, list[str]] = {"it takes": [], "not enough": []}
    base = {r["varied"]: r for r in data["rows"]}["Table 2"]
    start = data["table_2"] | {"ramp_s": 0.0}
    for name in NAMES:
        mine = [(r["value"], r["ratio"]) for r in data["rows"] if r["varied"] == name]
        mine = sorted([*mine, (start[name], base["ratio"])])
        good = [v for v, ratio in mine if ratio < 1]
        if not good:
            low, high = mine[0][0], mine[-1][0]
            found["not enough"].append(f"{_shown(name, low)} to {high:,g}{NAMES[name][1]}")
        elif good[-1] == mine[-1][0]:
            last_bad = max(v for v, ratio in mine if ratio >= 1)
            found["it takes"].append(f"{_shown(name, good[0])} or more ({last_bad:,g} is too little)")
        else:
            first_bad = min(v for v, ratio in mine if ratio >= 1)
            found["it takes"].append(f"{_shown(name, good[-1])} or less ({first_bad:,g} is too much)")
    kept = {r["varied"]: r for r in data["rows"]}["keep_bulk"]
    found["it takes" if kept["ratio"] < 1 else "not enough"].append("`keep_bulk = true`")
    return found


def porosity() -> str:
    """Table of four models, and of every variation with the same body without porosity."""
    (data,) = load("porosity_claim")
    names = {
        "Table 2, elastic": "Table 2 (porohyperelastic, compared with hyperelastic)",
        "Table 2": "Table 2 (complete, compared with viscous)",
        "keep_bulk": "the law's own bulk modulus acts too (`keep_bulk`)",
        "law's bulk of the rival": "Table 2, compared with a viscous body whose bulk modulus is K0",
    }
    rows = [
        "The table contains the largest displacement of a node of the liver phantom, with and without porosity. "
        "Gravity of 2 m/s2 acts from the beginning, if the row does not say otherwise. The",
        f"runs simulate {data['seconds']:g} s in steps of {data['dt_s']:g} s (Newmark). The parameters are those of "
        "Table 2, except the one that the row names:",
        "",
        "| complete model with | largest displacement | largest displacement without porosity | ratio | smallest J |",
        "|---|---|---|---|---|",
    ]
    for r in data["rows"]:
        name = names.get(r["varied"]) or (
            _shown(r["varied"], r["value"]) if r["varied"] in NAMES else f"{r['value']:,} tetrahedra, first peak"
        )
        state = "" if r["converged"] else " (not all steps converged)"
        cells = (f"{100 * r['largest_m']:.3g} cm", f"{100 * r['without_m']:.3g} cm", f"{r['ratio']:.3f}{state}")
        rows.append(f"| {name} | " + " | ".join([*cells, f"{r['least_J']:.2f}"]) + " |")
    found = holding(data)
    finer = {r["varied"]: r for r in data["rows"]}["tetrahedra"]
    rows += [
        "",
        "The chapter says that porosity prevents unrealistically large deformations. With the chapter's own "
        "parameters, porosity does not prevent them.",
        f"The law's bulk modulus K = {data['law_bulk_Pa']:g} Pa is not used. Instead, the bulk modulus of the porous "
        f"body, K0 = {data['table_2']['bulk']:g} Pa, acts, and the fluid flows out of the compressed parts.",
        f"The claim is true with {', or with '.join(found['it takes'])}.",
        f"It is false for all tested values of the other parameters: {'; '.join(found['not enough'])}. The mesh of "
        "linear",
        f"tetrahedra ({data['tetrahedra']:,} of them) is too stiff in bending. With eight times as many, the first "
        f"peak is {100 * finer['largest_m']:.3g} cm with porosity and",
        f"{100 * finer['without_m']:.3g} cm without it. So compare these displacements with each other, not with a "
        "liver.",
    ]
    return "\n".join(rows)


PARTS = {"porosity": porosity}
