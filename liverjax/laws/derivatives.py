"""Derivatives of a law's energy with respect to its invariants, by the chain rule and by automatic differentiation."""

from typing import Any

import jax
import jax.numpy as jnp

from liverjax.tensors.matrices import Invariants

First = dict[str, Any]
Second = dict[tuple[str, str], Any]

#: Names of the scalar invariants. A key of the second derivatives is a pair of names in this order.
ORDER = ("I1", "I2", "I4", "J")


def accumulate(total: dict, key: object, value: object) -> None:
    """Add `value` to the entry `key` of the dictionary `total` of derivatives. A missing entry is set to `value`."""
    total[key] = total[key] + value if key in total else value


def reduced(I: Invariants) -> tuple[Any, Any]:
    """Return the isochoric invariants Ibar1 = J^(-2/3) I1 and Ibar2 = J^(-4/3) I2.

    For J < 0, these invariants do not exist, and the results are NaN.
    """
    m = I.J ** (-2 / 3)
    return (None if I.I1 is None else m * I.I1), (None if I.I2 is None else m * m * I.I2)


def split_derivatives(law: Any, I: Invariants) -> tuple[First, Second]:
    """Return the first and second derivatives of w(Ibar1, Ibar2) with respect to I1, I2, J (chapter, section 4.1.2)."""
    m = I.J ** (-2 / 3)
    inverse_J = 1 / I.J
    Ibar = {"I1": m * I.I1} if "I1" in law.invariants else {}
    if "I2" in law.invariants:
        Ibar["I2"] = m * m * I.I2
    power = {"I1": m, "I2": m * m}
    p = {"I1": -2 / 3, "I2": -4 / 3}
    w1, w2 = _isochoric_derivatives(law, Ibar)
    slope_J = {a: p[a] * Ibar[a] * inverse_J for a in w1}  # dIbar_a/dJ

    first = {a: w * power[a] for a, w in w1.items()}
    first["J"] = sum(w * slope_J[a] for a, w in w1.items())
    second = {key: w * power[key[0]] * power[key[1]] for key, w in w2.items()}
    second["J", "J"] = sum(w * (p[a] - 1) * slope_J[a] * inverse_J for a, w in w1.items())
    for a, w in w1.items():
        second[a, "J"] = w * power[a] * p[a] * inverse_J
    for (a, b), w in w2.items():
        second[a, "J"] = second[a, "J"] + w * power[a] * slope_J[b]
        if a != b:
            second[b, "J"] = second[b, "J"] + w * power[b] * slope_J[a]
        second["J", "J"] = second["J", "J"] + (1 if a == b else 2) * w * slope_J[a] * slope_J[b]
    return first, second


def _isochoric_derivatives(law: Any, Ibar: dict) -> tuple[First, Second]:
    if law.isochoric_derivatives is not None:
        return law.isochoric_derivatives(Ibar.get("I1"), Ibar.get("I2"))
    return _scalar_derivatives(lambda **I: law.isochoric_energy(I.get("I1"), I.get("I2")), Ibar)


def autodiff_derivatives(law: Any, I: Invariants) -> tuple[First, Second]:
    """Compute the derivatives of `law.strain_energy` by forward mode, because the law defines only this energy."""
    values = {n: getattr(I, n) for n in ORDER if n in law.invariants}
    return _scalar_derivatives(lambda **v: law.strain_energy(I._replace(**v)), values)


def _scalar_derivatives(W: Any, values: dict) -> tuple[First, Second]:
    names = list(values)

    def slope(a):
        tangents = {n: jnp.ones_like(v) if n == a else jnp.zeros_like(v) for n, v in values.items()}
        return lambda v: jax.jvp(lambda v: W(**v), (v,), (tangents,))[1]

    def curvature(a, b):
        tangents = {n: jnp.ones_like(v) if n == b else jnp.zeros_like(v) for n, v in values.items()}
        return jax.jvp(slope(a), (values,), (tangents,))[1]

    first = {a: slope(a)(values) for a in names}
    return first, {(a, b): curvature(a, b) for k, a in enumerate(names) for b in names[k:]}
