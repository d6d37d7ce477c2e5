"""Read the columns of relaxation and creep tests: the time, and a modulus, a compliance, or two measured quantities.

The files have the same formats as for sweeps: plain CSV, TRIOS and RheoCompass text, with units in the header or below
it. The results are in SI units.
"""

import os
import re
from pathlib import Path

import numpy as np

from fitting.readers.rheometer import LARGEST
from fitting.readers.tables.text_tables import (
    EMPTY,
    decimal_sign,
    delimiter_of_header,
    means_nothing,
    refuse_unnamed_numbers,
    split_cells,
    split_line,
    summary_rows,
    text_of,
    to_number,
)
from fitting.readers.units import TIME_TEST_UNITS
from liverjax.core.errors import InputError

#: First words of a heading, and the quantity that they mean. If one entry begins with the words of another, the longer
#: entry comes first.
WORDS = (
    ("relaxation modulus e(t)", "tensile modulus"),
    ("young's modulus e(t)", "tensile modulus"),
    ("modulus e(t)", "tensile modulus"),
    ("elastizitätsmodul", "tensile modulus"),
    ("zugmodul", "tensile modulus"),
    ("module d'young", "tensile modulus"),
    ("zugspannung", "tensile stress"),
    ("relaxation modulus g(t)", "modulus"),
    ("tensile relaxation modulus", "tensile modulus"),
    ("tensile modulus", "tensile modulus"),
    ("young's relaxation modulus", "tensile modulus"),
    ("young's modulus", "tensile modulus"),
    ("youngs modulus", "tensile modulus"),
    ("tensile stress", "tensile stress"),
    ("tensile strain", "tensile strain"),
    ("compressive stress", "tensile stress"),
    ("compression stress", "tensile stress"),
    ("compression strain", "tensile strain"),
    ("compressive strain", "tensile strain"),
    ("engineering stress", "tensile stress"),
    ("engineering strain", "tensile strain"),
    ("nominal stress", "tensile stress"),
    ("nominal strain", "tensile strain"),
    ("e(t)", "tensile modulus"),
    ("tensile creep compliance", "tensile compliance"),
    ("creep compliance d(t)", "tensile compliance"),
    ("creep compliance j(t)", "compliance"),
    ("tensile compliance", "tensile compliance"),
    ("d(t)", "tensile compliance"),
    ("relaxationsmodul", "modulus"),
    ("schubmodul", "modulus"),
    ("module de relaxation", "modulus"),
    ("kriechnachgiebigkeit", "compliance"),
    ("complaisance", "compliance"),
    ("scherdeformation", "strain"),
    ("deformation", "strain"),
    ("dehnung", "strain"),
    ("déformation", "strain"),
    ("schubspannung", "stress"),
    ("scherspannung", "stress"),
    ("contrainte", "stress"),
    ("drehmoment", "torque"),
    ("auslenkwinkel", "angle"),
    ("normal force", "force"),
    ("normalkraft", "force"),
    ("kraft", "force"),
    ("load", "force"),
    ("extension", "displacement"),
    ("déplacement", "displacement"),
    ("weg", "displacement"),
    ("elapsed time", "time"),
    ("test time", "time"),
    ("zeit", "time"),
    ("temps", "time"),
    ("relaxation modulus", "modulus"),
    ("shear modulus", "modulus"),
    ("modulus", "modulus"),
    ("g(t)", "modulus"),
    ("creep compliance", "compliance"),
    ("compliance", "compliance"),
    ("j(t)", "compliance"),
    ("shear strain", "strain"),
    ("strain", "strain"),
    ("shear stress", "stress"),
    ("stress", "stress"),
    ("torque", "torque"),
    ("angle", "angle"),
    ("deflection angle", "angle"),
    ("axial force", "force"),
    ("force", "force"),
    ("displacement", "displacement"),
    ("step time", "time"),
    ("time", "time"),
    ("t", "time"),
)
#: Combinations of quantities, best first. A file must have one combination in addition to the time.
FORMS = (
    ("strain", "stress"),
    ("tensile strain", "tensile stress"),
    ("angle", "torque"),
    ("displacement", "force"),
    ("modulus",),
    ("compliance",),
    ("tensile modulus",),
    ("tensile compliance",),
)
#: For each tensile quantity: the quantity of shear and the conversion factor, for an incompressible sample.
TENSILE = {
    "tensile modulus": ("modulus", 1 / 3),
    "tensile compliance": ("compliance", 3.0),
    "tensile strain": ("strain", 1.0),
    "tensile stress": ("stress", 1 / 3),
}


