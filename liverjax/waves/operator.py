"""Dynamic stiffness of small harmonic motion, K(omega) - omega^2 M, stored as element matrices.

The body moves about positions x, where it has been at rest for a long time. Let S_h be the instantaneous elastic stress
of the relaxing part. At x this stress has relaxed to m_inf S_h, with m_inf = 1 - sum g_k and the ratios g_k of the
Prony series. A small motion adds m(omega) times the change of S_h, where m = G*/G0 is the complex modulus divided by
the instantaneous modulus. The tangent consists of a material and a geometric part (superposed small motion: Lockett
1972, Nonlinear Viscoelastic Solids, chapter 7). The stiffness is

    K(omega) = m(omega) (K_h - K_geometric) + m_inf K_geometric + K_rest,

with the tangent K_h of the elastic stress S_h and the geometric part K_geometric of K_h. K_rest is the stiffness that
does not relax: the stiffness of a porous body, supports, membranes and springs, and of the volumetric part of the law
if only the isochoric part relaxes. For unknown pressures, see `liverjax.waves.pressures`.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp

from liverjax.core.struct import Number
from liverjax.elements import mjed
from liverjax.laws.base import Law, volumetric_part
from liverjax.laws.terms import invariant_terms
from liverjax.mesh.nodal import element_density, nodal_volumes, products
from liverjax.mesh.shape_functions import basis
from liverjax.mesh.tetrahedra import TetMesh
from liverjax.physics import viscosity
from liverjax.physics.base import Free
from liverjax.scenes.scene import Scene
from liverjax.simulation.equations import Equations
from liverjax.simulation.tangent import node_blocks
from liverjax.solvers import attached
from liverjax.solvers.attached import Attached
from liverjax.solvers.block_matrix import Block
from liverjax.tensors.material_axes import symmetric
from liverjax.tensors.matrices import Matrix, Vector, add_matrices, deformation_gradient, dot, matvec, scale_matrix
from liverjax.waves.pressures import Pressures, law_beside, scalars_and_pressures

_OWN = tuple((a, b) for a in range(3) for b in range(a, 3))


class Operator(NamedTuple):
    """Matrices of the dynamic stiffness: of the E elements with n nodes each, and of the V nodes."""

    points: jax.Array  # (V, 3) [m] reference positions of the nodes
    nodes: jax.Array  # (n, E) node numbers of the elements
    relaxing: jax.Array  # (n, 3, n, 3, E) [N/m] stiffness that is multiplied by m(omega)
    rest: jax.Array | None  # (n, 3, n, 3, E) [N/m] stiffness that does not relax
    mass: jax.Array | None  # (n, n, E) [kg], the same for x, y and z; or lumped masses (V,)
    springs: Block | None  # stiffness of springs at the nodes: 3 x 3 entries (V,) [N/m]
    attached: tuple[Attached, ...]
    free: Free
    pressures: Pressures | None = None


def operator(e: Equations, x: jax.Array, loaded: bool, mass: str, stress: jax.Array | None = None) -> Operator:
    """Return the dynamic stiffness for small motion about positions x (V, 3) [m].

    Args:
        e: equations of the scene without its viscosity.
        x: positions (V, 3) [m].
        loaded: whether x differs from the reference shape. Then the stress at x changes the stiffness.
        mass: "consistent", or "lumped".
        stress: volumetric stress at the vertices (`liverjax.waves.pressures.AtRest`); None: it follows from x.
    """
    scene, mesh, F = e.scene, e.mesh, deformation_gradient(e.mesh, x)
    volume, pressures = scalars_and_pressures(scene, x, F, stress)
    relaxing, rest = _blocks(scene, law_beside(scene), F, loaded)
    if volume is not None:
        own = invariant_terms.blocks(invariant_terms.state_of(volume, F), _shape_vectors(mesh), _OWN)
        rest = own if rest is None else [add_matrices(a, b) for a, b in zip(rest, own, strict=True)]
    springs = node_blocks(e)
    more = tuple(own for own in (a.attached(mesh, x, 1.0) for a in e.nodal) if isinstance(own, Attached))
    nodes = jnp.stack(mesh.element_nodes)
    heavy = None if scene.body is None else _mass(mesh, jnp.asarray(scene.body.density), mass)
    whole = None if rest is None else _element_matrices(mesh, rest)
    return Operator(
        mesh.points, nodes, _element_matrices(mesh, relaxing), whole, heavy, springs, more, e.free, pressures
    )


def _shape_vectors(mesh: TetMesh) -> list[Vector]:
    return [tuple(mesh.gradients[a]) for a in range(3)]


def _blocks(scene: Scene, law: Law, F: Matrix, loaded: bool) -> tuple[list[Matrix], list[Matrix] | None]:
    """Return the 3 x 3 stiffness blocks, per unit volume, for the pairs `_OWN` of the corners 1, 2 and 3 of an element.

    The first list contains the relaxing part, which is multiplied by m(omega). The second list contains the part that
    does not relax. It is None if there is no such part.
    """
    mesh, prony, D = scene.mesh, scene.viscosity, _shape_vectors(scene.mesh)
    if prony is None:
        return invariant_terms.blocks(invariant_terms.state(law, F), D, _OWN), None
    own = viscosity.relaxing(prony, law)
    K, rest = invariant_terms.blocks(invariant_terms.state(own, F), D, _OWN), None
    if loaded:
        S = symmetric(tuple(viscosity.relaxing_stress(prony, law, F)))
        metric = [_times_identity(dot(D[i], matvec(S, D[j]))) for i, j in _OWN]
        K = [add_matrices(k, scale_matrix(-1.0, g)) for k, g in zip(K, metric, strict=True)]
        rest = [scale_matrix(viscosity.lasting(prony, mesh.order), g) for g in metric]
    volume = volumetric_part(law) if prony.part == "isochoric" else None
    if volume is not None:
        U = invariant_terms.blocks(invariant_terms.state(volume, F), D, _OWN)
        rest = U if rest is None else [add_matrices(a, b) for a, b in zip(rest, U, strict=True)]
    return K, rest


def _times_identity(value: jax.Array) -> Matrix:
    zero = jnp.zeros_like(value)
    return tuple(tuple(value if r == c else zero for c in range(3)) for r in range(3))


def _element_matrices(mesh: TetMesh, blocks: list[Matrix]) -> jax.Array:
    """Return stiffness matrices (n, 3, n, 3, E) [N/m] of elements with n nodes, from `_blocks` per unit volume."""
    weighted = {(a + 1, b + 1): scale_matrix(mesh.weights, K) for (a, b), K in zip(_OWN, blocks, strict=True)}
    corners = jnp.stack([jnp.stack([_stacked(K) for K in row]) for row in mjed.all_blocks(weighted)])
    if mesh.order == 1:
        return jnp.transpose(corners, (0, 2, 1, 3, 4))
    c = jnp.asarray(basis(mesh.order).c, corners.dtype)
    return _both_ways(mesh, jnp.einsum("akq,klrsqe,blq->arbse", c, corners, c, optimize=True))


def _both_ways(mesh: TetMesh, K: jax.Array) -> jax.Array:
    """Multiply the rows and columns of element matrices (n, …, n, …, E) by the signs of their n shape functions. Shape
    functions of order 3 have a direction along their edge, so their sign depends on the element."""
    if mesh.order < 3:
        return K
    n, E, half = len(K), K.shape[-1], K.ndim // 2
    rows = mesh.oriented(K.reshape(n, -1, E)).reshape(K.shape)
    turned = jnp.moveaxis(rows, range(half, 2 * half), range(half))
    return jnp.moveaxis(
        mesh.oriented(turned.reshape(n, -1, E)).reshape(turned.shape), range(half), range(half, 2 * half)
    )


def _stacked(K: Matrix) -> jax.Array:
    return jnp.stack([jnp.stack(row) for row in K])


def _mass(mesh: TetMesh, density: jax.Array, kind: str) -> jax.Array:
    if kind == "lumped":
        return density * nodal_volumes(mesh)
    own = density if density.ndim == 0 else element_density(mesh, density)
    M = jnp.asarray(products(mesh.order), mesh.points.dtype)[:, :, None] * (own * mesh.volumes)[None, None]
    return _both_ways(mesh, M)


#: Displacements (V, 3) [m], and pressures (P,) [Pa] or None.
Motion = tuple[jax.Array, jax.Array | None]


def forces_of_motion(A: Operator, factor: Number, omega: Number, motion: Motion) -> Motion:
    """Return the complex nodal forces (V, 3) [N] due to a motion, and the left-hand side (P,) [m^3] of the volume
    balance for P unknown pressures (see `liverjax.waves.pressures`). The left-hand side is None if no
    pressures are unknown.

    Args:
        A: `Operator`.
        factor: m(omega), one number or one per element (E,).
        omega: angular frequency [rad/s].
        motion: complex amplitudes of displacements [m] and pressures [Pa].
    """
    u, p = motion
    own = u[A.nodes]  # (n, E, 3)
    factor = jnp.asarray(factor)
    factor = factor[None, None] if factor.ndim else factor
    force = factor * jnp.einsum("arbse,bes->are", A.relaxing, own)
    if A.rest is not None:
        force = force + jnp.einsum("arbse,bes->are", A.rest, own)
    if A.mass is not None and A.mass.ndim == 3:
        force = force - omega**2 * jnp.einsum("abe,ber->are", A.mass, own)
    balance = None
    if A.pressures is not None and p is not None:
        near = p[A.pressures.nodes]
        force = force + jnp.einsum("arve,ve->are", A.pressures.pull, near)
        own_balance = jnp.einsum("arve,aer->ve", A.pressures.pull, own) - _stored(A.pressures, omega, near)
        balance = jnp.zeros_like(p).at[A.pressures.nodes].add(own_balance)
    total = jnp.zeros_like(u).at[A.nodes].add(jnp.swapaxes(force, 1, 2))
    return total + _of_nodes_alone(A, omega, u), balance


def _stored(own: Pressures, omega: Number, near: jax.Array) -> jax.Array:
    """Return the volumes (store + flow / (i omega)) p (4, E) [m^3] at the vertices of every element. `near` (4, E)
    [Pa]: pressures p."""
    stored = jnp.einsum("vwe,we->ve", own.store, near)
    return stored if own.flow is None else stored + jnp.einsum("vwe,we->ve", own.flow, near) / (1j * omega)


def _of_nodes_alone(A: Operator, omega: Number, u: jax.Array) -> jax.Array:
    """Return the nodal forces (V, 3) [N] of lumped masses, springs and attached elements for displacements u (V, 3)
    [m]."""
    total = jnp.zeros_like(u)
    if A.mass is not None and A.mass.ndim == 1:
        total = total - (omega**2 * A.mass)[:, None] * u
    if A.springs is not None:
        rows = [[jnp.zeros_like(u[:, c]) if K is None else K * u[:, c] for c, K in enumerate(row)] for row in A.springs]
        total = total + jnp.stack([row[0] + row[1] + row[2] for row in rows], axis=1)
    for K in A.attached:
        total = total + jnp.stack(attached.product(K, tuple(u.T)), axis=1)
    return total


def free_part(A: Operator, motion: Motion) -> Motion:
    """Return a motion, or forces, projected onto the free directions of the nodes and the unknown pressures."""
    u, p = motion
    return A.free.vectors(u), None if A.pressures is None or p is None else A.pressures.mask * p
