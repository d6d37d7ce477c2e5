"""Isotropic laws of thin layers, which have no stress through the thickness, and of bars."""

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp

from liverjax.core.errors import InputError
from liverjax.core.struct import replace
from liverjax.laws.base import Law
from liverjax.laws.registry import create, find

#: Number of iterations that find the thickness stretch, and maximum change of its logarithm in one iteration.
_ITERATIONS, _LONGEST = 30, 0.5


def read_layer(table: object, name: str) -> Law:
    """Read the law of a layer or bar from its table. The bulk modulus has no effect and may be omitted.

    Raises:
        InputError: a law or parameter is unknown. The message begins with `name`.
    """
    if not isinstance(table, dict) or "name" not in table:
        raise InputError(f'{name}.law needs name = "…": python -m liverjax laws lists the names')
    values = {key: value for key, value in table.items() if key != "name"}
    fields = {f.name: f for f in dataclasses.fields(find(table["name"]))}  # type: ignore[arg-type]
    without = "bulk" in fields and "bulk" not in values
    try:
        law = create(table["name"], **values | ({"bulk": 1.0} if without else {}))
    except InputError as error:
        raise InputError(f"{name}: {error}") from None
    return replace(law, bulk=None) if without else law


def check(law: Law, name: str) -> None:
    """Check that a law can be used for a layer or bar.

    Raises:
        InputError: the law has directions or is written in Green's strain (in these two cases, the message begins with
            `name`), or the parameters of the law contradict each other.
    """
    if any(one.fibre is not None or one.green_energy is not None for one in law.summands()):
        raise InputError(
            f"{name}.law cannot be used, because a layer or bar needs an isotropic law that is not written in Green's "
            "strain: use another law"
        )
    law.check()


def in_plane_energy(law: Law, C: tuple, solved: bool) -> jax.Array:
    """Return the energy density (Q, m) [Pa] of a layer without stress through its thickness, at Q points of m elements.

    Args:
        law: isotropic law.
        C: C_11, C_12, C_22 (Q, m) of the in-plane right Cauchy-Green tensor.
        solved: whether the thickness stretch is an unknown. If true, the law is evaluated at the J for which the stress
            through the thickness is 0. If false, it is evaluated at J = 1.
    """
    f11 = jnp.sqrt(C[0])
    f12 = C[1] / f11
    f22 = jnp.sqrt(C[2] - f12 * f12)

    def density(log_stretch: jax.Array) -> jax.Array:
        zero = jnp.zeros_like(f11)
        F = ((f11, f12, zero), (zero, f22, zero), (zero, zero, jnp.exp(log_stretch)))
        return law.strain_energy(law.measures(F))

    thinner = -jnp.log(f11 * f22)
    return density(_thinned(density, thinner) if solved else thinner)


def _thinned(density: Any, start: jax.Array) -> jax.Array:
    """Return the logarithm (Q, m) of the thickness stretch at which the energy `density` has its minimum.

    The iterations begin at `start`. The first and second derivatives of the result are exact.
    """

    def slope(u: jax.Array) -> jax.Array:
        return jax.jvp(density, (u,), (jnp.ones_like(u),))[1]

    def newton(u: jax.Array) -> jax.Array:
        first, second = jax.jvp(slope, (u,), (jnp.ones_like(u),))
        # A division by |second| gives a step that decreases the energy even if the energy is not convex.
        return u - jnp.clip(first / jnp.where(second == 0, 1.0, jnp.abs(second)), -_LONGEST, _LONGEST)

    frozen = jax.lax.stop_gradient
    u = jax.lax.fori_loop(0, _ITERATIONS, lambda _, u: frozen(newton(u)), frozen(start))
    # At the solution, one more iteration makes the first derivative exact, and another one the second derivative.
    return newton(newton(u))


def axial_energy(law: Law, stretch: jax.Array) -> jax.Array:
    """Return the energy density [Pa] of a bar in tension at constant volume, as a function of its stretch."""
    side, zero = 1 / jnp.sqrt(stretch), jnp.zeros_like(stretch)
    return law.strain_energy(law.measures(((stretch, zero, zero), (zero, side, zero), (zero, zero, side))))
