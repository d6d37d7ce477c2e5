"""Tables of the reduced models of the liver."""

from experiments.pages.results import load, percent


def came_out() -> str:
    """One line: error, stated error, time per step."""
    (data,) = load("reduced")
    r = data["models"][-1]
    near = f"{percent(r['relative_median'])} in {r['runs']} unseen runs (95 % below {percent(r['relative_95'])})"
    return (
        f"{r['modes']} modes from {r['rows']} runs: {r['step_ms']:.2g} ms a step ({r['full_step_ms']:.2g} in full), "
        f"off by {near}; the stated error is right within a factor 2 in {percent(r['within_factor_2'])}"
    )


def table() -> str:
    """Table of the viscous phantom: training, times, errors."""
    (data,) = load("reduced")
    rows = [
        f"The viscous phantom, {data['elements']:,} linear tetrahedra, 24 steps of 0.05 s; gravity, a pull at the",
        "tip, modulus, a ratio and a relaxation time are free (9 numbers). Errors are the largest distance of a node",
        "from the full model over its largest displacement, in runs from a box 10 % wider than that of the training.",
        "Times are of one core; that of the full step, from the same minutes, tells how busy it was:",
        "",
        "| training runs | training | modes | points | a step | full step | gradient over run | error: median | 95 % | "
        "largest | stated over true error | within a factor 2 |",
        "|---" * 12 + "|",
    ]
    for r in data["models"]:
        low, high = r["effectivity_range"]
        errors = " | ".join(percent(r[f"relative_{k}"]) for k in ("median", "95", "largest"))
        rows.append(
            f"| {r['rows']} | {r['training_s'] / 60:.1f} min | {r['modes']} | {r['points']} | {r['step_ms']:.2g} ms | "
            f"{r['full_step_ms']:.2g} ms | {r['gradient_over_run']:.1f} | {errors} | {low:.2g} to {high:.2g} | "
            f"{percent(r['within_factor_2'])} of {r['runs']} |"
        )
        if r["failed"]:
            rows += [
                "",
                f"In {r['failed']} of the runs a step failed, or its error was not found: the full model would run.",
            ]
        rows += ["", correction(r), "", identified(r)]
    return "\n".join(rows)


def correction(r: dict) -> str:
    """One line on the effect of the correction, and on its size as an estimate of the error without it."""
    low, high = r["change_effectivity_range"]
    without = f"{percent(r['uncorrected_median'])} (95 % below {percent(r['uncorrected_95'])})"
    return (
        f"{percent(r['within_half_percent'])} of the runs are off by at most 0.5 %. "
        f"Errors are those after the correction; without it they are {without}, and the size of the correction is "
        f"{low:.2g} to {high:.2g} of them: right within a factor 2 in {percent(r['change_within_factor_2'])}. With the "
        f"motion of all nodes and its error stated a step takes {r['answer_ms']:.2g} ms. Of {r['runs']} runs "
        f"{r['kept']} state an error of at most 1 %; the largest of these is {percent(r['kept_largest'])}."
    )


def identified(r: dict) -> str:
    """One line on parameters identified with the model, and on many runs at once with `vmap`."""
    errors = zip(r["identified"], r["identified_error"], r["identified_error_without_bias"], strict=True)
    each = "; ".join(f"`{name}` {percent(before)}, {percent(after)}" for name, before, after in errors)
    return (
        f"Identified through the model from full runs, these numbers are off by at most (first as found, then with "
        f"the bias subtracted, which one more full run states): {each}. A run takes "
        f"{r['iterations_per_step']:.2g} iterations a step; one of 64 lanes of `vmap` takes "
        f"{r['step_of_64_ms']:.2g} ms a step, compilation "
        f"{r['compile_s']:.2g} s."
    )


def porous_came_out() -> str:
    """One line: error, stated error, time per step."""
    (data,) = load("reduced_porous")
    made, r, took = data["training"], data["unseen"], data["times"]
    near = f"{percent(r['relative_median'])} in {r['runs']} unseen runs (largest {percent(r['relative_largest'])})"
    return (
        f"{made['modes']} modes and {made['pressures']} of pressure from {made['rows']} runs: {took['step_ms']:.2g} ms "
        f"a step ({took['full_step_ms']:.2g} in full), off by {near}; the stated error is right within a factor 2 in "
        f"{percent(r['within_factor_2'])}"
    )


