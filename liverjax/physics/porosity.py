"""A porous body: Kerdok-Hencky volumetric stress and Darcy flow, in parallel to the law (book chapter, section 4.3).

    sigma_p = sigma_Heq(J) - P,   (1/K_lim) dP/dt = kappa lap P - (dJ/dt)/J

sigma_p is the volumetric stress, J the volume ratio, P the pressure of the fluid at the nodes, kappa the permeability,
and lap the Laplacian. The Kerdok-Hencky stress is sigma_Heq = K0 r_w ln((r_w + J - 1)/r_w), with the drained bulk
modulus K0 and the fluid fraction r_w. Below J0 = 1 - r_w + r_w K0/K_lim it is replaced by its tangent line at J0, which
has the slope K_lim. (The chapter prints J0 without the factor r_w. The slope would then be r_w K_lim.) The pressure
equation uses the volumes at the beginning of a step, so that it is linear in P. There are two schemes:

* "implicit": P at the end of the step follows from the volume change of the same step. P is a function of the positions
  x and is eliminated. The problem in x is symmetric, and stable for any time step. Newton's direction comes from the
  coupled matrix of (x, P).
* "lagged": P follows from the volume change of the previous step, as in the chapter. This scheme is conditionally
  stable. The old name "chapter" is accepted.
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

    nodes: Indices | None = param("1", "nodes with the given pressure (n,)", lower=0, default=None)
    pressure: Number | None = param("Pa", "of the fluid at the nodes", default=None)
    triangles: Any = param("1", "triangles with the given flux, node numbers (m, 3)", lower=0, default=None)
    flux: Number | None = param("m/s", "volume that enters per reference area and time", default=None)
    times: Numbers | None = param("s", "times of a history (T,)", default=None)
    history: Numbers | None = param("1", "factors (T,) that multiply pressure or flux", default=None)

    def at(self, value: object, time: Number) -> jax.Array:
        """Given pressure [Pa] or flux [m/s] of this inlet at a time [s]; `value` is its constant value."""
        return history.value_at(value, time, self.times, self.history)


@struct
class Porosity(Physics):
    """A porous body with the drained bulk modulus K0. A fluid fills the fraction r_w of its volume."""

    bulk: Number = param("Pa", "K0, bulk modulus of the drained body at small strain", above=0.0)
    limit_bulk: Number = param("Pa", "K_lim, bulk modulus of the compressed body and of fluid storage", above=0.0)
    fluid_fraction: Number = param("1", "r_w", above=0.0, upper=1.0)
    permeability: Number = param("m^4/(N s)", "kappa", lower=0.0)
    drained: Indices | None = param("1", "nodes where P = 0 (n,); None: sealed", lower=0, default=None)
    inlet: tuple[Inlet, ...] = param("1", "given pressures and fluxes", default=())
    initial_pressure: Number | None = param("Pa", "pressure of the fluid at the beginning; None: 0", default=None)
    scheme: str = static(default="implicit", about="implicit, or lagged as in the chapter", words=SCHEMES)
    keep_bulk: bool = static(
        default=False, about="keep the law's volumetric energy in addition to that of the porous body"
    )

    def __post_init__(self) -> None:
        """Replace the old name of a scheme by the new one."""
        if self.scheme == "chapter":
            object.__setattr__(self, "scheme", "lagged")

    def begin(self, start: Start) -> "Fluid":
        """State of the fluid at the beginning of a run: the initial pressure and the reference volumes."""
        return initial_fluid(self, start.mesh)

    def freeze(self, memory: "Fluid", step: Step) -> "Sponge":
        """Return the force term, with the assembled pressure equation of the step.

        The lagged scheme solves this equation here, because in this scheme it does not depend on the step's end.
        """
        F = deformation_gradient(step.mesh, step.x)
        found = darcy.flow(self, step.mesh, memory.J, F, step.dt, 1e-2 * step.tolerance)
        if self.inlet:
            given, enters = inflow(self, step.mesh, step.k * step.dt, step.dt)
            found = found._replace(given=given, enters=enters)
        if self.scheme == "implicit":
            return CoupledSponge(porosity=self, fluid=memory, flow=found)
        return LaggedSponge(porosity=self, fluid=memory, given=pressure(self, step.mesh, memory, found, determinant(F)))

    def advance(self, memory: "Fluid", acting: "Sponge", end: End) -> "Fluid":
        """Pressure and volumes at the end of the step."""
        return Fluid(end.pressure, determinant(end.F), memory.J if self.scheme == "lagged" else None)

    def bulk_modulus(self) -> Number:
        """Bulk modulus [Pa] of the drained body."""
        return self.bulk

    def output(self, memory: "Fluid") -> dict[str, jax.Array]:
        """Pressure (V,) [Pa] of the fluid, under the name `pressure`."""
        return {"pressure": memory.pressure}


class Fluid(NamedTuple):
    """Internal variables of the fluid: pressure and volume ratios at the end of a step."""

    pressure: jax.Array  # P at the vertices (V,) [Pa]
    J: jax.Array  # volume ratios at every integration point
    J_before: jax.Array | None  # J one step earlier; only for the lagged scheme


def check_porosity(porosity: Porosity) -> None:
    """Check that a step can use the values of a porous body.

    Raises:
        InputError: unknown scheme, values out of bounds, K_lim not above K0, an inlet with an incomplete condition.
    """
    check_sponge(porosity)
    for k, inlet in enumerate(porosity.inlet):
        name = f"porosity.inlet.{k}"
        history.check_times(inlet.times, inlet.history, name, (1,))
        if (inlet.pressure is None) == (inlet.flux is None):
            raise InputError(f"{name} needs either pressure in Pa or flux in m/s: give one of them")
        if (inlet.nodes is None) != (inlet.pressure is None) or (inlet.triangles is None) != (inlet.flux is None):
            raise InputError(f"{name} needs nodes for a pressure, or triangles for a flux: give them")


def check_sponge(porosity: Porosity) -> None:
    """Check the parameters of the porous body. Parameters inside jit, grad or vmap are not checked.

    Raises:
        InputError: values out of bounds, K_lim not above K0.
    """
    bounds.check_fields(porosity, "porosity")
    check_limit(porosity)


def check_limit(porosity: Porosity) -> None:
    """Check that the porous body stiffens under compression. Parameters inside jit, grad or vmap are not checked.

    Raises:
        InputError: K_lim not above K0.
    """
    if any(isinstance(number, jax.core.Tracer) for number in (porosity.bulk, porosity.limit_bulk)):
        return
    bulk, limit = np.broadcast_arrays(np.asarray(porosity.bulk, float), np.asarray(porosity.limit_bulk, float))
    if np.any(limit <= bulk):
        k = int(np.argmax(limit - bulk <= 0))
        raise InputError(
            f"porosity limit_bulk = {limit.flat[k]:g} must be above bulk = {bulk.flat[k]:g}: a porous body stiffens"
        )


def law_in_force(porosity: Porosity | None, law: Law) -> Law:
    """Return the law that acts in parallel to the porous body.

    The volumetric energy U(J) of the law is removed, since the bulk modulus would count twice. If `keep_bulk` is true,
    this energy stays. A law that does not separate volume change from shear is not changed.
    """
    if porosity is None or porosity.keep_bulk:
        return law
    return law.each(lambda own: own.without_volume() or Volumetric(bulk=0.0))


def bulk_in_force(porosity: Porosity, law: Law) -> str:
    """Return a sentence for the report: the bulk modulus in use, and the parts of the law that are not used."""
    sponge = f"bulk modulus in use: that of the porous body, {float(porosity.bulk):g} Pa"
    if porosity.keep_bulk:
        return f"{sponge}, plus that of the law (keep_bulk)"
    parts = [part for own in law.pieces() for part in own.summands()]
    whole = [part for part in parts if isochoric_part(part) is None and part.without_volume() is not None]
    if not whole:
        return f"{sponge}; the volumetric energy of the law is not used"
    names = " and ".join(dict.fromkeys(type(getattr(part, "law", part)).__name__ for part in whole))
    changed = any(part.without_volume() is not part for part in parts)
    off = "; the separate volumetric energy is not used" if changed else ""
    return f"{sponge}, plus the part of {names} that is not separate from shear{off}"


def volumetric_stress(porosity: Porosity, J: Number) -> Number:
    """Stress sigma_Heq(J) [Pa]: Hencky's logarithm above J0, its tangent line below J0. It is finite for every J."""
    K0, K_lim, r_w = porosity.bulk, porosity.limit_bulk, porosity.fluid_fraction
    J0 = 1 - r_w + r_w * K0 / K_lim
    logarithm = K0 * r_w * jnp.log1p((jnp.maximum(J, J0) - 1) / r_w)
    return logarithm + K_lim * jnp.minimum(J - J0, 0.0)


