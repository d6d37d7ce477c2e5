"""Check that a measured response in time is possible for a material under the load of its test."""

import numpy as np

from fitting.readers.noise_of_series import noise_of_series
from liverjax.core.errors import InputError


def of_the_other_kind(kind: str, time: np.ndarray, strain: np.ndarray, stress: np.ndarray) -> list[str]:
    """Return a note if the quantity that should be imposed in this kind of test changes in the second half, while the
    other quantity is constant.

    No note is given if the rate of change is constant, because some samples are strained at a constant rate until their
    stress is steady.
    """
    driven, answer = (strain, stress) if kind == "relaxation" else (stress, strain)
    late = len(driven) // 2
    moves, held = (np.std(v[late:]) / max(float(np.max(np.abs(v))), 1e-300) for v in (driven, answer))
    if not (held < HELD and moves > 3 * held and moves > HELD):
        return []
    bent = driven[late:] - np.polyval(np.polyfit(time[late:], driven[late:], 1), time[late:])
    if np.std(bent) < STEADY * np.std(driven[late:]):
        return []
    names = ("stress", "strain", "creep") if kind == "relaxation" else ("strain", "stress", "relaxation")
    return [
        f"the {names[0]} is constant and the {names[1]} changes, as in a {names[2]} test: use python -m fitting "
        f"{names[2]}. The command {kind} assumes that the {names[1]} has no noise"
    ]


#: A quantity counts as constant if its relative standard deviation in the second half of the test is below this [1].
HELD = 0.01
#: A quantity changes at a constant rate if its standard deviation from a straight line is below this fraction of its
#: standard deviation from the mean.
STEADY = 0.05


#: The limit for the rise of a modulus and for the fall of a compliance is _WRONG_WAY times its largest value, or
#: BEYOND_NOISE standard deviations of its noise, whichever is larger.
_WRONG_WAY, BEYOND_NOISE = 0.25, 6.0


def another_course(path: str, kind: str, time: np.ndarray, values: np.ndarray, given: tuple) -> list[str]:
    """Check that a modulus does not rise, and a compliance does not fall, under a constant load. Return notes. A rise
    of the modulus is not checked if a ramp is given.

    A running median removes single wrong rows. `given`: duration of the ramp [s], first fitted time [s].

    Raises:
        InputError: the check fails; the message has the time and possible causes.
    """
    from scipy.ndimage import median_filter

    ramp, start = given
    rows = (time > 0) & (time >= start) & np.isfinite(values)
    t, v = time[rows], values[rows] * np.sign(np.sum(values[rows]))
    if len(t) < 8:
        return []
    smooth = median_filter(v, size=5, mode="nearest")
    noise, v = max(noise_of_series(v), 1.4826 * float(np.median(np.abs(v - smooth)))), smooth
    size = float(v.max())
    allowed = max(_WRONG_WAY * size, BEYOND_NOISE * noise)
    if kind == "creep":
        fallen = np.maximum.accumulate(v) - v
        if fallen.max() > allowed:
            last = t[int(np.argmax(v[: int(np.argmax(fallen > allowed)) + 1]))]
            raise InputError(
                f"{path}: the compliance falls from {last:.3g} s on. If the stress was removed, give strain and stress "
                "in two columns, or end the rows there. If the strain oscillates after loading, exclude these rows "
                "(--min-time)"
            )
        return []
    peak = int(np.argmax(v))
    if not ramp and v[peak] - v[: peak + 1].min() > allowed:
        raise InputError(
            f"{path}: the modulus rises until {t[peak]:.3g} s, but after a step of strain the modulus can only fall. "
            f"If the strain rose until then, give --ramp {t[peak]:.3g}; otherwise exclude the earlier rows (--min-time "
            f"{t[peak]:.3g})"
        )
    if ramp and t[0] < 0.3 * ramp and v[0] > 0.7 * size:
        return [
            f"the modulus has {100 * v[0] / size:.0f} % of its largest value at {t[0]:.3g} s, but a ramp of {ramp:g} s "
            f"has only {100 * t[0] / ramp:.2g} % of its strain at this time: check --ramp"
        ]
    return []


def of_ringing(time: np.ndarray, stress: np.ndarray, strain: np.ndarray, start: float) -> list[str]:
    """Return a note if the strain falls and rises again under constant stress. The inertia of the instrument causes
    such oscillations."""
    from scipy.ndimage import median_filter

    largest = float(stress[np.argmax(np.abs(stress))])
    held = (stress * np.sign(largest) > (1 - HELD) * abs(largest)) & (time >= start)
    first = int(np.argmax(held))
    length = int(np.argmin(np.append(held[first:], False)))
    t, v = time[first : first + length], np.abs(strain[first : first + length])
    if len(t) < 8:
        return []
    noise, v = noise_of_series(v), median_filter(v, size=3, mode="nearest")
    falls = np.maximum.accumulate(v) - v
    allowed = max(_RINGS * float(v.max()), BEYOND_NOISE * noise)
    if not falls.max() > allowed:
        return []
    worst = int(np.argmax(falls))
    rises = float(v[worst:].max() - v[worst])
    if not rises > allowed:
        return []
    return [
        f"the strain falls by {100 * falls[worst] / v.max():.2g} % until {t[worst]:.3g} s under a constant stress, and "
        "rises again. This is an oscillation of the instrument's inertia, not creep: exclude these rows (--min-time)"
    ]


#: The strain oscillates if it falls, and rises again, by more than this fraction of the largest strain.
_RINGS = 0.02
