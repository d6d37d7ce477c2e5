"""Pressures as unknowns against volumetric locking: Taylor-Hood (P2/P1) in quadratic and P1/P1 in linear elements.

The volumetric energy is U(J) = K g(J)^2 / 2, with the bulk modulus K and the volumetric strain g of the volume ratio J.
With pressures p the energy per volume is

    W_isochoric + gamma g^2 / 2 + p g - p^2 / (2 (K - gamma)),

with p linear in every element and continuous. If this energy is stationary with respect to p, its volumetric part is
gamma g^2/2 + (K - gamma) h^2/2, where h is the projection of g onto the shape functions of p. So a large K limits
volume changes only on average, not at every point. The part gamma of the bulk modulus stays in the displacement terms,
so that the displacement matrix is positive definite. gamma is min(mu, K/2) with the shear modulus mu, and a quarter of
this in linear elements. The finer the mesh, the less the solution depends on gamma. Pressures and positions are
unknowns of the same system. If the pressures were eliminated, Newton's method would not converge for large K.

In linear elements, the positions do not determine all pressures: some pressures that alternate from node to node cause
no force. For large K these pressures would grow without bound. So linear elements have a stabilisation term, - (p -
mean of p)^2 / (2 mu), with the mean over the element (Bochev, Dohrmann and Gunzburger 2006). This term decreases with
the square of the element size.
"""

from collections.abc import Callable, Sequence
from typing import ClassVar

import jax
import jax.numpy as jnp

from liverjax.core.errors import InputError
from liverjax.core.struct import Number, param, static, struct
from liverjax.laws.base import Law, Volumetric, isochoric_part, volumetric_part
from liverjax.laws.terms.invariant_terms import Scalars
from liverjax.mesh.adjacency import PAIRS
from liverjax.mesh.nodal import gathered, integrals, interpolated, summed
from liverjax.mesh.shape_functions import basis
from liverjax.mesh.tetrahedra import TetMesh
from liverjax.physics.base import End, Physics, Start, Step, VolumeStress
from liverjax.solvers.block_matrix import BlockMatrix, off_diagonal
from liverjax.tensors.matrices import Matrix, cofactor, determinant, scale_matrix
from liverjax.tensors.places import given, taken


def check_mixed_laws(several: Sequence[Law], name: str = "[solve] volumetric = 'mixed'") -> None:
    """Check that pressures can be unknowns with the laws of a body.

    Raises:
        InputError: a law has no isochoric part, no volumetric part, no shear modulus or no bulk modulus; a law is
            continued below a volume ratio; or the laws have different kinds of volumetric energy.
    """
    kinds = set()
    for law in several:
        U = volumetric_part(law)
        if isochoric_part(law) is None or U is None:
            raise InputError(
                f"{name} needs a law with an isochoric and a volumetric part, unlike {type(law).__name__}: use another "
                "law"
            )
        parts = [part for own in U.pieces() for part in own.summands() if isinstance(part, Volumetric)]
        if any(part.below is not None for part in parts):
            raise InputError(
                f"{name} cannot be used with continued_below: remove continued_below, or use 'element' or 'nodal'"
            )
        law.shear_modulus()  # `MixedVolume` needs both moduli: a law that lacks one of them raises an error here
        law.bulk_modulus()
        kinds |= {part.volumetric for part in parts}
    if len(kinds) != 1:
        raise InputError(
            f"{name} needs the same kind of volumetric energy in all laws: give the same value of volumetric to all "
            "laws"
        )


def strain(kind: str, J: jax.Array) -> jax.Array:
    """Return the volumetric strain g(J) of the energy U = K g^2 / 2, for the volume ratio J.

    g is J - 1 for "quadratic" and ln J for "log". For "simo", U is K (J^2 - 1 - 2 ln J) / 4.
    """
    if kind == "log":
        return jnp.log(J)
    d = J - 1
    if kind == "quadratic":
        return d
    # g^2 = (J^2 - 1 - 2 ln J) / 2 = d^2 (1 + sum_n (-1)^n d^(n-2) / n, n = 3 …). Near J = 1, the first expression loses
    # digits by roundoff.
    near = jnp.clip(d, -0.1, 0.1)
    series = 1 + sum((-1) ** n * near ** (n - 2) / n for n in range(3, 18))
    safe = jnp.where(jnp.abs(d) < 0.1, 1.0, d)
    whole = (safe**2 + 2 * safe - 2 * jnp.log1p(safe)) / (2 * safe**2)
    return d * jnp.sqrt(jnp.where(jnp.abs(d) < 0.1, series, whole))


