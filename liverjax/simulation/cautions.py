"""Warnings about a run, computed after the run. Most functions return a list of warnings, which may be empty."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np

from liverjax.core import status
from liverjax.core.compiled import compiled
from liverjax.core.errors import InputError
from liverjax.core.struct import Number, replace
from liverjax.elements.gradients import volume_ratios
from liverjax.mesh.locate import doubled_vertices, hanging_vertices
from liverjax.mesh.tetrahedra import TetMesh
from liverjax.physics.attached.membrane import Membrane
from liverjax.physics.base import Physics
from liverjax.physics.contact.friction import RoughObstacle
from liverjax.physics.contact.obstacle import Obstacle, missed_depth
from liverjax.physics.contact.passage import passed_in_step
from liverjax.physics.contact.pressed import PressedObstacle
from liverjax.physics.elastic_support import ElasticSupport
from liverjax.physics.inertia import Inertia, inertia_forces
from liverjax.physics.loads import dead_loads, follows
from liverjax.physics.porosity import law_in_force
from liverjax.physics.rigid_plate import RigidPlate
from liverjax.physics.sliding_support import SlidingSupport
from liverjax.scenes.by_element import by_element
from liverjax.scenes.checks.histories import cautions_of_histories
from liverjax.scenes.checks.rigid_motion import loose_piece
from liverjax.scenes.scene import Scene, histories, named_physics
from liverjax.simulation.automatic import advice_against_locking, form_of_volumes, qualities
from liverjax.simulation.obstacle_forces import obstacle_forces
from liverjax.simulation.run import Result
from liverjax.simulation.unloaded import cautions_of_loaded

#: No organ is longer than this [m]. If millimetres are read as centimetres, a liver seems to be 2 m long.
LONGEST = 1.0
#: No organ and no sample is shorter than this [m]. If metres are read as millimetres, a liver seems to be 0.2 mm long.
SHORTEST = 1e-3
#: A displacement that is not larger than this fraction of the body's size counts as zero.
_ROUNDOFF = 1e-13
#: Elements with a quality (see `qualities`) below this value are slivers: gradients there are 100 times less accurate.
SLIVER = 0.01
#: Bounds of the volume ratio J of an element. About four fifths of a soft tissue is fluid, so below `LEAST_J` not even
#: the solid part would have enough space. `MOST_J` is 1/`LEAST_J`.
LEAST_J, MOST_J = 0.2, 5.0


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
        *_of_contacts(scene, result),
        *_of_pressures(scene, result),
        *_of_volumes(scene, result),
        *_of_friction_alone(scene, result),
        *_of_sharp_cones(scene, result),
    ]


#: If the mesh error is below this fraction of the largest displacement, no finer mesh is recommended.
_SMALL = 0.02


def mesh_sentence(scene: Scene, result: Result) -> str:
    """Return a sentence about the mesh error of the positions at the last step, with advice if the error is large."""
    assert result.mesh_error is not None
    if np.asarray(result.status)[-1] not in (status.CONVERGED, status.ONE_STEP):
        return "the mesh error is unknown, because the last step failed"
    u = np.asarray(result.positions[-1]) - np.asarray(scene.mesh.points)
    size = float(np.linalg.norm(u, axis=1).max())
    error = float(np.linalg.norm(np.asarray(result.mesh_error.positions[-1]), axis=1).max())
    nothing = _ROUNDOFF * np.ptp(np.asarray(scene.mesh.points))
    found = np.asarray(result.mesh_error.found)
    if size <= nothing and error <= nothing and np.all(found):
        return "the mesh error is zero, because the body does not move"
    part = (
        f"{100 * error / size:.2g} % of the largest displacement ({size:.3g} m)"
        if size > nothing
        else "although the run shows no displacement"
    )
    begin = "mesh error (estimate, last step{})"
    if not found[-1]:
        begin = (
            "mesh error not reliable, because no estimate was found for the last step, or it inverts elements (rough "
            "size{})"
        )
    said = f"{begin}: nodal positions are wrong by up to {error:.2g} m, {part}{{}}"
    said = said.format(*_pressure_errors(result))
    single = next((p.section for p in scene.physics if p.pulls_single_nodes()), None)
    if single is not None:
        said += f". Forces of [[{single}]] at single nodes depend on the mesh; the estimate does not include this"
    if not np.all(found[:-1]):
        count = int(np.sum(~found[:-1]))
        said += f". At {count} earlier step{'s' * (count > 1)} no estimate was found, or the estimate inverts elements"
    if error <= _SMALL * size and found[-1]:
        return said
    return f"{said}: use {'order = 2 in [mesh], or a finer mesh' if scene.mesh.order == 1 else 'a finer mesh'}"


def _pressure_errors(result: Result) -> tuple[str, str]:
    """Return two parts of `mesh_sentence` (or ""): that the pressure error is omitted, and how large this error is."""
    if result.pressure is None or result.mesh_error is None:
        return "", ""
    if result.mesh_error.pressure is None:
        return ", without the error of the fluid's pressures", ""
    error, size = (float(np.abs(np.asarray(own[-1])).max()) for own in (result.mesh_error.pressure, result.pressure))
    return "", f"; pressures are wrong by up to {error:.2g} Pa (the largest pressure is {size:.3g} Pa)"


def cautions_of_mesh(mesh: TetMesh) -> list[str]:
    """Return warnings about the size of the body, nodes with equal coordinates, hanging nodes, and slivers."""
    points, tets = np.asarray(mesh.points), np.asarray(mesh.tetrahedra)
    size, quality = float(np.ptp(points, axis=0).max()), qualities(points, tets, np.asarray(mesh.volumes))
    said = []
    if size > LONGEST:
        said.append(f"the body is {size:.3g} m long: check the unit of the mesh, e.g. write unit = 'mm'")
    if size < SHORTEST:
        said.append(
            f"the body is {size:.3g} m long: check this size, and remove unit if the coordinates of the mesh are in m"
        )
    doubled = doubled_vertices(mesh)
    if doubled:
        said.append(
            f"{doubled} nodes have the same coordinates as another node, so the body is not connected there: merge "
            "these nodes if the body should be connected"
        )
    hanging = hanging_vertices(mesh)
    if hanging:
        said.append(
            f"{hanging} nodes lie on a face or edge of an element without being its corners (hanging nodes), so the "
            "body is not connected there: divide these elements, or make a conforming mesh"
        )
    slivers = np.flatnonzero(quality < SLIVER)
    if len(slivers):
        worst = int(np.argmin(quality))
        said.append(
            f"{len(slivers)} of {len(tets)} elements are slivers, with a quality below {SLIVER:g} (worst: element "
            f"{worst} with {quality[worst]:.2g}; a regular tetrahedron has 1). Stresses there are unreliable: improve "
            "the mesh"
        )
    return said


#: If bulk modulus / shear modulus exceeds this value, quadratic elements without pressure unknowns have errors of 10 %
#: or more (see `experiments/TABLES.md`).
_LOCKING = 100.0


def of_locking(scene: Scene) -> list[str]:
    """Warn if quadratic elements are too stiff (lock). With volumetric = "mixed" they would not lock."""
    if scene.mesh.order == 1 or form_of_volumes(scene) != "element" or scene.porosity is not None:
        return []
    try:
        law = by_element(scene).law
        ratio = float(np.max(np.asarray(law.bulk_modulus()) / np.asarray(law.shear_modulus())))
    except InputError:  # a law may have no moduli
        return []
    if ratio <= _LOCKING:
        return []
    return [
        f"the bulk modulus is {ratio:.3g} times the shear modulus, so these quadratic elements are too stiff: "
        f"{advice_against_locking(scene)}"
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


#: A warning is given if the depth of the obstacle between the contact points exceeds this fraction of its approach (see
#: `missed_depth`).
BETWEEN = 0.25


def _between_points(name: str, obstacle: Obstacle, scene: Scene, result: Result, moved: jax.Array) -> list[str]:
    """Warn if the obstacle overlaps the body between the contact points, at its last or largest displacement.

    `moved` (T, 3) contains the displacements [m] of the obstacle at T steps.
    """
    last = len(moved) - 1
    for k in {int(jnp.argmax(jnp.linalg.norm(moved, axis=1))), last}:
        x = jnp.asarray(result.positions[k], scene.mesh.points.dtype)
        between, approach = missed_depth(obstacle, scene.mesh, x, moved[k])
        if between > BETWEEN * approach:
            return [
                f"{name} penetrates the body by {between:.2g} m between the points at which contact is tested "
                f"(approach of the obstacle: {approach:.2g} m), because the triangles are too large for the radius "
                "of the obstacle: refine the mesh there"
            ]
    return []


def _lost_contact(name: str, obstacle: Obstacle, scene: Scene, result: Result, moved: np.ndarray) -> str:
    """Warn if the obstacle passed the surface within a step. `moved` (T + 1, 3): its displacements from step 0 on."""
    ways, radius = np.linalg.norm(np.diff(moved, axis=0), axis=1), float(np.asarray(obstacle.radius))
    centres, axis = np.asarray(obstacle.position, float) + moved, np.asarray(obstacle.axis, float)
    if obstacle.shape == "cylinder":  # a motion of a cylinder along its axis does not count
        ways = np.linalg.norm(np.diff(moved - np.outer(moved @ axis, axis), axis=0), axis=1)
    for k in np.flatnonzero(ways > radius) if radius > 0 else []:
        before = scene.mesh.points if k == 0 else result.positions[k - 1]
        both = np.stack([np.asarray(before), np.asarray(result.positions[k])])
        triangles = np.asarray(obstacle.triangles)
        what = passed_in_step(obstacle.shape, axis, scene.mesh, both, centres[k : k + 2], triangles)
        if what:
            return (
                f"{name} {what} the body in step {k + 1}. The obstacle moves {ways[k]:.2g} m in this step, and has a "
                f"radius of {radius:.2g} m, so it passed the surface between two steps. Contact forces are missing or "
                "have the wrong direction: use more steps"
            )
    return ""


def _of_contacts(scene: Scene, result: Result) -> list[str]:
    """Warn about obstacles (not planes) that passed the surface, or overlap the body between the contact points."""
    said, steps = [], len(result.times)
    obstacles = [(name, physics) for name, physics in named_physics(scene) if isinstance(physics, Obstacle)]
    pressed = any(isinstance(physics, PressedObstacle) for _, physics in obstacles)
    found = obstacle_forces(replace(scene, points_are="reference"), result).displacement if pressed else None
    for number, (name, physics) in enumerate(obstacles):
        if physics.shape == "plane":
            continue
        dt = 0.0 if scene.solve.dt is None else scene.solve.dt
        place = partial(physics.displacement, steps=scene.solve.steps, dt=dt)
        moved = jax.vmap(place)(jnp.arange(1, steps + 1)) if found is None else found[number]
        first = jnp.zeros(3) if isinstance(physics, PressedObstacle) else place(0)
        lost = _lost_contact(name, physics, scene, result, np.concatenate([first[None], moved]))
        said += [lost] if lost else _between_points(name, physics, scene, result, moved)
    return said


def _of_friction_alone(scene: Scene, result: Result) -> list[str]:
    """Warn if a static run failed and only friction prevents sliding of the body, or of a separate piece of it."""
    rough = any(isinstance(physics, RoughObstacle) for physics in scene.physics)
    fine = (status.CONVERGED, status.ONE_STEP, status.STALLED)
    if not rough or scene.solve.kind != "static" or np.isin(result.statistics.status, fine).all():
        return []

    def without_friction(physics: Physics) -> tuple[np.ndarray, np.ndarray]:
        return Obstacle.holds(physics, scene.mesh) if isinstance(physics, RoughObstacle) else physics.holds(scene.mesh)

    loose = loose_piece(scene, without_friction)
    if not loose:
        return []
    return [
        f"the run failed, and only friction prevents sliding of {loose}: if the friction is too small for the sideways "
        "loads, no equilibrium exists; use a larger friction coefficient, [[fixed]], or kind = 'dynamic'"
    ]


def _of_sharp_cones(scene: Scene, result: Result) -> list[str]:
    """Warn if a run with quadratic elements failed and a cone without a round tip is one of the obstacles."""
    sharp = [
        name
        for name, own in named_physics(scene)
        if isinstance(own, Obstacle) and own.shape == "cone" and not np.any(np.asarray(own.radius) > 0)
    ]
    fine = (status.CONVERGED, status.ONE_STEP)
    if not sharp or scene.mesh.order == 1 or np.isin(result.statistics.status, fine).all():
        return []
    return [
        f"the run failed, and {sharp[0]} is a cone with a sharp tip, under which quadratic elements may collapse: give "
        "the cone a round tip (radius), or use linear elements"
    ]


#: The lagged scheme counts as unstable if the sum of all pressure changes over one step exceeds this multiple of the
#: sum of all pressure changes over two steps.
ALTERNATING = 3.0


def _of_pressures(scene: Scene, result: Result) -> list[str]:
    """Warn if pressures overshoot, if elements at drained nodes are too thick, or if scheme = "lagged" is unstable."""
    if scene.porosity is None or result.pressure is None:
        return []
    P = np.asarray(result.pressure)
    if scene.porosity.scheme != "lagged":
        return [
            *_of_overshoot(scene, P[:, : scene.mesh.number_of_vertices]),
            *of_drained_layer(scene, float(scene.solve.dt or 0.0) * len(P), "in {:.3g} s"),
        ]
    if len(P) < 4:
        return []
    once, twice = np.abs(np.diff(P, axis=0)).sum(), np.abs(P[2:] - P[:-2]).sum()
    if not once > ALTERNATING * twice:
        return []
    return [
        "the pressure alternates from step to step, because scheme = 'lagged' is unstable here: write scheme = "
        "'implicit' in [porosity]"
    ]


def _heights_beside(scene: Scene, at: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Return the heights (n,) [m] of the elements with the numbers `at` (n,), measured from one face of each element.

    The entries of `faces` (E, 4) are true for the three corners of this face.
    """
    corners = np.asarray(scene.mesh.points)[np.asarray(scene.mesh.tetrahedra)[at]]
    base = corners[faces[at]].reshape(-1, 3, 3)
    area = 0.5 * np.linalg.norm(np.cross(base[:, 1] - base[:, 0], base[:, 2] - base[:, 0]), axis=1)
    return np.asarray(3 * np.abs(np.asarray(scene.mesh.volumes)[at]) / area)


