"""Error of a run by its mesh: one linearised solve in each step in the next richer space of functions.

The positions of a step, with nothing added, are put into quadratic elements (those of quadratic elements into cubic
ones). The forces out of balance, r, and the tangent K give du = -K^-1 r, which the elements of the run cannot
represent. A reaction changes by its derivative along du. A second run in this space goes along with the first one, and
the memories of viscosity, fluid and inertia are its own. In the richer space a surface touches an obstacle at other
points: with contact, solves go on until these are found. With only the contact points of the first solve, the stated
error of a flat punch's force was 1/4; the true error was 1/100.

The estimate is hierarchical (Bank and Smith 1993). For linear elements du is 0.8 to 1.3 of the error in small and in
moderate strain; with du added, about a tenth is left. For quadratic elements the cubic functions show about two thirds
of the error, so du is multiplied by 1.5. It leaves out the errors of the body's shape and of the time steps.

The pressures of a fluid are linear in both kinds of elements. With a fluid, the richer space is therefore that of the
same elements on a mesh with every element cut into eight (`liverjax.scenes.refined`), and du is multiplied by 4/3: an
error that falls with the square of the elements' size leaves a quarter there.

In motion the errors of steps add up. The richer run has consistent masses, so that the functions which it adds fall
like the others; the inertia of the richer motion acts on all of them. Each of its steps is linearised at its own
positions, moved by the run's motion in this step.
"""

from collections.abc import Callable
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from liverjax.core import names
from liverjax.core.errors import InputError
from liverjax.core.struct import param, replace, struct
from liverjax.elements.gradients import volume_ratios
from liverjax.mesh.promotion import on_middles
from liverjax.physics.base import End
from liverjax.scenes.by_element import sponge_at_points
from liverjax.scenes.enriched import enriched
from liverjax.scenes.refined import REFINED, Within, can_be_refined, on_refined_mesh
from liverjax.scenes.regions import changed_numbers, laws_of, refused_name
from liverjax.scenes.scene import Scene
from liverjax.simulation import automatic, tangent
from liverjax.simulation.equations import (
    Equations,
    Sizes,
    State,
    advanced,
    equations,
    force_sizes,
    forces,
    initial_state,
    positions,
    residual,
    unknowns,
)
from liverjax.solvers.krylov import true_residual
from liverjax.solvers.point_matrix import restricted
from liverjax.solvers.problem import MOST_LINEAR_ITERATIONS

#: Tolerance of the linear solve: 1e-1 finds only a fifth of the error of a slender beam of quadratic elements. Then
#: the tolerance if pressures are unknowns, and the factor on du, both for linear elements and for
#: quadratic ones; and the error bar of a number, over its correction.
_TOLERANCE = 1e-2
_WITH_PRESSURES = {1: 1e-5, 2: 1e-4}
_FACTOR = {1: 1.0, 2: 1.5}
BAR = 1.25
#: K/mu up to which quadratic elements without pressures do not lock (experiments/TABLES.md).
_LOCKS = 10.0
#: With contact: most linear solves of a step, and the residual, over the forces at work, that ends them.
_ROUNDS, _SETTLED = 24, 1e-3
_WITH_FLUID = 1e-5
#: Most halvings of such a solve, if it makes the residual larger.
_HALVINGS = 4


@struct
class MeshError:
    """Estimated error of a run: what an infinitely fine mesh would add to its result."""

    positions: jax.Array = param("m", "(T, V, 3)")
    reactions: jax.Array = param("N", "(T, V, 3)")
    found: jax.Array = param("1", "(T,) whether the linear solve of the step ended, with finite numbers")
    pressure: jax.Array | None = param(
        "Pa", "(T, V), of a fluid; None: no fluid, or its pressures' error is not known", default=None
    )

    def change(self, of: Callable[[jax.Array, jax.Array], Any], result: Any) -> tuple[Any, Any]:
        """A number of interest and its estimated change: add it to correct, `BAR` times its size is the error bar.

        Args:
            of: (positions (T, V, 3), reactions (T, V, 3)) -> numbers, any pytree; its derivative along the error.
            result: `Result` of the run.
        """
        return jax.jvp(of, (result.positions, result.reactions), (self.positions, self.reactions))


def mesh_error_of(
    scene: Scene, positions: jax.Array, reactions: jax.Array, pressure: jax.Array | None = None
) -> MeshError:
    """The estimate for a run from the reference positions; its node numbers may not be traced.

    Args:
        scene: the scene that was run (`liverjax.simulation.run.prepared`).
        positions, reactions: of the run (T, V, 3).
        pressure: of the run (T, V), if it has a fluid.

    Raises:
        InputError: a scene of another mesh; the one-step scheme, whose error is not only the mesh's.
    """
    if positions.shape[1] != scene.mesh.number_of_nodes:
        raise InputError(
            f"result.positions has {positions.shape[1]} nodes, the scene {scene.mesh.number_of_nodes}: give the scene "
            "of the run"
        )
    return estimated_error(scene, richer(scene), positions, reactions, pressure)


