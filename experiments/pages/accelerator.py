"""Table of one GPU compared with the processor of the same machine."""

import textwrap

from experiments.pages.results import error_text, load, short

#: What the size of a case counts, for each part.
COUNTED = {"assembly": "tetrahedra", "static cube": "tetrahedra", "liver": "steps", "sweep": "runs", "reduced": "runs"}


def _by_case() -> dict[tuple, dict[tuple, dict]]:
    """Return the rows for each part, name and size, by platform and precision."""
    (data,) = load("accelerator")
    found: dict[tuple, dict[tuple, dict]] = {}
    for r in data["rows"]:
        found.setdefault((r["part"], r["name"], r["size"]), {})[r["platform"], r["precision"]] = r
    return found


def _ms(row: dict | None) -> str:
    """Return the run time, or the reason why there is none."""
    if row is None:
        return ""
    return row["failed"] if "failed" in row else f"{short(1e3 * row['run_s'])} ms"


def table() -> str:
    """Table of all cases."""
    (data,) = load("accelerator")
    where = data["environment"]
    rows = [
        f"{', '.join(data['devices'])}, compared with {where['cores']} cores of the same machine, with jax "
        f"{where['jax']}.",
        "",
        "| case | size | processor, float64 | processor, float32 | GPU, float64 | GPU, float32 | "
        "time of processor divided by time of GPU, float64 | error on the GPU, float64 | error on the GPU, float32 |",
        "|---" * 9 + "|",
    ]
    for (part, name, size), of in _by_case().items():
        cpu, gpu, single = (of.get(key) for key in (("cpu", "float64"), ("gpu", "float64"), ("gpu", "float32")))
        times = " | ".join(_ms(of.get((p, q))) for p in ("cpu", "gpu") for q in ("float64", "float32"))
        faster = f"{short(cpu['run_s'] / gpu['run_s'])}" if cpu and gpu and "run_s" in gpu else ""
        errors = " | ".join(error_text(r["error"]) if r and "error" in r else "" for r in (gpu, single))
        rows.append(f"| {part}, {name} | {size:,} {COUNTED[part]} | {times} | {faster} | {errors} |")
    return "\n".join(rows)


def _seconds(part: str, name: str, size: int, platform: str) -> float:
    return _by_case()[part, name, size][platform, "float64"]["run_s"]


def came_out() -> str:
    """One line on the gain for large bodies and for many runs."""
    gain = {
        key: _seconds(*key, "cpu") / _seconds(*key, "gpu")
        for key in (("static cube", "run", 257_250), ("sweep", "384 tetrahedra", 1000), ("liver", "complete", 40))
    }
    cube, rows, liver = gain.values()
    return (
        f"the GPU is {short(cube)} times as fast for a static solution with 257,250 tetrahedra, {short(rows)} times "
        f"for 1,000 runs of a sweep, and {short(liver)} times for the complete phantom with 5,351 tetrahedra; in "
        "float64 the results have the same digits"
    )


def sentences() -> str:
    """Sentences for the guide."""
    (data,) = load("accelerator")
    large, small = ("static cube", "run", 257_250), ("liver", "hyperelastic", 40)
    lanes = _seconds("reduced", "phantom, runs", 1000, "gpu")
    text = (
        f"A static solution with 257,250 tetrahedra takes {short(1e3 * _seconds(*large, 'gpu'))} ms on one "
        f"{data['devices'][0]}, and {short(_seconds(*large, 'cpu'))} s on the processor of the same machine. 1,000 "
        f"runs of a mesh with 384 tetrahedra take {short(1e3 * _seconds('sweep', '384 tetrahedra', 1000, 'gpu'))} ms "
        f"on the GPU and {short(_seconds('sweep', '384 tetrahedra', 1000, 'cpu'))} s on the processor. 1,000 runs of "
        f"the reduced phantom take {short(lanes)} s on the GPU. For a small body the gain is small: 40 steps of the "
        f"hyperelastic phantom (5,351 tetrahedra) take {short(_seconds(*small, 'gpu'))} s on the GPU and "
        f"{short(_seconds(*small, 'cpu'))} s on the processor."
    )
    return textwrap.fill(text, 118)


PARTS = {"accelerator": table}
