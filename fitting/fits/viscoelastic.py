"""Identify a generalised Maxwell model from a frequency sweep, in closed form."""

import time
from collections.abc import Callable, Sequence
from functools import lru_cache, partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from fitting.methods import generalised_maxwell, host, uncertainty
from fitting.methods.estimate import Estimate, errors_and_correlation, with_slope
from fitting.methods.generalised_maxwell import Maxwell, Spectrum
from fitting.methods.host import Array
from fitting.methods.least_squares import ZERO, Solution, bfgs, from_starts
from fitting.methods.noise.factor_noise import factors_of_series
from fitting.methods.noise.uneven_noise import root_of_sizes, sizes_shown
from fitting.readers.frequency_sweep import check_sweep, mostly_repeated
from fitting.readers.rheometer import Sweep
from liverjax.core.errors import InputError
from liverjax.core.struct import Content

OPTIMIZERS = ("levenberg-marquardt", "bfgs")


class Kind(NamedTuple):
    """The meaning of the variables u of a fit. By default, u describes Prony modes."""

    name: str = "prony"
    maxwell: Callable[[Array], Maxwell] = generalised_maxwell.natural  # u -> Prony modes
    names: tuple[str, ...] = ()  # names of the model's parameters; empty: the modes are the parameters
    units: tuple[str, ...] = ()
    values: Callable[[Array], Array] | None = None  # u -> P parameters of the model (P,)
    prior: Callable[[Array], Array] | None = None  # u -> residuals of the prior, placed after the residuals of the data
    effective: float | None = None  # number of parameters that the data determine; None: the length of u
    moduli: Callable[[Array, Array], tuple[Array, Array]] | None = None  # (u, omega) -> G', G'' (n,) [Pa]


class Fit(NamedTuple):
    """A fitted model with all results for a report."""

    method: str
    model: Maxwell
    solution: Solution
    uncertainty: Estimate
    converged: bool
    storage: np.ndarray  # fitted G' at the measured frequencies [Pa]
    loss: np.ndarray
    warnings: tuple[str, ...]
    run_time: float  # [s]
    compile_time: float
    details: Content
    kind: Kind = Kind()
    parameters: Estimate | None = None  # parameters of another model; None: the modes are the parameters
    rivals: tuple["Fit", ...] = ()  # fits of the other models that could have been chosen
    noise_root: np.ndarray | None = None  # see `root_of_noise_shown`; None: no such noise is used

    @property
    def modes(self) -> int:
        """Number of Prony modes."""
        return len(self.model.ratios)

    def relative_errors(self, sweep: Sweep) -> np.ndarray:
        """Return the relative errors |fit / data - 1| (2n,) of G' and then of G'' at n frequencies."""
        data = np.concatenate([sweep.storage, sweep.loss])
        return np.abs(np.concatenate([self.storage, self.loss]) / data - 1)


def timed(function: Callable, *arguments: Any) -> tuple[Any, float, float]:
    """Return the result of a JAX function, the time [s] of compilation and the time [s] of the run. For arguments of
    the same shapes, the function is compiled only once."""
    begin = time.perf_counter()
    arguments = jax.tree.map(jnp.asarray, arguments)
    leaves, tree = jax.tree.flatten(arguments)
    compiled = _compiled(function, tree, tuple((leaf.shape, leaf.dtype) for leaf in leaves))
    middle = time.perf_counter()
    result = jax.block_until_ready(compiled(*arguments))
    return result, middle - begin, time.perf_counter() - middle


@lru_cache(maxsize=16)  # fits of several samples or parts of a band use one compiled program
def _compiled(function: Callable, tree: Any, kinds: tuple) -> Callable:
    arguments = jax.tree.unflatten(tree, [jax.ShapeDtypeStruct(shape, dtype) for shape, dtype in kinds])
    return jax.jit(function).lower(*arguments).compile()


@lru_cache(maxsize=16)
def best_of(minimise: Callable, residuals: Callable) -> Callable[..., Solution]:
    """Return a function that finds the lowest minimum from S starting points (S, P) of P variables."""

    def best(starts, *data):
        found = jax.vmap(lambda u: minimise(residuals, u, *data))(starts)
        k = jnp.argmin(jnp.where(jnp.isfinite(found.cost), found.cost, jnp.inf))
        return jax.tree.map(lambda leaf: leaf[k], found)

    return best


