"""The torsion rig (rheometer with its sample) at small strain: stiffness, bias of the mesh, and moduli without a
simulation in time."""

from typing import NamedTuple

import jax
import jax.numpy as jnp

from fitting.rigs.plates import (
    Rig,
    coordinates,
    number_of_coordinates,
    packed,
    rest_height,
    sample_positions,
    work_conjugates,
)
from liverjax.core.errors import InputError
from liverjax.core.struct import Number, replace
from liverjax.elements import mjed
from liverjax.laws import Law, isochoric_part, volumetric_part
from liverjax.mesh.nodal import nodal_volumes
from liverjax.physics import viscosity
from liverjax.physics.viscosity import Prony
from liverjax.tensors.material_axes import symmetric
from liverjax.tensors.matrices import deformation_gradient, matmul


def rest_stiffness(rig: Rig, law: Law) -> jax.Array:
    """Return the elastic tangent stiffness at rest, a dense matrix (n, n) [N/m] for the n coordinates of the rig (see
    `plates`)."""
    mesh = rig.mesh
    V = mesh.points.shape[0]
    dofs = (3 * mesh.tetrahedra[:, :, None] + jnp.arange(3)[None, None]).reshape(-1, 12)
    entries = mjed.element_matrices(mesh, law, mesh.points).reshape(-1, 12, 12)
    dense = jnp.zeros((3 * V, 3 * V), mesh.points.dtype).at[dofs[:, :, None], dofs[:, None, :]].add(entries)
    first, n = 3 * rig.bottom, 3 * (V - rig.top)
    X = mesh.points[V - rig.top :]
    turn = jnp.stack([-X[:, 1], X[:, 0], jnp.zeros(rig.top)], axis=-1).ravel() / rig.radius
    columns = [turn]
    if rig.free_height:
        columns = [jnp.tile(jnp.array([0.0, 0.0, 1.0]), rig.top), turn]
    T = jnp.stack(columns, axis=-1)
    K_fp = dense[first:n, n:] @ T
    K_pp = T.T @ dense[n:, n:] @ T
    return jnp.block([[dense[first:n, first:n], K_fp], [K_fp.T, K_pp]])


class Response(NamedTuple):
    """Linear response of the rig (n coordinates) when the plate turns by a unit arc length (radius times angle). Values
    may be complex."""

    shape: jax.Array  # (n,) coordinates of the rig; the last entry is 1
    stiffness: jax.Array  # force per arc length [N/m]


def _response(column: jax.Array) -> Response:
    """Return the response to a unit displacement of the last coordinate. `column`: the coordinates (n,) under a unit
    force on the last coordinate."""
    return Response(column / column[-1], 1 / column[-1])


def exact_stiffness(rig: Rig, law: Law) -> Number:
    """Return the force per arc length [N/m] of the exact elastic cylinder, pi r^2 G / (2 h)."""
    return jnp.pi * rig.radius**2 * law.shear_modulus() / (2 * rig.height)


@jax.jit
def geometry_factor(rig: Rig, law: Law) -> jax.Array:
    """Return the elastic torsional stiffness of the mesh, divided by the exact value pi r^4 G / (2 h). This bias
    differs from 1 because the cross-section is a polygon and the elements are too stiff.

    Moduli that are divided by this factor have no bias in the linear range.

    Raises:
        InputError: the rig is compressed.
    """
    if rig.held is not None:
        raise InputError("the factor of a compressed rig is not known: use the rig without its compression")
    inverse = jnp.linalg.inv(rest_stiffness(rig, law))
    return _response(inverse[:, -1]).stiffness / exact_stiffness(rig, law)


class Vibrations(NamedTuple):
    """Vibration modes of the elastic rig: K v = value M v, with the stiffness K, the lumped masses M and vectors v of
    unit modal mass. The modes are treated as constant in derivatives."""

    values: jax.Array  # (n,) [1/s^2]
    vectors: jax.Array  # (n, n) [kg^-1/2]

    def solve(self, r: jax.Array, stiffness: Number, mass: Number) -> jax.Array:
        """Return x (n,) with (stiffness K + mass M) x = r."""
        return jnp.asarray(self.vectors @ ((self.vectors.T @ r) / (stiffness * self.values + mass)))


class Linearised(NamedTuple):
    """Matrices of the linearised rig with n coordinates. They are the same for all frequencies."""

    inverse: jax.Array  # (n, n) inverse of the stiffness before relaxation (for very fast motions)
    relaxing: jax.Array | None  # (n, n) [N/m] relaxing part of the stiffness; None: the whole stress relaxes
    standing: jax.Array | None  # (n, n) [N/m] part that does not relax; None: the whole stress relaxes
    held: "Held | None" = None  # the compressed sample; None: not compressed
    stands: Number = 1.0  # fraction of the stress that does not relax
    mass: jax.Array | None = None  # (n,) [kg] for each coordinate; None: no inertia
    elastic: jax.Array | None = None  # (n, n) [N/m] elastic stiffness; None: no inertia
    modes: Vibrations | None = None  # vibration modes; None: no inertia


