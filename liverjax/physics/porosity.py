"""A sponge in parallel to the law: Kerdok-Hencky volumetric stress and Darcy diffusion (book chapter, section 4.3).

    sigma_p = sigma_Heq(J) - P,   (1/K_lim) dP/dt = kappa lap P - (dJ/dt)/J

The fluid has a pressure P at the nodes. sigma_Heq = K0 r_w ln((r_w + J - 1)/r_w). Below J0 = 1 - r_w + r_w K0/K_lim it
is the tangent line at J0, of slope K_lim. (The chapter prints J0 without the factor r_w: then the slope would be r_w
K_lim.) The pressure equation uses the volumes at the beginning of a step, so that it is linear in P. There are two
schemes:

* "implicit": P at the end of the step follows from the volume change of the same step. P = P(x) is eliminated. The
  problem in x is symmetric, and it is stable for any step. Newton's direction comes from the coupled matrix of (x, P).
* "lagged": P follows from the volume change of the previous step, as in the chapter. It is conditionally stable. The
  old name "chapter" is accepted.
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
    """A place with a given pressure of the fluid, or a part of the surface with a given flux."""

    nodes: Indices | None = param("1", "nodes with the given pressure (n,)", lower=0, default=None)
    pressure: Number | None = param("Pa", "of the fluid at the nodes", default=None)
    triangles: Any = param("1", "triangles with the given flux, node numbers (m, 3)", lower=0, default=None)
    flux: Number | None = param("m/s", "volume that enters per reference area and time", default=None)
    times: Numbers | None = param("s", "times of a history (T,)", default=None)
    history: Numbers | None = param("1", "factors of pressure or flux (T,)", default=None)

    def at(self, value: object, time: Number) -> jax.Array:
        """Pressure or flux at a time [s]."""
        return history.value_at(value, time, self.times, self.history)


@struct
class Porosity(Physics):
    """A sponge of bulk modulus K0, filled with a fluid. The fluid fills the fraction r_w of its volume."""

    bulk: Number = param("Pa", "K0, bulk modulus of the drained sponge at rest", above=0.0)
    limit_bulk: Number = param("Pa", "K_lim, bulk modulus of the compressed sponge and for the pressure", above=0.0)
    fluid_fraction: Number = param("1", "r_w", above=0.0, upper=1.0)
    permeability: Number = param("m^4/(N s)", "kappa", lower=0.0)
    drained: Indices | None = param("1", "nodes where P = 0 (n,); None: sealed", lower=0, default=None)
    inlet: tuple[Inlet, ...] = param("1", "given pressures and fluxes", default=())
    initial_pressure: Number | None = param("Pa", "of the fluid at the beginning; None: 0", default=None)
    scheme: str = static(default="implicit", about="implicit or lagged (the chapter's)", words=SCHEMES)
    keep_bulk: bool = static(default=False, about="keep the law's volumetric energy in addition to the sponge")

    def __post_init__(self) -> None:
        """Replace the old name of a scheme by the new one."""
        if self.scheme == "chapter":
            object.__setattr__(self, "scheme", "lagged")

    def begin(self, start: Start) -> "Fluid":
        """The fluid at the beginning of a run: the initial pressure and the reference volumes."""
        return initial_fluid(self, start.mesh)

    def freeze(self, memory: "Fluid", step: Step) -> "Sponge":
        """Make the pressure equation. It is solved here if it does not depend on the end of the step."""
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
        """Bulk modulus of the drained sponge."""
        return self.bulk

    def output(self, memory: "Fluid") -> dict[str, jax.Array]:
        """The fluid's pressure (V,) [Pa], by its name."""
        return {"pressure": memory.pressure}


class Fluid(NamedTuple):
    """Pressure and volume ratios at the end of a step: the memory of the fluid."""

    pressure: jax.Array  # P of the vertices (V,) [Pa]
    J: jax.Array  # volume ratios at every integration point
    J_before: jax.Array | None  # J one step earlier; only for the lagged scheme


def check_porosity(porosity: Porosity) -> None:
    """Refuse values that no step can use; host side.

    Raises:
        InputError: unknown scheme, values out of bounds, K_lim not above K0, an inlet without a complete condition.
    """
    check_sponge(porosity)
    for k, inlet in enumerate(porosity.inlet):
        name = f"porosity.inlet.{k}"
        history.check_times(inlet.times, inlet.history, name, (1,))
        if (inlet.pressure is None) == (inlet.flux is None):
            raise InputError(f"{name} needs either pressure in Pa or flux in m/s: give one of them")
        if (inlet.nodes is None) != (inlet.pressure is None) or (inlet.triangles is None) != (inlet.flux is None):
            raise InputError(f"{name} needs nodes with a pressure, triangles with a flux: give those")


