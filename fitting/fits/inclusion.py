"""A stiff or soft sphere in a uniform body. Centre, radius and stiffness of the sphere are estimated from measured
displacements.

A sphere has fewer parameters than a stiffness map. A smooth map spreads a sharp edge, so the peak of the map is not the
modulus of an inclusion. The map only gives the starting point of the fit. The edge of the sphere is smooth over a
length proportional to the element size, so the residuals have derivatives with respect to the position of the sphere.
An error of the radius can compensate an error of the modulus. The elements should therefore be quadratic, or much
smaller than the sphere. An element that the edge cuts has the mean of both moduli, weighted by volume. The estimated
mesh error contains the error of this mean, because the estimate uses smaller or quadratic elements, which resolve the
edge better.
"""

from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from fitting.fits.field import Field, start_of
from fitting.fits.scene_numbers import Problem, Unknowns, fit
from fitting.methods.estimate import Estimate
from liverjax.core.errors import InputError
from liverjax.core.struct import Number
from liverjax.mesh.shape_functions import basis
from liverjax.mesh.tetrahedra import TetMesh

#: The sphere is evaluated at a grid of points in each element, with this number of points per edge.
_POINTS = 5
#: Width of the smooth edge of the sphere, divided by the distance between the points of this grid.
_EDGE = 0.15
NAMES = ("centre.x", "centre.y", "centre.z", "radius", "background", "inclusion")


def edge_length(mesh: TetMesh) -> float:
    """Return a typical edge length [m] of the elements: the edge of a regular tetrahedron with their mean volume."""
    return float(np.cbrt(6 * np.sqrt(2) * np.mean(np.asarray(mesh.volumes))))


def _places_in_element() -> np.ndarray:
    """Return the barycentric coordinates (4, n) of a regular grid of points inside a tetrahedron."""
    m = _POINTS
    rows = [(a, b, c, m - 1 - a - b - c) for a in range(m) for b in range(m - a) for c in range(m - a - b)]
    return (np.array(rows, float).T + 0.25) / m


def inside(mesh: TetMesh, L: np.ndarray, centre: jax.Array, radius: Number) -> jax.Array:
    """Return a smooth indicator (n, E) of the sphere at n points of each of E elements: 1 inside, 0 outside.

    `L` (4, n): barycentric coordinates of the n points of each element.
    """
    width = _EDGE * edge_length(mesh) / _POINTS
    points = jnp.einsum("kq,eki->qei", L, mesh.points[mesh.tetrahedra])
    distance = jnp.sqrt(jnp.sum((points - centre[None, None]) ** 2, axis=-1) + 1e-3 * width**2)
    return jax.nn.sigmoid((radius - distance) / width)


def fraction(mesh: TetMesh, centre: jax.Array, radius: Number) -> jax.Array:
    """Return the fraction of each element (E,) that lies inside the sphere."""
    return jnp.mean(inside(mesh, _places_in_element(), centre, radius), axis=0)


def start_from(problem: Problem, field: Field) -> np.ndarray:
    """Return the starting point u (6,) of the sphere (see `estimate`) from the map. The sphere consists of the elements
    whose ln(modulus) differs from the background by more than half of the largest difference. For this comparison, the
    differences are divided by the standard deviation of the map. Without this division, the starting sphere could lie
    where the differences are large but the data contain little information, for example at corners.

    Raises:
        InputError: the map is uniform.
    """
    mesh = problem.scenes[0].mesh
    middle = np.asarray(mesh.points)[np.asarray(mesh.tetrahedra)].mean(axis=1)
    volumes = np.asarray(mesh.volumes)
    m, sd = (own[np.asarray(mesh.tetrahedra)].mean(axis=1) for own in (field.log_factor, field.sd))
    order = np.argsort(m)
    background = m[order[np.searchsorted(np.cumsum(volumes[order]), 0.5 * volumes.sum())]]
    away = m - background
    known = away / sd
    sign = 1.0 if known.max() >= -known.min() else -1.0
    weight = volumes * np.maximum(sign * known - 0.5 * (sign * known).max(), 0.0)
    inside = weight > 0
    if not inside.any():
        raise InputError(
            f"the map of {field.name} is uniform, so no sphere can be placed: fit no sphere, or give more accurate data"
        )
    centre = (weight[:, None] * middle).sum(axis=0) / weight.sum()
    radius = np.cbrt(3 * volumes[inside].sum() / (4 * np.pi))
    contrast = away[inside].mean()
    return np.array([*centre, np.log(radius), background, contrast])


def estimate(problem: Problem, name: str, start: np.ndarray, **options: Any) -> Estimate:
    """Estimate the centre and radius [m] of the sphere, and the parameter `name` outside and inside the sphere, with
    standard errors.

    Args:
        problem: scenes with one mesh, and the measurements.
        name: dotted name of a positive parameter of the law.
        start: (6,) centre (3,), ln(radius), ln(background / value in the scene), ln(inclusion / background).
        options: options of `fitting.fits.scene_numbers.fit`.
    """
    base, mesh = start_of(problem, name), problem.scenes[0].mesh
    size = float(np.ptp(np.asarray(mesh.points), axis=0).max())
    scale = jnp.array([size] * 3 + [1.0] * 3)

    def modulus(u, base, part_of):
        u = u * scale
        return {name: base * jnp.exp(u[4]) * (1 + jnp.expm1(u[5]) * part_of(u[:3], jnp.exp(u[3])))}

    def values_of(u):
        return modulus(u, base, partial(fraction, mesh))

    def at_points(u, richer):
        own = jnp.repeat(base, richer.number_of_elements // mesh.number_of_elements)  # refinement divides elements
        if richer.order == 1:
            return modulus(u, own, partial(fraction, richer))
        return modulus(u, own[None], partial(inside, richer, basis(richer.order).L))

    def natural_of(u):
        u = u * scale
        at_rest = jnp.mean(base)
        return jnp.stack([*u[:3], jnp.exp(u[3]), at_rest * jnp.exp(u[4]), at_rest * jnp.exp(u[4] + u[5])])

    # A [[region]] sets the modulus of whole elements. If the mesh describes the loaded body, the points of the mesh
    # change in the run. In both cases, `at_points` cannot be used to compute the error at the edge of the sphere.
    other = any(scene.region or scene.points_are == "loaded" for scene in problem.scenes)
    resolved = None if other else at_points
    unknowns = Unknowns(np.asarray(start) / np.asarray(scale), values_of, natural_of, NAMES, resolved)
    return fit(problem, unknowns, **options)[0]


#: If the radius of a sphere is below this number of element edges, the mesh is too coarse.
SMALL = 1.5


def size_sentence(mesh: TetMesh, found: Estimate) -> str | None:
    """Return a warning if the sphere is not much larger than the elements (`SMALL`), otherwise None. Each element has
    one modulus, so an element at the edge of the sphere has a mean of both moduli. `mesh_bias` contains this error only
    to first order, which is not accurate enough for so few elements."""
    radius, edge = float(found.values[3]), edge_length(mesh)
    if radius >= SMALL * edge:
        return None
    return (
        f"the radius of the sphere ({radius:.2g} m) is only {radius / edge:.2g} times the edges of the elements "
        f"({edge:.2g} m), so radius and modulus of the sphere may be wrong by more than their errors and mesh bias: "
        "refine the mesh"
    )
