"""Tables of laws, simulations, speed, many runs and fits."""

from experiments.pages.results import error_text, load, percent


def laws() -> str:
    """Table of laws: error and time of the hand-derived terms, and misfit for brain and rubber."""
    table, brain, rubber = load("laws_table", "curves_brain", "curves_rubber")
    fits = [{f["law"]: f for f in data["laws"]} for data in (brain, rubber)]

    def followed(found: dict, name: str) -> str:
        f = found.get({"ogden": "ogden, 3 terms"}.get(name, name))
        return "" if f is None else f"{100 * f['mean_relative_error']:.2g} %, {1000 * f['run_time_s']:.0f} ms"

    rows = [
        "| law | difference from automatic differentiation | time of the force | time of force and stiffness | "
        "compilation | brain | rubber |",
        "|---" * 7 + "|",
    ]
    for name, r in table["laws"].items():
        error = max(r["stress_error"], r["tangent_error"])
        times = (f"{1000 * r[key]:.2g} ms" for key in ("force_s", "force and stiffness_s"))
        cells = (error_text(error), *times, f"{r['force and stiffness_compile_s']:.2g} s")
        rows.append(" | ".join([f"| `{name}`", *cells, *(followed(f, name) for f in fits)]) + " |")
    return "\n".join(rows)


def numbers() -> str:
    """Table of error against run time, and the paragraph on the chapter's 5 %."""
    fig5, job = load("fig5_dma", "main_job")
    steps = {(r["scheme"], r["steps"]): r for r in fig5["steps"]}

    def row(what: str, error: str, run: float, compiling: float) -> str:
        return f"| {what} | {error} | {run:.2g} s | {compiling:.2g} s |"

    rows = ["| what | error | run | compilation |", "|---|---|---|---|"]
    for (scheme, n), r in sorted(steps.items()):
        recursion = scheme.replace("chapter", "backward_euler")
        what = f"simulated moduli at 16 frequencies, {recursion} recursion, {n} steps per cycle"
        error = f"{percent(r['error']['mean'])} of G', G''"
        rows.append(row(what, error, r["run_s"], r["compile_s"]))
    names = {
        "lions_mane": "lion's mane (30 of 31 frequencies, measured)",
        "porcine_liver": "porcine liver (16 frequencies, computed from a model)",
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
        f"alone causes an error of {mean['chapter', 20]} with 20 steps per cycle and of {mean['chapter', 50]} with 50 "
        "(the default recursion of liverjax:",
        f"{mean['exponential', 50]}). With a mesh of {mesh['nodes']} nodes the error is",
        f"{percent(mesh['raw']['mean'])}, and {percent(mesh['corrected']['mean'])} if the error of the mesh is divided "
        "out. For a",
        f"real tissue (the lion's mane mushroom), a fit of two modes has a misfit of {percent(modes[2]['mean'])},",
        f"and a fit of four modes has a misfit of {percent(modes[4]['mean'])}.",
    ]
    return "\n".join(rows)


def simulations() -> str:
    """Table of problems with known solutions on their finest meshes, and of the liver's three models."""
    known, liver = load("known_answers", "fig6_liver")
    rods = [r for r in known["cantilever"] if r["volumetric"] == "element"]
    cook, land, rod = known["cook"][-1], known["land"][-1], rods[-1]
    rows = ["| what | result | error | run | compilation |", "|---|---|---|---|---|"]

    def row(what: str, result: str, error: str, r: dict) -> None:
        rows.append(f"| {what} | {result} | {error} | {r['run_s']:.2g} s | {r['compile_s']:.2g} s |")

    off = abs(cook["rise_mm"] / 14.74 - 1)
    row(f"Cook's membrane, {cook['tetrahedra']:,} tetrahedra", f"{cook['rise_mm']:.2f} mm", f"{100 * off:.2g} %", cook)
    off = (4.0 - land["end_mm"]) / 4.0
    what = f"Land's beam, pressure that follows the surface, {land['tetrahedra']:,} tetrahedra"
    row(what, f"{land['end_mm']:.2f} mm", f"{100 * off:.2g} % below other programs (4.0-4.2 mm)", land)
    y = rod["tip_m"][0]
    what = f"silicone cantilever, {rod['tetrahedra']:,} tetrahedra"
    off = abs(y / rod["mazier_y_m"] - 1)
    row(what, f"{-1000 * y:.1f} mm", f"{100 * off:.2g} % from Mazier et al. with as many elements", rod)
    before = known["land"][-2]
    ratio = (land["cells"] / before["cells"]) ** 2
    limit = land["end_mm"] + (land["end_mm"] - before["end_mm"]) / (ratio - 1)
    short = [100 * (1 - r["tip_m"][0] / r["mazier_y_m"]) for r in rods if r["mazier_y_m"] is not None]
    rows += [
        "",
        f"Linear tetrahedra are too stiff in bending. Second-order extrapolation gives {limit:.2f} mm for Land's beam. "
        "The",
        f"cantilever sinks {min(short):.0f} to {max(short):.0f} % less than in another program with the chapter's "
        "method (MJED) and as many elements.",
    ]
    rows += ["", f"The liver phantom with {liver['tetrahedra']:,} tetrahedra moves for 2.4 s (implicit Euler):", ""]
    rows += [
        "| model | step | Newton | error of positions | steps per second | simulated time divided by run time |",
        "|---|---|---|---|---|---|",
    ]
    for r in liver["rows"]:
        newton = "one iteration" if r["newton"] == 1 else "to 1e-6"
        speed = f"{r['steps_per_s']:.3g} | {r['steps_per_s'] * r['dt']:.2g}"
        off = f"{100 * r['error']:.2g} % | {speed}" if r["converged"] else "stopped: no solution | |"
        rows.append(f"| {r['model']} | {r['dt']:g} s | {newton} | {off} |")
    return "\n".join(rows)


