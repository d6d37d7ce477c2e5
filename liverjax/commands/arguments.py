"""Arguments that several sub-commands have in common."""

import argparse
import re
from collections.abc import Sequence
from pathlib import Path

LAW = "name of a law of this package (with typical parameters), or FILE.py:LAW, a law object or class in your file"


def add_out(command: argparse.ArgumentParser) -> None:
    """Add --out, the folder of the results."""
    command.add_argument(
        "--out", type=Path, default=Path(), metavar="DIR", help="folder of the results (default: this folder)"
    )


def with_joined_numbers(arguments: Sequence[str]) -> list[str]:
    """Return the command line with "--gap=-1e-5" instead of "--gap -1e-5", because argparse would treat a number like
    -1e-5 as an option."""
    joined: list[str] = []
    for argument in arguments:
        if joined and re.fullmatch(r"-[0-9.]+[eE][-+]?[0-9]+", argument) and re.fullmatch(r"--[a-z0-9-]+", joined[-1]):
            joined[-1] += f"={argument}"
        else:
            joined.append(argument)
    return joined
