"""``liverjax fit …``: call the commands of the package `fitting` in the same way as the other commands."""

import argparse


def add(parsers: argparse._SubParsersAction) -> None:
    """Add the command to --help. The arguments of the command are defined and read by `fitting`."""
    parsers.add_parser(
        "fit",
        help="identify parameters from frequency sweeps, relaxation and creep tests, indentation, curves, "
        "displacements or waves",
        add_help=False,
    )


def run(arguments: list[str], prog: str) -> int:
    """Run a fit and return the exit code.

    Args:
        arguments: the arguments after `fit`.
        prog: the command as the user typed it; --help shows this name.
    """
    # This is the only import of `fitting` in `liverjax`: otherwise `liverjax` does not depend on `fitting`.
    from fitting.__main__ import main

    return main(arguments, prog)
