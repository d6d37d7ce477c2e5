"""Fit a few parameters of one or more scenes to measured displacements by Levenberg-Marquardt, with standard errors."""

import time
import warnings
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

import liverjax as lj
from fitting.methods.estimate import Estimate, bias_sentences, errors_and_correlation, estimated, mesh_bias
from fitting.methods.least_squares import Solution, levenberg_marquardt_host
from fitting.methods.noise.alike_noise import alike_noise
from fitting.methods.noise.uneven_noise import uneven_root
from fitting.readers.displacements import Displacements, error_between_nodes, weighted_differences
from fitting.rigs.time_steps import change_with_small_steps
from liverjax.core import status
from liverjax.core.errors import InputError
from liverjax.core.names import metadata
from liverjax.core.struct import Content, replace
from liverjax.mesh.tetrahedra import TetMesh
from liverjax.scenes.checks.numbers import check_bounds
from liverjax.scenes.scene import Scene, numbers_at
from liverjax.simulation.automatic import with_solver
from liverjax.simulation.mesh_error import mesh_error_of, refuse
from liverjax.simulation.run import prepared

#: Function from a richer mesh to the parameters of the scene, by dotted name (see `mesh_error_of`).
Finer = Callable[[TetMesh], Content]


class Problem(NamedTuple):
    """Scenes of one body under different loads, and the displacements that were measured in each scene."""

    scenes: tuple[Scene, ...]
    data: tuple[Displacements, ...]

    @property
    def components(self) -> int:
        """Number of measured displacement components in all scenes."""
        return sum(d.components for d in self.data)


def check_data(problem: Problem) -> None:
    """Raise `InputError` if the data of a scene name a step or a node that the scene does not have."""
    for k, (scene, data) in enumerate(zip(problem.scenes, problem.data, strict=True)):
        for name, values, number in (
            ("step", data.step, scene.solve.steps),
            ("nodes", data.nodes, scene.mesh.number_of_nodes),
        ):
            own = np.asarray(values)
            if own.size and not 0 <= own.min() <= own.max() < number:
                raise InputError(
                    f"data.{k}.{name} contains a number outside 0 to {number - 1}: count steps and nodes from 0"
                )


def misfit(problem: Problem, values: Mapping[str, object], store: str | int = "all") -> tuple[jax.Array, jax.Array]:
    """Simulate all scenes with the parameters `values`. Return the n residuals (n,), and the most severe status code of
    each scene. `store`: see `liverjax.simulate`."""
    parts, codes = [], []
    for scene, data in zip(problem.scenes, problem.data, strict=True):
        result = lj.simulate(lj.with_parameters(scene, values), store=store)
        parts.append(weighted_differences(data, scene, result.positions))
        codes.append(status.most_severe(result.status))
    return jnp.concatenate(parts), jnp.stack(codes)


def with_solvers(problem: Problem, values: Mapping[str, object]) -> Problem:
    """Return the problem with the linear solvers that its scenes need for the parameters `values`. The solvers must be
    chosen before compilation, because the values of the parameters are unknown during compilation.

    Raises:
        InputError: the data name a step or a node that a scene does not have.
    """
    check_data(problem)
    return problem._replace(scenes=tuple(with_solver(scene, [values]) for scene in problem.scenes))


class Unknowns(NamedTuple):
    """The n unknowns u (n,) of the fit, and the functions that compute the parameters of the scenes from u."""

    start: np.ndarray  # starting point u (n,)
    values_of: Callable[[jax.Array], Content]  # u -> dictionary: dotted name -> parameter of the scenes
    natural_of: Callable[[jax.Array], jax.Array]  # u -> m reported parameters (m,)
    names: Sequence[str]  # names of the reported parameters
    #: Function (u, richer mesh) -> parameters (E,) or (Q, E) of its E elements with Q integration points. It is needed
    #: if the parameters vary within an element. The estimated mesh error then contains the effect of this variation.
    at_points: Callable[[jax.Array, TetMesh], Content] | None = None


