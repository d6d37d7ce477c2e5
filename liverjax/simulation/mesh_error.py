"""Estimate the error of a run due to the mesh. Each step needs one linearised solve in a richer space of functions.

The richer space has quadratic functions for linear elements, and cubic functions for quadratic elements. The richer
space contains the positions of a step exactly. In the richer space these positions are not in equilibrium: the
out-of-balance forces are r. With the tangent stiffness K, the estimated change of the displacements is du = -K^-1 r.
The estimated change of the reactions is their derivative in the direction du. A second run, in the richer space, is
computed step by step together with the first run. The second run has separate internal variables of viscosity, fluid
and inertia. In the richer space a surface touches an obstacle at other points than in the first run. With contact, the
solves are therefore repeated until these contact points are found. After only one solve, the estimated error of the
force on a flat punch was 25 %, although the true error was 1 %.

The estimate is hierarchical (Bank and Smith 1993). For linear elements du is 0.8 to 1.3 times the true error, at small
and moderate strain. If du is added to the result, about a tenth of the error is left. For quadratic elements the cubic
functions represent about two thirds of the error, so du is multiplied by 1.5. The estimate does not contain the errors
of the body's shape and of the time steps.

The pressures of a fluid are linear both in linear and in quadratic elements. With a fluid, the richer space therefore
has the same elements on a finer mesh: every element is cut into eight (`liverjax.scenes.refined`). Then du is
multiplied by 4/3, because an error of second order is a quarter as large on the finer mesh.

In dynamics the errors of the steps accumulate. The second run (richer run) has consistent masses, so that the added
functions have the same acceleration under gravity as the other functions. The inertia forces follow from the
accelerations of the richer run. Each step is linearised at the positions of the richer run before the step, plus the
displacement of the first run in this step.
"""

import warnings
from collections.abc import Callable, Mapping
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from liverjax.core import names
from liverjax.core.errors import InputError
from liverjax.core.struct import in_precision, param, replace, struct
from liverjax.elements.gradients import volume_ratios
from liverjax.mesh.promotion import on_middles
from liverjax.mesh.tetrahedra import TetMesh
from liverjax.physics.base import End
from liverjax.scenes.by_element import sponge_at_points
from liverjax.scenes.enriched import enriched
from liverjax.scenes.refined import REFINED, Within, can_be_refined, on_refined_mesh, refuse_traced
from liverjax.scenes.regions import changed_numbers, laws_of, refused_name
from liverjax.scenes.scene import Scene, with_parameters
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
    reported_forces,
    residual,
    unknowns,
)
from liverjax.solvers.krylov import true_residual
from liverjax.solvers.point_matrix import restricted
from liverjax.solvers.problem import MOST_LINEAR_ITERATIONS

#: Relative tolerance of the linear solve. With a tolerance of 1e-1, the estimate for a slender beam of quadratic
#: elements would be only a fifth of the true error.
_TOLERANCE = 1e-2
#: Key: order of the elements. _WITH_PRESSURES: tolerance of the linear solve if pressures are unknowns. _FACTOR: factor
#: that multiplies du.
_WITH_PRESSURES = {1: 1e-5, 2: 1e-4}
_FACTOR = {1: 1.0, 2: 1.5}
#: Error bar of a quantity, divided by the estimated change of this quantity.
BAR = 1.25
#: If bulk modulus / shear modulus is at most this value, quadratic elements without pressure unknowns are not too stiff
#: (do not lock; see `experiments/TABLES.md`).
_LOCKS = 10.0
#: With contact or a flowing fluid, the linear solve of a step is repeated. _ROUNDS: maximum number of solves. _SETTLED:
#: with contact, the solves end if the residual, divided by the sum of the norms of all forces, is below this value.
_ROUNDS, _SETTLED = 24, 1e-3
#: With a flowing fluid, the solves end if the relative residual (as for `_SETTLED`) is below this value. One solve is
#: not exact, because it only approximates the inverse of the pressure matrix (`liverjax.physics.darcy.nearly_solved`).
_WITH_FLUID = 1e-5
#: If the change dq from a repeated solve does not reduce the residual, dq is halved, at most this number of times.
_HALVINGS = 4


