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
        "and the loads deform it into the given shape with an error of "
        f"{u['back_m']:.0e} m"
    )


def indented() -> str:
    """One line on the error of a half-space, and on the results of fits."""
    (data,) = load("indentation")
    soft = {r["thickness"]: r for r in data["layers"] if r["poisson"] == 0.5}
    fits = data["fits"]
    moduli, covered = [r["modulus_off"] for r in fits], [r["modulus_covered"] for r in fits]
    return (
        f"for a layer as thick as the contact radius, Hertz's formula gives {soft[1.0]['hertz']:.2g} times the true "
        f"modulus, for a layer ten times as thick {soft[10.0]['hertz']:.2g} times; with {percent(data['noise'])} of "
        f"noise the error of fits is {percent(min(moduli))} to {percent(max(moduli))} (median), and 95 % intervals "
        f"cover the true modulus in {percent(min(covered))} to {percent(max(covered))} of cases"
    )


def table() -> str:
    """Return both tables."""
    return "\n".join([*_liver(), "", *_layers()])


def _liver() -> list[str]:
    (data,) = load("liver_in_place")
    rows = [
        'The hyperelastic liver phantom is at rest under gravity of 2 m/s2, applied in four load steps. "Held at two '
        'places" means that only two regions of the surface are fixed. The tip is the node that moves most in this '
        "case.",
        '"The mesh adds" is the estimated error of the mesh at the tip. Quadratic elements on the same mesh show if '
        "this estimate is right.",
        "With quadratic elements no solution was found with the thin capsule, because it wrinkles. Estimates and runs "
        "in",
        "motion were timed while a dozen other jobs were running, and took about fifteen times as long as on two free "
        "cores:",
        "",
        "| supports | elements | largest displacement | mean | tip | the mesh adds | Newton iterations per step | run "
        "| compilation | estimate |",
        "|---" * 10 + "|",
    ]
    for r in data["rest"]:
        form = "linear" if r["order"] == 1 else "quadratic"
        found = f"{_mm(r['largest_m'])} | {_mm(r['mean_m'])}" if r["converged"] else "no solution | "
        times = f"{r['run_s']:.2g} s | {r['compile_s']:.2g} s | {_seconds(r)}"
        rows.append(f"| {r['name']} | {form} | {found} | {_tip(r)} | {r['newton_per_step']:.1f} | {times} |")
    for r in data["rest"]:
        if "plane_N" in r and r["converged"] and r["name"] == "with plane":
            rows += [
                "",
                f"The plane carries {r['plane_N']:.2g} N. The surface enters it by {1e6 * r['depth_m']:.2g} um.",
            ]
    rows.append("")
    for u in data["unloaded"]:
        rows.append(
            f"The given shape is now assumed to be the loaded shape ({u['name']}). The unloaded shape differs from it "
            f"by {1e3 * u['largest_m']:.2g} mm and is found in {u['run_s']:.2g} s. Its loads deform it into the given "
            f"shape with an error of {u['back_m']:.0e} m."
        )
    rows += [
        "",
        "The next table is for the motion after gravity is switched on suddenly, in steps of 0.05 s. The displacement "
        "of the tip is its peak. The estimate of the complete model fails",
        "in some steps. With all supports, the energy in its equations has directions of negative curvature. The "
        "reason is that the capsule is compressed in its",
        "plane and has no bending stiffness, and quadratic functions can wrinkle between the vertices. In",
        "the direction that the conjugate gradients found, the energy of the capsule decreases by more than the "
        "energy of the body increases. If the phantom is held at two places, the",
        "estimated change inverts elements from the third step on.",
        "These estimates used elements of the next higher order, without the error of the fluid's pressures. For "
        "scenes with a fluid and without vessels,",
        "the program now uses a finer mesh instead. This table has not been computed again since then.",
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
            found.append(f"{r['name']}: the peak is {percent(more)} higher, and the step was cut {r['cuts']} times")
        else:
            found.append(f"{r['name']}: a step failed")
    return [f"Quadratic elements on the same mesh, in motion: {'; '.join(found)}.", ""] if found else []


def _clamps(data: dict) -> list[str]:
    """Line on why quadratic elements fail where the phantom is fixed at two regions only."""
    said = [
        f"{r['name']}: {r['elements']} at {r['time_s']:.2g} s, all within {_mm(r['away_m'])} of a fixed node, where a "
        f"fixed region carries {r['mean_Pa']:.0f} Pa on average and the law reaches a volume of 0 at "
        f"{r['gone_Pa']:.0f} Pa"
        for r in data.get("clamps", [])
    ]
    why = (
        "If the phantom is held at two places, quadratic elements are inverted at the edges of the fixed regions. "
        "There the pressure is several times the mean, and the volumetric energies are finite at a volume of 0. Half "
        "the time step and `robust` give the same result. Numbers of inverted elements: "
    )
    return [f"{why}{'; '.join(said)}.", ""] if said else []


def _mm(length: float) -> str:
    return f"{1e3 * length:.1f} mm"


def _tip(r: dict) -> str:
    """Return two cells: the displacement of the tip, and its correction by the mesh error estimate."""
    tip = _mm(r["tip_m"]) if "tip_m" in r else ""
    if "mesh_m" not in r:
        return f"{tip} | "
    return f"{tip} | " + (
        f"{1e3 * r['mesh_m']:+.2g} mm" if r["mesh_found"] else "no estimate, because one of its steps failed"
    )


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
                f"{where}: viscosity changes the peak of the elastic body from {_mm(own['hyperelastic'])} to "
                f"{_mm(own['viscous'])}; the fluid changes the peak of the elastic body from "
                f"{_mm(own['hyperelastic'])} to {_mm(own['porohyperelastic'])} and that of the viscous body to "
                f"{_mm(own['complete'])}"
            )
    if not said:
        return []
    claim = "The chapter says that porosity prevents unrealistic deformations. Results with its Table 2, "
    return [claim + "; ".join(said) + "."]


def _layers() -> list[str]:
    (data,) = load("indentation")
    ratios = sorted({r["thickness"] for r in data["layers"]})
    rows = [
        "The next table is for a sphere on a bonded layer. It contains the modulus that Hertz's formula for a "
        "half-space gives, divided by the true modulus. The thickness of the layer is divided",
        "by the contact radius sqrt(R d). The series of Dimitriadis et al. (equation 12, for an incompressible layer) "
        "also gives a force.",
        "The numbers in brackets are the relative errors of this force:",
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
        f"Fits of modulus and contact point to curves with {percent(data['noise'])} of noise (Poisson's ratio 0.5). "
        "Intervals are those of 95 %:",
        "",
        "| thickness | curves | error of the modulus (median) | intervals that contain the modulus | error of the "
        "contact point divided by the depth | intervals that contain the contact point | time per curve |",
        "|---" * 7 + "|",
    ]
    for r in data["fits"]:
        point = f"{percent(r['contact_point_off'])} | {percent(r['contact_point_covered'])}"
        modulus = f"{percent(r['modulus_off'])} | {percent(r['modulus_covered'])}"
        rows.append(f"| {r['thickness']:g} | {r['curves']:,} | {modulus} | {point} | {1e3 * r['seconds']:.0f} ms |")
    return rows


PARTS = {"bodies": table}
