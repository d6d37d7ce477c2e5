"""Identify a generalised Maxwell model from a frequency sweep, in closed form or through the torsion simulation."""

import time
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from fitting import prony, torsion, uncertainty
from fitting.least_squares import Solution, bfgs, levenberg_marquardt, levenberg_marquardt_host
from fitting.prony import Maxwell, Spectrum
from fitting.rheometer import Sweep
from fitting.uncertainty import Uncertainty
from liverjax import laws, status
from liverjax.errors import InputError
from liverjax.viscosity import Prony

MAX_MODES = 6
OPTIMIZERS = ("levenberg-marquardt", "bfgs")


class Fit(NamedTuple):
    """A fitted model with all that a report needs."""

    method: str
    model: Maxwell
    solution: Solution
    uncertainty: Uncertainty
    converged: bool
    storage: np.ndarray  # fitted G' at the measured frequencies [Pa]
    loss: np.ndarray
    warnings: tuple[str, ...]
    run_time: float  # [s]
    compile_time: float
    details: dict[str, Any]

    @property
    def modes(self) -> int:
        """N."""
        return len(self.model.ratios)

    def relative_errors(self, sweep: Sweep) -> np.ndarray:
        """|fit / data - 1| of G' then G'' (2n,)."""
        data = np.concatenate([sweep.storage, sweep.loss])
        return np.abs(np.concatenate([self.storage, self.loss]) / data - 1)


def _timed(function: Callable, *arguments: Any) -> tuple[Any, float, float]:
    """Result, seconds of compilation, seconds of the run."""
    begin = time.perf_counter()
    compiled = jax.jit(function).lower(*arguments).compile()
    middle = time.perf_counter()
    result = jax.block_until_ready(compiled(*arguments))
    return result, middle - begin, time.perf_counter() - middle


def check_modes(sweep: Sweep, modes: int) -> None:
    """`InputError` where the sweep has too few points for the parameters, naming the largest number of modes."""
    largest = prony.largest_number_of_modes(sweep)
    if modes < 1:
        raise InputError(f"--modes {modes} must be at least 1, or auto")
    if modes > largest:
        raise InputError(
            f"{sweep.source or 'sweep'}: {len(sweep.angular_frequency)} frequencies cannot determine the "
            f"{2 * modes + 1} parameters of {modes} modes; use at most --modes {largest}"
        )


def closed_form(sweep: Sweep, modes: int, dense: Spectrum | None = None, optimizer: str = "levenberg-marquardt") -> Fit:
    """Fit the closed-form moduli from several starts; the best minimum is kept.

    Args:
        sweep: data; residuals are divided by `sweep.deviations`.
        modes: N.
        dense: `prony.spectrum(sweep)` if already there.
        optimizer: one of `OPTIMIZERS`.
    """
    check_modes(sweep, modes)
    dense = dense or prony.refuse_impossible(sweep)
    minimise = levenberg_marquardt if optimizer == OPTIMIZERS[0] else bfgs
    starts = prony.starts(sweep, modes, dense)

    def best(starts, *data):
        found = jax.vmap(lambda u: minimise(prony.residuals, u, *data))(starts)
        k = jnp.argmin(jnp.where(jnp.isfinite(found.cost), found.cost, jnp.inf))
        return jax.tree.map(lambda leaf: leaf[k], found)

    data = (sweep.angular_frequency, sweep.storage, sweep.loss, np.concatenate(sweep.deviations))
    found, compiling, running = _timed(best, starts, *data)
    model = prony.natural(found.u)
    storage, loss = (np.asarray(v) for v in prony.moduli(model, jnp.asarray(sweep.angular_frequency)))
    return _fit("closed-form", sweep, found, storage, loss, (), running, compiling, {"optimizer": optimizer})


