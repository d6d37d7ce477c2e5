"""Frozen dataclasses that are JAX pytrees, with unit and bounds beside each parameter."""

import dataclasses
from typing import Any, TypeVar, dataclass_transform

import jax

T = TypeVar("T")


def static(default: Any = dataclasses.MISSING, about: str = "") -> Any:
    """A field that is part of the structure (a tag, a count): changing it compiles anew, it has no gradient."""
    return dataclasses.field(default=default, metadata={"static": True, "about": about})


def param(
    unit: str,
    about: str = "",
    *,
    lower: float | None = None,
    upper: float | None = None,
    above: float | None = None,
    nonzero: bool = False,
    each: bool = False,
    typical: Any = None,
    default: Any = dataclasses.MISSING,
) -> Any:
    """A numeric field, a leaf of the pytree.

    Args:
        unit: SI unit, ``"1"`` for a pure number. Fields in ``Pa`` scale together in `liverjax.laws.scaled`.
        about: one line for ``python -m liverjax laws``.
        lower, upper: inclusive bounds; ``above``: strict lower bound.
        nonzero: 0 is refused.
        each: a sequence, one number a term (or the components of a direction).
        typical: value for a soft tissue of about 1 kPa shear modulus, used where a law is asked for by name alone.
        default: as in `dataclasses.field`.
    """
    metadata = {
        "unit": unit,
        "about": about,
        "lower": lower,
        "upper": upper,
        "above": above,
        "nonzero": nonzero,
        "each": each,
        "typical": default if typical is None and default is not dataclasses.MISSING else typical,
    }
    return dataclasses.field(default=default, metadata=metadata)


@dataclass_transform(frozen_default=True, kw_only_default=True, field_specifiers=(static, param))
def struct(cls: type[T]) -> type[T]:
    """Make `cls` a frozen, keyword-only dataclass registered as a pytree; `static` fields are not leaves."""
    made: Any = dataclasses.dataclass(frozen=True, kw_only=True, eq=False)(cls)
    fields = dataclasses.fields(made)
    meta = [f.name for f in fields if f.metadata.get("static")]
    data = [f.name for f in fields if not f.metadata.get("static")]
    jax.tree_util.register_dataclass(made, data_fields=data, meta_fields=meta)
    return made


def replace(of: T, **changes: Any) -> T:
    """A copy with other values in some fields."""
    whole: Any = of
    return dataclasses.replace(whole, **changes)
