"""``python -m liverjax simulate | sweep | design | check | plot | laws``."""

import argparse
import dataclasses
import os
import sys
import warnings
from pathlib import Path

from liverjax import laws
from liverjax.core.errors import InputError
from liverjax.core.files import writable
from liverjax.laws.volumetric import VOLUMETRIC


def _bounds(metadata) -> str:
    parts = [f"> {metadata['above']:g}"] if metadata.get("above") is not None else []
    parts += [f">= {metadata['lower']:g}"] if metadata.get("lower") is not None else []
    parts += [f"<= {metadata['upper']:g}"] if metadata.get("upper") is not None else []
    parts += ["not 0"] if metadata.get("nonzero") else []
    return ", ".join(parts) or "any"


def list_laws() -> None:
    """Print every law with its energy, parameters, units and bounds."""
    print(f"every law with bulk: volumetric = {' | '.join(VOLUMETRIC)} (default quadratic)")
    print("every law of I1, I2 and J: continued_below = 0.1, finite energy below that J (default off)")
    for name, cls in laws.LAWS.items():
        print(f"{name}\n    {(cls.__doc__ or name).splitlines()[0]}")
        for field in laws.parameters(cls):
            m = field.metadata
            optional = ", optional" if field.default is None else ""
            if field.default not in (None, dataclasses.MISSING):
                optional = f", default {field.default}"
            print(f"    {field.name:14s} [{m['unit']}]  {_bounds(m):8s} {m['about']}{optional}")


def check_law(name: str, out: Path) -> int:
    """Print the table of a law's gradient check and draw it; 1 if a row failed."""
    import jax

    from liverjax.laws import figures, gradient_check

    jax.config.update("jax_enable_x64", True)  # its limits are those of 64 bits
    law = gradient_check.load(name)
    file = _target(out, f"check_{_label(name)}.png")
    result = gradient_check.check(law)
    print(gradient_check.table(result))
    figures.gradient_check(result, _label(name), file)
    print(f"written: {file}")
    for row in result.failed:
        print(f"failed: {row.name}: {row.found}{f' ({row.limit})' if row.limit else ''}", file=sys.stderr)
    return 1 if result.failed else 0


def plot_laws(names: list[str], out: Path, stretches: list[float]) -> int:
    """Draw the stress-stretch curves of laws."""
    from liverjax.laws import figures, gradient_check

    if not 0 < stretches[0] < 1 < stretches[1] <= 20:
        raise InputError(
            f"--stretch {stretches[0]:g} {stretches[1]:g} is no range about 1: give e.g. --stretch 0.6 1.6"
        )
    names = [n for name in names for n in (laws.LAWS if name == "all" else [name])]
    labels = [_label(name) for name in names]
    named = {n if labels.count(k) > 1 else k: gradient_check.load(n) for k, n in zip(labels, names, strict=True)}
    file = _target(out, "laws.png")
    figures.curves(named, file, (stretches[0], stretches[1]))
    print(f"written: {file}")
    return 0


def run_scene(options: argparse.Namespace) -> int:
    """Simulate a scene file and write its results; 1 if a step failed, with what was computed kept."""
    import numpy as np
    from tqdm import tqdm

    from liverjax.core import status
    from liverjax.core.versions import versions
    from liverjax.jobs import long_run, output, parts
    from liverjax.physics import porosity
    from liverjax.scenes import scene_file
    from liverjax.simulation.cautions import cautions

    file, out = options.scene, options.out
    read, text = scene_file.load_scene(file), file.read_text(encoding="utf-8")
    target = _target(out, "result.h5")
    bar = tqdm(total=read.solve.steps, unit="step", disable=None, leave=False)  # on a terminal only
    report = None if bar.disable else lambda _: bar.update()
    try:
        ran = long_run.run(read, text, target, options.every, options.resume, report)
    except OSError as error:
        print(f"stopped: {target}: {error.strerror}; go on with --resume when there is space", file=sys.stderr)
        return 1
    finally:
        bar.close()
    result, codes = ran.result, np.asarray(ran.result.status)
    attributes = {"scene": text, "run_time_s": ran.run_time, "compile_time_s": ran.compile_time}
    if read.porosity is not None:
        attributes["bulk"] = porosity.bulk_in_force(read.porosity, read.law)
        print(attributes["bulk"])
    said = cautions(read, result)
    output.write_hdf5(target, read, result, attributes | {"warnings": said, "versions": versions()})
    if parts.beside(target).exists():
        parts.remove(parts.beside(target))
    s = result.statistics
    print(
        f"{read.mesh.number_of_nodes} nodes, {read.mesh.number_of_elements} tetrahedra, {len(codes)} steps: "
        f"{int(np.sum(s.iterations))} Newton and {int(np.sum(s.linear_iterations))} linear iterations, "
        f"largest residual {float(np.max(np.asarray(s.residual))):.1e} of the forces\n"
        + (f"run {ran.run_time:.3g} s ({ran.steps / ran.run_time:.3g} steps a second), " if ran.steps else "")
        + f"compile {ran.compile_time:.3g} s"
        + (f"; {len(codes) - ran.steps} steps found on disk" if ran.steps < len(codes) else "")
    )
    for sentence in said:
        print(f"caution: {sentence}")
    written = [str(target)]
    if options.vtu:
        written.append(str(output.write_vtu(out / "vtu", read, result)))
    if options.png:
        output.picture(out / "result.png", read, result)
        written.append(str(out / "result.png"))
    print(f"written: {', '.join(written)}")
    for step in np.flatnonzero(codes != status.CONVERGED)[:5]:
        print(f"failed: step {step + 1}: {status.advice(codes[step])}", file=sys.stderr)
    return 1 if np.any(codes != status.CONVERGED) else 0


