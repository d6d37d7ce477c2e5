"""Parts of a body with other numbers in its law: they become one number an element, where a region changes them."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from liverjax import laws
from liverjax.core import names
from liverjax.core.errors import InputError
from liverjax.core.struct import param, replace, struct
from liverjax.laws import Law
from liverjax.mesh.tetrahedra import TetMesh
from liverjax.physics import boundary
from liverjax.physics.viscosity import Prony, check_series

#: What may differ in a region's viscosity.
VISCOUS = ("ratios", "relaxation_times")


@struct
class Region:
    """Elements with other numbers than those of the scene; a later region wins where two meet."""

    elements: Any = param("1", "element numbers (n,)")
    law: dict[str, Any] | None = param(
        "1", "names as after `law.` (`mu`, `mu.0`, `1.mu` of several laws) -> values", default=None
    )
    viscosity: dict[str, Any] | None = param("1", "`ratios` or `relaxation_times` or both -> (N,)", default=None)


def select_elements(mesh: TetMesh, where: dict[str, float] | None, set: str | None, name: str = "region") -> np.ndarray:
    """Numbers of the elements of a set, or of those whose four nodes satisfy `where` (see `boundary.select`).

    Raises:
        InputError: both or neither given, a set that the mesh has not, no element found.
    """
    if set is not None and where is None:
        if set not in mesh.element_sets:
            known = ", ".join(mesh.element_sets) or "none"
            raise InputError(f"{name}: the mesh has no element set {set!r} (it has: {known}); use one of them or where")
        return np.asarray(mesh.element_sets[set])
    nodes = boundary.select(mesh, where, set, name)
    inside = np.flatnonzero(np.isin(np.asarray(mesh.tetrahedra), nodes).all(axis=1))
    if not len(inside):
        raise InputError(f"{name} = {where} holds nodes but no whole element: widen it")
    return inside


def law_of_elements(law: Law, regions: tuple[Region, ...], number_of_elements: int) -> Law:
    """The law with one number an element (E,) where a region has its own, and the scene's numbers elsewhere.

    Raises:
        InputError: a name that the law does not have.
    """
    for region in regions:
        for name, value in (region.law or {}).items():
            base = jnp.broadcast_to(jnp.asarray(_number_at(law, name), float), (number_of_elements,))
            law = names.put(law, name, base.at[region.elements].set(value), _refused_name(name))
    return law


def viscosity_of_elements(prony: Prony, regions: tuple[Region, ...], number_of_elements: int) -> Prony:
    """The series with one number a mode and element (N, E) where a region has its own."""
    found = {}
    for name in VISCOUS:
        own = {
            k: region.viscosity[name]
            for k, region in enumerate(regions)
            if region.viscosity and name in region.viscosity
        }
        if own:
            base = jnp.asarray(getattr(prony, name), float)[:, None]
            numbers = jnp.broadcast_to(base, (base.shape[0], number_of_elements))
            for k, values in own.items():
                numbers = numbers.at[:, regions[k].elements].set(jnp.asarray(values, float)[:, None])
            found[name] = numbers
    if not found:
        return prony
    shape = next(iter(found.values())).shape
    plain = {name: jnp.broadcast_to(jnp.asarray(getattr(prony, name), float)[:, None], shape) for name in VISCOUS}
    return replace(prony, **plain | found)


def check(law: Law, regions: tuple[Region, ...], number_of_elements: int) -> None:
    """Refuse regions that no scene can use; host side.

    Raises:
        InputError: no or unknown elements, a name that the law has not, a value that is not finite or out of bounds.
    """
    for k, region in enumerate(regions):
        elements = np.asarray(region.elements)
        if elements.size == 0 or elements.min() < 0 or elements.max() >= number_of_elements:
            raise InputError(f"region.{k} names elements outside 0 to {number_of_elements - 1}: renumber them")
        if not region.law and not region.viscosity:
            raise InputError(f"region.{k} changes nothing: give e.g. law = {{mu = 2000.0}}")
    check_regions(law, regions)


def check_viscosity(prony: Prony | None, regions: tuple[Region, ...]) -> None:
    """Refuse viscous numbers of regions that no step can use; traced ones pass.

    Raises:
        InputError: no [viscosity] in the scene, another number of modes, numbers out of bounds.
    """
    for k, region in enumerate(regions):
        name = f"region.{k}: viscosity"
        if not region.viscosity:
            continue
        if prony is None:
            raise InputError(
                f"{name} needs a [viscosity] of the scene: give one, with ratios = [0.0] where it has none"
            )
        unknown = sorted(set(region.viscosity) - set(VISCOUS))
        if unknown:
            raise InputError(f"{name} has {unknown[0]}: only {' and '.join(VISCOUS)} can differ in a region")
        modes = np.shape(prony.ratios)[0]
        for key, value in region.viscosity.items():
            if np.shape(value) != (modes,):
                raise InputError(f"{name}.{key} has {np.size(value)} numbers and the scene {modes} modes: give {modes}")
        if any(isinstance(value, jax.core.Tracer) for value in (*region.viscosity.values(), prony.ratios)):
            continue
        own = replace(prony, **{key: np.asarray(value, float) for key, value in region.viscosity.items()})
        try:
            check_series(own)
        except InputError as error:
            raise InputError(f"region.{k}: {error}") from None


def check_regions(law: Law, regions: tuple[Region, ...]) -> None:
    """Refuse numbers of regions that their law does not allow; traced ones pass.

    Raises:
        InputError: a name that the law has not, a value that is not finite or out of bounds.
    """
    for k, region in enumerate(regions):
        for name, value in (region.law or {}).items():
            _number_at(law, name)
            metadata = names.metadata(law, name, _refused_name(name)) | {"each": False}
            laws.check_value(f"region.{k}: law.{name}", metadata, value)


def _number_at(law: Law, name: str) -> Any:
    value = names.get(law, name, _refused_name(name))
    if isinstance(value, tuple):
        raise InputError(f"region: {name} is a list of {len(value)}: name one of them, {name}.0")
    return value


def _refused_name(name: str) -> str:
    return f"region: the law has no number {name!r}"
