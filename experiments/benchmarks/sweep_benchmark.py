"""Runs per minute of `python -m liverjax sweep`: one and two devices, a loop written by hand, and growth of memory.

``python -m experiments sweep_benchmark`` (4 minutes) writes results/sweep_benchmark.json. Whole processes are timed.
The time of start and compilation is removed by the difference between two numbers of runs. The largest difference of
the results is listed too.
"""

import resource
import statistics
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import h5py
import jax
import numpy as np

import liverjax as lj
from experiments.common import either, save
from liverjax.__main__ import main as command

SCENE = """
[mesh]
shape = "box"
size = [0.1, 0.1, 0.1]
cells = [4, 4, 4]
[law]
name = "neo_hookean"
mu = 770.0
bulk = 2200.0
[[fixed]]
where = {z_max = 0.0}
[[displaced]]
where = {z_min = 0.1}
by = [0.01, 0.0, 0.02]
[solve]
steps = 2
"""
FEW, MANY, MOST = either((200, 2000, 10000), (20, 100, 200))
CHUNK = 50


def swept(folder: Path, rows: int, devices: int) -> tuple[float, Path]:
    """Return the seconds of the whole process, and its results."""
    table, out = folder / f"rows_{rows}.csv", folder / f"{rows}_{devices}.h5"
    if not table.exists():
        command(["design", str(table), "law.mu=500:1000", "law.bulk=1500:3000", "--rows", str(rows)])
    call = [sys.executable, "-m", "liverjax", "sweep", str(folder / "scene.toml"), str(table), "--out", str(out)]
    begin = time.perf_counter()
    subprocess.run([*call, "--chunk", str(CHUNK), "--devices", str(devices)], check=True, capture_output=True)
    return time.perf_counter() - begin, out


def looped(folder: Path, rows: int) -> float:
    """Return the seconds per run of a compiled function that is called for one parameter set after the other."""
    scene = lj.load_scene(folder / "scene.toml")
    program = jax.jit(lambda scene, v: lj.simulate(lj.with_parameters(scene, v)).positions[-1])
    values = np.loadtxt(folder / f"rows_{rows}.csv", delimiter=",", skiprows=2)
    program(scene, {"law.mu": 700.0, "law.bulk": 2000.0})
    begin = time.perf_counter()
    for mu, bulk in values:
        jax.block_until_ready(program(scene, {"law.mu": mu, "law.bulk": bulk}))
    return (time.perf_counter() - begin) / rows


def main() -> None:
    """Run all parts."""
    with tempfile.TemporaryDirectory() as made:
        folder, content = Path(made), {"chunk": CHUNK}
        (folder / "scene.toml").write_text(SCENE)
        for devices in (1, 2):
            each = []
            for _ in range(either(3, 1)):
                few, many = (swept(folder, n, devices) for n in (FEW, MANY))
                each.append((many[0] - few[0]) / (MANY - FEW))
                last = many[1].rename(folder / f"last_{devices}.h5")
                few[1].unlink()
            content[f"seconds_a_row_{devices}"] = statistics.median(each)
        with h5py.File(folder / "last_1.h5") as one, h5py.File(last) as two:
            content["difference_m"] = float(abs(one["final_positions"][:] - two["final_positions"][:]).max())
            content["largest_residual"] = float(one["residual"][:].max())
        content["seconds_a_row_loop"] = statistics.median(looped(folder, MANY) for _ in range(either(3, 1)))
        before = resource.getrusage(resource.RUSAGE_CHILDREN).ru_maxrss
        content["most_rows"], (content["most_rows_s"], _) = MOST, swept(folder, MOST, 2)
        content["peak_memory_bytes"] = {
            f"{FEW} to {MANY} rows": 1024 * before,
            f"{MOST} rows": 1024 * resource.getrusage(resource.RUSAGE_CHILDREN).ru_maxrss,
        }
    content["rows_a_minute"] = {n: 60 / content[f"seconds_a_row_{n}"] for n in (1, 2)}
    content["two_devices_over_one"] = content["seconds_a_row_1"] / content["seconds_a_row_2"]
    content["overhead_over_loop"] = content["seconds_a_row_1"] / content["seconds_a_row_loop"] - 1
    print(content)
    save("sweep_benchmark", content)


if __name__ == "__main__":
    main()
