"""Relaxation and creep from files: time with modulus, compliance, strain and stress, or other pairs of columns.

Files have the forms of sweeps: plain CSV, TRIOS and RheoCompass text, units in the header or below it.
"""

import os
import re
from pathlib import Path
from typing import NamedTuple

import numpy as np

from fitting.readers.noise_of_series import noise_of_series
from fitting.readers.scattering_load import without_scatter
from fitting.readers.tables.text_tables import EMPTY, decimal_sign, means_nothing, split_line, text_of, to_number
from fitting.readers.units import TIME_TEST_UNITS
from liverjax.core.errors import InputError

#: Words that begin a heading, and the quantity; the longer ones come first.
WORDS = (
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
)
#: Quantities that a file must have in addition to the time, best first.
FORMS = (
    ("strain", "stress"),
    ("angle", "torque"),
    ("displacement", "force"),
    ("modulus",),
    ("compliance",),
)


#: TRIOS writes two times, since the test began and since the experiment began. The time of the test is used.
OWN_TIME = "step time"
#: A load at the first row below this part of the largest load counts as rest: its effect on answers is as small.
AT_REST = 0.01

#: Lower bound of the scales: noise over this relative error; in a cyclic test this part of the largest answer.
RELATIVE, CYCLIC = 0.03, 0.1


class TimeTest(NamedTuple):
    """A relaxation or creep test in SI units, as shear."""

    kind: str  # relaxation or creep
    time: np.ndarray  # (n,) [s], ascending
    driven: np.ndarray  # (n,) strain, in creep stress [Pa], at these times
    answer: np.ndarray  # (n,) measured response: stress [Pa], in creep strain
    used: np.ndarray  # (n,) rows whose answer is fitted
    source: str = ""
    notes: tuple[str, ...] = ()

    @property
    def scales(self) -> np.ndarray:
        """Scales of the residuals: the size of each answer, with a lower bound for answers that are lost in noise."""
        answer = self.answer[self.used]
        floor = max(noise_of_series(answer) / RELATIVE, CYCLIC * float(np.max(np.abs(answer))) if self.cyclic else 0.0)
        return np.hypot(answer, floor)

    @property
    def cyclic(self) -> bool:
        """Whether the driven quantity falls by more than half of its largest value and rises again (answers pass 0)."""
        driven = np.abs(self.driven)
        half = 0.5 * driven.max()
        fallen = np.maximum.accumulate(driven) - driven > half
        if not fallen.any():
            return False
        after = driven[int(np.argmax(fallen)) :]
        return bool(np.max(after - np.minimum.accumulate(after)) > half)

    @property
    def begun(self) -> float:
        """Time [s] of the last row at rest: instruments often record a while before they load."""
        driven = np.abs(self.driven)
        first = int(np.argmax(driven > AT_REST * driven.max()))
        while first > 0 and driven[first] - driven[first - 1] > 1e-6 * driven.max():  # back to where it rises from
            first -= 1
        return float(self.time[first])

    @property
    def resolved(self) -> tuple[float, float]:
        """Shortest and longest relaxation time [s] that the test resolves: from the first answer used to the last."""
        time = self.time[self.used] - self.begun
        return float(time[0]), float(time[-1])


class Sample(NamedTuple):
    """Size of the sample [m], needed if the columns are torque or force."""

    radius: float | None = None
    height: float | None = None