def speed() -> str:
    """Tables of force and stiffness by several methods, of solves, and of the growth with the mesh."""
    fig4, solve, scaling = load("fig4_assembly", "solve_benchmark", "scaling")
    ways = ("chapter", "standard FEM", "autodiff 9 x 9", "vmapped Hessian")
    rows = [
        f"Force and stiffness of {fig4['elements']:,} tetrahedra. All methods for one law were timed in one run. The "
        "error is the difference",
        "from the vmapped Hessian. The other methods are implemented as in textbooks, or with intermediate results in "
        "memory if this",
        "was measured to be faster:",
        "",
        "| law | time | error | " + " | ".join(f"{way}, times as long" for way in ways) + " |",
        "|---" * (3 + len(ways)) + "|",
    ]
    for name, r in fig4["laws"].items():
        slower = (f"{r['best_rival'][w]:.2g}" if w in r["best_rival"] else "" for w in ways)
        finite = r["errors"]["vmapped Hessian"] is not None
        error = f"{r['errors']['contracted']:.0e}" if finite else "Hessian not finite"
        time = f"{1e3 * r['seconds']['contracted']:.2g} ms"
        rows.append(f"| `{name}` | {time} | {error} | " + " | ".join(slower) + " |")
    neo, cube = fig4["laws"]["neo_hookean"]["seconds"], solve["static_cube"]
    over_floor, over_copy = neo["contracted"] / neo["floor"], neo["force only"] / neo["copy"]
    into_rows, pulled = 1e3 * neo["into the solver's rows"], cube["tetrahedra"]
    rows += [
        "",
        f"For the neo-Hookean law this time is {over_floor:.2g} times the time that is needed only to write the 45 "
        "different entries of each element's stiffness.",
        f"With the assembly into the rows of the solver it is {into_rows:.2g} ms. The force alone takes",
        f"{over_copy:.2g} times as long as copying 23 MB. A cube of {pulled:,} tetrahedra that is stretched by 20 % in "
        "one",
        f"load step takes {cube['seconds']:.2g} s (residual {cube['residual']:.0e}). With the gradient with respect to "
        "mu it takes",
        f"{cube['gradient_over_forward']:.3g} times as long (error of the gradient {cube['gradient_error']:.0e}).",
        "",
        "The hyperelastic liver phantom under a fifth of gravity (mild), and under full gravity, which crushes it:",
        "",
        "| gravity | step | Newton | steps per second | error of positions | largest residual |",
        "|---|---|---|---|---|---|",
    ]
    for r in solve["liver"]:
        off = f"{100 * r['error_of_positions']:.2g} %" if r["newton"] == "one" else "none: it is the reference"
        off = f"failed steps: {r['failed_steps']}" if r["failed_steps"] else off
        residual = "" if r["largest_residual"] is None else f"{r['largest_residual']:.0e}"
        cells = (r["gravity"], f"{r['dt']:g} s", r["newton"], f"{r['steps_per_s']:.3g}", off, residual)
        rows.append("| " + " | ".join(cells) + " |")
    largest, e = scaling["sizes"][-1], scaling["exponents"]
    step = largest["dynamic step"]
    memory = step["bytes"] / largest["tetrahedra"] / 1000
    rows += [
        "",
        f"From n = 4,000 to 500,000 tetrahedra, the time of a dynamic step grows as n^{e['dynamic step']:.2f}, and the "
        "time of a static",
        f"step as n^{e['static step']:.2f}. For the largest cube, with {largest['tetrahedra']:,} tetrahedra, a dynamic "
        "step takes",
        f"{step['seconds']:.2g} s (residual {step['residual']:.0e}), and the memory is {memory:.2g} kB per element.",
    ]
    return "\n".join(rows)


