"""Read a strain sweep from a file: moduli at several strain amplitudes and one frequency."""

from pathlib import Path
from typing import NamedTuple

import numpy as np

from fitting.readers.tables.complex_moduli import column_in_si, storage_and_loss, to_shear
from fitting.readers.tables.sweep_tables import choose_table, tables_of
from fitting.readers.tables.text_tables import text_of, without_multiples
from fitting.readers.units import RAW_TORQUE_UNITS
from liverjax.core.errors import InputError

FEWEST_POINTS, LARGEST_STRAIN, LARGEST_WITHOUT_UNIT = 4, 10.0, 2.0
#: If a column has the unit % and its largest strain is at most 0.01 (1 %), its numbers may be fractions and not %.
SMALLEST_LARGEST = 0.01
#: If the temperature changes by more than this value [K], the table contains several sweeps.
LARGEST_DRIFT = 2.0


class StrainSweep(NamedTuple):
    """Moduli of the first harmonic at n strain amplitudes, sorted by strain."""

    strain: np.ndarray  # (n,) amplitude at the rim [1]
    storage: np.ndarray  # (n,) [Pa]
    loss: np.ndarray  # (n,) [Pa]
    angular_frequency: float  # [rad/s]
    source: str = ""
    notes: tuple[str, ...] = ()


def read_strain_sweep(path: Path, table: str | None = None, max_strain: float | None = None) -> StrainSweep:
    """Read a strain sweep (frequency, storage modulus, loss modulus, strain amplitude) from a text file or workbook.

    Args:
        path: path of the file. The strain column has the name strain_% or strain_1, or the name that the software of a
            rheometer writes. If the unit is missing, the unit is 1.
        table: name of the table, a part of its name, or its number (from 1), if the file has several tables.
        max_strain: maximum strain [1]; points with a larger strain are ignored. None: all points are used.

    Raises:
        InputError: a column is missing; the moduli are tensile; a strain is too large; the table has several
            frequencies or temperatures, or too few points.
    """
    found = [t for t in tables_of(str(path), text_of(path, "a strain sweep").splitlines()) if "strain" in t.raw]
    if not found:
        raise InputError(f"{path}: no table has a strain column (unit % or 1); add this column")
    place, notes = choose_table(str(path), found, table, "strains", lambda t: len(np.unique(t.raw["strain"])))
    chosen, notes = found[place], [*notes, *found[place].notes]
    columns = {c.quantity: (c, j) for j, c in reversed(list(enumerate(chosen.columns)))}
    rows = np.asarray(chosen.rows)
    in_si = {q: (c, column_in_si(str(path), c, rows[:, j], notes)) for q, (c, j) in columns.items()}
    if told := to_shear(in_si):
        raise InputError(
            f"{path}: {told[0].partition(':')[0]}, and E = 3 G does not hold at large strain; give a strain sweep in "
            "shear, or fit curves of stress and stretch (python -m fitting curves)"
        )
    values = {q: v for q, (_, v) in in_si.items()}
    omega, both = values["frequency"], storage_and_loss(values, notes)
    G = both["storage"], both["loss"]
    strain = chosen.raw["strain"]
    positive = np.all([np.isfinite(column) & (column > 0) for column in (strain, omega, *G)], axis=0)
    good = _without_copied_rows(positive, [omega, *G, *chosen.raw.values()], notes)
    kept = good & (strain <= (np.inf if max_strain is None else max_strain))
    if good.sum() > kept.sum():
        notes.append(f"{good.sum() - kept.sum()} points above a strain of {max_strain:g} are ignored as requested")
    if len(np.unique(strain[kept])) < FEWEST_POINTS:
        raise InputError(
            f"{path}: only {len(np.unique(strain[kept]))} different strains are left; give {FEWEST_POINTS} or more"
        )
    if np.ptp(omega[kept]) > 0.01 * omega[kept].mean():
        low, high = omega[kept].min() / 2 / np.pi, omega[kept].max() / 2 / np.pi
        raise InputError(
            f"{path}: the frequency goes from {low:.3g} to {high:.3g} Hz; give a strain sweep at one frequency"
        )
    _refuse_several_temperatures(path, chosen.raw.get("temperature"), kept)
    if deviations := [c.name for c in chosen.columns if c.quantity.endswith("_sd")]:
        notes.append(
            f"the columns {', '.join(deviations)} are not used, because the noise is estimated from the residuals"
        )
    notes += _of_unit(path, chosen.strain_unit, float(strain[kept].max()))
    order = np.argsort(strain[kept], kind="stable")
    return StrainSweep(
        strain[kept][order],
        G[0][kept][order],
        G[1][kept][order],
        float(omega[kept].mean()),
        str(path),
        tuple(notes),
    )


def _without_copied_rows(positive: np.ndarray, columns: list[np.ndarray], notes: list[str]) -> np.ndarray:
    """Return a mask (n,) of the used rows: positive rows that are not copies of other rows (`without_multiples`). Add
    notes on the ignored rows.

    Args:
        positive: mask (n,) of the rows with positive strain, frequency and moduli.
        columns: all columns (n,) of the table.
        notes: list of notes. This function adds notes to it.
    """
    if not positive.all():
        notes.append(f"{(~positive).sum()} points without a positive strain, frequency or modulus are ignored")
    places = np.flatnonzero(positive)
    rows = np.nan_to_num(np.column_stack(columns)[places], nan=np.inf)  # an empty cell equals an empty cell
    own = places[without_multiples([tuple(row) for row in rows.tolist()])] if len(places) else places
    if len(own) < len(places):
        notes.append(
            f"{len(places) - len(own)} of {len(places)} points are ignored, because they are copies of other points"
        )
    return np.isin(np.arange(len(positive)), own)


def _refuse_several_temperatures(path: Path, temperature: np.ndarray | None, kept: np.ndarray) -> None:
    if temperature is None:
        return
    known = temperature[kept & np.isfinite(temperature)]
    if known.size == 0 or np.ptp(known) <= LARGEST_DRIFT:
        return
    low, high = known.min() - 273.15, known.max() - 273.15
    raise InputError(
        f"{path}: the temperature goes from {low:.3g} to {high:.3g} °C; give one file for each temperature"
    )


def _of_unit(path: Path, unit: str, largest: float) -> list[str]:
    """Return a note if the unit of the strains is missing or may be wrong. Raise `InputError` if strains are too
    large."""
    if largest > (LARGEST_STRAIN if unit else LARGEST_WITHOUT_UNIT):
        raise InputError(
            f"{path}: a strain of {largest:g} is too large; write the strains in % (strain_%), or as a fraction "
            "(strain_1)"
        )
    if not unit:
        return ["the strain column states no unit, so the unit 1 is assumed, not %"]
    if RAW_TORQUE_UNITS["strain"][unit] != 1.0 and largest <= SMALLEST_LARGEST:
        return [
            f"the strains end at {100 * largest:.3g} %: if the numbers of the column are fractions, name the column "
            "strain_1"
        ]
    return []
