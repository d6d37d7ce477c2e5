"""Reference methods: force and stiffness by automatic differentiation of the energy, and by standard finite elements.

These methods do not use the hand-derived formulas. They use only `law.strain_energy`, and they are not optimised for
speed.
"""

from typing import TYPE_CHECKING

import jax
import jax.numpy as jnp
import numpy as np

from liverjax.elements.mjed import sparse
from liverjax.laws.autodiff import derivative, first_piola, tangent
from liverjax.laws.base import Law
from liverjax.mesh.shape_functions import basis
from liverjax.mesh.tetrahedra import TetMesh

if TYPE_CHECKING:
    import scipy.sparse

__all__ = [
    "energy",
    "first_piola",
    "internal_force",
    "standard_internal_force",
    "standard_stiffness_matrix",
    "stiffness_matrix",
    "tangent",
]

# Voigt order xx, yy, zz, xy, yz, xz.
_VOIGT = ((0, 0), (1, 1), (2, 2), (0, 1), (1, 2), (0, 2))


def energy(mesh: TetMesh, law: Law, x: jax.Array) -> jax.Array:
    """Return the total strain energy [J] at positions x (V, 3) [m], computed from arrays of deformation gradients."""
    return jnp.sum(mesh.weights * mesh.at_points(law).energy(_gradient(mesh, x)))


@jax.jit
def internal_force(mesh: TetMesh, law: Law, x: jax.Array) -> jax.Array:
    """Return the gradient (V, 3) [N] of the energy with respect to the positions, by reverse-mode differentiation."""
    return jax.grad(energy, argnums=2)(mesh, law, x)


@jax.jit
def _hessians(mesh: TetMesh, law: Law, x: jax.Array) -> jax.Array:
    D = _all_shape_vectors(mesh)

    def total(nodes):
        return jnp.sum(mesh.weights * mesh.at_points(law).energy(jnp.einsum("eai,...eaj->...eij", nodes, D)))

    return derivative(jax.grad(total), _element_values(mesh, x))


def stiffness_matrix(mesh: TetMesh, law: Law, x: jax.Array) -> "scipy.sparse.csr_array":
    """Return the Hessian (3V, 3V) [N/m] of the energy, by forward-over-reverse differentiation of each element."""
    return sparse(mesh, np.asarray(_hessians(mesh, law, x)))


@jax.jit
def standard_internal_force(mesh: TetMesh, law: Law, x: jax.Array) -> jax.Array:
    """Return nodal forces (V, 3) [N] of standard finite elements: B^T S with S = 2 dW/dC (B: `_strain_displacement`).

    Elements must not be inverted, because S is computed from C.
    """
    F, law = _gradient(mesh, x), mesh.at_points(law)
    S = _second_piola(law, F)
    B = _strain_displacement(F, _all_shape_vectors(mesh))
    share = jnp.einsum("...e,...evad,...ev->...ead", mesh.weights, B, _voigt(S))
    element = share.reshape(-1, *share.shape[-3:]).sum(axis=0)
    return jnp.zeros_like(x).at[jnp.stack(mesh.element_nodes, axis=1)].add(_with_signs(mesh, element))


@jax.jit
def _standard_entries(mesh: TetMesh, law: Law, x: jax.Array) -> jax.Array:
    F, D, law = _gradient(mesh, x), _all_shape_vectors(mesh), mesh.at_points(law)
    C = jnp.einsum("...ki,...kj->...ij", F, F)
    elasticity = 2 * derivative(lambda C: _second_piola_of(law, C), C)
    elasticity = 0.5 * (elasticity + jnp.swapaxes(elasticity, -1, -2))
    rows = jnp.asarray(_VOIGT).T
    Dm = elasticity[..., rows[0], rows[1], :, :][..., rows[0], rows[1]]
    B = _strain_displacement(F, D)
    S = _second_piola(law, F)
    geometric = jnp.einsum("...eai,...eij,...ebj->...eab", D, S, D)
    material = jnp.einsum("...evai,...evw,...ewbj->...eaibj", B, Dm, B)
    whole = material + jnp.einsum("...eab,ij->...eaibj", geometric, jnp.eye(3))
    whole = mesh.weights[..., None, None, None, None] * whole
    return whole.reshape(-1, *whole.shape[-5:]).sum(axis=0)


def standard_stiffness_matrix(mesh: TetMesh, law: Law, x: jax.Array) -> "scipy.sparse.csr_array":
    """Return the stiffness (3V, 3V) [N/m] of standard finite elements: B^T D B plus the geometric stiffness.

    D contains the moduli dS/dE (Zienkiewicz and Taylor 2000). Elements must not be inverted.
    """
    return sparse(mesh, np.asarray(_standard_entries(mesh, law, x)))


def _all_shape_vectors(mesh: TetMesh) -> jax.Array:
    """Return shape function gradients: (E, 4, 3) for linear elements, otherwise (Q, E, n, 3): Q points, n nodes."""
    D = jnp.transpose(mesh.shape_vectors, (2, 0, 1))
    D = jnp.concatenate([-D.sum(axis=1, keepdims=True), D], axis=1)
    return D if mesh.order == 1 else jnp.einsum("akq,ekj->qeaj", jnp.asarray(basis(mesh.order).c, D.dtype), D)


def _gradient(mesh: TetMesh, x: jax.Array) -> jax.Array:
    return jnp.einsum("eai,...eaj->...eij", _element_values(mesh, x), _all_shape_vectors(mesh))


def _element_values(mesh: TetMesh, x: jax.Array) -> jax.Array:
    """Return the positions (E, n, 3) of the n nodes of every element, from the positions x (V, 3)."""
    return _with_signs(mesh, x[jnp.stack(mesh.element_nodes, axis=1)])


def _with_signs(mesh: TetMesh, values: jax.Array) -> jax.Array:
    """Multiply values (E, n, 3) of n functions by the signs of the functions in each element."""
    return jnp.transpose(mesh.oriented(jnp.transpose(values, (1, 2, 0))), (2, 0, 1))


def _energy_of_C(law: Law, C: jax.Array) -> jax.Array:
    """Return the energy W as a function of C. It is evaluated at F, the transposed Cholesky factor of C."""
    return law.energy(jnp.swapaxes(jnp.linalg.cholesky(0.5 * (C + jnp.swapaxes(C, -1, -2))), -1, -2))


def _second_piola(law: Law, F: jax.Array) -> jax.Array:
    return _second_piola_of(law, jnp.einsum("...ki,...kj->...ij", F, F))


def _second_piola_of(law: Law, C: jax.Array) -> jax.Array:
    return 2 * jax.grad(lambda C: jnp.sum(_energy_of_C(law, C)))(C)


def _voigt(S: jax.Array) -> jax.Array:
    return jnp.stack([S[..., i, j] for i, j in _VOIGT], axis=-1)


def _strain_displacement(F: jax.Array, D: jax.Array) -> jax.Array:
    """Return B (..., E, 6, n, 3): derivatives of Green's strain (shears doubled) with respect to n node positions."""
    rows = []
    for i, j in _VOIGT:
        term = jnp.einsum("...k,...a->...ak", F[..., :, i], D[..., :, j])
        rows.append(term if i == j else term + jnp.einsum("...k,...a->...ak", F[..., :, j], D[..., :, i]))
    return jnp.stack(rows, axis=-3)
