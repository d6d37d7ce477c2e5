"""Read relaxation and creep tests from files. A file has a column of time and one of these: a modulus, a compliance, or
two columns, for example strain and stress."""

import os
from typing import NamedTuple

import numpy as np

from fitting.readers.base_line import OFFSET, RESTING, base_line
from fitting.readers.changes_of_load import begins_of_changes, first_is_imposed, is_uncertain
from fitting.readers.checks.course_in_time import BEYOND_NOISE, another_course, of_ringing, of_the_other_kind
from fitting.readers.checks.scattering_load import without_scatter
from fitting.readers.noise_of_series import (
    noise_of_series,
    rounding_at_rest,
    rounding_of_series,
    smooth_sizes,
    told_of_far_values,
)
from fitting.readers.tables.time_columns import FORMS, TENSILE, beyond_small, in_shear, named_columns, read_columns
from liverjax.core.errors import InputError

#: A load below this fraction of the largest load counts as rest: its effect on the response is just as small.
AT_REST = 0.01

#: The scales of the residuals have a lower bound: the noise divided by RELATIVE, and also CYCLIC (in a cyclic test) or
#: LEAST_SIZE times the largest response.
RELATIVE, CYCLIC, LEAST_SIZE = 0.03, 0.1, 1e-6

#: What is known about a change of the load that no row shows. BETWEEN_ROWS: unknown; a linear change between rows is
#: assumed. BEFORE_ROWS: unknown; the first row is already loaded, so a row at 0 s was added. GIVEN: the user gave the
#: duration.
BETWEEN_ROWS, BEFORE_ROWS, GIVEN = "between rows", "before the rows", "given"


class TimeTest(NamedTuple):
    """A relaxation or creep test in SI units. All quantities are those of shear."""

    kind: str  # relaxation or creep
    time: np.ndarray  # (n,) [s], ascending
    driven: np.ndarray  # (n,) imposed strain; in creep the imposed stress [Pa]
    answer: np.ndarray  # (n,) measured response: stress [Pa]; in creep the strain
    used: np.ndarray  # (n,) whether the response in a row is fitted
    source: str = ""
    notes: tuple[str, ...] = ()
    constant_noise: bool = False  # whether the noise of all responses has the same size
    rise: str = BETWEEN_ROWS  # what is known about a change of the load that no row shows
    described: bool = False  # whether a TOML file describes the test
    # Standard errors of the subtracted base line of the sensor, in the unit of the response: error at the beginning of
    # the load, and error of the change per second.
    offset_error: float = 0.0
    drift_error: float = 0.0
    # Standard deviation of the rounding errors of the responses, 0 if they are not rounded. It is found before the base
    # line is subtracted, because rows with the same response differ after a drift is subtracted.
    rounding: float = 0.0
    axial: bool = False  # whether the test is one of tension or compression, not of torsion
    # Relative change of all moduli per metre of the height or thickness, and per metre of the radius, if a TOML file
    # describes the test.
    per_size: tuple[float, float] = (0.0, 0.0)

    @property
    def scales(self) -> np.ndarray:
        """Scales of the residuals: smoothed sizes of the responses, with a lower bound for responses below the noise.
        If the noise is constant, all scales are the median of these sizes."""
        sizes = self._sizes_of_answers()
        return np.full(len(sizes), np.median(sizes)) if self.constant_noise else sizes

    def _sizes_of_answers(self) -> np.ndarray:
        answer = self.answer[self.used]
        noise = max(noise_of_series(answer), rounding_of_series(answer), self.rounding)
        floor = max(noise / RELATIVE, (CYCLIC if self.cyclic else LEAST_SIZE) * float(np.max(np.abs(answer))))
        return np.hypot(smooth_sizes(answer), floor)

    @property
    def cyclic(self) -> bool:
        """Whether the imposed load falls by more than half of its largest value and rises again. The response of such a
        test passes through 0."""
        driven = np.abs(self.driven)
        half = 0.5 * driven.max()
        fallen = np.maximum.accumulate(driven) - driven > half
        if not fallen.any():
            return False
        after = driven[int(np.argmax(fallen)) :]
        return bool(np.max(after - np.minimum.accumulate(after)) > half)

    @property
    def begun(self) -> float:
        """Time [s] of the last row at rest. Instruments often record for a while before the load."""
        driven = np.abs(self.driven)
        first = int(np.argmax(driven > AT_REST * driven.max()))
        while first > 0 and driven[first] - driven[first - 1] > 1e-6 * driven.max():  # go back to the start of the rise
            first -= 1
        return float(self.time[first])

    def base_line_errors(self, rows: np.ndarray) -> np.ndarray:
        """Return the changes (k, m) of m responses due to k independent errors of the subtracted base line.

        Each error is one standard error. k is 0 if no base line was subtracted.
        """
        one = np.stack([np.full(len(rows), self.offset_error), self.drift_error * (self.time[rows] - self.begun)])
        return one[np.any(one != 0, axis=1)]

    @property
    def jumps(self) -> np.ndarray:
        """Indices (j,) of the rows at the ends of jumps of the load; empty if the user gave the duration of the
        jumps."""
        if self.rise == GIVEN:
            return np.zeros(0, int)
        shown = np.flatnonzero(np.isfinite(self.answer))  # added rows may have no response
        return shown[_rows_of_jumps(self.time[shown], self.driven[shown])]

    @property
    def answers_at_once(self) -> bool:
        """Whether a response at the instant of a step is fitted. Such a response determines G0, but no relaxation
        time."""
        return bool(_at_once(self.time[self.used], self.since_change[self.used]).any())

    @property
    def since_change(self) -> np.ndarray:
        """Times (n,) [s] since the load last began to change or changed its direction. At the instant of a change, the
        time since the earlier change is given."""
        begins = begins_of_changes(self.time, self.driven, self.begun)
        return self.time - begins[np.maximum(np.searchsorted(begins, self.time) - 1, 0)]

    @property
    def resolved(self) -> tuple[float, float]:
        """Shortest and longest relaxation time [s] that the test resolves: the shortest time between a change of the
        load and a fitted response (`since_change`; responses at the instant of a step do not count), and the time from
        the start of the load to the last fitted response."""
        time, since = self.time[self.used], self.since_change[self.used]
        return float(since[~_at_once(time, since)].min()), float(time[-1] - self.begun)


