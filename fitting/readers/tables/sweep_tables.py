"""Find the tables of frequency sweeps in the lines of a file: where each table begins, and its rows of numbers."""

import re
from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from fitting.readers import raw_torque
from fitting.readers.tables.sweep_columns import (
    MODULI,
    NEEDED,
    Column,
    columns_beside,
    condition_columns,
    first_missing,
    header_columns,
    is_complete,
    is_tensile,
    names_shear,
)
from fitting.readers.tables.sweep_headings import DEVIATION_WORDS
from fitting.readers.tables.text_tables import (
    EMPTY,
    decimal_sign,
    delimiter_of_header,
    find_delimiter,
    means_nothing,
    refuse_unnamed_numbers,
    split_cells,
    summary_rows,
    to_number,
)
from fitting.readers.units import FREQUENCY_UNITS, MODULUS_UNITS
from liverjax.core.errors import InputError

#: First characters of a comment line.
COMMENTS = ("#", "%")


class Table(NamedTuple):
    """A table of a file, before its units are converted."""

    name: str  # name in the file; may be empty
    columns: list[Column]
    rows: list[list[float]]  # in the order of the columns
    numbers: list[int]  # line numbers in the file
    raw: dict[str, np.ndarray]  # raw measurements of the instrument, one value per row
    strain_unit: str = ""  # unit of the strain column, as in the file
    beside: tuple[tuple[Column, np.ndarray], ...] = ()  # columns that the sweep does not need, for comparison
    notes: tuple[str, ...] = ()  # notes on headings and numbers with two possible meanings

    @property
    def frequencies(self) -> int:
        """Number of different frequencies in the table."""
        place = next(j for j, c in enumerate(self.columns) if c.quantity == "frequency")
        return len({row[place] for row in self.rows})


def choose_table(
    path: str,
    tables: list[Table],
    wanted: str | None,
    what: str = "frequencies",
    size: Callable[[Table], int] = lambda table: table.frequencies,
) -> tuple[int, list[str]]:
    """Return the index of the table to read, and a note if there are several tables.

    If `wanted` is None, the function chooses the table with the largest `size`. By default, `size` is the number of
    frequencies.
    """
    names = [f"{k} {t.name!r}" if t.name else str(k) for k, t in enumerate(tables, 1)]
    if wanted is not None:
        k = _named(path, tables, names, wanted)
        return k, [f"table {names[k]} of {len(tables)} is used"] if len(tables) > 1 else []
    counts = [size(t) for t in tables]
    k = counts.index(max(counts))
    if len(tables) == 1:
        return k, []
    why = f"{'the first' if counts.count(counts[k]) > 1 else 'the one'} with most {what}, {counts[k]}"
    listed = f"the file contains {len(tables)} tables: {', '.join(names)}"
    return k, [f"{listed}; table {names[k]} is used, {why}; choose another table with --table NUMBER or NAME"]


def _named(path: str, tables: list[Table], names: list[str], wanted: str) -> int:
    """Return the index of the table with number or name `wanted`, or of the only table whose name contains `wanted`."""
    wanted = str(wanted)
    if wanted.isdecimal() and 1 <= int(wanted) <= len(tables):
        return int(wanted) - 1
    sought = wanted.strip().lower()
    matches = [k for k, t in enumerate(tables) if sought == t.name.lower()]
    matches = matches or [k for k, t in enumerate(tables) if sought and sought in t.name.lower()]
    if len(matches) == 1:
        return matches[0]
    found = f"is in the names of {len(matches)} tables" if matches else "is no table of the file"
    offered = ", ".join(names[k] for k in matches) if matches else ", ".join(names)
    raise InputError(f"{path}: --table {wanted} {found}; give the number or the whole name of one table: {offered}")


