"""Is every number of the scene within its bounds, and are the numbers compatible? The mesh is checked elsewhere."""

from liverjax.core import bounds
from liverjax.physics import porosity, viscosity
from liverjax.scenes.checks.regions import check_region_numbers
from liverjax.scenes.regions import laws_of
from liverjax.scenes.scene import Scene, named_physics
from liverjax.scenes.springpots import check_springpots


def check_bounds(scene: Scene) -> None:
    """Check that numbers are within their bounds, and that directions do not have length 0. Nothing is compiled.

    Numbers inside jit, grad or vmap are not checked. `check_mesh` checks the mesh.

    Raises:
        InputError: the message contains the dotted name of the number, its value, its bound and a remedy.
    """
    bounds.check_fields(scene, leave=("mesh", "physics"))
    for name, physics in named_physics(scene):
        bounds.check_fields(physics, name)
    for law in laws_of(scene.law, scene.region):
        for one in law.summands():
            one.check_directions()
    if scene.viscosity is not None:
        viscosity.check_series(scene.viscosity)
    if scene.porosity is not None:
        porosity.check_limit(scene.porosity)
    check_region_numbers(scene)


def check_numbers(scene: Scene) -> None:
    """Check that the numbers, each and in combination, can be used. The mesh is not checked. Not for use inside jit.

    Raises:
        InputError: numbers are out of bounds, or contradict each other in law, viscosity or porosity.
    """
    check_bounds(scene)
    for law in laws_of(scene.law, scene.region):
        law.check()
        if scene.viscosity is not None:
            viscosity.check_viscosity(scene.viscosity, law)
        if scene.springpots is not None:
            check_springpots(scene.springpots, law, scene.viscosity)
    if scene.porosity is not None:
        porosity.check_porosity(scene.porosity)
