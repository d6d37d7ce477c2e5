"""One line of results for each script on fits and on learning from runs."""

from experiments.pages.results import RESULTS, load, percent


def main_job() -> str:
    (jobs,) = load("main_job")
    found, closed = jobs["lions_mane"], jobs["lions_mane"]["closed_form"]
    moved = found["shear_modulus"] / closed["shear_modulus"] - 1
    sd = found["standard_errors"]["shear_modulus"] / found["shear_modulus"]
    return (
        f"{found['modes']} modes miss the measured moduli by {percent(found['mean_relative_error'])}; the simulation "
        f"moves G0 by {percent(abs(moved))} of itself (its standard error: {percent(sd)}); of {found['total_s']:.0f} s "
        f"in all, {found['compile_time_s']:.0f} s are compilation"
    )


def methods() -> str:
    (data,) = load("fit_methods")
    found = {r["name"]: r for r in data["exact"]}
    closed, simulated = (
        found[n] for n in ("closed form, Levenberg-Marquardt", "torsion, exponential recursion, 50 steps")
    )
    noisy = data["noisy"][0]["error"]
    return (
        f"closed form exact in {closed['run_s']:.2g} s; torsion at 50 steps a cycle {percent(simulated['error'])} in "
        f"{simulated['run_s']:.2g} s; 1 % of noise on the moduli costs {percent(noisy)} whichever way"
    )


def torsion_speed() -> str:
    (data,) = load("torsion_speed")
    measured, synthetic = data["lions_mane"], data["porcine_liver"]
    moduli = max(fit["largest_difference_of_a_modulus"] for fit in (measured, synthetic))
    errors, exact = (fit["distance_to_the_minimum_in_standard_errors"] for fit in (measured, synthetic))
    (compiled, compiled_before), (run, run_before) = measured["compile_s"], measured["evaluation_s"]
    return (
        f"moduli the same to {percent(moduli)} at every frequency; the minimum to {errors:.0e} standard errors (of "
        f"data without noise, whose errors are tiny, to {exact:.1g}); it compiles {compiled_before / compiled:.2g} "
        f"times and runs {run_before / run:.2g} times as fast"
    )


def posterior() -> str:
    (data,) = load("propagate_posterior")
    low, high = (1e3 * edge[-1] for edge in data["interval_m"])
    return (
        f"{high - low:.2g} mm of {1e3 * data['mean_m'][-1]:.3g}; "
        "first G0 and the short time, in the end G0 and its ratio"
    )


def training() -> str:
    (data,) = load("training_set")
    best = data["surrogate"][-1]
    mesh = data["mesh"]
    return (
        f"median error {percent(best['median_error'])}, near collapse {percent(best['largest_error'])}; the rows "
        f"themselves, of linear elements, are {percent(mesh['median'])} (median) off those of quadratic ones"
    )


def lesion() -> str:
    (data,) = load("lesion")
    r = next(r for r in data["rows"] if r["noise_of_largest"] == 0.01 and "sphere" in r)
    s = r["sphere"]
    return (
        f"at 1 % noise a map finds its centre to {r['centre_off_mm']:.2g} mm ({r['seconds']:.0f} s) but only "
        f"{percent(r['largest_modulus_over_truth'])} of its modulus; a sphere, begun from the map, its centre to "
        f"{s['centre_off_mm']:.2g} mm and its modulus to {percent(abs(s['modulus_off']))} ({s['seconds']:.0f} s)"
    )


def creep() -> str:
    (data,) = load("creep_and_sweep")
    sd = {r["tests"]: r["standard_errors"]["relaxation_times[0]"] for r in data["rows"]}
    return (
        f"the standard error of a relaxation time of {data['true'][4]:g} s outside the sweep's band falls from "
        f"{sd['sweep']:,.0f} s (not determined) to {sd['sweep + creep']:.2g} s with creep, "
        f"{sd['sweep + pull']:.2g} s with "
        f"a pull, {sd['sweep + creep + pull']:.2g} s with both"
    )


def coverage() -> str:
    if not (RESULTS / "coverage.json").exists():
        return "has not run"
    (data,) = load("coverage")
    rows = {r["disturbance"]: r for r in data["rows"]}

    def listed(name: str, key: str = "moduli") -> str:
        return ", ".join(f"{kind} {percent(value)}" for kind, value in rows[name][key].items())

    p, gap, squeezed = (rows[n]["parameters"] for n in ("noise", "gap", "compression"))
    return (
        f"{_by_the_program(data)}95 % intervals of the moduli cover the true ones by truth, where N modes or a "
        f"springpot beside a spring are fitted to {data['sweeps']:,} sweeps, with noise alone: {listed('noise')}; with "
        f"the "
        f"inertia off: {listed('inertia')}; with the gap off: {listed('gap')} (told of it "
        f"by `--gap-error`: {listed('gap', 'moduli_with_gap_error')}); trimmed under compression: "
        f"{listed('compression')}. Relaxation times of two modes: {percent(p['times'])}, with all disturbances "
        f"{percent(squeezed['times'])}; G0: {percent(p['G0'])}, with the gap off {percent(gap['G0'])}. "
        f"{_predicted_decades(data['prediction'])}"
    )


def _by_the_program(data: dict) -> str:
    if "program" not in data:
        return ""
    own = data["program"]["moduli"]

    def by(model: str) -> str:
        return ", ".join(f"{kind} {percent(found[model])}" for kind, found in own.items())

    return (
        f"with `--model auto`, 95 % intervals of the moduli cover the true ones by truth: {by('auto')} (without the "
        f"choice of the model among the errors {by('auto_alone')}); with N modes: "
        f"{by('prony')}; with `--model spectrum` a wide spectrum {percent(own['spectrum']['spectrum'])} "
        f"({data['program']['sweeps']} sweeps of each truth, noise alone). "
    )


def _predicted_decades(found: dict) -> str:
    if "last" not in found:
        return ""
    last, first = found["last"], found["first"]
    return (
        f"The model chosen on two decades predicts the last one better than the next different model in "
        f"{percent(last['better'])}, the first one in {percent(first['better'])} of {first['sweeps']} (where the "
        f"criterion decides, "
        f"{percent(last['better_where_decided'])} and {percent(first['better_where_decided'])}). Against the next "
        f"model of any kind, which mostly has the chosen one as a special case and says nearly the same, it "
        f"is {percent(last['better_than_any_second'])} and {percent(first['better_than_any_second'])}"
    )


def curves() -> str:
    brain, rubber = load("curves_brain", "curves_rubber")
    best = [min(data["laws"], key=lambda f: f["mean_relative_error"]) for data in (brain, rubber)]
    return " and ".join(
        f"{material}: {f['law']}, {percent(f['mean_relative_error'])}"
        for material, f in zip(("brain", "rubber"), best, strict=True)
    )
