"""Read sweeps of one material at several temperatures from one or several files."""

import itertools
import re
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from fitting.readers.frequency_sweep import FEWEST, Sweep, some
from fitting.readers.rheometer import REPEATED, SORTED, read_all_sweeps
from fitting.readers.units import celsius
from liverjax.core.errors import InputError

#: Temperatures that differ by less than this [K] are regarded as one temperature, because the temperature of an
#: instrument varies by some tenths of a kelvin.
SAME = 1.0
#: The measured temperatures of a table and the temperature in its name differ by at most this [K].
OFF_NAME = 5.0


class AtTemperatures(NamedTuple):
    """Sweeps at K temperatures, in ascending order of the temperatures."""

    sweeps: list[Sweep]
    temperatures: np.ndarray  # (K,) [K], ascending
    shift_factors: np.ndarray | None  # (K,) shift factors a_T; None if the files give no shift factors


def read_temperatures(paths: Sequence[Path]) -> AtTemperatures:
    """Read all sweeps of the files, and join the sweeps at the same temperature.

    The temperature must be in a column (`temperature_C`, or `Temperature` with its unit) or in the name of the table. A
    column `shift_factor` may contain shift factors that are already known.

    Raises:
        InputError: a table states no temperature, there are fewer than two temperatures, or a temperature or shift
            factor is not positive.
    """
    parts: list[tuple[float, float, Sweep]] = []
    for path in paths:
        for name, sweep in read_all_sweeps(path):
            parts += _by_temperature(str(path), name, sweep)
    parts.sort(key=lambda part: part[0])
    group = _index_of_group(np.array([part[0] for part in parts]), exact=True)
    groups = [[parts[k] for k in np.flatnonzero(group == g)] for g in range(group.max() + 1)]
    if len(groups) < 2:
        raise InputError(
            f"{paths[0]}: --master needs sweeps at two or more temperatures, but all sweeps are at "
            f"{celsius(parts[0][0]):.4g} °C (rows less than {SAME:g} K apart count as one temperature); give a file "
            "with several tables, or several files"
        )
    factors = np.array([_mean_factor(np.array([p[1] for p in g])) for g in groups])
    means = np.array([float(np.mean([p[0] for p in g])) for g in groups])
    sweeps, known = [joined([p[2] for p in g]) for g in groups], np.isfinite(factors)
    if known.any() and not known.all():
        without = ", ".join(f"{T:.4g}" for T in celsius(means[~known]))
        note = (
            f"the given values of shift_factor are not used, and all factors are fitted, because the factor at "
            f"{without} °C is missing: give a factor at every temperature"
        )
        sweeps[0] = sweeps[0]._replace(notes=(*sweeps[0].notes, note))
    return AtTemperatures(sweeps, means, factors if known.all() else None)


def _mean_factor(factors: np.ndarray) -> float:
    """Return the geometric mean of the shift factors (n,). NaN values are ignored; the result is NaN if all are NaN."""
    given = factors[np.isfinite(factors)]
    return float(np.exp(np.mean(np.log(given)))) if len(given) else np.nan


def _index_of_group(T: np.ndarray, exact: bool) -> np.ndarray:
    """Return for each temperature (n,) [K] the index (n,) of its group, in ascending order of the temperatures.

    Exact temperatures that are `SAME` or more above the lowest one of a group begin the next group. Measured
    temperatures scatter around an unknown value, so they begin the next group only after a gap of `SAME` or more.
    """
    order = np.argsort(T, kind="stable")
    group, count, lowest = np.zeros(len(T), int), 0, T[order[0]]
    for before, k in itertools.pairwise(order):
        if T[k] - (lowest if exact else T[before]) >= SAME:
            count, lowest = count + 1, T[k]
        group[k] = count
    return group


