"""A load that rises between two rows of a test in time. No row shows how, so a straight rise is assumed.

If the load was a step at the later row, less had relaxed until then, and G0 is smaller. The change matters if
relaxation times are as short as the time between the two rows.
"""

import numpy as np

from fitting.fits import time_tests
from fitting.fits.families import limits
from fitting.fits.time_tests import TimeFit
from fitting.readers.time_tests import TimeTest, with_a_step

#: Key in `TimeFit.details`: changes of G0, ratios, times and equilibrium modulus if the load was a step, by name.
OF_A_STEP = "change_if_the_load_was_a_step"
#: The change is told if that of G0 exceeds this many standard errors.
SHOWN = 2.0


def with_rise_of_load(fit: TimeFit, test: TimeTest) -> TimeFit:
    """The fit of Prony modes with the changes of its parameters if the load was a step at the first row under load, and
    a sentence, if G0 changes by more than `SHOWN` standard errors. Other fits are returned unchanged."""
    row = test.rises_at
    if row is None or fit.parameters is not None or not fit.converged:
        return fit
    step = time_tests.refitted(fit, with_a_step(test, 0.0))
    values, moved = fit.uncertainty.values, step.uncertainty.values - fit.uncertainty.values
    if not step.converged or not abs(moved[0]) > SHOWN * fit.uncertainty.standard_errors[0]:
        return fit
    changes = dict(zip(fit.uncertainty.names, map(float, moved), strict=True))
    if fit.kind.name == "prony":
        changes["equilibrium_modulus"] = limits.equilibrium_of(step.model) - limits.equilibrium_of(fit.model)
    begin, end = test.time[row - 1], test.time[row]
    told = (
        f"no row shows how the load rose between {begin:.4g} and {end:.4g} s: a straight rise is assumed. If it was a "
        f"step at {end:.4g} s, G0 is {values[0] + moved[0]:.4g} Pa instead of {values[0]:.4g} Pa (the total errors "
        f"contain this): give more rows of the rise, or its seconds until {end:.4g} s as --ramp, 0 for a step"
    )
    return fit._replace(warnings=(*fit.warnings, told), details=fit.details | {OF_A_STEP: changes})


def share_of_rise(fit: TimeFit, names: list[str]) -> dict[str, float]:
    """Size of the change of each parameter if the load was a step; 0 if `with_rise_of_load` has told none."""
    changes = fit.details.get(OF_A_STEP, {})
    return {name: float(np.abs(changes.get(name, 0.0))) for name in names}
