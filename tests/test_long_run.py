"""A killed run continues from its finished parts and ends with the same numbers."""

import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import h5py
import jax
import numpy as np
import pytest

import liverjax as lj
from liverjax.__main__ import main
from liverjax.core import program_cache
from liverjax.jobs import long_run, output, resumable_parts, sweep
from liverjax.scenes import scene_file
from liverjax.simulation.run import Result
from liverjax.solvers.problem import StepStatistics

pytestmark = pytest.mark.quick_to_compile

SCENE = """
[mesh]
shape = "box"
size = [0.02, 0.02, 0.02]
cells = [2, 2, 2]
[law]
name = "neo_hookean"
mu = 770.0
bulk = 2200.0
[viscosity]
ratios = [0.235, 0.333]
relaxation_times = [0.27, 0.03]
[porosity]
bulk = 400.0
limit_bulk = 2200.0
fluid_fraction = 0.5
permeability = 2.0e-5
[body]
density = 1060.0
gravity = [0, 0, -9.81]
[[fixed]]
set = "z_min"
[[displaced]]
set = "z_max"
by = [0.0, 0.0, 0.002]
[solve]
kind = "dynamic"
integrator = "newmark"
dt = 0.02
steps = 10
"""

#: One cell that hangs, for 9,000 steps.
LONG = """
[mesh]
shape = "box"
size = [0.1, 0.1, 0.1]
cells = [1, 1, 1]
[law]
name = "neo_hookean"
mu = 770.0
bulk = 2200.0
[body]
density = 1060.0
gravity = [0, 0, -1.0]
[[fixed]]
set = "z_min"
[solve]
kind = "dynamic"
dt = 0.001
steps = 9000
tolerance = 1e-4
"""


@pytest.fixture(autouse=True, scope="module")
def _kept(tmp_path_factory):
    """A command finds the program of the command before, as for a user. All tests here compile it once."""
    names = ("jax_compilation_cache_dir", "jax_persistent_cache_min_compile_time_secs", "jax_logging_level")
    before = {name: getattr(jax.config, name) for name in names}
    with pytest.MonkeyPatch.context() as patch:
        patch.delenv("JAX_COMPILATION_CACHE_DIR", raising=False)
        patch.setenv(program_cache.SWITCH, str(tmp_path_factory.mktemp("programs")))
        yield
    for name, value in before.items():
        jax.config.update(name, value)


@pytest.fixture
def scene(tmp_path) -> Path:
    """A scene with every kind of state: inertia of second order, viscous memory, fluid."""
    file = tmp_path / "scene.toml"
    file.write_text(SCENE)
    return file


def _numbers(file: Path) -> dict[str, np.ndarray]:
    with h5py.File(file) as result:
        own = {name: value[()] for name, value in result.items() if isinstance(value, h5py.Dataset)}
        return own | {name: output.read_by_step(result, name) for name in output.BY_STEP}


def _stop_after(monkeypatch, count: int) -> None:
    """Simulate Ctrl-C while part `count` (from 0) is written."""
    write, written = resumable_parts.write, []

    def until(file, content):
        if len(written) == count:
            raise KeyboardInterrupt
        write(file, content)
        written.append(file)

    monkeypatch.setattr(resumable_parts, "write", until)


def test_an_unfinished_run_needs_the_same_number_of_steps_per_part(tmp_path):
    """The message advised only --resume, which refuses parts of another number of steps."""
    (tmp_path / "result.h5.parts").mkdir()
    with pytest.raises(lj.InputError, match="continue with --resume and the same --every, or remove this folder"):
        long_run.refuse_unfinished(tmp_path / "result.h5", False)


@pytest.mark.ci
def test_a_stopped_run_goes_on_to_the_same_numbers(scene, tmp_path, monkeypatch, capsys):
    whole, stopped = tmp_path / "whole", tmp_path / "stopped"
    command = ["simulate", str(scene), "--every", "4", "--out"]
    assert main([*command, str(whole)]) == 0
    with monkeypatch.context() as patch:
        _stop_after(patch, 2)
        assert main([*command, str(stopped)]) == 130
        assert "stopped; continue with --resume" in capsys.readouterr().err
    assert not (stopped / "result.h5").exists()
    assert main([*command, str(stopped)]) == 2
    assert "unfinished run: continue with --resume and the same --every" in capsys.readouterr().err
    # as if the machine had lost power while the file was written
    damaged = sorted(stopped.glob("result.h5.parts/part_*.h5"))[1]
    damaged.write_bytes(damaged.read_bytes()[:-1000])
    with monkeypatch.context() as patch:
        _stop_after(patch, 1)
        assert main([*command, str(stopped), "--resume"]) == 130
    capsys.readouterr()
    assert main([*command, str(stopped), "--resume"]) == 0
    assert "8 steps found on disk" in capsys.readouterr().out
    expected, found = _numbers(whole / "result.h5"), _numbers(stopped / "result.h5")
    assert len(found["times"]) == 10
    for name, value in expected.items():
        assert value.tobytes() == found[name].tobytes(), name
    assert sorted(p.name for p in stopped.iterdir()) == ["result.h5"]


