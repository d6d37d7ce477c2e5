"""Make a reduced model: choose parameter sets, run the full model, and compute modes from the displacements (proper
orthogonal decomposition)."""

import warnings
from collections.abc import Mapping
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from liverjax.core import status
from liverjax.core.errors import InputError
from liverjax.core.struct import replace
from liverjax.mesh.nodal import integrals, nodal_volumes
from liverjax.physics.prescribed import free_degrees
from liverjax.reduced.correction import FEWEST_RUNS, Correction, Learnt, correction_at, learnt_correction
from liverjax.reduced.model import ReducedModel, loads_of_run, other_numbers, refuse_unknown_physics, with_all_points
from liverjax.reduced.run import simulate_reduced
from liverjax.reduced.sampling import Coordinates, sampled
from liverjax.scenes.scene import Scene, with_parameters
from liverjax.simulation.batch import simulate_batch
from liverjax.tensors.principal_fields import principal_fields

#: Displacements below this fraction of the body's size are regarded as 0.
_ROUNDOFF = 1e-13
#: A run is at rest if its largest displacement is at most this fraction of the largest displacement in all runs [1].
#: Smaller displacements are roundoff.
_AT_REST = 1e-9
#: Maximum number of displacement modes, divided by the maximum number of pressure modes.
PRESSURES = 2


class _Runs(NamedTuple):
    """The R full runs that converged."""

    values: dict[str, np.ndarray]  # dotted names -> parameters of these runs (R, ...)
    u: np.ndarray  # displacements (R, T, V, 3) [m]
    P: np.ndarray | None  # pressures at the vertices (R, T, V) [Pa]; None if the scene has no fluid


def reduce_scene(
    scene: Scene,
    rows: Mapping[str, Any],
    tolerance: float = 1e-4,
    most_modes: int = 40,
    point_tolerance: float | None = None,
    runs: int | None = None,
) -> ReducedModel:
    """Make a reduced model of a scene from full runs with different parameters.

    Args:
        scene: `Scene`.
        rows: dotted names of parameters -> one value for each run (see `simulate_batch`). A row is the parameter set of
            one run.
        tolerance: fraction of the displacements of these runs that the modes may neglect [1] (root mean square).
        most_modes: maximum number of modes.
        point_tolerance: the reduced forces are converted to motions; the sampled points may neglect this fraction of
            the motions [1]. Default: `tolerance`.
        runs: number of full runs. Default: all rows. If there are more rows than runs, two thirds of the runs use the
            first rows. A preliminary reduced model is made from these two thirds. The last third uses the remaining
            rows with the largest corrections of the preliminary model, relative to the displacements. If this model has
            no correction, the last third uses the rows with the largest displacements. If none of the last third
            converges, the result is the preliminary model.

    Raises:
        InputError: the scene has entries that reduced models do not support; a tolerance is not between 0 and 1; no run
            converged, or none moves the body; `runs` does not fit the number of rows; `rows` contains solve.dt or a
            number of the mesh.
    """
    refuse_unknown_physics(scene)
    point_tolerance = tolerance if point_tolerance is None else point_tolerance
    for name, value in (("tolerance", tolerance), ("point_tolerance", point_tolerance)):
        if not 0 < value < 1:
            raise InputError(f"{name} = {value} must be between 0 and 1: give e.g. 1e-4")
    values = {name: np.asarray(value, float) for name, value in rows.items()}
    _refuse_other_bodies(values)
    count = len(next(iter(values.values()), ()))
    runs = count if runs is None else runs
    if not FEWEST_RUNS <= runs <= count and runs != count:
        allowed = f"from {FEWEST_RUNS} to {count}" if count > FEWEST_RUNS else f"{count}"
        raise InputError(f"runs = {runs} must be {allowed} (the number of rows)")
    first = count if runs == count else 2 * runs // 3
    own = _full_runs(scene, _some(values, slice(first)))
    if not len(own.u):
        raise InputError(f"none of the {first} runs converged: give smaller loads, or more steps")
    refuse_rest(scene, own.u)
    model = _model_of(scene, own, tolerance, most_modes, point_tolerance)
    if runs == count:
        return model
    others = _some(values, slice(first, None))
    far = np.argsort(_errors_of_rows(model, scene, others))[::-1][: runs - first]
    more = _full_runs(scene, _some(others, far))
    if not len(more.u):
        return model
    values = {name: np.concatenate([own.values[name], more.values[name]]) for name in values}
    P = None if own.P is None or more.P is None else np.concatenate([own.P, more.P])
    both = _Runs(values, np.concatenate([own.u, more.u]), P)
    return _model_of(scene, both, tolerance, most_modes, point_tolerance)


