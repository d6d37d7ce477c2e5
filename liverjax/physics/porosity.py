"""Porosity in parallel (chapter, section 4.3): Kerdok-Hencky volumetric stress, nodal fluid pressure, Darcy diffusion.

    sigma_p = sigma_Heq(J) - P,   (1/K_lim) dP/dt = kappa lap P - (dJ/dt)/J

sigma_Heq = K0 r_w ln((r_w + J - 1)/r_w), and below J0 = 1 - r_w + r_w K0/K_lim its tangent line of slope K_lim (the
chapter prints J0 without the factor r_w: then the slope would be r_w K_lim). Volumes of the pressure equation are those
at the beginning of a step, so that it is linear in P:

* "implicit": P belongs to the end of the step, with the volume change of the step itself. P is eliminated, P(x), which
  leaves a symmetric problem in x alone: stable at any step. Newton's direction comes from the coupled matrix of (x, P).
* "chapter": P from the volume change of the step before; conditionally stable.
"""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from liverjax.core import bounds
from liverjax.core.errors import InputError
from liverjax.core.struct import param, static, struct
from liverjax.laws.base import Law, isochoric_part
from liverjax.mesh.adjacency import PAIRS
from liverjax.mesh.tetrahedra import TetMesh
from liverjax.solvers import block_matrix, preconditioner
from liverjax.solvers.krylov import chebyshev, differentiable_solve
from liverjax.solvers.preconditioner import Coarse
from liverjax.tensors.matrices import Matrix, Vector, cofactor, determinant, dot, matvec, scale

SCHEMES = ("implicit", "chapter")


@struct
class Porosity:
    """A sponge of bulk modulus K0 filled with a fluid that makes up the part r_w of its volume."""

    bulk: Any = param("Pa", "K0, bulk modulus of the drained sponge at rest", above=0.0)
    limit_bulk: Any = param("Pa", "K_lim, of the compressed sponge and of the pressure", above=0.0)
    fluid_fraction: Any = param("1", "r_w", above=0.0, upper=1.0)
    permeability: Any = param("m^4/(N s)", "kappa", lower=0.0)
    drained: Any = param("1", "nodes where P = 0 (n,); None: sealed", lower=0, default=None)
    scheme: str = static(default="implicit", about="implicit or chapter")
    keep_bulk: bool = static(default=False, about="keep the law's own volumetric energy beside that of the sponge")


class Fluid(NamedTuple):
    """What a step hands to the next."""

    pressure: jax.Array  # P (V,) [Pa]
    J: jax.Array  # (E,)
    J_before: jax.Array | None  # of the step before; the chapter's scheme


def check(porosity: Porosity) -> None:
    """Refuse values that no step can use; host side.

    Raises:
        InputError: unknown scheme, values out of bounds, K_lim not above K0.
    """
    if porosity.scheme not in SCHEMES:
        raise InputError(f"porosity scheme = {porosity.scheme!r} is not known: use {' or '.join(SCHEMES)}")
    bounds.check(porosity, "porosity")
    bulk, limit = float(porosity.bulk), float(porosity.limit_bulk)
    if limit <= bulk:
        raise InputError(f"porosity limit_bulk = {limit:g} must be above bulk = {bulk:g}: a sponge stiffens")


def law_in_force(porosity: Porosity | None, law: Law) -> Law:
    """The law beside the sponge: without its own volumetric energy, lest bulk is counted twice, unless asked for."""
    if porosity is None or porosity.keep_bulk:
        return law
    split = isochoric_part(law)
    return law if split is None else split


def bulk_in_force(porosity: Porosity, law: Law) -> str:
    """One sentence: which bulk modulus acts."""
    sponge = f"bulk modulus in force: the sponge's, {float(porosity.bulk):g} Pa"
    if porosity.keep_bulk:
        return f"{sponge}, and the law's own (keep_bulk)"
    if isochoric_part(law) is None:
        return f"{sponge}, and what {type(law).__name__} has in one with its shear"
    return f"{sponge}; the law's own volumetric energy is off"


def volumetric_stress(porosity: Porosity, J: Any) -> Any:
    """sigma_Heq(J) [Pa]: Hencky's logarithm above J0, its tangent line below; finite for every J."""
    K0, K_lim, r_w = porosity.bulk, porosity.limit_bulk, porosity.fluid_fraction
    J0 = 1 - r_w + r_w * K0 / K_lim
    logarithm = K0 * r_w * jnp.log1p((jnp.maximum(J, J0) - 1) / r_w)
    return logarithm + K_lim * jnp.minimum(J - J0, 0.0)


