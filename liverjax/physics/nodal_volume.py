"""Volume changes averaged at the nodes, against the volumetric locking of linear tetrahedra (Bonet and Burton 1998).

The volumetric energy is sum_a V_a U(J_a) over nodes, J_a the mean J of the elements around node a weighted by their
volumes, V_a a quarter of these. There are about five times fewer nodes than elements, so five times fewer constraints
where the bulk modulus is large. Pressure is p_a = U'(J_a), an element's the mean over its nodes; the stiffness is that
at given pressures and G^T D^-1 G with D = V_a/U'': the system of a porous step in which nothing flows.
"""

from typing import Any

import jax
import jax.numpy as jnp

from liverjax.laws.base import Law, volumetric_part
from liverjax.mesh.tetrahedra import TetMesh
from liverjax.physics import boundary
from liverjax.solvers import block_matrix
from liverjax.tensors.matrices import Invariants


def _mean(mesh: TetMesh, J: jax.Array) -> tuple[jax.Array, jax.Array]:
    volumes = boundary.nodal_volumes(mesh)
    total = jnp.zeros_like(volumes)
    for a in range(4):
        total = total.at[mesh.tetrahedra[:, a]].add(mesh.volumes * J / 4)
    return total / volumes, volumes


def _invariants(law: Law, J: jax.Array) -> Any:
    return tuple(Invariants(J=J) for _ in law.laws) if hasattr(law, "laws") else Invariants(J=J)


def energy(mesh: TetMesh, law: Law, J: jax.Array) -> jax.Array:
    """Volumetric energy [J] of elements with volume ratios J (E,)."""
    mean, volumes = _mean(mesh, J)
    U = volumetric_part(law)
    return jnp.sum(volumes * U.strain_energy(_invariants(U, mean)))


def pressure(mesh: TetMesh, law: Law, J: jax.Array) -> jax.Array:
    """U' (V,) [Pa] of the nodes, positive in tension."""
    U = volumetric_part(law)
    return U.energy_derivatives(_invariants(U, _mean(mesh, J)[0]))[0]["J"]


def compliance(mesh: TetMesh, law: Law, J: jax.Array, positive: bool) -> block_matrix.BlockMatrix:
    """D = V_a/U'' [m^3/Pa] as the matrix of the pressures; `positive`: its absolute value."""
    U = volumetric_part(law)
    mean, volumes = _mean(mesh, J)
    slope = U.energy_derivatives(_invariants(U, mean))[1]["J", "J"]
    slope = abs(slope) if positive else slope
    rows = jnp.zeros(mesh.pattern.row_nodes.shape, J.dtype)
    return block_matrix.BlockMatrix(((rows,),), ((volumes / slope,),), mesh.pattern.row_nodes)
