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
        f"The sample is a lion's mane mushroom. The fit uses {used} of 31 measured frequencies; the last one shows an "
        f"effect of the instrument.\nG0 is {kilo:.3g} kPa. Its standard error due to noise is {sd:.2g} kPa. Its total "
        f"error is {whole:.2g} kPa, mostly because of the ends of the band of frequencies.\nThe relaxation times are "
        f"{times} s. The fitted moduli differ from the measured ones by {percent(found['mean_relative_error'])} on "
        f"average. No linear\nmaterial can differ by less than "
        f"{percent(found['details']['consistency']['kramers_kronig_misfit'])} "
        f"(root mean square of |G\\*|). The command takes {found['total_s']:.0f} s on two cores, and "
        f"{found['compile_time_s']:.0f} s of them\nare compilation. A second call takes {found['second_call_s']:.0f} s."
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
        "moduli from the torsion simulation: recursion, time steps per cycle": (
            steps,
            lambda r: f"{r['scheme'].replace('chapter', 'backward_euler')}, {r['steps']}",
        ),
        "moduli from the torsion simulation: mesh, its error divided out or not": (
            meshes,
            lambda r: f"{r['nodes']} nodes, {'divided out' if r['kind'] == 'corrected' else 'not'}",
        ),
        "parameters of a sweep without noise: method of the fit": (ways["exact"], lambda r: r["name"]),
        # The explicit integrator of the comparison is not an option of the program.
        "moving liver phantom, elastic: integrator, time step": (
            [r for r in of_liver("explicit against implicit (hyperelastic)") if not r["name"].startswith("explicit")],
            stepped,
        ),
        "moving liver phantom, viscous: integrator, recursion, time step": (
            of_liver("time step, integrator, recursion (viscous)"),
            stepped,
        ),
        "moving liver phantom, viscous and porous: porous scheme, time step": (
            of_liver("porous scheme (complete)"),
            stepped,
        ),
        "moving liver phantom, viscous, steps of 0.05 s: Newton's tolerance": (
            of_liver("Newton's tolerance (viscous, 0.05 s)"),
            lambda r: f"{r['newton_per_step']:.2g} iterations per step",
        ),
        "static cube stretched by 20 %: precision, tolerance": (
            cube["cube"],
            lambda r: f"{r['precision']}, {r['tolerance']:.0e}",
        ),
        "Cook's membrane, K/mu = 3: elements": (elements.rows_of("Cook's membrane", 3.0), lambda r: r["name"]),
        "Cook's membrane, K/mu = 1e4: elements": (elements.rows_of("Cook's membrane", 1e4), lambda r: r["name"]),
        "beam under a pressure that follows its surface (Land): elements": (
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
        "For the liver phantom, the table gives only the error of the time step or of Newton's tolerance. The error of",
        f"its linear tetrahedra is much larger: in {mesh['ended']} static runs, the displacement differs from that of "
        f"quadratic elements by {percent(mesh['median'])} (median) to {percent(mesh['largest'])}.",
        "",
        f"The assembly of force and stiffness has no options. Its error is {error_text(error)}. For "
        f"{fig4['elements']:,} neo-Hookean tetrahedra it",
        f"takes {1e3 * r['seconds']['contracted']:.2g} ms. The chapter's six stiffness terms take "
        f"{slower['chapter']:.2g} times as long, standard finite elements with",
        f"the same layout of arrays {slower['standard FEM']:.2g} times, and `jax.hessian` with `jax.vmap` "
        f"{slower['vmapped Hessian']:.2g} times.",
    ]
    return "\n".join(rows)


def simulation() -> str:
    """Speed and error of the liver in real time, and of the cube."""
    liver, solve = load("fig6_liver", "solve_benchmark")
    cube = solve["static_cube"]
    rows = {(r["model"], r["dt"], r["newton"]): r for r in liver["rows"]}
    lines = [
        f"The liver phantom has {liver['tetrahedra']:,} tetrahedra. It moves in steps of 0.05 s, and Newton's method "
        "iterates until the residual is below 1e-6:",
        "",
        "| model | steps per second | simulated time divided by run time | error of positions |",
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
            'The last column is the error of implicit Euler, which damps the motion. `integrator = "newmark"` does not '
            f"damp it. A cube of {cube['tetrahedra']:,} tetrahedra",
            f"is stretched by 20 % in one load step. This run takes {cube['seconds']:.2g} s (residual "
            f"{cube['residual']:.0e}).",
        ]
    )