def volumetric_slope(porosity: Porosity, J: Number) -> jax.Array:
    """Derivative d sigma_Heq / dJ [Pa]."""
    K0, K_lim, r_w = porosity.bulk, porosity.limit_bulk, porosity.fluid_fraction
    J0 = 1 - r_w + r_w * K0 / K_lim
    return jnp.where(J > J0, K0 / (1 + (jnp.maximum(J, J0) - 1) / r_w), K_lim)


def volumetric_energy(porosity: Porosity, J: Number) -> Number:
    """Volumetric energy density [Pa]: the integral of sigma_Heq from 1 to J.

    This energy is K0 r_w^2 (u ln u - u + 1) with u = (r_w + J - 1)/r_w, and a parabola below J0.
    """
    K0, K_lim, r_w = porosity.bulk, porosity.limit_bulk, porosity.fluid_fraction
    J0 = 1 - r_w + r_w * K0 / K_lim
    u = 1 + (jnp.maximum(J, J0) - 1) / r_w
    below = jnp.minimum(J - J0, 0.0)
    return K0 * r_w**2 * (u * jnp.log(u) - u + 1) + below * (volumetric_stress(porosity, J0) + 0.5 * K_lim * below)


def initial_fluid(porosity: Porosity, mesh: TetMesh) -> Fluid:
    """State of the fluid with the initial pressure (0 if None) and the reference volumes."""
    J = jnp.ones_like(mesh.weights)
    start = 0.0 if porosity.initial_pressure is None else porosity.initial_pressure
    return Fluid(jnp.full(mesh.number_of_vertices, start, J.dtype), J, J if porosity.scheme == "lagged" else None)


