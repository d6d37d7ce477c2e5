"""``python -m liverjax laws``: what the simulator offers."""

import argparse
import sys

from liverjax import laws
from liverjax.errors import InputError


def _bounds(metadata) -> str:
    parts = [f"> {metadata['above']:g}"] if metadata.get("above") is not None else []
    parts += [f">= {metadata['lower']:g}"] if metadata.get("lower") is not None else []
    parts += [f"<= {metadata['upper']:g}"] if metadata.get("upper") is not None else []
    return ", ".join(parts) or "any"


def list_laws() -> None:
    """Print every law with its energy, parameters, units and bounds."""
    for name, cls in laws.LAWS.items():
        print(f"{name}\n    {cls.__doc__.splitlines()[0]}")
        for field in laws.parameters(cls):
            m = field.metadata
            optional = ", optional" if field.default is None else ""
            print(f"    {field.name:14s} [{m['unit']}]  {_bounds(m):8s} {m['about']}{optional}")


def main(arguments: list[str] | None = None) -> int:
    """Entry point; returns the exit code: 0 done, 1 failed, 2 unusable input."""
    parser = argparse.ArgumentParser(prog="python -m liverjax", description="Soft-tissue mechanics in JAX.")
    commands = parser.add_subparsers(dest="command", required=True)
    commands.add_parser("laws", help="the laws, their parameters, units and bounds")
    options = parser.parse_args(arguments)
    try:
        if options.command == "laws":
            list_laws()
        return 0
    except InputError as error:
        print(f"error: {error}", file=sys.stderr)
        return 2


if __name__ == "__main__":
    sys.exit(main())
