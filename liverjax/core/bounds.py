"""Check whether the numbers of a struct, from a file or from Python, are within the bounds of its fields."""

import dataclasses
import math
from collections.abc import Iterator, Mapping
from typing import Any

import jax
import numpy as np

from liverjax.core.errors import InputError

#: Fields of a `Region` that may be dictionaries of numbers. They are skipped here: `scenes.checks.regions` checks them.
_DICTIONARIES = ("law", "viscosity", "porosity")
#: Maximum number of values that a message shows. If an array has more values, the message shows only the first wrong
#: value and its position in the array.
_FEW = 8
#: Largest allowed whole number, since compiled programs store whole numbers with 32 bits.
_LARGEST = 2**31 - 1


def check_fields(thing: Any, name: str = "", leave: tuple[str, ...] = ()) -> None:
    """Raise `InputError` if a value of a struct is out of bounds, not finite or not a number.

    The check compiles nothing.

    Args:
        thing: any struct; structs inside this struct are also checked. Values that are None, or unknown inside jit, are
            not checked.
        name: name of the struct. The names in messages begin with this name: ``law`` gives ``law.mu``.
        leave: fields that this function does not check, because another function checks them.

    Raises:
        InputError: a value is out of bounds, not finite or not a number. The message contains the dotted name (for
            example law.mu), the value, the bound and a remedy.
    """
    for dotted, metadata, value in _fields(thing, name, leave):
        check_bound(dotted, metadata, value)


def _fields(thing: Any, name: str, leave: tuple[str, ...]) -> Iterator[tuple[str, Mapping, object]]:
    """Yield (dotted name, metadata, value) of every field with metadata, also in nested structs.

    Fields of `thing` whose names are in `leave` are omitted.
    """
    for field in dataclasses.fields(thing):
        value = getattr(thing, field.name)
        if value is None or field.name in leave or (isinstance(value, dict) and field.name in _DICTIONARIES):
            continue
        # These names are the same as in scene files: `law.0.mu`, not `law.laws.0.mu`.
        dotted = name if field.metadata.get("unnamed") else ".".join(filter(None, (name, field.name)))
        several = isinstance(value, tuple) and any(dataclasses.is_dataclass(v) for v in value)
        if dataclasses.is_dataclass(value):
            yield from _fields(value, dotted, ())
        elif several:
            for k, one in enumerate(value):
                yield from _fields(one, f"{dotted}.{k}", ())
        elif field.metadata:
            yield dotted, field.metadata, value


def check_bound(where: str, metadata: Mapping, value: object) -> None:
    """Raise `InputError` if the field's `metadata` does not allow the value. The message begins with `where`.

    Args:
        where: name of the value, for the message.
        metadata: metadata of the field, from `param` or `static` of `liverjax.core.struct`.
        value: a number, an array, or a sequence of numbers or arrays. Values inside jit, grad or vmap are not checked.

    Raises:
        InputError: the value is not a number, not finite or out of bounds; or a static field does not allow this word.
    """
    lower = metadata.get("lower")
    if metadata.get("static"):
        words = metadata.get("words")
        if words and value not in words:
            *first, last = filter(None, words)
            raise InputError(f"{where} = {value!r} is not known: use {', '.join(first)} or {last}")
        whole = isinstance(value, (int, np.integer)) and not isinstance(value, bool)
        if lower is not None and not (whole and value >= lower):
            raise InputError(f"{where} = {value!r} must be a whole number above {lower - 1}: give {lower} or more")
        if isinstance(value, (int, np.integer)) and value > _LARGEST:
            raise InputError(f"{where} must be at most {_LARGEST}: give a smaller number")
        return
    if type(value) is int and not finite(value):
        raise InputError(f"{where} is a whole number with hundreds of digits: give a smaller number")
    if type(value) is float or type(value) is int:  # a fast path for single numbers, since every run checks all values
        leaves, numbers = [value], None
        least = most = value
    else:
        leaves = jax.tree.leaves(value, is_leaf=lambda v: v is None or isinstance(v, dict))
        if any(isinstance(leaf, jax.core.Tracer) for leaf in leaves):  # under jit or grad the value is unknown
            return
        numbers = _numbers_of(where, metadata, value, leaves)
        if not numbers.size:
            return
        least, most = numbers.min(), numbers.max()  # minimum and maximum are NaN if one number is NaN
    above, upper = metadata.get("above"), metadata.get("upper")
    inside = (above is None or least > above) and (lower is None or least >= lower) and (upper is None or most <= upper)
    if not (inside and math.isfinite(least) and math.isfinite(most)) or metadata.get("nonzero"):
        _refuse(where, metadata, value, np.asarray([value], float) if numbers is None else numbers)