def _share(given: list[str]) -> tuple[int, int]:
    """Number of this process and of all, from JAX's distributed runtime: HOST:PORT N I, or nothing on a cluster."""
    import jax

    if len(given) not in (0, 3) or not all(n.isdigit() for n in given[1:]):
        raise InputError(
            f"--distributed {' '.join(given)}: give HOST:PORT, number of processes and this one's, or nothing"
        )
    if given and int(given[2]) >= int(given[1]):
        raise InputError(f"--distributed {' '.join(given)}: processes are numbered from 0 to {int(given[1]) - 1}")
    try:
        if given:
            jax.distributed.initialize(given[0], int(given[1]), int(given[2]))
        else:
            jax.distributed.initialize()
        process = (jax.process_index(), jax.process_count())
        # Rows need no communication: left at once, so that a process that dies stops no other.
        jax.distributed.shutdown()
    except (RuntimeError, ValueError) as error:
        reason = str(error).splitlines()[0]
        raise InputError(
            f"--distributed: the processes did not find each other ({reason}): give HOST:PORT N I"
        ) from None
    return process


def run_sweep(options: argparse.Namespace) -> int:
    """Run a scene for every row of a table; 1 if a row failed or the disk is full, with what was computed kept."""
    import jax
    from tqdm import tqdm

    if options.devices is not None:
        if options.devices < 1:
            raise InputError(f"--devices {options.devices} must be above 0: give e.g. 2")
        jax.config.update("jax_num_cpu_devices", options.devices)
    process = (0, 1) if options.distributed is None else _share(options.distributed)

    from liverjax.core import status
    from liverjax.jobs import sweep

    table = sweep.read_sweep(
        options.scene,
        options.parameters,
        tuple(options.store),
        tuple(options.probe),
        options.chunk,
        tuple(options.rows),
    )
    out = options.out or options.parameters.with_suffix(".h5")
    bar = tqdm(total=len(table.rows), unit="row", disable=None, leave=False)  # on a terminal only
    try:
        done = sweep.run(table, out, options.resume, process, bar.update)
    except OSError as error:
        print(
            f"error: {out}: {error.strerror or error}: finished chunks are kept, go on with --resume", file=sys.stderr
        )
        return 1
    finally:
        bar.close()
    if done.file is None:
        print(f"process {process[0]} of {process[1]}: {done.computed} rows; others have rows to do yet")
        return 0
    print(f"{len(table.rows)} rows, {done.computed} computed now, {len(done.failed)} failed\nwritten: {done.file}")
    for row, code in list(done.failed.items())[:20]:
        print(f"failed: row {row}: {status.advice(code)}", file=sys.stderr)
    if done.failed:
        print(f"again: --rows {' '.join(map(str, done.failed))} --out OTHER.h5", file=sys.stderr)
    return 1 if done.failed else 0


def write_design(options: argparse.Namespace) -> int:
    """Write a table of parameters for a sweep."""
    from liverjax.jobs import design

    ranges = design.read_ranges(options.range)
    rows = design.design(ranges, options.rows, options.kind, options.seed)
    design.write_table(options.table, list(ranges), rows, f"{options.kind}, seed {options.seed}")
    print(f"{len(rows)} rows\nwritten: {options.table}")
    return 0


def _label(name: str) -> str:
    return name.rpartition(":")[2]


def _target(out: Path, name: str) -> Path:
    """File `name` in folder `out`, which is made and tried before anything is computed."""
    writable(out, (name,))
    return out / name