def _fit(method, sweep, found, storage, loss, extra, running, compiling, details) -> Fit:
    spread = uncertainty.estimate(found, sweep.storage_sd is not None)
    sentences = (*uncertainty.cautions(sweep, spread, found), *extra)
    converged = bool(found.converged)
    if not converged:
        sentences = (
            f"the fit did not converge in {int(found.iterations)} iterations: its best point is given; try fewer modes",
            *sentences,
        )
    model = Maxwell(*(np.asarray(v) for v in prony.natural(found.u)))
    details = details | {"iterations": int(found.iterations), "gradient": float(found.gradient)}
    return Fit(method, model, found, spread, converged, storage, loss, sentences, running, compiling, details)


def identifiable(fit: Fit) -> bool:
    """Every mode is needed and none has merged: parameters known to 50 %, times a factor 1.5 apart."""
    n, u = fit.modes, fit.uncertainty
    known = np.all(u.standard_errors[1:] < 0.5 * u.values[1:])
    tau = u.values[n + 1 :]
    return bool(fit.converged and known and np.all(tau[:-1] / tau[1:] > 1.5))


def information_criterion(fit: Fit) -> float:
    """Bayesian information criterion with the noise level estimated: m ln(RSS/m) + k ln m."""
    m, k = len(fit.solution.residuals), len(fit.solution.u)
    mean_square = max(2 * float(fit.solution.cost) / m, 1e-300)
    return m * np.log(mean_square) + k * np.log(m)


#: Mean relative residual at which a fit is exact to the digits of any data.
EXACT = 1e-7


def choose_modes(sweep: Sweep, dense: Spectrum, optimizer: str = OPTIMIZERS[0]) -> tuple[Fit, list[Fit]]:
    """Raise N until the criterion rises, a mode is not identifiable, or the fit is exact; also what was tried."""
    tried: list[Fit] = []
    chosen = None
    compiling = running = 0.0
    for modes in range(1, min(MAX_MODES, prony.largest_number_of_modes(sweep)) + 1):
        fit = closed_form(sweep, modes, dense, optimizer)
        tried.append(fit)
        compiling, running = compiling + fit.compile_time, running + fit.run_time
        if chosen is not None and not (
            identifiable(fit) and information_criterion(fit) < information_criterion(chosen)
        ):
            break
        chosen = fit
        if np.max(fit.relative_errors(sweep)) < EXACT:
            break
    table = [
        {
            "modes": f.modes,
            "information_criterion": float(information_criterion(f)),
            "identifiable": identifiable(f),
            "mean_relative_error": float(np.mean(f.relative_errors(sweep))),
        }
        for f in tried
    ]
    details = chosen.details | {"modes_tried": table}
    return chosen._replace(compile_time=compiling, run_time=running, details=details), tried


class Simulation(NamedTuple):
    """How the torsion fit simulates: geometry [m], law, recursion and resolution."""

    radius: float = torsion.RADIUS
    height: float = torsion.HEIGHT
    law: str = "neo_hookean"
    scheme: str = "exponential"
    part: str = "all"
    steps: int = 50
    cell_size: float | None = None
    strain: float = 1e-3  # amplitude at the rim (section 5.2)


def simulated_moduli(u, rig, law, omega, torque, drive, scheme, part):
    """`torsion.moduli` of unconstrained Maxwell parameters u, the law scaled to their G0."""
    model = prony.natural(u)
    scaled = laws.scaled(law, model.shear_modulus / law.shear_modulus())
    viscosity = Prony(ratios=model.ratios, relaxation_times=model.relaxation_times, scheme=scheme, part=part)
    return torsion.moduli(rig, scaled, viscosity, omega, torque, drive)


