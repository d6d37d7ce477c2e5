"""The base line of a sensor, found from the rows before the load: a constant offset or a steady drift."""

from typing import NamedTuple

import numpy as np

#: Minimum number of rows at rest that can show an offset or a drift. A base line is ignored if it changes no response
#: by more than OFFSET times the largest response.
RESTING, DRIFTING, OFFSET = 3, 10, 0.003
#: A drift counts as possible, or clear, above these numbers of standard errors. The limit for an offset is 3.
_POSSIBLE, _CLEAR = 2.5, 4.0
#: A drift is continued under load only if the rows at rest last at least _LONG times as long as the load, and if it
#: changes no response by more than _LARGE times the largest response.
_LONG, _LARGE = 0.2, 0.3
#: The error of a drift is at least this fraction of the drift, because no row shows how it continues under load.
_CONTINUED = 0.5
#: The estimated correlation between neighbouring responses is at most this number.
_MOST_ALIKE = 0.95


class BaseLine(NamedTuple):
    """Response `level` + `slope` * t of a sensor without load, and its standard errors. t is 0 when the load begins."""

    level: float
    level_error: float
    slope: float = 0.0  # per second
    slope_error: float = 0.0
    left: float = 0.0  # drift of the rows at rest that is not subtracted, because it may end


def base_line(time: np.ndarray, answer: np.ndarray, size: float, end: float, rounding: float = 0.0) -> BaseLine | None:
    """Return the base line that the rows at rest (n,) show, or None if it is not clearly different from 0 and does
    not clearly drift.

    Args:
        time: times [s] (n,) of these rows, counted from the beginning of the load.
        answer: their responses (n,).
        size: the largest response of the whole test.
        end: time [s] of the last response of the test.
        rounding: standard deviation of the rounding errors of these responses. Even the mean of equal responses has
            this error.
    """
    if len(time) < RESTING:
        return None
    mean, error = _mean_at_rest(answer)
    error = max(error, rounding)
    flat = BaseLine(mean, error) if abs(mean) > max(3 * error, OFFSET * size) else None
    if len(time) < DRIFTING or not np.ptp(time) > 0:
        return flat
    level, slope, level_error, slope_error = _straight_line(time, answer)
    rest = float(np.ptp(time))
    if abs(slope) <= _POSSIBLE * slope_error or abs(slope) * max(rest, end) <= OFFSET * size:
        return flat
    half = len(time) // 2
    (_, first, _, e1), (_, second, _, e2) = (
        _straight_line(time[:half], answer[:half]),
        _straight_line(time[half:], answer[half:]),
    )
    steady = abs(first - second) < 3 * np.hypot(e1, e2)
    small, clear = abs(slope) * end < _LARGE * size, abs(slope) > _CLEAR * slope_error
    if steady and small and rest > _LONG * end and clear:
        return BaseLine(level, max(level_error, rounding), slope, max(slope_error, _CONTINUED * abs(slope)))
    error = max(error, 0.5 * abs(slope) * rest)
    if steady and small:  # the whole drift counts as error
        return BaseLine(mean, error, slope_error=abs(slope), left=slope)
    return BaseLine(mean, error, left=slope) if clear or error > OFFSET * size else flat


def _mean_at_rest(answer: np.ndarray) -> tuple[float, float]:
    """Return the mean of responses (n,) and its standard error. The error contains the correlation between neighbouring
    responses. With the limit of this correlation, the error is at most the scatter of the responses. If the correlation
    is strong and n is 20 or less, the error is still too small."""
    n, mean = len(answer), float(np.mean(answer))
    alike = _correlation_of_noise(answer - mean, 1)
    return mean, float(np.std(answer, ddof=1) * np.sqrt((1 + alike) / (1 - alike) / n))


def _correlation_of_noise(off: np.ndarray, numbers: int) -> float:
    """Return the correlation of neighbouring noise, from residuals (n,) of a fit of 1 or 2 numbers (mean or line).

    The correlation r of the residuals is too small by about (numbers + 4 r) / n; this bias is corrected. The result is
    at most 1 - 2 numbers / n, because n residuals cannot determine a stronger correlation.
    """
    n, r = len(off), _neighbours_alike(off)
    return max(min(r + (numbers + 4 * r) / n, _MOST_ALIKE, 1 - 2 * numbers / n), 0.0)


def _neighbours_alike(off: np.ndarray) -> float:
    """Return the correlation between neighbouring residuals (n,), or 0 if all residuals are 0."""
    square = float(off @ off)
    return float(off[1:] @ off[:-1]) / square if square > 0 else 0.0


def _straight_line(time: np.ndarray, answer: np.ndarray) -> tuple[float, float, float, float]:
    """Fit a straight line to responses (n,). Return its value at time 0, its slope, and the standard errors of both.
    The errors contain the correlation between neighbouring responses."""
    A = np.column_stack([np.ones(len(time)), time])
    found = np.linalg.lstsq(A, answer, rcond=None)[0]
    off = answer - A @ found
    alike = _correlation_of_noise(off, 2)
    variance = float(off @ off) / (len(time) - 2) * (1 + alike) / (1 - alike)
    errors = np.sqrt(variance * np.diag(np.linalg.pinv(A.T @ A)))  # rounded times may all be equal
    return float(found[0]), float(found[1]), float(errors[0]), float(errors[1])
