"""Fit a relaxation spectrum on a fixed grid of relaxation times, with non-negative strengths (moduli of the modes).
Where the data do not determine the strengths, the fitted strengths change smoothly with the relaxation time.

For fixed relaxation times, the moduli are linear in the strengths, so the fit has only one minimum. Each strength is
divided by the measured |G*| at omega = 1 / tau. A weighted penalty on the second differences of the strengths makes
them smooth. Method: Honerkamp and Weese (1989), Macromolecules 22. Grid and weight are chosen by the highest restricted
likelihood (Wahba 1985, Ann. Stat. 13). With this choice, the intervals contain the true values about as often as their
confidence level states. The information criterion would choose a larger weight, and the intervals would contain the
true values less often (`experiments/identification/coverage.py`).
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from fitting.methods.generalised_maxwell import mode_columns, non_negative
from fitting.methods.host import Array, arrays_of, exponential
from fitting.readers.rheometer import Sweep

#: GRIDS: grids that are tried [times per decade]. MARGIN: decades of the grid beyond the band on each side. WEIGHTS:
#: weights of the penalty that are tried.
GRIDS, MARGIN, WEIGHTS = (2, 3), 1.0, np.logspace(-6, 4, 31)
#: The data determine a strength if its relative standard error is below this value.
CARRIED = 0.5
#: A warning is given if more than this fraction of the strengths is zero. Only strengths between the first and the last
#: strength above zero count.
GAPS = 0.1


class GridSpectrum(NamedTuple):
    """Strengths at K fixed relaxation times, with the weight of the penalty (R rows) and the criteria by which grid and
    weight are chosen."""

    times: np.ndarray  # (K,) [s], descending; only times with a strength above zero
    strengths: np.ndarray  # (K,) [Pa]
    equilibrium: float  # [Pa], 0 for a fluid
    per_decade: int
    smoothing: float  # weight of the second differences
    prior: np.ndarray  # (R, 1 + K): matrix of the penalty on equilibrium modulus and strengths [1/Pa]
    effective: float  # effective number of parameters that the data determine
    criterion: float  # information criterion, for the comparison with other models
    evidence: float  # -2 log of the restricted likelihood, up to a constant, with estimated noise
    decades: float  # number of decades of relaxation times at which the data determine the strengths
    places: np.ndarray  # (K,) indices of `times` in the whole grid


def fit(sweep: Sweep) -> GridSpectrum:
    """Fit the spectrum with the grid and the weight that have the highest restricted likelihood."""
    return min((at(sweep, grid, w) for grid in GRIDS for w in WEIGHTS), key=lambda found: found.evidence)


def fit_all(sweeps: Sequence[Sweep]) -> list[GridSpectrum]:
    """Fit the spectra of several samples on a common grid and with a common weight. Both are chosen by the highest
    restricted likelihood of all samples together."""
    band = min(s.resolved[0] for s in sweeps), max(s.resolved[1] for s in sweeps)
    every = ([at(s, grid, w, band) for s in sweeps] for grid in GRIDS for w in WEIGHTS)
    return min(every, key=lambda found: sum(f.evidence for f in found))


def at(sweep: Sweep, per_decade: int, smoothing: float, band: tuple[float, float] | None = None) -> GridSpectrum:
    """Fit the spectrum for one grid and one weight. This convex problem is solved exactly. `band`: shortest and longest
    relaxation time [s] that the data resolve; by default, the band of this sweep."""
    omega = sweep.angular_frequency
    times = grid_of_times(*(band or sweep.resolved), per_decade)
    size = np.exp(np.interp(-np.log(times), np.log(omega), np.log(np.hypot(sweep.storage, sweep.loss))))
    scales = np.concatenate(sweep.deviations)
    unit = np.concatenate([[sweep.storage.min()], size])
    A = mode_columns(omega, times) * unit / scales[:, None]
    b = np.concatenate([sweep.storage, sweep.loss]) / scales
    L = second_differences(len(times), smoothing)
    x, _ = non_negative(np.vstack([A, L]), np.concatenate([b, np.zeros(len(L))]))
    return described(x, A, A @ x - b, GridOfTimes(times, unit, per_decade, smoothing))


class GridOfTimes(NamedTuple):
    """Grid of a spectrum: K times, the units of the strengths, and the weight of the penalty."""

    times: np.ndarray  # (K,) [s], descending
    unit: np.ndarray  # (1 + K,) [Pa]; the first unit is for the equilibrium modulus
    per_decade: int
    smoothing: float


def grid_of_times(low: float, high: float, per_decade: int) -> np.ndarray:
    """Return relaxation times (K,) [s], descending, for data that resolve times from `low` to `high` [s]."""
    ends = np.log10(high) + MARGIN, np.log10(low) - MARGIN
    return np.logspace(*ends, int(np.ceil((ends[0] - ends[1]) * per_decade)) + 1)


def second_differences(count: int, smoothing: float) -> np.ndarray:
    """Return the matrix (K - 2, 1 + K) of the penalty on the second differences of K = `count` strengths. The first
    column, for the equilibrium modulus, is 0."""
    rows = np.column_stack([np.zeros(count - 2), np.diff(np.eye(count), 2, axis=0)])
    return np.sqrt(smoothing) * rows


def described(x: np.ndarray, A: np.ndarray, r: np.ndarray, grid: GridOfTimes) -> GridSpectrum:
    """Return the spectrum for the strengths x that minimise the misfit plus the penalty, with the effective number of
    parameters.

    Args:
        x: equilibrium modulus and strengths (1 + K,) in `grid.unit`.
        A: derivatives (m, 1 + K) of the residuals of the data with respect to x.
        r: residuals of the data (m,).
        grid: grid of the strengths.
    """
    L = second_differences(len(grid.times), grid.smoothing)
    m, free = len(r), x > 1e-10 * x.max()
    covariance = np.linalg.pinv(A[:, free].T @ A[:, free] + L[:, free].T @ L[:, free])
    effective = float(np.trace(covariance @ A[:, free].T @ A[:, free]))
    mean_square = max(float(r @ r) / m, 1e-300)
    errors = np.full(len(x), np.inf)
    errors[free] = np.sqrt(np.diag(covariance) * float(r @ r) / max(1.0, m - effective))
    carried = (errors[1:] < CARRIED * x[1:]).sum() / grid.per_decade
    kept = free[1:]
    return GridSpectrum(
        times=grid.times[kept],
        strengths=(x * grid.unit)[1:][kept],
        equilibrium=float(x[0] * grid.unit[0]) if free[0] else 0.0,
        per_decade=grid.per_decade,
        smoothing=float(grid.smoothing),
        prior=(L / grid.unit)[:, np.concatenate([[True], kept])],
        effective=effective,
        criterion=float(m * np.log(mean_square) + effective * np.log(m)),
        evidence=_restricted_likelihood(x, A, r, L),
        decades=float(carried),
        places=np.flatnonzero(kept),
    )


def gap_sentences(found: GridSpectrum) -> list[str]:
    """Return a warning if strengths within the spectrum are zero. Such gaps occur if the material has a few separate
    modes. The errors are then too small, because they assume that these strengths are exactly zero."""
    between = int(np.ptp(found.places)) + 1 if len(found.places) else 0
    gaps = between - len(found.places)
    if gaps <= GAPS * between:
        return []
    return [
        f"the spectrum has gaps: {gaps} of its {between} relaxation times have the strength 0, as in a material with a "
        "few separate modes. The errors of the spectrum and its moduli are then too small (in synthetic sweeps, 61 to "
        "87 % of the 95 % intervals contained the true modulus): use --model prony or --model auto"
    ]


def moduli_of_logarithms(u: Array, omega: np.ndarray, times: np.ndarray, solid: bool) -> tuple[Array, Array]:
    """Return G' and G'' (…, n) [Pa] from the logarithms u (…, K) of the strengths, in NumPy or JAX.

    Args:
        u: logarithms of the strengths. If the material is `solid`, the first entry is the logarithm of the equilibrium
            modulus.
        omega: angular frequencies (n,) [rad/s].
        times: relaxation times [s].
        solid: whether there is an equilibrium modulus.
    """
    columns = mode_columns(omega, times)[:, 0 if solid else 1 :]
    return arrays_of(u).split(exponential(u) @ columns.T, 2, axis=-1)


def _restricted_likelihood(x: np.ndarray, A: np.ndarray, r: np.ndarray, L: np.ndarray) -> float:
    """Return -2 log of the restricted likelihood, up to a constant. The matrix L of the penalty has fewer rows than
    columns. The difference is the number of parameters without a prior."""
    square = max(float(r @ r + np.sum((L @ x) ** 2)), 1e-300)
    with np.errstate(divide="ignore"):
        both = 2 * np.sum(np.log(np.abs(np.diag(np.linalg.qr(np.vstack([A, L]), mode="r")))))
    free = L.shape[1] - L.shape[0]
    prior = np.linalg.slogdet(L[:, 1:] @ L[:, 1:].T)[1]
    return float((len(r) - free) * np.log(square) + both - prior)
