"""A training set of 1,000 runs of the liver phantom by ``python -m liverjax sweep``, and a surrogate trained on it.

The runs are static sagging under gravity of any direction. Shear and bulk modulus vary by a factor of four. The 1,000
parameter sets are a Sobol sequence. A cubic polynomial in the parameters for the leading modes of the displacement is
fitted to 800 runs and tested on the 200 others. The runs use linear elements on one mesh. Therefore 100 runs are
repeated with quadratic elements on the same tetrahedra. The difference is an error of the data that no surrogate can
detect.

``python -m experiments training_set`` (12 minutes) writes results/training_set.json;
``python -m experiments.identification.training_set mesh`` runs the second part again.
"""

import json
import subprocess
import sys
import tempfile
import time
from itertools import combinations_with_replacement
from pathlib import Path

import h5py
import jax
import matplotlib.pyplot as plt
import numpy as np

import liverjax as lj
from experiments.common import RESULTS, either, save
from experiments.liver import SCENE
from liverjax.__main__ import main as command
from liverjax.core.struct import replace

RANGES = {
    "law.mu": (700.0, 2800.0),
    "law.bulk": (2200.0, 8800.0),
    "body.gravity.0": (-2.0, 2.0),
    "body.gravity.1": (-2.0, 2.0),
    "body.gravity.2": (-2.0, 2.0),
}
ROWS, TRAINED, DEGREE, MODES = either(1000, 80), either(800, 60), either(3, 2), either((1, 2, 5, 10, 20, 40), (1, 5))
MESH_ROWS = either(100, 4)


def scene_file(folder: Path, order: int = 1) -> Path:
    """Write the scene of the liver phantom, static and without viscosity and fluid."""
    mesh = SCENE.parent.joinpath("../../data/liver_phantom.vtu").resolve()
    text = f"""
[mesh]
file = "{mesh.as_posix()}"
order = {order}
[law]
name = "arruda_boyce"
mu = 715.0
chain_length = 8.0
bulk = 2200.0
[body]
density = 1060.0
gravity = [0, 2.0, 0]
[[fixed]]
set = "vena_cava"
[[fixed]]
set = "suspensory_ligament"
[solve]
steps = 1
tolerance = 1e-6
"""
    file = folder / f"scene_{order}.toml"
    file.write_text(text)
    return file


def swept(folder: Path, order: int, number: int) -> tuple[dict, str]:
    """Run a sweep. Return parameter sets, status and displacements (rows, V, 3), with times and size, and its
    messages.
    """
    file, table, out = scene_file(folder, order), folder / "rows.csv", folder / "rows.h5"
    command(["design", str(table), *(f"{n}={a}:{b}" for n, (a, b) in RANGES.items()), "--rows", str(number)])
    call = [sys.executable, "-m", "liverjax", "sweep", str(file), str(table), "--chunk", "50", "--devices", "2"]
    begin = time.perf_counter()
    code = subprocess.run(call, capture_output=True, text=True)
    seconds = time.perf_counter() - begin
    begin = time.perf_counter()
    with h5py.File(out) as data:
        found = {"rows": data["parameters"][:], "good": (data["status"][:] == 0).all(axis=1)}
        found["moved"] = data["final_positions"][:] - data["reference"][:]
    reading, size = time.perf_counter() - begin, out.stat().st_size
    for made in (out, table):
        made.unlink()
    return found | {"seconds": seconds, "reading": reading, "bytes": size}, code.stderr


def missed_by_linear() -> dict:
    """Return the difference between linear and quadratic elements on the same tetrahedra, for the runs that
    converge.
    """
    with tempfile.TemporaryDirectory() as made:
        linear, quadratic = (swept(Path(made), order, MESH_ROWS)[0] for order in (1, 2))
    good = linear["good"] & quadratic["good"]
    a, b = (own["moved"][good][:, : linear["moved"].shape[1]] for own in (linear, quadratic))
    missed = np.linalg.norm(a - b, axis=(1, 2)) / np.linalg.norm(b, axis=(1, 2))
    return {
        "rows": MESH_ROWS,
        "ended": int(good.sum()),
        "median": float(np.median(missed)),
        "largest": float(missed.max()),
        "seconds_linear": linear["seconds"],
        "seconds_quadratic": quadratic["seconds"],
    }


