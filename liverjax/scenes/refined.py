"""Convert a scene to a finer mesh, to estimate the mesh error of a run with a fluid. Every element is cut into eight.

The pressures of a fluid are linear in linear and in quadratic elements. So only a finer mesh represents the pressures
better.
"""

from collections.abc import Callable
from contextlib import nullcontext
from functools import partial
from typing import TypeVar

import jax
import jax.numpy as jnp
import numpy as np

from liverjax.core.errors import InputError
from liverjax.core.struct import Content, Indices, Number, param, replace, struct
from liverjax.laws import Law
from liverjax.laws.by_region import ByRegion
from liverjax.mesh.adjacency import node_numbers
from liverjax.mesh.locate import weights
from liverjax.mesh.nodal import element_density, lumped_sums, nodal_volumes
from liverjax.mesh.promotion import middles_between, middles_of_places, on_middles
from liverjax.mesh.refinement import middles_of_whole_faces, parts_of, places_in, quarters, refined
from liverjax.mesh.tetrahedra import TetMesh
from liverjax.physics.attached.vessel import Vessel
from liverjax.physics.base import Physics
from liverjax.physics.porosity import Porosity
from liverjax.physics.prescribed import Displaced
from liverjax.physics.viscosity import Prony
from liverjax.scenes.between_entries import joined_entries, joined_inlets
from liverjax.scenes.regions import POROUS, VISCOUS
from liverjax.scenes.scene import Scene
from liverjax.tensors.subsets import subsets

T = TypeVar("T")
#: Error of a run, divided by the difference between its result and the result on the refined mesh. For second-order
#: convergence, the error on the refined mesh is 1/4 of the error of the run.
REFINED = 4 / 3
#: Fields of an object in `scene.physics` that are vectors or histories, so they never have one number per triangle.
_NOT_PER_TRIANGLE = ("times", "history", "position", "axis", "by", "force")


@struct
class Within:
    """Positions of the V' nodes of a refined mesh in the elements of the old mesh, which have n nodes each."""

    nodes: jax.Array = param("1", "numbers (n, V') of the old nodes around each new node")
    weights: jax.Array = param("1", "values (n, V') of the shape functions of these old nodes at the new node")

    def field(self, values: jax.Array) -> jax.Array:
        """Return the values (V', …) at the V' new nodes of a field with the values (V, …) at the old nodes."""
        w = self.weights.reshape(*self.weights.shape, *(1,) * (values.ndim - 1))
        return jnp.sum(w * values[self.nodes], axis=0)

    def forces(self, values: jax.Array, number_of_nodes: int) -> jax.Array:
        """Convert forces on V' new nodes (V', …) to forces on the old nodes (V, …) that do the same work."""
        w = self.weights.reshape(*self.weights.shape, *(1,) * (values.ndim - 1))
        return jnp.zeros((number_of_nodes, *values.shape[1:]), values.dtype).at[self.nodes].add(w * values[None])


def can_be_refined(scene: Scene) -> bool:
    """Return whether all entries of the scene can be converted to the refined mesh.

    The following entries cannot be converted: an initial pressure with one number per vertex, an inlet with one
    number per node or triangle, and an object in `scene.physics` with one number per triangle. A vessel can be
    converted only if its position is known (not inside jit).
    """

    def plain(physics: Physics) -> bool:
        triangles = getattr(physics, "triangles", None)
        if triangles is None:
            return not (isinstance(physics, Vessel) and isinstance(physics.enters, jax.core.Tracer))
        left_out: Content = {name: None for name in ("triangles", *_NOT_PER_TRIANGLE) if hasattr(physics, name)}
        others = jax.tree.leaves(replace(physics, **left_out))
        return all(jnp.shape(leaf)[:1] != (len(triangles),) for leaf in others)

    fluid = scene.porosity
    one = [fluid.initial_pressure, *(own for i in fluid.inlet for own in (i.pressure, i.flux))] if fluid else []
    return not any(np.ndim(number) for number in one if number is not None) and all(map(plain, scene.physics))


