"""Files of other laboratories: each is read without changes, and spoiled ones give a one-line message."""

import numpy as np
import pytest
from conftest import SHARED

from fitting.readers import time_tests
from fitting.readers.rheometer import read_sweep
from liverjax import InputError

FOLDER = SHARED / "data"
pytestmark = pytest.mark.skipif(not (FOLDER / "rheology").is_dir(), reason="the measured files are not here")

SWEEPS = (
    *(f"lions_mane/lion-frequency-inplane-{k}.csv" for k in range(1, 11)),
    *(f"rheology/lions_mane/frequency-inplane-{k}.xls" for k in (1, 2)),
    *(f"rheology/pyrheo/oscillation_{name}_data.csv" for name in ("chia", "ps160", "ps190")),
    "rheology/pyrheo/epstein.csv",
    *(f"rheology/rheojax/{name}.txt" for name in ("frequency_sweep_tts", "multi_technique")),
)
RELAXATION = (
    *(f"rheology/pyrheo/HC1_stressrelaxation_20C_{k}.csv" for k in (2, 3, 5, 6, 7, 8, 9, 10, 11, 12)),
    *(f"rheology/pyrheo/stressrelaxation_{name}_data.csv" for name in ("fishmuscle", "ps160", "ps190")),
)
CREEP = tuple(f"rheology/pyrheo/creep_{name}_data.csv" for name in ("mucus", "perihepatic", "ps160", "ps190"))
FILES = [*((f, "sweep") for f in SWEEPS), *((f, "relaxation") for f in RELAXATION), *((f, "creep") for f in CREEP)]


def read(path, kind):
    return read_sweep(path) if kind == "sweep" else time_tests.read_time_test(path, kind)


@pytest.mark.parametrize(("file", "kind"), FILES)
def test_it_is_read_without_an_edit(file, kind):
    if file.endswith(".xls"):
        pytest.importorskip("python_calamine")
    found = read(FOLDER / file, kind)
    if kind == "sweep":
        assert len(found.angular_frequency) >= 6 and np.all(found.storage > 0) and np.all(found.loss > 0)
    else:
        assert found.used.sum() >= 10 and np.all(np.diff(found.time) > 0) and found.kind == kind


def spoiled(data: bytes, rng: np.random.Generator) -> bytes:
    """Return the data cut, overwritten, without some lines, or with a word instead of a number."""
    out, way = bytearray(data), rng.integers(4)
    if way == 0:
        del out[rng.integers(1, len(out)) :]
    elif way == 1:
        for place in rng.integers(len(out), size=rng.integers(1, 40)):
            out[place] = rng.integers(256)
    elif way == 2:
        lines = bytes(out).split(b"\n")
        out = bytearray(b"\n".join(line for line in lines if rng.random() > 0.3))
    else:
        place = int(rng.integers(len(out)))
        out[place : place + 6] = rng.choice([b"--", b"n/a", b"1e999", b"-5", b"\t\t\t", b'"', b"\x00", b","])
    return bytes(out)


@pytest.mark.ci
def test_two_hundred_spoiled_files_are_read_or_get_one_sentence(tmp_path):
    rng = np.random.default_rng(7)
    small = [(f, kind) for f, kind in FILES if (FOLDER / f).stat().st_size < 50_000]
    refused = 0
    for k in range(200):
        file, kind = small[k % len(small)]
        path = tmp_path / ("spoiled" + file[-4:])
        path.write_bytes(spoiled((FOLDER / file).read_bytes(), rng))
        try:
            read(path, kind)
        except InputError as error:
            refused += 1
            assert "\n" not in str(error) and 20 < len(str(error)) < 600, f"{file}: {error}"
    assert 20 < refused < 200
