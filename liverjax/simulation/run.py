"""Run a scene in load steps or time steps. Each step is a Newton solve with implicit differentiation."""

from collections.abc import Callable
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from liverjax.core import status
from liverjax.core.errors import InputError
from liverjax.core.struct import Number, in_precision, param, replace, struct
from liverjax.mesh.tetrahedra import with_points
from liverjax.scenes.by_element import by_element
from liverjax.scenes.scene import Scene
from liverjax.scenes.scene_checks import check_before_run, check_time_and_mass
from liverjax.simulation import automatic, gradient_checkpoints
from liverjax.simulation.equations import Sizes, State, equations, force_sizes, initial_state, outputs
from liverjax.simulation.mesh_error import MeshError, mesh_error_of, refuse
from liverjax.simulation.step import beginning, step
from liverjax.simulation.unloaded import Unloaded, unload
from liverjax.solvers.problem import StepStatistics


@struct
class Result:
    """Result of a run: arrays over the T steps. Positions, reactions and pressures are differentiable."""

    times: jax.Array = param("s", "(T,); numbers of the load steps if there is no time")
    positions: jax.Array = param("m", "(T, V, 3)")
    reactions: jax.Array = param("N", "(T, V, 3), force of the supports on the body, 0 where nothing is prescribed")
    status: jax.Array = param("1", "(T,) result codes of `liverjax.core.status`")
    pressure: jax.Array | None = param("Pa", "(T, V), fluid pressure of a porous body", default=None)
    statistics: StepStatistics = param("1", "for each step: iterations, halved substeps, residual")
    mesh_error: MeshError | None = param("1", "estimated mesh error; None: not estimated", default=None)

    def check(self) -> "Result":
        """Return this result, or raise `RuntimeError` with advice if a step failed."""
        codes = np.asarray(self.status)
        failed = np.argwhere(codes != status.CONVERGED)
        if len(failed):
            first = tuple(failed[0])
            run = f"run {', '.join(map(str, first[:-1]))} (counted from 0), " if len(first) > 1 else ""
            raise RuntimeError(f"{run}step {first[-1] + 1}: {status.advice(codes[first])}")
        return self


def _step_by_step(
    scene: Scene, sizes: Sizes, report: Callable[[int], None] | None, near: Any, differentiable: bool = True
) -> Callable:
    """Return a function (state and tangent, k) -> (state and tangent after step k, output of step k for `_result`)."""

    def physics(carry, k):
        state, kept = carry
        new, reactions, statistics, kept = step(equations(scene, state, k, sizes), kept, near, differentiable)
        # If a new state is not finite, the run stays at the last finite state.
        finite = jnp.array([jnp.all(jnp.isfinite(leaf)) for leaf in jax.tree.leaves((new, reactions))]).all()
        good = finite & (statistics.status != status.NOT_FINITE)
        statistics = statistics._replace(status=jnp.where(finite, statistics.status, status.NOT_FINITE))
        new = jax.tree.map(lambda a, b: jnp.where(good, a, b), new, state)
        P = outputs(scene, new).get("pressure")
        kept = kept._replace(made=kept.made & good)
        return (new, kept), (new.x, jnp.where(good, reactions, 0.0), P, statistics)

    one_step = gradient_checkpoints.one_step(physics) if differentiable else physics

    def advance(carry, k):
        new = one_step(carry, k)
        if report is not None:
            jax.debug.callback(report, k)
        return new

    return advance


def _result(scene: Scene, numbers: jax.Array, out: Any) -> Result:
    x, reactions, P, statistics = out
    times, code = numbers * (1.0 if scene.solve.dt is None else scene.solve.dt), statistics.status
    return Result(times=times, positions=x, reactions=reactions, pressure=P, status=code, statistics=statistics)


