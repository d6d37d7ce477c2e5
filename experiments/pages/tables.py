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
        "| law | error against autodiff | force | force and stiffness | compile | brain | rubber |",
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

    rows = ["| what | error | run | compile |", "|---|---|---|---|"]
    for (scheme, n), r in sorted(steps.items()):
        recursion = scheme.replace("chapter", "backward_euler")
        what = f"simulated moduli at 16 frequencies, {recursion} recursion, {n} steps a cycle"
        error = f"{percent(r['error']['mean'])} of G', G''"
        rows.append(row(what, error, r["run_s"], r["compile_s"]))
    names = {
        "lions_mane": "lion's mane (30 of 31 frequencies, measured)",
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


def simulations() -> str:
    """Table of problems with known solutions on their finest meshes, and of the liver's three models."""
    known, liver = load("known_answers", "fig6_liver")
    rods = [r for r in known["cantilever"] if r["volumetric"] == "element"]
    cook, land, rod = known["cook"][-1], known["land"][-1], rods[-1]
    rows = ["| what | result | error | run | compile |", "|---|---|---|---|---|"]

    def row(what: str, result: str, error: str, r: dict) -> None:
        rows.append(f"| {what} | {result} | {error} | {r['run_s']:.2g} s | {r['compile_s']:.2g} s |")

    off = abs(cook["rise_mm"] / 14.74 - 1)
    row(f"Cook's membrane, {cook['tetrahedra']:,} tetrahedra", f"{cook['rise_mm']:.2f} mm", f"{100 * off:.2g} %", cook)
    off = (4.0 - land["end_mm"]) / 4.0
    what = f"Land's beam, pressure that follows, {land['tetrahedra']:,} tetrahedra"
    row(what, f"{land['end_mm']:.2f} mm", f"{100 * off:.2g} % below the codes' 4.0-4.2 mm", land)
    y = rod["tip_m"][0]
    what = f"silicone cantilever, {rod['tetrahedra']:,} tetrahedra"
    off = abs(y / rod["mazier_y_m"] - 1)
    row(what, f"{-1000 * y:.1f} mm", f"{100 * off:.2g} % from Mazier et al. on as many", rod)
    before = known["land"][-2]
    ratio = (land["cells"] / before["cells"]) ** 2
    limit = land["end_mm"] + (land["end_mm"] - before["end_mm"]) / (ratio - 1)
    short = [100 * (1 - r["tip_m"][0] / r["mazier_y_m"]) for r in rods if r["mazier_y_m"] is not None]
    rows += [
        "",
        f"Linear tetrahedra are too stiff in bending: Land's beam extrapolates (second order) to {limit:.2f} mm, the",
        f"cantilever hangs {min(short):.0f} to {max(short):.0f} % less than another MJED program's on as many.",
    ]
    rows += ["", f"The liver phantom, {liver['tetrahedra']:,} tetrahedra, implicit Euler, 2.4 s of motion:", ""]
    rows += [
        "| model | step | Newton | error of positions | steps a second | simulated over run time |",
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
        f"Force and stiffness of {fig4['elements']:,} tetrahedra, every way of a law in one run, with the error",
        "against the vmapped Hessian. Rivals are as books have them, or with their parts written to memory where that",
        "was measured to be faster:",
        "",
        "| law | time | error | " + " | ".join(f"{way}, times slower" for way in ways) + " |",
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
        f"For the neo-Hookean law that is {over_floor:.2g} times the time to write the 45 different entries and",
        f"nothing else; {into_rows:.2g} ms with assembly into the solver's rows; the force alone takes",
        f"{over_copy:.2g} times as long as copying 23 MB. A cube of {pulled:,} tetrahedra is pulled by 20 % in one",
        f"load step in {cube['seconds']:.2g} s, residual {cube['residual']:.0e}; with the gradient by mu that takes",
        f"{cube['gradient_over_forward']:.3g} times as long, error {cube['gradient_error']:.0e}.",
        "",
        "The liver phantom, hyperelastic, under a fifth of gravity (mild) and all of it, which crushes it:",
        "",
        "| gravity | step | Newton | steps a second | error of positions | largest residual |",
        "|---|---|---|---|---|---|",
    ]
    for r in solve["liver"]:
        off = f"{100 * r['error_of_positions']:.2g} %" if r["newton"] == "one" else "as it is solved"
        off = f"failed steps: {r['failed_steps']}" if r["failed_steps"] else off
        residual = "" if r["largest_residual"] is None else f"{r['largest_residual']:.0e}"
        cells = (r["gravity"], f"{r['dt']:g} s", r["newton"], f"{r['steps_per_s']:.3g}", off, residual)
        rows.append("| " + " | ".join(cells) + " |")
    largest, e = scaling["sizes"][-1], scaling["exponents"]
    step = largest["dynamic step"]
    memory = step["bytes"] / largest["tetrahedra"] / 1000
    rows += [
        "",
        f"From 4,000 to 500,000 tetrahedra the time of a dynamic step grows as n^{e['dynamic step']:.2f}, of a static",
        f"one as n^{e['static step']:.2f}; the largest cube, {largest['tetrahedra']:,} tetrahedra, takes",
        f"{step['seconds']:.2g} s a dynamic step (residual {step['residual']:.0e}) and {memory:.2g} kB an element.",
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
    memory = [f"{b / 1e9:.2g} GB at {rows}" for rows, b in bench["peak_memory_bytes"].items()]
    low, high = (1e3 * edge[-1] for edge in spread["interval_m"])
    last, first = ({n: v[k] for n, v in spread["total_order"].items()} for k in (-1, 0))
    best, mesh = training["surrogate"][-1], training["mesh"]
    single, loop = bench["seconds_a_row_1"], bench["seconds_a_row_loop"]
    gain, off = bench["two_devices_over_one"], bench["difference_m"]
    table = [
        ("rows a minute, one device", f"{bench['rows_a_minute']['1']:,.0f}"),
        ("two devices over one", f"{gain:.3g}, results differ by {off:.0e} m"),
        ("a loop by hand over one device", f"{loop / single:.3g} of the time"),
        (f"{bench['most_rows']:,} rows, two devices", f"{bench['most_rows_s']:.0f} s, {', '.join(memory)}"),
        ("kills, of one process or of one of several", f"{killed}, {lost} finished chunks lost"),
        ("resumed results", f"{'the same' if equal else 'OTHER'} bytes as undisturbed ones"),
    ]
    rows = [
        f"A block of 384 tetrahedra, two load steps, residuals to {bench['largest_residual']:.0e} of the forces:",
        "",
        "| what | |",
        "|---|---|",
        *(f"| {what} | {value} |" for what, value in table),
        "",
        f"Noise of {100 * spread['noise']:g} % on a synthetic sweep of porcine liver leaves the tip of the liver",
        f"phantom, after {spread['times_s'][-1]:g} s, between {low:.1f} and {high:.1f} mm lower: of {spread['draws']}",
        f"draws from the posterior in {spread['seconds_propagation']:.0f} s, the mean known to",
        f"{1e3 * spread['error_of_mean_m'][-1]:.2g} mm. Total Sobol indices there: G0 {last['G0']:.2f},",
        f"g2 {last['g2']:.2f}, g1 {last['g1']:.2f}; in the first step tau2 has {first['tau2']:.2f}.",
        "",
        f"A training set of {training['rows']:,} static runs of the phantom (moduli, direction of gravity)",
        f"takes {training['seconds_sweep']:.0f} s on two cores, {1e3 * training['seconds_reading']:.0f} ms to read",
        f"back; a cubic polynomial for {best['modes']} modes, fitted to 800 rows in {best['seconds_to_fit']:.1f} s,",
        f"misses the others by {100 * best['median_error']:.2g} % (median) to",
        f"{100 * best['largest_error']:.2g} % (near collapse).",
        "",
        f"Its rows have linear elements on one mesh. Of {mesh['rows']} such rows, {mesh['ended']} end with quadratic",
        f"elements on the same tetrahedra too: the linear ones are {100 * mesh['median']:.2g} % (median) to",
        f"{100 * mesh['largest']:.2g} % off those, which no surrogate of them can see. The quadratic rows take",
        f"{mesh['seconds_quadratic'] / mesh['seconds_linear']:.2g} times as long. So make training sets with quadratic",
        "elements.",
    ]
    return "\n".join(rows)


PARTS = {"numbers": numbers, "laws": laws, "simulations": simulations, "speed": speed, "runs": runs}
