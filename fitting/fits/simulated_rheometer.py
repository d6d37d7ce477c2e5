"""Identify a generalised Maxwell model with a simulated rheometer: the torsion of a sample between two plates.

The recursion is the update of the history variables of the viscosity in each time step. The rig is the rheometer with
the sample. The linear rig is the same test for small strain, whose moduli are known without a mesh.
"""

import time
from collections.abc import Callable
from functools import cache, partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from fitting.fits import sample_inertia
from fitting.fits.honesty.alike_points import INDEPENDENT, OF_INDEPENDENT, SHARED, with_alike_points
from fitting.fits.honesty.long_times import INTERVAL
from fitting.fits.viscoelastic import (
    MISSES,
    OPTIMIZERS,
    SHORT,
    BestPoint,
    Fit,
    Kind,
    by_importance,
    check_optimizer,
    fit_at,
    timed,
)
from fitting.methods import uncertainty
from fitting.methods.estimate import Estimate, mesh_bias, with_shared_errors
from fitting.methods.generalised_maxwell import Maxwell
from fitting.methods.least_squares import Solution, bfgs, levenberg_marquardt_host
from fitting.readers.rheometer import Sweep
from fitting.rigs import compression, torsion
from fitting.rigs.glued_compression import Glued, glued
from liverjax import laws
from liverjax.core import status
from liverjax.core.compiled import compiled
from liverjax.core.errors import InputError
from liverjax.core.struct import replace
from liverjax.physics import viscosity
from liverjax.physics.viscosity import Prony


class Simulation(NamedTuple):
    """Settings of the simulated torsion test: geometry [m], law, time integration of the Prony series, number of time
    steps and element size. `height` is the gap during the test, so a precompressed sample was taller at rest."""

    radius: float = torsion.RADIUS
    height: float = torsion.HEIGHT
    law: str = "neo_hookean"
    scheme: str = "exponential"
    part: str = "all"
    steps: int = 50
    cell_size: float | None = None
    strain: float = 1e-3  # amplitude at the rim (section 5.2)
    density: float | None = None  # density of the sample [kg/m^3]; None: the moduli contain no inertia
    precompression: float = 0.0  # decrease of the height, divided by the height at rest (`compression`)
    tensile: bool = False  # whether the data were measured in tension (`Sweep.tensile`)

    @property
    def is_linear(self) -> bool:
        """Whether the moduli are also known without a mesh. This is true for small strain, except for a compressed
        sample with inertia."""
        return self.strain <= LINEAR_STRAIN and not (self.density is not None and self.precompression)

    @property
    def inertia(self) -> tuple[float, float] | None:
        """Density [kg/m^3] and height [m] for `sample_inertia`. None: the measured moduli contain no inertia."""
        if self.density is None:
            return None
        density = compression.torsional_density(laws.typical(self.law), self.precompression, self.density)
        return density, self.height

    @property
    def run(self) -> "Simulation":
        """The settings of the simulation that is fitted to the data. For a compressed sample, the mesh error is known
        only without inertia. So the simulation has no inertia, and the inertia is subtracted from the data. The same is
        done for data of tension, because tension and torsion have different inertial forces."""
        return self._replace(density=None) if self.precompression or self.tensile else self


#: Up to this strain at the rim, the derivatives are computed with the linear rig. The relative error of the derivatives
#: is then at most 1 %. With inertia, the error of the derivatives also contains the effect of the mesh on the inertial
#: forces.
LINEAR_STRAIN = 1e-2


def law_and_prony(model: Maxwell, law: laws.Law, simulation: Simulation) -> tuple[laws.Law, Prony]:
    """Return the material of the sample for given Prony modes: the law, scaled to the G0 of the modes, and the
    viscosity."""
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
    """Return the residuals and the simulated moduli. The residuals (2n,) are simulated minus measured moduli, divided
    by their standard deviations. If `kind` has a prior, the residuals of the prior follow.

    Args:
        u: variables of `kind`.
        data: rig, law, angular frequencies (n,) [rad/s], torque amplitudes (n,) [N m], measured moduli G' then G''
            (2n,) [Pa] and their standard deviations.
        simulation: settings of the simulated test.
        kind: the meaning of u. The Prony modes at u are simulated.
    """
    rig, law, omega, torque, measured, scales = data
    drive = torsion.Drive(steps=simulation.steps)
    m = torsion.moduli(rig, *law_and_prony(kind.maxwell(u), law, simulation), omega, torque, drive)
    return _and_prior((jnp.concatenate([m.storage, m.loss]) - measured) / scales, u, kind), m


