"""Read stress-stretch curves of incompressible samples: tension, compression, shear, equibiaxial and pure shear."""

import itertools
import re
from pathlib import Path
from typing import NamedTuple

import numpy as np

from fitting.readers.noise_of_series import off_the_line
from fitting.readers.tables.text_tables import (
    EMPTY,
    decimal_sign,
    find_delimiter,
    is_summary,
    split_cells,
    summary_rows,
    text_of,
    to_number,
    without_comments,
    without_multiples,
)
from fitting.readers.units import STRESS_UNITS
from liverjax.core.errors import InputError
from liverjax.laws import homogeneous

#: Last words of headings that name standard deviations or errors.
_SPREAD = re.compile(r"(?i)(^|[ _])(sd|std|stdev|se|sem|error|deviation)([ _]?[\[(].*|[ _][km]?Pa)?$")
_INDICES = [f"{i}{j}" for i in (1, 2, 3) for j in (1, 2, 3)]


class Curve(NamedTuple):
    """A measured stress-stretch curve with n points: one component of the stress in one test of one sample."""

    label: str
    test: str  # uniaxial, equibiaxial, pure_shear, simple_shear or general
    F: np.ndarray  # (n, 3, 3) deformation gradient, det F = 1; face 3 is free of stress
    component: tuple[int, int]  # indices of the measured component of the nominal stress, from 0
    stress: np.ndarray  # (n,) [Pa]
    returns: int = 0  # number of reversals after which the deformation repeats earlier values
    sample: str = ""  # name of the sample, the same for all components of one test; if empty, `label`
    law_scale: float | None = None  # [Pa] root mean square of the stress of a fitted law; None: no law is fitted
    file: str = ""  # path of the file; all tests of a file may belong to one sample

    @property
    def driven(self) -> np.ndarray:
        """Component (n,) of F on which the measured stress does work. If this component is constant, F12 is used. If
        F12 is constant too, F11 is used."""
        own, shear = self.F[:, *self.component], self.F[:, 0, 1]
        return own if np.ptp(own) > 0 else shear if np.ptp(shear) > 0 else self.F[:, 0, 0]

    @property
    def rises(self) -> bool:
        """Whether the stress of a stable material must rise with `driven`. It is False in a general test. It is also
        False if the component of F that belongs to the measured stress is constant."""
        return self.test != "general" and np.ptp(self.F[:, *self.component]) > 0

    @property
    def divisor(self) -> float:
        """Divisor [Pa] of the residuals: the root mean square of the law's stress if it is known, or else `scale`."""
        return self.scale if self.law_scale is None else self.law_scale

    @property
    def scale(self) -> float:
        """Root mean square of the stress [Pa], the scale of relative errors."""
        return float(np.sqrt(np.mean(self.stress**2)))


#: det F may differ from 1 by this much, because the digits of F in a file are rounded.
_SAME_VOLUME = 1e-3


def check_curves(curves: list[Curve]) -> None:
    """Check the values of curves that were made in Python. The file reader has separate checks, whose messages name
    file and row.

    Raises:
        InputError: there is no curve; a shape is wrong; a value is not finite; the volume changes; or face 3 tilts.
    """
    if not curves:
        raise InputError("there are no curves: give one curve or more")
    for c in curves:
        F, stress = np.asarray(c.F), np.asarray(c.stress)
        if F.shape != (*stress.shape, 3, 3) or stress.ndim != 1 or not len(stress):
            raise InputError(f"{c.label}: F has shape {F.shape} and stress {stress.shape}: give (n, 3, 3) and (n,)")
        if not (np.all(np.isfinite(F)) and np.all(np.isfinite(stress))):
            raise InputError(f"{c.label}: F or stress is not finite; remove these points")
        off = np.abs(np.linalg.det(F) - 1)
        if off.max() > _SAME_VOLUME:
            raise InputError(
                f"{c.label}: det F = {np.linalg.det(F)[off.argmax()]:.4g} at point {off.argmax()}, but the volume must "
                "not change; give gradients with det F = 1"
            )
        if np.abs(F[:, [0, 1, 2, 2], [2, 2, 0, 1]]).max() > 1e-9:
            raise InputError(f"{c.label}: F13, F23, F31, F32 must be 0; rotate the axes so that face 3 stays flat")


