"""Relaxation and creep tests from files: the time with a modulus, a compliance, strain and stress, or another pair of
columns."""

import os
from typing import NamedTuple

import numpy as np

from fitting.readers.noise_of_series import noise_of_series
from fitting.readers.scattering_load import without_scatter
from fitting.readers.tables.time_columns import FORMS, beyond_small, read_columns
from liverjax.core.errors import InputError

#: A load below this part of the largest load counts as rest: its effect on the answers is just as small.
AT_REST = 0.01

#: Lower bound of the scales: the noise divided by RELATIVE. In a cyclic test, the bound is at least the part CYCLIC of
#: the largest answer.
RELATIVE, CYCLIC = 0.03, 0.1

#: What is known of changes of the load that no row shows: nothing, so it is straight between rows; nothing, and a row
#: at 0 s was added before a first row under load; or how long they took.
BETWEEN_ROWS, BEFORE_ROWS, GIVEN = "between rows", "before the rows", "given"


class TimeTest(NamedTuple):
    """A relaxation or creep test in SI units, as quantities of shear."""

    kind: str  # relaxation or creep
    time: np.ndarray  # (n,) [s], ascending
    driven: np.ndarray  # (n,) imposed strain; in creep the imposed stress [Pa]
    answer: np.ndarray  # (n,) measured response: stress [Pa]; in creep the strain
    used: np.ndarray  # (n,) whether the answer of a row is fitted
    source: str = ""
    notes: tuple[str, ...] = ()
    constant_noise: bool = False  # whether the noise of all answers has the same size
    rise: str = BETWEEN_ROWS  # what is known of changes of the load that no row shows
    described: bool = False  # whether a description in TOML names the file

    @property
    def scales(self) -> np.ndarray:
        """Scales of the residuals: the size of each answer, with a lower bound for answers that are lost in noise.
        If the noise is constant, all scales are the median of these.
        """
        sizes = self._sizes_of_answers()
        return np.full(len(sizes), np.median(sizes)) if self.constant_noise else sizes

    def _sizes_of_answers(self) -> np.ndarray:
        answer = self.answer[self.used]
        floor = max(noise_of_series(answer) / RELATIVE, CYCLIC * float(np.max(np.abs(answer))) if self.cyclic else 0.0)
        return np.hypot(answer, floor)

    @property
    def cyclic(self) -> bool:
        """Whether the driven quantity falls by more than half of its largest value and rises again. Then the answers
        pass 0."""
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
        while first > 0 and driven[first] - driven[first - 1] > 1e-6 * driven.max():  # back to where the rise begins
            first -= 1
        return float(self.time[first])

    @property
    def jumps(self) -> np.ndarray:
        """Numbers (j,) of the rows at the ends of jumps of the load, if nobody has said how long they took."""
        if self.rise == GIVEN:
            return np.zeros(0, int)
        shown = np.flatnonzero(np.isfinite(self.answer))  # rows without an answer may have been added between others
        return shown[_rows_of_jumps(self.driven[shown])]

    @property
    def answers_at_once(self) -> bool:
        """Whether an answer at the moment of a step is used. It tells G0, but resolves no time."""
        first, second = self.time[self.used][:2] - self.begun
        return bool(first < AT_ONCE * second)

    @property
    def resolved(self) -> tuple[float, float]:
        """Shortest and longest relaxation time [s] that the test resolves: the times of the first and the last used
        answer after the load began."""
        time = self.time[self.used] - self.begun
        return float(time[int(self.answers_at_once)]), float(time[-1])


class Sample(NamedTuple):
    """Size of the sample [m], needed if the columns are torque or force."""

    radius: float | None = None
    height: float | None = None