def tables_of(path: str, lines: list[str]) -> list[Table]:
    """Return all tables that have numbers. If no table has numbers, raise an `InputError` that names what is
    missing."""
    for uncomment in (False, True):  # second try: the header is a comment, as np.savetxt writes it
        tables, headers = _search(path, [line.lstrip("#% ") for line in lines] if uncomment else lines)
        if tables:
            return tables
        if headers:
            break
    if headers:
        raise InputError(
            f"{path}: line {headers[0]}: there are no numbers below the header; give two frequencies or more"
        )
    named = [header_columns(split_cells(line, find_delimiter(line))) for line in lines]
    best = max(range(len(lines)), key=lambda k: len({c.quantity for c in named[k]}))
    shown = lines[best].strip()[:80]
    if not named[best]:
        shown = next((s.strip() for s in lines if s.strip() and not s.lstrip().startswith("#")), "only comments")[:80]
        raise InputError(
            f"{path}: no header names frequency_Hz, storage_modulus_Pa and loss_modulus_Pa (the first line is "
            f"{shown!r}); add that header, separated by commas, or export the sweep as CSV"
        )
    lacks = first_missing(named[best])
    viscous = any(c.quantity == "viscosity" for c in named[best])
    hint = (
        "; viscosities are not read (convert them to |G*| = omega |eta*|, and name the column complex_modulus_Pa)"
        if viscous
        else "; shear waves belong to a sweep (SWEEP --with this file)"
        if re.search("(?i)velocity", shown)
        else ""
    )
    raise InputError(f"{path}: no column for {lacks} in the header {shown!r}; add {NEEDED[lacks]}{hint}")


def _search(path: str, lines: list[str]) -> tuple[list[Table], list[int]]:
    """Return the tables with numbers, and the line numbers of all headers that name enough quantities for a sweep."""
    tables, headers, k, free = [], [], 0, 0  # `free`: first line after the last table
    while k < len(lines):
        line = lines[k]
        k += 1
        if not line.strip() or line.lstrip().startswith(COMMENTS):
            continue
        delimiter = delimiter_of_header(line, _names_all)
        cells = split_cells(line, delimiter)
        columns = header_columns(cells)
        if not is_complete(columns):
            continue
        headers.append(k)
        name = _title(lines[free : k - 1])
        columns, k = _with_unit_row(columns, lines, k, delimiter)
        above = k
        rows, numbers, notes, k = _rows_below(path, columns, lines, k, delimiter, cells)
        if rows:
            units = [split_cells(line, delimiter) for line in lines[headers[-1] : above]]
            own = [split_cells(lines[n - 1], delimiter) for n in numbers]
            sign = decimal_sign(row[c.place] for row in own for c in columns if c.place < len(row))
            raw = _raw(cells, units, own, delimiter, sign)
            unit = raw_torque.unit_of("strain", cells, units[-1] if units else [])
            others = [c for c in columns_beside(cells, units[-1] if units else [], columns) if c.place < len(cells)]
            beside = tuple((c, _cells_of(c.place, own, delimiter, sign)) for c in others)
            unread = raw_torque.without_unit(cells, units[-1] if units else [])
            told = (*notes, *_nameless_deviations(cells), *_perhaps_thousands(own, columns, sign), *unread)
            told += tuple(_perhaps_tensile(cells, columns))
            tables.append(Table(name, columns, rows, numbers, raw, unit, beside, told))
        free = k
    return tables, headers


def _nameless_deviations(cells: list[str]) -> list[str]:
    """Return a note on headings such as "SD" and "±", which do not show to which modulus they belong."""
    words = [re.sub(r"[^a-z±]", " ", cell.lower()).split() for cell in cells]
    spread = {*DEVIATION_WORDS, "±"}
    found = [c for c, own in zip(cells, words, strict=True) if spread & set(own) and set(own) <= spread | {"pa", "kpa"}]
    if not found:
        return []
    return [
        f"columns {', '.join(map(repr, found))} are not used, because the headings do not show to which modulus the "
        "columns belong; name them storage_modulus_sd_Pa and loss_modulus_sd_Pa"
    ]


#: Words in headings of a DMA (dynamic mechanical analyser), which stretches, compresses or bends its samples. A
#: rheometer does not write these words.
_OF_DMA = re.compile(r"(static|dynamic|dyn\.?) (force|strain|stress|displacement)|^(sample )?length\b|stiffness", re.I)


def _perhaps_tensile(cells: list[str], columns: list[Column]) -> list[str]:
    """Return a note if the headings of the moduli name neither shear nor tension, but another heading is typical of a
    DMA (tension, compression or bending)."""
    moduli = [c for c in columns if c.quantity in MODULI]
    sign = next((c for c in cells if _OF_DMA.search(c.replace("_", " ").strip('" '))), None)
    turned = any(re.search(r"torque|angle|drehmoment|winkel|m/rad", cell.lower()) for cell in cells)
    if sign is None or turned or any(is_tensile(c) or names_shear(c) for c in moduli):
        return []
    names = " and ".join(dict.fromkeys(c.name for c in moduli))
    return [
        f"{names}: these columns are read as shear moduli G, although the column {sign.strip()!r} belongs to tests in "
        "tension, compression or bending; if the numbers are moduli E, three times as large, name the columns E' and "
        "E''"
    ]


