"""Prony viscohyperelasticity (book chapter, section 4.2): S_v = S_h - sum_k gamma_k.

S_v is the second Piola-Kirchhoff stress of the viscoelastic body, and S_h is the stress of the law. Each mode k has one
internal (history) variable, the symmetric tensor gamma_k. It is the part of the stress that has relaxed in this mode.
The history variables are updated from step n-1 to step n by a recursion: gamma^n = a S^n + c S^(n-1) + b gamma^(n-1). S
is the stress that relaxes (S_h or its isochoric part), dt is the time step, and g and tau are the ratio and the
relaxation time of the mode. There are two schemes:

* ``"exponential"``: exact if the stress changes linearly during the step. e = exp(-dt/tau), q = (1 - e) tau/dt,
  a = g (1 - q), c = g (q - e), b = e. This scheme is of second order in dt.
* ``"backward_euler"``: as printed in the chapter, a = g dt/(dt + tau), c = 0, b = tau/(dt + tau). This scheme is of
  first order in dt. The old name "chapter" is accepted.

The history variables are updated once per accepted step. Their contribution to the stress (`recall`) is constant
during a step.
"""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import DTypeLike

from liverjax.core import bounds
from liverjax.core.errors import InputError
from liverjax.core.struct import Array, Number, param, static, struct
from liverjax.laws.base import Law, isochoric_part, volumetric_part
from liverjax.laws.terms import invariant_terms
from liverjax.physics.base import End, Pairs, Physics, Solid, Start, Step
from liverjax.tensors.material_axes import SIX, symmetric
from liverjax.tensors.matrices import (
    Matrix,
    Vector,
    add_matrices,
    deformation_gradient,
    determinant,
    dot,
    matmul,
    matvec,
    right_cauchy_green,
    scale_matrix,
)

SCHEMES = ("exponential", "backward_euler")
PARTS = ("all", "isochoric")


@struct
class Prony:
    """Prony series alpha(t) = 1 - sum_k g_k (1 - exp(-t/tau_k)): stress at time t, divided by the initial stress.

    The series has N modes k. At constant strain, the fraction 1 - sum_k g_k of the stress remains after a long time.
    """

    ratios: Any = param("1", "g_k, fraction that relaxes in mode k (N,), or per element (N, E)", lower=0.0, upper=1.0)
    relaxation_times: Any = param("s", "tau_k (N,), or one per element (N, E)", above=0.0)
    part: str = static(
        default="all",
        about="all: the whole stress relaxes (as printed in the chapter); isochoric: its isochoric part (Fig. 3)",
        words=PARTS,
    )
    scheme: str = static(
        default="exponential", about="exponential or backward_euler (as in the chapter)", words=SCHEMES
    )

    def __post_init__(self) -> None:
        """Replace the old name "chapter" of a scheme by its new name "backward_euler"."""
        if self.scheme == "chapter":
            object.__setattr__(self, "scheme", "backward_euler")


class History(NamedTuple):
    """History variables of N modes at the end of a step: six components of symmetric tensors.

    The last axes are (Q, E), not (E,), if elements have Q integration points.
    """

    gamma: jax.Array  # (N, 6, E) [Pa] stress that has relaxed in each mode
    stress: jax.Array | None  # (6, E) [Pa] stress S^n that relaxes; None for backward Euler


class Recall(NamedTuple):
    """Contribution of the history variables to the stress in a step. It is constant during Newton's iterations."""

    past: Matrix  # [Pa] known part of the relaxed stress: sum_k (c_k S^(n-1) + b_k gamma_k^(n-1))
    now: jax.Array  # factor of the current stress, 1 - sum_k a_k: one number, or one per element or integration point


def check_viscosity(prony: Prony, law: Law) -> None:
    """Check that this viscosity can be used in a step, together with this law.

    Raises:
        InputError: the scheme or part is unknown; there are not as many ratios as relaxation times; a value is out of
            bounds; the ratios add up to 1 or more; or part is "isochoric" and the law has no isochoric part.
    """
    check_series(prony)
    check_part(prony.part, law, "viscosity")


def check_part(part: str, law: Law, section: str) -> None:
    """Check that the law has the part that relaxes. The parameters of the law are not checked.

    Raises:
        InputError: part is "isochoric" and the law has no isochoric part.
    """
    if part == "isochoric" and isochoric_part(law) is None:
        raise InputError(
            f"{section} part = 'isochoric' needs a law with an isochoric part, unlike {type(law).__name__}: "
            "use part = 'all', or a law with the parameter bulk"
        )


