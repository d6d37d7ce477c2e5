"""Robustness of sweeps: 20 kills at random moments, several processes of which one is killed, eight devices.

The processes run on one machine and find each other by a loopback address. ``python -m experiments sweep_survival`` (5
minutes) writes results/sweep_survival.json. Results are compared byte by byte with those of an undisturbed run, and
those of eight devices by their largest difference.
"""

import os
import random
import signal
import socket
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import h5py
import numpy as np

from experiments.benchmarks.sweep_benchmark import SCENE
from experiments.common import either, save

ROWS, CHUNK, KILLS, SEED = either(4096, 512), 32, either(20, 2), 7


class Case:
    """One sweep in a folder, run as separate processes."""

    def __init__(self, folder: Path):
        self.folder = folder
        (folder / "scene.toml").write_text(SCENE)
        ranges = ["law.mu=500:1000", "law.bulk=1500:3000"]
        subprocess.run(
            [sys.executable, "-m", "liverjax", "design", str(folder / "rows.csv"), *ranges, "--rows", str(ROWS)],
            check=True,
            capture_output=True,
        )

    def start(self, out: str, *more: str) -> subprocess.Popen:
        """Start a sweep in a separate process. Programs that are compiled once are found again in a cache."""
        files = [str(self.folder / name) for name in ("scene.toml", "rows.csv")]
        call = [sys.executable, "-m", "liverjax", "sweep", *files, "--out", str(self.folder / out)]
        kept = {
            "JAX_COMPILATION_CACHE_DIR": str(self.folder / "cache"),
            "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS": "0",
        }
        return subprocess.Popen(
            [*call, "--chunk", str(CHUNK), *more],
            env=os.environ | kept,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
        )

    def run(self, out: str, *more: str) -> float:
        """Return the seconds of a complete run."""
        begin, process = time.perf_counter(), self.start(out, *more)
        said, _ = process.communicate(timeout=600)
        if process.returncode != 0:
            raise RuntimeError(said)
        return time.perf_counter() - begin

    def content(self, out: str) -> dict[str, bytes]:
        """Return the bytes of every dataset."""
        with h5py.File(self.folder / out) as file:
            return {name: value[()].tobytes() for name, value in file.items()}

    def finished(self, out: str) -> set[str]:
        """Return the finished chunks, and check that each one can be read."""
        parts = set((self.folder / f"{out}.parts").glob("part_*.h5"))
        for part in parts:
            with h5py.File(part) as file:
                assert file["status"].shape[0] == CHUNK
        return {part.name for part in parts}


def kills(case: Case, whole: dict[str, bytes], longest: float) -> dict:
    """Kill sweeps at random moments and resume them until they are complete. The moments have a fixed seed."""
    moments, done, lost, sweeps, equal = random.Random(SEED), 0, 0, 0, True
    after: list[int] = []
    while done < KILLS:
        out, sweeps, running = f"killed_{sweeps}.h5", sweeps + 1, True
        while running and done < KILLS:
            before, process = case.finished(out), case.start(out, "--resume")
            try:
                process.wait(moments.uniform(0, longest))
                running = False
            except subprocess.TimeoutExpired:
                process.send_signal(signal.SIGKILL)
                process.wait()
                done += 1
                if (case.folder / out).exists():
                    break  # killed after the parts had been joined
                lost += len(before - case.finished(out))
                after.append(len(case.finished(out)))
        case.run(out, "--resume")
        equal &= case.content(out) == whole
    return {
        "kills": done,
        "sweeps": sweeps,
        "finished_chunks_at_the_kills": after,
        "finished_chunks_lost": lost,
        "equal_bytes": equal,
    }


def _free_port() -> int:
    with socket.socket() as listening:
        listening.bind(("127.0.0.1", 0))
        return listening.getsockname()[1]


def loopback(case: Case, whole: dict[str, bytes], n: int, kill: bool) -> dict:
    """Run n processes that find each other by JAX's distributed runtime. One is killed after its first chunk,
    or none.
    """
    out, host = f"shared_{n}_{kill}.h5", f"127.0.0.1:{_free_port()}"
    begin = time.perf_counter()
    processes = [case.start(out, "--distributed", host, str(n), str(i)) for i in range(n)]
    killed = None
    if kill:
        killed = processes[-1]
        while not (case.folder / f"{out}.parts" / f"part_{n - 1:06d}.h5").exists():
            time.sleep(0.001)
        killed.kill()
    said = [p.communicate(timeout=600)[0] for p in processes]
    codes = [p.returncode for p in processes if p is not killed]
    left = ROWS // CHUNK - len(case.finished(out)) if not (case.folder / out).exists() else 0
    if any(codes):
        raise RuntimeError("\n".join(said))
    seconds = time.perf_counter() - begin
    if kill:
        assert not (case.folder / out).exists()
        case.run(out, "--resume")
    return {
        "processes": n,
        "killed": int(kill),
        "seconds": seconds,
        "exit_codes_of_the_others": codes,
        "chunks_left_to_resume": left,
        "equal_bytes": case.content(out) == whole,
    }


def main() -> None:
    """Run all parts."""
    with tempfile.TemporaryDirectory() as made:
        case = Case(Path(made))
        case.run("first.h5")  # fills the cache of compiled programs
        seconds = case.run("whole.h5")
        whole = case.content("whole.h5")
        content = {"rows": ROWS, "chunk": CHUNK, "seconds_undisturbed": seconds}
        content["loopback"] = [loopback(case, whole, n, kill) for n in either((2, 4), (2,)) for kill in (False, True)]
        content["kills"] = kills(case, whole, seconds)
        case.run("eight.h5", "--devices", "8")
        with h5py.File(case.folder / "eight.h5") as eight, h5py.File(case.folder / "whole.h5") as one:
            difference = np.abs(eight["final_positions"][:] - one["final_positions"][:]).max()
        content["eight_devices_difference_m"] = float(difference)
    print(content)
    save("sweep_survival", content)


if __name__ == "__main__":
    main()
