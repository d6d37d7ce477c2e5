"""Read sweeps of one material at several temperatures from one or several files."""

import itertools
import re
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from fitting.methods.kramers_kronig import without_instrument
from fitting.readers import raw_torque
from fitting.readers.frequency_sweep import FEWEST, Sweep, some, within, without_inertia
from fitting.readers.rheometer import REPEATED, SORTED, read_all_sweeps
from fitting.readers.units import celsius
from liverjax.core.errors import InputError

#: Temperatures that differ by less than this value [K] count as one temperature, because the temperature of an
#: instrument varies by some tenths of a kelvin.
SAME = 1.0
#: Maximum difference [K] between the measured temperatures of a table and the temperature in its name. A sweep whose
#: temperature changes by more than this value counts as several sweeps.
OFF_NAME = 5.0
#: A temperature in the name of a table. A hyphen after a letter or a digit separates words ("Sweep-25C"), so it is not
#: a minus sign. A value before a slash is a rate ("5 K/min").
_STATED = re.compile(r"((?:(?<![^\W_])-)?\d+(?:[.,]\d+)?)\s*(°?)\s*([CK])\b(?!\s*/)")


class AtTemperatures(NamedTuple):
    """Sweeps at K temperatures, in ascending order of the temperatures."""

    sweeps: list[Sweep]
    temperatures: np.ndarray  # (K,) [K], ascending
    shift_factors: np.ndarray | None  # (K,) shift factors a_T; None if the files give no shift factors
    ignored: np.ndarray = np.zeros(0)  # temperatures [K] that are left out, because too few points remain