#: Element order -> gamma divided by min(mu, K/2). In linear elements, gamma causes locking, so a smaller gamma gives
#: more accurate results.
_PART = {1: 0.25, 2: 1.0, 3: 1.0}


#: Minimum relative residual that Newton's method can reach, divided by the machine precision.
_REACHED = 4096


@struct
class MixedVolume(Physics):
    """The volumetric energy of a law, with pressures as unknowns."""

    law: Law = param("1", "law whose volumetric part is used")

    def begin(self, start: Start) -> jax.Array:
        """Return the pressures (V,) [Pa] at the beginning of a run, which are zeros."""
        return jnp.zeros(start.mesh.number_of_vertices, start.x.dtype)

    def freeze(self, memory: jax.Array, step: Step) -> "Mixed":
        """Return the force term of a step. It stores the moduli, and the pressures at the beginning of the step."""
        U = volumetric_part(self.law)
        mu, bulk = self.law.shear_modulus(), self.law.bulk_modulus()
        part = _PART[step.mesh.order] * jnp.minimum(mu, bulk / 2)
        kind = next(law.volumetric for law in U.pieces()[0].summands())
        mean = jax.lax.stop_gradient(jnp.sum(jnp.broadcast_to(mu, step.mesh.weights.shape) * step.mesh.weights))
        volume = jax.lax.stop_gradient(jnp.sum(step.mesh.volumes))
        width = (volume / step.mesh.number_of_vertices) ** (1 / 3)
        soft = jax.lax.stop_gradient(jnp.min(jnp.asarray(mu / bulk)))
        reached = _REACHED * float(jnp.finfo(step.x.dtype).eps) / (1.0 if step.tolerance is None else step.tolerance)
        counted = jnp.minimum(jnp.maximum(soft, reached), 1.0)
        own = {"unit": mean / volume / width, "counted": counted, "kind": kind}
        return Mixed(part=part, rest=bulk - part, shear=mu, before=memory, **own)

    def advance(self, memory: jax.Array, acting: "Mixed", end: End) -> jax.Array:
        """Return the pressures (V,) [Pa] at the end of the step."""
        return end.pressure