def features(rows: np.ndarray) -> np.ndarray:
    """Return monomials up to DEGREE of the parameters, scaled to -1 … 1. Compliances replace the moduli."""
    low, high = np.array(list(RANGES.values())).T
    stiff = np.array([name.startswith("law") for name in RANGES])
    x = np.where(stiff, high / rows, rows)
    low, high = np.where(stiff, 1.0, low), np.where(stiff, high / low, high)
    x = 2 * (x - low) / (high - low) - 1
    powers = [p for d in range(DEGREE + 1) for p in combinations_with_replacement(range(x.shape[1]), d)]
    return np.stack([np.prod(x[:, p], axis=1) if p else np.ones(len(x)) for p in powers], axis=1)


def surrogate(rows: np.ndarray, moved: np.ndarray) -> list[dict]:
    """Return the error of polynomial and modes on the runs that were not used for the fit, for several numbers of
    modes.
    """
    begin = time.perf_counter()
    U, s, Vt = np.linalg.svd(moved[:TRAINED], full_matrices=False)
    weights = np.linalg.lstsq(features(rows[:TRAINED]), U * s, rcond=None)[0]
    fitting = time.perf_counter() - begin
    errors = []
    for n in MODES:
        begin = time.perf_counter()
        found = features(rows[TRAINED:]) @ weights[:, :n] @ Vt[:n]
        evaluating = (time.perf_counter() - begin) / (ROWS - TRAINED)
        missed = np.linalg.norm(found - moved[TRAINED:], axis=1) / np.linalg.norm(moved[TRAINED:], axis=1)
        errors.append(
            {
                "modes": n,
                "median_error": float(np.median(missed)),
                "largest_error": float(missed.max()),
                "seconds_a_row": evaluating,
                "seconds_to_fit": fitting,
            }
        )
    return errors


def main(wanted: list[str]) -> None:
    """Run all parts, or only the runs with quadratic elements."""
    if wanted == ["mesh"]:
        content = json.loads((RESULTS / "training_set.json").read_text())
        save("training_set", content | {"mesh": missed_by_linear()}, _figure(content))
        return
    with tempfile.TemporaryDirectory() as made:
        found, said = swept(Path(made), 1, ROWS)
        scene, worst = lj.load_scene(scene_file(Path(made))), 0.0
    rows, moved = found["rows"], found["moved"].reshape(ROWS, -1)
    # Check that a stored run is equal to a single run with its parameters.
    for k in (0, ROWS // 2, ROWS - 1):
        law = replace(scene.law, mu=rows[k, 0], bulk=rows[k, 1])
        body = replace(scene.body, gravity=rows[k, 2:])
        again = jax.jit(lj.simulate)(replace(scene, law=law, body=body)).positions[-1] - scene.mesh.points
        worst = max(worst, float(np.abs(np.asarray(again).ravel() - moved[k]).max()))
    if not found["good"].all():
        raise RuntimeError(f"{(~found['good']).sum()} rows failed: {said[-500:]}")
    content = {
        "rows": ROWS,
        "ranges": {name: list(pair) for name, pair in RANGES.items()},
        "seconds_sweep": found["seconds"],
        "seconds_reading": found["reading"],
        "bytes": found["bytes"],
        "largest_difference_to_single_runs_m": worst,
        "largest_displacement_m": float(np.linalg.norm(found["moved"], axis=-1).max()),
        "surrogate": surrogate(rows, moved),
        "mesh": missed_by_linear(),
    }
    save("training_set", content, _figure(content))


def _figure(content: dict) -> plt.Figure:
    figure, axis = plt.subplots(figsize=(4, 3), layout="constrained")
    modes = [row["modes"] for row in content["surrogate"]]
    for key, label, marker in (("median_error", "median", "o"), ("largest_error", "largest", "s")):
        axis.loglog(
            modes, [100 * row[key] for row in content["surrogate"]], marker=marker, label=f"{label} of 200 rows"
        )
    axis.set(xlabel="modes kept", ylabel="error of the displacement [%]", title="Surrogate from 800 runs")
    axis.legend()
    return figure


if __name__ == "__main__":
    main([a for a in sys.argv[1:] if not a.startswith("-")])
