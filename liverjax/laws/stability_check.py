"""Stable range of a material law, and jumps of its energy or stress: rows of the gradient check."""

from collections.abc import Callable
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from liverjax.laws import Law, homogeneous

#: Limit for the relative difference of results that are equal apart from roundoff. It allows for sums of some hundred
#: terms, and for cancellation in deviatoric parts.
EXACT_LIMIT = 1e-10
#: Values at which stability is checked. Both arrays have the same length, so that they share one compiled program.
STRETCHES, SHEARS = np.linspace(0.2, 4.0, 381), np.linspace(0.0, 3.8, 381)


class Row(NamedTuple):
    """One row of the table. `passed` is None for a row that gives information but tests nothing."""

    name: str
    found: str
    limit: str
    passed: bool | None


def as_numbers(function: Callable, F: np.ndarray) -> np.ndarray:
    """Return the values of a function of deformation gradients as a NumPy array."""
    return np.asarray(function(jnp.asarray(F)), float)


def stability_rows(law: Law, tangent: Callable) -> tuple[list[Row], dict]:
    """Return rows with the ranges around rest in which the stress increases and the law is strongly elliptic.

    A row fails if the rest state is not stable. A law without stiffness at rest, for example a law with only fibres, is
    neither stable nor unstable at rest, so its row does not fail.
    """
    rows, ranges = [], {}
    stress = jax.jit(partial(homogeneous.nominal_stress, law))
    for test, what in homogeneous.TESTS.items():
        if test == "pure_shear":
            continue
        driven = SHEARS if what == "shear" else STRETCHES
        F = np.asarray(homogeneous.deformation_gradient(test, driven))
        P = as_numbers(stress, F)
        A = as_numbers(tangent, F)
        stable = _work_is_positive(test, driven, P) & (ellipticity(A) > 0)
        start = int(np.argmin(np.abs(driven - (0.0 if what == "shear" else 1.0))))
        low, high = _range(driven, stable, start)
        ranges[test] = (low, high)
        whole = " and maybe beyond" if (low, high) == (driven[0], driven[-1]) else ""
        text, passed = f"{what} {low:.3g} to {high:.3g}{whole}", (True if stable[start] else None)
        if not stable[start] and ellipticity(A[[start]])[0] >= -EXACT_LIMIT * np.abs(A[start]).max():
            text = "no stiffness at rest in some direction: add a law that has stiffness there"
        elif not stable[start]:
            text, passed = "not even at rest", False
        rows.append(Row(f"stable in {test.replace('_', ' ')}", text, "", passed))
    return rows, ranges


#: If the energy jumps in a step of the stretch, the change of the energy differs from the work of the stress. If the
#: difference is above the fraction `_MISSED` of the change, the step is divided into `_PARTS` substeps. The substep
#: with the largest difference is divided again, and so on (`_CUTS` divisions). A difference due to a jump stays in one
#: substep. Other differences become smaller with each division. A jump of the stress is found in the same way, from the
#: change of the stress and from the tangent.
_MISSED, _PARTS, _CUTS = 0.05, 32, 3


def jump_rows(energy: Callable, stress: Callable, tangent: Callable) -> list[Row]:
    """Return one row if energy or stress jumps: then its change is not the integral of its derivative.

    Otherwise return no row.

    The other checks use only single states, so they cannot find a jump.

    Args:
        energy, stress, tangent: functions of deformation gradients (n, 3, 3).
    """
    # If a law depends only on the volume, its energy is 0 in the tests at constant volume, apart from roundoff. If a
    # law is isochoric, its energy is 0 in the test "volume". So the roundoff is estimated from the larger of two
    # stresses: in a swollen state and in a sheared state.
    F = np.tile(1.1 * np.eye(3), (len(STRETCHES), 1, 1))
    F[0] = np.eye(3) + 0.1 * np.eye(3, k=1)
    roundoff = 1e-12 * np.nan_to_num(np.abs(as_numbers(stress, F))).max()
    work, slope = "nij,nij->n", "nijkl,nkl->nij"
    for name, function, derivative, product in (
        ("energy", energy, stress, work),
        ("stress", stress, tangent, slope),
    ):
        for path in (*homogeneous.TESTS, "volume"):
            missed = partial(_missed, function, derivative, product, path)
            found = _jump(missed, SHEARS if path == "simple_shear" else STRETCHES, roundoff)
            if found is not None:
                size, at = found
                what = homogeneous.TESTS.get(path, "J =")
                where = "" if path == "volume" else f" in {path.replace('_', ' ')}"
                other = "the stress does" if name == "energy" else "the tangent does"
                text = f"by {size:.3g} Pa at {what} {at:.3g}{where}"
                return [Row(f"the {name} jumps", text, f"{other} not show this jump", False)]
    return []


