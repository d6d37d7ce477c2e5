"""Read measured displacements of points of a body from CSV, and compute the simulated displacements of these points."""

from pathlib import Path
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from scipy.spatial import cKDTree

from fitting.readers.tables.text_tables import decimal_sign, split_cells, split_line, text_of, to_number
from liverjax.core.errors import InputError
from liverjax.mesh.adjacency import PAIRS
from liverjax.mesh.promotion import cubic, quadratic
from liverjax.mesh.shape_functions import functions
from liverjax.mesh.tetrahedra import UNITS, TetMesh
from liverjax.scenes.scene import Scene

#: A point farther from the mesh than this does not belong to the body (unit: size of the nearest element).
_FAR = 2.0
#: At most the fraction _MOST_OUTSIDE of all points may lie outside of the mesh by more than _OUTSIDE element sizes.
#: Such points occur near a surface with a coarse mesh.
_OUTSIDE, _MOST_OUTSIDE = 0.25, 0.2
#: A displacement that exceeds this value times the size of the body must be an error in the file.
_LONGEST = 2.0
_COLUMNS = ("node", "x", "y", "z", "ux", "uy", "uz", "time", "sd")


class Displacements(NamedTuple):
    """Displacements of n points, each measured at one step of the scene."""

    step: np.ndarray  # (n,) index of the step, from 0
    nodes: np.ndarray  # (n, 4) nodes of the element at the point; (n, 10) if quadratic
    weights: np.ndarray  # (n, 4) or (n, 10) values of the shape functions of these nodes at the point
    measured: np.ndarray  # (n, 3) [m]; 0 where not measured
    sd: np.ndarray  # (n, 3) [m] standard deviation of the noise; infinite where not measured

    @property
    def components(self) -> int:
        """Number of measured components of the displacements, at all points together."""
        return int(np.isfinite(self.sd).sum())


def read_displacements(path: str | Path, scene: Scene, noise: float | None = None, unit: str = "m") -> Displacements:
    """Read displacements from a CSV file with a header.

    The columns are: ``node`` (index of the node in `scene.mesh`, from 0), or ``x, y, z`` (position at rest); ``ux, uy,
    uz`` (empty if not measured); ``time`` [s], if the scene has time steps (default: the last step); ``sd``, the
    standard deviation of the noise. `#` begins a comment. The indices of the nodes may differ from the indices in the
    mesh file, see `liverjax.mesh.files.read_mesh`: give ``x, y, z`` in this case.

    Args:
        path: CSV file.
        scene: the scene whose simulation is compared with the displacements.
        noise: standard deviation of the noise [m], used if the file has no column ``sd``.
        unit: unit of all lengths in the file, one of `liverjax.mesh.tetrahedra.UNITS`.

    Raises:
        InputError: the file, a column, a value, a node or a point is wrong, or no noise is given.
    """
    path = Path(path)
    if unit not in UNITS:
        raise InputError(f"--unit {unit!r} is not known: use one of {', '.join(UNITS)}")
    table = _table_of_nodes(path)
    mesh, scale = scene.mesh, UNITS[unit]
    n = len(table["ux"])
    measured = scale * np.stack([table[c] for c in ("ux", "uy", "uz")], axis=1)
    if np.any(np.isinf(measured)):
        raise InputError(
            f"{path}: row {int(np.argwhere(np.isinf(measured))[0, 0]) + 1} contains an infinite displacement; leave "
            "the cell empty"
        )
    seen = np.isfinite(measured)
    if not seen.any():
        raise InputError(f"{path}: no displacement is measured; fill the columns ux, uy, uz")
    size = float(np.ptp(np.asarray(mesh.points), axis=0).max())
    wild = np.argwhere(np.abs(np.where(seen, measured, 0.0)) > _LONGEST * size)
    if len(wild):
        row, axis = wild[0]
        raise InputError(
            f"{path}: row {row + 1} has u{'xyz'[axis]} = {measured[row, axis]:g} m in a body of {size:.3g} m; give "
            "--unit, or leave the cell empty if the displacement was not measured"
        )
    sd = _deviations_of_noise(path, scale * table["sd"] if "sd" in table else None, noise, n)
    if "node" in table:
        nodes, weights = _at_nodes(path, mesh, table["node"])
    else:
        places = scale * np.stack([table[c] for c in "xyz"], axis=1)
        _refuse_other_places(path, places, size, unit)
        nodes, weights = _measured_at_points(path, mesh, places)
    _no_copies(path, table)
    return Displacements(
        step=_steps(path, scene, table.get("time"), n),
        nodes=nodes,
        weights=weights,
        measured=np.where(seen, measured, 0.0),
        sd=np.where(seen, sd[:, None], np.inf),
    )