@pytest.mark.slow
def test_a_run_in_parts_is_the_run_in_one(scene, tmp_path):
    assert main(["simulate", str(scene), "--every", "4", "--out", str(tmp_path)]) == 0
    found = _numbers(tmp_path / "result.h5")
    # A part does not inherit the tangent of the part before. The difference from one run is below Newton's tolerance.
    once = lj.simulate(lj.load_scene(scene)).check()
    moved = np.abs(np.asarray(once.positions) - np.asarray(once.positions)[0]).max()
    assert np.abs(np.asarray(once.positions) - found["positions"]).max() < 1e-4 * moved


def test_parts_of_another_scene_are_refused(scene, tmp_path, monkeypatch, capsys):
    command = ["simulate", str(scene), "--every", "4", "--out", str(tmp_path)]
    with monkeypatch.context() as patch:
        _stop_after(patch, 1)
        assert main(command) == 130
    scene.write_text(SCENE.replace("770.0", "700.0"))
    assert main([*command, "--resume"]) == 2
    assert "of another run (not the same scene)" in capsys.readouterr().err
    scene.write_text(SCENE)
    load = scene_file.load_scene
    with monkeypatch.context() as patch:  # the text is the same, but a file that it names has changed
        patch.setattr(scene_file, "load_scene", lambda file: lj.with_parameters(load(file), {"body.density": 1000.0}))
        assert main([*command, "--resume"]) == 2
    assert "of another run (not the same numbers)" in capsys.readouterr().err
    assert main(["simulate", str(scene), "--every", "0"]) == 2
    assert "--every 0 must be above 0" in capsys.readouterr().err


def test_the_result_of_another_scene_is_not_replaced_by_resume(scene, tmp_path, capsys):
    """The result was computed again and replaced, without a message."""
    out = tmp_path / "result.h5"
    with h5py.File(out, "w") as file:
        file.attrs["scene"] = SCENE.replace("770.0", "700.0")
    assert main(["simulate", str(scene), "--resume", "--out", str(tmp_path)]) == 2
    assert "result.h5 is the result of another scene: give another --out, or remove --resume" in capsys.readouterr().err
    long_run.refuse_unfinished(out, resume=False, text=SCENE)
    long_run.refuse_unfinished(out, resume=True, text="# of the same numbers\n" + SCENE.replace("770.0", "700.0"))


@pytest.mark.parametrize("steps", [5, 8125, 8126, 40_000])
def test_runs_of_any_length_are_written(steps, tmp_path):
    """HDF5 does not allow attributes above 64 kB, which is 8,190 residuals."""
    scene = lj.Scene(mesh=lj.shapes.box((1, 1, 1), (1, 1, 1)), law=lj.laws.create("neo_hookean", mu=1.0, bulk=1.0))
    number = np.arange(steps)
    codes = number.astype(np.int32) % 2
    taken = dict.fromkeys(StepStatistics._fields, number) | {"residual": 1e-9 * number, "status": codes}
    nowhere = np.broadcast_to(np.zeros(()), (steps, 8, 3))
    rows = {"times": number, "positions": nowhere, "reactions": nowhere, "status": codes}
    result = Result(**rows, statistics=StepStatistics(**taken))
    output.write_hdf5(tmp_path / "result.h5", scene, result, {"scene": "x" * 100_000})
    found = _numbers(tmp_path / "result.h5")
    assert found["status"].tolist() == codes.tolist() and found["residual"].tolist() == (1e-9 * number).tolist()
    assert all(found[name].tolist() == number.tolist() for name in ("iterations", "linear_iterations", "cuts"))
    with h5py.File(tmp_path / "result.h5") as file:
        assert ("residual" in file.attrs) == (steps <= 8125) and len(file.attrs["scene"]) == 100_000


