"""Indentation curves from files: depth and force of a loading."""

import re
from pathlib import Path
from typing import NamedTuple

import numpy as np

from fitting.readers.noise_of_series import noise_of_series
from fitting.readers.tables.text_tables import decimal_sign, find_delimiter, split_cells, text_of, to_number
from fitting.readers.units import INDENTATION_UNITS
from liverjax.core.errors import InputError

#: First words of the two columns.
_WORDS = {"depth": ("depth", "displacement", "indentation"), "force": ("force", "load")}
_FEWEST = 6
#: A loading ends where the indenter goes back by this part of the depth; a longer hold at its end, in points, is cut.
_BACK, _HELD = 0.1, 0.15
#: An offset is subtracted only if the noise could not hide a rise by this part of the largest force.
_FLAT = 0.01


class IndentationCurve(NamedTuple):
    """The measured approach of an indenter."""

    depth: np.ndarray  # (n,) [m] of the indenter, from any origin, larger further in
    force: np.ndarray  # (n,) [N]
    source: str
    notes: tuple[str, ...] = ()


def read_indentation(path: str | Path) -> IndentationCurve:
    """Read the loading part of a curve, up to the deepest point or to an earlier hold of depth or force; of several
    loadings the first is read.

    Args:
        path: text with a header that names depth (or displacement, indentation) and force (or load), with units m, mm,
            um, nm and N, mN, uN, nN: `depth_um,force_mN`; or a workbook.

    Raises:
        InputError: one sentence naming file, column or line, value and remedy.
    """
    lines = text_of(Path(path), "an indentation curve").splitlines()
    head = next((k for k, line in enumerate(lines) if all(_depth_and_force(line).values())), None)
    if head is None:
        raise InputError(f"{path}: no header names depth and force with units; write depth_mm,force_mN above the rows")
    delimiter = find_delimiter(lines[head])
    columns = {
        quantity: _in_si_units(str(path), lines[head + 1 :], head + 2, delimiter, *place)
        for quantity, place in _depth_and_force(lines[head]).items()
        if place is not None
    }
    depth, force = columns["depth"], columns["force"]
    last, notes = _end_of_loading(depth, force)
    if last < _FEWEST or np.ptp(depth[:last]) == 0:
        falls = len(depth) >= _FEWEST and np.argmax(depth) < len(depth) / 10 and depth[-1] < depth[0]
        pulls = len(force) >= _FEWEST and np.mean(force) < 0 and np.argmin(force) > len(force) / 2
        remedy = "the depth falls: it must grow further in, so change its sign" if falls else "give more of them"
        remedy = "the force falls while the depth grows: change its sign" if pulls and not falls else remedy
        raise InputError(f"{path}: {last} loading points; a fit needs {_FEWEST} or more, at different depths: {remedy}")
    depth, force = depth[:last], force[:last]
    offset = _offset(force)
    if offset:
        notes.append(f"the force is {offset:.3g} N before it rises: this offset of the sensor is subtracted")
    return IndentationCurve(depth, force - offset, str(path), tuple(notes))


def _end_of_loading(depth: np.ndarray, force: np.ndarray) -> tuple[int, list[str]]:
    """Number of points of the first loading, without a hold at its end; then notes."""
    number, notes = len(depth), []
    back = np.maximum.accumulate(depth) - depth > _BACK * np.ptp(depth)
    end = int(np.argmax(back)) if back.any() else number
    last = int(np.argmax(depth[:end])) + 1
    if np.any(depth[end:] > depth[last - 1] - 2 * _BACK * np.ptp(depth)):
        notes.append("the file has several loadings: the first is fitted")
    reached = [int(np.argmax(v[:last] >= np.max(v[:last]) - _margin(v[:last]))) + 1 for v in (depth, force)]
    if last - min(reached) > max(5, _HELD * last):
        notes.append(
            f"{last - min(reached)} points are left out, as depth or force is constant at the end of the loading"
        )
        last = min(reached)
    elif last < number:
        notes.append(f"{number - last} points after the deepest one are left out")
    return last, notes


def _offset(force: np.ndarray) -> float:
    """Mean force [N] of the first points, if the next ones have the same: the indenter does not touch there yet.

    It is 0 if the noise could hide a rise of the force, or if the noise alone explains this mean.
    """
    few = max(3, len(force) // 20)
    first, after = float(np.mean(force[:few])), float(np.mean(force[few : 2 * few]))
    level = 3 * noise_of_series(force) / np.sqrt(few / 2)
    flat = abs(after - first) < max(level, 1e-3 * np.max(force)) and level < _FLAT * np.max(force)
    return first if flat and abs(first) > max(level, 1e-3 * np.max(force)) else 0.0


def _margin(values: np.ndarray) -> float:
    """Distance from the largest value at which a quantity counts as held: twice its noise, plus 0.5 % of its range."""
    return 2 * noise_of_series(values) + 0.005 * float(np.ptp(values))


def _depth_and_force(line: str) -> dict[str, tuple[int, float] | None]:
    """Places of both columns in a line; None if the line does not name one of them."""
    cells = split_cells(line, find_delimiter(line))
    return {quantity: _place_and_factor(cells, quantity) for quantity in _WORDS}


def _place_and_factor(cells: list[str], quantity: str) -> tuple[int, float] | None:
    """Column and factor to SI of the heading that names a quantity with its unit."""
    for j, cell in enumerate(cells):
        words = [w for w in re.split(r"[\s_()\[\]#\"]+", cell) if w]
        if len(words) > 1 and words[0].lower() in _WORDS[quantity] and words[-1] in INDENTATION_UNITS[quantity]:
            return j, INDENTATION_UNITS[quantity][words[-1]]
    return None


def _in_si_units(path: str, lines: list[str], first: int, delimiter: str, place: int, factor: float) -> np.ndarray:
    values = []
    numbered = [(k, line) for k, line in enumerate(lines, first) if line.strip(f"{delimiter} \t")]
    rows = [(k, split_cells(line, delimiter)) for k, line in numbered if not line.lstrip().startswith("#")]
    sign = decimal_sign(cell for _, cells in rows for cell in cells)
    for number, cells in rows:
        value = to_number(cells[place], delimiter, sign) if place < len(cells) else None
        if value is None or not np.isfinite(value):
            shown = repr(cells[place]) if place < len(cells) else "missing"
            raise InputError(f"{path}: line {number}: {shown} is not a finite number; correct or remove the line")
        values.append(factor * value)
    return np.array(values)
