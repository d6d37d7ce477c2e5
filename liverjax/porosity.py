"""Porosity in parallel (chapter, section 4.3): Kerdok-Hencky volumetric stress, nodal fluid pressure, Darcy diffusion.

    sigma_p = sigma_Heq(J) - P,   (1/K_lim) dP/dt = kappa lap P - (dJ/dt)/J

sigma_Heq = K0 r_w ln((r_w + J - 1)/r_w), and below J0 = 1 - r_w + r_w K0/K_lim its tangent line of slope K_lim (the
chapter prints J0 without the factor r_w: then the slope would be r_w K_lim). Volumes of the pressure equation are those
at the beginning of a step, so that it is linear in P:

* "implicit": P belongs to the end of the step, with the volume change of the step itself. P is eliminated, P(x), which
  leaves a symmetric problem in x alone: stable at any step.
* "chapter": P from the volume change of the step before; conditionally stable.
"""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from liverjax.errors import InputError
from liverjax.kinematics import Matrix, cofactor, determinant, dot, matvec
from liverjax.laws.base import Law, isochoric_part
from liverjax.linear import differentiable_solve
from liverjax.mesh import TetMesh
from liverjax.struct import param, static, struct

SCHEMES = ("implicit", "chapter")


@struct
class Porosity:
    """A sponge of bulk modulus K0 filled with a fluid that makes up the part r_w of its volume."""

    bulk: Any = param("Pa", "K0, bulk modulus of the drained sponge at rest", above=0.0)
    limit_bulk: Any = param("Pa", "K_lim, of the compressed sponge and of the pressure", above=0.0)
    fluid_fraction: Any = param("1", "r_w", above=0.0, upper=1.0)
    permeability: Any = param("m^4/(N s)", "kappa", lower=0.0)
    drained: Any = param("1", "nodes where P = 0 (n,); None: sealed", default=None)
    scheme: str = static("implicit", "implicit or chapter")
    keep_bulk: bool = static(False, "keep the law's own volumetric energy beside that of the sponge")


class Fluid(NamedTuple):
    """What a step hands to the next."""

    pressure: jax.Array  # P (V,) [Pa]
    J: jax.Array  # (E,)
    J_before: jax.Array | None  # of the step before; the chapter's scheme


def check(porosity: Porosity) -> None:
    """Refuse values that no step can use; host side.

    Raises:
        InputError: unknown scheme, values out of bounds, K_lim not above K0.
    """
    if porosity.scheme not in SCHEMES:
        raise InputError(f"porosity scheme = {porosity.scheme!r} is not known: use {' or '.join(SCHEMES)}")
    values = {n: float(getattr(porosity, n)) for n in ("bulk", "limit_bulk", "fluid_fraction", "permeability")}
    for name, value in values.items():
        low_enough = value <= 1 if name == "fluid_fraction" else True
        if not (np.isfinite(value) and (value > 0 or (name == "permeability" and value == 0)) and low_enough):
            raise InputError(
                f"porosity {name} = {value:g} is out of bounds: give a positive number (fluid_fraction <= 1)"
            )
    if values["limit_bulk"] <= values["bulk"]:
        raise InputError(
            f"porosity limit_bulk = {values['limit_bulk']:g} must be above bulk = {values['bulk']:g}: a sponge stiffens"
        )


def law_in_force(porosity: Porosity | None, law: Law) -> Law:
    """The law beside the sponge: without its own volumetric energy, lest bulk is counted twice, unless asked for."""
    if porosity is None or porosity.keep_bulk:
        return law
    split = isochoric_part(law)
    return law if split is None else split


def volumetric_stress(porosity: Porosity, J: Any) -> Any:
    """sigma_Heq(J) [Pa]: Hencky's logarithm above J0, its tangent line below; finite for every J."""
    K0, K_lim, r_w = porosity.bulk, porosity.limit_bulk, porosity.fluid_fraction
    J0 = 1 - r_w + r_w * K0 / K_lim
    logarithm = K0 * r_w * jnp.log1p((jnp.maximum(J, J0) - 1) / r_w)
    return logarithm + K_lim * jnp.minimum(J - J0, 0.0)


