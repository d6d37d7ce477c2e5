"""Read phase velocities of shear waves at several frequencies from files, with or without attenuation. Such data are
measured for example with ultrasound."""

import os
import re
from pathlib import Path
from typing import NamedTuple

import numpy as np
import scipy.special

from fitting.readers.frequency_sweep import distances_from_polynomials, merged, smooth_curve
from fitting.readers.rheometer import LARGEST, SMALLEST
from fitting.readers.tables.text_tables import (
    refuse_unnamed_numbers,
    split_cells,
    split_line,
    text_of,
    to_number,
    without_later_sheets,
    without_multiples,
)
from fitting.readers.units import WAVE_UNITS
from fitting.waves.shear_waves import DENSITY
from liverjax.core.errors import InputError

#: Words at the beginning of a column heading, and the quantity that the column then contains.
WORDS = (
    ("angular frequency", "frequency"),
    ("frequency", "frequency"),
    ("phase velocity", "velocity"),
    ("shear wave speed", "velocity"),
    ("velocity", "velocity"),
    ("speed", "velocity"),
    ("attenuation", "attenuation"),
)
#: A column whose heading contains one of these words states the error of another column. Such a column is not read.
ERRORS = {"sd", "std", "stdev", "stddev", "stderr", "se", "sem", "err", "error", "errors", "dev", "deviation"}
ERRORS |= {"sigma", "uncertainty", "ci"}
#: Number of neighbouring points to which a cubic is fitted. The residuals of these fits show the noise.
_NEIGHBOURS = 5
#: A relative scatter below this value may come from the curvature of data without noise.
CURVED = 3e-3
#: Minimum number of frequencies in a file.
FEWEST = 3


class Dispersion(NamedTuple):
    """Phase velocity and attenuation of shear waves in a material, in SI units and sorted by frequency."""

    angular_frequency: np.ndarray  # (n,) [rad/s]
    velocity: np.ndarray  # (n,) [m/s]
    attenuation: np.ndarray | None  # (n,) [1/m]
    density: float  # [kg/m^3]
    source: str = ""
    notes: tuple[str, ...] = ()

    @property
    def resolved(self) -> tuple[float, float]:
        """Shortest and longest relaxation time [s] that data at these frequencies can determine."""
        return float(1 / self.angular_frequency[-1]), float(1 / self.angular_frequency[0])

    @property
    def measured(self) -> np.ndarray:
        """Velocities, then attenuations if they were measured."""
        return self.velocity if self.attenuation is None else np.concatenate([self.velocity, self.attenuation])

    @property
    def scales(self) -> np.ndarray:
        """Values of smooth curves through the measured values, so errors divided by these scales are relative. If the
        relative scatter of the attenuation differs from that of the velocity by more than chance explains, the scales
        of the attenuation are multiplied by the ratio of the two scatters."""
        smooth = smooth_curve(self.angular_frequency, self.velocity)
        if self.attenuation is None:
            return smooth
        factor = self._noise_of_attenuation()
        return np.concatenate([smooth, factor * smooth_curve(self.angular_frequency, self.attenuation)])

    def _noise_of_attenuation(self) -> float:
        """Return the relative noise of the attenuation, divided by that of the velocity. Return 1 if the two may differ
        by chance."""
        assert self.attenuation is not None
        omega, *columns = merged(self.angular_frequency, self.velocity, self.attenuation)
        freedom = len(omega) - _NEIGHBOURS
        if freedom < 1:
            return 1.0
        distances = (distances_from_polynomials(np.log(omega), np.log(c), _NEIGHBOURS) for c in columns)
        noise, own = (max(float(np.sqrt(np.mean(d**2))), CURVED) for d in distances)
        chance = np.sqrt(scipy.special.fdtri(freedom, freedom, 0.99))
        return own / noise if not 1 / chance < own / noise < chance else 1.0


def names_velocities(path: str | os.PathLike) -> bool:
    """Return whether the file has a header line with a frequency and a velocity."""
    return _header(text_of(Path(path), "shear waves").splitlines()) is not None


def read_dispersion(path: str | os.PathLike, density: float | None = None) -> Dispersion:
    """Read a table with a header such as ``frequency_Hz,phase_velocity_m/s,attenuation_Np/m``.

    Args:
        path: text file.
        density: density of the material [kg/m^3]. If it is None, `DENSITY` is used, and a note is added.

    Raises:
        InputError: the file cannot be used; the message states the file, the line or column, the value and what to do.
    """
    lines = text_of(Path(path), "shear waves").splitlines()
    header = _header(lines)
    if header is None:
        raise InputError(f"{path}: no header names frequency_Hz and phase_velocity_m/s; add a header with these names")
    notes = (
        [] if density is not None else [f"a density of {DENSITY:g} kg/m^3 is assumed: change this value with --density"]
    )
    lines, unread = without_later_sheets(lines, header[0])
    notes += unread
    columns = _columns(str(path), lines, header)
    rows = np.column_stack(list(columns.values()))
    kept = without_multiples([tuple(row) for row in rows.tolist()])
    if len(kept) < len(rows):
        notes.append(f"{len(rows) - len(kept)} of {len(rows)} rows are ignored, because they are copies of other rows")
        columns = {q: v[kept] for q, v in columns.items()}
    order = np.argsort(columns["frequency"], kind="stable")
    columns = {q: v[order] for q, v in columns.items()}
    for quantity, values in columns.items():
        bad = np.flatnonzero(~(np.isfinite(values) & (values > 0)))
        if bad.size:
            raise InputError(f"{path}: {quantity} {values[bad[0]]:g} must be above 0; correct or remove this row")
        far = values[(values < SMALLEST) | (values > LARGEST)]
        if far.size:
            raise InputError(f"{path}: {quantity} {far[0]:g} is beyond any measurement; correct the unit or this row")
    if len(np.unique(columns["frequency"])) < FEWEST:
        raise InputError(
            f"{path}: {len(order)} rows of numbers follow the header; give at least {FEWEST} different frequencies"
        )
    return Dispersion(
        columns["frequency"],
        columns["velocity"],
        columns.get("attenuation"),
        DENSITY if density is None else density,
        str(path),
        tuple(notes),
    )


