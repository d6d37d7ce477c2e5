"""Checks of a scene before anything is compiled; each refusal is one sentence."""

import warnings
from collections.abc import Container
from typing import Any

import jax
import numpy as np

from liverjax import laws
from liverjax.core import bounds, history
from liverjax.core.errors import InputError
from liverjax.mesh.selection import AXES, check_nodes, check_triangles
from liverjax.mesh.tetrahedra import TetMesh, check_mesh
from liverjax.physics import porosity, viscosity
from liverjax.physics.base import Physics
from liverjax.physics.loads import Traction
from liverjax.physics.prescribed import Displaced, Fixed, check_axes, free_places
from liverjax.physics.sliding_support import SlidingSupport
from liverjax.physics.volumes.mixed import check_mixed_law
from liverjax.scenes.region_checks import check_region_elements, check_region_numbers
from liverjax.scenes.regions import Region, laws_of
from liverjax.scenes.scene import Body, Scene, Solve
from liverjax.scenes.springpots import SpringpotSeries, check_springpots

#: Allowed values of the choices in [solve].
CHOICES = {
    "kind": ("static", "dynamic", "harmonic"),
    "newton": ("converged", "one_step"),
    "integrator": ("euler", "newmark"),
    "precision": ("float64", "float32"),
    "linear_solver": ("auto", "cg", "direct"),
    "volumetric": ("element", "nodal", "mixed", "auto"),
    "robust": ("off", "projected", "regularised"),
}
#: Types of the parts of a scene: of single parts, and of parts that may be several.
PARTS = {
    "mesh": TetMesh,
    "law": laws.Law,
    "viscosity": viscosity.Prony,
    "springpots": SpringpotSeries,
    "porosity": porosity.Porosity,
    "body": Body,
    "solve": Solve,
}
SEVERAL = {"region": Region, "fixed": Fixed, "displaced": Displaced, "traction": Traction, "physics": Physics}
#: Allowed values of [body] mass.
MASSES = ("lumped", "consistent")


def check_before_run(scene: Scene) -> None:
    """Refuse unknown choices, numbers out of bounds and nodes that are not in the mesh; traced ones pass. Compiles
    nothing.

    Raises:
        InputError: as `check_choices` and `check_bounds`; nodes that are not in the mesh; elements without volume;
            nodes that are fixed and moved along one axis, or held while a plate moves them.
    """
    check_choices(scene)
    check_bounds(scene)
    _known_nodes(scene)
    _moved_where_fixed(scene)
    _plates_alone(scene)


def check_choices(scene: Scene) -> None:
    """Refuse unknown or contradictory choices. Numbers are not checked, so a traced scene passes as well.

    Raises:
        InputError: unknown choices; a load or motion given twice, not at all, of wrong shape.
    """
    _check_kinds(scene)
    for key, allowed in CHOICES.items():
        value = getattr(scene.solve, key)
        if value not in allowed:
            raise InputError(f"[solve] {key} = {value!r} is not known: use {' or '.join(allowed)}")
    if (scene.solve.kind == "harmonic") != (scene.solve.frequencies is not None):
        raise InputError("[solve] kind = 'harmonic' and frequencies = [60.0] (Hz) go together: give both, or neither")
    if scene.solve.frequencies is not None and not np.size(scene.solve.frequencies):
        raise InputError("[solve] frequencies = [] holds no frequency: give e.g. frequencies = [60.0] (Hz)")
    if scene.solve.reduced and scene.solve.kind == "harmonic":
        raise InputError("[solve] reduced is for runs in time, kind is 'harmonic': leave it out")
    if scene.springpots is not None and scene.solve.kind != "harmonic":
        raise InputError("[springpots] are for kind = 'harmonic': a run in time takes [viscosity], a Prony series")
    if scene.solve.kind == "harmonic":
        _refuse_what_moves_in_time(scene)
    _loaded(scene)
    if scene.solve.linear_solver == "direct" and any(load.pressure is not None for load in scene.traction):
        raise InputError("[solve] linear_solver = 'direct' is for symmetric forces: use cg if a pressure follows")
    if scene.solve.linear_solver == "direct" and any(physics.ties for physics in scene.physics):
        raise InputError(
            "[solve] linear_solver = 'direct' cannot treat nodes that move together: use cg with a rigid plate"
        )
    if scene.solve.volumetric in ("nodal", "mixed"):
        _own_volumes(scene)
    if scene.solve.volumetric == "mixed":
        _mixed(scene)
    for k, load in enumerate(scene.traction):
        _check_traction(load, f"traction.{k}")
    if scene.body is not None:
        _body(scene.body, scene.mesh.number_of_nodes)
    if scene.viscosity is not None:
        for law in laws_of(scene.law, scene.region):
            viscosity.check_part(scene.viscosity.part, law, "viscosity")
    for k, hold in enumerate(scene.fixed):
        check_axes(hold.axes, f"fixed.{k}")
    for k, motion in enumerate(scene.displaced):
        _check_motion(motion, f"displaced.{k}")


