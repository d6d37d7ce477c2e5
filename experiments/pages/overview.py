"""The table of experiments/README.md: question and result of every script, the chapter's statement, run times."""

import json
from collections.abc import Callable

from experiments.pages import (
    accelerator,
    bodies,
    elements,
    equal_error,
    fits,
    identification,
    moving,
    reduced,
    rigs,
    stability,
)
from experiments.pages.porosity import holding
from experiments.pages.results import RESULTS, load, percent


def _fig5() -> str:
    (fig5,) = load("fig5_dma")
    steps = {(r["scheme"], r["steps"]): percent(r["error"]["mean"]) for r in fig5["steps"]}
    mesh = min(fig5["mesh"], key=lambda r: abs(r["nodes"] - 508))
    return (
        f"backward Euler at 20 steps a cycle alone costs {steps['chapter', 20]}, an uncorrected mesh of "
        f"{mesh['nodes']} "
        f"nodes {percent(mesh['raw']['mean'])}; exponential recursion at 50 steps and a corrected mesh "
        f"{steps['exponential', 50]}"
    )


def _strain() -> str:
    (data,) = load("strain_sweep")
    limits = {r["law"]: r["limit_5_percent"] for r in data["laws"]}
    left = ", ".join(f"`{n}` at {percent(v)}" for n, v in limits.items() if v is not None)
    error = max(r["error"] for r in data["laws"])
    return (
        f"of {len(limits)} laws only {left} leaves linearity (5 % in G') below 20 %, none at the measured "
        f"1-2 %; error of the time step {percent(error)}"
    )


def _fig2() -> str:
    (data,) = load("fig2_uniaxial")
    viscous = data["chord_moduli"]["neo_hookean, tension"]
    sponge = data["chord_moduli"]["porous sample"]["chord_modulus_Pa"]
    stiffer = [v[-1] / v[0] for v in (viscous["chord_modulus_Pa"], sponge)]
    return (
        f"over the measured rates viscosity makes the chord modulus {stiffer[0]:.2g} times as large, the "
        f"sponge of Table "
        f"2 {stiffer[1]:.2g} times; error of the time step {percent(viscous['error'])}"
    )


def _fig3() -> str:
    (data,) = load("fig3_volumetric")
    r = data["rows"][0]
    return (
        f"at r_w = {r['fluid_fraction']} tangent and slope are both true at J0 = {r['J0']:.3g}, not at the printed "
        f"{r['J0_printed']:.3g}: J0 = 1 - r_w + r_w K0/K_lim"
    )


def _fig6() -> str:
    (data,) = load("fig6_liver")
    speed = {r["model"]: r["steps_per_s"] for r in data["rows"] if r["dt"] == 0.15 and r["newton"] != 1}
    off = {r["model"]: r["error"] for r in data["rows"] if r["dt"] == 0.15 and r["newton"] != 1}
    peak, swing = (
        {m: f"{100 * r[key]:.2g}" for m, r in data["summary"].items()} for key in ("largest_m", "amplitude_m")
    )
    return (
        ", ".join(f"{m} {speed[m]:.2g} steps a second (error {percent(off[m])})" for m in speed)
        + f" at 0.15 s. Viscosity raises the tip's peak from {peak['hyperelastic']} to {peak['viscous']} cm, and "
        f"lowers its swing after a quarter of the run from {swing['hyperelastic']} to {swing['viscous']} cm; the "
        f"complete model's peak is {peak['complete']} cm, the porohyperelastic one's {peak['porohyperelastic']} cm"
    )


def _porosity() -> str:
    (data,) = load("porosity_claim")
    rows = {(r["varied"], r["value"]): r for r in data["rows"]}
    both, table = rows["Table 2", None], data["table_2"]
    found = holding(data)
    rival = next(r for r in data["rows"] if r["varied"] == "law's bulk of the rival")
    return (
        f"no: complete {100 * both['largest_m']:.3g} cm, viscous {100 * both['without_m']:.3g} cm, because the law's "
        f"bulk modulus of {data['law_bulk_Pa']:g} Pa does not act: the sponge's K0 = {table['bulk']:g} Pa takes its "
        "place. What does hold it back: "
        f"{'; '.join(found['it takes'])}. Not enough: {'; '.join(found['not enough'])}. Against a viscous body whose "
        f"own bulk is K0 the sponge's fluid does hold back: {rival['ratio']:.2g} times its displacement"
    )


