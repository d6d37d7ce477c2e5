"""Stress that relaxes before the first answer of a test in time is missing in G0. The way in which the stress begins
to fall tells how much may be missing.

Let r be the fall in one half decade divided by the fall in the next one. If r < 1 stays the same, the falls before the
record are r, r^2, … times the fall in its first half decade. One relaxation time far longer than the first time of the
record gives r = 0.32, and nothing is missing in G0. A stress that falls as a power of time gives r >= 1, and G0 has no
upper bound.
"""

import numpy as np

from fitting.fits.time_tests import TimeFit
from fitting.methods.generalised_maxwell import Maxwell
from fitting.readers.time_tests import TimeTest

HALF_DECADE = float(np.sqrt(10))
#: Key in `TimeFit.details`: part of G0 [Pa] that the record does not show.
MISSING = "relaxed_before_the_record"
#: Above this ratio of two falls, the fall before the record has no bound.
LEAST_SLOWING = 0.9
#: The fall, or the missing part of G0, is reported if it exceeds this many standard errors of G0.
SHOWN = 2.0


def with_short_times(fit: TimeFit, test: TimeTest) -> TimeFit:
    """The fit of Prony modes with the part that may be missing in G0, and a sentence, if this part exceeds `SHOWN`
    standard errors of G0.

    Fits of other models, of records shorter than a decade, and of records with an answer at the moment of the load are
    returned unchanged.
    """
    first, last = test.resolved
    if fit.parameters is not None or not fit.converged or test.answers_at_once or last < HALF_DECADE**2 * first:
        return fit
    whole, error = float(fit.model.shear_modulus), float(fit.uncertainty.standard_errors[0])
    G = _relaxation_modulus(fit.model, first * HALF_DECADE ** np.arange(3))
    fall, next_fall = G[0] - G[1], G[1] - G[2]
    if fall <= SHOWN * error:
        return fit
    ratio = fall / max(next_fall, 1e-300)
    if ratio > LEAST_SLOWING:
        what = "stress" if test.kind == "relaxation" else "relaxation modulus"
        told = (
            f"the {what} falls by {100 * fall / whole:.2g} % in the first half decade of the record, and by "
            f"{100 * max(next_fall, 0.0) / whole:.2g} % in the next: nothing tells how much relaxed before {first:.3g} "
            "s, and G0 does not contain it; begin earlier, or compare --model auto"
        )
        return fit._replace(warnings=(*fit.warnings, told))
    missing = fall * ratio / (1 - ratio) - (whole - G[0])
    if missing <= SHOWN * error:
        return fit
    told = (
        f"G0 may be {missing:.2g} Pa larger, if the modulus fell before {first:.3g} s in the same way as after it. "
        "The chosen modes do not contain this part (it is in the total error): begin the record earlier, or compare "
        "--model auto"
    )
    return fit._replace(warnings=(*fit.warnings, told), details=fit.details | {MISSING: float(missing)})


def _relaxation_modulus(model: Maxwell, time: np.ndarray) -> np.ndarray:
    """G(t) [Pa] at times (n,) [s]."""
    relaxed = -np.expm1(-time[:, None] / np.asarray(model.relaxation_times))
    return np.asarray(float(model.shear_modulus) * (1 - relaxed @ np.asarray(model.ratios)))
