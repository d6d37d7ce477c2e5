"""Table of the reduced model of the liver, and of the models that the chapter weighs against its own."""

from experiments.pages.results import load, percent


def came_out() -> str:
    """One line: error, stated error, time a step."""
    (data,) = load("reduced")
    r = data["models"][-1]
    near = f"{percent(r['relative_median'])} in {r['runs']} unseen runs (95 % below {percent(r['relative_95'])})"
    return (
        f"{r['modes']} modes from {r['rows']} runs: {r['step_ms']:.2g} ms a step ({r['full_step_ms']:.2g} in full), "
        f"off by {near}; the stated error is right within a factor 2 in {percent(r['within_factor_2'])}"
    )


def table() -> str:
    """Both tables."""
    (data,) = load("reduced")
    rows = [
        f"The viscous phantom, {data['elements']:,} linear tetrahedra, 24 steps of 0.05 s; gravity, a pull at the",
        "tip, modulus, a ratio and a relaxation time are free (9 numbers). Errors are the largest distance of a node",
        "from the full model over its largest displacement, in runs from a box 10 % wider than that of the training.",
        "Times are of one core of a busy machine:",
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
    rows += [
        "",
        "The models that the chapter names, under the weight alone; the viscous full model is the truth. The first",
        "four have no viscosity:",
        "",
        "| model | error | error to the elastic model | a step of 0.05 s |",
        "|---|---|---|---|",
    ]
    for r in data["rivals"]:
        rows.append(
            f"| {r['model']} | {percent(r['error'])} | {percent(r['error_to_hyperelastic'])} | {r['step_ms']:.3g} ms |"
        )
    return "\n".join(rows)


PARTS = {"reduced": table}
