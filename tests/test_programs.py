"""Compiled programs kept on disk: who has them, the same bits, broken entries, the bound on the size."""

import argparse
import importlib
import os
import subprocess
import sys
import warnings
from pathlib import Path

import h5py
import jax
import numpy as np
import pytest
from conftest import ROOT

from liverjax.commands.exit_codes import exit_code
from liverjax.core import programs

#: A program that takes longer to compile than to find, in a process as a command has it; its numbers are printed.
WORK = """
import jax, jax.numpy as jnp
import liverjax
from liverjax.core.programs import kept_on_disk
def work(x):
    return jnp.linalg.inv(jnp.sin(x) @ jnp.cos(x).T + 9 * jnp.eye(7)) @ jnp.exp(x)
with kept_on_disk():
    print(jax.jit(work)(jnp.arange(49.0).reshape(7, 7) / 50).tobytes().hex())
"""


@pytest.fixture
def switched(monkeypatch, tmp_path) -> Path:
    """The folder that `LIVERJAX_CACHE` names; what JAX was told before comes back afterwards."""
    before = {name: getattr(jax.config, name) for name in CONFIGURED}
    monkeypatch.delenv("JAX_COMPILATION_CACHE_DIR")
    monkeypatch.setenv(programs.SWITCH, str(tmp_path / "kept"))
    yield tmp_path / "kept"
    for name, value in before.items():
        jax.config.update(name, value)


CONFIGURED = ("jax_compilation_cache_dir", "jax_persistent_cache_min_compile_time_secs", "jax_logging_level")


def _started(command: list[str], cache: str | Path) -> subprocess.Popen:
    """A process of its own, without the folder that these tests give to JAX."""
    environment = {k: v for k, v in os.environ.items() if not k.startswith(("JAX_COMPILATION", "JAX_PERSISTENT"))}
    return subprocess.Popen(
        [sys.executable, "-W", "error", *command],
        cwd=ROOT,
        env=environment | {programs.SWITCH: str(cache)},
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )


def _ended(process: subprocess.Popen) -> str:
    """What a process printed, if it ended well and without a word on standard error."""
    out, said = process.communicate()
    assert process.returncode == 0 and said == "", said
    return out


def _entries(cache: Path) -> list[Path]:
    return sorted(cache.glob("*/*-cache"))


def test_a_second_process_finds_the_programs_and_the_same_bits(tmp_path):
    """Two that compile at once, one that reads, one that finds every entry spoilt; no word on standard error."""
    cache = tmp_path / "kept"
    both = [_started(["-c", WORK], cache) for _ in range(2)]
    compiled, other = (_ended(process) for process in both)
    before = {entry: (entry.stat().st_mtime_ns, entry.read_bytes()) for entry in _entries(cache)}
    assert compiled == other and any("jit_work" in entry.name for entry in before)
    assert _ended(_started(["-c", WORK], cache)) == compiled
    assert before == {entry: (entry.stat().st_mtime_ns, entry.read_bytes()) for entry in _entries(cache)}
    for entry in before:
        entry.write_bytes(before[entry][1][:40])  # as a kill in the middle of writing leaves it
    assert _ended(_started(["-c", WORK], cache)) == compiled
    work = next(entry for entry in before if "jit_work" in entry.name)
    assert len(work.read_bytes()) > 0.9 * len(before[work][1])  # replaced: the next process finds it


SCENE = ROOT / "experiments" / "scenes" / "box_pull.toml"


@pytest.mark.slow
def test_a_scene_ends_with_the_same_bits_from_disk(tmp_path):
    """Compiled without a cache, compiled for it, and read from it."""
    found = []
    for cache in ("off", tmp_path / "kept", tmp_path / "kept"):
        _ended(_started(["-m", "liverjax", "simulate", str(SCENE), "--out", str(tmp_path)], cache))
        with h5py.File(tmp_path / "result.h5") as file:
            found.append(np.asarray(file["positions"]).tobytes())
    assert found[0] == found[1] == found[2]
    assert any("jit_simulate_part" in entry.name for entry in _entries(tmp_path / "kept"))


