"""Frequency sweeps from files: plain CSV, TA TRIOS text and Anton Paar RheoCompass exports.

One reader serves all three: it looks for a line that names a frequency, a storage and a loss modulus, an optional line
of units below it, and numbers below that. Everything leaves in rad/s and Pa, sorted by frequency.
"""

import os
from pathlib import Path

import numpy as np

# Some of these are here for users alone: `fitting.rheometer` offers what this module has.
from fitting.readers.frequency_sweep import FEWEST, Sweep
from fitting.readers.frequency_sweep import some as some
from fitting.readers.frequency_sweep import within as within
from fitting.readers.frequency_sweep import without_inertia as without_inertia
from fitting.readers.sweep_columns import Column, is_angular, is_tensile, known_unit
from fitting.readers.sweep_tables import Table, choose_table, tables_of
from fitting.readers.text_tables import split_line as split_line
from fitting.readers.text_tables import text_of
from fitting.readers.text_tables import to_number as to_number
from fitting.readers.units import FREQUENCY_UNITS, MODULUS_UNITS
from liverjax.core.errors import InputError
from liverjax.core.struct import Content

#: Beyond these no modulus [Pa] or frequency [rad/s] was ever measured, and squares overflow.
SMALLEST, LARGEST = 1e-30, 1e30


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
    tables = tables_of(str(path), text_of(Path(path)).splitlines())
    chosen, notes = choose_table(str(path), tables, table)
    return _sweep(str(path), tables[chosen], notes)


def read_all_sweeps(path: str | os.PathLike) -> list[tuple[str, Sweep]]:
    """Every table of a file that is a sweep, with its name; as `read_sweep` reads one."""
    tables = tables_of(str(path), text_of(Path(path)).splitlines())
    return [(table.name, _sweep(str(path), table, [])) for table in tables]


def _si(path: str, table: Table, j: int, notes: list[str]) -> np.ndarray:
    """Column j in rad/s or Pa."""
    column, unit = table.columns[j], table.columns[j].unit
    if unit is None:
        unit = "Pa" if column.quantity != "frequency" else "rad/s" if is_angular(column) else "Hz"
        notes.append(f"column {column.name!r} states no unit; {unit} is taken")
    if not known_unit(column.quantity, unit):
        known = "Hz or rad_s" if column.quantity == "frequency" else "Pa, kPa or MPa"
        raise InputError(f"{path}: unit {unit!r} of column {column.name} is not known; use {known}")
    if is_angular(column) and unit.lower() == "hz":
        raise InputError(
            f"{path}: column {column.name} is an angular frequency in Hz; "
            "name it frequency_Hz or angular_frequency_rad_s"
        )
    scale = FREQUENCY_UNITS[unit.lower()] if column.quantity == "frequency" else MODULUS_UNITS[unit]
    return np.asarray(table.rows)[:, j] * scale


def _fault(column: Column, written: float, value: float) -> tuple[str, str] | None:
    """The fault of a value in SI, in the file's own words, and the remedy."""
    if not np.isfinite(value):
        problem, remedy = "is not finite", "remove the line"
    elif value <= 0:
        problem, remedy = "is not positive", "correct the sign or remove the line"
    elif not SMALLEST < value < LARGEST:
        problem, remedy = "is beyond any measurement", "check the unit"
    else:
        return None
    return f"{column.name} = {written:g} {problem}", remedy


def _usable(path: str, table: Table, values: dict[int, np.ndarray]) -> tuple[np.ndarray, list[str]]:
    """Which rows are good in all columns of `values`, and a note on the others.

    Raises:
        InputError: fewer than half of the points or fewer than three frequencies are good.
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


def _to_shear(table: Table, places: dict[str, int], columns: dict[int, np.ndarray]) -> list[str]:
    """Divide moduli of tension or bending by 3 in place; a note says so."""
    tensile = [j for q, j in places.items() if q != "frequency" and is_tensile(table.columns[j])]
    for j in tensile:
        columns[j] = columns[j] / 3
    if not tensile:
        return []
    names = " and ".join(table.columns[j].name for j in tensile)
    return [f"{names} are of tension or bending: G = E / 3 is taken, as of an incompressible material"]


def _sweep(path: str, table: Table, notes: list[str]) -> Sweep:
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
        if j == places[q] or not known_unit(q.removesuffix("_sd"), column.unit):
            continue
        both = _si(path, table, j, [])[good] / (3 if is_tensile(column) else 1)
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
    get: Content = {q: values[q][order] if q in values else None for q in ("storage", "loss", "storage_sd", "loss_sd")}
    raw = {q: v[good][order] for q, v in table.raw.items()}
    return Sweep(omega[order], **get, source=path, notes=tuple(notes), raw=raw or None)
