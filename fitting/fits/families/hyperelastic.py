"""Hyperelastic laws that can be fitted: their fitted parameters, and starting points for the fit."""

from collections.abc import Callable, Collection, Mapping
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from liverjax import laws
from liverjax.core import bounds
from liverjax.core.errors import InputError
from liverjax.core.struct import replace
from liverjax.laws import Law, gradient_check


class Candidate(NamedTuple):
    """A law to be fitted, and the functions that turn unconstrained variables u into its parameters."""

    label: str
    names: tuple[str, ...]
    units: tuple[str, ...]
    values: Callable[[jax.Array, Any], jax.Array]  # (u, modulus scale [Pa]) -> parameters in the order of `names`
    law: Callable[[jax.Array], Law]  # parameters -> law without volumetric energy
    random: Callable[[np.random.Generator, int], np.ndarray]  # (generator, n) -> n random starting points (n, len(u))
    notes: tuple[str, ...] = ()  # notes about parameters that are not fitted
    fields: tuple[Mapping, ...] = ()  # metadata of the parameters, with their bounds


def candidates(name: str, terms: int | None = None) -> list[Candidate]:
    """Return the laws to be fitted for a given `name`. `FILE.py:LAW` is the law LAW in a file, and `all` means all laws
    of this package that can be fitted. If `terms` is None, Ogden's law is returned several times, each time with
    another number of terms.

    Raises:
        InputError: the law is unknown, its energy is not an isochoric energy plus a volumetric energy U(J), or `terms`
            is given for a law other than Ogden's law.
    """
    if terms is not None and name not in ("ogden", "all"):
        raise InputError(f"--terms {terms} cannot be used with {name}, only with ogden: remove --terms")
    if name == "all":
        singles = [c for n in laws.LAWS if n != "ogden" and incompressible_form(n) for c in candidates(n)]
        # By default, Ogden's law with one term is not added. It is the same law as bogen, which `singles` contains.
        return singles + [_ogden(k) for k in ((2, 3) if terms is None else (terms,))]
    typical = gradient_check.load(name)
    if laws.isochoric_part(typical) is None:
        usable = ", ".join(n for n in laws.LAWS if incompressible_form(n))
        raise InputError(f"law {name} is not an isochoric energy plus U(J), which the fit requires: use {usable}")
    if isinstance(typical, laws.Ogden) and ":" not in name:
        return [_ogden(k) for k in ((1, 2, 3) if terms is None else (terms,))]
    return [_candidate(name.rpartition(":")[2], typical)]


def _candidate(label: str, law: Law) -> Candidate:
    """Return the candidate for one law, or for a sum of laws."""
    if isinstance(law, laws.Sum):
        shaped = {k: s for k, s in enumerate(laws.summands(law)) if not isinstance(s, laws.Volumetric)}
        return _sum(label, {k: _candidate(f"{label}, summand {k}", s) for k, s in shaped.items()})
    if isinstance(law, laws.Ogden):
        return _ogden(len(law.alpha))._replace(label=label)
    return _bogen()._replace(label=label) if isinstance(law, laws.Bogen) else _single(label, law)


def _sum(label: str, numbered: dict[int, Candidate]) -> Candidate:
    """Return the candidate for a sum of laws. The parameters have the same names as in a scene. For example, `1.mu` is
    the parameter mu of the second law, and `2.mu.0` is the first mu of the third law.

    Args:
        label: label of the candidate.
        numbered: dictionary: place of a law in the sum -> candidate of this law. A law that has only U(J) has no
            candidate.
    """
    parts = list(numbered.values())
    ends = np.cumsum([len(p.names) for p in parts])[:-1]  # each parameter has one unconstrained variable

    def values(u, scale):
        return jnp.concatenate([p.values(v, scale) for p, v in zip(parts, jnp.split(u, ends), strict=True)])

    def law(p):
        return laws.Sum(laws=tuple(part.law(v) for part, v in zip(parts, jnp.split(p, ends), strict=True)))

    def random(rng, n):
        return np.concatenate([p.random(rng, n) for p in parts], axis=1)

    return Candidate(
        label,
        tuple(f"{k}.{name.replace('[', '.').rstrip(']')}" for k, p in numbered.items() for name in p.names),
        tuple(unit for p in parts for unit in p.units),
        values,
        law,
        random,
        tuple(note for p in parts for note in p.notes),
        tuple(metadata for p in parts for metadata in p.fields),
    )


def incompressible_form(name: str) -> bool:
    """Return whether the energy of a law is an isochoric energy plus a volumetric energy U(J)."""
    return laws.isochoric_part(laws.typical(name)) is not None


