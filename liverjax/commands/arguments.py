"""Arguments that several sub-commands have."""

import argparse
from pathlib import Path

LAW = "name of a shipped law (typical parameters), or FILE.py:LAW, a law object or class of your own"


def add_out(command: argparse.ArgumentParser) -> None:
    """Add --out, the folder of the results."""
    command.add_argument("--out", type=Path, default=Path(), metavar="DIR", help="folder of the results (here)")
