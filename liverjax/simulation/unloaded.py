"""The unloaded shape: the reference positions from which the loads deform the body into the given positions.

The unknowns are the displacements u. The vertices of the reference shape are X = x - u, with the given positions x. In
the reference shape quadratic elements have straight edges, so the edge middles follow from the vertices. The
displacements of the edge middles are unknowns, too. A body with the reference shape X must be in equilibrium at X + u.
For small u the derivative of the out-of-balance forces with respect to u is the stiffness matrix K. So Newton's method
with BiCGSTAB uses the preconditioner of K.

Source: Govindjee and Mihalic 1996, "Computational methods for inverse finite elastostatics". This module solves the
same problem with the equations of the forward run.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from liverjax import laws
from liverjax.core import status
from liverjax.core.errors import InputError
from liverjax.core.struct import Content, replace
from liverjax.elements.gradients import volume_ratios
from liverjax.mesh.tetrahedra import with_points
from liverjax.physics.contact.friction import RoughObstacle
from liverjax.physics.prescribed import Fixed
from liverjax.physics.viscosity import lasting
from liverjax.scenes.by_element import by_element
from liverjax.scenes.scene import Scene, named_physics
from liverjax.scenes.springpots import check_spring_at_rest, series_at_rest
from liverjax.simulation import automatic, tangent
from liverjax.simulation.equations import Equations, Sizes, equations, force_sizes, initial_state, residual, unknowns
from liverjax.solvers.block_matrix import columns, flat
from liverjax.solvers.newton import NewtonOptions, newton_root
from liverjax.solvers.step_cutting import ROUNDINGS

#: `max_halvings`: a Newton step that does not reduce the residual is halved. `linear_tolerance`: it is large, because
#: only the last linear solve needs high accuracy.
_OPTIONS = NewtonOptions(max_iterations=50, linear_tolerance=1e-2, max_halvings=12, symmetric=False)
#: After this number of relaxation times, the stress of an initially unrelaxed body is relaxed to within 1 %.
_RESTS = 5.0


class Unloaded(NamedTuple):
    """A scene with the reference shape, the status of the search and its residual."""

    scene: Scene  # with the reference shape
    status: jax.Array  # code of `liverjax.core.status`; under jit the points are NaN if it is not CONVERGED
    residual: jax.Array  # norm of the residual forces, divided by the norm of all forces


def unload(scene: Scene) -> Unloaded:
    """Find the reference shape of a scene that is already prepared for its run.

    `liverjax.simulation.run.unloaded` does the same, but also checks and prepares the scene.

    Raises:
        InputError: no reference shape was found, for example because springpots without a spring leave no shear
            stiffness at rest. Inside jit, grad or vmap no error is raised.
    """
    points, code, relative, rounded = _found_shape(resting(scene))
    if not isinstance(code, jax.core.Tracer) and int(code) != status.CONVERGED:
        check_spring_at_rest(scene.springpots, "or remove the gravity")
        if int(code) == status.STALLED and float(relative) <= float(rounded):
            precise = 'precision = "float64" or ' if points.dtype == jnp.float32 else ""
            raise InputError(
                f'[mesh] is = "loaded": the residual {float(relative):.1g} of the forces is only roundoff, but is '
                f"above the tolerance: use {precise}a tolerance above {2 * float(relative):.1g}"
            )
        raise InputError(
            '[mesh] is = "loaded": no reference shape was found for the given shape under these loads (residual '
            f"{float(relative):.1g} of the forces); use a stiffer law, smaller loads or a better mesh"
        )
    # Under jit the points are NaN if no shape was found.
    mesh = with_points(scene.mesh, jnp.where(code == status.CONVERGED, points, jnp.nan))
    return Unloaded(replace(scene, mesh=mesh, points_are="reference"), code, relative)


def resting(scene: Scene) -> Scene:
    """Return a static scene of the same body, which has fully relaxed under the loads at time 0.

    The setting `volumetric` of the given scene is kept: without viscosity, `volumetric = "auto"` could choose another
    form.
    """
    form = automatic.form_of_volumes(scene)
    if scene.springpots is not None:
        scene = replace(scene, viscosity=series_at_rest(scene.springpots), springpots=None)
    law = scene.law
    if scene.viscosity is not None:
        left, part = lasting(scene.viscosity, scene.mesh.order), scene.viscosity.part

        def relaxed(own):
            split, volume = own.isochoric_part(), own.volumetric_part()
            if part == "all" or split is None:
                return laws.scaled(own, left)
            return laws.scaled(split, left) if volume is None else laws.scaled(split, left) + volume

        law = law.each(relaxed)
    held = tuple(Fixed(nodes=d.nodes, axes=d.axes) for d in scene.displaced)
    # There is one step with dt = 0, so each history has its first value.
    solve = replace(scene.solve, kind="static", steps=1, dt=0.0, newton="converged", robust="off")
    solve = replace(solve, volumetric=form)
    changed: Content = {"fixed": (*scene.fixed, *held), "physics": tuple(p.at_beginning() for p in scene.physics)}
    changed |= {"displaced": (), "solve": solve, "points_are": "reference"}
    return replace(scene, law=law, unrelaxed=scene.law, viscosity=None, **changed)


@jax.jit
def _found_shape(scene: Scene) -> tuple[jax.Array, jax.Array, jax.Array, jax.Array]:
    """Find the reference positions (V, 3) [m].

    Return the positions, a status code, the relative residual, and the value below which this residual is roundoff.
    """
    one, given = jnp.ones((), scene.mesh.points.dtype), scene.mesh.points
    sizes = force_sizes(scene)
    first = jax.lax.stop_gradient(equations(scene, initial_state(scene), one, sizes))
    q = unknowns(first, given)
    # `loads` is the norm of all forces on the given shape without strain. The residual is divided by this norm.
    _, loads, pressure = jax.lax.stop_gradient(residual(first, q, one))
    K = tangent.tangent(first, pressure, given, one)

    def held(z: jax.Array) -> jax.Array:
        e, q = _with_displacements(scene, given, z, sizes)
        # Unknowns that are not free must be 0. The added term gives equations for these unknowns, so that the matrix
        # has no empty rows.
        return residual(e, q, one)[0] + (z - _free_part(first, z))

    options = _OPTIONS._replace(tolerance=jax.lax.stop_gradient(scene.solve.tolerance))
    z, found = newton_root(held, jnp.zeros_like(q), tangent.preconditioner(first, K), loads, options)
    # `first` is constant. The free directions depend on the normals of sliding supports, so they are computed again
    # from `scene`.
    u = _displacements_in(equations(scene, initial_state(scene), one, sizes), z)
    mesh = with_points(scene.mesh, given - u)
    # Loaded quadratic elements have curved edges, so their edge middles differ from the edge middles of the given mesh.
    good = jnp.all(volume_ratios(mesh, mesh.points + u) > 0) & jnp.all(mesh.volumes > 0)
    code = jnp.where((found.status == status.CONVERGED) & ~good, status.INVERTED, found.status)
    return mesh.points, code, found.residual, ROUNDINGS * first.roundoff / loads


def _free_part(e: Equations, z: jax.Array) -> jax.Array:
    """Set displacements that are not free to 0 in the unknowns z (displacements, then pressures)."""
    n = 3 * e.mesh.number_of_nodes
    return jnp.concatenate([jnp.concatenate(e.free.columns(columns(z[:n]))), z[n:]])


def _displacements_in(e: Equations, z: jax.Array) -> jax.Array:
    """Return the displacements (V, 3) [m] in the unknowns z. Held nodes have the displacement 0."""
    return jnp.stack(e.free.columns(columns(z[: 3 * e.mesh.number_of_nodes])), axis=-1)


def _with_displacements(scene: Scene, given: jax.Array, z: jax.Array, sizes: Sizes) -> tuple[Equations, jax.Array]:
    """Return the equations of the body whose reference shape follows from the unknowns z, and the unknowns of the
    loaded body."""
    still = equations(scene, initial_state(scene), jnp.ones((), given.dtype), sizes)
    mesh = with_points(scene.mesh, given - _displacements_in(still, z))
    one = replace(scene, mesh=mesh)
    e = equations(one, initial_state(one), jnp.ones((), given.dtype), sizes)
    x = mesh.points + _displacements_in(e, z)
    return e, jnp.concatenate([flat(e.free.vectors(x)), z[3 * mesh.number_of_nodes :]])


def cautions_of_loaded(scene: Scene, times: jax.Array) -> list[str]:
    """Return warnings if a static run of a body with a given loaded shape does not end in this shape.

    Args:
        scene: the scene with the given shape.
        times: times [s] of the steps of its run.
    """
    if scene.points_are != "loaded" or scene.solve.kind != "static":
        return []
    return [*_of_unrelaxed_stress(scene, times), *_of_friction(scene)]


def _of_unrelaxed_stress(scene: Scene, reached: jax.Array) -> list[str]:
    """Warn if the run ends before the viscous stress has relaxed."""
    if scene.viscosity is None:
        return []
    own, lasts = by_element(scene).viscosity, float(reached[-1])
    assert own is not None
    ratios, times = np.broadcast_arrays(np.asarray(own.ratios, float), np.asarray(own.relaxation_times, float))
    slowest = float(np.max(times[ratios > 0], initial=0.0))
    if scene.solve.dt is None or lasts > _RESTS * slowest:
        return []
    return [
        f"the run begins with unrelaxed stress and lasts {lasts:.3g} s, but a relaxation time is {slowest:.3g} s, so "
        "the body does not end in the given shape: remove viscosity, or simulate a longer time"
    ]


def _of_friction(scene: Scene) -> list[str]:
    """Warn if obstacles have friction and the loads are applied in several steps."""
    rough = [name for name, own in named_physics(scene) if isinstance(own, RoughObstacle)]
    solve = scene.solve
    if not rough or solve.dt is not None or solve.steps == 1:
        return []
    return [
        f"the unloaded shape was computed with all loads in one step, but the friction of {' and '.join(rough)} "
        f"depends on the steps. The body does not end in the given shape after {solve.steps} steps: write steps = 1"
    ]