def _known_nodes(scene: Scene) -> None:
    """Refuse node numbers that are not in the mesh, and inverted elements; traced arrays pass."""
    mesh = scene.mesh
    named: dict[str, object] = {f"fixed.{k}.nodes": hold.nodes for k, hold in enumerate(scene.fixed)}
    named |= {f"displaced.{k}.nodes": motion.nodes for k, motion in enumerate(scene.displaced)}
    named |= {f"traction.{k}.triangles": load.triangles for k, load in enumerate(scene.traction)}
    if scene.porosity is not None:
        named["porosity.drained"] = scene.porosity.drained
        named |= {f"porosity.inlet.{k}.nodes": inlet.nodes for k, inlet in enumerate(scene.porosity.inlet)}
    for name, nodes in named.items():
        if nodes is not None and not isinstance(nodes, jax.core.Tracer):
            numbers = np.asarray(nodes)
            check_nodes(numbers.ravel() if name.endswith("triangles") else numbers, mesh.number_of_nodes, name, least=0)
    if not isinstance(mesh.volumes, jax.core.Tracer):
        wrong = int(np.sum(~(np.asarray(mesh.volumes) > 0)))
        if wrong:
            raise InputError(f"mesh has {wrong} elements that are inside out or without volume: correct their vertices")


def histories(scene: Scene) -> dict[str, object]:
    """Every load, motion, inlet and further physics that has a history, by its name."""
    inlets = () if scene.porosity is None else scene.porosity.inlet
    parts: dict[str, object] = {"body": scene.body}
    for key, several in (("displaced", scene.displaced), ("traction", scene.traction), ("porosity.inlet", inlets)):
        parts |= {f"{key}.{k}": part for k, part in enumerate(several)}
    parts |= dict(named_physics(scene))
    return {name: part for name, part in parts.items() if getattr(part, "history", None) is not None}


#: Part of the largest motion that counts as none: roundoff of a turn.
_NO_MOTION = 1e-12


def _moved_where_fixed(scene: Scene) -> None:
    """Refuse a motion of nodes that are fixed along its axis; traced arrays and motions of 0 pass."""
    for k, motion in enumerate(scene.displaced):
        by = motion.history if motion.by is None else motion.by
        if any(isinstance(leaf, jax.core.Tracer) for leaf in jax.tree.leaves((by, motion.nodes))):
            continue
        numbers, vectors = np.asarray(motion.nodes).ravel(), np.asarray(by, float)
        if motion.by is None or vectors.ndim == 1:  # one motion of all its nodes
            vectors = np.broadcast_to(np.abs(vectors.reshape(-1, 3)).max(axis=0), (len(numbers), 3))
        nothing = _NO_MOTION * float(np.abs(vectors).max(initial=0.0))
        for n, hold in enumerate(scene.fixed):
            if isinstance(hold.nodes, jax.core.Tracer):
                continue
            shared = np.isin(numbers, np.asarray(hold.nodes))
            for axis in (a for a in motion.axes if a in hold.axes):
                wrong = numbers[shared & (np.abs(vectors[:, AXES.index(axis)]) > nothing)]
                if len(wrong):
                    raise InputError(
                        f"fixed.{n} and displaced.{k} both prescribe node {wrong[0]} along {axis}: make their places "
                        "differ"
                    )