def whole_number(modes: int | str, otherwise: str = 'give "auto"') -> int:
    """Return `modes` as an integer. Raise `InputError` if it is not a whole number. `otherwise`: what else the user can
    do."""
    if isinstance(modes, bool) or not isinstance(modes, (int, np.integer)):
        raise InputError(f"modes = {modes!r} must be a whole number: give e.g. 2, or {otherwise}")
    return int(modes)


def check_optimizer(optimizer: str) -> None:
    """Raise `InputError` if the name of an optimizer is unknown."""
    if optimizer not in OPTIMIZERS:
        raise InputError(f"optimizer = {optimizer!r} is not known: use {' or '.join(OPTIMIZERS)}")


def check_modes(sweep: Sweep, modes: int | str) -> None:
    """Raise `InputError` if `modes` is not a whole number above 0, or if the sweep has too few points for the
    parameters of this number of modes."""
    check_sweep(sweep)
    largest = generalised_maxwell.largest_number_of_modes(sweep)
    modes = whole_number(modes, "call choose_modes")
    if largest < 1:
        raise InputError(
            f"{sweep.source or 'sweep'}: one frequency does not determine a mode. Measure at more frequencies"
        )
    if modes < 1:
        raise InputError(f"--modes {modes} must be at least 1, or auto")
    if modes > largest:
        raise InputError(
            f"{sweep.source or 'sweep'}: {largest + 1} different frequencies cannot determine the {2 * modes + 1} "
            f"parameters of {modes} modes; use at most --modes {largest}"
        )


def closed_form(sweep: Sweep, modes: int, dense: Spectrum | None = None, optimizer: str = "levenberg-marquardt") -> Fit:
    """Fit the closed-form moduli from several starting points, and return the lowest minimum.

    Args:
        sweep: data; residuals are divided by `sweep.deviations`.
        modes: number of modes.
        dense: `generalised_maxwell.spectrum(sweep)`, if it was computed before.
        optimizer: one of `OPTIMIZERS`.
    """
    check_modes(sweep, modes)
    check_optimizer(optimizer)
    dense = dense or generalised_maxwell.refuse_impossible(sweep)
    return modes_from(sweep, generalised_maxwell.starts(sweep, modes, dense), Kind(), optimizer)


def modes_from(sweep: Sweep, starts: np.ndarray, kind: Kind = Kind(), optimizer: str = OPTIMIZERS[0]) -> Fit:
    """Fit Prony modes from the S starting points `starts` (S, P) of P variables, and return the best fit. `kind` states
    whether the modes form a solid or a fluid."""
    data = (sweep.angular_frequency, sweep.storage, sweep.loss, np.concatenate(sweep.deviations))
    if optimizer == OPTIMIZERS[0]:
        begin = time.perf_counter()
        found, compiling = from_starts(partial(host.with_jacobian, residuals_of(kind)), starts, *data), 0.0
        running = time.perf_counter() - begin
    else:
        found, compiling, running = timed(best_of(bfgs, residuals_of(kind)), starts, *data)
    return fitted(sweep, found, kind, running, compiling, {"optimizer": optimizer})


def residuals_of(kind: Kind) -> Callable[..., Array]:
    """Return the function that computes the residuals of Prony modes of a solid or a fluid, in NumPy or JAX."""
    return generalised_maxwell.fluid_residuals if kind.name == FLUID.name else generalised_maxwell.residuals


def fitted(sweep: Sweep, found: Solution, kind: Kind, running: float, compiling: float, details: Content) -> Fit:
    """Return the closed-form fit at the minimum `found` for the variables u of `kind`. The first residuals of `found`
    must be the residuals of the data."""
    scales, measured = np.concatenate(sweep.deviations), np.concatenate([sweep.storage, sweep.loss])
    storage, loss = np.split(np.asarray(found.residuals)[: len(measured)] * scales + measured, 2)
    simulated = BestPoint("closed-form", found, storage, loss)
    return fit_at(sweep, simulated, kind, (running, compiling), details)


class BestPoint(NamedTuple):
    """The result of a search: a minimum (`Solution`), and the moduli [Pa] at this minimum."""

    method: str
    solution: Solution
    storage: np.ndarray
    loss: np.ndarray
    advice: tuple[str, ...] = ()  # remedies, if the simulation failed