def read_curves(files: list[Path], unit: str = "Pa") -> tuple[list[Curve], list[str]]:
    """Read the stress-stretch curves of CSV files. Return the curves, and notes for the user.

    A file has one of two forms. In both forms, `#` begins a comment. In the first form, the columns are F11 … F33 and
    P11 … P33 (deformation gradient and nominal stress). In this form, a stress that is zero in all rows counts as not
    measured. In the second form, the columns are `test`, `stretch`, `shear` and `nominal_stress_kPa`, and `test` is one
    of uniaxial, equibiaxial, pure_shear, simple_shear. The name of a stress column may end in _Pa, _kPa or _MPa.
    Otherwise the stress is in `unit`.

    Raises:
        InputError: the file or a column does not exist, a value is not a number, the volume changes, or there are too
            few points.
    """
    curves, notes = [], []
    for file in files:
        rows, summaries = _rows_of_curves(file)
        notes += [
            f"{file.name}: data row {k} is a summary of other rows ({own}) and is ignored" for k, own in summaries
        ]
        rows, left_out = _measured_rows(file, rows)
        notes += [f"{file.name}: {left_out} rows without a stress are ignored"] if left_out else []
        rows, left_out = _rows_without_copies(rows)
        notes += (
            [f"{file.name}: {left_out} rows are ignored, because they are copies of other rows"] if left_out else []
        )
        spreads = [name for name in rows[0] if _SPREAD.search(name)]
        if spreads:
            notes.append(
                f"{file.name}: {', '.join(spreads)} {'is' if len(spreads) == 1 else 'are'} not used, because the noise "
                "is estimated from the residuals"
            )
        found, named = _components(file, rows, unit) if "F11" in rows[0] else _named_tests(file, rows, unit)
        curves += found
        if not named:
            notes.append(
                f"{file.name}: the stress column names no unit; {unit} is assumed (to change this, give --unit Pa, kPa "
                "or MPa)"
            )
    notes += [note for curve in curves for note in _of_faults(curve)]
    for curve in (c for c in curves if c.returns):
        times = "once" if curve.returns == 1 else f"{curve.returns} times"
        notes.append(
            f"{curve.label}: the deformation reverses {times} (unloading, cycles or several samples). All rows are "
            "fitted as one curve, and the errors do not contain the differences between its parts; keep one part, or "
            "write each part into a separate file"
        )
    seen: dict[str, int] = {}
    for k, curve in enumerate(curves):
        seen[curve.label] = seen.get(curve.label, 0) + 1
        if seen[curve.label] > 1:
            curves[k] = curve._replace(label=f"{curve.label} ({seen[curve.label]})")
    return curves, notes


def _of_faults(curve: Curve) -> list[str]:
    return [
        f"{curve.label}: the stress {curve.stress[k]:.4g} Pa at {curve.driven[k]:.4g} is far from its neighbours "
        f"{curve.stress[k - 1]:.4g} and {curve.stress[k + 1]:.4g} Pa: if this value is a fault, remove this row"
        for k in off_the_line(curve.stress)
    ]


#: Headings of a column of strains.
_STRAIN = re.compile(r"(?i)strain([ _]*[\[(]?(%|percent|-|1|mm/mm)[\])]?)?$")
#: Headings of columns that are read.
_USED = re.compile(r"(?i)(F|P)[1-3]{2}|(test|stretch|shear)$|nominal_stress")


