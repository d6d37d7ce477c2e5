"""What the front page prints is what the code does."""

import re
import subprocess
import sys

import pytest
from conftest import ROOT

sys.path.insert(0, str(ROOT))
from experiments.pages import porosity, write

PAGE = (ROOT / "README.md").read_text()
BLOCKS = re.findall(r"```python\n(.*?)```", PAGE, flags=re.DOTALL)


@pytest.mark.parametrize("page", write.PAGES, ids=lambda page: page.name)
def test_numbers_come_from_the_experiments(page):
    text = page.read_text()
    for part, made in write.PAGES[page].items():
        quoted = text.split(write.begin(part))[1].split(write.END)[0].strip()
        assert quoted == made().strip(), part


def test_what_the_claim_on_porosity_takes_is_told_from_both_sides():
    """K0 from 800 Pa, a permeability of 1e-6 or less; neither K_lim nor the rate at any value tried."""
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


@pytest.mark.parametrize("block", BLOCKS[:4], ids=["fit", "many bodies", "check of a law", "rheometer"])
def test_examples_run_as_printed(block):
    lines = [line for line in block.splitlines() if line.strip()]
    assert len(lines) <= 10 or "loss_moduli" in block
    run = subprocess.run([sys.executable, "-c", block], cwd=ROOT, capture_output=True, text=True)
    assert run.returncode == 0, run.stderr
    assert len(re.findall(r"\d+\.\d+", run.stdout)) >= 7


def test_law_of_ten_lines_passes_the_check_as_printed(tmp_path, capsys):
    from liverjax.__main__ import main

    law = BLOCKS[4]
    body = law.split("@lj.struct")[1].strip().splitlines()
    assert len([line for line in body if line.strip()]) <= 10
    (tmp_path / "my_law.py").write_text(law)
    assert main(["check", f"{tmp_path / 'my_law.py'}:Gent", "--out", str(tmp_path)]) == 0
    assert main(["check", f"{ROOT / 'experiments' / 'my_law.py'}:Gent", "--out", str(tmp_path)]) == 0
    assert "FAILED" not in capsys.readouterr().out


def test_pictures_and_pages_are_there():
    for page in write.PAGES:
        for path in re.findall(r"!?\[.*?\]\(([^)#:]*?)\)", page.read_text()):
            assert (page.parent / path).is_file(), path
