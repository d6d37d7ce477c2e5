"""A reduced model: modes of motion, and a weighted selection of integration points at which stresses are evaluated.

The positions of the nodes are x = X + u_D(t) + sum_k q_k phi_k, with the reference positions X, the prescribed
displacement u_D and the reduced coordinates q_k. The modes phi_k are 0 where displacements are fixed or prescribed. The
energy of the reduced model is sum_p w_p W(F_p(q)), with the strain energy function W, the deformation gradients F_p at
the sampled points p, and the weights w_p >= 0. The derivative of this energy with respect to q_k is the reduced force
of mode k, sum_p w_p P(F_p) : grad phi_k, with the first Piola-Kirchhoff stress P. So the reduced forces are
conservative, as in the full model (energy-conserving sampling and weighting: Farhat, Avery, Chapman, Cortial 2014; here
with points instead of elements).
"""

import hashlib
import json
from collections.abc import Mapping
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from liverjax.core.errors import InputError
from liverjax.core.struct import Content, param, replace, static, struct
from liverjax.laws import Law
from liverjax.mesh.nodal import interpolated
from liverjax.mesh.shape_functions import basis
from liverjax.mesh.tetrahedra import TetMesh
from liverjax.physics.base import Physics
from liverjax.physics.elasticity import Elasticity
from liverjax.physics.loads import follows
from liverjax.physics.porosity import law_in_force
from liverjax.physics.viscosity import Viscoelasticity
from liverjax.reduced.correction import Correction
from liverjax.reduced.physics.supports import identity_of_supports, refuse_other_physics
from liverjax.scenes.by_element import law_of_elements
from liverjax.scenes.regions import laws_of
from liverjax.scenes.scene import Scene, numbers_at, with_parameters
from liverjax.simulation import automatic
from liverjax.tensors.matrices import Matrix, deformation_gradient
from liverjax.tensors.places import taken

#: A parameter may be outside of its training range by at most this fraction of the width of the range. In a test with a
#: viscous block, the stated error was half of the true error at this distance outside of the range. At a distance of
#: half of the width, the stated error was a sixth of the true error.
BEYOND = 0.1
#: Entries of a scene that contain numbers on which the motion depends.
_PARTS = ("law", "region", "viscosity", "porosity", "body", "displaced", "traction", "physics")
#: Names of numbers that may differ from the training runs, because a load with another history can lead to the same
#: states. The size of the load is checked by its values during the run (`loads_of_run`).
_FREE = ("times", "history")
#: Entries of a scene that may have a history, and the name of the number that a history multiplies or replaces.
_TIMED = {"body": "gravity", "displaced": "by", "traction": "value"}


@struct
class PressureModes:
    """The m modes of the fluid pressure, with their values at the S points of the reduced model. The modes are 0 where
    the body is drained."""

    modes: jax.Array = param("m^-1.5", "(m, V), orthonormal with the volumes of the vertices as weights")
    values: jax.Array = param("m^-1.5", "values at the points (S, m)")
    parts: jax.Array = param(
        "m^-1.5", "(m, 4, S) vertex values around each point, times square roots of shape functions"
    )
    slopes: jax.Array = param("m^-2.5", "gradients at the points (m, 3, S)")


@struct
class ReducedModel:
    """A reduced model of one scene with n modes and S points. The loads of the scene and the parameters of law,
    viscosity, porosity, supports and body can be changed."""

    modes: jax.Array = param("m^-1.5", "(n, V, 3), orthonormal with the nodal volumes as weights")
    slopes: jax.Array = param("m^-2.5", "gradients of the modes at the points (9, S, n), with 9 entries row by row")
    weights: jax.Array = param("m^3", "reference volume that a point represents (S,), not negative")
    points: jax.Array = param("1", "(S,) numbers q E + e: integration point q of element e, with E elements")
    ranges: dict[str, Any] = param("1", "name of each training parameter -> its lowest and highest value")
    correction: Correction | None = param("1", "correction of the motion (`Correction`), or None", default=None)
    pressures: PressureModes | None = param("1", "pressure modes; None if the scene has no porous body", default=None)
    loads: dict[str, Any] | None = param(
        "1", "lowest and highest values in all training runs (`loads_of_run`); None in older models", default=None
    )
    identity: str = static(default="", about="digest of the scene for which the model is made")
    others: str = static(default="", about="digests of the numbers that are equal in all training runs, as JSON")

    @property
    def number_of_modes(self) -> int:
        """Number n of modes, which is the number of unknowns of a step."""
        return self.modes.shape[0]