class Sample(NamedTuple):
    """Size of the sample [m], needed if the columns are torque or force."""

    radius: float | None = None
    height: float | None = None


def read_time_test(
    path: str | os.PathLike, kind: str, sample: Sample = Sample(), ramp: float | None = None, start: float = 0.0
) -> TimeTest:
    """Read a relaxation or creep test.

    Args:
        path: a file with a header that names the time and one combination of quantities in `FORMS`.
        kind: "relaxation" or "creep".
        sample: radius and height of a cylinder, for torque and force.
        ramp: duration [s] of the ramp of strain or stress, 0 for a step. For a column of modulus or compliance, None
            means a step. For two columns, give a duration only if no row shows the rise (see `from_rest`).
        start: responses before this time [s] are not fitted. This is a time of the file, whenever the load begins.

    Raises:
        InputError: the file cannot be used; the message names the column or line, the value and the remedy.
    """
    if not (np.isfinite(start) and start >= 0):
        raise InputError(
            f"--min-time {start:g} must be a finite number of seconds, 0 or more, on the time axis of the file: give "
            "e.g. 0.5"
        )
    named, notes = named_columns(path)
    axial = not TENSILE.keys().isdisjoint(named)
    columns, notes = in_shear(named, notes)
    time = columns["time"]
    form = next((f for f in FORMS if set(f) <= set(columns)), None)
    if form is None or (form[0] in ("modulus", "compliance") and form[0] != _own_table(kind)):
        raise InputError(
            f"{path}: a {kind} test needs the time and one of these: {_own_table(kind)}; strain and stress; angle and "
            f"torque; displacement and force. The file has {', '.join(columns)}"
        )
    if form[0] in ("modulus", "compliance"):
        notes += another_course(str(path), kind, time, columns[form[0]], (ramp or 0.0, start))
        time, driven, answer = _as_a_step(str(path), time, columns[form[0]], ramp or 0.0)
        if sample.radius is not None or sample.height is not None:
            notes.append(
                f"the size of the sample does not change the moduli, because the file has a column of {form[0]}: it is "
                "used only for the total errors"
            )
        if ramp is None:
            word = "strain" if kind == "relaxation" else "stress"
            notes.append(
                f"no column shows how the {word} rose: a step at 0 s is assumed. If the rise took some time, give "
                "--ramp SECONDS, and count the times from the start of the rise. Otherwise G0 is too large (or too "
                "small if the times count from the end of the rise)"
            )
    else:
        strain, stress, told = _as_shear(str(path), form, columns, sample)
        notes += told
        notes += of_the_other_kind(kind, time, strain, stress)
        driven, answer = (strain, stress) if kind == "relaxation" else (stress, strain)
        own_time, own_drive = time, driven
        time, driven, answer, told = from_rest(time, driven, answer, ramp, (str(path), "--ramp"))
        driven, scatter = without_scatter(time, driven, "strain" if kind == "relaxation" else "stress")
        test = of_columns(kind, time, driven, answer, (str(path), [*notes, *told, *scatter]), start)
        test = with_known_rise(test, own_time, own_drive, ramp)
        return test._replace(axial=axial or form == ("displacement", "force"))
    test = TimeTest(kind, time, driven, answer, time > 0, str(path), tuple(notes))
    return _checked(test._replace(rise=GIVEN, axial=axial), start)


