"""What the scripts wrote, and how its numbers are printed."""

import json
from pathlib import Path

RESULTS = Path(__file__).parent.parent / "results"


def load(*names: str) -> list[dict]:
    """JSON of some scripts."""
    return [json.loads((RESULTS / f"{n}.json").read_text()) for n in names]


def error_text(error: float) -> str:
    """Roundoff, as a power of ten."""
    return f"{error:.0e}"


def percent(x: float) -> str:
    """Two digits, or all before the point."""
    return f"{short(100 * x)} %"


def short(x: float) -> str:
    """The same without a unit."""
    return f"{x:.2g}" if abs(x) < 99.5 else f"{x:,.0f}"
