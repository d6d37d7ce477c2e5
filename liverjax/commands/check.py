"""``liverjax check NAME | FILE.py:LAW``: check the derivatives of a material law."""

import argparse
import sys

from liverjax.commands.arguments import LAW, add_out
from liverjax.core.files import writable


def add(parsers: argparse._SubParsersAction) -> None:
    """Add the command to the parser."""
    command = parsers.add_parser(
        "check", help="check the derivatives of a material law", description="Gradient-check a law."
    )
    command.add_argument("law", metavar="NAME|FILE.py:LAW", help=LAW)
    add_out(command)
    command.set_defaults(run=run)


def run(options: argparse.Namespace) -> int:
    """Check the derivatives of a law: print a table and draw a figure. Return 1 if a row of the table failed."""
    import jax

    from liverjax.laws import figures, gradient_check

    jax.config.update("jax_enable_x64", True)  # the limits of the check are for double precision
    law, label = gradient_check.load(options.law), options.law.rpartition(":")[2]
    file = options.out / f"check_{label}.png"
    writable(options.out, (file.name,))
    result = gradient_check.check(law)
    print(gradient_check.table(result))
    figures.gradient_check(result, label, file)
    print(f"written: {file}")
    for row in result.failed:
        print(f"failed: {row.name}: {row.found}{f' ({row.limit})' if row.limit else ''}", file=sys.stderr)
    return 1 if result.failed else 0
