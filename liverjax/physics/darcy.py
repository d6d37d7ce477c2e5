"""Darcy's law (book chapter, section 4.3): storage and flow of the fluid, with its pressure at the nodes.

    (1/K_lim) dP/dt = kappa lap P - (dJ/dt)/J

The equation uses the volumes at the beginning of a step, so that it is linear in P: A P = b.
"""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from liverjax.core.struct import Number
from liverjax.elements.gradients import volume_gradients
from liverjax.mesh.adjacency import PAIRS
from liverjax.mesh.nodal import integrals, summed
from liverjax.mesh.tetrahedra import TetMesh
from liverjax.solvers import block_matrix, preconditioner
from liverjax.solvers.krylov import Known, chebyshev, differentiable_solve
from liverjax.solvers.preconditioner import Coarse
from liverjax.tensors.matrices import Matrix, dot

#: Elements with a smaller J (flat or inverted) store and conduct fluid as if they had this J.
LEAST_J = 1e-3


class Flow(NamedTuple):
    """The pressure equation of a step at its initial positions: storage plus dt times Darcy's Laplacian."""

    matrix: block_matrix.BlockMatrix  # symmetric positive definite, 1 x 1 blocks
    store: jax.Array  # (V,) [m^3/Pa]
    mask: jax.Array  # (V,) 0 where P is given
    slow: Coarse  # coarse space of the matrix
    low: jax.Array  # estimated minimum eigenvalue of D^-1 A outside the coarse space
    high: jax.Array  # upper bound of the eigenvalues of D^-1 A
    tolerance: jax.Array  # of a solve, relative to its right-hand side
    given: jax.Array | None = None  # (V,) [Pa] pressures where they are given, 0 elsewhere; None: they are 0
    enters: jax.Array | None = None  # (V,) [m^3] fluid that enters during the step; None: none enters


def unknown_pressures(porosity: Any, mesh: TetMesh, dtype: jnp.dtype) -> jax.Array:
    """1 at vertices (V,) whose pressure is unknown, 0 where it is drained or given."""
    mask = jnp.ones(mesh.number_of_vertices, dtype)
    if porosity.drained is not None:
        # Only vertices have pressures: middles of edges among these nodes are ignored.
        mask = mask.at[porosity.drained].set(0.0, mode="drop")
    for inlet in porosity.inlet:
        if inlet.nodes is not None:
            mask = mask.at[inlet.nodes].set(0.0, mode="drop")
    return mask


def flow(porosity: Any, mesh: TetMesh, J: jax.Array, F: Matrix, dt: Number, tolerance: jax.Array) -> Flow:
    """The matrix of the pressure equation for a step of dt [s] that begins at F, with volume ratios J (E,)."""
    mask = unknown_pressures(porosity, mesh, J.dtype)
    # Everything is multiplied by dt, so that the storage term does not depend on the step.
    J = jnp.maximum(J, LEAST_J)
    by_element = jnp.ndim(porosity.limit_bulk) > 0
    store = integrals(mesh, J / porosity.limit_bulk) if by_element else integrals(mesh, J) / porosity.limit_bulk
    g = volume_gradients(mesh, F)
    # grad N_a = cof(F) D_a / J per current volume J V0.
    weight = dt * porosity.permeability * mesh.weights / J
    rows = block_matrix.off_diagonal(mesh, {(a, b): ((summed(mesh, weight * dot(g[a], g[b])),),) for a, b in PAIRS})
    diagonal = ((store - block_matrix.row_sums(rows)[0][0],),)
    A = block_matrix.BlockMatrix(rows, diagonal, mesh.pattern.row_nodes)
    A0 = jax.lax.stop_gradient(A)
    low = jax.lax.stop_gradient(_least_eigenvalue(mesh, dt * porosity.permeability, store, diagonal[0][0]))
    slow = preconditioner.coarse(mesh, A0, mask[:, None], True)
    high = 1 + jnp.max(jnp.sum(jnp.abs(A0.rows[0][0]), axis=0) / A0.diagonal[0][0])  # Gershgorin
    return Flow(A, store, mask, slow, low, high, tolerance)


def _least_eigenvalue(mesh: TetMesh, rate: Number, store: jax.Array, diagonal: jax.Array) -> jax.Array:
    """Estimated minimum eigenvalue of D^-1 A outside the coarse space; `rate` is dt kappa, one or one per element."""
    stored, total = jnp.sum(store), jnp.sum(diagonal)
    if jnp.ndim(rate):
        # It is smallest where the fluid flows fastest: treat the whole body as if it flowed everywhere as fast.
        fastest, mean = jnp.max(rate), jnp.sum(jnp.ravel(rate) * mesh.volumes) / jnp.sum(mesh.volumes)
        total, rate = stored + (total - stored) * fastest / jnp.where(mean > 0, mean, 1.0), fastest
    # Storage, and flow at the wave number 5 / width: the coarse space treats longer waves (measured: 4.9 to 5.4).
    waves = rate * (5 / mesh.pattern.patch_width) ** 2 * jnp.sum(mesh.volumes)
    return (stored + waves) / total


