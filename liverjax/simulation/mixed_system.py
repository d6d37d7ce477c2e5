"""The mixed system of positions and nodal pressures: its assembly, and the elimination of the pressures.

A force term with a stress that depends on the volume ratio of the elements (`liverjax.physics.base.VolumeStress`) has
pressures at the nodes, and a pressure matrix. In a porous body the fluid flows, so this matrix couples the pressures of
neighbouring nodes. If volume changes are averaged at the nodes, the matrix is diagonal. Columns (V,) are the x, y and z
components of a nodal vector in separate arrays.
"""

from collections.abc import Sequence
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp

from liverjax.core.struct import Number
from liverjax.elements.gradients import volume_gradients
from liverjax.mesh.nodal import integrals, interpolated
from liverjax.mesh.tetrahedra import TetMesh
from liverjax.physics import darcy
from liverjax.physics.darcy import Flow
from liverjax.solvers import block_matrix, point_matrix
from liverjax.solvers.krylov import chebyshev
from liverjax.solvers.point_matrix import PointMatrix
from liverjax.tensors.matrices import Matrix, scale

#: Degree of the polynomial that approximates the inverse of the pressure matrix with an error of 1 %.
_DEGREE = 6


def coupled(
    mesh: TetMesh, K: dict, own: Any, F: Matrix, pressures: block_matrix.BlockMatrix, slope: Any = 1.0
) -> block_matrix.BlockMatrix:
    """Assemble the coupled matrix of positions and pressures, with 4 x 4 blocks. It is symmetric and indefinite.

    The matrix is the derivative of the forces, and of the pressure equation with a minus sign, with respect to the
    positions x and the pressures P.

    Args:
        K: stiffness blocks (E,) [N/m] at given pressure, for pairs of nodes.
        own: 3 x 3 blocks of entries (V,) that force terms at nodes add to the diagonal, or None. Entries that are 0 may
            be None.
        F: deformation gradient at the end of the step.
        pressures: matrix of the pressure equation.
        slope: derivative (E,) of the volumetric strain with respect to the volume ratio J. The energy contains the
            product of pressure and volumetric strain.
    """
    q = [scale(slope * mesh.volumes / 4, g) for g in volume_gradients(mesh, F)]
    bordered = {}
    for (a, b), block in K.items():
        forces = [(*block[r], -q[a][r]) for r in range(3)]
        bordered[a, b] = (*forces, (*(-x for x in q[b]), None))
    rows: block_matrix.Block = block_matrix.off_diagonal(mesh, bordered)
    rows = (*rows[:3], (*rows[3][:3], -pressures.rows[0][0]))
    sums = block_matrix.row_sums(rows)
    # A translation causes no force, so in each row the entries that multiply positions add up to 0.
    corner: Any = tuple(tuple(-sums[r][c] for c in range(3)) for r in range(3))
    corner = corner if own is None else block_matrix.added(corner, own)
    border = [-sums[3][c] for c in range(3)]
    diagonal = (*((*corner[r], border[r]) for r in range(3)), (*border, -pressures.diagonal[0][0]))
    return block_matrix.BlockMatrix(rows, diagonal, mesh.pattern.row_nodes)


def balances(
    mesh: TetMesh, A: block_matrix.BlockMatrix | PointMatrix, motion: Sequence[jax.Array]
) -> tuple[tuple[jax.Array, ...], jax.Array]:
    """Return two effects of the displacement `motion` at constant pressures: forces [N], as columns (V,), and the
    change (V,) of the volume balance."""
    if isinstance(A, PointMatrix):
        return point_matrix.product(mesh, A, motion), -point_matrix.volume_changes(mesh, A, motion)
    *forces, balance = block_matrix.product(A, motion)
    return tuple(forces), balance


def pressure_change(
    mesh: TetMesh,
    flow: Flow | None,
    A: block_matrix.BlockMatrix | PointMatrix,
    balance: jax.Array,
    exactly: bool = False,
) -> jax.Array:
    """Return the change of the pressures (V,) that reduces the residual `balance` (V,) of the pressure equation to 0.

    Without `flow` the pressure matrix is diagonal. With `flow` the pressure equation is solved approximately, or to the
    tolerance of `flow` if `exactly` is true.
    """
    if flow is None:
        if isinstance(A, PointMatrix):
            assert A.pressures is not None
            return balance / A.pressures.diagonal[0][0]
        return balance / -A.diagonal[3][3]
    if exactly:
        return flow.mask * darcy.solved(mesh, flow, flow.mask * balance)
    return darcy.nearly_solved(mesh, flow, balance)


