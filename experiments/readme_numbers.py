"""The numbers that README.md quotes, from the JSON of other experiments.

``python experiments/readme_numbers.py`` rewrites the part of README.md between its two markers; a test compares them.
"""

import json
from pathlib import Path

HERE = Path(__file__).parent
README = HERE.parent / "README.md"
BEGIN, END = "<!-- numbers: experiments/readme_numbers.py -->", "<!-- end of numbers -->"


def text() -> str:
    """The table of error against run time and the paragraph on the chapter's 5 %."""
    fig5, job = (json.loads((HERE / "results" / f"{n}.json").read_text()) for n in ("fig5_dma", "main_job"))
    steps = {(r["scheme"], r["steps"]): r for r in fig5["steps"]}

    def percent(x: float) -> str:
        return f"{100 * x:.2g} %"

    def row(what: str, error: str, run: float, compiling: float) -> str:
        return f"| {what} | {error} | {run:.2g} s | {compiling:.2g} s |"

    rows = ["| what | error | run | compile |", "|---|---|---|---|"]
    for (scheme, n), r in sorted(steps.items()):
        what = f"simulated moduli at 16 frequencies, {scheme} recursion, {n} steps a cycle"
        error = f"{percent(r['error']['mean'])} of G', G''"
        rows.append(row(what, error, r["run_s"], r["compile_s"]))
    names = {
        "lions_mane": "lion's mane (31 frequencies, measured)",
        "porcine_liver": "porcine liver (16, model-implied)",
    }
    for name, label in names.items():
        for method, c in (("closed form", job[name]["closed_form"]), ("torsion simulation", job[name])):
            what = f"fit of {label}, {c['modes']} modes, {method}"
            error = f"{percent(c['mean_relative_error'])} of the data"
            rows.append(row(what, error, c["run_time_s"], c["compile_time_s"]))
    mesh = min(fig5["mesh"], key=lambda r: abs(r["nodes"] - 508))
    modes = {r["modes"]: r for r in fig5["modes"]}
    mean = {k: percent(r["error"]["mean"]) for k, r in steps.items()}
    rows += [
        "",
        "The chapter reports a mean error of 5 % between simulated and measured moduli. Its recursion, backward Euler,",
        f"alone costs {mean['chapter', 20]} at 20 steps a cycle and {mean['chapter', 50]} at 50 (the default here",
        f"{mean['exponential', 50]}); a mesh of {mesh['nodes']} nodes whose bias is not divided out",
        f"{percent(mesh['raw']['mean'])}, divided out {percent(mesh['corrected']['mean'])}; two modes on a",
        f"real tissue, the lion's mane with its wider band, {percent(modes[2]['mean'])},",
        f"four {percent(modes[4]['mean'])}.",
    ]
    return "\n".join(rows)


def main() -> None:
    """Rewrite README.md."""
    page = README.read_text()
    head, rest = page.split(BEGIN)
    README.write_text(head + BEGIN + "\n" + text() + "\n" + END + rest.split(END)[1])


if __name__ == "__main__":
    main()
