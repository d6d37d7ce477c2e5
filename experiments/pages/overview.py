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
        f"backward Euler with 20 steps per cycle alone causes an error of {steps['chapter', 20]}, and a mesh of "
        f"{mesh['nodes']} nodes without correction an error of {percent(mesh['raw']['mean'])}; with the exponential "
        f"recursion, 50 steps and a corrected mesh, the error is {steps['exponential', 50]}"
    )


def _strain() -> str:
    (data,) = load("strain_sweep")
    limits = {r["law"]: r["limit_5_percent"] for r in data["laws"]}
    left = ", ".join(f"`{n}` at {percent(v)}" for n, v in limits.items() if v is not None)
    error = max(r["error"] for r in data["laws"])
    return (
        f"of {len(limits)} laws, only {left} strain leaves the linear range (5 % in G') below a strain of 20 %, and no "
        f"law does so at the measured 1-2 %; the error of the time step is {percent(error)}"
    )


def _fig2() -> str:
    (data,) = load("fig2_uniaxial")
    viscous = data["chord_moduli"]["neo_hookean, tension"]
    sponge = data["chord_moduli"]["porous sample"]["chord_modulus_Pa"]
    stiffer = [v[-1] / v[0] for v in (viscous["chord_modulus_Pa"], sponge)]
    return (
        f"over the measured strain rates, viscosity makes the chord modulus {stiffer[0]:.2g} times as large, and the "
        f"porous body of Table 2 makes it {stiffer[1]:.2g} times as large; the error of the time step is "
        f"{percent(viscous['error'])}"
    )


def _fig3() -> str:
    (data,) = load("fig3_volumetric")
    r = data["rows"][0]
    return (
        f"at r_w = {r['fluid_fraction']} the line is tangent to the curve and has the slope K_lim if J0 = "
        f"{r['J0']:.3g}, not at the printed {r['J0_printed']:.3g}; so J0 = 1 - r_w + r_w K0/K_lim"
    )


def _fig6() -> str:
    (data,) = load("fig6_liver")
    speed = {r["model"]: r["steps_per_s"] for r in data["rows"] if r["dt"] == 0.15 and r["newton"] != 1}
    off = {r["model"]: r["error"] for r in data["rows"] if r["dt"] == 0.15 and r["newton"] != 1}
    peak, swing = (
        {m: f"{100 * r[key]:.2g}" for m, r in data["summary"].items()} for key in ("largest_m", "amplitude_m")
    )
    return (
        ", ".join(f"{m} {speed[m]:.2g} steps per second (error {percent(off[m])})" for m in speed)
        + f", with steps of 0.15 s. Viscosity raises the peak of the tip from {peak['hyperelastic']} to "
        f"{peak['viscous']} cm. It reduces the amplitude after a quarter of the run from {swing['hyperelastic']} to "
        f"{swing['viscous']} cm. The peak is {peak['complete']} cm with the complete model and "
        f"{peak['porohyperelastic']} cm with the porohyperelastic model"
    )


def _porosity() -> str:
    (data,) = load("porosity_claim")
    rows = {(r["varied"], r["value"]): r for r in data["rows"]}
    both, table = rows["Table 2", None], data["table_2"]
    found = holding(data)
    rival = next(r for r in data["rows"] if r["varied"] == "law's bulk of the rival")
    return (
        f"no: the complete model moves by {100 * both['largest_m']:.3g} cm, the viscous model by "
        f"{100 * both['without_m']:.3g} cm. The reason is that the porous body's K0 = {table['bulk']:g} Pa replaces "
        f"the law's bulk modulus of {data['law_bulk_Pa']:g} Pa. Porosity does reduce the motion with: "
        f"{'; '.join(found['it takes'])}. It does not with: {'; '.join(found['not enough'])}. The displacement is "
        f"{rival['ratio']:.2g} times that of a viscous body whose bulk modulus is K0, so the fluid does reduce the "
        "motion of such a body"
    )


def _choices() -> str:
    (data,) = load("liver_choices")
    viscous = data["time step, integrator, recursion (viscous)"]
    both = [next(r for r in viscous[n] if r["dt"] == 0.02) for n in ("implicit Euler", "Newmark")]
    explicit = data["explicit against implicit (hyperelastic)"]["explicit, total Lagrangian"][0]
    return (
        f"with steps of 0.02 s, the error of Newmark's method is {percent(both[1]['error'])}, that of implicit Euler "
        f"{percent(both[0]['error'])}; explicit dynamics with a step of {1e3 * explicit['dt']:.2g} ms (critical step: "
        f"{1e3 * data['critical_step_s']:.2g} ms) has an error of {percent(explicit['error'])} and takes "
        f"{explicit['run_s']:.2g} s; for such soft elastic "
        "tissue no other method is much faster; errors of the mesh are not included"
    )


