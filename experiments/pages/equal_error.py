"""The table of all models at equal error, with the run time of a simulated second."""

import math

from experiments.pages.results import load, percent, short


def at_error(runs: list[dict], target: float) -> tuple[float, float] | None:
    """Return time step [s] and run time [s] at an error, interpolated between the two runs whose errors enclose it.

    The interpolation is linear in the logarithms. If the longest step of all meets the error, its values are returned.
    Returns None if no run meets the error.
    """
    before = None
    for run in sorted(runs, key=lambda r: -r["dt"]):
        error = math.inf if run["error"] is None else run["error"]
        if error <= target:
            if before is None or not math.isfinite(before["error"] or math.inf):
                return run["dt"], run["run_s"]
            part = math.log(before["error"] / target) / math.log(before["error"] / error)
            dt, run_s = (before[k] * (run[k] / before[k]) ** part for k in ("dt", "run_s"))
            return dt, run_s
        before = run
    return None


def ways(own: dict) -> dict[str, list[dict]]:
    """Return the runs, grouped by the name of their method."""
    found: dict[str, list[dict]] = {}
    for run in own["runs"]:
        found.setdefault(run["way"], []).append(run)
    return found


def cell(found: tuple[float, float] | None, seconds: float) -> str:
    """Return step, steps per second, and simulated seconds per second."""
    if found is None:
        return "- | - | -"
    dt, run_s = found
    return f"{short(1e3 * dt)} ms | {seconds / dt / run_s:,.0f} | {seconds / run_s:.2g}"


def came_out() -> str:
    """One line with the reduced, the full and the chapter's method for each model at the middle error."""
    (data,) = load("equal_error")
    target, told = sorted(data["targets"])[1], []
    for model, own in data["models"].items():
        met = {way: at_error(runs, target) for way, runs in ways(own).items()}
        speed = {way: data["seconds"] / found[1] for way, found in met.items() if found is not None}
        full = max((way for way in speed if "reduced" not in way), key=lambda way: speed[way])
        small, chapters = (next((f"{v:.2g}" for w, v in speed.items() if k in w), "-") for k in ("reduced", "chapter"))
        told.append(
            f"{model} {small} with a reduced model, {speed[full]:.2g} with the full model ({full}), {chapters} with "
            "the chapter's method"
        )
    return (
        f"simulated seconds per second of run time at an error of {percent(target)} (-: this error was not reached): "
        f"{'; '.join(told)}"
    )


def table() -> str:
    """Table of all models and methods at all targets, then the errors of linear and corotational bodies."""
    (data,) = load("equal_error")
    targets = sorted(data["targets"], reverse=True)
    rows = [
        "| model | method | smallest error | "
        + " | ".join(f"error {percent(t)}: step | steps per second | simulated seconds per second" for t in targets)
        + " |",
        "|---" * (3 + 3 * len(targets)) + "|",
    ]
    for model, own in data["models"].items():
        for way, runs in ways(own).items():
            least = min(r["error"] for r in runs if r["error"] is not None)
            cells = " | ".join(cell(at_error(runs, t), data["seconds"]) for t in targets)
            rows.append(f"| {model} | {way} | {percent(least)} | {cells} |")
    rows += ["", reduced(data), "", by_weight(data)]
    return "\n".join(rows)


def reduced(data: dict) -> str:
    """One line on the training of the reduced models, and on the error of the reference runs."""
    made = ", ".join(
        f"{model} {r['modes']} modes and {r['points']} points from {r['rows']} runs in {r['training_s']:.0f} s"
        for model, r in ((m, own["reduced"]) for m, own in data["models"].items())
    )
    truths = ", ".join(f"{model} {percent(own['truth_halved'])}" for model, own in data["models"].items())
    return f"Reduced models: {made}. With a step of twice the length, the reference solutions change by: {truths}."


def by_weight(data: dict) -> str:
    """Table of the errors of a linear and a corotational body, for each weight."""
    names = [name for name in data["weights"][0] if name != "weight"]
    rows = [
        "Errors of linear and corotational bodies, computed with the same short steps as the hyperelastic body, for "
        "several",
        "fractions of the load:",
        "",
        "| fraction of the load | " + " | ".join(names) + " |",
        "|---" * (1 + len(names)) + "|",
    ]
    rows += [
        f"| {percent(row['weight'])} | "
        + " | ".join("-" if row[name] is None else percent(row[name]) for name in names)
        + " |"
        for row in data["weights"]
    ]
    return "\n".join(rows)


PARTS = {"equal_error": table}
