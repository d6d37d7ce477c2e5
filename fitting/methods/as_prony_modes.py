"""Convert any linear viscoelastic model to Prony modes for the simulation; the largest error over the band is known.

The relaxation times are fixed, equally spaced on a log axis. The strengths come from non-negative least squares of the
relative errors of G' and G''. As long as the set of non-zero strengths stays the same, the strengths are linear in the
moduli of the model. So the conversion has derivatives.
"""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from fitting.methods.generalised_maxwell import Maxwell, non_negative
from fitting.methods.host import Array, arrays_of

#: Maximum relative error of G' and of G'' over the band in a conversion.
ALLOWED = 0.01
#: Frequencies per decade for the conversion and its check, margins of the times [decades], and maximum number of modes.
PER_DECADE, MARGINS, MOST = 20, (0.0, 0.25, 0.5, 1.0, 2.0), 60


class Conversion(NamedTuple):
    """The linear map from moduli at `omega` to Prony modes."""

    omega: np.ndarray  # (n,) [rad/s], over the band
    times: np.ndarray  # (N,) [s], descending
    solid: bool  # whether the first strength is an equilibrium modulus
    strengths_of: np.ndarray  # (N + solid, 2n): strengths [Pa] from G' then G''
    error: float  # largest relative error of G' and G'', for the converted model


def _columns_of_modes(omega: np.ndarray, times: np.ndarray, solid: bool) -> np.ndarray:
    x = omega[:, None] * times
    A = np.vstack([x**2 / (1 + x**2), x / (1 + x**2)])
    rest = np.concatenate([np.ones(len(omega)), np.zeros(len(omega))])
    return np.column_stack([rest, A]) if solid else A


def convert(
    moduli: Callable[[np.ndarray], tuple[np.ndarray, np.ndarray]], low: float, high: float, solid: bool
) -> Conversion:
    """Find the smallest number of modes with an error below `ALLOWED`, or else the best fit with at most `MOST` modes.

    Args:
        moduli: function from angular frequencies (n,) [rad/s] to G' and G'' (n,) [Pa].
        low, high: ends of the band [rad/s].
        solid: whether the model has an equilibrium modulus. If the modes need an equilibrium modulus, they get one in
            any case.
    """
    decades = np.log10(high / low)
    omega = np.geomspace(low, high, max(12, int(decades * PER_DECADE) + 1))
    target = np.concatenate(moduli(omega))
    best: tuple[float, np.ndarray, np.ndarray, np.ndarray] | None = None
    for modes in range(1, MOST + 1):
        for margin in MARGINS:
            ends = (10**margin / low, 10**-margin / high)
            times = np.geomspace(*ends, modes) if modes > 1 else np.array([np.sqrt(ends[0] * ends[1])])
            A = _columns_of_modes(omega, times, solid)
            strengths, _ = non_negative(A / target[:, None], np.ones(len(target)))
            error = float(np.abs(A @ strengths / target - 1).max())
            if best is None or error < best[0]:
                best = error, times, strengths, A
            if modes == 1:
                break
        assert best is not None
        if best[0] < ALLOWED:
            break
    assert best is not None
    if not solid and best[0] > ALLOWED:  # a small exponent: nearly a spring
        with_rest = convert(moduli, low, high, solid=True)
        if with_rest.error < best[0]:
            return with_rest
    error, times, strengths, A = best
    kept = strengths[solid:] > 1e-9 * strengths.sum()
    columns = np.concatenate([[True], kept]) if solid else kept
    if solid and strengths[0] <= 1e-12 * strengths.sum():  # a modulus of zero stays zero and has no slope
        solid, columns = False, np.concatenate([[False], kept])
    weighed = A[:, columns] / target[:, None]
    return Conversion(omega, times[kept], solid, np.linalg.pinv(weighed) / target, error)


def modes(conversion: Conversion, moduli: tuple[Array, Array]) -> Maxwell:
    """Prony modes of G' and G'' (…, n) at `conversion.omega`, in NumPy or JAX."""
    xp = arrays_of(*moduli)
    strengths = xp.concatenate(moduli, axis=-1) @ conversion.strengths_of.T
    total = xp.sum(strengths, axis=-1)
    ratios = strengths[..., int(conversion.solid) :] / total[..., None]
    return Maxwell(total, ratios, xp.broadcast_to(xp.asarray(conversion.times), ratios.shape))
