"""Table of the estimated mesh error in motion."""

from experiments.pages.results import load, percent


def came_out() -> str:
    """One line on the accuracy of the estimates."""
    (data,) = load("moving_mesh")
    rows = data["moving"]
    near = [r["effectivity"] for r in rows]
    left = {order: max(r["left"] for r in rows if r["order"] == order) for order in (1, 2)}
    return (
        f"for a swinging beam, the estimated error is {min(near):.2g} to {max(near):.2g} times the true error; with "
        f"the estimate added, at most {percent(left[1])} of the error remain with linear elements, {percent(left[2])} "
        "with quadratic elements"
    )


def table() -> str:
    """Table of all rows."""
    (data,) = load("moving_mesh")
    rows = [
        "A beam is released. Motion, error and estimate are those of its end (root mean square over all steps). "
        "Effectivity is",
        "the estimate divided by the error. The remaining error is the error with the estimate added, divided by the "
        "error without it. The reference solution is that of",
        f"864 quadratic elements with consistent masses. The last refinement of this mesh changed it by "
        f"{percent(max(r['truth_m'] / r['motion_m'] for r in data['moving']))} at most.",
        "The motion of a freely falling body has a closed form. With lumped masses, a body of few quadratic elements "
        "bends while it falls. The",
        "estimate shows this error, but it is 1.5 times too large. The reason: the estimate is multiplied by 1.5, "
        "because in other problems cubic functions show two thirds of the error.",
        "",
        "| case | elements | number of elements | masses | motion | error | effectivity | remaining error |",
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