@pytest.mark.slow
def test_a_long_run_whose_parts_are_all_there_ends_well(tmp_path, monkeypatch):
    (tmp_path / "scene.toml").write_text(LONG)
    command = ["simulate", str(tmp_path / "scene.toml"), "--every", "4500", "--out", str(tmp_path)]

    def stopped(*_):
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr(output, "write_hdf5", stopped)
        assert main(command) == 130
    assert main([*command, "--resume"]) == 0
    found = _numbers(tmp_path / "result.h5")
    assert found["positions"].shape == (9000, 8, 3) and not found["status"].any() and len(found["residual"]) == 9000
    assert main(["plot", str(tmp_path / "result.h5"), "--step", "9000", "--out", str(tmp_path)]) == 0


@pytest.mark.slow
def test_a_killed_process_loses_no_finished_part(scene, tmp_path):
    command = [sys.executable, "-m", "liverjax", "simulate", str(scene), "--every", "1", "--out", str(tmp_path)]
    folder = resumable_parts.beside(tmp_path / "result.h5")
    process = subprocess.Popen(command)
    while not resumable_parts.part(folder, 0).exists():
        time.sleep(0.01)
        assert process.poll() is None or (tmp_path / "result.h5").exists()
    os.kill(process.pid, signal.SIGKILL)
    process.wait()
    assert subprocess.run([*command, "--resume"]).returncode == 0
    assert len(_numbers(tmp_path / "result.h5")["times"]) == 10


@pytest.mark.parametrize("content", ["", '{"scene": "fir', "[1]", "\0" * 40])
def test_a_damaged_file_with_the_input_is_told(tmp_path, content):
    """It was a traceback of the JSON reader."""
    (tmp_path / "run.json").write_text(content)
    with pytest.raises(lj.InputError, match=r"run\.json is damaged, so the input of the parts is unknown"):
        resumable_parts.same({"scene": "first"}, tmp_path / "run.json")


def test_parts_that_another_process_uses_stay(tmp_path):
    """A second process that had begun with --resume lost the parts while it was reading them."""
    folder = resumable_parts.beside(tmp_path / "result.h5")
    long_run.remove_parts(tmp_path / "result.h5")  # there are none
    resumable_parts.make_folder(folder)
    with resumable_parts.locked(folder / "lock_0"):
        long_run.remove_parts(tmp_path / "result.h5")
        assert folder.exists()
    long_run.remove_parts(tmp_path / "result.h5")
    assert not folder.exists()


def test_parts_that_a_killed_sweep_left_are_removed(tmp_path):
    """A process was killed while it removed its parts. They stayed, and refused a sweep with a changed table."""
    (tmp_path / "scene.toml").write_text(LONG)
    (tmp_path / "rows.csv").write_text("law.mu\n700\n")
    table, out = sweep.read_sweep(tmp_path / "scene.toml", tmp_path / "rows.csv"), tmp_path / "rows.h5"
    with h5py.File(out, "w") as file:
        file.attrs["sweep"] = json.dumps(table.identity)
        file["status"], file["volume_ratios"] = np.zeros((1, 2), int), np.ones((1, 2))
    folder = resumable_parts.beside(out)
    for identity in ({"scene": "another"}, table.identity):
        resumable_parts.make_folder(folder)
        resumable_parts.same(identity, folder / "sweep.json")
        resumable_parts.write(resumable_parts.part(folder, 1), {"x": np.zeros(1)})
        assert sweep.run(table, out, resume=True).computed == 0
        assert folder.exists() == (identity is not table.identity)
        if folder.exists():
            resumable_parts.remove(folder)


def _finished(table: sweep.Sweep, out: Path) -> None:
    """Write the parts of a sweep, as if all rows were computed."""
    folder = resumable_parts.beside(out)
    resumable_parts.make_folder(folder)
    resumable_parts.same(table.identity, folder / "sweep.json")
    for k in sweep._chunks(table):
        n = len(sweep._of(table, k))
        results = {"status": np.zeros((n, 2), int), "volume_ratios": np.ones((n, 2))}
        resumable_parts.write(resumable_parts.part(folder, k), results)


def _swept(folder: Path, outputs: tuple[str, ...] = ("final_positions",), chunk: int = 16) -> sweep.Sweep:
    (folder / "scene.toml").write_text(LONG)
    (folder / "rows.csv").write_text("law.mu\n700\n710\n")
    return sweep.read_sweep(folder / "scene.toml", folder / "rows.csv", outputs, chunk=chunk)


def test_the_results_of_a_wide_table_are_joined(tmp_path):
    """The names of the columns were too large for an attribute, after all runs were computed."""
    table, out = _swept(tmp_path), tmp_path / "rows.h5"
    names = tuple(f"law.mu.{k}" for k in range(4200))
    _finished(table, out)
    assert sweep.run(table._replace(names=names, rows=np.ones((2, 4200))), out, resume=True).file == out
    with h5py.File(out) as file:
        assert tuple(file["names"].asstr()[:]) == names and "names" not in file["parameters"].attrs


