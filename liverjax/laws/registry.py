"""The laws by name (Table 1 of the book chapter, and three more), and functions to make, check and scale a law."""

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from liverjax.core import bounds
from liverjax.core.did_you_mean import as_word, hint
from liverjax.core.errors import InputError
from liverjax.core.struct import Number, Numbers, replace
from liverjax.laws.base import Law
from liverjax.laws.continued import Continued
from liverjax.laws.families.arruda_boyce import ArrudaBoyce
from liverjax.laws.families.bogen import Bogen
from liverjax.laws.families.costa import Costa
from liverjax.laws.families.exponential import Exponential
from liverjax.laws.families.fung_demiray import FungDemiray
from liverjax.laws.families.logarithmic import Logarithmic
from liverjax.laws.families.mooney_rivlin import MooneyRivlin
from liverjax.laws.families.neo_hookean import NeoHookean, NeoHookeanCompressible
from liverjax.laws.families.ogden import Ogden
from liverjax.laws.families.saint_venant_kirchhoff import SaintVenantKirchhoff
from liverjax.laws.families.stable_neo_hookean import StableNeoHookean
from liverjax.laws.families.veronda_westmann import VerondaWestmann
from liverjax.laws.families.yeoh import Yeoh
from liverjax.laws.volumetric import VOLUMETRIC

#: Name in scene files and command lines -> class.
LAWS: dict[str, type[Law]] = {
    "neo_hookean": NeoHookean,
    "neo_hookean_compressible": NeoHookeanCompressible,
    "stable_neo_hookean": StableNeoHookean,
    "saint_venant_kirchhoff": SaintVenantKirchhoff,
    "mooney_rivlin": MooneyRivlin,
    "yeoh": Yeoh,
    "arruda_boyce": ArrudaBoyce,
    "ogden": Ogden,
    "bogen": Bogen,
    "logarithmic": Logarithmic,
    "exponential": Exponential,
    "fung_demiray": FungDemiray,
    "veronda_westmann": VerondaWestmann,
    "costa": Costa,
}


def find(name: str) -> type[Law]:
    """Return the class of the law with this name. The `InputError` for an unknown name suggests a similar name."""
    if as_word(name, "law name") not in LAWS:
        raise InputError(f"law {name!r} is not known: {hint(name, LAWS)}")
    return LAWS[name]


def parameters(law: Any) -> list[dataclasses.Field]:
    """Return the numeric fields of a law.

    The `metadata` of a field contain its unit, bounds and description (`about`).
    """
    return [f for f in dataclasses.fields(law) if not f.metadata.get("static")]


def create(name: str, **values: Numbers) -> Law:
    """Make a law from its name. The parameters are checked against their bounds.

    Args:
        name: a key of `LAWS`.
        values: parameters in the units that ``python -m liverjax laws`` lists; sequences become tuples.

    Raises:
        InputError: a law or parameter is unknown, or a value is missing or out of bounds.
    """
    cls: Any = find(name)
    known = {f.name: f for f in dataclasses.fields(cls)}
    for key in values:
        if key not in known:
            raise InputError(f"law {name} has no parameter {key!r}: {hint(key, known)}")
    for key, field in known.items():
        if key not in values and field.default is dataclasses.MISSING:
            raise InputError(f"law {name} needs parameter {key} [{field.metadata.get('unit', '')}]: give {key} = …")
    for key, value in values.items():
        if value is None and known[key].default is None:
            continue  # an optional coefficient is not given
        check_value(f"law {name}: {key}", known[key].metadata, value)
    law = cls(**{k: _sequence(v) if known[k].metadata.get("each") else v for k, v in values.items()})
    if not any(isinstance(v, jax.core.Tracer) for v in jax.tree.leaves(law)):
        law.check()
    return law


def _sequence(value: Any) -> Any:
    """Return a list of numbers as a tuple (each number is a leaf of the pytree), or a list of vectors as an array."""
    if isinstance(value, (list, tuple)) and not any(isinstance(v, (list, tuple)) for v in value):
        return tuple(value)
    if jnp.ndim(value) == 0:
        raise InputError(f"{value} is one number, but a list of numbers is needed: give a list")
    return jnp.asarray(value) if jnp.ndim(value) > 1 else tuple(value)


def check_value(where: str, metadata: Any, value: Any) -> None:
    """Raise `InputError` if the parameter's `metadata` does not allow the value. The message begins with `where`."""
    if metadata.get("static"):
        if not isinstance(value, str) or value not in VOLUMETRIC:
            raise InputError(f"{where} = {value!r} is not known: use one of {', '.join(VOLUMETRIC)}")
        return
    several = isinstance(value, (list, tuple)) or np.ndim(value) > 0
    if metadata["each"] != several and not isinstance(value, (str, jax.core.Tracer)):
        shape = "a list of numbers" if metadata["each"] else "one number"
        raise InputError(f"{where} = {value} is not {shape}: give {shape} in {metadata['unit']}")
    bounds.check_bound(where, metadata, value)


def typical(name: str) -> Law:
    """Return the law with typical (not measured) parameters, scaled to a ground-state shear modulus of 770 Pa."""
    values = {f.name: f.metadata["typical"] for f in parameters(find(name))}
    law = find(name)(**values)
    return scaled(law, 770.0 / law.shear_modulus())


def scaled(law: Law, factor: Number) -> Law:
    """Return the law with its energy multiplied by `factor`. For this, the parameters in Pa are multiplied by it."""

    def one(s: Law) -> Law:
        if isinstance(s, Continued):
            return replace(s, law=scaled(s.law, factor))
        moduli = {f.name: getattr(s, f.name) for f in parameters(s) if f.metadata["unit"] == "Pa"}
        return replace(s, **{k: _times(v, factor) for k, v in moduli.items() if v is not None})

    if law.subsets is not None:
        return law.each(lambda own: scaled(own, factor))
    first, *others = (one(s) for s in law.summands())
    return sum(others, first)


def _times(value: Any, factor: Number) -> Any:
    return tuple(v * factor for v in value) if isinstance(value, (tuple, list)) else jnp.multiply(value, factor)