def of_columns(
    kind: str,
    time: np.ndarray,
    driven: np.ndarray,
    answer: np.ndarray,
    source: tuple[str, list[str]],
    start: float = 0.0,
) -> TimeTest:
    """Return a test from columns of strain and stress. Their rows begin at 0 s (see `from_rest`).

    Args:
        kind: "relaxation" or "creep".
        time: (n,) [s], rising from 0.
        driven, answer: (n,) strain and stress [Pa]; in creep, stress [Pa] and strain. The scatter of `driven` was
            removed before (see `without_scatter`).
        source: name of the file, and notes.
        start: responses before this time [s] are not fitted.

    Raises:
        InputError: the imposed load is zero, there are too few responses, most responses have the opposite sign, or the
            times do not ascend.
    """
    if np.any(np.diff(time) < 0):
        raise InputError(f"{source[0]}: the times do not ascend; sort the rows by time")
    told = of_ringing(time, driven, answer, start) if kind == "creep" else []
    return _checked(TimeTest(kind, time, driven, answer, time > 0, source[0], (*source[1], *told)), start)


#: Note on a file whose first row, at 0 s, is already under load.
BEGINS_LOADED = (
    "the first row, at 0 s, is under load already: a step from rest at 0 s is assumed. If the sample was loaded "
    "before, give these earlier rows too; otherwise G0 lacks the stress that relaxed before 0 s. If the sample was "
    "under a constant load until its stress was steady, subtract this strain and this stress from all rows. If the "
    "load was a step, confirm this with ramp = 0 in a description, or with --ramp 0 (relaxation and creep only)"
)