@struct
class Richer:
    """A scene in the next richer space of functions."""

    scene: Scene = param("1", "the scene with richer elements, or on the refined mesh")
    within: Within | None = param("1", "where the nodes of a refined mesh lie; None: richer elements", default=None)

    def padded(self, x: jax.Array) -> jax.Array:
        """Positions (V, 3) of a run in the richer space: the same field."""
        rich = self.scene.mesh
        if self.within is not None:
            return self.within.field(x)
        if rich.order == 2:
            return on_middles(rich, x.T).T
        return jnp.concatenate([x, jnp.zeros((rich.number_of_nodes - len(x), 3), x.dtype)])

    def on_nodes(self, force: jax.Array, number_of_nodes: int) -> jax.Array:
        """Forces (V, 3) on the nodes of the run, from forces on the richer functions."""
        rich = self.scene.mesh
        if self.within is not None:
            return self.within.forces(force, number_of_nodes)
        if rich.order == 3:
            return force[:number_of_nodes]
        return jnp.stack([restricted(rich, column) for column in force.T], axis=-1)


def richer(scene: Scene) -> Richer:
    """The scene in the next richer space, as its error is estimated.

    Raises:
        InputError: as in `mesh_error_of`.
    """
    refuse(scene)
    if scene.porosity is not None and can_be_refined(scene):
        finer, within = on_refined_mesh(scene)
        solve = replace(finer.solve, linear_solver="cg", robust="off")
        return Richer(scene=replace(finer, solve=solve), within=within)
    return Richer(scene=_with_richer_elements(scene))


def _with_richer_elements(scene: Scene) -> Scene:
    rich = enriched(scene)
    # Linear elements lock: their error is measured against elements that do not. Quadratic ones do not at a low bulk
    # modulus, and have no pressures, which would have to be continuous where the material changes.
    of_linear = "auto" if _may_lock(scene) else "element"
    volumetric = of_linear if scene.mesh.order == 1 else scene.solve.volumetric
    # Under an indenter the iterations of mixed cubic elements do not end: factorise if the user has chosen it.
    mixed = scene.mesh.order == 2 and scene.solve.volumetric == "mixed"
    linear = "direct" if mixed and scene.solve.linear_solver == "direct" else "cg"
    solve = replace(rich.solve, linear_solver=linear, robust="off", volumetric=volumetric)
    sponge = None if rich.porosity is None else sponge_at_points(rich.porosity, rich.mesh)
    # With lumped masses the functions that the richer space adds would fall differently from the others.
    body = None if rich.body is None else replace(rich.body, mass="consistent")
    rich = replace(rich, law=rich.mesh.at_points(rich.law), porosity=sponge, body=body, solve=solve)
    return replace(rich, solve=replace(solve, volumetric=automatic.form_of_volumes(rich)))


def _may_lock(scene: Scene) -> bool:
    """Whether a bulk modulus is, or may be, more than `_LOCKS` times the shear modulus."""
    laws = list(laws_of(scene.law, scene.region))
    for region in scene.region:
        own = scene.law
        for name, value in changed_numbers(region).items():
            own = names.put(own, name, value, refused_name(name))
        laws.append(own)
    try:
        numbers = [(a.bulk_modulus(), a.shear_modulus()) for a in laws]
    except InputError:  # a law need not state its moduli
        return True
    if any(isinstance(a, jax.core.Tracer) for pair in numbers for a in pair):
        return True
    return any(bool(np.any(np.asarray(bulk) > _LOCKS * np.asarray(shear))) for bulk, shear in numbers)


def refuse(scene: Scene) -> None:
    """Refuse a scene for which this estimate cannot be made.

    Raises:
        InputError: the one-step scheme.
    """
    if scene.solve.newton == "one_step":
        raise InputError("solve.newton = 'one_step' leaves an error of its own: estimate that of a converged run")


@jax.jit
def estimated_error(
    scene: Scene, rich: Richer, x: jax.Array, reactions: jax.Array, pressure: jax.Array | None = None
) -> MeshError:
    """The estimate from positions and reactions (T, V, 3) and pressures (T, V) of the run, with the result of
    `richer`.
    """
    sizes = force_sizes(rich.scene)
    numbers = jnp.arange(1, len(x) + 1, dtype=x.dtype)
    before = jnp.concatenate([scene.mesh.points[None], x[:-1]])
    advance = partial(_step, scene, rich, sizes)
    rows = (numbers, before, x, reactions, pressure if rich.within is not None else None)
    _, (change, found) = jax.lax.scan(advance, initial_state(rich.scene), rows)
    factor = _FACTOR[scene.mesh.order] if rich.within is None else REFINED
    return MeshError(**jax.tree.map(lambda a: factor * a, change), found=found)


