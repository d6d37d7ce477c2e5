"""Make a body of quadratic elements, with a node at the centre of each voxel. So the measured displacements are
displacements of nodes."""

import itertools
from typing import NamedTuple

import numpy as np
import scipy.sparse

from liverjax.core.errors import InputError
from liverjax.mesh.promotion import quadratic
from liverjax.mesh.tetrahedra import TetMesh, tet_mesh


class VoxelBody(NamedTuple):
    """Body of bricks of 3 x 3 x 3 voxels, each divided into six quadratic tetrahedra. Neighbouring bricks share the
    voxels on their common face.

    A large body is divided into parts. At a voxel that belongs to two parts, each part has a separate node.
    """

    linear: TetMesh  # linear mesh of the corners
    mesh: TetMesh  # quadratic; the nodes of `linear` come first
    voxel: np.ndarray  # (V, 3) index of the voxel of each node
    inner: np.ndarray  # (V,) bool: nodes with elements of their part on all sides; there the forces balance
    part: np.ndarray  # (V,) number of the part of each node
    whole: TetMesh  # linear mesh of the undivided body, for fields that are continuous between the parts
    corner: np.ndarray  # (P,) node of `whole` for each of the P nodes of `linear`


def voxel_body(
    mask: np.ndarray, spacing: np.ndarray, origin: np.ndarray | None = None, side: int | None = None
) -> VoxelBody:
    """Return the body that consists of all bricks with 27 voxels in the mask.

    Args:
        mask: (nx, ny, nz) bool.
        spacing: spacing of the voxels (3,) [m].
        origin: centre of the first voxel (3,) [m]; None: 0.
        side: maximum number of bricks along the side of a part; None: the body has one part.

    Raises:
        InputError: no brick fits into the mask.
    """
    first = _corner(mask)
    cells = tuple(int(n) for n in (np.array(mask.shape) - 1 - first) // 2)
    if min(cells) < 1:
        covered = (np.ptp(np.flatnonzero(mask.any(axis=(axis - 2, axis - 1)))) + 1 for axis in range(3))
        raise InputError(
            f"the mask covers only {' x '.join(map(str, covered))} voxels: at least "
            "3 are needed along every axis, and 5 or more are better; measure more slices"
        )
    kept = _whole_bricks(mask[tuple(slice(f, None) for f in first)], cells)
    if not _surrounded(kept).any():
        raise InputError("no cube of 3 x 3 x 3 voxels lies within the mask: give a larger mask")
    parts = _part_of_each_brick(kept, side)
    used, tets = np.unique(_sixths(np.argwhere(kept), kept.shape), return_inverse=True)
    at = 2 * np.stack(np.unravel_index(used, tuple(n + 1 for n in kept.shape)), axis=1)
    start = np.zeros(3) if origin is None else np.asarray(origin)
    whole = tet_mesh((at + first) * spacing + start, tets.reshape(-1, 4))
    # Different parts have different nodes, also at the same voxel.
    own, split = np.unique(np.repeat(parts[kept], 24) * len(used) + tets.ravel(), return_inverse=True)
    corner = own % len(used)
    linear = whole if len(own) == len(used) else tet_mesh(np.asarray(whole.points)[corner], split.reshape(-1, 4))
    mesh = quadratic(linear)
    place = np.rint((np.asarray(mesh.points) - start) / spacing).astype(int)
    part = np.empty(len(place), int)
    part[mesh.element_nodes_on_host] = np.repeat(parts[kept], 6)
    inner = np.zeros(len(place), bool)
    for k in range(parts.max() + 1):
        inner[part == k] = _surrounded(parts == k)[tuple((place[part == k] - first).T)]
    return VoxelBody(linear, mesh, place, inner, part, whole, corner)


def _part_of_each_brick(kept: np.ndarray, side: int | None) -> np.ndarray:
    """Return the number of the part to which each brick belongs, or -1 for bricks that are not in the body. All parts
    have about the same length along an axis."""
    parts = np.zeros(kept.shape, int)
    for axis, n in enumerate(kept.shape):
        number = 1 if side is None else -(-n // side)
        along = np.arange(n) * number // n
        parts = parts * number + along.reshape([-1 if a == axis else 1 for a in range(3)])
    out = np.full(kept.shape, -1)
    out[kept] = np.unique(parts[kept], return_inverse=True)[1]
    return out


def number_of_bricks(mask: np.ndarray) -> int:
    """Return the number of bricks in the body that `voxel_body` makes from a mask (nx, ny, nz)."""
    first = _corner(mask)
    cells = tuple(int(n) for n in (np.array(mask.shape) - 1 - first) // 2)
    return int(_whole_bricks(mask[tuple(slice(f, None) for f in first)], cells).sum()) if min(cells) > 0 else 0


def _sixths(brick: np.ndarray, cells: tuple[int, ...]) -> np.ndarray:
    """Return the corners (6 n, 4) of the elements of n bricks (n, 3). Along each axis, every second brick is a mirror
    image of the brick before.

    So the diagonals of the elements do not all have the same direction, and waves in all directions have about the same
    speed.
    """
    out = []
    for order in itertools.permutations(range(3)):
        path = np.vstack([np.zeros(3, int), np.cumsum(np.eye(3, dtype=int)[list(order)], axis=0)])
        odd = brick[:, None] % 2
        nodes = brick[:, None] + np.where(odd, 1 - path, path)
        mirrored = (np.linalg.det(np.eye(3)[list(order)]) < 0) ^ (odd.sum(axis=(1, 2)) % 2 == 1)
        nodes[mirrored] = nodes[mirrored][:, [0, 2, 1, 3]]
        out.append(np.ravel_multi_index(tuple(np.moveaxis(nodes, -1, 0)), tuple(n + 1 for n in cells)))
    return np.stack(out, axis=1).reshape(-1, 4)


def _corner(mask: np.ndarray) -> np.ndarray:
    """Return the first voxel (3,) of the smallest box around the mask."""
    if not mask.any():
        raise InputError("the mask contains no voxel: give a mask that is true within the organ")
    return np.array([np.flatnonzero(mask.any(axis=tuple(b for b in range(3) if b != a)))[0] for a in range(3)])


def _whole_bricks(mask: np.ndarray, cells: tuple[int, ...]) -> np.ndarray:
    """Return for each brick (array of shape `cells`) whether all 27 voxels are in the mask."""
    kept = np.ones(cells, bool)
    for offset in np.ndindex(3, 3, 3):
        kept &= mask[_every_second(offset, cells)]
    return kept


def _surrounded(kept: np.ndarray) -> np.ndarray:
    """Return for each voxel of the grid whether it is inside the body: all bricks that contain the voxel are in the
    body (`kept`), and the voxel is not at the end of the grid. Along each axis, n bricks have 2 n + 1 voxels."""
    inside = np.ones(tuple(2 * n + 1 for n in kept.shape), bool)
    for offset in np.ndindex(3, 3, 3):
        inside[_every_second(offset, kept.shape)] &= kept
    for a in range(3):
        np.moveaxis(inside, a, 0)[[0, -1]] = False
    return inside


def _every_second(offset: tuple[int, ...], cells: tuple[int, ...]) -> tuple[slice, ...]:
    return tuple(slice(o, o + 2 * n - 1, 2) for o, n in zip(offset, cells, strict=True))


def on_all_nodes(body: VoxelBody, corners: np.ndarray) -> np.ndarray:
    """Return the values (V,) at all nodes of a field that is linear in each element. `corners`: values of the field at
    the nodes of `body.whole`."""
    from liverjax.mesh.adjacency import PAIRS

    values = np.empty(body.mesh.number_of_nodes, corners.dtype)
    values[: len(body.corner)] = corners[body.corner]
    nodes = body.mesh.element_nodes_on_host
    for middle, (i, j) in zip(nodes[4:], PAIRS, strict=True):
        values[middle] = 0.5 * (values[nodes[i]] + values[nodes[j]])
    return values


def mean_of_corners(body: VoxelBody) -> scipy.sparse.csr_array:
    """Return the matrix (E, P) of the means over the four corners of each element."""
    tets = np.asarray(body.whole.tetrahedra)
    rows = np.repeat(np.arange(len(tets)), 4)
    shape = (len(tets), body.whole.number_of_nodes)
    return scipy.sparse.csr_array((np.full(rows.size, 0.25), (rows, tets.ravel())), shape=shape)


def mean_around_corners(body: VoxelBody, mean: scipy.sparse.csr_array) -> scipy.sparse.csr_array:
    """Return the matrix (P, E) of the means over the elements around each corner, weighted by volume."""
    volumes = np.asarray(body.whole.volumes)
    return (scipy.sparse.diags_array(1 / (mean.T @ volumes)) @ mean.T @ scipy.sparse.diags_array(volumes)).tocsr()


def changes_over_slopes(
    body: VoxelBody, mean: scipy.sparse.csr_array, length: float
) -> tuple[scipy.sparse.csr_array, ...]:
    """Return one matrix (P, P) for each axis: its product with a nodal field is the change of the field over the width
    w. The width w is `length` [m], or the side of a brick if the side is longer.

    The gradient at a corner is the mean over the elements around this corner, weighted by volume.
    """
    tets = np.asarray(body.whole.tetrahedra)
    D = np.moveaxis(np.asarray(body.whole.shape_vectors), -1, 0)
    gradients = np.concatenate([-D.sum(axis=1, keepdims=True), D], axis=1)  # (E, 4, 3)
    over = np.maximum(np.ptp(np.asarray(body.whole.points)[tets[0]], axis=0), length)
    rows, columns = np.repeat(np.arange(len(tets)), 4), tets.ravel()
    of_elements = [
        scipy.sparse.csr_array((w * gradients[:, :, a].ravel(), (rows, columns)), shape=mean.shape)
        for a, w in enumerate(over)
    ]
    around = mean_around_corners(body, mean)
    return tuple((around @ own).tocsr() for own in of_elements)