def read_temperatures(paths: Sequence[Path]) -> AtTemperatures:
    """Read all sweeps of the files. Sweeps at the same temperature become one sweep.

    The temperature must be in a column (`temperature_C`, or `Temperature` with its unit) or in the name of the table. A
    column `shift_factor` may contain shift factors that are already known. Without such factors, temperatures with
    fewer than `FEWEST` frequencies are ignored.

    Raises:
        InputError: the temperature of a table or of some rows is unknown, there are fewer than two temperatures, or a
            temperature [K] or shift factor is not positive.
    """
    parts: list[tuple[float, float, Sweep]] = []
    for path in paths:
        for name, sweep in read_all_sweeps(path):
            parts += _by_temperature(str(path), name, sweep)
    parts.sort(key=lambda part: part[0])
    group = _index_of_group(np.array([part[0] for part in parts]), exact=True)
    every = [[parts[k] for k in np.flatnonzero(group == g)] for g in range(max(group) + 1)]
    groups, ignored = _with_enough_points(every)
    if len(groups) < 2:
        also = "".join(f"; {note}" for note in ignored)
        raise InputError(
            f"{paths[0]}: --master needs sweeps at two or more temperatures, but all sweeps are at "
            f"{celsius(groups[0][0][0]):.4g} °C{also} (rows less than {SAME:g} K apart count as one temperature); give "
            "a file with several tables, or several files"
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
        ignored = [*ignored, note]
    sweeps[0] = sweeps[0]._replace(notes=(*sweeps[0].notes, *ignored))
    few = [float(np.mean([p[0] for p in g])) for g in every if not any(g is own for own in groups)]
    return AtTemperatures(sweeps, means, factors if known.all() else None, np.array(few))


def _with_enough_points(
    groups: list[list[tuple[float, float, Sweep]]],
) -> tuple[list[list[tuple[float, float, Sweep]]], list[str]]:
    """Return the groups (one for each temperature) with `FEWEST` or more frequencies, and a note on each other group.

    One or two points at another temperature are often wrong readings of the temperature, and so few points do not
    determine a shift. All groups are returned if all shift factors are given, or if no group has enough frequencies.
    """
    omegas = [np.unique(np.concatenate([p[2].angular_frequency for p in own])) for own in groups]
    few = [len(omega) < FEWEST for omega in omegas]
    if all(few) or all(np.isfinite([p[1] for p in own]).any() for own in groups):
        return groups, []
    notes = []
    for own, omega in itertools.compress(zip(groups, omegas, strict=True), few):
        T, hertz = celsius(float(np.mean([p[0] for p in own]))), ", ".join(f"{f:.3g}" for f in omega / (2 * np.pi))
        notes.append(
            f"the points at {T:.4g} °C (frequencies: {hertz} Hz) are ignored, because a shift needs {FEWEST} or more "
            "frequencies at one temperature: check the temperature of these rows"
        )
    return [own for own, short in zip(groups, few, strict=True) if not short], notes


def with_usable_points(
    data: AtTemperatures, band: tuple[float | None, float | None], radius: float | None, height: float | None
) -> AtTemperatures:
    """Return the data without the points where the inertia of the instrument dominates, and without the points outside
    the band. Notes say which points are ignored, and at which temperatures. A temperature is ignored if too few of its
    points remain. The minimum is `FEWEST` frequencies if shifts are fitted, and one frequency if the shift factors are
    given.

    Args:
        data: sweeps that are not shifted.
        band: lowest and highest measured frequency [Hz], or None. If the highest frequency is given, points that the
            instrument seems to falsify (`without_instrument`) are kept, as in a fit of one sweep.
        radius, height: size of the sample [m], if known.

    Raises:
        InputError: fewer than two temperatures remain.
    """
    fewest = FEWEST if data.shift_factors is None else 1
    highest = max(float(sweep.angular_frequency[-1]) for sweep in data.sweeps)
    sweeps, told, faults, notes = [], dict[str, list[str]](), list[InputError](), list[str]()
    kept = np.ones(len(data.sweeps), bool)
    for k, (sweep, T) in enumerate(zip(data.sweeps, celsius(data.temperatures), strict=True)):
        named = sweep._replace(source=f"{sweep.source} at {T:.4g} °C", notes=())
        try:
            own = without_inertia(within(named, *band, fewest), radius, height, fewest)
        except InputError as fault:
            kept[k] = False
            faults.append(fault)
            why = str(fault).removeprefix(f"{named.source}: ")
            notes += [*sweep.notes, f"the points at {T:.4g} °C are ignored: {why}"]
            continue
        own = own if band[1] else without_instrument(own, highest)
        for note in own.notes:
            told.setdefault(note, []).append(f"{T:.4g}")
        sweeps.append(own._replace(source=sweep.source, notes=sweep.notes))
    if not sweeps:
        raise faults[0]
    if len(sweeps) < 2:
        left = f"{celsius(data.temperatures[kept][0]):.4g} °C"
        raise InputError(f"{faults[0]} (--master needs two or more temperatures, and only {left} remains)")
    notes += [f"at {', '.join(places)} °C: {note}" for note, places in told.items()]
    sweeps[0] = sweeps[0]._replace(notes=(*sweeps[0].notes, *notes))
    factors = None if data.shift_factors is None else data.shift_factors[kept]
    ignored = np.append(data.ignored, data.temperatures[~kept])
    return data._replace(sweeps=sweeps, temperatures=data.temperatures[kept], shift_factors=factors, ignored=ignored)


def _mean_factor(factors: np.ndarray) -> float:
    """Return the geometric mean of the shift factors (n,). NaN values are ignored; the result is NaN if all are NaN."""
    given = factors[np.isfinite(factors)]
    return float(np.exp(np.mean(np.log(given)))) if len(given) else np.nan


def _index_of_group(T: np.ndarray, exact: bool) -> np.ndarray:
    """Divide the temperatures T (n,) [K] into groups, and return the index (n,) of the group of each. The groups are in
    ascending order of the temperatures.

    If the temperatures are `exact`, a group ends before a temperature that is `SAME` or more above the lowest
    temperature of this group. Measured temperatures scatter around an unknown value, so a group ends only before a gap
    of `SAME` or more.
    """
    order = np.argsort(T, kind="stable")
    group, count, lowest = np.zeros(len(T), int), 0, T[order[0]]
    for before, k in itertools.pairwise(order):
        if T[k] - (lowest if exact else T[before]) >= SAME:
            count, lowest = count + 1, T[k]
        group[k] = count
    return group


def joined(sweeps: Sequence[Sweep]) -> Sweep:
    """Return one sweep with all points of several sweeps, sorted by frequency. It has standard deviations if all sweeps
    have them, and each raw column that all sweeps have. If the sweeps have no common raw column of the instrument
    (`raw_torque.COLUMNS`), each such column is kept, with NaN for sweeps without this column."""
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
    files = tuple(dict.fromkeys(file for s in sweeps for file in s.files or (s.source,)))
    more = f" and {len(files) - 1} more file{'s' if len(files) > 2 else ''}" if len(files) > 1 else ""
    raws, greys = [s.raw or {} for s in sweeps], [s.grey for s in sweeps if s.grey is not None]
    names = [q for q in raws[0] if all(q in raw for raw in raws)]
    if not set(names) & set(raw_torque.COLUMNS):
        names += sorted({q for raw in raws for q in raw} & set(raw_torque.COLUMNS))
    columns = {
        q: [raw.get(q, np.full(len(s.loss), np.nan)) for s, raw in zip(sweeps, raws, strict=True)] for q in names
    }
    return Sweep(
        omega[order],
        storage,
        loss,
        storage_sd,
        loss_sd,
        source=f"{files[0]}{more}",
        notes=tuple(dict.fromkeys(notes)),
        raw={q: np.concatenate(parts)[order] for q, parts in columns.items()} or None,
        grey=np.concatenate(greys) if greys else None,
        sd_estimated=all(given) and all(s.sd_estimated for s in sweeps),
        sd_before=all(given) and all(s.sd_before for s in sweeps),
        sweep_numbers=np.repeat(np.arange(len(sweeps)), [len(s.storage) for s in sweeps])[order],
        load=next((s.load for s in sweeps if s.tensile), "shear"),
        files=files,
    )


def temperatures_in(name: str) -> list[float]:
    """Return the different temperatures [K] in the name of a table. Temperatures without the sign ° count only if no
    temperature has this sign."""
    stated = _STATED.findall(name)
    chosen = [own for own in stated if own[1]] or stated
    every = [float(value.replace(",", ".")) + 273.15 * (unit == "C") for value, _, unit in chosen]
    return [T for k, T in enumerate(every) if all(abs(T - other) >= SAME for other in every[:k])]


def _by_temperature(path: str, name: str, sweep: Sweep) -> list[tuple[float, float, Sweep]]:
    """Return (temperature [K], shift factor, sweep) for each temperature in a table. An unknown shift factor is NaN."""
    raw = sweep.raw or {}
    T = raw.get("temperature", np.full(len(sweep.storage), np.nan))
    missing = ~np.isfinite(T)
    if np.any(missing):
        stated = temperatures_in(name)
        if len(stated) != 1 and np.all(missing):
            found = ", ".join(f"{T:.4g} °C" for T in celsius(np.array(stated)))
            raise InputError(
                f"{path}: the table {repr(name) if name else 'of the file'} states "
                f"{f'several temperatures ({found})' if found else 'no temperature'}; add a column temperature_C"
            )
        of_name = stated[0] if len(stated) == 1 else np.nan
        # The temperature in the name cannot replace missing temperatures in two cases: the known temperatures differ
        # from each other, or they differ much from the name.
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