def _single(label: str, typical: Law) -> Candidate:
    fields, notes = _fitted(label, typical)
    names = tuple(f.name for f in fields)
    middle = np.array([float(getattr(typical, n)) for n in names])
    positive = np.array([f.metadata.get("above") == 0 for f in fields])
    modulus = np.array([f.metadata["unit"] == "Pa" for f in fields])
    # If the law has only terms of higher order, its shear modulus is 0. Then its largest parameter in Pa is the scale.
    size = abs(ground_state_modulus(typical)) or np.abs(middle[modulus]).max(initial=0.0)
    middle = middle / np.where(modulus, size, 1.0)

    def values(u, scale):
        unit = jnp.where(modulus, scale, 1.0)
        return unit * jnp.where(positive, jnp.exp(jnp.where(positive, u, 0.0)), u)

    def random(rng, n):
        near = np.log(np.abs(middle)) + 1.5 * rng.standard_normal((n, len(names)))
        u = np.where(positive, near, middle * np.exp(rng.standard_normal((n, len(names)))))
        # An exponent alpha without the bound `above=0` may be positive or negative. The other parameters without this
        # bound are coefficients and keep their signs.
        alpha = np.array([m == "alpha" for m in names]) & ~positive
        return np.where(alpha, _exponents_of_law(rng, (n, len(names))), u)

    def law(p):
        return replace(typical, **dict(zip(names, p, strict=True))).isochoric_part()

    units = tuple("Pa" if m else "1" for m in modulus)
    return Candidate(label, names, units, values, law, random, notes, tuple(f.metadata for f in fields))


def out_of_bounds(candidate: Candidate, values: np.ndarray, limits: Collection[str]) -> list[str]:
    """Return a warning for each fitted value outside the bounds of its parameter. The fit itself considers only the
    bound `above=0`.

    Args:
        candidate: the fitted law.
        values: the values (p,) of its parameters.
        limits: names of the parameters that went to a limit. These parameters already have a warning.
    """
    told = []
    for name, value, metadata in zip(candidate.names, values.tolist(), candidate.fields, strict=True):
        try:
            bounds.check_bound(name, metadata, value)
        except InputError:
            if name not in limits and np.isfinite(value):
                told.append(
                    f"{name} = {value:.4g} is out of the bounds of the law, so scenes refuse it: use a law without "
                    "this parameter, or change the bounds of the law"
                )
    return told


def _fitted(label: str, law: Law) -> tuple[list, tuple[str, ...]]:
    """Return the fitted parameters (fields) of the law, and notes on the other parameters. A parameter is not fitted if
    its value is 0 or missing.

    Raises:
        InputError: a parameter is a list, or no parameter is left to be fitted.
    """
    fields = [f for f in laws.parameters(type(law)) if f.name != "bulk"]
    absent = [f.name for f in fields if getattr(law, f.name) is None]
    given = [f for f in fields if f.name not in absent]
    for f in given:
        if isinstance(getattr(law, f.name), Law) or np.ndim(getattr(law, f.name)) > 0:
            raise InputError(
                f"law {label}: {f.name} of {type(law).__name__} is not a single number, but the fit of curves needs a "
                "law whose parameters are single numbers"
            )
    zero = [f.name for f in given if float(getattr(law, f.name)) == 0]
    fitted = [f for f in given if f.name not in zero]
    if not fitted:
        raise InputError(
            f"no parameter of law {label} has a value other than 0, so none can be fitted: give a value to each "
            "parameter that is to be fitted"
        )
    notes = []
    if zero:
        notes.append(f"the given value 0 is kept for {', '.join(zero)}")
    if absent:
        notes.append(
            f"no value is given or fitted for {', '.join(absent)} (to fit such a parameter, give a value in a law "
            "FILE.py:LAW)"
        )
    told = f"{label}: the fitted parameters are {', '.join(f.name for f in fitted)}; " + "; ".join(notes)
    return fitted, (told,) if notes else ()


def ground_state_modulus(law: Law) -> float:
    """Return the shear modulus [Pa] in the undeformed state. If the law cannot compute this modulus, dP12/dF12 in this
    state is returned (P: first Piola-Kirchhoff stress, F: deformation gradient)."""
    try:
        return float(law.shear_modulus())
    except InputError:
        return float(law.tangent(jnp.eye(3))[0, 1, 0, 1])


def _exponents_of_law(rng: np.random.Generator, shape: tuple) -> np.ndarray:
    return rng.choice([-1.0, 1.0], shape) * np.exp(rng.uniform(np.log(0.5), np.log(30.0), shape))


def _ogden_starts(rng: np.random.Generator, n: int, terms: int) -> np.ndarray:
    share = rng.dirichlet(np.ones(terms), n)
    return np.concatenate(
        [np.log(share + 1e-3) + 0.5 * rng.standard_normal((n, terms)), _exponents_of_law(rng, (n, terms))], 1
    )


def _ogden(terms: int) -> Candidate:
    """Return the candidate for Ogden's law. In every term k the shear modulus mu_k alpha_k / 2 is above 0, so the law
    is stable at every stretch."""
    names = tuple(f"{n}[{k}]" for n in ("mu", "alpha") for k in range(terms))

    def values(u, scale):
        alpha = u[terms:]
        return jnp.concatenate([2 * scale * jnp.exp(u[:terms]) / alpha, alpha])

    def law(p):
        return laws.Ogden(mu=tuple(p[:terms]), alpha=tuple(p[terms:]), bulk=None)

    label = f"ogden, {terms} term{'s' if terms > 1 else ''}"
    units, starts = ("Pa",) * terms + ("1",) * terms, partial(_ogden_starts, terms=terms)
    return Candidate(label, names, units, values, law, starts, fields=({},) * (2 * terms))


def _bogen() -> Candidate:
    """Return the candidate for the law `Bogen`, which is one term of Ogden's law."""

    def law(p):
        return laws.Bogen(mu=p[0], alpha=p[1], bulk=None)

    return _ogden(1)._replace(label="bogen", names=("mu", "alpha"), law=law)