def runs() -> str:
    """One line on the sweeps."""
    bench, lives = load("sweep_benchmark", "sweep_survival")
    kills = lives["kills"]["kills"] + sum(r["killed"] for r in lives["loopback"])
    lost = lives["kills"]["finished_chunks_lost"]
    return (
        f"With a block of 384 tetrahedra, a sweep makes {bench['rows_a_minute']['1']:,.0f} runs per minute on one "
        f"core, and {bench['two_devices_over_one']:.3g} times as many on\ntwo cores. The largest residual is "
        f"{bench['largest_residual']:.0e} of the forces. In a test, processes were killed {kills} times, and {lost} "
        "finished chunks were\nlost."
    )


def gradients() -> str:
    """Cost of a gradient for the liver."""
    (cost,) = load("gradient_cost")
    liver = {(r["model"], r["steps"], r["store"]): r for r in cost["rows"]}
    rows = [
        "| complete liver model, 5,351 tetrahedra | `store` | time of gradient divided by time of run | memory | "
        "predicted |",
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
            "The derivative with respect to mu was checked for the complete model with 162 tetrahedra and up to 100 "
            f"steps. It differs from forward mode by {error_text(forward)},",
            f"and from the best central difference by {error_text(central)} (relative differences).",
        ]
    )


def maps() -> str:
    """Table of the lesion."""
    (found,) = load("lesion")
    rows = [
        "| noise | map: error of the centre | time | sphere: error of the centre | error of the radius | "
        "error of the modulus | the same, corrected | standard error of the modulus | time |",
        "|---" * 9 + "|",
    ]
    for r in found["rows"]:
        if "sphere" in r:
            s = r["sphere"]
            modulus = s["values"]["inclusion"]
            sd = s["standard_errors"]["inclusion"] / modulus
            corrected = (1 - s["mesh_bias"]["inclusion"] / modulus) * (1 + s["modulus_off"]) - 1
            cells = (
                f"{100 * r['noise_of_largest']:g} %",
                f"{r['centre_off_mm']:.2g} mm",
                f"{r['seconds']:.0f} s",
                f"{s['centre_off_mm']:.2g} mm",
                f"{100 * s['radius_off']:+.2g} %",
                f"{100 * s['modulus_off']:+.2g} %",
                f"{100 * corrected:+.2g} %",
                percent(sd),
                f"{s['seconds']:.0f} s",
            )
            rows.append("| " + " | ".join(cells) + " |")
    return "\n".join(rows)


def together() -> str:
    """Table of intervals of the slowest mode, for each combination of tests."""
    (found,) = load("creep_and_sweep")
    rows = [
        "| fitted tests (synthetic, 2 % noise) | G0 | ratio of the slow mode | its relaxation time | "
        "run time with compilation |",
        "|---" * 5 + "|",
    ]
    for r in found["rows"]:
        if r["tests"] == "creep":
            continue

        def interval(name: str, unit: str, r: dict = r) -> str:
            value, sd = r["parameters"][name], r["standard_errors"][name]
            return f"{value:.3g}{unit} ± {sd:.2g}" if sd < abs(value) else "not determined"

        cells = (interval("shear_modulus", " Pa"), interval("ratios[0]", ""), interval("relaxation_times[0]", " s"))
        rows.append(f"| {r['tests']} | " + " | ".join(cells) + f" | {r['seconds']:.0f} s |")
    true = found["true"]
    rows.append(f"| true values | {true[0]:g} Pa | {true[1]:g} | {true[4]:g} s | |")
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
        f"`projected` was tested with {half.laws} laws. For each law and each number of inverted elements, runs began "
        f"at {inverted['seeds']}\nrandom positions. In a time step from these positions, the minimiser finds the right "
        f"equilibrium in {span(mild)} of\nthe runs if up to a fifth of the elements are inverted, and in {span(half)} "
        f"if half of them are inverted. {percent(half.folded)} of the\nother runs end in another equilibrium, in which "
        "the body is folded. In static runs, `projected` begins at the reference\nshape if elements are inverted. "
        f"Then the load can be followed from there, and {part} of the runs find the right\nequilibrium. If `projected` "
        f"is not needed, it makes a run at most {100 * max(over - 1, 0):.0f} % longer, and compilation takes "
        f"{min(compiling):.2g} to {max(compiling):.2g}\ntimes as long."
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
