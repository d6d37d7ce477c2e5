"""Read frequency sweeps from files: plain CSV, TA TRIOS text and Anton Paar RheoCompass exports.

One reader is used for all these files. It looks for a header line that names a frequency and two of these quantities:
storage modulus, loss modulus, |G*|, phase and tan(delta). A line of units may follow, then the numbers. The result is
in rad/s and Pa, sorted by frequency.
"""

import os
from pathlib import Path

import numpy as np

from fitting.readers.checks.scattering_phase import weighed_by_scatter

# Some of these names are imported only for users: `fitting.rheometer` exports all names of this module.
from fitting.readers.frequency_sweep import FEWEST, Sweep, mostly_repeated, without_copies
from fitting.readers.frequency_sweep import some as some
from fitting.readers.frequency_sweep import within as within
from fitting.readers.frequency_sweep import without_inertia as without_inertia
from fitting.readers.tables.complex_moduli import column_in_si, fault_of, load_of, storage_and_loss, to_shear
from fitting.readers.tables.sweep_columns import MODULI, Column, is_tensile
from fitting.readers.tables.sweep_headings import known_unit
from fitting.readers.tables.sweep_tables import Table, choose_table, tables_of
from fitting.readers.tables.text_tables import split_line as split_line
from fitting.readers.tables.text_tables import text_of
from fitting.readers.tables.text_tables import to_number as to_number
from fitting.readers.units import MODULUS_UNITS, celsius
from liverjax.core.errors import InputError
from liverjax.core.struct import Content

#: A modulus [Pa] or frequency [rad/s] outside of these limits cannot be a measurement, and its square may overflow.
SMALLEST, LARGEST = 1e-30, 1e30


def read_sweep(path: str | os.PathLike, table: str | None = None) -> Sweep:
    """Read a frequency sweep.

    A point is ignored if a modulus or the frequency is not finite, not positive, or outside of `SMALLEST` to
    `LARGEST`. A note names these points. If every line was written several times, the copies are ignored too: lines
    with the same numbers in all columns that are used. Standard deviations are not used if too many of them are empty
    or not positive.

    Args:
        path: an instrument's export, or text with a header that names ``frequency_Hz`` or ``angular_frequency_rad_s``,
            ``storage_modulus_Pa`` and ``loss_modulus_Pa`` (or kPa, MPa). ``storage_modulus_sd_Pa`` and
            ``loss_modulus_sd_Pa`` are optional. ``#`` begins a comment.
        table: which table to read if the file has several: its number (from 1), its name or a part of its name. By
            default, the table with the largest number of frequencies is read (the first one if there are several).

    Raises:
        InputError: the file cannot be used; the message names the column or line, the value and the remedy.
    """
    tables = tables_of(str(path), text_of(Path(path)).splitlines())
    chosen, notes = choose_table(str(path), tables, table)
    found = weighed_by_scatter(_sweep(str(path), tables[chosen], notes))
    return found._replace(notes=(*found.notes, *_what_differs(found)))


def read_all_sweeps(path: str | os.PathLike) -> list[tuple[str, Sweep]]:
    """Read all frequency sweeps of a file, and return name and sweep of each table. Unlike `read_sweep`, this function
    does not weight the points by their scatter."""
    tables = tables_of(str(path), text_of(Path(path)).splitlines())
    return [(table.name, _sweep(str(path), table, [])) for table in tables]


#: Standard deviations are not used if they are missing or unusable at more than this fraction of the usable points. If
#: they are unusable at fewer points, these points are ignored.
WITHOUT_SD = 0.25


def _poor_deviations(table: Table, values: dict[int, np.ndarray]) -> list[str]:
    """Return a note if the standard deviations in `values` are unusable at too many points (`WITHOUT_SD`)."""
    names = {j: table.columns[j].name for j in values if table.columns[j].quantity.endswith("_sd")}

    def bad(k: int, j: int) -> bool:
        return fault_of(table.columns[j], table.rows[k][j], values[j][k], SMALLEST, LARGEST) is not None

    rows = [k for k in range(len(table.rows)) if not any(bad(k, j) for j in values if j not in names)]
    poor = sum(any(bad(k, j) for j in names) for k in rows)
    if poor <= WITHOUT_SD * len(rows):
        return []
    return [
        f"the standard deviations ({', '.join(names.values())}) are not used, because they are empty, not "
        f"positive or too large at {poor} of {len(rows)} points: fill in these cells to use them"
    ]


