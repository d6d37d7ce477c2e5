"""Tables of precision, gradients and maps."""

from experiments.pages.results import load, percent, short


def precision() -> str:
    """float32 beside float64: laws, cube, liver."""
    (data,) = load("precision")
    tetrahedra = data["laws"][0]["tetrahedra"]
    rows = [
        f"| law, {tetrahedra:,} tetrahedra | float64 | float32 | error of the force | of the stiffness |",
        "|---" * 5 + "|",
    ]
    for r in data["laws"]:
        ms = " | ".join(f"{1e3 * r['seconds'][p]:.2g} ms" for p in ("float64", "float32"))
        rows.append(f"| `{r['law']}` | {ms} | {r['force_error']:.0e} | {r['stiffness_error']:.0e} |")
    rows += ["", "| solve | precision | tolerance | residual | error | run | ended |", "|---" * 7 + "|"]
    for r in [{"model": "static cube"} | r for r in data["cube"]] + data["liver"]:
        residual = f"{r['residual']:.0e} | {r['error']:.0e} | {r['run_s']:.2g} s"
        rows.append(f"| {r['model']} | {r['precision']} | {r['tolerance']:.0e} | {residual} | {r['code']} |")
    return "\n".join(rows)


def gradients() -> str:
    """Every row of the cost of a gradient."""
    (data,) = load("gradient_cost")
    rows = ["| model | tetrahedra | steps | store | run | gradient | over | memory | predicted |", "|---" * 9 + "|"]
    for r in data["rows"]:
        memory = f"{r['planned_bytes'] / 1e6:.3g} MB | {r['predicted_bytes'] / 1e6:.3g} MB"
        times = f"{short(r['forward_s'])} s | {short(r['gradient_s'])} s | {r['ratio']:.3g}"
        rows.append(f"| {r['model']} | {r['tetrahedra']:,} | {r['steps']:,} | `{r['store']}` | {times} | {memory} |")
    return "\n".join(rows)


def lesion() -> str:
    """Every map."""
    (data,) = load("lesion")
    rows = [
        "| noise | length of the prior | chi2 a component | centre off | largest modulus over true | "
        "error of ln(modulus), uniform body | run |",
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


PARTS = {"precision": precision, "gradients": gradients, "lesion": lesion}