def volumetric_slope(porosity: Porosity, J: Any) -> Any:
    """d sigma_Heq / dJ [Pa]."""
    K0, K_lim, r_w = porosity.bulk, porosity.limit_bulk, porosity.fluid_fraction
    J0 = 1 - r_w + r_w * K0 / K_lim
    return jnp.where(J > J0, K0 / (1 + (jnp.maximum(J, J0) - 1) / r_w), K_lim)


def volumetric_energy(porosity: Porosity, J: Any) -> Any:
    """The integral of sigma_Heq from 1 to J [Pa]: K0 r_w^2 (u ln u - u + 1), u = (r_w + J - 1)/r_w, and a parabola."""
    K0, K_lim, r_w = porosity.bulk, porosity.limit_bulk, porosity.fluid_fraction
    J0 = 1 - r_w + r_w * K0 / K_lim
    u = 1 + (jnp.maximum(J, J0) - 1) / r_w
    below = jnp.minimum(J - J0, 0.0)
    return K0 * r_w**2 * (u * jnp.log(u) - u + 1) + below * (volumetric_stress(porosity, J0) + 0.5 * K_lim * below)


def initial_fluid(porosity: Porosity, mesh: TetMesh) -> Fluid:
    """No pressure, reference volumes."""
    J = jnp.ones_like(mesh.volumes)
    return Fluid(jnp.zeros(mesh.points.shape[0], J.dtype), J, J if porosity.scheme == "chapter" else None)


#: Flat and inverted elements store and conduct fluid as elements of this J.
_LEAST_J = 1e-3


class Flow(NamedTuple):
    """dt times storage rate plus Darcy's Laplacian, in the positions at the beginning of a step: made once a step."""

    matrix: block_matrix.BlockMatrix  # symmetric positive definite, 1 x 1 blocks
    store: jax.Array  # (V,) [m^3/Pa]
    mask: jax.Array  # (V,) 0 where P is given
    slow: Coarse  # coarse space of the matrix
    low: jax.Array  # about the least eigenvalue of D^-1 A beyond the coarse space
    high: jax.Array  # no eigenvalue of D^-1 A is above it
    tolerance: float  # of a solve, relative to its right-hand side


def flow(porosity: Porosity, mesh: TetMesh, fluid: Fluid, F: Matrix, dt: Any, tolerance: float) -> Flow:
    """The matrix of the pressure equation for a step of dt [s] that begins at F."""
    mask = jnp.ones(mesh.points.shape[0], fluid.J.dtype)
    if porosity.drained is not None:
        mask = mask.at[porosity.drained].set(0.0)
    # Everything times dt: the storage term stays of the size of a volume whatever the step.
    J = jnp.maximum(fluid.J, _LEAST_J)
    store = _scatter(mesh, mesh.volumes * J / 4) / porosity.limit_bulk
    g = _gradients(mesh, F)
    # grad N_a = cof(F) D_a / J per current volume J V0.
    weight = dt * porosity.permeability * mesh.volumes / J
    rows = block_matrix.off_diagonal(mesh, {(a, b): ((weight * dot(g[a], g[b]),),) for a, b in PAIRS})
    diagonal = ((store - block_matrix.row_sums(rows)[0][0],),)
    A = block_matrix.BlockMatrix(rows, diagonal, mesh.pattern.row_nodes)
    A0, total, rate = jax.lax.stop_gradient((A, jnp.sum(diagonal[0][0]), dt * porosity.permeability))
    # Storage, and Darcy flow at the wave number 5 / width: slower waves the coarse space takes (measured: 4.9 to 5.4).
    waves = rate * (5 / mesh.pattern.patch_width) ** 2 * jnp.sum(mesh.volumes)
    low = jax.lax.stop_gradient(jnp.sum(store) + waves) / total
    slow = preconditioner.coarse(mesh, A0, mask[:, None], True)
    high = 1 + jnp.max(jnp.sum(jnp.abs(A0.rows[0][0]), axis=0) / A0.diagonal[0][0])  # Gershgorin
    return Flow(A, store, mask, slow, low, high, tolerance)


