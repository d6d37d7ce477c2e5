"""Numbers for the front page and the two guides: the main task, choices by error, a few results of each part."""

from collections.abc import Callable
from typing import Any

from experiments.pages import accelerator, elements, identification
from experiments.pages.results import error_text, load, percent
from experiments.pages.stability import Returned, returned

TARGETS = (0.1, 0.01, 0.001)


def job() -> str:
    """Results of the main task on measured data."""
    (jobs,) = load("main_job")
    found = jobs["lions_mane"]
    kilo, sd = found["shear_modulus"] / 1e3, found["standard_errors"]["shear_modulus"] / 1e3
    whole, used = found["total_errors"]["shear_modulus"] / 1e3, found["frequencies"]
    times = ", ".join(f"{t:.2g}" for t in found["relaxation_times"])
    return (
        f"Lion's mane mushroom (Hericium erinaceus), {used} of 31 measured frequencies (the last is the instrument's): "
        f"G0 = {kilo:.3g} kPa\nwith an error of {sd:.2g} kPa by noise and of {whole:.2g} kPa in all (the ends of the "
        f"band cause most of it), relaxation times\n{times} s; the fit misses the moduli by "
        f"{percent(found['mean_relative_error'])} on average. No\nlinear material of any spectrum comes closer than "
        f"{percent(found['details']['consistency']['kramers_kronig_misfit'])} (root mean square of |G\\*|): so much is "
        "in the data.\n"
        f"{found['total_s']:.0f} s in all on two cores, {found['compile_time_s']:.0f} s of them compilation; a second "
        f"call takes {found['second_call_s']:.0f} s."
    )


def cheapest(rows: list[dict[str, Any]], target: float) -> dict[str, Any] | None:
    """Return the fastest row within an error, or None."""
    good = [r for r in rows if r["error"] is not None and r["error"] <= target and r.get("converged", True)]
    return min(good, key=lambda r: r["run_s"], default=None)


def questions() -> dict[str, tuple[list[dict], Callable[[dict], str]]]:
    """Return, for each choice, the rows with `error` and `run_s`, and a function for the name of a row."""
    fig5, liver, cube, ways = load("fig5_dma", "liver_choices", "precision", "fit_methods")
    steps = [r | {"error": r["error"]["mean"]} for r in fig5["steps"]]
    meshes = [r | {"error": r[kind]["mean"], "kind": kind} for r in fig5["mesh"] for kind in ("raw", "corrected")]

    def of_liver(title: str) -> list[dict]:
        return [r | {"name": name} for name, rows in liver[title].items() for r in rows]

    def stepped(r: dict) -> str:
        return f"{r['name']}, {r['dt']:.2g} s"

    return {
        "moduli by the torsion simulation: recursion, steps a cycle": (
            steps,
            lambda r: f"{r['scheme'].replace('chapter', 'backward_euler')}, {r['steps']}",
        ),
        "the same: mesh, its linear bias divided out or not": (
            meshes,
            lambda r: f"{r['nodes']} nodes, {'divided out' if r['kind'] == 'corrected' else 'not'}",
        ),
        "parameters of a sweep without noise: method of the fit": (ways["exact"], lambda r: r["name"]),
        # The explicit integrator of the comparison is not an option of the program.
        "liver in motion, elastic: integrator, step": (
            [r for r in of_liver("explicit against implicit (hyperelastic)") if not r["name"].startswith("explicit")],
            stepped,
        ),
        "viscous: integrator, recursion, step": (of_liver("time step, integrator, recursion (viscous)"), stepped),
        "complete: porous scheme, step": (of_liver("porous scheme (complete)"), stepped),
        "viscous, one step size: Newton's tolerance": (
            of_liver("Newton's tolerance (viscous, 0.05 s)"),
            lambda r: f"{r['newton_per_step']:.2g} iterations a step",
        ),
        "static cube pulled by 20 %: precision, tolerance": (
            cube["cube"],
            lambda r: f"{r['precision']}, {r['tolerance']:.0e}",
        ),
        "Cook's membrane, K/mu = 3: elements": (elements.rows_of("Cook's membrane", 3.0), lambda r: r["name"]),
        "the same, K/mu = 1e4": (elements.rows_of("Cook's membrane", 1e4), lambda r: r["name"]),
        "a beam under a following pressure (Land): elements": (
            elements.rows_of("Land's beam", None),
            lambda r: r["name"],
        ),
    }