def on_refined_mesh(scene: Scene) -> tuple[Scene, Within]:
    """Return (scene, within): the scene with every element cut into eight elements of the same order, and the positions
    of the nodes of the refined mesh in the old mesh.

    Numbers of the scene may be unknown (inside jit, grad or vmap), but node numbers must be known.

    Raises:
        InputError: the node numbers of the mesh are unknown inside `jax.jit`.
    """
    old, E = scene.mesh, scene.mesh.number_of_elements
    mesh, within = _mesh_and_within(old)

    def more(nodes: Indices) -> jax.Array:
        return node_numbers(np.concatenate([nodes, _between_nodes(old, mesh, np.asarray(nodes))]))

    def more_pressures(nodes: Indices) -> jax.Array:
        return node_numbers(_with_nodes_between(old, mesh, np.asarray(nodes)))

    def parts(load: T) -> T:
        triangles = getattr(load, "triangles", None)
        return load if triangles is None else replace(load, triangles=quarters(old, triangles))  # type: ignore[type-var]

    def attached(physics: Physics) -> Physics:
        return physics.in_parts(old) if isinstance(physics, Vessel) else parts(physics.enriched(mesh, more))

    body = scene.body
    if body is not None and jnp.ndim(body.density):
        density = jnp.asarray(body.density)
        body = replace(body, density=within.field(density) if old.order == 1 else _density_of_parts(old, mesh, density))
    made = replace(
        scene,
        mesh=mesh,
        law=_law_of_parts(E, scene.law),
        viscosity=_series(scene.viscosity),
        region=tuple(replace(r, elements=node_numbers(parts_of(r.elements))) for r in scene.region),
        porosity=_sponge(scene, more_pressures, parts),
        body=body,
        fixed=tuple(replace(f, nodes=more(f.nodes)) for f in scene.fixed),
        displaced=tuple(_moved_in_between(within, d, more(d.nodes), old.number_of_nodes) for d in scene.displaced),
        traction=tuple(map(parts, scene.traction)),
        physics=tuple(map(attached, scene.physics)),
    )
    return joined_entries(scene, made, partial(_between_groups, old, mesh), within.field), within


def refuse_traced(mesh: TetMesh) -> None:
    """Check that the node numbers of a mesh are known. They are unknown if the mesh is an argument of a compiled
    function. A richer mesh cannot be made there.

    Raises:
        InputError: the node numbers are unknown.
    """
    if isinstance(mesh.tetrahedra, jax.core.Tracer) or isinstance(mesh.pattern.edges, jax.core.Tracer):
        raise InputError(
            "the mesh error cannot be estimated inside jax.jit if the mesh is an argument of the compiled function (or "
            "of jax.vmap): estimate the error outside, or use the mesh as a constant of the function"
        )


def _mesh_and_within(old: TetMesh) -> tuple[TetMesh, Within]:
    """Return the refined mesh, and the positions of its nodes in the old mesh."""
    refuse_traced(old)
    traced = isinstance(old.points, jax.core.Tracer)
    with nullcontext() if traced else jax.ensure_compile_time_eval():  # the node numbers must be known
        mesh = refined(replace(old, triangle_sets=None))
        element, place = places_in(old, mesh)
        nodes, values = weights(old, element, place)
        return mesh, Within(nodes=node_numbers(nodes), weights=jnp.asarray(values))


def _with_nodes_between(old: TetMesh, mesh: TetMesh, nodes: np.ndarray) -> np.ndarray:
    """Return the node numbers `nodes`, and the numbers of the new nodes that lie between them (see
    `middles_of_places`). It is used for pressures: they are linear along the edges of linear and quadratic elements."""
    found = np.concatenate([nodes, np.setdiff1d(middles_of_places(old, nodes), nodes)])
    if mesh.order == 1:
        return found
    return np.concatenate([found, np.setdiff1d(middles_of_places(mesh, found), found)])


