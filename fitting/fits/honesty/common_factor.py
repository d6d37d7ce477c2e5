"""The factor between the moduli of tests that contradict each other. This module checks whether all tests agree after
all moduli of one test are multiplied by one factor.

Another temperature, a wrong size of the sample or a wrong calibration changes all moduli of a test by the same factor.
A common fit lies between such tests and fits none of them well. In this module, the factor is an additional parameter
of the fit.
"""

from collections.abc import Callable

import numpy as np

from fitting.fits.together import contributions, doubts, measured_tests, residuals_of_tests, starting_points
from fitting.fits.together.residuals_of_tests import Together
from fitting.fits.viscoelastic import Kind
from fitting.methods.estimate import spread
from fitting.methods.generalised_maxwell import Maxwell
from fitting.methods.least_squares import Solution, from_starts

#: A factor is reported if its logarithm differs from 0 by more than CERTAIN standard errors and by more than LEAST.
CERTAIN, LEAST = 4.0, 0.005


def told(fit: Together, relative: float | np.ndarray = 0.0) -> list[str]:
    """Return a warning that names the test and the factor that make all tests agree. There is no warning if the tests
    agree already, or if no factor makes them agree.

    The ratios and relaxation times of a common fit can compensate a factor of a few percent. The common fit then fits
    each test nearly as well as a separate fit does. Errors in the sizes of the samples may cause a small factor.

    `relative`: relative errors (K,) of the moduli of the K tests, caused by errors in the sizes of the samples. One
    number means the same error for all tests.
    """
    if fit.kind.effective is not None:
        return []
    found = {k: factor_of(fit, k) for k in range(1 if len(fit.tests) == 2 else 0, len(fit.tests))}
    known = {k: own for k, own in found.items() if own is not None}
    if not known:
        return []
    k = min(known, key=lambda k: known[k][2])
    factor, error, _ = known[k]
    said = (
        f"the tests agree if all moduli of {fit.shares[k].source or fit.shares[k].name} are {factor:.3g} ± {error:.1g} "
        "times the moduli of the other tests: "
    )
    sizes = np.broadcast_to(relative, len(fit.tests))
    if abs(np.log(factor)) < 2 * np.hypot(sizes[k], np.delete(sizes, k).max()):
        return [
            said + "errors in the sizes of the samples explain this factor, and the total errors contain these errors"
        ]
    return [
        said
        + "check whether this test was made at another temperature or on another sample, or whether the size of its "
        "sample is wrong. Until the cause is known, fit each test separately"
    ]


def factor_of(fit: Together, k: int) -> tuple[float, float, float] | None:
    """Return the factor [1] of all moduli of test k, the standard error of this factor, and the largest relative misfit
    that remains in a fit with this factor. The relative misfit of a test is its misfit, divided by the misfit of a fit
    to this test alone.

    Returns None if the factor is 1 within its error, or if the misfit of a test is still large.
    """
    names = list(map(measured_tests.name_of, fit.tests))
    parts = [measured_tests.reported_numbers(t) for t in fit.tests]
    data = [(at, y, scales * s.alone) for (at, y, scales), s in zip(parts, fit.shares, strict=True)]
    each = [_as_the_others(fit.kind.maxwell), _with_factor(fit.kind.maxwell)]

    def evaluate(u: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        rows = [
            residuals_of_tests.tests_evaluated([name], Kind(maxwell=each[j == k]), u, [own])
            for j, (name, own) in enumerate(zip(names, data, strict=True))
        ]
        r, J = zip(*rows, strict=True)
        return np.concatenate(r, axis=-1), np.concatenate(J, axis=-2)

    counts, common = [len(y) for _, y, _ in data], np.append(np.asarray(fit.solution.u), 0.0)[None]
    if fit.kind.values is not None:  # the starting points below are for Prony modes
        return _certain(from_starts(evaluate, common), counts)
    # The common fit of tests that contradict each other may have too few modes. So fits with more modes are tried too.
    more, answer = contributions.MORE if doubts.disagreements(fit.shares) else 0, None
    for modes in range(fit.modes, fit.modes + 1 + more):
        starts = _starts_at_the_others(fit, k, modes)
        starts = np.concatenate([common, starts]) if modes == fit.modes else starts
        answer = _certain(from_starts(evaluate, starts), counts)
        if answer is not None:
            break
    return answer


def _certain(found: Solution, counts: list[int]) -> tuple[float, float, float] | None:
    """Return the factor, its standard error and the largest remaining relative misfit, or None (see `factor_of`).
    `counts`: the number of residuals of each test."""
    left = np.split(np.asarray(found.residuals), np.cumsum(counts)[:-1])
    worst = max(float(np.sqrt(np.mean(r**2))) for r in left)
    last = np.eye(len(found.u))[-1:]
    error = float(np.linalg.norm(spread(np.asarray(found.jacobian), max(1.0, worst), last)[0]))
    if worst > doubts.APART or not abs(found.u[-1]) > max(CERTAIN * error, LEAST):
        return None
    factor = float(np.exp(found.u[-1]))
    return factor, factor * error, worst


def _starts_at_the_others(fit: Together, k: int, modes: int) -> np.ndarray:
    """Return starting points for the modes and the factor. The modes fit the other tests. The factor shifts the
    prediction of test k to its measured values. For a large factor, the common fit is not a good starting point.
    """
    others = [t for j, t in enumerate(fit.tests) if j != k]
    band = measured_tests.ResolvedBand(measured_tests.resolved_by(others))
    found = starting_points.starts_of_all(others, band, modes, fit.kind)
    own = _, measured, scales = measured_tests.reported_numbers(fit.tests[k])
    residuals, _ = residuals_of_tests.tests_evaluated([measured_tests.name_of(fit.tests[k])], fit.kind, found, [own])
    with np.errstate(all="ignore"):
        apart = np.abs(np.log(np.abs(measured / (residuals * scales + measured))))
    size = np.nan_to_num(np.median(apart, axis=-1), nan=0.0, posinf=0.0)
    # If moduli grow, a compliance falls. So the sign of the logarithm of the factor is unknown, and both signs are
    # tried.
    return np.concatenate([np.column_stack([found, sign * size]) for sign in (1, -1)])


def _as_the_others(maxwell: Callable[[np.ndarray], Maxwell]) -> Callable[[np.ndarray], Maxwell]:
    return lambda u: maxwell(u[..., :-1])


def _with_factor(maxwell: Callable[[np.ndarray], Maxwell]) -> Callable[[np.ndarray], Maxwell]:
    def multiplied(u):
        model = maxwell(u[..., :-1])
        return model._replace(shear_modulus=model.shear_modulus * np.exp(u[..., -1]))

    return multiplied
