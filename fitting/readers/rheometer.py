"""Frequency sweeps from files: plain CSV, TA TRIOS text and Anton Paar RheoCompass exports.

One reader serves all three: it looks for a line that names a frequency, a storage and a loss modulus, an optional line
of units below it, and numbers below that. Everything leaves in rad/s and Pa, sorted by frequency.
"""

import codecs
import csv
import os
import re
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from fitting.readers import raw_torque, trios_json, workbook
from liverjax.core.errors import InputError

#: mPa is left out on purpose: it may be a millipascal or a careless MPa, a factor of 1e9.
MODULUS_UNITS = {"Pa": 1.0, "kPa": 1e3, "MPa": 1e6, "GPa": 1e9} | {"pa": 1.0, "kpa": 1e3, "gpa": 1e9, "MPA": 1e6}
FREQUENCY_UNITS = {"hz": 2 * np.pi} | dict.fromkeys(("rad/s", "rad_s", "rad s-1", "rad_s-1", "1/s", "s-1"), 1.0)
DEVIATION_WORDS = {"sd", "std", "stdev", "stddev", "se", "sem", "error", "err", "uncertainty", "deviation"}
#: First words of the columns; those with an E are of tension or bending.
STORAGE, LOSS = ("storage", "g'", "gp", "e'", "ep"), ("loss", "g''", "gpp", "e''", "epp")
#: Beyond these no modulus [Pa] or frequency [rad/s] was ever measured, and squares overflow.
SMALLEST, LARGEST = 1e-30, 1e30
#: Frequencies that must remain where points are left out: more would be lost than a fit of one mode can spare.
FEWEST = 3
NEEDED = {
    "frequency": "frequency_Hz or angular_frequency_rad_s",
    "storage": "storage_modulus_Pa",
    "loss": "loss_modulus_Pa",
}


class Sweep(NamedTuple):
    """A frequency sweep in SI units, sorted by frequency."""

    angular_frequency: np.ndarray  # (n,) [rad/s]
    storage: np.ndarray  # (n,) G' [Pa]
    loss: np.ndarray  # (n,) G'' [Pa]
    storage_sd: np.ndarray | None = None  # (n,) standard deviations [Pa]
    loss_sd: np.ndarray | None = None
    source: str = ""
    notes: tuple[str, ...] = ()  # what the reader changed or chose, sentences
    raw: dict[str, np.ndarray] | None = None  # (n,) raw torque [N m], angle [rad], phase [rad], where the file has them
    grey: np.ndarray | None = None  # (k, 3) [rad/s, Pa, Pa] points left out for the instrument's sake

    @property
    def deviations(self) -> tuple[np.ndarray, np.ndarray]:
        """Scales of the residuals [Pa]: the given deviations, or the moduli themselves (relative errors)."""
        return (
            self.storage if self.storage_sd is None else self.storage_sd,
            self.loss if self.loss_sd is None else self.loss_sd,
        )

    @property
    def resolved(self) -> tuple[float, float]:
        """Shortest and longest relaxation time [s] that the frequencies resolve."""
        return float(1 / self.angular_frequency[-1]), float(1 / self.angular_frequency[0])


class _Column(NamedTuple):
    place: int
    name: str
    quantity: str  # frequency, storage, loss, storage_sd, loss_sd
    unit: str | None


class _Table(NamedTuple):
    name: str  # what the file calls it, may be empty
    columns: list[_Column]
    rows: list[list[float]]  # in the order of the columns
    numbers: list[int]  # of the lines in the file
    raw: dict[str, np.ndarray]  # what the instrument measured, one value a row

    @property
    def frequencies(self) -> int:
        """How many different ones it holds."""
        place = next(j for j, c in enumerate(self.columns) if c.quantity == "frequency")
        return len({row[place] for row in self.rows})