def fit(
    problem: Problem,
    unknowns: Unknowns,
    max_iterations: int = 20,
    progress: Callable[[int, float], None] = lambda iteration, cost: None,
    mesh_error: bool = True,
) -> tuple[Estimate, Solution]:
    """Minimise the sum of the squared residuals over the unknowns u. Return the reported parameters with standard
    errors, and the solution for u.

    Args:
        problem: scenes and data.
        unknowns: u, and the functions from u to the parameters of the scenes and to the reported parameters.
        max_iterations, progress: see `levenberg_marquardt_host`.
        mesh_error: whether to estimate the errors due to the meshes and the time steps. These errors change each
            parameter (`mesh_bias`, `time_step_bias`). A warning is given if the change is larger than the standard
            error. The estimate needs more runs, and one linear solve per step.
    """
    begin, codes = time.perf_counter(), [0] * len(problem.scenes)
    start, values_of, natural_of, names, at_points = unknowns
    problem = with_solvers(problem, values_of(jnp.asarray(start, float)))

    @jax.jit
    def with_jacobian(problem, u):
        def twice(u):
            r, codes = misfit(problem, values_of(u))
            return r, (r, codes)

        J, (r, codes) = jax.jacfwd(twice, has_aux=True)(u)
        return r, J, codes

    def evaluate(u):
        r, J, codes[:] = with_jacobian(problem, u)
        return r, J

    found = levenberg_marquardt_host(evaluate, jnp.asarray(start, float), max_iterations, progress)
    ended = tuple(int(c) for c in np.asarray(with_jacobian(problem, found.u)[2]))
    converged = bool(found.converged) and all(c == status.CONVERGED for c in ended)
    seconds = time.perf_counter() - begin
    estimate = estimated(names, natural_of, found, problem.components)
    estimate = _of_alike_noise(problem, natural_of, found, estimate)
    known = np.all(np.isfinite(estimate.standard_errors))  # an infinite standard error: a parameter ran to a limit
    values = values_of(found.u)
    refused = _refused(problem, values) if known else None
    if refused is not None:
        warnings.warn(refused, stacklevel=2)
        estimate = estimate._replace(warnings=(*estimate.warnings, refused))
    elif mesh_error and known:
        finer = None if at_points is None else partial(at_points, found.u)
        estimate = _of_discretisation(problem, (values, finer), (estimate, found, natural_of))
        for sentence in bias_sentences(estimate):
            warnings.warn(sentence, stacklevel=2)
    return estimate._replace(converged=converged, codes=ended, seconds=seconds), found


def _refused(problem: Problem, values: Content) -> str | None:
    """Return a warning if a scene with the fitted parameters `values` is not allowed, otherwise None. The search cannot
    check this, because the values of the parameters are unknown inside jit."""
    try:
        for scene in problem.scenes:
            check_bounds(lj.with_parameters(scene, values))
    except InputError as e:
        return f"the fitted parameters are not possible, so the data or other parameters of the scene are wrong: {e}"
    return None


def _of_discretisation(
    problem: Problem, values: tuple[Content, Finer | None], fitted: tuple[Estimate, Solution, Callable]
) -> Estimate:
    """Return the estimate with the changes of the parameters due to the meshes, and due to the time steps if a scene
    has time steps. `values`: see `discretisation_errors`. `fitted`: estimate, solution, and function from u to the
    reported parameters."""
    estimate, found, natural_of = fitted
    of_mesh, of_steps = discretisation_errors(problem, *values)
    if of_mesh is not None:
        size = float(np.sqrt(np.sum(of_mesh**2) / problem.components))
        estimate = estimate._replace(mesh_bias=mesh_bias(found, natural_of, of_mesh), mesh_over_noise=size)
    if of_steps is not None:
        estimate = estimate._replace(time_step_bias=mesh_bias(found, natural_of, of_steps))
    return estimate


def _of_alike_noise(problem: Problem, natural_of: Callable, found: Solution, estimate: Estimate) -> Estimate:
    """Return the estimate. Its standard errors are larger if the residuals show one of two facts: the noise differs
    between components, or the noise of neighbouring points is correlated. Correlated noise also causes a warning."""
    if not np.all(np.isfinite(estimate.standard_errors)):
        return estimate
    r, J = np.asarray(found.residuals), np.asarray(found.jacobian)
    seen = np.concatenate([np.isfinite(d.sd).ravel() for d in problem.data])
    slope = np.asarray(jax.jacfwd(natural_of)(jnp.asarray(found.u)))
    # The noise of some components may be larger than stated, for example in the depth direction or where the motion is
    # large.
    uneven = np.linalg.norm(uneven_root(J[seen], r[seen], slope), axis=1)
    if _many(J, seen):
        larger = np.maximum(uneven / estimate.standard_errors, 1.0)
        estimate = estimate._replace(
            root=larger[:, None] * estimate.root, standard_errors=larger * estimate.standard_errors
        )
    alike = alike_noise(*_places_and_groups(problem, seen), r[seen], J[seen])
    if alike is None:
        return estimate
    root = slope @ alike.root
    errors, correlation = errors_and_correlation(root)
    most = float(np.max(errors / estimate.standard_errors))
    if most < 1:
        return estimate
    sentence = (
        f"residuals of points within {alike.length:.2g} m are correlated: the measured field was smoothed, or the "
        f"scene is inadequate. The standard errors include this correlation, and are up to {most:.2g} times those "
        "for independent noise"
    )
    warnings.warn(sentence, stacklevel=3)
    larger = np.maximum(estimate.standard_errors / errors, 1.0)
    told, root = (*estimate.warnings, sentence), larger[:, None] * root
    return estimate._replace(root=root, standard_errors=larger * errors, correlation=correlation, warnings=told)