def _perhaps_thousands(rows: list[list[str]], columns: list[Column], sign: str | None) -> list[str]:
    """Return a note if the commas in numbers may separate thousands, for example "410,382"."""
    cells = [row[c.place].strip('" ') for row in rows for c in columns if c.place < len(row)]
    shown = next((cell for cell in cells if re.fullmatch(r"[1-9]\d{0,2},\d{3}", cell)), None)
    if sign is not None or shown is None:
        return []
    return [f"{shown} is read as {shown.replace(',', '.')}: if the comma separates thousands, write no comma there"]


def _raw(cells, unit_rows, rows, delimiter, sign) -> dict[str, np.ndarray]:
    """Return raw torque, angle, phase, strain and temperature in SI units, for the rows of a table.

    An empty cell is NaN. `sign` is the table's decimal sign.
    """
    found, units = {}, unit_rows[-1] if unit_rows else []
    measured = {q: (place, factor, 0.0) for q, (place, factor) in raw_torque.known_columns(cells, units).items()}
    for quantity, (place, factor, offset) in (measured | condition_columns(cells, units)).items():
        values = _cells_of(place, rows, delimiter, sign)
        if np.any(np.isfinite(values)):
            found[quantity] = factor * values + offset
    return found


def _cells_of(place: int, rows: list[list[str]], delimiter: str, sign: str | None) -> np.ndarray:
    """Return the numbers of a column; NaN where a cell has no number."""
    found = [to_number(row[place], delimiter, sign) if place < len(row) else None for row in rows]
    return np.array([np.nan if value is None else value for value in found])


def _title(above: list[str]) -> str:
    """Return the name of a table from the lines above its header: the name of the step (TRIOS) or of the result
    (RheoCompass), or else the nearest line."""
    cells = [[c.strip("#\"' ") for c in line.split("\t")] for line in above]
    cells = [[c for c in row if c] for row in cells]
    for row in reversed(cells):
        if len(row) > 1 and row[0].lower().rstrip(":") in ("step name", "result", "test"):
            return row[1]
    steps = [k for k, row in enumerate(cells) if row and row[0].lower() == "[step]"]
    titles = [row[0] for row in (cells[steps[-1] + 1 :] if steps else cells[::-1]) if row]
    return titles[0][:60] if titles else ""


def _with_unit_row(columns: list[Column], lines: list[str], k: int, delimiter: str) -> tuple[list[Column], int]:
    """Return the columns, and the index of the next line to read. If one of the next two lines is a line of units, the
    columns get these units."""
    for ahead in range(k, min(k + 2, len(lines))):
        cells = split_cells(lines[ahead], delimiter)
        units = {c.place: cells[c.place].strip('"[]() ') for c in columns if c.place < len(cells)}
        moduli = [units.get(c.place) in MODULUS_UNITS for c in columns if c.quantity in MODULI]
        # If only the unit of the frequency is known, a later step raises the error for the units of the moduli.
        known = [units.get(c.place, "").lower() in FREQUENCY_UNITS for c in columns if c.quantity == "frequency"]
        if any(moduli) or any(known):
            return [c._replace(unit=units.get(c.place) or c.unit) for c in columns], ahead + 1
        if any(re.match(r"[-+]?\d", cell) for cell in cells):
            break
    return columns, k