def read_sweep(path: str | os.PathLike, table: str | None = None) -> Sweep:
    """Read a frequency sweep.

    A point with a modulus or frequency that is not finite, not positive or beyond any measurement is left out, and a
    note names it.

    Args:
        path: text with a header naming ``frequency_Hz`` or ``angular_frequency_rad_s``, ``storage_modulus_Pa``,
            ``loss_modulus_Pa`` (kPa, MPa likewise), optional ``storage_modulus_sd_Pa`` and ``loss_modulus_sd_Pa``;
            ``#`` comments; or an instrument's export.
        table: of a file with several tables, the number (from 1), the name or a part of the name of the one to read;
            by default the one with most frequencies, the first of equals.

    Raises:
        InputError: one sentence naming file, column or line, value and remedy.
    """
    tables = _tables(str(path), text_of(Path(path)).splitlines())
    chosen, notes = _choose(str(path), tables, table)
    return _sweep(str(path), tables[chosen], notes)


def within(sweep: Sweep, low: float | None, high: float | None) -> Sweep:
    """The points from `low` to `high` [Hz]; a note names how many are left out.

    Raises:
        InputError: fewer than `FEWEST` frequencies are left.
    """
    hertz = sweep.angular_frequency / (2 * np.pi)
    kept = np.ones(len(hertz), bool)
    for limit, side, name in ((low, -1, "min"), (high, 1, "max")):
        if limit is None:
            continue
        if not (np.isfinite(limit) and limit > 0):
            raise InputError(f"--{name}-frequency {limit:g} is no frequency in Hz: give a positive number")
        kept &= side * hertz <= side * limit * (1 + side * 1e-9)
    if kept.all():
        return sweep
    if len(np.unique(hertz[kept])) < FEWEST:
        raise InputError(
            f"{sweep.source or 'sweep'}: --min-frequency and --max-frequency leave {kept.sum()} of {len(kept)} points "
            f"(the file has {hertz[0]:.3g} to {hertz[-1]:.3g} Hz): leave {FEWEST} or more"
        )
    ends = " and ".join(
        f"{word} {limit:g} Hz" for word, limit in (("below", low), ("above", high)) if limit is not None
    )
    note = f"{(~kept).sum()} of {len(kept)} points {ends} are left out as asked for"
    return some(sweep, kept)._replace(notes=(*sweep.notes, note))


def some(sweep: Sweep, kept: np.ndarray) -> Sweep:
    """The points where `kept` (n,) is true."""
    names = ("angular_frequency", "storage", "loss", "storage_sd", "loss_sd")
    columns: dict[str, Any] = {q: None if getattr(sweep, q) is None else getattr(sweep, q)[kept] for q in names}
    raw = None if sweep.raw is None else {q: v[kept] for q, v in sweep.raw.items()}
    return sweep._replace(**columns, raw=raw)


def _choose(path: str, tables: list[_Table], wanted: str | None) -> tuple[int, list[str]]:
    """Place of the table to read, and a note where there are several."""
    names = [f"{k} {t.name!r}" if t.name else str(k) for k, t in enumerate(tables, 1)]
    if wanted is not None:
        k = _named(path, tables, names, wanted)
        return k, [f"table {names[k]} of {len(tables)} is used"] if len(tables) > 1 else []
    counts = [t.frequencies for t in tables]
    k = counts.index(max(counts))
    if len(tables) == 1:
        return k, []
    why = f"{'the first' if counts.count(counts[k]) > 1 else 'the one'} with most frequencies, {counts[k]}"
    listed = f"the file holds {len(tables)} tables: {', '.join(names)}"
    return k, [f"{listed}; table {names[k]} is used, {why}; choose another with --table NUMBER or NAME"]


