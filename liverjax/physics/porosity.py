"""A porous body: Kerdok-Hencky volumetric stress and Darcy flow, in addition to the law (book chapter, section 4.3).

    sigma_p = sigma_Heq(J) - P,   (1/K_lim) dP/dt = kappa lap P - (dJ/dt)/J

sigma_p is the volumetric stress, J the volume ratio, P the pressure of the fluid at the nodes, kappa the permeability,
lap the Laplacian, and 1/K_lim the fluid volume stored per volume of the body and per pressure. The Kerdok-Hencky stress
is sigma_Heq = K0 r_w ln((r_w + J - 1)/r_w), with the drained bulk modulus K0 and the fluid fraction r_w. Below J0 = 1 -
r_w + r_w K0/K_lim this stress is replaced by its tangent line at J0, which has the slope K_lim. (The chapter prints J0
without the factor r_w. Without this factor, the slope would be r_w K_lim.) The pressure equation uses the volumes at
the beginning of a step, so that it is linear in P. There are two schemes:

* "implicit": P at the end of the step follows from the volume change of the same step. P is a function of the positions
  x and is eliminated. The equations for x are symmetric, and stable for any time step. Newton's direction is computed
  with the coupled matrix of x and P.
* "lagged": P follows from the volume change of the previous step, as in the chapter. This scheme is only conditionally
  stable. Its old name "chapter" is also accepted.
"""

from typing import Any, ClassVar, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from liverjax.core import bounds, history
from liverjax.core.errors import InputError
from liverjax.core.struct import Indices, Number, Numbers, param, static, struct
from liverjax.laws.base import Law, Volumetric, isochoric_part
from liverjax.laws.terms.invariant_terms import Scalars
from liverjax.mesh.nodal import integrals, interpolated
from liverjax.mesh.surface import areas
from liverjax.mesh.tetrahedra import TetMesh
from liverjax.physics import darcy
from liverjax.physics.base import End, Physics, Start, Step, VolumeStress
from liverjax.physics.darcy import Flow
from liverjax.solvers.block_matrix import BlockMatrix
from liverjax.tensors.matrices import Matrix, cofactor, deformation_gradient, determinant

SCHEMES = ("implicit", "lagged")


@struct
class Inlet:
    """A set of nodes with a given pressure of the fluid, or a part of the surface with a given flux."""

    nodes: Indices | None = param("1", "numbers (n,) of the nodes with the given pressure", lower=0, default=None)
    pressure: Number | None = param("Pa", "pressure of the fluid at the nodes", default=None)
    triangles: Any = param("1", "node numbers (m, 3) of the triangles with the given flux", lower=0, default=None)
    flux: Number | None = param("m/s", "volume that enters per reference area and time", default=None)
    times: Numbers | None = param("s", "times of a history (T,)", default=None)
    history: Numbers | None = param("1", "factors (T,) that multiply pressure or flux", default=None)

    def at(self, value: object, time: Number) -> jax.Array:
        """Return the given pressure [Pa] or flux [m/s] of this inlet at a time [s].

        `value` is the pressure or flux before it is multiplied by the factor of the history.
        """
        return history.value_at(value, time, self.times, self.history)


