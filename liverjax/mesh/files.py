"""Read and write mesh files with meshio: linear and quadratic tetrahedra with their sets."""

import contextlib
import io
import os
import re
import warnings
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from liverjax.core.did_you_mean import as_word
from liverjax.core.errors import InputError
from liverjax.core.struct import replace
from liverjax.mesh.adjacency import PAIRS, node_numbers
from liverjax.mesh.formats.abaqus import read_abaqus
from liverjax.mesh.promotion import quadratic
from liverjax.mesh.tetrahedra import SIX_DIGITS, UNITS, TetMesh, check_mesh, tet_mesh

if TYPE_CHECKING:
    import meshio

#: Order of the elements -> meshio's name of their cells.
CELLS = {1: "tetra", 2: "tetra10"}
_NAMES = {1: "linear", 2: "quadratic"}
#: Edges of a quadratic element in the order of VTK and meshio.
_VTK = ((0, 1), (1, 2), (0, 2), (0, 3), (1, 3), (2, 3))
#: An edge counts as curved if the distance between its midside node and its middle is above a limit. The limit is the
#: roundoff of coordinates with six digits (`SIX_DIGITS`), but at least the fraction `_STRAIGHT` and at most the
#: fraction `_ROUNDED` of the edge's length.
_STRAIGHT, _ROUNDED = 1e-6, 1e-2


def read_mesh(path: str | os.PathLike, unit: str = "m") -> TetMesh:
    """Read a file with tetrahedra of 4 or 10 nodes, in any format of meshio, and its sets of nodes and elements.

    In meshes of 10-node elements the vertices get the first numbers, in the order of the file. The middles of the edges
    follow. Curved edges are made straight, with a warning. Nodes without a tetrahedron are left out, with a warning,
    and the nodes after them get smaller numbers. Nodes are counted from 0, also if the file has other numbers (Abaqus).

    Args:
        path: mesh file.
        unit: length unit of the file, one of `UNITS`.

    Raises:
        InputError: the file is unreadable, has no tetrahedra or also has other volume cells. The same error is raised
            for an unknown unit and an unusable mesh.
    """
    if as_word(unit, "mesh unit") not in UNITS:
        raise InputError(f"mesh unit = {unit!r} is not known: use one of {', '.join(UNITS)}")
    path = Path(path)
    if not path.is_file():
        raise InputError(f"mesh file {path} {'is a folder' if path.is_dir() else 'does not exist'}; give a mesh file")
    data = _read_quietly(path)
    order = next((k for k, kind in CELLS.items() if any(block.type == kind for block in data.cells)), None)
    if order is None:
        kinds = ", ".join(sorted({block.type for block in data.cells}))
        held = f"{kinds} but no linear or quadratic tetrahedra" if kinds else "no cells"
        raise InputError(f"mesh file {path} contains {held}; export tetrahedra of 4 or 10 nodes")
    cell = CELLS[order]
    blocks = [block.data for block in data.cells if block.type == cell]
    others = sorted({b.type for b in data.cells if b.type != cell and not b.type.startswith(_FLAT_CELLS)})
    if others:
        raise InputError(
            f"mesh file {path} contains {', '.join(others)} in addition to {_NAMES[order]} tetrahedra; remesh the body "
            f"with {4 if order == 1 else 10}-node tetrahedra"
        )
    points, tets = np.asarray(data.points, dtype=float)[:, :3] * UNITS[unit], np.vstack(blocks)
    if points.shape[1] != 3:
        raise InputError(f"mesh file {path}: the points have {points.shape[1]} coordinates; give three")
    if tets.min(initial=0) < 0 or tets.max(initial=0) >= len(points):
        raise InputError(
            f"mesh file {path}: tetrahedra contain node numbers that do not exist (largest number {tets.max()}, number "
            f"of nodes {len(points)}); export the mesh again"
        )
    node_sets, groups = _node_sets(data, tets, f"mesh file {path}"), _named_triangles(data)
    points, tets, node_sets, groups = _without_other_nodes(points, tets, (node_sets, groups), f"mesh file {path}")
    sets = node_sets, _element_sets(data, cell)
    if order == 1:
        mesh = tet_mesh(points, tets, *sets)
        check_mesh(mesh, f"mesh file {path}")
    else:
        mesh = _with_middles(points, tets, *sets, f"mesh file {path}")
        groups = {name: np.searchsorted(np.unique(tets[:, :4]), corners) for name, corners in groups.items()}
    if groups:
        mesh = replace(mesh, triangle_sets={name: node_numbers(corners) for name, corners in groups.items()})
    size = float(np.ptp(points, axis=0).max())
    if size > _LARGE and unit == "m":
        warnings.warn(
            f"mesh file {path} is {size:.4g} m long: if the coordinates are in millimetres, write unit = 'mm'",
            stacklevel=2,
        )
    return mesh