def _named(path: str, tables: list[_Table], names: list[str], wanted: str) -> int:
    """Place of the table with this number, this name, or alone with this in its name."""
    if wanted.isdecimal() and 1 <= int(wanted) <= len(tables):
        return int(wanted) - 1
    sought = wanted.strip().lower()
    matches = [k for k, t in enumerate(tables) if sought == t.name.lower()]
    matches = matches or [k for k, t in enumerate(tables) if sought and sought in t.name.lower()]
    if len(matches) == 1:
        return matches[0]
    found = f"is in the names of {len(matches)} tables" if matches else "is no table of the file"
    offered = ", ".join(names[k] for k in matches) if matches else ", ".join(names)
    raise InputError(f"{path}: --table {wanted} {found}; give the number or the whole name of one: {offered}")


def text_of(path: Path, what: str = "a frequency sweep") -> str:
    """Content of a text file of any encoding; `InputError` asking for the CSV file of `what`."""
    try:
        if path.is_dir():
            raise InputError(f"{path} is a folder: give the CSV file of {what}")
        if not path.exists():
            raise InputError(f"{path}: no such file; give the CSV file of {what}")
        data = path.read_bytes()
    except OSError as error:
        raise InputError(f"{path}: {error.strerror}; give the CSV file of {what}") from None
    if not data.strip():
        raise InputError(f"{path} is empty: export the sweep again")
    workbook.refuse(path, data, f"the sheet of {what.replace('a ', 'the ', 1)}")
    text = _decoded(path, data)
    if text.lstrip().startswith("{"):
        found = trios_json.tables(text)
        if found is None:
            raise InputError(f"{path} is JSON, but not the export of TRIOS (it has no Results): give CSV or text")
        return found
    return text


def _decoded(path: Path, data: bytes) -> str:
    if data.startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE)):
        return data.decode("utf-16", errors="replace")
    if b"\0" in data:
        raise InputError(f"{path} is not a text file: export the sweep as CSV or text")
    try:
        return data.decode("utf-8-sig")
    except UnicodeDecodeError:
        return data.decode("latin-1")


def _known_unit(quantity: str, unit: str | None) -> bool:
    return unit is None or (unit.lower() in FREQUENCY_UNITS if quantity == "frequency" else unit in MODULUS_UNITS)


def _quantity(cell: str) -> tuple[str, str | None] | None:
    """(quantity, unit) that a header cell names, or None."""
    name, unit = cell, None
    for prime, plain in (("′", "'"), ("’", "'"), ("″", "''"), ("”", "''"), ('"', "''")):
        name = name.replace(prime, plain)
    bracket = re.search(r"[\[(]\s*([^\])]*?)\s*[\])]\s*$", name)
    if bracket:
        name, unit = name[: bracket.start()], bracket.group(1)
    words = [w for w in re.split(r"[\s_.]+", name.strip()) if w]
    lower = [w.lower() for w in words]
    spread = any(w in DEVIATION_WORDS for w in lower)
    kept = [(w, l) for w, l in zip(words, lower, strict=True) if l not in DEVIATION_WORDS | {"standard", "mean"}]
    words, lower = [w for w, _ in kept], [l for _, l in kept]
    if not lower:
        return None
    if lower[:2] in (["e", "stor"], ["e", "storage"], ["e", "loss"]):  # DMA: "E_stor", "E_loss (MPa)"
        lower, words = [f"e'{'' if lower[1].startswith('stor') else chr(39)}", *lower[2:]], words[1:]
    if lower[0] in STORAGE + LOSS:
        quantity = "storage" if lower[0] in STORAGE else "loss"
        stem = 2 if lower[1:2] in (["modulus"], ["mod"]) else 1
        certain = stem == 2 or lower[0].startswith(("g", "e"))
    elif lower[0] in ("angular", "ang", "omega", "ω"):
        quantity, certain = "frequency", True
        stem = 2 if lower[1:2] in (["frequency"], ["freq"]) else 1
    elif lower[0] in ("frequency", "freq", "f"):
        quantity, certain, stem = "frequency", lower[0] != "f", 1
    else:
        return None
    rest = "_".join(words[stem:])
    if unit is not None and rest:
        return None  # "Storage compliance (1/Pa)", "Frequency point (1)"
    unit = unit if unit is not None else (rest or None)
    if not certain and not _known_unit(quantity, unit):
        return None
    return quantity + ("_sd" if spread and quantity != "frequency" else ""), unit