def _choices() -> str:
    (data,) = load("liver_choices")
    viscous = data["time step, integrator, recursion (viscous)"]
    both = [next(r for r in viscous[n] if r["dt"] == 0.02) for n in ("implicit Euler", "Newmark")]
    explicit = data["explicit against implicit (hyperelastic)"]["explicit, total Lagrangian"][0]
    return (
        f"at 0.02 s Newmark's error is {percent(both[1]['error'])}, implicit Euler's "
        f"{percent(both[0]['error'])}; explicit "
        f"dynamics at its critical step ({1e3 * data['critical_step_s']:.2g} ms): {percent(explicit['error'])} in "
        f"{explicit['run_s']:.2g} s, hard to beat for elastic tissue as soft as this; these errors leave the mesh out"
    )


def _gravity() -> str:
    (data,) = load("gravity_path")
    return "; ".join(f"{name}: to {r['converged_to_m_s2']:.2g} m/s2" for name, r in data["rows"].items())


def _known() -> str:
    (data,) = load("known_answers")
    cook, land = data["cook"][-1], data["land"][-1]
    theirs = [r for r in data["cantilever"] if r["mazier_y_m"] is not None]
    off = [r["tip_m"][0] / r["mazier_y_m"] - 1 for r in theirs if r["volumetric"] == "element"]
    nodal = [r["tip_m"][0] / r["mazier_y_m"] - 1 for r in theirs if r["volumetric"] == "nodal"]
    best = data["cantilever, quadratic"][-1]
    return (
        f"Cook {percent(abs(cook['rise_mm'] / 14.74 - 1))}; Land's beam ends at {land['end_mm']:.3g} mm "
        f"(codes: 4.0-4.2); "
        f"the cantilever hangs {percent(-max(off))} to {percent(-min(off))} less than in another MJED program "
        f"on as many "
        f"tetrahedra, with volumes at the nodes {percent(nodal[-1])} more; "
        f"{best['tetrahedra']:,} quadratic mixed elements {-1e3 * best['tip_m'][0]:.1f} mm, with their estimate "
        f"{-1e3 * (best['tip_m'][0] + best['change_m']):.1f} mm, where 116 mm are measured"
    )


def _fig4() -> str:
    (data,) = load("fig4_assembly")
    rows = data["laws"].values()

    def span(way: str) -> str:
        found = [r["best_rival"][way] for r in rows if way in r["best_rival"]]
        return f"{min(found):.2g} to {max(found):.2g}"

    stored = "chapter, L and U stored"
    both = [r["times_faster"] for r in rows if stored in r["times_faster"]]
    worse = sum(t[stored] > t["chapter, on the fly"] for t in both)
    six = [r["best_rival"] for r in rows if "chapter" in r["best_rival"]]
    behind = sum(t["chapter"] > t["standard FEM"] for t in six)
    return (
        f"the chapter's six terms take {span('chapter')} times as long, standard FEM in the same layout "
        f"{span('standard FEM')}, a vmapped Hessian {span('vmapped Hessian')} (parts written to memory where "
        f"that was measured to be faster): the six terms are slower than standard FEM in {behind} of {len(six)} laws; "
        f"storing L and U loses in {worse} of {len(both)}"
    )


def _solve() -> str:
    (data,) = load("solve_benchmark")
    cube = data["static_cube"]
    stiff = [r for r in data["preconditioners"] if r["dt"] == 0.3]
    part = min(r["two-level"]["iterations"] / r["block-Jacobi"]["iterations"] for r in stiff)
    return (
        f"the cube in {cube['seconds']:.2g} s (residual {cube['residual']:.0e}), with its gradient "
        f"{cube['gradient_over_forward']:.2g} times that; at 0.3 s the coarse space takes {percent(part)} of "
        f"the iterations"
    )


def _scaling() -> str:
    (data,) = load("scaling")
    e = data["exponents"]
    return f"a dynamic step grows as n^{e['dynamic step']:.2f}, a static one as n^{e['static step']:.2f}"


def _precision() -> str:
    (data,) = load("precision")
    ratio = [r["seconds"]["float64"] / r["seconds"]["float32"] for r in data["laws"]]
    floor = min(r["residual"] for r in data["cube"] if r["precision"] == "float32" and r["code"] == "converged")
    off = max(max(r["force_error"], r["stiffness_error"]) for r in data["laws"])
    return (
        f"float32 is {min(ratio):.2g} to {max(ratio):.2g} times as fast an assembly, errors up to {off:.0e}; "
        f"the cube's "
        f"residual gets down to {floor:.0e}"
    )


def _jax_releases() -> str:
    (data,) = load("jax_releases")
    times = ", ".join(f"{r['jax']} {r['torsion']['run_s']:.2g} s" for r in data["rows"])
    compiled = {r["torsion"]["compiled_transpose"] for r in data["rows"]}
    return f"torsion program by release: {times}; transposes in it: {' to '.join(str(n) for n in sorted(compiled))}"