def linearised_rig(rig: Rig, law: Law, prony: Prony | None) -> Linearised:
    """Return the stiffness of the rig and its inverse, which are the same for all frequencies. If the rig has a
    density, also return the masses and the vibration modes."""
    rest = _without_inertia(rig, law, prony)
    if rig.density is None:
        return rest
    mass = rest_masses(rig)
    if rest.relaxing is None or rest.standing is None:
        elastic = rest_stiffness(rig, law)
    else:
        elastic = rest.relaxing + rest.standing
    root = jax.lax.stop_gradient(jnp.sqrt(mass))
    values, vectors = jnp.linalg.eigh(jax.lax.stop_gradient(elastic) / root[:, None] / root[None])
    return rest._replace(mass=mass, elastic=elastic, modes=Vibrations(values, vectors / root[:, None]))


def rest_masses(rig: Rig) -> jax.Array:
    """Return the lumped masses (n,) [kg] of the rig's coordinates: of the free nodes, then of the plate's lift (if it
    is free), then of the plate's rotation."""
    assert rig.density is not None
    mass = rig.density * nodal_volumes(rig.mesh)
    plate, X = mass[-rig.top :], (rig.mesh.points if rig.held is None else rig.held)[-rig.top :]
    turn = jnp.sum(plate * (X[:, 0] ** 2 + X[:, 1] ** 2)) / rig.radius**2
    last = [jnp.sum(plate), turn] if rig.free_height else [turn]
    return jnp.concatenate([jnp.repeat(mass[rig.bottom : -rig.top], 3), jnp.stack(last)])


def _without_inertia(rig: Rig, law: Law, prony: Prony | None) -> Linearised:
    if rig.held is not None:
        of, stands = held(rig, law), 1.0 if prony is None else 1 - jnp.sum(jnp.asarray(prony.ratios))
        standing = stands * of.standing
        return Linearised(jnp.linalg.inv(of.relaxing + standing), of.relaxing, standing, of, stands)
    if prony is None or prony.part == "all":
        return Linearised(jnp.linalg.inv(rest_stiffness(rig, law)), None, None)
    isochoric, volumetric = (rest_stiffness(rig, part(law)) for part in (isochoric_part, volumetric_part))
    return Linearised(jnp.linalg.inv(isochoric + volumetric), isochoric, volumetric)


def about_held(rig: Rig, law: Law) -> tuple[jax.Array, jax.Array]:
    """Return two parts (n, n) [N/m] of the stiffness of a compressed sample. The first comes from changes of the
    stress, the second from the constant stress of the compression (geometric stiffness).

    A small motion only rotates a stress S that has been constant for a long time. The second part is computed with the
    value of S before relaxation.
    """
    mesh = rig.mesh
    rest = jnp.zeros(number_of_coordinates(rig), mesh.points.dtype)
    elastic = Prony(ratios=jnp.zeros(0), relaxation_times=jnp.zeros(0))

    def gradient(q):
        return deformation_gradient(mesh, sample_positions(rig, *coordinates(rig, q)))

    def stress(q):
        return viscosity.relaxing_stress(elastic, law, gradient(q))

    def forces(q, S):
        x = sample_positions(rig, *coordinates(rig, q))
        f = mjed.nodal_force(mesh, matmul(gradient(q), symmetric(tuple(S))))
        return packed(rig, *work_conjugates(rig, x, f))

    S = stress(rest)
    standing = jax.jacfwd(forces)(rest, S)
    return jax.jacfwd(lambda q: forces(q, stress(q)))(rest) - standing, standing


def steady_response(rest: Linearised, modulus: Number) -> Response:
    """Return the response in a steady cycle, if the relaxing stress is `modulus` (complex) times the elastic stress."""
    if rest.relaxing is None or rest.standing is None:
        elastic = _response(rest.inverse[:, -1])
        return Response(elastic.shape, elastic.stiffness * modulus)
    K = modulus * rest.relaxing + rest.standing
    return _response(jnp.linalg.solve(K, jnp.zeros(K.shape[0], K.dtype).at[-1].set(1.0)))


def torque_for_strain(rig: Rig, modulus: Number, strain: Number) -> Number:
    """Return the torque amplitude [N m] that gives about `strain` at the rim of a sample with the dynamic modulus |G*|
    = `modulus` [Pa]."""
    return jnp.pi * rig.radius**3 / 2 * modulus * strain