def with_jacobian(
    u: jax.Array, data: tuple, simulation: Simulation, kind: Kind = Kind()
) -> tuple[jax.Array, jax.Array, torsion.Moduli]:
    """Return the m residuals of `simulated_residuals`, their derivatives (m, P) with respect to the P variables u, and
    the simulated moduli.

    The derivatives are computed with the linear rig. If the strain is large, or if a compressed sample has inertia, the
    simulation is differentiated instead. With the linear rig, Gauss-Newton finds the same minimum in a small fraction
    of the time (experiments/benchmarks/torsion_speed.py).
    """
    if not simulation.is_linear:

        def twice(u):
            r, m = simulated_residuals(u, data, simulation, kind)
            return r, (r, m)

        J, (r, m) = jax.jacfwd(twice, has_aux=True)(u)
        return r, J, m
    rig, law, omega, _, _, scales = data

    def linear(u):
        G = small_strain_moduli(rig, kind.maxwell(u), law, omega, simulation)
        return _and_prior(jnp.concatenate([jnp.real(G), jnp.imag(G)]) / scales, u, kind)

    r, m = simulated_residuals(u, data, simulation, kind)
    return r, jax.jacfwd(linear)(u), m


def small_strain_moduli(
    rig: torsion.Rig, model: Maxwell, law: laws.Law, omega: jax.Array, simulation: Simulation
) -> jax.Array:
    """Return the complex moduli (n,) [Pa] of the linear rig at n frequencies. For small strain, the moduli of the
    simulation approach these moduli, except for the mesh error."""
    scaled, prony = law_and_prony(model, law, simulation)
    if simulation.precompression:
        scale = model.shear_modulus / law.shear_modulus()
        return scale * torsion.held_moduli(torsion.held(rig, law), rig, prony, omega, simulation.steps)
    G = torsion.linear_moduli(scaled, prony, omega, simulation.steps)
    if simulation.inertia is None:
        return G
    return sample_inertia.shown(G, sample_inertia.rate_in_steps(omega, simulation.steps), *simulation.inertia)


def rig_of(simulation: Simulation) -> torsion.Rig:
    """Return the rig of a simulation. Without a given element size, a coarse mesh is used for small strain without
    inertia: there, the mesh error is known exactly."""
    cell, height = simulation.cell_size, simulation.height
    if cell is None and simulation.density is None and simulation.strain <= LINEAR_STRAIN:
        cell = torsion.linear_cell_for(simulation.radius, height)
    if not simulation.precompression:
        return torsion.make_rig(simulation.radius, height, cell, density=simulation.density)
    if simulation.part != "all":
        raise InputError(
            f"a precompression of {simulation.precompression:g} needs a sample whose whole stress relaxes: remove part "
            f"= {simulation.part!r}"
        )
    tall = height / (1 - simulation.precompression)
    rest = torsion.make_rig(simulation.radius, tall, cell, density=simulation.density)
    rig = compression.compressed(rest, laws.typical(simulation.law), simulation.precompression)
    found, _ = _without_mesh(simulation.radius, height, simulation.law, simulation.precompression)
    return replace(rig, meshless=jnp.array([found.relaxing, found.standing]))


@cache
def _without_mesh(radius: float, gap: float, law: str, strain: float) -> tuple[Glued, Glued]:
    """Return the factors and the force of a sample that is compressed between glued plates, and the estimated mesh
    errors of these numbers (see `glued_compression.glued`). `law`: name of the law. A fit needs this result twice, so
    it is cached."""
    return glued(radius, gap, laws.typical(law), strain)


def simulation_data(sweep: Sweep, simulation: Simulation) -> tuple:
    """Return the data of `simulated_residuals`: rig, law, angular frequencies, torques, measured moduli and their
    standard deviations.

    Raises:
        InputError: `scheme` or `part` of the simulation is unknown, or the law does not have this part.
    """
    from liverjax.physics.viscosity import check_viscosity

    rig, law = rig_of(simulation), laws.typical(simulation.law)
    check_viscosity(Prony(ratios=(0.1,), relaxation_times=(1.0,), scheme=simulation.scheme, part=simulation.part), law)
    torque = torsion.torque_for_strain(rig, np.hypot(sweep.storage, sweep.loss), simulation.strain)
    measured, scales = np.concatenate([sweep.storage, sweep.loss]), np.concatenate(sweep.deviations)
    return rig, law, jnp.asarray(sweep.angular_frequency), torque, measured, scales


