"""Identify a generalised Maxwell model from a frequency sweep, in closed form or through the torsion simulation."""

import time
from collections.abc import Callable, Sequence
from functools import lru_cache, partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from fitting.methods import generalised_maxwell, uncertainty
from fitting.methods.estimate import Estimate, mesh_bias
from fitting.methods.generalised_maxwell import Maxwell, Spectrum
from fitting.methods.host import Array
from fitting.methods.least_squares import Solution, bfgs, from_starts, levenberg_marquardt_host
from fitting.readers.rheometer import Sweep
from fitting.rigs import compression, torsion
from liverjax import laws
from liverjax.core import status
from liverjax.core.compiled import compiled
from liverjax.core.errors import InputError
from liverjax.core.struct import Content
from liverjax.physics.viscosity import Prony

OPTIMIZERS = ("levenberg-marquardt", "bfgs")


class Kind(NamedTuple):
    """The meaning of the numbers u of a fit; by default they are the Prony modes."""

    name: str = "prony"
    maxwell: Callable[[Array], Maxwell] = generalised_maxwell.natural  # Prony modes of u, for the simulation
    names: tuple[str, ...] = ()  # of its own parameters, where they are not the modes
    units: tuple[str, ...] = ()
    values: Callable[[jax.Array], jax.Array] | None = None  # u -> its own parameters (P,)
    prior: Callable[[jax.Array], jax.Array] | None = None  # u -> rows that stand below the residuals of the data
    effective: float | None = None  # number of parameters that the data determine; None: the length of u
    moduli: Callable[[Array, Array], Array] | None = None  # (u, omega) -> its own G* (n,) [Pa] at any frequency


class Fit(NamedTuple):
    """A fitted model with all that a report needs."""

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
    parameters: Estimate | None = None  # of the model's own numbers, where they are not the modes

    @property
    def modes(self) -> int:
        """N."""
        return len(self.model.ratios)

    def relative_errors(self, sweep: Sweep) -> np.ndarray:
        """|fit / data - 1| of G' then G'' (2n,)."""
        data = np.concatenate([sweep.storage, sweep.loss])
        return np.abs(np.concatenate([self.storage, self.loss]) / data - 1)


def timed(function: Callable, *arguments: Any) -> tuple[Any, float, float]:
    """Result, seconds of compilation, seconds of the run; a function seen with these shapes is not compiled again."""
    begin = time.perf_counter()
    arguments = jax.tree.map(jnp.asarray, arguments)
    leaves, tree = jax.tree.flatten(arguments)
    compiled = _compiled(function, tree, tuple((leaf.shape, leaf.dtype) for leaf in leaves))
    middle = time.perf_counter()
    result = jax.block_until_ready(compiled(*arguments))
    return result, middle - begin, time.perf_counter() - middle


@lru_cache(maxsize=16)  # the fits of several samples, and of parts of a band, are one program
def _compiled(function: Callable, tree: Any, kinds: tuple) -> Callable:
    arguments = jax.tree.unflatten(tree, [jax.ShapeDtypeStruct(shape, dtype) for shape, dtype in kinds])
    return jax.jit(function).lower(*arguments).compile()


@lru_cache(maxsize=16)
def best_of(minimise: Callable, residuals: Callable, each: int = 0) -> Callable[..., Solution]:
    """The lowest minimum over starting points (S, P). The first `each` arrays of data have a row a start."""

    def best(starts, *data):
        rows, common = data[:each], data[each:]
        found = jax.vmap(lambda u, *own: minimise(residuals, u, *own, *common))(starts, *rows)
        k = jnp.argmin(jnp.where(jnp.isfinite(found.cost), found.cost, jnp.inf))
        return jax.tree.map(lambda leaf: leaf[k], found)

    return best


def check_modes(sweep: Sweep, modes: int) -> None:
    """`InputError` where the sweep has too few points for the parameters, naming the largest number of modes."""
    largest = generalised_maxwell.largest_number_of_modes(sweep)
    if modes < 1:
        raise InputError(f"--modes {modes} must be at least 1, or auto")
    if modes > largest:
        raise InputError(
            f"{sweep.source or 'sweep'}: {largest + 1} different frequencies cannot determine the {2 * modes + 1} "
            f"parameters of {modes} modes; use at most --modes {largest}"
        )


