"""The installed JAX computes element loops correctly, and the package sets what it says it sets."""

import subprocess
import sys

import jax
import jax.numpy as jnp
import pytest
from conftest import ROOT


@pytest.mark.parametrize(("dtype", "n"), [(jnp.float64, 16385), (jnp.float32, 32769)])
def test_known_miscompilation_is_absent(dtype, n):
    # jax issue 39103: 0.10.2 answers 267911424 for 268435456 in the last row.
    i = jnp.arange(n, dtype=dtype)
    x = jnp.stack((i, jnp.zeros_like(i), jnp.zeros_like(i)), axis=1)
    matrix = jnp.eye(3, dtype=dtype)
    result = jax.jit(jax.vmap(lambda row: jnp.sum((matrix @ row) ** 2)))(x)
    assert float(result[-1]) == float((n - 1) ** 2)


@pytest.mark.parametrize("release", ["0.10.2", "0.11.0"])
def test_affected_release_is_refused(release):
    code = f"import jax; jax.__version__ = {release!r}\nimport liverjax"
    run = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True)
    assert run.returncode != 0 and f"jax {release}" in run.stderr and "pip install" in run.stderr


@pytest.mark.parametrize(("setting", "expected"), [(None, "True"), ("0", "False")])
def test_import_turns_on_64_bits_unless_the_user_chose(setting, expected, monkeypatch):
    monkeypatch.delenv("JAX_ENABLE_X64", raising=False)
    if setting is not None:
        monkeypatch.setenv("JAX_ENABLE_X64", setting)
    code = "import liverjax, jax; print(jax.config.jax_enable_x64)"
    run = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True, check=True)
    assert run.stdout.strip() == expected


def test_types_are_checked():
    run = subprocess.run([sys.executable, "-m", "mypy"], cwd=ROOT, capture_output=True, text=True)
    assert run.returncode == 0, run.stdout


def test_code_is_formatted_and_linted():
    for command in (["check"], ["format", "--check"]):
        run = subprocess.run([sys.executable, "-m", "ruff", *command, "."], cwd=ROOT, capture_output=True, text=True)
        assert run.returncode == 0, run.stdout
