"""Run a scene step by step, while a spring pulls on one of the nodes.

The spring is a `Ligament`. Only the numbers of this spring change from step to step, so one compiled program is used
for all steps.
"""

from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from liverjax.core import status
from liverjax.core.compiled import compiled
from liverjax.core.errors import InputError
from liverjax.core.struct import replace
from liverjax.mesh.selection import boundary_triangles
from liverjax.physics.attached.ligament import Ligament
from liverjax.scenes.scene import Scene
from liverjax.simulation.equations import State, initial_state
from liverjax.simulation.run import prepared, simulate_part

#: Number of steps of the scene, so large that the run never ends.
STEPS = 10**9
#: Rest length of the spring, divided by the size of the body. A spring of length 0 would have no direction.
SLACK = 1e-3
#: Stiffness of the spring while the user does not pull, divided by its stiffness during a pull.
NOTHING = 1e-12


class Playing(NamedTuple):
    """A body at one instant, and the compiled program for the next step."""

    scene: Scene
    program: Callable[..., Any]
    state: State
    step: int  # number of finished steps
    size: float  # diagonal of the body's box [m]
    nodes: np.ndarray  # (n,) node numbers of the surface
    triangles: np.ndarray  # (m, 3) triangles of the surface, as indices into `nodes`
    positions: np.ndarray  # positions of all nodes (V, 3) [m]
    code: int = status.CONVERGED  # status of the last step

    @property
    def time(self) -> float:
        """Simulated time [s], or the number of the step in a scene without time."""
        dt = self.scene.solve.dt
        return self.step * (1.0 if dt is None else float(dt))

    @property
    def stiffness(self) -> float:
        """Stiffness [N/m] of the spring during a pull: shear modulus times a twentieth of the body's size."""
        return float(np.mean(np.asarray(self.scene.law.shear_modulus()))) * self.size / 20


def at_rest(scene: Scene) -> Playing:
    """Return the body before the first step, with the compiled program for a step. A scene with time steps dt starts in
    its initial state. A scene without dt starts at the end of its load steps.

    Raises:
        InputError: the scene is harmonic, `simulate` cannot run the scene, or one of its load steps fails.
    """
    if scene.solve.kind == "harmonic":
        raise InputError("[solve] kind = 'harmonic' cannot be used here: give a static or a dynamic scene")
    points = np.asarray(scene.mesh.points)
    size = float(np.linalg.norm(np.ptp(points, axis=0)))
    spring = Ligament(
        nodes=jnp.zeros((1, 1), jnp.int32),
        weights=jnp.ones((1, 1)),
        to=jnp.asarray(points[0] + size),
        stiffness=jnp.asarray(NOTHING),
        rest_length=jnp.asarray(SLACK * size),
    )
    solve = replace(scene.solve, reduced="")
    scene = prepared(_with_histories(replace(scene, physics=(*scene.physics, spring), solve=solve)))
    state = initial_state(scene) if scene.solve.dt is not None else _after_load_steps(scene)
    scene = replace(scene, solve=replace(scene.solve, steps=STEPS))
    program = compiled(partial(simulate_part, count=1), scene, state, 1.0)
    nodes, triangles = np.unique(boundary_triangles(scene.mesh), return_inverse=True)
    return Playing(scene, program, state, 0, size, nodes, triangles.reshape(-1, 3), np.asarray(state.x))


def _with_histories(scene: Scene) -> Scene:
    """Return the scene with a history for prescribed motions and forces that have none. Without a history they would
    grow until step `STEPS`. With it, they grow during the planned time of the scene, and are constant afterwards."""
    if scene.solve.dt is None:
        return scene
    table = {"times": scene.solve.steps * scene.solve.dt * jnp.array([0.0, 1.0]), "history": jnp.array([0.0, 1.0])}

    def grows(part: object, field: str) -> bool:
        return getattr(part, field, None) is not None and getattr(part, "history", None) is None

    displaced = tuple(replace(d, **table) if grows(d, "by") else d for d in scene.displaced)
    physics = tuple(replace(p, **table) if grows(p, getattr(p, "driven", "")) else p for p in scene.physics)
    return replace(scene, displaced=displaced, physics=physics)


def _after_load_steps(scene: Scene) -> State:
    """Return the state of the body after all load steps of a scene without time."""
    count = scene.solve.steps
    program = compiled(partial(simulate_part, count=count), scene, initial_state(scene), 1.0)
    result, state = program(scene, initial_state(scene), 1.0)
    for step, code in enumerate(np.asarray(result.status), 1):
        if code not in (status.CONVERGED, status.ONE_STEP):
            raise InputError(f"load step {step} of {count} failed before the first pull: {status.advice(code)}")
    return state


def pulled(playing: Playing, node: int | None = None, to: np.ndarray | None = None, stiffness: float = 0.0) -> Playing:
    """Return the body after one more step. If the step fails, only `code` changes.

    Args:
        playing: the body before the step.
        node: number of the node that is pulled; None: no node is pulled.
        to: position (3,) [m] of the free end of the spring.
        stiffness: stiffness of the spring [N/m].

    Raises:
        InputError: the node does not exist, or `to` or `stiffness` cannot be used.
    """
    *others, spring = playing.scene.physics
    if node is None:
        spring = replace(spring, stiffness=jnp.asarray(NOTHING * playing.stiffness))
    else:
        end = _end_of_spring(playing, node, to, stiffness)
        off = playing.positions[node] - end
        if np.linalg.norm(off) < 0.5 * SLACK * playing.size:  # a spring of length 0 has no direction
            end = end + 0.5 * SLACK * playing.size * np.array([1.0, 0.0, 0.0])
        spring = replace(
            spring, nodes=jnp.full((1, 1), node, jnp.int32), to=jnp.asarray(end), stiffness=jnp.asarray(stiffness)
        )
    # The compiled program needs arrays with the same precision as at its compilation.
    spring = jax.tree.map(lambda new, old: jnp.asarray(new, old.dtype), spring, playing.scene.physics[-1])
    scene = replace(playing.scene, physics=(*others, spring))
    first = STEPS if playing.scene.solve.dt is None else playing.step + 1  # the full load acts at step STEPS
    result, state = jax.block_until_ready(playing.program(scene, playing.state, float(first)))
    code = int(result.status[0])
    if code not in (status.CONVERGED, status.ONE_STEP, status.STALLED):  # the residual of a stalled step is roundoff
        return playing._replace(code=code)
    positions = np.asarray(result.positions[0])
    return playing._replace(state=state, step=playing.step + 1, positions=positions, code=code)


def _end_of_spring(playing: Playing, node: int, to: Any, stiffness: float) -> np.ndarray:
    """Check the arguments, and return the position (3,) [m] of the free end of the spring."""
    if not isinstance(node, int) or not 0 <= node < len(playing.positions):
        raise InputError(f"node = {node!r} is not in the mesh: give a number from 0 to {len(playing.positions) - 1}")
    try:
        end = np.asarray(to, float)
    except (TypeError, ValueError):
        end = np.empty(0)
    if end.shape != (3,) or not np.all(np.isfinite(end)):
        raise InputError(f"to = {to!r} is not a position: give three numbers in m")
    if not (isinstance(stiffness, int | float) and np.isfinite(stiffness) and stiffness > 0):
        raise InputError(f"stiffness = {stiffness!r} must be above 0 N/m: give e.g. {playing.stiffness:.3g}")
    return end
