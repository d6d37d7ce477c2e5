"""Parts of a body with other numbers in its law: they become one number an element, where a region changes them."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from liverjax import laws
from liverjax.core.errors import InputError
from liverjax.core.struct import param, replace, struct
from liverjax.laws import Law
from liverjax.mesh.tetrahedra import TetMesh
from liverjax.physics import boundary


@struct
class Region:
    """Elements whose law has other numbers than that of the scene; a later region wins where two meet."""

    elements: Any = param("1", "element numbers (n,)")
    law: dict[str, Any] = param("1", "names as after `law.` (`mu`, `mu.0`, `1.mu` of several laws) -> values")


def select(mesh: TetMesh, where: dict[str, float] | None, set: str | None, name: str = "region") -> np.ndarray:
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
        for name, value in region.law.items():
            path = name.split(".")
            base = jnp.broadcast_to(jnp.asarray(_get(law, path, name), float), (number_of_elements,))
            law = _put(law, path, base.at[region.elements].set(value))
    return law


def check(law: Law, regions: tuple[Region, ...], number_of_elements: int) -> None:
    """Refuse regions that no scene can use; host side.

    Raises:
        InputError: no or unknown elements, a name that the law has not, a value that is not finite or out of bounds.
    """
    for k, region in enumerate(regions):
        elements = np.asarray(region.elements)
        if elements.size == 0 or elements.min() < 0 or elements.max() >= number_of_elements:
            raise InputError(f"region.{k} names elements outside 0 to {number_of_elements - 1}: renumber them")
        if not region.law:
            raise InputError(f"region.{k} changes nothing: give e.g. law = {{mu = 2000.0}}")
    check_numbers(law, regions)


def check_numbers(law: Law, regions: tuple[Region, ...]) -> None:
    """Refuse numbers of regions that their law does not allow; traced ones pass.

    Raises:
        InputError: a name that the law has not, a value that is not finite or out of bounds.
    """
    for k, region in enumerate(regions):
        for name, value in region.law.items():
            path = name.split(".")
            _get(law, path, name)
            laws.check_value(f"region.{k}: law.{name}", _metadata(law, path), value)


def _owner(law: Law, path: list[str]) -> tuple[Law, list[str]]:
    """The one law that a name is of, and the rest of the name."""
    if isinstance(law, laws.Continued):
        return _owner(law.law, path)
    if isinstance(law, laws.Sum) and path[0].isdigit() and int(path[0]) < len(law.laws):
        return _owner(law.laws[int(path[0])], path[1:])
    return law, path


def _metadata(law: Law, path: list[str]) -> dict[str, Any]:
    owner, (key, *_) = _owner(law, path)
    return {f.name: f.metadata for f in laws.parameters(owner)}[key] | {"each": False}


def _get(law: Law, path: list[str], name: str) -> Any:
    owner, path = _owner(law, path)
    known = [f.name for f in laws.parameters(owner) if getattr(owner, f.name) is not None]
    if not path or path[0] not in known:
        raise InputError(f"region: the law has no number {name!r}: use one of {', '.join(known)}")
    value = getattr(owner, path[0])
    if isinstance(value, tuple):
        if len(path) != 2 or not path[1].isdigit() or int(path[1]) >= len(value):
            raise InputError(f"region: {path[0]} is a list of {len(value)}: name one of them, {path[0]}.0")
        return value[int(path[1])]
    if len(path) > 1:
        raise InputError(f"region: {path[0]} is one number: name it {path[0]}")
    return value


def _put(law: Law, path: list[str], value: jax.Array) -> Law:
    if isinstance(law, laws.Continued):
        return replace(law, law=_put(law.law, path, value))
    if isinstance(law, laws.Sum):
        k = int(path[0])
        return replace(law, laws=(*law.laws[:k], _put(law.laws[k], path[1:], value), *law.laws[k + 1 :]))
    if len(path) == 2:
        k, old = int(path[1]), getattr(law, path[0])
        return replace(law, **{path[0]: (*old[:k], value, *old[k + 1 :])})
    return replace(law, **{path[0]: value})