def check_sponge(porosity: Porosity) -> None:
    """Refuse parameters of a sponge that no step can use. Traced parameters pass.

    Raises:
        InputError: values out of bounds, K_lim not above K0.
    """
    bounds.check_fields(porosity, "porosity")
    check_limit(porosity)


def check_limit(porosity: Porosity) -> None:
    """Refuse a sponge that does not stiffen under compression. Traced parameters pass.

    Raises:
        InputError: K_lim not above K0.
    """
    if any(isinstance(number, jax.core.Tracer) for number in (porosity.bulk, porosity.limit_bulk)):
        return
    bulk, limit = np.broadcast_arrays(np.asarray(porosity.bulk, float), np.asarray(porosity.limit_bulk, float))
    if np.any(limit <= bulk):
        k = int(np.argmax(limit - bulk <= 0))
        raise InputError(
            f"porosity limit_bulk = {limit.flat[k]:g} must be above bulk = {bulk.flat[k]:g}: a sponge stiffens"
        )


def law_in_force(porosity: Porosity | None, law: Law) -> Law:
    """The law that acts in parallel to the sponge.

    Its summands have no volumetric energy U(J), since the bulk modulus would count twice. With `keep_bulk` they keep
    it. A law that does not separate volume change from shear is not changed.
    """
    if porosity is None or porosity.keep_bulk:
        return law
    return law.each(lambda own: own.without_volume() or Volumetric(bulk=0.0))


def bulk_in_force(porosity: Porosity, law: Law) -> str:
    """One sentence that says which bulk modulus acts."""
    sponge = f"bulk modulus in force: the sponge's, {float(porosity.bulk):g} Pa"
    if porosity.keep_bulk:
        return f"{sponge}, and the law's own (keep_bulk)"
    parts = [part for own in law.pieces() for part in own.summands()]
    whole = [part for part in parts if isochoric_part(part) is None and part.without_volume() is not None]
    if not whole:
        return f"{sponge}; the law's own volumetric energy is off"
    names = " and ".join(dict.fromkeys(type(getattr(part, "law", part)).__name__ for part in whole))
    changed = any(part.without_volume() is not part for part in parts)
    off = "; the separate volumetric energy is off" if changed else ""
    return f"{sponge}, and the part of {names} that is not separate from shear{off}"


def volumetric_stress(porosity: Porosity, J: Number) -> Number:
    """sigma_Heq(J) [Pa]: Hencky's logarithm above J0, and its tangent line below J0. It is finite for every J."""
    K0, K_lim, r_w = porosity.bulk, porosity.limit_bulk, porosity.fluid_fraction
    J0 = 1 - r_w + r_w * K0 / K_lim
    logarithm = K0 * r_w * jnp.log1p((jnp.maximum(J, J0) - 1) / r_w)
    return logarithm + K_lim * jnp.minimum(J - J0, 0.0)


def volumetric_slope(porosity: Porosity, J: Number) -> jax.Array:
    """d sigma_Heq / dJ [Pa]."""
    K0, K_lim, r_w = porosity.bulk, porosity.limit_bulk, porosity.fluid_fraction
    J0 = 1 - r_w + r_w * K0 / K_lim
    return jnp.where(J > J0, K0 / (1 + (jnp.maximum(J, J0) - 1) / r_w), K_lim)


def volumetric_energy(porosity: Porosity, J: Number) -> Number:
    """The integral of sigma_Heq from 1 to J [Pa].

    It is K0 r_w^2 (u ln u - u + 1) with u = (r_w + J - 1)/r_w, and a parabola below J0.
    """
    K0, K_lim, r_w = porosity.bulk, porosity.limit_bulk, porosity.fluid_fraction
    J0 = 1 - r_w + r_w * K0 / K_lim
    u = 1 + (jnp.maximum(J, J0) - 1) / r_w
    below = jnp.minimum(J - J0, 0.0)
    return K0 * r_w**2 * (u * jnp.log(u) - u + 1) + below * (volumetric_stress(porosity, J0) + 0.5 * K_lim * below)


def initial_fluid(porosity: Porosity, mesh: TetMesh) -> Fluid:
    """The fluid with the initial pressure (0 if None) and the reference volumes."""
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
    """P (V,) [Pa] at the end of a step with volume ratios J_end (E,) at its end."""
    before: Any = fluid.J_before
    increment = fluid.J - before if porosity.scheme == "lagged" else J_end - fluid.J
    b = flow.store * fluid.pressure - integrals(mesh, increment)
    return darcy.with_given(mesh, flow, b, guess)