def _without_other_nodes(points: np.ndarray, tets: np.ndarray, sets: tuple[dict, dict], name: str) -> tuple:
    """Return points, elements, node sets and groups of triangles without the nodes that belong to no tetrahedron.

    Such nodes are for example centres of arcs, reference points or nodes of shells. The program warns about them.
    """
    used, (node_sets, groups) = np.unique(tets), sets
    if len(used) == len(points):
        return points, tets, node_sets, groups
    warnings.warn(
        f"{name}: {len(points) - len(used)} nodes belong to no tetrahedron. They are left out, so the nodes after them "
        "get smaller numbers than in the file: select nodes by their positions, not by numbers",
        stacklevel=3,
    )
    node_sets = {name: np.searchsorted(used, np.intersect1d(own, used)) for name, own in node_sets.items()}
    groups = {name: np.searchsorted(used, own[np.isin(own, used).all(axis=1)]) for name, own in groups.items()}
    return points[used], np.searchsorted(used, tets), node_sets, groups


def _with_middles(points: np.ndarray, tets: np.ndarray, node_sets: dict, element_sets: dict, name: str) -> TetMesh:
    """Make a quadratic mesh with straight edges, from elements (E, 10) in the node order of VTK."""
    used = np.unique(tets[:, :4])
    new = np.full(len(points), -1)
    new[used] = np.arange(len(used))
    linear = tet_mesh(points[used], new[tets[:, :4]], {}, element_sets)
    check_mesh(linear, name)
    mesh = quadratic(linear)
    middles = mesh.element_nodes_on_host[4:].T
    of_file = tets[:, [4 + _VTK.index(pair) for pair in PAIRS]]
    if np.any(np.isin(of_file, used)):
        raise InputError(
            f"{name}: a node is a vertex of one element and an edge middle of another element; export the mesh again"
        )
    new[of_file] = middles
    straight = np.asarray(mesh.points)
    low, high = np.asarray(mesh.pattern.edges)
    length = np.linalg.norm(straight[high] - straight[low], axis=1)[middles - len(used)]
    off = np.linalg.norm(points[of_file] - straight[middles], axis=2)
    curved = of_file[off > np.clip(SIX_DIGITS * np.abs(points).max(), _STRAIGHT * length, _ROUNDED * length)]
    if len(curved) and _permuted(points[of_file], straight[middles]):
        raise InputError(
            f"{name}: the middle nodes of the elements are not in the order of the file format (they lie on other "
            "edges of their elements); export the mesh again, as VTU or Gmsh"
        )
    if np.any(new[of_file] != middles):
        place = points[of_file[new[of_file] != middles][0]].tolist()
        raise InputError(
            f"{name}: the node at {place} m is the middle node of two different edges; export the mesh again, as VTU "
            "or Gmsh"
        )
    if len(curved):
        warnings.warn(
            f"{name}: {len(np.unique(curved))} midside nodes lie up to {off.max():.3g} m off their straight edges. "
            "These nodes are moved onto the edges, because elements must be straight; refine the mesh where the "
            "surface is curved",
            stacklevel=3,
        )
    sets = {k: new[nodes][new[nodes] >= 0] for k, nodes in node_sets.items()}
    return replace(mesh, node_sets={k: node_numbers(np.unique(v)) for k, v in sets.items()})