def _plates_alone(scene: Scene) -> None:
    """Refuse a plate's node that something else holds or moves, which would have no effect; traced arrays pass."""
    named = [(f"{kind}.{k}", part) for kind in ("fixed", "displaced") for k, part in enumerate(getattr(scene, kind))]
    every = named_physics(scene)
    plates = [(name, physics) for name, physics in every if physics.ties]
    named += [(name, physics) for name, physics in every if isinstance(physics, SlidingSupport)]
    for k, (name, plate) in enumerate(plates):
        for other, part in named + plates[:k]:
            nodes = [getattr(own, "nodes", None) for own in (plate, part)]
            if any(own is None or isinstance(own, jax.core.Tracer) for own in nodes):
                continue
            both = np.intersect1d(np.asarray(nodes[0]), np.asarray(nodes[1]))
            if len(both):
                raise InputError(
                    f"{name} and {other} share node {both[0]}, whose motion the plate alone decides: make their places "
                    "differ"
                )


def _refuse_what_moves_in_time(scene: Scene) -> None:
    """Refuse histories in harmonic motion, and obstacles that move."""
    for name in histories(scene):
        raise InputError(f"{name}.history is for runs in time: give harmonic motion its amplitudes alone")
    for name, part in named_physics(scene):
        if getattr(part, "by", None) is not None:
            raise InputError(
                f"{name}.by is for runs in time: give the obstacle its place in harmonic motion as position"
            )


def _check_kinds(scene: Scene) -> None:
    """Refuse parts of a wrong type, such as numbers of nodes in place of `Fixed`."""
    for key, kind in PARTS.items():
        own = getattr(scene, key)
        if own is not None and not isinstance(own, kind):
            raise InputError(f"{key} is of type {type(own).__name__}: give {_remedy(kind)}")
    for key, kind in SEVERAL.items():
        own = getattr(scene, key)
        if not isinstance(own, tuple | list):
            raise InputError(f"{key} is of type {type(own).__name__}: give a tuple, with {_remedy(kind)} in it")
        for k, each in enumerate(own):
            if not isinstance(each, kind):
                raise InputError(f"{key}.{k} is of type {type(each).__name__}: give {_remedy(kind)}")


def _remedy(kind: type) -> str:
    """Words for a message: how a user writes a value of this type."""
    families: dict[object, str] = {laws.Law: "a law of lj.laws", Physics: "a physics, such as lj.Obstacle"}
    return families.get(kind, f"an lj.{kind.__name__}")


def _loaded(scene: Scene) -> None:
    if scene.points_are not in ("reference", "loaded"):
        raise InputError(f"[mesh] is = {scene.points_are!r} is not known: use reference or loaded")
    if scene.points_are == "loaded" and scene.porosity is not None:
        raise InputError('[mesh] is = "loaded" cannot have the pressure of a fluid: leave [porosity] out')
    if scene.points_are == "loaded" and any(physics.ties for physics in scene.physics):
        raise InputError('[mesh] is = "loaded" cannot have nodes that move together: leave the rigid plate out')


def _check_traction(load: Traction, name: str) -> None:
    history.check(load.times, load.history, name)
    if np.ndim(load.history) == 2:
        if load.value is not None or load.pressure is not None:
            raise InputError(f"{name} has a value and a history of values: leave one of them out")
        return
    if (load.value is None) == (load.pressure is None):
        raise InputError(f"{name} needs either value (3,) or pressure, in Pa: give one of them")
    key, shape = ("pressure", ()) if load.value is None else ("value", (3,))
    if np.shape(getattr(load, key)) != shape:
        raise InputError(f"{name} {key} has shape {np.shape(getattr(load, key))}: give shape {shape}")


def _check_motion(motion: Displaced, name: str) -> None:
    history.check(motion.times, motion.history, name, (3,) if motion.by is None else (1,))
    check_axes(motion.axes, name)
    # NumPy cannot tell the shape of a tuple of traced numbers.
    by: Any = motion.by
    shape = (3,) if isinstance(by, tuple | list) and len(by) == 3 and np.ndim(by[0]) == 0 else np.shape(by)
    if by is not None and shape not in ((3,), (*np.shape(motion.nodes), 3)):
        raise InputError(f"{name} by has shape {shape}: give three numbers in m, or three a node")
    if motion.by is None and motion.history is None:
        raise InputError(f"{name} needs either by (3,) or times and history: give one of them")


