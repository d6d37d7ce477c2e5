"""Tables of the reduced models of the liver."""

from experiments.pages.results import load, percent


def came_out() -> str:
    """One line: error, stated error, time per step."""
    (data,) = load("reduced")
    r = data["models"][-1]
    near = (
        f"{percent(r['relative_median'])} in {r['runs']} unseen runs (95 % of them: below {percent(r['relative_95'])})"
    )
    return (
        f"with {r['modes']} modes from {r['rows']} training runs, a step takes {r['step_ms']:.2g} ms (full model: "
        f"{r['full_step_ms']:.2g} ms); the median error is {near}; the stated error is right within a factor of 2 in "
        f"{percent(r['within_factor_2'])} of the runs"
    )


def table() -> str:
    """Table of the viscous phantom: training, times, errors."""
    (data,) = load("reduced")
    rows = [
        f"The viscous phantom has {data['elements']:,} linear tetrahedra and moves for 24 steps of 0.05 s. Gravity, a "
        "pull at the",
        "tip, the modulus, a ratio and a relaxation time may change (9 numbers). The error is the largest distance of "
        "a node",
        "from the full model, divided by the largest displacement of the full model. The parameters of these unseen "
        "runs lie in ranges that are 10 % wider than in the training.",
        "Times are for one core. The step of the full model was timed in the same minutes; it shows how busy the core "
        "was:",
        "",
        "| training runs | training | modes | points | time of a step | step of the full model | time of gradient "
        "divided by time of run | error: median | 95 % of runs below | largest | stated error divided by true error | "
        "stated error right within a factor of 2 |",
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
                f"In {r['failed']} of the runs a step failed, or its error could not be computed. The program would "
                "then run the full model.",
            ]
        rows += ["", correction(r), "", identified(r)]
    return "\n".join(rows)


def correction(r: dict) -> str:
    """One line on the effect of the correction, and on its size as an estimate of the error without it."""
    low, high = r["change_effectivity_range"]
    without = f"{percent(r['uncorrected_median'])} (95 % below {percent(r['uncorrected_95'])})"
    return (
        f"{percent(r['within_half_percent'])} of the runs have an error of at most 0.5 %. These errors include the "
        f"correction. Without the correction the median error is {without}, and its estimate is the size of the "
        f"correction. This size is {low:.2g} to {high:.2g} times the true error, and right within a factor of 2 in "
        f"{percent(r['change_within_factor_2'])} of the runs. A step takes {r['answer_ms']:.2g} ms if the motion of "
        f"all nodes and the stated error are computed too. In {r['kept']} of {r['runs']} runs the stated error is at "
        f"most 1 %. The largest true error of these runs is {percent(r['kept_largest'])}."
    )


def identified(r: dict) -> str:
    """One line on parameters identified with the model, and on many runs at once with `vmap`."""
    errors = zip(r["identified"], r["identified_error"], r["identified_error_without_bias"], strict=True)
    each = "; ".join(f"`{name}` {percent(before)}, {percent(after)}" for name, before, after in errors)
    return (
        f"These parameters were identified from full runs with the reduced model. Their largest errors are (first as "
        f"found, then with the bias subtracted that one further full run estimates): {each}. A run takes "
        f"{r['iterations_per_step']:.2g} iterations per step. With `vmap` over 64 runs, a step of one run takes "
        f"{r['step_of_64_ms']:.2g} ms, and compilation takes {r['compile_s']:.2g} s."
    )


def porous_came_out() -> str:
    """One line: error, stated error, time per step."""
    (data,) = load("reduced_porous")
    made, r, took = data["training"], data["unseen"], data["times"]
    near = f"{percent(r['relative_median'])} in {r['runs']} unseen runs (largest {percent(r['relative_largest'])})"
    return (
        f"with {made['modes']} modes of the motion and {made['pressures']} modes of the pressure from {made['rows']} "
        f"training runs, a step takes {took['step_ms']:.2g} ms (full model: {took['full_step_ms']:.2g} ms); the median "
        f"error is {near}; the stated error is right within a factor of 2 in {percent(r['within_factor_2'])} of the "
        "runs"
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
            f"The complete phantom (porous and viscous) has {made['elements']:,} linear tetrahedra and moves for 24 "
            "steps of 0.05 s.",
            "The permeability and the bulk modulus of the porous body may change, besides the 9 numbers above. Errors "
            "of the",
            "motion are divided by the largest displacement of the run, errors of the pressure by its largest "
            "pressure:",
            "",
            "| training runs | training | modes of the motion | modes of the pressure | points | time of a step | "
            "step of the full model | time of gradient divided by time of run |",
            "|---" * 8 + "|",
            f"| {made['rows']} | {made['training_s'] / 60:.1f} min ({made['training_cpu_s'] / 60:.1f} CPU min) | "
            f"{made['modes']} | {made['pressures']} | {made['points']} | {took['step_ms']:.2g} ms | "
            f"{took['full_step_ms']:.2g} ms | {took['gradient_over_run']:.1f} |",
            "",
            f"| error in {r['runs']} unseen runs ({r['failed']} failed) | median | 95 % of runs below | largest |",
            "|---|---|---|---|",
            f"| motion | {motion} |",
            f"| motion without the correction | {plain} |",
            f"| pressure (never corrected) | {pressure} |",
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
        f"{percent(r['within_one_percent'])} of the runs have an error of at most 1 %. The stated error is {low:.2g} "
        f"to {high:.2g} times the true error, and right within a factor of 2 in {percent(r['within_factor_2'])} of the "
        f"runs. Without the correction, the stated error of the motion is {least:.2g} to {most:.2g} times the true "
        f"error, and right within a factor of 2 in {percent(r['change_within_factor_2'])}. A step takes "
        f"{took['answer_ms']:.2g} ms if the motion of all nodes and its stated error are computed too. In "
        f"{len(of_motion)} runs the error was also estimated on the full mesh (`reduced_error`). This estimate is "
        f"{min(of_motion):.2g} to {max(of_motion):.2g} times the error of the motion and {min(of_pressure):.2g} to "
        f"{max(of_pressure):.2g} times the error of the pressure. A run takes {took['iterations_per_step']:.2g} "
        f"iterations per step. With `vmap` over {took['lanes']:,} runs, a step of one run takes "
        f"{took['step_of_a_lane_ms']:.2g} ms. Times of steps are processor times, because other jobs were running. For "
        f"the same reason the training took {made['training_s'] / made['training_cpu_s']:.1f} times as long as alone."
    )


