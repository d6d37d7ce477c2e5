"""Write a fit on one page for printing: pictures, parameters, notes and warnings."""

import textwrap
from pathlib import Path
from typing import TYPE_CHECKING

from fitting.fits.viscoelastic import Fit
from fitting.readers.rheometer import Sweep
from fitting.reports import sweep_report
from liverjax.core.plotting import pyplot, save
from liverjax.core.struct import Content

if TYPE_CHECKING:
    from matplotlib.figure import Figure


#: Width and height of A4 [inch], fraction of the height for the text, and margin (as a fraction of width or height).
WIDTH, HEIGHT, TEXT, MARGIN = 8.27, 11.69, 0.56, 0.06
#: CHARACTERS: maximum number of characters per line. SIZE: font size [pt] at which such a line fits on the page. If
#: there are too many lines, a smaller font is used.
CHARACTERS, SIZE = 104, 8.0


def write(file: Path, sweep: Sweep, fits: list[Fit], content: Content, first: str = "") -> None:
    """Write the page into `file`. The suffix of the file name determines the format (.pdf for PDF).

    Args:
        sweep, fits: see `sweep_report.write`.
        content: content of fit.json.
        first: lines before the table of the fit.
    """
    save(page(sweep, fits, content, first), file)


def page(sweep: Sweep, fits: list[Fit], content: Content, first: str = "") -> "Figure":
    """Return the page as a figure."""
    figure = pyplot().figure(figsize=(WIDTH, HEIGHT))
    place = {"left": 0.12, "right": 0.96, "top": 0.91, "bottom": TEXT + 0.04, "wspace": 0.3}
    grid = figure.add_gridspec(2, 2, width_ratios=(3, 2), height_ratios=(3, 1), **place)
    top = figure.add_subplot(grid[0, 0])
    sweep_report.draw_moduli(top, figure.add_subplot(grid[1, 0], sharex=top), sweep, fits)
    sweep_report.draw_time_constants(figure.add_subplot(grid[:, 1]), sweep, fits, 1)
    name = Path(sweep.source).name or "sweep"
    if len(name) > CHARACTERS // 2:
        name = f"{name[: CHARACTERS // 2 - 1]}…"
    figure.suptitle(f"{name}: {content['model']}, {content['method']}", fontsize=11, y=0.975)
    lines = text_of_page(sweep, fits, content, first)
    size = min(SIZE, 72 * HEIGHT * (TEXT - 0.5 * MARGIN) / (1.25 * len(lines)))
    figure.text(MARGIN, TEXT - 0.01, "\n".join(lines), family="monospace", fontsize=size, va="top", linespacing=1.2)
    return figure


def text_of_page(sweep: Sweep, fits: list[Fit], content: Content, first: str = "") -> list[str]:
    """Return the lines below the pictures."""
    f = content["shear_waves"]["frequency_Hz"]
    rows = [
        f"{len(f)} frequencies from {f[0]:.3g} to {f[-1]:.3g} Hz; errors are standard errors",
        "",
        *([*first.splitlines(), ""] if first else []),
    ]
    for row in sweep_report.table(sweep, fits).splitlines():
        rows += [row] if len(row) <= CHARACTERS else textwrap.wrap(row, CHARACTERS, subsequent_indent="  ")
    for head, sentences in (("Notes", content["notes"]), ("Warnings about this fit", content["warnings"])):
        if sentences:
            rows += ["", f"{head}:"]
        for sentence in sentences:
            rows += textwrap.wrap(sentence, CHARACTERS, initial_indent="- ", subsequent_indent="  ")
    used = ", ".join(f"{name} {version}" for name, version in content["versions"].items())
    return [*rows, "", *textwrap.wrap(used, CHARACTERS)]
