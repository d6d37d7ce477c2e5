"""Unknown pressures at the vertices in harmonic motion: pressures of a flowing fluid, or of a nearly incompressible
material.

The unknowns are the displacements u and the pressures p. Both cases lead to a symmetric system,

    K u + B p = f,    B^T u - (store + flow / (i omega)) p = -enters / (i omega),

with the dynamic stiffness K, the nodal forces B p of the pressures, the forces f, the matrices `store` and `flow` of
storage and flow, and the inflow `enters`.

In a porous body (`liverjax.physics.porosity`), B^T u is minus the change of the volumes at the vertices. The second
equation is then Darcy's law divided by i omega. The law is (1/K_lim) i omega p = kappa lap p - i omega (dJ/J), with the
Laplacian lap p of the pressure, the volume ratio J, the bulk modulus K_lim of the storage and the permeability kappa.
Volumes refer to the state about which the body moves. With averaged or mixed volumes (`liverjax.physics.volumes`),
p is positive in tension and B^T u is the change of the volumes. Nothing flows, and `store` is the volumetric
compliance.
"""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from liverjax.elements.gradients import volume_gradients
from liverjax.laws.base import isochoric_part
from liverjax.laws.terms.invariant_terms import Scalars
from liverjax.mesh.nodal import integrals, summed
from liverjax.mesh.shape_functions import basis
from liverjax.mesh.tetrahedra import TetMesh
from liverjax.physics.base import Free, Step
from liverjax.physics.darcy import LEAST_J, unknown_pressures
from liverjax.physics.porosity import Porosity, inflow, law_in_force, volumetric_slope, volumetric_stress
from liverjax.physics.volumes.averaged import Averaged, nodal_energy
from liverjax.physics.volumes.mixed import Mixed, MixedVolume, strain
from liverjax.scenes.scene import Scene
from liverjax.tensors.matrices import Matrix, deformation_gradient, determinant, dot, scale


class Pressures(NamedTuple):
    """Matrices of the E elements with n nodes each (symbols: module docstring), and given values of the P pressures."""

    nodes: jax.Array  # (4, E) vertices of the elements
    pull: jax.Array  # (n, 3, 4, E) [m^2]: B
    store: jax.Array  # (4, 4, E) [m^3/Pa]
    flow: jax.Array | None  # (4, 4, E) [m^3/(Pa s)]; None if nothing flows
    mask: jax.Array  # (P,) 0 where the pressure is given, 1 elsewhere
    given: jax.Array  # (P,) [Pa] given amplitudes, 0 elsewhere
    enters: jax.Array | None  # (P,) [m^3/s] amplitude of the inflow; None without inflow


class AtRest(NamedTuple):
    """Positions at rest with the volumetric stress of mixed elements.

    Only linear elements have a stabilisation term, so other elements have another stress at the same positions.
    """

    positions: jax.Array  # (V, 3) [m]
    stress: jax.Array  # (P,) [Pa] derivative of the energy with respect to the volumetric strain, at the vertices


def mixed_at_rest(scene: Scene, x: jax.Array) -> jax.Array:
    """Return the volumetric stress `AtRest.stress` of a scene without regions at positions x (V, 3) [m]."""
    J = determinant(deformation_gradient(scene.mesh, x))
    volume = _mixed_volume(scene, x, J)
    return volume.settled(scene.mesh, J) + _beside_pressures(scene.mesh, volume, J)


def law_beside(scene: Scene) -> Any:
    """Return the law without its volumetric energy if unknown pressures or the porous body replace this energy;
    otherwise return the law."""
    if scene.solve.volumetric in ("nodal", "mixed"):
        return isochoric_part(scene.law)
    return law_in_force(scene.porosity, scene.law)


def scalars_and_pressures(
    scene: Scene, x: jax.Array, F: Matrix, stress: jax.Array | None
) -> tuple[Scalars | None, Pressures | None]:
    """Return the volumetric stress and its derivative with respect to the volume ratio J at given pressures, and
    `Pressures`.

    Both are computed at positions x (V, 3) [m], with the volumetric stress `AtRest.stress` if it is given. Both are
    None if the scene has no unknown pressures.
    """
    mesh, J = scene.mesh, determinant(F)
    if scene.porosity is not None:
        own = scene.porosity
        # After a long time at rest, the fluid has flowed until its pressure is 0.
        found = Scalars({"J": volumetric_stress(own, J)}, {("J", "J"): volumetric_slope(own, J)})
        return found, _of_sponge(own, mesh, F)
    if scene.solve.volumetric == "mixed":
        return _of_mixed(scene, x, F, stress)
    if scene.solve.volumetric == "nodal":
        return _of_averaged(scene, F)
    return None, None