def choices() -> str:
    """Return the fastest choice for an error of 10, 1 and 0.1 %, with its error and its run time."""
    rows = ["| what | 10 % | 1 % | 0.1 % |", "|---|---|---|---|"]
    for what, (found, name) in questions().items():
        cells = []
        for target in TARGETS:
            r = cheapest(found, target)
            cells.append("none measured" if r is None else f"{name(r)}: {percent(r['error'])}, {r['run_s']:.2g} s")
        rows.append(f"| {what} | " + " | ".join(cells) + " |")
    fig4, table, training = load("fig4_assembly", "laws_table", "training_set")
    mesh, r = training["mesh"], fig4["laws"]["neo_hookean"]
    slower = r["best_rival"]
    error = max(table["laws"]["neo_hookean"][f"{what}_error"] for what in ("stress", "tangent"))
    rows += [
        "",
        "The errors of the liver phantom are those of the time step alone. Its mesh of linear tetrahedra adds far",
        f"more: at rest, in {mesh['ended']} runs of the training set, {percent(mesh['median'])} (median) to "
        f"{percent(mesh['largest'])} of the displacement against quadratic elements.",
        "",
        f"Assembly needs no choice: the terms are exact to {error_text(error)}; for {fig4['elements']:,} neo-Hookean",
        f"tetrahedra the contracted terms take {1e3 * r['seconds']['contracted']:.2g} ms, the chapter's six "
        f"{slower['chapter']:.2g} times as long, standard",
        f"finite elements in the same layout {slower['standard FEM']:.2g} times, a vmapped `jax.hessian` "
        f"{slower['vmapped Hessian']:.2g} times.",
    ]
    return "\n".join(rows)


def simulation() -> str:
    """Speed and error of the liver in real time, and of the cube."""
    liver, solve = load("fig6_liver", "solve_benchmark")
    cube = solve["static_cube"]
    rows = {(r["model"], r["dt"], r["newton"]): r for r in liver["rows"]}
    lines = [
        f"The liver phantom, {liver['tetrahedra']:,} tetrahedra, in steps of 0.05 s with Newton to 1e-6:",
        "",
        "| model | steps a second | simulated over run time | error of positions |",
        "|---|---|---|---|",
    ]
    for model in ("hyperelastic", "viscous", "complete"):
        r = next(v for (m, dt, newton), v in rows.items() if m == model and dt == 0.05 and newton != 1)
        speed = r["steps_per_s"]
        lines.append(f"| {model} | {speed:.3g} | {speed * r['dt']:.2g} | {percent(r['error'])} |")
    return "\n".join(
        [
            *lines,
            "",
            'The error is that of implicit Euler, which damps; `integrator = "newmark"` does not. A cube of '
            f"{cube['tetrahedra']:,} tetrahedra",
            f"that is pulled by 20 % in one load step takes {cube['seconds']:.2g} s (residual {cube['residual']:.0e}).",
        ]
    )


def runs() -> str:
    """One line on the sweeps."""
    bench, lives = load("sweep_benchmark", "sweep_survival")
    kills = lives["kills"]["kills"] + sum(r["killed"] for r in lives["loopback"])
    lost = lives["kills"]["finished_chunks_lost"]
    return (
        f"A block of 384 tetrahedra: {bench['rows_a_minute']['1']:,.0f} rows a minute on one core, "
        f"{bench['two_devices_over_one']:.3g} times that on two, residuals\n"
        f"to {bench['largest_residual']:.0e}; after {kills} kills {lost} finished chunks were lost."
    )


def gradients() -> str:
    """Cost of a gradient for the liver."""
    (cost,) = load("gradient_cost")
    liver = {(r["model"], r["steps"], r["store"]): r for r in cost["rows"]}
    rows = [
        "| the complete liver, 5,351 tetrahedra | store | gradient over run | memory | predicted |",
        "|---|---|---|---|---|",
    ]
    for (model, steps, store), r in liver.items():
        if model == "complete":
            memory = f"{r['planned_bytes'] / 1e6:,.0f} MB | {r['predicted_bytes'] / 1e6:,.0f} MB"
            rows.append(f"| {steps:,} steps | `{store}` | {r['ratio']:.3g} | {memory} |")
    small = [r for r in cost["rows"] if "differences" in r]
    forward = max(r["against_forward_mode"] for r in small)
    central = max(min(r["differences"].values()) for r in small)
    return "\n".join(
        [
            *rows,
            "",
            f"Error of the derivative by mu (complete model, 162 tetrahedra, up to 100 steps): {error_text(forward)} "
            "against forward mode,",
            f"{error_text(central)} against the best central difference.",
        ]
    )


