"""What holds, moves and loads a body: nodes chosen by place or by name, prescribed motion, tractions."""

import difflib
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from liverjax.core.errors import InputError
from liverjax.core.struct import param, static, struct
from liverjax.mesh.tetrahedra import TetMesh

AXES = "xyz"


@struct
class Fixed:
    """Nodes that do not move along some axes."""

    nodes: Any = param("1", "node numbers (n,)", lower=0)
    axes: str = static(default="xyz", about="held axes")


@struct
class Displaced:
    """Nodes that are moved: by `by` at the last step, proportionally before, or along a history."""

    nodes: Any = param("1", "node numbers (n,)", lower=0)
    by: Any = param("m", "displacement (3,), or one a node (n, 3), reached at the last step", default=None)
    times: Any = param("s", "times of a history (T,)", default=None)
    history: Any = param("m", "displacements at these times (T, 3), linear in between", default=None)
    axes: str = static(default="xyz", about="prescribed axes")


@struct
class Traction:
    """A load on boundary triangles: dead (`value`), or a pressure that follows them."""

    triangles: Any = param("1", "node numbers (m, 3), normals outwards", lower=0)
    value: Any = param("Pa", "force per reference area (3,); direction and reference area count", default=None)
    pressure: Any = param("Pa", "positive pushes inwards; normal and area of the moment", default=None)


def select(
    mesh: TetMesh, where: dict[str, float] | None = None, set: str | None = None, name: str = "where"
) -> np.ndarray:
    """Node numbers that satisfy all conditions of `where`, or those of a node set of the mesh.

    Args:
        mesh: `TetMesh`.
        where: x_min, x_max, y_min, … [m], inclusive within 1e-9 of the mesh's size.
        set: name of a node set.
        name: of the condition, for messages.

    Raises:
        InputError: both or neither given, unknown key or set, no node found.
    """
    if (where is None) == (set is None):
        raise InputError(f'{name}: give either where = {{z_max = 0.0}} or set = "name"')
    if set is not None:
        if set not in mesh.node_sets:
            there = ", ".join(mesh.node_sets) or "none"
            raise InputError(f"{name}: the mesh has no node set {set!r} (it has: {there}); use one of them or where")
        return np.asarray(mesh.node_sets[set])
    points = np.asarray(mesh.points)
    tolerance = 1e-9 * np.linalg.norm(np.ptp(points, axis=0))
    inside = np.ones(len(points), dtype=bool)
    known = [f"{a}_{end}" for a in AXES for end in ("min", "max")]
    for key, bound in (where or {}).items():
        if key not in known:
            near = difflib.get_close_matches(key, known, n=1, cutoff=0.0)[0]
            raise InputError(f"{name}: {key!r} is not known: did you mean {near}?")
        if isinstance(bound, bool) or not isinstance(bound, (int, float)) or not np.isfinite(bound):
            raise InputError(f"{name}: {key} = {bound!r} is not a length: give a number in metres")
        x = points[:, AXES.index(key[0])]
        inside &= x >= bound - tolerance if key.endswith("min") else x <= bound + tolerance
    if not inside.any():
        low, high = points.min(axis=0), points.max(axis=0)
        box = ", ".join(f"{a} {lo:.4g} to {hi:.4g}" for a, lo, hi in zip(AXES, low, high, strict=True))
        raise InputError(f"{name} = {where} meets no node: the mesh spans {box} m")
    return np.flatnonzero(inside)


def boundary_triangles(mesh: TetMesh, nodes: Any | None = None) -> np.ndarray:
    """Outer triangles (m, 3), normals outwards; with `nodes` those whose three nodes are among them."""
    tets = np.asarray(mesh.tetrahedra)
    faces = np.concatenate([tets[:, f] for f in ((1, 2, 3), (0, 3, 2), (0, 1, 3), (0, 2, 1))])
    _, first, count = np.unique(np.sort(faces, axis=1), axis=0, return_index=True, return_counts=True)
    outer = faces[np.sort(first[count == 1])]
    return outer if nodes is None else outer[np.isin(outer, np.asarray(nodes)).all(axis=1)]


def free_degrees(mesh: TetMesh, fixed: tuple, displaced: tuple) -> jax.Array:
    """1 where a degree of freedom is solved for, 0 where it is held or prescribed: (V, 3)."""
    mask = jnp.ones(mesh.points.shape, mesh.points.dtype)
    for condition in (*fixed, *displaced):
        for axis in condition.axes:
            mask = mask.at[condition.nodes, AXES.index(axis)].set(0.0)
    return mask


def prescribed(mesh: TetMesh, displaced: tuple, time: Any, fraction: Any) -> jax.Array:
    """Displacements (V, 3) [m] of prescribed degrees of freedom, zero elsewhere.

    Args:
        time: [s], for histories.
        fraction: of the whole run, for `by`.
    """
    u = jnp.zeros(mesh.points.shape, mesh.points.dtype)
    for condition in displaced:
        for axis in condition.axes:
            k = AXES.index(axis)
            if condition.by is not None:
                value = jnp.asarray(condition.by, u.dtype)[..., k] * fraction
            else:
                value = jnp.interp(time, condition.times, jnp.asarray(condition.history)[:, k])
            u = u.at[condition.nodes, k].set(value)
    return u


def nodal_tractions(mesh: TetMesh, tractions: tuple) -> jax.Array:
    """Dead nodal forces (V, 3) [N]: a third of reference area times traction at each corner."""
    force = jnp.zeros(mesh.points.shape, mesh.points.dtype)
    for load in tractions:
        if load.value is None:
            continue
        corner = mesh.points[load.triangles]
        normal = jnp.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0])
        area = 0.5 * jnp.sqrt(jnp.sum(normal * normal, axis=1))
        share = (area / 3)[:, None] * jnp.asarray(load.value, force.dtype)[None]
        for a in range(3):
            force = force.at[load.triangles[:, a]].add(share)
    return force


def follows(tractions: tuple) -> bool:
    """Whether a load follows the body: then the tangent is not symmetric."""
    return any(load.pressure is not None for load in tractions)


def follower_forces(tractions: tuple, x: jax.Array) -> jax.Array:
    """Nodal forces (V, 3) [N] of the pressures at positions x (V, 3) [m]: a third of -p n da at each corner."""
    force = jnp.zeros_like(x)
    for load in tractions:
        if load.pressure is None:
            continue
        corner = x[load.triangles]
        twice = jnp.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0])
        for a in range(3):
            force = force.at[load.triangles[:, a]].add(-load.pressure / 6 * twice)
    return force


def nodal_volumes(mesh: TetMesh) -> jax.Array:
    """A quarter of every element at each of its nodes (V,) [m^3]: lumped mass over density."""
    share = jnp.zeros(mesh.points.shape[0], mesh.points.dtype)
    for a in range(4):
        share = share.at[mesh.tetrahedra[:, a]].add(mesh.volumes / 4)
    return share