#: Results of the closed-form fit that are also valid for the fit with the simulation. OF_THE_DATA: words in the
#: warnings that are also valid. KEPT: keys of the details that are also valid.
OF_THE_DATA = (
    "modes would follow",
    "about as well as",
    "explains the data better",
    "would fit the data more closely",
    "no finite instantaneous",
    "that relaxes",
    "Kramers-Kronig",
    "half decade",
    "structured misfit",
    SHARED,
    "poses as",
    SHORT,
    "a solid fits the data as well",
)
KEPT = (
    "conversion",
    "spectrum",
    "models_compared",
    "band_sensitivity",
    "band_scatter",
    INDEPENDENT,
    OF_INDEPENDENT,
    "consistency",
    "instrument",
    "gap_error",
    INTERVAL,
)


def _as_simulated(sweep: Sweep, simulation: Simulation) -> tuple[Sweep, Simulation]:
    """Return the sweep and the settings of its simulation. Tension and torsion have different inertial forces. So for
    data of tension, the inertia is subtracted from the data, and the simulation has no inertia."""
    if simulation.inertia is None or not sweep.tensile:
        return sweep, simulation
    return sample_inertia.taken_off(sweep, *simulation.inertia), simulation._replace(tensile=True).run


def through_torsion(
    sweep: Sweep,
    start: Fit,
    simulation: Simulation = Simulation(),
    optimizer: str = OPTIMIZERS[0],
    progress: Callable[[int, float], None] = lambda iteration, cost: None,
) -> Fit:
    """Fit the moduli of the simulated rheometer to the measured moduli. The search begins at the closed-form fit.

    Args:
        sweep: data. They contain the inertia of the sample if `simulation` has a density.
        start: closed-form fit with the wanted number of modes, and with the errors of gap and instrument.
        simulation: settings of the simulated test. For data of tension, the fitted moduli contain no inertia.
        optimizer: one of `OPTIMIZERS`.
        progress: called after every evaluation.
    """
    check_optimizer(optimizer)
    begin = time.perf_counter()
    sweep, simulation = _as_simulated(sweep, simulation)
    data = simulation_data(sweep, simulation)
    # The time for the compression counts as compile time, because nearly all of it is compilation.
    pressing = time.perf_counter() - begin if simulation.precompression else 0.0
    rig, law, *_, scales = data
    u0, kind = jnp.asarray(start.solution.u), start.kind
    if optimizer == OPTIMIZERS[0]:
        begin = time.perf_counter()
        program = compiled(partial(with_jacobian, simulation=simulation, kind=kind), u0, data, short=True)
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
    if isinstance(start.solution.u, np.ndarray):  # then all later steps use NumPy too
        found = Solution(*(np.asarray(field) for field in found))
    storage, loss = np.asarray(m.storage), np.asarray(m.loss)
    worst = int(status.most_severe(m.statistics.status))
    found = found._replace(converged=bool(found.converged) and worst == status.CONVERGED)
    details = _simulation_details(simulation, rig, law, m) | {"optimizer": optimizer}
    if rig.held is not None:
        force, missed = _without_mesh(simulation.radius, simulation.height, simulation.law, simulation.precompression)
        details |= {"force_of_law_N": force.force, "force_of_law_mesh_bias_N": -missed.force}
    advice = () if worst == status.CONVERGED else (f"in the simulation, {status.advice(worst)}",)
    at = BestPoint("torsion", found, storage, loss, advice)
    fit = fit_at(sweep, at, kind, (running, compiling + pressing), details)
    if simulation.is_linear and kind.prior is None:
        fit = _with_biases(fit, (rig, law, data[2], scales), simulation)
    return _as_told_before(with_alike_points(fit, sweep) if INDEPENDENT in start.details else fit, start)


