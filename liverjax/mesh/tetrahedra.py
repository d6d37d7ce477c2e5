"""Meshes of straight tetrahedra: positions, constant shape vectors, node sets.

An element has 4 nodes, or 10: vertices and the middles of its edges (`liverjax.mesh.quadratic`).
"""

import contextlib
import dataclasses
import io
import os
import re
import warnings
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from liverjax.core.errors import InputError
from liverjax.core.struct import param, static, struct
from liverjax.mesh.adjacency import PAIRS, Pattern, pattern
from liverjax.mesh.basis import basis

UNITS = {"m": 1.0, "cm": 1e-2, "mm": 1e-3, "um": 1e-6}


@struct
class TetMesh:
    """Straight tetrahedra with their reference geometry; a pytree whose arrays are leaves.

    Made by `tet_mesh`; `shape_vectors` and `volumes` follow from points and tetrahedra, also under `jax.grad`. With
    `order` 2 the nodes are the vertices and then the middles of the edges, in the order of `pattern.edges`.
    """

    points: jax.Array = param("m", "reference positions (V, 3)")
    tetrahedra: jax.Array = param("1", "vertices of every element (E, 4), positively oriented")
    shape_vectors: jax.Array = param("1/m", "D_a = grad N_a of nodes a = 1, 2, 3, shape (3, 3, E); D_0 = -(sum)")
    volumes: jax.Array = param("m^3", "reference volumes (E,)")
    node_sets: dict[str, Any] = param("1", "named arrays of node numbers")
    element_sets: dict[str, Any] = param("1", "named arrays of element numbers")
    pattern: Pattern = param("1", "which vertices share an element")
    faces: Any = param("1", "number of each of an element's faces (4, E), of order 3", default=None)
    order: int = static(default=1, about="of the shape functions: 1 linear, 2 quadratic", lower=1)

    @property
    def number_of_nodes(self) -> int:
        """V, vertices and middles of edges."""
        return self.points.shape[0]

    @property
    def number_of_vertices(self) -> int:
        """Corners of elements: the first nodes."""
        return self.pattern.row_nodes.shape[1]

    @property
    def number_of_elements(self) -> int:
        """E."""
        return self.tetrahedra.shape[0]

    @property
    def weights(self) -> jax.Array:
        """Reference volume [m^3] of every point of integration: (E,) of linear elements, else (Q, E)."""
        if self.order == 1:
            return self.volumes
        return jnp.asarray(basis(self.order).weights, self.volumes.dtype)[:, None] * self.volumes[None]

    @property
    def element_nodes(self) -> list[jax.Array]:
        """Numbers (E,) of the nodes of every element: 4, or 10 with the middles of `liverjax.mesh.adjacency.PAIRS`."""
        vertices = [self.tetrahedra[:, a] for a in range(4)]
        if self.order == 1:
            return vertices
        V, N = self.number_of_vertices, self.pattern.edges.shape[1]
        middles = [V + edge for edge in self.pattern.element_edges]
        if self.order == 2:
            return vertices + middles
        return vertices + middles + [N + m for m in middles] + [V + 2 * N + face for face in self.faces]

    def corners(self, column: jax.Array) -> list[jax.Array]:
        """Of a nodal field (V,): y_k of `liverjax.mesh.basis` (E,) or (Q, E) at every point, k = 0 … 3.

        With shape vectors D_k the gradient of the field is the sum of y_k D_k.
        """
        values = [column[n] for n in self.element_nodes]
        if self.order == 1:
            return values
        values = self._oriented(values)
        c = basis(self.order).c
        return [
            sum(jnp.asarray(c[a, k], column.dtype)[:, None] * values[a] for a in range(len(c)) if c[a, k].any())
            for k in range(4)
        ]

    def spread(self, shares: list[jax.Array]) -> jax.Array:
        """The transpose of `corners`: a nodal field (V,) from four shares, (E,) or (Q, E)."""
        if self.order > 1:
            c, dtype = basis(self.order).c, self.volumes.dtype
            shares = self._oriented(
                [
                    sum(jnp.sum(jnp.asarray(c[a, k], dtype)[:, None] * shares[k], 0) for k in range(4) if c[a, k].any())
                    for a in range(len(c))
                ]
            )
        total = jnp.zeros(self.number_of_nodes, shares[0].dtype)
        # Chained scatters: after a concatenate XLA:CPU recomputes the shares for every update (4 times slower).
        for nodes, share in zip(self.element_nodes, shares, strict=True):
            total = total.at[nodes].add(share)
        return total

    def _oriented(self, values: list[jax.Array]) -> list[jax.Array]:
        """Functions of order 3 on edges change sign with the direction, which goes to the higher vertex."""
        if self.order < 3:
            return values
        t, first = self.tetrahedra, 4 + len(PAIRS)
        signs = [jnp.where(t[:, i] < t[:, j], 1.0, -1.0).astype(self.volumes.dtype) for i, j in PAIRS]
        own = [sign * value for sign, value in zip(signs, values[first : first + len(PAIRS)], strict=True)]
        return [*values[:first], *own, *values[first + len(PAIRS) :]]


