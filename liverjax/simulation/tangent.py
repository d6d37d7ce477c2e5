"""The tangent of the forces of a scene (from hand-derived stiffness blocks), and linear solves with this tangent.

With `linear_solver = "direct"` a factorisation solves the linear systems. Otherwise the physics of the scene determines
the method. Conjugate gradients solve symmetric systems, after nodal pressures are eliminated. BiCGSTAB solves systems
with follower loads or friction, because these systems are not symmetric. It also solves systems with pressure unknowns,
because the preconditioner of these systems is not symmetric. The preconditioner consists of the inverse diagonal blocks
of the stiffness. A coarse space, with few unknowns for motions of long wavelength, is added if these motions would need
many iterations. Columns (V,) are the x, y and z components of a nodal vector in separate arrays. A flat vector (3 V,)
contains the columns one after the other.
"""

from collections.abc import Callable, Sequence
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from liverjax.core.struct import Number
from liverjax.elements import mjed, projection
from liverjax.elements.gradients import volume_gradients
from liverjax.laws.terms import invariant_terms
from liverjax.mesh.adjacency import PAIRS
from liverjax.physics.base import Free, VolumeStress
from liverjax.simulation import mixed_system
from liverjax.simulation.equations import Equations, in_directions_at
from liverjax.solvers import attached, block_matrix, clusters, direct, point_matrix
from liverjax.solvers.attached import Attached, Between
from liverjax.solvers.block_matrix import Block, BlockMatrix
from liverjax.solvers.clusters import Inverses
from liverjax.solvers.krylov import conjugate_gradients, stabilised_biconjugate_gradients
from liverjax.solvers.point_matrix import PointMatrix
from liverjax.solvers.preconditioner import Coarse, coarse, coarse_of_product, corrected, correction, worthwhile
from liverjax.tensors.matrices import (
    Matrix,
    add_matrices,
    deformation_gradient,
    determinant,
    scale,
    scale_matrix,
    stored,
)

_OWN = tuple((a, b) for a in range(3) for b in range(a, 3))

#: Kinds of element stiffness: the true stiffness, a stiffness without negative eigenvalues, and the stiffness of the
#: book chapter, section 4.1.2 iii.
KINDS = ("true", "projected", "regularised")

#: One of `KINDS`; or a pair: one of the last two `KINDS`, and a flag that is computed at run time (false: true
#: stiffness).
Kind = str | tuple[str, jax.Array]


def _of_kind(kind: Kind, make: Callable[[str], Any]) -> Any:
    """Return `make(kind)`. If the kind is chosen at run time, the compiled program contains code for both kinds."""
    if isinstance(kind, str):
        return make(kind)
    name, taken = kind
    return jax.lax.cond(taken, lambda: make(name), lambda: make("true"))


def own_blocks(e: Equations, pressure: Any, F: Matrix, kind: Kind = "true") -> dict[tuple[int, int], Matrix]:
    """Return the stiffness K_ab [N/m] between corners a and b (1 <= a <= b <= 3) at every integration point."""
    return _of_kind(kind, partial(_own_blocks, e, pressure, F))


def _own_blocks(e: Equations, pressure: Any, F: Matrix, kind: str) -> dict[tuple[int, int], Matrix]:
    mesh, F = e.mesh, stored(F)
    D = [tuple(mesh.gradients[a]) for a in range(3)]
    volume = None if e.volume is None else e.volume.scalars(mesh, pressure, F)
    if kind == "true":
        summands = [solid.blocks(F, D, _OWN) for solid in e.solids]
        if volume is not None:
            summands.append(invariant_terms.blocks(invariant_terms.state_of(volume, F), D, _OWN))
    else:
        make = projection.blocks if kind == "projected" else projection.regularised
        pairs = [solid.parts() for solid in e.solids]
        parts = [part for laws, _ in pairs for part in laws]
        remembered = [S for _, S in pairs if S is not None]
        summands = [make(parts, remembered[0] if remembered else None, F, D, _OWN, volume)]
    K = summands[0]
    for more in summands[1:]:
        K = [add_matrices(a, b) for a, b in zip(K, more, strict=True)]
    return {(a + 1, b + 1): scale_matrix(mesh.weights, block) for (a, b), block in zip(_OWN, K, strict=True)}


