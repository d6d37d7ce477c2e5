"""``liverjax reduce SCENE.toml ROWS.csv``: make a reduced model of a scene from one full run for each row of a
table."""

import argparse
import os
from contextlib import suppress
from pathlib import Path


def add(parsers: argparse._SubParsersAction) -> None:
    """Add the command to the parser."""
    command = parsers.add_parser(
        "reduce",
        help="make a reduced model of a scene from full runs with different parameters",
        description="Run a scene for every row of a table, and make a reduced model from these runs.",
    )
    command.add_argument("scene", type=Path, metavar="SCENE.toml")
    command.add_argument(
        "rows", type=Path, metavar="ROWS.csv", help="table with a header of dotted names and one row per run"
    )
    command.add_argument(
        "--out", type=Path, default=Path("model.h5"), metavar="MODEL.h5", help="file of the model (default model.h5)"
    )
    command.add_argument(
        "--tolerance",
        type=float,
        default=1e-4,
        metavar="X",
        help="fraction of the displacements that the modes may neglect (default 1e-4)",
    )
    command.add_argument("--modes", type=int, default=40, metavar="N", help="maximum number of modes (default 40)")
    command.add_argument(
        "--runs",
        type=int,
        metavar="N",
        help="number of full runs (default: one for each row). Two thirds of the runs use the first rows, and the "
        "others use the rows with the largest estimated errors",
    )
    command.set_defaults(run=run)


def run(options: argparse.Namespace) -> int:
    """Make the reduced model and write it to a file."""
    from liverjax.jobs import reduction

    model = reduction.make(options.scene, options.rows, options.out, options.tolerance, options.modes, options.runs)
    print(
        f"{model.number_of_modes} modes, {len(model.points)} points, {reduction.learnt(model)}\nwritten: {options.out}"
    )
    # Paths in a scene file are relative to the folder of the scene file.
    path = str(options.out.resolve())
    with suppress(ValueError):  # on Windows, there is no relative path between two drives
        path = os.path.relpath(path, options.scene.parent.resolve())
    print(f'to use this model, write reduced = "{Path(path).as_posix()}" in [solve]')
    return 0