def flat_gradient(mesh: TetMesh, x: jax.Array) -> jax.Array:
    """Return the gradient (9, Q E) of a field x (V, 3) at the integration points, Q in each of E elements. The 3 x 3
    gradient is stored row by row."""
    F = deformation_gradient(mesh, x)
    return jnp.stack([entry for row in F for entry in row]).reshape(9, -1)


def as_matrix(flat: jax.Array) -> Matrix:
    """Return 3 x 3 matrices at S points as nested tuples, from their nine entries (9, S)."""
    return tuple(tuple(flat[3 * i + j] for j in range(3)) for i in range(3))


def pressure_modes(mesh: TetMesh, modes: jax.Array) -> PressureModes:
    """Return `PressureModes` at all integration points, from the values `modes` (m, V) of m pressure modes at the
    vertices."""
    L = jnp.full((4, 1), 0.25) if mesh.order == 1 else jnp.asarray(basis(mesh.order).L)

    def at_points(mode: jax.Array) -> tuple[jax.Array, jax.Array, jax.Array]:
        corner = jnp.stack([taken(mode, mesh.tetrahedra[:, a]) for a in range(4)])
        parts = (jnp.sqrt(L)[:, :, None] * corner[:, None]).reshape(4, -1)
        slope = jnp.sum((corner[1:] - corner[:1])[:, None] * mesh.shape_vectors, axis=0)
        slopes = jnp.broadcast_to(slope[:, None], (3, L.shape[1], slope.shape[1]))
        return interpolated(mesh, mode).ravel(), parts, slopes.reshape(3, -1)

    values, parts, slopes = jax.lax.map(at_points, modes)
    return PressureModes(modes=modes, values=values.T, parts=parts, slopes=slopes)


def with_all_points(scene: Scene, modes: jax.Array, pressures: jax.Array | None = None) -> ReducedModel:
    """Return the reduced model with all integration points (Galerkin projection of the full model).

    Args:
        scene: `Scene`.
        modes: the n modes of the motion (n, V, 3).
        pressures: the m modes of the pressure (m, V); None if the scene has no fluid.
    """
    mesh = scene.mesh
    slopes = jnp.moveaxis(jax.lax.map(lambda mode: flat_gradient(mesh, mode), modes), 0, -1)
    w = mesh.weights.ravel()
    return ReducedModel(
        modes=modes,
        slopes=slopes,
        weights=w,
        points=jnp.arange(w.size, dtype=jnp.int32),
        ranges={},
        pressures=None if pressures is None else pressure_modes(mesh, pressures),
        identity=reduced_identity(scene),
    )


def solid_at_points(model: ReducedModel, scene: Scene) -> Physics:
    """Return the physics object for elasticity or viscoelasticity, as in the full model, with the law's parameters at
    the sampled points."""
    E = scene.mesh.number_of_elements
    law = law_in_force(scene.porosity, law_of_elements(scene.law, scene.region, E))
    elements = model.points % E
    law = jax.tree.map(lambda a: jnp.asarray(a)[elements] if jnp.shape(a) in ((E,), (E, 3)) else a, law)
    assert isinstance(law, Law)
    return Elasticity(law=law) if scene.viscosity is None else Viscoelasticity(law=law, prony=scene.viscosity)