def element_blocks(
    e: Equations, pressure: jax.Array | None, F: Matrix, kind: Kind = "true"
) -> dict[tuple[int, int], Matrix]:
    """Return the stiffness K_ab [N/m] of every linear element for the node pairs (a, b) in `PAIRS`."""
    full = mjed.all_blocks(own_blocks(e, pressure, F, kind))
    return {(a, b): full[a][b] for a, b in PAIRS}


def stiffness(e: Equations, pressure: jax.Array | None, x: jax.Array, kind: Kind = "true") -> BlockMatrix:
    """Return the stiffness matrix of the elements and of the force terms at nodes, at positions x (V, 3) [m]."""
    K = element_blocks(e, pressure, deformation_gradient(e.mesh, x), kind)
    return block_matrix.force_matrix(e.mesh, K, node_blocks(e))


def node_blocks(e: Equations) -> Block | None:
    """Return the sum of the diagonal stiffness blocks (entries (V,) [N/m]) of force terms at nodes, or None."""
    total: Block | None = None
    for a in e.nodal:
        own = a.stiffness()
        if own is not None:
            total = own if total is None else block_matrix.added(total, own)
    return total


def _attached(e: Equations, x: jax.Array, s: Number, kind: Kind) -> tuple[Between, ...]:
    """Return the stiffness between nodes (springs, contact …) of all force terms, and rank-one changes `GivesWay`."""

    def of(kind: str) -> tuple[Between, ...]:
        found: list[Between | None] = []
        for a in e.nodal:
            found.append(a.attached(e.mesh, x, s) if kind == "true" else a.definite(e.mesh, x, s))
            found.append(a.gives_way(e.mesh, x, s, kind != "true"))
        return tuple(own for own in found if own is not None)

    return _of_kind(kind, of)


def _symmetric(e: Equations, more: tuple[Between, ...]) -> tuple[Attached, ...]:
    """Return the symmetric parts of `Attached` matrices in `more`, for a preconditioner. Friction is not symmetric."""
    elements = tuple(own for own in more if isinstance(own, Attached))
    return elements if e.conservative else tuple(attached.symmetric_part(own) for own in elements)


def _with_diagonals(e: Equations, diagonal: Block, more: tuple[Attached, ...]) -> Block:
    for own in more:
        diagonal = block_matrix.added(diagonal, attached.own_diagonal(own, e.mesh.number_of_nodes))
    return diagonal


def _shift(e: Equations) -> jax.Array | None:
    """Return the stiffness (V,) [N/m] that acts on every node (inertia), or None if there is no such stiffness."""
    own = [a.stiffness() for a in e.nodal if a.everywhere]
    return own[0][0][0] if own and own[0] is not None else None


def volume_with_pressures(e: Equations) -> VolumeStress | None:
    """Return the force term with pressures that depend on the positions, or None if there is no such term."""
    return e.volume if e.volume is not None and e.volume.coupled else None


class Tangent(NamedTuple):
    """A tangent with its preconditioner, assembled at some positions and used for iterates near these positions."""

    matrix: BlockMatrix | PointMatrix
    inverse: Inverses  # inverses of the diagonal blocks of the matrix
    vertices: Inverses | None  # for quadratic elements: `inverse` for linear elements with the same vertices
    slow: Coarse
    x: jax.Array | None  # (V, 3) positions of the assembly; None: conservative forces, and no nodes rotate together
    s: Any  # fraction of the step at the assembly
    follows: jax.Array | None  # 1 if K contains the stiffness of non-conservative forces, else 0
    attached: tuple[Between, ...] = ()  # stiffness between nodes that is not in the matrix
    pressures: Coarse | None = None  # coarse space of pressure unknowns in thin elements
    #: Whether `solve` eliminates pressure unknowns first; None: never.
    eliminates: jax.Array | None = None


