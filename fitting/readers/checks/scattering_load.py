"""Remove the scatter of a measured load (strain, stress, displacement or force), if the true load is constant or a
linear ramp."""

import numpy as np

from fitting.readers.noise_of_series import noise_of_series

#: Scatter of the load below this fraction of the largest load is ignored.
QUIET = 1e-3
#: For files of at most _FEW_ROWS rows: the scatter of the hold is used if that of all rows is more than _RAMP times
#: larger.
_FEW_ROWS, _RAMP = 10, 3.0


def without_scatter(time: np.ndarray, driven: np.ndarray, word: str) -> tuple[np.ndarray, list[str]]:
    """Return the imposed load without scatter, and notes. A constant load is replaced by its mean, and a linear ramp by
    a fitted straight line. `word`: name of the load, for example "strain", for the notes.

    The model treats every change between two readings as a real change of the load. So it would also treat the scatter
    of a sensor as a change of the load.
    """
    size, noise = float(np.max(np.abs(driven))), noise_of_series(driven)
    if len(driven) <= _FEW_ROWS and noise > _RAMP * _of_the_hold(driven):
        noise = _of_the_hold(driven)  # the ramp is a large part of the rows, and its corners are not scatter
    if not min(noise, _from_neighbours(time, driven)) > QUIET * size:
        return driven, []
    level = np.median(driven[np.abs(driven) > size / 2])
    near = np.abs(driven - level) <= 5 * noise
    first, told = int(np.argmax(near)), f"the {word} scatters by {100 * noise / size:.2g} % of its largest value"
    share = np.mean(near[first:])
    if share < 0.5:  # the load is cyclic: its third differences look like noise
        return driven, []
    # Because of the scatter, a single row of the ramp may be near the constant level before the ramp ends.
    first = next((int(k) for k in np.flatnonzero(near) if np.mean(near[k:]) >= 0.99), len(near))
    if np.sum(near[first:]) < 0.9 * np.sum(near):
        return driven, [
            f"{told}, and each reading counts as a step, so the moduli will be too small: smooth this column first"
        ]
    rest = int(np.argmax(np.abs(driven - np.median(driven[:3])) > 5 * noise))
    rest = rest if rest <= first else 0
    rest_level = float(np.mean(driven[:rest])) if rest else 0.0
    if first - rest >= _ROWS_OF_RAMP:
        straight = _straight_ramp(time, driven, (rest, first, rest_level), noise)
        if straight is not None:
            begin, end, held = straight
            return held, [
                f"{told}: a linear ramp from {begin:.3g} to {end:.3g} s and then a constant load are used; the "
                "standard errors do not contain the uncertainty of these times"
            ]
        told = f"{told}, and each reading of the ramp counts as a step, which makes G0 too small (smooth the ramp)"
    held = driven.copy()
    held[first:] = np.mean(driven[first:])
    held[:rest] = rest_level
    return held, [f"{told}: from {time[first]:.3g} s on, the load is constant, and its mean is used"]


def _of_the_hold(driven: np.ndarray) -> float:
    """Return the scatter of the load at the end of the hold, from the differences of neighbouring rows. Only rows above
    half of the largest load are used, and only the later half of these rows. The result is infinite if there are fewer
    than two such rows."""
    steps = np.abs(np.diff(driven[np.abs(driven) > np.max(np.abs(driven)) / 2]))
    late = steps[len(steps) // 2 :]
    return float(np.quantile(late, 0.75)) / (1.1503 * np.sqrt(2)) if len(late) else np.inf


def _from_neighbours(time: np.ndarray, driven: np.ndarray) -> float:
    """Return the scatter of the load, from the distances of the rows from the straight lines between their neighbours.

    Here, irregular times of a straight ramp do not count as scatter. In `noise_of_series`, they do. Most distances of
    rounded loads are 0, so the upper quartile is used, which is 1.15 standard deviations of Gaussian noise.
    """
    if len(time) < 3:
        return 0.0
    share = (time[1:-1] - time[:-2]) / (time[2:] - time[:-2])
    off = driven[1:-1] - (1 - share) * driven[:-2] - share * driven[2:]
    return float(np.quantile(np.abs(off) / np.sqrt(1 + share**2 + (1 - share) ** 2), 0.75)) / 1.1503


#: A straight line replaces a ramp only if the ramp has _ROWS_OF_RAMP rows or more, and if the misfit of the line is
#: below _STRAIGHT times the noise.
_ROWS_OF_RAMP, _STRAIGHT = 4, 1.5
#: The straight ramp is fitted to all rows of the ramp, and to at most this number of rows before it (rest) and at most
#: this number after it (hold).
_OF_HOLD = 500


def _straight_ramp(
    time: np.ndarray, driven: np.ndarray, places: tuple[int, int, float], noise: float
) -> tuple[float, float, np.ndarray] | None:
    """Return start and end [s] of a linear ramp, and the load (n,) without scatter before, during and after the ramp.
    Returns None if the ramp is not linear.

    `places`: index of the first row under load, index of the first row of the hold, load at rest.
    """
    import scipy.optimize

    rest, first, low = places
    whole, late = time, np.linspace(first, len(time) - 1, min(_OF_HOLD, len(time) - first)).astype(int)
    rows = np.concatenate([np.arange(max(rest - _OF_HOLD, 0), first), late])
    time, driven, rest, first = time[rows], driven[rows], rest - int(rows[0]), first - int(rows[0])

    def rise(at: np.ndarray, begin: float, end: float) -> np.ndarray:
        return np.clip((at - begin) / float(np.maximum(end - begin, 1e-12)), 0.0, 1.0)

    def size(begin: float, end: float, low: float) -> float:
        line = rise(time, begin, end)
        return float(line @ (driven - low)) / float(np.maximum(line @ line, 1e-300))

    def line_from(begin: float, end: float, low: float) -> np.ndarray:
        return low + rise(time, begin, end) * size(begin, end, low)

    before = max(rest - 1, 0)
    start, spacing = time[[before, first]], (time[first] - time[before]) / (first - before)

    def misfit(later: np.ndarray) -> float:
        """Return the misfit if the ends of the ramp (`start`) are moved by `later` (2,), in units of `spacing`."""
        begin, end = start + spacing * later
        return float(np.sum(((line_from(begin, end, low) - driven) / noise) ** 2))

    ends = np.linspace(time[rest], time[min(first + max(3, (first - rest) // 4), len(time) - 1)], 400)
    near = ends[int(np.argmin([np.sum((line_from(time[0], end, 0.0) - driven) ** 2) for end in ends]))]
    # The tolerances of the search are absolute, so the misfit is made independent of the units of time and load.
    simplex = {"initial_simplex": np.array([[0.0, 0.0], [1.0, 0.0], [0.0, 1.0]])}
    free = start + spacing * scipy.optimize.minimize(misfit, np.zeros(2), method="Nelder-Mead", options=simplex).x
    # First try: a ramp from load 0 at the first row. Second try: a ramp from the load at rest, at a fitted time.
    for begin, end, level in ((time[0], near, 0.0), (free[0], free[1], low)):
        line = line_from(begin, end, level)
        off = (line - driven) / noise
        if max(np.sqrt(np.mean(part**2)) for part in (off, off[rest : first + 1])) < _STRAIGHT:
            return float(begin), float(end), level + rise(whole, begin, end) * size(begin, end, level)
    return None
