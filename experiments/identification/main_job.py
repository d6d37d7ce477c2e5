"""The main task on both shipped sweeps with the README's command: where is the time spent?

Each command is one separate process, timed from start to end. It runs with an empty cache of compiled programs, and
then once more. ``python -m experiments main_job`` writes results/main_job.json, main_job_lions_mane.png and
main_job_porcine_liver.png.
"""

import json
import os
import shutil
import subprocess
import sys
import tempfile
import time
from pathlib import Path

from experiments.common import RESULTS, ROOT, either, save
from liverjax.core.program_cache import SWITCH

DATA = ROOT / "data"


def fit_command(sweep: Path, out: Path, cache: Path) -> tuple[int, float]:
    """Return the exit code and the seconds of the README's command."""
    begin = time.perf_counter()
    command = [sys.executable, "-m", "fitting", str(sweep), "--out", str(out)]
    code = subprocess.run(command, cwd=ROOT, env=os.environ | {SWITCH: str(cache)}).returncode
    return code, time.perf_counter() - begin


def main() -> None:
    """Run both fits and keep figure and numbers."""
    rows = {}
    for name in either(("lions_mane", "porcine_liver"), ("porcine_liver",)):
        with tempfile.TemporaryDirectory() as folder:
            sweep, out, cache = DATA / f"{name}_frequency_sweep.csv", Path(folder, "out"), Path(folder, "cache")
            code, total = fit_command(sweep, out, cache)
            content = json.loads((out / "fit.json").read_text())
            RESULTS.mkdir(parents=True, exist_ok=True)
            shutil.copy(out / "fit.png", RESULTS / f"main_job_{name}.png")
            _, again = fit_command(sweep, out, cache)
        closed = content["closed_form"]
        keep = ("modes", "shear_modulus", "equilibrium_modulus", "ratios", "relaxation_times", "standard_errors")
        keep += ("mean_relative_error", "max_relative_error", "run_time_s", "compile_time_s", "warnings", "details")
        rows[name] = {k: content[k] for k in keep} | {
            "total_errors": content["total_errors"],
            "error_shares": content["error_shares"],
            "frequencies": len(content["shear_waves"]["frequency_Hz"]),
            "notes": content["notes"],
            "exit_code": code,
            "total_s": total,
            "second_call_s": again,
            "closed_form": {k: closed[k] for k in keep},
        }
        print(f"{name}: exit {code}, {total:.1f} s in all, a second call {again:.1f} s")
        for label, c in (("closed form", closed), ("torsion", content)):
            seconds = f"compile {c['compile_time_s']:.1f} s  run {c['run_time_s']:.2f} s"
            print(f"  {label:12s} mean error {100 * c['mean_relative_error']:.3g} %  {seconds}")
    save("main_job", rows)


if __name__ == "__main__":
    main()