def closed_form(sweep: Sweep, modes: int, dense: Spectrum | None = None, optimizer: str = "levenberg-marquardt") -> Fit:
    """Fit the closed-form moduli from several starts; the best minimum is kept.

    Args:
        sweep: data; residuals are divided by `sweep.deviations`.
        modes: N.
        dense: `generalised_maxwell.spectrum(sweep)` if already there.
        optimizer: one of `OPTIMIZERS`.
    """
    check_modes(sweep, modes)
    dense = dense or generalised_maxwell.refuse_impossible(sweep)
    return modes_from(sweep, generalised_maxwell.starts(sweep, modes, dense), Kind(), optimizer)


def modes_from(sweep: Sweep, starts: np.ndarray, kind: Kind = Kind(), optimizer: str = OPTIMIZERS[0]) -> Fit:
    """The best fit over `starts` (S, P) of Prony modes, of a solid or (by `kind`) of a fluid."""
    data = (sweep.angular_frequency, sweep.storage, sweep.loss, np.concatenate(sweep.deviations))
    if optimizer == OPTIMIZERS[0]:
        begin = time.perf_counter()
        found, compiling = from_starts(residuals_of(kind), starts, *data), 0.0
        running = time.perf_counter() - begin
    else:
        found, compiling, running = timed(best_of(bfgs, residuals_of(kind)), starts, *data)
    return fitted(sweep, found, kind, running, compiling, {"optimizer": optimizer})


def residuals_of(kind: Kind) -> Callable[..., Array]:
    """Residuals of Prony modes of a solid or a fluid, in NumPy or JAX."""
    return generalised_maxwell.fluid_residuals if kind.name == FLUID.name else generalised_maxwell.residuals


def fitted(sweep: Sweep, found: Solution, kind: Kind, running: float, compiling: float, details: Content) -> Fit:
    """The fit in closed form at a minimum over u of `kind`, whose first residuals are those of the data."""
    scales, measured = np.concatenate(sweep.deviations), np.concatenate([sweep.storage, sweep.loss])
    storage, loss = np.split(np.asarray(found.residuals)[: len(measured)] * scales + measured, 2)
    simulated = Simulated("closed-form", found, storage, loss)
    return _fit(sweep, simulated, kind, (running, compiling), details)


class Simulated(NamedTuple):
    """A minimum and the moduli there [Pa]."""

    method: str
    solution: Solution
    storage: np.ndarray
    loss: np.ndarray
    advice: tuple[str, ...] = ()  # where the simulation broke down


def _fit(sweep: Sweep, at: Simulated, kind: Kind, seconds: tuple[float, float], details: Content) -> Fit:
    found, storage, loss = at.solution, at.storage, at.loss
    spread = uncertainty.estimate(found, sweep.noise_given, kind.maxwell, (2 * len(storage), kind.effective))
    own = None
    if kind.values is not None:
        rows = (2 * len(storage), sweep.noise_given, kind.effective)
        own = uncertainty.estimated(kind.names, kind.values, found, *rows)
    sentences = _misfit(sweep, storage, loss, kind)
    sentences += tuple(uncertainty.cautions(sweep, spread, kind.name) if own is None else ())
    converged = bool(found.converged)
    advice = at.advice or (("try fewer modes",) if own is None else ("try another model",))
    if not converged:
        reason = f"the fit did not converge in {int(found.iterations)} iterations; its best point is given"
        sentences = (f"{reason}: {advice[0]}", *sentences)
    modes = len(spread.values) // 2
    model = Maxwell(spread.values[0], spread.values[1 : modes + 1], spread.values[modes + 1 :])
    details = details | {"iterations": int(found.iterations), "gradient": float(found.gradient)}
    return Fit(at.method, model, found, spread, converged, storage, loss, sentences, *seconds, details, kind, own)


#: N modes without an equilibrium modulus: their ratios add up to one.
FLUID = Kind("prony_fluid", generalised_maxwell.natural_fluid)


def _misfit(sweep: Sweep, storage: np.ndarray, loss: np.ndarray, kind: Kind) -> tuple[str, ...]:
    """A sentence where the model does not follow the data, naming the worst point."""
    e = np.abs(np.concatenate([storage / sweep.storage, loss / sweep.loss]) - 1)
    if e.mean() < 0.05 and e.max() < 0.3:
        return ()
    worst, n = int(np.argmax(e)), len(storage)
    where = f"{'storage' if worst < n else 'loss'}_modulus at {sweep.angular_frequency[worst % n] / (2 * np.pi):.3g} Hz"
    return (
        f"{MISSES} by {100 * e.mean():.2g} % on average and by {100 * e.max():.3g} % in {where}: "
        f"try {'another --model' if kind.values else 'more modes or another --model'}, or look at the data",
    )