@struct
class Porosity(Physics):
    """A porous body with the drained bulk modulus K0. A fluid fills the fraction r_w of its volume."""

    bulk: Number = param("Pa", "K0, bulk modulus of the drained body at small strain", above=0.0)
    limit_bulk: Number = param("Pa", "K_lim, bulk modulus of the compressed body and of fluid storage", above=0.0)
    fluid_fraction: Number = param("1", "r_w", above=0.0, upper=1.0)
    permeability: Number = param("m^4/(N s)", "kappa", lower=0.0)
    drained: Indices | None = param(
        "1", "numbers (n,) of the nodes where P = 0; None: no fluid leaves", lower=0, default=None
    )
    inlet: tuple[Inlet, ...] = param("1", "given pressures and fluxes", default=())
    initial_pressure: Number | None = param("Pa", "pressure of the fluid at the beginning; None: 0", default=None)
    scheme: str = static(default="implicit", about="implicit, or lagged as in the chapter", words=SCHEMES)
    keep_bulk: bool = static(
        default=False, about="keep the law's volumetric energy in addition to that of the porous body"
    )

    def __post_init__(self) -> None:
        """Replace the old name "chapter" of a scheme by its new name "lagged"."""
        if self.scheme == "chapter":
            object.__setattr__(self, "scheme", "lagged")

    def begin(self, start: Start) -> "Fluid":
        """Return the state of the fluid at the beginning of a run: the initial pressure and the reference volumes."""
        return initial_fluid(self, start.mesh)

    def freeze(self, memory: "Fluid", step: Step) -> "Sponge":
        """Return the force term, with the assembled pressure equation of the step.

        In the lagged scheme, this equation does not depend on the end of the step, so it is solved here.
        """
        # In a static run the first positions are only a guess, so the first step begins at the reference shape.
        x = step.x if step.inertia else jnp.where(step.k == 1, step.mesh.points, step.x)
        F = deformation_gradient(step.mesh, x)
        J = determinant(F)  # at the beginning of a run, `memory.J` is 1 even if x is not the reference shape
        found = darcy.flow(self, step.mesh, J, F, step.dt, 1e-2 * step.tolerance)
        if self.inlet:
            given, enters = inflow(self, step.mesh, step.k * step.dt, step.dt)
            found = found._replace(given=given, enters=enters)
        if self.scheme == "implicit":
            return CoupledSponge(porosity=self, fluid=memory, flow=found)
        return LaggedSponge(porosity=self, fluid=memory, given=pressure(self, step.mesh, memory, found, J))

    def advance(self, memory: "Fluid", acting: "Sponge", end: End) -> "Fluid":
        """Return the state of the fluid at the end of the step: pressures and volume ratios."""
        return Fluid(end.pressure, determinant(end.F), memory.J if self.scheme == "lagged" else None)

    def bulk_modulus(self) -> Number:
        """Return the bulk modulus [Pa] of the drained body."""
        return self.bulk

    def output(self, memory: "Fluid") -> dict[str, jax.Array]:
        """Return the pressure (V,) [Pa] of the fluid, under the name `pressure`."""
        return {"pressure": memory.pressure}


class Fluid(NamedTuple):
    """Internal variables of the fluid: pressure and volume ratios at the end of a step."""

    pressure: jax.Array  # P at the vertices (V,) [Pa]
    J: jax.Array  # volume ratios (E,), or (Q, E) at Q points of each element
    J_before: jax.Array | None  # J at the end of the previous step; only for the lagged scheme


def check_porosity(porosity: Porosity) -> None:
    """Check that the values of a porous body and its inlets can be used in a step.

    Raises:
        InputError: the scheme is unknown, a value is out of bounds, K_lim is not above K0, or an inlet is incomplete.
    """
    check_sponge(porosity)
    check_inlets(porosity)


def check_inlets(porosity: Porosity) -> None:
    """Check that every inlet is complete. Values are not checked.

    Raises:
        InputError: an inlet does not have exactly one of two pairs (pressure and nodes, or flux and triangles), or its
            times and history do not match.
    """
    for k, inlet in enumerate(porosity.inlet):
        name = f"porosity.inlet.{k}"
        history.check_times(inlet.times, inlet.history, name, (1,))
        if (inlet.pressure is None) == (inlet.flux is None):
            raise InputError(f"{name} needs either pressure in Pa or flux in m/s: give one of them")
        if (inlet.nodes is None) != (inlet.pressure is None) or (inlet.triangles is None) != (inlet.flux is None):
            raise InputError(f"{name} needs nodes for a pressure, or triangles for a flux: give nodes or triangles")


def check_sponge(porosity: Porosity) -> None:
    """Check the parameters of the porous body. Parameters inside jit, grad or vmap are not checked.

    Raises:
        InputError: a value is out of bounds, or K_lim is not above K0.
    """
    bounds.check_fields(porosity, "porosity")
    check_limit(porosity)


