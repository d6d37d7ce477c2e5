"""Checks of a scene before anything is compiled. Each error message is one sentence. The checks are in `checks/`."""

import warnings
from collections.abc import Container

import jax

from liverjax.core.errors import InputError
from liverjax.mesh.tetrahedra import check_mesh
from liverjax.physics.prescribed import free_places
from liverjax.scenes.checks.choices import check_choices
from liverjax.scenes.checks.conflicts import (
    check_motion_in_planes,
    check_moved_where_fixed,
    check_normals,
    check_plates_alone,
    check_prescribed_once,
)
from liverjax.scenes.checks.numbers import check_bounds, check_numbers
from liverjax.scenes.checks.places import check_known_nodes, check_places
from liverjax.scenes.checks.regions import check_region_elements
from liverjax.scenes.checks.rigid_motion import check_held
from liverjax.scenes.scene import Scene, named_physics


def check_before_run(scene: Scene) -> None:
    """Check choices, bounds of numbers, nodes, regions and the objects in `scene.physics`. Arrays inside jit are not
    checked. The check compiles nothing. The shear modulus of the law is not computed: `check_scene` refuses a negative
    shear modulus.

    Raises:
        InputError: see `check_choices` and `check_bounds`; a node is not in the mesh; an element is inverted; a node is
            fixed and moved along the same axis, is fixed although a plate moves it, or slides in two oblique planes;
            regions contradict each other; a support or an obstacle has a wrong number, for example an axis that is
            not a unit vector.
    """
    check_choices(scene)
    check_bounds(scene)
    check_known_nodes(scene)
    check_moved_where_fixed(scene)
    check_plates_alone(scene)
    check_normals(scene)
    if _are_known([region.elements for region in scene.region]):
        check_region_elements(scene)
    with jax.ensure_compile_time_eval():  # checks may use JAX on these known numbers
        for name, physics in named_physics(scene):
            if _are_known((physics, scene.mesh)):
                physics.check(scene.mesh, name)


def _are_known(arrays: object) -> bool:
    return not any(isinstance(leaf, jax.core.Tracer) for leaf in jax.tree.leaves(arrays))


def check_time_and_mass(scene: Scene) -> None:
    """Check that the scene has a time step and a mass if they are needed. The values are not checked.

    Raises:
        InputError: `dt` is missing, but viscosity, porosity, a history or dynamics needs it; or the mass is missing in
            dynamics.
    """
    solve = scene.solve
    loads = (*scene.displaced, *scene.traction, *scene.physics, *([] if scene.body is None else [scene.body]))
    given = (getattr(load, key, None) for load in loads for key in ("history", "times"))
    histories = any(values is not None for values in given)
    if solve.dt is None and solve.kind != "harmonic":
        for present, what in (
            (scene.viscosity is not None, "viscosity"),
            (scene.porosity is not None, "porosity"),
            (histories, "a history"),
            *((physics.in_time, name) for name, physics in named_physics(scene)),
        ):
            if present:
                raise InputError(f"[solve] has no dt, which {what} needs: give the time step in seconds")
        if solve.kind == "dynamic":
            raise InputError("[solve] kind = 'dynamic' needs dt: give the time step in seconds")
    if solve.kind == "dynamic" and scene.body is None:
        raise InputError("[solve] kind = 'dynamic' needs mass: add [body] with a density")


def check_physics(scene: Scene, only: Container[str] | None = None) -> None:
    """Check that a run can begin with the objects in `scene.physics` (supports, obstacles, …).

    Do not call this function inside jit.

    Args:
        scene: `Scene`.
        only: names of the objects to check, for example ``obstacle.0``. If None, all are checked.

    Raises:
        InputError: an object has wrong numbers, nodes or positions. The message begins with the name of the object.
    """
    for name, physics in named_physics(scene):
        if only is None or name in only:
            physics.check(scene.mesh, name)
            if scene.points_are != "loaded":
                physics.check_place(scene.mesh, name)


def check_scene(scene: Scene) -> None:
    """Check that a scene can be simulated, before anything is compiled. Do not call this function inside jit.

    Raises:
        InputError: for example, a number is out of bounds, the mesh cannot be used, time step or mass is missing,
            conditions contradict each other, or the supports do not prevent rigid motions.
    """
    check_choices(scene)
    check_numbers(scene)
    check_mesh(scene.mesh)
    check_places(scene)
    check_physics(scene)
    check_normals(scene)
    check_plates_alone(scene)
    check_time_and_mass(scene)
    check_prescribed_once(scene)
    check_motion_in_planes(scene)
    if not free_places(scene.mesh, scene.fixed, ()).any():
        warnings.warn(
            "[[fixed]] fixes all nodes in all directions, so nothing can move. Note: where = {z_min = 0} selects all "
            "nodes with z >= 0, and {z_max = 0} all nodes with z <= 0",
            stacklevel=2,
        )
    if scene.solve.kind == "static" or scene.points_are == "loaded":
        check_held(scene)