def tangent(
    e: Equations,
    pressure: jax.Array | None,
    x: jax.Array,
    s: Number,
    near: tuple[Any, Tangent] | None = None,
    kind: Kind = "true",
) -> Tangent:
    """Return the derivative of the forces at positions x (V, 3) [m] and step fraction s. JAX treats it as a constant.

    `pressure`: pressures at the nodes (V,) [Pa], or None without pressures. `near`: a flag and a tangent; if the flag
    is true, the coarse space of this tangent is used. `kind`: a `Kind`.
    """
    e, pressure, x, s = jax.lax.stop_gradient((e, pressure, x, s))
    name, taken = (kind, None) if isinstance(kind, str) else kind
    matrix, inverse, below, A, more = _assembled(e, pressure, (x, s), taken, name)

    slow = _coarse(e, A) if near is None else jax.lax.cond(near[0], lambda: near[1].slow, lambda: _coarse(e, A))
    # Non-conservative forces and nodes that rotate together need the positions at which the tangent was assembled.
    part, follows = (None, None) if e.conservative else (s, _true(kind, x.dtype))
    where = None if e.conservative and all(nodes.linear for nodes in e.free.tied) else x
    eliminates = ~_true(kind, bool) if kind != "true" and eliminates_pressures(e) else None
    K = Tangent(matrix, inverse, below, slow, where, part, follows, more, eliminates=eliminates)
    if not _thin(e):
        return K

    def slow_pressures() -> Coarse:
        return _slow_pressures(e, K)

    own = slow_pressures() if near is None else jax.lax.cond(near[0], lambda: near[1].pressures, slow_pressures)
    return K._replace(pressures=own)


def eliminates_pressures(e: Equations) -> bool:
    """Return whether pressure unknowns are eliminated in solves with a tangent that has no negative eigenvalues.

    Far from a solution, the pressures, and the stiffness that they cause, are as large as the bulk modulus. Iterations
    for positions and pressures together are scaled by the shear modulus and do not converge there. After the
    elimination the matrix of the positions is positive definite. For linear elements the pressures are not eliminated,
    because the pressure matrix has no simple inverse.
    """
    return e.mixed is not None and e.mesh.order > 1 and e.scene.solve.linear_solver != "direct"


def _thin(e: Equations) -> bool:
    """Return whether the pressure unknowns have a coarse space: true for linear elements if some elements are thin.

    In strongly compressed quadratic elements a coarse space would increase the number of iterations.
    """
    return e.mixed is not None and e.mesh.order == 1 and _groups_in_use(e, e.mesh.pattern.clusters) is not None


@jax.jit
def _slow_pressures(e: Equations, K: Tangent) -> Coarse:
    """Return the coarse space of the pressures, after approximate elimination of the displacements.

    In a layer between plates, pressures that vary slowly along the layer cause much smaller displacements than the
    mass matrix of the pressures suggests.
    """
    motions, volume = _motions(e, K), e.mixed

    def eliminated(p: jax.Array) -> jax.Array:
        moved = e.free.columns(motions(e.free.columns(mixed_system.pulled(e.mesh, K.matrix, p))))
        _, balance = mixed_system.with_pressures(e.mesh, volume, K.matrix, (moved, -p / volume.unit))
        return balance / volume.unit

    return coarse_of_product(e.mesh, eliminated)


def _true(kind: Kind, dtype: Any) -> jax.Array:
    """Return 1 for the true tangent, and 0 for the other kinds."""
    return jnp.asarray(kind == "true" if isinstance(kind, str) else ~kind[1], dtype)


#: Fields `matrix`, `inverse` and `vertices` of a `Tangent`, the matrix of its coarse space, and its field `attached`.
_Assembled = tuple[BlockMatrix | PointMatrix, Inverses, Inverses | None, BlockMatrix, tuple[Between, ...]]

# The functions below are called several times in a compiled program. With jit, JAX traces them only once.


@partial(jax.jit, static_argnames="name")
def _assembled(
    e: Equations, pressure: jax.Array | None, at: tuple[jax.Array, Number], taken: jax.Array | None, name: str
) -> _Assembled:
    """Assemble the tangent without its coarse space."""
    mesh, volume, (x, s) = e.mesh, volume_with_pressures(e), at
    kind: Kind = name if taken is None else (name, taken)
    if mesh.order > 1:
        return _of_points(e, pressure, x, s, kind)
    acting = volume if e.mixed is None else e.mixed
    if acting is None:
        A = stiffness(e, pressure, x, kind)
        diagonal = A.diagonal
    else:
        F = deformation_gradient(mesh, x)
        K, J = element_blocks(e, pressure, F, kind), determinant(F)
        pressures = _of_kind(kind, lambda kind: acting.matrix(mesh, J, kind != "true"))
        slope = 1.0 if e.mixed is None else e.mixed.border(J)
        A = mixed_system.coupled(mesh, K, node_blocks(e), F, pressures, slope)
        diagonal = tuple(row[:3] for row in A.diagonal[:3])
    if volume is not None:
        diagonal = mixed_system.undrained_diagonal(A, 1.0 if volume.flow is None else volume.flow.mask)
    more = _attached(e, x, s, kind)
    near = _symmetric(e, more)
    inverse = _vertex_inverses(e, e.free, A, _with_diagonals(e, diagonal, near))
    return A, inverse, None, attached.with_attached(mesh, A, near), more


