"""Modes of the fluid's pressure at the points of a reduced model."""

import jax
import jax.numpy as jnp

from liverjax.core.struct import param, struct
from liverjax.mesh.basis import basis
from liverjax.mesh.nodal import interpolated
from liverjax.mesh.tetrahedra import TetMesh
from liverjax.tensors.places import taken


@struct
class PressureModes:
    """m modes of the fluid's pressure, which vanish where it is drained, and their values at the points."""

    modes: jax.Array = param("1", "(m, V), orthonormal with the lumped volumes of the vertices")
    values: jax.Array = param("1", "at the points (S, m)")
    parts: jax.Array = param("1", "at the vertices of each point's element, times the root of their part (m, 4, S)")
    slopes: jax.Array = param("1/m", "gradients at the points (m, 3, S)")


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
