"""Effect of a load that changes between two rows of the file of a relaxation or creep test. No row shows how the load
changed, so a linear change is assumed.

If the load was in fact a step at the later row, the material had less time to relax before this row, and the true G0 is
smaller. If the sample is already loaded in the first row, the load may have been a step at 0 s. The assumption matters
if relaxation times are as short as the time between the two rows.
"""

import numpy as np

from fitting.fits import time_tests
from fitting.fits.families import limits
from fitting.fits.time_tests import TimeFit
from fitting.readers.time_tests import BEFORE_ROWS, TimeTest, rows_before_jumps

#: Key in `TimeFit.details` of the changes of G0, ratios, times and equilibrium modulus (by name) if the load was a
#: step.
OF_A_STEP = "change_if_the_load_was_a_step"
#: The changes are reported if the change of G0 exceeds this many standard errors.
SHOWN = 2.0


def with_rise_of_load(fit: TimeFit, test: TimeTest, prony: TimeFit) -> TimeFit:
    """Fit the test again with steps of the load instead of linear changes between rows. Return `fit`, with a warning if
    the steps change G0 by more than `SHOWN` standard errors. If `fit` is a fit of Prony modes, its details then also
    contain the changes of all parameters.

    Args:
        fit: a fit of any model to this test.
        test: data.
        prony: the fit of Prony modes. If `fit` has another model, the change of G0 is computed with `prony`.
    """
    own = prony if fit.parameters is not None else fit
    if not len(test.jumps) or not own.converged:
        return fit
    steps = with_steps(test)
    if steps.used.sum() <= len(own.solution.u):
        return fit
    step = time_tests.refitted(own, steps)
    values, moved = own.uncertainty.values, step.uncertainty.values - own.uncertainty.values
    if not step.converged or not abs(moved[0]) > SHOWN * own.uncertainty.standard_errors[0]:
        return fit
    changes = dict(zip(own.uncertainty.names, map(float, moved), strict=True))
    if own.kind.name == "prony":
        changes["equilibrium_modulus"] = limits.equilibrium_of(step.model) - limits.equilibrium_of(own.model)
    known = fit.parameters is None and not test.described
    told = (
        f"{_assumed_between_rows(test)} G0 is {values[0] + moved[0]:.4g} Pa instead of {values[0]:.4g} Pa"
        f"{' with Prony modes' if own is not fit else ''} (the total errors "
        f"{'contain this' if known else 'do not contain this'} change): {_remedy_of_jumps(test)}"
    )
    details = fit.details | {OF_A_STEP: changes} if fit.parameters is None else fit.details
    return fit._replace(warnings=(*fit.warnings, told), details=details)


def with_steps(test: TimeTest) -> TimeTest:
    """Return the test with each jump of the load (`TimeTest.jumps`) replaced by a step at the later row.

    If the sample is already loaded in the first row, the first step is at 0 s.
    """
    driven, jumps = test.driven.copy(), test.jumps
    if test.rise == BEFORE_ROWS:
        driven[: jumps[0]] = driven[jumps[0]]
        jumps = jumps[1:]
    shown = np.flatnonzero(np.isfinite(test.answer))
    for row in jumps:
        last = shown[np.searchsorted(shown, row) - 1]
        driven[last + 1 : row] = driven[last]
    time, driven, answer = rows_before_jumps(jumps, 0.0, test.time, driven, test.answer)
    steps = test._replace(time=time, driven=driven, answer=answer, used=np.isin(time, test.time[test.used]))
    # With steps, the load may begin later than with linear changes. The values measured between these two times then
    # belong to the unloaded state, and are not used.
    return steps._replace(used=steps.used & ((time <= test.begun) | (time > steps.begun)))


def _assumed_between_rows(test: TimeTest) -> str:
    begin, end = test.time[test.jumps[0] - 1], test.time[test.jumps[0]]
    if test.rise == BEFORE_ROWS:
        return (
            f"no row shows how the load rose before {end:.4g} s, so a linear rise is assumed. If the load was a step "
            "at 0 s,"
        )
    others = len(test.jumps) - 1
    more = f" (the same is true for {others} more jump{'s' if others > 1 else ''})" if others else ""
    steps = "the changes were steps at the later rows" if more else f"the change was a step at {end:.4g} s"
    return (
        f"no row shows how the load changed between {begin:.4g} and {end:.4g} s{more}, so linear changes are assumed. "
        f"If {steps},"
    )


def _remedy_of_jumps(test: TimeTest) -> str:
    name = "ramp = 0 in the description" if test.described else "--ramp 0"
    if test.rise == BEFORE_ROWS:
        return f"add the rows measured while the load rose to the file, or give {name} if the load was a step at 0 s"
    seconds = "" if test.described else ", or --ramp with the duration [s] of the change until the later row"
    return f"add the rows measured during the change to the file, or give {name} if the change was a step{seconds}"


def share_of_rise(fit: TimeFit, names: list[str]) -> dict[str, float]:
    """Return the absolute change of each parameter, by name, if the load was a step. The change is 0 if
    `with_rise_of_load` added no changes to the fit."""
    changes = fit.details.get(OF_A_STEP, {})
    return {name: abs(changes.get(name, 0.0)) for name in names}