def from_rest(
    time: np.ndarray, driven: np.ndarray, answer: np.ndarray, ramp: float | None, names: tuple[str, str]
) -> tuple[np.ndarray, np.ndarray, np.ndarray, list[str]]:
    """Return times, loads and responses (n,) that begin at rest, and notes. Rows at 0 s and in jumps are added if
    needed.

    Args:
        time, driven, answer: (n,), see `of_columns`.
        ramp: duration [s] of a jump of the load between two rows. The jump ends at the later row; 0 means a step. If
            the first row is under load, this is the duration of the rise from 0 s on. None means that the load changes
            linearly between rows.
        names: name of the file, and name of `ramp`, for messages.

    Raises:
        InputError: `ramp` contradicts the rows: they already show how the load rose, or the rise took less time.
    """
    size, rows = np.abs(driven), _rows_of_jumps(time, driven)
    loaded = size[0] > AT_REST * np.max(size)
    still = loaded and bool(np.all(np.abs(driven[1:6] - driven[0]) <= _JUMP * np.max(size)))
    early = ramp is not None and loaded and (ramp == 0 or (still and 0 < ramp <= time[0]))  # the rise is already over
    if ramp is not None and not ramp >= 0:
        raise InputError(f"{names[0]}: {names[1]} {ramp:g} is not a duration: give 0 or more seconds")
    if ramp is not None and not early and not (len(rows) and 0 <= ramp <= time[rows[0]] - time[rows[0] - 1]):
        shown = "the rows show how the load rose"
        if still:
            shown = f"the rows begin under load at {time[0]:.4g} s, and the rise cannot end later"
        elif len(rows):
            shown = f"the load rose between {time[rows[0] - 1]:.4g} and {time[rows[0]]:.4g} s"
        raise InputError(f"{names[0]}: {names[1]} {ramp:g} cannot be right, since {shown}; remove this setting")
    if ramp is not None:
        time, driven, answer = rows_before_jumps(rows, ramp, time, driven, answer)
    if not time[0] > 0:
        return time, driven, answer, [BEGINS_LOADED] if loaded and not early else []
    begin, rise, notes = [0.0], [0.0], []
    if ramp == 0 and loaded:
        rise = [driven[0]]
    elif ramp is not None and early and ramp != time[0]:
        begin, rise = [0.0, ramp], [0.0, driven[0]]
    elif loaded and not early:
        notes.append(
            f"the rows begin at {time[0]:.3g} s under load: a linear ramp from 0 s on is assumed. If the load was a "
            "step at 0 s, give --ramp 0, or the duration of a faster rise (relaxation and creep only; in a "
            "description: ramp = 0)"
        )
    return np.append(begin, time), np.append(rise, driven), np.append(np.zeros(len(begin)), answer), notes


def with_known_rise(test: TimeTest, time: np.ndarray, driven: np.ndarray, ramp: float | None) -> TimeTest:
    """Return the test with its field `rise`, which is found from the times and loads (n,) of the file.

    Responses in rows that `from_rest` has added are not fitted.
    """
    test = test._replace(used=test.used & np.isin(test.time, time))
    if ramp is not None:
        return test._replace(rise=GIVEN)
    loaded = time[0] > 0 and abs(driven[0]) > AT_REST * np.max(np.abs(driven))
    before = loaded and len(test.jumps) > 0 and test.time[test.jumps[0]] == time[0]
    return test._replace(rise=BEFORE_ROWS) if before else test


#: The load jumps between two rows if it changes by more than _JUMP times its largest value, and if the changes of the
#: load before and after are below _COMPLETE times this change. See `_rows_of_jumps` for irregular times.
_JUMP, _COMPLETE = 0.05, 0.5
#: Duration of a step, as a fraction of the time between two rows. It is so short that it resolves no relaxation time.
AT_ONCE = 1e-4


def _rows_of_jumps(time: np.ndarray, driven: np.ndarray) -> np.ndarray:
    """Return the indices (j,) of the rows at the ends of jumps. No row shows how the load changed in a jump.

    The changes of the load before and after a jump must be small: either the changes within equal times, or both the
    changes and their rates between the neighbouring rows. So a straight ramp at irregular times has no jump.
    """
    begin, end = time[:-1], time[1:]
    own, least = np.abs(np.diff(driven)), _JUMP * np.max(np.abs(driven))
    before, after = np.interp(2 * begin - end, time, driven), np.interp(2 * end - begin, time, driven)
    alone = np.maximum(np.abs(driven[:-1] - before), np.abs(after - driven[1:])) < _COMPLETE * own
    sizes = np.stack([own, own / (end - begin)])
    beside = np.pad(sizes, ((0, 0), (1, 1)))
    alone |= np.all(np.maximum(beside[:, :-2], beside[:, 2:]) < _COMPLETE * sizes, axis=0)
    return 1 + np.flatnonzero((own > least) & alone)


def _at_once(time: np.ndarray, since: np.ndarray) -> np.ndarray:
    """Return for each response (n,) whether it is at the instant of a step. `time`: times (n,) [s] of the responses.
    `since`: times (n,) [s] since the last change of the load."""
    first = np.diff(since, prepend=np.inf) <= 0  # the first response after a change
    # No response follows the last one, so the two intervals before it count. One of them may be a step.
    return first & (since < AT_ONCE * np.append(since[1:], np.ptp(time[-3:])))


