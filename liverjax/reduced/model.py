"""A reduced model: modes of motion, and weighted points of elements at which stresses are evaluated.

Positions are x = X + u_D(t) + sum_k q_k phi_k, with the prescribed motion u_D. The modes phi_k are 0 where the body is
held or moved. The energy is W(q) = sum_p w_p W(F_p(q)) over the sampled points p, with weights w_p >= 0. The gradient
of W, sum_p w_p P(F_p) : grad phi_k, is the reduced force. So the sum over points keeps the structure of the full model
(energy-conserving sampling and weighting: Farhat, Avery, Chapman, Cortial 2014; here with points instead of elements).
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
from liverjax.physics.registry import law_at_rest
from liverjax.physics.viscosity import Viscoelasticity
from liverjax.reduced.correction import Correction
from liverjax.reduced.physics.supports import identity_of_supports, refuse_other_physics
from liverjax.scenes.by_element import law_of_elements
from liverjax.scenes.regions import laws_of
from liverjax.scenes.scene import Scene, numbers_at, with_parameters
from liverjax.tensors.matrices import Matrix, deformation_gradient
from liverjax.tensors.places import taken

#: A parameter may be outside of its range by this fraction of the range's width.
BEYOND = 0.5
#: Parts of a scene with numbers that determine its motion.
_PARTS = ("law", "region", "viscosity", "porosity", "body", "displaced", "traction", "physics")
#: Names of numbers that may differ: they can lead through states that also occur in the rows.
_FREE = ("times", "history")


@struct
class PressureModes:
    """m modes of the fluid's pressure and their values at the points. The modes are 0 where the body is drained."""

    modes: jax.Array = param("1", "(m, V), orthonormal with the lumped volumes of the vertices")
    values: jax.Array = param("1", "values at the points (S, m)")
    parts: jax.Array = param("1", "at the vertices of each point's element, times the root of their part (m, 4, S)")
    slopes: jax.Array = param("1/m", "gradients at the points (m, 3, S)")


@struct
class ReducedModel:
    """n modes and S points of one scene. Parameters of its law and viscosity, and its loads, can be changed."""

    modes: jax.Array = param("1", "(n, V, 3), orthonormal with the lumped volumes of the nodes")
    slopes: jax.Array = param("1/m", "gradients of the modes at the points (9, S, n), row by row")
    weights: jax.Array = param("m^3", "reference volume that a point represents (S,), not negative")
    points: jax.Array = param("1", "number q E + e of point q of element e (S,)")
    ranges: dict[str, Any] = param("1", "parameters of the training: name -> lowest and highest value")
    correction: Correction | None = param("1", "correction of the error of modes and points, or None", default=None)
    pressures: PressureModes | None = param("1", "of a porous scene", default=None)
    identity: str = static(default="", about="digest of the scene for which the model is made")
    others: str = static(default="", about="digests of the numbers that the rows did not vary, as JSON text")

    @property
    def number_of_modes(self) -> int:
        """Number n of modes: the unknowns of a step."""
        return self.modes.shape[0]


def flat_gradient(mesh: TetMesh, x: jax.Array) -> jax.Array:
    """Gradient of a field x (V, 3) at all points of the mesh: (9, Q E), row by row."""
    F = deformation_gradient(mesh, x)
    return jnp.stack([entry for row in F for entry in row]).reshape(9, -1)


def as_matrix(flat: jax.Array) -> Matrix:
    """A tuple matrix from its nine entries (9, S)."""
    return tuple(tuple(flat[3 * i + j] for j in range(3)) for i in range(3))


def pressure_modes(mesh: TetMesh, modes: jax.Array) -> PressureModes:
    """Modes (m, V) of the vertices, with their values at all points."""
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
    """The model with modes (n, V, 3), and modes (m, V) of pressures, and with all points: Galerkin's projection."""
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
    """The physics in the elements of the full model, with the parameters of the law at the sampled points."""
    E = scene.mesh.number_of_elements
    law = law_of_elements(law_at_rest(scene), scene.region, E)
    elements = model.points % E
    law = jax.tree.map(lambda a: jnp.asarray(a)[elements] if jnp.shape(a) in ((E,), (E, 3)) else a, law)
    assert isinstance(law, Law)
    return Elasticity(law=law) if scene.viscosity is None else Viscoelasticity(law=law, prony=scene.viscosity)