def tet_mesh(
    points: Any,
    tetrahedra: Any,
    node_sets: dict[str, Any] | None = None,
    element_sets: dict[str, Any] | None = None,
) -> TetMesh:
    """A mesh from positions (V, 3) [m] and node numbers (E, 4), without any check (see `check_mesh`).

    The positions may be traced, the node numbers may not.
    """
    if isinstance(tetrahedra, jax.core.Tracer):
        raise InputError("tet_mesh: the node numbers are traced: make the mesh outside jit, grad and vmap")
    # Copies: asarray may alias the caller's NumPy arrays, and the mesh would change with them.
    points = jnp.array(points, dtype=float)
    neighbours = pattern(tetrahedra, points)
    tetrahedra = jnp.array(tetrahedra, dtype=jnp.int32)
    shape_vectors, volumes = _geometry(points, tetrahedra)
    nodes, elements = (
        {k: jnp.array(v, dtype=jnp.int32) for k, v in (sets or {}).items()} for sets in (node_sets, element_sets)
    )
    return TetMesh(
        points=points,
        tetrahedra=tetrahedra,
        shape_vectors=shape_vectors,
        volumes=volumes,
        node_sets=nodes,
        element_sets=elements,
        pattern=neighbours,
    )


def with_points(mesh: TetMesh, points: Any) -> TetMesh:
    """The mesh with other reference positions (V, 3) [m], which may be traced; patches stay those it was made with.

    Edges stay straight: where the mesh is quadratic the positions of their middles follow from those of the vertices.
    """
    points = jnp.array(points, mesh.points.dtype)
    if points.shape != mesh.points.shape:
        raise InputError(f"mesh.points has shape {points.shape}: give positions of shape {mesh.points.shape}")
    if mesh.order > 1:
        vertices, (low, high) = points[: mesh.number_of_vertices], mesh.pattern.edges
        points = jnp.concatenate([vertices, 0.5 * (vertices[low] + vertices[high])])
    shape_vectors, volumes = _geometry(points, mesh.tetrahedra)
    return dataclasses.replace(mesh, points=points, shape_vectors=shape_vectors, volumes=volumes)


