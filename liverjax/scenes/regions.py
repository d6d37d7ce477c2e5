"""Regions: parts of a body with other parameters of law, viscosity or porosity, or with another kind of law."""

import warnings
from collections.abc import Mapping

import jax
import numpy as np

from liverjax.core import names
from liverjax.core.did_you_mean import as_word
from liverjax.core.errors import InputError
from liverjax.core.struct import Content, Indices, Numbers, param, struct
from liverjax.laws import Law
from liverjax.mesh.tetrahedra import TetMesh, tolerance_of_bounds
from liverjax.physics import boundary

#: Parameters of viscosity and porosity that may differ in a region.
VISCOUS = ("ratios", "relaxation_times")
POROUS = ("bulk", "limit_bulk", "fluid_fraction", "permeability")


@struct
class Region:
    """Elements with other parameters or another law than the scene.

    If regions that change parameters overlap, the later region is used. A region with a whole law must not overlap a
    later region that changes the law.
    """

    elements: Indices = param("1", "element numbers (n,)")
    law: Content | Law | None = param(
        "1",
        "names of parameters without `law.` (`mu`, `mu.0`, or `1.mu` of several laws) -> values; or another law",
        default=None,
    )
    viscosity: Mapping[str, Numbers] | None = param(
        "1", "`ratios`, `relaxation_times` or both -> values (N,) of N modes", default=None
    )
    porosity: Mapping[str, Numbers] | None = param(
        "1", "`bulk`, `limit_bulk`, `fluid_fraction`, `permeability` -> values", default=None
    )


def select_elements(mesh: TetMesh, where: dict[str, float] | None, set: str | None, name: str = "region") -> np.ndarray:
    """Return the numbers of the elements in a set, or of the elements with all vertices in `where` (`boundary.select`).

    Raises:
        InputError: `where` and `set` are both given or both missing; the mesh has no such set; no element is found.
    """
    if set is not None and where is None:
        if as_word(set, f"{name}: set") not in mesh.element_sets:
            known = ", ".join(mesh.element_sets) or "none"
            raise InputError(
                f"{name}: the mesh has no element set {set!r} (the element sets are: {known}); use one of these sets, "
                "or where"
            )
        elements = np.asarray(mesh.element_sets[set])
        if not len(elements):
            raise InputError(f"{name}: the element set {set!r} of the mesh is empty; correct the set, or use where")
        return elements
    nodes = boundary.select(mesh, where, set, name)
    inside = np.flatnonzero(np.isin(np.asarray(mesh.tetrahedra), nodes).all(axis=1))
    if not len(inside):
        raise InputError(f"{name} = {where} contains nodes but no whole element: enlarge the region")
    _warn_of_cut_elements(mesh, inside, where or {}, name)
    return inside


#: The program warns if the distance between a bound of `where` and the elements of its region is larger than this
#: fraction of the width of the region.
_APART = 0.02


def _warn_of_cut_elements(mesh: TetMesh, elements: np.ndarray, where: dict[str, float], name: str) -> None:
    """Warn if a bound of `where` cuts elements. The region does not contain cut elements, so it is smaller than its
    bounds."""
    points, tets = np.asarray(mesh.points), np.asarray(mesh.tetrahedra)
    tolerance = tolerance_of_bounds(mesh)
    inside = {
        key: (points[:, "xyz".index(key[0])] - bound) * (1 if key.endswith("min") else -1) >= -tolerance
        for key, bound in where.items()
    }
    for key, bound in where.items():
        x, first = points[:, "xyz".index(key[0])], key.endswith("min")
        beside = np.all([inside[other][tets].all(axis=1) for other in where if other != key] or [True], axis=0)
        cut = beside & inside[key][tets].any(axis=1) & ~inside[key][tets].all(axis=1)
        own = x[tets[elements]]
        end = own.min() if first else own.max()
        if np.any(cut) and abs(end - bound) > _APART * np.ptp(own):
            warnings.warn(
                f"{name}: {key} = {bound:g} cuts elements. Cut elements are not in the region, so the region "
                f"{'begins' if first else 'ends'} at {end:.4g} m. Put a layer of nodes at this bound (cells of the "
                "mesh), or use an element set",
                stacklevel=3,
            )


def laws_of(law: Law, regions: tuple[Region, ...]) -> tuple[Law, ...]:
    """Return the law of a scene, and the complete laws that replace this law in regions."""
    return (*law.pieces(), *(region.law for region in regions if isinstance(region.law, Law)))


def changed_numbers(region: Region) -> dict[str, object]:
    """Return names and values of the parameters that a region changes in the law of the scene."""
    return region.law if isinstance(region.law, dict) else {}


def changed_directions(region: Region) -> list[str]:
    """Return the names of the directions, such as `fibre` or `1.sheet`, with a component that the region changes."""
    owners = {name.rpartition(".")[0] for name in changed_numbers(region)}
    return sorted(name for name in owners if name.rpartition(".")[2] in ("fibre", "sheet"))


def set_by_regions(regions: tuple[Region, ...], name: str, number_of_elements: int) -> tuple[np.ndarray, np.ndarray]:
    """Return for each element whether a region changes a parameter such as `law.mu` (E,), and the new value (E,).

    A value is NaN if the law of the region does not have the parameter, or if the parameter is not one number.
    """
    table, _, rest = name.partition(".")
    own, values = np.zeros(number_of_elements, bool), np.full(number_of_elements, np.nan)
    for region in regions:
        given = changed_numbers(region) if table == "law" else (getattr(region, table, None) or {})
        value, key = None, rest
        if table == "law" and isinstance(region.law, Law):
            value = getattr(region.law, rest, np.nan)
        elif rest in given:
            value = given[rest]
        elif table in ("viscosity", "porosity") and rest.partition(".")[0] in given:
            key, _, mode = rest.partition(".")
            value = np.asarray(given[key])[int(mode)]
        if value is not None:
            own[np.asarray(region.elements)] = True
            values[np.asarray(region.elements)] = np.asarray(value, float) if np.ndim(value) == 0 else np.nan
    return own, values


def law_number(law: Law, name: str) -> jax.Array:
    """Return the value that the parameter `name` has in the law of the scene. A region changes this parameter.

    Raises:
        InputError: the law has no parameter with this name, or the name belongs to a list of parameters or to a law.
    """
    value = names.get(law, name, refused_name(name))
    if isinstance(value, tuple):
        raise InputError(
            f"region: {name} is a list of {len(value)} values: name one of these values, for example {name}.0"
        )
    if isinstance(value, Law):
        raise InputError(f"region: {name} is a law with several parameters: name one of them, for example {name}.mu")
    return value


def refused_name(name: str) -> str:
    """Return the beginning of the message for a parameter that the law does not have."""
    return f"region: the law has no number {name!r}"