def _of_sponge(porosity: Porosity, mesh: TetMesh, F: Matrix) -> Pressures:
    J, g = jnp.maximum(determinant(F), LEAST_J), volume_gradients(mesh, F)
    mask = unknown_pressures(porosity, mesh, J.dtype)
    pressures, enters = inflow(porosity, mesh, 0.0, 1.0)
    weight = porosity.permeability * mesh.weights / J
    flow = jnp.stack([jnp.stack([summed(mesh, weight * dot(a, b)) for b in g]) for a in g])
    store = _lumped(mesh, J / porosity.limit_bulk)
    pulled = _pull(mesh, [scale(-1.0, own) for own in g])
    flux = any(inlet.flux is not None for inlet in porosity.inlet)
    return Pressures(mesh.tetrahedra.T, pulled, store, flow, mask, pressures, enters if flux else None)


def _of_mixed(scene: Scene, x: jax.Array, F: Matrix, stress: jax.Array | None) -> tuple[Scalars, Pressures]:
    mesh, J = scene.mesh, determinant(F)
    volume = _mixed_volume(scene, x, J)
    pressure = volume.settled(mesh, J) if stress is None else stress - _beside_pressures(mesh, volume, J)
    border = volume.border(J)
    store = _compliance(mesh, volume)
    pull = _pull(mesh, [scale(border, g) for g in volume_gradients(mesh, F)])
    return volume.scalars(mesh, pressure, F), _sealed(mesh, pull, store)


def _mixed_volume(scene: Scene, x: jax.Array, J: jax.Array) -> Mixed:
    none = jnp.zeros(scene.mesh.number_of_vertices, J.dtype)
    step = Step(scene.mesh, x, 1, 1, None, False, None, Free(jnp.ones_like(x)))
    return MixedVolume(law=scene.law).freeze(none, step)


def _beside_pressures(mesh: TetMesh, volume: Mixed, J: jax.Array) -> jax.Array:
    """Return the volumetric stress that the pressures do not contain, as means (P,) [Pa] around the vertices."""
    return integrals(mesh, jnp.asarray(volume.part) * strain(volume.kind, J)) / integrals(mesh, jnp.ones_like(J))


def _compliance(mesh: TetMesh, volume: Mixed) -> jax.Array:
    """Return the matrix of the volumetric compliance of every element (4, 4, E) [m^3/Pa] (see `Mixed.compliance`)."""
    if mesh.order > 1:
        L = jnp.asarray(basis(mesh.order).L, mesh.volumes.dtype)
        return jnp.einsum("aq,bq,qe->abe", L, L, mesh.weights / volume.rest, optimize=True)
    one, every = jnp.eye(4)[:, :, None], jnp.ones((4, 4, 1))
    soft, held = (jnp.broadcast_to(mesh.volumes / (20 * a), mesh.volumes.shape) for a in (volume.rest, volume.shear))
    return (every + one) * soft[None, None] + (one - every / 4) * held[None, None]


def _of_averaged(scene: Scene, F: Matrix) -> tuple[Scalars, Pressures]:
    mesh, J = scene.mesh, determinant(F)
    volume = Averaged(law=nodal_energy(mesh, scene.law))
    volumes = integrals(mesh, jnp.ones_like(J))
    compliance = volume.matrix(mesh, J, False).diagonal[0][0] / volumes
    share = (mesh.volumes / 4)[None] * compliance[mesh.tetrahedra.T]
    store = jnp.eye(4)[:, :, None] * share[None]
    found = volume.scalars(mesh, volume.pressure(mesh, J), F)
    return found, _sealed(mesh, _pull(mesh, volume_gradients(mesh, F)), store)


def _sealed(mesh: TetMesh, pull: jax.Array, store: jax.Array) -> Pressures:
    P = mesh.number_of_vertices
    return Pressures(mesh.tetrahedra.T, pull, store, None, jnp.ones(P, pull.dtype), jnp.zeros(P, pull.dtype), None)


def _lumped(mesh: TetMesh, density: jax.Array) -> jax.Array:
    """Return diagonal element matrices (4, 4, E): integrals of a quantity per volume times the linear shape function of
    each vertex. `density`: values of this quantity at the integration points."""
    if mesh.order == 1:
        share = jnp.broadcast_to(mesh.volumes * density / 4, (4, mesh.number_of_elements))
    else:
        share = jnp.asarray(basis(mesh.order).L, density.dtype) @ (mesh.weights * density)
    return jnp.eye(4)[:, :, None] * share[None]


def _pull(mesh: TetMesh, g: list) -> jax.Array:
    """Return the forces (n, 3, 4, E) [m^2] on the n nodes of each element due to unit pressures at its four vertices.
    `g`: derivatives of the volume ratio with respect to the positions of the four corners."""
    own = mesh.weights[None, None] * jnp.stack([jnp.stack(vector) for vector in g])  # (4, 3, E), or (4, 3, Q, E)
    if mesh.order == 1:
        return jnp.broadcast_to(own[:, :, None] / 4, (4, 3, 4, mesh.number_of_elements))
    N = basis(mesh.order)
    pull = jnp.einsum("akq,krqe,vq->arve", N.c, own, N.L, optimize=True)
    return mesh.oriented(pull.reshape(len(N.c), 12, -1)).reshape(pull.shape)
