"""Constrain the new nodes between two entries of a scene, for example between two `[[fixed]]` entries of one clamp.

A sliding support is also such an entry. Each entry of a scene gets the new nodes between its own nodes. On a strip of
triangles between two entries, the run prescribes the motion of all nodes. So the new nodes on this strip get the motion
of its triangles in the run. Between two entries with given pressures of the fluid, the new nodes get the pressures of
the run.
"""

from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np

from liverjax.core.struct import replace
from liverjax.mesh.adjacency import node_numbers
from liverjax.mesh.promotion import middles_between
from liverjax.mesh.selection import AXES
from liverjax.physics.base import Physics
from liverjax.physics.porosity import Inlet, Porosity
from liverjax.physics.prescribed import Displaced, Fixed
from liverjax.physics.sliding_support import SlidingSupport
from liverjax.scenes.scene import Scene

#: Two normals are parallel if the sine of their angle is below this value.
_SAME_NORMAL = 1e-6
#: Weights of old nodes at a new node, and components of unit normals, count as 0 if they are below this value.
_SOME_WEIGHT = 1e-9


def joined_entries(
    old: Scene,
    made: Scene,
    between: Callable[[list[np.ndarray]], np.ndarray],
    field: Callable[[jax.Array], jax.Array],
) -> Scene:
    """Return the scene `made` with additional entries for the new nodes between the entries of the scene `old`.

    A new node of linear elements between two motions with different histories stays free. If the positions of the mesh
    are unknown (inside jit, grad or vmap), no entry is added.

    Args:
        old, made: the scene before and after the conversion.
        between: function that returns, for the old nodes of several entries, the new nodes on their joint regions.
        field: function that returns, for values (V,) at the old nodes, the values (V',) at all nodes of `made`.
    """
    if isinstance(old.mesh.points, jax.core.Tracer):
        return made
    still, displaced = dict[tuple[int, ...], str](), made.displaced  # still: {nodes: axes without motion}
    for axis in AXES:
        own = _entries_along(old, axis)
        if len(own) < 2:
            continue
        held = [np.asarray(entry.nodes) for entry in _entries_along(made, axis)]
        new = np.setdiff1d(between([np.asarray(entry.nodes) for entry in own]), np.concatenate(held))
        if not len(new):
            continue
        owner = np.full(old.mesh.number_of_nodes, -1)
        for k, entry in enumerate(own):
            owner[np.asarray(entry.nodes)] = k
        clocks, alike = _clocks(own)
        with jax.ensure_compile_time_eval():
            masks = [np.asarray(field(jnp.asarray(owner == k, float))) for k in range(len(own))]
        near = np.array([np.abs(mask[new]) > _SOME_WEIGHT for mask in masks])
        moved = np.array([near[clocks == c].any(axis=0) for c in range(len(alike))]).reshape(len(alike), len(new))
        staying = tuple(new[~moved.any(axis=0)].tolist())
        if staying:
            still[staying] = still.get(staying, "") + axis
        for c, first in enumerate(alike):
            nodes = new[moved[c] & (moved.sum(axis=0) == 1)]
            if len(nodes):
                parts = [(e, owner == k) for k, e in enumerate(own) if isinstance(e, Displaced) and clocks[k] == c]
                by = field(sum((_amounts(e, axis, where) for e, where in parts), jnp.zeros(len(owner))))[nodes]
                displaced = (*displaced, _along_axis(first, axis, nodes, by.astype(old.mesh.points.dtype)))
    fixed = (Fixed(nodes=node_numbers(nodes), axes=axes) for nodes, axes in still.items())
    made = replace(made, fixed=(*made.fixed, *fixed), displaced=displaced)
    return replace(made, physics=_joined_slides(old, made, between))


def joined_inlets(old: Scene, made: Porosity) -> tuple[Inlet, ...]:
    """Return the inlets of `made`, and inlets for the new vertices between drained nodes and inlets of `old`.

    `made` is the porosity on the refined mesh. A new vertex has the mean pressure of the ends of its edge. If an entry
    of `made` gives it another pressure (entries may overlap), this pressure is replaced. Between two inlets with
    different histories, no pressure is added. If the positions of the mesh are unknown (inside jit, grad or vmap), no
    inlet is added.
    """
    mesh, V = old.mesh, old.mesh.number_of_vertices
    given, taken = ([] if s is None else _given_pressures(s) for s in (old.porosity, made))
    if isinstance(mesh.points, jax.core.Tracer) or len(given) < 2:
        return made.inlet
    edges = np.asarray(mesh.pattern.edges)
    owner, by_made = np.full(V, -1), np.full(V + edges.shape[1], -1)
    for k, ((_, nodes), (_, wider)) in enumerate(zip(given, taken, strict=True)):
        owner[nodes[nodes < V]] = k  # at a common node of two inlets, the later inlet counts
        by_made[wider[wider < len(by_made)]] = k
    new = np.union1d(middles_between(mesh, [nodes for _, nodes in given]), V + np.flatnonzero(by_made[V:] >= 0))
    ends = np.sort(owner[edges[:, new - V]], axis=0)
    missing = np.all(ends >= 0, axis=0) & np.any(ends != by_made[new], axis=0)
    new, ends = new[missing], ends[:, missing]
    more = []
    for k, m in np.unique(ends, axis=1).T:
        own = node_numbers(new[(ends[0] == k) & (ends[1] == m)])
        first, last = given[k][0], given[m][0]  # drained: number 0, so `last` is drained only if both are
        if last is None:
            more.append(Inlet(nodes=own, pressure=0.0))
        elif first is None:
            more.append(replace(last, nodes=own, pressure=0.5 * last.pressure))
        elif _same(first.times, last.times) and _same(first.history, last.history):
            more.append(replace(last, nodes=own, pressure=0.5 * (first.pressure + last.pressure)))
    return (*made.inlet, *more)


