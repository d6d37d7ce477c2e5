"""``liverjax fit …``: the commands of the package `fitting` under the same name as the others."""

import argparse


def add(parsers: argparse._SubParsersAction) -> None:
    """Declare the command for --help; `fitting` declares and reads its arguments."""
    parsers.add_parser(
        "fit", help="parameters from sweeps, tests in time, indentation, curves, displacements or waves", add_help=False
    )


def run(arguments: list[str], prog: str) -> int:
    """Run a fit; the exit code.

    Args:
        arguments: those after `fit`.
        prog: the command as it was called, which --help shows.
    """
    # Imported when called: `fitting` is built on `liverjax`, and nothing else here may know it.
    from fitting.__main__ import main

    return main(arguments, prog)