def through_torsion(
    sweep: Sweep,
    start: Fit,
    simulation: Simulation = Simulation(),
    optimizer: str = OPTIMIZERS[0],
    progress: Callable[[int, float], None] = lambda iteration, cost: None,
) -> Fit:
    """Fit the moduli of the simulated rheometer, starting from the closed form.

    Args:
        sweep: data.
        start: fit in closed form with the number of modes wanted.
        simulation: geometry, law and resolution.
        optimizer: one of `OPTIMIZERS`.
        progress: told of every evaluation.
    """
    from liverjax.viscosity import check

    law = laws.typical(simulation.law)
    rig = torsion.make_rig(simulation.radius, simulation.height, simulation.cell_size)
    drive = torsion.Drive(steps=simulation.steps)
    check(Prony(ratios=(0.1,), relaxation_times=(1.0,), scheme=simulation.scheme, part=simulation.part), law)
    torque = torsion.torque_for_strain(rig, np.hypot(sweep.storage, sweep.loss), simulation.strain)
    measured, scales = np.concatenate([sweep.storage, sweep.loss]), np.concatenate(sweep.deviations)
    data = (rig, law, jnp.asarray(sweep.angular_frequency), torque, measured, scales)

    def residuals(u, rig, law, omega, torque, measured, scales):
        m = simulated_moduli(u, rig, law, omega, torque, drive, simulation.scheme, simulation.part)
        return (jnp.concatenate([m.storage, m.loss]) - measured) / scales, m

    def evaluate(u, *data):
        def twice(u):
            r, m = residuals(u, *data)
            return r, (r, m)

        J, (r, m) = jax.jacfwd(twice, has_aux=True)(u)
        return r, J, m

    u0 = start.solution.u
    begin = time.perf_counter()
    if optimizer == OPTIMIZERS[0]:
        compiled = jax.jit(evaluate).lower(u0, *data).compile()
        compiling = time.perf_counter() - begin
        seen = {}

        def evaluated(u):
            r, J, seen[u.tobytes()] = compiled(u, *data)
            return r, J

        found = levenberg_marquardt_host(lambda u: evaluated(np.asarray(u)), u0, progress=progress)
        m = seen[np.asarray(found.u).tobytes()]
        running = time.perf_counter() - begin - compiling
    else:
        (found, m), compiling, running = _timed(
            lambda u, *data: (lambda s: (s, residuals(s.u, *data)[1]))(
                bfgs(lambda u, *d: residuals(u, *d)[0], u, *data)
            ),
            u0,
            *data,
        )
    storage, loss = np.asarray(m.storage), np.asarray(m.loss)
    worst = int(np.max(m.statistics.status))
    found = found._replace(converged=bool(found.converged) and worst == status.CONVERGED)
    details = {
        "optimizer": optimizer,
        "law": simulation.law,
        "radius_m": simulation.radius,
        "height_m": simulation.height,
        "nodes": rig.mesh.number_of_nodes,
        "elements": rig.mesh.number_of_elements,
        "geometry_factor": float(torsion.geometry_factor(rig, law)),
        "steps_per_cycle": simulation.steps,
        "scheme": simulation.scheme,
        "part": simulation.part,
        "rim_strain": simulation.strain,
        "newton_iterations": int(np.max(m.statistics.iterations)),
        "newton_residual": float(np.max(m.statistics.residual)),
        "newton_status": status.advice(worst),
        "transient": float(np.max(m.defect)),
    }
    fit = _fit("torsion", sweep, found, storage, loss, (), running, compiling, details)
    return fit._replace(warnings=(*fit.warnings, *_bias(start, fit)))


def _bias(closed: Fit, simulated: Fit) -> list[str]:
    """Where discretisation moves a parameter by more than its standard error."""
    shift = simulated.uncertainty.values - closed.uncertainty.values
    errors = simulated.uncertainty.standard_errors
    out = []
    for name, d, e, v in zip(simulated.uncertainty.names, shift, errors, closed.uncertainty.values, strict=True):
        if abs(d) > e and abs(d) > 1e-6 * abs(v):
            out.append(
                f"{name}: the simulation's discretisation moves it by {100 * d / v:.2g} %, more than its "
                f"standard error ({100 * e / v:.2g} %); raise --steps or trust the closed form"
            )
    return out
