"""Stress that relaxes before the first measured value of a relaxation or creep test is missing in G0. The missing part
is estimated from the decrease of the stress at the beginning of the record.

Let r be the decrease of the stress in one half decade, divided by the decrease in the next half decade. If r < 1 is
constant, the decreases before the record are r, r^2, … times the decrease in the first half decade of the record. If a
material has a single relaxation time, far longer than the first time of the record, then r is 0.32, and no part of G0
is missing. If the stress is a negative power of time, r >= 1 and G0 has no upper bound.
"""

import numpy as np

from fitting.fits.time_tests import TimeFit
from fitting.methods.generalised_maxwell import Maxwell
from fitting.readers.time_tests import TimeTest

HALF_DECADE = float(np.sqrt(10))
#: Key in `TimeFit.details` of the part of G0 [Pa] that relaxed before the record.
MISSING = "relaxed_before_the_record"
#: If the ratio r of two decreases (module docstring) is above this value, the decrease before the record has no upper
#: bound.
LEAST_SLOWING = 0.9
#: The program warns about the decrease, or about the missing part of G0, only if it exceeds this many standard errors
#: of G0.
SHOWN = 2.0


def with_short_times(fit: TimeFit, test: TimeTest) -> TimeFit:
    """Return the fit of Prony modes. If the part that may be missing in G0 exceeds `SHOWN` standard errors of G0, this
    part and a warning are added. If this part has no upper bound, only a warning is added. The fit is returned
    unchanged if the model is not a Prony series, if the fit did not converge, if the record covers less than one decade
    of time, if it contains a value at the instant of loading, or if the decrease in the first half decade of the record
    is at most `SHOWN` standard errors of G0.
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
            f"{100 * max(next_fall, 0.0) / whole:.2g} % in the next half decade. It is unknown which part relaxed "
            f"before {first:.3g} s, and G0 does not contain this part: begin the record earlier, or compare with "
            "--model auto"
        )
        return fit._replace(warnings=(*fit.warnings, told))
    missing = fall * ratio / (1 - ratio) - (whole - G[0])
    if missing <= SHOWN * error:
        return fit
    contained = "" if test.described else " (the total error contains this part)"
    told = (
        f"G0 may be {missing:.2g} Pa larger, if the modulus fell before {first:.3g} s in the same way as after this "
        f"time. The chosen modes do not contain this part{contained}: begin the record earlier, or compare with "
        "--model auto"
    )
    return fit._replace(warnings=(*fit.warnings, told), details=fit.details | {MISSING: float(missing)})


def _relaxation_modulus(model: Maxwell, time: np.ndarray) -> np.ndarray:
    """Return the relaxation modulus G(t) (n,) [Pa] at times (n,) [s]."""
    relaxed = -np.expm1(-time[:, None] / np.asarray(model.relaxation_times))
    return np.asarray(float(model.shear_modulus) * (1 - relaxed @ np.asarray(model.ratios)))
