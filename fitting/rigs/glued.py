"""Tension, indentation and creep of a cylinder as differentiable experiments.

Each is a scene whose law and viscosity are filled in, and a reading of its run. The sample is glued to its plates: that
is part of the simulation, so no factor of shape has to correct for it.

By default the mesh is a narrow sector of the cylinder between two planes of symmetry, fine at the rims of the plates
and at the punch's edge, where stresses are infinite. Its error is in experiments/TABLES.md.
"""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

import liverjax as lj
from liverjax.core.errors import InputError
from liverjax.core.struct import param, replace, static, struct
from liverjax.laws import Law
from liverjax.mesh import cylinders
from liverjax.physics import boundary
from liverjax.physics.loads import nodal_tractions
from liverjax.physics.sliding_support import SlidingSupport
from liverjax.physics.viscosity import Prony

READINGS = ("force", "displacement")
#: Corners of the polygon that stands for the circle, of which a sector has one edge.
CORNERS = 24
#: Length of the cells at the rim of a plate and at a punch's edge, over the shortest length there.
RIM, EDGE = 0.04, 0.02
#: Longest cells over the radius.
LARGEST = 0.34
#: A punch narrower than this part of the sample, or a gap beside it, is below what the mesh is made for.
NARROWEST = 0.01


@struct
class Rig:
    """A scene without its law, and what is read of it along z."""

    scene: lj.Scene = param("1", "with a law that `read` replaces")
    nodes: Any = param("1", "node numbers (n,) that are read")
    weights: Any = param("1", "of each of these nodes (n,) in the reading")
    reading: str = static(default="force", about="force [N], or mean displacement [m], of the whole cylinder's nodes")
    whole: bool = static(default=False, about="the scene is the whole cylinder, not a sector of it")


class _Sample(NamedTuple):
    """A cylinder or a sector of it, glued to a plate at its bottom."""

    mesh: lj.TetMesh
    fixed: tuple
    physics: tuple
    parts: float  # how many such meshes are a cylinder
    under: np.ndarray  # nodes of the top within the punch, or of all of it


def read(rig: Rig, law: Law, prony: Prony | None) -> tuple[jax.Array, jax.Array]:
    """What the rig shows at every step (T,) [N] or [m], and the steps' codes (T,).

    Raises:
        InputError: a law with directions of its own in a sector, where only what is alike all around the axis fits.
    """
    if not rig.whole and any(part.fibre is not None or part.green_energy is not None for part in law.summands()):
        raise InputError(
            f"law {type(law).__name__} has directions, and the rig's mesh is a sector of the cylinder: give the rig a "
            "cell_size, then it is whole"
        )
    result = lj.simulate(replace(rig.scene, law=law, viscosity=prony))
    if rig.reading == "force":
        return result.reactions[:, rig.nodes, 2] @ rig.weights, result.status
    rest = rig.scene.mesh.points[rig.nodes, 2]
    return (result.positions[:, rig.nodes, 2] - rest[None]) @ rig.weights, result.status


def tension(radius: float, height: float, dt: float, strains: Any, cell_size: float | None = None) -> Rig:
    """A cylinder pulled (or pressed) between glued plates; the force is read.

    Args:
        radius, height: of the sample [m].
        dt: time step [s].
        strains: nominal strain at the end of every step (T,).
        cell_size: edge length [m] of a mesh of the whole cylinder with cells of one size; default a graded sector.

    Raises:
        InputError: lengths or times that are not positive, strains that are not finite or flatten the sample.
    """
    strains = _finite("strains", strains)
    if strains.min() <= -0.9:
        raise InputError(f"strains reach {strains.min():g}: keep them above -0.9")
    _check(radius, height, dt, cell_size)
    rim = RIM * min(radius, height / 2)
    sample = _sample({radius: rim}, {0.0: rim, height: rim}, cell_size)
    return _driven(sample, dt, height * strains)


def indentation(
    radius: float, height: float, punch: float, dt: float, depths: Any, cell_size: float | None = None
) -> Rig:
    """A glued flat punch of radius `punch` [m] pressed into a cylinder by `depths` (T,) [m]; the force on it.

    Args:
        radius, height, dt, cell_size: as of `tension`; a ring of nodes is at the punch's edge.

    Raises:
        InputError: as of `tension`; a punch wider than the sample, or far narrower.
    """
    depths = _finite("depths", depths)
    _check(radius, height, dt, cell_size)
    if not NARROWEST * radius <= punch <= (1 - NARROWEST) * radius:
        raise InputError(
            f"punch = {punch:g} m must be between {NARROWEST:g} and {1 - NARROWEST:g} of the radius {radius:g}: mend "
            "one of them"
        )
    edge = EDGE * min(punch, radius - punch, height)
    rings = {punch: edge, radius: RIM * min(radius - punch, height)}
    layers = {0.0: RIM * min(radius, height), height: edge}
    return _driven(_sample(rings, layers, cell_size, punch), dt, -depths)