def read_time_test(
    path: str | os.PathLike, kind: str, sample: Sample = Sample(), ramp: float | None = None, start: float = 0.0
) -> TimeTest:
    """Read a test.

    Args:
        path: text with a header that names time and one of `FORMS`.
        kind: "relaxation" or "creep".
        sample: radius and height of a cylinder, for torque and force.
        ramp: for a column of modulus or compliance, seconds in which strain or stress was raised; 0 (or None) for a
            step. For two columns: None; or 0 if the load was a step at 0 s and the rows begin later.
        start: answers before this time [s] are not fitted.

    Raises:
        InputError: one sentence naming file, column or line, value and remedy.
    """
    columns, notes = read_columns(path)
    time = columns["time"]
    form = next((f for f in FORMS if set(f) <= set(columns)), None)
    if form is None or (form[0] in ("modulus", "compliance") and form[0] != _own_table(kind)):
        raise InputError(
            f"{path}: a {kind} test needs, with time, {_own_table(kind)}, or strain and stress, angle and torque, or "
            f"displacement and force; the file has {', '.join(columns)}"
        )
    if form[0] in ("modulus", "compliance"):
        notes += _another_course(str(path), kind, time, columns[form[0]], (ramp or 0.0, start))
        time, driven, answer = _as_a_step(str(path), time, columns[form[0]], ramp or 0.0)
        if sample.radius is not None or sample.height is not None:
            notes.append(f"the size of the sample is not used: the file has a column of {form[0]}")
        if ramp is None:
            word = "strain" if kind == "relaxation" else "stress"
            notes.append(
                f"no column shows how the {word} rose: a step at 0 s is assumed. If it took some time, give --ramp "
                "SECONDS: what relaxed meanwhile is missing from G0 otherwise"
            )
    else:
        if ramp:
            raise InputError(f"{path}: --ramp {ramp:g} is for a file without the {form[0]}; leave it out")
        strain, stress, told = _as_shear(str(path), form, columns, sample)
        notes += told
        driven, answer = (strain, stress) if kind == "relaxation" else (stress, strain)
        time, driven, answer, told = from_rest(time, driven, answer, at_once=ramp == 0)
        return of_columns(kind, time, driven, answer, (str(path), [*notes, *told]), start)
    return _checked(TimeTest(kind, time, driven, answer, time > 0, str(path), tuple(notes)), start)


def read_columns(path: str | os.PathLike) -> tuple[dict[str, np.ndarray], list[str]]:
    """The columns of a test by quantity, in SI units, at rising times from 0 s or later; then notes.

    Raises:
        InputError: one sentence naming file, column or line, value and remedy.
    """
    columns, notes = _columns_in_time(str(path), text_of(Path(path), "a relaxation or creep test").splitlines())
    time = columns["time"]
    if not len(time):
        raise InputError(f"{path}: every row has an empty cell or one that is not finite; give numbers")
    if len(time) > 2 and np.all(np.diff(time) < 0):
        raise InputError(
            f"{path}: the rows run backwards, from {time[0]:g} s to {time[-1]:g} s; turn their order round"
        )
    if np.any(np.diff(time) <= 0) or time[0] < 0:
        k = int(np.argmax(np.diff(time) <= 0)) + 1
        order = f"time {time[k]:g} s follows {time[k - 1]:g} s" if time[0] >= 0 else f"time {time[0]:g} s is negative"
        raise InputError(f"{path}: {order}; let the rows begin at 0 s or later and rise in time")
    return columns, notes


def of_columns(
    kind: str,
    time: np.ndarray,
    driven: np.ndarray,
    answer: np.ndarray,
    source: tuple[str, list[str]],
    start: float = 0.0,
) -> TimeTest:
    """A test from columns of strain and stress whose rows begin at 0 s (see `from_rest`).

    Args:
        kind: "relaxation" or "creep".
        time: (n,) [s], rising from 0.
        driven, answer: (n,) strain and stress [Pa]; in creep stress and strain.
        source: name of the file, and notes.
        start: answers before this time [s] are not fitted.

    Raises:
        InputError: the driven quantity is zero, there are too few answers, or their sign is opposite.
    """
    driven, told = without_scatter(time, driven, "strain" if kind == "relaxation" else "stress")
    return _checked(TimeTest(kind, time, driven, answer, time > 0, source[0], (*source[1], *told)), start)


#: A note on rows that begin at 0 s with the load there.
BEGINS_LOADED = (
    "the first row, at 0 s, is under load already: a step from rest at 0 s is assumed. If the load rose before it, or "
    "the sample was loaded before, give those rows too: what relaxed until then is missing from G0 otherwise. If it "
    "was a step, ramp = 0 in a description, or (relaxation and creep alone) --ramp 0, says so"
)


def from_rest(
    time: np.ndarray, driven: np.ndarray, answer: np.ndarray, at_once: bool
) -> tuple[np.ndarray, np.ndarray, np.ndarray, list[str]]:
    """The rows (n,), with a row added at 0 s if they begin later; then notes.

    Args:
        time, driven, answer: (n,) as in `of_columns`.
        at_once: whether the first load acted from 0 s on; else it was raised from 0 s until the first row.
    """
    if not time[0] > 0:
        loaded = abs(driven[0]) > AT_REST * np.max(np.abs(driven)) and not at_once
        return time, driven, answer, [BEGINS_LOADED] if loaded else []
    first, notes = driven[0] if at_once else 0.0, []
    if not at_once and abs(driven[0]) > AT_REST * np.max(np.abs(driven)):
        notes.append(
            f"the rows begin at {time[0]:.3g} s under load: a linear ramp from 0 s on is assumed. If it was a step at "
            "0 s, put a row with this load at 0 s, or (relaxation and creep alone) say --ramp 0 (in a description: "
            "ramp = 0)"
        )
    return np.append(0.0, time), np.append(first, driven), np.append(0.0, answer), notes