@struct
class MeshError:
    """Estimated mesh error of a run of T steps: how the result would change on an infinitely fine mesh.

    If `found` is false for a step, the numbers of this step show only the order of magnitude of the error.
    """

    positions: jax.Array = param("m", "(T, V, 3)")
    reactions: jax.Array = param("N", "(T, V, 3)")
    found: jax.Array = param("1", "(T,) whether the solves of the step converged and no element was inverted")
    pressure: jax.Array | None = param(
        "Pa", "(T, V), of a fluid; None: no fluid, or the error of its pressures is unknown", default=None
    )
    added: jax.Array | None = param(
        "m",
        "(T, A, 3) coefficients of the A richer shape functions that the run does not have; None: on a refined mesh",
        default=None,
    )

    def change(self, of: Callable[[jax.Array, jax.Array], Any], result: Any) -> tuple[Any, Any]:
        """Return a quantity of interest and its estimated change on an infinitely fine mesh.

        The sum of both is the corrected quantity. The error bar is `BAR` times the absolute value of the change. A
        warning is given if `found` is false for a step (not inside jit).

        Args:
            of: function (positions (T, V, 3), reactions (T, V, 3)) -> the quantity, as a pytree of numbers. The change
                is the derivative of this function in the direction of the estimated error.
            result: `Result` of the run.
        """
        if not isinstance(self.found, jax.core.Tracer) and not np.all(self.found):
            found = np.asarray(self.found)
            steps = 1 + np.flatnonzero(~found.reshape(-1, found.shape[-1]).all(axis=0))  # failed steps, in any run
            warnings.warn(
                f"the mesh error is not reliable in {len(steps)} of {found.shape[-1]} steps (the first is step "
                f"{steps[0]}), because its solves did not converge or it inverts elements: use a finer mesh",
                stacklevel=2,
            )
        return jax.jvp(of, (result.positions, result.reactions), (self.positions, self.reactions))


def mesh_error_of(
    scene: Scene,
    positions: jax.Array,
    reactions: jax.Array,
    pressure: jax.Array | None = None,
    finer: Callable[[TetMesh], Mapping[str, Any]] | None = None,
) -> MeshError:
    """Estimate the mesh error of a run that began at the reference positions.

    The node numbers of the scene must be known (not inside jit), and the arrays must contain all steps of the run.
    Call `refuse` before `prepared`: a prepared scene no longer shows that its mesh was loaded.

    Args:
        scene: the scene that was run (`liverjax.simulation.run.prepared`).
        positions, reactions: positions [m] and reactions [N] of the run (T, V, 3) with T steps.
        pressure: pressures [Pa] of the run (T, V), if it has a fluid.
        finer: function of a richer mesh (E elements with Q integration points) -> dotted names with values (Q, E), or
            (E,) if Q = 1. These values replace the numbers of the scene, which do not vary enough within an element.
            The estimate then also contains the error due to these numbers.

    Raises:
        InputError: the scene has another mesh than the run, or uses the one-step scheme, which has an additional error.
    """
    if positions.shape[1] != scene.mesh.number_of_nodes:
        raise InputError(
            f"result.positions has {positions.shape[1]} nodes, but the scene has {scene.mesh.number_of_nodes}: give "
            "the scene of the run"
        )
    rich = richer(scene)
    if finer is not None:
        changed = with_parameters(rich.scene, finer(rich.scene.mesh))
        precise = partial(in_precision, dtype=rich.scene.mesh.points.dtype)
        rich = replace(rich, scene=jax.tree.map(precise, changed))
    return estimated_error(scene, rich, positions, reactions, pressure)


@struct
class Richer:
    """A scene in a richer space of functions: with elements of the next order, or on a refined mesh."""

    scene: Scene = param("1", "the scene with richer elements, or on the refined mesh")
    within: Within | None = param(
        "1", "positions of the refined nodes in the mesh; None: richer elements", default=None
    )

    def padded(self, x: jax.Array) -> jax.Array:
        """Convert positions x (V, 3) of the run to coefficients in the richer space. They describe the same field."""
        rich = self.scene.mesh
        if self.within is not None:
            return self.within.field(x)
        if rich.order == 2:
            return on_middles(rich, x.T).T
        return jnp.concatenate([x, jnp.zeros((rich.number_of_nodes - len(x), 3), x.dtype)])

    def added(self, x: jax.Array, number_of_nodes: int) -> jax.Array | None:
        """Return the coefficients (A, 3) [m] of the A functions that the run does not have, from richer positions x."""
        rich = self.scene.mesh
        if self.within is not None:
            return None
        if rich.order == 3:
            return x[number_of_nodes:]
        return (x - on_middles(rich, x[:number_of_nodes].T).T)[number_of_nodes:]

    def on_nodes(self, force: jax.Array, number_of_nodes: int) -> jax.Array:
        """Convert forces on the functions of the richer space to forces (V, 3) [N] on the nodes of the run."""
        rich = self.scene.mesh
        if self.within is not None:
            return self.within.forces(force, number_of_nodes)
        if rich.order == 3:
            return force[:number_of_nodes]
        return jnp.stack([restricted(rich, column) for column in force.T], axis=-1)