def joined(sweeps: Sequence[Sweep]) -> Sweep:
    """Return one sweep with all points of several sweeps, sorted by frequency. It has standard deviations if all
    sweeps have them."""
    omega = np.concatenate([s.angular_frequency for s in sweeps])
    order = np.argsort(omega, kind="stable")
    storage, loss = (np.concatenate([getattr(s, q) for s in sweeps])[order] for q in ("storage", "loss"))
    storage_sd = loss_sd = None
    notes = [note for s in sweeps for note in s.notes]
    given = [s.storage_sd is not None and s.loss_sd is not None for s in sweeps]
    if any(given) and not all(given):
        notes.append("the standard deviations are not used, because some of the sweeps have none: give them for all")
    if all(given):
        storage_sd, loss_sd = (
            np.concatenate([getattr(s, q) for s in sweeps])[order] for q in ("storage_sd", "loss_sd")
        )
    told = tuple(dict.fromkeys(notes))
    return Sweep(omega[order], storage, loss, storage_sd, loss_sd, source=sweeps[0].source, notes=told)


def _by_temperature(path: str, name: str, sweep: Sweep) -> list[tuple[float, float, Sweep]]:
    """Return (temperature [K], shift factor, points of the sweep) for each temperature in a table. The shift factor is
    NaN if it is unknown."""
    raw = sweep.raw or {}
    T = raw.get("temperature", np.full(len(sweep.storage), np.nan))
    missing = ~np.isfinite(T)
    if np.any(missing):
        # A hyphen after a letter or a digit separates words ("Sweep-25C"), so it is not a minus sign.
        stated = re.search(r"((?:(?<![^\W_])-)?\d+(?:[.,]\d+)?)\s*°?\s*([CK])\b", name)
        if stated is None and np.all(missing):
            raise InputError(
                f"{path}: the table {repr(name) if name else 'of the file'} states no temperature; add a column "
                "temperature_C"
            )
        of_name = float(stated[1].replace(",", ".")) + 273.15 * (stated[2] == "C") if stated else np.nan
        # The name cannot replace missing temperatures if the other rows differ from each other, or much from the name.
        known = T[~missing]
        if not np.isfinite(of_name) or (known.size and (np.ptp(known) >= SAME or np.ptp([*known, of_name]) > OFF_NAME)):
            raise InputError(
                f"{path}: the temperature of {missing.sum()} of {len(T)} rows is missing; fill in these cells, or "
                "remove these rows"
            )
        T = np.full(len(T), of_name)
    if np.any(T <= 0):
        raise InputError(f"{path}: a temperature of {celsius(T.min()):.4g} °C is below absolute zero; check the unit")
    # If each temperature occurs in as many rows as a sweep needs, the column contains set temperatures.
    group = _index_of_group(T, exact=bool(np.unique(T, return_counts=True)[1].min() >= FEWEST))
    factors = raw.get("shift_factor", np.full(len(T), np.nan))
    if np.any(factors <= 0):
        raise InputError(
            f"{path}: shift_factor = {factors.min():g} is not above 0; give positive factors of the frequency"
        )
    # If a table has several temperatures, the same frequencies occur at each temperature. So notes about repeated or
    # sorted frequencies do not apply and are removed.
    if group.max() > 0:
        sweep = sweep._replace(notes=tuple(note for note in sweep.notes if REPEATED not in note and note != SORTED))
    out = []
    for k in range(group.max() + 1):
        mine = group == k
        factor = _mean_factor(factors[mine])
        own = some(sweep, mine)
        repeated = len(own.angular_frequency) - len(np.unique(own.angular_frequency))
        if repeated and group.max() > 0:
            own = own._replace(notes=(*own.notes, f"repeated frequencies: {repeated}. {REPEATED}"))
        if np.ptp(T[mine]) >= SAME:
            low, high, mean = (celsius(f(T[mine])) for f in (np.min, np.max, np.mean))
            own = own._replace(
                notes=(
                    *own.notes,
                    f"rows from {low:.4g} to {high:.4g} °C count as one temperature, {mean:.4g} °C, because the "
                    f"temperatures between them are less than {SAME:g} K apart",
                )
            )
        out.append((float(np.mean(T[mine])), factor, own))
    return out