def test_commands_keep_their_programs(switched):
    told = []
    exit_code(lambda _: told.append(jax.config.jax_compilation_cache_dir) or 0, argparse.Namespace())
    assert Path(told[0]).parent == switched and Path(told[0]).is_dir()


@pytest.mark.parametrize("cache", ["off", "OFF", "/dev/null/no/folder"])
def test_no_cache_is_no_error(switched, monkeypatch, cache):
    monkeypatch.setenv(programs.SWITCH, cache)
    before = jax.config.jax_compilation_cache_dir
    with programs.kept_on_disk() as folder:
        assert folder is None and jax.config.jax_compilation_cache_dir == before
    assert not switched.exists()


def test_the_import_switches_nothing_on():
    told = "import liverjax, fitting, jax; print(jax.config.jax_compilation_cache_dir)"
    environment = {k: v for k, v in os.environ.items() if not k.startswith("JAX_COMPILATION")}
    environment.pop(programs.SWITCH)
    run = subprocess.run([sys.executable, "-c", told], cwd=ROOT, env=environment, capture_output=True, text=True)
    assert run.stdout.strip() == "None", run.stderr


def test_a_folder_given_to_jax_stays(switched, monkeypatch):
    monkeypatch.setenv("JAX_COMPILATION_CACHE_DIR", "mine")
    before = jax.config.jax_compilation_cache_dir
    with programs.kept_on_disk() as folder:
        assert folder is None and jax.config.jax_compilation_cache_dir == before
    assert not switched.exists()


def test_the_user_cache_follows_the_platform(monkeypatch, tmp_path):
    monkeypatch.setattr(sys, "platform", "linux")
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    assert programs._user_cache() == tmp_path
    monkeypatch.setenv("XDG_CACHE_HOME", "relative")
    assert programs._user_cache() == Path.home() / ".cache"
    monkeypatch.setattr(sys, "platform", "darwin")
    assert programs._user_cache() == Path.home() / "Library" / "Caches"
    monkeypatch.setattr(sys, "platform", "win32")
    monkeypatch.setenv("LOCALAPPDATA", str(tmp_path))
    assert programs._user_cache() == tmp_path


def test_another_source_or_processor_has_another_folder(monkeypatch, tmp_path):
    here = programs._name()
    assert here == programs._name() and f"jax{jax.__version__}-" in here
    monkeypatch.setattr(programs, "_processor", lambda: "another")
    assert programs._name() != here
    monkeypatch.undo()
    package = tmp_path / "liverjax"
    package.mkdir()
    (package / "__init__.py").write_text("")
    monkeypatch.setattr(importlib.import_module("liverjax"), "__file__", str(package / "__init__.py"))
    empty = programs._name()
    (package / "law.py").write_text("one = 1\n")
    assert len({here, empty, programs._name()}) == 3


def test_what_was_longest_not_used_goes_first(tmp_path):
    folders = [tmp_path / "old", tmp_path / "new"]
    for k in range(6):
        folders[k % 2].mkdir(exist_ok=True)
        entry = folders[k % 2] / f"jit_f-{k}-cache"
        entry.write_bytes(bytes(100))
        os.utime(entry, (1000 - k, 500))  # the first was read last
    mine = tmp_path / "old" / "notes.txt"
    mine.write_text("mine")
    programs.bound(tmp_path, 350)
    assert {entry.name for entry in _entries(tmp_path)} == {f"jit_f-{k}-cache" for k in range(3)}
    assert mine.exists()
    programs.bound(tmp_path, 350)
    assert len(_entries(tmp_path)) == 3


def test_other_warnings_are_shown(switched):
    with programs.kept_on_disk(), pytest.warns(UserWarning, match="mine"):
        warnings.warn("mine", stacklevel=1)
