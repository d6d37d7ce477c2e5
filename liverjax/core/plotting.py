"""Colours of figures, and Matplotlib for drawing to files."""

import os
import threading
from pathlib import Path
from typing import Any

#: Colours of Okabe and Ito. People with any kind of colour vision can distinguish them.
BLUE, ORANGE, GREEN, GREY = "#0072B2", "#D55E00", "#009E73", "#666666"
COLOURS = (BLUE, ORANGE, GREEN, "#CC79A7", "#E69F00", "#56B4E9", "#000000")


def pyplot() -> Any:
    """Return Matplotlib's `pyplot`, set to work without a screen.

    Matplotlib is imported only if needed, because the import is slow.
    """
    os.environ["MPLBACKEND"] = "Agg"  # with an unknown backend in this variable, the import would fail
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot

    return matplotlib.pyplot


def import_meanwhile() -> None:
    """Import pyplot in a thread. The import takes about a second. During this time a compiled program can run."""
    threading.Thread(target=pyplot, daemon=True).start()


def save(figure: Any, file: Path) -> None:
    """Write a figure to a file and close it."""
    figure.savefig(file, dpi=150)
    pyplot().close(figure)
