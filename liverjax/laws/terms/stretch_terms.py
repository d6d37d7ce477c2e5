"""Hand-derived stress and stiffness of energies w(Xi(alpha_1), …) of the principal stretches lambda_m.

Here Xi(alpha) = sum_m (J^(-1/3) lambda_m)^alpha, with exponents alpha and the volume ratio J.

In the principal axes, the second Piola-Kirchhoff stress S is diagonal: S_m = tau_m / lambda_m^2 with
tau_m = dw/d ln lambda_m. The moduli are

    C_mmnn = (d2w/d ln lambda_m d ln lambda_n - 2 delta_mn tau_m) / (lambda_m lambda_n)^2
    C_mnmn = (S_m - S_n) / (lambda_m^2 - lambda_n^2).

The formula for C_mnmn is evaluated such that it is exact if stretches are equal. The A H A form of the book chapter
(section 4.1.2) contains a geometric mean instead of this formula. This mean is correct only for alpha = 2 and 4.

The values of stress and moduli are computed with these formulas. Other derivatives are computed from an expansion of
the energy, in which the principal axes are constant (`liverjax.tensors.principal`). If stretches are equal, this
expansion is smooth, but the principal axes are not.
"""

from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax.custom_derivatives import SymbolicZero

from liverjax.core.struct import Number
from liverjax.laws.energies import Energies
from liverjax.tensors.material_axes import (
    PAIRS,
    SIX,
    anisotropic,
    half_contracted,
    pushed,
    rotated,
    six_of,
    symmetric,
)
from liverjax.tensors.matrices import Matrix, Vector, add, determinant, dot, matmul, stored, transpose
from liverjax.tensors.principal import change, expanded_power_sum, principal, sinh_ratio

#: Logarithms of the principal stretches, and principal axes (`liverjax.tensors.principal`). Derivatives treat both as
#: constants.
Frame = tuple[Vector, Matrix]


class Principal(NamedTuple):
    """Values at one deformation gradient F that both stress and moduli need."""

    logs: Vector  # ln lambda_m
    axes: Matrix
    inverse: Vector  # 1 / lambda_m^2
    alphas: tuple
    first: tuple  # dw/dXi_k
    second: dict  # {(k, l): d2w/dXi_k dXi_l}
    powers: list  # t_km = (J^(-1/3) lambda_m)^alpha_k
    slopes: list  # dXi_k / d ln lambda_m
    tau: list  # dw / d ln lambda_m


def stretch_slopes(law: Energies, X: tuple) -> tuple[tuple, dict]:
    """Return dw/dX_k and {(k, l): d2w/dX_k dX_l}, hand-derived if the law defines them, otherwise by autodiff."""
    if law.stretch_derivatives is not None:
        return law.stretch_derivatives(*X)
    n = len(X)
    ones = [tuple(jnp.ones_like(x) if k == j else jnp.zeros_like(x) for j, x in enumerate(X)) for k in range(n)]

    def slope(k):
        return lambda *X: jax.jvp(law.stretch_energy, X, ones[k])[1]

    second = {(k, l): jax.jvp(slope(k), X, ones[l])[1] for k in range(n) for l in range(k, n)}
    return tuple(slope(k)(*X) for k in range(n)), second


def _at_stretches(law: Energies, F: Matrix, frame: Frame) -> Principal:
    logs, axes = frame
    mean_log = jnp.log(determinant(F)) / 3  # NaN for J < 0
    d = [e - mean_log for e in logs]
    alphas = law.exponents()
    first, second = stretch_slopes(law, tuple(sum(jnp.expm1(a * x) for x in d) for a in alphas))
    powers = [[jnp.exp(a * x) for x in d] for a in alphas]
    slopes = [[a * (t - sum(ts) / 3) for t in ts] for a, ts in zip(alphas, powers, strict=True)]
    tau = [sum(w * s[m] for w, s in zip(first, slopes, strict=True)) for m in range(3)]
    return Principal(logs, axes, tuple(jnp.exp(-2 * e) for e in logs), alphas, first, second, powers, slopes, tau)