def _between_nodes(old: TetMesh, mesh: TetMesh, nodes: np.ndarray) -> np.ndarray:
    """Return the new nodes that an entry with the old nodes `nodes` also constrains.

    With linear elements, see `middles_of_places`. With quadratic elements, see `middles_of_whole_faces`.
    """
    if mesh.order == 1:
        return np.setdiff1d(middles_of_places(old, nodes), nodes)
    return middles_of_whole_faces(old, mesh, nodes)


def _between_groups(old: TetMesh, mesh: TetMesh, groups: list[np.ndarray]) -> np.ndarray:
    """Return the new nodes that several entries with these groups of old nodes constrain together."""
    if mesh.order == 1:
        return middles_between(old, groups)
    return middles_of_whole_faces(old, mesh, np.concatenate(groups))


def _of_parts(E: int, numbers: T) -> T:
    """Repeat the element values (…, E) or (…, E, 3) in a pytree, for the eight parts of each element."""

    def one(a: Number) -> Number:
        shape = jnp.shape(a)
        if shape[-2:] == (E, 3):  # first, because three elements have directions of shape (3, 3)
            return jnp.repeat(jnp.asarray(a), 8, axis=-2)
        return jnp.repeat(jnp.asarray(a), 8, axis=-1) if shape[-1:] == (E,) else a

    return jax.tree.map(one, numbers)


def _density_of_parts(old: TetMesh, mesh: TetMesh, density: jax.Array) -> jax.Array:
    """Return the density (V',) at the new nodes of quadratic elements.

    Quadratic shape functions may be negative. So the density (V,) at the old nodes is interpolated linearly along the
    edges. Each element has a factor that restores its mass, and the density at a node is multiplied by the mean factor
    of its elements. The total mass does not change.
    """
    linear = on_middles(mesh, density)
    parts = (element_density(mesh, linear) * mesh.volumes).reshape(-1, 8)
    factor = element_density(old, density) * old.volumes / jnp.sum(parts, axis=1)
    return linear * lumped_sums(mesh, jnp.repeat(factor, 8) * mesh.volumes) / nodal_volumes(mesh)


def _law_of_parts(E: int, law: Law) -> Law:
    if not isinstance(law, ByRegion):
        return _of_parts(E, law)
    groups = [node_numbers(parts_of(own[0])) for own in law.subsets.elements]
    found = subsets(groups, 8 * E)
    return ByRegion(
        laws=tuple(map(partial(_of_parts, E), law.laws)),
        subsets=found._replace(places=found.places.reshape(*law.subsets.places.shape[:-1], -1)),
    )


def _series(prony: Prony | None) -> Prony | None:
    """Return the Prony series for the refined mesh.

    Values (N, E) of N modes for each element are repeated for the eight parts of the element.
    """
    if prony is None:
        return None
    series = {name: jnp.asarray(getattr(prony, name)) for name in VISCOUS}
    parts: Content = {name: jnp.repeat(own, 8, axis=-1) for name, own in series.items() if own.ndim == 2}
    return replace(prony, **parts)


def _sponge(scene: Scene, more: Callable[[Indices], Indices], parts: Callable) -> Porosity | None:
    """Return the porosity for the refined mesh, with new drained nodes, inlets, and values per element."""
    porosity = scene.porosity
    if porosity is None:
        return None
    inlets = tuple(parts(own if own.nodes is None else replace(own, nodes=more(own.nodes))) for own in porosity.inlet)
    drained = None if porosity.drained is None else more(porosity.drained)
    numbers = _of_parts(scene.mesh.number_of_elements, {name: getattr(porosity, name) for name in POROUS})
    made = replace(porosity, drained=drained, inlet=inlets, **numbers)
    return replace(made, inlet=joined_inlets(scene, made))


def _moved_in_between(within: Within, moved: Displaced, nodes: Indices, number_of_nodes: int) -> Displaced:
    """Extend a motion of the old nodes to the new nodes. The shape functions give the values at the new nodes."""
    if moved.by is None or np.ndim(moved.by) == 1:
        return replace(moved, nodes=nodes)
    by = jnp.zeros((number_of_nodes, 3)).at[moved.nodes].set(moved.by)
    return replace(moved, nodes=nodes, by=within.field(by)[nodes])