def initial_fluid(porosity: Porosity, mesh: TetMesh) -> Fluid:
    """No pressure, reference volumes."""
    J = jnp.ones_like(mesh.volumes)
    return Fluid(jnp.zeros(mesh.points.shape[0], J.dtype), J, J if porosity.scheme == "chapter" else None)


def pressure(
    porosity: Porosity, mesh: TetMesh, fluid: Fluid, F_begin: Matrix, J_end: Any, dt: Any, tolerance: float
) -> jax.Array:
    """P (V,) [Pa] at the end of a step that begins at F_begin and ends with volumes J_end (E,).

    `tolerance` is that of the linear solve, relative to its right-hand side.
    """
    increment = fluid.J - fluid.J_before if porosity.scheme == "chapter" else J_end - fluid.J
    matvec_A, diagonal, mask = _operator(porosity, mesh, F_begin, fluid.J, dt)
    store = _scatter(mesh, mesh.volumes * fluid.J / 4) / porosity.limit_bulk
    rate = -_scatter(mesh, mesh.volumes * increment / 4)
    # Everything times dt: the storage term stays of the size of a volume whatever the step.
    rhs = mask * (store * fluid.pressure + rate)
    return differentiable_solve(matvec_A, rhs, lambda r: r / diagonal, tolerance, 2000)


def _operator(porosity: Porosity, mesh: TetMesh, F: Matrix, J: Any, dt: Any) -> tuple[Any, jax.Array, jax.Array]:
    """dt times storage rate plus Darcy's Laplacian in the positions F, its diagonal, and the mask of wet nodes."""
    mask = jnp.ones(mesh.points.shape[0], J.dtype)
    if porosity.drained is not None:
        mask = mask.at[porosity.drained].set(0.0)
    store = _scatter(mesh, mesh.volumes * J / 4) / porosity.limit_bulk
    cof = cofactor(F)
    g = [matvec(cof, tuple(mesh.shape_vectors[a])) for a in range(3)]
    g = [tuple(-(x + y + z) for x, y, z in zip(*g, strict=True)), *g]
    # grad N_a = cof(F) D_a / J per current volume J V0.
    weight = dt * porosity.permeability * mesh.volumes / J
    pairs = {(a, b): weight * dot(g[a], g[b]) for a in range(4) for b in range(a, 4)}
    diagonal = store
    for a in range(4):
        diagonal = diagonal.at[mesh.tetrahedra[:, a]].add(pairs[a, a])
    diagonal = mask * diagonal + (1 - mask)

    def apply(p):
        held, p = (1 - mask) * p, mask * p  # a unit row where drained: adjoint loads need not vanish there
        corner = [p[mesh.tetrahedra[:, a]] for a in range(4)]
        flow = jnp.zeros_like(p)
        for a in range(4):
            flow = flow.at[mesh.tetrahedra[:, a]].add(sum(pairs[min(a, b), max(a, b)] * corner[b] for b in range(4)))
        return mask * (store * p + flow) + held

    return apply, diagonal, mask


def _scatter(mesh: TetMesh, share: jax.Array) -> jax.Array:
    total = jnp.zeros(mesh.points.shape[0], share.dtype)
    for a in range(4):
        total = total.at[mesh.tetrahedra[:, a]].add(share)
    return total


def first_piola(porosity: Porosity, mesh: TetMesh, P: jax.Array, F: Matrix) -> Matrix:
    """(sigma_Heq(J) - P) cof F [Pa], P the mean over an element's nodes."""
    mean = sum(P[mesh.tetrahedra[:, a]] for a in range(4)) / 4
    sigma = volumetric_stress(porosity, determinant(F)) - mean
    return tuple(tuple(sigma * c for c in row) for row in cofactor(F))


def advance(porosity: Porosity, fluid: Fluid, P: jax.Array, F: Matrix) -> Fluid:
    """The state after an accepted step."""
    return Fluid(P, determinant(F), fluid.J if porosity.scheme == "chapter" else None)


def undrained(porosity: Porosity) -> Any:
    """K0 + K_lim [Pa], the bulk modulus before anything flows; for preconditioners."""
    return porosity.bulk + porosity.limit_bulk