def _sweeps() -> str:
    (data,) = load("sweep_benchmark")
    return (
        f"{data['rows_a_minute']['1']:,.0f} rows a minute on one core, {data['two_devices_over_one']:.3g} times on two"
    )


def _survival() -> str:
    (data,) = load("sweep_survival")
    kills = data["kills"]["kills"] + sum(r["killed"] for r in data["loopback"])
    return f"{kills} kills, {data['kills']['finished_chunks_lost']} finished chunks lost, the same bytes in the end"


def _gradient() -> str:
    (data,) = load("gradient_cost")
    liver = [r for r in data["rows"] if r["model"] == "complete"]
    ratios = ", ".join(f"{r['ratio']:.2g} ({r['steps']:,} steps)" for r in liver if r["store"] == "all")
    most = max(liver, key=lambda r: (r["steps"], r["planned_bytes"]))
    return (
        f"a gradient of the complete liver, all stored, takes {ratios} times as long as its run (in most of the 1,000 "
        f"steps the liver hangs still); {most['steps']:,} steps in {most['planned_bytes'] / 1e9:.2g} GB"
    )


def _laws() -> str:
    (data,) = load("laws_table")
    worst = max(max(r["stress_error"], r["tangent_error"]) for r in data["laws"].values())
    return f"the hand-derived terms of all {len(data['laws'])} laws are within {worst:.0e} of automatic differentiation"