@struct
class Mixed(VolumeStress):
    """Force term with pressures as unknowns, for one step. Symbols (K, gamma, mu, g, p): docstring of the module."""

    part: Number = param("Pa", "gamma, part of K in the displacement terms")
    rest: Number = param("Pa", "K - gamma, part of K in the pressure terms")
    shear: Number = param("Pa", "shear modulus")
    before: jax.Array = param("Pa", "pressures at the beginning of the step (V,)")
    unit: jax.Array = param("N/m^3", "unknowns are pressures divided by this unit; then all residuals are forces")
    counted: jax.Array = param(
        "1",
        "weight (about mu/K) of other than isochoric forces in the sum on which the tolerance is based; isochoric "
        "forces have the weight 1. In a confined body the pressures cause nearly all forces, but small volume changes "
        "determine the pressures",
    )
    kind: str = static(about="kind of the volumetric energy")

    coupled: ClassVar[bool] = False
    unknown: ClassVar[bool] = True

    def _slopes(self, J: jax.Array) -> tuple[jax.Array, jax.Array, jax.Array]:
        """Return the volumetric strain g and its first two derivatives with respect to J."""

        def first(J: jax.Array) -> tuple[jax.Array, jax.Array]:
            return jax.jvp(lambda J: strain(self.kind, J), (J,), (jnp.ones_like(J),))

        (g, g1), (_, g2) = jax.jvp(first, (J,), (jnp.ones_like(J),))
        return g, g1, g2

    def stress(self, mesh: TetMesh, pressure: jax.Array, F: Matrix) -> Matrix:
        """Return the first Piola-Kirchhoff stress (gamma g + p) g' cof F [Pa], with g' = dg/dJ."""
        g, g1, _ = self._slopes(determinant(F))
        return scale_matrix((self.part * g + interpolated(mesh, pressure)) * g1, cofactor(F))

    def energy(self, mesh: TetMesh, J: jax.Array) -> jax.Array:
        """Return the energy [J] at volume ratios J and pressures p from `settled`: integral of gamma g^2/2 + p g/2."""
        g = strain(self.kind, J)
        return jnp.sum(mesh.weights * (0.5 * self.part * g * g)) + 0.5 * jnp.vdot(
            self.settled(mesh, J), integrals(mesh, g)
        )

    def density(self, mesh: TetMesh, pressure: jax.Array, J: jax.Array) -> jax.Array:
        """Return the volumetric energy density [J/m^3], gamma g^2/2 + p g/2, at pressures p (V,) from `settled`."""
        g = strain(self.kind, J)
        return 0.5 * g * (self.part * g + interpolated(mesh, pressure))

    def scalars(self, mesh: TetMesh, pressure: jax.Array, F: Matrix) -> Scalars:
        """Return the first and second derivative of the energy density with respect to J, at given pressures (V,)."""
        g, g1, g2 = self._slopes(determinant(F))
        whole = self.part * g + interpolated(mesh, pressure)
        return Scalars({"J": whole * g1}, {("J", "J"): self.part * g1 * g1 + whole * g2})

    def border(self, J: jax.Array) -> jax.Array:
        """Return the derivative g' of the volumetric strain g with respect to J. It couples pressures and positions."""
        return self._slopes(J)[1]

    def balance(self, mesh: TetMesh, pressure: jax.Array, J: jax.Array) -> jax.Array:
        """Return the residual (V,) [m^3] of the pressure equation, which is 0 at a solution.

        It contains the integrals of N (g - p/(K - gamma)), with the shape functions N of p. In linear elements, the
        stabilisation term is subtracted.
        """
        return integrals(mesh, strain(self.kind, J)) - self.compliance(mesh, pressure)

    def compliance(self, mesh: TetMesh, pressure: jax.Array) -> jax.Array:
        """Return the integrals (V,) [m^3] of N p/(K - gamma), with the shape functions N of p.

        In linear elements, the stabilisation term is added.
        """
        if mesh.order > 1:
            return gathered(mesh, mesh.weights * interpolated(mesh, pressure) / self.rest)
        own = [taken(pressure, mesh.tetrahedra[:, a]) for a in range(4)]
        mean = interpolated(mesh, pressure)
        shares = [mesh.volumes * ((4 * mean + p) / self.rest + (p - mean) / self.shear) / 20 for p in own]
        return given(jnp.zeros_like(pressure), mesh.tetrahedra.T, jnp.stack(shares))

    def diagonal(self, mesh: TetMesh) -> jax.Array:
        """Return the diagonal (V,) [m^3/Pa] of the pressure matrix."""
        none = jnp.zeros_like(self.before)
        if mesh.order == 1:
            share = jnp.stack(4 * [mesh.volumes * (2 / self.rest + 0.75 / self.shear) / 20])
        else:
            share = jnp.asarray(basis(mesh.order).L ** 2, none.dtype) @ (mesh.weights / self.rest)
        return given(none, mesh.tetrahedra.T, share)

    def settled(self, mesh: TetMesh, J: jax.Array) -> jax.Array:
        """Return the pressures (V,) [Pa] for which `balance` is 0 at volume ratios J."""
        none, diagonal = jnp.zeros_like(self.before), self.diagonal(mesh)

        def solve(apply: Callable[[jax.Array], jax.Array], b: jax.Array) -> jax.Array:
            return jax.scipy.sparse.linalg.cg(apply, b, tol=1e-14, maxiter=1000, M=lambda r: r / diagonal)[0]

        def own(p: jax.Array) -> jax.Array:
            return self.compliance(mesh, p)

        return jax.lax.custom_linear_solve(own, self.balance(mesh, none, J), solve, symmetric=True)

    def matrix(self, mesh: TetMesh, J: jax.Array, positive: bool) -> BlockMatrix:
        """Return the pressure matrix [m^3/Pa]. Its product with the pressures is the result of `compliance`."""

        def block(a: int, b: int) -> jax.Array:
            same = float(a == b)
            if mesh.order == 1:
                return mesh.volumes * ((1 + same) / self.rest + (same - 0.25) / self.shear) / 20
            L = basis(mesh.order).L
            return summed(mesh, mesh.weights * jnp.asarray(L[a] * L[b])[:, None] / self.rest)

        rows = off_diagonal(mesh, {(a, b): ((block(a, b),),) for a, b in PAIRS})
        own = jnp.stack([block(a, a) for a in range(4)])
        zero = jnp.zeros(mesh.number_of_vertices, own.dtype)
        return BlockMatrix(rows, ((given(zero, mesh.tetrahedra.T, own),),), mesh.pattern.row_nodes)

    def schur(self, mesh: TetMesh) -> jax.Array:
        """Return a diagonal approximation (V,) [m^3/Pa] of the Schur complement for the pressures."""
        soft = 1 / (1.5 * self.shear + self.part) + 1 / self.rest
        return integrals(mesh, jnp.broadcast_to(soft, mesh.weights.shape))