#: In viscoelastic tests, soft tissue is not strained more than this [1]. A larger value may be in percent.
LARGE = 1.0
#: TRIOS writes two times: one from the start of the test step, one from the start of the experiment. The time of the
#: step is used.
OWN_TIME = "step time"


def read_columns(
    path: str | os.PathLike, preferred: tuple[str, ...] = FORMS[0]
) -> tuple[dict[str, np.ndarray], list[str]]:
    """Return the columns of a test by quantity, in SI units, and notes. The times increase, and begin at 0 s or later.

    Args:
        path: a file with a header that names the time and one combination of quantities in `FORMS`.
        preferred: the combination that is read if the file has several. Without it, the first one in `FORMS` is read.

    Raises:
        InputError: the file cannot be used; the message names the column or line, the value and the remedy.
    """
    return in_shear(*named_columns(path, preferred))


def named_columns(
    path: str | os.PathLike, preferred: tuple[str, ...] = FORMS[0]
) -> tuple[dict[str, np.ndarray], list[str]]:
    """Return the same columns and notes as `read_columns`, but with the tensile quantities not converted to shear."""
    columns, notes = _columns_in_time(
        str(path), text_of(Path(path), "a relaxation or creep test").splitlines(), preferred
    )
    time = columns["time"]
    if not len(time):
        raise InputError(f"{path}: every row has a cell that is empty or not finite; give numbers")
    if len(time) > 2 and np.all(np.diff(time) < 0):
        raise InputError(
            f"{path}: the times decrease from {time[0]:g} s to {time[-1]:g} s; reverse the order of the rows"
        )
    if np.any(np.diff(time) <= 0) or time[0] < 0:
        k = int(np.argmax(np.diff(time) <= 0)) + 1
        order = f"time {time[k]:g} s follows {time[k - 1]:g} s" if time[0] >= 0 else f"time {time[0]:g} s is negative"
        if time[0] >= 0 and time[k] == time[k - 1]:
            raise InputError(
                f"{path}: two rows have the time {time[k]:g} s; write times with more digits, or replace both rows by "
                "their mean"
            )
        raise InputError(f"{path}: {order}; the times must begin at 0 s or later, and increase")
    return columns, notes


def _columns_in_time(
    path: str, lines: list[str], preferred: tuple[str, ...]
) -> tuple[dict[str, np.ndarray], list[str]]:
    """Return the columns, in SI units, of the first table that has the time and one of `FORMS`; and notes."""
    for k, line in enumerate(lines):
        delimiter = delimiter_of_header(line.lstrip("# "), _names_a_test)
        cells = split_cells(line.lstrip("# "), delimiter)
        found = _heading(cells)
        form = next((f for f in (preferred, *FORMS) if set(f) <= set(found)), None)
        if "time" in found and form is not None:
            found = {q: found[q] for q in ("time", *form)}  # other columns may have empty cells and other units
            rows, units, left_out = _rows_in_time(path, lines, k + 1, delimiter, found)
            columns, notes = _in_si(path, found, np.array(rows), units)
            return columns, [*_told_of_times(cells), *notes, *left_out, *_told_of_tables(lines[k + 1 :])]
    unknown = next(filter(None, map(_unknown_unit, lines)), None)
    if unknown is not None:
        raise InputError(f"{path}: unit {unknown[1]!r} of {unknown[0]} is not known; {_known_units(unknown[0])}")
    first = next((line.strip() for line in lines if line.strip()), "")[:80]
    raise InputError(
        f"{path}: no header names time_s together with one of these: relaxation_modulus_Pa; creep_compliance_1/Pa; "
        "E(t); strain and stress_Pa; angle_rad and torque_N.m; displacement_m and force_N. Add such a header (first "
        f"line: {first!r})"
    )


def in_shear(columns: dict[str, np.ndarray], notes: list[str]) -> tuple[dict[str, np.ndarray], list[str]]:
    """Return the columns with tensile quantities converted to shear, and a note on this."""
    tensile = [name for name in TENSILE if name in columns]
    for name in tensile:
        shear, factor = TENSILE[name]
        columns[shear] = factor * columns.pop(name)
    if tensile:
        verb = "is assumed to be that" if len(tensile) == 1 else "are assumed to be those"
        notes = [*notes, f"{' and '.join(tensile)} {verb} of an incompressible sample: G = E / 3"]
    if "tensile stress" in tensile:
        notes += beyond_small(float(np.nanmax(np.abs(columns["strain"]), initial=0.0)))
    return columns, notes


#: A note is given if the relative deviation of the force from linear elasticity exceeds this value [1].
BENT = 0.02


