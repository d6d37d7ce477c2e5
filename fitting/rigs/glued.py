"""Tension, indentation and creep of a cylinder as differentiable simulations.

Each test is a rig: a scene without a law, and a reading (the force or displacement that is taken from the run). Law and
viscosity are added for each run. The simulated sample is glued to its plates (in creep, only at its bottom). So no
shape factor is needed.

By default, the mesh is a narrow sector of the cylinder between two planes of symmetry. The cells of the mesh are small
at the rims of the plates and at the edge of the punch, where stresses are infinite. experiments/TABLES.md lists the
error of this mesh.
"""

import warnings
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

import liverjax as lj
from fitting.rigs.time_steps import change_with_small_steps
from liverjax.core.errors import InputError
from liverjax.core.struct import Array, Indices, Numbers, param, replace, static, struct
from liverjax.laws import Law
from liverjax.mesh import cylinders
from liverjax.mesh.promotion import quadratic
from liverjax.physics import boundary
from liverjax.physics.loads import nodal_tractions
from liverjax.physics.sliding_support import SlidingSupport
from liverjax.physics.viscosity import Prony
from liverjax.simulation import automatic

#: Minimum radius of the punch, and minimum width of the ring around the punch, divided by the radius of the sample.
NARROWEST = 0.01
#: The error of a default mesh is known to be below 1 % if height / radius lies within SHAPES and K/mu is at most
#: STIFFEST. STIFFEST depends on how the elements treat volume changes (`volumetric` of `lj.Solve`). "mixed" needs a law
#: that separates bulk from shear, and a viscosity with `part = "isochoric"` or no viscosity.
SHAPES, STIFFEST = (0.2, 5.0), {"mixed": 1e4, "element": 20.0}


class Cells(NamedTuple):
    """Sizes and kind of the elements of a rig's mesh. Results of the default mesh are within 1 % of converged results
    (experiments/TABLES.md)."""

    # Cell length [m] in a mesh of the whole cylinder (along the axis, up to twice this length); None: a graded sector.
    size: float | None = None
    # Only for a sector: cell size at the rim of a plate, divided by the shortest dimension of the sample near this rim
    # (for example the radius or half the height).
    rim: float = 0.04
    edge: float = 0.02  # in a sector: cell size at the edge of a punch, divided by the shortest dimension at this edge
    largest: float = 0.34  # in a sector: longest cells, divided by the radius; along the axis, twice this length
    growth: float = cylinders.GROWTH  # increase of the cell length per distance from rims and edge
    corners: int = 24  # number of corners of the polygon that replaces the circle; a sector has one side of it
    order: int = 2  # order of the elements
    volumetric: str = "auto"  # how the elements treat volume changes, see `lj.Solve`


@struct
class Rig:
    """A scene without its law, and the force or displacement along z that is read from its run."""

    scene: lj.Scene = param("1", "scene; `read` replaces its law")
    nodes: Indices = param("1", "indices (n,) of the nodes that are read")
    weights: Array = param("1", "weights (n,): the reading is the sum of the weighted values of these nodes")
    reading: str = static(default="force", about="force [N], or mean displacement [m], of the whole cylinder's nodes")
    whole: bool = static(default=False, about="the scene is the whole cylinder, not a sector of it")


class _Sample(NamedTuple):
    """A cylinder or a sector of it, glued to a plate at its bottom."""

    mesh: lj.TetMesh
    fixed: tuple
    physics: tuple
    parts: float  # number of such meshes that make a whole cylinder
    under: np.ndarray  # nodes of the top under the punch, or all nodes of the top
    volumetric: str


def read(rig: Rig, law: Law, prony: Prony | None) -> tuple[jax.Array, jax.Array]:
    """Run the rig and return, for each of its T steps, the reading (T,) [N] or [m] and the status code (T,).

    Raises:
        InputError: the law is not isotropic, but the mesh is a sector, which needs symmetry around the axis.
    """
    result = lj.simulate(_with(rig, law, prony))
    return _reading(rig, result.positions, result.reactions), result.status


def mesh_error(rig: Rig, law: Law, prony: Prony | None) -> jax.Array:
    """Estimate how each reading (T,) [N] or [m] would change with an infinitely fine mesh. Law and viscosity must
    have known numbers (not inside jit, grad or vmap).

    The estimate needs one run, and for each step one linear solve with elements of higher order
    (`liverjax.simulation.mesh_error`). The result is NaN for a step without an estimate.
    """
    return _changed_by_mesh(rig, lj.simulate(_with(rig, law, prony), mesh_error=True))


