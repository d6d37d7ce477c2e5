"""Derivatives of a result of a run with respect to numbers of its scene.

    found = lj.value_and_gradient(lambda result: loss(result.positions), scene, {"law.mu": 770.0})

`jax.grad` through `simulate` gives the same derivatives. This module adds a status code, the choice between reverse and
forward mode, and a prediction of the required memory.
"""

import functools
from collections.abc import Callable, Mapping
from typing import Any

import jax
import jax.numpy as jnp

from liverjax.core import status
from liverjax.core.errors import InputError
from liverjax.core.struct import param, replace, struct
from liverjax.scenes.scene import Scene, with_parameters
from liverjax.scenes.scene_checks import check_before_run
from liverjax.simulation import automatic, gradient_checkpoints
from liverjax.simulation.equations import equations, initial_state, outputs, unknowns
from liverjax.simulation.run import Result, prepared, simulate
from liverjax.simulation.step import beginning

MODES = ("reverse", "forward")
#: This name in `at` means the positions at the beginning of the run. `with_parameters` explains the other names.
START = "start"


@struct
class Gradient:
    """A number computed from a run, and the derivatives of this number."""

    value: jax.Array = param("1", "()")
    gradient: dict = param("1", "name of a parameter -> derivative, with the shape of the parameter")
    status: jax.Array = param("1", "a code of `core.status`: GRADIENT_UNCONVERGED, ADJOINT_FAILED or CONVERGED")


def value_and_gradient(
    loss: Callable[[Result], jax.Array],
    scene: Scene,
    at: Mapping[str, object],
    store: str | int = "all",
    mode: str = "reverse",
) -> Gradient:
    """Compute the value of `loss` (Result -> number) and its gradient with respect to the numbers named in `at`.

    Args:
        loss: a function that JAX can differentiate. If the same function is given again, the compiled program is
            reused.
        scene: `Scene`.
        at: dotted names (see `with_parameters`) -> values that replace the values of the scene. The name "start" means
            the positions (V, 3) [m] at which the run begins, at rest.
        store: how many states reverse mode keeps: "all", "sqrt" (square root of the number of steps), or a number
            (see `gradient_checkpoints` and `memory`).
        mode: "reverse" or "forward". The cost of "reverse" does not grow with the number of parameters. "forward" needs
            no memory for the steps, but costs one run per parameter.

    Raises:
        InputError: `mode` or `store` is unknown; `at` is empty; a step has only one Newton iteration; the scene has no
            number with one of the names; or `simulate` would raise InputError.
    """
    if mode not in MODES:
        raise InputError(f"mode = {mode!r} is not known: use {' or '.join(MODES)}")
    if not at:
        raise InputError("no parameters are given for the derivatives: give e.g. {'law.mu': 770.0}")
    if automatic.is_one_step(scene.solve):
        raise InputError(
            "[solve] newton = 'one_step' (or newton_iterations = 1) has no correct derivatives: use newton = "
            "'converged' and more iterations"
        )
    gradient_checkpoints.number_kept(store, scene.solve.steps)
    values = {name: jnp.asarray(value, float) for name, value in at.items()}
    numbers = {name: value for name, value in values.items() if name != START}
    check_before_run(with_parameters(scene, numbers))
    scene = automatic.with_solver(scene, [numbers])
    return _program_of_gradient(loss, store, mode)(scene, values)


@functools.lru_cache(maxsize=32)
def _program_of_gradient(loss: Callable[[Result], jax.Array], store: str | int, mode: str) -> Callable:
    def run(values, scene):
        numbers = {name: value for name, value in values.items() if name != START}
        result = simulate(with_parameters(scene, numbers), start=values.get(START), store=store)
        value = loss(result)
        return value, (value, result.status)

    def both(scene, values):
        derivative = jax.grad if mode == "reverse" else jax.jacfwd
        gradient, (value, codes) = derivative(run, has_aux=True)(values, scene)
        finite = jnp.array([jnp.all(jnp.isfinite(g)) for g in jax.tree.leaves(gradient)]).all()
        unconverged = jnp.any(codes != status.CONVERGED)
        code = jnp.where(finite, status.CONVERGED, status.ADJOINT_FAILED)
        code = jnp.where(unconverged, status.GRADIENT_UNCONVERGED, code)
        return Gradient(value=value, gradient=gradient, status=code)

    return jax.jit(both)


#: Number of floating-point numbers per integration point that the derivative of one step stores, without the tangents
#: (measured).
_WORK = 440


def memory(scene: Scene, store: str | int = "all") -> int:
    """Predict the memory [bytes] for a derivative in reverse mode, without compilation.

    The arrays of the result and of the derivative with respect to its positions are included.
    For a loaded mesh, the memory for the search for its reference shape is not included.

    Raises:
        InputError: `store` is unknown, or `prepared` would raise InputError.
    """
    steps = scene.solve.steps
    kept = gradient_checkpoints.number_kept(store, steps)

    # The numbers of nodes and elements do not depend on the shape, so the reference shape is not computed.
    scene = prepared(replace(scene, points_are="reference"))

    def carry(scene):
        start = initial_state(scene)
        first = equations(scene, start, jnp.ones((), scene.mesh.points.dtype))
        return start, beginning(first)[0], unknowns(first, start.x), start.x, outputs(scene, start)

    state, tangent, root, positions, others = (_bytes(part) for part in jax.eval_shape(carry, scene))
    if scene.porosity is not None and scene.porosity.scheme == "implicit":
        root += scene.mesh.number_of_vertices * scene.mesh.points.dtype.itemsize
    stored, again = steps * (state + root), 0
    if kept < steps:
        count, length, rest = gradient_checkpoints.lengths(steps, kept)
        stored, again = (count + (rest > 0)) * (state + tangent), length * (state + root)
    # There are two tangents: the tangent of a step, and the tangent of the beginning of the run. For each step, the
    # forward run stores three arrays with the size of the positions, and the fluid pressures. The reverse run stores
    # the derivatives with respect to the positions, and needs the working memory of one step.
    forward = stored + steps * (3 * positions + others) + 2 * tangent
    work = _WORK * scene.mesh.weights.size * scene.mesh.points.dtype.itemsize
    return max(forward, stored + again + steps * positions + 2 * tangent + work)


def _bytes(tree: Any) -> int:
    return sum(leaf.size * leaf.dtype.itemsize for leaf in jax.tree.leaves(tree))
