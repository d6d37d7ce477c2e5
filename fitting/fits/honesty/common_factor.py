"""Tests that contradict each other: would they agree if all moduli of one of them had a common factor?

Another temperature, a sample of another size than stated, or a wrong calibration change all moduli of a test alike. A
common fit lies between such tests and follows none of them. Here the factor is one more number of the fit.
"""

from collections.abc import Callable

import numpy as np

from fitting.fits import together
from fitting.fits.together import Together
from fitting.fits.viscoelastic import Kind
from fitting.methods.estimate import spread
from fitting.methods.generalised_maxwell import Maxwell
from fitting.methods.least_squares import Solution, from_starts

#: A factor is named if it differs from 1 by so many standard errors, and by more than this.
CERTAIN, LEAST = 4.0, 0.005


def told(fit: Together, relative: float = 0.0) -> list[str]:
    """A sentence on the test whose factor makes all tests agree; none if the tests agree, or if no factor helps.

    A factor of a few percent hides in ratios and times: each test is then followed nearly as well as by itself. Sizes
    of samples, with an error `relative` of the moduli of each test, explain a small one.
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
        "times those of the others: "
    )
    if abs(np.log(factor)) < 2 * np.sqrt(2) * relative:
        return [said + "errors in the sizes of the samples explain this, and the errors with these sizes contain it"]
    return [
        said
        + "look for another temperature, another sample, or a wrong size of it, and fit the tests one by one until "
        "then"
    ]


def factor_of(fit: Together, k: int) -> tuple[float, float, float] | None:
    """Factor of all moduli of test k [1], its standard error, and the largest misfit left over that of a test alone.

    None if the factor is 1 within its error, or if a test is still missed.
    """
    names = list(map(together.name_of, fit.tests))
    parts = [together.reported_numbers(t) for t in fit.tests]
    data = [(at, y, scales * s.alone) for (at, y, scales), s in zip(parts, fit.shares, strict=True)]
    each = [_as_the_others(fit.kind.maxwell), _with_factor(fit.kind.maxwell)]

    def evaluate(u: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        rows = [
            together.tests_evaluated([name], Kind(maxwell=each[j == k]), u, [own])
            for j, (name, own) in enumerate(zip(names, data, strict=True))
        ]
        r, J = zip(*rows, strict=True)
        return np.concatenate(r, axis=-1), np.concatenate(J, axis=-2)

    counts, common = [len(y) for _, y, _ in data], np.append(np.asarray(fit.solution.u), 0.0)[None]
    if fit.kind.values is not None:  # a springpot: starts of modes are none of its own
        return _certain(from_starts(evaluate, common), counts)
    # A common fit of tests that contradict each other may have too few modes.
    more, answer = together.MORE if together.disagreements(fit.shares) else 0, None
    for modes in range(fit.modes, fit.modes + 1 + more):
        starts = _starts_at_the_others(fit, k, modes)
        starts = np.concatenate([common, starts]) if modes == fit.modes else starts
        answer = _certain(from_starts(evaluate, starts), counts)
        if answer is not None:
            break
    return answer


def _certain(found: Solution, counts: list[int]) -> tuple[float, float, float] | None:
    """The result of `factor_of` from the solution for tests with so many numbers."""
    left = np.split(np.asarray(found.residuals), np.cumsum(counts)[:-1])
    worst = max(float(np.sqrt(np.mean(r**2))) for r in left)
    last = np.eye(len(found.u))[-1:]
    error = float(np.linalg.norm(spread(np.asarray(found.jacobian), max(1.0, worst), last)[0]))
    if worst > together.APART or not abs(found.u[-1]) > max(CERTAIN * error, LEAST):
        return None
    factor = float(np.exp(found.u[-1]))
    return factor, factor * error, worst


def _starts_at_the_others(fit: Together, k: int, modes: int) -> np.ndarray:
    """Starts that follow the other tests, with the factor that moves their prediction to test k; a large factor is far
    from the common fit.
    """
    others = [t for j, t in enumerate(fit.tests) if j != k]
    band = together.ResolvedBand(together.resolved_by(others))
    found = together.starts_of_all(others, band, modes, fit.kind)
    own = _, measured, scales = together.reported_numbers(fit.tests[k])
    residuals, _ = together.tests_evaluated([together.name_of(fit.tests[k])], fit.kind, found, [own])
    with np.errstate(all="ignore"):
        apart = np.abs(np.log(np.abs(measured / (residuals * scales + measured))))
    size = np.nan_to_num(np.median(apart, axis=-1), nan=0.0, posinf=0.0)
    # A compliance falls where moduli grow: one of both signs is right.
    return np.concatenate([np.column_stack([found, sign * size]) for sign in (1, -1)])


def _as_the_others(maxwell: Callable[[np.ndarray], Maxwell]) -> Callable[[np.ndarray], Maxwell]:
    return lambda u: maxwell(u[..., :-1])


def _with_factor(maxwell: Callable[[np.ndarray], Maxwell]) -> Callable[[np.ndarray], Maxwell]:
    def multiplied(u):
        model = maxwell(u[..., :-1])
        return model._replace(shear_modulus=model.shear_modulus * np.exp(u[..., -1]))

    return multiplied