def creep(radius: float, height: float, dt: float, steps: int, stress: float, cell_size: float | None = None) -> Rig:
    """A cylinder under a constant pull `stress` [Pa] on its top from time 0 on; the mean displacement of the top.

    The pull comes up over the first step, as it does in a rheometer over some time. The mean is that over the area.
    """
    _check(radius, height, dt, cell_size)
    rim = RIM * min(radius, height)
    sample = _sample({radius: rim}, {0.0: rim, height: height}, cell_size)
    mesh, top = sample.mesh, jnp.asarray(sample.under)
    triangles = jnp.asarray(boundary.boundary_triangles(mesh, sample.under))
    unit = lj.Traction(triangles=triangles, value=jnp.array([0.0, 0.0, 1.0]))
    share = nodal_tractions(mesh, (unit,))[top, 2]
    pull = replace(unit, value=float(stress) * unit.value)
    scene = _scene(sample, dt, steps, traction=(pull,))
    weights = share / jnp.sum(share)
    return Rig(scene=scene, nodes=top, weights=weights, reading="displacement", whole=not sample.physics)


def _finite(name: str, values: Any) -> np.ndarray:
    values = np.atleast_1d(np.asarray(values, float))
    if values.ndim != 1 or not len(values) or not np.all(np.isfinite(values)):
        raise InputError(f"{name} must be finite numbers, one a step: mend the list")
    return values


def _check(radius: float, height: float, dt: float, cell_size: float | None) -> None:
    if not (np.isfinite(dt) and dt > 0):
        raise InputError(f"dt = {dt} must be positive: give the time step in seconds")
    for name, value in (("radius", radius), ("height", height), ("cell_size", cell_size)):
        if value is not None and not (np.isfinite(value) and value > 0):
            raise InputError(f"{name} = {value} must be positive and finite: give a length in metres")


def _sample(rings: dict, layers: dict, cell_size: float | None, punch: float | None = None) -> _Sample:
    """A sector with cells of given lengths at given radii and heights; whole, of one cell size, where one is given."""
    radius, height = max(rings), max(layers)
    if cell_size:
        rings, layers = (dict.fromkeys(places, cell_size) for places in (rings, layers))
    largest = min(cell_size or LARGEST * radius, radius / 2)
    radii, heights = cylinders.graded(radius, rings, largest), cylinders.graded(height, layers, 2 * largest)
    if cell_size:
        mesh, normal, parts = cylinders.graded_cylinder(radii, heights), None, 1.0
    else:
        mesh, normal, parts, _ = cylinders.sector(radii, heights, CORNERS)
    sets = {name: np.asarray(nodes) for name, nodes in mesh.node_sets.items()}
    under = sets["top"]
    if punch is not None:
        # The nodes of a layer are numbered from the axis outwards, ring after ring.
        distance = np.hypot(*np.asarray(mesh.points)[under, :2].T)
        ends = np.flatnonzero(np.diff(distance) > 1e-9 * radius)
        under = under[: 1 + ends[np.argmin(np.abs(radii - punch))]]
    fixed = [lj.Fixed(nodes=jnp.asarray(sets["bottom"]))]
    if normal is None:
        return _Sample(mesh, tuple(fixed), (), parts, under)
    fixed += [
        lj.Fixed(nodes=jnp.asarray(sets["start"]), axes="y"),
        lj.Fixed(nodes=jnp.asarray(sets["axis"]), axes="xy"),
    ]
    slides = SlidingSupport(nodes=jnp.asarray(np.setdiff1d(sets["end"], sets["axis"])), normal=jnp.asarray(normal))
    return _Sample(mesh, tuple(fixed), (slides,), parts, under)


def _driven(sample: _Sample, dt: float, lift: np.ndarray) -> Rig:
    history = np.zeros((len(lift) + 1, 3))
    history[1:, 2] = lift
    times = dt * np.arange(len(lift) + 1)
    nodes = jnp.asarray(sample.under)
    moved = lj.Displaced(nodes=nodes, times=jnp.asarray(times), history=jnp.asarray(history))
    scene = _scene(sample, dt, len(lift), displaced=(moved,))
    return Rig(scene=scene, nodes=nodes, weights=jnp.full(len(nodes), sample.parts), whole=not sample.physics)


def _scene(sample: _Sample, dt: float, steps: int, **loads: Any) -> lj.Scene:
    return lj.Scene(
        mesh=sample.mesh,
        law=lj.laws.NeoHookean(mu=1.0, bulk=1.0),
        fixed=sample.fixed,
        physics=sample.physics,
        solve=lj.Solve(dt=dt, steps=steps, tolerance=1e-9),
        **loads,
    )