def _rows_of_curves(file: Path) -> tuple[list[dict[str, str]], list[tuple[int, str]]]:
    """Return the measured rows of a file. Also return numbers and labels of excluded rows such as "Mean"."""
    text = text_of(file, "curves")
    lines = [line for line in text.splitlines() if line.strip() and not line.lstrip().startswith("#")]
    cells = [[c.strip('" ') for c in split_cells(line, _delimiter_of_curves(line))] for line in lines]
    first = next((k for k, names in enumerate(cells) if _names_curves(names)), 0)
    end = next((k for k in range(first, len(cells)) if cells[k][:1] == ["[step]"]), len(cells))  # the next sheet begins
    if end < first + 2:
        raise InputError(f"{file} contains no rows: give a CSV file of curves")
    names, between = _documented(cells[first]), _delimiter_of_curves(lines[first])
    twice = [name for name in names if names.count(name) > 1 and _USED.match(name)]
    if twice:
        raise InputError(f"{file} has two columns {twice[0]}: remove one of them")
    read = [name != "test" and bool(_USED.match(name)) for name in names]
    every = [without_comments(own, read) for own in cells[first + 1 : end]]
    tests = [k for k, name in enumerate(names) if name == "test"]  # cells of this column are never numbers
    labelled = [[cell for k, cell in enumerate(own) if k not in tests or is_summary(cell)] for own in every]
    summaries = summary_rows(labelled)
    rows = [_row_under(names, own, file) for k, own in enumerate(every) if k not in summaries]
    if between != ",":  # then numbers may have a decimal comma
        sign = decimal_sign(cell for row in rows for cell in row.values())
        rows = [{k: _with_point(v, between, sign) for k, v in row.items()} for row in rows]
    rows = [dict.fromkeys(names, "") | row | {"row": str(k)} for k, row in enumerate(rows, 1) if any(row.values())]
    if not rows:
        raise InputError(f"{file} contains no rows: give a CSV file of curves")
    if not _names_curves(names):
        raise InputError(
            f"{file} has columns {', '.join(names)[:100]}: give F11 … F33, P11 … P33, "
            f"or test, stretch, shear, nominal_stress_kPa{_of_strains(names)}"
        )
    return rows, [(k + 1, own) for k, own in summaries.items()]


def _measured_rows(file: Path, rows: list[dict[str, str]]) -> tuple[list[dict[str, str]], int]:
    """Return the rows with a measured nominal stress, and the number of rows without it. If no row has a nominal
    stress, return all rows and 0."""
    column = _stress_column(file, rows[0], "nominal_stress", "Pa")
    kept = rows if column is None else [row for row in rows if row[column[0]].lower() not in EMPTY]
    return (kept, len(rows) - len(kept)) if kept else (rows, 0)


def _rows_without_copies(rows: list[dict[str, str]]) -> tuple[list[dict[str, str]], int]:
    """Return the rows without copies, and the number of copies. The rows of a test contain copies only if every row of
    this test was written several times, with the same text in all cells."""
    groups: dict[str, list[dict[str, str]]] = {}
    for row in rows:
        groups.setdefault(row.get("test", ""), []).append(row)
    kept: set[str] = set()
    for own in groups.values():
        cells = [tuple(cell for name, cell in row.items() if name != "row") for row in own]
        kept |= {own[k]["row"] for k in without_multiples(cells)}
    return [row for row in rows if row["row"] in kept], len(rows) - len(kept)


def _row_under(names: list[str], cells: list[str], file: Path) -> dict[str, str]:
    if any(re.match(r"[-+]?\.?\d", cell) for cell in cells[len(names) :]):
        raise InputError(
            f"{file}: there are {len(cells)} cells under {len(names)} headings in {','.join(cells)[:60]!r}; write "
            "decimals with a point, and give every column a heading"
        )
    return dict(zip(names, cells, strict=False))  # cells may be missing at the end, and remarks may follow the cells


def _delimiter_of_curves(line: str) -> str:
    found = find_delimiter(line)
    return found if found in ";\t" else ","


def _documented(headings: list[str]) -> list[str]:
    """Return the headings in their documented spelling, unless this would make two headings equal."""
    plain = [_folded(name) for name in headings]
    return [own if own == name or plain.count(own) == 1 else name for name, own in zip(headings, plain, strict=True)]


def _folded(name: str) -> str:
    """Return a heading in its documented spelling: in small letters, and without the unit [-]."""
    plain = re.sub(r"\s*[\[(][-1][\])]$", "", name)
    if plain.lower() in ("test", "stretch", "shear"):
        return plain.lower()
    return re.sub(r"(?i)^nominal[ _]stress", "nominal_stress", name)


def _names_curves(headings: list[str]) -> bool:
    names = _documented(headings)
    return "F11" in names or ("test" in names and bool({"stretch", "shear"} & set(names)))