def read_time_test(
    path: str | os.PathLike, kind: str, sample: Sample = Sample(), ramp: float | None = None, start: float = 0.0
) -> TimeTest:
    """Read a test.

    Args:
        path: a file with a header that names the time and one of `FORMS`.
        kind: "relaxation" or "creep".
        sample: radius and height of a cylinder, for torque and force.
        ramp: for a column of modulus or compliance: duration [s] of the ramp of strain or stress; 0 (or None) for a
            step. For two columns: None; or the seconds of a rise that no row shows (see `from_rest`), 0 for a step.
        start: answers before this time [s] are not fitted.

    Raises:
        InputError: one sentence with the file, the column or line, the value and the remedy.
    """
    if not (np.isfinite(start) and start >= 0):
        raise InputError(f"--min-time {start:g} cannot be seconds after the load: give 0 or more")
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
                "SECONDS, with times that count from its beginning: otherwise G0 is too large, or too small if the "
                "times count from its end"
            )
    else:
        strain, stress, told = _as_shear(str(path), form, columns, sample)
        notes += told
        notes += _of_the_other_kind(kind, time, strain, stress)
        driven, answer = (strain, stress) if kind == "relaxation" else (stress, strain)
        rows = from_rest(time, driven, answer, ramp, (str(path), "--ramp"))
        test = of_columns(kind, *rows[:3], (str(path), [*notes, *rows[3]]), start)
        return with_known_rise(test, time, driven, ramp)
    test = TimeTest(kind, time, driven, answer, time > 0, str(path), tuple(notes))
    return _checked(test._replace(rise=GIVEN), start)


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
        driven, answer: (n,) strain and stress [Pa]; in creep, stress [Pa] and strain.
        source: name of the file, and notes.
        start: answers before this time [s] are not fitted.

    Raises:
        InputError: the driven quantity is zero, there are too few answers, or most answers have the opposite sign.
    """
    driven, told = without_scatter(time, driven, "strain" if kind == "relaxation" else "stress")
    told += _ringing(time, driven, answer, start) if kind == "creep" else []
    return _checked(TimeTest(kind, time, driven, answer, time > 0, source[0], (*source[1], *told)), start)


#: A note on rows that begin at 0 s under load.
BEGINS_LOADED = (
    "the first row, at 0 s, is under load already: a step from rest at 0 s is assumed. If the load rose before it, or "
    "the sample was loaded before, give those rows too: what relaxed until then is missing from G0 otherwise. If it "
    "was held under an earlier load until its stress was steady, take that strain and that stress off all rows. If it "
    "was a step, ramp = 0 in a description, or (relaxation and creep alone) --ramp 0, says so"
)


def from_rest(
    time: np.ndarray, driven: np.ndarray, answer: np.ndarray, ramp: float | None, names: tuple[str, str]
) -> tuple[np.ndarray, np.ndarray, np.ndarray, list[str]]:
    """The rows (n,), with an added row at 0 s if they begin later, and added rows if `ramp` is given; and notes.

    Args:
        time, driven, answer: (n,), see `of_columns`.
        ramp: None: the load is straight between rows. If the rows begin under load, 0: it acted from 0 s on. Where the
            load changes between two rows alone: seconds of this change until the later row; 0 for a step.
        names: name of the file, and name of `ramp`, for messages.

    Raises:
        InputError: the rows show how the load rose, or it rose in less time.
    """
    size, rows = np.abs(driven), _rows_of_jumps(driven)
    loaded = size[0] > AT_REST * np.max(size)
    at_once = ramp == 0 and loaded
    if ramp is not None and not at_once and not (len(rows) and 0 <= ramp <= time[rows[0]] - time[rows[0] - 1]):
        shown = "the rows show how the load rose"
        if len(rows):
            shown = f"the load rose between {time[rows[0] - 1]:.4g} and {time[rows[0]]:.4g} s"
        elif loaded:
            shown = "the rows begin under load, and only 0 (a step at 0 s) is possible there"
        raise InputError(f"{names[0]}: {names[1]} {ramp:g} cannot be right, since {shown}: leave it out")
    if ramp is not None:
        time, driven, answer = _rows_before_jumps(rows, ramp, time, driven, answer)
    if not time[0] > 0:
        return time, driven, answer, [BEGINS_LOADED] if loaded and not at_once else []
    first, notes = driven[0] if at_once else 0.0, []
    if not at_once and loaded:
        notes.append(
            f"the rows begin at {time[0]:.3g} s under load: a linear ramp from 0 s on is assumed. If it was a step at "
            "0 s, put a row with this load at 0 s, or (relaxation and creep alone) say --ramp 0 (in a description: "
            "ramp = 0)"
        )
    return np.append(0.0, time), np.append(first, driven), np.append(0.0, answer), notes


def with_known_rise(test: TimeTest, time: np.ndarray, driven: np.ndarray, ramp: float | None) -> TimeTest:
    """The test with what is known of its `rise`, from the times and driven values (n,) of its file.

    Answers in rows that `from_rest` has added are not fitted.
    """
    test = test._replace(used=test.used & np.isin(test.time, time))
    if ramp is not None:
        return test._replace(rise=GIVEN)
    loaded = time[0] > 0 and abs(driven[0]) > AT_REST * np.max(np.abs(driven))
    before = loaded and len(test.jumps) > 0 and test.time[test.jumps[0]] == time[0]
    return test._replace(rise=BEFORE_ROWS) if before else test


#: A load jumps if it changes between two rows by more than this part of its largest value, and if the changes before
#: and after are below the second part of this change.
_JUMP, _COMPLETE = 0.05, 0.5
#: A step takes this part of the time between two rows. Such a short time resolves no relaxation time.
AT_ONCE = 1e-4


def _rows_of_jumps(driven: np.ndarray) -> np.ndarray:
    """Numbers (j,) of the rows at the ends of jumps: no row shows how the load changed there."""
    change = np.abs(np.diff(driven, prepend=driven[0], append=driven[-1]))
    before, own, after = change[:-2], change[1:-1], change[2:]
    least = _JUMP * np.max(np.abs(driven))
    return 1 + np.flatnonzero((own > least) & (np.maximum(before, after) < _COMPLETE * own))


def _rows_before_jumps(rows: np.ndarray, ramp: float, time: np.ndarray, *columns: np.ndarray) -> tuple:
    """The columns with a row before each jump that has the values of the earlier row, `ramp` [s] before the later
    row."""
    interval = time[rows] - time[rows - 1]
    after = np.append(np.diff(time), np.inf)[rows]
    before = time[rows] - np.clip(ramp, 0.1 * AT_ONCE * np.minimum(interval, after), interval)
    new = before > time[rows - 1]
    return tuple(
        np.insert(values, rows[new], added[new])
        for values, added in ((time, before), *((c, c[rows - 1]) for c in columns))
    )


def with_steps(test: TimeTest) -> TimeTest:
    """The test whose load has steps at the later rows of its jumps (`TimeTest.jumps`).

    If the rows begin under load, the step is at 0 s.
    """
    driven, jumps = test.driven.copy(), test.jumps
    if test.rise == BEFORE_ROWS:
        driven[: jumps[0]] = driven[jumps[0]]
        jumps = jumps[1:]
    shown = np.flatnonzero(np.isfinite(test.answer))
    for row in jumps:
        last = shown[np.searchsorted(shown, row) - 1]
        driven[last + 1 : row] = driven[last]
    time, driven, answer = _rows_before_jumps(jumps, 0.0, test.time, driven, test.answer)
    used = np.isin(time, test.time[test.used])
    return test._replace(time=time, driven=driven, answer=answer, used=used)


def kind_of(path: str | os.PathLike) -> str:
    """ "relaxation" or "creep". A column of modulus or compliance decides. Otherwise the column that changes less in
    the second half is the driven quantity."""
    columns, _ = read_columns(path)
    form = next((f for f in FORMS if set(f) <= set(columns)), ("modulus",))
    if len(form) == 1:
        return "relaxation" if form == ("modulus",) else "creep"
    late = len(columns["time"]) // 2
    moves = [np.ptp(columns[q][late:]) / max(float(np.max(np.abs(columns[q]))), 1e-300) for q in form]
    return "relaxation" if moves[0] <= moves[1] else "creep"


def _of_the_other_kind(kind: str, time: np.ndarray, strain: np.ndarray, stress: np.ndarray) -> list[str]:
    """A note if, in the second half, the quantity that this kind of test imposes changes while the other quantity is
    held.

    No note if it changes at a constant rate: this also happens if a sample is strained until its stress is steady.
    """
    driven, answer = (strain, stress) if kind == "relaxation" else (stress, strain)
    late = len(driven) // 2
    moves, held = (np.std(v[late:]) / max(float(np.max(np.abs(v))), 1e-300) for v in (driven, answer))
    if not (held < HELD and moves > 3 * held and moves > HELD):
        return []
    bent = driven[late:] - np.polyval(np.polyfit(time[late:], driven[late:], 1), time[late:])
    if np.std(bent) < STEADY * np.std(driven[late:]):
        return []
    names = ("stress", "strain", "creep") if kind == "relaxation" else ("strain", "stress", "relaxation")
    return [
        f"the {names[0]} is held and the {names[1]} changes, as in a {names[2]} test, so python -m fitting {names[2]} "
        f"is the right command: this command takes the {names[1]} as exact, although it has noise"
    ]


#: A quantity is held if its relative standard deviation in the second half is below this [1].
HELD = 0.01
#: A quantity changes at a constant rate if its distance from a straight line is below this part of its change (standard
#: deviations).
STEADY = 0.05


def _own_table(kind: str) -> str:
    return "modulus" if kind == "relaxation" else "compliance"


def _as_a_step(path, time, modulus, ramp):
    """Times, a driven strain (or stress) that reaches 1 at once or by a ramp, and answers."""
    if not (np.isfinite(ramp) and ramp >= 0):
        raise InputError(f"{path}: --ramp {ramp:g} cannot be the seconds of a ramp; give 0 or more")
    if ramp > time[-1]:
        raise InputError(f"{path}: --ramp {ramp:g} ends after the last row at {time[-1]:g} s; give its seconds")
    kept = time > 0
    times = np.unique(np.concatenate([[0.0], time[kept], [ramp] if ramp else []]))
    answer = np.full(len(times), np.nan)
    answer[np.searchsorted(times, time[kept])] = modulus[kept]
    return times, np.minimum(times / ramp, 1.0) if ramp else np.ones(len(times)), answer


#: A modulus or compliance may change in the wrong direction by this part of its largest value, or by this many standard
#: deviations of its noise.
_WRONG_WAY, _IN_NOISE = 0.25, 6.0


def _another_course(path: str, kind: str, time: np.ndarray, values: np.ndarray, given: tuple) -> list[str]:
    """Refuse a modulus that rises, or a compliance that falls, under a constant load. `given`: ramp [s] and start [s].

    A running median removes single wrong rows. Returns notes.

    Raises:
        InputError: one sentence with the time and possible causes.
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


