"""Compiled programs kept on disk: which runs use them, equal bits, broken entries, limit of the size."""

import argparse
import importlib
import os
import subprocess
import sys
import warnings
from functools import partial
from pathlib import Path

import h5py
import jax
import numpy as np
import pytest
from conftest import ROOT

import liverjax as lj
from liverjax.commands.exit_codes import exit_code
from liverjax.core import compiled as compiled_module
from liverjax.core import program_cache
from liverjax.core.compiled import _found, compiled
from liverjax.core.struct import replace
from liverjax.elements import mjed

#: A program that takes longer to compile than to find, in a process like that of a command. It prints its results.
WORK = """
import jax, jax.numpy as jnp
import liverjax
from liverjax.core.program_cache import kept_on_disk
def work(x):
    return jnp.linalg.inv(jnp.sin(x) @ jnp.cos(x).T + 9 * jnp.eye(7)) @ jnp.exp(x)
with kept_on_disk():
    print(jax.jit(work)(jnp.arange(49.0).reshape(7, 7) / 50).tobytes().hex())
"""


@pytest.fixture
def switched(monkeypatch, tmp_path) -> Path:
    """Set the folder that `LIVERJAX_CACHE` names. JAX's earlier settings are restored afterwards."""
    before = {name: getattr(jax.config, name) for name in CONFIGURED}
    monkeypatch.delenv("JAX_COMPILATION_CACHE_DIR")
    monkeypatch.setenv(program_cache.SWITCH, str(tmp_path / "kept"))
    yield tmp_path / "kept"
    for name, value in before.items():
        jax.config.update(name, value)


CONFIGURED = ("jax_compilation_cache_dir", "jax_persistent_cache_min_compile_time_secs", "jax_logging_level")


def _started(command: list[str], cache: str | Path) -> subprocess.Popen:
    """Start a separate process, without the cache folder that these tests give to JAX."""
    environment = {k: v for k, v in os.environ.items() if not k.startswith(("JAX_COMPILATION", "JAX_PERSISTENT"))}
    return subprocess.Popen(
        [sys.executable, "-W", "error", *command],
        cwd=ROOT,
        env=environment | {program_cache.SWITCH: str(cache)},
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )


def _ended(process: subprocess.Popen) -> str:
    """Return what a process printed, after a check of its exit code and of an empty standard error."""
    out, said = process.communicate()
    assert process.returncode == 0 and said == "", said
    return out


def _entries(cache: Path) -> list[Path]:
    return sorted(cache.glob("*/*-cache"))


@pytest.mark.ci
def test_a_second_process_finds_the_programs_and_the_same_bits(tmp_path):
    """Two processes compile at once, one reads, and one finds every entry spoiled. None writes to standard error."""
    cache = tmp_path / "kept"
    both = [_started(["-c", WORK], cache) for _ in range(2)]
    compiled, other = (_ended(process) for process in both)
    before = {entry: (entry.stat().st_mtime_ns, entry.read_bytes()) for entry in _entries(cache)}
    assert compiled == other and any("jit_work" in entry.name for entry in before)
    assert _ended(_started(["-c", WORK], cache)) == compiled
    # A busy machine may keep one more small program, because its compilation took long.
    assert before == {entry: (entry.stat().st_mtime_ns, entry.read_bytes()) for entry in before}
    for entry in before:
        entry.write_bytes(before[entry][1][:40])  # as a kill during writing leaves it
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
    assert any("simulate_part" in entry.name for entry in _entries(tmp_path / "kept"))


def test_commands_keep_their_programs(switched):
    told = []
    exit_code(lambda _: told.append(jax.config.jax_compilation_cache_dir) or 0, argparse.Namespace())
    assert Path(told[0]).parent == switched and Path(told[0]).is_dir()