def _body(body: Body, nodes: int) -> None:
    if body.mass not in MASSES:
        raise InputError(f"[body] mass = {body.mass!r} is not known: use {' or '.join(MASSES)}")
    # NumPy cannot tell the shape of a tuple of traced numbers.
    gravity = (len(body.gravity),) if isinstance(body.gravity, tuple) else np.shape(body.gravity)
    density = np.shape(body.density)
    if density not in ((), (nodes,)):
        raise InputError(f"body density has shape {density}: give one number or one per node ({nodes},), in kg/m^3")
    history.check(body.times, body.history, "body")
    if gravity != (3,):
        raise InputError(f"body gravity has shape {gravity}: give three numbers in m/s^2")


def _mixed(scene: Scene) -> None:
    name = "[solve] volumetric = 'mixed'"
    for law in laws_of(scene.law, scene.region):
        check_mixed_law(law, name)


def _own_volumes(scene: Scene) -> None:
    name = f"[solve] volumetric = {scene.solve.volumetric!r}"
    if scene.porosity is not None:
        raise InputError(f"{name} is for a law's own volumetric energy, which a sponge replaces: use 'element'")
    several = laws_of(scene.law, scene.region)
    for law in several:
        if laws.isochoric_part(law) is None or laws.volumetric_part(law) is None:
            raise InputError(
                f"{name} needs a law whose energy is a shear part and a volumetric part, unlike {type(law).__name__}"
            )
    if scene.viscosity is not None and scene.viscosity.part != "isochoric":
        raise InputError(f"{name} needs [viscosity] part = 'isochoric': volumes do not relax there")


def check_bounds(scene: Scene) -> None:
    """Refuse numbers out of bounds. Traced ones pass; `check_mesh` checks the mesh. Compiles nothing.

    Raises:
        InputError: one sentence with the number's dotted name, value, bound and remedy.
    """
    bounds.check(scene, leave=("mesh", "physics"))
    for name, physics in named_physics(scene):
        bounds.check(physics, name)
    if scene.viscosity is not None:
        viscosity.check_series(scene.viscosity)
    if scene.porosity is not None:
        porosity.check_limit(scene.porosity)
    check_region_numbers(scene)


def check_numbers(scene: Scene) -> None:
    """Refuse numbers that cannot be used, alone or together. The mesh is not checked; host side.

    Raises:
        InputError: numbers out of bounds, or that contradict each other in law, viscosity or porosity.
    """
    check_bounds(scene)
    for law in laws_of(scene.law, scene.region):
        law.check()
        if scene.viscosity is not None:
            viscosity.check(scene.viscosity, law)
        if scene.springpots is not None:
            check_springpots(scene.springpots, law, scene.viscosity)
    if scene.porosity is not None:
        porosity.check(scene.porosity)


def check_physics(scene: Scene, only: Container[str] | None = None) -> None:
    """Refuse further physics whose numbers, nodes or places no run can begin with; host side.

    Args:
        scene: `Scene`.
        only: names of the physics to check, like ``obstacle.0``; None: all.

    Raises:
        InputError: one sentence that begins with the name of the physics.
    """
    for name, physics in named_physics(scene):
        if only is None or name in only:
            physics.check(scene.mesh, name)
            if scene.points_are != "loaded":
                physics.check_place(scene.mesh, name)


def check_scene(scene: Scene) -> None:
    """Refuse a scene that cannot be simulated; host side, before any compile.

    Raises:
        InputError: an unusable mesh or viscosity, missing time step or mass, contradicting conditions, a loose body.
    """
    check_choices(scene)
    check_numbers(scene)
    check_mesh(scene.mesh)
    check_region_elements(scene)
    _places(scene)
    check_physics(scene)
    _no_two_normals(scene)
    _plates_alone(scene)
    solve = scene.solve
    loads = (*scene.displaced, *scene.traction, *scene.physics, *([] if scene.body is None else [scene.body]))
    histories = any(getattr(load, "history", None) is not None for load in loads)
    if solve.dt is None and solve.kind != "harmonic":
        for present, what in (
            (scene.viscosity is not None, "viscosity"),
            (scene.porosity is not None, "porosity"),
            (histories, "a history"),
        ):
            if present:
                raise InputError(f"[solve] has no dt, which {what} needs: give the time step in seconds")
        if solve.kind == "dynamic":
            raise InputError("[solve] kind = 'dynamic' needs dt: give the time step in seconds")
    if solve.kind == "dynamic" and scene.body is None:
        raise InputError("[solve] kind = 'dynamic' needs mass: add [body] with a density")
    _no_contradiction(scene)
    check_motion_in_planes(scene)
    if not free_places(scene.mesh, scene.fixed, ()).any():
        warnings.warn(
            "fixed holds every node along every axis, so nothing can move: a place like where = {z_min = 0} takes all "
            "nodes at and above it, {z_max = 0} those at and below",
            stacklevel=2,
        )
    if solve.kind == "static" or scene.points_are == "loaded":
        _held(scene)


