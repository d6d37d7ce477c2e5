"""Tables of precision, gradients, maps and waves."""

from experiments.pages.results import load, percent, short


def precision() -> str:
    """Table of float32 and float64: laws, cube, liver."""
    (data,) = load("precision")
    tetrahedra = data["laws"][0]["tetrahedra"]
    rows = [
        f"| law, {tetrahedra:,} tetrahedra | time, float64 | time, float32 | error of the force, float32 | "
        "error of the stiffness, float32 |",
        "|---" * 5 + "|",
    ]
    for r in data["laws"]:
        ms = " | ".join(f"{1e3 * r['seconds'][p]:.2g} ms" for p in ("float64", "float32"))
        rows.append(f"| `{r['law']}` | {ms} | {r['force_error']:.0e} | {r['stiffness_error']:.0e} |")
    rows += ["", "| model | precision | tolerance | residual | error | run time | status |", "|---" * 7 + "|"]
    for r in [{"model": "static cube"} | r for r in data["cube"]] + data["liver"]:
        residual = f"{r['residual']:.0e} | {r['error']:.0e} | {r['run_s']:.2g} s"
        rows.append(f"| {r['model']} | {r['precision']} | {r['tolerance']:.0e} | {residual} | {r['code']} |")
    return "\n".join(rows)


def jax_releases() -> str:
    """Table of the same programs with different releases of jax."""
    (data,) = load("jax_releases")
    head = (
        "| jax | torsion program: transposes before, after compilation; copies | run | compilation | complete liver | "
        "compilation |"
    )
    rows = [head, "|---" * 6 + "|"]
    for r in data["rows"]:
        t, liver = r["torsion"], r["liver"]
        size = f"{t['written_transposes']}, {t['compiled_transpose']}; {t['compiled_copy']}"
        times = f"{short(t['run_s'])} s | {t['compile_s']:.2g} s | {liver['steps_per_s']:.3g} steps/s"
        rows.append(f"| {r['jax']} | {size} | {times} | {liver['compile_s']:.2g} s |")
    return "\n".join(rows)


def gradients() -> str:
    """Table of all costs of a gradient."""
    (data,) = load("gradient_cost")
    rows = [
        "| model | tetrahedra | steps | `store` | run | gradient | gradient divided by run | memory | "
        "predicted memory |",
        "|---" * 9 + "|",
    ]
    for r in data["rows"]:
        memory = f"{r['planned_bytes'] / 1e6:.3g} MB | {r['predicted_bytes'] / 1e6:.3g} MB"
        times = f"{short(r['forward_s'])} s | {short(r['gradient_s'])} s | {r['ratio']:.3g}"
        rows.append(f"| {r['model']} | {r['tetrahedra']:,} | {r['steps']:,} | `{r['store']}` | {times} | {memory} |")
    return "\n".join(rows)


def lesion() -> str:
    """Table of all maps."""
    (data,) = load("lesion")
    rows = [
        "| noise | correlation length of the prior | chi2 per component | error of the centre | "
        "largest modulus divided by true modulus | error of ln(modulus), the same for a uniform body | run |",
        "|---" * 7 + "|",
    ]
    for r in data["rows"]:
        cells = (
            f"{100 * r['noise_of_largest']:g} %",
            f"{100 * r['length_m']:g} cm",
            f"{r['chi2_per_component']:.2f}",
            f"{r['centre_off_mm']:.2g} mm",
            percent(r["largest_modulus_over_truth"]),
            f"{r['rms_error_of_log_modulus']:.2f}, {r['rms_error_of_a_uniform_body']:.2f}",
            f"{r['seconds']:.0f} s",
        )
        rows.append("| " + " | ".join(cells) + " |")
    return "\n".join(rows)