def test_a_finished_sweep_is_known_again(tmp_path):
    """Other chunks, another order of the outputs or another version of NumPy were called another sweep."""
    table, out = _swept(tmp_path, ("final_positions", "positions")), tmp_path / "rows.h5"
    _finished(table, out)
    assert sweep.run(table, out, resume=True).file == out
    again = _swept(tmp_path, ("positions", "final_positions"), chunk=1)
    again.identity["versions"] = {"numpy": "0"}
    assert sweep.run(again, out, resume=True) == sweep.Done(out, {}, 0, {})
    with pytest.raises(lj.InputError, match=r"another sweep \(not the same outputs\)"):
        sweep.run(_swept(tmp_path), out, resume=True)
    with pytest.raises(lj.InputError, match=r"another sweep \(not the same numbers, parameters\)"):
        changed = table.identity | {"numbers": "0", "parameters": "0"}
        sweep.run(table._replace(identity=changed), out, resume=True)


def test_a_process_that_comes_after_the_join_ends_well(tmp_path, monkeypatch):
    """It ended with an error. If the parts were removed just before it joined them, it said that rows were left."""
    table, out = _swept(tmp_path), tmp_path / "rows.h5"
    _finished(table, out)
    join = sweep._joined

    def joined_before(*given):
        assert join(*given).file == out and not resumable_parts.beside(out).exists()
        return join(*given)

    with monkeypatch.context() as patched:
        patched.setattr(sweep, "_joined", joined_before)
        assert sweep.run(table, out, process=(0, 2)) == sweep.Done(out, {}, 0, {})
    assert sweep.run(table, out, process=(1, 2)) == sweep.Done(out, {}, 0, {})
    with pytest.raises(lj.InputError, match="exists already"):
        sweep.run(table, out)


def test_a_kill_while_parts_are_removed_leaves_no_parts_of_unknown_input(tmp_path, monkeypatch):
    """The file with the input went first, and --resume put the remaining parts into the run of another scene."""
    folder = tmp_path / "result.h5.parts"
    for kept in range(4):
        resumable_parts.make_folder(folder)
        resumable_parts.same({"scene": "first"}, folder / "run.json")
        for k in range(3):
            resumable_parts.write(resumable_parts.part(folder, k), {"x": np.zeros(1)})
        unlink, left = Path.unlink, 4 - kept

        def killed(file, missing_ok=False, unlink=unlink):
            nonlocal left
            if not left:
                raise KeyboardInterrupt
            left -= 1
            unlink(file, missing_ok)

        with monkeypatch.context() as patched, pytest.raises((KeyboardInterrupt, OSError)):
            patched.setattr(Path, "unlink", killed)
            resumable_parts.remove(folder)
            raise OSError  # all files were removed
        if folder.exists():
            with pytest.raises(lj.InputError, match="not the same scene"):
                resumable_parts.same({"scene": "second"}, folder / "run.json")
            resumable_parts.remove(folder)
    folder.mkdir()
    resumable_parts.write(resumable_parts.part(folder, 0), {"x": np.zeros(1)})
    with pytest.raises(lj.InputError, match=r"contains parts, but not the file run\.json with their input"):
        resumable_parts.same({"scene": "second"}, folder / "run.json")


@pytest.mark.parametrize("kind", ["static", "harmonic"])
def test_files_that_a_scene_names_are_not_replaced(kind, tmp_path, capsys):
    """A mesh that an earlier run had written was replaced by the new results."""
    name = "step_00001.vtu" if kind == "static" else "frequency_001.vtu"
    (tmp_path / "vtu").mkdir()
    lj.write_mesh(tmp_path / "vtu" / name, lj.shapes.box((0.01, 0.01, 0.01), (1, 1, 1)))
    solve = "steps = 1" if kind == "static" else 'kind = "harmonic"\nfrequencies = [40.0]'
    (tmp_path / "scene.toml").write_text(
        f"[mesh]\nfile = 'vtu/{name}'\n[law]\nname = 'neo_hookean'\nmu = 770.0\nbulk = 7700.0\n"
        "[body]\ndensity = 1000.0\n[[fixed]]\nwhere = {z_min = 0.01}\n[[displaced]]\nwhere = {z_max = 0.0}\n"
        f"by = [0.0, 0.0, 1e-4]\n[solve]\n{solve}\n"
    )
    assert main(["simulate", str(tmp_path / "scene.toml"), "--vtu", "--out", str(tmp_path)]) == 2
    assert f"{name} would be replaced by the results: give another --out" in capsys.readouterr().err
