"""``liverjax design PARAMETERS.csv NAME=LOW:HIGH …``: write a table of parameters for a sweep."""

import argparse
from pathlib import Path


def add(parsers: argparse._SubParsersAction) -> None:
    """Add the command to the parser."""
    command = parsers.add_parser("design", help="write a table of parameters", description="Write a table for a sweep.")
    command.add_argument("table", type=Path, metavar="PARAMETERS.csv")
    command.add_argument("range", nargs="+", metavar="NAME=LOW:HIGH", help="e.g. law.mu=500:1000")
    command.add_argument("--kind", default="sobol", metavar="KIND", help="grid | latin | sobol (default sobol)")
    command.add_argument(
        "--rows", type=int, default=64, metavar="N", help="number of rows, of a grid at most (default 64)"
    )
    command.add_argument(
        "--seed", type=int, default=0, metavar="N", help="seed of the random numbers of latin and sobol (default 0)"
    )
    command.set_defaults(run=run)


def run(options: argparse.Namespace) -> int:
    """Write the table of parameters and return 0."""
    from liverjax.jobs import design

    ranges = design.read_ranges(options.range)
    rows = design.design(ranges, options.rows, options.kind, options.seed)
    design.write_table(
        options.table,
        list(ranges),
        rows,
        options.kind if options.kind == "grid" else f"{options.kind}, seed {options.seed}",
    )
    print(f"{len(rows)} rows\nwritten: {options.table}")
    return 0
