"""Warnings about a run, computed after the run. Most functions return a list of warnings, which may be empty."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np

from liverjax.core.compiled import compiled
from liverjax.elements.gradients import volume_ratios
from liverjax.mesh.tetrahedra import TetMesh
from liverjax.physics.attached.membrane import Membrane
from liverjax.physics.base import Physics
from liverjax.physics.contact.obstacle import Obstacle
from liverjax.physics.contact.pressed import PressedObstacle
from liverjax.physics.elastic_support import ElasticSupport
from liverjax.physics.inertia import Inertia, inertia_forces
from liverjax.physics.loads import dead_loads, follows, weighing_masses
from liverjax.physics.rigid_plate import RigidPlate
from liverjax.physics.sliding_support import SlidingSupport
from liverjax.scenes.checks.histories import cautions_of_histories
from liverjax.scenes.scene import Scene, histories, named_physics
from liverjax.simulation.cautions.of_contacts import of_friction_alone, of_obstacles, of_sharp_cones
from liverjax.simulation.cautions.of_mesh import cautions_of_mesh, of_locking
from liverjax.simulation.cautions.of_pressures import of_pressures
from liverjax.simulation.run import Result
from liverjax.simulation.unloaded import cautions_of_loaded

#: Bounds of the volume ratio J of an element. About four fifths of a soft tissue is fluid, so below `LEAST_J` not even
#: the solid part would have enough space. `MOST_J` is 1/`LEAST_J`.
LEAST_J, MOST_J = 0.2, 5.0

#: Upper bound of the rounding of a coordinate, relative to the motion during one time step due to the acceleration. At
#: this bound, the error of a falling body in single precision was about 1 % after 20 steps.
_RESOLVED = 0.1


def cautions_of_run(scene: Scene, result: Result) -> list[str]:
    """Return warnings about the mesh, the loads, the contacts and the volumes of a run. The list may be empty.

    Args:
        scene: a `Scene` with known numbers (not inside jit, grad or vmap). Its points are the reference points.
        result: `Result` of its run.
    """
    return [
        *cautions_of_mesh(scene.mesh),
        *of_locking(scene),
        *cautions_of_histories(scene, np.asarray(result.times)),
        *cautions_of_loaded(scene, result.times),
        *_of_growing_motion(scene, result),
        *_of_unresolved_motion(scene, result),
        *of_obstacles(scene, result),
        *of_pressures(scene, result),
        *_of_volumes(scene, result),
        *of_friction_alone(scene, result),
        *of_sharp_cones(scene, result),
    ]


def _of_growing_motion(scene: Scene, result: Result) -> list[str]:
    """Warn if the kinetic energy of a body under constant loads exceeds the work of these loads.

    Newmark's method conserves the energy of small motions only. If a time step is as long as a period of the motion,
    large motions can grow.
    """
    body, solve = scene.body, scene.solve
    if solve.kind != "dynamic" or solve.integrator != "newmark" or body is None:
        return []
    driven = any(np.any(np.asarray(d.by)) for d in scene.displaced) or histories(scene) or follows(scene.traction)
    inlets = scene.porosity is not None and (scene.porosity.inlet or scene.porosity.initial_pressure is not None)
    driven = driven or not all(_gives_no_energy(physics) for _, physics in named_physics(scene))
    if driven or inlets or np.ndim(body.density) or solve.dt is None:
        return []
    momentum = partial(inertia_forces, *Inertia(density=body.density, mass=body.mass).masses_on(scene.mesh))
    x = np.concatenate([np.asarray(scene.mesh.points)[None], np.asarray(result.positions)])
    force = np.asarray(dead_loads(scene.mesh, body.density, body.gravity, scene.traction, body.mass))
    work = np.sum((x - x[0]) * force, axis=(1, 2))
    velocity = np.diff(x, axis=0) / float(solve.dt)
    moving = 0.5 * np.sum(velocity * np.asarray(jax.lax.map(momentum, velocity)), axis=(1, 2))
    given = 0.5 * (work[1:] + work[:-1])
    if not np.any(moving > given + 1e-3 * np.abs(work).max()):
        return []
    k = int(np.argmax(moving > given + 1e-3 * np.abs(work).max()))
    return [
        f"from {float(np.asarray(result.times)[k]):.4g} s on, the kinetic energy of the body exceeds the work of its "
        "loads. With Newmark's method, large motions grow if dt is as long as a period of the motion. Use a dt of at "
        "most a twentieth of this period, or integrator = 'euler'"
    ]


def _of_unresolved_motion(scene: Scene, result: Result) -> list[str]:
    """Warn if the motion a dt^2 due to the acceleration a is not above the rounding of positions in single precision.

    The acceleration is the mean one due to the dead loads, or the largest one of the run if it is larger.
    """
    body, solve = scene.body, scene.solve
    if solve.kind != "dynamic" or solve.precision != "float32" or body is None or solve.dt is None:
        return []
    x = np.concatenate([np.asarray(scene.mesh.points)[None], np.asarray(result.positions, float)])
    force = np.asarray(dead_loads(scene.mesh, body.density, body.gravity, scene.traction, body.mass))
    mass = np.asarray(weighing_masses(scene.mesh, body.density, body.mass))
    loaded = np.linalg.norm(force) / np.linalg.norm(mass) * float(solve.dt) ** 2
    motion = max(loaded, np.abs(np.diff(x, n=2, axis=0)).max(initial=0.0))
    rounding = float(np.finfo(np.float32).eps) * np.abs(x).max()
    if motion == 0 or not rounding > _RESOLVED * motion:
        return []
    return [
        f"dt = {float(solve.dt):.4g} s is too short for float32: during one step the acceleration moves the body by "
        f"about {motion:.2g} m, but float32 rounds its coordinates to {rounding:.2g} m: use precision = 'float64' or a "
        "longer dt"
    ]


def _gives_no_energy(physics: Physics) -> bool:
    """Return whether a physics object (support, obstacle, …) is passive. The object must not have a history.

    A passive object stores no energy at the beginning of the run. Later it returns only energy that it has received
    from the body.
    """
    if isinstance(physics, Obstacle):
        return not isinstance(physics, PressedObstacle) and physics.by is None
    if isinstance(physics, RigidPlate):
        return not np.any(np.asarray(physics.turn))
    return isinstance(physics, SlidingSupport | ElasticSupport | Membrane)


def _of_volumes(scene: Scene, result: Result) -> list[str]:
    """Warn about elements whose volume ratio J is below `LEAST_J` or above `MOST_J` at any step."""
    said = []
    # The positions may be in single precision, so they are converted to the precision of the mesh (double).
    positions = jnp.asarray(result.positions, scene.mesh.points.dtype)
    found = [np.asarray(a) for a in compiled(_extremes, scene.mesh, positions)(scene.mesh, positions)]
    kinds = ((np.less, LEAST_J, "shrank below"), (np.greater, MOST_J, "grew above"))
    for k, (beyond, bound, words) in enumerate(kinds):
        J, step = found[2 * k], found[2 * k + 1]
        out = beyond(J, bound)
        if not out.any():
            continue
        worst = int(np.argmin(J) if beyond is np.less else np.argmax(J))
        time = float(np.asarray(result.times)[step[worst]])
        when = f"load step {time:g}" if scene.solve.dt is None else f"{time:.4g} s"
        said.append(
            f"{int(out.sum())} of {len(J)} elements {words} J = {bound:g} (worst: element {worst}, J = {J[worst]:.2g} "
            f"at {when}), which is impossible in tissue: use a larger bulk modulus or smaller loads"
        )
    return said


def _extremes(mesh: TetMesh, positions: jax.Array) -> tuple[jax.Array, jax.Array, jax.Array, jax.Array]:
    """Return four arrays (E,): the minimum volume ratio J of each element (at most 1), the index of the step with this
    minimum, the maximum J (at least 1), and the index of the step with this maximum. Indices begin at 0."""

    def one(carry: tuple, given: tuple) -> tuple[tuple, None]:
        least, when_least, most, when_most = carry
        k, x = given
        J = volume_ratios(mesh, x)
        low, high = jnp.min(J, axis=0), jnp.max(J, axis=0)
        when_least, when_most = jnp.where(low < least, k, when_least), jnp.where(high > most, k, when_most)
        return (jnp.minimum(least, low), when_least, jnp.maximum(most, high), when_most), None

    rest, start = jnp.ones(mesh.number_of_elements, positions.dtype), jnp.zeros(mesh.number_of_elements, jnp.int32)
    steps = jnp.arange(len(positions), dtype=jnp.int32)
    return jax.lax.scan(one, (rest, start, rest, start), (steps, positions))[0]
