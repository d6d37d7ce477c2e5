"""Table of the estimated mesh error in motion."""

from experiments.pages.results import load, percent


def came_out() -> str:
    """One line on the accuracy of the estimates."""
    (data,) = load("moving_mesh")
    rows = data["moving"]
    near = [r["effectivity"] for r in rows]
    left = {order: max(r["left"] for r in rows if r["order"] == order) for order in (1, 2)}
    return (
        f"the estimate is {min(near):.2g} to {max(near):.2g} of the error of a beam that swings; added, it leaves at "
        f"most {percent(left[1])} of it with linear elements, {percent(left[2])} with quadratic ones"
    )


def table() -> str:
    """Table of all rows."""
    (data,) = load("moving_mesh")
    rows = [
        "A beam is let go. Motion, error and estimate are of its end, root mean square over all steps; effectivity is",
        "the estimate over the error; left: what is still off with the estimate added, over the error. The truth is",
        f"864 quadratic elements with consistent masses, whose own last refinement moves it by "
        f"{percent(max(r['truth_m'] / r['motion_m'] for r in data['moving']))} at most.",
        "A body that falls freely has a closed form. With lumped masses few quadratic elements bend as they fall; the",
        "estimate knows it, 1.5 times too large: the factor is for what cubic functions do not show of other errors.",
        "",
        "| motion | elements | number | masses | motion | error | effectivity | left |",
        "|---" * 8 + "|",
    ]
    for r in [*data["falling"], *data["moving"]]:
        form = "linear" if r["order"] == 1 else "quadratic"
        name = r["case"] + (", implicit Euler" if r.get("integrator") == "euler" else "")
        exact = r["error_m"] < 1e-9 * r["motion_m"]
        near = " | " if exact else f"{r['effectivity']:.2f} | {percent(r['left'])}"
        off = "none" if exact else percent(r["error_m"] / r["motion_m"])
        rows.append(
            f"| {name} | {form} | {r['elements']} | {r['mass']} | {1e3 * r['motion_m']:.2g} mm | {off} | {near} |"
        )
    return "\n".join(rows)


PARTS = {"moving": table}