@pytest.mark.parametrize("cache", ["off", "OFF", "/dev/null/no/folder"])
def test_no_cache_is_no_error(switched, monkeypatch, cache):
    monkeypatch.setenv(program_cache.SWITCH, cache)
    before = jax.config.jax_compilation_cache_dir
    with program_cache.kept_on_disk() as folder:
        assert folder is None and jax.config.jax_compilation_cache_dir == before
    assert not switched.exists()


def test_a_folder_given_to_jax_stays(switched, monkeypatch):
    monkeypatch.setenv("JAX_COMPILATION_CACHE_DIR", "mine")
    before = jax.config.jax_compilation_cache_dir
    with program_cache.kept_on_disk() as folder:
        assert folder is None and jax.config.jax_compilation_cache_dir == before
    assert not switched.exists()


def test_the_user_cache_follows_the_platform(monkeypatch, tmp_path):
    monkeypatch.setattr(sys, "platform", "linux")
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    assert program_cache._user_cache() == tmp_path
    monkeypatch.setenv("XDG_CACHE_HOME", "relative")
    assert program_cache._user_cache() == Path.home() / ".cache"
    monkeypatch.setattr(sys, "platform", "darwin")
    assert program_cache._user_cache() == Path.home() / "Library" / "Caches"
    monkeypatch.setattr(sys, "platform", "win32")
    monkeypatch.setenv("LOCALAPPDATA", str(tmp_path))
    assert program_cache._user_cache() == tmp_path


def test_another_source_or_processor_has_another_folder(monkeypatch, tmp_path):
    here = program_cache._name()
    assert here == program_cache._name() and f"jax{jax.__version__}-" in here
    monkeypatch.setattr(program_cache, "_processor", lambda: "another")
    assert program_cache._name() != here
    monkeypatch.undo()
    package = tmp_path / "liverjax"
    package.mkdir()
    (package / "__init__.py").write_text("")
    monkeypatch.setattr(importlib.import_module("liverjax"), "__file__", str(package / "__init__.py"))
    empty = program_cache._name()
    (package / "law.py").write_text("one = 1\n")
    assert len({here, empty, program_cache._name()}) == 3


def test_what_was_longest_not_used_goes_first(tmp_path):
    folders = [tmp_path / "old", tmp_path / "new"]
    for k in range(6):
        folders[k % 2].mkdir(exist_ok=True)
        entry = folders[k % 2] / f"jit_f-{k}-cache"
        entry.write_bytes(bytes(100))
        os.utime(entry, (1000 - k, 500))  # the first entry was read last
    mine = tmp_path / "old" / "notes.txt"
    mine.write_text("mine")
    program_cache.bound(tmp_path, 350)
    assert {entry.name for entry in _entries(tmp_path)} == {f"jit_f-{k}-cache" for k in range(3)}
    assert mine.exists()
    program_cache.bound(tmp_path, 350)
    assert len(_entries(tmp_path)) == 3


@pytest.fixture
def cube():
    """Return a mesh, a law and positions."""
    mesh = lj.shapes.box((1.0, 1.0, 1.0), (1, 1, 1))
    return mesh, lj.laws.typical("neo_hookean"), 1.1 * mesh.points


def _whole(folder: Path) -> list[Path]:
    return sorted(folder.glob("*/whole_*-cache"))


def test_a_whole_program_is_found_without_being_traced(processor, switched, cube, monkeypatch):
    (mesh, law, x), traced = cube, []
    energy = type(law).strain_energy
    monkeypatch.setattr(type(law), "strain_energy", lambda self, m: traced.append(1) or energy(self, m))
    with program_cache.kept_on_disk():
        first = compiled(mjed.energy, mesh, law, x)(mesh, law, x)
        assert traced
        (file,) = _whole(switched)
        content = file.read_bytes()
        found = _found(file)
        assert found is not None and found(mesh, law, x).tobytes() == first.tobytes()
        traced.clear()
        assert compiled(mjed.energy, mesh, law, x)(mesh, law, x).tobytes() == first.tobytes()
        assert not traced
        harder = replace(law, mu=2 * law.mu)
        expected = mjed.energy(mesh, harder, x)
        assert np.isclose(compiled(mjed.energy, mesh, harder, x)(mesh, harder, x), expected, rtol=1e-14)
        assert _whole(switched) == [file]  # other values use the same program
        file.write_bytes(content[:100])
        assert compiled(mjed.energy, mesh, law, x)(mesh, law, x).tobytes() == first.tobytes()
        assert len(file.read_bytes()) > 0.9 * len(content)  # the entry is replaced
    assert program_cache.folder() is None