def check_limit(porosity: Porosity) -> None:
    """Check that the porous body stiffens under compression. Parameters inside jit, grad or vmap are not checked.

    Raises:
        InputError: K_lim is not above K0.
    """
    if any(isinstance(number, jax.core.Tracer) for number in (porosity.bulk, porosity.limit_bulk)):
        return
    bulk, limit = np.broadcast_arrays(np.asarray(porosity.bulk, float), np.asarray(porosity.limit_bulk, float))
    if np.any(limit <= bulk):
        k = int(np.argmax(limit - bulk <= 0))
        raise InputError(
            f"porosity limit_bulk = {limit.flat[k]:g} must be above bulk = {bulk.flat[k]:g}: give a larger limit_bulk"
        )


def law_in_force(porosity: Porosity | None, law: Law) -> Law:
    """Return the law that acts in addition to the stress of the porous body (`porosity`, or None).

    The volumetric energy U(J) of the law is removed. Otherwise the body would have two bulk moduli. If `keep_bulk` is
    true, U(J) is not removed. A law that does not separate volume change from shear is not changed.
    """
    if porosity is None or porosity.keep_bulk:
        return law
    return law.each(lambda own: own.without_volume() or Volumetric(bulk=0.0))


def bulk_in_force(porosity: Porosity, law: Law) -> str:
    """Return a sentence for the report: the bulk modulus in use, and the parts of the law that are not used.

    Both arguments may contain one value per element (`liverjax.scenes.by_element`).
    """
    low, high = float(np.min(np.asarray(porosity.bulk))), float(np.max(np.asarray(porosity.bulk)))
    size = f"{low:g} Pa" if low == high else f"{low:g} to {high:g} Pa (it differs between regions)"
    sponge = f"the bulk modulus in use is the modulus {size} of the porous body"
    if porosity.keep_bulk:
        return f"{sponge}, plus the bulk modulus of the law (keep_bulk)"
    parts = [part for own in law.pieces() for part in own.summands()]
    whole = [part for part in parts if isochoric_part(part) is None and part.without_volume() is not None]
    if not whole:
        return f"{sponge}; the volumetric energy of the law is not used"
    names = " and ".join(dict.fromkeys(type(getattr(part, "law", part)).__name__ for part in whole))
    changed = any(part.without_volume() is not part for part in parts)
    off = "; the separate volumetric energy is not used" if changed else ""
    return f"{sponge}, plus the part of {names} that is not separate from shear{off}"


def _fluid_ratio(porosity: Porosity, J: Number) -> jax.Array:
    """Return u = (r_w + J - 1)/r_w, or the value K0/K_lim of u at J0 if this value is larger.

    In single precision, J0 may round to 1 - r_w. Without the bound K0/K_lim, u would then be 0, and ln u infinite.
    """
    return jnp.maximum(1 + (J - 1) / porosity.fluid_fraction, porosity.bulk / porosity.limit_bulk)


def volumetric_stress(porosity: Porosity, J: Number) -> Number:
    """Return the stress sigma_Heq(J) [Pa]: Hencky's logarithm above J0, and its tangent line below J0.

    This stress is finite for every volume ratio J. J0 is defined in the docstring of the module.
    """
    K0, K_lim, r_w = porosity.bulk, porosity.limit_bulk, porosity.fluid_fraction
    J0 = 1 - r_w + r_w * K0 / K_lim
    u = _fluid_ratio(porosity, J)
    near_1 = jnp.log1p(jnp.maximum((J - 1) / r_w, jnp.maximum(K0 / K_lim, 0.5) - 1))  # constant for J < J0
    logarithm = jnp.where(u > 0.5, near_1, jnp.log(u))
    return K0 * r_w * logarithm + K_lim * jnp.minimum(J - J0, 0.0)


def volumetric_slope(porosity: Porosity, J: Number) -> jax.Array:
    """Return the derivative d sigma_Heq / dJ [Pa] of the volumetric stress with respect to the volume ratio J."""
    K0, K_lim, r_w = porosity.bulk, porosity.limit_bulk, porosity.fluid_fraction
    J0 = 1 - r_w + r_w * K0 / K_lim
    return jnp.where(J > J0, K0 / _fluid_ratio(porosity, J), K_lim)