def _is_angular(column: _Column) -> bool:
    return column.name.lower().startswith(("ang", "omega", "ω"))


def _header(cells: list[str]) -> list[_Column]:
    """Columns by quantity; the first of known unit comes first, rad/s before Hz, others after it (to compare)."""
    found = [(k, cell, _quantity(cell)) for k, cell in enumerate(cells)]
    columns = [_Column(k, cell.strip(), *q) for k, cell, q in found if q is not None]
    shear = {c.quantity for c in columns if not _is_tensile(c)}
    columns = [c for c in columns if c.quantity not in shear or not _is_tensile(c)]  # G before E where a file has both
    columns.sort(key=lambda c: (not _known_unit(c.quantity.removesuffix("_sd"), c.unit), not _is_angular(c), c.place))
    return columns


def _delimiter(line: str) -> str:
    best = max("\t;,|", key=line.count)
    return best if best in line else ("  " if "  " in line.strip() else " ")


def split_line(line: str, delimiter: str | None = None) -> tuple[str, list[str]]:
    """The delimiter, found where none is given, and the cells of a line."""
    delimiter = delimiter or _delimiter(line)
    return delimiter, _split(line, delimiter)


def _split(line: str, delimiter: str) -> list[str]:
    if delimiter in (" ", "  "):
        return re.split(r"\s{2,}" if delimiter == "  " else r"\s+", line.strip())
    return [c.strip() for c in next(csv.reader([line], delimiter=delimiter, skipinitialspace=True), [])]


def _tables(path: str, lines: list[str]) -> list[_Table]:
    """Every table that holds numbers; `InputError` saying what is missing where there is none."""
    for uncomment in (False, True):  # np.savetxt writes its header as a comment
        tables, headers = _search(path, [line.lstrip("# ") for line in lines] if uncomment else lines)
        if tables:
            return tables
        if headers:
            break
    if headers:
        raise InputError(
            f"{path}: line {headers[0]}: there are no numbers below the header; give two frequencies or more"
        )
    named = [{c.quantity for c in _header(_split(line, _delimiter(line)))} & set(NEEDED) for line in lines]
    best = max(range(len(lines)), key=lambda k: len(named[k]))
    shown = lines[best].strip()[:80]
    if not named[best]:
        shown = next((s.strip() for s in lines if s.strip() and not s.lstrip().startswith("#")), "only comments")[:80]
        raise InputError(
            f"{path}: no header names frequency_Hz, storage_modulus_Pa and loss_modulus_Pa (the first line is "
            f"{shown!r}); add that header, separated by commas, or export the sweep as CSV"
        )
    missing = next(q for q in NEEDED if q not in named[best])
    raise InputError(f"{path}: no column for {missing} in the header {shown!r}; add {NEEDED[missing]}")


def _search(path: str, lines: list[str]) -> tuple[list[_Table], list[int]]:
    """Tables with numbers, and the line numbers of all complete headers."""
    tables, headers, k, free = [], [], 0, 0  # `free`: from where on lines belong to no table
    while k < len(lines):
        line = lines[k]
        k += 1
        if not line.strip() or line.lstrip().startswith("#"):
            continue
        delimiter = _delimiter(line)
        cells = _split(line, delimiter)
        columns = _header(cells)
        if not set(NEEDED) <= {c.quantity for c in columns}:
            continue
        headers.append(k)
        name = _title(lines[free : k - 1])
        columns, k = _with_unit_row(columns, lines, k, delimiter)
        above = k
        rows, numbers, k = _rows(path, columns, lines, k, delimiter, len(cells))
        if rows:
            units = [_split(line, delimiter) for line in lines[headers[-1] : above]]
            raw = _raw(cells, units, [_split(lines[n - 1], delimiter) for n in numbers], delimiter)
            tables.append(_Table(name, columns, rows, numbers, raw))
        free = k
    return tables, headers