def identifiable(fit: Fit, sweep: Sweep) -> bool:
    """Whether the fit converged and no warning advises against one of its modes."""
    return bool(fit.converged and not uncertainty.superfluous(sweep, fit.uncertainty))


def information_criterion(fit: Fit) -> float:
    """Bayesian information criterion with the noise level estimated: m ln(RSS/m) + k ln m.

    k is the number of parameters, or the effective one where a prior holds them.
    """
    m, k = 2 * len(fit.storage), len(fit.solution.u) if fit.kind.effective is None else fit.kind.effective
    mean_square = max(float(np.sum(np.asarray(fit.solution.residuals)[:m] ** 2)) / m, 1e-300)
    return float(m * np.log(mean_square) + k * np.log(m))


#: Mean relative residual at which a fit is exact to the digits of any data.
EXACT = 1e-7


def choose_modes(sweep: Sweep, dense: Spectrum, optimizer: str = OPTIMIZERS[0]) -> tuple[Fit, list[Fit]]:
    """Raise N while the criterion falls and every mode is identifiable, or until the fit is exact. Return the chosen
    fit and all tried.

    One failure may be a local minimum: the search ends at the second in a row. A number of modes whose computation
    breaks down is such a failure, and is named in the warnings; the others stay.
    """
    cap = min(uncertainty.supported_modes(sweep), generalised_maxwell.largest_number_of_modes(sweep))
    tried: list[Fit] = []
    broken: dict[int, str] = {}
    chosen, failures = None, 0
    for modes in range(1, cap + 1):
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
        raise InputError(f"{sweep.source or 'sweep'}: no number of modes could be fitted ({broken[1]}); check the data")
    table = [
        {
            "modes": f.modes,
            "information_criterion": float(information_criterion(f)),
            "identifiable": identifiable(f, sweep),
            "mean_relative_error": float(np.mean(f.relative_errors(sweep))),
        }
        for f in tried
    ]
    return (
        chosen._replace(
            warnings=(*chosen.warnings, *_other_numbers(sweep, chosen, tried, broken)),
            compile_time=sum(f.compile_time for f in tried),
            run_time=sum(f.run_time for f in tried),
            details=chosen.details | {"modes_tried": table},
        ),
        tried,
    )


def _other_numbers(sweep: Sweep, chosen: Fit, tried: list[Fit], broken: dict[int, str]) -> list[str]:
    """Warnings on other numbers of modes: a closer fit that was not chosen, and fits that broke down."""
    out = []
    closer = min(tried, key=information_criterion)
    if information_criterion(closer) < information_criterion(chosen) - 10:
        a, b = (100 * np.mean(f.relative_errors(sweep)) for f in (closer, chosen))
        out.append(
            f"{closer.modes} modes would follow the data more closely ({a:.2g} % instead of {b:.2g} % on average), but "
            f"the data leave some of their parameters free; --modes {closer.modes} gives them all the same"
        )
    for modes, reason in broken.items():
        out.append(
            f"{modes} mode{'s' if modes > 1 else ''} could not be fitted ({reason}) and took no part in the choice"
        )
    return out


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
    density: float | None = None  # of the sample [kg/m^3]; None: moduli that the instrument corrected for inertia
    precompression: float = 0.0  # part of the height at rest by which the plates compress the sample (`compression`)


#: Strain at the rim up to which the derivatives of the linear rig serve: they are off by less than the strain.
LINEAR_STRAIN = 1e-2


def law_and_prony(model: Maxwell, law: laws.Law, simulation: Simulation) -> tuple[laws.Law, Prony]:
    """The sample of Prony modes: the law scaled to their G0, and how it relaxes."""
    viscosity = Prony(
        ratios=model.ratios,
        relaxation_times=model.relaxation_times,
        scheme=simulation.scheme,
        part=simulation.part,
    )
    return laws.scaled(law, model.shear_modulus / law.shear_modulus()), viscosity