def _changed_by_mesh(rig: Rig, run: lj.Result) -> jax.Array:
    assert run.mesh_error is not None
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", message="the mesh error is not reliable")  # then it is NaN
        change = run.mesh_error.change(lambda x, force: _reading(rig, x, force), run)[1]
    return jnp.where(run.mesh_error.found, change, jnp.nan)


def reading_errors(rig: Rig, law: Law, prony: Prony | None) -> tuple[jax.Array, np.ndarray]:
    """Estimate how each reading (T,) [N] or [m] would change with an infinitely fine mesh (see `mesh_error`), and with
    infinitely small time steps. The rise of the load does not change: with smaller time steps too, it lasts as long as
    the first step of the rig."""
    scene = _with(rig, law, prony)
    run = lj.simulate(scene, mesh_error=True)
    dt, steps = scene.solve.dt, scene.solve.steps
    rise = {"times": jnp.array([0.0, dt, (steps + 1) * dt]), "history": jnp.array([0.0, 1.0, 1.0])}
    scene = replace(scene, traction=tuple(replace(pull, **rise) for pull in scene.traction))
    of_steps = change_with_small_steps(scene, lambda run: _reading(rig, run.positions, run.reactions), run)
    return _changed_by_mesh(rig, run), of_steps


def _with(rig: Rig, law: Law, prony: Prony | None) -> lj.Scene:
    """Return the rig's scene with the given law and viscosity."""
    if not rig.whole and any(part.fibre is not None or part.green_energy is not None for part in law.summands()):
        raise InputError(
            f"law {type(law).__name__} is not isotropic, but the mesh of the rig is a sector of the cylinder: give the "
            "rig a cell_size, which makes a mesh of the whole cylinder"
        )
    scene = replace(rig.scene, law=law, viscosity=prony)
    most = STIFFEST.get(automatic.form_of_volumes(scene))
    ratio = _ratio(law)
    if not rig.whole and most is not None and ratio is not None and ratio > most * (1 + 1e-9):
        warnings.warn(
            f"K/mu = {ratio:.3g} is above {most:g}, and the error of the mesh is known to be below 1 % only up to this "
            "value: estimate the error with rigs.mesh_error",
            stacklevel=3,
        )
    return scene


def _ratio(law: Law) -> float | None:
    """Return the bulk modulus divided by the shear modulus. Returns None if the law does not define these moduli, or if
    their numbers are unknown (inside jit, grad or vmap)."""
    try:
        moduli = law.bulk_modulus(), law.shear_modulus()
    except InputError:
        return None
    if any(isinstance(m, jax.core.Tracer) for m in moduli):
        return None
    return float(np.max(np.asarray(moduli[0]) / np.asarray(moduli[1])))


def _reading(rig: Rig, positions: jax.Array, reactions: jax.Array) -> jax.Array:
    """Return the readings (T,) from positions [m] and reactions [N] of all steps (T, V, 3)."""
    if rig.reading == "force":
        return reactions[:, rig.nodes, 2] @ rig.weights
    rest = rig.scene.mesh.points[rig.nodes, 2]
    return (positions[:, rig.nodes, 2] - rest[None]) @ rig.weights


def tension(radius: float, height: float, dt: float, strains: Numbers, cell_size: float | Cells | None = None) -> Rig:
    """Return the rig of a cylinder that is pulled (or pressed) between glued plates. Its reading is the force [N] of
    the upper plate, positive in tension.

    Args:
        radius, height: size of the sample [m].
        dt: time step [s].
        strains: nominal strain (T,) at the end of each of T steps.
        cell_size: `Cells`, or the cell length [m] of a mesh of the whole cylinder (see `Cells.size`). Default: a graded
            sector.

    Raises:
        InputError: a length or a time is not positive, or a strain is not finite or is at most -0.9.
    """
    strains = _finite_history("strains", strains)
    if strains.min() <= -0.9:
        raise InputError(f"strains reach {strains.min():g}: keep all strains above -0.9")
    cells = _cells(radius, height, dt, cell_size)
    rim = cells.rim * min(radius, height / 2)
    sample = _sample({radius: rim}, {0.0: rim, height: rim}, cells)
    return _driven(sample, dt, height * strains)


