"""The fluid of a reduced model with a porous body. The pressure is a sum of a few modes, and Darcy's law gives the
coordinates of the modes.

The pressure is P = sum_k p_k psi_k, with modes psi_k and coordinates p_k. The discrete equation of the full model
(`liverjax.physics.porosity`) is projected onto the same modes. Its integrals are sums over the weighted points of the
reduced model:

    A p = S p_before - c,    A = S + dt D,    c_k = sum_p w_p psi_k (J - J_before),
    S_kl = sum_p w_p J_before / K_lim sum_a N_a psi_ka psi_la,
    D_kl = sum_p w_p kappa / J_before (cof F_before grad psi_k) . (cof F_before grad psi_l),

with the change of volume c, the time step dt, the weight w_p of a point, the volume ratio J and the deformation
gradient F at the end of the step. Values with the index `before` belong to the beginning of the step. K_lim is the bulk
modulus of the storage, kappa the permeability, and N_a the shape function of vertex a. Storage is lumped at the
vertices, as in the full model. In the lagged scheme, c is the change of volume in the previous step. Since A is
positive definite, p can be eliminated. The forces on the body after this elimination are conservative. With all modes
and all points, these are the equations of the full model.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp

from liverjax.core.struct import Number, replace
from liverjax.laws.terms import invariant_terms
from liverjax.laws.terms.invariant_terms import Scalars
from liverjax.mesh.nodal import integrals
from liverjax.mesh.shape_functions import basis
from liverjax.physics import darcy
from liverjax.physics.porosity import Porosity, volumetric_slope, volumetric_stress
from liverjax.reduced.model import ReducedModel, as_matrix
from liverjax.scenes.by_element import porosity_of_elements
from liverjax.scenes.regions import POROUS
from liverjax.scenes.scene import Scene
from liverjax.tensors.matrices import IDENTITY, Matrix, cofactor, determinant, matvec
from liverjax.tensors.places import given


class ReducedFluid(NamedTuple):
    """State of the fluid at the end of a step, from which the next step starts (m pressure modes, S points)."""

    pressure: jax.Array  # coordinates p (m,) [Pa m^1.5]
    F: jax.Array  # deformation gradients (9, S)
    J_before: jax.Array | None  # volume ratios one step earlier (S,), only for the lagged scheme


class Lumped(NamedTuple):
    """Data for lumped storage: the fluid volume of each point is assigned to the vertices of the point's element."""

    vertices: jax.Array  # vertices of each point's element (4, S)
    parts: jax.Array  # fraction of a point's volume at each vertex (4, S) [1]


class ReducedSponge(NamedTuple):
    """Data of the porous body that are the same in all steps."""

    porosity: Porosity  # parameters have one value per point
    lumped: Lumped | None  # None if the mesh has more than 4 vertices per point (the points then store the fluid)


class Flowing(NamedTuple):
    """Data of the fluid that are constant during a step (m pressure modes, S points; A and S: module docstring)."""

    porosity: Porosity  # parameters have one value per point
    inverse: jax.Array  # inverse of A (m, m) [Pa]
    stored: jax.Array  # (m,) [m^1.5] S p_before; in the lagged scheme S p_before - c, with the last change of volume c
    averages: jax.Array  # modes at the points, times weights of the points (S, m) [m^1.5]
    J: jax.Array  # volume ratios at the beginning of the step (S,)