def _and_prior(r: jax.Array, u: jax.Array, kind: Kind) -> jax.Array:
    return r if kind.prior is None else jnp.concatenate([r, kind.prior(u)])


def simulated_residuals(
    u: jax.Array, data: tuple, simulation: Simulation, kind: Kind = Kind()
) -> tuple[jax.Array, torsion.Moduli]:
    """Simulated less measured moduli over their deviations (2n,), then rows of a prior; and the simulated moduli.

    Args:
        u: numbers of `kind`.
        data: rig, law, angular frequencies (n,) [rad/s], torque amplitudes (n,) [N m], measured moduli G' then G''
            (2n,) [Pa] and their deviations.
        simulation: law, recursion and resolution.
        kind: what u means; its Prony modes are simulated.
    """
    rig, law, omega, torque, measured, scales = data
    drive = torsion.Drive(steps=simulation.steps)
    m = torsion.moduli(rig, *law_and_prony(kind.maxwell(u), law, simulation), omega, torque, drive)
    return _and_prior((jnp.concatenate([m.storage, m.loss]) - measured) / scales, u, kind), m


def with_jacobian(
    u: jax.Array, data: tuple, simulation: Simulation, kind: Kind = Kind()
) -> tuple[jax.Array, jax.Array, torsion.Moduli]:
    """Residuals, their derivative by u (rows, P), and the simulated moduli. See `simulated_residuals`.

    The derivative is that of the linear rig; with large strain or inertia it is that of the simulation. Gauss-Newton
    finds the same minimum with it in a small part of the time (experiments/benchmarks/torsion_speed.py).
    """
    if simulation.density is not None or simulation.strain > LINEAR_STRAIN:

        def twice(u):
            r, m = simulated_residuals(u, data, simulation, kind)
            return r, (r, m)

        J, (r, m) = jax.jacfwd(twice, has_aux=True)(u)
        return r, J, m
    rig, law, omega, _, _, scales = data

    def linear(u):
        G = _linear_moduli(rig, kind.maxwell(u), law, omega, simulation)
        return _and_prior(jnp.concatenate([jnp.real(G), jnp.imag(G)]) / scales, u, kind)

    r, m = simulated_residuals(u, data, simulation, kind)
    return r, jax.jacfwd(linear)(u), m


def _linear_moduli(
    rig: torsion.Rig, model: Maxwell, law: laws.Law, omega: jax.Array, simulation: Simulation
) -> jax.Array:
    """Complex moduli [Pa] (n,) that the simulation approaches as the strain goes to zero."""
    scaled, prony = law_and_prony(model, law, simulation)
    if simulation.precompression:
        scale = model.shear_modulus / law.shear_modulus()
        return scale * torsion.held_moduli(torsion.held(rig, law), rig, prony, omega, simulation.steps)
    return torsion.linear_moduli(scaled, prony, omega, simulation.steps)


def rig_of(simulation: Simulation) -> torsion.Rig:
    """The sample of a simulation; its mesh is coarse where the bias of the mesh is known exactly."""
    cell, height = simulation.cell_size, simulation.height
    if cell is None and simulation.density is None and simulation.strain <= LINEAR_STRAIN:
        cell = torsion.linear_cell_for(simulation.radius, height)
    if not simulation.precompression:
        return torsion.make_rig(simulation.radius, height, cell, density=simulation.density)
    if simulation.part != "all":
        raise InputError(
            f"a precompression of {simulation.precompression:g} is of a sample whose whole stress relaxes: leave out "
            f"part {simulation.part!r}"
        )
    tall = height / (1 - simulation.precompression)
    rest = torsion.make_rig(simulation.radius, tall, cell, density=simulation.density)
    return compression.compressed(rest, laws.typical(simulation.law), simulation.precompression)


def simulation_data(sweep: Sweep, simulation: Simulation) -> tuple:
    """Rig, law, angular frequencies, torques, measured moduli and deviations: the data of `simulated_residuals`."""
    rig = rig_of(simulation)
    torque = torsion.torque_for_strain(rig, np.hypot(sweep.storage, sweep.loss), simulation.strain)
    measured, scales = np.concatenate([sweep.storage, sweep.loss]), np.concatenate(sweep.deviations)
    return rig, laws.typical(simulation.law), jnp.asarray(sweep.angular_frequency), torque, measured, scales