def kind_of(path: str | os.PathLike) -> str:
    """ "relaxation" or "creep". A modulus or a compliance decides; else the column that stays constant is the driven
    one."""
    columns, _ = read_columns(path)
    form = next((f for f in FORMS if set(f) <= set(columns)), ("modulus",))
    if len(form) == 1:
        return "relaxation" if form == ("modulus",) else "creep"
    late = len(columns["time"]) // 2
    moves = [np.ptp(columns[q][late:]) / max(float(np.max(np.abs(columns[q]))), 1e-300) for q in form]
    return "relaxation" if moves[0] <= moves[1] else "creep"


def _own_table(kind: str) -> str:
    return "modulus" if kind == "relaxation" else "compliance"


def _columns_in_time(path: str, lines: list[str]) -> tuple[dict[str, np.ndarray], list[str]]:
    """The columns, in SI units, of the first table that has time and an answer; then notes."""
    for k, line in enumerate(lines):
        delimiter, cells = split_line(line.lstrip("# "))
        found = _heading(cells)
        if "time" in found and any(set(f) <= set(found) for f in FORMS):
            rows, units, left_out = _rows_in_time(path, lines, k + 1, delimiter, found)
            columns, notes = _in_si(path, found, np.array(rows), units)
            return columns, [*_told_of_times(cells), *notes, *left_out, *_told_of_tables(lines[k + 1 :])]
    first = next((line.strip() for line in lines if line.strip()), "")[:80]
    raise InputError(
        f"{path}: no header names time_s and relaxation_modulus_Pa, creep_compliance_1/Pa, strain and stress_Pa, "
        f"angle_rad and torque_N.m, or displacement_m and force_N (the first line is {first!r}); add that header"
    )


def _told_of_tables(below: list[str]) -> list[str]:
    """A note if further tables of tests are below the first one."""
    more = sum(map(_begins_a_table, below))
    if not more:
        return []
    return [f"the file holds {more + 1} tables of a test: the first is read; give each a file of its own"]


def _begins_a_table(line: str) -> bool:
    found = _heading(split_line(line.lstrip("# "))[1])
    return "time" in found and any(set(f) <= set(found) for f in FORMS)


def _heading(cells: list[str]) -> dict[str, tuple[int, str | None]]:
    """Quantity -> place and unit of the first cell that names it; a step time comes before other times."""
    found: dict[str, tuple[int, str | None]] = {}
    for k, cell in sorted(enumerate(cells), key=lambda each: not _is_own_time(each[1])):
        text = cell.strip().strip('"')
        bracket = re.search(r"[\[(]\s*([^\])]*?)\s*[\])]\s*$", text) if not text.lower().endswith("(t)") else None
        unit = bracket.group(1) if bracket else None
        name = (text[: bracket.start()] if bracket else text).replace("_", " ").strip()
        for word, quantity in WORDS:
            if name.lower().startswith(word):
                rest = name[len(word) :].strip()
                if rest and not _known_column(quantity, rest):
                    break  # "strain rate", "stress (step)"
                found.setdefault(quantity, (k, unit or rest or None))
                break
    return found


def _is_own_time(cell: str) -> bool:
    return cell.strip('" ').replace("_", " ").lower().startswith(OWN_TIME)


def _told_of_times(cells: list[str]) -> list[str]:
    """A note if the header has two times."""
    if not any(map(_is_own_time, cells)) or not any("time" in _heading([c]) and not _is_own_time(c) for c in cells):
        return []
    return ["the times are those of the column Step time; the column Time counts from another beginning"]


def _plain_heading(unit: str) -> str:
    return unit.replace("µ", "u").replace("μ", "u").replace("·", ".").replace("⋅", ".").strip('[]() "')


def _known_column(quantity: str, unit: str) -> bool:
    return _plain_heading(unit) in TIME_TEST_UNITS[quantity]


