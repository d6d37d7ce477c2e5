"""Parts of a body with other numbers in its law, or with a law of another kind.

Other numbers become one number an element. A law of another kind is computed for the elements of its region alone.
"""

from collections.abc import Mapping

import jax
import jax.numpy as jnp
import numpy as np

from liverjax import laws
from liverjax.core import names
from liverjax.core.did_you_mean import hint
from liverjax.core.errors import InputError
from liverjax.core.struct import Content, Indices, Numbers, param, replace, struct
from liverjax.laws import Law
from liverjax.laws.by_region import ByRegion
from liverjax.mesh.tetrahedra import TetMesh
from liverjax.physics import boundary
from liverjax.physics.porosity import Porosity, check_sponge
from liverjax.physics.viscosity import Prony, check_series
from liverjax.tensors.subsets import subsets

#: What may differ in a region's viscosity, and in its porosity.
VISCOUS = ("ratios", "relaxation_times")
POROUS = ("bulk", "limit_bulk", "fluid_fraction", "permeability")


@struct
class Region:
    """Elements with other numbers than the scene, or with another law. Where two regions meet, the later one counts."""

    elements: Indices = param("1", "element numbers (n,)")
    law: Content | Law | None = param(
        "1", "names as after `law.` (`mu`, `mu.0`, `1.mu` of several laws) -> values; or a law of its own", default=None
    )
    viscosity: Mapping[str, Numbers] | None = param("1", "`ratios` or `relaxation_times` or both -> (N,)", default=None)
    porosity: Mapping[str, Numbers] | None = param(
        "1", "`bulk`, `limit_bulk`, `fluid_fraction`, `permeability` -> values", default=None
    )


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
    """The law of every element.

    It has one number an element (E,) where a region changes it, and laws side by side where a region has its own.

    Raises:
        InputError: a name that the law does not have.
    """
    for region in regions:
        for name, value in _changed(region).items():
            base = jnp.broadcast_to(jnp.asarray(_number_at(law, name), float), (number_of_elements,))
            law = names.put(law, name, base.at[region.elements].set(value), _refused_name(name))
    own = [(region.law, region.elements) for region in regions if isinstance(region.law, Law)]
    if not own:
        return law
    groups = subsets([elements for _, elements in own], number_of_elements)
    kinds = tuple(kind for kind, _ in own)
    return ByRegion(laws=kinds if len(kinds) == len(groups.elements) else (law, *kinds), subsets=groups)


def laws_of(law: Law, regions: tuple[Region, ...]) -> tuple[Law, ...]:
    """The law of a scene, and those that regions have of their own."""
    return (*law.pieces(), *(region.law for region in regions if isinstance(region.law, Law)))


def _changed(region: Region) -> dict[str, object]:
    """Names and values where a region changes numbers of the scene's law."""
    return region.law if isinstance(region.law, dict) else {}


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


def porosity_of_elements(porosity: Porosity, regions: tuple[Region, ...], mesh: TetMesh) -> Porosity:
    """The porosity with one number an element (E,), or (1, E) of quadratic ones, where a region has its own."""
    found: dict[str, object] = {}
    for region in regions:
        for name, value in (region.porosity or {}).items():
            before = jnp.asarray(found.get(name, getattr(porosity, name)), float)
            base = jnp.broadcast_to(before, (mesh.number_of_elements,))
            found[name] = base.at[region.elements].set(value)
    return sponge_at_points(replace(porosity, **found), mesh)


def sponge_at_points(porosity: Porosity, mesh: TetMesh) -> Porosity:
    """The porosity, its numbers by element as they go with arrays over the points."""
    return replace(porosity, **mesh.at_points({name: getattr(porosity, name) for name in POROUS}))


def check(law: Law, regions: tuple[Region, ...], number_of_elements: int) -> None:
    """Refuse regions that no scene can use; host side.

    Raises:
        InputError: no or unknown elements, a name that the law has not, a value that is not finite or out of bounds.
    """
    for k, region in enumerate(regions):
        elements = np.asarray(region.elements)
        if elements.size == 0 or elements.min() < 0 or elements.max() >= number_of_elements:
            raise InputError(f"region.{k} names elements outside 0 to {number_of_elements - 1}: renumber them")
        if not region.law and not region.viscosity and not region.porosity:
            raise InputError(f"region.{k} changes nothing: give e.g. law = {{mu = 2000.0}}")
    check_regions(law, regions)
    _check_own_laws(regions)


def _check_own_laws(regions: tuple[Region, ...]) -> None:
    """Refuse regions that leave open which law an element has."""
    for k, region in enumerate(regions):
        if not isinstance(region.law, Law):
            continue
        elements = np.asarray(region.elements)
        if np.unique(elements).size < elements.size:
            raise InputError(f"region.{k} names an element twice: name each once")
        for later, other in enumerate(regions[k + 1 :], k + 1):
            if other.law and np.isin(np.asarray(other.elements), elements).any():
                raise InputError(
                    f"region.{later} changes the law of elements to which region.{k} gives a law of its own: give them "
                    "elements apart, or write the numbers into that law"
                )


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


def check_porosity(porosity: Porosity | None, regions: tuple[Region, ...]) -> None:
    """Refuse porous numbers of regions that no step can use; traced ones pass.

    Raises:
        InputError: no [porosity] in the scene, an unknown name, numbers out of bounds.
    """
    for k, region in enumerate(regions):
        name, own = f"region.{k}: porosity", region.porosity or {}
        if not own:
            continue
        if porosity is None:
            raise InputError(f"{name} needs a [porosity] of the scene: give one")
        for key, value in own.items():
            if key not in POROUS:
                raise InputError(f"{name} has {key}, which cannot differ in a region: {hint(key, POROUS)}")
            if np.ndim(value):
                raise InputError(f"{name}.{key} has {np.size(value)} numbers: give one")
        numbers = (*own.values(), *(getattr(porosity, key) for key in POROUS))
        if not any(isinstance(value, jax.core.Tracer) for value in numbers):
            try:
                check_sponge(replace(porosity, **own))
            except InputError as error:
                raise InputError(f"region.{k}: {error}") from None


def check_regions(law: Law, regions: tuple[Region, ...]) -> None:
    """Refuse numbers of regions that their law does not allow; traced ones pass.

    Raises:
        InputError: a name that the law has not, a value that is not finite or out of bounds.
    """
    for k, region in enumerate(regions):
        for name, value in _changed(region).items():
            _number_at(law, name)
            metadata = names.metadata(law, name, _refused_name(name)) | {"each": False}
            laws.check_value(f"region.{k}: law.{name}", metadata, value)


def _number_at(law: Law, name: str) -> jax.Array:
    value = names.get(law, name, _refused_name(name))
    if isinstance(value, tuple):
        raise InputError(f"region: {name} is a list of {len(value)}: name one of them, {name}.0")
    return value


def _refused_name(name: str) -> str:
    return f"region: the law has no number {name!r}"
