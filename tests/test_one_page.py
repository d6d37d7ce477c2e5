"""The report on one page: everything that a user should read is on it, and inside the paper."""

import re

import pytest
from conftest import ROOT

from fitting.__main__ import main
from fitting.fits import compressed_sample, viscoelastic
from fitting.fits.simulated_rheometer import Simulation
from fitting.readers import rheometer
from fitting.reports import one_page, sweep_report
from liverjax.core.versions import versions

pytestmark = pytest.mark.quick_to_compile


@pytest.mark.ci
@pytest.mark.parametrize("more", [0, 60])
def test_the_page_holds_it_all(more):
    sweep = rheometer.read_sweep(ROOT / "data" / "lions_mane_frequency_sweep.csv")
    fit = viscoelastic.closed_form(sweep, 3)
    fit = fit._replace(warnings=(*fit.warnings, *(f"warning {k} of many, which has a whole line" for k in range(more))))
    content = sweep_report.summary(fit, sweep) | {"notes": ["a point was left out"], "versions": versions()}
    figure = one_page.page(sweep, [fit], content)
    figure.canvas.draw()
    (text,) = (t for t in figure.texts if t.get_family() == ["monospace"])
    words = re.sub(r"\s+", " ", text.get_text())
    assert all(re.sub(r"\s+", " ", w) in words for w in (*content["warnings"], "a point was left out", "G_inf"))
    extent, paper = text.get_window_extent(), figure.bbox
    assert extent.x0 >= 0 and extent.x1 <= paper.x1 and extent.y0 >= 0
    for axes in figure.axes:
        box = axes.get_tightbbox()
        assert box.x0 >= 0 and box.x1 <= paper.x1 and box.y0 >= extent.y1


def test_no_line_is_wider_than_the_page():
    """The lines for a compressed sample were cut off at the edge."""
    sweep = rheometer.read_sweep(ROOT / "data" / "lions_mane_frequency_sweep.csv")
    fit = viscoelastic.closed_form(sweep, 3)
    fit.details["precompression"] = compressed_sample.compression_numbers(fit, Simulation(precompression=0.1))
    content = sweep_report.summary(fit, sweep) | {"notes": [], "versions": versions()}
    lines = one_page.text_of_page(sweep, [fit], content)
    assert max(map(len, lines)) <= one_page.CHARACTERS
    assert "if the volume is kept" in re.sub(r"\s+", " ", " ".join(lines))


@pytest.mark.ci
@pytest.mark.draws
def test_the_command_writes_it(tmp_path, capsys):
    data = str(ROOT / "data" / "lions_mane_frequency_sweep.csv")
    common = ["--method", "closed-form", "--modes", "2", "--report", "--out", str(tmp_path)]
    assert main([data, *common]) == 0
    assert (tmp_path / "report.pdf").read_bytes().startswith(b"%PDF")
    assert main([data, data, "--report", "--out", str(tmp_path)]) == 2
    assert "--report" in capsys.readouterr().err


def test_the_title_names_one_file_and_shows_where_it_is_cut():
    """The title split a path at a comma, and had no mark where it was cut."""
    sweep = rheometer.read_sweep(ROOT / "data" / "lions_mane_frequency_sweep.csv")
    fit = viscoelastic.closed_form(sweep, 2)
    content = sweep_report.summary(fit, sweep) | {"notes": [], "versions": versions()}
    for source, name in (("x, y/a, b.csv", "a, b.csv: "), ("x/" + 60 * "a", 51 * "a" + "…: ")):
        figure = one_page.page(sweep._replace(source=source), [fit], content)
        assert figure.get_suptitle().startswith(name)
