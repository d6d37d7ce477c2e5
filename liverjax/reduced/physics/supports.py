"""Supports in reduced models: springs between the body and a wall, and nodes that slide in a plane normal to x, y or z.

The forces of the springs are linear in the displacements. So the reduced forces of the springs are exactly a stiffness
matrix (n, n) times the n reduced coordinates. In all training runs the sliding nodes stay in their planes, so they also
stay there in all modes.
"""

from typing import TYPE_CHECKING

import jax
import jax.numpy as jnp
import numpy as np

from liverjax.core.errors import InputError
from liverjax.physics.base import Free, NodalForce, Step
from liverjax.physics.elastic_support import ElasticSupport, Foundation, Springs
from liverjax.physics.sliding_support import SlidingSupport
from liverjax.scenes.scene import Scene

if TYPE_CHECKING:
    import scipy.sparse


def refuse_other_physics(scene: Scene) -> None:
    """Raise InputError if `scene.physics` contains objects other than the supports that the module docstring names.

    Raises:
        InputError: the scene has membranes, ligaments, vessels, obstacles, springs with a history, or sliding nodes in
            oblique planes.
    """
    for own in scene.physics:
        if isinstance(own, SlidingSupport):
            if not own.axis:
                raise InputError(
                    "a reduced model supports sliding only in planes normal to x, y or z: rotate the mesh so that the "
                    "plane of [[support]] is normal to an axis, or run the full model"
                )
        elif not isinstance(own, ElasticSupport):
            raise InputError(f"a reduced model cannot have [[{own.section}]]: remove this entry, or run the full model")
        elif own.history is not None:
            raise InputError(
                "a reduced model cannot have a history of [[support]]: remove history, or run the full model"
            )


def identity_of_supports(scene: Scene) -> list[object]:
    """Return the kind and the nodes of each support, without the parameters of the supports."""
    found: list[object] = []
    for own in scene.physics:
        if isinstance(own, SlidingSupport):
            found.append(("slide", np.asarray(own.nodes).tolist(), own.axis))
        elif isinstance(own, ElasticSupport):
            places = (own.nodes, own.triangles)
            found.append(("springs", *(None if place is None else np.asarray(place).tolist() for place in places)))
    return found


def _springs(scene: Scene) -> list[NodalForce]:
    """Return one `NodalForce` for each elastic support."""
    points = scene.mesh.points
    step = Step(scene.mesh, points, 1, 1, None, False, None, Free(jnp.ones_like(points)))
    return [own.freeze(None, step) for own in scene.physics if isinstance(own, ElasticSupport)]


def has_springs(scene: Scene) -> bool:
    """Return whether the scene has an elastic support."""
    return any(isinstance(own, ElasticSupport) for own in scene.physics)


def forces_of_springs(scene: Scene, u: jax.Array) -> jax.Array:
    """Return the forces (V, 3) [N] of all springs for displacements u (V, 3) [m]."""
    mesh = scene.mesh
    return sum((own.force(mesh, mesh.points + u, 1.0) for own in _springs(scene)), jnp.zeros_like(u))


def reduced_springs(modes: jax.Array, scene: Scene) -> jax.Array | None:
    """Return the reduced stiffness (n, n) [N m^-4] of all springs for n modes (n, V, 3).

    Return None if the scene has no springs.
    """
    if not has_springs(scene):
        return None
    return jnp.tensordot(jax.lax.map(lambda mode: forces_of_springs(scene, mode), modes), modes, axes=((1, 2), (1, 2)))


def spring_matrix(scene: Scene) -> "scipy.sparse.csr_array":
    """Return the stiffness (3 V, 3 V) [N/m] of all springs as a sparse matrix. The scene must have known numbers (not
    inside jit, grad or vmap)."""
    import scipy.sparse

    V = scene.mesh.number_of_nodes
    K = scipy.sparse.csr_array((3 * V, 3 * V))
    for own in _springs(scene):
        if isinstance(own, Foundation):
            attached = own.attached(scene.mesh, scene.mesh.points, 1.0)
            nodes, blocks = np.asarray(attached.nodes), np.asarray(attached.blocks)
        else:
            assert isinstance(own, Springs)
            nodes = np.arange(V)[None]
            blocks = np.stack([np.stack([np.asarray(entry) for entry in row]) for row in own.blocks])[None, :, None]
        places = 3 * nodes[:, None] + np.arange(3)[None, :, None]
        rows, columns = np.broadcast_arrays(places[:, :, None, None], places[None, None])
        K = K + scipy.sparse.coo_array((blocks.ravel(), (rows.ravel(), columns.ravel())), shape=K.shape).tocsr()
    return K