@jax.jit
def _geometry(points: jax.Array, tetrahedra: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Shape vectors, the rows of the inverse edge matrix as cross products over six times the volume, and volumes."""
    corner = points[tetrahedra]
    e = corner[:, 1:] - corner[:, :1]
    normals = jnp.stack([jnp.cross(e[:, 1], e[:, 2]), jnp.cross(e[:, 2], e[:, 0]), jnp.cross(e[:, 0], e[:, 1])])
    six_volumes = (e[:, 0] * normals[0]).sum(-1)
    return jnp.transpose(normals / six_volumes[None, :, None], (0, 2, 1)), six_volumes / 6


def check_mesh(mesh: TetMesh, name: str = "mesh") -> None:
    """Refuse a mesh that no simulation can use; host side, before any compile.

    Raises:
        InputError: no elements, node numbers out of range, positions that are not finite, flat or inverted elements,
            elements twice, nodes of no element.
    """
    points, tets = np.asarray(mesh.points), np.asarray(mesh.tetrahedra)
    if tets.size == 0:
        raise InputError(f"{name}: there are no tetrahedra; export a volume mesh, not a surface")
    if tets.min() < 0 or tets.max() >= len(points):
        raise InputError(f"{name}: tetrahedra name node {tets.max()}, but there are {len(points)} nodes; renumber them")
    if not np.all(np.isfinite(points)):
        bad = int(np.argwhere(~np.isfinite(points).all(axis=1))[0, 0])
        raise InputError(f"{name}: the position of node {bad} is {points[bad]}; give finite coordinates")
    volumes = np.asarray(mesh.volumes)
    edge = np.linalg.norm(points[tets[:, 1:]] - points[tets[:, :1]], axis=-1).max(axis=1)
    flat = np.flatnonzero(~(volumes > 1e-12 * edge**3))
    if len(flat):
        raise InputError(
            f"{name}: {len(flat)} of {len(tets)} tetrahedra are flat or inverted (first: {flat[0]}, volume "
            f"{volumes[flat[0]]:.3g} m^3); swap two of their nodes or remesh"
        )
    _, first, copies = np.unique(np.sort(tets, axis=1), axis=0, return_index=True, return_counts=True)
    if np.any(copies > 1):
        again = int(first[copies > 1].min())
        raise InputError(
            f"{name}: {int((copies - 1).sum())} tetrahedra stand there twice (first: {again}, nodes "
            f"{tets[again].tolist()}); remove the copies"
        )
    unused = np.setdiff1d(np.arange(len(points)), tets)
    if len(unused):
        raise InputError(f"{name}: {len(unused)} nodes belong to no tetrahedron (first: {unused[0]}); remove them")


def read_mesh(path: str | os.PathLike, unit: str = "m") -> TetMesh:
    """Read any file meshio reads that holds linear tetrahedra; sets of nodes and elements come along.

    Args:
        path: mesh file.
        unit: length unit of the file, one of `UNITS`.

    Raises:
        InputError: unreadable file, no or other-than-linear cells, unit unknown, unusable mesh.
    """
    if unit not in UNITS:
        raise InputError(f"mesh unit = {unit!r} is not known: use one of {', '.join(UNITS)}")
    path = Path(path)
    if not path.is_file():
        raise InputError(f"mesh file {path}: {'is a folder' if path.is_dir() else 'no such file'}; give a mesh file")
    data = _read_quietly(path)
    blocks = [block.data for block in data.cells if block.type == "tetra"]
    if not blocks:
        kinds = ", ".join(sorted({block.type for block in data.cells})) or "nothing"
        raise InputError(f"mesh file {path}: it holds {kinds} but no linear tetrahedra; export 4-node tetrahedra")
    others = sorted({b.type for b in data.cells if b.type != "tetra" and not b.type.startswith(_FLAT_CELLS)})
    if others:
        raise InputError(
            f"mesh file {path}: it holds {', '.join(others)} beside linear tetrahedra; remesh all of the body with "
            "4-node tetrahedra"
        )
    points, tets = np.asarray(data.points, dtype=float)[:, :3] * UNITS[unit], np.vstack(blocks)
    if points.shape[1] != 3:
        raise InputError(f"mesh file {path}: its points have {points.shape[1]} coordinates; give three")
    if tets.min(initial=0) < 0 or tets.max(initial=0) >= len(points):
        raise InputError(
            f"mesh file {path}: tetrahedra name node {tets.max()}, but there are {len(points)} nodes; renumber them"
        )
    mesh = tet_mesh(points, tets, _node_sets(data), _element_sets(data))
    check_mesh(mesh, f"mesh file {path}")
    size = float(np.ptp(points, axis=0).max())
    if size > _LARGE and unit == "m":
        warnings.warn(
            f"mesh file {path} is {size:.4g} m long: if its numbers are millimetres write unit = 'mm'", stacklevel=2
        )
    return mesh


#: What the beginning of a file says that meshio does not read -> what it is, and the remedy.
_FOREIGN = {
    r"\$NOD\b": "it is in Gmsh's format of version 1 ($NOD, $ELM); open it in Gmsh and save it as version 4 or VTK",
    r"DATASET\s+POLYDATA|type=.PolyData": "it holds VTK polygons, a surface; fill the surface with tetrahedra "
    "(Gmsh, TetGen) and export an unstructured grid",
}


def _read_quietly(path: Path) -> Any:
    """What meshio reads, without what meshio prints: one sentence of ours says what was found."""
    import meshio

    try:
        with path.open("rb") as file:
            beginning = file.read(1000).decode("latin-1")
    except OSError as error:
        raise InputError(f"mesh file {path} cannot be read ({error.strerror}); give a mesh file") from None
    for mark, sentence in _FOREIGN.items():
        if re.search(mark, beginning):
            raise InputError(f"mesh file {path}: {sentence}")
    said = io.StringIO()
    try:
        with contextlib.redirect_stdout(said), contextlib.redirect_stderr(io.StringIO()):
            return meshio.read(path)
    except SystemExit:  # meshio's way to say that no reader took the file; their reasons are printed
        reason = " ".join(said.getvalue().split()) or f"its content is not what {path.suffix} files hold"
    except Exception as error:  # meshio's readers raise whatever their parser meets
        reason = " ".join(str(error).split()) or type(error).__name__
    raise InputError(f"mesh file {path}: meshio cannot read it ({reason[:120]}); export it as VTU or Gmsh")


#: Cells of surfaces and edges, which a volume mesh may carry beside its own.
_FLAT_CELLS = ("vertex", "line", "triangle", "quad", "polygon")
#: A body longer than this [m] is likelier a mesh in millimetres.
_LARGE = 10.0


def _node_sets(data: Any) -> dict[str, np.ndarray]:
    """meshio's point sets, and integer point data named ``set:NAME`` (how `write_mesh` keeps them in VTU)."""
    sets = {name: np.asarray(nodes, dtype=np.int32) for name, nodes in (data.point_sets or {}).items()}
    for name, values in data.point_data.items():
        if name.startswith("set:"):
            sets[name.removeprefix("set:")] = np.flatnonzero(values).astype(np.int32)
    return sets


#: A cell array of whole numbers with more of them than this numbers the cells, it does not group them.
_MOST_GROUPS = 100


def _element_sets(data: Any) -> dict[str, np.ndarray]:
    """Sets of tetrahedra: meshio's cell sets, cell data ``set:NAME``, and groups of whole numbers.

    A group is called as the file does (Gmsh's physical names), or after array and number, ``medit:ref=2``.
    """
    kinds = [block.type for block in data.cells]
    first = np.cumsum([0, *(len(block.data) if block.type == "tetra" else 0 for block in data.cells)])
    sets = {}
    for name, parts in (data.cell_sets or {}).items():
        picks = [
            first[k] + np.asarray(part, int)
            for k, part in enumerate(parts)
            if part is not None and kinds[k] == "tetra" and not name.startswith("gmsh:bounding")
        ]
        if picks and sum(map(len, picks)):
            sets[name] = np.concatenate(picks)
    names = {(int(tag[0]), "gmsh:physical"): name for name, tag in data.field_data.items() if tag[-1] == 3}
    for name, parts in data.cell_data.items():
        values = np.concatenate([np.asarray(p) for p, kind in zip(parts, kinds, strict=True) if kind == "tetra"])
        if values.ndim != 1 or not np.issubdtype(values.dtype, np.integer):
            continue
        if name.startswith("set:"):
            sets[name.removeprefix("set:")] = np.flatnonzero(values)
            continue
        groups = np.unique(values)
        for group in groups if len(groups) <= _MOST_GROUPS else ():
            sets[names.get((int(group), name), f"{name}={group}")] = np.flatnonzero(values == group)
    return sets


def write_mesh(path: str | os.PathLike, mesh: TetMesh, point_data: dict[str, Any] | None = None) -> None:
    """Write a mesh [m] with meshio; sets are kept as 0/1 data ``set:NAME``, in formats that carry data."""
    import meshio

    data = {name: np.asarray(values) for name, values in (point_data or {}).items()}
    for name, nodes in mesh.node_sets.items():
        mask = np.zeros(mesh.number_of_nodes, dtype=np.int32)
        mask[np.asarray(nodes)] = 1
        data[f"set:{name}"] = mask
    cell_data = {}
    for name, elements in mesh.element_sets.items():
        mask = np.zeros(mesh.number_of_elements, dtype=np.int32)
        mask[np.asarray(elements)] = 1
        cell_data[f"set:{name}"] = [mask]
    cells = [("tetra", np.asarray(mesh.tetrahedra))]
    # meshio takes .msh for an ANSYS file; in this field it is Gmsh's.
    file_format = "gmsh" if Path(path).suffix == ".msh" else None
    meshio.Mesh(np.asarray(mesh.points), cells, point_data=data, cell_data=cell_data).write(
        path, file_format=file_format
    )