def _rows_in_time(path, lines, k, delimiter, found):
    """Numbers below the header, the units of a unit line, and notes. An empty cell is NaN."""
    kept, numbers, units, notes = [], [], {}, []
    needed = {q: place for q, (place, _) in found.items()}
    while k < len(lines):
        line = lines[k]
        k += 1
        _, cells = split_line(line, delimiter)
        own = [cells[p] if p < len(cells) else "" for p in needed.values()]
        if not means_nothing(own):
            kept.append(own)
            numbers.append(k)
            continue
        named = {q: cells[p] for q, p in needed.items() if p < len(cells) and _known_column(q, cells[p])}
        if not kept and named:  # unknown units are kept here, and refused later
            units = {q: cells[p].strip('[]() "') for q, p in needed.items() if p < len(cells) and cells[p].strip()}
        elif kept and any(c.strip().lower() not in EMPTY for c in own) and not line.lstrip().startswith("#"):
            if not _rows_follow(lines[k:], delimiter, list(needed.values())):
                break
            notes.append(f"line {k}, {line.strip()[:40]!r}, has no numbers and is left out")
    sign = decimal_sign(cell for own in kept for cell in own)
    rows = [[to_number(cell, delimiter, sign) for cell in own] for own in kept]
    for number, row in zip(numbers, rows, strict=True):
        if any(v is None for v in row):
            shown = lines[number - 1].strip()[:40]
            raise InputError(f"{path}: line {number}: {shown!r} has a cell that is no number; correct or remove it")
    if len(rows) < 4:
        raise InputError(f"{path}: {len(rows)} rows of numbers are below the header; give four or more")
    return rows, units, notes


def _rows_follow(below: list[str], delimiter: str, places: list[int]) -> bool:
    """Whether numbers of the same table follow."""
    for line in below:
        if _begins_a_table(line):
            return False
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
            notes.append(f"the column of {quantity} states no unit; {unit} is taken")
        if not _known_column(quantity, unit):
            raise InputError(
                f"{path}: unit {unit!r} of {quantity} is not known; use {', '.join(TIME_TEST_UNITS[quantity])}"
            )
        columns[quantity] = rows[:, j] * TIME_TEST_UNITS[quantity][_plain_heading(unit)]
    good = np.all(np.isfinite(rows), axis=1)
    if not good.all():
        notes.append(f"{(~good).sum()} of {len(good)} rows are left out: a cell in them is empty or not finite")
    return {q: v[good] for q, v in columns.items()}, notes


def _as_a_step(path, time, modulus, ramp):
    """Times, a driven strain (or stress) of 1 that is reached at once or over a ramp, and answers."""
    if not (np.isfinite(ramp) and ramp >= 0):
        raise InputError(f"{path}: --ramp {ramp:g} cannot be the seconds of a ramp; give 0 or more")
    kept = time > 0
    times = np.unique(np.concatenate([[0.0], time[kept], [ramp] if ramp else []]))
    answer = np.full(len(times), np.nan)
    answer[np.searchsorted(times, time[kept])] = modulus[kept]
    return times, np.minimum(times / ramp, 1.0) if ramp else np.ones(len(times)), answer


#: Part of the largest modulus or compliance by which it may go the wrong way; in noise, times its deviation.
_WRONG_WAY, _IN_NOISE = 0.25, 6.0


def _another_course(path: str, kind: str, time: np.ndarray, values: np.ndarray, given: tuple) -> list[str]:
    """Refuse a modulus that rises, or a compliance that falls, where the load is constant; `given`: ramp and start [s].

    A running median leaves single wrong rows out. Returns notes.

    Raises:
        InputError: one sentence with the time, and what it may be.
    """
    from scipy.ndimage import median_filter

    ramp, start = given
    rows = (time > 0) & (time >= start) & np.isfinite(values)
    t, v = time[rows], values[rows] * np.sign(np.sum(values[rows]))
    if len(t) < 8:
        return []
    smooth = median_filter(v, size=5, mode="nearest")
    noise, v = max(noise_of_series(v), 1.4826 * float(np.median(np.abs(v - smooth)))), smooth
    size = float(v.max())
    allowed = max(_WRONG_WAY * size, _IN_NOISE * noise)
    if kind == "creep":
        fallen = np.maximum.accumulate(v) - v
        if fallen.max() > allowed:
            last = t[int(np.argmax(v[: int(np.argmax(fallen > allowed)) + 1]))]
            raise InputError(
                f"{path}: the compliance falls from {last:.3g} s on. If the stress was taken away, give strain and "
                "stress in two columns, or end the rows there; if it rings after the load, leave these rows out "
                "(--min-time)"
            )
        return []
    peak = int(np.argmax(v))
    if not ramp and v[peak] - v[: peak + 1].min() > allowed:
        raise InputError(
            f"{path}: the modulus rises until {t[peak]:.3g} s, and after a step of strain it can only fall: if the "
            f"strain rose until then, give --ramp {t[peak]:.3g}, else leave the rows before it out (--min-time "
            f"{t[peak]:.3g})"
        )
    if ramp and t[0] < 0.3 * ramp and v[0] > 0.7 * size:
        return [
            f"the modulus has {100 * v[0] / size:.0f} % of its largest value at {t[0]:.3g} s, and a ramp of {ramp:g} s "
            f"has {100 * t[0] / ramp:.2g} % of its strain then: is --ramp right?"
        ]
    return []


