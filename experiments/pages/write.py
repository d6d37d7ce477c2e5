"""Fill in the parts of the pages between their markers."""

import json
from collections.abc import Callable
from pathlib import Path

from experiments.pages import (
    accelerator,
    bodies,
    elements,
    equal_error,
    front,
    identification,
    moving,
    overview,
    porosity,
    reduced,
    stability,
    tables,
    verification,
)
from experiments.pages.results import RESULTS

HERE = Path(__file__).parent.parent
END = "<!-- end of numbers -->"
PAGES: dict[Path, dict[str, Callable[[], str]]] = {
    HERE.parent / "README.md": front.PARTS,
    HERE.parent / "fitting" / "README.md": front.FITS,
    HERE.parent / "liverjax" / "README.md": front.SIMULATOR,
    HERE / "README.md": overview.PARTS,
    HERE / "TABLES.md": tables.PARTS
    | elements.PARTS
    | moving.PARTS
    | porosity.PARTS
    | identification.PARTS
    | stability.PARTS
    | bodies.PARTS
    | reduced.PARTS
    | equal_error.PARTS
    | accelerator.PARTS,
    HERE / "VERIFICATION.md": verification.PARTS,
}


def begin(part: str) -> str:
    """Return the marker before a part."""
    return f"<!-- {part}: python -m experiments pages -->"


def write() -> None:
    """Rewrite every page."""
    for page, parts in PAGES.items():
        text = page.read_text()
        for part, made in parts.items():
            head, rest = text.split(begin(part))
            text = head + begin(part) + "\n" + made() + "\n" + END + rest.split(END, 1)[1]
        page.write_text(text)


def record(script: str, kind: str, seconds: float) -> None:
    """Store the run time of a script, for full or quick runs."""
    file = RESULTS / "run_times.json"
    times = json.loads(file.read_text()) if file.exists() else {}
    times.setdefault(script, {})[kind] = round(seconds, 1)
    file.write_text(json.dumps(times, indent=1, sort_keys=True) + "\n")
