"""Five hundred spoiled files: each gives a one-line message or is read correctly, without a traceback or
endless loop.
"""

import random
import re
import warnings
from pathlib import Path

import meshio
import numpy as np
import pytest

import liverjax as lj
from fitting.methods.generalised_maxwell import refuse_impossible
from fitting.readers.rheometer import read_sweep
from liverjax.jobs import sweep
from liverjax.mesh import shapes
from liverjax.scenes.scene_file import load_scene

pytestmark = pytest.mark.quick_to_compile

SCENE = """[mesh]
file = "body.vtk"
[law]
name = "mooney_rivlin"
c10 = 300.0
c01 = 50.0
bulk = 2200.0
[viscosity]
ratios = [0.235, 0.333]
relaxation_times = [0.27, 0.03]
[porosity]
bulk = 400.0
limit_bulk = 2200.0
fluid_fraction = 0.5
permeability = 2.0e-5
drained = {z_max = 0.0}
[body]
density = 1060.0
gravity = [0, 0, -2.0]
[[fixed]]
where = {z_max = 0.0}
[[displaced]]
where = {z_min = 0.1}
by = [0.01, 0.0, 0.0]
axes = "xy"
[[traction]]
where = {z_min = 0.1}
value = [0.0, 0.0, 5.0]
[solve]
kind = "dynamic"
dt = 0.05
steps = 4
tolerance = 1e-6
"""
SWEEP = Path(__file__).parent.parent / "data" / "lions_mane_frequency_sweep.csv"
ROWS = "law.c10,body.density\n" + "".join(f"{300 + k},{1000 + k}\n" for k in range(6))
WORDS = ("nan", "inf", "-inf", "-1", "0", "1e308", "-1e308", "1e-320", '"text"', "true", "[]", "[1.0]", "{}", "''", "")
#: One line: what is wrong, then what to do.
SENTENCE = re.compile(r"\S[^\n]+[:;,(][^\n]+\S")


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """A folder with a scene, its mesh, a table of parameter sets and a rheometer's sweep."""
    made = tmp_path_factory.mktemp("sound")
    mesh = shapes.box((0.1, 0.1, 0.1), (2, 2, 2))
    meshio.Mesh(np.asarray(mesh.points), [("tetra", np.asarray(mesh.tetrahedra))]).write(
        made / "body.vtk", binary=False
    )
    (made / "scene.toml").write_text(SCENE)
    (made / "rows.csv").write_text(ROWS)
    return made


def spoiled(text: str, rng: random.Random) -> bytes:
    """Change one thing: a number, a word, a line, a cut, swapped lines, or random bytes."""
    lines, kind = text.split("\n"), rng.randrange(8)
    k = rng.randrange(len(lines))
    if kind <= 2:  # a number becomes something else
        places = list(re.finditer(r"-?\d+\.?\d*(e-?\d+)?", text))
        m = rng.choice(places)
        return (text[: m.start()] + rng.choice(WORDS) + text[m.end() :]).encode()
    if kind == 3:
        del lines[k]
    elif kind == 4:
        lines.insert(k, rng.choice(lines))
    elif kind == 5:
        other = rng.randrange(len(lines))
        lines[k], lines[other] = lines[other], lines[k]
    elif kind == 6:
        return text[: rng.randrange(len(text))].encode()
    else:
        raw = bytearray(text.encode())
        for _ in range(rng.randrange(1, 9)):
            raw[rng.randrange(len(raw))] = rng.randrange(256)
        return bytes(raw)
    return "\n".join(lines).encode()


def sound(scene: lj.Scene) -> None:
    """Check that all values are finite and in the range of a body."""
    for value in (scene.mesh.points, scene.mesh.volumes, scene.law.c10, scene.law.c01):
        assert np.isfinite(value).all()
    assert (np.asarray(scene.mesh.volumes) > 0).all()
    if scene.viscosity is not None:
        assert np.sum(scene.viscosity.ratios) < 1 and (np.asarray(scene.viscosity.relaxation_times) > 0).all()
    if scene.body is not None:
        assert scene.body.density > 0 and np.isfinite(scene.body.gravity).all()
    assert scene.solve.steps >= 1 and scene.solve.tolerance > 0


def refused_or(read, check, what: bytes) -> bool:
    """Return whether `read` raised a one-line message. Anything but a message or a sound result fails the test."""
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # large numbers cause warnings
            found = read()
    except lj.InputError as error:
        said = str(error)
        assert SENTENCE.fullmatch(said) and len(said) < 1000, (what, said)
        return True
    except Exception as error:
        raise AssertionError(f"{what!r} raised {error!r}") from error
    check(found)
    return False


@pytest.mark.parametrize("seed", range(5))
def test_spoiled_scenes(folder, tmp_path, seed):
    rng, refused = random.Random(seed), 0
    for name in ("body.vtk",):
        (tmp_path / name).write_bytes((folder / name).read_bytes())
    for _ in range(50):
        content = spoiled(SCENE, rng)
        (tmp_path / "scene.toml").write_bytes(content)
        refused += refused_or(lambda: load_scene(tmp_path / "scene.toml"), sound, content)
    assert refused > 15


@pytest.mark.parametrize("seed", range(2))
def test_spoiled_meshes(folder, tmp_path, seed):
    rng, refused = random.Random(100 + seed), 0
    text = (folder / "body.vtk").read_text()
    (tmp_path / "scene.toml").write_text(SCENE)

    def check(mesh):
        assert np.isfinite(mesh.points).all() and (np.asarray(mesh.volumes) > 0).all()

    for _ in range(50):
        content = spoiled(text, rng)
        (tmp_path / "body.vtk").write_bytes(content)
        refused += refused_or(lambda: lj.read_mesh(tmp_path / "body.vtk"), check, content[:200])
    assert refused > 15


def test_spoiled_tables(folder, tmp_path):
    rng, refused = random.Random(7), 0
    for name in ("body.vtk", "scene.toml"):
        (tmp_path / name).write_bytes((folder / name).read_bytes())
    for _ in range(75):
        content = spoiled(ROWS, rng)
        (tmp_path / "rows.csv").write_bytes(content)
        refused += refused_or(
            lambda: sweep.read_table(tmp_path / "rows.csv"),
            lambda found: np.testing.assert_array_equal(np.isfinite(found[1]), True),
            content,
        )
    assert refused > 10


def test_spoiled_sweeps_of_a_rheometer(tmp_path):
    rng, refused = random.Random(8), 0
    text = SWEEP.read_text()

    def check(found):
        for values in (found.angular_frequency, found.storage, found.loss):
            assert np.isfinite(values).all() and (np.asarray(values) > 0).all()

    def read():
        found = read_sweep(tmp_path / "sweep.csv")
        refuse_impossible(found)
        return found

    for _ in range(75):
        content = spoiled(text, rng)
        (tmp_path / "sweep.csv").write_bytes(content)
        refused += refused_or(read, check, content)
    assert refused > 5