def _usable(path: str, table: Table, values: dict[int, np.ndarray]) -> tuple[np.ndarray, list[str]]:
    """Return whether each row is usable in all columns of `values`, and a note on the unusable rows.

    Raises:
        InputError: fewer than half of the points or fewer than three frequencies are usable.
    """
    good, faults = np.ones(len(table.rows), bool), []
    for k, number in enumerate(table.numbers):
        limits = SMALLEST, LARGEST
        found = (fault_of(table.columns[j], table.rows[k][j], column[k], *limits) for j, column in values.items())
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
    return good, [f"{len(faults)} of {len(good)} points {verb} ignored as unusable: {told}"]


def _below_zero(first: dict[str, tuple[Column, np.ndarray]], good: np.ndarray) -> list[str]:
    """Return a note if several points are ignored because their loss modulus is not above zero."""
    column, loss = next((first[q] for q in ("loss", "tangent", "phase") if q in first), (None, np.ones(len(good))))
    count = int(np.sum(~good & (loss <= 0)))
    if column is None or count < 2:
        return []
    return [
        f"{count} points are ignored because {column.name} is not above zero there. The remaining points are too high "
        "on average: if noise is the cause, average repeated sweeps before you fit"
    ]


#: In all tissues and most other materials, the ratios G' / G'' and G'' / G' are below this value [1].
FAR_APART = 100.0


def _unlike_units(first: dict[str, tuple[Column, np.ndarray]], good: np.ndarray) -> list[str]:
    """Return a note if G' and G'' differ by a factor above `FAR_APART` only because of the units of their columns."""
    if not {"storage", "loss"} <= set(first):
        return []
    (one, storage), (other, loss) = first["storage"], first["loss"]
    scale = MODULUS_UNITS[one.unit or "Pa"] / MODULUS_UNITS[other.unit or "Pa"]
    ratio = float(np.median(storage[good] / loss[good]))
    if max(ratio, 1 / ratio) < FAR_APART or max(ratio / scale, scale / ratio) > FAR_APART:
        return []
    return [
        f"column {one.name!r} is in {one.unit or 'Pa'} and {other.name!r} in {other.unit or 'Pa'}, so G' is "
        f"{ratio:.2g} times G'': if both are in one unit, correct the header"
    ]


def _sweep(path: str, table: Table, notes: list[str]) -> Sweep:
    written = np.asarray(table.rows)
    notes += table.notes
    first: dict[str, tuple[Column, np.ndarray]] = {}
    columns: dict[int, np.ndarray] = {}
    for j, column in enumerate(table.columns):
        if column.quantity not in first:
            columns[j] = column_in_si(path, column, written[:, j], notes)
            first[column.quantity] = column, columns[j]
    load = load_of(first)
    notes += to_shear(first)
    if poor := _poor_deviations(table, columns):
        notes += poor
        first = {q: own for q, own in first.items() if not q.endswith("_sd")}
        columns = {j: v for j, v in columns.items() if table.columns[j].quantity in first}
    good, left_out = _usable(path, table, columns)
    for j, column in enumerate(table.columns):
        if (
            j not in columns
            and column.quantity in first
            and known_unit(column.quantity.removesuffix("_sd"), column.unit)
        ):
            _check_agreement(path, first, column, written[:, j], good)
    notes += [*left_out, *_below_zero(first, good), *_unlike_units(first, good)]
    values = {q: v[good] for q, (_, v) in first.items()}
    omega = values["frequency"]
    if len(np.unique(omega)) < 2:
        raise InputError(
            f"{path}: the file has {len(np.unique(omega))} frequency; give at least two different frequencies"
        )
    values = storage_and_loss(values, notes)
    beside = [(c, written[good]) for c, written in table.beside]
    notes += _contradictions(path, beside, values | {"frequency": omega}, load != "shear")
    if ("storage_sd" in values) != ("loss_sd" in values):
        raise InputError(
            f"{path}: only one of storage_modulus_sd_Pa and loss_modulus_sd_Pa is in the file; give both or none"
        )
    order = np.argsort(omega, kind="stable")
    if not np.array_equal(order, np.arange(len(omega))):
        notes.append(SORTED)
    get: Content = {q: values[q][order] if q in values else None for q in ("storage", "loss", "storage_sd", "loss_sd")}
    raw = {q: v[good][order] for q, v in table.raw.items()}
    found = Sweep(omega[order], **get, source=path, notes=tuple(notes), raw=raw or None, load=load, table=table.name)
    found = without_copies(found)
    repeated = len(found.storage) - len(np.unique(omega))
    if repeated:
        found = found._replace(notes=(*found.notes, f"repeated frequencies: {repeated}. {REPEATED}"))
    return found