def richer(scene: Scene) -> Richer:
    """Create the scene in a richer space of functions (elements of the next order, or a refined mesh).

    Raises:
        InputError: the mesh is loaded or an argument of a compiled function, or the scene uses the one-step scheme.
    """
    refuse(scene)
    if scene.porosity is not None and can_be_refined(scene):
        finer, within = on_refined_mesh(scene)
        solve = replace(finer.solve, linear_solver="cg", robust="off")
        return Richer(scene=replace(finer, solve=solve), within=within)
    return Richer(scene=_with_richer_elements(scene))


def _with_richer_elements(scene: Scene) -> Scene:
    rich = enriched(scene)
    # Linear elements lock (are too stiff), so they are compared with elements that do not lock. If the bulk modulus is
    # low, quadratic elements do not lock even without pressure unknowns. Then pressure unknowns are not used, because
    # nodal pressures would be continuous even where the material changes.
    of_linear = "auto" if _may_lock(scene) else "element"
    volumetric = of_linear if scene.mesh.order == 1 else scene.solve.volumetric
    # Under an indenter, iterative solves for cubic elements with pressure unknowns do not converge, so the choice
    # "direct" is kept.
    mixed = scene.mesh.order == 2 and scene.solve.volumetric == "mixed"
    linear = "direct" if mixed and scene.solve.linear_solver == "direct" else "cg"
    solve = replace(rich.solve, linear_solver=linear, robust="off", volumetric=volumetric)
    sponge = None if rich.porosity is None else sponge_at_points(rich.porosity, rich.mesh)
    # With lumped masses, the added functions would have a different acceleration under gravity.
    body = None if rich.body is None else replace(rich.body, mass="consistent")
    law, unrelaxed = rich.mesh.at_points((rich.law, rich.unrelaxed))
    rich = replace(rich, law=law, unrelaxed=unrelaxed, porosity=sponge, body=body, solve=solve)
    return replace(rich, solve=replace(solve, volumetric=automatic.form_of_volumes(rich)))


def _may_lock(scene: Scene) -> bool:
    """Return whether bulk modulus / shear modulus exceeds `_LOCKS` in any material.

    Inside `jax.jit` and `jax.vmap` the moduli may be unknown. Then the result is True.
    """
    laws = list(laws_of(scene.law, scene.region))
    for region in scene.region:
        own = scene.law
        for name, value in changed_numbers(region).items():
            own = names.put(own, name, value, refused_name(name))
        laws.append(own)
    try:
        with jax.ensure_compile_time_eval():  # inside `jax.jit`, constant moduli are known
            numbers = [(jnp.asarray(a.bulk_modulus()), jnp.asarray(a.shear_modulus())) for a in laws]
            return any(bool(jnp.any(bulk > _LOCKS * shear)) for bulk, shear in numbers)
    except (InputError, jax.errors.ConcretizationTypeError):  # a law may have no moduli
        return True


def refuse(scene: Scene) -> None:
    """Check that the mesh error of a scene can be estimated.

    If the mesh is loaded, the reference shape also has a mesh error. At the end of a static run this error and the
    error of the run cancel, but the estimate contains only the error of the run.

    Raises:
        InputError: the mesh is loaded or an argument of a compiled function, or the scene uses the one-step scheme.
    """
    refuse_traced(scene.mesh)
    if scene.points_are == "loaded":
        raise InputError(
            '[mesh] is = "loaded": the mesh error is unknown, because the reference shape also depends on the mesh: '
            "compare with a run on a finer mesh, without an estimate of the mesh error"
        )
    if automatic.is_one_step(scene.solve):
        raise InputError(
            "[solve] newton = 'one_step' has an additional error: use newton = 'converged' to estimate the mesh error"
        )


