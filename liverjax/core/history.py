"""Histories of loads and motions: tables of numbers at increasing times.

A history is linear between two times, and constant before the first and after the last time. A table with one number
per time contains factors that multiply the load or motion. A table with three numbers per time contains the vector of
the load or motion itself.
"""

from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from liverjax.core.errors import InputError
from liverjax.core.struct import Number, Numbers

#: Columns of a history file, for factors and for vectors.
_FACTOR, _VECTOR = ("time", "factor"), ("time", "x", "y", "z")


def read_history(value: object, name: str, forms: tuple[int, ...] = (1, 3)) -> tuple[jax.Array, jax.Array]:
    """Return times (T,) [s], and factors (T,) or vectors (T, 3), from the `history` in a scene file.

    Args:
        value: rows `[[t, factor], …]` or `[[t, x, y, z], …]`; or a CSV file with columns time,factor or time,x,y,z.
        name: name of the load or motion with this history, for messages.
        forms: allowed numbers of values per time: 1 (a factor), 3 (a vector), or both.

    Raises:
        InputError: the file cannot be read, the columns are wrong, a number is not finite, or the times do not
            increase.
    """
    wanted = " or ".join("[[time, factor], …]" if n == 1 else "[[time, x, y, z], …]" for n in forms)
    if isinstance(value, (str, Path)):
        data, where = _file(Path(value), name, forms), f"{name} history {value}"
    else:
        where = f"{name} history"
        try:
            data = np.array(value, float)
            if any(isinstance(cell, str | bool) for row in value for cell in row):  # type: ignore[attr-defined]
                data = np.empty(0)
        except (TypeError, ValueError, OverflowError):
            data = np.empty(0)
        if data.ndim != 2 or data.shape[1] - 1 not in forms:
            found = f"has rows of {data.shape[1]} numbers" if data.ndim == 2 else "is not a table of numbers"
            raise InputError(f"{where} {found}: write {wanted}, or name a CSV file")
    if not len(data) or not np.all(np.isfinite(data)) or not np.all(np.diff(data[:, 0]) > 0):
        raise InputError(f"{where} must have finite numbers at increasing times: sort and complete its rows")
    numbers = data[:, 1] if data.shape[1] == 2 else data[:, 1:]
    return jnp.asarray(data[:, 0]), jnp.asarray(numbers)


def _file(path: Path, name: str, forms: tuple[int, ...]) -> np.ndarray:
    kinds = [_FACTOR if n == 1 else _VECTOR for n in forms]
    wanted = " or ".join(",".join(kind) for kind in kinds)
    try:
        text = path.read_text(encoding="utf-8-sig")  # files of spreadsheet programs begin with a byte order mark
    except OSError as error:
        raise InputError(
            f"{name} history {path} cannot be read ({error.strerror}): give a CSV file with columns {wanted}"
        ) from None
    except UnicodeDecodeError:
        raise InputError(f"{name} history {path} is not a text file: give a CSV file with columns {wanted}") from None
    # NumPy would read a comment on the first line as the names of the columns.
    lines = [line for line in text.replace('"', "").splitlines() if line.strip() and not line.lstrip().startswith("#")]
    if not lines:
        raise InputError(f"{name} history {path} is empty: give a CSV file with columns {wanted}")
    commas = {line.count(",") for line in lines}
    if len(commas) > 1 or commas == {0}:
        why = "has rows of different lengths" if len(commas) > 1 else "has one column"
        raise InputError(
            f"{name} history {path} {why}: give columns {wanted}, separated by commas, with decimal points"
        )
    heads = [cell.strip() for cell in lines[0].split(",")]
    twice = next((head for head in heads if head in (*_FACTOR, *_VECTOR) and heads.count(head) > 1), None)
    if twice is not None:
        raise InputError(f"{name} history {path} has two columns {twice}: remove one of them")
    data = np.atleast_1d(np.genfromtxt(lines, delimiter=",", names=True))
    every = [kind for kind in kinds if set(kind) <= set(data.dtype.names or ())]
    if len(every) > 1:
        raise InputError(f"{name} history {path} has both {wanted.replace(' or ', ' and ')}: give one of these")
    found = next(iter(every), None)
    if found is None:
        raise InputError(f"{name} history {path} has the columns {data.dtype.names}: give the columns {wanted}")
    return np.stack([data[column] for column in found], axis=1)


def check_times(times: Any, history: Any, name: str, forms: tuple[int, ...] = (1, 3)) -> None:
    """Raise `InputError` if a history made in Python cannot be used. Times that are unknown inside jit are not checked.

    Raises:
        InputError: only one of times and history is given, their shapes do not match, there is no time, or the times do
            not increase.
    """
    if (times is None) != (history is None):
        raise InputError(f"{name} needs both times and history, or neither of them: give both, or remove both")
    if history is None:
        return
    count = np.shape(times)
    allowed = [count if n == 1 else (*count, n) for n in forms]
    if len(count) != 1 or np.shape(history) not in allowed:
        shapes = " or ".join(map(str, allowed))
        raise InputError(
            f"{name} history has the shape {np.shape(history)}, and the times have the shape {count}: give a history "
            f"of shape {shapes}"
        )
    if isinstance(times, jax.core.Tracer):
        return
    falls = np.flatnonzero(~(np.diff(np.asarray(times)) > 0))
    if not count[0]:
        raise InputError(f"{name} history is empty: give at least one time, or remove times and history")
    if falls.size:
        found = f"{times[falls[0] + 1]:g} s after {times[falls[0]]:g} s"
        raise InputError(f"{name} history must have increasing times, but has {found}: sort the times")


def entry_at(time: Number, times: Any, history: Numbers) -> jax.Array:
    """Return the factor (), or the vector (3,), at a time [s], by linear interpolation in the history."""
    values = jnp.asarray(history)
    if values.ndim == 1:
        return jnp.interp(time, times, values)
    return jnp.stack([jnp.interp(time, times, values[:, k]) for k in range(values.shape[1])])


def value_at(value: object, time: Number, times: Any, history: Any) -> Any:
    """Return a value at a time [s]: `value` times the factor of its history, or the vector of its history.

    If `history` is None, the value is constant.
    """
    if history is None:
        return value
    now = entry_at(time, times, history)
    return now if now.ndim else jnp.asarray(value, now.dtype) * now


def integral_of(value: Number, begin: Number, dt: Number, times: Numbers, history: Numbers) -> jax.Array:
    """Return the time integral of `value` times the factor of its history, from `begin` to `begin` + dt [s].

    The intervals between two times of the history are integrated separately. So derivatives are also correct if a step
    ends at one of these times.
    """
    t, factors = jnp.asarray(times) - begin, jnp.asarray(history)
    inside = jnp.clip(t, 0.0, dt)
    low, high = inside[:-1], inside[1:]
    middles = factors[:-1] + jnp.diff(factors) / jnp.diff(t) * (0.5 * (low + high) - t[:-1])
    ends = factors[0] * inside[0] + factors[-1] * (dt - inside[-1])  # the history is constant outside its times
    return jnp.asarray(value, t.dtype) * (ends + jnp.sum((high - low) * middles))