def _as_told_before(fit: Fit, start: Fit) -> Fit:
    """Add the errors of the gap and of the instrument to the simulated fit. They are taken from the closed-form fit
    `start`. Warnings and details of `start` are added too if they concern the data."""
    more = tuple(w for w in start.warnings if any(words in w for words in OF_THE_DATA))
    of_the_model = {k: v for k, v in start.details.items() if k in KEPT}
    fit = _with_shared_errors(fit._replace(details=fit.details | of_the_model), start)
    known = any(w.startswith(MISSES) for w in more)
    own = (w for w in fit.warnings if not w.startswith((SHARED, MISSES) if known else SHARED))
    return fit._replace(warnings=by_importance((*own, *more, *_bias(start, fit))))


def _with_shared_errors(fit: Fit, start: Fit) -> Fit:
    own = fit.parameters
    if own is not None and start.parameters is not None:
        own = with_shared_errors(own, start.parameters)
    return fit._replace(uncertainty=with_shared_errors(fit.uncertainty, start.uncertainty), parameters=own)


def _with_biases(fit: Fit, data: tuple, simulation: Simulation) -> Fit:
    """Return the fit with the changes of the parameters due to the mesh and due to the time steps, to first order.

    At small strain, both changes are computed from two sets of moduli without mesh error: one for the recursion, and
    one for continuous time. For a compressed sample, these moduli are computed with quadratic elements, and an estimate
    of the remaining mesh error is added (`glued_compression`).
    """
    rig, law, omega, scales = data
    scaled, prony = law_and_prony(fit.kind.maxwell(fit.solution.u), law, simulation)
    if simulation.precompression:
        meshless, exact = _of_held(rig, (scaled, prony), omega, simulation)
    else:
        program = compiled(partial(_of_no_mesh, steps=simulation.steps), scaled, prony, omega, short=True)
        meshless, exact = (np.asarray(G) for G in program(scaled, prony, omega))
    if simulation.inertia is not None:
        rate, inertia = np.asarray(omega), simulation.inertia
        exact = sample_inertia.shown(exact, rate, *inertia)
        meshless = sample_inertia.shown(meshless, sample_inertia.rate_in_steps(rate, simulation.steps), *inertia)

    def told(estimate: Estimate, natural_of: Callable) -> Estimate:
        def moved(missing: np.ndarray) -> np.ndarray:
            return mesh_bias(fit.solution, natural_of, np.concatenate([missing.real, missing.imag]) / scales)

        of_mesh = moved(meshless - (fit.storage + 1j * fit.loss))
        return estimate._replace(mesh_bias=of_mesh, time_step_bias=moved(exact - meshless))

    own, values = fit.parameters, fit.kind.values
    own = own if own is None or values is None else told(own, values)
    of_modes = told(fit.uncertainty, partial(uncertainty.parameter_vector, maxwell=fit.kind.maxwell))
    return fit._replace(uncertainty=of_modes, parameters=own)


def _of_no_mesh(law: laws.Law, prony: Prony, omega: jax.Array, steps: int) -> tuple[jax.Array, jax.Array]:
    """Return the complex moduli (n,) [Pa] at n frequencies without a mesh, for the recursion and for continuous
    time."""
    return torsion.linear_moduli(law, prony, omega, steps), torsion.linear_moduli(law, prony, omega, None)


def _of_held(
    rig: torsion.Rig, material: tuple[laws.Law, Prony], omega: jax.Array, simulation: Simulation
) -> tuple[np.ndarray, np.ndarray]:
    """Return the complex moduli (n,) [Pa] of a compressed sample at n frequencies, for the recursion and for continuous
    time. Both are corrected for the mesh error that `_without_mesh` estimates.
    """
    law, prony = material
    of, moduli = jax.jit(torsion.held)(rig, law), jax.jit(torsion.held_moduli, static_argnums=4)
    recursion, exact = (np.asarray(moduli(of, rig, prony, omega, steps)) for steps in (simulation.steps, None))
    _, missed = _without_mesh(simulation.radius, simulation.height, simulation.law, simulation.precompression)
    ratios = np.asarray(viscosity.complex_ratios(prony, omega, None))
    factor = missed.relaxing * (1 - ratios.sum(axis=0)) + missed.standing * (1 - np.sum(prony.ratios))
    more = float(law.shear_modulus()) * factor
    return recursion + more, exact + more