def porous_table() -> str:
    """Table of the complete phantom: training, times, errors of motion and pressure."""
    (data,) = load("reduced_porous")
    made, r, took = data["training"], data["unseen"], data["times"]
    motion, plain, pressure = (
        " | ".join(percent(r[f"{kind}_{k}"]) for k in ("median", "95", "largest"))
        for kind in ("relative", "uncorrected", "pressure")
    )
    return "\n".join(
        [
            f"The complete phantom (porous and viscous), {made['elements']:,} linear tetrahedra, 24 steps of 0.05 s;",
            "the permeability and the bulk modulus of the sponge are free beside the 9 numbers above. Errors of the",
            "motion are over the largest displacement of the run, those of the pressure over its largest pressure:",
            "",
            "| training runs | training | modes | of pressure | points | a step | full step | gradient over run |",
            "|---" * 8 + "|",
            f"| {made['rows']} | {made['training_s'] / 60:.1f} min ({made['training_cpu_s'] / 60:.1f} CPU min) | "
            f"{made['modes']} | {made['pressures']} | {made['points']} | {took['step_ms']:.2g} ms | "
            f"{took['full_step_ms']:.2g} ms | {took['gradient_over_run']:.1f} |",
            "",
            f"| error in {r['runs']} unseen runs, {r['failed']} failed | median | 95 % | largest |",
            "|---|---|---|---|",
            f"| motion | {motion} |",
            f"| motion, not corrected | {plain} |",
            f"| pressure, not corrected | {pressure} |",
            "",
            porous_words(made, r, took),
        ]
    )


def porous_words(made: dict, r: dict, took: dict) -> str:
    """One line on stated errors of the test runs r, iterations, batches, and load of the machine."""
    low, high = r["effectivity_range"]
    least, most = r["change_effectivity_range"]
    of_motion, of_pressure = zip(*r["mesh_ratios"], strict=True)
    return (
        f"{percent(r['within_one_percent'])} of the runs are off by at most 1 %. The stated error is {low:.2g} to "
        f"{high:.2g} of the true one, within a factor 2 in {percent(r['within_factor_2'])}; that of the motion without "
        f"the correction is {least:.2g} to {most:.2g} of its own, in {percent(r['change_within_factor_2'])}. With the "
        f"motion of all nodes and its error a step takes {took['answer_ms']:.2g} ms. The full mesh, asked in "
        f"{len(of_motion)} runs, states {min(of_motion):.2g} to {max(of_motion):.2g} of the motion's error and "
        f"{min(of_pressure):.2g} to {max(of_pressure):.2g} of the pressure's. A run takes "
        f"{took['iterations_per_step']:.2g} iterations a step; one of {took['lanes']:,} lanes of `vmap` takes "
        f"{took['step_of_a_lane_ms']:.2g} ms a step. Times of steps are the processor's, for others ran beside: the "
        f"training took {made['training_s'] / made['training_cpu_s']:.1f} times as long as alone."
    )


def quadratic_came_out() -> str:
    """One line: error, stated error, time per step."""
    (data,) = load("reduced_quadratic")
    made, r, took = data["training"], data["unseen"], data["times"]

    def errors(kind: str) -> str:
        return f"{percent(r[f'{kind}_median'])} (largest {percent(r[f'{kind}_largest'])})"

    return (
        f"{made['modes']} modes from {made['runs']} runs: {took['step_ms']:.2g} ms a step "
        f"({took['full_step_ms']:.3g} in full); in {r['runs']} unseen runs off by {errors('uncorrected')}, and the "
        f"stated error is right within a factor 2 in {percent(r['change_within_factor_2'])}; corrected off by "
        f"{errors('relative')}, in {percent(r['within_factor_2'])}"
    )


