"""Frozen dataclasses that are JAX pytrees, with a unit and bounds for each parameter."""

import dataclasses
import functools
from collections.abc import Callable, Sequence
from dataclasses import replace as replace
from typing import Any, TypedDict, TypeVar, Unpack, dataclass_transform

import jax
import jax.numpy as jnp
import numpy as np

from liverjax.core.errors import InputError

T = TypeVar("T")
#: One number, or an array with one number per element or sample. It may be unknown (inside jit, grad or vmap).
Number = float | np.ndarray | jax.Array
#: Numbers as a user writes them: one number, a sequence of numbers, or an array.
Numbers = Number | Sequence[float] | Sequence[Sequence[float]]
#: An array of NumPy or of JAX.
Array = np.ndarray | jax.Array
#: Index numbers of nodes, elements or triangles.
Indices = Array
#: A table of a TOML file, or the content of a JSON file. Its values are checked when they are used.
Content = dict[str, Any]


def static(
    default: Any = dataclasses.MISSING, about: str = "", *, lower: int | None = None, words: Sequence[str] = ()
) -> Any:
    """Declare a field that is part of the structure of a pytree, for example a tag or a count.

    The field has no gradient, and a new value needs a new compilation. With `lower`, the value must be a whole number
    that is at least `lower`. With `words`, the value must be one of these words (see `liverjax.core.bounds`).
    """
    metadata = {"static": True, "about": about, "lower": lower, "words": tuple(words)}
    return dataclasses.field(default=default, metadata=metadata)


class Limits(TypedDict, total=False):
    """Bounds of a number. The function `liverjax.core.bounds.check_fields` checks these bounds."""

    lower: float  # inclusive
    upper: float  # inclusive
    above: float  # strict
    nonzero: bool  # 0 is not allowed


def param(
    unit: str,
    about: str = "",
    *,
    each: bool = False,
    typical: Any = None,
    default: Any = dataclasses.MISSING,
    **limits: Unpack[Limits],
) -> Any:
    """Declare a numeric field, which is a leaf of the pytree.

    Args:
        unit: SI unit, ``"1"`` for a pure number. `liverjax.laws.scaled` multiplies all fields in ``Pa``, so a law
            must not have another unit of pressure.
        about: one-line description that ``python -m liverjax laws`` prints.
        each: whether the value is a sequence: one number for each term of a law, or the components of a direction.
            The struct keeps an array (n,) as a tuple; `jnp.stack` makes it an array again.
        typical: value for a soft tissue with a shear modulus of about 1 kPa. It is used if a user gives only the name
            of a law.
        default: see `dataclasses.field`.
        limits: ``lower`` and ``upper`` are inclusive bounds; ``above`` is a strict lower bound; ``nonzero=True`` means
            that 0 is not allowed.
    """
    unknown = limits.keys() - Limits.__annotations__.keys()
    if unknown:
        raise TypeError(f"param has no argument {sorted(unknown)[0]!r}: use {', '.join(Limits.__annotations__)}")
    metadata = {
        "unit": unit,
        "about": about,
        "each": each,
        "typical": default if typical is None and default is not dataclasses.MISSING else typical,
        **limits,
    }
    return dataclasses.field(default=default, metadata=metadata)


def unnamed(about: str = "", *, places: str = "", default: object = dataclasses.MISSING) -> Any:
    """Declare a field that contains structs. Dotted names omit the name of this field: `law.mu`, not `law.law.mu`.

    Args:
        about: one line about the field.
        places: name of a method of the struct. For a given word, the method returns the indices of the entries of the
            field that have this word as their name. For example, `support.0` is the entry at the first index of
            ``named("support")``.
        default: see `dataclasses.field`.
    """
    return dataclasses.field(default=default, metadata={"about": about, "unnamed": places or True})