def fit_at(sweep: Sweep, at: BestPoint, kind: Kind, seconds: tuple[float, float], details: Content) -> Fit:
    """Return the fit at a minimum, with its errors and warnings. `seconds`: time of the run, and time of
    compilation."""
    found, storage, loss = at.solution, at.storage, at.loss
    own_noise = not sweep.noise_given and kind.effective is None and len(found.residuals) == 2 * len(storage)
    noise_root = root_of_noise_shown(found, sweep) if own_noise else None
    spread, own = estimates(found, kind, (2 * len(storage), sweep.noise_given), noise_root)
    sentences = _misfit(sweep, storage, loss, kind)
    sentences += tuple(uncertainty.cautions(sweep, spread, kind.name) if own is None else ())
    converged = bool(found.converged)
    advice = at.advice or (("try fewer modes",) if own is None else ("try another model",))
    if not converged:
        reason = (
            f"the fit did not converge in {int(found.iterations)} iterations, and the parameters with the smallest "
            "misfit are given"
        )
        sentences = (f"{reason}: {advice[0]}", *sentences)
    modes = len(spread.values) // 2
    model = Maxwell(spread.values[0], spread.values[1 : modes + 1], spread.values[modes + 1 :])
    details = details | {"iterations": int(found.iterations), "gradient": float(found.gradient)}
    result = Fit(at.method, model, found, spread, converged, storage, loss, sentences, *seconds, details, kind, own)
    return result._replace(noise_root=noise_root)


def estimates(
    found: Solution, kind: Kind, data: tuple[int, bool], noise_root: np.ndarray | None
) -> tuple[Estimate, Estimate | None]:
    """Return two estimates: of the Prony modes, and of the parameters of another model (None if the modes are the
    parameters).

    Args:
        found: the minimum for the variables u of `kind`.
        kind: the meaning of u.
        data: number of measured residuals, and whether the data have standard deviations.
        noise_root: see `root_of_noise_shown`.
    """
    count, given = data
    fluid, own = kind.name == FLUID.name, None
    spread = uncertainty.estimate(found, given, kind.maxwell, (count, kind.effective), fluid)
    spread = of_noise_shown(spread, partial(uncertainty.parameter_vector, maxwell=kind.maxwell), found.u, noise_root)
    if kind.values is not None:
        own = uncertainty.estimated(kind.names, kind.values, found, count, given, kind.effective)
        own = of_noise_shown(own, kind.values, found.u, noise_root)
    return spread, own


def of_noise_shown(
    estimate: Estimate, natural_of: Callable[[Array], Array], u: Array, noise_root: np.ndarray | None
) -> Estimate:
    """Return the estimate with standard errors for the noise that the residuals show. `noise_root`: see
    `root_of_noise_shown`; if it is None, the estimate is unchanged. `natural_of`: function from u to the parameters of
    the estimate."""
    if noise_root is None:
        return estimate
    root = with_slope(natural_of, u)[1] @ noise_root
    errors, correlation = errors_and_correlation(root)
    errors = np.where(np.isfinite(estimate.standard_errors), errors, np.inf)
    return estimate._replace(root=root, standard_errors=errors, correlation=correlation)


def root_of_noise_shown(found: Solution, sweep: Sweep) -> np.ndarray | None:
    """Return the square root (p, k) of the covariance of the p unknowns u for the noise that the residuals show. There
    are three kinds of such noise: it is correlated between repeated measurements at one frequency, it has different
    relative sizes in G' and G'', or it has a constant size in Pa. Returns None if the residuals show no such noise."""
    J, r = np.asarray(found.jacobian), np.asarray(found.residuals)
    root = _of_repeats(J, r, sweep.angular_frequency)
    if root is not None:
        return root
    sizes = sizes_shown(J, r, np.concatenate(sweep.deviations))
    return None if sizes is None else root_of_sizes(J, sizes, np.eye(J.shape[1]))


