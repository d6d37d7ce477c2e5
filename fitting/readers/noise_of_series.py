"""The noise of a series of values, estimated from these values."""

import numpy as np


def noise_of_series(values: np.ndarray) -> float:
    """Standard deviation of independent noise on a smooth series (n,), from third differences; 0 for fewer than four
    values.

    A third difference has 20 times the variance of the noise. A few jumps hardly change the median.
    """
    steps = np.abs(np.diff(values, 3))
    return float(np.median(steps)) / 0.6745 / np.sqrt(20) if len(steps) else 0.0
