"""Darcy's law (book chapter, section 4.3): storage and flow of a fluid with the pressure P at the nodes.

    (1/K_lim) dP/dt = kappa lap P - (dJ/dt)/J

J is the volume ratio, kappa the permeability, lap the Laplacian, and 1/K_lim the fluid volume stored per volume of the
body and per pressure. The equation uses the volumes at the beginning of a step, so that it is linear in P. Its discrete
form is the pressure equation A P = b, with the pressure matrix A.
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
from liverjax.solvers.krylov import Known, chebyshev, differentiable_solve, length
from liverjax.solvers.preconditioner import Coarse
from liverjax.tensors.matrices import Matrix, dot

#: Minimum volume ratio J. In elements with a smaller J (flat or inverted), storage and flow are computed with this
#: value.
LEAST_J = 1e-3


class Flow(NamedTuple):
    """The pressure equation of a step, for the positions at the beginning of the step.

    A is the pressure matrix, and D its diagonal. A contains the storage of fluid plus dt times the flow
    between nodes, both per unit of pressure.
    """

    matrix: block_matrix.BlockMatrix  # A: symmetric, positive definite, with 1 x 1 blocks
    store: jax.Array  # (V,) [m^3/Pa] fluid volume stored per unit of pressure
    mask: jax.Array  # (V,): 0 where the pressure is given, 1 elsewhere
    slow: Coarse  # coarse space of the preconditioner
    low: jax.Array  # estimated minimum eigenvalue of D^-1 A outside the coarse space
    high: jax.Array  # upper bound of the eigenvalues of D^-1 A
    tolerance: jax.Array  # tolerance of a solve, relative to the right-hand side
    given: jax.Array | None = None  # (V,) [Pa] given pressures, 0 at other nodes; None: all given pressures are 0
    enters: jax.Array | None = None  # (V,) [m^3] fluid that enters during the step; None: no fluid enters


def unknown_pressures(porosity: Any, mesh: TetMesh, dtype: jnp.dtype) -> jax.Array:
    """Return a mask (V,) of the vertices: 0 if the vertex is drained or its pressure is given, otherwise 1."""
    mask = jnp.ones(mesh.number_of_vertices, dtype)
    if porosity.drained is not None:
        # Only vertices have pressures, so edge midpoints in this list are ignored.
        mask = mask.at[porosity.drained].set(0.0, mode="drop")
    for inlet in porosity.inlet:
        if inlet.nodes is not None:
            mask = mask.at[inlet.nodes].set(0.0, mode="drop")
    return mask


def flow(porosity: Any, mesh: TetMesh, J: jax.Array, F: Matrix, dt: Number, tolerance: jax.Array) -> Flow:
    """Return the pressure equation of a step of length dt [s].

    F (deformation gradient) and J (E,) (volume ratios) are values at the beginning of the step.
    """
    mask = unknown_pressures(porosity, mesh, J.dtype)
    # The whole equation is multiplied by dt, so that the storage term does not depend on the time step.
    J = jnp.maximum(J, LEAST_J)
    by_element = jnp.ndim(porosity.limit_bulk) > 0
    store = integrals(mesh, J / porosity.limit_bulk) if by_element else integrals(mesh, J) / porosity.limit_bulk
    g = volume_gradients(mesh, F)
    # In the flow term, gradients grad N_a = cof(F) D_a / J occur twice, and the volume is J V0. So one factor 1/J
    # remains.
    weight = dt * porosity.permeability * mesh.weights / J
    rows = block_matrix.off_diagonal(mesh, {(a, b): ((summed(mesh, weight * dot(g[a], g[b])),),) for a, b in PAIRS})
    diagonal = ((store - block_matrix.row_sums(rows)[0][0],),)
    A = block_matrix.BlockMatrix(rows, diagonal, mesh.pattern.row_nodes)
    A0 = jax.lax.stop_gradient(A)
    low = jax.lax.stop_gradient(_least_eigenvalue(mesh, dt * porosity.permeability, store, diagonal[0][0]))
    slow = preconditioner.coarse(mesh, A0, mask[:, None], True)
    high = 1 + jnp.max(jnp.sum(jnp.abs(A0.rows[0][0]), axis=0) / A0.diagonal[0][0])  # Gershgorin's bound
    return Flow(A, store, mask, slow, low, high, tolerance)


def _least_eigenvalue(mesh: TetMesh, rate: Number, store: jax.Array, diagonal: jax.Array) -> jax.Array:
    """Estimate the minimum eigenvalue of D^-1 A outside the coarse space, with the diagonal D of A.

    The coarse space is that of the preconditioner. `rate` is the time step dt times the permeability kappa: one number,
    one per element (E,) or (1, E), or one for each of Q integration points of the elements (Q, E).
    """
    stored, total = jnp.sum(store), jnp.sum(diagonal)
    if jnp.ndim(rate):
        # The elements with the largest dt kappa determine the minimum eigenvalue. So this value is used for the whole
        # body.
        fastest, mean = jnp.max(rate), jnp.sum(rate * mesh.weights) / jnp.sum(mesh.volumes)
        total, rate = stored + (total - stored) * fastest / jnp.where(mean > 0, mean, 1.0), fastest
    # The numerator of the estimate is the storage plus the Darcy flow of a pressure wave with wave number 5 / (width of
    # a patch of the coarse space). In numerical tests, this number was 4.9 to 5.4 instead of 5. Errors with longer
    # waves are corrected in the coarse space.
    waves = rate * (5 / mesh.pattern.patch_width) ** 2 * jnp.sum(mesh.volumes)
    return (stored + waves) / total


def right_side(flow: Flow, b: jax.Array) -> jax.Array:
    """Return the right-hand side (V,) [m^3] for unknown pressures: b plus inflow, minus A times given pressures."""
    if flow.enters is not None:
        b = b + flow.enters
    return flow.mask * (b if flow.given is None else b - flow_product(flow, flow.given))


def lack(flow: Flow, b: jax.Array, pressure: jax.Array) -> jax.Array:
    """Return the residual b - A P (V,) [m^3] for pressures P (V,) [Pa]. It is 0 at a solution.

    At nodes with a given pressure, the residual is the given pressure minus P.
    """
    own = flow.mask * pressure
    error = own - pressure if flow.given is None else own - pressure + flow.given
    return right_side(flow, b) - flow.mask * flow_product(flow, own) + error


class Guess(NamedTuple):
    """Starting pressures of a solve, and the accuracy that this solve needs."""

    pressure: jax.Array  # (V,) [Pa]; derivatives of the solution do not depend on these pressures
    looser: Number  # tolerance of the solve, divided by `Flow.tolerance`


def with_given(mesh: TetMesh, flow: Flow, b: jax.Array, guess: Guess | None = None) -> jax.Array:
    """Solve the pressure equation. Return all pressures (V,) [Pa], computed and given."""
    P = solved(mesh, flow, right_side(flow, b), guess)
    return P if flow.given is None else P + flow.given


def solved(mesh: TetMesh, flow: Flow, b: jax.Array, guess: Guess | None = None) -> jax.Array:
    """Solve A p = b for b (V,), with the pressure matrix A, to the tolerance of `flow`. The result is differentiable.

    A `guess` of p saves iterations. The derivatives are as accurate as without a guess.
    """

    def apply(p):
        # For given pressures, the rows of the matrix are rows of the identity, since the right-hand side of an adjoint
        # solve may be nonzero in these rows.
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
        size = length(r)
        tolerance = guess.looser * flow.tolerance * length(b) / jnp.where(size > 0, size, 1.0)
        return begin + differentiable_solve(apply, r, precondition, tolerance, 2000, known)

    begin = jax.lax.stop_gradient(flow.mask * guess.pressure)
    return jax.lax.custom_root(lambda p: apply(p) - b, begin, found, exact)


def flow_product(flow: Flow, p: jax.Array) -> jax.Array:
    """Return A p, with the flow computed from differences of p between neighbours. So a uniform p causes no flow."""
    rows, nodes = flow.matrix.rows[0][0], flow.matrix.nodes
    # One operation for all neighbours takes a third of the time of a loop over the neighbours, on small and large
    # meshes.
    return flow.store * p + jnp.sum(rows * (p[nodes] - p[None]), axis=0)


#: Relative error of the polynomial that approximates the inverse of the pressure matrix in Newton's direction.
_POLYNOMIAL_ERROR = 0.1


def nearly_solved(mesh: TetMesh, flow: Flow, b: jax.Array) -> jax.Array:
    """Solve A p = b for b (V,) approximately, with the pressure matrix A.

    The approximate inverse is linear, symmetric and positive definite. It is exact in the coarse space, which
    represents pressures of long wavelength. For other pressures it is a polynomial of D^-1 A, with the diagonal D of A.
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
