"""The command that trains and uses a reduced model; one-line messages for invalid input."""

import argparse
import inspect
from types import SimpleNamespace

import h5py
import numpy as np
import pytest

import liverjax as lj
from liverjax.__main__ import main
from liverjax.commands import reduce
from liverjax.jobs import reduction

pytestmark = pytest.mark.quick_to_compile


SCENE = """
[mesh]
shape = "box"
size = [0.03, 0.01, 0.01]
cells = [3, 1, 1]

[law]
name = "neo_hookean"
mu = 800.0
bulk = 3000.0

[body]
density = 1000.0
gravity = [0.0, 0.0, -1.0]

[[fixed]]
where = {x_max = 0.0}

[solve]
"""


@pytest.mark.ci
def test_the_commands_make_and_use_a_model_and_turn_to_the_full_one(tmp_path, capsys):
    (tmp_path / "scene.toml").write_text(SCENE)
    (tmp_path / "rows.csv").write_text("law.mu,body.gravity.2\n700,-1.2\n900,-0.8\n800,-0.4\n800,-1.0\n")
    model = ["--out", str(tmp_path / "model.h5")]
    assert main(["reduce", str(tmp_path / "scene.toml"), str(tmp_path / "rows.csv"), *model, "--modes", "3"]) == 0
    assert (
        "3 modes" in (said := capsys.readouterr().out)
        and "no correction, because there were too few training runs" in said
    )
    found = {}
    for name, lines in (("full", ""), ("used", 'reduced = "model.h5"'), ("refused", REFUSED)):
        (tmp_path / f"{name}.toml").write_text(SCENE + lines)
        assert main(["simulate", str(tmp_path / f"{name}.toml"), "--out", str(tmp_path / name)]) == 0
        said = capsys.readouterr().out
        assert ("estimated error" in said) == (name != "full") and ("the full model runs" in said) == (
            name == "refused"
        )
        with h5py.File(tmp_path / name / "result.h5") as file:
            found[name] = file["positions"][()], file["reactions"][()].sum(axis=(0, 1))
    assert np.array_equal(found["full"][0], found["refused"][0])
    moved = np.abs(found["full"][0] - found["full"][0][0, :1]).max()
    assert 0 < np.abs(found["used"][0] - found["full"][0]).max() < 0.01 * moved
    # In both models the fixed nodes carry the weight: 3 g of tissue.
    assert np.allclose(found["full"][1], [0, 0, 3e-3], rtol=0, atol=1e-9)
    # A reduced run does not discard an interrupted run in the same folder.
    (tmp_path / "used" / "result.h5.parts").mkdir()
    assert main(["simulate", str(tmp_path / "used.toml"), "--out", str(tmp_path / "used")]) == 2
    assert "contains an unfinished run" in capsys.readouterr().err and (tmp_path / "used" / "result.h5.parts").exists()


def test_the_command_has_the_defaults_of_the_function():
    parsers = argparse.ArgumentParser().add_subparsers()
    reduce.add(parsers)
    found = parsers.choices["reduce"].parse_args(["scene.toml", "rows.csv"])
    defaults = inspect.signature(lj.reduce_scene).parameters
    for option, argument in (("tolerance", "tolerance"), ("modes", "most_modes"), ("runs", "runs")):
        assert getattr(found, option) == defaults[argument].default


@pytest.mark.slow
def test_one_row_makes_a_model_without_correction(tmp_path, capsys):
    (tmp_path / "scene.toml").write_text(SCENE)
    (tmp_path / "row.csv").write_text("law.mu\n800\n")
    arguments = [str(tmp_path / "scene.toml"), str(tmp_path / "row.csv"), "--out", str(tmp_path / "model.h5")]
    assert main(["reduce", *arguments]) == 0
    assert (
        "1 modes" in (said := capsys.readouterr().out)
        and "no correction, because there were too few training runs" in said
    )
    assert lj.load_reduced(tmp_path / "model.h5").correction is None


def test_a_model_is_not_written_over_a_folder(tmp_path, capsys):
    """The path is checked before the runs."""
    (tmp_path / "scene.toml").write_text(SCENE)
    (tmp_path / "row.csv").write_text("law.mu\n800\n")
    arguments = [str(tmp_path / "scene.toml"), str(tmp_path / "row.csv"), "--out", str(tmp_path)]
    assert main(["reduce", *arguments]) == 2 and "is a folder: name a file" in capsys.readouterr().err