def test_what_decides_a_program_is_in_its_name(switched, cube, monkeypatch):
    mesh, law, x = cube
    names = [compiled_module._key(mjed.energy, (mesh, law, x))]
    larger = lj.shapes.box((1.0, 1.0, 1.0), (2, 1, 1))
    names.append(compiled_module._key(mjed.energy, (larger, law, larger.points)))
    names.append(compiled_module._key(mjed.energy, (mesh, replace(law, volumetric="log"), x)))
    names.append(compiled_module._key(mjed.energy, (mesh, lj.laws.typical("yeoh"), x)))
    names.append(compiled_module._key(mjed.energy, (mesh, law, x.astype("float32"))))
    names.append(compiled_module._key(partial(mjed.energy, terms="chapter"), (mesh, law, x)))
    names += [compiled_module._key(partial(mjed.energy, one=f), (mesh, law, x)) for f in (mjed.energy, exit_code)]
    names.append(compiled_module._key(mjed.energy, (mesh, law, x), {"xla_cpu_use_fusion_emitters": False}))
    with pytest.raises(compiled_module._Unknown):  # the values in a closure are not visible in its source
        compiled_module._key(partial(mjed.energy, one=lambda: mesh), (mesh, law, x))
    monkeypatch.setenv("XLA_FLAGS", "--xla_cpu_enable_fast_math=true")
    names.append(compiled_module._key(mjed.energy, (mesh, law, x)))
    assert len(set(names)) == len(names)


@lj.struct
class Mine(lj.Law):
    """W = mu/2 (Ibar1 - 3), in a file that no digest contains."""

    mu: float = lj.param("Pa")
    bulk: float = lj.param("Pa")
    volumetric: str = lj.static("quadratic")

    def isochoric_energy(self, I1, I2):
        return self.mu / 2 * (I1 - 3)


def test_a_law_of_ones_own_is_compiled_as_it_is_now(switched, cube):
    mesh, law, x = cube
    with program_cache.kept_on_disk():
        mine = Mine(mu=law.mu, bulk=law.bulk)
        energy = compiled(mjed.energy, mesh, mine, x)(mesh, mine, x)
        assert np.isclose(energy, mjed.energy(mesh, law, x), rtol=1e-14)
        assert not _whole(switched)


#: A program that calls LAPACK. JAX gives LAPACK's addresses to XLA when it lowers a factorisation.
FACTORISES = """
import jax.numpy as jnp, liverjax
from fitting.methods.least_squares import accept, begin
from liverjax.core.compiled import compiled
from liverjax.core.program_cache import kept_on_disk
state, r, J = begin(jnp.ones(2), 3), jnp.arange(3.0), jnp.arange(6.0).reshape(3, 2) ** 2
with kept_on_disk():
    print(compiled(accept, state, r, J)(state, r, J).trial.tobytes().hex())
"""


@pytest.mark.ci
def test_a_program_that_factorises_runs_from_disk(processor, tmp_path):
    first, second = (_ended(_started(["-c", FACTORISES], tmp_path)) for _ in range(2))
    assert first == second and _whole(tmp_path)


def test_other_warnings_are_shown(switched):
    with program_cache.kept_on_disk(), pytest.warns(UserWarning, match="mine"):
        warnings.warn("mine", stacklevel=1)