def sizes_of_noise(fit: Fit, sweep: Sweep) -> np.ndarray | None:
    """Return the standard deviations (2n,) of the residuals of G' and G'' at n frequencies, if the residuals show that
    the standard deviations differ (`sizes_shown`). Returns None if they may be equal, or if standard deviations that
    describe the noise are given (`Sweep.noise_given`)."""
    J, r = np.asarray(fit.solution.jacobian), np.asarray(fit.solution.residuals)
    return None if fit.noise_root is None else sizes_shown(J, r, np.concatenate(sweep.deviations))


def _of_repeats(J: np.ndarray, r: np.ndarray, omega: np.ndarray) -> np.ndarray | None:
    """Return the square root of the covariance of the unknowns for noise that is correlated between repeated values of
    G', or of G'', at one frequency. Returns None if the residuals show no such noise."""
    of_row = np.concatenate([omega, omega + 2 * omega.max()])  # G' and G'' form separate groups
    if not mostly_repeated(omega):
        return None
    _, group, counts = np.unique(of_row, return_inverse=True, return_counts=True)
    order = np.argsort(group, kind="stable")
    shared = factors_of_series(counts.tolist(), J[order], r[order], np.ones(len(r)), np.eye(J.shape[1]))
    return shared.root if shared is not None and shared.shown else None


#: Prony modes of a fluid, which has no equilibrium modulus: the ratios add up to one.
FLUID = Kind("prony_fluid", generalised_maxwell.natural_fluid)


def _misfit(sweep: Sweep, storage: np.ndarray, loss: np.ndarray, kind: Kind) -> tuple[str, ...]:
    """Return a warning that names the point with the largest error, if the model does not fit the data."""
    # If the standard deviations were estimated from the scatter of the points, errors of the phase angle may cause this
    # scatter. Then small loss moduli have large relative errors, so errors of G'' are divided by |G*|.
    size = np.hypot(sweep.storage, sweep.loss) if sweep.sd_estimated else sweep.loss
    e = np.abs(np.concatenate([storage / sweep.storage - 1, (loss - sweep.loss) / size]))
    if e.mean() < 0.05 and e.max() < 0.3:
        return ()
    worst, n = int(np.argmax(e)), len(storage)
    where = f"{'storage' if worst < n else 'loss'}_modulus at {sweep.angular_frequency[worst % n] / (2 * np.pi):.3g} Hz"
    return (
        f"{MISSES} by {100 * e.mean():.2g} % on average and by {100 * e.max():.3g} % in {where}: "
        f"try {'another --model' if kind.values else 'more modes or another --model'}, or check the data",
    )


def identifiable(fit: Fit, sweep: Sweep) -> bool:
    """Return whether the fit converged and none of its modes is superfluous (`uncertainty.superfluous`)."""
    return bool(fit.converged and not uncertainty.superfluous(sweep, fit.uncertainty))


def number_of_parameters(fit: Fit) -> float:
    """Return the number of parameters, or the effective number for a model with a prior."""
    return len(fit.solution.u) if fit.kind.effective is None else fit.kind.effective


def mean_square(fit: Fit) -> float:
    """Return the mean square of the residuals of the data, but at least `ZERO`. Smaller values are only roundoff of
    exact fits."""
    m = 2 * len(fit.storage)
    return max(float(np.sum(np.asarray(fit.solution.residuals)[:m] ** 2)) / m, ZERO)


def information_criterion(fit: Fit) -> float:
    """Return the Bayesian information criterion m ln(RSS/m) + k ln m for k parameters and m residuals with an estimated
    noise level. RSS is the sum of the squared residuals."""
    m = 2 * len(fit.storage)
    return float(m * np.log(mean_square(fit)) + number_of_parameters(fit) * np.log(m))


#: Key in `Fit.details` of the table of tried numbers of modes.
TRIED = "modes_tried"
#: End of the warning about a failed fit with some number of modes.
NOT_FITTED = "so this number of modes could not be chosen"
#: A fit counts as exact if all its relative errors are below this value. No measured data are so accurate.
EXACT = 1e-7