def runs() -> str:
    """Paragraphs on runs per minute, killed sweeps, a posterior propagated through the liver, and a training
    set.
    """
    bench, lives, spread, training = load("sweep_benchmark", "sweep_survival", "propagate_posterior", "training_set")
    kills, others = lives["kills"], lives["loopback"]
    killed, lost = kills["kills"] + sum(r["killed"] for r in others), kills["finished_chunks_lost"]
    equal = kills["equal_bytes"] and all(r["equal_bytes"] for r in others)
    memory = [f"{b / 1e9:.2g} GB for {rows}" for rows, b in bench["peak_memory_bytes"].items()]
    low, high = (1e3 * edge[-1] for edge in spread["interval_m"])
    last, first = ({n: v[k] for n, v in spread["total_order"].items()} for k in (-1, 0))
    best, mesh = training["surrogate"][-1], training["mesh"]
    single, loop = bench["seconds_a_row_1"], bench["seconds_a_row_loop"]
    gain, off = bench["two_devices_over_one"], bench["difference_m"]
    table = [
        ("runs per minute, one device", f"{bench['rows_a_minute']['1']:,.0f}"),
        ("speed of two devices divided by that of one", f"{gain:.3g}, results differ by {off:.0e} m"),
        ("a loop over single runs, compared with one device", f"{loop / single:.3g} times as long"),
        (f"{bench['most_rows']:,} runs, two devices", f"{bench['most_rows_s']:.0f} s, {', '.join(memory)}"),
        ("kills of one process, or of one of several processes", f"{killed}, {lost} finished chunks lost"),
        ("resumed results", f"{'the same' if equal else 'OTHER'} bytes as uninterrupted ones"),
    ]
    rows = [
        f"A block of 384 tetrahedra, in two load steps. The largest residual is {bench['largest_residual']:.0e} of the "
        "forces:",
        "",
        "| what | |",
        "|---|---|",
        *(f"| {what} | {value} |" for what, value in table),
        "",
        f"A synthetic sweep of porcine liver with {100 * spread['noise']:g} % of noise was fitted. With the posterior "
        "of this fit, the tip of the liver",
        f"phantom sinks by {low:.1f} to {high:.1f} mm within {spread['times_s'][-1]:g} s (95 % interval). The runs of "
        f"{spread['draws']}",
        f"draws from the posterior took {spread['seconds_propagation']:.0f} s. The standard error of the mean is",
        f"{1e3 * spread['error_of_mean_m'][-1]:.2g} mm. At the end, the total Sobol indices are {last['G0']:.2f} for "
        "G0,",
        f"{last['g2']:.2f} for the ratio g2 and {last['g1']:.2f} for g1. In the first step, the index of the "
        f"relaxation time tau2 is {first['tau2']:.2f}.",
        "",
        f"A training set of {training['rows']:,} static runs of the phantom, with different moduli and directions of "
        "gravity,",
        f"takes {training['seconds_sweep']:.0f} s on two cores, and {1e3 * training['seconds_reading']:.0f} ms to read",
        f"back. A cubic polynomial for {best['modes']} modes is fitted to 800 runs in {best['seconds_to_fit']:.1f} s. "
        "Its",
        f"error for the other runs is {100 * best['median_error']:.2g} % (median) to",
        f"{100 * best['largest_error']:.2g} % (near collapse).",
        "",
        f"These runs have linear elements on one mesh. {mesh['rows']} of them were repeated with quadratic elements on "
        f"the same tetrahedra, and in {mesh['ended']}",
        f"cases both runs converged. Their displacements differ by {100 * mesh['median']:.2g} % (median) to",
        f"{100 * mesh['largest']:.2g} %. A surrogate of linear runs cannot show this difference. Quadratic runs take",
        f"{mesh['seconds_quadratic'] / mesh['seconds_linear']:.2g} times as long. So make training sets with quadratic",
        "elements.",
    ]
    return "\n".join(rows)


PARTS = {"numbers": numbers, "laws": laws, "simulations": simulations, "speed": speed, "runs": runs}