def _vertex_inverses(e: Equations, free: Free, A: BlockMatrix, diagonal: Block) -> Inverses:
    """Return the inverses of the diagonal blocks of the matrix A of the vertices, and of clusters of vertices."""
    single = block_matrix.inverse_blocks(diagonal, free.mask, free.normals)
    groups = _groups_in_use(e, e.mesh.pattern.clusters)
    entries = clusters.of_rows(groups, e.mesh.pattern.edge_slots, A)
    return clusters.inverses(groups, entries, diagonal, free.mask, single)


def _groups_in_use(e: Equations, groups: Any) -> Any:
    """Return the clusters; None if a factorisation is used or nodes slide on oblique planes (no clusters are used)."""
    return None if e.free.normals is not None or e.scene.solve.linear_solver == "direct" else groups


@jax.jit
def _coarse(e: Equations, A: BlockMatrix) -> Coarse:
    """Return the coarse space of the preconditioner, made from the tangent A of the vertices."""
    used = False if e.scene.solve.linear_solver == "direct" else worthwhile(A, _vertex_shift(e))
    return coarse(e.mesh, A, _coarse_mask(_of_vertices(e)), used)


def _of_points(e: Equations, pressure: jax.Array | None, x: jax.Array, s: Number, kind: Kind) -> _Assembled:
    """Assemble the tangent of quadratic elements: blocks at integration points, and a two-level preconditioner."""
    mesh, volume = e.mesh, volume_with_pressures(e)
    F = deformation_gradient(mesh, x)
    A = PointMatrix(stored(own_blocks(e, pressure, F, kind)), node_blocks(e), None, None)
    bulk = None
    if volume is not None:
        C = _of_kind(kind, lambda kind: volume.matrix(mesh, determinant(F), kind != "true"))
        border = [scale(mesh.weights, g) for g in volume_gradients(mesh, F)[1:]]
        A = A._replace(border=stored(border), pressures=C)
        bulk = mixed_system.undrained_bulk(mesh, C, 1.0 if volume.flow is None else volume.flow.mask)
    elif e.mixed is not None:
        g = mesh.weights * e.mixed.border(determinant(F))
        A = A._replace(border=stored([scale(g, v) for v in volume_gradients(mesh, F)[1:]]))
        if e.scene.solve.linear_solver == "direct":
            C = _of_kind(kind, lambda kind: e.mixed.matrix(mesh, determinant(F), kind != "true"))
            A = A._replace(pressures=C)
        elif kind != "true":
            bulk = (1 - _true(kind, F[0][0].dtype)) * e.mixed.rest / mesh.weights
    own = point_matrix.levels(mesh, A, bulk)
    more = _attached(e, x, s, kind)
    near = _symmetric(e, more)
    diagonal, groups = _with_diagonals(e, own.diagonal, near), _groups_in_use(e, mesh.clusters)
    single = block_matrix.inverse_blocks(diagonal, e.free.mask, e.free.normals)
    inverse = clusters.inverses(groups, clusters.of_points(groups, mesh.order, A), diagonal, e.free.mask, single)
    below = attached.with_attached(mesh, own.vertices, near)
    return A, inverse, _vertex_inverses(e, _of_vertices(e), below, below.diagonal), below, more


def _of_vertices(e: Equations) -> Free:
    """Return the free directions of the vertices."""
    V, (mask, normals) = e.mesh.number_of_vertices, e.free[:2]
    return Free(mask[:V], None if normals is None else normals[:V])


def _vertex_shift(e: Equations) -> jax.Array | None:
    own = _shift(e)
    return own if own is None or e.mesh.order == 1 else point_matrix.restricted(e.mesh, own)


def _coarse_mask(free: Free) -> jax.Array:
    """Return the coarse space's mask (V, 3): 0 for fixed directions and nodes that slide on oblique planes, else 1."""
    mask, normals = free[:2]
    return mask if normals is None else mask * jnp.all(normals == 0, axis=1, keepdims=True)


def preconditioner(e: Equations, K: Tangent) -> Callable[[jax.Array], jax.Array]:
    """Return the preconditioner, a function of flat vectors: inverse diagonal blocks plus the coarse solution."""
    return in_directions_at(e, K.x, lambda e: _with_pressures(e, K, _motions(e, K)))