def _gradients(mesh: TetMesh, F: Matrix) -> list[Vector]:
    """cof(F) D_a = dJ/dx_a of the four nodes."""
    cof = cofactor(F)
    g = [matvec(cof, tuple(mesh.shape_vectors[a])) for a in range(3)]
    return [tuple(-(x + y + z) for x, y, z in zip(*g, strict=True)), *g]


def pressure(porosity: Porosity, mesh: TetMesh, fluid: Fluid, flow: Flow, J_end: Any) -> jax.Array:
    """P (V,) [Pa] at the end of a step that ends with volumes J_end (E,)."""
    before: Any = fluid.J_before
    increment = fluid.J - before if porosity.scheme == "chapter" else J_end - fluid.J
    rate = -_scatter(mesh, mesh.volumes * increment / 4)
    return solved(mesh, flow, flow.mask * (flow.store * fluid.pressure + rate))


def solved(mesh: TetMesh, flow: Flow, b: jax.Array) -> jax.Array:
    """A^-1 b for b (V,), A the matrix of the pressure, to the tolerance of the flow; has derivatives."""

    def apply(p):
        # A unit row where drained: adjoint loads need not vanish there.
        return flow.mask * _product(flow, flow.mask * p) + (1 - flow.mask) * p

    diagonal = flow.mask * flow.matrix.diagonal[0][0] + (1 - flow.mask)
    slow = preconditioner.correction(mesh, flow.slow, flow.mask[:, None])

    def precondition(r):
        return r / diagonal + slow((r,))[0]

    D = jax.lax.stop_gradient(diagonal)
    return differentiable_solve(apply, b, precondition, flow.tolerance, 2000, diagonal=D)


def _product(flow: Flow, p: jax.Array) -> jax.Array:
    """A p, by differences of neighbours: where p is uniform nothing flows, however large dt and however few digits."""
    rows, nodes = flow.matrix.rows[0][0], flow.matrix.nodes

    def add(slot, total):
        return total + rows[slot] * (p[nodes[slot]] - p)

    return jax.lax.fori_loop(0, nodes.shape[0], add, flow.store * p)


def fluid_energy(porosity: Porosity, mesh: TetMesh, fluid: Fluid, flow: Flow, J_end: Any) -> jax.Array:
    """b . P / 2 [J] with P = A^-1 b the pressure at the end of a step that ends with volumes J_end (E,)."""
    b = flow.store * fluid.pressure - _scatter(mesh, mesh.volumes * (J_end - fluid.J) / 4)
    return 0.5 * jnp.vdot(flow.mask * b, pressure(porosity, mesh, fluid, flow, J_end))


#: Error of the polynomial that stands for the inverse of the pressure's matrix in Newton's direction.
_POLYNOMIAL_ERROR = 0.1


def nearly_solved(mesh: TetMesh, flow: Flow, b: jax.Array) -> jax.Array:
    """Near A^-1 b for b (V,), A the matrix of the pressure: a symmetric, positive definite, linear map.

    The slow waves exactly, by the coarse space, the others by a polynomial.
    """
    d = flow.matrix.diagonal[0][0]
    degree = jnp.ceil(0.5 * jnp.sqrt(flow.high / flow.low) * jnp.log(2 / _POLYNOMIAL_ERROR)).astype(jnp.int32)
    exact = preconditioner.correction(mesh, flow.slow, flow.mask[:, None])

    def apply(p):
        return flow.mask * _product(flow, p)

    def slow(r):
        return exact((r,))[0]

    b = flow.mask * b
    at_once = slow(b)
    p = chebyshev(apply, b - apply(at_once), d, (flow.low, flow.high), degree)
    return at_once + p - slow(apply(p))


def with_flow(
    mesh: TetMesh, flow: Flow | None, A: block_matrix.BlockMatrix, both: tuple[jax.Array, ...], exactly: bool = False
) -> tuple[jax.Array, ...]:
    """Forces, columns (V,), of a motion that changes pressures too, from `both` = A (dx, 0) of the `coupled` matrix A.

    Without `flow` nothing flows: the matrix of the pressures is diagonal. With it their equation is solved nearly, or
    `exactly`: to its tolerance.
    """
    *forces, balance = both
    if flow is None:
        dP = -balance / A.diagonal[3][3]
    else:
        dP = flow.mask * solved(mesh, flow, flow.mask * balance) if exactly else nearly_solved(mesh, flow, balance)
    rows, diagonal = (tuple(row[3:] for row in blocks[:3]) for blocks in (A.rows, A.diagonal))
    pull = block_matrix.product(block_matrix.BlockMatrix(rows, diagonal, A.nodes), (dP,))
    return tuple(f + p for f, p in zip(forces, pull, strict=True))