def reduced_identity(scene: Scene) -> str:
    """Return a digest of the mesh, of the fixed, displaced and drained nodes, and of the kinds of law, viscosity,
    porosity, supports and solution (static or dynamic).

    The digest does not depend on the values of parameters.
    """
    whole = hashlib.sha256()
    for array in (scene.mesh.points, scene.mesh.tetrahedra):
        whole.update(np.ascontiguousarray(np.asarray(array)).tobytes())
    parts: list[object] = [scene.mesh.order, str(jax.tree.structure(scene.law))]
    prony = scene.viscosity
    parts.append(None if prony is None else (prony.part, prony.scheme, len(jnp.atleast_1d(jnp.asarray(prony.ratios)))))
    parts += [(np.asarray(c.nodes).tolist(), c.axes) for held in (scene.fixed, scene.displaced) for c in held]
    parts += [scene.solve.kind, scene.solve.dt is None, *identity_of_supports(scene)]
    sponge = scene.porosity
    if sponge is not None:
        drained = None if sponge.drained is None else np.asarray(sponge.drained).tolist()
        parts.append((sponge.scheme, sponge.keep_bulk, drained))
    whole.update(repr(parts).encode())
    return whole.hexdigest()[:16]


def refuse_unknown_physics(scene: Scene) -> None:
    """Raise InputError if the scene has entries that reduced models do not support.

    Raises:
        InputError: the scene has a viscosity per element, regions with a separate viscosity or another kind of law,
            inlets of a fluid, physics objects other than supports, a mesh of the loaded body, or pressures that follow
            the surface. Other reasons are averaged or mixed volumes, a consistent mass matrix, viscosity without a time
            step, a precision other than "float64", newton = "one_step", or only one Newton iteration.
    """
    by_element = scene.viscosity is not None and jnp.asarray(scene.viscosity.ratios).ndim == 2
    if by_element or any(region.viscosity for region in scene.region):
        raise InputError(
            "a reduced model can have only one viscosity: remove the viscosity of regions, give one series for the "
            "whole body, or run the full model"
        )
    if len(laws_of(scene.law, scene.region)) > 1:
        raise InputError(
            "a reduced model can have only one kind of law: use the same law in all regions, or run the full model"
        )
    if scene.porosity is not None and scene.porosity.inlet:
        raise InputError("a reduced model cannot have [[porosity.inlet]]: remove the inlet, or run the full model")
    if scene.points_are == "loaded":
        raise InputError('[mesh] is = "loaded" cannot be used with reduced models: use the scene of lj.unloaded(scene)')
    refuse_other_physics(scene)
    if follows(scene.traction):
        raise InputError("a reduced model cannot have a pressure that follows the surface: give traction.value instead")
    if automatic.form_of_volumes(scene) != "element":
        raise InputError(
            f"[solve] volumetric = {scene.solve.volumetric!r} does not work in reduced models: use "
            "volumetric = 'element'"
        )
    if scene.body is not None and scene.body.mass != "lumped":
        raise InputError(f"[body] mass = {scene.body.mass!r} does not work in reduced models: use mass = 'lumped'")
    if automatic.is_one_step(scene.solve):
        raise InputError(
            "[solve] newton = 'one_step' (or newton_iterations = 1) does not work in reduced models: use newton = "
            "'converged' and more iterations"
        )
    if scene.solve.precision != "float64":
        raise InputError(
            f"[solve] precision = {scene.solve.precision!r} does not work in reduced models: use precision = 'float64'"
        )
    if scene.solve.kind == "static" and scene.viscosity is not None and scene.solve.dt is None:
        raise InputError("[viscosity] needs dt in [solve]: give a time step in s")


def refuse_another_scene(model: ReducedModel, scene: Scene) -> None:
    """Raise InputError if the model was not made for this scene.

    Raises:
        InputError: reduced models do not support the scene (`refuse_unknown_physics`), or the mesh, the fixed nodes, or
            the kinds of law, viscosity, supports or solution differ. Inside jit, grad or vmap these data are not
            compared.
    """
    refuse_unknown_physics(scene)
    if isinstance(scene.mesh.points, jax.core.Tracer):
        return
    own = reduced_identity(scene)
    if own != model.identity:
        raise InputError(
            f"the reduced model was made for scene {model.identity}, but this is scene {own} (mesh, fixed nodes, law, "
            "viscosity, supports or kind differ): run python -m liverjax reduce for this scene"
        )