def _gravity() -> str:
    (data,) = load("gravity_path")
    return "; ".join(f"{name}: converges up to {r['converged_to_m_s2']:.2g} m/s2" for name, r in data["rows"].items())


def _known() -> str:
    (data,) = load("known_answers")
    cook, land = data["cook"][-1], data["land"][-1]
    theirs = [r for r in data["cantilever"] if r["mazier_y_m"] is not None]
    off = [r["tip_m"][0] / r["mazier_y_m"] - 1 for r in theirs if r["volumetric"] == "element"]
    nodal = [r["tip_m"][0] / r["mazier_y_m"] - 1 for r in theirs if r["volumetric"] == "nodal"]
    best = data["cantilever, quadratic"][-1]
    return (
        f"Cook's membrane has an error of {percent(abs(cook['rise_mm'] / 14.74 - 1))}; Land's beam ends at "
        f"{land['end_mm']:.3g} mm (other programs: 4.0-4.2 mm); the cantilever sinks {percent(-max(off))} to "
        f"{percent(-min(off))} less than in another program with the chapter's method (MJED) and as many tetrahedra, "
        f"and {percent(nodal[-1])} more with volumes averaged at the nodes; {best['tetrahedra']:,} quadratic mixed "
        f"elements give {-1e3 * best['tip_m'][0]:.1f} mm, with the estimated error added "
        f"{-1e3 * (best['tip_m'][0] + best['change_m']):.1f} mm (measured: 116 mm)"
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
        f"the chapter's six terms take {span('chapter')} times as long as the terms of liverjax, standard FEM with the "
        f"same layout of arrays {span('standard FEM')} times, a vmapped Hessian {span('vmapped Hessian')} times "
        "(intermediate results are written to memory if this was measured to be faster); the six terms are slower "
        f"than standard FEM for {behind} of {len(six)} laws; the six terms with stored L and U are slower than without "
        f"for {worse} of {len(both)} laws"
    )


def _solve() -> str:
    (data,) = load("solve_benchmark")
    cube = data["static_cube"]
    stiff = [r for r in data["preconditioners"] if r["dt"] == 0.3]
    part = min(r["two-level"]["iterations"] / r["block-Jacobi"]["iterations"] for r in stiff)
    return (
        f"the cube takes {cube['seconds']:.2g} s (residual {cube['residual']:.0e}), and with its gradient "
        f"{cube['gradient_over_forward']:.2g} times as long; with steps of 0.3 s, the coarse space reduces the number "
        f"of iterations to {percent(part)}"
    )


def _scaling() -> str:
    (data,) = load("scaling")
    e = data["exponents"]
    return (
        f"with n tetrahedra, the time of a dynamic step grows as n^{e['dynamic step']:.2f}, that of a static step as "
        f"n^{e['static step']:.2f}"
    )


def _precision() -> str:
    (data,) = load("precision")
    ratio = [r["seconds"]["float64"] / r["seconds"]["float32"] for r in data["laws"]]
    floor = min(r["residual"] for r in data["cube"] if r["precision"] == "float32" and r["code"] == "converged")
    off = max(max(r["force_error"], r["stiffness_error"]) for r in data["laws"])
    return (
        f"the assembly is {min(ratio):.2g} to {max(ratio):.2g} times as fast in float32, with errors of up to "
        f"{off:.0e}; the residual of the cube falls to {floor:.0e}"
    )


def _jax_releases() -> str:
    (data,) = load("jax_releases")
    times = ", ".join(f"{r['torsion']['run_s']:.2g} s with {r['jax']}" for r in data["rows"])
    compiled = {r["torsion"]["compiled_transpose"] for r in data["rows"]}
    return (
        f"run time of the torsion program: {times}; number of transposes in the program: "
        f"{' to '.join(str(n) for n in sorted(compiled))}"
    )


def _sweeps() -> str:
    (data,) = load("sweep_benchmark")
    return (
        f"{data['rows_a_minute']['1']:,.0f} runs per minute on one core, {data['two_devices_over_one']:.3g} times as "
        "many on two cores"
    )


def _survival() -> str:
    (data,) = load("sweep_survival")
    kills = data["kills"]["kills"] + sum(r["killed"] for r in data["loopback"])
    return (
        f"{kills} kills, {data['kills']['finished_chunks_lost']} finished chunks lost; the final files have the same "
        "bytes as without kills"
    )


