"""The noise of a series of values, estimated from these values."""

import numpy as np


def noise_of_series(values: np.ndarray) -> float:
    """Estimate the standard deviation of independent noise in a smooth series (n,) from its third differences. Returns
    0 for fewer than four values.

    A third difference has 20 times the variance of the noise. The median is used, because a few jumps hardly change it.
    """
    steps = np.abs(np.diff(values, 3))
    return float(np.median(steps)) / 0.6745 / np.sqrt(20) if len(steps) else 0.0
