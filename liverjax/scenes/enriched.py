"""Convert a scene to shape functions of the next order: linear to quadratic elements, quadratic to cubic elements.

Supports, motions and loads do not change. The position and the values of a new node follow from the nodes around it.
"""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np

from liverjax.core.struct import Indices, replace
from liverjax.mesh import promotion
from liverjax.mesh.adjacency import node_numbers
from liverjax.mesh.nodal import element_density
from liverjax.mesh.tetrahedra import TetMesh
from liverjax.physics.loads import Traction
from liverjax.physics.prescribed import Displaced, Fixed
from liverjax.scenes.between_entries import joined_entries
from liverjax.scenes.scene import Scene


def enriched(scene: Scene) -> Scene:
    """Return the scene with quadratic or cubic elements (`liverjax.mesh.promotion`). Its numbers may be JAX tracers."""
    return _quadratic_mesh(scene) if scene.mesh.order == 1 else _cubic(scene)


def _quadratic_mesh(scene: Scene) -> Scene:
    mesh = promotion.quadratic(scene.mesh)

    def more(nodes: Indices) -> jax.Array:
        return node_numbers(promotion.of_faces(scene.mesh, np.asarray(nodes)))

    body = scene.body
    if body is not None and jnp.ndim(body.density):
        body = replace(body, density=promotion.on_middles(mesh, jnp.asarray(body.density)))
    made = replace(
        scene,
        mesh=mesh,
        body=body,
        fixed=tuple(replace(f, nodes=more(f.nodes)) for f in scene.fixed),
        displaced=tuple(_between(mesh, d, more(d.nodes)) for d in scene.displaced),
        physics=tuple(p.enriched(mesh, more) for p in scene.physics),
    )
    return joined_entries(
        scene, made, partial(promotion.middles_between, scene.mesh), partial(promotion.on_middles, mesh)
    )


def _between(mesh: TetMesh, moved: Displaced, nodes: Indices) -> Displaced:
    """Extend a motion to the new nodes. A midside node has the mean displacement of the two ends of its edge."""
    if moved.by is None or np.ndim(moved.by) == 1:
        return replace(moved, nodes=nodes)
    by = jnp.zeros((mesh.number_of_vertices, 3), mesh.points.dtype).at[moved.nodes].set(moved.by)
    return replace(moved, nodes=nodes, by=promotion.on_middles(mesh, by.T).T[nodes])


def _cubic(scene: Scene) -> Scene:
    mesh = promotion.cubic(scene.mesh)

    def more(nodes: Indices) -> jax.Array:
        return node_numbers(promotion.with_functions(mesh, np.asarray(nodes)))

    # The unknowns of the new shape functions are not positions. Where a motion is prescribed, these unknowns are fixed
    # at 0.
    added = [(promotion.with_functions(mesh, np.asarray(d.nodes))[len(d.nodes) :], d.axes) for d in scene.displaced]
    still = tuple(Fixed(nodes=node_numbers(nodes), axes=axes) for nodes, axes in added if len(nodes))
    body = scene.body
    if body is not None and jnp.ndim(body.density):
        body = replace(body, density=_of_new_functions(mesh, jnp.asarray(body.density)))
    made = replace(
        scene,
        mesh=mesh,
        body=body,
        fixed=(*(replace(f, nodes=more(f.nodes)) for f in scene.fixed), *still),
        traction=tuple(_with_faces(mesh, load) for load in scene.traction),
        physics=tuple(p.enriched(mesh, more) for p in scene.physics),
    )

    def between(groups: list[np.ndarray]) -> np.ndarray:
        whole = np.unique(np.concatenate(groups))
        return promotion.with_functions(mesh, whole)[len(whole) :]

    def field(values: jax.Array) -> jax.Array:
        return jnp.pad(values, (0, mesh.number_of_nodes - len(values)))

    return joined_entries(scene, made, between, field)


def _of_new_functions(mesh: TetMesh, density: jax.Array) -> jax.Array:
    """Return the density for all shape functions. A new function gets the mean density of its elements."""
    nodes = jnp.stack(mesh.element_nodes)
    own = jnp.broadcast_to(element_density(mesh, density), nodes.shape)
    total, count = (jnp.zeros(mesh.number_of_nodes, own.dtype).at[nodes].add(each) for each in (own, 1.0))
    return jnp.concatenate([density, (total / count)[len(density) :]])


def _with_faces(mesh: TetMesh, load: Traction) -> Traction:
    """Add the face number to each triangle of a load. A part of the load acts on the shape function of the face."""
    triangles = np.asarray(load.triangles)
    faces = promotion.face_numbers(mesh, triangles)
    return replace(load, triangles=node_numbers(np.column_stack([triangles, faces])))
