"""``liverjax laws``: print every law with its energy, parameters, units and bounds."""

import argparse
import dataclasses
from collections.abc import Mapping
from typing import Any

from liverjax import laws
from liverjax.laws.volumetric import VOLUMETRIC


def add(parsers: argparse._SubParsersAction) -> None:
    """Add the command to the parser."""
    parsers.add_parser("laws", help="the laws, their parameters, units and bounds").set_defaults(run=run)


def run(options: argparse.Namespace) -> int:
    """Print every law."""
    print(f"option of every law with the parameter bulk: volumetric = {' | '.join(VOLUMETRIC)} (default quadratic)")
    print("option of every law of I1, I2 and J: continued_below = 0.1, for a finite energy below this J (default off;")
    print("    an exponential law can still exceed the largest number of float32 there)")
    for name, cls in laws.LAWS.items():
        energy = (cls.__doc__ or name).split("\n\n")[0].splitlines()
        print("\n".join([name, *(f"    {line.strip()}" for line in energy)]))
        for field in laws.parameters(cls):
            m = field.metadata
            optional = ", optional" if field.default is None else ""
            if field.default not in (None, dataclasses.MISSING):
                optional = f", default {field.default}"
            print(f"    {field.name:14s} [{m['unit']}]  {_bounds(m):8s} {m['about']}{optional}")
    return 0


def _bounds(metadata: Mapping[str, Any]) -> str:
    parts = [f"> {metadata['above']:g}"] if metadata.get("above") is not None else []
    parts += [f">= {metadata['lower']:g}"] if metadata.get("lower") is not None else []
    parts += [f"<= {metadata['upper']:g}"] if metadata.get("upper") is not None else []
    parts += ["not 0"] if metadata.get("nonzero") else []
    return ", ".join(parts) or "any"