@dataclass_transform(frozen_default=True, kw_only_default=True, field_specifiers=(static, param, unnamed))
def struct(cls: type[T]) -> type[T]:
    """Make `cls` a frozen, keyword-only dataclass that is registered as a pytree. `static` fields are not leaves."""
    made: Any = dataclasses.dataclass(frozen=True, kw_only=True, eq=False)(cls)
    fields = dataclasses.fields(made)
    several = frozenset(f.name for f in fields if f.metadata.get("each"))
    arrays = {f.name for f in fields} & (_WHOLE | _FLOATING) - several
    if arrays:
        made.__init__ = _with_arrays(made.__init__, arrays)
    if several:
        made.__init__ = _with_tuples(made.__init__, several)
    meta = tuple(f.name for f in fields if f.metadata.get("static"))
    data = tuple(f.name for f in fields if not f.metadata.get("static"))
    keys = tuple(jax.tree_util.GetAttrKey(name) for name in data)

    def flatten(thing: Any) -> tuple[tuple, tuple]:
        values = thing.__dict__
        # The class is part of the structure. `register_dataclass` of jaxlib 0.10.0 to 0.12.0.1 ignores the class when
        # it compares structures: a jitted function may then use the program of one law with the numbers of another law.
        return tuple(values[name] for name in data), (made, *(values[name] for name in meta))

    def flatten_with_keys(thing: Any) -> tuple[tuple, tuple]:
        values, structure = flatten(thing)
        return tuple(zip(keys, values, strict=True)), structure

    def unflatten(structure: tuple, values: Any) -> Any:
        thing = object.__new__(made)
        thing.__dict__.update(zip(data, values, strict=True))
        thing.__dict__.update(zip(meta, structure[1:], strict=True))
        return thing

    jax.tree_util.register_pytree_with_keys(made, flatten_with_keys, unflatten, flatten)
    return made


#: Names of fields with arrays of whole numbers. A user may also give a list or a tuple.
_WHOLE = frozenset(("nodes", "triangles", "elements", "drained"))
#: Names of fields with arrays of floating-point numbers. A user may also give a list or a tuple.
_FLOATING = frozenset(("times", "history", "exponents", "limits"))


def _with_arrays(make: Callable[..., None], arrays: set[str]) -> Callable[..., None]:
    """Return the method `make` (__init__ of a struct), changed such that it first converts lists and tuples to arrays.

    Args:
        make: the method.
        arrays: names of the fields that are arrays.
    """

    def converted(name: str, value: list | tuple) -> Array:
        try:
            if any(isinstance(leaf, jax.core.Tracer) for leaf in jax.tree.leaves(value)):
                return jnp.asarray(value)
            return np.asarray(value, float if name in _FLOATING else None if value else int)
        except (TypeError, ValueError):
            raise InputError(f"{name} = {str(value)[:60]} is not an array of numbers: correct this list") from None

    @functools.wraps(make)
    def init(self: object, **given: object) -> None:
        lists = {k: v for k, v in given.items() if k in arrays and isinstance(v, list | tuple)}
        make(self, **given | {name: converted(name, value) for name, value in lists.items()})

    return init


def _with_tuples(make: Callable[..., None], several: frozenset[str]) -> Callable[..., None]:
    """Return the method `make` (__init__ of a struct), changed such that it first converts arrays (n,) to tuples.

    Otherwise, n numbers of a law could be mistaken for one number of each element in a body of n elements.

    Args:
        make: the method.
        several: names of the fields that are sequences (`each` of `param`).
    """

    @functools.wraps(make)
    def init(self: object, **given: object) -> None:
        rows = {k: v for k, v in given.items() if k in several and isinstance(v, Array) and v.ndim == 1}
        make(self, **given | {name: tuple(value) for name, value in rows.items()})

    return init


def in_precision(value: Any, dtype: Any) -> Any:
    """Convert a leaf of a pytree to the precision `dtype` if it is floating-point. Other leaves do not change."""
    return jnp.asarray(value, dtype) if jnp.issubdtype(jnp.result_type(value), jnp.floating) else value
