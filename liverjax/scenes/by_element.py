"""Convert the parameters of regions to arrays: a parameter that a region changes gets one value per element.

If a region has another kind of law, this law is computed only for the elements of the region.
"""

import jax
import jax.numpy as jnp

from liverjax.core import names
from liverjax.core.struct import Content, Numbers, replace
from liverjax.laws import Law
from liverjax.laws.by_region import ByRegion
from liverjax.mesh.tetrahedra import TetMesh
from liverjax.physics.porosity import Porosity
from liverjax.physics.viscosity import Prony
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
from liverjax.tensors.subsets import subsets


def by_element(scene: Scene) -> Scene:
    """Return the scene without regions. A parameter that a region changes gets one value per element."""
    mesh, law, prony, sponge = scene.mesh, scene.law, scene.viscosity, scene.porosity
    if scene.region:
        law = law_of_elements(law, scene.region, mesh.number_of_elements)
        if prony is not None:
            prony = viscosity_of_elements(prony, scene.region, mesh.number_of_elements)
        if sponge is not None:
            sponge = porosity_of_elements(sponge, scene.region, mesh)
    law, unrelaxed = mesh.at_points((law, scene.unrelaxed))
    return replace(scene, law=law, unrelaxed=unrelaxed, viscosity=prony, porosity=sponge, region=())


def law_of_elements(law: Law, regions: tuple[Region, ...], number_of_elements: int) -> Law:
    """Return the law of the body: the law of the scene, with the parameters and laws of its regions.

    A parameter that a region changes has one value per element (E,). A direction that a region changes has one row per
    element (E, 3). If a region has a complete law, the result is a `ByRegion` of all laws.

    Raises:
        InputError: a region changes a parameter that the law does not have.
    """
    directions = sorted({name for region in regions for name in changed_directions(region)})
    for name in directions:  # as a tuple of the three components
        law = names.put(law, name, tuple(jnp.moveaxis(_direction_in(law, name), -1, 0)), refused_name(name))
    for region in regions:
        for name, value in changed_numbers(region).items():
            base = jnp.broadcast_to(jnp.asarray(law_number(law, name), float), (number_of_elements,))
            law = names.put(law, name, base.at[region.elements].set(value), refused_name(name))
    for name in directions:
        law = names.put(law, name, _direction_in(law, name), refused_name(name))
    own = [(region.law, region.elements) for region in regions if isinstance(region.law, Law)]
    if not own:
        return law
    groups = subsets([elements for _, elements in own], number_of_elements)
    kinds = tuple(kind for kind, _ in own)
    return ByRegion(laws=kinds if len(kinds) == len(groups.elements) else (law, *kinds), subsets=groups)


def _direction_in(law: Law, name: str) -> jax.Array:
    """Return a direction of the law as an array (3,), or (E, 3) with one row per element."""
    value = names.get(law, name, refused_name(name))
    return jnp.stack(value, axis=-1) if isinstance(value, tuple) else jnp.asarray(value)


def viscosity_of_elements(prony: Prony, regions: tuple[Region, ...], number_of_elements: int) -> Prony:
    """Return the Prony series of the body, with the changes in its regions.

    If a region changes the series, ratios and times have one value per mode and element, (N, E) with N modes.
    """
    found: Content = {}
    for name in VISCOUS:
        own = {
            k: region.viscosity[name]
            for k, region in enumerate(regions)
            if region.viscosity and name in region.viscosity
        }
        if own:
            base = _per_element(getattr(prony, name))
            numbers = jnp.broadcast_to(base, (base.shape[0], number_of_elements))
            for k, values in own.items():
                numbers = numbers.at[:, regions[k].elements].set(jnp.asarray(values, float)[:, None])
            found[name] = numbers
    if not found:
        return prony
    shape = next(iter(found.values())).shape
    plain: Content = {n: jnp.broadcast_to(_per_element(getattr(prony, n)), shape) for n in VISCOUS}
    return replace(prony, **plain | found)


def _per_element(values: Numbers) -> jax.Array:
    """Return the numbers (N,) of the modes as (N, 1); numbers per element (N, E) are returned as they are."""
    found = jnp.asarray(values, float)
    return found if found.ndim == 2 else found[:, None]


def porosity_of_elements(porosity: Porosity, regions: tuple[Region, ...], mesh: TetMesh) -> Porosity:
    """Return the porosity of the body. A parameter that a region changes has one value per element.

    The values of such a parameter have the shape (E,). If the elements have Q integration points, the shape is (1, E),
    or (Q, E) if the scene has a value for each point.
    """
    found: Content = {}
    for region in regions:
        for name, value in (region.porosity or {}).items():
            before = jnp.asarray(found.get(name, getattr(porosity, name)), float)
            base = jnp.broadcast_to(before, (*before.shape[:-1], mesh.number_of_elements))
            found[name] = base.at[..., region.elements].set(value)
    return sponge_at_points(replace(porosity, **found), mesh)


def sponge_at_points(porosity: Porosity, mesh: TetMesh) -> Porosity:
    """Return the porosity. Parameters with one value per element get an additional axis for the integration points."""
    return replace(porosity, **mesh.at_points({name: getattr(porosity, name) for name in POROUS}))
