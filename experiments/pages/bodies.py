"""Tables of the liver in its place and of indentation."""

from experiments.pages.results import load, percent


def in_place() -> str:
    """One line: what each part changes."""
    (data,) = load("liver_in_place")
    rest = [r for r in data["rest"] if r["order"] == 1 and r["converged"]]
    said = ", ".join(f"{r['name']} {1e3 * r['largest_m']:.1f} mm" for r in rest)
    u = data["unloaded"]
    return (
        f"largest displacement under a fifth of gravity: {said}; the unloaded shape in {u['run_s']:.2g} s, and back to "
        f"{u['back_m']:.0e} m"
    )


def indented() -> str:
    """One line: how wrong a half-space is, and what fits find."""
    (data,) = load("indentation")
    soft = {r["thickness"]: r for r in data["layers"] if r["poisson"] == 0.499}
    fits = data["fits"]
    moduli, covered = [r["modulus_off"] for r in fits], [r["modulus_covered"] for r in fits]
    return (
        f"a layer as thick as the contact's radius passes for {soft[1.0]['hertz']:.2g} times its modulus with Hertz, "
        f"one ten times as thick for {soft[10.0]['hertz']:.2g} times; with {percent(data['noise'])} of noise fits are "
        f"{percent(min(moduli))} to {percent(max(moduli))} off (median), intervals cover {percent(min(covered))} to "
        f"{percent(max(covered))}"
    )


def table() -> str:
    """Both tables."""
    return "\n".join([*_liver(), "", *_layers()])


def _liver() -> list[str]:
    (data,) = load("liver_in_place")
    rows = [
        "The liver phantom at rest under 2 m/s2, hyperelastic, four load steps. Quadratic elements on the same mesh",
        "tell what linear ones leave out; what the quadratic ones leave out is not known. Run times are of a busy",
        "machine:",
        "",
        "| held | elements | largest | mean | Newton a step | run | compile |",
        "|---" * 7 + "|",
    ]
    for r in data["rest"]:
        form = "linear" if r["order"] == 1 else "quadratic"
        found = f"{1e3 * r['largest_m']:.1f} mm | {1e3 * r['mean_m']:.1f} mm" if r["converged"] else "no solution | "
        times = f"{r['run_s']:.2g} s | {r['compile_s']:.2g} s"
        rows.append(f"| {r['name']} | {form} | {found} | {r['newton_per_step']:.1f} | {times} |")
    for r in data["rest"]:
        if "plane_N" in r and r["converged"] and r["name"] == "with plane":
            rows += ["", f"The plane carries {r['plane_N']:.2g} N; the surface is {1e6 * r['depth_m']:.2g} um in it."]
    u = data["unloaded"]
    rows += [
        "",
        f"The unloaded shape, of the phantom taken as loaded: {1e3 * u['largest_m']:.0f} mm away, found in "
        f"{u['run_s']:.2g} s; the run from it ends {u['back_m']:.0e} m from the given shape.",
        "",
        "In motion, let fall at once, steps of 0.05 s:",
        "",
        "| model | peak | run |",
        "|---|---|---|",
    ]
    for r in data["motion"]:
        peak = f"{1e3 * r['peak_m']:.0f} mm" if r["converged"] else "a step failed"
        rows.append(f"| {r['name']} | {peak} | {r['run_s']:.2g} s |")
    return rows


def _layers() -> list[str]:
    (data,) = load("indentation")
    ratios = sorted({r["thickness"] for r in data["layers"]})
    rows = [
        "A sphere on a bonded layer: modulus that Hertz's half-space finds over the true one, by the layer's thickness",
        "over the contact's radius sqrt(R d); in brackets the error of the force by the series of Dimitriadis et al.:",
        "",
        "| Poisson's ratio | " + " | ".join(f"{t:g}" for t in ratios) + " |",
        "|---" * (1 + len(ratios)) + "|",
    ]
    for poisson in sorted({r["poisson"] for r in data["layers"]}):
        own = {r["thickness"]: r for r in data["layers"] if r["poisson"] == poisson}
        cells = (f"{own[t]['hertz']:.3g} ({100 * own[t]['series_error']:+.2g} %)" for t in ratios)
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