def _simulation_details(
    simulation: Simulation, rig: torsion.Rig, law: laws.Law, m: torsion.Moduli
) -> dict[str, object]:
    """Return settings and statistics of the simulation, for the report."""
    # For a sample without compression whose whole stress relaxes, the effect of the mesh is the same at every
    # frequency.
    known = simulation.part == "all" and rig.held is None
    rest = rig if rig.held is None else replace(rig, held=None, height=torsion.rest_height(rig))
    return {
        "law": simulation.law,
        "radius_m": simulation.radius,
        "height_m": simulation.height,
        "density_kg_m3": simulation.density,
        "nodes": rig.mesh.number_of_nodes,
        "elements": rig.mesh.number_of_elements,
        "geometry_factor": float(np.asarray(m.bias)[0].real if known else torsion.geometry_factor(rest, law)),
        "steps_per_cycle": simulation.steps,
        "scheme": simulation.scheme,
        "part": simulation.part,
        "precompression_strain": simulation.precompression,
        "rim_strain": simulation.strain,
        "newton_iterations": int(np.asarray(m.statistics.iterations).max()),
        "newton_residual": float(np.asarray(m.statistics.residual).max()),
        "newton_status": status.advice(int(status.most_severe(m.statistics.status))),
        "transient": float(np.asarray(m.defect).max()),
    }


def largest_shift(closed: Fit, simulated: Fit) -> float:
    """Return the largest difference between closed form and simulation, of all parameters and the equilibrium modulus.
    Each difference is divided by the standard error."""
    (before, _), (after, errors) = (_with_equilibrium(fit) for fit in (closed, simulated))
    shift = np.abs(after - before)
    known = np.isfinite(errors) & (shift > 1e-6 * np.abs(before))
    return float(np.max(shift[known] / np.maximum(errors[known], 1e-300), initial=0.0))


def _seen_by_user(fit: Fit) -> Estimate:
    """Return the parameters that are compared between simulation and closed form: of a springpot model, or of the Prony
    modes."""
    return fit.uncertainty if fit.parameters is None or fit.kind.effective is not None else fit.parameters


def _with_equilibrium(fit: Fit) -> tuple[np.ndarray, np.ndarray]:
    """Return two arrays: parameters and their standard errors. The parameters belong to a springpot model or to Prony
    modes. For Prony modes, the last entry is the equilibrium modulus."""
    u = _seen_by_user(fit)
    if u is not fit.uncertainty:
        return u.values, u.standard_errors
    rest = u.values[0] * (1 - u.values[1 : 1 + (len(u.values) - 1) // 2].sum())
    return np.append(u.values, rest), np.append(u.standard_errors, uncertainty.equilibrium_error(u))


def _bias(closed: Fit, simulated: Fit) -> list[str]:
    """Return a warning, with the cause, for each parameter that differs between simulation and closed form by more than
    its standard error."""
    before, after, out = _seen_by_user(closed), _seen_by_user(simulated), []
    each = zip(after.names, after.values - before.values, after.standard_errors, before.values, strict=True)
    for k, (name, d, e, v) in enumerate(each):
        if abs(d) > e and abs(d) > 1e-6 * abs(v):
            cause, remedy = _cause(closed, simulated, k)
            out.append(
                f"{name}: {cause} this parameter by {100 * d / v:.2g} %, more than its standard error "
                f"({100 * e / v:.2g} %); {remedy}"
            )
    return out


def _cause(closed: Fit, simulated: Fit, k: int) -> tuple[str, str]:
    """Return two parts of a warning about the change of parameter k: the cause with a verb ("… changes"), and the
    remedy."""
    # The simulation contains the inertia of the sample, but the closed form does not.
    if simulated.details.get("density_kg_m3") and not closed.details.get("density_kg_m3"):
        return (
            "the sample's inertia and the discretisation change",
            "raise --steps to see which of the two is the cause",
        )
    if simulated.details.get("precompression_strain"):
        return (
            "the glued plates, which prevent the sample from widening, change",
            "for smooth plates use --method closed-form",
        )
    of_mesh, of_steps = _seen_by_user(simulated).mesh_bias, _seen_by_user(simulated).time_step_bias
    if of_mesh is not None and of_steps is not None and abs(of_mesh[k]) > abs(of_steps[k]):
        return "the mesh of the simulation changes", "use the closed form (--method closed-form)"
    return "the simulation's discretisation changes", "raise --steps, or use the closed form (--method closed-form)"