def check_series(prony: Prony) -> None:
    """Check that ratios and times form a Prony series.

    Inside jit their values may be unknown. Then only the number of ratios and the number of times are compared.

    Raises:
        InputError: there are not as many ratios as relaxation times, a value is out of bounds, or the ratios add up to
            1 or more.
    """
    bounds.check_fields(prony, "viscosity")
    both = (prony.ratios, prony.relaxation_times)
    for key, values in zip(("ratios", "relaxation_times"), both, strict=True):
        if not isinstance(values, (tuple, list)) and not np.ndim(values):
            raise InputError(
                f"viscosity.{key} = {values} is one number: give a list with one number per mode, e.g. [{values}]"
            )
    if any(isinstance(leaf, jax.core.Tracer) for leaf in jax.tree.leaves(both)):
        # NumPy cannot find the shape of a tuple of JAX tracers (numbers that are unknown inside jit).
        ratios, times = (len(v) if isinstance(v, (tuple, list)) else (*np.shape(v), 1)[0] for v in both)
        if ratios != times:
            raise InputError(
                f"viscosity has {ratios} ratios and {times} relaxation_times: give one ratio and one relaxation time "
                "for each mode"
            )
        return
    g, tau = (np.atleast_1d(np.asarray(v, float)) for v in both)
    if g.shape != tau.shape:
        raise InputError(
            f"viscosity has {g.size} ratios and {tau.size} relaxation_times: give one ratio and one relaxation time "
            "for each mode"
        )
    if not np.all(g.sum(axis=0) < 1):
        shown = g if g.ndim == 1 else g[:, int(np.argmax(g.sum(axis=0)))]
        raise InputError(f"viscosity.ratios = {shown.tolist()} must add up to less than 1: give smaller ratios")


def coefficients(prony: Prony, dt: Any) -> tuple[jax.Array, jax.Array, jax.Array]:
    """Return the coefficients a, b, c of the recursion gamma^n = a S^n + c S^(n-1) + b gamma^(n-1), for dt [s].

    Each coefficient has the shape of the ratios: (N,) for N modes, or (N, E).
    """
    g, tau = jnp.asarray(prony.ratios), jnp.asarray(prony.relaxation_times)
    r = dt / tau
    if prony.scheme == "backward_euler":
        return g * r / (1 + r), 1 / (1 + r), jnp.zeros_like(g)
    one_minus_q, q_minus_e = _weights(r)
    return g * one_minus_q, jnp.exp(-r), g * q_minus_e


def lasting(prony: Prony, order: int = 1) -> jax.Array:
    """Return the fraction of the stress that never relaxes: one number (), or one per element (E,).

    For elements of an `order` above 1 the shape is (1, E) instead of (E,), so that it broadcasts over integration
    points.
    """
    left = 1 - jnp.sum(jnp.asarray(prony.ratios), axis=0)
    return left[None] if left.ndim and order > 1 else left


def _beside(numbers: jax.Array, ndim: int) -> jax.Array:
    """Add axes to `numbers` (N,) or (N, E), so that they broadcast with arrays (N, 6, …, E) of `ndim` dimensions."""
    if numbers.ndim == 1:
        return numbers[(slice(None), *(None,) * (ndim - 1))]
    return numbers[(slice(None), *(None,) * (ndim - 2))]