def _principal_moduli(s: Principal) -> tuple[Matrix, Vector]:
    """Return the moduli C_mmnn as a matrix, and C_mnmn of the three pairs of axes."""

    def normal(m: int, n: int) -> jax.Array:
        h = -2 * s.tau[m] if m == n else 0.0
        for w, a, t in zip(s.first, s.alphas, s.powers, strict=True):
            h = h + w * a * a * ((t[m] if m == n else 0.0) - (t[m] + t[n]) / 3 + sum(t) / 9)
        for (k, l), w in s.second.items():
            a, b = s.slopes[k], s.slopes[l]
            h = h + w * (a[m] * b[n] if k == l else a[m] * b[n] + b[m] * a[n])
        return h * (s.inverse[m] * s.inverse[n])

    def shear(m: int, n: int) -> jax.Array:
        G = 0.0
        for w, a, t in zip(s.first, s.alphas, s.powers, strict=True):
            ratio = sinh_ratio(a / 2 - 1, s.logs[m] - s.logs[n])
            G = G + w * a * (jnp.sqrt(t[m] * t[n]) * ratio + sum(t) / 3)
        return G * (s.inverse[m] * s.inverse[n])

    return symmetric(tuple(normal(m, n) for m, n in SIX)), tuple(shear(m, n) for m, n in PAIRS)


# -- stress and moduli -------------------------------------------------------------------------------------------------


def stress(law: Energies, F: Matrix, frame: Frame) -> Matrix:
    """Return the second Piola-Kirchhoff stress [Pa] of w, without the volumetric energy. `frame`: `principal(F)`."""
    return symmetric(_stress(_arrays(law, F), F, frame))


def moduli(law: Energies, F: Matrix, frame: Frame) -> list[list]:
    """Return the moduli dS/dE [Pa] of the energy w: 6 x 6 components in coordinate axes. `frame`: `principal(F)`."""
    return _square(_moduli_of_axes(_arrays(law, F), F, frame))


def blocks(law: Energies, F: Matrix, frame: Frame, D: list[Vector], pairs: tuple) -> list[Matrix]:
    """Return the part of the stiffness d2w/dx_i dx_j per reference volume that contains the moduli.

    The result has one matrix for each pair (i, j) of nodes with shape vectors D.
    """
    C = stored(moduli(law, F, frame))
    half = stored([half_contracted(C, d) for d in D])
    return [pushed(F, anisotropic(half[j], D[i])) for i, j in pairs]


def _arrays(law: Energies, F: Matrix) -> jax.Array:
    """Return the law with its parameters as arrays in the precision of F, since whole numbers have no derivative."""
    return jax.tree.map(lambda v: jnp.asarray(v, jnp.result_type(F[0][0])), law)


_UPPER = tuple((a, b) for a in range(6) for b in range(a, 6))


def _square(upper: tuple) -> list[list]:
    entries = dict(zip(_UPPER, upper, strict=True))
    return [[entries[min(a, b), max(a, b)] for b in range(6)] for a in range(6)]


# A function with a custom derivative rule must not be linear in an argument. Otherwise JAX ignores the rule if the
# function is differentiated only with respect to this argument (forward over reverse mode).


def stress_at_constant(law: Energies, F: Matrix) -> Matrix:
    """Return the result of `stress` for constant F. JAX can differentiate it with respect to parameters of the law."""
    return symmetric(_stress.fun(_arrays(law, F), F, principal(F)))


@jax.custom_jvp
def _stress(law: Energies, F: Matrix, frame: Frame) -> tuple:
    s = _at_stretches(law, F, frame)
    diagonal = tuple(t * c for t, c in zip(s.tau, s.inverse, strict=True))
    scaled_axes = tuple(tuple(n * d for n, d in zip(row, diagonal, strict=True)) for row in s.axes)
    return tuple(dot(scaled_axes[i], s.axes[j]) for i, j in SIX)


@partial(_stress.defjvp, symbolic_zeros=True)
def _(primals, tangents):
    (law, F, frame), (law_dot, F_dot, _) = primals, tangents
    parts = []
    if _perturbed(F_dot):
        half = matmul(transpose(F), _filled_matrix(F_dot, F))
        dE = tuple((1.0 if i == j else 2.0) * 0.5 * (half[i][j] + half[j][i]) for i, j in SIX)
        parts.append(
            tuple(sum(c * e for c, e in zip(row, dE, strict=True)) for row in _square(_moduli_of_axes(law, F, frame)))
        )
    if _perturbed(law_dot):
        parts.append(jax.jvp(lambda law: _expanded_stress(law, F, frame), (law,), (_filled_matrix(law_dot, law),))[1])
    return _stress(law, F, frame), add(*parts)


