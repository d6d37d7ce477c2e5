"""Find and replace values by the dotted names that scene files use, for example `law.1.mu`."""

import dataclasses
import itertools
from collections.abc import Iterator
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from liverjax.core.did_you_mean import hint
from liverjax.core.errors import InputError
from liverjax.core.struct import replace


class PathStep(NamedTuple):
    """One step on the path to a value: from `owner` to its content at `key`."""

    owner: Any  # a struct, tuple, dictionary or array
    key: Any  # name of a field, index, or key of a dictionary

    def inside(self) -> Any:
        """Return the content of the owner at the key."""
        return getattr(self.owner, self.key) if dataclasses.is_dataclass(self.owner) else self.owner[self.key]

    def with_inside(self, value: Any) -> Any:
        """Return a copy of the owner with `value` at the key."""
        owner, key = self
        if dataclasses.is_dataclass(owner) and not isinstance(owner, type):
            return replace(owner, **{key: value})
        if isinstance(owner, dict):
            return owner | {key: value}
        if isinstance(owner, tuple):
            return (*owner[:key], value, *owner[key + 1 :])
        numbers = jnp.asarray(owner)
        if jnp.issubdtype(numbers.dtype, jnp.integer) and not _is_whole(value):
            numbers = numbers.astype(float)
        return numbers.at[key].set(jnp.asarray(value, numbers.dtype))


def get(thing: Any, name: str, refusal: str) -> Any:
    """Return the value at a dotted name. See `walk` for the arguments and errors."""
    return walk(thing, name, refusal)[-1].inside()


def put(thing: Any, name: str, value: object, refusal: str) -> Any:
    """Return a copy of `thing` with `value` at a dotted name. `value` may be a JAX tracer.

    See `walk` for the arguments.
    """
    for step in reversed(walk(thing, name, refusal)):
        value = step.with_inside(value)
    return value


def metadata(thing: Any, name: str, refusal: str) -> dict[str, object]:
    """Return the metadata (unit, bounds, …) of the field at a dotted name. See `walk` for the arguments and errors."""
    last = next(step for step in reversed(walk(thing, name, refusal)) if dataclasses.is_dataclass(step.owner))
    return dict(last.owner.__dataclass_fields__[last.key].metadata)


def walk(thing: Any, name: str, refusal: str) -> list[PathStep]:
    """Return all steps from `thing` to the value at a dotted name.

    Args:
        thing: a struct. Static fields, and fields that are None, cannot be named.
        name: names of fields, indices of tuples and arrays, keys of dictionaries. Fields declared `unnamed` do
            not appear in the name.
        refusal: beginning of the error message.

    Raises:
        InputError: no value has this name. The message suggests a similar name.
    """
    steps: list[PathStep] = []
    path, inside = name.split("."), thing
    while path:
        try:
            keys, path = _keys(inside, path, refusal, name[: len(name) - len(".".join(path))])
        except InputError:
            near = _names_that_end_in(thing, name)
            if near:
                raise InputError(f"{refusal}: did you mean {' or '.join(near)}?") from None
            raise
        for key in keys:
            steps.append(PathStep(inside, key))
            inside = steps[-1].inside()
    return steps


def _names_that_end_in(thing: object, name: str) -> list[str]:
    """Return up to three dotted names in `thing` that end in `name`. Letter case and a unit in brackets are ignored."""
    end = name.partition("[")[0].strip().lower()
    every = _names_of_numbers(thing) if end else ()
    return list(itertools.islice((own for own in every if f".{own}".lower().endswith(f".{end}")), 3))


def _names_of_numbers(struct: object, before: str = "") -> Iterator[str]:
    """Yield the dotted names of all fields with numbers in a struct and in the structs inside it."""
    for field in dataclasses.fields(struct) if dataclasses.is_dataclass(struct) else ():
        value = getattr(struct, field.name)
        own = before if field.metadata.get("unnamed") else f"{before}{field.name}."
        if dataclasses.is_dataclass(value):
            yield from _names_of_numbers(value, own)
        elif isinstance(value, tuple) and any(dataclasses.is_dataclass(one) for one in value):
            if not isinstance(field.metadata.get("unnamed"), str):
                for k, one in enumerate(value):
                    yield from _names_of_numbers(one, f"{own}{k}.")
        elif value is not None and field.metadata and not field.metadata.get("static"):
            yield own.removesuffix(".")


def _keys(thing: Any, path: list[str], refusal: str, before: str) -> tuple[list, list[str]]:
    """Return the keys that the first words of a path select in `thing`, and the remaining words of the path.

    `before` is the beginning of the dotted name, without the path. It is used in messages.
    """
    word, rest = path[0], path[1:]
    if dataclasses.is_dataclass(thing):
        return _keys_of_struct(thing, path, refusal, before)
    if isinstance(thing, dict):  # a key may contain dots; an index of the array at this key may follow
        ends = (n for n in range(len(path), 0, -1) if ".".join(path[:n]) in thing)
        if end := next(ends, 0):
            return [".".join(path[:end])], path[end:]
    several = isinstance(thing, tuple) or np.ndim(thing)
    if _is_place(word) and several and int(word) < len(thing):
        return [int(word)], rest
    raise InputError(f"{refusal}: {_nowhere(word, len(thing) if several else 0)}")


def _keys_of_struct(thing: Any, path: list[str], refusal: str, before: str) -> tuple[list, list[str]]:
    word, rest = path[0], path[1:]
    fields = [f for f in dataclasses.fields(thing) if not f.metadata.get("static")]
    known = [f.name for f in fields if not f.metadata.get("unnamed") and getattr(thing, f.name) is not None]
    if word in known:
        return [word], rest
    for field in fields:
        unnamed = field.metadata.get("unnamed")
        if isinstance(unnamed, str):
            places = getattr(thing, unnamed)(word)
            if rest and _is_place(rest[0]) and int(rest[0]) < len(places):
                return [field.name, places[int(rest[0])]], rest[1:]
            known += dict.fromkeys(part.section for part in getattr(thing, field.name))
        elif unnamed and (word.isdigit() or not isinstance(getattr(thing, field.name), tuple)):
            return [field.name], path
    if known:
        raise InputError(f"{refusal}: {hint(word, known, before)}")
    places = next((len(getattr(thing, f.name)) for f in fields if isinstance(getattr(thing, f.name), tuple)), 0)
    raise InputError(f"{refusal}: {_nowhere(word, places)}")


def _is_whole(value: object) -> bool:
    """Return whether a value is known (no JAX tracer) and is a whole number."""
    return not isinstance(value, jax.core.Tracer) and bool(np.all(np.asarray(value) == np.rint(np.asarray(value))))


def _is_place(word: str) -> bool:
    """Return whether a word is an index, such as 2.

    The word 02 is not an index, so that each value has only one name.
    """
    return word.isascii() and word.isdigit() and str(int(word)) == word


def _nowhere(word: str, places: int) -> str:
    return f"{word!r} is not a name or index here" + (f": use an index from 0 to {places - 1}" if places else "")
