"""Check that every number of a scene is within its bounds, and that the numbers are compatible.

The mesh is not checked.
"""

from collections.abc import Collection
from contextlib import suppress

import jax
import numpy as np

from liverjax.core import bounds
from liverjax.core.errors import InputError
from liverjax.mesh.shape_functions import basis
from liverjax.physics import porosity, viscosity
from liverjax.scenes.by_element import law_of_elements
from liverjax.scenes.checks.regions import check_region_elements, check_region_numbers
from liverjax.scenes.regions import POROUS, Region, laws_of
from liverjax.scenes.scene import Scene, named_physics
from liverjax.scenes.springpots import check_springpots


def check_bounds(scene: Scene) -> None:
    """Check that numbers are within their bounds, and that vectors of directions do not have length 0.

    The check compiles nothing. Numbers inside jit, grad or vmap are not checked. The mesh is not checked here, but by
    `check_mesh`.

    Raises:
        InputError: a number is outside its bounds, a direction has length 0, or a number of [porosity] has a wrong
            shape. For a number outside its bounds, the message contains its name (for example law.mu), its value, its
            bound and a remedy.
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
        E, order = scene.mesh.number_of_elements, scene.mesh.order
        of_points = () if order == 1 else ((1, E), (len(basis(order).weights), E))
        for name in POROUS:
            bounds.check_shape(f"porosity.{name}", getattr(scene.porosity, name), (), (E,), *of_points, (1,))
        porosity.check_limit(scene.porosity)
    check_region_numbers(scene)


def check_numbers(scene: Scene, changed: Collection[str] | None = None) -> None:
    """Check that all numbers can be used, also in combination. The mesh is not checked.

    Do not call this function inside jit.

    Args:
        scene: `Scene`.
        changed: dotted names of the numbers that changed since the last check, for example ``law.mu``. The elements of
            regions are then not checked again, and the shear modulus only if a law may have changed. If None,
            everything is checked.

    Raises:
        InputError: a number is out of bounds, numbers of law, viscosity or porosity contradict each other, the shear
            modulus at rest is negative in an element, or the elements of a region are wrong.
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
    if changed is None:
        check_region_elements(scene)
    if changed is None or any(name.split(".")[0] in ("law", "region") for name in changed):
        _check_stiffness(scene)


def _check_stiffness(scene: Scene) -> None:
    """Raise InputError if the shear modulus at rest of the whole law is negative in an element.

    One law of a sum may have a negative shear modulus. A law without the method `shear_modulus` is not checked, and
    neither is a law inside jit, grad or vmap. The message names a region if the modulus is not negative without this
    region.
    """
    if any(isinstance(leaf, jax.core.Tracer) for leaf in jax.tree.leaves((scene.law, scene.region))):
        return
    regions = scene.region
    least = _least_shear_modulus(scene, regions)
    if least < 0:
        without = (_least_shear_modulus(scene, (*regions[:k], *regions[k + 1 :])) for k in range(len(regions)))
        causes = [k for k, other in enumerate(without) if other >= 0]
        name, more = (f"region.{causes[0]}: law", "") if len(causes) == 1 else ("law", " or those of its regions")
        raise InputError(
            f"{name} has a shear modulus of {least:.4g} Pa at rest, which must not be negative: change its "
            f"parameters{more}, e.g. the sign of a coefficient"
        )


def _least_shear_modulus(scene: Scene, regions: tuple[Region, ...]) -> float:
    """Return the smallest shear modulus at rest [Pa] of the body with these regions. Return infinity if no law has the
    method `shear_modulus`."""
    whole, least = law_of_elements(scene.law, regions, scene.mesh.number_of_elements), np.inf
    for k in range(len(whole.pieces())):
        with suppress(InputError):  # this law defines no shear modulus
            least = np.fmin.reduce(np.ravel(np.asarray(whole.piece(k).shear_modulus(), float)), initial=least)
    return float(least)
