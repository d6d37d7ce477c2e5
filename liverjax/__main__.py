"""Command line ``liverjax simulate | sweep | reduce | design | laws | check | plot | play | fit``.

``python -m liverjax …`` runs the same commands.
"""

import argparse
import sys

from liverjax.commands import check, design, fit, laws, play, plot, reduce, simulate, sweep
from liverjax.commands.arguments import with_joined_numbers
from liverjax.commands.exit_codes import end_if_stopped, exit_code, show_unknown_letters


def _parser(prog: str) -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog=prog,
        description="Soft-tissue mechanics in JAX.",
        epilog="Exit codes: 0 = done, 1 = a check or a step failed, 2 = unusable input.",
    )
    parsers = parser.add_subparsers(dest="command", required=True)
    for command in (simulate, sweep, reduce, design, laws, check, plot, play, fit):
        command.add(parsers)
    return parser


def main(arguments: list[str] | None = None, prog: str = "liverjax") -> int:
    """Run one command. Return its exit code: 0 (done), 1 (failed), 2 (unusable input) or 130 (Ctrl-C)."""
    show_unknown_letters()
    given = sys.argv[1:] if arguments is None else arguments
    if given[:1] == ["fit"]:
        code = fit.run(given[1:], f"{prog} fit")
    else:
        options = _parser(prog).parse_args(with_joined_numbers(given))
        code = exit_code(options.run, options)
    if arguments is None:
        end_if_stopped(code)
    return code


if __name__ == "__main__":
    sys.exit(main(prog="python -m liverjax"))
