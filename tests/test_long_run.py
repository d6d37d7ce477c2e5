"""A run that is killed goes on from its finished parts and ends with the same numbers."""

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
from liverjax.core import programs
from liverjax.jobs import resumable_parts
from liverjax.scenes import scene_file

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


@pytest.fixture(autouse=True, scope="module")
def _kept(tmp_path_factory):
    """A command finds the program of the one before, as a user's does: it is compiled once for all tests here."""
    names = ("jax_compilation_cache_dir", "jax_persistent_cache_min_compile_time_secs", "jax_logging_level")
    before = {name: getattr(jax.config, name) for name in names}
    with pytest.MonkeyPatch.context() as patch:
        patch.delenv("JAX_COMPILATION_CACHE_DIR", raising=False)
        patch.setenv(programs.SWITCH, str(tmp_path_factory.mktemp("programs")))
        yield
    for name, value in before.items():
        jax.config.update(name, value)


@pytest.fixture
def scene(tmp_path) -> Path:
    """Everything that has a state: inertia of second order, memory, fluid."""
    file = tmp_path / "scene.toml"
    file.write_text(SCENE)
    return file


def _numbers(file: Path) -> dict[str, np.ndarray]:
    with h5py.File(file) as result:
        return {name: value[()] for name, value in result.items()} | {"status": result.attrs["status"]}


def _stop_after(monkeypatch, count: int) -> None:
    """Ctrl-C at the write of part `count`, from 0."""
    write, written = resumable_parts.write, []

    def until(file, content):
        if len(written) == count:
            raise KeyboardInterrupt
        write(file, content)
        written.append(file)

    monkeypatch.setattr(resumable_parts, "write", until)


def test_a_stopped_run_goes_on_to_the_same_numbers(scene, tmp_path, monkeypatch, capsys):
    whole, stopped = tmp_path / "whole", tmp_path / "stopped"
    command = ["simulate", str(scene), "--every", "4", "--out"]
    assert main([*command, str(whole)]) == 0
    with monkeypatch.context() as patch:
        _stop_after(patch, 2)
        assert main([*command, str(stopped)]) == 130
        assert "go on with --resume" in capsys.readouterr().err
    assert not (stopped / "result.h5").exists()
    assert main([*command, str(stopped)]) == 2
    assert "go on with --resume" in capsys.readouterr().err
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
    # Parts differ from one run by the tangents that a part does not inherit: within the tolerance of Newton.
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
    assert "of another run (its scene differ)" in capsys.readouterr().err
    scene.write_text(SCENE)
    load = scene_file.load_scene
    with monkeypatch.context() as patch:  # the same text, but a file that it names has changed
        patch.setattr(scene_file, "load_scene", lambda file: lj.with_parameters(load(file), {"body.density": 1000.0}))
        assert main([*command, "--resume"]) == 2
    assert "of another run (its numbers differ)" in capsys.readouterr().err
    assert main(["simulate", str(scene), "--every", "0"]) == 2
    assert "--every 0 must be above 0" in capsys.readouterr().err


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