def maps() -> str:
    """Table of the lesion."""
    (found,) = load("lesion")
    rows = [
        "| noise | map: centre off | time | sphere: centre off | radius off | modulus off | standard error | time |",
        "|---" * 8 + "|",
    ]
    for r in found["rows"]:
        if "sphere" in r:
            s = r["sphere"]
            sd = s["standard_errors"]["inclusion"] / s["values"]["inclusion"]
            cells = (
                f"{100 * r['noise_of_largest']:g} %",
                f"{r['centre_off_mm']:.2g} mm",
                f"{r['seconds']:.0f} s",
                f"{s['centre_off_mm']:.2g} mm",
                f"{100 * s['radius_off']:+.2g} %",
                f"{100 * s['modulus_off']:+.2g} %",
                percent(sd),
                f"{s['seconds']:.0f} s",
            )
            rows.append("| " + " | ".join(cells) + " |")
    return "\n".join(rows)


def together() -> str:
    """Table of intervals of the slowest mode, for each combination of tests."""
    (found,) = load("creep_and_sweep")
    rows = ["| fitted (synthetic, 2 % noise) | G0 | slow ratio | slow time | run, compile included |", "|---" * 5 + "|"]
    for r in found["rows"]:
        if r["tests"] == "creep":
            continue

        def interval(name: str, unit: str, r: dict = r) -> str:
            value, sd = r["parameters"][name], r["standard_errors"][name]
            return f"{value:.3g}{unit} ± {sd:.2g}" if sd < abs(value) else "not determined"

        cells = (interval("shear_modulus", " Pa"), interval("ratios[0]", ""), interval("relaxation_times[0]", " s"))
        rows.append(f"| {r['tests']} | " + " | ".join(cells) + f" | {r['seconds']:.0f} s |")
    true = found["true"]
    rows.append(f"| truth | {true[0]:g} Pa | {true[1]:g} | {true[4]:g} s | |")
    return "\n".join(rows)


def span(found: Returned) -> str:
    """Return the smallest and the largest fraction, in per cent."""
    return " to ".join(percent(part) for part in dict.fromkeys((found.least, found.most)))


def extremes() -> str:
    """Two lines on the robust solver."""
    inverted, cost = load("stability_inverted", "stability_cost")
    solver = "projected, from the start itself"
    mild = returned(solver, ("0 % inverted", "5 % inverted", "20 % inverted"))
    half, left = returned(solver, ("50 % inverted",)), returned("projected, guess left")
    over = max(r["time_over_off"] for r in cost["rows"])
    compiling = [r["compile_s"]["projected"] / r["compile_s"]["off"] for r in cost["rows"]]
    part = "all" if left.least == 1 else f"at least {percent(left.least)}"
    return (
        f"From the start itself the minimiser brings back {span(mild)} of {inverted['seeds']} scrambled starts for "
        f"each law ({half.laws} laws) if up to\na fifth of the elements are inverted, "
        f"and {span(half)} if half of them are; "
        f"{percent(half.folded)} of the others end folded, in\nanother equilibrium. At rest a start is only a guess. "
        f"`projected` leaves an inverted one for the reference shape, and\n{part} come back, because the load can be "
        "followed from there. Where robustness is not needed, it costs\n"
        f"{100 * max(over - 1, 0):.0f} % of run time at most, and compiling takes "
        f"{min(compiling):.2g} to {max(compiling):.2g} times as long."
    )


PARTS = {"job": job, "choices": choices}
SIMULATOR = {
    "simulation": simulation,
    "gradients": gradients,
    "runs": runs,
    "extremes": extremes,
    "elements": elements.sentences,
    "accelerator": accelerator.sentences,
}
FITS = {"maps": maps, "together": together, "elastography": identification.plate}