@pytest.mark.parametrize("name", ["scene.toml", "row.csv", "notes.txt"])
def test_a_model_is_not_written_over_another_file(name, tmp_path, monkeypatch, capsys):
    """The scene file itself was replaced by the model."""
    (tmp_path / "scene.toml").write_text(SCENE)
    (tmp_path / "row.csv").write_text("law.mu\n800\n")
    (tmp_path / "notes.txt").write_text("mine")
    before = (tmp_path / name).read_text()
    monkeypatch.setattr(reduction, "reduce_scene", lambda *_, **__: pytest.fail("the runs begin"))
    arguments = [str(tmp_path / "scene.toml"), str(tmp_path / "row.csv"), "--out", str(tmp_path / name)]
    assert main(["reduce", *arguments]) == 2 and (tmp_path / name).read_text() == before
    assert "exists, and is not a reduced model: name another file for the model, or remove" in capsys.readouterr().err


@pytest.mark.parametrize("names", [("modes", "weights"), ("modes",)])
def test_an_incomplete_model_may_be_replaced(names, tmp_path, monkeypatch):
    """`simulate` advised to make the model again, but `reduce` refused to replace it. Another HDF5 file stays."""
    (tmp_path / "scene.toml").write_text(SCENE)
    (tmp_path / "row.csv").write_text("law.mu\n800\n")
    with h5py.File(tmp_path / "model.h5", "w") as file:
        for name in names:
            file[name] = [1.0]
    begun = []
    monkeypatch.setattr(reduction, "reduce_scene", lambda *_, **__: begun.append(1))
    monkeypatch.setattr(reduction, "save_reduced", lambda *_: None)
    reduction_of = (tmp_path / "scene.toml", tmp_path / "row.csv", tmp_path / "model.h5", 0.01, 5)
    if len(names) == 2:
        reduction.make(*reduction_of)
    else:
        with pytest.raises(lj.InputError, match="or remove this file"):
            reduction.make(*reduction_of)
    assert len(begun) == len(names) - 1


def test_the_command_tells_the_path_of_the_model_from_the_scene(tmp_path, monkeypatch, capsys):
    """The path from the folder of the command was printed, and [solve] of the scene did not find the model."""
    (tmp_path / "scenes").mkdir()
    monkeypatch.chdir(tmp_path)
    model = SimpleNamespace(number_of_modes=3, points=[1], correction=None)
    monkeypatch.setattr(reduction, "make", lambda *_: model)
    assert main(["reduce", "scenes/scene.toml", "rows.csv", "--out", "models/m.h5"]) == 0
    assert 'write reduced = "../models/m.h5" in [solve]' in capsys.readouterr().out


def test_a_cell_that_is_too_long_for_a_table_is_told(tmp_path, capsys):
    (tmp_path / "scene.toml").write_text(SCENE)
    (tmp_path / "row.csv").write_text(f"law.mu\n{200_000 * '1'}\n")
    assert main(["reduce", str(tmp_path / "scene.toml"), str(tmp_path / "row.csv")]) == 2
    assert "row.csv is not a table (field larger than field limit" in capsys.readouterr().err


REFUSED = """
reduced = "model.h5"
reduced_tolerance = 1e-9
"""


def test_an_empty_name_is_no_reduced_model(tmp_path):
    """The folder of the scene was put before the empty name, and was then taken for the model."""
    (tmp_path / "scene.toml").write_text(SCENE + 'reduced = ""\n')
    assert lj.load_scene(tmp_path / "scene.toml").solve.reduced == ""


def test_a_model_on_another_drive_has_its_whole_path(monkeypatch, tmp_path, capsys):
    """On Windows, the last line of the command was a traceback."""

    def refused(*_):
        raise ValueError("path is on mount 'D:', start on mount 'C:'")

    monkeypatch.setattr(reduce.os.path, "relpath", refused)
    model = SimpleNamespace(number_of_modes=1, points=[0])
    monkeypatch.setattr(reduction, "make", lambda *_: model)
    monkeypatch.setattr(reduction, "learnt", lambda _: "no correction")
    options = argparse.Namespace(scene=tmp_path / "a.toml", rows=None, out=tmp_path / "m.h5", tolerance=1, modes=1)
    options.runs = None
    assert reduce.run(options) == 0
    assert f'reduced = "{(tmp_path / "m.h5").resolve().as_posix()}"' in capsys.readouterr().out
