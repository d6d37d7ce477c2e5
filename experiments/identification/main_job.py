"""The main job on both shipped sweeps, as the README's command does it; where its time goes.

``python -m experiments main_job`` writes results/main_job.json, main_job_lions_mane.png and main_job_porcine_liver.png.
"""

import json
import shutil
import tempfile
import time
from pathlib import Path

from experiments.common import RESULTS, ROOT, either, save
from fitting.__main__ import main as fit_command

DATA = ROOT / "data"


def main() -> None:
    """Run both fits and keep figure and numbers."""
    rows = {}
    for name in either(("lions_mane", "porcine_liver"), ("porcine_liver",)):
        begin = time.perf_counter()
        with tempfile.TemporaryDirectory() as folder:
            code = fit_command([str(DATA / f"{name}_frequency_sweep.csv"), "--out", folder])
            total = time.perf_counter() - begin
            content = json.loads((Path(folder) / "fit.json").read_text())
            RESULTS.mkdir(parents=True, exist_ok=True)
            shutil.copy(Path(folder) / "fit.png", RESULTS / f"main_job_{name}.png")
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
            "closed_form": {k: closed[k] for k in keep},
        }
        print(f"{name}: exit {code}, {total:.0f} s in all")
        for label, c in (("closed form", closed), ("torsion", content)):
            seconds = f"compile {c['compile_time_s']:.1f} s  run {c['run_time_s']:.2f} s"
            print(f"  {label:12s} mean error {100 * c['mean_relative_error']:.3g} %  {seconds}")
    save("main_job", rows)


if __name__ == "__main__":
    main()