def plate() -> str:
    """Return the guide's table: regions, map and direct inversion, with the true values."""
    (data,) = load("elastography")
    hertz = data["frequencies_Hz"]
    rows = [
        "In this example, a plate of 80 x 100 x 10 mm with a modulus of 3 kPa contains four cylinders of 10 kPa. The "
        "voxels are 2 mm long. The",
        "data come from the exact series for an unbounded medium, with "
        f"{percent(data['noise'])} of noise. The table contains storage moduli in kPa. Those of the regions are at "
        f"{', '.join(f'{h:g}' for h in hertz)} Hz, those of the map and of the direct inversion at {hertz[-1]:g} Hz:",
        "",
        "| | true value | regions ± standard error | median of the map ± standard deviation | "
        "median of the direct inversion |",
        "|---|---|---|---|---|",
    ]
    for r in data["rows"]:
        name = "plate" if r["radius_m"] is None else f"cylinder, radius {1e3 * r['radius_m']:g} mm"
        each = zip(r["storage_Pa"], r["standard_error_Pa"], strict=True)
        own = ", ".join(f"{1e-3 * value:.3g} ± {1e-3 * error:.2g}" for value, error in each)
        drawn, sd, direct = (1e-3 * r[key][-1] for key in ("map_median_Pa", "map_sd_Pa", "direct_median_Pa"))
        rows.append(f"| {name} | {1e-3 * r['true_storage_Pa']:g} | {own} | {drawn:.3g} ± {sd:.2g} | {direct:.3g} |")
    cover = data["covered_90"]
    rows += [
        "",
        f"On {data['environment']['cores']} cores the regions took {data['regions_s']:.0f} s and the map "
        f"{data['map_s']:.0f} s, with {data['unknowns']:,} unknowns at {len(hertz)} frequencies.",
        f"The 90 % intervals of the map contain the true storage modulus in {_span(cover['storage'])} of the voxels, "
        f"and the true loss modulus in {_span(cover['loss'])}. The map is smooth at edges. So its standard deviation "
        "near an edge is large: the position of the edge is known only within the correlation length of the prior. "
        "The next table gives the percentage of voxels whose interval contains the true storage modulus, by distance "
        "from the nearest edge:",
        "",
        "| " + " | ".join(_between(row) for row in cover["by_distance"]) + " |",
        "|" + len(cover["by_distance"]) * "---|",
        "| " + " | ".join(percent(row["storage"]) for row in cover["by_distance"]) + " |",
    ]
    return "\n".join(rows)


def _span(parts: list[float]) -> str:
    """Return the smallest and the largest fraction, or one number if both are printed alike."""
    return " to ".join(dict.fromkeys(percent(part) for part in (min(parts), max(parts))))


def _between(row: dict) -> str:
    """Return the range of distances of a row's voxels from the nearest edge."""
    low, high = (None if row[key] is None else 1e3 * row[key] for key in ("from_m", "to_m"))
    side = "inside" if high is not None and high <= 0 else "outside"
    ends = [abs(end) for end in (low, high) if end is not None]
    return f"{min(ends):g} to {max(ends):g} mm {side}" if len(ends) == 2 else f"more than {ends[0]:g} mm {side}"


def liver_waves_came_out() -> str:
    """Sentence for the overview."""
    (data,) = load("liver_waves")
    said = []
    for r in data["rows"]:
        true, own = complex(*r["true_Pa"]), complex(*r["regions_Pa"])
        drawn = complex(*r["map_median_Pa"])
        said.append(
            f"{r['name']} {percent(abs(own / true - 1))} with regions and {percent(abs(drawn / true - 1))} with a map"
        )
    return f"errors of the complex moduli with {percent(data['noise'])} of noise: {'; '.join(said)}"


def plate_came_out() -> str:
    """Sentence for the overview."""
    (data,) = load("elastography")
    said = []
    for r in data["rows"][1:]:
        off = [v / r["true_storage_Pa"] - 1 for v in r["storage_Pa"]]
        said.append(f"{1e3 * r['radius_m']:g} mm {percent(min(off))} to {percent(max(off))}")
    plain = data["rows"][0]
    off = [abs(v / plain["true_storage_Pa"] - 1) for v in plain["storage_Pa"]]
    return (
        f"the error of the storage modulus is at most {percent(max(off))} for the plate; for cylinders with these "
        f"radii it is: {', '.join(said)}; the 90 % intervals of the map contain the true value in "
        f"{percent(min(data['covered_90']['storage']))} of the voxels"
    )


def large_organ_came_out() -> str:
    """Sentence for the overview."""
    (data,) = load("large_organ")
    true, said = complex(*data["true_Pa"]), []
    for key, name in (("divided", "parts"), ("averaged", "means over 2 x 2 x 2 voxels")):
        r = data[key]
        said.append(
            f"{name}: modulus wrong by {percent(abs(complex(*r['modulus_Pa']) / true - 1))} (stated mesh bias "
            f"{percent(r['mesh_bias'])}), chi2 of the map {r['map_chi2']:.2f}, {r['seconds'] / 60:.1f} min, "
            f"{r['peak_GB']:.1f} GB"
        )
    return f"{data['voxels']:,} voxels, {data['voxels_in_a_wavelength']:.0f} per wavelength; {'; '.join(said)}"


PARTS = {"precision": precision, "jax_releases": jax_releases, "gradients": gradients, "lesion": lesion}