def _rows_below(path, columns, lines, k, delimiter, headings):
    """Return the rows of numbers below a header, their line numbers, and the index of the line after them. An empty
    cell is NaN."""
    needed = [c for c in columns if not c.quantity.endswith("_sd")]
    every, numbers, notes = [], [], []
    while k < len(lines):
        line = lines[k]
        if line.lstrip().startswith(COMMENTS) or not line.strip(f"{delimiter} \t-=+:"):
            k += 1
            if every and not line.strip() and any(later.startswith("[") or _complete(later) for later in lines[k:]):
                break  # the next table of an export begins
            continue
        cells = split_cells(line, delimiter)
        words = _is_words(cells, needed)
        following = _row_after(lines, k, needed) if words and every and delimiter == "\t" else None
        if following is not None and _continues(every, following, needed):
            k += 1
            notes.append(f"line {k}, {_line_shown(line)}, has no numbers and is ignored")
            continue
        if words and (
            not every or line.startswith("[") or delimiter == "\t" or not _goes_on(lines, k, delimiter, needed)
        ):
            below = "".join(lines[k + 1 : k + 2])
            unread = following is not None or (delimiter == "\t" and _has_all_numbers(below, needed))
            if every and unread and not _complete(line):
                notes.append(f"line {k + 1}, {_line_shown(line)}, has no numbers, and the rows below it are not read")
            break  # the header was only a title, or this table ends
        k += 1
        refuse_unnamed_numbers(path, k, cells, headings, delimiter)
        every.append(cells)
        numbers.append(k)
    summaries = summary_rows(every)
    notes += [f"line {numbers[j]} is a summary of other rows ({word}) and is ignored" for j, word in summaries.items()]
    every, numbers = ([v for j, v in enumerate(a) if j not in summaries] for a in (every, numbers))
    kept = [[cells[c.place] if c.place < len(cells) else "" for c in columns] for cells in every]
    return _numbers_of_cells(path, columns, kept, numbers, delimiter), numbers, notes, k


def _is_words(cells: list[str], needed: list[Column]) -> bool:
    return means_nothing(cells[c.place] for c in needed if c.place < len(cells))


def _line_shown(line: str) -> str:
    return repr(" ".join(line.split())[:40])


def _needed_cells(line: str, needed: list[Column]) -> list[str]:
    """Return the needed cells of a line with tabs between the cells; a cell that is missing is empty."""
    cells = split_cells(line, "\t")
    return [cells[c.place] if c.place < len(cells) else "" for c in needed]


def _has_all_numbers(line: str, needed: list[Column]) -> bool:
    """Return whether a line with tabs between the cells has a number in each needed column."""
    return not any(means_nothing([cell]) for cell in _needed_cells(line, needed))


def _row_after(lines: list[str], k: int, needed: list[Column]) -> str | None:
    """Return the next whole row of numbers below line k, which has no numbers. Return None if there is no such row
    above the next table. The cells are separated by tabs. A line with words in two of the needed columns is the header
    of another table."""
    for line in lines[k:]:
        if _has_all_numbers(line, needed):
            return line
        own = _needed_cells(line, needed)
        headings = means_nothing(own) and sum(cell.lower() not in EMPTY for cell in own) > 1
        if headings or line.startswith("[") or _complete(line):
            return None
    return None


def _continues(rows: list[list[str]], line: str, needed: list[Column]) -> bool:
    """Return whether the frequency of a line continues the rows above it: it rises or falls like the last frequencies.
    Otherwise the line may begin another block of numbers. The cells of the line are separated by tabs."""
    place = next(c.place for c in needed if c.quantity == "frequency")
    cells = [row[place] for row in [*rows, split_cells(line, "\t")] if place < len(row)]
    sign = decimal_sign(cells)
    found = [to_number(cell, "\t", sign) for cell in cells]
    known = [value for value in found if value is not None and np.isfinite(value)]
    if len(known) < 3:
        return True  # one frequency above the line shows no direction
    *above, last, here = known
    before = next((value for value in reversed(above) if value != last), last)
    return (here - last) * (last - before) >= 0


def _goes_on(lines: list[str], k: int, delimiter: str, needed: list[Column]) -> bool:
    """Return whether numbers of the same table follow after line k, which has only words."""
    for line in lines[k:]:
        if _complete(line):
            return False
        if not _is_words(split_cells(line, delimiter), needed):
            return True
    return False


def _numbers_of_cells(path, columns, kept, numbers, delimiter):
    """Return the cells of all rows as numbers."""
    sign = decimal_sign(cell for row in kept for cell in row)
    rows = []
    for row, number in zip(kept, numbers, strict=True):
        rows.append([to_number(cell, delimiter, sign) for cell in row])
        for column, cell, value in zip(columns, row, rows[-1], strict=True):
            if value is None:
                raise InputError(
                    f"{path}: line {number}: {column.name} = {cell!r} is not a number; correct or remove the line"
                )
    return rows


def _complete(line: str) -> bool:
    return _names_all(split_cells(line, delimiter_of_header(line, _names_all)))


def _names_all(cells: list[str]) -> bool:
    return is_complete(header_columns(cells))