def volumetric_energy(porosity: Porosity, J: Number) -> Number:
    """Return the volumetric energy density [Pa]: the integral of sigma_Heq from 1 to J.

    Above J0, this energy is K0 r_w^2 (u ln u - u + 1) with u = (r_w + J - 1)/r_w. Below J0, it is a parabola.
    The other symbols are defined in the docstring of the module.
    """
    K0, K_lim, r_w = porosity.bulk, porosity.limit_bulk, porosity.fluid_fraction
    J0 = 1 - r_w + r_w * K0 / K_lim
    u = _fluid_ratio(porosity, J)
    below = jnp.minimum(J - J0, 0.0)
    at_J0 = K0 * r_w * jnp.log(K0 / K_lim)  # the stress
    return K0 * r_w**2 * (u * jnp.log(u) - u + 1) + below * (at_J0 + 0.5 * K_lim * below)


def initial_fluid(porosity: Porosity, mesh: TetMesh) -> Fluid:
    """Return the state of the fluid with the initial pressure (0 if None) and the reference volumes."""
    J = jnp.ones_like(mesh.weights)
    start = 0.0 if porosity.initial_pressure is None else porosity.initial_pressure
    return Fluid(jnp.full(mesh.number_of_vertices, start, J.dtype), J, J if porosity.scheme == "lagged" else None)


def _volume_per_area(inlet: Inlet, time: Number, dt: Number) -> Number:
    """Return the volume [m] that enters per reference area through an inlet with a flux, in a step (see `inflow`)."""
    assert inlet.flux is not None
    if inlet.history is None or inlet.times is None:
        return dt * inlet.flux
    return history.integral_of(inlet.flux, time - dt, dt, inlet.times, inlet.history)


def inflow(porosity: Porosity, mesh: TetMesh, time: Number, dt: Number) -> tuple[jax.Array, jax.Array]:
    """Return the given pressures (V,) [Pa] and the inflow (V,) [m^3] of a step, for `darcy.Flow`.

    The step has the length dt [s] and ends at `time` [s]. The pressures are those at the end of the step. The inflow is
    the time integral of the flux over the step.
    """
    given = enters = jnp.zeros(mesh.number_of_vertices, mesh.points.dtype)
    for inlet in porosity.inlet:
        if inlet.nodes is not None:
            given = given.at[inlet.nodes].set(inlet.at(inlet.pressure, time), mode="drop")
        else:
            normal = areas(mesh.points, inlet.triangles)
            volume = _volume_per_area(inlet, time, dt) * jnp.sqrt(jnp.sum(normal * normal, axis=1)) / 3
            for a in range(3):
                enters = enters.at[inlet.triangles[:, a]].add(volume)
    return given, enters


def pressure(
    porosity: Porosity, mesh: TetMesh, fluid: Fluid, flow: Flow, J_end: jax.Array, guess: darcy.Guess | None = None
) -> jax.Array:
    """Return the pressures P (V,) [Pa] at the end of a step.

    `fluid` is the state of the fluid at the beginning of the step, and J_end (E,) are the volume ratios at its end.
    """
    before: Any = fluid.J_before
    increment = fluid.J - before if porosity.scheme == "lagged" else J_end - fluid.J
    b = flow.store * fluid.pressure - integrals(mesh, increment)
    return darcy.with_given(mesh, flow, b, guess)


def fluid_energy(porosity: Porosity, mesh: TetMesh, fluid: Fluid, flow: Flow, J_end: jax.Array) -> jax.Array:
    """Return the energy b . P / 2 [J] of the fluid. P = A^-1 b are the pressures at the end of a step.

    A P = b is the pressure equation (`liverjax.physics.darcy`). J_end (E,) are the volume ratios at the end of the
    step. If pressures or fluxes are given, terms are added such that the gradient of the energy with respect to b is P.
    """
    b = flow.store * fluid.pressure - integrals(mesh, J_end - fluid.J)
    P = pressure(porosity, mesh, fluid, flow, J_end)
    if flow.given is None:
        return 0.5 * jnp.vdot(flow.mask * b, P)
    return 0.5 * jnp.vdot(darcy.right_side(flow, b), P) + jnp.vdot(flow.given, b)