def right_side(flow: Flow, b: jax.Array) -> jax.Array:
    """The part of b (V,) for the free pressures: inflow added, the effect of given pressures subtracted."""
    if flow.enters is not None:
        b = b + flow.enters
    return flow.mask * (b if flow.given is None else b - flow_product(flow, flow.given))


def lack(flow: Flow, b: jax.Array, pressure: jax.Array) -> jax.Array:
    """Residual b - A P (V,) for pressures P (V,) [Pa]. At nodes with a given pressure it is the error of P.

    It is 0 at a solution.
    """
    own = flow.mask * pressure
    error = own - pressure if flow.given is None else own - pressure + flow.given
    return right_side(flow, b) - flow.mask * flow_product(flow, own) + error


class Guess(NamedTuple):
    """Pressures at which a solve begins, and the accuracy that it needs."""

    pressure: jax.Array  # (V,) [Pa], without derivative
    looser: Number  # tolerance of the solve, over `Flow.tolerance`


def with_given(mesh: TetMesh, flow: Flow, b: jax.Array, guess: Guess | None = None) -> jax.Array:
    """All pressures (V,) [Pa]: the computed and the given ones."""
    P = solved(mesh, flow, right_side(flow, b), guess)
    return P if flow.given is None else P + flow.given


def solved(mesh: TetMesh, flow: Flow, b: jax.Array, guess: Guess | None = None) -> jax.Array:
    """A^-1 b for b (V,), with A the matrix of the pressures, to the tolerance of the flow. It has derivatives.

    A `guess` saves iterations; the derivatives are as accurate as without a guess.
    """

    def apply(p):
        # Rows of given pressures are unit rows: adjoint loads may be different from 0 there.
        return flow.mask * flow_product(flow, flow.mask * p) + (1 - flow.mask) * p

    diagonal = flow.mask * flow.matrix.diagonal[0][0] + (1 - flow.mask)
    slow = preconditioner.correction(mesh, flow.slow, flow.mask[:, None])

    def precondition(r):
        return r / diagonal + slow((r,))[0]

    known = Known(diagonal=jax.lax.stop_gradient(diagonal))

    def exact(A, b):
        return differentiable_solve(A, b, precondition, flow.tolerance, 2000, known)

    if guess is None:
        return exact(apply, b)

    def found(lack, begin):
        r = -lack(begin)
        size = jnp.linalg.norm(r)
        tolerance = guess.looser * flow.tolerance * jnp.linalg.norm(b) / jnp.where(size > 0, size, 1.0)
        return begin + differentiable_solve(apply, r, precondition, tolerance, 2000, known)

    begin = jax.lax.stop_gradient(flow.mask * guess.pressure)
    return jax.lax.custom_root(lambda p: apply(p) - b, begin, found, exact)


def flow_product(flow: Flow, p: jax.Array) -> jax.Array:
    """The product A p, from differences between neighbours: a uniform p gives exactly no flow, in any precision."""
    rows, nodes = flow.matrix.rows[0][0], flow.matrix.nodes
    # One kernel for all neighbours takes a third of the time of a loop over them, on small and on large meshes.
    return flow.store * p + jnp.sum(rows * (p[nodes] - p[None]), axis=0)


#: Error of the polynomial that replaces the inverse of the matrix of the pressures in Newton's direction.
_POLYNOMIAL_ERROR = 0.1


def nearly_solved(mesh: TetMesh, flow: Flow, b: jax.Array) -> jax.Array:
    """Approximate A^-1 b for b (V,), with A the matrix of the pressures.

    The approximation is linear in b, symmetric and positive definite. The coarse space solves exactly for long waves; a
    polynomial treats the other waves.
    """
    d = flow.matrix.diagonal[0][0]
    degree = jnp.ceil(0.5 * jnp.sqrt(flow.high / flow.low) * jnp.log(2 / _POLYNOMIAL_ERROR)).astype(jnp.int32)
    exact = preconditioner.correction(mesh, flow.slow, flow.mask[:, None])

    def apply(p):
        return flow.mask * flow_product(flow, p)

    def slow(r):
        return exact((r,))[0]

    b = flow.mask * b
    at_once = slow(b)
    p = chebyshev(apply, b - apply(at_once), d, (flow.low, flow.high), degree)
    return at_once + p - slow(apply(p))