def quadratic_came_out() -> str:
    """One line: error, stated error, time per step."""
    (data,) = load("reduced_quadratic")
    made, r, took = data["training"], data["unseen"], data["times"]

    def errors(kind: str) -> str:
        return f"{percent(r[f'{kind}_median'])} (largest {percent(r[f'{kind}_largest'])})"

    return (
        f"with {made['modes']} modes from {made['runs']} training runs, a step takes {took['step_ms']:.2g} ms (full "
        f"model: {took['full_step_ms']:.3g} ms); in {r['runs']} unseen runs, the median error without the correction "
        f"is {errors('uncorrected')}, and the stated error is right within a factor of 2 in "
        f"{percent(r['change_within_factor_2'])}; with the correction, the median error is {errors('relative')}, and "
        f"the stated error is right within a factor of 2 in {percent(r['within_factor_2'])}"
    )


def quadratic_table() -> str:
    """Table of the phantom with quadratic elements: training, times, errors."""
    (data,) = load("reduced_quadratic")
    made, r, took = data["training"], data["unseen"], data["times"]
    return "\n".join(
        [
            f"The viscous phantom has {made['elements']:,} quadratic tetrahedra. Its weight and the pull are a tenth "
            "of those",
            "above. With an eighth or more, elements at the fixed regions are inverted in the softest bodies, and the "
            "status of the full model",
            "shows that the run failed. Parameters, steps and errors are as above:",
            "",
            "| training runs | training | modes | points | time of a step | step of the full model | time of gradient "
            "divided by time of run |",
            "|---" * 7 + "|",
            f"| {made['runs']} of {made['rows']} rows | {made['training_s'] / 60:.1f} min "
            f"({made['training_cpu_s'] / 60:.1f} CPU min) | {made['modes']} | {made['points']} of "
            f"{made['of_points']:,} | {took['step_ms']:.2g} ms | {took['full_step_ms']:.3g} ms | "
            f"{took['gradient_over_run']:.1f} |",
            "",
            f"| error in {r['runs']} unseen runs ({r['failed']} failed) | median | 95 % of runs below | largest | runs "
            "with at most 0.5 % | stated error divided by true error | stated error right within a factor of 2 | time "
            "of a step with all nodes and the stated error |",
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
        f'The largest displacement is {r["largest_displacement_mm"]:.0f} mm. "Modes alone" means without the '
        "correction; the size of the correction is then the stated error. A run takes "
        f"{took['iterations_per_step']:.2g} iterations per step. Times of steps are processor times of one core. Tests "
        "of low priority were running during the training."
    )


def separated_came_out() -> str:
    """One line on the error and the time of one evaluation."""
    (data,) = load("separated")
    best = min((r for r in data["models"] if r["model"] == "separated"), key=lambda r: r["error_largest"])
    near = f"the error is at most {percent(best['error_largest'])} in {data['unseen']} unseen runs"
    took = f"one evaluation takes {best['answer_us']:.2g} µs (full run: {1e-6 * data['full_us']:.2g} s)"
    return f"with {best['terms']} terms from {best['runs']} training runs, {took}; {near}"


def separated_table() -> str:
    """Table of separated forms on several grids, and of a reduced basis."""
    (data,) = load("separated")
    rows = [
        "The hyperelastic phantom is at rest. Shear modulus, bulk modulus and gravity differ between the runs. "
        "The error is the largest distance",
        f"of a node from the full model, divided by the largest displacement of the full model, in {data['unseen']} "
        "unseen runs within the ranges of the training.",
        f"A full run takes {1e-6 * data['full_us']:.2g} s. Times are for one core:",
        "",
        "| model | training runs | training | terms or modes | time of one evaluation | error: median | error: "
        "largest | stated error: largest |",
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
