"""Find histories of loads and motions that the steps of a run do not resolve, or that begin after its end."""

import numpy as np

from liverjax.scenes.scene import Scene, histories

#: The program warns if the steps miss more than this fraction of a history's largest value or of its time integral.
MISSED = 0.05


def cautions_of_histories(scene: Scene, ends: np.ndarray) -> list[str]:
    """Return a warning for each history that begins after the end of the run, and for each history that is not linear
    within the steps. The run uses only the values of a history at the ends of steps, except for the flux of an inlet.

    Args:
        scene: `Scene` with known numbers (not inside jit, grad or vmap).
        ends: end times (T,) [s] of the steps.
    """
    said = []
    steps = np.concatenate([[0.0], ends])
    for name, part in histories(scene).items():
        times, values = (np.asarray(getattr(part, column)) for column in ("times", "history"))
        if times[0] >= steps[-1] and np.ptp(values, axis=0).any():
            said.append(
                f"the history of {name} begins at {times[0]:.4g} s, but the run ends at {steps[-1]:.4g} s, so the run "
                "uses only the first value: check that the times are in seconds, or use more steps"
            )
            continue
        if getattr(part, "flux", None) is not None:  # the inflow of a step is the exact integral of the flux
            continue
        every = np.union1d(steps, times[(times > 0) & (times < steps[-1])])
        table, at_steps = (_at_times(at, times, values) for at in (every, steps))
        seen = _at_times(every, steps, at_steps)
        apart, whole = np.abs(table - seen), np.abs(table)
        beyond = np.maximum(table - at_steps.max(axis=0), at_steps.min(axis=0) - table).max(axis=1)
        peak = int(beyond.argmax())
        if beyond[peak] > MISSED * whole.max():
            said.append(
                f"the history of {name} has a peak at {every[peak]:.4g} s between two steps, and the run misses "
                f"{100 * beyond[peak] / whole.max():.2g} % of this peak: use a smaller dt, or a dt that divides "
                f"{every[peak]:.4g} s"
            )
            continue
        lost, everything = (np.trapezoid(a, every, axis=0).max() for a in (apart, whole))
        if lost > MISSED * everything:
            said.append(
                f"the history of {name} is not linear within steps, but the run uses only the values at the ends of "
                f"steps, so the error is {100 * lost / everything:.2g} % of the integral over time: use a smaller dt"
            )
    return said


def _at_times(at: np.ndarray, times: np.ndarray, values: np.ndarray) -> np.ndarray:
    """Return the values (n, k) of a table with k columns at the n times `at`, by linear interpolation."""
    columns = values.reshape(len(times), -1).T
    return np.stack([np.interp(at, times, column) for column in columns], axis=1)