@partial(jax.jit, static_argnames=("report", "store"))
def _run(scene: Scene, begin: jax.Array | None, report: Callable[[int], None] | None, store: Any) -> Result:
    steps, dtype = scene.solve.steps, scene.mesh.points.dtype
    sizes = force_sizes(scene)
    numbers = jnp.arange(1, steps + 1, dtype=dtype)
    start = initial_state(scene, begin)
    first = equations(scene, start, numbers[0], sizes)
    # In a run of several steps, all solves for derivatives use the coarse space of the first step.
    kept, near = beginning(first, tangent_too=steps > 1)
    advance = _step_by_step(scene, sizes, report, near)
    return _result(scene, numbers, gradient_checkpoints.scan(advance, (start, kept), numbers, store))


@partial(jax.jit, static_argnames="report")
def _run_part(
    scene: Scene, state: State, numbers: jax.Array, report: Callable[[int], None] | None
) -> tuple[Result, State]:
    sizes = force_sizes(scene)
    kept, _ = beginning(equations(scene, state, numbers[0], sizes))
    # With `inline`, JAX traces the function only once, for `eval_shape` and for the compiled program.
    advance = jax.jit(_step_by_step(scene, sizes, report, None, differentiable=False), inline=True)

    def unless_over(carry, k):
        nothing = jax.tree.map(lambda a: jnp.zeros(a.shape, a.dtype), jax.eval_shape(advance, carry, k)[1])
        return jax.lax.cond(k <= scene.solve.steps, advance, lambda carry, _: (carry, nothing), carry, k)

    (state, _), out = jax.lax.scan(unless_over, (state, kept), numbers)
    return _result(scene, numbers, out), state


def simulate(
    scene: Scene,
    report: Callable[[int], None] | None = None,
    start: jax.Array | None = None,
    store: str | int = "all",
    mesh_error: bool = False,
) -> Result:
    """Run a scene. This function may be differentiated, vmapped and jitted. See `Result` and `Result.check`.

    Args:
        scene: `Scene`.
        start: positions (V, 3) [m] at which the run begins, at rest, as if the body had just been moved there from the
            reference positions. No stress has relaxed yet, and the fluid responds to the change of volume in the first
            step. None: the reference positions. If elements are inverted at `start`, use robust = "projected". With
            this setting, a static scene uses `start` only as a guess. If the guess is inverted or does not lead to a
            solution, the run begins at the reference positions.
        report: a Python function that is called with the number of each finished step, to show progress.
        store: number of states that reverse mode keeps: "all" (the end of every step), a whole number, or "sqrt" (the
            square root of the number of steps). The steps between kept states run a second time. Without derivatives
            `store` has no effect. See `liverjax.simulation.gradients`.
        mesh_error: whether to estimate the mesh error (`liverjax.simulation.mesh_error`). Then the run must begin at
            the reference positions, and the mesh must not be "loaded". The estimate can be differentiated in forward
            mode only. If the moduli are unknown inside jit or vmap, the estimate for linear elements uses the elements
            for nearly incompressible bodies. For compressible bodies it then differs by some per cent.

    Raises:
        InputError: unknown choices; harmonic motion or a reduced model; a time step or a mass is missing; numbers out
            of bounds; a loaded mesh for which no reference shape is found; precision "float64" although JAX's 64-bit
            mode is off; a wrong shape of `start`; `mesh_error` together with a loaded mesh, `start` or the one-step
            scheme, or inside jit if the mesh is an argument of the compiled function. Inside jit, grad or vmap, numbers
            are not checked. If no reference shape is found there, the points are NaN and the status of the steps is
            NOT_FINITE. `check_scene`, which is called when a scene file is read, checks more: the mesh, the shear
            modulus, the positions of obstacles, and whether the supports prevent rigid motions.
    """
    if mesh_error:
        refuse(scene)
    scene = prepared(scene)
    check_time_and_mass(scene)
    if start is not None:
        start = jnp.array(start, scene.mesh.points.dtype)
        if start.shape != scene.mesh.points.shape:
            raise InputError(
                f"the argument start has shape {start.shape}: give positions of shape {scene.mesh.points.shape}"
            )
        if mesh_error:
            raise InputError("mesh_error = True needs a run from the reference positions: remove start")
    result = _run(scene, start, report, gradient_checkpoints.number_kept(store, scene.solve.steps))
    if not mesh_error:
        return result
    return replace(result, mesh_error=mesh_error_of(scene, result.positions, result.reactions, result.pressure))