def other_numbers(scene: Scene, varied: Mapping[str, np.ndarray | jax.Array]) -> str:
    """Return a JSON string: names and digests of the numbers of a scene, the time integrator and the duration of the
    run. The numbers in `varied` count as 0, because they differ between the training runs.

    Args:
        scene: `Scene` with known numbers (not inside jit, grad or vmap).
        varied: dotted names -> one value of each number that differs between the training runs.
    """
    scene = with_parameters(scene, {name: np.zeros_like(np.asarray(value, float)) for name, value in varied.items()})
    found = {}
    for part in _PARTS:
        for path, leaf in jax.tree_util.tree_flatten_with_path(getattr(scene, part), is_leaf=_is_sequence)[0]:
            words = [str(getattr(key, "name", getattr(key, "idx", getattr(key, "key", key)))) for key in path]
            if part == "physics":  # names as in a scene file, for example support.0
                part_of = scene.physics[: int(words[0]) + 1]
                section = part_of[-1].section
                words = [str(sum(own.section == section for own in part_of) - 1), *words[1:]]
                name = ".".join([section, *words])
            else:
                name = ".".join([part, *words])
            if name.rsplit(".", 1)[-1] not in _FREE:
                # The numbers are rounded, because equal numbers may differ in their last digits and in the sign of 0.
                rounded = np.asarray(leaf, np.float32) + np.float32(0)
                found[name] = hashlib.sha256(rounded.tobytes()).hexdigest()[:8]
    return json.dumps(found | _course(scene))


def _is_sequence(value: object) -> bool:
    """Return whether a value is a tuple or a list of numbers. Such a value has the same digest as an array of these
    numbers."""
    if not isinstance(value, tuple | list) or not value:
        return False
    numbers = (int, float, np.generic, np.ndarray, jax.Array)
    return all((isinstance(part, numbers) and np.ndim(part) == 0) or _is_sequence(part) for part in value)


def _course(scene: Scene) -> Content:
    """Return {name: value} of the time integrator and of the duration [s] of the run (None without time)."""
    solve = scene.solve
    duration = None if solve.dt is None else float(solve.dt) * solve.steps
    return {"solve.integrator": solve.integrator, "solve.dt x solve.steps": duration}


def loads_of_run(scene: Scene) -> dict[str, np.ndarray]:
    """Return the lowest and the highest values (2, …) of each load and prescribed motion in a run, by name. If a load
    has a history, the values of this history are used. The value 0 is always included, because a run begins at rest.

    The values are those at the beginning and at the ends of the steps. They must be known (not inside jit, grad or
    vmap).
    """
    found = {}
    times = (0.0 if scene.solve.dt is None else float(scene.solve.dt)) * np.arange(scene.solve.steps + 1)
    for section, key in _TIMED.items():
        entries = getattr(scene, section)
        parts = {f"{section}.{k}": part for k, part in enumerate(entries)} if key != "gravity" else {section: entries}
        for name, part in parts.items():
            value, history = getattr(part, key, None), getattr(part, "history", None)
            if history is not None:
                columns = np.asarray(history, float).reshape(len(history), -1).T
                at = np.stack([np.interp(times, np.asarray(part.times), column) for column in columns], axis=-1)
                values = at if value is None or np.ndim(history) == 2 else np.multiply.outer(at[:, 0], value)
            elif value is not None:
                values = np.asarray(value, float)[None]
            else:
                continue
            ends = values.min(axis=0, initial=0.0), values.max(axis=0, initial=0.0)
            found[f"{name}.{key} during the run"] = np.stack(ends) + 0.0  # -0 becomes 0
    return found


def _known_value(scene: Scene, name: str) -> np.ndarray | None:
    """Return the value that a scene has for a dotted name, or None if the scene has no number with this name."""
    try:
        return np.asarray(numbers_at(scene, name), float)
    except (InputError, TypeError):  # TypeError: the entry is None
        return None


