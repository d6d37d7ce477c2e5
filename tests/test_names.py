"""Dotted names of scene files, and files that are written completely or not at all."""

import os

import numpy as np
import pytest

import liverjax as lj
from liverjax.core import names
from liverjax.core.did_you_mean import hint
from liverjax.core.files import whole

LAW = lj.laws.Sum(
    laws=(
        lj.laws.Continued(law=lj.laws.NeoHookean(mu=770.0, bulk=2200.0), below=0.1),
        lj.laws.Ogden(mu=(1.0, 2.0), alpha=np.array([2.0, -2.0]), bulk=3.0),
    )
)


@pytest.mark.parametrize("name, value", [("0.mu", 770.0), ("1.mu.1", 2.0), ("1.alpha.0", 2.0)])
def test_what_is_put_is_got(name, value):
    assert names.get(LAW, name, "no") == value
    changed = names.put(LAW, name, 5.0, "no")
    assert names.get(changed, name, "no") == 5.0 and names.get(LAW, name, "no") == value
    assert names.metadata(LAW, name, "no")["unit"] == ("1" if "alpha" in name else "Pa")


@pytest.mark.parametrize(
    "name, sentence",
    [
        ("0.nu", "no: did you mean 0.mu?"),
        ("0.volumetric", "no: use one of 0.mu, 0.bulk"),
        ("1.mu.2", "no: '2' is not a name or index here: use an index from 0 to 1"),
        ("2.mu", "no: '2' is not a name or index here: use an index from 0 to 1"),
        ("mu", "no: did you mean 0.mu or 1.mu?"),
        ("0.mu.0", "no: '0' is not a name or index here"),
        ("", "no: '' is not a name or index here: use an index from 0 to 1"),
    ],
)
def test_names_that_lead_nowhere_are_refused(name, sentence):
    with pytest.raises(lj.InputError) as error:
        names.get(LAW, name, "no")
    assert str(error.value) == sentence


@pytest.mark.parametrize(
    "word, known, sentence",
    [
        ("points", ("line", "unit", "radius"), "use one of line, unit, radius"),
        ("neo", ("ogden", "neo_hookean"), "did you mean neo_hookean?"),
        ("frictoin", ("force", "friction"), "did you mean friction?"),
    ],
)
def test_only_a_near_word_is_hinted_at(word, known, sentence):
    assert hint(word, known) == sentence


def test_a_write_that_fails_leaves_the_file_as_it_was(tmp_path):
    file = tmp_path / "result.txt"
    with whole(file) as new:
        new.write_text("first")
    with pytest.raises(KeyboardInterrupt), whole(file) as new:
        new.write_text("half")
        raise KeyboardInterrupt
    assert file.read_text() == "first" and list(tmp_path.iterdir()) == [file]


def test_two_processes_of_one_number_write_one_file(tmp_path):
    """Processes of two containers may have one number. Both used one temporary name: the second process failed, and
    removed the file of the first one.
    """
    file = tmp_path / "result.h5"
    with whole(file) as first:
        first.write_text("first")
        with pytest.raises(OSError), whole(file):
            raise OSError
    assert file.read_text() == "first" and list(tmp_path.iterdir()) == [file]


def test_temporary_files_of_killed_processes_are_removed(tmp_path):
    file = tmp_path / "result.h5"
    with whole(file) as new:
        left = new.with_name(new.name.replace("result.", "result.0"))
        left.write_text("half")
        new.write_text("first")
    with whole(file) as new:
        new.write_text("second")
    assert left.exists()  # its process may still write
    os.utime(left, (0, 0))
    with whole(file) as new:
        new.write_text("third")
    assert list(tmp_path.iterdir()) == [file]
