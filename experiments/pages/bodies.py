"""Tables of the liver as in a body and of indentation."""

from experiments.pages.results import load, percent


def in_place() -> str:
    """One line on what each support changes."""
    (data,) = load("liver_in_place")
    rest = [r for r in data["rest"] if r["order"] == 1 and r["converged"]]
    said = ", ".join(f"{r['name']} {1e3 * r['largest_m']:.1f} mm" for r in rest)
    u = data["unloaded"][0]
    return (
        f"largest displacement under a fifth of gravity: {said}; the unloaded shape is found in {u['run_s']:.2g} s, "
        "and its loads bring it back to the given shape to within "
        f"{u['back_m']:.0e} m"
    )


def indented() -> str:
    """One line on the error of a half-space, and on the results of fits."""
    (data,) = load("indentation")
    soft = {r["thickness"]: r for r in data["layers"] if r["poisson"] == 0.5}
    fits = data["fits"]
    moduli, covered = [r["modulus_off"] for r in fits], [r["modulus_covered"] for r in fits]
    return (
        f"a layer as thick as the contact's radius passes for {soft[1.0]['hertz']:.2g} times its modulus with Hertz, "
        f"one ten times as thick for {soft[10.0]['hertz']:.2g} times; with {percent(data['noise'])} of noise fits are "
        f"{percent(min(moduli))} to {percent(max(moduli))} off (median), intervals cover {percent(min(covered))} to "
        f"{percent(max(covered))}"
    )


def table() -> str:
    """Return both tables."""
    return "\n".join([*_liver(), "", *_layers()])


def _liver() -> list[str]:
    (data,) = load("liver_in_place")
    rows = [
        "The liver phantom at rest under 2 m/s2, hyperelastic, four load steps. The tip is the node that moves most by",
        "itself; beside it what the mesh's estimate adds. Quadratic elements on the same mesh tell if it is right;",
        "with them no solution was found where there is a thin capsule, which wrinkles. Estimates and runs in",
        "motion were timed beside a dozen other jobs, about fifteen times as long as on two free cores:",
        "",
        "| held | elements | largest | mean | tip | the mesh adds | Newton a step | run | compile | estimate |",
        "|---" * 10 + "|",
    ]
    for r in data["rest"]:
        form = "linear" if r["order"] == 1 else "quadratic"
        found = f"{_mm(r['largest_m'])} | {_mm(r['mean_m'])}" if r["converged"] else "no solution | "
        times = f"{r['run_s']:.2g} s | {r['compile_s']:.2g} s | {_seconds(r)}"
        rows.append(f"| {r['name']} | {form} | {found} | {_tip(r)} | {r['newton_per_step']:.1f} | {times} |")
    for r in data["rest"]:
        if "plane_N" in r and r["converged"] and r["name"] == "with plane":
            rows += ["", f"The plane carries {r['plane_N']:.2g} N; the surface is {1e6 * r['depth_m']:.2g} um in it."]
    rows.append("")
    for u in data["unloaded"]:
        rows.append(
            f"The unloaded shape of the phantom as loaded, {u['name']}: {1e3 * u['largest_m']:.2g} mm away, found "
            f"in {u['run_s']:.2g} s; the run from it ends {u['back_m']:.0e} m from the given shape."
        )
    rows += [
        "",
        "In motion, let fall at once, steps of 0.05 s; the tip at its peak. The estimate of the complete model fails",
        "in some steps. With all parts its equations have negative curvature: the capsule is pressed together in its",
        "plane and has no stiffness against bending, and quadratic functions can wrinkle between the vertices. Along",
        "the direction that conjugate gradients met, the capsule lost more than the body held. Held at two places, the",
        "change turns elements inside out from the third step on.",
        "These estimates used richer elements, without the fluid's pressures. Scenes with a fluid and without vessels",
        "are now estimated on a finer mesh: this table has not been run again since.",
        "",
        "| model | elements | peak | tip | the mesh adds | fluid's pressure | run | estimate |",
        "|---" * 8 + "|",
    ]
    for r in [*data["motion"], *data.get("finer", [])]:
        peak = f"{_mm(r['peak_m'])} | {_tip(r)}" if r["converged"] else "a step failed | | "
        pressure = f"{r['least_Pa']:.0f} to {r['greatest_Pa']:.0f} Pa" if "least_Pa" in r else "none"
        form = "quadratic" if r.get("order") == 2 else "linear"
        run = f"{r['run_s']:.0f}" if r["run_s"] > 10 else f"{r['run_s']:.2g}"
        rows.append(f"| {r['name']} | {form} | {peak} | {pressure} | {run} s | {_seconds(r)} |")
    return [*rows, "", *_finer(data), *_clamps(data), *_claim(data["motion"])]