def beyond_small(strain: float) -> list[str]:
    """Return a note if the force of a neo-Hookean sample at this strain is no longer proportional to the strain."""

    def off(stretch: float) -> float:
        """Return the force, divided by the linear force, minus 1."""
        return (stretch - stretch**-2) / (3 * (stretch - 1)) - 1

    if not strain > 0 or -off(1 + strain) < BENT:
        return []
    shorter = f"{100 * off(1 - strain):.2g} % too large in compression, " if strain < 1 else ""
    return [
        f"the sample is strained by {100 * strain:.2g} %, where the force of neo-Hookean tissue is not proportional to "
        f"the strain: the moduli are {shorter}{-100 * off(1 + strain):.2g} % too small in tension. To include this "
        "effect in the fit, describe the test in a TOML file"
    ]


def _unknown_unit(line: str) -> tuple[str, str] | None:
    """Return quantity and unit of a heading with an unknown unit. Returns None if the line is no header of a test (the
    time and one of `FORMS`), or if all units are known."""
    cells = split_line(line.lstrip("# "))[1]
    found = _heading(cells)
    for cell in cells if "time" in found else []:
        name = re.sub(r"[\[(\])\"_]", " ", cell).strip()
        for word, quantity in WORDS:
            *before, unit = name.split() or [""]
            whole = any(set(f) <= {*found, quantity} for f in FORMS)
            if quantity not in found and " ".join(before).lower() == word and whole:
                return quantity, unit
    return None


def _known_units(quantity: str) -> str:
    return f"use {', '.join(TIME_TEST_UNITS[quantity])}"


def _told_of_tables(below: list[str]) -> list[str]:
    """Return a note if further tables of tests follow below the first table."""
    more = sum(map(_begins_a_table, below))
    if not more:
        return []
    return [f"the file contains {more + 1} tables of a test, and only the first is read: give one file for each table"]


def _begins_a_table(line: str) -> bool:
    plain = line.lstrip("# ")
    return _names_a_test(split_cells(plain, delimiter_of_header(plain, _names_a_test)))


def _names_a_test(cells: list[str]) -> bool:
    found = _heading(cells)
    return "time" in found and any(set(f) <= set(found) for f in FORMS)


def _heading(cells: list[str]) -> dict[str, tuple[int, str | None]]:
    """Return for each quantity the column index and unit of the first cell that names the quantity. If
    several columns contain times, the column of the step time is used."""
    found: dict[str, tuple[int, str | None]] = {}
    for k, cell in sorted(enumerate(cells), key=lambda each: not _is_own_time(each[1])):
        text = cell.strip().strip('"')
        bracket = re.search(r"[\[(]\s*([^\])]*?)\s*[\])]\s*$", text) if not text.lower().endswith("(t)") else None
        unit = bracket.group(1) if bracket else None
        name = (text[: bracket.start()] if bracket else text).replace("_", " ").strip()
        for word, quantity in WORDS:
            if name.lower().startswith(word):
                # Remove the sign or word before the unit, as in "Zeit / s", "time, s" or "time in s".
                rest = re.sub(r"^(?:[/,]|in\b)\s*", "", name[len(word) :].strip())
                if rest and not _known_column(quantity, rest):
                    break  # another quantity, for example "strain rate" or "stress (step)"
                if word in ("e(t)", "d(t)") and name[0].islower():
                    break  # in small letters, e(t) is a strain and d(t) a displacement
                if word == "t" and not (name[0] == "t" and (unit or rest) and _known_column("time", unit or rest)):
                    break  # a capital T is a temperature
                found.setdefault(quantity, (k, unit or rest or None))
                break
    return _all_tensile(found, cells)


#: Words of headings that mean shear even in a table of a tensile test.
_SHEAR = re.compile(r"shear|g\(t\)|j\(t\)|schub|scher|cisail", re.IGNORECASE)


def _all_tensile(found: dict[str, tuple[int, str | None]], cells: list[str]) -> dict[str, tuple[int, str | None]]:
    """Make all quantities tensile if one is tensile, but not those whose headings name shear. Return the columns."""
    if not TENSILE.keys() & found.keys():
        return found
    return {
        f"tensile {q}" if f"tensile {q}" in TENSILE and not _SHEAR.search(cells[place[0]]) else q: place
        for q, place in sorted(found.items(), key=lambda each: each[0] in TENSILE)
    }


def _is_own_time(cell: str) -> bool:
    return cell.strip('" ').replace("_", " ").lower().startswith(OWN_TIME)


def _told_of_times(cells: list[str]) -> list[str]:
    """Return a note if the header has two time columns."""
    if not any(map(_is_own_time, cells)) or not any("time" in _heading([c]) and not _is_own_time(c) for c in cells):
        return []
    return ["the times are those of the column Step time; the column Time has another zero point"]