def _missed(
    function: Callable, derivative: Callable, product: str, path: str, driven: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return |change of the function - integral of its derivative| and |change| in each step, both (n - 1,) [Pa]."""
    if path == "volume":
        F = driven[:, None, None] ** (1 / 3) * np.eye(3)
    else:
        F = np.asarray(homogeneous.deformation_gradient(path, driven))
    values, slopes = as_numbers(function, F), as_numbers(derivative, F)
    with np.errstate(all="ignore"):
        change = np.diff(values, axis=0)
        gap = np.abs(change - np.einsum(product, 0.5 * (slopes[1:] + slopes[:-1]), np.diff(F, axis=0)))
        sides = tuple(range(1, values.ndim))
        return np.nan_to_num(gap, posinf=0.0).max(axis=sides), np.nan_to_num(np.abs(change)).max(axis=sides)


def _jump(missed: Callable, driven: np.ndarray, roundoff: float) -> tuple[float, float] | None:
    """Return size [Pa] and place of the first jump, or None if there is no jump."""
    gap, change = missed(driven)
    for k in np.flatnonzero(gap > _MISSED * change + 1e-9 * change.max() + roundoff):
        low, high, most = driven[k], driven[k + 1], gap[k]
        for _ in range(_CUTS):
            finer = np.linspace(low, high, _PARTS + 1)
            parts, _ = missed(finer)
            worst = int(np.argmax(parts))
            low, high = finer[worst], finer[worst + 1]
            if not 0.5 * most < parts[worst] < 2 * most:  # at a pole, the differences grow
                break
        else:
            return float(parts.max()), float(low)
    return None


def _work_is_positive(test: str, driven: np.ndarray, P: np.ndarray) -> np.ndarray:
    """Return whether the nominal stress increases at each of n states (n,).

    At the first and the last state, one-sided differences are used.
    """
    stress = np.asarray(homogeneous.measured(test, jnp.asarray(P)))
    with np.errstate(all="ignore"):
        return np.gradient(stress, driven) > 0


def ellipticity(A: np.ndarray) -> np.ndarray:
    """Return the minimum eigenvalue [Pa] of the acoustic tensor A_iJkL n_J n_L over 203 directions n, for every A.

    It is -inf if A is not finite.
    """
    k = np.arange(200) + 0.5
    z, angle = 1 - k / 200, np.pi * (1 + 5**0.5) * k  # the directions n are Fibonacci points on a half sphere
    n = np.stack([np.sqrt(1 - z * z) * np.cos(angle), np.sqrt(1 - z * z) * np.sin(angle), z], axis=1)
    n = np.concatenate([n, np.eye(3)])
    finite = np.isfinite(A).all(axis=(1, 2, 3, 4))
    acoustic = np.einsum("eijkl,dj,dl->edik", np.where(finite[:, None, None, None, None], A, 0.0), n, n, optimize=True)
    smallest = np.linalg.eigvalsh(0.5 * (acoustic + np.swapaxes(acoustic, -1, -2)))[..., 0].min(axis=1)
    return np.where(finite, smallest, -np.inf)


def _range(driven: np.ndarray, stable: np.ndarray, start: int) -> tuple[float, float]:
    low = high = start
    while low > 0 and stable[low - 1]:
        low -= 1
    while high < len(driven) - 1 and stable[high + 1]:
        high += 1
    return float(driven[low]), float(driven[high])
