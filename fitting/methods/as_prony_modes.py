"""Convert any linear viscoelastic model to Prony modes for the simulation, and compute the largest error in the band.

The relaxation times are fixed, equally spaced on a log axis. The strengths (moduli of the modes) minimise the sum
of the squared relative errors of G' and G''; no strength is negative. As long as the same strengths are positive, all
strengths are linear functions of the model's moduli. So the conversion can be differentiated.
"""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from fitting.methods.generalised_maxwell import Maxwell, non_negative
from fitting.methods.host import Array, arrays_of

#: Maximum relative error of G' and G'' in the band that a conversion may have.
ALLOWED = 0.01
#: PER_DECADE: frequencies per decade at which a conversion is computed and checked. MARGINS: distances [decades] that
#: are tried between each end of the band and the outermost relaxation time there. MOST: maximum number of modes.
PER_DECADE, MARGINS, MOST = 20, (0.0, 0.25, 0.5, 1.0, 2.0), 60


class Conversion(NamedTuple):
    """The linear map from the moduli of a model at n frequencies to N Prony modes that represent this model."""

    omega: np.ndarray  # (n,) [rad/s], frequencies over the band
    times: np.ndarray  # (N,) [s], descending
    solid: bool  # whether the first strength is an equilibrium modulus
    strengths_of: np.ndarray  # (N + solid, 2n): matrix from the moduli (G', then G'') to the strengths [Pa]
    error: float  # largest relative difference of G' and G'' between modes and model


def _columns_of_modes(omega: np.ndarray, times: np.ndarray, solid: bool) -> np.ndarray:
    x = omega[:, None] * times
    A = np.vstack([x**2 / (1 + x**2), x / (1 + x**2)])
    rest = np.concatenate([np.ones(len(omega)), np.zeros(len(omega))])
    return np.column_stack([rest, A]) if solid else A


def convert(
    moduli: Callable[[np.ndarray], tuple[np.ndarray, np.ndarray]], low: float, high: float, solid: bool
) -> Conversion:
    """Convert a model to the smallest number of modes whose error is below `ALLOWED`. If no number up to `MOST` reaches
    this error, the modes with the smallest error are used.

    Args:
        moduli: function from angular frequencies (n,) [rad/s] to G' and G'' (n,) [Pa].
        low, high: ends of the frequency band [rad/s].
        solid: whether the model has an equilibrium modulus. If False, the modes get an equilibrium modulus only if
            the error of modes without this modulus is too large.
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
    if not solid and best[0] > ALLOWED:  # for example a springpot with a small exponent: it is nearly a spring
        with_rest = convert(moduli, low, high, solid=True)
        if with_rest.error < best[0]:
            return with_rest
    error, times, strengths, A = best
    kept = strengths[solid:] > 1e-9 * strengths.sum()
    columns = np.concatenate([[True], kept]) if solid else kept
    if solid and strengths[0] <= 1e-12 * strengths.sum():  # the equilibrium modulus is zero: it is removed
        solid, columns = False, np.concatenate([[False], kept])
    weighed = A[:, columns] / target[:, None]
    return Conversion(omega, times[kept], solid, np.linalg.pinv(weighed) / target, error)


def modes(conversion: Conversion, moduli: tuple[Array, Array]) -> Maxwell:
    """Return the Prony modes for the moduli G' and G'' (…, n) [Pa] at `conversion.omega`, in NumPy or JAX."""
    xp = arrays_of(*moduli)
    strengths = xp.concatenate(moduli, axis=-1) @ conversion.strengths_of.T
    total = xp.sum(strengths, axis=-1)
    ratios = strengths[..., int(conversion.solid) :] / total[..., None]
    return Maxwell(total, ratios, xp.broadcast_to(xp.asarray(conversion.times), ratios.shape))
