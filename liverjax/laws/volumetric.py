"""Volumetric energies U(J), and their first and second derivatives."""

import jax
import jax.numpy as jnp

from liverjax.core.errors import InputError
from liverjax.core.struct import Number


def _quadratic_energy(K, J):
    return 0.5 * K * (J - 1) ** 2, K * (J - 1), K * jnp.ones_like(J)


def _log(K, J):
    ln = jnp.log(J)
    return 0.5 * K * ln**2, K * ln / J, K * (1 - ln) / J**2


def _simo(K, J):
    # J^2 - 1 is computed as (J - 1)(J + 1), so that there is no cancellation at rest.
    return 0.25 * K * ((J - 1) * (J + 1) - 2 * jnp.log(J)), 0.5 * K * (J - 1) * (J + 1) / J, 0.5 * K * (1 + 1 / J**2)


#: Name -> function of bulk modulus K and volume ratio J that returns U, U' and U''.
#: U is K/2 (J-1)^2, K/2 ln^2 J or K/4 (J^2 - 1 - 2 ln J).
VOLUMETRIC = {"quadratic": _quadratic_energy, "log": _log, "simo": _simo}


def volumetric(kind: str, K: Number, J: Number) -> tuple[jax.Array, jax.Array, jax.Array]:
    """Return U, dU/dJ and d2U/dJ2 [Pa] for the bulk modulus K [Pa]. Raise `InputError` for an unknown kind."""
    if kind not in VOLUMETRIC:
        raise InputError(f"volumetric = {kind!r} is not known: use one of {', '.join(VOLUMETRIC)}")
    return VOLUMETRIC[kind](K, J)
