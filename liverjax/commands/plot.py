"""Draw stress-stretch curves of laws (``liverjax plot NAME | FILE.py:LAW …``), or a field of a run (``plot
RESULT.h5``)."""

import argparse
from pathlib import Path

from liverjax import laws
from liverjax.commands.arguments import LAW, add_out
from liverjax.core.errors import InputError
from liverjax.core.files import writable


def add(parsers: argparse._SubParsersAction) -> None:
    """Add the command to the parser."""
    command = parsers.add_parser(
        "plot",
        help="stress-stretch curves, or a field of a run",
        description="Draw stress-stretch curves of laws, or the surface of a run coloured by a field.",
    )
    command.add_argument(
        "law",
        nargs="+",
        metavar="NAME|FILE.py:LAW|RESULT.h5",
        help=f"{LAW}; all for every law of this package; or the result.h5 of liverjax simulate",
    )
    command.add_argument("--field", metavar="NAME", help="field of a result, e.g. cauchy_stress (default displacement)")
    command.add_argument(
        "--step", type=int, metavar="N", help="number of the step of a result, counted from 1 (default: the last step)"
    )
    command.add_argument(
        "--stretch", nargs=2, type=float, metavar=("LOW", "HIGH"), help="range of stretches for a law (default 0.6 1.6)"
    )
    add_out(command)
    command.set_defaults(run=run)


def run(options: argparse.Namespace) -> int:
    """Draw the curves of laws, or a field of a run."""
    results = [Path(name) for name in options.law if name.endswith(".h5")]
    for name in options.law:
        if name.endswith(".toml"):
            raise InputError(f"{name} is a scene: run it with liverjax simulate, and draw its result.h5")
        if Path(name).exists() and not name.endswith((".h5", ".py")) and name not in (*laws.LAWS, "all"):
            raise InputError(
                f"{name} is a file or a folder, and not a law: give the name of a law, or the result.h5 of a run"
            )
    for option, of_results in (("field", True), ("step", True), ("stretch", False)):
        if getattr(options, option) is not None and bool(results) != of_results:
            raise InputError(
                f"--{option} is for {'results' if of_results else 'laws'}, not for {options.law[0]}: remove this option"
            )
    if results:
        if len(options.law) > 1:
            raise InputError(
                f"{results[0]} is the result of a run, which cannot be drawn together with other arguments: give only "
                "this file"
            )
        return _draw_field(results[0], options)
    from liverjax.laws import figures, gradient_check

    low, high = options.stretch or (0.6, 1.6)
    if not 0 < low < 1 < high <= 20:
        raise InputError(f"--stretch {low:g} {high:g} is not a range that contains 1: give e.g. --stretch 0.6 1.6")
    names = [n for name in options.law for n in (laws.LAWS if name == "all" else [name])]
    labels = [name.rpartition(":")[2] for name in names]
    named = {n if labels.count(k) > 1 else k: gradient_check.load(n) for k, n in zip(labels, names, strict=True)}
    file = options.out / "laws.png"
    writable(options.out, (file.name,))
    figures.curves(named, file, (low, high))
    print(f"written: {file}")
    return 0


def _draw_field(result: Path, options: argparse.Namespace) -> int:
    from liverjax.jobs import pictures

    field = options.field or "displacement"
    surface, file = pictures.of_result(result, field, options.step), options.out / f"{field}.png"
    writable(options.out, (file.name,))
    pictures.draw_surface(file, surface)
    low, high = (float(f(surface.values)) for f in (min, max))
    print(f"{surface.label}: {low:.4g} to {high:.4g}\nwritten: {file}")
    return 0