def _raw(cells, unit_rows, rows, delimiter) -> dict[str, np.ndarray]:
    """Raw torque, angle and phase in SI, of the rows of a table; a column with a gap is none."""
    found = {}
    for quantity, (place, factor) in raw_torque.columns(cells, unit_rows[-1] if unit_rows else []).items():
        values = [to_number(row[place], delimiter) if place < len(row) else None for row in rows]
        if all(v is not None and np.isfinite(v) for v in values):
            found[quantity] = factor * np.array(values, float)
    return found


def without_inertia(sweep: Sweep, radius: float | None = None, height: float | None = None) -> Sweep:
    """The points whose modulus exceeds what is not known of the instrument's inertia; the others become `grey`.

    Needs raw torque and angle in the file, and the torque of the sample or its radius and height [m].
    """
    if not sweep.raw:
        return sweep
    geometry = np.pi * radius**4 / (2 * height) if radius and height else None
    G = sweep.storage + 1j * sweep.loss
    found = raw_torque.share(sweep.angular_frequency, G, sweep.raw, geometry)
    if found is None:
        return sweep
    unknown = raw_torque.UNCERTAINTY * found.modulus
    lost = unknown > np.abs(G)
    k = int(np.argmax(found.modulus / np.abs(G)))
    note = (
        f"the raw torque shows an instrument inertia of {1e6 * found.inertia:.4g} uN m s^2; at "
        f"{sweep.angular_frequency[k] / (2 * np.pi):.3g} Hz it carries {found.modulus[k] / np.abs(G[k]):.3g} times the "
        "torque of the sample"
    )
    if not lost.any():
        return sweep._replace(notes=(*sweep.notes, note))
    if len(np.unique(sweep.angular_frequency[~lost])) < FEWEST:
        raise InputError(
            f"{sweep.source}: {note}: nearly all of the sweep is the instrument's; measure at lower frequencies"
        )
    lowest = sweep.angular_frequency[lost].min() / (2 * np.pi)
    share = f"{100 * raw_torque.UNCERTAINTY:g} % of the inertia, which calibrations leave open"
    left = (
        f"{lost.sum()} of {len(lost)} points from {lowest:.4g} Hz on are left out: the sample carries less than {share}"
    )
    grey = np.column_stack([sweep.angular_frequency, sweep.storage, sweep.loss])[lost]
    return some(sweep, ~lost)._replace(notes=(*sweep.notes, note, left), grey=grey)


def _title(above: list[str]) -> str:
    """What the lines above a header call its table: TRIOS's step, RheoCompass's result, else the nearest line."""
    cells = [[c.strip("#\"' ") for c in line.split("\t")] for line in above]
    cells = [[c for c in row if c] for row in cells]
    for row in reversed(cells):
        if len(row) > 1 and row[0].lower().rstrip(":") in ("step name", "result", "test"):
            return row[1]
    steps = [k for k, row in enumerate(cells) if row and row[0].lower() == "[step]"]
    titles = [row[0] for row in (cells[steps[-1] + 1 :] if steps else cells[::-1]) if row]
    return titles[0][:60] if titles else ""


def _with_unit_row(columns: list[_Column], lines: list[str], k: int, delimiter: str) -> tuple[list[_Column], int]:
    """Instruments put units in a line of their own, within the next two."""
    for ahead in range(k, min(k + 2, len(lines))):
        cells = _split(lines[ahead], delimiter)
        units = {c.place: cells[c.place].strip('"[]() ') for c in columns if c.place < len(cells)}
        moduli = [units.get(c.place) in MODULUS_UNITS for c in columns if c.quantity in ("storage", "loss")]
        if any(moduli):
            return [c._replace(unit=units.get(c.place) or c.unit) for c in columns], ahead + 1
        if any(re.match(r"[-+]?\d", cell) for cell in cells):
            break
    return columns, k


