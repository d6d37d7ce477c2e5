"""Results of the scripts, and formats of their numbers."""

import json
from pathlib import Path

RESULTS = Path(__file__).parent.parent / "results"


def load(*names: str) -> list[dict]:
    """Return the JSON content of some scripts' results."""
    return [json.loads((RESULTS / f"{n}.json").read_text()) for n in names]


def error_text(error: float) -> str:
    """Return an error of the size of rounding, with one digit and a power of ten."""
    return f"{error:.0e}"


def percent(x: float) -> str:
    """Return a number in per cent, with two digits or all digits before the point."""
    return f"{short(100 * x)} %"


def short(x: float) -> str:
    """Return a number with two digits, or with all digits before the point."""
    return f"{x:.2g}" if abs(x) < 99.5 else f"{x:,.0f}"