def _ringing(time: np.ndarray, stress: np.ndarray, strain: np.ndarray, start: float) -> list[str]:
    """A note if the strain falls and rises again under a constant stress: then the inertia of the instrument causes
    oscillations."""
    from scipy.ndimage import median_filter

    largest = float(stress[np.argmax(np.abs(stress))])
    held = (stress * np.sign(largest) > (1 - HELD) * abs(largest)) & (time >= start)
    first = int(np.argmax(held))
    length = int(np.argmin(np.append(held[first:], False)))
    t, v = time[first : first + length], np.abs(strain[first : first + length])
    if len(t) < 8:
        return []
    noise, v = noise_of_series(v), median_filter(v, size=3, mode="nearest")
    falls = np.maximum.accumulate(v) - v
    allowed = max(_RINGS * float(v.max()), _IN_NOISE * noise)
    if not falls.max() > allowed:
        return []
    worst = int(np.argmax(falls))
    rises = float(v[worst:].max() - v[worst])
    if not rises > allowed:
        return []
    return [
        f"the strain falls by {100 * falls[worst] / v.max():.2g} % until {t[worst]:.3g} s under a constant stress, and "
        "rises again: the inertia of the instrument rings, and no creep does; leave these rows out (--min-time)"
    ]


#: The strain oscillates if it falls, and rises again, by more than this part of the largest strain.
_RINGS = 0.02


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
    strain = columns["displacement"] / h
    return strain, columns["force"] / (3 * np.pi * r**2), [note, *beyond_small(float(np.nanmax(np.abs(strain))))]


