"""Find the times at which the load of a relaxation or creep test begins to change or changes its direction, and find
which of two columns is the load."""

from functools import lru_cache

import numpy as np

from fitting.readers.noise_of_series import noise_of_series

#: The load is replaced by straight parts. The allowed difference is _CLOSE times the largest load or _OF_SCATTER
#: standard deviations of the scatter, whichever is larger, but at most _LOOSE times the largest load.
_CLOSE, _OF_SCATTER, _LOOSE = 0.01, 4.0, 0.1
#: Changes of the load below _LEAST_CHANGE times its largest value do not count.
_LEAST_CHANGE = 0.05
#: A change of the load begins where the load changes more than _FASTER times as much as in the same length of time
#: before.
_FASTER = 10.0
#: Rows count as equally far from a straight part if their distances are above _NEARLY times the largest distance. The
#: search for corners ends after _PASSES passes. This limit is reached only with thousands of irregular cycles.
_NEARLY, _PASSES = 0.99, 60
#: The numbers of straight parts of two columns are compared if the smaller number is at most _MOST_PARTS. A column is
#: smoother than the other column if its noise is smaller by the factor _SMOOTHER.
_MOST_PARTS, _SMOOTHER = 50, 1.5
#: A column counts as constant in the second half only if the other column changes more by the factor _MOVES.
_MOVES = 3.0


def first_is_imposed(time: np.ndarray, first: np.ndarray, second: np.ndarray) -> bool:
    """Return whether the first of two columns (n,) is imposed, and the second is the response.

    If only one column is constant in the second half, it is imposed. Otherwise, the imposed quantity is often constant
    or linear in parts. So it has fewer straight parts than the response. In long smooth cycles, the
    imposed quantity has less noise. If these rules do not decide, the imposed quantity is the column that changes less
    in the second half."""
    return _first_or_not(time, first, second)[0]


def is_uncertain(time: np.ndarray, first: np.ndarray, second: np.ndarray) -> bool:
    """Return whether only the smoothness or the size of the changes shows which column is imposed
    (`first_is_imposed`). This is the case for long smooth cycles, for example."""
    return not _first_or_not(time, first, second)[1]


def _first_or_not(time: np.ndarray, first: np.ndarray, second: np.ndarray) -> tuple[bool, bool]:
    """Return the result of `first_is_imposed`, and whether a constant column or the straight parts decide it."""
    late, both = len(time) // 2, (first, second)
    moves = [float(np.ptp(v[late:])) / max(float(np.max(np.abs(v))), 1e-300) for v in both]
    if min(moves) < _LEAST_CHANGE and max(moves) > _MOVES * min(moves):
        return moves[0] < moves[1], True
    # Scale the columns to the range 1. A constant column needs no scale.
    scaled = [v / (float(np.ptp(v)) or 1.0) for v in both]
    noise = [noise_of_series(v) for v in scaled]
    allowed = float(np.clip(_OF_SCATTER * max(noise), _CLOSE, _LOOSE))
    parts = [len(_corners_of_load(time, v, allowed)) for v in scaled]
    if parts[0] != parts[1] and min(parts) <= _MOST_PARTS:
        return parts[0] < parts[1], True
    if max(noise) > _SMOOTHER * min(noise) and min(parts) > _MOST_PARTS:
        return noise[0] < noise[1], False
    return moves[0] <= moves[1], False


def begins_of_changes(time: np.ndarray, driven: np.ndarray, begun: float) -> np.ndarray:
    """Return the times (k,) [s] at which the load begins to change, or changes its direction. The first time is
    `begun`. Changes below _LEAST_CHANGE times the largest load do not count. If the load scatters, the limit is
    larger. The result for the last few tests is kept, because a fit needs it many times."""
    return _begins_of_kept(np.asarray(time, float).tobytes(), np.asarray(driven, float).tobytes(), begun)


@lru_cache(maxsize=8)
def _begins_of_kept(times: bytes, loads: bytes, begun: float) -> np.ndarray:
    """Return the same as `begins_of_changes`, as an array that cannot be changed."""
    time, driven = np.frombuffer(times), np.frombuffer(loads)
    size = float(np.max(np.abs(driven)))
    allowed = float(np.clip(_OF_SCATTER * noise_of_series(driven), _CLOSE * size, _LOOSE * size))
    corners = _corners_of_load(time, driven, allowed)
    at, load, least = time[corners], driven[corners], max(_LEAST_CHANGE * size, 2 * allowed)
    large = np.flatnonzero(np.abs(np.diff(load)) > least)
    moves, before = np.diff(load)[large], load[large] - np.interp(2 * at[large] - at[large + 1], at, load)
    begin = np.abs(before) <= np.maximum(np.abs(moves) / _FASTER, allowed)
    begin |= np.diff(np.sign(moves), prepend=0.0) != 0
    begin[:1] &= np.abs(load[large[:1]]) > 2 * least  # the first change from rest begins at `begun`
    begins = at[large[begin]]
    found = np.append(begun, begins[begins > begun])
    found.setflags(write=False)
    return found


def _corners_of_load(time: np.ndarray, driven: np.ndarray, allowed: float) -> np.ndarray:
    """Return the indices (c,) of the first and the last row and of corners between them. Straight lines between these
    rows differ from the load by at most `allowed`. In each part, the row farthest from the line is the next corner; if
    several rows are equally far, the middle row."""
    corners, rows = np.array([0, len(time) - 1]), np.arange(len(time))
    for _ in range(_PASSES):
        off = np.abs(driven - np.interp(time, time[corners], driven[corners]))
        off[corners] = 0.0
        part = np.repeat(np.arange(len(corners)), np.diff(corners, append=len(time)))
        far = np.flatnonzero((off > allowed) & (off >= _NEARLY * np.maximum.reduceat(off, corners)[part]))
        if not len(far):
            break
        ends = np.append(corners, corners[-1])
        aside = np.abs(2 * rows[far] - ends[part[far]] - ends[part[far] + 1])
        far = far[np.lexsort((aside, part[far]))]
        corners = np.union1d(corners, far[np.unique(part[far], return_index=True)[1]])
    return corners
