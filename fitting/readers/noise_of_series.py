"""Estimate the noise and the typical sizes of a measured series of values, and find single wrong values in it."""

import numpy as np

#: A single value is far from its neighbours if its distance from both exceeds three limits: _FAR times the changes
#: beside it, _NOISES times the noise, and _OF_LARGEST times the largest value.
_FAR, _NOISES, _OF_LARGEST = 10.0, 20.0, 0.02
_LOW = 0.5
#: Sizes are smoothed over _WINDOW values. A size is not smoothed if its distance from the smooth size exceeds two
#: limits: the first number of _OFF_LINE times the size, and the second number times the robust standard deviation of
#: all distances.
_WINDOW, _OFF_LINE = 11, (0.2, 5.0)
#: Two values count as the same if they differ by less than this fraction of the largest value.
_SAME = 1e-9
#: A series counts as rounded if at least this fraction of its neighbouring values are the same.
_OFTEN_SAME = 0.25


def noise_of_series(values: np.ndarray) -> float:
    """Estimate the standard deviation of independent noise in a smooth series (n,) from its third differences. Returns
    0 for fewer than four values.

    A third difference has 20 times the variance of the noise. The median is used, because a few jumps hardly change it.
    """
    steps = np.abs(np.diff(values, 3))
    return float(np.median(steps)) / 0.6745 / np.sqrt(20) if len(steps) else 0.0


def rounding_of_series(values: np.ndarray) -> float:
    """Return the standard deviation of the rounding errors of a series (n,): the smallest change between neighbouring
    values, divided by the square root of 12. Returns 0 if few neighbouring values are the same (see `_OFTEN_SAME`).

    If most values are the same because of rounding, `noise_of_series` is 0.
    """
    steps = np.abs(np.diff(values))
    same = steps <= _SAME * np.abs(values).max(initial=0.0)
    if np.all(same) or np.mean(same) < _OFTEN_SAME:
        return 0.0
    return float(steps[~same].min()) / np.sqrt(12)


def rounding_at_rest(values: np.ndarray, whole: np.ndarray) -> float:
    """Return the standard deviation of the rounding errors of a sensor at rest with the values (n,). Because these
    values may all be the same, the result is the smallest difference between the values `whole` (m,) of the complete
    test, divided by the square root of 12. Returns 0 if few neighbouring values at rest are the same (see
    `_OFTEN_SAME`)."""
    least = _SAME * np.abs(whole).max(initial=0.0)
    gaps = np.diff(np.sort(whole))
    if len(values) < 2 or np.mean(np.abs(np.diff(values)) <= least) < _OFTEN_SAME or not np.any(gaps > least):
        return 0.0
    return float(gaps[gaps > least].min()) / np.sqrt(12)


def sizes_of_series(values: np.ndarray) -> np.ndarray:
    """Return the absolute values (n,). A value below `_LOW` times the median of itself and its neighbours is replaced
    by this median.

    If these sizes are the scales of the residuals, a single value near 0 has no larger weight than its neighbours.
    """
    from scipy.ndimage import median_filter

    sizes = np.abs(values)
    typical = median_filter(sizes, 3, mode="mirror")
    return np.where(sizes < _LOW * typical, typical, sizes)


def smooth_sizes(values: np.ndarray) -> np.ndarray:
    """Return `sizes_of_series`, smoothed by straight lines through `_WINDOW` neighbouring values (n,).

    If a residual is divided by its own measured value, a value that is low by chance has more weight than a value that
    is high. The fit is then too low by twice the square of the relative noise. A size that differs much from the line
    (`_OFF_LINE`), for example beside a jump, is not smoothed.
    """
    from scipy.signal import savgol_filter

    sizes = sizes_of_series(values)
    if len(sizes) < _WINDOW:
        return sizes
    line = savgol_filter(sizes, _WINDOW, 1)
    off = np.abs(line - sizes)
    least = np.maximum(_OFF_LINE[0] * sizes, _OFF_LINE[1] * 1.4826 * np.median(off))
    return np.where((off > least) | (line <= 0), sizes, line)


def far_values(values: np.ndarray) -> np.ndarray:
    """Return the indices of single values that lie far from both neighbours, on the same side. The changes between the
    two neighbours, and between each neighbour and the next value, must be much smaller."""
    if len(values) < 5:
        return np.zeros(0, int)
    own, steps = values[2:-2], np.abs(np.diff(values))
    before, after = own - values[1:-3], own - values[3:-1]
    off = np.where(before * after > 0, np.minimum(np.abs(before), np.abs(after)), 0.0)
    beside = np.max([steps[:-3], steps[3:], np.abs(before - after)], axis=0)
    least = max(_NOISES * noise_of_series(values), _OF_LARGEST * float(np.max(np.abs(values))))
    return 2 + np.flatnonzero(off > np.maximum(_FAR * beside, least))


def off_the_line(values: np.ndarray) -> np.ndarray:
    """Return the indices of single values that lie far from the line between their neighbours. Unlike `far_values`, the
    values (n,) may rise steeply. Corners and jumps of the series are not found, because their second differences have
    another pattern."""
    if len(values) < 7:
        return np.zeros(0, int)
    off = values[1:-1] - 0.5 * (values[:-2] + values[2:])
    own, size = off[2:-2], np.abs(off[2:-2])
    beside = np.minimum(-off[1:-3] * np.sign(own), -off[3:-1] * np.sign(own))
    far = size > _FAR * np.maximum(np.abs(off[:-4]), np.abs(off[4:]))
    least = max(_NOISES * noise_of_series(values), _OF_LARGEST * float(np.max(np.abs(values))))
    return 3 + np.flatnonzero(far & (beside > 0.3 * size) & (size > least))


def told_of_far_values(time: np.ndarray, load: np.ndarray, values: np.ndarray) -> list[str]:
    """Return a note for each of the `far_values` of the response (n,) to a `load` (n,), at the times `time` (n,) [s].
    No note is given beside a change of the load, because there the value may be a true peak."""
    still = np.abs(np.diff(load)) <= _OF_LARGEST * np.max(np.abs(load))
    return [
        f"the response {values[k]:.4g} at {time[k]:.4g} s is far from its neighbours {values[k - 1]:.4g} and "
        f"{values[k + 1]:.4g}: if this value is a fault of the measurement, remove this row"
        for k in far_values(values)
        if still[k - 1] and still[k]
    ]