def with_pressures(
    mesh: TetMesh, volume: Any, A: PointMatrix | block_matrix.BlockMatrix, both: Any
) -> tuple[tuple[jax.Array, ...], jax.Array]:
    """Return the changes of the forces, as columns (V,), and of the residual of the pressure equation (V,).

    `both` contains the changes of the unknowns: positions as columns (V,), and pressures (V,) divided by `volume.unit`.
    The residual of the pressure equation is multiplied by `volume.unit`.
    """
    motion, dp = both
    if isinstance(A, block_matrix.BlockMatrix):
        # In the coupled matrix positive pressures push inwards, and the volume balance has a minus sign.
        every = block_matrix.product(A, (*motion, -volume.unit * dp))
        return every[:3], -volume.unit * every[3]
    forces, outwards = point_matrix.product(mesh, A, motion), pulled(mesh, A, volume.unit * dp)
    balance = point_matrix.volume_changes(mesh, A, motion) - volume.compliance(mesh, volume.unit * dp)
    return tuple(f + p for f, p in zip(forces, outwards, strict=True)), volume.unit * balance


def without_pressures(mesh: TetMesh, volume: Any, A: PointMatrix, motion: Sequence[jax.Array]) -> tuple[jax.Array, ...]:
    """Return the forces, as columns (V,), due to a displacement and the pressures that it causes (quadratic elements).

    A polynomial approximates the inverse of the pressure matrix, so that this product stays symmetric. In tetrahedra
    the pressure matrix divided by its diagonal has eigenvalues between 1/2 and 5/2 (Wathen 1987).
    """
    changes = point_matrix.volume_changes(mesh, A, motion)
    own, bounds = volume.diagonal(mesh), (0.5, 2.5)
    p = chebyshev(partial(volume.compliance, mesh), changes, own, bounds, _DEGREE)
    return block_matrix.sums(point_matrix.product(mesh, A, motion), point_matrix.pull(mesh, A, p))


def pulled(mesh: TetMesh, A: PointMatrix | block_matrix.BlockMatrix, pressures: jax.Array) -> tuple[jax.Array, ...]:
    """Return the forces, as columns (V,), of vertex pressures (V,) [Pa]. Positive pressures push outwards."""
    if isinstance(A, block_matrix.BlockMatrix):
        rows, diagonal = (tuple(row[3:] for row in blocks[:3]) for blocks in (A.rows, A.diagonal))
        return block_matrix.product(block_matrix.BlockMatrix(rows, diagonal, A.nodes), (-pressures,))
    return point_matrix.pull(mesh, A, pressures)


def undrained_bulk(mesh: TetMesh, C: block_matrix.BlockMatrix, mask: Number) -> jax.Array:
    """Return the stiffness [Pa/m^3] of each integration point against a volume change, if no fluid leaves an element.

    C is the pressure matrix. `mask` (V,) is 0 where the pressure is given, else 1. The diagonal of C is divided among
    the elements in proportion to their volumes. With this division, the assembled matrix is at least as stiff as the
    true matrix.
    """
    share = integrals(mesh, jnp.ones_like(mesh.volumes)) * mask / C.diagonal[0][0]
    return interpolated(mesh, share) / mesh.weights


def undrained_diagonal(A: block_matrix.BlockMatrix, mask: Number) -> block_matrix.Block:
    """Return the diagonal blocks of K + G^T D^-1 G, with the diagonal D of the pressure matrix.

    K is the stiffness at given pressures, and G couples pressures and positions. `mask` (V,) is 0 where the pressure is
    given, else 1. If nothing flows, these are exactly the diagonal blocks after the elimination of the pressures.
    """
    soft = -mask / A.diagonal[3][3]
    near = soft[A.nodes]

    def entry(r, c):
        pull = jnp.sum(A.rows[r][3] * near * A.rows[c][3], axis=0)
        return A.diagonal[r][c] + pull + A.diagonal[r][3] * soft * A.diagonal[c][3]

    return tuple(tuple(entry(r, c) for c in range(3)) for r in range(3))