def _weights(r: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Return 1 - q and q - e of the exponential scheme (docstring of the module) for r = dt/tau, without cancellation.

    Below r = 1, the truncated Taylor series of 1 - q is used. Its error is below 1/20!.
    """
    # At r = 1 (time step equal to a relaxation time), `minimum` and `maximum` would give half of the derivative.
    small, large = jnp.where(r < 1, r, 1.0), jnp.where(r < 1, 1.0, r)
    series = jnp.zeros_like(r)
    for k in range(18, 0, -1):
        series = small / (k + 1) * (1 - series)
    q = -jnp.expm1(-large) / large
    one_minus_q = jnp.where(r < 1, series, 1 - q)
    return one_minus_q, jnp.where(r < 1, -jnp.expm1(-small) - series, q - jnp.exp(-large))


def complex_ratios(prony: Prony, omega: Number, dt: Number | None = None) -> jax.Array:
    """Return the complex ratios gamma_k / S_h (N, ...) of N modes in steady vibration.

    Ratios and times must have the shape (N,). If they differ between elements, call this function for each element.

    gamma_k is the stress that has relaxed in mode k, and S_h the stress of the law. `omega` [rad/s] are angular
    frequencies. With `dt` [s] the ratios are exact for the time-discrete recursion. Without `dt` they are the ratios in
    continuous time, g/(1 + i omega tau). The complex modulus G*, divided by the instantaneous modulus G0, is 1 minus
    the sum of the ratios over the modes.
    """
    omega = jnp.asarray(omega)[None]
    column = (-1,) + (1,) * (omega.ndim - 1)
    g, tau = (jnp.reshape(jnp.asarray(v), column) for v in (prony.ratios, prony.relaxation_times))
    if dt is None:
        return g / (1 + 1j * omega * tau)
    dt = jnp.broadcast_to(dt, omega.shape[1:])[None]
    a, b, c = coefficients(Prony(ratios=g, relaxation_times=tau, scheme=prony.scheme), dt)
    back = jnp.exp(-1j * omega * dt)
    return (a + c * back) / (1 - b * back)


def initial_history(prony: Prony, points: int | tuple[int, ...], dtype: DTypeLike = float) -> History:
    """Return the history variables (zeros) of a body at rest.

    `points` is the number of integration points, or their shape (Q, E) with Q points in each of E elements.
    """
    shape = (points,) if isinstance(points, int) else points
    gamma = jnp.zeros((jnp.asarray(prony.ratios).shape[0], 6, *shape), dtype)
    return History(gamma, None if prony.scheme == "backward_euler" else jnp.zeros((6, *shape), dtype))


def relaxed_history(prony: Prony, stress: jax.Array) -> History:
    """Return the history variables after complete relaxation.

    `stress` (6, …) [Pa] is the part of the stress that relaxes.
    """
    gamma = _beside(jnp.asarray(prony.ratios), 1 + stress.ndim) * stress[None]
    return History(gamma, None if prony.scheme == "backward_euler" else stress)


def recall(prony: Prony, history: History, dt: Array) -> Recall:
    """Return the contribution to the stress in a step, from the history variables at the beginning of the step."""
    a, b, c = coefficients(prony, dt)
    if a.ndim == 2:
        return _recall_by_element(a, b, c, history)
    modes = [b[k] * history.gamma[k] for k in range(b.shape[0])]
    past: Any = sum(modes[1:], modes[0]) if modes else jnp.zeros(history.gamma.shape[1:], history.gamma.dtype)
    if history.stress is not None:
        past = past + jnp.sum(c) * history.stress
    return Recall(symmetric(tuple(past)), 1 - jnp.sum(a))


def _recall_by_element(a: jax.Array, b: jax.Array, c: jax.Array, history: History) -> Recall:
    """Return the result of `recall` for coefficients a, b, c (N, E) with one value per mode and element."""
    ndim = history.gamma.ndim
    past = jnp.sum(_beside(b, ndim) * history.gamma, axis=0)
    if history.stress is not None:
        past = past + _beside(jnp.sum(c, axis=0)[None], ndim)[0] * history.stress
    now = 1 - jnp.sum(a, axis=0)
    return Recall(symmetric(tuple(past)), now if ndim == 3 else now[None])


def advance(prony: Prony, history: History, law: Law, F: Matrix, dt: Number) -> History:
    """Return the history variables at the end of an accepted step, from those at its beginning.

    F is the deformation gradient at the end of the step.
    """
    a, b, c = coefficients(prony, dt)
    S = relaxing_stress(prony, law, F)
    a, b, c = (_beside(each, 1 + S.ndim) for each in (a, b, c))
    gamma = a * S[None] + b * history.gamma
    if history.stress is None:
        return History(gamma, None)
    return History(gamma + c * history.stress[None], S)


def relaxing_stress(prony: Prony, law: Law, F: Matrix) -> jax.Array:
    """Return the second Piola-Kirchhoff stress (6, E) [Pa] that relaxes: that of the law, or its isochoric part."""
    s = invariant_terms.state(relaxing(prony, law), F)
    S = invariant_terms.second_piola(F, invariant_terms.stress(s))
    return jnp.stack([S[i][j] for i, j in SIX])


def first_piola(prony: Prony, memory: Recall, law: Law, F: Matrix) -> Matrix:
    """Return the first Piola-Kirchhoff stress P_v = (1 - sum a) P_h - F past [Pa], with the stress P_h of the law.

    `memory.now` is 1 - sum a, and `memory.past` is `past`. If part is "isochoric", P_h is the isochoric stress of the
    law, and the complete volumetric stress is added.
    """
    P = invariant_terms.first_piola(relaxing(prony, law), F)
    remembered = matmul(F, memory.past)
    P = tuple(tuple(memory.now * P[i][j] - remembered[i][j] for j in range(3)) for i in range(3))
    rest = volumetric_part(law) if prony.part == "isochoric" else None
    if rest is None:
        return P
    U = invariant_terms.first_piola(rest, F)
    return tuple(tuple(P[i][j] + U[i][j] for j in range(3)) for i in range(3))


def blocks(
    prony: Prony, memory: Recall, law: Law, F: Matrix, D: list[Vector], pairs: tuple[tuple[int, int], ...]
) -> list[Matrix]:
    """Return the stiffness blocks (1 - sum a) K_h - (D_i . past D_j) I of the stress `first_piola`, for pairs (i, j).

    i and j are nodes of an element. K_h are the blocks of the law (`invariant_terms.blocks`), D the gradients of the
    shape functions, I the identity.
    """
    K = invariant_terms.blocks(invariant_terms.state(relaxing(prony, law), F), D, pairs)
    K = [scale_matrix(memory.now, block) for block in K]
    result = []
    for (i, j), block in zip(pairs, K, strict=True):
        metric = dot(D[i], matvec(memory.past, D[j]))
        result.append(tuple(tuple(block[r][c] - (metric if r == c else 0.0) for c in range(3)) for r in range(3)))
    rest = volumetric_part(law) if prony.part == "isochoric" else None
    if rest is None:
        return result
    return [
        add_matrices(a, b)
        for a, b in zip(result, invariant_terms.blocks(invariant_terms.state(rest, F), D, pairs), strict=True)
    ]


def relaxing(prony: Prony, law: Law) -> Law:
    """Return the part of a law that relaxes: the whole law, or its isochoric part."""
    return law if prony.part == "all" else isochoric_part(law)


@struct
class Viscoelasticity(Physics):
    """A solid with a hyperelastic law, whose stress relaxes according to a Prony series."""

    law: Law = param("1", "the instantaneous law")
    prony: Prony = param("1", "how it relaxes")

    def begin(self, start: Start) -> History:
        """Return the history variables at the beginning of a run, which are zeros.

        Exception: if the body was just moved to its positions, the stored stress S^n is the stress at these positions.
        """
        memory = initial_history(self.prony, start.mesh.weights.shape, start.x.dtype)
        if memory.stress is None or not start.moved:
            return memory
        F = deformation_gradient(start.mesh, start.x)
        # In inverted elements F = I is used, so that the stored stress is 0.
        whole = determinant(F) > 0
        F = tuple(tuple(jnp.where(whole, F[i][j], float(i == j)) for j in range(3)) for i in range(3))
        return memory._replace(stress=relaxing_stress(self.prony, self.law, F))

    def freeze(self, memory: History, step: Step) -> "Viscoelastic":
        """Return the force term of the relaxing law for one step."""
        return Viscoelastic(law=self.law, prony=self.prony, recall=recall(self.prony, memory, step.dt), dt=step.dt)

    def advance(self, memory: History, acting: "Viscoelastic", end: End) -> History:
        """Return the history variables, updated with the stress at the end of the step."""
        return advance(self.prony, memory, self.law, end.F, acting.dt)


@struct
class Viscoelastic(Solid):
    """Force term of a relaxing law, for one step."""

    law: Law = param("1", "the instantaneous law")
    prony: Prony = param("1", "how it relaxes")
    recall: Recall = param("1", "contribution of the history variables to the stress")
    dt: jax.Array = param("s", "time step")

    def stress(self, F: Matrix) -> Matrix:
        """Return the first Piola-Kirchhoff stress [Pa] from the function `first_piola`."""
        return first_piola(self.prony, self.recall, self.law, F)

    def blocks(self, F: Matrix, D: list[Vector], pairs: Pairs) -> list[Matrix]:
        """Return the stiffness blocks from the function `blocks` of this module."""
        return blocks(self.prony, self.recall, self.law, F, D, pairs)

    def energy(self, F: Matrix) -> jax.Array:
        """Return the incremental potential (1 - sum a) W - past : C/2 [Pa], with the strain energy W and C = F^T F.

        1 - sum a and `past` are the fields of `Recall`. If the volumetric energy U does not relax, the complete U is
        added.
        """
        law, past = relaxing(self.prony, self.law), self.recall.past
        C = right_cauchy_green(F)
        stored = sum(past[i][j] * C[i][j] for i in range(3) for j in range(3))
        W = self.recall.now * law.strain_energy(law.measures(F)) - 0.5 * stored
        rest = volumetric_part(self.law) if self.prony.part == "isochoric" else None
        return W if rest is None else W + rest.strain_energy(rest.measures(F))

    def parts(self) -> tuple[list[tuple[Any, Any]], Matrix]:
        """Return pairs (weight, law) for the relaxing part and the rest of the law, and the stress -`past` [Pa]."""
        rest = volumetric_part(self.law) if self.prony.part == "isochoric" else None
        weighted = [(self.recall.now, relaxing(self.prony, self.law))]
        return weighted if rest is None else [*weighted, (1.0, rest)], scale_matrix(-1.0, self.recall.past)
