"""Springpots for harmonic motion: fractional models of soft tissue, relative to the stiffness of the law.

A springpot has the complex modulus V (i omega)^alpha, with a constant V, the angular frequency omega and the exponent
alpha. It is between a spring (alpha = 0) and a dashpot (alpha = 1). With the stiffness G0 of the law, the model is

    G* / G0 = spring + sum_k 1 / ((i omega tau_k)^-alpha_k + 1 / limit_k).

The parameters of springpot k are explained in `SpringpotSeries`. Special cases with one springpot: spring = 0 gives the
springpot alone, and spring = 1 the fractional Kelvin-Voigt model. With a limit, a spring of stiffness limit_k G0 is in
series with springpot k. This is the fractional Zener model (Bagley and Torvik 1983, J. Rheol. 27, 201).
"""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from liverjax.core import bounds
from liverjax.core.errors import InputError
from liverjax.core.struct import Number, param, static, struct
from liverjax.laws.base import Law
from liverjax.physics.viscosity import PARTS, Prony, check_part


@struct
class SpringpotSeries:
    """A spring and K springpots in parallel. Their complex modulus is relative to the modulus of the law. They can be
    used only in harmonic motion."""

    times: Any = param("s", "tau_k (K,): at omega = 1/tau_k a springpot is as stiff as the law", above=0.0)
    exponents: Any = param("1", "alpha_k (K,): 0 is a spring, 1 a dashpot", lower=0.0, upper=1.0)
    limits: Any = param(
        "1",
        "stiffness of the spring in series with each springpot (K,), divided by the stiffness of the law",
        above=0.0,
        default=None,
    )
    spring: Number = param("1", "stiffness of the spring, divided by the stiffness of the law", lower=0.0, default=1.0)
    part: str = static(
        default="all", about="all: whole stress; isochoric: only the isochoric part of the stress", words=PARTS
    )


def check_springpots(own: SpringpotSeries, law: Law, viscosity: Prony | None) -> None:
    """Check that the springpots define a modulus. Do not call this function inside jit.

    Raises:
        InputError: the lists differ in length, a value is out of bounds, `part` is unknown, the law does not have this
            part, or the scene also has a viscosity.
    """
    if viscosity is not None:
        raise InputError("the scene has [viscosity] and [springpots]: remove one of them")
    bounds.check_fields(own, "springpots")
    shapes = {np.shape(a) for a in (own.times, own.exponents, own.limits) if a is not None}
    if len(shapes) != 1 or len(np.shape(own.times)) != 1:
        raise InputError(
            "times, exponents and limits of [springpots] must be lists of equal lengths: give one number of each list "
            "per springpot"
        )
    check_part(own.part, law, "springpots")


def check_spring_at_rest(own: SpringpotSeries | None, otherwise: str) -> None:
    """Check that spring and springpots leave a shear stiffness at rest. Numbers inside jit, grad or vmap are not
    checked.

    Args:
        own: the springpots; None is always accepted.
        otherwise: what the user can do instead of a larger spring. It is the end of the error message.

    Raises:
        InputError: the spring is 0, and no springpot has the exponent 0.
    """
    if own is None or any(isinstance(leaf, jax.core.Tracer) for leaf in jax.tree.leaves((own.spring, own.exponents))):
        return
    # Inside jit, jnp makes tracers of known numbers too, so this check uses NumPy.
    if not (np.any(np.asarray(own.spring)) or np.any(np.asarray(own.exponents) == 0)):
        raise InputError(
            "springpots.spring = 0 leaves no shear stiffness at rest, so the body has no state of rest under gravity "
            f"or tension: give spring above 0, {otherwise}"
        )


def series_at_rest(own: SpringpotSeries) -> Prony:
    """Return a Prony series whose completely relaxed stress is equal to the stress of the springpots at rest."""
    return Prony(ratios=1 - jnp.atleast_1d(factor_at_rest(own)), relaxation_times=jnp.ones(1), part=own.part)


def factor_at_rest(own: SpringpotSeries) -> jax.Array:
    """Return the ratio G*/G0 at frequency 0: the spring, and all springpots with exponent 0, which are springs too."""
    compliance = jnp.ones(()) if own.limits is None else 1 + 1 / jnp.atleast_1d(own.limits)
    springs = jnp.where(jnp.atleast_1d(own.exponents) == 0, 1 / compliance, 0.0)
    return jnp.asarray(own.spring) + jnp.sum(springs)


def springpot_factors(own: SpringpotSeries, omegas: jax.Array) -> jax.Array:
    """Return the complex ratios G*/G0 (F,) at F angular frequencies (F,) [rad/s]."""
    times, alpha = jnp.atleast_1d(own.times)[:, None], jnp.atleast_1d(own.exponents)[:, None]
    # (i omega tau)^-alpha has the phase -alpha pi/2.
    compliance = jnp.exp(-alpha * (jnp.log(omegas[None] * times) + 0.5j * jnp.pi))
    if own.limits is not None:
        compliance = compliance + 1 / jnp.atleast_1d(own.limits)[:, None]
    return jnp.asarray(own.spring) + jnp.sum(1 / compliance, axis=0)