def quadratic_table() -> str:
    """Table of the phantom with quadratic elements: training, times, errors."""
    (data,) = load("reduced_quadratic")
    made, r, took = data["training"], data["unseen"], data["times"]
    return "\n".join(
        [
            f"The viscous phantom, {made['elements']:,} quadratic tetrahedra, with a tenth of the weight and the pull",
            "above: from an eighth on, elements at the clamps turn inside out in the softest rows, and the full model",
            "refuses its own answer. Numbers, steps and errors as above:",
            "",
            "| training runs | training | modes | points | a step | full step | gradient over run |",
            "|---" * 7 + "|",
            f"| {made['runs']} of {made['rows']} rows | {made['training_s'] / 60:.1f} min "
            f"({made['training_cpu_s'] / 60:.1f} CPU min) | {made['modes']} | {made['points']} of "
            f"{made['of_points']:,} | {took['step_ms']:.2g} ms | {took['full_step_ms']:.3g} ms | "
            f"{took['gradient_over_run']:.1f} |",
            "",
            f"| error in {r['runs']} unseen runs, {r['failed']} failed | median | 95 % | largest | at most 0.5 % | "
            "stated over true error | within a factor 2 | a step, all nodes and the error stated |",
            "|---" * 8 + "|",
            quadratic_row("modes alone", r, ("uncorrected", "uncorrected_", "change_"), took["uncorrected_answer_ms"]),
            quadratic_row("corrected", r, ("relative", "", ""), took["answer_ms"]),
            "",
            quadratic_words(r, took),
        ]
    )


def quadratic_row(name: str, r: dict, kinds: tuple[str, str, str], step_ms: float) -> str:
    """Return a row with errors of the test runs r, with or without the correction, and the quality of the stated
    errors.
    """
    error, part, stated = kinds
    low, high = r[f"{stated}effectivity_range"]
    errors = " | ".join(percent(r[f"{error}_{k}"]) for k in ("median", "95", "largest"))
    return (
        f"| {name} | {errors} | {percent(r[f'{part}within_half_percent'])} | {low:.2g} to {high:.2g} | "
        f"{percent(r[f'{stated}within_factor_2'])} | {step_ms:.2g} ms |"
    )


def quadratic_words(r: dict, took: dict) -> str:
    """One line on the largest displacement and on iterations."""
    return (
        f"The largest displacement is {r['largest_displacement_mm']:.0f} mm. The error of the modes alone is stated by "
        f"the size of the correction. A run takes {took['iterations_per_step']:.2g} iterations a step. Times of steps "
        "are the processor's, of one core; tests of low priority ran beside the training."
    )


def separated_came_out() -> str:
    """One line on the error and the time of one evaluation."""
    (data,) = load("separated")
    best = min((r for r in data["models"] if r["model"] == "separated"), key=lambda r: r["error_largest"])
    near = f"off by {percent(best['error_largest'])} at most in {data['unseen']} unseen runs"
    took = f"an answer in {best['answer_us']:.2g} µs (full {1e-6 * data['full_us']:.2g} s)"
    return f"{best['terms']} terms from {best['runs']} runs: {took}, {near}"


def separated_table() -> str:
    """Table of separated forms on several grids, and of a reduced basis."""
    (data,) = load("separated")
    rows = [
        "The hyperelastic phantom at rest; modulus, bulk modulus and weight are free. Errors are the largest distance",
        f"of a node from the full model over its largest displacement, in {data['unseen']} unseen runs in the box.",
        f"A full run takes {1e-6 * data['full_us']:.2g} s. Times are of one core:",
        "",
        "| model | training runs | training | terms or modes | an answer | error: median | largest | stated: largest |",
        "|---" * 8 + "|",
    ]
    for r in data["models"]:
        stated = "-" if r["stated_largest"] is None else percent(r["stated_largest"])
        rows.append(
            f"| {r['model']} | {r['runs']} | {r['training_s']:.0f} s | {r['terms']} | {r['answer_us']:.3g} µs | "
            f"{percent(r['error_median'])} | {percent(r['error_largest'])} | {stated} |"
        )
    return "\n".join(rows)


PARTS = {
    "reduced": table,
    "reduced_porous": porous_table,
    "reduced_quadratic": quadratic_table,
    "separated": separated_table,
}
