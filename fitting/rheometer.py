"""Frequency sweeps from files: plain CSV, TA TRIOS text and Anton Paar RheoCompass exports.

One reader serves all three: it looks for a line that names a frequency, a storage and a loss modulus, an optional line
of units below it, and numbers below that. Everything leaves in rad/s and Pa, sorted by frequency.
"""

import codecs
import os
import re
from pathlib import Path
from typing import NamedTuple

import numpy as np

from liverjax.errors import InputError

MODULUS_UNITS = {"pa": 1.0, "kpa": 1e3, "mpa": 1e6, "gpa": 1e9}
FREQUENCY_UNITS = {"hz": 2 * np.pi, "rad/s": 1.0, "rad_s": 1.0, "1/s": 1.0}
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

    @property
    def deviations(self) -> tuple[np.ndarray, np.ndarray]:
        """Scales of the residuals [Pa]: the given deviations, or the moduli themselves (relative errors)."""
        return (
            self.storage if self.storage_sd is None else self.storage_sd,
            self.loss if self.loss_sd is None else self.loss_sd,
        )


class _Column(NamedTuple):
    index: int
    name: str
    quantity: str  # frequency, storage, loss, storage_sd, loss_sd
    unit: str | None


def read_sweep(path: str | os.PathLike) -> Sweep:
    """Read a frequency sweep.

    Args:
        path: text with a header naming ``frequency_Hz`` or ``angular_frequency_rad_s``, ``storage_modulus_Pa``,
            ``loss_modulus_Pa`` (kPa, MPa likewise), optional ``storage_modulus_sd_Pa`` and ``loss_modulus_sd_Pa``;
            ``#`` comments; or an instrument's export.

    Raises:
        InputError: one sentence naming file, column or line, value and remedy.
    """
    lines = _text(Path(path)).splitlines()
    tables = _tables(str(path), lines)
    chosen = max(tables, key=lambda t: len({row[0] for row in t[1]}))
    columns, rows, numbers = chosen
    notes = []
    if len(tables) > 1:
        notes.append(f"the file holds {len(tables)} tables; the one with most frequencies, {len(rows)} rows, is used")
    return _sweep(str(path), columns, np.asarray(rows), numbers, notes)


def _text(path: Path) -> str:
    if path.is_dir():
        raise InputError(f"{path} is a folder: give the CSV file of a frequency sweep")
    if not path.is_file():
        raise InputError(f"{path}: no such file; give the CSV file of a frequency sweep")
    data = path.read_bytes()
    if not data.strip():
        raise InputError(f"{path} is empty: export the sweep again")
    if data.startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE)):
        return data.decode("utf-16", errors="replace")
    if b"\0" in data:
        raise InputError(f"{path} is not a text file: export the sweep as CSV or text")
    try:
        return data.decode("utf-8-sig")
    except UnicodeDecodeError:
        return data.decode("latin-1")


def _quantity(cell: str) -> tuple[str, str | None] | None:
    """(quantity, unit) that a header cell names, or None."""
    name = cell.strip().strip('"').strip().lower()
    unit = None
    bracket = re.search(r"[\[(]\s*([^\])]*?)\s*[\])]\s*$", name)
    if bracket:
        name, unit = name[: bracket.start()].strip(), bracket.group(1)
    plain = re.sub(r"[\s.\-]+", "_", name)
    sd = bool(re.search(r"(^|_)(sd|std|stdev|standard_deviation)(_|$)", plain))
    if re.match(r"(storage|g'(?!'))", plain):
        quantity = "storage"
    elif re.match(r"(loss_mod|loss_sd|loss_std|loss$|loss_[kmg]?pa$|g''|g\")", plain):
        quantity = "loss"
    elif re.match(r"(ang\w*_freq|omega|ω)", plain):
        quantity = "frequency"
        unit = unit or _suffix(plain, r"(?:ang\w*_frequency|omega|ω)") or None
    elif re.match(r"(freq|f_hz$|f$)", plain):
        quantity = "frequency"
        unit = unit or _suffix(plain, r"(?:frequency|freq|f)")
    else:
        return None
    if quantity != "frequency":
        stem = r"(?:storage|loss|g''|g'|g\")(?:_modulus)?(?:_(?:sd|std|stdev|standard_deviation))?"
        unit = unit or _suffix(plain, stem)
        quantity += "_sd" if sd else ""
    return quantity, unit


def _suffix(plain: str, stem: str) -> str | None:
    match = re.fullmatch(stem + r"_(.+)", plain)
    return match.group(1) if match else None


def _header(cells: list[str]) -> list[_Column]:
    columns: dict[str, _Column] = {}
    for k, cell in enumerate(cells):
        found = _quantity(cell)
        if found is None:
            continue
        column = _Column(k, cell.strip().strip('"').strip(), *found)
        angular = column.quantity == "frequency" and _quantity(cell)[0] == "frequency" and "ang" in cell.lower()
        if column.quantity not in columns or angular:  # rad/s wins where both are given
            columns[column.quantity] = column
    return list(columns.values())


def _split(line: str, delimiter: str) -> list[str]:
    return [c.strip() for c in line.split(delimiter)]