#: A warning about the elements at the drained nodes is given if it applies to more than this fraction of them.
_MANY = 0.2


def of_drained_layer(scene: Scene, seconds: float, when: str) -> list[str]:
    """Warn if the layer that drains in `seconds` is thinner than many of the elements at the drained nodes.

    The numbers in the warning are medians over these elements. `when` is the beginning of the message. It contains a
    format field for `seconds`.

    In a time t, a layer of the thickness sqrt(c t) drains, with the diffusivity c = kappa / (1/K_lim + 1/M) (Biot
    1941). kappa is the permeability, and 1/K_lim is the storage (see `liverjax.physics.porosity`). M = K0 + 4/3 mu,
    with the bulk modulus K0 of the drained body (sponge and law) and the shear modulus mu. The pressure is linear in
    an element, so an element thicker than this layer loses too much fluid.
    """
    sponge = scene.porosity
    assert sponge is not None
    if sponge.drained is None or not seconds > 0:
        return []
    given = np.isin(np.asarray(scene.mesh.tetrahedra), np.asarray(sponge.drained))
    at = np.flatnonzero(given.sum(axis=1) == 3)
    if not len(at):
        return []
    try:
        M, limit, kappa = _moduli_and_permeability(scene, at)
    except InputError:  # a law may have no moduli
        return []
    heights = _heights_beside(scene, at, given)
    layers = np.sqrt(kappa / (1 / limit + 1 / M) * seconds)
    thick = layers < heights
    if thick.mean() <= _MANY:
        return []
    layer, height = np.median(layers[thick]), np.median(heights[thick])
    where = "the drained nodes" if thick.all() else "some of the drained nodes"
    return [
        f"{when.format(seconds)} the fluid leaves a layer of about {layer:.2g} m at {where}, but the elements there "
        f"are {height:.2g} m thick. These elements lose too much fluid, so pressures and displacements are wrong there "
        "(the mesh error shows how much). Use thinner elements there, or no drained nodes if nothing should flow"
    ]