def rows_before_jumps(rows: np.ndarray, ramp: float, time: np.ndarray, *columns: np.ndarray) -> tuple:
    """Return the columns with an added row in each jump, `ramp` [s] before the later row of the jump. The added row has
    the values of the earlier row."""
    interval = time[rows] - time[rows - 1]
    after = np.append(np.diff(time), np.inf)[rows]
    before = time[rows] - np.clip(ramp, 0.1 * AT_ONCE * np.minimum(interval, after), interval)
    new = before > time[rows - 1]
    return tuple(
        np.insert(values, rows[new], added[new])
        for values, added in ((time, before), *((c, c[rows - 1]) for c in columns))
    )


def kind_of(path: str | os.PathLike) -> str:
    """Return "relaxation" or "creep". A column of modulus means relaxation, and a column of compliance means creep.
    Otherwise, `first_is_imposed` finds the imposed quantity."""
    columns, _ = read_columns(path)
    form = next((f for f in FORMS if set(f) <= set(columns)), ("modulus",))
    if len(form) == 1:
        return "relaxation" if form == ("modulus",) else "creep"
    return "relaxation" if first_is_imposed(columns["time"], columns[form[0]], columns[form[1]]) else "creep"


def read_test_of_any_kind(path: str | os.PathLike, sample: Sample) -> TimeTest:
    """Read a relaxation or creep test of the kind that `kind_of` finds. A note says if this kind is uncertain."""
    test = read_time_test(path, kind_of(path), sample)
    rows = np.isfinite(test.answer)
    if not is_uncertain(test.time[rows], test.driven[rows], test.answer[rows]):
        return test
    imposed, other, kind = ("strain", "stress", "creep")
    if test.kind == "creep":
        imposed, other, kind = ("stress", "strain", "relaxation")
    note = (
        f"the {imposed} is taken as imposed, but the rows hardly show which quantity was imposed: if it was the "
        f"{other}, fit this file alone with python -m fitting {kind}"
    )
    return test._replace(notes=(*test.notes, note))


def _own_table(kind: str) -> str:
    return "modulus" if kind == "relaxation" else "compliance"


def _as_a_step(path, time, modulus, ramp):
    """Return times, an imposed strain (or stress) that rises to 1 in a step or a ramp, and responses."""
    if not (np.isfinite(ramp) and ramp >= 0):
        raise InputError(f"{path}: --ramp {ramp:g} cannot be the duration of a ramp in seconds; give 0 or more")
    if ramp > time[-1]:
        raise InputError(
            f"{path}: --ramp {ramp:g} ends after the last row at {time[-1]:g} s; give a duration in seconds"
        )
    kept = time > 0
    times = np.unique(np.concatenate([[0.0], time[kept], [ramp] if ramp else []]))
    answer = np.full(len(times), np.nan)
    answer[np.searchsorted(times, time[kept])] = modulus[kept]
    return times, np.minimum(times / ramp, 1.0) if ramp else np.ones(len(times)), answer


def _as_shear(path, form, columns, sample):
    """Return shear strain, shear stress [Pa] and notes, from the two columns that `form` names."""
    if form == ("strain", "stress"):
        return columns["strain"], columns["stress"], []
    if sample.radius is None or sample.height is None:
        raise InputError(f"{path}: {form[1]} needs the sample's size; give --radius and --height in metres")
    r, h = sample.radius, sample.height
    if form == ("angle", "torque"):
        return columns["angle"] * r / h, columns["torque"] * 2 / (np.pi * r**3), []
    note = "force and displacement are those of an incompressible cylinder between frictionless plates: G = E / 3"
    strain = columns["displacement"] / h
    return strain, columns["force"] / (3 * np.pi * r**2), [note, *beyond_small(float(np.nanmax(np.abs(strain))))]