def _plain_heading(unit: str) -> str:
    return unit.replace("µ", "u").replace("μ", "u").replace("·", ".").replace("⋅", ".").strip('[]() "')


def _known_column(quantity: str, unit: str) -> bool:
    return _plain_heading(unit) in TIME_TEST_UNITS[quantity]


def _rows_in_time(path, lines, k, delimiter, found):
    """Return the numbers below the header, the units from a line of units, and notes. An empty cell is NaN. Below the
    header, lines that begin with `#` are comments. Only a line of units may also begin with `#`."""
    kept, numbers, every, units, notes = [], [], [], {}, []
    needed = {q: place for q, (place, _) in found.items()}
    headings = split_cells(lines[k - 1].lstrip("# "), delimiter)
    while k < len(lines):
        line = lines[k]
        k += 1
        _, cells = split_line(line, delimiter)
        own = [cells[p] if p < len(cells) else "" for p in needed.values()]
        if not means_nothing(own) and not line.lstrip().startswith("#"):
            refuse_unnamed_numbers(path, k, cells, headings, delimiter)
            kept.append(own)
            every.append(cells)
            numbers.append(k)
            continue
        named = {q: cells[p] for q, p in needed.items() if p < len(cells) and _known_column(q, cells[p])}
        if not kept and named:  # unknown units are kept here; `_in_si` raises the error
            units = {q: cells[p].strip('[]() "') for q, p in needed.items() if p < len(cells) and cells[p].strip()}
        elif kept and _begins_a_table(line):
            break
        elif kept and any(c.strip().lower() not in EMPTY for c in own) and not line.lstrip().startswith("#"):
            if not _rows_follow(lines[k:], delimiter, list(needed.values())):
                break
            notes.append(f"line {k}, {line.strip()[:40]!r}, has no numbers and is ignored")
    left_out = summary_rows(every)
    notes += [f"line {numbers[j]} is a summary of other rows ({word}) and is ignored" for j, word in left_out.items()]
    kept, numbers = ([v for j, v in enumerate(a) if j not in left_out] for a in (kept, numbers))
    sign = decimal_sign(cell for own in kept for cell in own)
    rows = [[to_number(cell, delimiter, sign) for cell in own] for own in kept]
    for number, row in zip(numbers, rows, strict=True):
        if any(v is None for v in row):
            shown = lines[number - 1].strip()[:40]
            raise InputError(
                f"{path}: line {number}: {shown!r} has a cell that is not a number; correct or remove the line"
            )
    if len(rows) < 4:
        raise InputError(f"{path}: {len(rows)} rows of numbers are below the header; give four or more")
    return rows, units, notes


def _rows_follow(below: list[str], delimiter: str, places: list[int]) -> bool:
    """Return whether the lines `below` contain more numbers of the same table."""
    for line in below:
        if _begins_a_table(line):
            return False
        if line.lstrip().startswith("#"):
            continue
        cells = split_line(line, delimiter)[1]
        if not means_nothing([cells[p] if p < len(cells) else "" for p in places]) and line.strip():
            return True
    return False


def _in_si(path, found, rows, units):
    notes, columns = [], {}
    for j, (quantity, (_, unit)) in enumerate(found.items()):
        unit = units.get(quantity) or unit
        if unit is None:
            unit = next(iter(TIME_TEST_UNITS[quantity]))
            notes.append(f"the column of {quantity} states no unit; {unit} is assumed")
            most = float(np.nanmax(np.abs(rows[:, j]), initial=0.0))
            if quantity.endswith("strain") and most > LARGE:
                notes[-1] += (
                    f", so that the strain reaches {100 * most:.4g} %: if the strain is in percent, name the column "
                    "strain_%"
                )
        if not _known_column(quantity, unit):
            raise InputError(f"{path}: unit {unit!r} of {quantity} is not known; {_known_units(quantity)}")
        columns[quantity] = rows[:, j] * TIME_TEST_UNITS[quantity][_plain_heading(unit)]
    good = np.all(np.isfinite(rows), axis=1)
    if not good.all():
        notes.append(f"{(~good).sum()} of {len(good)} rows are ignored, because a cell is empty or not finite")
    columns = {q: v[good] for q, v in columns.items()}
    for (quantity, values), written in zip(columns.items(), rows[good].T, strict=True):
        far = np.maximum(np.abs(values), np.abs(written)) > LARGEST  # some instruments write 9.91e37 for no value
        if far.any():
            raise InputError(
                f"{path}: {quantity} = {written[far][0]:g} is beyond any measurement; correct the unit or the row"
            )
    return columns, notes