def simulate_part(
    scene: Scene,
    state: State,
    first: Number,
    count: int,
    report: Callable[[int], None] | None = None,
) -> tuple[Result, State]:
    """Run some steps. Return their results and the final state, so that a long run can be stored in parts.

    This function is not differentiable. Every part of the run begins with a new tangent, whether the run was
    interrupted or not. So a run that continues from a stored state gives exactly the same result.

    Args:
        scene: `Scene`.
        state: state after the previous step; at the beginning `initial_state(prepared(scene))`.
        first: number of the first step, from 1; may be unknown during compilation.
        count: number of steps. Steps after the last step of the scene are skipped; their results are zeros.
        report: the same argument as for `simulate`.

    Raises:
        InputError: in the same cases as `simulate`, and if `first` is below 1.
    """
    if not isinstance(first, jax.core.Tracer) and first < 1:
        raise InputError(f"the argument first = {first} must be 1 or more: steps are counted from 1")
    scene = prepared(scene)
    check_time_and_mass(scene)
    numbers = first + jnp.arange(count, dtype=scene.mesh.points.dtype)
    return _run_part(scene, state, numbers, report)


def prepared(scene: Scene) -> Scene:
    """Prepare a scene for its run.

    Each number gets one value per element, a linear solver is chosen, and numbers are converted to the scene's
    precision. If the mesh of the scene is "loaded", the reference shape is computed.

    `simulate` calls this function. But inside `jax.jit` the numbers are unknown, so `linear_solver = "auto"` then means
    conjugate gradients. Call this function before `jax.jit` if a factorisation may be chosen.

    Raises:
        InputError: in the same cases as `simulate`, but a time step or a mass may be missing.
    """
    scene = _ready(scene)
    if scene.solve.kind == "harmonic":
        raise InputError(
            "[solve] kind = 'harmonic' has no time steps: run python -m liverjax simulate, or call lj.harmonic(scene)"
        )
    return unload(scene).scene if scene.points_are == "loaded" else scene


def unloaded(scene: Scene) -> Unloaded:
    """Return the scene with the reference shape that the loads deform into the given mesh.

    The reference points have derivatives with respect to all numbers of the scene. The loads have their values
    at the beginning of the run: histories have their value at time 0, and prescribed motion has not begun. The body has
    been under these loads for a long time, so viscous stress has relaxed. Under load the vertices of quadratic elements
    are at the given positions. In the reference shape the edges of these elements are straight. In harmonic motion the
    tractions cause only the vibration, so they do not act here.

    Raises:
        InputError: in the same cases as `simulate`, but harmonic motion is allowed; the scene has a porous body or a
            rigid plate; no reference shape was found (inside jit, grad or vmap the points are NaN instead).
    """
    loaded = replace(scene, points_are="loaded", traction=() if scene.solve.kind == "harmonic" else scene.traction)
    found = unload(_ready(loaded))
    whole = replace(scene, mesh=with_points(scene.mesh, found.scene.mesh.points), points_are="reference")
    return found._replace(scene=whole)


def _ready(scene: Scene) -> Scene:
    """Prepare a scene for its run as `prepared` does, but keep the given points."""
    check_before_run(scene)
    if scene.solve.reduced:
        file = scene.solve.reduced
        raise InputError(
            f"[solve] reduced = {file!r} is only for python -m liverjax simulate: in Python, remove reduced and call "
            "lj.simulate_reduced(lj.load_reduced(file), scene)"
        )
    scene = automatic.chosen(by_element(scene))
    if scene.solve.precision == "float32":
        scene = jax.tree.map(partial(in_precision, dtype=jnp.float32), scene)
    elif jnp.result_type(float) != jnp.float64:  # 64-bit mode is off
        raise InputError("precision = 'float64' needs JAX's 64-bit mode: unset JAX_ENABLE_X64, or use float32")
    return scene