def holding(scene: Scene, only: Container[str] | None = None) -> dict[str, int]:
    """Name of each further physics (as in `check_physics`) -> number of nodal directions that it holds at first."""
    named = [(name, physics) for name, physics in named_physics(scene) if only is None or name in only]
    return {name: len(physics.holds(scene.mesh)[0]) for name, physics in named}


def check_hold(scene: Scene, before: dict[str, int]) -> None:
    """Refuse numbers with which physics hold less than `before` (see `holding`), if a static body is then loose.

    Raises:
        InputError: nothing holds a connected piece any more.
    """
    still = scene.solve.kind == "static" or scene.points_are == "loaded"
    if still and any(number < before[name] for name, number in holding(scene, before).items()):
        _held(scene)


def _places(scene: Scene) -> None:
    """Refuse node numbers and triangles that are not in the mesh."""
    mesh = scene.mesh
    for kind in ("fixed", "displaced"):
        for k, condition in enumerate(getattr(scene, kind)):
            check_nodes(condition.nodes, mesh.number_of_nodes, f"{kind}.{k}.nodes", least=0)
    for k, load in enumerate(scene.traction):
        check_triangles(mesh, load.triangles, f"traction.{k}.triangles")
    if scene.porosity is None:
        return
    if scene.porosity.drained is not None:
        check_nodes(scene.porosity.drained, mesh.number_of_nodes, "porosity.drained")
        _has_vertices(mesh, scene.porosity.drained, "porosity.drained")
    for k, inlet in enumerate(scene.porosity.inlet):
        if inlet.nodes is not None:
            check_nodes(inlet.nodes, mesh.number_of_nodes, f"porosity.inlet.{k}.nodes")
            _has_vertices(mesh, inlet.nodes, f"porosity.inlet.{k}")
        else:
            check_triangles(mesh, inlet.triangles, f"porosity.inlet.{k}.triangles")
    _inlets_that_act(scene.porosity)


def _has_vertices(mesh: TetMesh, nodes: object, name: str) -> None:
    """Refuse a place of the fluid that holds only middles of edges: pressures belong to vertices."""
    if not np.any(np.asarray(nodes, int) < mesh.number_of_vertices):
        raise InputError(f"{name} meets only middles of edges, which have no pressure: make its place hold vertices")


def _inlets_that_act(sponge: porosity.Porosity) -> None:
    """Refuse inlets within a place whose pressure is given already; places may share an edge."""
    given = [] if sponge.drained is None else [set(np.asarray(sponge.drained).tolist())]
    pressures = [(k, inlet) for k, inlet in enumerate(sponge.inlet) if inlet.nodes is not None]
    for k, inlet in pressures:
        own = set(np.asarray(inlet.nodes).tolist())
        if any(own <= place for place in given):
            raise InputError(
                f"porosity.inlet.{k} gives a pressure where it is drained or given already: make their places differ"
            )
        given.append(own)
    for k, inlet in enumerate(sponge.inlet):
        corners = set() if inlet.triangles is None else set(np.ravel(inlet.triangles).tolist())
        if inlet.nodes is None and any(corners <= place for place in given):
            raise InputError(
                f"porosity.inlet.{k} is a flux through a surface whose pressures are given or drained, where nothing "
                "enters: make their places differ"
            )


def named_physics(scene: Scene) -> list[tuple[str, Physics]]:
    """Every further physics with the name that scene files give it: support.0."""
    places = {k: f"{p.section}.{n}" for p in scene.physics for n, k in enumerate(scene.named(p.section))}
    return [(places[k], physics) for k, physics in enumerate(scene.physics)]