def _deviations_of_noise(path: Path, own: np.ndarray | None, noise: float | None, n: int) -> np.ndarray:
    """Return the standard deviations (n,) [m] of the noise: the file's column (`own`), or else `noise` for all rows."""
    if own is None and noise is None:
        raise InputError(
            f"{path}: the column sd is missing; add this column, or give the noise's standard deviation in metres "
            "with --noise"
        )
    sd = np.full(n, noise) if own is None else own
    if not (np.all(np.isfinite(sd)) and np.all(sd > 0)):
        raise InputError(f"{path}: sd must be positive and finite; give the noise's standard deviation")
    return sd


#: If the file has _SOME points or more, and all of them lie within _TOGETHER times the size of the body, the positions
#: are assumed to be in another unit.
_SOME, _TOGETHER = 8, 0.01


def _refuse_other_places(path: Path, places: np.ndarray, size: float, unit: str) -> None:
    across = float(np.ptp(places, axis=0).max()) if np.all(np.isfinite(places)) else size
    if len(np.unique(places, axis=0)) >= _SOME and across < _TOGETHER * size:
        raise InputError(
            f"{path}: all points lie within {across:.2g} m of each other, in a body of {size:.3g} m: --unit {unit} "
            "applies to x, y, z and to ux, uy, uz, so write all these columns in one unit"
        )


def _no_copies(path: Path, table: dict[str, np.ndarray]) -> None:
    """Raise an error if half of the rows or more are copies of other rows, because each row counts as a measurement. A
    few rows may be equal because of rounding."""
    rows = np.nan_to_num(np.column_stack(list(table.values())), nan=np.inf)
    _, first, of = np.unique(rows, axis=0, return_index=True, return_inverse=True)
    again = np.flatnonzero(first[of.ravel()] != np.arange(len(rows)))
    if 2 * len(again) >= len(rows):
        k = int(again[0])
        raise InputError(
            f"{path}: row {k + 1} repeats row {first[of.ravel()[k]] + 1} ({len(again)} of {len(rows)} rows are "
            "copies); remove the copies, because each row counts as a measurement"
        )


def _table_of_nodes(path: Path) -> dict[str, np.ndarray]:
    """Return the columns by name. An empty cell is NaN. The header may be a comment, as in files of `numpy.savetxt`."""
    lines = [line for line in text_of(path, "displacements").splitlines() if line.strip(" \t#;,")]
    if not lines:
        raise InputError(f"{path} is empty: give a CSV with columns x,y,z,ux,uy,uz")
    between, names = split_line(lines[0].lstrip("# "))
    names = [name.lower() for name in names]
    if not lines[0].lstrip().startswith("#") or set(names) & set(_COLUMNS):
        lines = lines[1:]
    else:  # the first lines are comments, and the header follows them
        lines = [line for line in lines if not line.lstrip().startswith("#")]
        between, names = split_line(lines[0]) if lines else (between, names)
        names, lines = [name.lower() for name in names], lines[1:]
    while names and not names[-1]:  # each line ends with a separator
        names.pop()
    for name in names:
        if name not in _COLUMNS:
            raise InputError(f"{path}: column {name!r} is not known; use {', '.join(_COLUMNS)}")
        if names.count(name) > 1:
            raise InputError(f"{path} has two columns {name}: remove one of them")
    for needed in ("ux", "uy", "uz"):
        if needed not in names:
            raise InputError(f"{path} has no column {needed}: give x,y,z (or node) and ux,uy,uz")
    if ("node" in names) == all(c in names for c in "xyz"):
        raise InputError(f"{path} needs either a column node or columns x,y,z: give one of them")
    rows = [split_cells(line.partition("#")[0], between) for line in lines if not line.lstrip().startswith("#")]
    return dict(zip(names, _rows_of_numbers(path, names, rows, between).T, strict=True))