def _is_outside(value: np.ndarray, bounds: np.ndarray | jax.Array) -> bool:
    low, high = np.asarray(bounds)
    return not np.all(np.maximum(low - value, value - high) <= BEYOND * (high - low) + 1e-9 * np.abs(high))


def parameters_outside(model: ReducedModel, scene: Scene) -> list[str]:
    """Return the names of parameters, and of loads and motions during the run (`loads_of_run`), if their values are
    outside the training range by more than `BEYOND` times the width of this range. Parameters that the scene does not
    have are also listed. The values must be known (not inside jit, grad or vmap)."""
    found = []
    for name, bounds in model.ranges.items():
        value = _known_value(scene, name)
        if value is None or _is_outside(value, bounds):
            found.append(name)
    if model.loads is None:
        return found
    for name, values in loads_of_run(scene).items():
        told = any(other.startswith(name.split()[0]) for other in found)
        if not told and _is_outside(values, model.loads.get(name, np.zeros(2))):
            found.append(name)
    return found


def _sentence_of(model: ReducedModel, scene: Scene, name: str) -> str:
    """Return an error message for one of the names from `parameters_outside`."""
    if name in model.ranges:
        given, bounds = _known_value(scene, name), model.ranges[name]
        if given is None:
            return (
                f"the scene has no {name}, which differs between the training runs of the reduced model: add it to the "
                "scene, or use lj.reduced_error"
            )
        value = np.array2string(given, precision=4)
    else:
        bounds = (model.loads or {}).get(name, np.zeros(2))
        value = " to ".join(np.array2string(end, precision=4) for end in loads_of_run(scene)[name])
    low, high = np.asarray(bounds)
    return (
        f"{name} = {value} is outside the training range of the reduced model ({np.array2string(low, precision=4)} to "
        f"{np.array2string(high, precision=4)}) by more than {BEYOND:.0%} of its width. The stated error is not valid "
        "there: use lj.reduced_error, or train the model with a wider range"
    )


def refuse_unseen_numbers(model: ReducedModel, scene: Scene) -> None:
    """Raise InputError if the scene has numbers that do not occur in the training runs. A scene inside jit, grad or
    vmap is not checked.

    Raises:
        InputError: a number that was varied in the training is missing, or it is outside its training range by more
            than `BEYOND`; the values of a load or of a prescribed motion during the run are outside their training
            range; a number that was not varied, or the time integrator, differs from the training runs; or the run is
            longer than the training runs.
    """
    parts = [*(getattr(scene, part) for part in _PARTS), scene.solve.dt]
    if any(isinstance(leaf, jax.core.Tracer) for leaf in jax.tree.leaves((parts, model.ranges, model.loads))):
        return
    for name in parameters_outside(model, scene):
        raise InputError(_sentence_of(model, scene, name))
    if not model.others:
        return  # models of an earlier version of the program do not contain these digests
    made, own = json.loads(model.others), json.loads(other_numbers(scene, {n: b[0] for n, b in model.ranges.items()}))
    for name in _course(scene):
        before, after = made.pop(name, None), own.pop(name)
        if before is not None and (after > before * (1 + 1e-6) if isinstance(after, float) else after != before):
            raise InputError(
                f"{name} = {after}, but the reduced model was trained with {before}, so the error of the model is "
                "unknown: use lj.reduced_error, or train a model for this value"
            )
    changed = sorted(name for name in made.keys() | own.keys() if made.get(name) != own.get(name))
    if changed:
        raise InputError(
            f"{changed[0]} differs from the training runs of the reduced model, so the error of the model is unknown: "
            "use lj.reduced_error, or train a model with this number among its parameters"
        )


def without_rows(model: ReducedModel) -> ReducedModel:
    """Return the model without the data that are needed only for the correction and the stated error. Models that
    differ only in these data use the same compiled program."""
    return replace(model, correction=None, ranges={}, loads=None, others="")
