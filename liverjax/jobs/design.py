"""Make tables of parameters for a sweep: a grid, a Latin hypercube or a Sobol sequence."""

import re
from pathlib import Path

import numpy as np

from liverjax.core.errors import InputError
from liverjax.core.files import whole

KINDS = ("grid", "latin", "sobol")
#: Possible first bytes of a table that `design` has written.
_BEGINNINGS = tuple(f"# {kind}".encode() for kind in KINDS)


def number_of(text: str) -> float:
    """Convert a table cell (a string) to a number. Underscores and non-ASCII digits are not allowed (unlike in Python).

    Raises:
        ValueError: the string is not such a number.
    """
    if "_" in text or not text.isascii():
        raise ValueError(text)
    return float(text)


def read_ranges(given: list[str]) -> dict[str, tuple[float, float]]:
    """Convert strings such as ``law.mu=500:1000`` to {name: (low, high)}.

    Raises:
        InputError: a string is not a range of numbers, a range has low >= high, or a name occurs twice.
    """
    ranges: dict[str, tuple[float, float]] = {}
    for text in given:
        name, _, span = text.partition("=")
        try:
            low, high = (number_of(v) for v in span.split(":"))
        except ValueError:
            raise InputError(f"{text!r} is not a range: write name=low:high, e.g. law.mu=500:1000") from None
        if not (np.isfinite(high - low) and low < high):
            raise InputError(
                f"{text!r} does not rise from low to high, or is too wide: write name=low:high, e.g. law.mu=500:1000"
            )
        if not re.fullmatch(r"[\w.]+", name.strip()):
            raise InputError(f"{text!r} contains no dotted name: write name=low:high, e.g. law.mu=500:1000")
        if name in ranges:
            raise InputError(f"{name} has two ranges: remove one of them")
        ranges[name] = (low, high)
    return ranges


def design(ranges: dict[str, tuple[float, float]], rows: int, kind: str = "sobol", seed: int = 0) -> np.ndarray:
    """Return a table (N, P) of N sets of P parameters within the ranges, with one set per row.

    Args:
        ranges: lower and upper bound of every parameter.
        rows: number of rows. A grid may have fewer rows: every parameter has the same number of values.
        kind: "grid", "latin" (hypercube) or "sobol" (sequence, balanced if `rows` is a power of 2).
        seed: random seed of "latin" and "sobol".

    Raises:
        InputError: `kind` is unknown, `rows` is below 1, `seed` is below 0, no parameter is given, or `rows` is too
            small for a grid with two values of each parameter.
    """
    from scipy.stats import qmc

    if kind not in KINDS:
        raise InputError(f"--kind {kind} is not known: use {', '.join(KINDS)}")
    if rows < 1 or not ranges:
        raise InputError(
            f"--rows {rows} and {len(ranges)} parameters make no table: give at least one row and one parameter"
        )
    if seed < 0:
        raise InputError(f"--seed {seed} is negative: give 0 or a positive integer")
    low, high = np.array(list(ranges.values())).T
    if kind == "grid":
        if rows < 2 ** len(low):
            raise InputError(
                f"--rows {rows} is too few for a grid of {len(low)} parameters: give {2 ** len(low)} or more, or "
                "another --kind"
            )
        along = int(np.floor(rows ** (1 / len(low)) + 1e-9))
        axes = [np.linspace(a, b, along) for a, b in zip(low, high, strict=True)]
        return np.stack([g.ravel() for g in np.meshgrid(*axes, indexing="ij")], axis=1)
    if kind == "latin":
        return qmc.scale(qmc.LatinHypercube(len(low), rng=seed).random(rows), low, high)
    exponent = int(np.ceil(np.log2(rows)))
    return qmc.scale(qmc.Sobol(len(low), rng=seed).random_base2(exponent)[:rows], low, high)


def write_table(file: Path, names: list[str], rows: np.ndarray, note: str) -> None:
    """Write a CSV file for `liverjax.jobs.sweep.read_table`, with `note` as a comment.

    Raises:
        InputError: the file cannot be written, or it exists and is not a table of `design`.
    """
    lines = [names, *([repr(float(v)) for v in row] for row in rows)]
    text = f"# {note}\n" + "".join(",".join(line) + "\n" for line in lines)
    try:
        if file.is_file() and file.stat().st_size and not file.read_bytes().startswith(_BEGINNINGS):
            raise InputError(
                f"{file} exists and is not a table of `liverjax design`: give another file, or remove this file"
            )
        if file.exists() and not file.is_file():  # a terminal or a pipe cannot be replaced by a new file
            file.write_text(text, encoding="utf-8")
            return
        with whole(file) as beside:
            beside.write_text(text, encoding="utf-8")
    except OSError as error:
        raise InputError(f"{file} cannot be written ({error.strerror}): give another file") from None