def _tables(path: str, lines: list[str]) -> list[tuple[list[_Column], list[list[float]], list[int]]]:
    """Every table found: its columns, rows of numbers in the order of the columns (frequency first), line numbers."""
    tables, best, k = [], [], 0
    while k < len(lines):
        line = lines[k]
        k += 1
        if not line.strip() or line.lstrip().startswith("#"):
            continue
        delimiter = max("\t;,", key=line.count)
        columns = _header(_split(line, delimiter))
        names = {c.quantity for c in columns}
        if len(names & set(NEEDED)) > len({c.quantity for c in best} & set(NEEDED)) or not best:
            best = columns
        if not set(NEEDED) <= names:
            continue
        columns, k = _with_unit_row(columns, lines, k, delimiter)
        columns.sort(key=lambda c: c.quantity != "frequency")
        rows, numbers, k = _rows(path, columns, lines, k, delimiter)
        if rows:
            tables.append((columns, rows, numbers))
        else:
            raise InputError(f"{path}: line {k}: there are no numbers below the header; give at least two frequencies")
    if tables:
        return tables
    found = {c.quantity for c in best}
    missing = next(q for q in NEEDED if q not in found)
    seen = next((s.strip() for s in lines if s.strip() and not s.lstrip().startswith("#")), "only comments")[:80]
    if not found:
        raise InputError(
            f"{path}: no header names frequency_Hz, storage_modulus_Pa and loss_modulus_Pa (the first line is "
            f"{seen!r}); add that header or export the sweep as CSV"
        )
    raise InputError(f"{path}: no column for {missing} in the header {seen!r}; add {NEEDED[missing]}")


def _with_unit_row(columns, lines, k, delimiter):
    """Instruments put units in a line of their own, within the next two."""
    for ahead in range(k, min(k + 2, len(lines))):
        cells = _split(lines[ahead], delimiter)
        units = {c.quantity: cells[c.index].strip('"[]() ').lower() for c in columns if c.index < len(cells)}
        if units.get("storage") in MODULUS_UNITS or units.get("frequency") in FREQUENCY_UNITS:
            return [c._replace(unit=units.get(c.quantity) or c.unit) for c in columns], ahead + 1
        if any(re.match(r"[-+]?\d", cell) for cell in cells):
            break
    return list(columns), k


def _number(text: str, delimiter: str) -> float | None:
    text = text.strip().strip('"')
    if delimiter != "," and "," in text and "." not in text:
        text = text.replace(",", ".")
    try:
        return float(text)
    except ValueError:
        return None


def _rows(path, columns, lines, k, delimiter):
    rows, numbers = [], []
    while k < len(lines):
        line = lines[k]
        k += 1
        if line.lstrip().startswith("#"):
            continue
        cells = _split(line, delimiter)
        if not any(cells):
            if rows and any(_header(_split(later, delimiter)) or later.startswith("[") for later in lines[k:]):
                break  # the next table of an instrument's export
            continue
        values = [_number(cells[c.index], delimiter) if c.index < len(cells) else None for c in columns]
        if all(v is None for v in values) and (line.startswith("[") or delimiter == "\t"):
            break
        for column, value in zip(columns, values, strict=True):
            if value is None:
                shown = repr(cells[column.index]) if column.index < len(cells) else "missing"
                raise InputError(
                    f"{path}: line {k}: {column.name} = {shown} is not a number; correct or remove the line"
                )
        rows.append(values)
        numbers.append(k)
    return rows, numbers, k


def _sweep(path: str, columns: list[_Column], rows: np.ndarray, numbers: list[int], notes: list[str]) -> Sweep:
    values = {}
    for j, column in enumerate(columns):
        table = FREQUENCY_UNITS if column.quantity == "frequency" else MODULUS_UNITS
        unit = column.unit
        if unit is None:
            unit = (
                ("rad/s" if "ang" in column.name.lower() or "omega" in column.name.lower() else "hz")
                if (column.quantity == "frequency")
                else "pa"
            )
            notes.append(f"column {column.name!r} states no unit; {unit} is taken")
        if unit.lower() not in table:
            known = "Hz or rad_s" if column.quantity == "frequency" else "Pa, kPa or MPa"
            raise InputError(f"{path}: unit {unit!r} of column {column.name} is not known; use {known}")
        for k, value in enumerate(rows[:, j]):
            if not np.isfinite(value):
                problem, remedy = "is not finite", "remove the line"
            elif value <= 0:
                problem, remedy = "is not positive", "correct the sign or remove the line"
            else:
                continue
            raise InputError(f"{path}: line {numbers[k]}: {column.name} = {value:g} {problem}; {remedy}")
        values[column.quantity] = rows[:, j] * table[unit.lower()]
    omega = values["frequency"]
    if len(omega) < 2:
        raise InputError(f"{path}: it holds {len(omega)} frequency; give at least two")
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
    get = {q: values[q][order] if q in values else None for q in ("storage", "loss", "storage_sd", "loss_sd")}
    return Sweep(omega[order], **get, source=path, notes=tuple(notes))