def _without_base_line(test: TimeTest) -> tuple[TimeTest, list[str]]:
    """Return the test without the base line of its sensor, and a note if a base line was subtracted."""
    rest = np.isfinite(test.answer) & (test.time < test.begun) & ~((test.time == 0) & (test.answer == 0))
    count, size = int(rest.sum()), float(np.nanmax(np.abs(test.answer)))
    if count < RESTING:
        return test, _of_one_row_at_rest(test, size)
    time = test.time - test.begun
    rounding = rounding_at_rest(test.answer[rest], test.answer[np.isfinite(test.answer)])
    line = base_line(time[rest], test.answer[rest], size, float(time[-1]), rounding)
    if line is None:
        return test, []
    what, unit = ("stress", " Pa") if test.kind == "relaxation" else ("strain", "")
    if line.slope:
        told = (
            f"the {what} of {count} rows at rest changes steadily, by {line.slope:.3g}{unit} per second: "
            f"the sensor drifts. This straight line is subtracted from all rows: {line.level:.3g}{unit} at the "
            f"beginning of the load, {line.level + line.slope * time[-1]:.3g}{unit} at the end of the test. Nothing "
            "shows how the drift continues under load, so the errors allow for half of it"
        )
    else:
        told = f"the {what} of {count} rows at rest is {line.level:.3g}{unit} on average"
        if abs(line.level) > OFFSET * size:
            told += (
                f", which is {100 * abs(line.level) / size:.2g} % of the largest {what} (absolute value): this sensor "
                "offset is subtracted"
            )
        else:
            told += ". This mean is subtracted"
        if line.left:
            told += (
                f". But the {what} changes during these rows, by {line.left:.2g}{unit} per second: the sensor may "
                "drift, or the sample has not settled. If this change continues under load, the last response is wrong "
                f"by {abs(line.left) * time[-1]:.2g}{unit}"
                f"{', and the errors allow for this' if line.slope_error else ''}: record a longer rest"
            )
    answer = test.answer - line.level - line.slope * time
    return test._replace(answer=answer, offset_error=line.level_error, drift_error=line.slope_error), [told]


def _of_one_row_at_rest(test: TimeTest, size: float) -> list[str]:
    """Return a note if the response at the start of the load is not 0. With too few rows at rest, an offset
    cannot be distinguished from noise. The last of these rows is the beginning of the load, so RESTING + 1 rows are
    enough."""
    k = int(np.argmax(test.time >= test.begun))
    here, load = float(test.answer[k]), abs(float(test.driven[k])) / float(np.max(np.abs(test.driven)))
    noise = noise_of_series(test.answer[np.isfinite(test.answer) & (test.time > test.begun)])
    # In a steady cycle, the first response is not 0, because it lags behind the load.
    if test.cyclic or load > AT_REST or not abs(here) > max(BEYOND_NOISE * noise, (OFFSET + 2 * load) * size):
        return []
    what, unit = ("stress", " Pa") if test.kind == "relaxation" else ("strain", "")
    return [
        f"the {what} is {here:.3g}{unit} at {test.time[k]:.3g} s, before the load. This is "
        f"{100 * abs(here) / size:.2g} % of the largest {what} (absolute value). If this is an offset of the sensor, "
        f"all moduli are wrong: subtract this {what} from all rows, or give {RESTING + 1} or more rows at rest"
    ]


def _checked(test: TimeTest, start: float) -> TimeTest:
    if not np.max(np.abs(test.driven)) > 0:
        word = "strain" if test.kind == "relaxation" else "stress"
        raise InputError(f"{test.source}: the {word} is zero throughout; give a {test.kind} test with a load")
    sign = np.sign(test.driven[np.argmax(np.abs(test.driven))])
    recorded = test.answer
    test, told = _without_base_line(test)
    driven, answer = sign * test.driven, sign * test.answer
    used = test.used & np.isfinite(answer) & (test.time >= start) & (test.time > test.begun)
    if used.sum() < 4:
        raise InputError(
            f"{test.source}: {used.sum()} usable responses remain; give four or more, or a smaller --min-time"
        )
    if not np.sum(driven[used] * answer[used]) > 0:
        raise InputError(
            f"{test.source}: most responses of the {test.kind} test have the wrong sign for its load; correct the signs"
        )
    if 0 < start <= test.begun:
        told = [*told, f"--min-time {start:g} s has no effect, because the load begins at {test.begun:.3g} s"]
    if np.sum(test.time <= test.begun) > 2:
        told = [*told, f"the load begins at {test.begun:.3g} s: the rows before it are not fitted"]
    told = [*told, *told_of_far_values(test.time[used], driven[used], answer[used])]
    test = test._replace(rounding=rounding_of_series(recorded[used]), notes=(*test.notes, *told))
    return test._replace(driven=driven, answer=answer, used=used)