#: Note on a file whose lines were not sorted by frequency.
SORTED = "the frequencies were not in ascending order and have been sorted"
#: Note on frequencies that occur in several lines. The number of repeated lines comes before this string.
REPEATED = "Each line counts as a separate measurement, unless the noise of lines with the same frequency is correlated"

#: Part of the note on a sweep at several temperatures.
WARM = "but one material at one temperature is fitted"
#: A note is given if the temperature varies within one sweep by more than WARMER [K], or if the largest strain exceeds
#: STRAINED times the smallest.
WARMER, STRAINED = 2.0, 1.5


def _what_differs(sweep: Sweep) -> list[str]:
    """Return notes if temperature or strain differ between the lines of a sweep."""
    out, raw = [], sweep.raw or {}
    heat, strain = (raw[q][np.isfinite(raw[q])] if q in raw else np.empty(0) for q in ("temperature", "strain"))
    if not mostly_repeated(sweep.angular_frequency):
        if heat.size and np.ptp(heat) > WARMER:
            out.append(
                f"the temperature changes by {np.ptp(heat):.2g} K in the sweep, and the fit treats the effect of "
                "the temperature on the moduli as an effect of the frequency"
            )
        if strain.size and strain.min() > 0 and strain.max() > STRAINED * strain.min():
            out.append(
                f"the strain goes from {strain.min():.2g} to {strain.max():.2g} in the sweep: if the strain is not "
                "small, the fit treats the effect of the strain as an effect of the frequency"
            )
        return out
    if heat.size and np.ptp(heat) > WARMER:
        low, high = celsius(np.array([heat.min(), heat.max()]))
        out.append(
            f"the temperatures are {low:.4g} to {high:.4g} °C, {WARM}: give --master, or a file for each temperature"
        )
    if strain.size and strain.min() > 0 and strain.max() > STRAINED * strain.min():
        out.append(
            f"the strains are {strain.min():.3g} to {strain.max():.3g}, but one linear material is fitted: give a "
            "file for each strain"
        )
    return out


#: A note is given if the median relative difference between a column and the values computed from G' and G'' exceeds
#: this value [1].
CONTRADICTS = 0.03


def _contradictions(path: str, beside: list[tuple[Column, np.ndarray]], values: Content, stretched: bool) -> list[str]:
    """Return notes on columns of |G*|, phase, tan(delta) or |eta*| that differ from the values computed from G' and
    G''.

    If the file has E' and E'' (`stretched`), a column of modulus or viscosity may belong to tension or to shear.
    """
    G = values["storage"] + 1j * values["loss"]
    expected = {"complex": np.abs(G), "phase": np.angle(G), "tangent": values["loss"] / values["storage"]}
    expected["viscosity"] = np.abs(G) / values["frequency"]
    out = []
    for column, written in beside:
        if not np.isfinite(written).any() or (column.quantity == "phase" and column.unit is None):
            continue
        found, known = column_in_si(path, column, written, []), expected[column.quantity]
        seen = np.isfinite(found)
        steps = np.diff(np.unique(found[seen]))
        rounding = 0.5 * steps.min() if steps.size else 0.0
        factors = (1.0, 3.0) if stretched and column.quantity in ("complex", "viscosity") else (1.0,)
        apart = min(
            float(np.median(np.maximum(np.abs(found / k - known)[seen] - rounding / k, 0.0) / known[seen]))
            for k in factors
        )
        if apart > CONTRADICTS:
            out.append(
                f"column {column.name!r} is not used, because it contradicts G' and G'' by {100 * apart:.2g} % "
                "(median): check which of these columns is wrong, or was corrected"
            )
    return out


def _check_agreement(path: str, first: dict, column: Column, written: np.ndarray, good: np.ndarray) -> None:
    """Raise `InputError` if a second column of a quantity disagrees with the first."""
    own, values = first[column.quantity]
    both = column_in_si(path, column, written, [])[good]
    both = both / 3 if column.quantity.split("_")[0] in MODULI and is_tensile(column) else both
    seen = np.isfinite(both)
    if not np.allclose(both[seen], values[good][seen], rtol=0.01):
        raise InputError(f"{path}: columns {own.name} and {column.name} disagree; remove the wrong column")
