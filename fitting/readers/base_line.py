"""The base line of a sensor: its response in the rows before the load, a constant offset or a steady drift."""

from typing import NamedTuple

import numpy as np

#: Minimum number of rows at rest that can show an offset or a drift. A base line is ignored if it changes no response
#: by more than OFFSET times the largest response.
RESTING, DRIFTING, OFFSET = 3, 8, 0.003
#: A drift is clear above this number of its standard errors. The limit for an offset is 3.
_CLEAR = 4
#: The error of a drift is at least this fraction of it, because nothing shows how it continues under load.
_CONTINUED = 0.5


class BaseLine(NamedTuple):
    """Response `level` + `slope` * t of a sensor without load, and its standard errors. t is 0 when the load begins."""

    level: float
    level_error: float
    slope: float = 0.0  # per second
    slope_error: float = 0.0


def base_line(time: np.ndarray, answer: np.ndarray, size: float, end: float) -> BaseLine | None:
    """Return the base line that the rows at rest (n,) show, or None if it is not clearly different from 0.

    Args:
        time: times [s] (n,) of these rows, counted from the beginning of the load.
        answer: their responses (n,).
        size: the largest response of the whole test.
        end: time [s] of the last response of the test.
    """
    if len(time) < RESTING:
        return None
    if len(time) >= DRIFTING:
        A = np.column_stack([np.ones(len(time)), time])
        level, slope = np.linalg.lstsq(A, answer, rcond=None)[0]
        variance = float(np.sum((answer - A @ (level, slope)) ** 2)) / (len(time) - 2)
        level_error, slope_error = np.sqrt(variance * np.diag(np.linalg.inv(A.T @ A)))
        if abs(slope) > _CLEAR * slope_error and abs(slope) * end > OFFSET * size:
            error = max(float(slope_error), _CONTINUED * abs(float(slope)))
            return BaseLine(float(level), float(level_error), float(slope), error)
    mean, error = float(np.mean(answer)), float(np.std(answer, ddof=1)) / np.sqrt(len(answer))
    return BaseLine(mean, error) if abs(mean) > max(3 * error, OFFSET * size) else None