def _motions(e: Equations, K: Tangent) -> Callable:
    """Return the preconditioner of the displacements, as a function of columns (V,)."""
    mesh = e.mesh
    vertices = _groups_in_use(e, mesh.pattern.clusters)
    nodes = vertices if mesh.order == 1 else _groups_in_use(e, mesh.clusters)

    def fine(columns: Any) -> tuple[jax.Array, ...]:
        return clusters.smoothed(nodes, K.inverse, e.free.columns(columns))

    if K.vertices is None:
        return corrected(e.mesh, K.slow, _coarse_mask(e.free), fine)
    inverse, free = K.vertices, _of_vertices(e)

    def linear(columns: Any) -> tuple[jax.Array, ...]:
        return clusters.smoothed(vertices, inverse, free.columns(columns))

    level = corrected(e.mesh, K.slow, _coarse_mask(free), linear)

    def levels(columns: Any) -> tuple[jax.Array, ...]:
        columns = e.free.columns(columns)
        below = level([point_matrix.restricted(e.mesh, c) for c in columns])
        added = [point_matrix.prolonged(e.mesh, c) for c in below]
        return tuple(a + b for a, b in zip(fine(columns), added, strict=True))

    return levels


def _with_pressures(e: Equations, K: Tangent, motions: Callable) -> Callable[[jax.Array], jax.Array]:
    """Return the preconditioner as a function of flat vectors. If pressures are unknowns, the vectors contain them.
    `motions` is the preconditioner of the displacements, a function of columns (V,)."""
    if e.mixed is None:
        return lambda r: flat_free(e, motions(block_matrix.columns(r)))
    volume, n = e.mixed, 3 * e.mesh.number_of_nodes
    schur = volume.unit**2 * volume.schur(e.mesh)
    every = jnp.ones((e.mesh.number_of_vertices, 1), schur.dtype)
    slow = None if K.pressures is None else correction(e.mesh, K.pressures, every)

    def triangular(r: jax.Array) -> jax.Array:
        """Solve for the pressures first, then for the displacements that the remaining forces cause."""
        dp = -r[n:] / schur
        if slow is not None:
            dp = dp - slow((r[n:],))[0] / volume.unit**2
        pulled = mixed_system.pulled(e.mesh, K.matrix, volume.unit * dp)
        left = [f - p for f, p in zip(block_matrix.columns(r[:n]), pulled, strict=True)]
        return jnp.concatenate([flat_free(e, motions(left)), dp])

    return triangular


def flat_free(e: Equations, columns: Any) -> jax.Array:
    """Project columns (V,) onto the free directions, and return a flat vector (3 V,)."""
    if e.free.normals is None and not e.free.tied:
        return e.free.mask.T.ravel() * jnp.concatenate(columns)
    return jnp.concatenate(e.free.columns(columns))


def product(e: Equations, K: Tangent, exactly: bool = False) -> Callable[[jax.Array], jax.Array]:
    """Return the product with K, as a function of flat vectors (3 V,).

    If `exactly` is false, pressures that depend on the positions are computed approximately.
    """
    return in_directions_at(e, K.x, lambda e: _product(e, K, exactly))


def _product(e: Equations, K: Tangent, exactly: bool) -> Callable[[jax.Array], jax.Array]:
    A, volume, n = K.matrix, volume_with_pressures(e), 3 * e.mesh.number_of_nodes

    def apply(v: jax.Array) -> jax.Array:
        motion, balance = e.free.columns(block_matrix.columns(v[:n])), None
        if e.mixed is not None:
            force, balance = mixed_system.with_pressures(e.mesh, e.mixed, A, (motion, v[n:]))
        elif volume is not None:
            force, left = mixed_system.balances(e.mesh, A, motion)
            dP = mixed_system.pressure_change(e.mesh, volume.flow, A, left, exactly)
            force = block_matrix.sums(force, mixed_system.pulled(e.mesh, A, -dP))
        elif isinstance(A, BlockMatrix):
            force = block_matrix.product(A, motion)
        else:
            force = point_matrix.product(e.mesh, A, motion)
        force = with_nodal_products(e, K, motion, force)
        return flat_free(e, force) if balance is None else jnp.concatenate([flat_free(e, force), balance])

    return apply