def inflow(porosity: Porosity, mesh: TetMesh, time: Number, dt: Number) -> tuple[jax.Array, jax.Array]:
    """Given pressures (V,) [Pa] at a time [s], and the inflow (V,) [m^3] during dt, for `darcy.Flow`."""
    given = enters = jnp.zeros(mesh.number_of_vertices, mesh.points.dtype)
    for inlet in porosity.inlet:
        if inlet.nodes is not None:
            given = given.at[inlet.nodes].set(inlet.at(inlet.pressure, time), mode="drop")
        else:
            normal = areas(mesh.points, inlet.triangles)
            volume = dt * inlet.at(inlet.flux, time) * jnp.sqrt(jnp.sum(normal * normal, axis=1)) / 3
            for a in range(3):
                enters = enters.at[inlet.triangles[:, a]].add(volume)
    return given, enters


def pressure(
    porosity: Porosity, mesh: TetMesh, fluid: Fluid, flow: Flow, J_end: jax.Array, guess: darcy.Guess | None = None
) -> jax.Array:
    """Pressures P (V,) [Pa] at the end of a step, for the volume ratios J_end (E,) there."""
    before: Any = fluid.J_before
    increment = fluid.J - before if porosity.scheme == "lagged" else J_end - fluid.J
    b = flow.store * fluid.pressure - integrals(mesh, increment)
    return darcy.with_given(mesh, flow, b, guess)


def fluid_energy(porosity: Porosity, mesh: TetMesh, fluid: Fluid, flow: Flow, J_end: jax.Array) -> jax.Array:
    """Energy b . P / 2 [J] of the fluid, with the pressures P = A^-1 b at the end of a step.

    J_end (E,) are the volume ratios at the end of the step.
    """
    b = flow.store * fluid.pressure - integrals(mesh, J_end - fluid.J)
    P = pressure(porosity, mesh, fluid, flow, J_end)
    if flow.given is None:
        return 0.5 * jnp.vdot(flow.mask * b, P)
    return 0.5 * jnp.vdot(darcy.right_side(flow, b), P) + jnp.vdot(flow.given, b)


def first_piola(porosity: Porosity, mesh: TetMesh, P: jax.Array, F: Matrix) -> Matrix:
    """First Piola-Kirchhoff stress (sigma_Heq(J) - P) cof F [Pa], with the pressure P linear in every element."""
    sigma = volumetric_stress(porosity, determinant(F)) - interpolated(mesh, P)
    return tuple(tuple(sigma * c for c in row) for row in cofactor(F))


class Sponge(VolumeStress):
    """Force term of the porous body and its fluid, for one step."""

    porosity: Porosity
    fluid: Fluid

    def stress(self, mesh: TetMesh, pressure: jax.Array, F: Matrix) -> Matrix:
        """First Piola-Kirchhoff stress [Pa], computed by `first_piola`."""
        return first_piola(self.porosity, mesh, pressure, F)

    def scalars(self, mesh: TetMesh, pressure: jax.Array, F: Matrix) -> Scalars:
        """Volumetric stress sigma_Heq(J) - P [Pa], and its derivative with respect to J at given pressure P."""
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
        """Pressures (V,) [Pa] at the end of the step, from the volume change of this step."""
        return pressure(self.porosity, mesh, self.fluid, self.flow, J, guess)

    def in_force(self, pressure: jax.Array) -> jax.Array:
        """Pressures (V,) [Pa], with the given values at nodes where a pressure is given."""
        free = self.flow.mask * pressure
        return free if self.flow.given is None else free + self.flow.given

    def balance(self, mesh: TetMesh, pressure: jax.Array, J: jax.Array) -> jax.Array:
        """Residual (V,) [m^3] of the pressure equation; 0 at a solution.

        At nodes with a given pressure, it is the given pressure minus `pressure`.
        """
        b = self.flow.store * self.fluid.pressure - integrals(mesh, J - self.fluid.J)
        return darcy.lack(self.flow, b, pressure)

    def matrix(self, mesh: TetMesh, J: jax.Array, positive: bool) -> BlockMatrix:
        """Matrix [m^3/Pa] of storage and flow; it is positive definite."""
        return self.flow.matrix

    def energy(self, mesh: TetMesh, J: jax.Array) -> jax.Array:
        """Energy [J] of the porous body and of the fluid that leaves it."""
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
        """Known pressures (V,) [Pa], which do not depend on the end of the step."""
        return self.given

    def energy(self, mesh: TetMesh, J: jax.Array) -> jax.Array:
        """Energy [J] of the porous body, minus the work of the known fluid pressure."""
        density = volumetric_energy(self.porosity, J)
        return jnp.sum(mesh.weights * (density - interpolated(mesh, self.given) * J))
