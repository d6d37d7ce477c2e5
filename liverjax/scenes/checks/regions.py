"""Checks of the regions of a scene. One function checks their parameters, another one checks their elements."""

import math

import jax
import numpy as np

from liverjax import laws
from liverjax.core import bounds, names
from liverjax.core.did_you_mean import hint
from liverjax.core.errors import InputError
from liverjax.core.struct import Content, replace
from liverjax.laws import Law
from liverjax.physics.porosity import Porosity, check_limit
from liverjax.physics.viscosity import Prony, check_series
from liverjax.scenes.regions import (
    POROUS,
    VISCOUS,
    Region,
    changed_directions,
    changed_numbers,
    law_number,
    refused_name,
)
from liverjax.scenes.scene import Scene


def check_region_numbers(scene: Scene) -> None:
    """Check the parameters of all regions. Parameters inside jit, grad or vmap are not checked.

    Raises:
        InputError: a region changes [viscosity] or [porosity], but the scene has none; a name is unknown; a value is
            out of bounds; a direction is incomplete or unusable; the number of modes is wrong; or limit_bulk is not
            above bulk in an element.
    """
    for k, region in enumerate(scene.region):
        _check_law(scene.law, region, f"region.{k}")
        check_region_viscosity(scene.viscosity, region, f"region.{k}")
        check_region_porosity(scene.porosity, region, f"region.{k}")
    _check_directions(scene)
    _check_limits(scene)


def check_region_elements(scene: Scene) -> None:
    """Check the elements of all regions. Do not call this function inside jit.

    Raises:
        InputError: a region has no elements, has unknown elements or changes nothing; an element has two laws.
    """
    last = scene.mesh.number_of_elements - 1
    for k, region in enumerate(scene.region):
        elements = np.asarray(region.elements)
        if elements.size and elements.dtype.kind not in "iu":
            raise InputError(f"region.{k} has element numbers of type {elements.dtype}: give whole numbers")
        if elements.size == 0 or elements.min() < 0 or elements.max() > last:
            raise InputError(f"region.{k} has no elements, or element numbers outside 0 to {last}: correct the numbers")
        if not region.law and not region.viscosity and not region.porosity:
            raise InputError(f"region.{k} changes nothing: give e.g. law = {{mu = 2000.0}}")
    _check_own_laws(scene.region)
    _check_hidden(scene.region, last + 1)


def _check_law(law: Law, region: Region, name: str) -> None:
    for number, value in changed_numbers(region).items():
        law_number(law, number)
        metadata = names.metadata(law, number, refused_name(number)) | {"each": False}
        laws.check_value(f"{name}: law.{number}", metadata, value)
    own = changed_numbers(region)
    for direction in changed_directions(region):
        if any(f"{direction}.{k}" not in own for k in range(3)):
            raise InputError(f"{name}: law.{direction} does not have three components: give three numbers")


def _check_directions(scene: Scene) -> None:
    """Raise InputError if regions give an element directions that the law cannot have, for example parallel ones.

    Directions inside jit, grad or vmap, and wrong element numbers, are not checked here.
    """
    law, turning = scene.law, {k: own for k, own in enumerate(scene.region) if changed_directions(own)}
    for direction in sorted({name for region in turning.values() for name in changed_directions(region)}):
        rows = _rows_of_direction(scene, direction)
        if rows is None:
            return
        law = names.put(law, direction, rows, refused_name(direction))
    try:
        for part in law.summands() if turning else ():
            part.check_directions()
    except InputError as error:
        raise InputError(f"{', '.join(f'region.{k}' for k in turning)}: {error}") from None


def _rows_of_direction(scene: Scene, direction: str) -> np.ndarray | None:
    """Return a direction in all elements (E, 3), with the changes by the regions. Return None if values or element
    numbers are unknown or wrong."""
    n, value = scene.mesh.number_of_elements, names.get(scene.law, direction, refused_name(direction))
    changes = []
    for region in scene.region:
        own = changed_numbers(region)
        if f"{direction}.0" in own:
            changes.append((region.elements, [own[f"{direction}.{k}"] for k in range(3)]))
    if any(isinstance(leaf, jax.core.Tracer) for leaf in jax.tree.leaves((value, changes))):
        return None
    if np.shape(value) not in ((3,), (n, 3)):
        return None
    rows = np.broadcast_to(np.asarray(value, float), (n, 3)).copy()
    for elements, vector in changes:
        places = np.asarray(elements)
        if places.dtype.kind not in "iu" or np.any((places < 0) | (places >= n)):
            return None
        rows[places] = vector
    return rows