def with_nodal_products(
    e: Equations, K: Tangent, motion: Sequence[jax.Array], force: Sequence[jax.Array]
) -> tuple[jax.Array, ...]:
    """Add to `force` the forces that `motion` causes in `K.attached` and in follower loads. All are columns (V,)."""
    for own in K.attached:
        force = block_matrix.sums(force, attached.product(own, motion))
    following = [a for a in e.nodal if not a.conservative]
    if following and K.x is not None and K.follows is not None:
        dx = jnp.stack(motion, axis=-1)
        for a in following:
            change = K.follows * a.product(e.mesh, K.x, K.s, dx)
            force = block_matrix.sums(force, change.T)
    return tuple(force)


def solve(
    e: Equations, K: Tangent, b: jax.Array, tolerance: Number, max_iterations: int
) -> tuple[jax.Array, jax.Array, jax.Array]:
    """Solve K dq = b. Return dq, the number of iterations (0: factorisation), and whether K seems positive definite."""
    if e.scene.solve.linear_solver == "direct":
        dq = factorised_solution(e, K, b)
        # With pressure unknowns the matrix always has negative eigenvalues.
        positive = jnp.vdot(dq, b) >= 0 if e.mixed is None else jnp.all(jnp.isfinite(dq))
        return dq, jnp.zeros((), jnp.int32), positive
    if K.eliminates is not None:
        return _one_of_both(e, K, K.eliminates, b, (tolerance, max_iterations))
    # With pressure unknowns the preconditioner is block-triangular, hence not symmetric.
    method = conjugate_gradients if e.conservative and e.mixed is None else stabilised_biconjugate_gradients
    dq, s = method(product(e, K), b, preconditioner(e, K), tolerance, max_iterations)
    return dq, s.iterations, s.positive


def _one_of_both(
    e: Equations, K: Tangent, flag: jax.Array, b: jax.Array, limits: tuple[Number, int]
) -> tuple[jax.Array, jax.Array, jax.Array]:
    """Solve K dq = b. Pressures are eliminated if `flag` is true. The unused solve has b = 0 and does no iterations."""
    n, A = 3 * e.mesh.number_of_nodes, K.matrix
    assert isinstance(A, PointMatrix)

    def forces(e: Equations, v: jax.Array) -> jax.Array:
        motion = e.free.columns(block_matrix.columns(v))
        force = mixed_system.without_pressures(e.mesh, e.mixed, A, motion)
        return flat_free(e, with_nodal_products(e, K, motion, force))

    def fine(e: Equations) -> Callable[[jax.Array], jax.Array]:
        motions = _motions(e, K)
        return lambda r: flat_free(e, motions(block_matrix.columns(r)))

    apply, smooth = in_directions_at(e, K.x, lambda e: partial(forces, e)), in_directions_at(e, K.x, fine)
    alone, s = conjugate_gradients(apply, jnp.where(flag, b[:n], 0.0), smooth, *limits)
    load = jnp.where(flag, 0.0, b)
    both, t = stabilised_biconjugate_gradients(product(e, K), load, preconditioner(e, K), *limits)
    dq = both + jnp.concatenate([alone, jnp.zeros_like(b[n:])])
    return dq, s.iterations + t.iterations, jnp.where(flag, s.positive, t.positive)


def factorised_solution(e: Equations, K: Tangent, b: jax.Array) -> jax.Array:
    """Solve K dq = b by a factorisation. If pressures are unknowns or depend on the positions, K couples them with the
    displacements. b may then also contain the right-hand sides of the pressure equations."""
    n, volume, nothing = 3 * e.mesh.number_of_nodes, volume_with_pressures(e), jnp.ones(0)
    # In the factorised matrix positive pressures push inwards, and the volume balance has a minus sign.
    unit = 1.0 if e.mixed is None else -e.mixed.unit
    free, load, balance = e.free.mask.T, b[:n].reshape(3, -1), b[n:] / unit
    if isinstance(K.matrix, PointMatrix):
        known = nothing if volume is None or volume.flow is None else volume.flow.mask
        x = direct.solve_points(e.mesh, K.matrix, (free, known), (load, balance), e.free.normals, K.attached)
    else:
        if volume is not None or e.mixed is not None:
            known = jnp.ones_like(free[:1]) if volume is None or volume.flow is None else volume.flow.mask[None]
            free = jnp.concatenate([free, known])
            load = jnp.concatenate([load, balance[None] if len(balance) else jnp.zeros_like(load[:1])])
        x = direct.solve(K.matrix, free, load, e.free.normals, K.attached).ravel()
    return jnp.concatenate([x[:n], x[n:] / unit])[: len(b)]