#: What the closed form says of data and model, which the simulation leaves as it is: words of warnings, and details.
OF_THE_DATA = (
    "modes would follow",
    "about as well as",
    "would follow the data more closely",
    "no finite instantaneous",
    "that relaxes",
    "Kramers-Kronig",
    "half decade",
    "structured misfit",
    "poses as",
)
#: Words of the warnings that come first, the most important of all at the beginning.
MISSES = "the fit misses the data"
IMPORTANT = ("did not converge", MISSES, "Kramers-Kronig", "that relaxes", "structured misfit", "half decade")
KEPT = ("conversion", "spectrum", "models_compared", "band_sensitivity", "consistency", "instrument")


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
    from liverjax.physics.viscosity import check

    data = simulation_data(sweep, simulation)
    rig, law, *_, scales = data
    check(Prony(ratios=(0.1,), relaxation_times=(1.0,), scheme=simulation.scheme, part=simulation.part), law)
    u0, kind = jnp.asarray(start.solution.u), start.kind
    if optimizer == OPTIMIZERS[0]:
        begin = time.perf_counter()
        program = compiled(partial(with_jacobian, simulation=simulation, kind=kind), u0, data)
        compiling = time.perf_counter() - begin
        seen = {}

        def evaluated(u):
            r, J, seen[np.asarray(u).tobytes()] = program(u, data)
            return r, J

        found = levenberg_marquardt_host(evaluated, u0, progress=progress)
        m = seen[np.asarray(found.u).tobytes()]
        running = time.perf_counter() - begin - compiling
    else:

        def minimised(u, *data):
            found = bfgs(lambda u, *data: simulated_residuals(u, data, simulation, kind)[0], u, *data)
            return found, simulated_residuals(found.u, data, simulation, kind)[1]

        (found, m), compiling, running = timed(minimised, u0, *data)
    if isinstance(start.solution.u, np.ndarray):  # what follows runs where the closed form did
        found = Solution(*(np.asarray(field) for field in found))
    storage, loss = np.asarray(m.storage), np.asarray(m.loss)
    worst = int(np.max(m.statistics.status))
    found = found._replace(converged=bool(found.converged) and worst == status.CONVERGED)
    details = _simulation_details(simulation, rig, law, m) | {"optimizer": optimizer}
    if rig.held is not None:
        details["force_of_law_N"] = float(torsion.axial_force(rig, law))
    advice = () if worst == status.CONVERGED else (f"in the simulation, {status.advice(worst)}",)
    at = Simulated("torsion", found, storage, loss, advice)
    fit = _fit(sweep, at, kind, (running, compiling), details)
    if simulation.density is None and simulation.strain <= LINEAR_STRAIN and kind.prior is None:
        fit = fit._replace(uncertainty=_with_biases(fit, (law, data[2], scales), simulation))
    more = tuple(w for w in start.warnings if any(words in w for words in OF_THE_DATA))
    of_the_model = {k: v for k, v in start.details.items() if k in KEPT}
    fit = fit._replace(details=fit.details | of_the_model)
    own = tuple(w for w in fit.warnings if not (w.startswith(MISSES) and any(m.startswith(MISSES) for m in more)))
    return fit._replace(warnings=by_importance((*own, *more, *_bias(start, fit))))


def by_importance(sentences: Sequence[str]) -> tuple[str, ...]:
    """Warnings in the order of `IMPORTANT`; the others as they stand."""

    def place(sentence: str) -> int:
        return next((k for k, words in enumerate(IMPORTANT) if words in sentence), len(IMPORTANT))

    return tuple(sorted(sentences, key=place))


def _with_biases(fit: Fit, data: tuple, simulation: Simulation) -> Estimate:
    """Change of the parameters by the simulation's mesh and time steps, to first order (`mesh_bias`).

    At small strain both are known: the moduli of the recursion without a mesh, and those of continuous time. Those of
    a compressed sample without a mesh are extrapolated from a finer mesh.
    """
    law, omega, scales = data
    scaled, prony = law_and_prony(fit.kind.maxwell(jnp.asarray(fit.solution.u)), law, simulation)
    if simulation.precompression:
        meshless, exact = _of_finer_mesh(fit, scaled, prony, omega, simulation)
    else:
        meshless = np.asarray(torsion.linear_moduli(scaled, prony, omega, simulation.steps))
        exact = np.asarray(torsion.linear_moduli(scaled, prony, omega, None))
    natural_of = partial(uncertainty.parameter_vector, maxwell=fit.kind.maxwell)
    found = fit.solution._replace(u=jnp.asarray(fit.solution.u))

    def moved(missing: np.ndarray) -> np.ndarray:
        return mesh_bias(found, natural_of, np.concatenate([missing.real, missing.imag]) / scales)

    return fit.uncertainty._replace(
        mesh_bias=moved(meshless - (fit.storage + 1j * fit.loss)), time_step_bias=moved(exact - meshless)
    )


