"""``liverjax plot NAME | FILE.py:LAW …``: stress-stretch curves of laws."""

import argparse

from liverjax import laws
from liverjax.commands.arguments import LAW, add_out
from liverjax.core.errors import InputError
from liverjax.core.files import writable


def add(parsers: argparse._SubParsersAction) -> None:
    """Declare the command."""
    command = parsers.add_parser(
        "plot", help="stress-stretch curves", description="Draw stress-stretch curves of laws."
    )
    command.add_argument("law", nargs="+", metavar="NAME|FILE.py:LAW", help=f"{LAW}; all for every shipped one")
    command.add_argument("--stretch", nargs=2, type=float, default=(0.6, 1.6), metavar=("LOW", "HIGH"), help="0.6 1.6")
    add_out(command)
    command.set_defaults(run=run)


def run(options: argparse.Namespace) -> int:
    """Draw the curves of laws."""
    from liverjax.laws import figures, gradient_check

    low, high = options.stretch
    if not 0 < low < 1 < high <= 20:
        raise InputError(f"--stretch {low:g} {high:g} is no range about 1: give e.g. --stretch 0.6 1.6")
    names = [n for name in options.law for n in (laws.LAWS if name == "all" else [name])]
    labels = [name.rpartition(":")[2] for name in names]
    named = {n if labels.count(k) > 1 else k: gradient_check.load(n) for k, n in zip(labels, names, strict=True)}
    file = options.out / "laws.png"
    writable(options.out, (file.name,))
    figures.curves(named, file, (low, high))
    print(f"written: {file}")
    return 0