def _no_two_normals(scene: Scene) -> None:
    """Refuse a node in two oblique planes, or held along some but not all axes of its plane's normal."""
    taken: dict[int, str] = {}
    mask = free_places(scene.mesh, scene.fixed, scene.displaced)
    for physics in scene.physics:
        if isinstance(physics, SlidingSupport) and physics.axis:
            mask[np.asarray(physics.nodes), AXES.index(physics.axis)] = False
    for name, physics in named_physics(scene):
        if not isinstance(physics, SlidingSupport) or physics.axis:
            continue
        across = np.abs(np.asarray(physics.normal)) > 1e-12
        for node in np.asarray(physics.nodes).tolist():
            other = taken.setdefault(node, name)
            if other != name or 0 < mask[node, across].sum() < across.sum():
                held = f"{other} and {name} both hold" if other != name else f"{name} and a held axis both hold"
                raise InputError(f"{held} node {node}, in directions that are not at right angles: make places differ")


def _no_contradiction(scene: Scene) -> None:
    taken: dict[tuple[int, str], str] = {}
    for kind in ("fixed", "displaced"):
        for k, condition in enumerate(getattr(scene, kind)):
            for axis in condition.axes:
                for node in np.asarray(condition.nodes).tolist():
                    other = taken.setdefault((node, axis), f"{kind}.{k}")
                    if other != f"{kind}.{k}" and "displaced" in (kind, other.partition(".")[0]):
                        raise InputError(
                            f"{other} and {kind}.{k} both prescribe node {node} along {axis}: make their places differ"
                        )


def check_motion_in_planes(scene: Scene) -> None:
    """Refuse a prescribed motion that leads nodes off the plane in which they slide; host side.

    Raises:
        InputError: one sentence that begins with the name of the motion.
    """
    for name, physics in named_physics(scene):
        if not isinstance(physics, SlidingSupport):
            continue
        nodes, normals = physics.holds(scene.mesh)
        for k, motion in enumerate(scene.displaced):
            both = np.isin(np.asarray(motion.nodes), nodes)
            vectors = np.array(motion.history if motion.by is None else motion.by, float)
            vectors[..., [a for a in range(3) if AXES[a] not in motion.axes]] = 0.0
            own = vectors[both] if motion.by is not None and vectors.ndim == 2 else vectors
            if both.any() and np.any(np.abs(own @ normals[0]) > 1e-9 * np.abs(vectors).max()):
                node = np.asarray(motion.nodes)[both][0]
                raise InputError(
                    f"displaced.{k} moves node {node} off the plane of {name}: make their places differ, or leave that "
                    "direction out of axes"
                )


def _held(scene: Scene) -> None:
    """Refuse a connected piece that nothing holds: a static solution does not exist then."""
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components

    each, n = [np.asarray(a) for a in scene.mesh.element_nodes], scene.mesh.number_of_nodes
    rows, columns = np.tile(each[0], len(each)), np.concatenate(each)
    pieces, label = connected_components(coo_array((np.ones(len(rows)), (rows, columns)), shape=(n, n)), directed=False)
    fixed = np.argwhere(~free_places(scene.mesh, scene.fixed, scene.displaced))
    both = [(fixed[:, 0], np.eye(3)[fixed[:, 1]]), *(physics.holds(scene.mesh) for physics in scene.physics)]
    numbers, directions = (np.concatenate(a) for a in zip(*both, strict=True))
    for piece in range(pieces):
        nodes = np.flatnonzero(label == piece)
        inside = np.isin(numbers, nodes)
        points = np.asarray(scene.mesh.points)
        held = points[numbers[inside]] - points[nodes].mean(axis=0)
        if _rigid_rank(held, directions[inside], np.ptp(points[nodes], axis=0).max()) < 6:
            which = f"piece {piece} ({len(nodes)} nodes)" if pieces > 1 else "the body"
            raise InputError(f"nothing holds {which} against every rigid motion: add [[fixed]] or kind = 'dynamic'")


def _rigid_rank(points: np.ndarray, directions: np.ndarray, size: float) -> int:
    """Rank of the six rigid motions as seen along held directions (n, 3) at points (n, 3) of a body of that size."""
    if not len(points):
        return 0
    # A turn about e moves x by e x x, of which the part along d is (x x d) . e.
    motions = np.concatenate([directions, np.cross(points / max(size, 1e-300), directions)], axis=1)
    return int(np.linalg.matrix_rank(motions, tol=1e-6))