def to_number(text: str, delimiter: str) -> float | None:
    """A number, with a decimal comma where commas do not separate cells; None for any other text."""
    text = text.strip().strip('"')
    if delimiter != "," and "," in text and "." not in text:
        text = text.replace(",", ".")
    try:
        return float(text)
    except ValueError:
        return None


def _rows(path, columns, lines, k, delimiter, width):
    """Rows of numbers below a header, their line numbers, and where to go on."""
    needed = [c for c in columns if c.quantity in NEEDED]
    rows, numbers = [], []
    while k < len(lines):
        line = lines[k]
        if line.lstrip().startswith("#") or not line.strip(f"{delimiter} \t"):
            k += 1
            if rows and not line.strip() and any(later.startswith("[") or _complete(later) for later in lines[k:]):
                break  # the next table of an instrument's export
            continue
        cells = _split(line, delimiter)
        values = [to_number(cells[c.place], delimiter) if c.place < len(cells) else None for c in columns]
        here = [cells[c.place] for c in columns if c in needed and c.place < len(cells)]
        blank = not any(re.match(r"[-+]?\.?\d|nan|inf", cell.lower()) for cell in here)
        if blank and (not rows or line.startswith("[") or delimiter == "\t"):
            break  # a title taken for a header, or the end of this table
        k += 1
        for column, value in zip(columns, values, strict=True):
            if value is None:
                shown = repr(cells[column.place]) if column.place < len(cells) else "missing"
                raise InputError(
                    f"{path}: line {k}: {column.name} = {shown} is not a number; correct or remove the line"
                )
        if len([c for c in cells if c]) > width:
            raise InputError(
                f"{path}: line {k}: {len(cells)} cells under {width} headings; write decimals with a point"
            )
        rows.append(values)
        numbers.append(k)
    return rows, numbers, k


def _complete(line: str) -> bool:
    return set(NEEDED) <= {c.quantity for c in _header(_split(line, _delimiter(line)))}


def _si(path: str, table: _Table, j: int, notes: list[str]) -> np.ndarray:
    """Column j in rad/s or Pa."""
    column, unit = table.columns[j], table.columns[j].unit
    if unit is None:
        unit = "Pa" if column.quantity != "frequency" else "rad/s" if _is_angular(column) else "Hz"
        notes.append(f"column {column.name!r} states no unit; {unit} is taken")
    if not _known_unit(column.quantity, unit):
        known = "Hz or rad_s" if column.quantity == "frequency" else "Pa, kPa or MPa"
        raise InputError(f"{path}: unit {unit!r} of column {column.name} is not known; use {known}")
    if _is_angular(column) and unit.lower() == "hz":
        raise InputError(
            f"{path}: column {column.name} is an angular frequency in Hz; "
            "name it frequency_Hz or angular_frequency_rad_s"
        )
    scale = FREQUENCY_UNITS[unit.lower()] if column.quantity == "frequency" else MODULUS_UNITS[unit]
    return np.asarray(table.rows)[:, j] * scale


def _fault(column: _Column, written: float, value: float) -> tuple[str, str] | None:
    """What is wrong with a value in SI, as the file writes it, and the remedy."""
    if not np.isfinite(value):
        problem, remedy = "is not finite", "remove the line"
    elif value <= 0:
        problem, remedy = "is not positive", "correct the sign or remove the line"
    elif not SMALLEST < value < LARGEST:
        problem, remedy = "is beyond any measurement", "check the unit"
    else:
        return None
    return f"{column.name} = {written:g} {problem}", remedy