#: The residuals show whether the noise differs between components only if there are at least this many measured
#: components per parameter.
_MANY = 20


def _many(J: np.ndarray, seen: np.ndarray) -> bool:
    """Return whether there are enough residuals (`_MANY`) to test whether the noise differs between components."""
    return bool(np.count_nonzero(seen) >= _MANY * J.shape[1])


def _places_and_groups(problem: Problem, seen: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the positions (n, 3) [m] of the n measured components, and the indices (n,) of their groups. A group
    contains the components of one scene, step and direction."""
    places, groups = [], []
    for k, (scene, data) in enumerate(zip(problem.scenes, problem.data, strict=True)):
        points = np.asarray(scene.mesh.points)[np.asarray(data.nodes)]
        places.append(np.repeat(np.einsum("nk,nkc->nc", np.asarray(data.weights), points), 3, axis=0))
        direction = np.tile(np.arange(3), len(points))
        groups.append(np.stack([np.full(len(direction), k), np.repeat(np.asarray(data.step), 3), direction], axis=1))
    of = np.unique(np.concatenate(groups), axis=0, return_inverse=True)[1]
    return np.concatenate(places)[seen], of.ravel()[seen]


class Discretisation(NamedTuple):
    """Errors of the n residuals due to the meshes and due to the time steps."""

    mesh: np.ndarray | None  # (n,); None: unknown
    time_step: np.ndarray | None  # (n,); None: unknown, or no scene has time steps


def discretisation_errors(problem: Problem, values: Content, finer: Finer | None = None) -> Discretisation:
    """Return the errors of the residuals due to the meshes and the time steps, for scenes with the parameters `values`.
    The function warns if an error is unknown. `finer`: see `mesh_error_of`."""
    both = [
        _errors_in(lj.with_parameters(scene, values), data, finer)
        for scene, data in zip(problem.scenes, problem.data, strict=True)
    ]
    of_mesh, of_steps = (np.concatenate(rows) for rows in zip(*both, strict=True))
    timed = any(scene.solve.dt is not None for scene in problem.scenes)
    if timed and not np.all(np.isfinite(of_steps)):
        warnings.warn(
            "the effect of the time step on the fit is unknown: a run with this step, or with half of it, is not "
            "allowed or did not converge",
            stacklevel=3,
        )
    known = Discretisation(of_mesh, of_steps if timed else None)
    return Discretisation(*(e if e is not None and np.all(np.isfinite(e)) else None for e in known))


def _errors_in(scene: Scene, data: Displacements, finer: Finer | None) -> tuple[np.ndarray, np.ndarray]:
    """Return the errors of the n residuals of a scene due to the mesh (n,), and due to the time steps (n,). Unknown
    errors are NaN. If the mesh error is unknown, the function warns."""
    readings = partial(_all_differences, data, scene)
    try:
        refuse(scene)  # this check must come before `prepared`, which replaces a loaded mesh
        run = lj.simulate(scene, mesh_error=finer is None)
        error = run.mesh_error
        if error is None:
            error = mesh_error_of(prepared(scene), run.positions, run.reactions, run.pressure, finer)
        exact = replace(run, positions=run.positions + error.positions)
        good = np.all(run.status == status.CONVERGED) and np.all(error.found)
        moved = readings(exact) - readings(run)
        if error.added is not None:
            moved = moved + error_between_nodes(data, scene.mesh, error.added)
        of_mesh = np.where(good, moved, np.nan)
        cause = "a step of the run failed, or the mesh is too coarse for an estimate"
    except InputError as e:
        run, of_mesh, cause = None, np.full(np.size(data.measured), np.nan), str(e)
    if not np.all(np.isfinite(of_mesh)):
        warnings.warn(f"the effect of the mesh error on the fit is unknown: {cause}", stacklevel=4)
    if scene.solve.dt is None:
        return of_mesh, np.zeros_like(of_mesh)
    try:
        return of_mesh, change_with_small_steps(scene, readings, run)
    except InputError:
        return of_mesh, np.full_like(of_mesh, np.nan)


def _all_differences(data: Displacements, scene: Scene, result: lj.Result) -> jax.Array:
    return weighted_differences(data, scene, result.positions)


def with_discretisation_as_noise(problem: Problem) -> tuple[Problem, list[dict[str, float]]]:
    """Add the errors of the meshes and the time steps to the noise of the problem. Also return, for each scene, the
    sizes of these errors, divided by the stated noise [1]. The keys are the fields of `Discretisation`; unknown errors
    are not included.

    A size is a root mean square over the measured components, for the parameters in the scenes. Without the added
    noise, a wrong stiffness in a map would compensate these errors. If an error cannot be estimated, a warning is
    given, and this error is not added.
    """
    errors = {kind: e for kind, e in discretisation_errors(problem, {})._asdict().items() if e is not None}
    data, sizes, begin = [], [], 0
    for one in problem.data:
        own = slice(begin, begin + np.size(one.measured))
        begin = own.stop
        sizes.append({kind: float(np.sqrt(np.sum(e[own] ** 2) / one.components)) for kind, e in errors.items()})
        data.append(one._replace(sd=one.sd * np.sqrt(1.0 + sum(size**2 for size in sizes[-1].values()))))
    return problem._replace(data=tuple(data)), sizes


#: The search begins at a distance of at least this fraction of the upper bound from this bound. At the bound itself,
#: the derivative of the parametrisation is 0.
_FROM_BOUND = 0.02


def _upper_bound(scene: Scene, name: str) -> float:
    """Return the upper bound of the field with a dotted name, or infinity."""
    bound = metadata(scene, name, name).get("upper")
    return float(bound) if isinstance(bound, int | float) else np.inf


def _in_bounds(starts: np.ndarray, upper: np.ndarray) -> Callable[[jax.Array], jax.Array]:
    """Return the function from the unknowns u (n,) to the parameters (n,). For u = 0, the parameters are `starts` (n,),
    but not closer to a bound than `_FROM_BOUND`. Positive parameters stay positive and do not exceed their bounds
    `upper` (n,). A parameter without a bound has the bound infinity."""
    positive, bounded = starts > 0, (starts > 0) & np.isfinite(upper)
    top = np.where(bounded, upper, 1.0)
    begin = np.sqrt(np.maximum(np.log(top / np.where(bounded, starts, 1.0)), _FROM_BOUND))

    def natural_of(u):
        free = jnp.where(positive, starts * jnp.exp(jnp.where(positive & ~bounded, u, 0.0)), starts + u)
        return jnp.where(bounded, top * jnp.exp(-((begin - u) ** 2)), free)

    return natural_of


#: A fitted parameter is at its upper bound if its distance from the bound is at most this fraction of its standard
#: error.
_AT_BOUND = 0.01


def _told_of_bounds(found: Estimate, upper: np.ndarray) -> Estimate:
    """Return the estimate. If a parameter is at its bound in `upper` (n,), warn and add the warning to the estimate."""
    if not np.isfinite(upper).any():
        return found
    errors = np.where(np.isfinite(found.standard_errors), found.standard_errors, 0.0)
    (places,) = np.nonzero(np.isfinite(upper) & (upper - found.values <= _AT_BOUND * errors))
    if not len(places):
        return found
    each = ", ".join(f"{found.names[k]} = {upper[k]:g}" for k in places)
    sentence = (
        f"the fit ended at the upper bound of a parameter ({each}), where the search cannot converge: give this value "
        "in the scene and fit the other parameters, or check the data and the scene"
    )
    warnings.warn(sentence, stacklevel=3)
    return found._replace(warnings=(*found.warnings, sentence))


def fit_numbers(problem: Problem, names: Sequence[str], **options: Any) -> Estimate:
    """Fit the parameters of the scenes with the dotted names `names`, for example law.mu. Positive parameters stay
    positive, and do not exceed the upper bounds of their fields. A warning is given if a parameter is at its upper
    bound, or if the result is not possible, for example because limit_bulk is not above bulk.

    Raises:
        InputError: a scene has no parameter of this name, or the parameter is not a floating-point number.
    """
    starts = [numbers_at(problem.scenes[0], name) for name in names]
    sizes = [np.size(v) for v in starts]
    flat = np.concatenate([np.ravel(v) for v in starts])
    labels = [
        name if np.ndim(v) == 0 else f"{name}.{i}"
        for name, v in zip(names, starts, strict=True)
        for i in range(np.size(v))
    ]
    upper = np.repeat([_upper_bound(problem.scenes[0], name) for name in names], sizes)
    natural_of = _in_bounds(flat, upper)

    def values_of(u):
        p, out, k = natural_of(u), {}, 0
        for name, value, size in zip(names, starts, sizes, strict=True):
            part = p[k : k + size]
            out[name] = tuple(part) if isinstance(value, tuple) else part.reshape(np.shape(value))
            k += size
        return out

    lj.with_parameters(problem.scenes[0], dict(zip(names, starts, strict=True)))
    found = fit(problem, Unknowns(np.zeros(len(flat)), values_of, natural_of, labels), **options)[0]
    return _told_of_bounds(found, upper)
