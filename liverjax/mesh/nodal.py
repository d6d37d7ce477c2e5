"""Sums at the nodes of what elements share, and means over the nodes of an element."""

from typing import Any

import jax
import jax.numpy as jnp

from liverjax.mesh.tetrahedra import TetMesh


def to_nodes(mesh: TetMesh, share: jax.Array) -> jax.Array:
    """Sum (V,) at every node of what each of its elements gives to each of its nodes, `share` (E,)."""
    total = jnp.zeros(mesh.points.shape[0], share.dtype)
    for a in range(4):
        total = total.at[mesh.tetrahedra[:, a]].add(share)
    return total


def nodal_volumes(mesh: TetMesh) -> jax.Array:
    """A quarter of every element at each of its nodes (V,) [m^3]: lumped mass over density."""
    return to_nodes(mesh, mesh.volumes / 4)


def element_mean(mesh: TetMesh, values: jax.Array) -> jax.Array:
    """Mean (E,) of nodal values (V,) over the nodes of every element."""
    corners: Any = sum(values[mesh.tetrahedra[:, a]] for a in range(4))
    return corners / 4
