"""Frozen dataclasses that are JAX pytrees, with unit and bounds for each parameter."""

import dataclasses
from collections.abc import Sequence
from dataclasses import replace as replace
from typing import Any, TypedDict, TypeVar, Unpack, dataclass_transform

import jax
import numpy as np

T = TypeVar("T")
#: One number, or an array with one number per element or sample; it may be traced.
Number = float | np.ndarray | jax.Array
#: Numbers as a user writes them: one, a sequence of them, or an array.
Numbers = Number | Sequence[float] | Sequence[Sequence[float]]
#: An array on the host (NumPy) or of a program (JAX).
Array = np.ndarray | jax.Array
#: Numbers of nodes, elements or triangles.
Indices = Array
#: The table under a heading of a TOML file, or the content of a JSON file; values are checked where they are read.
Content = dict[str, Any]


def static(
    default: Any = dataclasses.MISSING, about: str = "", *, lower: int | None = None, words: Sequence[str] = ()
) -> Any:
    """A field that is part of the structure (a tag, a count): a change compiles anew, and there is no gradient.

    With `lower` it must be a whole number, `lower` or more; with `words` it must be one of them (see
    `liverjax.core.bounds`).
    """
    metadata = {"static": True, "about": about, "lower": lower, "words": tuple(words)}
    return dataclasses.field(default=default, metadata=metadata)


class Limits(TypedDict, total=False):
    """What `liverjax.core.bounds.check_fields` asks of a number."""

    lower: float  # inclusive
    upper: float  # inclusive
    above: float  # strict
    nonzero: bool  # 0 is refused


def param(
    unit: str,
    about: str = "",
    *,
    each: bool = False,
    typical: Any = None,
    default: Any = dataclasses.MISSING,
    **limits: Unpack[Limits],
) -> Any:
    """A numeric field, a leaf of the pytree.

    Args:
        unit: SI unit, ``"1"`` for a pure number. Fields in ``Pa`` scale together in `liverjax.laws.scaled`.
        about: one line for ``python -m liverjax laws``.
        each: a sequence with one number per term (or the components of a direction).
        typical: value for a soft tissue of about 1 kPa shear modulus, used if a law is given by its name alone.
        default: as in `dataclasses.field`.
        limits: ``lower`` and ``upper``, inclusive bounds; ``above``, a strict lower bound; ``nonzero=True``, 0 is
            refused.
    """
    unknown = limits.keys() - Limits.__annotations__.keys()
    if unknown:
        raise TypeError(f"param has no {sorted(unknown)[0]!r}: use {', '.join(Limits.__annotations__)}")
    metadata = {
        "unit": unit,
        "about": about,
        "each": each,
        "typical": default if typical is None and default is not dataclasses.MISSING else typical,
        **limits,
    }
    return dataclasses.field(default=default, metadata=metadata)


def unnamed(about: str = "", *, places: str = "", default: object = dataclasses.MISSING) -> Any:
    """A field that contains structs, and is left out of their dotted names: `law.mu`, not `law.law.mu`.

    Args:
        about: one line on it.
        places: name of a method that returns the places in this field for a word: `support.0` is the first of
            ``named("support")``.
        default: as in `dataclasses.field`.
    """
    return dataclasses.field(default=default, metadata={"about": about, "unnamed": places or True})


@dataclass_transform(frozen_default=True, kw_only_default=True, field_specifiers=(static, param, unnamed))
def struct(cls: type[T]) -> type[T]:
    """Make `cls` a frozen, keyword-only dataclass registered as a pytree; `static` fields are not leaves."""
    made: Any = dataclasses.dataclass(frozen=True, kw_only=True, eq=False)(cls)
    fields = dataclasses.fields(made)
    meta = tuple(f.name for f in fields if f.metadata.get("static"))
    data = tuple(f.name for f in fields if not f.metadata.get("static"))
    keys = tuple(jax.tree_util.GetAttrKey(name) for name in data)

    def flatten(thing: Any) -> tuple[tuple, tuple]:
        values = thing.__dict__
        # The class itself is part of the structure. `register_dataclass` of jaxlib 0.10.0 to 0.12.0.1 leaves it out
        # where structures are compared: a jitted function then may run one law's program on another law's numbers.
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