def _rows_of_numbers(path: Path, names: list[str], rows: list[list[str]], between: str) -> np.ndarray:
    """Return the numbers (n, columns). Raise an error for a cell that is neither empty nor a number, because it would
    count as not measured."""
    sign, values = decimal_sign(cell for row in rows[:1000] for cell in row), np.full((len(rows), len(names)), np.nan)
    for k, row in enumerate(rows):
        if any(row[len(names) :]):
            raise InputError(f"{path}: row {k + 1} has {len(row)} cells under {len(names)} headings; correct the row")
        for j, cell in enumerate(row[: len(names)]):
            value = to_number(cell, between, sign)
            if value is None:
                raise InputError(
                    f"{path}: row {k + 1}: {names[j]} = {cell!r} is not a number; correct this cell, or leave it empty"
                )
            values[k, j] = value
    return values


def _at_nodes(path: Path, mesh: TetMesh, node: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    whole = np.isfinite(node) & (node == np.round(node)) & (node >= 0) & (node < mesh.number_of_nodes)
    if not whole.all():
        bad = node[np.flatnonzero(~whole)[0]]
        raise InputError(f"{path}: node {bad:g} is not in the mesh; give whole numbers 0 to {mesh.number_of_nodes - 1}")
    weights = np.zeros((len(node), 4))
    weights[:, 0] = 1
    return np.repeat(node.astype(np.int32)[:, None], 4, axis=1), weights


def _measured_at_points(path: Path, mesh: TetMesh, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    if not np.all(np.isfinite(points)):
        raise InputError(f"{path}: a position x,y,z is not finite; give the position at rest of every point")
    nodes, weights, outside = locate(mesh, points)
    if np.any(outside > _FAR):
        bad = int(np.argmax(outside))
        raise InputError(
            f"{path}: the point {points[bad].tolist()} m is {outside[bad]:.3g} element sizes away from the mesh; check "
            "--unit"
        )
    off = int(np.sum(outside > _OUTSIDE))
    if off > _MOST_OUTSIDE * len(points):
        raise InputError(
            f"{path}: {off} of {len(points)} points lie outside of the mesh, by up to {outside.max():.2g} element "
            "sizes; check the axes, the origin and --unit"
        )
    return nodes, weights


def locate(mesh: TetMesh, points: np.ndarray, candidates: int = 40) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Find the element that contains each point, or the nearest element.

    Returns the nodes (n, 4) of this element, the barycentric coordinates (n, 4) of the point, and the distance (n,)
    from point to element in element sizes. For quadratic elements, the first two results are the nodes (n, 10) and the
    values (n, 10) of their shape functions. The function runs on the CPU, outside compiled programs.
    """
    X, tets = np.asarray(mesh.points), np.asarray(mesh.tetrahedra)
    candidates = min(candidates, len(tets))
    _, near = cKDTree(X[tets].mean(axis=1)).query(points, k=candidates)
    near = near.reshape(len(points), candidates)
    D = np.moveaxis(np.asarray(mesh.shape_vectors), -1, 0)  # (E, 3, 3) gradients of shape functions 1 to 3

    def barycentric(element: np.ndarray, points: np.ndarray) -> np.ndarray:
        """Return the barycentric coordinates (…, 4) of points (…, 3) in elements (…)."""
        inner = np.einsum("...ac,...c->...a", D[element], points - X[tets[element, 0]])
        return np.concatenate([1 - inner.sum(axis=-1, keepdims=True), inner], axis=-1)

    bary = barycentric(near, points[:, None])
    best = np.argmax(bary.min(axis=-1), axis=1)
    row = np.arange(len(points))
    element, weights = near[row, best], bary[row, best]
    # If the sizes of the elements differ much, the centre of the right element may not be among the nearest centres. So
    # all elements whose bounding box, enlarged by a tenth, contains the point are searched too.
    low, high = X[tets].min(axis=1), X[tets].max(axis=1)
    low, high = low - 0.1 * (high - low), high + 0.1 * (high - low)
    for k in np.flatnonzero(weights.min(axis=-1) < 0):
        boxed = np.flatnonzero(np.all((low <= points[k]) & (points[k] <= high), axis=1))
        own = barycentric(boxed, points[k])
        if np.max(own.min(axis=-1), initial=-np.inf) > weights[k].min():
            nearest = int(np.argmax(own.min(axis=-1)))
            element[k], weights[k] = boxed[nearest], own[nearest]
    outside = np.maximum(0.0, -weights.min(axis=-1))
    if mesh.order == 1:
        return tets[element], weights, outside
    nodes = mesh.element_nodes_on_host.T
    return nodes[element], functions(2, weights.T)[0].T, outside


def _steps(path: Path, scene: Scene, time: np.ndarray | None, n: int) -> np.ndarray:
    last = scene.solve.steps - 1
    if time is None:
        return np.full(n, last, np.int32)
    if scene.solve.dt is None:
        raise InputError(f"{path} has a column time, but [solve] of the scene has no dt: add dt, or remove the column")
    dt = float(scene.solve.dt)
    step = np.round(time / dt) - 1
    off = ~(np.isfinite(time) & (step >= 0) & (step <= last) & (np.abs(time / dt - 1 - step) < 0.01))
    if off.any():
        bad = time[np.flatnonzero(off)[0]]
        raise InputError(
            f"{path}: the scene has no step at the time {bad:g} s; use multiples of dt = {dt:g} s up to "
            f"{dt * (last + 1):g} s"
        )
    return step.astype(np.int32)


def predicted(data: Displacements, scene: Scene, positions: jax.Array) -> jax.Array:
    """Return the simulated displacements (n, 3) [m] of the points, from the node positions (T, V, 3) [m] of a run with
    T steps."""
    corner = positions[data.step[:, None], data.nodes] - scene.mesh.points[data.nodes]
    return jnp.sum(data.weights[..., None] * corner, axis=1)


def weighted_differences(data: Displacements, scene: Scene, positions: jax.Array) -> jax.Array:
    """Return predicted minus measured displacements, divided by the standard deviation of the noise, as a flat array (3
    n,). A component that was not measured gives 0."""
    return ((predicted(data, scene, positions) - data.measured) / data.sd).ravel()


def error_between_nodes(data: Displacements, mesh: TetMesh, added: jax.Array) -> np.ndarray:
    """Return the part (3 n,) of the mesh error between the nodes, divided by the standard deviation of the noise.

    `added` (T, A, 3) [m]: coefficients of the richer shape functions (`MeshError.added`). They are 0 at the nodes.
    """
    own = 4 if mesh.order == 1 else 10
    rich = quadratic(mesh) if mesh.order == 1 else cubic(mesh)
    numbers = np.asarray(rich.element_nodes_on_host).T  # (E, 10) or (E, 20)
    element_of = {tuple(row): k for k, row in enumerate(numbers[:, :4].tolist())}
    element = np.array([element_of.get(tuple(row), -1) for row in np.asarray(data.nodes)[:, :4].tolist()])
    inside = np.flatnonzero(element >= 0)  # a measured node has no element
    weights = np.asarray(data.weights)[inside]
    L = weights[:, :4].T.copy()
    if mesh.order == 2:
        for k, (i, j) in enumerate(PAIRS):  # an edge middle has the coordinates 1/2 and 1/2
            L[i] += 0.5 * weights[:, 4 + k]
            L[j] += 0.5 * weights[:, 4 + k]
    N = functions(rich.order, L)[0][own:].T
    coefficients = np.asarray(added)[
        np.asarray(data.step)[inside, None], numbers[element[inside], own:] - mesh.number_of_nodes
    ]
    part = np.zeros(np.shape(data.measured))
    part[inside] = np.einsum("na,nac->nc", N, coefficients)
    return (part / data.sd).ravel()