def _of_strains(headings: list[str]) -> str:
    """Return the end of a message: how to convert a column of strains to stretches; empty if there is no such
    column."""
    strain = next((name for name in headings if _STRAIN.match(name)), None)
    if strain is None:
        return ""
    return f"; for the column {strain}: stretch = 1 + strain (1.02 for 2 %), and in simple shear, shear = strain"


def _with_point(cell: str, between: str, sign: str | None) -> str:
    """Return a cell with a number in Python's notation. Any other cell is returned unchanged."""
    value = to_number(cell, between, sign) if cell else None
    return cell if value is None else repr(value)


def _column(file: Path, rows: list[dict], name: str, default: float | None = None) -> np.ndarray:
    values = []
    if name not in rows[0] and default is None:
        headings = [key for key in rows[0] if key != "row"]
        of_strains = _of_strains(headings) if name == "stretch" else ""
        raise InputError(
            f"{file} has no column {name}, only {', '.join(headings)}: add this column, without a unit{of_strains}"
        )
    for row in rows:
        text = row.get(name, "")
        if not text and default is not None:
            values.append(default)
            continue
        try:
            values.append(float(text))
        except ValueError:
            where = f"{file}, data row {row['row']}"
            raise InputError(f"{where}: {name} = {text[:40]!r} is not a number; give a number") from None
        if not np.isfinite(values[-1]):
            raise InputError(f"{file}, data row {row['row']}: {name} = {text} is not finite; remove this row")
    return np.array(values)


def _stress_column(file: Path, row: dict, pattern: str, unit: str) -> tuple[str, float, bool] | None:
    """Return the name of the stress column, its factor to Pa, and whether its heading names the unit. Returns None if
    there is no such column.

    Raises:
        InputError: there are two such columns.
    """
    named = [(name, re.fullmatch(pattern + r"(?:[_ ]*[\[(]?(Pa|kPa|MPa)[\])]?)?", name)) for name in row]
    found = [(name, match[1]) for name, match in named if match]
    if len(found) > 1:
        raise InputError(f"{file} has two columns of one stress, {found[0][0]} and {found[1][0]}: remove one of them")
    return (found[0][0], STRESS_UNITS[found[0][1] or unit], found[0][1] is not None) if found else None


#: A stress component below this fraction of the largest component counts as not measured. Programs write roundoff
#: instead of 0, some of them in single precision.
ROUNDOFF = 1e-5


def _components(file: Path, rows: list[dict], unit: str) -> tuple[list[Curve], bool]:
    missing = [f"F{k}{k}" for k in (1, 2, 3) if f"F{k}{k}" not in rows[0]]
    if missing:
        raise InputError(
            f"{file} has no column {', '.join(missing)}: give F11, F22 and F33, and the shears that are not 0"
        )
    # A shear component without a column counts as 0.
    given = {ij: None if f"F{ij}" in rows[0] else 0.0 for ij in _INDICES}
    F = np.stack([_column(file, rows, f"F{ij}", zero) for ij, zero in given.items()], axis=1).reshape(-1, 3, 3)
    measured, stated = {}, {}
    for ij in _INDICES:
        column = _stress_column(file, rows[0], f"P{ij}", unit)
        if column is None:
            continue
        measured[int(ij[0]) - 1, int(ij[1]) - 1] = column[1] * _column(file, rows, column[0])
        stated[int(ij[0]) - 1, int(ij[1]) - 1] = column[2]
    largest = max((np.abs(values).max() for values in measured.values()), default=0.0)
    measured = {at: values for at, values in measured.items() if np.abs(values).max() > ROUNDOFF * largest}
    named = all(stated[at] for at in measured)
    if not measured:
        raise InputError(f"{file}: all stresses P11 … P33 are zero or missing; give the measured components")
    if any(2 in ij for ij in measured):
        raise InputError(f"{file}: P13 … P33 are not 0; rotate the axes so that face 3 is free of stress")
    if np.abs(F[:, [0, 1, 2, 2], [2, 2, 0, 1]]).max() > 1e-9:
        raise InputError(f"{file}: F13, F23, F31, F32 must be 0; rotate the axes so that face 3 stays flat")
    if (1, 1) in measured and (0, 0) in measured and np.allclose(measured[0, 0], measured[1, 1], rtol=1e-6):
        del measured[1, 1]  # P11 and P22 are the same measurement, written twice
    kind = _kind(F)
    several = len(measured) > 1
    return [
        _one_curve(file, f"{file.stem}{f', P{i + 1}{j + 1}' if several else ''}", kind, F, (i, j), values)._replace(
            sample=str(file)
        )
        for (i, j), values in measured.items()
    ], named


