"""One set of Prony parameters, fitted to several tests together (sweep, creep, tension, indentation). Each test has its
own noise.

The Levenberg-Marquardt method minimises the sum of the squared residuals of all tests. Each residual is divided by its
noise. A rig is a test machine with its sample. The simulation of a rig is differentiated in forward mode. The shear
modulus of the law is scaled to G0, as in the torsion fit.
"""

import time
import warnings
from collections.abc import Callable, Sequence
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from fitting.fits import viscoelastic
from fitting.fits.together.measured_tests import QUIETEST
from fitting.methods import generalised_maxwell
from fitting.methods.estimate import Estimate, bias_sentences, estimated, mesh_bias
from fitting.methods.least_squares import levenberg_marquardt_host
from fitting.methods.uncertainty import parameter_names, parameter_vector
from fitting.readers.frequency_sweep import check_sweep
from fitting.readers.rheometer import Sweep
from fitting.rigs import glued, torsion
from liverjax import laws
from liverjax.core import status
from liverjax.core.errors import InputError
from liverjax.core.struct import Number, Numbers
from liverjax.laws import Law
from liverjax.physics.viscosity import Prony


class Test(NamedTuple):
    """A measurement with n values, and the function `predict`, which returns the predicted values (n,) and the worst
    status code of the simulation."""

    name: str
    predict: Callable[[Law, Prony, generalised_maxwell.Maxwell], tuple[jax.Array, jax.Array]]  # (n,), worst code
    measured: np.ndarray  # (n,)
    sd: np.ndarray  # (n,) standard deviation of the noise
    #: Two changes (n,) of the predicted values: from the mesh to an infinitely fine mesh, and from the time steps to
    #: infinitely small time steps. None: the test has no mesh and no time steps, or these changes are unknown.
    errors: Callable[[Law, Prony], tuple[jax.Array, np.ndarray]] | None = None


def sweep(data: Sweep) -> Test:
    """Return the test for a frequency sweep that is predicted in closed form. The noise is read from the file. If the
    file states no noise, it is computed from the misfit of the best Prony modes."""
    check_sweep(data)
    omega = jnp.asarray(data.angular_frequency)

    def predict(law, viscosity, model):
        return jnp.concatenate(generalised_maxwell.moduli(model, omega)), jnp.zeros((), jnp.int32)

    return Test("sweep", predict, np.concatenate([data.storage, data.loss]), _noise_of(data))


def torsion_sweep(data: Sweep, rig: torsion.Rig, torque: Number, drive: torsion.Drive = torsion.Drive()) -> Test:
    """Return the test for a frequency sweep that the torsion simulation predicts, with the torque amplitude `torque` [N
    m]. `rig.free_height` states whether the height of the sample is free.

    The moduli are corrected for the mesh. The error of the time steps is computed for small strain. This error is
    unknown if the rig has a density or is compressed.
    """
    check_sweep(data)
    omega = jnp.asarray(data.angular_frequency)

    def predict(law, viscosity, model):
        found = torsion.moduli(rig, law, viscosity, omega, torque, drive)
        return jnp.concatenate([found.storage, found.loss]), status.most_severe(found.statistics.status)

    def errors(law, viscosity):
        exact, found = (torsion.linear_moduli(law, viscosity, omega, steps) for steps in (None, drive.steps))
        of_steps = np.asarray(exact - found)
        return jnp.zeros(2 * len(of_steps)), np.concatenate([of_steps.real, of_steps.imag])

    known = rig.density is None and rig.held is None
    measured = np.concatenate([data.storage, data.loss])
    return Test("torsion", predict, measured, _noise_of(data), errors if known else None)


def _noise_of(data: Sweep) -> np.ndarray:
    """Return the standard deviations (2n,) [Pa] of G' and G'' at the n frequencies of a sweep. If the file has no
    standard deviations, the scales of the sweep are only weights, and the misfit of Prony modes gives the noise.
    """
    scales = np.concatenate(data.deviations)
    if data.noise_given:
        return scales
    _, tried = viscoelastic.choose_modes(data, generalised_maxwell.refuse_impossible(data))
    # This sweep may not determine all modes of a fit. Such a fit is used too, because the other tests may determine
    # these modes.
    return scales * max(QUIETEST, min(fit.uncertainty.noise for fit in tried))


def through(name: str, rig: glued.Rig, measured: Numbers, sd: Numbers) -> Test:
    """Return the test for readings (T,) [N] or [m] of a rig of `fitting.rigs.glued`, one reading for each of T time
    steps. `sd` is the standard deviation of the noise, as one number or (T,).

    Raises:
        InputError: the number of readings differs from the number of steps of the rig, a value is not finite, or `sd`
            is not positive.
    """
    measured = np.asarray(measured, float)
    if measured.shape != (rig.scene.solve.steps,):
        raise InputError(
            f"{name}: there are {measured.size} readings for {rig.scene.solve.steps} steps; give one reading per step"
        )
    if np.shape(sd) not in ((), measured.shape):
        raise InputError(f"{name}: sd has shape {np.shape(sd)}; give one number, or one per reading {measured.shape}")
    sd = np.broadcast_to(np.asarray(sd, float), measured.shape)
    if not (np.all(np.isfinite(measured)) and np.all(np.isfinite(sd)) and np.all(sd > 0)):
        raise InputError(f"{name}: measured and sd must be finite, and sd above 0; correct these values")

    def predict(law, viscosity, model):
        readings, codes = glued.read(rig, law, viscosity)
        return readings, status.most_severe(codes)

    return Test(name, predict, measured, sd, partial(glued.reading_errors, rig))