def _moduli_and_permeability(scene: Scene, at: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return numbers (n,) of the elements with the numbers `at` (n,): the longitudinal modulus K0 + 4/3 mu [Pa], the
    storage modulus K_lim [Pa], and the permeability [m^4/(N s)]. Parameters of regions are included.

    Raises:
        InputError: the law has no moduli.
    """
    own = by_element(scene)
    sponge = own.porosity
    assert sponge is not None

    def there(value: Number) -> np.ndarray:  # the median of the points of each element
        shape = np.broadcast_shapes(np.shape(value), (scene.mesh.number_of_elements,))
        return np.asarray(np.median(np.broadcast_to(value, shape)[..., at].reshape(-1, len(at)), axis=0), float)

    K0 = there(sponge.bulk) + there(law_in_force(sponge, own.law).bulk_modulus())
    return K0 + 4 / 3 * there(own.law.shear_modulus()), there(sponge.limit_bulk), there(sponge.permeability)


#: A warning is given if the overshoot, divided by the largest pressure of the step, exceeds this value.
OVERSHOOT = 0.05
#: Smallest dt for which the overshoot stays below `OVERSHOOT`, in units of h^2/(kappa M), for elements of height h,
#: permeability kappa and longitudinal modulus M.
_FOLLOWS = 0.4


def _least_steps(scene: Scene, at: np.ndarray, heights: np.ndarray) -> np.ndarray | None:
    """Return the smallest dt (n,) [s] without overshoot in the elements `at` with the given heights (n,) [m], 0 without
    flow. Returns None if the law has no moduli."""
    try:
        M, _, kappa = _moduli_and_permeability(scene, at)
    except InputError:
        return None
    return _FOLLOWS * heights**2 / (np.where(kappa > 0, kappa, np.inf) * M)


def _of_overshoot(scene: Scene, P: np.ndarray) -> list[str]:
    """Warn if pressures P (T, V) at T steps are higher beside the drained nodes than further inside.

    The warning is about the elements at the drained nodes for which dt is too short.

    The fluid volume that leaves an element within a step is distributed to all nodes of the element. In one dimension,
    with dt < h^2/(4 kappa M), this distribution couples neighbouring nodes more strongly than the flow does (h: height
    of the elements, kappa: permeability, M: longitudinal modulus). In three dimensions the smallest dt without
    overshoot is about 1.5 times this bound. Source of such bounds: Vermeer and Verruijt 1981 (Int. J. Numer. Anal.
    Methods Geomech. 5, 1).
    """
    sponge, tets, V = scene.porosity, np.asarray(scene.mesh.tetrahedra), scene.mesh.number_of_vertices
    assert sponge is not None
    if sponge.drained is None:
        return []
    given = np.zeros(V, bool)
    given[np.asarray(sponge.drained)[np.asarray(sponge.drained) < V]] = True
    faces = given[tets]
    at = np.flatnonzero(faces.sum(axis=1) == 3)
    if not len(at):
        return []
    heights = _heights_beside(scene, at, faces)
    least = _least_steps(scene, at, heights)
    short = np.ones(len(at), bool) if least is None else float(scene.solve.dt) < least
    if short.mean() <= _MANY:  # then short steps are not the cause
        return []
    beside = np.zeros(V, bool)
    beside[tets[at].ravel()] = True
    beside &= ~given
    inner = np.zeros((V, len(P)))  # the largest |pressure| of neighbours further inside
    for a, b in ((a, b) for a in range(4) for b in range(4) if a != b):
        one = beside[tets[:, a]] & ~given[tets[:, b]] & ~beside[tets[:, b]]
        np.maximum.at(inner, tets[one, a], np.abs(P[:, tets[one, b]]).T)
    known = beside & (inner.max(axis=1) > 0) & np.isin(np.arange(V), tets[at[short]])
    largest = np.abs(P).max(axis=1, initial=0.0)
    if not known.any() or not largest.any():
        return []
    over = np.median(np.abs(P[:, known]) - inner[known].T, axis=1) / np.where(largest > 0, largest, 1.0)
    worst = int(np.argmax(np.where(largest > 0.1 * largest.max(), over, 0.0)))
    if not over[worst] > OVERSHOOT:
        return []
    said = (
        f"the pressure overshoots beside the drained nodes, by {100 * over[worst]:.2g} % at "
        f"{float(scene.solve.dt) * (worst + 1):.3g} s, because the first steps are too short for the elements there"
    )
    if least is None:
        return [f"{said}: use a larger dt, or thinner elements there"]
    enough, height = np.median(least[short]), np.median(heights[short])
    return [
        f"{said}: use a dt of {enough:.2g} s or more, or elements of "
        f"{height * np.sqrt(float(scene.solve.dt) / enough):.2g} m there (the elements are {height:.2g} m thick)"
    ]


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