def reduced_sponge(model: ReducedModel, scene: Scene) -> ReducedSponge:
    """Return the data of the porous body that are the same in all steps. The storage is a sum over vertices, or over
    points if a sum over points has fewer terms."""
    porosity, mesh = porosity_at_points(model, scene), scene.mesh
    if mesh.number_of_vertices > 4 * len(model.points):
        return ReducedSponge(porosity, None)
    E = mesh.number_of_elements
    of_point = jnp.full((4, 1), 0.25) if mesh.order == 1 else jnp.asarray(basis(mesh.order).L)
    parts = of_point[:, model.points // E].astype(model.weights.dtype)
    return ReducedSponge(porosity, Lumped(mesh.tetrahedra[model.points % E].T, parts))


def porosity_at_points(model: ReducedModel, scene: Scene) -> Porosity:
    """Return the porosity. Parameters with one value per element get one value for each of the S points (S,)."""
    assert scene.porosity is not None
    own = porosity_of_elements(scene.porosity, scene.region, scene.mesh)
    elements = model.points % scene.mesh.number_of_elements
    whole = {name: jnp.asarray(getattr(own, name)) for name in POROUS}
    numbers: dict = {name: a.ravel()[elements] if a.ndim else a for name, a in whole.items()}
    return replace(own, **numbers)


def fluid_at_rest(model: ReducedModel, scene: Scene) -> ReducedFluid:
    """Return the state of the fluid at the beginning, for the initial pressure and the undeformed body."""
    modes, porosity, S = model.pressures, scene.porosity, model.weights.shape[0]
    assert modes is not None and porosity is not None
    volumes = integrals(scene.mesh, jnp.ones_like(scene.mesh.weights))
    start = 0.0 if porosity.initial_pressure is None else porosity.initial_pressure
    rest = jnp.tile(jnp.eye(3).reshape(9, 1), S).astype(model.slopes.dtype)
    J = jnp.ones(S, rest.dtype) if porosity.scheme == "lagged" else None
    return ReducedFluid(modes.modes @ (start * volumes), rest, J)


def flowing(model: ReducedModel, sponge: ReducedSponge, memory: ReducedFluid, dt: Number) -> Flowing:
    """Return the data of the fluid for a step of length dt [s]. `memory`: state of the fluid at the beginning of the
    step."""
    assert model.pressures is not None
    porosity, lumped, J = sponge.porosity, sponge.lumped, determinant(as_matrix(memory.F))
    stores, slopes = storage_and_flow(model, porosity, memory.F)
    store = _products(stores, stores) if lumped is None else _stored_at_vertices(model, sponge, J)
    flow = _products(jnp.broadcast_to(dt * porosity.permeability, J.shape)[None, None] * slopes, slopes)
    averages, stored = model.weights[:, None] * model.pressures.values, store @ memory.pressure
    if memory.J_before is not None:
        stored = stored - (J - memory.J_before) @ averages
    return Flowing(porosity, jnp.linalg.inv(store + flow), stored, averages, J)


def storage_and_flow(model: ReducedModel, porosity: Porosity, F: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Return vectors (m, 4, S) [Pa^-0.5] and (m, 3, S) [1/m] for m pressure modes and S points. The scalar products of
    the first vectors are the matrix S (module docstring), for a step that begins with the deformation gradients F
    (9, S). The scalar products of the second vectors, with the factor kappa at each point, are the matrix D."""
    modes, w = model.pressures, model.weights
    assert modes is not None
    matrix = as_matrix(F)
    volume = w * jnp.maximum(determinant(matrix), darcy.LEAST_J)
    # In the current shape, grad psi = cof(F) G / J with the reference gradient G, and the volume is J w (`darcy.flow`).
    # The square root does not contain kappa, because the derivative of a square root is infinite at 0.
    root = jnp.sqrt(w**2 / volume)
    scaled = tuple(tuple((root * entry)[None] for entry in row) for row in cofactor(matrix))
    g = matvec(scaled, tuple(jnp.moveaxis(modes.slopes, 1, 0)))
    return jnp.sqrt(volume / porosity.limit_bulk)[None, None] * modes.parts, jnp.stack(g, axis=1)


def _stored_at_vertices(model: ReducedModel, sponge: ReducedSponge, J: jax.Array) -> jax.Array:
    """Return the storage matrix (m, m) [1/Pa] of m pressure modes as a sum over vertices. `J` (S,): volume ratios at
    the S points."""
    modes, lumped = model.pressures, sponge.lumped
    assert modes is not None and lumped is not None
    capacity = model.weights * jnp.maximum(J, darcy.LEAST_J) / sponge.porosity.limit_bulk
    of_vertices = given(jnp.zeros(modes.modes.shape[1], J.dtype), lumped.vertices, lumped.parts * capacity[None])
    return (modes.modes * of_vertices[None]) @ modes.modes.T


def _products(a: jax.Array, b: jax.Array) -> jax.Array:
    """Return the scalar products (m, m) of m vectors in `a` and m vectors in `b`. Each vector is an array (k, S)."""
    return a.reshape(a.shape[0], -1) @ b.reshape(b.shape[0], -1).T


def pressure_coordinates(own: Flowing, J: jax.Array) -> jax.Array:
    """Return the coordinates p (m,) [Pa m^1.5] of m pressure modes at the end of a step, for the volume ratios J (S,)
    at the S points at this time."""
    if own.porosity.scheme == "lagged":
        return own.inverse @ own.stored
    return own.inverse @ (own.stored - (J - own.J) @ own.averages)


def volume_stress(model: ReducedModel, porosity: Porosity, p: jax.Array, F: jax.Array) -> jax.Array:
    """Return the volumetric part (sigma_Heq(J) - P) cof F (9, S) [Pa] of the first Piola-Kirchhoff stress at S points.

    sigma_Heq is the volumetric stress of the drained body. `p` (m,) [Pa m^1.5]: coordinates of the pressure P in m
    modes; `F` (9, S): deformation gradients.
    """
    matrix = as_matrix(F)
    stress = _scalars(model, porosity, p, matrix).first["J"]
    return jnp.stack([stress * entry for row in cofactor(matrix) for entry in row])


def _scalars(model: ReducedModel, porosity: Porosity, p: jax.Array, F: Matrix) -> Scalars:
    assert model.pressures is not None
    J = determinant(F)
    stress = volumetric_stress(porosity, J) - model.pressures.values @ p
    return Scalars({"J": stress}, {("J", "J"): volumetric_slope(porosity, J)})


def volume_blocks(model: ReducedModel, own: Flowing, F: Matrix, pairs: tuple[tuple[int, int], ...]) -> list[Matrix]:
    """Return the derivative of `volume_stress` with respect to F at constant pressures, as one 3 x 3 block for each
    pair of axes in `pairs`.

    The blocks are computed by `invariant_terms.blocks`, the function for the stiffness between nodes. Here its
    arguments are unit vectors instead of the gradients of shape functions.
    """
    scalars = _scalars(model, own.porosity, pressure_coordinates(own, determinant(F)), F)
    return invariant_terms.blocks(invariant_terms.state_of(scalars, F), list(IDENTITY), pairs)


def stiffness_of_pressures(model: ReducedModel, own: Flowing, F: Matrix) -> jax.Array:
    """Return the stiffness (n, n) [N m^-4] due to the pressures, which change with the n reduced coordinates of the
    motion."""
    n = model.number_of_modes
    if own.porosity.scheme == "lagged":
        return jnp.zeros((n, n), model.slopes.dtype)
    cof = jnp.stack([entry for row in cofactor(F) for entry in row])
    change = own.averages.T @ jnp.sum(cof[..., None] * model.slopes, axis=0)
    return change.T @ own.inverse @ change


def advanced_fluid(own: Flowing, F: jax.Array) -> ReducedFluid:
    """Return the state of the fluid at the end of a step. `F` (9, S): deformation gradients at this time."""
    lagged = own.porosity.scheme == "lagged"
    return ReducedFluid(pressure_coordinates(own, determinant(as_matrix(F))), F, own.J if lagged else None)