def fluid_energy(porosity: Porosity, mesh: TetMesh, fluid: Fluid, flow: Flow, J_end: jax.Array) -> jax.Array:
    """b . P / 2 [J], with P = A^-1 b the pressure at the end of a step and J_end (E,) the volume ratios there."""
    b = flow.store * fluid.pressure - integrals(mesh, J_end - fluid.J)
    P = pressure(porosity, mesh, fluid, flow, J_end)
    if flow.given is None:
        return 0.5 * jnp.vdot(flow.mask * b, P)
    return 0.5 * jnp.vdot(darcy.right_side(flow, b), P) + jnp.vdot(flow.given, b)


def first_piola(porosity: Porosity, mesh: TetMesh, P: jax.Array, F: Matrix) -> Matrix:
    """(sigma_Heq(J) - P) cof F [Pa], with P linear in every element."""
    sigma = volumetric_stress(porosity, determinant(F)) - interpolated(mesh, P)
    return tuple(tuple(sigma * c for c in row) for row in cofactor(F))


class Sponge(VolumeStress):
    """Sponge and fluid during a step."""

    porosity: Porosity
    fluid: Fluid

    def stress(self, mesh: TetMesh, pressure: jax.Array, F: Matrix) -> Matrix:
        """See `first_piola`."""
        return first_piola(self.porosity, mesh, pressure, F)

    def scalars(self, mesh: TetMesh, pressure: jax.Array, F: Matrix) -> Scalars:
        """sigma_Heq(J) - P and its slope at given pressure."""
        J = determinant(F)
        stress = volumetric_stress(self.porosity, J) - interpolated(mesh, pressure)
        return Scalars({"J": stress}, {("J", "J"): volumetric_slope(self.porosity, J)})


@struct
class CoupledSponge(Sponge):
    """Sponge and fluid during a step, with the pressure at the end of the step as an unknown."""

    porosity: Porosity = param("1", "its numbers")
    fluid: Fluid = param("1", "at the beginning of the step")
    flow: Flow = param("1", "the equation of the pressure")

    def pressure(self, mesh: TetMesh, J: jax.Array, guess: darcy.Guess | None = None) -> jax.Array:
        """Pressures from the volume change of this step."""
        return pressure(self.porosity, mesh, self.fluid, self.flow, J, guess)

    def in_force(self, pressure: jax.Array) -> jax.Array:
        """Pressures (V,) [Pa], with the given values at nodes where a pressure is given."""
        free = self.flow.mask * pressure
        return free if self.flow.given is None else free + self.flow.given

    def balance(self, mesh: TetMesh, pressure: jax.Array, J: jax.Array) -> jax.Array:
        """Residual (V,) [m^3] of the pressure equation, 0 at a solution.

        At nodes with a given pressure: minus its error.
        """
        b = self.flow.store * self.fluid.pressure - integrals(mesh, J - self.fluid.J)
        return darcy.lack(self.flow, b, pressure)

    def matrix(self, mesh: TetMesh, J: jax.Array, positive: bool) -> BlockMatrix:
        """Matrix of storage and flow; it is positive."""
        return self.flow.matrix

    def energy(self, mesh: TetMesh, J: jax.Array) -> jax.Array:
        """Energy of the sponge and of the fluid that leaves it."""
        density = volumetric_energy(self.porosity, J)
        return jnp.sum(mesh.weights * density) + fluid_energy(self.porosity, mesh, self.fluid, self.flow, J)


@struct
class LaggedSponge(Sponge):
    """Sponge and fluid during a step, with a pressure that is known at the beginning of the step."""

    coupled: ClassVar[bool] = False
    porosity: Porosity = param("1", "its numbers")
    fluid: Fluid = param("1", "at the beginning of the step")
    given: jax.Array = param("Pa", "the pressure (V,)")

    def pressure(self, mesh: TetMesh, J: jax.Array, guess: darcy.Guess | None = None) -> jax.Array:
        """The known pressures, which do not depend on the end of the step."""
        return self.given

    def energy(self, mesh: TetMesh, J: jax.Array) -> jax.Array:
        """Energy of the sponge, and work of the fluid's pressure."""
        density = volumetric_energy(self.porosity, J)
        return jnp.sum(mesh.weights * (density - interpolated(mesh, self.given) * J))