def indentation(
    radius: float, height: float, punch: float, dt: float, depths: Numbers, cell_size: float | Cells | None = None
) -> Rig:
    """Return the rig of a cylinder with a glued flat punch of radius `punch` [m]. Its reading is the force [N] of the
    punch along its axis, negative while the punch presses.

    At the end of each of T steps, the punch is pressed into the cylinder by `depths` (T,) [m]. At a negative depth, the
    punch pulls.

    Args:
        radius, height, dt, cell_size: see `tension`. A ring of nodes lies at the edge of the punch.

    Raises:
        InputError: a length or a time is not positive, a depth is not finite or too large, or the punch is too wide or
            too narrow.
    """
    depths = _finite_history("depths", depths)
    cells = _cells(radius, height, dt, cell_size)
    if depths.max() >= 0.9 * height:
        raise InputError(
            f"depths reach {depths.max():g} m of a height of {height:g} m: keep all depths below {0.9 * height:g} m"
        )
    if not NARROWEST * radius <= punch <= (1 - NARROWEST) * radius:
        raise InputError(
            f"punch = {punch:g} m must be between {NARROWEST:g} and {1 - NARROWEST:g} times the radius {radius:g} m: "
            "change the punch or the radius"
        )
    edge = cells.edge * min(punch, radius - punch, height)
    rings = {punch: edge, radius: cells.rim * min(radius - punch, height)}
    layers = {0.0: cells.rim * min(radius, height), height: edge}
    return _driven(_sample(rings, layers, cells, punch), dt, -depths)


def creep(
    radius: float, height: float, dt: float, steps: int, stress: float, cell_size: float | Cells | None = None
) -> Rig:
    """Return the rig of a cylinder that is loaded by a tensile stress `stress` [Pa] on its top.

    The stress is a force per original area. It acts everywhere on the top, without a plate; only the bottom is glued.
    The stress rises during the first step, as in a rheometer, and is constant afterwards. The reading is the mean
    displacement [m] of the top, weighted with the area.

    Raises:
        InputError: a length or a time is not positive, there are no steps, or the stress is not finite.
    """
    if isinstance(steps, bool) or not isinstance(steps, (int, np.integer)) or steps < 1:
        raise InputError(f"steps = {steps!r} must be a whole number, 1 or more")
    if not np.isfinite(stress):
        raise InputError(f"stress = {stress!r} must be finite: give the tensile stress in Pa")
    cells = _cells(radius, height, dt, cell_size)
    rim = cells.rim * min(radius, height)
    sample = _sample({radius: rim}, {0.0: rim, height: height}, cells)
    mesh, top = sample.mesh, jnp.asarray(sample.under)
    triangles = jnp.asarray(boundary.boundary_triangles(mesh, sample.under))
    unit = lj.Traction(triangles=triangles, value=jnp.array([0.0, 0.0, 1.0]))
    share = nodal_tractions(mesh, (unit,))[top, 2]
    pull = replace(unit, value=float(stress) * unit.value)
    scene = _scene(sample, dt, steps, traction=(pull,))
    weights = share / jnp.sum(share)
    return Rig(scene=scene, nodes=top, weights=weights, reading="displacement", whole=not sample.physics)


def _finite_history(name: str, values: Numbers) -> np.ndarray:
    values = np.atleast_1d(np.asarray(values, float))
    if values.ndim != 1 or not len(values) or not np.all(np.isfinite(values)):
        raise InputError(f"{name} must be finite numbers, one per step: correct the list")
    return values


def _cells(radius: float, height: float, dt: float, cell_size: float | Cells | None) -> Cells:
    """Check all values and return the cells of the mesh."""
    cells = cell_size if isinstance(cell_size, Cells) else Cells(size=cell_size)
    if not (np.isfinite(dt) and dt > 0):
        raise InputError(f"dt = {dt} must be positive: give the time step in seconds")
    for name, value in (("radius", radius), ("height", height), ("cell_size", cells.size)):
        if value is not None and not (np.isfinite(value) and value > 0):
            raise InputError(f"{name} = {value} must be positive and finite: give a length in metres")
    shape = height / radius
    if cells.size is None and not SHAPES[0] * (1 - 1e-9) <= shape <= SHAPES[1] * (1 + 1e-9):
        warnings.warn(
            f"height = {height:g} m is {shape:.3g} radii, and the error of the mesh is known to be below 1 % only from "
            f"{SHAPES[0]:g} to {SHAPES[1]:g} radii: estimate the error with rigs.mesh_error",
            stacklevel=3,
        )
    return cells