def _kind(F: np.ndarray) -> str:
    a, b, c = F[:, 0, 0], F[:, 1, 1], F[:, 2, 2]
    if np.any(F[:, 1, 0] != 0):
        return "general"
    if np.any(F[:, 0, 1] != 0):
        return "simple_shear"
    for name, one, two in (("uniaxial", b, c), ("equibiaxial", a, b), ("pure_shear", b, np.ones_like(b))):
        if np.allclose(one, two, rtol=1e-3):
            return name
    return "general"


#: If all stretches of a test are at or above this value, the column probably contains strains in %, because a test
#: begins near rest (stretch 1).
STRAINED = 1.9
#: A shear above this value is probably in %.
SHEARED = 3.0
#: The column probably contains strains in % also if a test has a stretch above `STRAINED` and a stretch below this
#: value, with stresses of the same sign.
SHORTENED = 0.9


def _named_tests(file: Path, rows: list[dict], unit: str) -> tuple[list[Curve], bool]:
    column = _stress_column(file, rows[0], "nominal_stress", unit)
    if column is None:
        raise InputError(f"{file} has no column nominal_stress_Pa (or _kPa, _MPa): rename the column of the stress")
    groups: dict[tuple, list[dict]] = {}
    at = _stretches_of_shear(rows)
    for row in rows:
        test = row["test"]
        if test not in homogeneous.TESTS:
            raise InputError(f"{file}: test {test!r} is not known; use one of {', '.join(homogeneous.TESTS)}")
        groups.setdefault((test, at.get(_stretch_of_shear(row), "") if test == "simple_shear" else ""), []).append(row)
    curves, factor = [], column[1]
    for (test, fixed), group in groups.items():
        shear = homogeneous.TESTS[test] == "shear"
        stretch = _column(file, group, "stretch", 1.0 if shear else None)
        driven = _column(file, group, "shear") if shear else stretch
        if shear and np.abs(driven).max() > SHEARED:
            raise InputError(
                f"{file}: a shear of {driven[np.argmax(np.abs(driven))]:g} is too large. A shear is the displacement "
                "divided by the height; write a shear of 2 % as 0.02"
            )
        if np.any(stretch <= 0):
            raise InputError(
                f"{file}: a stretch of {stretch.min():g} is not possible; give the length divided by the length at rest"
            )
        if not shear and stretch.min() >= STRAINED:
            raise InputError(
                f"{file}: stretches of {stretch.min():g} to {stretch.max():g} do not begin near 1. A stretch is the "
                "length divided by the length at rest; write a strain of 2 % as 1.02"
            )
        stress = factor * _column(file, group, column[0])
        ends = stress[[int(np.argmin(stretch)), int(np.argmax(stretch))]]
        of_one_sign = np.prod(np.sign(ends)) >= 0
        if not shear and stretch.min() < SHORTENED and stretch.max() > STRAINED and of_one_sign:
            raise InputError(
                f"{file}: stretches of {stretch.min():g} and {stretch.max():g} do not have opposite stresses, although "
                "one is below 1. A stretch is the length divided by the length at rest; write 1.02 for a strain of 2 %"
            )
        F = np.asarray(homogeneous.deformation_gradient(test, driven, stretch))
        label = f"{file.stem}, {test.replace('_', ' ')}" + (f" at {fixed}" if shear and fixed not in ("", "1") else "")
        component = (0, 1) if shear else (0, 0)
        curves.append(_one_curve(file, label, test, F, component, stress))
    return curves, column[2]


#: If two stretches of a sheared sample differ by less than this value, they are treated as equal. They differ because
#: the stretch was measured again in each row.
SAME_STRETCH = 0.01


def _stretch_of_shear(row: dict[str, str]) -> float:
    """Return the stretch at which a sample is sheared, or NaN if the cell is not a number. `_column` raises the error
    for such a cell later."""
    try:
        return float(row.get("stretch") or 1.0)
    except ValueError:
        return np.nan