def _refuse_other_bodies(values: Mapping[str, np.ndarray]) -> None:
    """Raise InputError if the values would give the runs different time steps or different meshes."""
    if "solve.dt" in values:
        raise InputError(
            "all runs of a reduced model must have the same time step dt: remove the column solve.dt, and give dt in "
            "[solve]"
        )
    for name in values:
        if name.startswith("mesh."):
            raise InputError(
                f"all runs of a reduced model must have the same mesh: remove the column {name}, and make one model "
                "for each mesh"
            )


def refuse_rest(scene: Scene, u: np.ndarray) -> None:
    """Raise InputError if the displacements u (…, V, 3) [m] of all runs are 0, apart from roundoff."""
    if np.abs(u).max() <= _ROUNDOFF * np.ptp(np.asarray(scene.mesh.points)):
        raise InputError("no training run moves the body: give loads or prescribed motions that are not 0")


def _some(values: Mapping[str, np.ndarray], which: slice | np.ndarray) -> dict[str, np.ndarray]:
    return {name: value[which] for name, value in values.items()}


def _words_of(row: Mapping[str, np.ndarray]) -> str:
    return ", ".join(f"{name} = {np.array2string(value[0], precision=4)}" for name, value in row.items())


def _full_runs(scene: Scene, values: dict[str, np.ndarray]) -> _Runs:
    """Return the runs that converged, and warn of the runs that failed."""
    result = simulate_batch(scene, dict(values)).result
    good = np.all(np.asarray(result.status) == status.CONVERGED, axis=1)
    if not good.all():
        warnings.warn(
            f"{np.sum(~good)} of {len(good)} training runs failed and are left out (the first has "
            f"{_words_of(_some(values, np.flatnonzero(~good)[:1]))}). The model is not trained for such parameters: "
            "give smaller loads, or more steps",
            stacklevel=3,
        )
    mask = free_degrees(scene.mesh, scene.fixed, scene.displaced)
    u = np.asarray(result.positions)[good]
    u -= np.asarray(scene.mesh.points)
    u *= np.asarray(mask)
    P = None if result.pressure is None else np.asarray(result.pressure)[good, :, : scene.mesh.number_of_vertices]
    return _Runs(_some(values, good), u, P)


def _model_of(scene: Scene, runs: _Runs, tolerance: float, most_modes: int, point_tolerance: float) -> ReducedModel:
    u, volumes = runs.u, np.asarray(nodal_volumes(scene.mesh))
    modes = proper_modes(u.reshape(-1, *u.shape[-2:]), volumes, tolerance)[:most_modes]
    fields, p = (None, None) if runs.P is None else _pressure_fields(scene, runs.P, tolerance, most_modes)
    whole = with_all_points(scene, jnp.asarray(modes), fields)
    q = jnp.einsum("rtvc,nvc->rtn", u * volumes[:, None], whole.modes)
    model = sampled(whole, scene, runs.values, Coordinates(q, p), point_tolerance)
    ranges = {name: jnp.asarray(np.stack([v.min(axis=0), v.max(axis=0)])) for name, v in runs.values.items()}
    model = replace(model, ranges=ranges, loads=_loads_of_rows(scene, runs))
    model = replace(model, others=other_numbers(scene, {n: v[0] for n, v in runs.values.items()}))
    return replace(model, correction=_learnt_from(model, scene, runs))