def _sample(rings: dict, layers: dict, cells: Cells, punch: float | None = None) -> _Sample:
    """Return the sample: a sector of the cylinder, or the whole cylinder if `cells.size` is given. `rings` and
    `layers`: cell length [m] at given radii and heights [m]."""
    radius, height = max(rings), max(layers)
    if cells.size is not None:
        rings, layers = (dict.fromkeys(places, cells.size) for places in (rings, layers))
    largest = min(cells.size or cells.largest * radius, radius / 2)
    radii = cylinders.graded(radius, rings, largest, cells.growth)
    heights = cylinders.graded(height, layers, 2 * largest, cells.growth)
    if cells.size is not None:
        mesh, normal, parts = cylinders.graded_cylinder(radii, heights), None, 1.0
    else:
        mesh, normal, parts, _ = cylinders.sector(radii, heights, cells.corners)
    mesh = _with_punch(mesh, radii, punch)
    if cells.order == 2:
        mesh = quadratic(mesh)
    sets = {name: np.asarray(nodes) for name, nodes in mesh.node_sets.items()}
    bottom = lj.Fixed(nodes=jnp.asarray(sets["bottom"]))
    if normal is None:
        return _Sample(mesh, (bottom,), (), parts, sets["under"], cells.volumetric)
    # The nodes of the axis, with the mid-edge nodes, lie in both planes of symmetry.
    axis = np.intersect1d(sets["start"], sets["end"])
    fixed = (
        bottom,
        lj.Fixed(nodes=jnp.asarray(sets["start"]), axes="y"),
        lj.Fixed(nodes=jnp.asarray(axis), axes="xy"),
    )
    slides = SlidingSupport(nodes=jnp.asarray(sets["end"]), normal=jnp.asarray(normal))
    return _Sample(mesh, fixed, (slides,), parts, sets["under"], cells.volumetric)


def _with_punch(mesh: lj.TetMesh, radii: np.ndarray, punch: float | None) -> lj.TetMesh:
    """Return the mesh with a node set `under`: the nodes of the top within the radius `punch`, or all nodes of the
    top."""
    top = np.asarray(mesh.node_sets["top"])
    if punch is not None:
        # The nodes of a layer are numbered from the axis outwards, ring after ring.
        distance = np.hypot(*np.asarray(mesh.points)[top, :2].T)
        ends = np.flatnonzero(np.diff(distance) > 1e-9 * radii[-1])
        top = top[: 1 + ends[np.argmin(np.abs(radii - punch))]]
    return replace(mesh, node_sets=mesh.node_sets | {"under": jnp.asarray(top)})


def _driven(sample: _Sample, dt: float, lift: np.ndarray) -> Rig:
    history = np.zeros((len(lift) + 1, 3))
    history[1:, 2] = lift
    times = dt * np.arange(len(lift) + 1)
    nodes = jnp.asarray(sample.under)
    # The motion is prescribed along z only. The planes of symmetry already fix other directions of some of these nodes,
    # and a fixed direction must not be prescribed too.
    moved = lj.Displaced(nodes=nodes, times=jnp.asarray(times), history=jnp.asarray(history), axes="z")
    sample = sample._replace(fixed=(*sample.fixed, lj.Fixed(nodes=nodes, axes="xy")))
    scene = _scene(sample, dt, len(lift), displaced=(moved,))
    return Rig(scene=scene, nodes=nodes, weights=jnp.full(len(nodes), sample.parts), whole=not sample.physics)


def _scene(sample: _Sample, dt: float, steps: int, **loads: Any) -> lj.Scene:
    return lj.Scene(
        mesh=sample.mesh,
        law=lj.laws.NeoHookean(mu=1.0, bulk=1.0),
        fixed=sample.fixed,
        physics=sample.physics,
        solve=lj.Solve(dt=dt, steps=steps, tolerance=1e-8, volumetric=sample.volumetric),
        **loads,
    )
