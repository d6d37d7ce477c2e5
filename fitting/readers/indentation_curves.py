"""Read indentation curves from files: depth and force while the indenter moves in."""

import re
from pathlib import Path
from typing import NamedTuple

import numpy as np

from fitting.readers.noise_of_series import noise_of_series
from fitting.readers.tables.text_tables import (
    decimal_sign,
    delimiter_of_header,
    means_nothing,
    refuse_unnamed_numbers,
    split_cells,
    text_of,
    to_number,
    without_later_sheets,
)
from fitting.readers.units import INDENTATION_UNITS
from liverjax.core.errors import InputError

#: First words of the headings of the two columns. If several columns match, the column with the earlier word in this
#: list is read.
_WORDS = {
    "depth": ("indentation", "eindringtiefe", "enfoncement", "depth", "tiefe", "profondeur", "displacement", "weg"),
    "force": ("force", "kraft", "load", "normal force"),
}
#: A heading with one of these words names another quantity, for example a speed or an error.
_NOT = {"rate", "velocity", "speed", "sd", "std", "error", "modulus"}
#: A value above this, in SI units, cannot be a measurement.
_LARGEST = 1e30
_FEWEST = 6
#: A loading ends when the indenter moves back by more than _BACK times the depth range. A hold at the end of the
#: loading is ignored if it contains more than the fraction _HELD of the points of the loading.
_BACK, _HELD = 0.1, 0.15
#: An offset of the force is subtracted only if the noise is too small to hide a rise by this fraction of the largest
#: force.
_FLAT = 0.01


class IndentationCurve(NamedTuple):
    """The measured loading of an indentation test."""

    depth: np.ndarray  # (n,) [m] depth of the indenter, from an arbitrary zero; grows as the indenter moves in
    force: np.ndarray  # (n,) [N]
    source: str
    notes: tuple[str, ...] = ()


def read_indentation(path: str | Path) -> IndentationCurve:
    """Read the loading part of a curve. This part ends at the deepest point, or at an earlier hold of depth or force.
    If the file has several loadings, the first is read.

    Args:
        path: a workbook, or text with a header that names depth (or displacement, indentation) and force (or load) with
            their units, for example `depth_um,force_mN`. Units are m, mm, um, nm and N, mN, uN, nN, pN.

    Raises:
        InputError: the file cannot be used; the message names the column or line, the value and the remedy.
    """
    lines = text_of(Path(path), "an indentation curve").splitlines()
    head = next((k for k, line in enumerate(lines) if len(_depth_and_force(lines, k)) == 2), None)
    if head is None:
        unknown = next((words for words in map(_told_of_unknown_unit, lines) if words), None)
        missing = "no header names depth and force with units; write depth_mm,force_mN above the rows"
        raise InputError(f"{path}: {unknown or missing}")
    lines, unread = without_later_sheets(lines, head)
    found, delimiter = _depth_and_force(lines, head), _delimiter_of(lines, head)
    columns, notes = _in_si_units(str(path), lines, head, delimiter, found)
    notes = [*unread, *_told_of_others(lines, head, found), *notes]
    depth, force = columns["depth"], columns["force"]
    if not len(depth):
        raise InputError(
            f"{path}: there are no numbers below the header in line {head + 1}; give {_FEWEST} rows or more"
        )
    last, told = _end_of_loading(depth, force)
    notes += told
    if last < _FEWEST or np.ptp(depth[:last]) == 0:
        falls = len(depth) >= _FEWEST and np.argmax(depth) < len(depth) / 10 and depth[-1] < depth[0]
        pulls = len(force) >= _FEWEST and np.mean(force) < 0 and np.argmin(force) > len(force) / 2
        reversed_rows = falls and np.cov(depth, force)[0, 1] > 0 and np.mean(force) > 0
        remedy = "the depth falls during loading, so change its sign" if falls else "give more loading points"
        if reversed_rows:
            remedy = "depth and force fall from row to row, so reverse the order of the rows, or give the loading"
        remedy = "the force falls while the depth grows, so change its sign" if pulls and not falls else remedy
        remedy = "the force is the same in all rows, so check the column of the force" if np.ptp(force) == 0 else remedy
        raise InputError(
            f"{path}: the loading has {last} points; a fit needs {_FEWEST} or more, at different depths: {remedy}"
        )
    depth, force = depth[:last], force[:last]
    offset = _offset(force)
    if offset:
        notes.append(f"the force is {offset:.3g} N before the rise; this offset of the sensor is subtracted")
    return IndentationCurve(depth, force - offset, str(path), tuple(notes))