def _gradient() -> str:
    (data,) = load("gradient_cost")
    liver = [r for r in data["rows"] if r["model"] == "complete"]
    ratios = ", ".join(f"{r['ratio']:.2g} ({r['steps']:,} steps)" for r in liver if r["store"] == "all")
    most = max(liver, key=lambda r: (r["steps"], r["planned_bytes"]))
    return (
        f"a gradient of the complete liver, with all states stored, takes {ratios} times as long as the run (in most "
        f"of the 1,000 steps the liver is at rest); {most['steps']:,} steps need {most['planned_bytes'] / 1e9:.2g} GB"
    )


def _laws() -> str:
    (data,) = load("laws_table")
    worst = max(max(r["stress_error"], r["tangent_error"]) for r in data["laws"].values())
    return (
        f"the hand-derived terms of all {len(data['laws'])} laws differ from automatic differentiation by at most "
        f"{worst:.0e}"
    )


#: Script -> (question, function for the result, the chapter's statement and the reason for a difference).
ROWS: dict[str, tuple[str, Callable[[], str], str]] = {
    "main_job": (
        "the README's command with both sweeps in `data/`: what is the result, and what takes the time?",
        fits.main_job,
        "",
    ),
    "fit_methods": (
        "error of fitted parameters against run time: method, recursion, steps per cycle",
        fits.methods,
        "",
    ),
    "fig5_dma": (
        "Fig. 5: simulated moduli with both recursions; steps per cycle, mesh",
        _fig5,
        "mean error of 5 %; its recursion alone and its mesh alone can cause such an error",
    ),
    "strain_sweep": (
        "section 5.2: at what strain does the linear range end?",
        _strain,
        "measured tissue is linear up to 1-2 %; the laws are linear up to larger strains",
    ),
    "fig2_uniaxial": (
        "Fig. 2: laws of Table 1, and stiffness against strain rate",
        _fig2,
        "shows curves of other authors, only as printed pictures",
    ),
    "fig3_volumetric": (
        "Fig. 3, right: volumetric stress and its tangent line",
        _fig3,
        "in its formula of J0 a factor r_w is missing",
    ),
    "fig6_liver": (
        "Fig. 6: the liver phantom under a fifth of gravity with three models: steps per second, and error",
        _fig6,
        "10, 9 and 6 frames per second with 5,000 tetrahedra and one Newton iteration on another machine, without an "
        "error; says that viscosity increases the amplitude of the oscillations; here it increases only the peak",
    ),
    "equal_error": (
        "how long does a simulated second of the liver take at equal error, with every model that the chapter names?",
        equal_error.came_out,
        "10, 9 and 6 frames per second, without an error",
    ),
    "porosity_claim": (
        "does porosity prevent large deformations? The load of Fig. 6, with different K0, K_lim, permeability and "
        "rate of loading",
        _porosity,
        "says that porosity prevents unrealistically large deformations; here, with its Table 2, porosity increases "
        "them (one mesh of linear tetrahedra, too stiff in bending)",
    ),
    "liver_choices": (
        "error against run time: time step and integrator, recursion, tolerance, porous scheme, explicit dynamics",
        _choices,
        "its porous scheme is unstable here",
    ),
    "gravity_path": (
        "at what gravity does liver collapse under its weight?",
        _gravity,
        "shows full gravity, with a liver that is fixed all around",
    ),
    "known_answers": ("Cook's membrane, Land's beam, the silicone cantilever on finer and finer meshes", _known, ""),
    "fig4_assembly": (
        "Fig. 4: run time of force and stiffness for every law and method (`assembly_rivals.py`), compared with the "
        "time for writing alone",
        _fig4,
        "its method is up to five times as fast as its standard FEM; here the six terms are slower than standard FEM, "
        "and the terms of liverjax are faster; proposes to store L and U",
    ),
    "solve_benchmark": (
        "time of solutions: a static cube and its gradient, steps of the liver, preconditioner, factorisation",
        _solve,
        "",
    ),
    "scaling": ("time and memory from 1,000 to 1,000,000 tetrahedra", _scaling, ""),
    "precision": ("float32 compared with float64", _precision, ""),
    "accelerator": ("one GPU compared with the processor of its machine, in both precisions", accelerator.came_out, ""),
    "jax_releases": ("the same programs with different releases of jax", _jax_releases, ""),
    "gradient_cost": (
        "how long does the gradient of a run take, by number of steps and of stored states?",
        _gradient,
        "",
    ),
    "lesion": (
        "a stiff lesion is found from noisy displacements of the surface (synthetic data of a finer mesh)",
        fits.lesion,
        "",
    ),
    "creep_and_sweep": ("how much narrower are the intervals with several tests (synthetic)?", fits.creep, ""),
    "coverage": (
        "how often do 95 % intervals cover the true values, with realistic noise, inertia, gap and compression "
        "(synthetic)? does the chosen model predict a decade that was left out?",
        fits.coverage,
        "",
    ),
    "torsion_speed": (
        "the torsion fit with the derivative of the linear model on 100 nodes, compared with the derivative of the "
        "whole simulation on the finer mesh",
        fits.torsion_speed,
        "",
    ),
    "sweep_benchmark": ("a sweep: runs per minute, memory, 10,000 runs", _sweeps, ""),
    "sweep_survival": ("a sweep that is killed at random moments, with several processes and 8 devices", _survival, ""),
    "propagate_posterior": (
        "how uncertain is the sinking of a liver if its parameters come from a sweep with 5 % of noise (synthetic)?",
        fits.posterior,
        "",
    ),
    "training_set": ("1,000 runs of the phantom in a sweep, and a polynomial surrogate of them", fits.training, ""),
    "stability_inverted": (
        "runs from random, inverted and crushed positions with every solver: how many find the right equilibrium?",
        stability.inverted_came_out,
        "its regularised stiffness is the second solver",
    ),
    "stability_steps": (
        "the liver under its full weight with many step sizes, with and without `robust`",
        stability.steps_came_out,
        "",
    ),
    "stability_bulk": ("error due to locking against K/mu", stability.bulk_came_out, ""),
    "elements": (
        "linear, quadratic and mixed elements: error, estimated error, run time",
        elements.came_out,
        "uses only linear tetrahedra, and gives no error of the mesh",
    ),
    "liver_mesh": (
        "how exact is the displacement of the phantom? two meshes, linear and quadratic elements",
        elements.phantom,
        "",
    ),
    "moving_mesh": ("how exact is the estimate of the mesh's error for a moving body?", moving.came_out, ""),
    "liver_in_place": (
        "the phantom with capsule, ligaments, vessels and a plane, and its unloaded shape: what does each of them "
        "change?",
        bodies.in_place,
        "says that its liver lacks capsule, vessels and realistic boundary conditions",
    ),
    "indentation": (
        "a sphere on a layer: how wrong is the formula of a half-space, and how exact are modulus and contact point "
        "from noisy curves?",
        bodies.indented,
        "",
    ),
    "elastography": (
        "four stiff cylinders in a plate are found from waves (synthetic, exact series): errors, and coverage of "
        "intervals",
        identification.plate_came_out,
        "mentions elastography as a way to measure the liver of a patient",
    ),
    "liver_waves": (
        "a lesion in the liver phantom is found from waves of 60 Hz (synthetic): errors",
        identification.liver_waves_came_out,
        "mentions elastography as a way to measure the liver of a patient",
    ),
    "large_organ": (
        "waves in an organ that needs too much memory (synthetic): divided into parts, or means over voxels?",
        identification.large_organ_came_out,
        "mentions elastography as a way to measure the liver of a patient",
    ),
    "stability_rigs": (
        "error of simulated tension, indentation and creep tests against run time: mesh, elements",
        rigs.came_out,
        "",
    ),
    "reduced": (
        "a reduced model of the viscous liver: error, stated error and time per step",
        reduced.came_out,
        "compares its model with reduced bases, without errors",
    ),
    "reduced_porous": (
        "a reduced model of the complete liver (porous and viscous): error, stated error and time per step",
        reduced.porous_came_out,
        "compares its model with reduced bases, without errors",
    ),
    "reduced_quadratic": (
        "a reduced model of the viscous liver with quadratic elements: error, stated error and time per step",
        reduced.quadratic_came_out,
        "compares its model with reduced bases, without errors",
    ),
    "separated": (
        "the phantom at rest as a sum of products (proper generalised decomposition), compared with a reduced basis",
        reduced.separated_came_out,
        "compares its model with proper generalised decomposition, without numbers",
    ),
    "stability_cost": ("how much time does `robust` take if it is not needed?", stability.cost_came_out, ""),
    "laws_table": ("every law: error of its terms, run time and compilation time", _laws, ""),
    "curves_fit": (
        "which law fits brain and rubber in tension, compression and shear at once?",
        fits.curves,
        "curves of liver are published only as printed pictures",
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
        "| script | question | result | what the chapter says | minutes (empty: not timed) | minutes with `--quick` |",
        "|---" * 6 + "|",
    ]
    for name, (question, came_out, chapter) in ROWS.items():
        cells = (f"`{name}.py`", question, came_out(), chapter, minutes(name, "full"), minutes(name, "quick"))
        rows.append("| " + " | ".join(cells) + " |")
    return "\n".join(rows)


PARTS = {"overview": overview}
