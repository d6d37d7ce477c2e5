"""The shape before the load: reference positions from which the loads lead to the given ones.

The unknowns are the displacements u. The vertices of the reference shape are X = x - u, with x the given positions; of
quadratic elements the middles of its edges follow from these, since elements are straight there, and move by
displacements of their own. What must vanish are the out-of-balance forces of the body with reference shape X at X + u.
For small u their derivative is the stiffness K, so K's preconditioner serves Newton's method with BiCGSTAB.

Source: Govindjee and Mihalic 1996, "Computational methods for inverse finite elastostatics"; here the same problem on
the equations of the forward run.
"""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from liverjax import laws
from liverjax.core import status
from liverjax.core.errors import InputError
from liverjax.core.struct import replace
from liverjax.elements.gradients import volume_ratios
from liverjax.mesh.tetrahedra import TetMesh, with_points
from liverjax.physics.prescribed import Fixed
from liverjax.scenes.scene import Scene
from liverjax.simulation import tangent
from liverjax.simulation.equations import Equations, equations, force_sizes, initial_state, residual, unknowns
from liverjax.solvers.block_matrix import columns, flat
from liverjax.solvers.krylov import differentiable_solve, stabilised_biconjugate_gradients

#: Most iterations, shortenings of one, and iterations of a linear solve; tolerance of the linear solve, the loosest.
_ITERATIONS, _HALVINGS, _LINEAR, _FORCING = 50, 12, 2000, 1e-2


class Unloaded(NamedTuple):
    """A reference shape, and how well it was found."""

    scene: Scene  # with the reference shape
    status: jax.Array  # of `liverjax.core.status`; the points are NaN where it is not CONVERGED
    residual: jax.Array  # |r| over the forces at work


def unload(scene: Scene) -> Unloaded:
    """See `liverjax.simulation.run.unloaded`; for a scene as it is run.

    Raises:
        InputError: no reference shape was found; traced numbers pass.
    """
    points, code, relative = _solved(_resting(scene))
    if not isinstance(code, jax.core.Tracer) and int(code) != status.CONVERGED:
        raise InputError(
            '[mesh] is = "loaded": no reference shape was found that these loads bring to the given one (the rest is '
            f"{float(relative):.1g} of the forces): take a stiffer law, smaller loads or a better mesh"
        )
    # Under jit a shape that was not found passes for none.
    mesh = with_points(scene.mesh, jnp.where(code == status.CONVERGED, points, jnp.nan))
    return Unloaded(replace(scene, mesh=mesh, points_are="reference"), code, relative)


def _resting(scene: Scene) -> Scene:
    """The same body at rest for long under the loads of time 0."""
    law = scene.law
    if scene.viscosity is not None:
        left = 1 - jnp.sum(jnp.asarray(scene.viscosity.ratios))
        split, volume = law.isochoric_part(), law.volumetric_part()
        if scene.viscosity.part == "all" or split is None:
            law = laws.scaled(law, left)
        else:
            law = laws.scaled(split, left) if volume is None else laws.scaled(split, left) + volume
    held = tuple(Fixed(nodes=d.nodes, axes=d.axes) for d in scene.displaced)
    # A step without length: histories are at their beginning.
    solve = replace(scene.solve, kind="static", steps=1, dt=0.0, newton="converged", robust="off")
    fixed = (*scene.fixed, *held)
    return replace(scene, law=law, viscosity=None, fixed=fixed, displaced=(), solve=solve, points_are="reference")