def _given_pressures(porosity: Porosity) -> list[tuple[Inlet | None, np.ndarray]]:
    """Return the inlets with a given pressure, and their nodes. Drained nodes come first, with None as their inlet."""
    given: list[tuple[Inlet | None, np.ndarray]] = []
    if porosity.drained is not None:
        given.append((None, np.asarray(porosity.drained)))
    return given + [(own, np.asarray(own.nodes)) for own in porosity.inlet if own.nodes is not None]


def _entries_along(scene: Scene, axis: str) -> list[Fixed | Displaced]:
    """Return the entries that constrain an axis. A sliding support with this normal counts as a fixed entry."""
    supports = [own for own in scene.physics if isinstance(own, SlidingSupport) and own.axis == axis]
    slides = [Fixed(nodes=own.nodes, axes=axis) for own in supports]
    entries: tuple[Fixed | Displaced, ...] = (*slides, *scene.fixed, *scene.displaced)
    return [entry for entry in entries if axis in entry.axes]


def _joined_slides(old: Scene, made: Scene, between: Callable[[list[np.ndarray]], np.ndarray]) -> tuple[Physics, ...]:
    """Return the physics of `made`, with more nodes for its sliding supports that have an oblique normal.

    A new node gets such a support if all old nodes around it stay in planes with this normal, because of sliding
    supports with equal normals or of fixed entries.
    """
    physics = list(made.physics)
    oblique = {
        k: (own, now)
        for k, (own, now) in enumerate(zip(old.physics, made.physics, strict=True))
        if isinstance(own, SlidingSupport) and isinstance(now, SlidingSupport) and not own.axis
        if not isinstance(own.normal, jax.core.Tracer)
    }
    # `SlidingSupport.check` accepts normals with roundoff, so their length may differ from 1.
    given = {k: np.asarray(own.normal, float) for k, (own, _) in oblique.items()}
    normals = {k: normal / np.linalg.norm(normal) for k, normal in given.items()}
    taken = [np.asarray(now.nodes) for _, now in oblique.values()]
    for k, normal in normals.items():
        alike = [j for j in oblique if np.linalg.norm(np.cross(normal, normals[j])) < _SAME_NORMAL]
        along = {axis for axis, part in zip(AXES, normal, strict=True) if abs(part) > _SOME_WEIGHT}
        groups = [np.asarray(oblique[j][0].nodes) for j in alike]
        groups += [np.asarray(entry.nodes) for entry in old.fixed if along <= set(entry.axes)]
        if k != alike[0] or len(groups) < 2:
            continue
        held = [np.asarray(entry.nodes) for axis in along for entry in _entries_along(made, axis)]
        new = np.setdiff1d(between(groups), np.concatenate([*taken, *held]))
        if len(new):
            own = oblique[k][1]
            physics[k] = replace(own, nodes=node_numbers(np.concatenate([np.asarray(own.nodes), new])))
    return tuple(physics)


def _clocks(own: list[Fixed | Displaced]) -> tuple[np.ndarray, list[Displaced]]:
    """Return a number for each entry, and one entry for each number. Entries with equal numbers have equal histories.

    The number of a fixed entry is -1.
    """
    clocks, alike = np.full(len(own), -1), list[Displaced]()
    for k, entry in enumerate(own):
        if isinstance(entry, Displaced):
            same = [c for c, other in enumerate(alike) if _same(entry.times, other.times)]
            same = [c for c in same if _same(entry.history, alike[c].history)]
            clocks[k] = same[0] if same else len(alike)
            alike += [] if same else [entry]
    return clocks, alike


def _same(a: object, b: object) -> bool:
    if a is None or b is None or isinstance(a, jax.core.Tracer) or isinstance(b, jax.core.Tracer):
        return a is b
    return np.array_equal(np.asarray(a), np.asarray(b))


def _amounts(entry: Displaced, axis: str, where: np.ndarray) -> jax.Array:
    """Return the displacement [m] along an axis at the nodes of the mask `where` (V,), and 0 at other nodes.

    If the history itself contains the displacements, the result at these nodes is 1, the factor of this history.
    """
    values = jnp.ones(()) if entry.by is None else jnp.asarray(entry.by)[..., AXES.index(axis)]
    nodes = np.asarray(entry.nodes)
    return jnp.where(where, jnp.zeros(len(where), values.dtype).at[nodes].set(values), 0.0)


def _along_axis(entry: Displaced, axis: str, nodes: np.ndarray, by: jax.Array) -> Displaced:
    """Return a motion of n nodes along one axis with the history of an entry. `by` (n,): see `_amounts`."""
    k = AXES.index(axis)
    history = entry.history
    if entry.by is None and history is not None:
        history = jnp.asarray(history)[:, k]
    by = jnp.zeros((len(nodes), 3), by.dtype).at[:, k].set(by)
    return replace(entry, nodes=node_numbers(nodes), by=by, history=history, axes=axis)