def fit(
    tests: Sequence[Test],
    start: generalised_maxwell.Maxwell,
    law: Law,
    part: str = "all",
    max_iterations: int = 30,
    progress: Callable[[int, float], None] = lambda iteration, cost: None,
) -> Estimate:
    """Fit the Maxwell parameters (`uncertainty.parameter_names`) to all tests. The result contains standard errors.

    If tests are simulated in rigs, `mesh_bias` and `time_step_bias` are the errors of each parameter due to meshes and
    time steps. Subtract both to correct the parameter. A warning is given if one of them exceeds the standard error. A
    test with `Test.errors` = None counts as a test without these errors.

    Args:
        tests: one or more tests.
        start: starting values of the parameters. They also set the number of modes.
        law: one law for all tests. The fit scales its shear modulus to G0.
        part: which part of the stress relaxes, see `Prony`.
        max_iterations, progress: see `levenberg_marquardt_host`.
    """
    _check_joint(tests, start, law)
    begin, worst = time.perf_counter(), list[int]()

    def material(u):
        model = generalised_maxwell.natural(u)
        viscosity = Prony(ratios=model.ratios, relaxation_times=model.relaxation_times, part=part)
        return laws.scaled(law, model.shear_modulus / law.shear_modulus()), viscosity, model

    @jax.jit
    def with_jacobian(u):
        def residuals(u):
            scaled, viscosity, model = material(u)
            rows, codes = [], []
            for test in tests:
                predicted, code = test.predict(scaled, viscosity, model)
                rows.append((predicted - test.measured) / test.sd)
                codes.append(code)
            return jnp.concatenate(rows), (jnp.concatenate(rows), jnp.stack(codes))

        J, (r, codes) = jax.jacfwd(residuals, has_aux=True)(u)
        return r, J, codes

    def evaluate(u):
        r, J, codes = with_jacobian(u)
        worst[:] = np.asarray(codes).tolist()
        return r, J

    found = levenberg_marquardt_host(evaluate, generalised_maxwell.unconstrained(start), max_iterations, progress)
    evaluate(found.u)
    names = parameter_names((len(found.u) - 1) // 2)
    converged = bool(found.converged) and all(c == status.CONVERGED for c in worst)
    estimate = estimated(names, parameter_vector, found, len(found.residuals))
    if any(test.errors for test in tests):
        missing = _missing(tests, material(found.u)[:2])
        of_mesh, of_steps = (mesh_bias(found, parameter_vector, rows) for rows in missing)
        estimate = estimate._replace(mesh_bias=of_mesh, time_step_bias=of_steps)
        for sentence in bias_sentences(estimate):
            warnings.warn(sentence, stacklevel=2)
    return estimate._replace(converged=converged, codes=tuple(worst), seconds=time.perf_counter() - begin)


def _check_joint(tests: Sequence[Test], start: generalised_maxwell.Maxwell, law: Law) -> None:
    """Raise InputError if tests, law or start are invalid."""
    if not tests:
        raise InputError("tests is empty: give one test or more")
    if not callable(getattr(law, "shear_modulus", None)):
        raise InputError(f"law = {law!r} is not a law: give e.g. laws.typical('neo_hookean')")
    ratios, times = (np.atleast_1d(np.asarray(v, float)) for v in (start.ratios, start.relaxation_times))
    if ratios.shape != times.shape or ratios.ndim != 1:
        raise InputError(
            f"start has {ratios.size} ratios and {times.size} relaxation_times: give one ratio and one time for each "
            "mode"
        )
    if not (np.isfinite(start.shear_modulus) and start.shear_modulus > 0):
        raise InputError(f"start: shear_modulus = {start.shear_modulus} must be above 0 Pa; give e.g. 1000.0")
    if not (np.all(ratios > 0) and ratios.sum() < 1):
        raise InputError(
            f"start: ratios = {ratios.tolist()} must be above 0 and add up to less than 1; correct the ratios"
        )
    if not (np.all(times > 0) and np.all(np.isfinite(times))):
        raise InputError(f"start: relaxation_times = {times.tolist()} must be finite and above 0 s; correct the times")


def _missing(tests: Sequence[Test], material: tuple[Law, Prony]) -> tuple[np.ndarray, np.ndarray]:
    """Return two errors of all n readings: the errors due to the meshes (n,), and the errors due to the time steps
    (n,). Both are divided by the standard deviations of the noise."""
    both = []
    for test in tests:
        none = np.zeros(len(test.measured))
        errors = (none, none) if test.errors is None else test.errors(*material)
        both.append([np.asarray(error) / test.sd for error in errors])
    of_mesh, of_steps = (np.concatenate(rows) for rows in zip(*both, strict=True))
    return of_mesh, of_steps