def undrained_diagonal(A: block_matrix.BlockMatrix, mask: Any) -> block_matrix.Block:
    """Diagonal blocks of K + G^T D^-1 G, with D the diagonal of the pressure's matrix: right where nothing flows."""
    soft = -mask / A.diagonal[3][3]
    near = soft[A.nodes]

    def entry(r, c):
        pull = jnp.sum(A.rows[r][3] * near * A.rows[c][3], axis=0)
        return A.diagonal[r][c] + pull + A.diagonal[r][3] * soft * A.diagonal[c][3]

    return tuple(tuple(entry(r, c) for c in range(3)) for r in range(3))


class Volume(NamedTuple):
    """The stress sigma_Heq - P as a law of J alone, for `terms.blocks`."""

    stress: Any
    slope: Any
    invariants: tuple = ("J",)

    def measures(self, F: Matrix) -> Matrix:
        """What `energy_derivatives` takes."""
        return F

    def energy_derivatives(self, _: Matrix) -> tuple[dict, dict]:
        """Stress and slope."""
        return {"J": self.stress}, {("J", "J"): self.slope}


def sponge(porosity: Porosity, mesh: TetMesh, P: jax.Array, F: Matrix) -> Volume:
    """The sponge at a given pressure, as a law."""
    J = determinant(F)
    return Volume(volumetric_stress(porosity, J) - element_pressure(mesh, P), volumetric_slope(porosity, J))


def coupled(
    mesh: TetMesh, K: dict, inertia: Any, F: Matrix, pressures: block_matrix.BlockMatrix
) -> block_matrix.BlockMatrix:
    """Derivative of forces and minus the pressure equation by (x, P): symmetric, indefinite, 4 x 4 blocks.

    Args:
        K: blocks (E,) of the forces at given pressure, by pairs of nodes.
        inertia: (V,) what inertia adds to the diagonal, or None.
        F: deformation gradient at the end of the step.
        pressures: matrix of the pressure equation.
    """
    q = [scale(mesh.volumes / 4, g) for g in _gradients(mesh, F)]
    bordered = {}
    for (a, b), block in K.items():
        forces = [(*block[r], -q[a][r]) for r in range(3)]
        bordered[a, b] = (*forces, (*(-x for x in q[b]), None))
    rows: block_matrix.Block = block_matrix.off_diagonal(mesh, bordered)
    rows = (*rows[:3], (*rows[3][:3], -pressures.rows[0][0]))
    sums = block_matrix.row_sums(rows)
    # No force under translation: the columns of x add up to zero along a row.
    corner = [[-sums[r][c] + (inertia if inertia is not None and r == c else 0.0) for c in range(3)] for r in range(3)]
    border = [-sums[3][c] for c in range(3)]
    diagonal = (*((*corner[r], border[r]) for r in range(3)), (*border, -pressures.diagonal[0][0]))
    return block_matrix.BlockMatrix(rows, diagonal, mesh.pattern.row_nodes)


def _scatter(mesh: TetMesh, share: jax.Array) -> jax.Array:
    total = jnp.zeros(mesh.points.shape[0], share.dtype)
    for a in range(4):
        total = total.at[mesh.tetrahedra[:, a]].add(share)
    return total


def element_pressure(mesh: TetMesh, P: jax.Array) -> jax.Array:
    """Mean (E,) of the pressure (V,) of the nodes."""
    corners: Any = sum(P[mesh.tetrahedra[:, a]] for a in range(4))
    return corners / 4


def first_piola(porosity: Porosity, mesh: TetMesh, P: jax.Array, F: Matrix) -> Matrix:
    """(sigma_Heq(J) - P) cof F [Pa], P the mean over an element's nodes."""
    sigma = volumetric_stress(porosity, determinant(F)) - element_pressure(mesh, P)
    return tuple(tuple(sigma * c for c in row) for row in cofactor(F))


def advance(porosity: Porosity, fluid: Fluid, P: jax.Array, F: Matrix) -> Fluid:
    """The state after an accepted step."""
    return Fluid(P, determinant(F), fluid.J if porosity.scheme == "chapter" else None)