#: Script -> (question, function for the result, the chapter's statement and the reason for a difference).
ROWS: dict[str, tuple[str, Callable[[], str], str]] = {
    "main_job": (
        "the README's command on both shipped sweeps: what comes out, where does the time go?",
        fits.main_job,
        "",
    ),
    "fit_methods": ("error of a fit's parameters against run time: method, recursion, steps a cycle", fits.methods, ""),
    "fig5_dma": (
        "Fig. 5: simulated moduli, both recursions; steps a cycle, mesh",
        _fig5,
        "mean error 5 %: its recursion and mesh each explain as much",
    ),
    "strain_sweep": (
        "section 5.2: at what strain does linearity end?",
        _strain,
        "linear to 1-2 % as measured: the laws reach farther",
    ),
    "fig2_uniaxial": (
        "Fig. 2: laws of Table 1; stiffness against strain rate",
        _fig2,
        "curves of other authors, print only",
    ),
    "fig3_volumetric": ("Fig. 3, right: volumetric stress and its tangent line", _fig3, "J0 misses a factor r_w"),
    "fig6_liver": (
        "Fig. 6: the liver phantom under a fifth of gravity, three models; steps a second beside the error",
        _fig6,
        "10, 9 and 6 frames a second on 5,000 tetrahedra, one Newton iteration, another machine, no error stated; says "
        "that viscosity increases the amplitude of the oscillations: here the peak, not the oscillation",
    ),
    "equal_error": (
        "what does a simulated second of the liver cost at equal error, with every model that the chapter names?",
        equal_error.came_out,
        "10, 9 and 6 frames a second, no error stated",
    ),
    "porosity_claim": (
        "does porosity prevent large deformations? Fig. 6's loading and its porohyperelastic run; K0, K_lim, "
        "permeability, rate",
        _porosity,
        "yes, it prevents unrealistic large deformations: with its own Table 2 the other way round here; linear "
        "tetrahedra on one mesh, too stiff in bending",
    ),
    "liver_choices": (
        "error against run time: step and integrator, recursion, tolerance, porous scheme, explicit",
        _choices,
        "its porous scheme is unstable here",
    ),
    "gravity_path": (
        "how near to collapse is liver under its weight?",
        _gravity,
        "shows full gravity: its liver is held all around",
    ),
    "known_answers": ("Cook's membrane, Land's beam, the silicone cantilever on finer and finer meshes", _known, ""),
    "fig4_assembly": (
        "Fig. 4: force and stiffness, every law, every way (`assembly_rivals.py`), the write floor",
        _fig4,
        "up to five times faster than standard FEM (its implementation): here the six terms are slower than that, "
        "the contracted ones faster; proposes storing L and U",
    ),
    "solve_benchmark": (
        "solves: a static cube and its gradient; the liver's steps; preconditioner; factorisation",
        _solve,
        "",
    ),
    "scaling": ("time and memory from 1,000 to 1,000,000 tetrahedra", _scaling, ""),
    "precision": ("float32 beside float64", _precision, ""),
    "accelerator": ("one GPU beside the processor of its machine, both precisions", accelerator.came_out, ""),
    "jax_releases": ("the same programs with different releases of jax", _jax_releases, ""),
    "gradient_cost": ("what does a gradient through a run cost, by steps and what is stored?", _gradient, ""),
    "lesion": (
        "a stiff lesion found from noisy surface displacements (synthetic, data of a finer mesh)",
        fits.lesion,
        "",
    ),
    "creep_and_sweep": ("how much narrower do intervals become with several tests (synthetic)?", fits.creep, ""),
    "coverage": (
        "how often do 95 % intervals cover, with noise, inertia, gap and compression as they are (synthetic)? does the "
        "chosen model predict the decade that was left out?",
        fits.coverage,
        "",
    ),
    "torsion_speed": (
        "the torsion fit with the linear rig's derivative on 100 nodes, against the derivative of the whole simulation "
        "on the finer mesh",
        fits.torsion_speed,
        "",
    ),
    "sweep_benchmark": ("rows a minute of a sweep, memory, 10,000 rows", _sweeps, ""),
    "sweep_survival": ("kills at random moments, several processes, 8 devices", _survival, ""),
    "propagate_posterior": (
        "how uncertain is the sagging of a liver after a rheometer's 5 % of noise (synthetic)?",
        fits.posterior,
        "",
    ),
    "training_set": ("1,000 runs of the phantom by a sweep, and a polynomial surrogate of them", fits.training, ""),
    "stability_inverted": (
        "scrambled, inverted and crushed starts, every solver: how many come back?",
        stability.inverted_came_out,
        "its regularised stiffness is the second solver",
    ),
    "stability_steps": (
        "the liver under its full weight at any step, with and without `robust`",
        stability.steps_came_out,
        "",
    ),
    "stability_bulk": ("locking against K/mu", stability.bulk_came_out, ""),
    "elements": (
        "linear, quadratic and mixed elements: error, estimated error, run time",
        elements.came_out,
        "has linear tetrahedra alone, and no error of the mesh",
    ),
    "liver_mesh": ("how far is the phantom's answer known: two meshes, two orders?", elements.phantom, ""),
    "moving_mesh": ("how near is the estimate of the mesh's error while a body moves?", moving.came_out, ""),
    "liver_in_place": (
        "the phantom with capsule, ligaments, vessels, on a plane, and its unloaded shape: what does each change?",
        bodies.in_place,
        "names capsule, vessels and boundary conditions as what its liver lacks",
    ),
    "indentation": (
        "a sphere on a layer: how wrong is a half-space, and how well do noisy curves give modulus and contact point?",
        bodies.indented,
        "",
    ),
    "elastography": (
        "four stiff cylinders in a plate, from its waves (synthetic, exact series): how far off, how sure?",
        identification.plate_came_out,
        "names elastography as a way to measure the liver in a patient",
    ),
    "liver_waves": (
        "a lesion in the liver phantom from waves of 60 Hz (synthetic): found, and how far off?",
        identification.liver_waves_came_out,
        "names elastography as a way to measure the liver in a patient",
    ),
    "stability_rigs": ("error of tension, indentation and creep against run time: mesh, elements", rigs.came_out, ""),
    "reduced": (
        "a reduced model of the viscous liver: error, stated error and time a step",
        reduced.came_out,
        "weighs its model against reduced bases and names no error",
    ),
    "reduced_porous": (
        "a reduced model of the complete liver, porous and viscous: error, stated error and time a step",
        reduced.porous_came_out,
        "weighs its model against reduced bases and names no error",
    ),
    "reduced_quadratic": (
        "a reduced model of the viscous liver of quadratic elements: error, stated error and time a step",
        reduced.quadratic_came_out,
        "weighs its model against reduced bases and names no error",
    ),
    "separated": (
        "the phantom at rest as a sum of products (proper generalised decomposition), beside a reduced basis",
        reduced.separated_came_out,
        "weighs its model against proper generalised decomposition and gives no number",
    ),
    "stability_cost": ("what does robustness at hand cost where it is not needed?", stability.cost_came_out, ""),
    "laws_table": ("every law: error of its terms beside time and compile time", _laws, ""),
    "curves_fit": (
        "which law follows brain and rubber in tension, compression and shear at once?",
        fits.curves,
        "liver curves exist in print only as pictures",
    ),
}


def overview() -> str:
    """Return the whole table."""
    file = RESULTS / "run_times.json"
    times = json.loads(file.read_text()) if file.exists() else {}

    def minutes(name: str, kind: str) -> str:
        seconds = times.get(name, {}).get(kind)
        return "" if seconds is None else f"{seconds / 60:.1f}"

    rows = [
        "| script | question | what came out | the chapter | minutes (empty: not timed) | minutes with `--quick` |",
        "|---" * 6 + "|",
    ]
    for name, (question, came_out, chapter) in ROWS.items():
        cells = (f"`{name}.py`", question, came_out(), chapter, minutes(name, "full"), minutes(name, "quick"))
        rows.append("| " + " | ".join(cells) + " |")
    return "\n".join(rows)


PARTS = {"overview": overview}
