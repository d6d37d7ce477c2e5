"""The examples and outputs on the front page and in the guides agree with the code."""

import argparse
import importlib.util
import re
import shlex
import sys
import tomllib
import warnings

import jax
import pytest
from conftest import ROOT

sys.path.insert(0, str(ROOT))
import fitting.__main__
import liverjax as lj
import liverjax.__main__
from experiments import __main__ as experiments
from experiments.pages import overview, porosity, write
from fitting.rigs.described import read_described
from liverjax.scenes.scene_file import scene_from

pytestmark = pytest.mark.quick_to_compile

GUIDES = {name: ROOT / name for name in ("README.md", "fitting/README.md", "liverjax/README.md")}
#: The rest of the scene, for scene fragments in the guides.
BODY = """
[mesh]
shape = "box"
size = [0.1, 0.1, 0.1]
cells = [2, 2, 2]

[law]
name = "neo_hookean"
mu = 770.0
bulk = 2200.0

[[fixed]]
where = {z_max = 0.0}

[[displaced]]
where = {z_min = 0.1, x_min = 0.1}
axes = "x"
by = [0.002, 0.0, 0.0]
"""


def blocks(language: str) -> list:
    """Return the examples of the three pages in one language, by page and number."""
    fence = re.compile(rf"^```{language}\n(.*?)^```$", re.DOTALL | re.MULTILINE)
    # Other tests have faster cases of these functions.
    long = ("joint.fit", "lj.reduce_scene", "lj.separate", "lj.value_and_gradient")
    found = [
        pytest.param(block, id=f"{name}-{k}", marks=[pytest.mark.slow] if any(one in block for one in long) else [])
        for name, page in GUIDES.items()
        for k, block in enumerate(fence.findall(page.read_text()))
    ]
    assert found
    return found


def test_every_experiment_of_the_overview_is_one_script():
    assert all(importlib.util.find_spec(experiments.module(name)) for name in overview.ROWS)


@pytest.mark.parametrize("page", write.PAGES, ids=lambda page: page.name)
def test_numbers_come_from_the_experiments(page):
    text = page.read_text()
    for part, made in write.PAGES[page].items():
        quoted = text.split(write.begin(part))[1].split(write.END)[0].strip()
        assert quoted == made().strip(), part


def test_what_the_claim_on_porosity_takes_is_told_from_both_sides():
    """The claim holds for K0 from 800 Pa, or a permeability of 1e-6 or less. It fails for all tested K_lim and
    rates.
    """
    varied = {"bulk": {800.0: 0.9, 1600.0: 0.8}, "limit_bulk": {8800.0: 1.1}, "permeability": {0.0: 0.7, 1e-6: 0.9}}
    varied |= {"ramp_s": {3.0: 1.2}, "keep_bulk": {True: 1.0}, "Table 2": {None: 1.1}}
    rows = [{"varied": n, "value": v, "ratio": r} for n, found in varied.items() for v, r in found.items()]
    found = porosity.holding({"rows": rows, "table_2": {"bulk": 400.0, "limit_bulk": 2200.0, "permeability": 2e-5}})
    assert found["it takes"] == [
        "K0 of 800 Pa or more (400 is too little)",
        "a permeability of 1e-06 m^4/(N s) or less (2e-05 is too much)",
    ]
    assert found["not enough"] == [
        "K_lim of 2,200 Pa to 8,800 Pa",
        "gravity that grows over 0 s to 3 s",
        "`keep_bulk = true`",
    ]


@pytest.mark.ci
@pytest.mark.parametrize("block", blocks("python"))
def test_examples_run_as_printed(block, monkeypatch, capsys):
    """Each example runs with its own imports only, as for users. It runs in this process, because a new one imports JAX
    again.
    """
    monkeypatch.chdir(ROOT)
    with warnings.catch_warnings(), jax.numpy_rank_promotion("allow"):
        warnings.simplefilter("default")
        exec(compile(block, "example", "exec"), {"__name__": "__main__"})
    assert "print" not in block or re.search(r"\d", capsys.readouterr().out)