@jax.jit
def estimated_error(
    scene: Scene, rich: Richer, x: jax.Array, reactions: jax.Array, pressure: jax.Array | None = None
) -> MeshError:
    """Estimate the mesh error from positions x, reactions (T, V, 3) and pressures (T, V) of T steps.

    `rich` is `richer(scene)`.
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
        # In dynamics errors accumulate. So the solve begins at the richer run's positions before the step, plus the
        # displacement of the first run in this step.
        begin = q + unknowns(e, state.x) - unknowns(e, rich.padded(before))
    near, (dq, iterations, positive) = _found_near(scene, e, begin)
    f, along = jax.linearize(lambda q: forces(e, q, one), near)
    there = positions(e, near + dq, one)
    whole, _ = reported_forces(e, f.total + along(dq).total, there)
    reaction = whole - e.free.vectors(whole, there)
    dq = near + dq - q
    # If the change dq inverts elements, the richer run continues from the positions of the first run.
    sound = jnp.all(volume_ratios(e.mesh, positions(e, q + dq, one)) > 0) & jnp.all(jnp.isfinite(dq))
    end = forces(e, jnp.where(sound, q + dq, q), one)
    found = sound & positive & (iterations < MOST_LINEAR_ITERATIONS)
    after = positions(e, q + dq, one)
    change = {
        "positions": after[: len(x)] - x,
        "added": rich.added(after, len(x)),
        "reactions": rich.on_nodes(reaction, len(x)) - reactions,
        # The nodes of the run are the first vertices of the refined mesh.
        "pressure": None if pressure is None else end.pressure[: len(x)] - pressure,
    }
    by_end_forces = reported_forces(e, end.total, end.x)[1]
    return advanced(e, End(end.x, end.F, end.pressure), by_end_forces), (change, found)


#: Result of a linear solve: the change dq, the number of iterations, and whether the solve succeeded.
_Solved = tuple[jax.Array, jax.Array, jax.Array]


def _found_near(scene: Scene, e: Equations, q: jax.Array) -> tuple[jax.Array, _Solved]:
    """Return the unknowns of the last linearisation, and the solution of the linear system at these unknowns.

    Without contact and without a flowing fluid, there is one solve, at q. With contact, more solves are needed to find
    the contact points in the richer space. With a flowing fluid, more solves are needed because one solve is not exact.
    """
    one = jnp.ones((), q.dtype)
    tolerance = _TOLERANCE
    if e.volume is not None and e.volume.unknown:
        # The solve starts at the pressures before the step, so its right-hand side is much larger than the residual
        # that the mesh error causes.
        tolerance = _WITH_PRESSURES[scene.mesh.order]

    def solved(q: jax.Array) -> _Solved:
        f = forces(e, q, one)
        K = tangent.tangent(e, f.pressure, f.x, one)

        def along(dq: jax.Array) -> jax.Array:
            return jax.jvp(lambda q: residual(e, q, one)[0], (q,), (dq,))[1]

        def solve(_: Callable, load: jax.Array) -> tuple[jax.Array, tuple[jax.Array, jax.Array]]:
            dq, iterations, positive = tangent.solve(e, K, load, tolerance, MOST_LINEAR_ITERATIONS)
            # The solver does not report every breakdown, so the true residual is checked.
            ended = true_residual(tangent.product(e, K), load, dq) <= 10 * tolerance
            return dq, (iterations, positive & ended)

        # K is a constant for JAX. So JAX takes the derivative of K dq from `along`, which is the same product.
        load = -residual(e, q, one)[0]
        dq, (iterations, positive) = jax.lax.custom_linear_solve(along, load, solve, has_aux=True)
        return dq, iterations, positive

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
        # Before the first solve, dq is 0.
        q = q + jax.lax.cond(k == 0, lambda: one, lambda: _shortened(size, q, dq)) * dq
        return q, solved(q), k + 1

    nothing, none = (jnp.zeros_like(q), jnp.zeros((), jnp.int32), jnp.array(True)), jnp.zeros((), jnp.int32)
    q, (dq, iterations, positive), k = jax.lax.while_loop(go_on, again, (q, nothing, none))
    return q, (dq, iterations, positive & (k < _ROUNDS))


def _shortened(size: Callable[[jax.Array], jax.Array], q: jax.Array, dq: jax.Array) -> jax.Array:
    """Return the step length t. From 1 it is halved (at most `_HALVINGS` times) until q + t dq has a smaller residual
    than q."""
    before = size(q)

    def go_on(t: jax.Array) -> jax.Array:
        return ~(size(q + t * dq) < before) & (t > 0.5**_HALVINGS)

    return jax.lax.while_loop(go_on, lambda t: 0.5 * t, jnp.ones((), q.dtype))