def _permuted(points: np.ndarray, middles: np.ndarray) -> bool:
    """Return whether the points (E, 6, 3) [m] are the edge middles (E, 6, 3) [m] in another order.

    This is the case if, for one of the six edges, most elements have its point nearer to the middle of another edge.
    """
    apart = [np.linalg.norm(points - middles[:, k : k + 1], axis=2) for k in range(6)]
    elsewhere = np.argmin(apart, axis=0) != np.arange(6)
    return bool(np.any(elsewhere.mean(axis=0) > 0.5))


#: Pattern at the beginning of a file that meshio cannot read -> kind of the file, and a remedy.
_FOREIGN = {
    r"\$NOD\b": "the file has Gmsh's format of version 1 ($NOD, $ELM); open it in Gmsh and save it as version 4 or VTK",
    r"DATASET\s+POLYDATA|type=.PolyData": "the file has VTK polygons (a surface); fill the surface with tetrahedra "
    "(Gmsh, TetGen) and export an unstructured grid",
}


def _read_quietly(path: Path) -> Any:
    """Read a file with meshio, and hide the output of meshio. If meshio fails, raise `InputError` with the reason."""
    import meshio

    try:
        with path.open("rb") as file:
            beginning = file.read(1000).decode("latin-1")
    except OSError as error:
        raise InputError(f"mesh file {path} cannot be read ({error.strerror}); give a mesh file") from None
    for mark, sentence in _FOREIGN.items():
        if re.search(mark, beginning):
            raise InputError(f"mesh file {path}: {sentence}")
    if path.suffix.lower() == ".inp":
        return read_abaqus(path)
    said = io.StringIO()
    try:
        with contextlib.redirect_stdout(said), contextlib.redirect_stderr(io.StringIO()):
            return meshio.read(path)
    except SystemExit:  # meshio prints the reasons and exits if none of its readers accepts the file
        reason = " ".join(said.getvalue().split()) or f"the content is not in the format of {path.suffix} files"
    except KeyError as error:  # a missing attribute, or a missing entity of a Gmsh group
        reason = f"it does not know or does not find the entry {error.args[0]}"
    except Exception as error:  # meshio's readers raise many kinds of errors
        reason = " ".join(str(error).split()) or type(error).__name__
    raise InputError(f"mesh file {path} cannot be read by meshio ({reason[:120]}); export the mesh as VTU or Gmsh 2.2")


#: Types of surface and edge cells. A file may contain such cells in addition to its tetrahedra.
_FLAT_CELLS = ("vertex", "line", "triangle", "quad", "polygon")
#: If a body is longer than this [m], the unit of the mesh file is probably millimetres.
_LARGE = 10.0


def _node_sets(data: Any, tets: np.ndarray, name: str) -> dict[str, np.ndarray]:
    """Return node sets from meshio's point sets, integer point data ``set:NAME``, and groups of triangles.

    Raises:
        InputError: two different sets have the same name.
    """
    sets = {name: np.asarray(nodes, dtype=np.int32) for name, nodes in (data.point_sets or {}).items()}
    for key, values in data.point_data.items():
        if key.startswith("set:"):
            sets[key.removeprefix("set:")] = np.flatnonzero(values).astype(np.int32)
    for key, nodes in _surface_sets(data, tets).items():
        if key in sets and set(sets[key].tolist()) != set(nodes.tolist()):
            raise InputError(
                f"{name}: {key!r} is a set of {len(sets[key])} nodes and a group of triangles with {len(nodes)} nodes; "
                "rename the set or the group"
            )
        sets[key] = nodes
    return sets


#: Maximum number of groups in an array with one whole number for each cell. An array with more different numbers is
#: ignored, because it probably contains numbers of cells and not of groups.
_MOST_GROUPS = 100