def choose_modes(
    sweep: Sweep,
    dense: Spectrum,
    optimizer: str = OPTIMIZERS[0],
    progress: Callable[[str], None] = lambda text: None,
) -> tuple[Fit, list[Fit]]:
    """Increase the number of modes while the criterion falls and every mode is identifiable, or until the fit is exact.
    Return the chosen fit and all tried fits. `progress` is called with the name of each fit.

    A failure is a fit that does not lower the criterion or has superfluous modes. A single failure may be a local
    minimum, so the search ends only after two failures in a row. If the computation for a number of modes raises an
    error, this counts as a failure too. A warning then names this number of modes, and the search continues with the
    other fits.
    """
    cap = most_modes(sweep)
    tried: list[Fit] = []
    broken: dict[int, str] = {}
    chosen, failures = None, 0
    for modes in range(1, cap + 1):
        progress(f"{modes} modes")
        try:
            fit = closed_form(sweep, modes, dense, optimizer)
        except (ArithmeticError, RuntimeError, ValueError) as error:
            if isinstance(error, InputError):
                raise
            broken[modes] = " ".join(str(error).split())[:100] or type(error).__name__
            failures += 1
        else:
            tried.append(fit)
            falls = chosen is None or information_criterion(fit) < information_criterion(chosen)
            if chosen is None or (identifiable(fit, sweep) and falls):
                chosen, failures = fit, 0
            else:
                failures += 1
            if np.max(fit.relative_errors(sweep)) < EXACT:
                break
        if failures == 2:
            break
    if chosen is None:
        raise InputError(f"{sweep.source or 'sweep'}: every fit failed (with 1 mode: {broken[1]}); check the data")
    rows = [row_of_modes(f, sweep) for f in tried]
    warnings = closer_number(rows, rows[[f.modes for f in tried].index(chosen.modes)], tried)
    for modes, reason in broken.items():
        warnings.append(f"{modes} mode{'s' if modes > 1 else ''} could not be fitted ({reason}), {NOT_FITTED}")
    compiling, running = sum(f.compile_time for f in tried), sum(f.run_time for f in tried)
    chosen = chosen._replace(warnings=(*chosen.warnings, *warnings), details=chosen.details | {TRIED: rows})
    return chosen._replace(compile_time=compiling, run_time=running), tried


def most_modes(sweep: Sweep) -> int:
    """Return the largest number of modes that is tried for the sweep."""
    return min(uncertainty.supported_modes(sweep), generalised_maxwell.largest_number_of_modes(sweep))


def row_of_modes(fit: Fit, sweep: Sweep) -> dict[str, float]:
    """Return a row of the table of tried numbers of modes in fit.json."""
    return {
        "modes": fit.modes,
        "information_criterion": float(information_criterion(fit)),
        "identifiable": identifiable(fit, sweep),
        "mean_relative_error": float(np.mean(fit.relative_errors(sweep))),
    }


def closer_number(rows: list[dict[str, float]], chosen: dict[str, float], tried: list[Fit]) -> list[str]:
    """Return a warning if another number of modes has a much lower criterion than the chosen one."""
    closer = min(rows, key=lambda row: row["information_criterion"])
    if closer["information_criterion"] >= chosen["information_criterion"] - 10:
        return []
    converged = next((f.converged for f in tried if f.modes == closer["modes"]), True)
    errors = [row["mean_relative_error"] for row in (closer, chosen)]
    return [closer_but_not_chosen(int(closer["modes"]), errors, converged)]


def closer_but_not_chosen(modes: int, errors: list[float], converged: bool) -> str:
    """Return a warning about a number of modes with a lower criterion. `errors`: mean relative errors of the fit with
    this number of modes and of the chosen fit."""
    reason = "the data do not determine some of their parameters" if converged else "their fit did not converge"
    a, b = (100 * e for e in errors)
    return (
        f"{modes} modes would follow the data more closely ({a:.2g} % instead of {b:.2g} % on average), but {reason}: "
        f"to use them anyway, give --modes {modes}"
    )


#: Words in the most important warnings, in order of importance.
MISSES, SHORT = "the fit misses the data", "the test ends before the material has relaxed"
IMPORTANT = ("did not converge", MISSES, "Kramers-Kronig", "that relaxes", "structured misfit", SHORT, "half decade")


def by_importance(sentences: Sequence[str]) -> tuple[str, ...]:
    """Sort the warnings in the order of `IMPORTANT`. The other warnings follow in their given order."""

    def place(sentence: str) -> int:
        return next((k for k, words in enumerate(IMPORTANT) if words in sentence), len(IMPORTANT))

    return tuple(sorted(sentences, key=place))
