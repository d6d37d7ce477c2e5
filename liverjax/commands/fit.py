"""``liverjax fit …``: the commands of the package `fitting`, called in the same way as the other commands."""

import argparse


def add(parsers: argparse._SubParsersAction) -> None:
    """Declare the command for --help; `fitting` declares and reads its arguments."""
    parsers.add_parser(
        "fit", help="parameters from sweeps, tests in time, indentation, curves, displacements or waves", add_help=False
    )


def run(arguments: list[str], prog: str) -> int:
    """Run a fit and return the exit code.

    Args:
        arguments: the arguments after `fit`.
        prog: the command as the user called it; --help shows it.
    """
    # Imported here only: `fitting` uses `liverjax`, and nothing else in `liverjax` may import `fitting`.
    from fitting.__main__ import main

    return main(arguments, prog)