#: Length of a cell of the finer mesh over that of the mesh, for the extrapolation.
FINER = 0.62


def _of_finer_mesh(
    fit: Fit, law: laws.Law, prony: Prony, omega: jax.Array, simulation: Simulation
) -> tuple[np.ndarray, np.ndarray]:
    """Complex moduli (n,) of a compressed sample without a mesh: by the recursion, and in continuous time.

    The error of the mesh is taken to be of second order.
    """
    cell = simulation.cell_size or torsion.linear_cell_for(simulation.radius, simulation.height)
    rig = rig_of(simulation._replace(cell_size=FINER * cell))
    of, moduli = jax.jit(torsion.held)(rig, law), jax.jit(torsion.held_moduli, static_argnums=4)
    fine, exact = (np.asarray(moduli(of, rig, prony, omega, steps)) for steps in (simulation.steps, None))
    found = fit.storage + 1j * fit.loss
    meshless = found + (fine - found) / (1 - FINER**2)
    force = float(torsion.axial_force(rig, laws.typical(simulation.law)))
    fit.details["force_of_law_mesh_bias_N"] = (fit.details["force_of_law_N"] - force) / (1 - FINER**2)
    return meshless, meshless + exact - fine


def _simulation_details(
    simulation: Simulation, rig: torsion.Rig, law: laws.Law, m: torsion.Moduli
) -> dict[str, object]:
    """Settings and statistics of the simulation, for the report."""
    whole = simulation.part == "all"  # then the bias is the same at every frequency, and known
    return {
        "law": simulation.law,
        "radius_m": simulation.radius,
        "height_m": simulation.height,
        "density_kg_m3": simulation.density,
        "nodes": rig.mesh.number_of_nodes,
        "elements": rig.mesh.number_of_elements,
        "geometry_factor": float(m.bias[0].real if whole else torsion.geometry_factor(rig, law)),
        "steps_per_cycle": simulation.steps,
        "scheme": simulation.scheme,
        "part": simulation.part,
        "precompression_strain": simulation.precompression,
        "rim_strain": simulation.strain,
        "newton_iterations": int(np.max(m.statistics.iterations)),
        "newton_residual": float(np.max(m.statistics.residual)),
        "newton_status": status.advice(np.max(m.statistics.status)),
        "transient": float(np.max(m.defect)),
    }


def largest_shift(closed: Fit, simulated: Fit) -> float:
    """Largest change of a parameter by the simulation, over its standard error."""
    shift = np.abs(simulated.uncertainty.values - closed.uncertainty.values)
    errors = simulated.uncertainty.standard_errors
    known = np.isfinite(errors) & (shift > 1e-6 * np.abs(closed.uncertainty.values))
    return float(np.max(shift[known] / np.maximum(errors[known], 1e-300), initial=0.0))


def _bias(closed: Fit, simulated: Fit) -> list[str]:
    """A warning where the simulation moves a parameter by more than its standard error, with the cause."""
    shift = simulated.uncertainty.values - closed.uncertainty.values
    errors = simulated.uncertainty.standard_errors
    cause, remedy = "the simulation's discretisation moves", "raise --steps or trust the closed form"
    if simulated.details.get("precompression_strain"):
        cause, remedy = "the plates, which hold the sides of the sample, move", "which plates yours are decides it"
    if simulated.details.get("density_kg_m3") is not None:  # which the closed form knows nothing of
        cause, remedy = "the sample's inertia and the discretisation move", "raise --steps to see which it is"
    out = []
    for name, d, e, v in zip(simulated.uncertainty.names, shift, errors, closed.uncertainty.values, strict=True):
        if abs(d) > e and abs(d) > 1e-6 * abs(v):
            out.append(
                f"{name}: {cause} it by {100 * d / v:.2g} %, more than its standard error ({100 * e / v:.2g} %); "
                f"{remedy}"
            )
    return out