def _as_shear(path, form, columns, sample):
    """Shear strain, shear stress [Pa], and notes."""
    if form == ("strain", "stress"):
        return columns["strain"], columns["stress"], []
    if sample.radius is None or sample.height is None:
        raise InputError(f"{path}: {form[1]} needs the sample's size: give --radius and --height in metres")
    r, h = sample.radius, sample.height
    if form == ("angle", "torque"):
        return columns["angle"] * r / h, columns["torque"] * 2 / (np.pi * r**3), []
    note = "force and displacement are taken as those of an incompressible cylinder between slippery plates: G = E / 3"
    return columns["displacement"] / h, columns["force"] / (3 * np.pi * r**2), [note, *_beyond_small(columns, h)]


#: Deviation [1] of the force from a straight line from which it is told.
BENT = 0.02


def _beyond_small(columns: dict[str, np.ndarray], height: float) -> list[str]:
    """A note if the force of a neo-Hookean sample, stretched or compressed so far, is not in proportion."""
    strain = float(np.nanmax(np.abs(columns["displacement"]))) / height

    def off(stretch: float) -> float:
        """The force over that of the straight line, less 1."""
        return (stretch - stretch**-2) / (3 * (stretch - 1)) - 1

    if not strain > 0 or -off(1 + strain) < BENT:
        return []
    shorter = f"{100 * off(1 - strain):.2g} % too large in compression, " if strain < 1 else ""
    return [
        f"the sample is strained by {100 * strain:.2g} %, where the force of neo-Hookean tissue is no straight line: "
        f"moduli come out {shorter}{-100 * off(1 + strain):.2g} % too small in tension. Describe the test in a TOML "
        "file to have this computed"
    ]


#: Fewest rows at rest whose mean is an offset, and the part of the largest answer below which it does not matter.
RESTING, OFFSET = 3, 0.003


def _without_offset(test: TimeTest) -> tuple[np.ndarray, list[str]]:
    """The answers without their mean before the load, if it is more than their scatter; then a note."""
    rest = np.isfinite(test.answer) & (test.time < test.begun) & ~((test.time == 0) & (test.answer == 0))
    count, size = int(rest.sum()), float(np.nanmax(np.abs(test.answer)))
    if count < RESTING:
        return test.answer, []
    mean, error = float(np.mean(test.answer[rest])), float(np.std(test.answer[rest], ddof=1)) / np.sqrt(count)
    if not abs(mean) > max(3 * error, OFFSET * size):
        return test.answer, []
    what, unit = ("stress", " Pa") if test.kind == "relaxation" else ("strain", "")
    return test.answer - mean, [
        f"the {what} of the {count} rows before the load is {mean:.3g}{unit} on average, "
        f"{100 * abs(mean) / size:.2g} % of the largest: it is taken off all rows, as an offset of the sensor"
    ]


def _checked(test: TimeTest, start: float) -> TimeTest:
    if not np.max(np.abs(test.driven)) > 0:
        word = "strain" if test.kind == "relaxation" else "stress"
        raise InputError(f"{test.source}: the {word} is zero throughout; a {test.kind} test needs one")
    sign = np.sign(test.driven[np.argmax(np.abs(test.driven))])
    driven, (answer, told) = sign * test.driven, _without_offset(test)
    answer = sign * answer
    used = test.used & np.isfinite(answer) & (test.time >= start) & (test.time > test.begun)
    if used.sum() < 4:
        raise InputError(
            f"{test.source}: {used.sum()} usable answers are left; give four or more (--min-time too late?)"
        )
    if not np.sum(driven[used] * answer[used]) > 0:
        raise InputError(
            f"{test.source}: most answers have the opposite sign of the {test.kind} test's input; correct the signs"
        )
    notes, before = (*test.notes, *told), int(np.sum(test.time <= test.begun))
    if before > 2:
        notes = (*notes, f"the load begins at {test.begun:.3g} s: {before} rows before it are not fitted")
    return test._replace(driven=driven, answer=answer, used=used, notes=notes)
