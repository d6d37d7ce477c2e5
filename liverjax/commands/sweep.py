"""``liverjax sweep SCENE.toml PARAMETERS.csv``: run a scene once for every row of a table."""

import argparse
import math
import sys
from pathlib import Path

from liverjax.core.errors import InputError

#: A copy of the names in `liverjax.jobs.sweep.OUTPUTS`, so that --help does not have to load that module.
OUTPUTS = ("final_positions", "positions", "largest_displacement", "final_reactions", "largest_pressure")


def add(parsers: argparse._SubParsersAction) -> None:
    """Add the command to the parser."""
    command = parsers.add_parser(
        "sweep",
        help="run a scene for every row of a table",
        description="Run a scene for every row of a table. If the run is stopped, --resume continues it. At most one "
        "chunk of rows must be repeated.",
    )
    command.add_argument("scene", type=Path, metavar="SCENE.toml")
    command.add_argument(
        "parameters",
        type=Path,
        metavar="PARAMETERS.csv",
        help="table with a header of dotted names and one row per run",
    )
    command.add_argument("--out", type=Path, metavar="FILE.h5", help="file of the results (default PARAMETERS.h5)")
    command.add_argument("--resume", action="store_true", help="continue a run that was stopped")
    command.add_argument("--store", nargs="+", default=["final_positions"], metavar="WHAT", help="|".join(OUTPUTS))
    command.add_argument(
        "--probe", nargs="+", type=int, default=[], metavar="NODE", help="nodes whose positions are stored at all steps"
    )
    command.add_argument(
        "--rows", nargs="+", type=int, default=[], metavar="N", help="run only these rows, numbered from 1"
    )
    command.add_argument(
        "--chunk", type=int, default=16, metavar="N", help="write the results after each N rows (default 16)"
    )
    command.add_argument("--devices", type=int, metavar="N", help="distribute the rows over N CPU devices (default 1)")
    where = (
        "run as process I of N processes, connected through HOST:PORT. If no values are given, they are read from the "
        "cluster (SLURM)"
    )
    command.add_argument("--distributed", nargs="*", metavar="HOST:PORT N I", help=where)
    command.set_defaults(run=run, kept=lambda options: Path(f"{_results(options)}.parts").glob("*"))


def run(options: argparse.Namespace) -> int:
    """Run the scene for the rows of the table. Return 1 if a row failed or a file could not be written."""
    import jax
    from tqdm import tqdm

    if options.devices is not None:
        if options.devices < 1:
            raise InputError(f"--devices {options.devices} must be above 0: give e.g. 2")
        jax.config.update("jax_num_cpu_devices", options.devices)
    process = (0, 1) if options.distributed is None else _share(options.distributed)

    from liverjax.core import status
    from liverjax.jobs import sweep
    from liverjax.simulation.cautions.of_mesh import cautions_of_mesh

    stored, probes, numbers = tuple(options.store), tuple(options.probe), tuple(options.rows)
    table = sweep.read_sweep(options.scene, options.parameters, stored, probes, options.chunk, numbers)
    solve = table.scene.solve
    if solve.kind == "harmonic" or solve.reduced:
        own = "kind = 'harmonic'" if solve.kind == "harmonic" else f"reduced = {solve.reduced!r}"
        raise InputError(
            f"{options.scene}: [solve] {own} cannot be used in a sweep; use python -m liverjax simulate for each row"
        )
    out = _results(options)
    if out.is_dir():
        raise InputError(f"--out {out} is a folder: name a file for the results, e.g. {out / 'sweep.h5'}")
    bar = tqdm(total=len(table.rows), unit="row", disable=None, leave=False)  # tqdm shows it only on a terminal
    try:
        done = sweep.run(table, out, options.resume, process, bar.update)
    except OSError as error:
        print(
            f"error: {out} cannot be written ({error.strerror or error}). Finished chunks are kept: continue with "
            "--resume",
            file=sys.stderr,
        )
        return 1
    finally:
        bar.close()
    if done.file is None:
        print(
            f"process {process[0]} of {process[1]} computed {done.computed} rows; other processes still have rows to "
            "compute"
        )
        return 0
    print(f"{len(table.rows)} rows, {done.computed} computed now, {len(done.failed)} failed\nwritten: {done.file}")
    for row, code in list(done.failed.items())[:20]:
        print(f"failed: row {row}: {status.advice(code)}", file=sys.stderr)
    for said in (*cautions_of_mesh(table.scene.mesh), *_of_crushed(done.crushed)):
        print(f"caution: {said}", file=sys.stderr)
    if done.failed:
        print(f"to run these rows again, use --rows {' '.join(map(str, done.failed))} --out OTHER.h5", file=sys.stderr)
    return 1 if done.failed else 0


def _results(options: argparse.Namespace) -> Path:
    return options.out or options.parameters.with_suffix(".h5")


def _of_crushed(rows: dict[int, float]) -> list[str]:
    if not rows:
        return []
    worst = max(rows, key=lambda row: abs(math.log(max(rows[row], 1e-300))))
    named = ", ".join(map(str, list(rows)[:20])) + (", …" if len(rows) > 20 else "")
    s = "s" if len(rows) > 1 else ""
    how_many = f"{len(rows)} run{s} (row{s} {named}; worst: row {worst}, J = {rows[worst]:.2g})"
    return [
        f"at the end of {how_many}, some elements have less than a fifth or more than five times their initial "
        "volume, which is impossible in tissue: use a larger bulk modulus or smaller loads"
    ]


def _is_address(text: str) -> bool:
    """Return whether a string is HOST:PORT. With an invalid port JAX would end with a segmentation fault."""
    host, _, port = text.rpartition(":")
    return bool(host) and port.isdigit() and 1 <= int(port) <= 65535


def _share(given: list[str]) -> tuple[int, int]:
    """Return the index of this process and the number of processes, from JAX's distributed runtime.

    `given`: the values of --distributed: HOST:PORT, number of processes, index of this process; none on a cluster.
    """
    import jax

    option = f"--distributed {' '.join(given)}"
    if len(given) not in (0, 3) or not all(n.isdigit() for n in given[1:]):
        raise InputError(
            f"{option} needs three values or none: give HOST:PORT, the number of processes and the index of this "
            "process, or no value"
        )
    if given and not _is_address(given[0]):
        raise InputError(f"{option}: {given[0]} is not HOST:PORT with a port of 1 to 65535; give e.g. node1:12345")
    if given and int(given[1]) < 1:
        raise InputError(f"{option}: the number of processes must be above 0; give e.g. {given[0]} 2 0")
    if given and int(given[2]) >= int(given[1]):
        raise InputError(f"{option}: the processes are numbered from 0; give an index from 0 to {int(given[1]) - 1}")
    try:
        if given:
            jax.distributed.initialize(given[0], int(given[1]), int(given[2]))
        else:
            jax.distributed.initialize()
        process = (jax.process_index(), jax.process_count())
        # Runs need no communication. The runtime is shut down here, so that a failed process does not stop the rest.
        jax.distributed.shutdown()
    except (RuntimeError, ValueError) as error:
        reason = str(error).splitlines()[0]
        raise InputError(
            f"--distributed: the processes could not be connected ({reason}); check HOST:PORT and the number of "
            "processes, or give HOST:PORT N I"
        ) from None
    return process
