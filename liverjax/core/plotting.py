"""Pictures: colours, and a Matplotlib that draws to files."""

import os
import threading
from pathlib import Path
from typing import Any

#: The colours of Okabe and Ito, distinct for every kind of colour vision.
BLUE, ORANGE, GREEN, GREY = "#0072B2", "#D55E00", "#009E73", "#666666"
COLOURS = (BLUE, ORANGE, GREEN, "#CC79A7", "#E69F00", "#56B4E9", "#000000")


def pyplot() -> Any:
    """Matplotlib's `pyplot`, set to work without a screen; imported only for a picture, because the import is slow."""
    os.environ["MPLBACKEND"] = "Agg"  # a name there that Matplotlib does not know would end the import
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot

    return matplotlib.pyplot


def import_meanwhile() -> None:
    """Begin to import pyplot, which takes a second, while a computation outside of Python runs."""
    threading.Thread(target=pyplot, daemon=True).start()


def save(figure: Any, file: Path) -> None:
    """Write a figure to a file and close it."""
    figure.savefig(file, dpi=150)
    pyplot().close(figure)
