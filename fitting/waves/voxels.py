"""A body of quadratic elements whose nodes are voxels. So the measured displacements are displacements of nodes."""

import itertools
from typing import NamedTuple

import numpy as np

from liverjax.core.errors import InputError
from liverjax.mesh.promotion import quadratic
from liverjax.mesh.tetrahedra import TetMesh, tet_mesh


class VoxelBody(NamedTuple):
    """Bricks of 3 x 3 x 3 voxels, each cut into six quadratic elements. Neighbouring bricks share their outer
    voxels.

    A large body has parts. Neighbouring parts have nodes of their own on the voxels that they share.
    """

    linear: TetMesh  # linear mesh of the corners
    mesh: TetMesh  # quadratic; the nodes of `linear` come first
    voxel: np.ndarray  # (V, 3) index of the voxel of each node
    inner: np.ndarray  # (V,) bool: nodes with elements of their part on all sides, where forces must balance
    part: np.ndarray  # (V,) number of the part of each node
    whole: TetMesh  # linear mesh of the same elements, without parts: for fields that are continuous in the body
    corner: np.ndarray  # (P,) node of `whole` at each node of `linear`


def voxel_body(
    mask: np.ndarray, spacing: np.ndarray, origin: np.ndarray | None = None, side: int | None = None
) -> VoxelBody:
    """The body of all bricks whose 27 voxels are in the mask.

    Args:
        mask: (nx, ny, nz) bool.
        spacing: spacing of the voxels (3,) [m].
        origin: centre of the first voxel (3,) [m]; None: 0.
        side: most bricks along the side of a part; None: one part.

    Raises:
        InputError: the mask has no room for a brick, or for a node with bricks on all sides.
    """
    first = _corner(mask)
    cells = tuple(int(n) for n in (np.array(mask.shape) - 1 - first) // 2)
    if min(cells) < 1:
        raise InputError(
            f"the mask reaches over {' x '.join(map(str, np.array(mask.shape) - first))} voxels: waves need at least "
            "3 along every axis, and better 5 or more; measure more slices"
        )
    kept = _whole_bricks(mask[tuple(slice(f, None) for f in first)], cells)
    if not _surrounded(kept).any():
        raise InputError("no voxel has two more voxels of the mask on every side: give a larger mask")
    parts = _part_of_each_brick(kept, side)
    used, tets = np.unique(_sixths(np.argwhere(kept), kept.shape), return_inverse=True)
    at = 2 * np.stack(np.unravel_index(used, tuple(n + 1 for n in kept.shape)), axis=1)
    start = np.zeros(3) if origin is None else np.asarray(origin)
    whole = tet_mesh((at + first) * spacing + start, tets.reshape(-1, 4))
    # Corners of different parts are different nodes.
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
    """The part of every brick, -1 where no brick is kept. Parts along an axis are about equally long."""
    parts = np.zeros(kept.shape, int)
    for axis, n in enumerate(kept.shape):
        number = 1 if side is None else -(-n // side)
        along = np.arange(n) * number // n
        parts = parts * number + along.reshape([-1 if a == axis else 1 for a in range(3)])
    out = np.full(kept.shape, -1)
    out[kept] = np.unique(parts[kept], return_inverse=True)[1]
    return out


def number_of_bricks(mask: np.ndarray) -> int:
    """How many bricks `voxel_body` makes of a mask (nx, ny, nz)."""
    first = _corner(mask)
    cells = tuple(int(n) for n in (np.array(mask.shape) - 1 - first) // 2)
    return int(_whole_bricks(mask[tuple(slice(f, None) for f in first)], cells).sum()) if min(cells) > 0 else 0


def _sixths(brick: np.ndarray, cells: tuple[int, ...]) -> np.ndarray:
    """Corners (6 n, 4) of the elements of bricks (n, 3). Along each axis, every second brick is a mirror image.

    So the diagonals have no common direction, and waves in all directions have about the same speed.
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
    """First voxel (3,) of the smallest box around the mask."""
    if not mask.any():
        raise InputError("the mask contains no voxel: give a mask that is true within the organ")
    return np.array([np.flatnonzero(mask.any(axis=tuple(b for b in range(3) if b != a)))[0] for a in range(3)])


def _whole_bricks(mask: np.ndarray, cells: tuple[int, ...]) -> np.ndarray:
    """Bricks (cells) with every voxel in the mask."""
    kept = np.ones(cells, bool)
    for offset in np.ndindex(3, 3, 3):
        kept &= mask[_every_second(offset, cells)]
    return kept


def _surrounded(kept: np.ndarray) -> np.ndarray:
    """For each voxel (2 cells + 1): whether all its bricks are kept and it is not at the end of the grid."""
    inside = np.ones(tuple(2 * n + 1 for n in kept.shape), bool)
    for offset in np.ndindex(3, 3, 3):
        inside[_every_second(offset, kept.shape)] &= kept
    for a in range(3):
        np.moveaxis(inside, a, 0)[[0, -1]] = False
    return inside


def _every_second(offset: tuple[int, ...], cells: tuple[int, ...]) -> tuple[slice, ...]:
    return tuple(slice(o, o + 2 * n - 1, 2) for o, n in zip(offset, cells, strict=True))


def on_all_nodes(body: VoxelBody, corners: np.ndarray) -> np.ndarray:
    """Values (V,) at all nodes of a field that is linear in the elements, from its values at the corners
    (the nodes of `body.whole`)."""
    from liverjax.mesh.adjacency import PAIRS

    values = np.empty(body.mesh.number_of_nodes, corners.dtype)
    values[: len(body.corner)] = corners[body.corner]
    nodes = body.mesh.element_nodes_on_host
    for middle, (i, j) in zip(nodes[4:], PAIRS, strict=True):
        values[middle] = 0.5 * (values[nodes[i]] + values[nodes[j]])
    return values
