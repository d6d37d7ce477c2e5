"""Volume changes averaged at the nodes, against the volumetric locking of linear tetrahedra (Bonet and Burton 1998).

The volumetric energy is the sum of V_a U(J_a) over the nodes, with the volumetric energy density U of the law. J_a is
the mean volume ratio J of the elements around node a, weighted by their volumes. V_a is a quarter of the sum of these
volumes. A mesh has about five times fewer nodes than elements. So there are about five times fewer volume constraints,
which prevents locking if the bulk modulus is large. The pressure at a node is p_a = U'(J_a), and the pressure in an
element is the mean over its nodes. The stiffness is the stiffness at constant pressures plus G^T D^-1 G. G is the
derivative of the nodal volumes with respect to the positions, and D is diagonal with the entries V_a/U''. A step of a
porous body without flow leads to the same system of equations.

If the elements around a node have different volumetric energies, the mean of these energies is used, weighted by
volume.
"""

from typing import Any

import jax
import jax.numpy as jnp

from liverjax.core.struct import param, struct
from liverjax.laws.base import Law, Sum, Volumetric, volumetric_part
from liverjax.laws.by_region import ByRegion
from liverjax.laws.terms.invariant_terms import Scalars
from liverjax.mesh.nodal import integrals, interpolated
from liverjax.mesh.tetrahedra import TetMesh
from liverjax.physics.base import Physics, Step, VolumeStress
from liverjax.physics.darcy import Guess
from liverjax.solvers.block_matrix import BlockMatrix
from liverjax.tensors.matrices import Invariants, Matrix, cofactor, scale_matrix


def _mean(mesh: TetMesh, J: jax.Array) -> tuple[jax.Array, jax.Array]:
    volumes = integrals(mesh, jnp.ones_like(mesh.volumes))
    return integrals(mesh, J) / volumes, volumes


def _invariants(law: Law, J: jax.Array) -> Any:
    return tuple(Invariants(J=J) for _ in law.laws) if isinstance(law, Sum) else Invariants(J=J)


def nodal_energy(mesh: TetMesh, law: Law) -> Law:
    """Return the volumetric energy of the nodes, with one bulk modulus per node (V,) if the moduli of elements vary."""
    U = volumetric_part(law)
    if len(U.pieces()) == 1 and all(jnp.ndim(leaf) == 0 for leaf in jax.tree.leaves(U)):
        return U
    E = mesh.number_of_elements
    found: dict[tuple, jax.Array] = {}
    for k, own in enumerate(U.pieces()):
        for part in own.summands():
            bulk = jnp.broadcast_to(jnp.reshape(part.bulk, -1), (E,))
            if isinstance(U, ByRegion):
                bulk = jnp.zeros_like(bulk).at[U.subsets.elements[k][0]].set(bulk[U.subsets.elements[k][0]])
            kind = (part.volumetric, part.below)
            found[kind] = found.get(kind, 0.0) + _mean(mesh, bulk)[0]
    parts = [Volumetric(bulk=bulk, volumetric=kind, below=below) for (kind, below), bulk in found.items()]
    return parts[0] if len(parts) == 1 else Sum(laws=tuple(parts))


def energy(mesh: TetMesh, law: Law, J: jax.Array) -> jax.Array:
    """Return the volumetric energy [J] of a body with volume ratios J (E,) of its elements."""
    mean, volumes = _mean(mesh, J)
    U = volumetric_part(law)
    return jnp.sum(volumes * U.strain_energy(_invariants(U, mean)))


def averaged_pressure(mesh: TetMesh, law: Law, J: jax.Array) -> jax.Array:
    """Return the pressures dU/dJ (V,) [Pa] at the nodes. They are positive in tension."""
    U = volumetric_part(law)
    return U.energy_derivatives(_invariants(U, _mean(mesh, J)[0]))[0]["J"]


def compliance(mesh: TetMesh, law: Law, J: jax.Array, positive: bool) -> BlockMatrix:
    """Return the diagonal matrix D with entries V_a/U'' [m^3/Pa], or their absolute values if `positive` is true."""
    U = volumetric_part(law)
    mean, volumes = _mean(mesh, J)
    slope = U.energy_derivatives(_invariants(U, mean))[1]["J", "J"]
    slope = abs(slope) if positive else slope
    rows = jnp.zeros(mesh.pattern.row_nodes.shape, J.dtype)
    return BlockMatrix(((rows,),), ((volumes / slope,),), mesh.pattern.row_nodes)


@struct
class AveragedVolume(Physics):
    """The volumetric energy of a law, averaged at the nodes."""

    law: Law = param("1", "law whose volumetric part is used")

    def freeze(self, memory: None, step: Step) -> "Averaged":
        """Return the force term with the volumetric energy of the nodes, for one step."""
        return Averaged(law=nodal_energy(step.mesh, self.law))


@struct
class Averaged(VolumeStress):
    """Force term of volume changes averaged at the nodes, for one step."""

    law: Law = param("1", "volumetric energy of the nodes")

    def pressure(self, mesh: TetMesh, J: jax.Array, guess: Guess | None = None) -> jax.Array:
        """Return the pressures (V,) [Pa] at the nodes from the function `averaged_pressure`."""
        return averaged_pressure(mesh, self.law, J)

    def stress(self, mesh: TetMesh, pressure: jax.Array, F: Matrix) -> Matrix:
        """Return the first Piola-Kirchhoff stress p cof F [Pa]. The pressure p is linear in every element."""
        return scale_matrix(interpolated(mesh, pressure), cofactor(F))

    def scalars(self, mesh: TetMesh, pressure: jax.Array, F: Matrix) -> Scalars:
        """Return the pressure [Pa] in the elements, and its derivative with respect to J, which is 0.

        This derivative is taken at constant nodal pressures.
        """
        p = interpolated(mesh, pressure)
        return Scalars({"J": p}, {("J", "J"): jnp.zeros_like(p)})

    def energy(self, mesh: TetMesh, J: jax.Array) -> jax.Array:
        """Return the volumetric energy [J] from the function `energy` of this module."""
        return energy(mesh, self.law, J)

    def density(self, mesh: TetMesh, pressure: jax.Array, J: jax.Array) -> jax.Array:
        """Return the volumetric energy density (E,) [J/m^3]: the mean of the densities at the corners."""
        U = volumetric_part(self.law)
        return interpolated(mesh, U.strain_energy(_invariants(U, _mean(mesh, J)[0])))

    def matrix(self, mesh: TetMesh, J: jax.Array, positive: bool) -> BlockMatrix:
        """Return the pressure matrix [m^3/Pa] from the function `compliance`."""
        return compliance(mesh, self.law, J, positive)