#: Minimum number of rows at rest that show an offset; and the part of the largest answer below which an offset does
#: not matter.
RESTING, OFFSET = 3, 0.003


def _without_offset(test: TimeTest) -> tuple[np.ndarray, list[str]]:
    """The answers, and a note. If the mean before the load clearly exceeds its error, this mean is subtracted from all
    answers."""
    rest = np.isfinite(test.answer) & (test.time < test.begun) & ~((test.time == 0) & (test.answer == 0))
    count, size = int(rest.sum()), float(np.nanmax(np.abs(test.answer)))
    if count < RESTING:
        return test.answer, _of_one_row_at_rest(test, size)
    mean, error = float(np.mean(test.answer[rest])), float(np.std(test.answer[rest], ddof=1)) / np.sqrt(count)
    if not abs(mean) > max(3 * error, OFFSET * size):
        return test.answer, []
    what, unit = ("stress", " Pa") if test.kind == "relaxation" else ("strain", "")
    return test.answer - mean, [
        f"the {what} of the {count} rows before the load is {mean:.3g}{unit} on average, "
        f"{100 * abs(mean) / size:.2g} % of the largest: it is taken off all rows, as an offset of the sensor"
    ]


def _of_one_row_at_rest(test: TimeTest, size: float) -> list[str]:
    """A note if the answer at the begin of the load is not 0. One or two rows cannot distinguish an offset from
    noise."""
    k = int(np.argmax(test.time >= test.begun))
    here, load = float(test.answer[k]), abs(float(test.driven[k])) / float(np.max(np.abs(test.driven)))
    noise = noise_of_series(test.answer[np.isfinite(test.answer) & (test.time > test.begun)])
    # In a steady cycle, the first answer is not 0, because the response lags behind.
    if test.cyclic or load > AT_REST or not abs(here) > max(_IN_NOISE * noise, (OFFSET + 2 * load) * size):
        return []
    what, unit = ("stress", " Pa") if test.kind == "relaxation" else ("strain", "")
    return [
        f"the {what} is {here:.3g}{unit} at {test.time[k]:.3g} s, before the load, {100 * abs(here) / size:.2g} % of "
        "the largest: if this is an offset of the sensor, it changes all moduli: subtract it from all rows, or give "
        f"{RESTING} or more rows before the load"
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
            f"{test.source}: most answers of the {test.kind} test have the wrong sign for its load; correct the signs"
        )
    notes = (*test.notes, *told)
    if np.sum(test.time <= test.begun) > 2:
        notes = (*notes, f"the load begins at {test.begun:.3g} s: the rows before it are not fitted")
    return test._replace(driven=driven, answer=answer, used=used, notes=notes)