def linear_moduli(law: Law, prony: Prony, omega: jax.Array, steps: int | None) -> jax.Array:
    """Return the complex moduli (n,) [Pa] of the simulation at small strain. With `steps`, they contain the error of
    the recursion that updates the history variables in each time step. They are the limit of `torsion.moduli` for small
    strain.

    In this limit, the rig is linear, and dividing by the bias removes the error of the mesh. So the moduli depend
    neither on the mesh nor on the plates. Up to an error of the order of the strain, their derivatives with respect to
    the parameters equal the derivatives of `torsion.moduli`. So no derivatives of the simulation are needed. Inertia is
    not included.

    Args:
        law: the law; its shear modulus at rest is G0.
        prony: relaxation of the law.
        omega: angular frequencies (n,) [rad/s].
        steps: time steps per cycle; None: continuous time.
    """
    ratios = viscosity.complex_ratios(prony, omega, None if steps is None else 2 * jnp.pi / (omega * steps))
    return law.shear_modulus() * (1 - jnp.sum(ratios, axis=0))


class Held(NamedTuple):
    """Stiffness and mesh error of a compressed sample, which do not depend on its relaxation."""

    relaxing: jax.Array  # (n, n) [N/m], see `about_held`
    standing: jax.Array
    bias: jax.Array  # bias of the uncompressed mesh, see `geometry_factor`
    factors: jax.Array  # factors R and S (2,) [1] of this mesh, see `glued_compression`
    meshless: jax.Array | None  # R and S (2,) without mesh error; None: unknown

    def bias_at(self, modulus: Number, stands: Number) -> jax.Array:
        """Return the bias of the mesh. `modulus`: complex ratio of the relaxing stress to the elastic stress. `stands`:
        fraction of the stress that never relaxes."""
        if self.meshless is None:
            return self.bias + 0j
        own, true = (R * modulus + S * stands for R, S in (self.factors, self.meshless))
        return jnp.asarray(own / true)


def held(rig: Rig, law: Law) -> Held:
    """Return stiffness and mesh error of the compressed sample in a rig from `compression.compressed`."""
    relaxing, standing = about_held(rig, law)
    whole, part = (1 / jnp.linalg.inv(relaxing + s * standing)[-1, -1] for s in (1.0, 0.5))
    factors = jnp.stack([2 * part - whole, 2 * (whole - part)]) / exact_stiffness(rig, law)
    bias = geometry_factor(replace(rig, held=None, height=rest_height(rig)), law)
    return Held(relaxing, standing, bias, factors, rig.meshless)


def moving_response(rest: Linearised, modulus: Number, square: Number) -> Response:
    """Return the response in a steady cycle with inertia (without inertia: see `steady_response`). The relaxing stress
    is `modulus` (complex) times the elastic stress; accelerations are -`square` [1/s^2] times displacements."""
    assert rest.mass is not None and rest.elastic is not None and rest.modes is not None
    mass, modes, elastic = rest.mass, rest.modes, rest.elastic
    unit = jnp.zeros(len(mass), complex).at[-1].set(1.0)
    if rest.relaxing is not None and rest.standing is not None:
        K = modulus * rest.relaxing + rest.standing - square * jnp.diag(mass)
        return _response(jnp.linalg.solve(K, unit))

    def product(v: jax.Array) -> jax.Array:
        return jnp.asarray(modulus * (elastic @ v) - square * mass * v)

    def solved(_: object, r: jax.Array) -> jax.Array:
        return modes.solve(r, jax.lax.stop_gradient(modulus), -jax.lax.stop_gradient(square))

    column: jax.Array = jax.lax.custom_linear_solve(product, unit, solved, symmetric=True)
    return _response(column)


def held_moduli(of: Held, rig: Rig, prony: Prony, omega: jax.Array, steps: int | None) -> jax.Array:
    """Return the complex moduli (n,) [Pa] of the compressed sample `of` at small strain. They are computed on the mesh
    of the rig and divided by the bias of this mesh.

    Args:
        of, rig: the compressed sample and its rig.
        prony: relaxation of the law.
        omega: angular frequencies (n,) [rad/s].
        steps: time steps per cycle; None: continuous time.
    """
    ratios = viscosity.complex_ratios(prony, omega, None if steps is None else 2 * jnp.pi / (omega * steps))
    stands = 1 - jnp.sum(jnp.asarray(prony.ratios))
    parts = Linearised(of.relaxing, of.relaxing, stands * of.standing)

    def shown(modulus: jax.Array) -> jax.Array:
        return steady_response(parts, modulus).stiffness / of.bias_at(modulus, stands)

    return 2 * rig.height / (jnp.pi * rig.radius**2) * jax.lax.map(shown, 1 - jnp.sum(ratios, axis=0))