def _element_sets(data: Any, cell: str) -> dict[str, np.ndarray]:
    """Return sets of tetrahedra from meshio's cell sets, cell data ``set:NAME``, and cell data with group numbers.

    The name of a group comes from the file (Gmsh's physical names). Otherwise, it is made from the name of the array
    and the group's number, e.g. ``medit:ref=2``.
    """
    return _cell_groups(data, (cell,), 3)


#: _TRIANGLES: types of surface cells. Their named groups become node sets. _EDGES: edges of a triangle.
_TRIANGLES, _EDGES = ("triangle", "triangle6"), ((0, 1), (1, 2), (0, 2))


def _surface_sets(data: Any, tets: np.ndarray) -> dict[str, np.ndarray]:
    """Return the nodes of each named group of triangles. In a quadratic mesh, the midside nodes are included."""
    sets = {}
    for name, parts in _triangle_groups(data).items():
        nodes = [part.ravel() for part in parts]
        if tets.shape[1] == 10:
            nodes += [_middles(tets, part) for part in parts if part.shape[1] == 3]
        sets[name] = np.unique(np.concatenate(nodes)).astype(np.int32)
    return sets


def _named_triangles(data: "meshio.Mesh") -> dict[str, np.ndarray]:
    """Return the vertices (m, 3) of each named group of triangles."""
    groups = _triangle_groups(data)
    return {name: np.concatenate([part[:, :3] for part in parts]).astype(np.int32) for name, parts in groups.items()}


def _triangle_groups(data: "meshio.Mesh") -> dict[str, list[np.ndarray]]:
    """Return the triangles of each named group, with 3 or 6 nodes, in one array for each block of cells."""
    blocks = [block for block in data.cells if block.type in _TRIANGLES]
    first = np.cumsum([0, *(len(block.data) for block in blocks)])
    return {
        name: [
            block.data[numbers[(numbers >= low) & (numbers < high)] - low]
            for block, low, high in zip(blocks, first[:-1], first[1:], strict=True)
        ]
        for name, numbers in (_cell_groups(data, _TRIANGLES, 2) if blocks else {}).items()
    }


def _middles(tets: np.ndarray, triangles: np.ndarray) -> np.ndarray:
    """Return the middle nodes on the edges of triangles (m, 3), from elements (E, 10) in the node order of VTK."""

    def code(pairs: np.ndarray) -> np.ndarray:
        low, high = np.moveaxis(np.sort(pairs.astype(np.int64), axis=-1), -1, 0)
        return low * (int(tets.max()) + 1) + high

    return tets[:, 4:][np.isin(code(tets[:, _VTK]), code(triangles[:, _EDGES]))]


def _cell_groups(data: Any, cells: tuple[str, ...], dimension: int) -> dict[str, np.ndarray]:
    """Return {name of a group: numbers of its cells}. Cells are counted over all blocks with a type in `cells`.

    A group of tetrahedra without a name is named by its number. A group of surface cells without a name is ignored.
    """
    kinds = [block.type for block in data.cells]
    first = np.cumsum([0, *(len(block.data) if block.type in cells else 0 for block in data.cells)])
    sets = {}
    for name, parts in (data.cell_sets or {}).items():
        picks = [
            first[k] + np.asarray(part, int)
            for k, part in enumerate(parts)
            if part is not None and kinds[k] in cells and not name.startswith("gmsh:bounding")
        ]
        if picks and sum(map(len, picks)):
            sets[name] = np.concatenate(picks)
    names = {(int(tag[0]), "gmsh:physical"): name for name, tag in data.field_data.items() if tag[-1] == dimension}
    for name, parts in data.cell_data.items():
        values = np.concatenate([np.asarray(p) for p, kind in zip(parts, kinds, strict=True) if kind in cells])
        if values.ndim != 1 or not _are_whole(values):
            continue
        values = values.astype(int)
        if name.startswith("set:"):
            if values.any() or all(kind in cells for kind in kinds):  # otherwise the set has only cells of other types
                sets[name.removeprefix("set:")] = np.flatnonzero(values)
            continue
        groups = np.unique(values)
        for group in groups if len(groups) <= _MOST_GROUPS else ():
            if dimension == 3 or (int(group), name) in names:
                # In these arrays a cell has only the number of its first group. A cell set of the same name is
                # complete, so it is not replaced.
                sets.setdefault(names.get((int(group), name), f"{name}={group}"), np.flatnonzero(values == group))
    return sets