@jax.jit
def _solved(scene: Scene) -> tuple[jax.Array, jax.Array, jax.Array]:
    """Reference positions (V, 3) [m], code, and the residual over the forces at work."""
    one, given = jnp.ones((), scene.mesh.points.dtype), scene.mesh.points
    sizes = force_sizes(scene)

    def at(z: jax.Array) -> tuple[jax.Array, jax.Array]:
        e, q = _moved(scene, given, z, sizes)
        r, force, _ = residual(e, q, one)
        return r, force

    first = jax.lax.stop_gradient(equations(scene, initial_state(scene), one, sizes))
    start = jnp.zeros_like(unknowns(first, given))
    pressure = jax.lax.stop_gradient(residual(first, unknowns(first, given), one)[2])
    K = tangent.tangent(first, pressure, jax.lax.stop_gradient(given), one)
    precondition = tangent.preconditioner(first, K)

    def follow(r: Any, start: jax.Array) -> tuple[jax.Array, Any]:
        return _newton(lambda z: jax.lax.stop_gradient(at(z)[1]), r, start, precondition, scene.solve.tolerance)

    def solve(linear: Any, y: jax.Array) -> jax.Array:
        return differentiable_solve(linear, y, precondition, 1e-11, _LINEAR, symmetric=False)

    def held(z: jax.Array) -> jax.Array:
        # Where nothing is free the unknown itself must vanish: a matrix without empty rows.
        return at(z)[0] + (z - _free(first, z))

    z, (code, relative) = jax.lax.custom_root(held, start, follow, solve, has_aux=True)
    mesh = _reference(scene.mesh, given, first, z)
    good = jnp.all(volume_ratios(mesh, given) > 0) & jnp.all(mesh.volumes > 0)
    code = jnp.where(good, code, status.INVERTED).astype(jnp.int32)
    return mesh.points, code, relative


def _free(e: Equations, z: jax.Array) -> jax.Array:
    """The part of the unknowns that is free: displacements, then pressures that are unknown."""
    n = 3 * e.mesh.number_of_nodes
    return jnp.concatenate([jnp.concatenate(e.free.columns(columns(z[:n]))), z[n:]])


def _reference(mesh: TetMesh, given: jax.Array, e: Equations, z: jax.Array) -> TetMesh:
    u = jnp.stack(e.free.columns(columns(z[: 3 * mesh.number_of_nodes])), axis=-1)
    return with_points(mesh, given - u)


def _moved(scene: Scene, given: jax.Array, z: jax.Array, sizes: Any) -> tuple[Equations, jax.Array]:
    """The equations of the body with the reference shape of z, and its unknowns."""
    n = 3 * scene.mesh.number_of_nodes
    still = equations(scene, initial_state(scene), jnp.ones((), given.dtype), sizes)
    mesh = _reference(scene.mesh, given, still, z)
    one = replace(scene, mesh=mesh)
    e = equations(one, initial_state(one), jnp.ones((), given.dtype), sizes)
    u = jnp.stack(e.free.columns(columns(z[:n])), axis=-1)
    return e, jnp.concatenate([flat(e.free.vectors(mesh.points + u)), z[n:]])


def _newton(
    force: Any, residual: Any, start: jax.Array, precondition: Any, tolerance: Any
) -> tuple[jax.Array, tuple[jax.Array, jax.Array]]:
    """A root of `residual` to `tolerance` of `force`; every step is halved until the residual falls."""

    def size(r: jax.Array) -> jax.Array:
        return jnp.linalg.norm(r)

    def go_on(c: Any) -> jax.Array:
        z, r, k, stuck = c
        return (size(r) > tolerance * force(z)) & (k < _ITERATIONS) & ~stuck & jnp.isfinite(size(r))

    def step(c: Any) -> Any:
        z, r, k, _ = c
        _, product = jax.linearize(residual, z)
        forcing = jnp.clip(0.1 * tolerance * force(z) / size(r), 1e-12, _FORCING)
        dz, _ = stabilised_biconjugate_gradients(product, -r, precondition, forcing, _LINEAR)

        def worse(t: Any) -> jax.Array:
            # False for a number that is not finite.
            return ~(t[1] < size(r)) & (t[2] < _HALVINGS)

        def shorter(t: Any) -> Any:
            half = 0.5 * t[0]
            return half, size(residual(z + half * dz)), t[2] + 1

        full = jnp.ones((), z.dtype)
        t, found, _ = jax.lax.while_loop(worse, shorter, (full, size(residual(z + dz)), jnp.zeros((), jnp.int32)))
        better = found < size(r)
        z = jnp.where(better, z + t * dz, z)
        return z, residual(z), k + 1, ~better

    begin = (start, residual(start), jnp.zeros((), jnp.int32), jnp.array(False))
    z, r, _, _ = jax.lax.while_loop(go_on, step, begin)
    relative = size(r) / force(z)
    code = jnp.where(relative <= tolerance, status.CONVERGED, status.STALLED)
    code = jnp.where(jnp.isfinite(relative), code, status.NOT_FINITE)
    return z, (code.astype(start.dtype), relative)