def _refuse(where: str, metadata: Mapping, value: object, numbers: np.ndarray) -> None:
    """Raise an error for the first bound that one of the numbers (n,) violates. The error shows `where` and `value`."""
    unit, typical = metadata.get("unit", "1"), metadata.get("typical")
    if not np.isfinite(numbers).all():
        raise InputError(
            f"{_shown(where, value, numbers, ~np.isfinite(numbers))} is not finite: give a number{_in(unit)}"
        )
    if metadata.get("nonzero") and np.any(numbers == 0):
        raise InputError(f"{_shown(where, value, numbers, numbers == 0)} must not be 0: give another exponent")
    example = f"give e.g. {typical:g}" if isinstance(typical, (int, float)) else ""
    for key, wrong, words, remedy in (
        ("above", np.less_equal, "be above", "give a larger value"),
        ("lower", np.less, "be at least", "give a larger value"),
        ("upper", np.greater, "be at most", "give a smaller value"),
    ):
        bound = metadata.get(key)
        if bound is not None and np.any(wrong(numbers, bound)):
            said = f"{_shown(where, value, numbers, wrong(numbers, bound))} must {words} {bound:g}"
            raise InputError(f"{said}{'' if unit == '1' else f' {unit}'}: {example or remedy}")


def _numbers_of(where: str, metadata: Mapping, value: object, leaves: list) -> np.ndarray:
    """Return the numbers of all leaves of a value as one array (n,). Raise InputError if a leaf is not a number."""
    try:
        if any(isinstance(leaf, (str, bytes, bool, dict)) or np.iscomplexobj(leaf) for leaf in leaves):
            raise TypeError
        return np.concatenate([np.ravel(np.asarray(leaf, float)) for leaf in leaves]) if leaves else np.empty(0)
    except (TypeError, ValueError, OverflowError):
        unit = metadata.get("unit", "1")
        raise InputError(f"{where} = {value!r} is not a number: give a value{_in(unit)}") from None


def _in(unit: str) -> str:
    """Return " in " and the unit, for a message. Return an empty string if the quantity has no unit."""
    return "" if unit == "1" else f" in {unit}"


def _shown(where: str, value: Any, numbers: np.ndarray, wrong: np.ndarray) -> str:
    """Return name and value as a string for a message.

    If the value has many numbers, the string shows only the first wrong number.
    """
    if numbers.size > _FEW:
        first = int(np.argmax(wrong))
        return f"{where}, number {first + 1} of {numbers.size}, = {numbers[first]:g}"
    if isinstance(value, (tuple, list)):
        return f"{where} = {numbers.tolist()}"
    return f"{where} = {np.asarray(value).tolist() if np.ndim(value) else value}"


def check_shape(where: str, value: Any, *allowed: tuple[int, ...]) -> None:
    """Raise `InputError` if the shape of an array is not in `allowed`. A value of None is not checked.

    Raises:
        InputError: the array has a shape that is not in `allowed`.
    """
    if value is not None and shape_of(value) not in allowed:
        words = " or ".join("one number" if shape == () else f"shape {shape}" for shape in allowed)
        raise InputError(f"{where} has shape {shape_of(value)}: give {words}")


def shape_of(value: Any) -> tuple[int, ...]:
    """Return the shape of a value, also of a sequence of numbers inside jit (NumPy cannot determine this shape)."""
    rows = {shape_of(row) for row in value} if isinstance(value, tuple | list) else set()
    return (len(value), *rows.pop()) if len(rows) == 1 else np.shape(value)


def finite(value: float) -> bool:
    """Return whether a number can be converted to a finite float.

    The result is False for a whole number with hundreds of digits, because this number is too large for a float.
    """
    try:
        return math.isfinite(value)
    except OverflowError:
        return False


def array_of(value: object) -> np.ndarray | None:
    """Convert a number, or lists of numbers, from a scene file to a float array.

    Returns None for all other values, for example strings, booleans, NaN, and lists of unequal length.
    """
    if not _is_numbers(value):
        return None
    try:
        return np.array(value, float)
    except ValueError:
        return None


def _is_numbers(value: object) -> bool:
    if isinstance(value, (list, tuple)):
        return all(map(_is_numbers, value))
    if isinstance(value, (bool, str)):
        return False
    if isinstance(value, (int, float)):
        return finite(value)
    try:
        array = np.asarray(value)
    except (TypeError, ValueError):  # a JAX tracer (inside jit) has no value and is not from a file
        return False
    return array.dtype.kind in "fiu" and bool(np.all(np.isfinite(array)))


def check_one(where: str, value: object) -> None:
    """Raise `InputError` if a value of a scene file is not one finite number.

    Raises:
        InputError: the value is not one finite number. The message begins with `where`.
    """
    if isinstance(value, bool) or not isinstance(value, (int, float)) or not finite(value):
        raise InputError(f"{where} = {value!r} is not a number: give a number")