def _end_of_loading(depth: np.ndarray, force: np.ndarray) -> tuple[int, list[str]]:
    """Return the number of points of the first loading (a hold at its end does not count), and notes."""
    number, notes = len(depth), []
    back = np.maximum.accumulate(depth) - depth > _BACK * np.ptp(depth)
    end = int(np.argmax(back)) if back.any() else number
    last = int(np.argmax(depth[:end])) + 1
    # Several loadings: after moving back, the indenter moves in again by more than _BACK times the depth range.
    after = depth[end:]
    if len(after) and np.max(after - np.minimum.accumulate(after)) > _BACK * np.ptp(depth):
        notes.append("the file has several loadings: the first is fitted")
    held = max(_points_of_hold(v[:last]) for v in (depth, force))
    if held:
        notes.append(f"{held} points are ignored, because depth or force is constant at the end of the loading")
        last -= held
    elif last < number:
        notes.append(f"{number - last} points after the deepest one are ignored")
    return last, notes


def _offset(force: np.ndarray) -> float:
    """Return the mean force [N] of the first points if the indenter does not touch the sample there. This is assumed if
    the next points have the same mean force.

    Returns 0 otherwise, and also if the noise could hide a rise of the force, or if noise alone explains this mean.
    """
    few = max(3, len(force) // 20)
    first, after = float(np.mean(force[:few])), float(np.mean(force[few : 2 * few]))
    level = 3 * noise_of_series(force) / np.sqrt(few / 2)
    flat = abs(after - first) < max(level, 1e-3 * np.max(force)) and level < _FLAT * np.max(force)
    return first if flat and abs(first) > max(level, 1e-3 * np.max(force)) else 0.0


def _points_of_hold(values: np.ndarray) -> int:
    """Return the number of points at the end at which depth or force stays at its largest value; 0 if it still rises.

    Because of noise, a rising quantity comes near its largest value long before the end. So these points count as a
    hold only if they rise much less than the points before: by less than half of this rise minus twice the noise.
    """
    reached = int(np.argmax(values >= np.max(values) - _margin(values))) + 1
    held = len(values) - reached
    if held <= max(5, _HELD * len(values)):
        return 0
    half = min(held, reached) // 2
    if half < 2:  # the largest value is reached at the beginning
        return held
    before, within = (np.diff(part.reshape(2, half).mean(axis=1))[0] for part in _both_sides(values, reached, half))
    noise = noise_of_series(values) * np.sqrt(2 / half)  # noise of a difference of two means
    return held if within < 0.5 * before - 2 * noise else 0


def _both_sides(values: np.ndarray, reached: int, half: int) -> tuple[np.ndarray, np.ndarray]:
    """Return the last 2 * half values before index `reached`, and the last 2 * half values of the whole array."""
    return values[reached - 2 * half : reached], values[len(values) - 2 * half :]


def _margin(values: np.ndarray) -> float:
    """Return a distance. If a quantity is nearer than this to its largest value, it counts as constant. The distance is
    twice the noise, plus 0.5 % of the range of the values."""
    return 2 * noise_of_series(values) + 0.005 * float(np.ptp(values))


class _PlacedColumn(NamedTuple):
    """The column of depth or force in the table."""

    column: int  # index of the column, from 0
    name: str
    factor: float  # converts the values to SI units


def _depth_and_force(lines: list[str], head: int) -> dict[str, _PlacedColumn]:
    """Return the column of each quantity that line `head` names. The unit is in the heading or in the line below."""
    return _in_columns(*_header_and_below(lines, head, _delimiter_of(lines, head)))


def _delimiter_of(lines: list[str], head: int) -> str:
    """Return the delimiter of line `head` that gives depth and force, or else the most frequent one."""
    below = lines[head + 1] if head + 1 < len(lines) else ""

    def complete(cells: list[str]) -> bool:
        return any(len(_in_columns(cells, split_cells(below, sign))) == 2 for sign in "\t;,")

    return delimiter_of_header(lines[head], complete)


def _header_and_below(lines: list[str], head: int, delimiter: str) -> tuple[list[str], list[str]]:
    """Return the cells of line `head` and of the line below, which may contain units."""
    below = split_cells(lines[head + 1], delimiter) if head + 1 < len(lines) else []
    return split_cells(lines[head], delimiter), below


def _in_columns(cells: list[str], below: list[str]) -> dict[str, _PlacedColumn]:
    found = {}
    for quantity in _WORDS:
        places = _places(cells, below, quantity)
        if places:
            found[quantity] = places[0]
    return found


def _places(cells: list[str], below: list[str], quantity: str) -> list[_PlacedColumn]:
    """Return the columns of a quantity, best first. The headings of these columns begin with a word of the quantity and
    have a unit."""
    found, units = [], INDENTATION_UNITS[quantity]
    for j, cell in enumerate(cells):
        words = _words_of_heading(cell)
        unit = words[-1] if len(words) > 1 and words[-1] in units else None
        if unit is None and j < len(below):
            unit = next((w for w in [below[j].strip('[]() "')] if w in units), None)
        rank = _place_among_words(cell, quantity)
        if unit is not None and rank is not None:
            found.append((rank, j, _PlacedColumn(j, cell.strip('# "'), units[unit])))
    return [place for _, _, place in sorted(found)]


def _words_of_heading(cell: str) -> list[str]:
    return [w for w in re.split(r"[\s_()\[\]#\"/,]+", cell) if w]


def _place_among_words(cell: str, quantity: str) -> int | None:
    """Return the index in `_WORDS` of the first word of a heading, or None if the heading names another quantity."""
    if _NOT & {w.lower() for w in _words_of_heading(cell)}:
        return None
    return next((k for k, word in enumerate(_WORDS[quantity]) if cell.lower().lstrip('# "').startswith(word)), None)


def _told_of_unknown_unit(line: str) -> str | None:
    """Return a message on the first unknown unit in a line that names depth and force, or None if there is none. Such a
    unit is in brackets or follows an underscore."""
    for sign in "\t;,":
        cells = split_cells(line, sign)
        named = [(q, [cell for cell in cells if _place_among_words(cell, q) is not None]) for q in _WORDS]
        if not all(headings for _, headings in named):
            continue
        for quantity, headings in named:
            known = INDENTATION_UNITS[quantity]
            stated = re.search(r"(?:[\[(]\s*|_)([^\s_\[\]()]+)\s*[\])]?\s*$", headings[0])
            if stated is not None and stated[1] not in known:
                return (
                    f"unit {stated[1]!r} of {headings[0]!r} is not known; use {', '.join(filter(str.isascii, known))}"
                )
    return None


def _told_of_others(lines: list[str], head: int, found: dict[str, _PlacedColumn]) -> list[str]:
    """Return a note for each quantity that has several columns."""
    cells, below = _header_and_below(lines, head, _delimiter_of(lines, head))
    notes = []
    for quantity, place in found.items():
        others = [each.name for each in _places(cells, below, quantity) if each != place]
        if others:
            notes.append(
                f"the {quantity} is read from the column {place.name!r}, not from {', '.join(map(repr, others))}"
            )
    return notes


def _in_si_units(
    path: str, lines: list[str], head: int, delimiter: str, found: dict[str, _PlacedColumn]
) -> tuple[dict[str, np.ndarray], list[str]]:
    """Return the columns in SI units, and a note on rows that are ignored because of an empty cell."""
    numbered = [(k, line) for k, line in enumerate(lines[head + 1 :], head + 2) if line.strip(f"{delimiter} \t")]
    rows = [(k, split_cells(line, delimiter)) for k, line in numbered if not line.lstrip().startswith("#")]
    if rows and means_nothing(rows[0][1][p.column] for p in found.values() if p.column < len(rows[0][1])):
        rows = rows[1:]  # this row contains the units, not numbers
    sign, kept, empty = decimal_sign(cell for _, cells in rows for cell in cells), [], 0
    headings = split_cells(lines[head], delimiter)
    for number, cells in rows:
        refuse_unnamed_numbers(path, number, cells, headings, delimiter)
        shown = [cells[p.column] if p.column < len(cells) else "" for p in found.values()]
        values = [to_number(cell, delimiter, sign) for cell in shown]
        wrong = [cell for cell, value in zip(shown, values, strict=True) if value is None or np.isinf(value)]
        if wrong:
            raise InputError(f"{path}: line {number}: {wrong[0]!r} is not a finite number; correct or remove the line")
        if np.any(np.isnan(np.array(values, float))):
            empty += 1
            continue
        kept.append(values)
    table = np.array(kept, float).reshape(-1, len(found)) * [p.factor for p in found.values()]
    if np.any(np.abs(table) > _LARGEST):
        raise InputError(f"{path}: {np.abs(table).max():g} is beyond any measurement; correct the unit or the row")
    notes = [f"{empty} of {len(rows)} rows are ignored, because a cell is empty"] if empty else []
    return dict(zip(found, table.T, strict=True)), notes