def _are_whole(values: np.ndarray) -> bool:
    """Return whether all values are whole numbers of any type. ParaView's filters write region numbers as floats."""
    if np.issubdtype(values.dtype, np.floating):
        return bool(np.all(np.isfinite(values)) and np.all(values == np.rint(values)))
    return np.issubdtype(values.dtype, np.integer)


#: File formats without quadratic tetrahedra: meshio does not write them, or does not read them again.
_LINEAR_ONLY = (".mesh", ".meshb", ".ugrid", ".node", ".ele", ".h5m", ".f3grid")
#: File formats without quadratic triangles: meshio does not read them again.
_NO_TRIANGLES = (".xdmf", ".xmf")


def write_mesh(path: str | os.PathLike, mesh: TetMesh, point_data: Mapping[str, object] | None = None) -> None:
    """Write a mesh [m] with meshio. In formats that can store data, sets are written as 0/1 data ``set:NAME``.

    Raises:
        InputError: the mesh is quadratic, but the format has no quadratic tetrahedra (`_LINEAR_ONLY`) or triangles.
    """
    import meshio

    refused = _LINEAR_ONLY + (_NO_TRIANGLES if mesh.triangle_sets else ())
    if mesh.order > 1 and Path(path).suffix.lower() in refused:
        raise InputError(
            f"{path}: a quadratic mesh cannot be written in the format {Path(path).suffix.lower()}: write a .vtu file"
        )
    data = {name: np.asarray(values) for name, values in (point_data or {}).items()}
    for name, nodes in mesh.node_sets.items():
        data[f"set:{name}"] = _mask(nodes, mesh.number_of_nodes)
    cells = [meshio_cells(mesh)]
    numbers = [{name: np.asarray(own) for name, own in mesh.element_sets.items()}]
    groups = {name: np.asarray(own)[:, :3] for name, own in (mesh.triangle_sets or {}).items()}
    if groups and Path(path).suffix == ".msh":
        warnings.warn(
            f"{path}: groups of triangles ({', '.join(groups)}) are not written in Gmsh's format; write a .vtu file",
            stacklevel=2,
        )
    elif groups:
        ends = np.cumsum([0, *(len(own) for own in groups.values())])
        cells.append(("triangle", np.concatenate(list(groups.values()))))
        numbers.append({name: np.arange(ends[k], ends[k + 1]) for k, name in enumerate(groups)})
    cell_data = {
        f"set:{name}": [_mask(own.get(name, ()), len(nodes)) for own, (_, nodes) in zip(numbers, cells, strict=True)]
        for name in dict.fromkeys(name for own in numbers for name in own)
    }
    # For .msh meshio would choose the format of ANSYS; here .msh means Gmsh.
    file_format = "gmsh" if Path(path).suffix == ".msh" else None
    meshio.Mesh(np.asarray(mesh.points), cells, point_data=data, cell_data=cell_data).write(
        path, file_format=file_format
    )


def _mask(numbers: object, size: int) -> np.ndarray:
    """Return an array (size,) with 1 at the given numbers and 0 elsewhere."""
    mask = np.zeros(size, dtype=np.int32)
    mask[np.asarray(numbers, int)] = 1
    return mask


def meshio_cells(mesh: TetMesh) -> tuple[str, np.ndarray]:
    """Return meshio's name of the cell type, and the node numbers (E, 4) or (E, 10) in the node order of VTK."""
    if mesh.order == 1:
        return "tetra", np.asarray(mesh.tetrahedra)
    nodes = mesh.element_nodes_on_host.T
    return "tetra10", nodes[:, [*range(4), *(4 + PAIRS.index(pair) for pair in _VTK)]]
