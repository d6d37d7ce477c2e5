"""Tables of parameters for sweeps: ranges, kinds, and files that are not overwritten."""

import numpy as np
import pytest

from liverjax.__main__ import main
from liverjax.jobs import design, sweep

pytestmark = pytest.mark.quick_to_compile


@pytest.mark.parametrize("kind, rows", [("grid", 9), ("latin", 10), ("sobol", 8)])
def test_designs(tmp_path, kind, rows):
    table = tmp_path / "design.csv"
    ranges = ["law.mu=500:1000", "body.density=1000:1100"]
    assert main(["design", str(table), *ranges, "--kind", kind, "--rows", str(rows), "--seed", "3"]) == 0
    assert table.read_text().startswith("# grid\n" if kind == "grid" else f"# {kind}, seed 3\n")
    names, found = sweep.read_table(table)
    assert names == ("law.mu", "body.density") and found.shape == (rows, 2)
    assert (found.min(axis=0) >= [500, 1000]).all() and (found.max(axis=0) <= [1000, 1100]).all()
    again = design.design(design.read_ranges(ranges), rows, kind, 3)
    assert np.array_equal(found, again)


def test_unusable_designs_are_refused(tmp_path, capsys):
    for given, sentence in (
        (["law.mu=5"], "is not a range"),
        (["law.mu=5:1"], "does not rise"),
        (["law.mu=-1e308:1e308"], "too wide"),
        (["a,b=1:2"], "contains no dotted name"),
        (["a=1:2", "a=1:2"], "two"),
        (["a=1:2", "--seed", "-1"], "--seed -1 is negative"),
        (["a=1:2", "b=1:2", "--kind", "grid", "--rows", "3"], "too few for a grid of 2 parameters: give 4"),
    ):
        assert main(["design", str(tmp_path / "d.csv"), *given]) == 2
        assert sentence in capsys.readouterr().err


def test_a_table_is_not_written_over_other_files(tmp_path, capsys):
    scene = '[mesh]\nshape = "box"\n'
    (tmp_path / "scene.toml").write_text(scene)
    assert main(["design", str(tmp_path / "scene.toml"), "law.mu=500:600"]) == 2
    assert (
        "is not a table of `liverjax design`" in capsys.readouterr().err
        and (tmp_path / "scene.toml").read_text() == scene
    )
    (tmp_path / "d.csv").touch()  # an empty file is not another table
    for rows in ("2", "4"):
        assert main(["design", str(tmp_path / "d.csv"), "law.mu=500:600", "--rows", rows]) == 0
        assert len(sweep.read_table(tmp_path / "d.csv")[1]) == int(rows)