def reduced_identity(scene: Scene) -> str:
    """Digest of the mesh, of held, moved and drained nodes, and of the kinds of law, viscosity, porosity and run.

    It does not depend on the parameters.
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
    """Refuse a scene with physics that reduced models do not have.

    Raises:
        InputError: viscosity or laws of regions, inlets of a fluid, physics other than supports, a loaded mesh,
            pressures that follow the surface, averaged or mixed volumes, consistent mass, other precision or Newton.
    """
    if any(region.viscosity for region in scene.region):
        raise InputError("a reduced model has one viscosity: leave the viscosity of regions out, or run the full model")
    if len(laws_of(scene.law, scene.region)) > 1:
        raise InputError(
            "a reduced model has one kind of law: give regions other parameters of it, or run the full model"
        )
    if scene.porosity is not None and scene.porosity.inlet:
        raise InputError("a reduced model has no [[porosity.inlet]]: leave it out, or run the full model")
    if scene.points_are == "loaded":
        raise InputError('[mesh] is = "loaded" is not for reduced models: take the scene of lj.unloaded(scene)')
    refuse_other_physics(scene)
    if follows(scene.traction):
        raise InputError("a reduced model has no pressure that follows the body: give traction.value instead")
    if scene.solve.volumetric != "element":
        raise InputError(f"[solve] volumetric = {scene.solve.volumetric!r} is not for reduced models: use 'element'")
    if scene.body is not None and scene.body.mass != "lumped":
        raise InputError(f"[body] mass = {scene.body.mass!r} is not for reduced models: use 'lumped'")
    if scene.solve.newton != "converged":
        raise InputError(f"[solve] newton = {scene.solve.newton!r} is not for reduced models: use 'converged'")
    if scene.solve.precision != "float64":
        raise InputError(f"[solve] precision = {scene.solve.precision!r} is not for reduced models: use 'float64'")
    if scene.solve.kind == "static" and scene.viscosity is not None and scene.solve.dt is None:
        raise InputError("[viscosity] needs dt in [solve]: give a time step in s")


def refuse_another_scene(model: ReducedModel, scene: Scene) -> None:
    """Refuse a scene for which the model was not made.

    Raises:
        InputError: as `refuse_unknown_physics`, or another mesh, held nodes, law, viscosity, supports or kind of run.
    """
    refuse_unknown_physics(scene)
    if isinstance(scene.mesh.points, jax.core.Tracer):
        return
    own = reduced_identity(scene)
    if own != model.identity:
        raise InputError(
            f"the reduced model was made for scene {model.identity}, and this is {own} (mesh, held nodes, law, "
            "viscosity, supports or kind differ): run python -m liverjax reduce for this scene"
        )


def other_numbers(scene: Scene, varied: Mapping[str, np.ndarray | jax.Array]) -> str:
    """Names and digests of the numbers that the rows do not vary, as JSON text.

    Args:
        scene: `Scene`, not traced.
        varied: dotted names -> one value of each number that the rows vary.
    """
    scene = with_parameters(scene, {name: np.zeros_like(np.asarray(value, float)) for name, value in varied.items()})
    found = {}
    for part in _PARTS:
        for path, leaf in jax.tree_util.tree_flatten_with_path(getattr(scene, part))[0]:
            words = [str(getattr(key, "name", getattr(key, "idx", key))) for key in path]
            if part == "physics":  # with the names of a scene file: support.0
                part_of = scene.physics[: int(words[0]) + 1]
                section = part_of[-1].section
                words = [str(sum(own.section == section for own in part_of) - 1), *words[1:]]
                name = ".".join([section, *words])
            else:
                name = ".".join([part, *words])
            if name.rsplit(".", 1)[-1] not in _FREE:
                # Equal numbers may differ in their last digits, and in the sign of 0.
                rounded = np.asarray(leaf, np.float32) + np.float32(0)
                found[name] = hashlib.sha256(rounded.tobytes()).hexdigest()[:8]
    return json.dumps(found | _course(scene))


def _course(scene: Scene) -> Content:
    """Names and values of the settings for time."""
    solve = scene.solve
    duration = None if solve.dt is None else float(solve.dt) * solve.steps
    return {"solve.integrator": solve.integrator, "solve.dt x solve.steps": duration}


def refuse_unseen_numbers(model: ReducedModel, scene: Scene) -> None:
    """Refuse numbers that do not occur in the rows of the model. A traced scene passes.

    Raises:
        InputError: a varied number far outside of its range in the rows, or another number that differs from the scene
            of the rows.
    """
    parts = [*(getattr(scene, part) for part in _PARTS), scene.solve.dt]
    if any(isinstance(leaf, jax.core.Tracer) for leaf in jax.tree.leaves((parts, model.ranges))):
        return
    for name, bounds in model.ranges.items():
        value, (low, high) = np.asarray(numbers_at(scene, name), float), np.asarray(bounds)
        if np.any(np.maximum(low - value, value - high) > BEYOND * (high - low) + 1e-9 * np.abs(high)):
            raise InputError(
                f"{name} = {np.array2string(value, precision=4)} is far out of its range in the model's rows, "
                f"{np.array2string(low, precision=4)} to {np.array2string(high, precision=4)}, where nothing is known "
                "of the error: take lj.reduced_error, or reduce with wider rows"
            )
    if not model.others:
        return  # made by an earlier version
    made, own = json.loads(model.others), json.loads(other_numbers(scene, {n: b[0] for n, b in model.ranges.items()}))
    for name in _course(scene):
        before, after = made.pop(name, None), own.pop(name)
        if before is not None and (after > before * (1 + 1e-6) if isinstance(after, float) else after != before):
            raise InputError(
                f"{name} = {after} and the model's rows have {before}, so nothing is known of the error: take "
                "lj.reduced_error, or reduce with such rows"
            )
    changed = sorted(name for name in made.keys() | own.keys() if made.get(name) != own.get(name))
    if changed:
        raise InputError(
            f"{changed[0]} is not that of the model's rows, where nothing is known of the error: take "
            "lj.reduced_error, or give it as a column of the rows"
        )


def without_rows(model: ReducedModel) -> ReducedModel:
    """The model without the data that only its error needs. Models that differ only in these data share one program."""
    return replace(model, correction=None, ranges={}, others="")