def check_region_viscosity(prony: Prony | None, region: Region, name: str) -> None:
    """Check the viscous parameters of a region. Parameters inside jit, grad or vmap are not checked.

    Raises:
        InputError: the scene has no [viscosity], the number of modes is wrong, or a value is out of bounds.
    """
    own = region.viscosity
    if not own:
        return
    if prony is None:
        raise InputError(
            f"{name} has a viscosity, which needs [viscosity] in the scene: add [viscosity], with ratios = [0.0] if "
            "the rest of the body is elastic"
        )
    unknown = sorted(set(own) - set(VISCOUS))
    if unknown:
        raise InputError(
            f"{name}: viscosity contains {unknown[0]}, but only {' and '.join(VISCOUS)} can differ in a region"
        )
    modes = bounds.shape_of(prony.ratios)[0]
    for key, value in own.items():
        if bounds.shape_of(value) != (modes,):
            n = math.prod(bounds.shape_of(value))
            raise InputError(
                f"{name}: viscosity.{key} has {n} numbers, but the scene has {modes} modes; give {modes} numbers"
            )
    if any(isinstance(leaf, jax.core.Tracer) for leaf in jax.tree.leaves((dict(own), prony.ratios))):
        return
    changed: Content = {key: np.asarray(value, float) for key, value in own.items()}
    if np.ndim(prony.ratios) == 2:  # the scene has one series per element
        changed = {key: np.broadcast_to(value[:, None], np.shape(prony.ratios)) for key, value in changed.items()}
    try:
        check_series(replace(prony, **changed))
    except InputError as error:
        raise InputError(f"{name}: {error}") from None


def check_region_porosity(porosity: Porosity | None, region: Region, name: str) -> None:
    """Check the porous parameters of a region. Parameters inside jit, grad or vmap are not checked.

    bulk and limit_bulk are not compared here, because several regions may change them in an element.

    Raises:
        InputError: the scene has no [porosity], a name is unknown, or a value is out of bounds.
    """
    own: Content = dict(region.porosity or {})
    if not own:
        return
    if porosity is None:
        raise InputError(f"{name} has a porosity, which needs [porosity] in the scene: add [porosity]")
    for key, value in own.items():
        if key not in POROUS:
            raise InputError(f"{name}: porosity contains {key}, which cannot differ in a region; {hint(key, POROUS)}")
        if np.ndim(value):
            raise InputError(f"{name}: porosity.{key} has {np.size(value)} numbers; give one number")
    numbers = (*own.values(), *(getattr(porosity, key) for key in POROUS))
    if any(isinstance(value, jax.core.Tracer) for value in numbers):
        return
    try:
        bounds.check_fields(replace(porosity, **own), "porosity")
    except InputError as error:
        raise InputError(f"{name}: {error}") from None


def _check_limits(scene: Scene) -> None:
    """Raise InputError if limit_bulk is not above bulk in an element, with the changes by all regions.

    Parameters inside jit, grad or vmap, and wrong element numbers, are not checked here.
    """
    porosity, n, keys = scene.porosity, scene.mesh.number_of_elements, ("bulk", "limit_bulk")
    changed = {k: own for k, region in enumerate(scene.region) if (own := region.porosity) and set(keys) & set(own)}
    if porosity is None or not changed:
        return
    values: Content = {key: getattr(porosity, key) for key in keys}
    places = {k: scene.region[k].elements for k in changed}
    if any(isinstance(leaf, jax.core.Tracer) for leaf in jax.tree.leaves((values, changed, places))):
        return
    if any(np.shape(value)[-1:] not in ((), (1,), (n,)) for value in values.values()):
        return  # other shapes are not compared here
    for key in keys:
        numbers = np.broadcast_to(np.asarray(values[key], float), (*np.shape(values[key])[:-1], n)).copy()
        for k, own in changed.items():
            elements = np.asarray(places[k])
            if elements.dtype.kind not in "iu" or np.any((elements < 0) | (elements >= n)):
                return
            if key in own:
                numbers[..., elements] = own[key]
        values[key] = numbers
    try:
        check_limit(replace(porosity, **values))
    except InputError as error:
        raise InputError(f"{', '.join(f'region.{k}' for k in changed)}: {error}") from None


def _check_hidden(regions: tuple[Region, ...], elements: int) -> None:
    """Raise InputError if a region has no effect, because later regions replace its parameters in all its elements."""
    taken: dict[str, np.ndarray] = {}
    nothing = np.zeros(elements, bool)
    for k, region in reversed(list(enumerate(regions))):
        own, names = np.asarray(region.elements), _names_of(region)
        law = taken.get("law", nothing)[own]  # a complete law of a later region replaces all parameters
        if all(np.all(taken.get(n, nothing)[own] | (law if n.startswith("law.") else False)) for n in names):
            raise InputError(
                f"region.{k} changes nothing, because later regions set the same parameters in all of its elements: "
                "remove this region, or select other elements"
            )
        for name in names:
            taken.setdefault(name, nothing.copy())[own] = True


def _names_of(region: Region) -> set[str]:
    """Return the names of the parameters that a region changes."""
    own = {"law"} if isinstance(region.law, Law) else {f"law.{name}" for name in changed_numbers(region)}
    own |= {f"viscosity.{name}" for name in region.viscosity or {}}
    return own | {f"porosity.{name}" for name in region.porosity or {}}


def _check_own_laws(regions: tuple[Region, ...]) -> None:
    """Raise InputError if the regions give contradictory laws for an element, or contain an element twice."""
    for k, region in enumerate(regions):
        if not isinstance(region.law, Law):
            continue
        elements = np.asarray(region.elements)
        if np.unique(elements).size < elements.size:
            raise InputError(f"region.{k} contains an element twice: list each element once")
        for later, other in enumerate(regions[k + 1 :], k + 1):
            if other.law and np.isin(np.asarray(other.elements), elements).any():
                raise InputError(
                    f"region.{later} changes parameters of elements whose whole law is given by region.{k}: select "
                    "different elements, or write these parameters into that law"
                )