_SWEEP = "Run a scene for every row of a table. A kill at any moment costs one chunk: --resume goes on."
OUTPUTS = ("final_positions", "positions", "largest_displacement", "final_reactions", "largest_pressure")


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="python -m liverjax",
        description="Soft-tissue mechanics in JAX.",
        epilog="Exit code 0: done; 1: a check or a step failed; 2: unusable input.",
    )
    commands = parser.add_subparsers(dest="command", required=True)
    simulate = commands.add_parser("simulate", help="run a scene file", description="Run a scene file.")
    simulate.add_argument("scene", type=Path, metavar="SCENE.toml")
    simulate.add_argument("--vtu", action="store_true", help="write a ParaView series as well")
    simulate.add_argument("--png", action="store_true", help="draw the last state as well")
    simulate.add_argument("--every", type=int, default=50, metavar="N", help="steps between two writes (50)")
    simulate.add_argument("--resume", action="store_true", help="go on where a run was stopped")
    sweep = commands.add_parser("sweep", help="run a scene for every row of a table", description=_SWEEP)
    sweep.add_argument("scene", type=Path, metavar="SCENE.toml")
    sweep.add_argument(
        "parameters", type=Path, metavar="PARAMETERS.csv", help="a header of dotted names, one row a run"
    )
    sweep.add_argument("--out", type=Path, metavar="FILE.h5", help="the results (PARAMETERS.h5)")
    sweep.add_argument("--resume", action="store_true", help="go on where a run was stopped")
    sweep.add_argument("--store", nargs="+", default=["final_positions"], metavar="WHAT", help="|".join(OUTPUTS))
    sweep.add_argument("--probe", nargs="+", type=int, default=[], metavar="NODE", help="nodes to keep over time")
    sweep.add_argument("--rows", nargs="+", type=int, default=[], metavar="N", help="these rows alone, from 1")
    sweep.add_argument("--chunk", type=int, default=16, metavar="N", help="rows between two writes (16)")
    sweep.add_argument("--devices", type=int, metavar="N", help="spread the rows over N CPU devices (1)")
    where = "one of several processes; without HOST:PORT N I as the cluster (SLURM) says"
    sweep.add_argument("--distributed", nargs="*", metavar="HOST:PORT N I", help=where)
    design = commands.add_parser("design", help="write a table of parameters", description="Write a table for a sweep.")
    design.add_argument("table", type=Path, metavar="PARAMETERS.csv")
    design.add_argument("range", nargs="+", metavar="NAME=LOW:HIGH", help="e.g. law.mu=500:1000")
    design.add_argument("--kind", default="sobol", metavar="KIND", help="grid | latin | sobol (sobol)")
    design.add_argument("--rows", type=int, default=64, metavar="N", help="how many (64)")
    design.add_argument("--seed", type=int, default=0, metavar="N", help="of the random ones (0)")
    commands.add_parser("laws", help="the laws, their parameters, units and bounds")
    law = "name of a shipped law (typical parameters), or FILE.py:LAW, a law object or class of your own"
    check = commands.add_parser("check", help="gradient-check a material law", description="Gradient-check a law.")
    check.add_argument("law", metavar="NAME|FILE.py:LAW", help=law)
    plot = commands.add_parser("plot", help="stress-stretch curves", description="Draw stress-stretch curves of laws.")
    plot.add_argument("law", nargs="+", metavar="NAME|FILE.py:LAW", help=f"{law}; all for every shipped one")
    plot.add_argument("--stretch", nargs=2, type=float, default=(0.6, 1.6), metavar=("LOW", "HIGH"), help="0.6 1.6")
    for command in (check, plot, simulate):
        command.add_argument("--out", type=Path, default=Path(), metavar="DIR", help="folder of the results (here)")
    return parser


def main(arguments: list[str] | None = None) -> int:
    """Entry point; returns the exit code: 0 done, 1 failed, 2 unusable input."""
    options = _parser().parse_args(arguments)
    with warnings.catch_warnings():
        warnings.showwarning = lambda message, *_: print(f"warning: {message}", file=sys.stderr)
        return _run(options)


def _run(options: argparse.Namespace) -> int:
    try:
        if options.command == "check":
            return check_law(options.law, options.out)
        if options.command == "simulate":
            return run_scene(options)
        if options.command == "sweep":
            return run_sweep(options)
        if options.command == "design":
            return write_design(options)
        if options.command == "plot":
            return plot_laws(options.law, options.out, list(options.stretch))
        list_laws()
        return 0
    except InputError as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        resumable = options.command in ("simulate", "sweep")
        print("stopped" + ("; finished parts are kept: go on with --resume" if resumable else ""), file=sys.stderr)
        return 130  # as shells do
    except BrokenPipeError:  # the reader of a pipe has seen enough
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 0


if __name__ == "__main__":
    sys.exit(main())