def _stretches_of_shear(rows: list[dict[str, str]]) -> dict[float, str]:
    """Map each stretch in the rows of sheared samples to the rounded stretch of the sample (a string)."""
    own = {_stretch_of_shear(row) for row in rows if row["test"] == "simple_shear"}
    values = np.array(sorted(v for v in own if np.isfinite(v)))
    parts = np.split(values, np.flatnonzero(np.diff(values) >= SAME_STRETCH) + 1)
    return {float(v): f"{round(float(np.median(part)), 2):g}" for part in parts for v in part}


def _one_curve(file: Path, label: str, test: str, F: np.ndarray, component: tuple, stress: np.ndarray) -> Curve:
    J = np.linalg.det(F)
    worst = int(np.argmax(np.abs(J - 1)))
    if abs(J[worst] - 1) > _SAME_VOLUME:
        raise InputError(
            f"{file}: det F = {J[worst]:.4g} in row {worst + 1}, but the volume must not change; give gradients with "
            "det F = 1"
        )
    if len(stress) < 3:
        raise InputError(f"{file}: {label} has {len(stress)} points; give at least 3")
    rms = np.sqrt(np.mean(stress**2))
    if not 1e-100 < rms < 1e100:
        raise InputError(f"{file}: {label} has a mean stress of {rms:g} Pa; give measured stresses")
    if np.ptp(F, axis=0).max() == 0:
        raise InputError(f"{file}: {label} has the same deformation in every row; give a curve")
    # The digits of F in the file are rounded, so F33 is scaled to make det F = 1.
    F = F.copy()
    F[:, 2, 2] /= J
    driven = Curve(label, test, F, component, stress).driven
    order = np.argsort(driven, kind="stable")
    returns = _returns(driven, F.reshape(len(F), 9))
    return Curve(label, test, F[order], component, stress[order], returns, file=str(file))


#: The deformation of a test reverses if it goes back by more than this fraction of its range.
_TURN = 0.05


def _returns(driven: np.ndarray, F: np.ndarray) -> int:
    """Return the number of reversals of the deformation after which the rows repeat earlier deformations.

    Args:
        driven: (n,) the component of the deformation that the test changes.
        F: (n, 9) all components. Rows with the same `driven` but different other components do not count as a
            repetition, for example in biaxial tests with several stretch ratios.
    """
    turns, low, high, least = [0], 0, 0, _TURN * np.ptp(driven)
    rises: bool | None = None
    for k, value in enumerate(driven):
        high = k if value > driven[high] else high
        low = k if value < driven[low] else low
        if rises is not False and driven[high] - value > least:
            turns += [high] if rises else []
            rises, low = False, k
        elif rises is not True and value - driven[low] > least:
            turns += [low] if rises is False else []
            rises, high = True, k
    parts = [np.arange(a + (a > 0), b + 1) for a, b in zip(turns, [*turns[1:], len(driven) - 1], strict=True)]
    # A jump back to the start is not a separate part. The extreme values of each part are ignored, so that a single
    # wrong value does not count as a range of deformations.
    parts = [rows[np.argsort(driven[rows], kind="stable")][1:-1] for rows in parts if len(rows) >= 3]
    return sum(_same_again(driven, F, before, after) for before, after in itertools.pairwise(parts))


def _same_again(driven: np.ndarray, F: np.ndarray, before: np.ndarray, after: np.ndarray) -> bool:
    """Return whether the rows `after` repeat the deformations of the rows `before` over a range of `driven`. `before`
    and `after` are row numbers, sorted by `driven`; F is (n, 9)."""
    low, high = max(driven[before[0]], driven[after[0]]), min(driven[before[-1]], driven[after[-1]])
    if not high - low > 2 * _TURN * np.ptp(driven):
        return False
    inside = after[(driven[after] >= low) & (driven[after] <= high)]
    passed = np.stack([np.interp(driven[inside], driven[before], column[before]) for column in F.T], axis=1)
    return bool(np.abs(F[inside] - passed).max(initial=0.0) <= _TURN * np.ptp(F, axis=0).max())