def in_band(waves: Dispersion, low: float | None, high: float | None) -> Dispersion:
    """Return the waves at frequencies from `low` to `high` [Hz]. A note states how many waves are ignored.

    Raises:
        InputError: fewer than `FEWEST` frequencies are left.
    """
    hertz = waves.angular_frequency / (2 * np.pi)
    kept = (hertz >= (0.0 if low is None else low) * (1 - 1e-9)) & (
        hertz <= (np.inf if high is None else high) * (1 + 1e-9)
    )
    if kept.all():
        return waves
    if len(np.unique(hertz[kept])) < FEWEST:
        left = len(np.unique(hertz[kept]))
        raise InputError(
            f"{waves.source}: only {left} frequencies are between --min-frequency and --max-frequency, but {FEWEST} "
            "are needed; widen the band"
        )
    attenuation = None if waves.attenuation is None else waves.attenuation[kept]
    note = f"{np.sum(~kept)} waves outside of the given frequency band are ignored"
    return waves._replace(
        angular_frequency=waves.angular_frequency[kept],
        velocity=waves.velocity[kept],
        attenuation=attenuation,
        notes=(*waves.notes, note),
    )


def _header(lines: list[str]) -> tuple[int, str, dict[str, list[tuple[int, str]]]] | None:
    """Return the index and the delimiter of the first line that names frequency and velocity, and the columns and units
    of each quantity in this line. Return None if no line names both."""
    for k, line in enumerate(lines):
        delimiter, cells = split_line(line.lstrip("# "))
        found: dict[str, list[tuple[int, str]]] = {}
        for place, cell in enumerate(cells):
            named = _quantity_named(cell)
            if named:
                found.setdefault(named[0], []).append((place, named[1]))
        if {"frequency", "velocity"} <= set(found):
            return k, delimiter, found
    return None


def _quantity_named(cell: str) -> tuple[str, str] | None:
    """Return quantity and unit of a heading, for example "Phase velocity (m/s)" or "attenuation_Np/m". An angular
    frequency without a unit is in rad/s. Return None if the heading is not known, or if it names an error."""
    parts = re.match(r'^"?([^\[(]*?)\s*(?:[\[(]\s*([^\])]*?)\s*[\])])?"?$', cell.strip())
    if parts is None or ERRORS & {word.lower() for word in re.findall("[A-Z]*[a-z]+|[A-Z]+", cell)}:
        return None
    name = parts.group(1).replace("_", " ").strip()
    for word, quantity in WORDS:
        if name.lower().startswith(word):
            rest = parts.group(1).strip()[len(word) :].strip("_ ")
            unit = (parts.group(2) or rest).replace("s-1", "1/s")
            return quantity, unit or ("rad/s" if word == "angular frequency" else "")
    return None


def _columns(path: str, lines: list[str], header: tuple) -> dict[str, np.ndarray]:
    k, delimiter, found = header[0], header[1], {q: columns[0] for q, columns in header[2].items()}
    for quantity, columns in header[2].items():
        if quantity != "frequency" and len(columns) > 1:  # of several columns of frequencies, the first one is used
            places = ", ".join(str(place + 1) for place, _ in columns)
            raise InputError(f"{path}: columns {places} may all contain {quantity}; keep one of these columns")
    factors = {}
    for quantity, (_, unit) in found.items():
        known = WAVE_UNITS[quantity]
        if unit and unit not in known:
            raise InputError(f"{path}: unit {unit!r} of {quantity} is not known; use {', '.join(known)}")
        factors[quantity] = known[unit] if unit else next(iter(known.values()))
    rows, headings = [], split_cells(lines[k].lstrip("# "), delimiter)
    for number, line in enumerate(lines[k + 1 :], k + 2):
        if not line.strip() or line.lstrip().startswith("#"):
            continue
        cells = split_cells(line, delimiter)
        refuse_unnamed_numbers(path, number, cells, headings, delimiter)
        values = [to_number(cells[p], delimiter) if p < len(cells) else None for p, _ in found.values()]
        if not all(v is not None and np.isfinite(v) for v in values):
            raise InputError(
                f"{path}: line {number}: {line.strip()[:40]!r} has a cell that is not a number; correct this line"
            )
        rows.append(values)
    table = np.array(rows, float).reshape(-1, len(found))
    return {q: table[:, j] * factors[q] for j, q in enumerate(found)}
