"""One line of results for each script on fits and on learning from runs."""

from experiments.pages.results import RESULTS, load, percent


def main_job() -> str:
    (jobs,) = load("main_job")
    found, closed = jobs["lions_mane"], jobs["lions_mane"]["closed_form"]
    moved = found["shear_modulus"] / closed["shear_modulus"] - 1
    sd = found["standard_errors"]["shear_modulus"] / found["shear_modulus"]
    return (
        f"the moduli of {found['modes']} fitted modes differ from the measured ones by "
        f"{percent(found['mean_relative_error'])}; the simulation changes G0 by {percent(abs(moved))} (standard error "
        f"of G0: {percent(sd)}); of the {found['total_s']:.0f} s of run time, {found['compile_time_s']:.0f} s are "
        "compilation"
    )


def methods() -> str:
    (data,) = load("fit_methods")
    found = {r["name"]: r for r in data["exact"]}
    closed, simulated = (
        found[n] for n in ("closed form, Levenberg-Marquardt", "torsion, exponential recursion, 50 steps")
    )
    noisy = data["noisy"][0]["error"]
    return (
        f"the closed form is exact and takes {closed['run_s']:.2g} s; the torsion fit with 50 steps per cycle has an "
        f"error of {percent(simulated['error'])} and takes {simulated['run_s']:.2g} s; 1 % of noise in the moduli "
        f"causes an error of {percent(noisy)} with every method"
    )


def torsion_speed() -> str:
    (data,) = load("torsion_speed")
    measured, synthetic = data["lions_mane"], data["porcine_liver"]
    moduli = max(fit["largest_difference_of_a_modulus"] for fit in (measured, synthetic))
    errors, exact = (fit["distance_to_the_minimum_in_standard_errors"] for fit in (measured, synthetic))
    (compiled, compiled_before), (run, run_before) = measured["compile_s"], measured["evaluation_s"]
    return (
        f"the moduli differ by at most {percent(moduli)} at every frequency; the fitted parameters differ by "
        f"{errors:.0e} standard errors (by {exact:.1g} for data without noise, whose standard errors are tiny); "
        f"compilation is {compiled_before / compiled:.2g} times and the run {run_before / run:.2g} times as fast"
    )


def posterior() -> str:
    (data,) = load("propagate_posterior")
    low, high = (1e3 * edge[-1] for edge in data["interval_m"])
    return (
        f"the 95 % interval is {high - low:.2g} mm wide, at a mean of {1e3 * data['mean_m'][-1]:.3g} mm; at first most "
        "of this comes from G0 and the short relaxation time, at the end from G0 and the ratio of this time"
    )


def training() -> str:
    (data,) = load("training_set")
    best = data["surrogate"][-1]
    mesh = data["mesh"]
    return (
        f"the surrogate has a median error of {percent(best['median_error'])}, and an error of "
        f"{percent(best['largest_error'])} "
        f"near collapse; the training runs themselves use linear elements and differ from runs with quadratic elements "
        f"by {percent(mesh['median'])} (median)"
    )


def lesion() -> str:
    (data,) = load("lesion")
    r = next(r for r in data["rows"] if r["noise_of_largest"] == 0.01 and "sphere" in r)
    s = r["sphere"]
    return (
        f"with 1 % of noise, a map finds the centre with an error of {r['centre_off_mm']:.2g} mm in {r['seconds']:.0f} "
        f"s, but only {percent(r['largest_modulus_over_truth'])} of the modulus; the fit of a sphere, which starts "
        f"from the map, finds the centre with an error of {s['centre_off_mm']:.2g} mm and the modulus with an error of "
        f"{percent(abs(s['modulus_off']))} in {s['seconds']:.0f} s"
    )


def creep() -> str:
    (data,) = load("creep_and_sweep")
    sd = {r["tests"]: r["standard_errors"]["relaxation_times[0]"] for r in data["rows"]}
    return (
        f"the standard error of a relaxation time of {data['true'][4]:g} s outside the sweep's band falls from "
        f"{sd['sweep']:,.0f} s (not determined) to {sd['sweep + creep']:.2g} s with creep, "
        f"{sd['sweep + pull']:.2g} s with "
        f"a tension test, {sd['sweep + creep + pull']:.2g} s with both"
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
        f"{_by_the_program(data)}Fixed models (N modes, or a spring in parallel with a springpot) were fitted to "
        f"{data['sweeps']:,} sweeps of each material. The 95 % intervals of the moduli cover the true values in these "
        f"percentages of cases. With noise alone: {listed('noise')}; with an error of the inertia: "
        f"{listed('inertia')}; with an error of the gap: {listed('gap')} (with `--gap-error`: "
        f"{listed('gap', 'moduli_with_gap_error')}); with samples trimmed under compression: {listed('compression')}. "
        f"Intervals of the relaxation times of two modes: {percent(p['times'])}, with all disturbances "
        f"{percent(squeezed['times'])}. Intervals of G0: {percent(p['G0'])}, with an error of the gap "
        f"{percent(gap['G0'])}. {_predicted_decades(data['prediction'])}"
    )


def _by_the_program(data: dict) -> str:
    if "program" not in data:
        return ""
    own = data["program"]["moduli"]

    def by(model: str) -> str:
        return ", ".join(f"{kind} {percent(found[model])}" for kind, found in own.items())

    return (
        "For each kind of true material, this is how often the 95 % intervals of the moduli cover the true values "
        f"with noise alone ({data['program']['sweeps']} sweeps of each material). With `--model auto`: {by('auto')} "
        f"(without the uncertainty of the choice of the model: {by('auto_alone')}); with N modes: {by('prony')}; with "
        f"`--model spectrum` for a wide spectrum: {percent(own['spectrum']['spectrum'])}. "
    )


def _predicted_decades(found: dict) -> str:
    if "last" not in found:
        return ""
    last, first = found["last"], found["first"]
    return (
        "The model that is chosen from two decades predicts the last decade better than the next different model in "
        f"{percent(last['better'])} of {first['sweeps']} cases, and the first decade in {percent(first['better'])} "
        f"(where the criterion decides: {percent(last['better_where_decided'])} and "
        f"{percent(first['better_where_decided'])}). It is better than the next model of any kind in "
        f"{percent(last['better_than_any_second'])} and {percent(first['better_than_any_second'])}. This next model "
        "mostly contains the chosen model as a special case and predicts nearly the same moduli"
    )


def curves() -> str:
    brain, rubber = load("curves_brain", "curves_rubber")
    best = [min(data["laws"], key=lambda f: f["mean_relative_error"]) for data in (brain, rubber)]
    return " and ".join(
        f"{material}: {f['law']} (mean misfit {percent(f['mean_relative_error'])})"
        for material, f in zip(("brain", "rubber"), best, strict=True)
    )