def _usable(path: str, table: _Table, values: dict[int, np.ndarray]) -> tuple[np.ndarray, list[str]]:
    """Which rows are good in all columns of `values`, and a note on the others.

    Raises:
        InputError: fewer than half of the points, or of three frequencies, are good.
    """
    good, faults = np.ones(len(table.rows), bool), []
    for k, number in enumerate(table.numbers):
        found = (_fault(table.columns[j], table.rows[k][j], column[k]) for j, column in values.items())
        fault = next((f for f in found if f is not None), None)
        if fault is not None:
            good[k] = False
            faults.append((f"line {number}: {fault[0]}", fault[1]))
    if not faults:
        return good, []
    omega = next(column for j, column in values.items() if table.columns[j].quantity == "frequency")
    if len(np.unique(omega[good])) < FEWEST or 2 * good.sum() < len(good):
        told, remedy = faults[0]
        more = f" (and {len(faults) - 1} more points are unusable)" if len(faults) > 1 else ""
        raise InputError(f"{path}: {told}{more}; {remedy}")
    told = "; ".join(told for told, _ in faults[:8]) + (f"; and {len(faults) - 8} more" if len(faults) > 8 else "")
    verb = "is" if len(faults) == 1 else "are"
    return good, [f"{len(faults)} of {len(good)} points {verb} left out as unusable: {told}"]


def _is_tensile(column: _Column) -> bool:
    return bool(re.match(r"\s*e['′’_ ]|\s*epp?\b|\s*[(]?e\b|\s*tensile", column.name.lower().replace('"', "'")))


def _to_shear(table: _Table, places: dict[str, int], columns: dict[int, np.ndarray]) -> list[str]:
    """Divide moduli of tension or bending by 3 in place; a note says so."""
    tensile = [j for q, j in places.items() if q != "frequency" and _is_tensile(table.columns[j])]
    for j in tensile:
        columns[j] = columns[j] / 3
    if not tensile:
        return []
    names = " and ".join(table.columns[j].name for j in tensile)
    return [f"{names} are of tension or bending: G = E / 3 is taken, as of an incompressible material"]


def _sweep(path: str, table: _Table, notes: list[str]) -> Sweep:
    places: dict[str, int] = {}
    columns: dict[int, np.ndarray] = {}
    for j, column in enumerate(table.columns):
        if column.quantity not in places:
            places[column.quantity], columns[j] = j, _si(path, table, j, notes)
    notes += _to_shear(table, places, columns)
    good, left_out = _usable(path, table, columns)
    values = {q: columns[j][good] for q, j in places.items()}
    for j, column in enumerate(table.columns):
        q = column.quantity
        if j == places[q] or not _known_unit(q.removesuffix("_sd"), column.unit):
            continue
        both = _si(path, table, j, [])[good] / (3 if _is_tensile(column) else 1)
        if not np.allclose(both, values[q], rtol=0.01):
            name = table.columns[places[q]].name
            raise InputError(f"{path}: columns {name} and {column.name} disagree; remove the wrong one")
    notes += left_out
    omega = values["frequency"]
    if len(np.unique(omega)) < 2:
        raise InputError(f"{path}: it holds {len(np.unique(omega))} frequency; give at least two different ones")
    if ("storage_sd" in values) != ("loss_sd" in values):
        raise InputError(
            f"{path}: only one of storage_modulus_sd_Pa and loss_modulus_sd_Pa is there; give both or none"
        )
    order = np.argsort(omega, kind="stable")
    if not np.array_equal(order, np.arange(len(omega))):
        notes.append("the frequencies were not in ascending order and have been sorted")
    repeated = len(omega) - len(np.unique(omega))
    if repeated:
        notes.append(f"{repeated} frequencies are repeated; each line counts as a measurement of its own")
    get: dict[str, Any] = {
        q: values[q][order] if q in values else None for q in ("storage", "loss", "storage_sd", "loss_sd")
    }
    raw = {q: v[good][order] for q, v in table.raw.items()}
    return Sweep(omega[order], **get, source=path, notes=tuple(notes), raw=raw or None)