@jax.custom_jvp
def _moduli_of_axes(law: Energies, F: Matrix, frame: Frame) -> tuple:
    s = _at_stretches(law, F, frame)
    normal, shear = _principal_moduli(s)
    n = transpose(s.axes)
    squares = [tuple(n[m][i] * n[m][j] for i, j in SIX) for m in range(3)]
    weighted = [[dot(normal[m], (squares[0][a], squares[1][a], squares[2][a])) for a in range(6)] for m in range(3)]
    mixed = [tuple(n[p][i] * n[q][j] + n[q][i] * n[p][j] for i, j in SIX) for p, q in PAIRS]
    turned = [[G * w for w in six] for G, six in zip(shear, mixed, strict=True)]
    return tuple(sum(squares[m][a] * weighted[m][b] + mixed[m][a] * turned[m][b] for m in range(3)) for a, b in _UPPER)


@partial(_moduli_of_axes.defjvp, symbolic_zeros=True)
def _(primals, tangents):
    (law, F, frame), (law_dot, F_dot, _) = primals, tangents
    parts = []
    if _perturbed(F_dot):
        parts.append(jax.jvp(lambda F: _expanded_moduli(law, F, frame), (F,), (_filled_matrix(F_dot, F),))[1])
    if _perturbed(law_dot):
        parts.append(jax.jvp(lambda law: _expanded_moduli(law, F, frame), (law,), (_filled_matrix(law_dot, law),))[1])
    return _moduli_of_axes(law, F, frame), add(*parts)


def _perturbed(tangents: Number) -> bool:
    return not all(isinstance(t, SymbolicZero) for t in jax.tree.leaves(tangents, is_leaf=_vanishes))


def _filled_matrix(tangents: Number, like: Any) -> jax.Array:
    def fill(t, v):
        return jnp.zeros_like(v) if isinstance(t, SymbolicZero) else t

    return jax.tree.map(fill, tangents, like, is_leaf=_vanishes)


def _vanishes(t: Number) -> bool:
    return isinstance(t, SymbolicZero)


# -- stress and moduli from the expanded energy: slower, used for derivatives -----------------------------------------


def _expanded_energy(law: Energies, logs: Vector, axes: Matrix, log_J0: Number, Y: tuple) -> jax.Array:
    """Return w for the tensor C + Y. In the frozen principal axes N, this tensor is diag(lambda^2) + N^T Y N."""
    X = six_of(rotated(symmetric(Y), transpose(axes)))
    relative = [x * jnp.exp(-logs[i] - logs[j]) for x, (i, j) in zip(X, SIX, strict=True)]
    one_plus = symmetric(tuple(r + (1.0 if i == j else 0.0) for r, (i, j) in zip(relative, SIX, strict=True)))
    log_J = log_J0 + 0.5 * jnp.log(determinant(one_plus))
    return law.stretch_energy(*(expanded_power_sum(a, logs, X, log_J) for a in law.exponents()))


def _energy_of_change(law: Energies, F: Matrix, frame: Frame, orders: int) -> tuple[Any, tuple]:
    """Return the energy as a function of a change Y of C, and Y itself.

    The value of Y is 0, but its derivatives with respect to F are those of C, up to the order `orders`.
    """
    logs, axes = frame
    log_J0 = jax.lax.stop_gradient(jnp.log(determinant(F)))
    return partial(_expanded_energy, law, logs, axes, log_J0), change(F, orders)


def _strain_derivatives(function: Any, Y: tuple) -> jax.Array:
    """Return the derivatives of `function` with respect to the six entries of E (first axis).

    Y is the change of C, so dY = 2 dE. A shear component occurs at two positions of the tensor, so its factor is 1,
    not 2.
    """

    def along(direction):
        tangents = tuple(d * jnp.ones_like(y) for d, y in zip(direction, Y, strict=True))
        return jax.jvp(function, (Y,), (tangents,))[1]

    return jax.vmap(along)(jnp.diag(jnp.array([2.0, 2.0, 2.0, 1.0, 1.0, 1.0], jnp.result_type(Y[0]))))


def _expanded_stress(law: Energies, F: Matrix, frame: Frame) -> tuple:
    energy, Y = _energy_of_change(law, F, frame, 2)
    return tuple(_strain_derivatives(energy, Y))


def _expanded_moduli(law: Energies, F: Matrix, frame: Frame) -> tuple:
    energy, Y = _energy_of_change(law, F, frame, 1)
    C = _strain_derivatives(lambda Y: _strain_derivatives(energy, Y), Y)
    return tuple(C[a, b] for a, b in _UPPER)