def _step(scene: Scene, rich: Richer, sizes: Sizes, state: State, given: Any) -> tuple[State, Any]:
    k, before, x, reactions, pressure = given
    e, one = equations(rich.scene, state, k, sizes), jnp.ones((), x.dtype)
    q = unknowns(e, rich.padded(x))
    begin = q
    if scene.solve.kind == "dynamic":
        # Errors of a motion add up: the richer run goes on from its own positions, by the run's motion in the step.
        begin = q + unknowns(e, state.x) - unknowns(e, rich.padded(before))
    near, (dq, iterations, positive) = _found_near(scene, e, begin)
    f, along = jax.linearize(lambda q: forces(e, q, one), near)
    whole = f.total + along(dq).total
    reaction = whole - e.free.vectors(whole)
    dq = near + dq - q
    # If du inverts elements, the richer run goes on from the positions of the run.
    sound = jnp.all(volume_ratios(e.mesh, positions(e, q + dq, one)) > 0) & jnp.all(jnp.isfinite(dq))
    end = forces(e, jnp.where(sound, q + dq, q), one)
    found = sound & positive & (iterations < MOST_LINEAR_ITERATIONS)
    change = {
        "positions": positions(e, q + dq, one)[: len(x)] - x,
        "reactions": rich.on_nodes(reaction, len(x)) - reactions,
        # The old nodes are vertices of the refined mesh.
        "pressure": None if pressure is None else end.pressure[: len(x)] - pressure,
    }
    return advanced(e, End(end.x, end.F, end.pressure)), (change, found)


#: A change, the iterations it took, whether the matrix was positive.
_Solved = tuple[jax.Array, jax.Array, jax.Array]


def _found_near(scene: Scene, e: Equations, q: jax.Array) -> tuple[jax.Array, _Solved]:
    """The point where the last linear solve begins, and its result.

    One solve from q, unless there may be contact: more solves find its points in the richer space.
    """
    one = jnp.ones((), q.dtype)
    tolerance = _TOLERANCE
    if e.volume is not None and e.volume.unknown:
        # Pressures begin at the step's beginning, far from its end: the load is much larger than the mesh's error.
        tolerance = _WITH_PRESSURES[scene.mesh.order]

    def solved(q: jax.Array) -> _Solved:
        f = forces(e, q, one)
        K = tangent.tangent(e, f.pressure, f.x, one)
        load = -residual(e, q, one)[0]
        dq, iterations, positive = tangent.solve(e, K, load, tolerance, MOST_LINEAR_ITERATIONS)
        # Iterations may break off without a sign.
        ended = true_residual(tangent.product(e, K), load, dq) <= 10 * tolerance
        return dq, iterations, positive & ended

    flows = e.volume is not None and e.volume.flow is not None
    if not any(a.kinked for a in e.nodal) and not flows:
        return q, solved(q)

    settled = _WITH_FLUID if flows else _SETTLED

    def size(q: jax.Array) -> jax.Array:
        r, force, _ = residual(e, q, one)
        return jnp.linalg.norm(r) / force

    def go_on(c: tuple) -> jax.Array:
        q, (dq, iterations, positive), k = c
        well = positive & (iterations < MOST_LINEAR_ITERATIONS) & jnp.all(jnp.isfinite(dq))
        return (k == 0) | (well & (k < _ROUNDS) & (size(q + dq) > settled))

    def again(c: tuple) -> tuple:
        q, (dq, _, _), k = c
        # The first round has no motion yet.
        q = q + jax.lax.cond(k == 0, lambda: one, lambda: _shortened(size, q, dq)) * dq
        return q, solved(q), k + 1

    nothing, none = (jnp.zeros_like(q), jnp.zeros((), jnp.int32), jnp.array(True)), jnp.zeros((), jnp.int32)
    q, (dq, iterations, positive), k = jax.lax.while_loop(go_on, again, (q, nothing, none))
    return q, (dq, iterations, positive & (k < _ROUNDS))


def _shortened(size: Callable[[jax.Array], jax.Array], q: jax.Array, dq: jax.Array) -> jax.Array:
    """The part of dq, halved `_HALVINGS` times at most, that leaves a smaller residual than at q."""
    before = size(q)

    def go_on(t: jax.Array) -> jax.Array:
        return ~(size(q + t * dq) < before) & (t > 0.5**_HALVINGS)

    return jax.lax.while_loop(go_on, lambda t: 0.5 * t, jnp.ones((), q.dtype))