def first_piola(porosity: Porosity, mesh: TetMesh, P: jax.Array, F: Matrix) -> Matrix:
    """Return the first Piola-Kirchhoff stress (sigma_Heq(J) - P) cof F [Pa]. P is linear in every element."""
    sigma = volumetric_stress(porosity, determinant(F)) - interpolated(mesh, P)
    return tuple(tuple(sigma * c for c in row) for row in cofactor(F))


class Sponge(VolumeStress):
    """Force term of the porous body and its fluid, for one step."""

    porosity: Porosity
    fluid: Fluid

    def stress(self, mesh: TetMesh, pressure: jax.Array, F: Matrix) -> Matrix:
        """Return the first Piola-Kirchhoff stress [Pa] from the function `first_piola`."""
        return first_piola(self.porosity, mesh, pressure, F)

    def scalars(self, mesh: TetMesh, pressure: jax.Array, F: Matrix) -> Scalars:
        """Return the volumetric stress sigma_Heq(J) - P [Pa] and its derivative with respect to J, at given P."""
        J = determinant(F)
        stress = volumetric_stress(self.porosity, J) - interpolated(mesh, pressure)
        return Scalars({"J": stress}, {("J", "J"): volumetric_slope(self.porosity, J)})


@struct
class CoupledSponge(Sponge):
    """Force term of the implicit scheme: the pressure depends on the positions at the end of the step."""

    porosity: Porosity = param("1", "its numbers")
    fluid: Fluid = param("1", "state of the fluid at the beginning of the step")
    flow: Flow = param("1", "pressure equation of the step")

    def pressure(self, mesh: TetMesh, J: jax.Array, guess: darcy.Guess | None = None) -> jax.Array:
        """Return the pressures (V,) [Pa] at the end of the step, from the volume change of this step."""
        return pressure(self.porosity, mesh, self.fluid, self.flow, J, guess)

    def in_force(self, pressure: jax.Array) -> jax.Array:
        """Return the pressures (V,) [Pa], with the given values at nodes where the pressure is given."""
        free = self.flow.mask * pressure
        return free if self.flow.given is None else free + self.flow.given

    def balance(self, mesh: TetMesh, pressure: jax.Array, J: jax.Array) -> jax.Array:
        """Return the residual (V,) [m^3] of the pressure equation. It is 0 at a solution.

        At nodes with a given pressure, the residual is the given pressure minus `pressure`.
        """
        b = self.flow.store * self.fluid.pressure - integrals(mesh, J - self.fluid.J)
        return darcy.lack(self.flow, b, pressure)

    def matrix(self, mesh: TetMesh, J: jax.Array, positive: bool) -> BlockMatrix:
        """Return the matrix [m^3/Pa] of storage and flow, which is positive definite."""
        return self.flow.matrix

    def energy(self, mesh: TetMesh, J: jax.Array) -> jax.Array:
        """Return the energy [J] of the porous body plus that of its fluid (function `fluid_energy`)."""
        density = volumetric_energy(self.porosity, J)
        return jnp.sum(mesh.weights * density) + fluid_energy(self.porosity, mesh, self.fluid, self.flow, J)


@struct
class LaggedSponge(Sponge):
    """Force term of the lagged scheme: the pressure is known at the beginning of the step."""

    coupled: ClassVar[bool] = False
    porosity: Porosity = param("1", "its numbers")
    fluid: Fluid = param("1", "state of the fluid at the beginning of the step")
    given: jax.Array = param("Pa", "the pressure (V,)")

    def pressure(self, mesh: TetMesh, J: jax.Array, guess: darcy.Guess | None = None) -> jax.Array:
        """Return the known pressures (V,) [Pa]. They do not depend on the end of the step."""
        return self.given

    def energy(self, mesh: TetMesh, J: jax.Array) -> jax.Array:
        """Return the energy [J] of the porous body, minus the work of the known fluid pressure."""
        density = volumetric_energy(self.porosity, J)
        return jnp.sum(mesh.weights * (density - interpolated(mesh, self.given) * J))