def test_the_front_page_is_short():
    text = GUIDES["README.md"].read_text()
    assert len(text.splitlines()) <= 150
    uses = re.findall(r"```python\n(.*?)```", text, flags=re.DOTALL)
    assert len(uses) == 3
    for use in uses:
        assert len([line for line in use.splitlines() if line.strip()]) <= 10


#: Scene files, and descriptions of tests in rigs.
SCENES, TESTS = ([b for b in blocks("toml") if b.values[0].startswith("test =") is it] for it in (False, True))


@pytest.mark.slow
@pytest.mark.parametrize("block", TESTS)
def test_descriptions_are_read_as_printed(block, tmp_path):
    (tmp_path / "test.toml").write_text(block)
    rows = "\n".join(f"{k},1e-5,{0.01 / k}" for k in range(1, 9))
    (tmp_path / tomllib.loads(block)["data"]).write_text(f"time_s,displacement_m,force_N\n{rows}\n")
    assert read_described(tmp_path / "test.toml").used.sum() == 8


@pytest.mark.parametrize("block", SCENES)
def test_scene_files_load_as_printed(block):
    scene_from(tomllib.loads(BODY) | tomllib.loads(block))


@pytest.mark.slow
@pytest.mark.parametrize("block", SCENES)
def test_scene_files_run_as_printed(block):
    scene = scene_from(tomllib.loads(BODY) | tomllib.loads(block))
    (lj.harmonic if scene.solve.kind == "harmonic" else lj.simulate)(scene).check()


class Parsed(Exception):
    """Raised when the parser has accepted the command line."""


@pytest.mark.parametrize("block", blocks("sh"))
def test_command_lines_are_parsed(block, monkeypatch):
    """Options and choices are known, and files whose names are not in capitals exist."""
    parse = argparse.ArgumentParser.parse_args

    def stop(self, arguments=None, namespace=None):
        parse(self, arguments, namespace)
        raise Parsed

    monkeypatch.setattr(argparse.ArgumentParser, "parse_args", stop)
    commands = {"liverjax": liverjax.__main__.main, "fitting": fitting.__main__.main}
    for line in block.splitlines():
        words = shlex.split(line, comments=True)
        module = words[words.index("-m") + 1]
        if module != "pytest":
            arguments = words[words.index("-m") + 2 :]
            with pytest.raises(Parsed):
                commands[module](arguments)
            for word in arguments:
                assert "/" not in word or (ROOT / word.split(":")[0]).is_file(), word


@pytest.mark.ci
def test_the_law_of_the_guide_passes_the_check_as_printed(tmp_path, capsys):
    text = GUIDES["liverjax/README.md"].read_text()
    (law,) = (block for block in re.findall(r"```python\n(.*?)```", text, re.DOTALL) if "lj.Law" in block)
    body = law.split("@lj.struct")[1].strip().splitlines()
    assert len([line for line in body if line.strip()]) <= 10
    (tmp_path / "my_law.py").write_text(law)
    assert liverjax.__main__.main(["check", f"{tmp_path / 'my_law.py'}:Gent", "--out", str(tmp_path)]) == 0
    mine = f"{ROOT / 'experiments' / 'my_law.py'}:Gent"
    assert liverjax.__main__.main(["check", mine, "--out", str(tmp_path)]) == 0
    assert "FAILED" not in capsys.readouterr().out


def test_links_lead_somewhere():
    for page in write.PAGES:
        for link in re.findall(r"!?\[.*?\]\(([^):]*?)\)", page.read_text()):
            path, _, section = link.partition("#")
            target = page.parent / path
            assert target.is_file(), link
            titles = re.findall(r"^#+ (.*)$", target.read_text(), re.MULTILINE) if section else []
            assert not section or section in {title.lower().replace(" ", "-") for title in titles}, link