def _loads_of_rows(scene: Scene, runs: _Runs) -> dict[str, jax.Array]:
    """Return the lowest and the highest values (2, …) of each load and prescribed motion in all runs, by name."""
    rows = [{name: value[r] for name, value in runs.values.items()} for r in range(len(runs.u))]
    loads = [loads_of_run(with_parameters(scene, row)) for row in rows]
    low, high = ({name: np.stack([own[name][k] for own in loads]) for name in loads[0]} for k in range(2))
    return {name: jnp.asarray(np.stack([low[name].min(axis=0), high[name].max(axis=0)])) for name in low}


def _pressure_fields(scene: Scene, P: np.ndarray, tolerance: float, most: int) -> tuple[jax.Array, np.ndarray]:
    """Return m modes (m, V) [m^-1.5] of the pressures P (R, T, V) [Pa] in R runs, and the coordinates (R, T, m)
    [Pa m^1.5] of P in these modes. The number m of modes is at most half of `most`."""
    volumes = np.asarray(integrals(scene.mesh, jnp.ones_like(scene.mesh.weights)))
    modes = proper_modes(P.reshape(-1, P.shape[-1], 1), volumes, tolerance)[: max(1, most // PRESSURES), :, 0]
    return jnp.asarray(modes), (P * volumes) @ modes.T


def _learnt_from(model: ReducedModel, scene: Scene, runs: _Runs) -> Correction | None:
    q, failed = _coordinates_of_rows(model, scene, runs.values)
    moved = np.linalg.norm(runs.u, axis=-1).max(axis=(1, 2))
    good = ~failed & (moved > _AT_REST * moved.max(initial=0.0))
    missing = runs.u[good] - np.tensordot(q[good], np.asarray(model.modes), axes=1)
    volumes = np.asarray(nodal_volumes(scene.mesh))
    return learnt_correction(Learnt(q[good], missing, moved[good], volumes, scene.solve.dt))


def _coordinates_of_rows(
    model: ReducedModel, scene: Scene, values: Mapping[str, np.ndarray]
) -> tuple[np.ndarray, np.ndarray]:
    """Run the reduced model once for each of R parameter sets. Return the n reduced coordinates (R, T, n) [m^2.5], and
    for each run whether it failed (R,)."""

    def run(model: ReducedModel, values: dict[str, jax.Array]) -> tuple[jax.Array, jax.Array]:
        found = simulate_reduced(model, with_parameters(scene, values))
        return found.coordinates, found.status

    together = jax.jit(lambda model, values: jax.lax.map(lambda own: run(model, own), values))
    q, code = together(model, {name: jnp.asarray(value) for name, value in values.items()})
    return np.asarray(q), np.any(np.asarray(code) != status.CONVERGED, axis=1)


def _errors_of_rows(model: ReducedModel, scene: Scene, values: Mapping[str, np.ndarray]) -> np.ndarray:
    """Return for each row the largest correction of a node, divided by the largest displacement [1]. If the model has
    no correction, return the largest displacement [m] instead. The value of a run at rest is 0, and the value of a
    failed run is -1."""
    q, failed = _coordinates_of_rows(model, scene, values)
    found, moved = np.zeros(len(q)), np.zeros(len(q))
    for k, own in enumerate(q):
        u = moved[k] = np.linalg.norm(np.tensordot(own, np.asarray(model.modes), axes=1), axis=-1).max()
        if model.correction is None:
            found[k] = u
            continue
        off = np.linalg.norm(np.asarray(correction_at(model.correction, jnp.asarray(own), scene.solve.dt)), axis=-1)
        found[k] = off.max() / max(u, 1e-300)
    found[moved <= _AT_REST * moved[~failed].max(initial=0.0)] = 0.0
    # Parameter sets whose reduced run failed are chosen last, because the full run would probably fail too.
    return np.where(failed, -1.0, found)


def proper_modes(u: np.ndarray, volumes: np.ndarray, tolerance: float) -> np.ndarray:
    """Return n modes (n, V, c). Linear combinations of these modes approximate the N fields u (N, V, c) with c
    components. The relative error is at most `tolerance`. The error is a root mean square, weighted by the nodal
    volumes `volumes` (V,).
    """
    modes = principal_fields((u * np.sqrt(volumes)[:, None]).reshape(len(u), -1), tolerance)
    return modes.reshape(-1, *u.shape[1:]) / np.sqrt(volumes)[:, None]