def _finer(data: dict) -> list[str]:
    """Line on what quadratic elements change in motion."""
    linear, found = {r["name"]: r for r in data["motion"]}, []
    for r in data.get("finer", []):
        if r["converged"]:
            more = r["peak_m"] / linear[r["name"]]["peak_m"] - 1
            found.append(f"{r['name']}: the peak is {percent(more)} higher, the step was cut {r['cuts']} times")
        else:
            found.append(f"{r['name']}: a step failed")
    return [f"Quadratic elements on the same mesh, in motion: {'; '.join(found)}.", ""] if found else []


def _clamps(data: dict) -> list[str]:
    """Line on why quadratic elements fail where the phantom is fixed at two regions only."""
    said = [
        f"{r['name']}: {r['elements']} at {r['time_s']:.2g} s, all within {_mm(r['away_m'])} of a held node; a "
        f"place carries {r['mean_Pa']:.0f} Pa on average; the law allows a volume of 0 at {r['gone_Pa']:.0f} Pa"
        for r in data.get("clamps", [])
    ]
    why = (
        "Held at two places, quadratic elements are pressed inside out at the edges of the clamps. There the pressure "
        "is several times the mean, and the energies of the volume are finite where it is gone. Half the time step "
        "and robust steps end the same. Elements inside out: "
    )
    return [f"{why}{'; '.join(said)}.", ""] if said else []


def _mm(length: float) -> str:
    return f"{1e3 * length:.1f} mm"


def _tip(r: dict) -> str:
    """Return two cells: the displacement of the tip, and its correction by the mesh error estimate."""
    tip = _mm(r["tip_m"]) if "tip_m" in r else ""
    if "mesh_m" not in r:
        return f"{tip} | "
    return f"{tip} | " + (f"{1e3 * r['mesh_m']:+.2g} mm" if r["mesh_found"] else "no estimate: a step of it failed")


def _seconds(r: dict) -> str:
    return f"{r['mesh_s']:.0f} s" if "mesh_s" in r else ""


def _claim(motion: list[dict]) -> list[str]:
    """Lines on the chapter's claim on porosity and viscosity, without and with all supports."""
    peaks = {r["name"]: r["peak_m"] for r in motion}
    said = []
    for where in ("held at two places", "with all"):
        own = {name.partition(",")[0]: peak for name, peak in peaks.items() if name.endswith(where)}
        if {"hyperelastic", "viscous", "porohyperelastic", "complete"} <= set(own):
            said.append(
                f"{where}: viscosity takes the peak from {_mm(own['hyperelastic'])} to {_mm(own['viscous'])}, fluid "
                f"from "
                f"{_mm(own['hyperelastic'])} to {_mm(own['porohyperelastic'])} and, of the viscous one, to "
                f"{_mm(own['complete'])}"
            )
    if not said:
        return []
    claim = "The chapter says that porosity prevents unrealistic deformations. With the numbers of its Table 2, "
    return [claim + "; ".join(said) + "."]


def _layers() -> list[str]:
    (data,) = load("indentation")
    ratios = sorted({r["thickness"] for r in data["layers"]})
    rows = [
        "A sphere on a bonded layer: modulus that Hertz's half-space finds over the true one, by the layer's thickness",
        "over the contact's radius sqrt(R d); in brackets the error of the force by the series of Dimitriadis et al.",
        "(equation 12, for an incompressible layer):",
        "",
        "| Poisson's ratio | " + " | ".join(f"thickness {t:g}" for t in ratios) + " |",
        "|---" * (1 + len(ratios)) + "|",
    ]
    for poisson in sorted({r["poisson"] for r in data["layers"]}):
        own = {r["thickness"]: r for r in data["layers"] if r["poisson"] == poisson}
        cells = (
            f"{own[t]['hertz']:.3g}" + (f" ({100 * own[t]['series_error']:+.2g} %)" if "series_error" in own[t] else "")
            for t in ratios
        )
        rows.append(f"| {poisson:g} | " + " | ".join(cells) + " |")
    rows += [
        "",
        f"Fits of curves with {percent(data['noise'])} of noise, modulus and contact point together (Poisson 0.5):",
        "",
        "| thickness | curves | modulus off (median) | covered | contact point off, of the depth | covered | a curve |",
        "|---" * 7 + "|",
    ]
    for r in data["fits"]:
        point = f"{percent(r['contact_point_off'])} | {percent(r['contact_point_covered'])}"
        modulus = f"{percent(r['modulus_off'])} | {percent(r['modulus_covered'])}"
        rows.append(f"| {r['thickness']:g} | {r['curves']:,} | {modulus} | {point} | {1e3 * r['seconds']:.0f} ms |")
    return rows


PARTS = {"bodies": table}
