"""Positions of the edges of regions, which may lie between voxel centres, and the uncertainty of these positions.

The labels give one region for each whole voxel. Smoothed labels give the volume of a region, but the position of the
edge has an error of a fraction of a voxel. For circles with a radius of 2.5 to 8 voxels, the error of the mean radius
is 0.05 to 0.1 voxels. In addition, the local position of the edge has an error with a standard deviation of 0.13 voxels
and a correlation length of 1.6 voxels. These errors change the modulus of a stiff cylinder with a radius of 5 voxels by
3 to 4 % (`tests/test_wave_edges.py`). So the edges are divided into patches, and the outward shift of each patch is an
unknown of the fit.
"""

from typing import NamedTuple

import numpy as np
from scipy import ndimage

from fitting.waves.voxels import VoxelBody

#: Standard deviation [voxels] of the Gaussian that smooths the labels.
SMOOTHING = 1.4
#: Number of parts into which each side of a voxel is divided when volumes are computed.
FINE = 4
#: Shift of the edges [voxels] in the finite difference for derivatives with respect to the position of the edges.
FARTHER = 0.1
#: SIDE: side of a patch. REACH: maximum distance between an edge and a node of a cut element (both in voxels).
SIDE, REACH = 2.0, 2.0
#: WHOLE: standard deviation of the position of a whole edge (rounding to a voxel). PATCH, ALIKE: standard deviation and
#: correlation length of the positions of the patches (all in voxels).
WHOLE, PATCH, ALIKE = 1 / np.sqrt(12), 0.13, 1.6


class Patches(NamedTuple):
    """P patches of the edges of regions."""

    region: np.ndarray  # (P,) index of the region to which the edge belongs
    centre: np.ndarray  # (P, 3) centre of each patch [voxels]

    @property
    def covariance(self) -> np.ndarray:
        """Prior covariance (P, P) [voxels^2] of the outward shifts of the patches, before the waves are used."""
        apart = np.sum((self.centre[:, None] - self.centre[None]) ** 2, axis=-1)
        same = self.region[:, None] == self.region[None]
        return np.asarray(same * (WHOLE**2 + PATCH**2 * np.exp(-0.5 * apart / ALIKE**2)))

    def means(self, values: np.ndarray, regions: int) -> np.ndarray:
        """Return the means (regions,) of values (P,) over the patches of each region; 0 if a region has no patch."""
        count = np.bincount(self.region, minlength=regions)
        return np.asarray(np.bincount(self.region, values, regions) / np.maximum(count, 1))


class MovedEdges(NamedTuple):
    """R regions after their edges are moved by `FARTHER`. Each edge is moved outwards from the smaller of its two
    regions."""

    s: np.ndarray  # (R, V) smoothed indicator functions of the regions, from `places`
    rank: np.ndarray  # (R,) rank of each region by its size, from `ranks_of_regions`


NO_PATCHES = Patches(np.zeros(0, int), np.zeros((0, 3)))


def places(labels: np.ndarray, body: VoxelBody, known: np.ndarray, farther: float = 0.0) -> np.ndarray:
    """Return the smoothed indicator function s_k (R, V) of each label in `known` (R,), at the nodes.

    An indicator function is 1 inside the region and 0 outside. It is smoothed by the filter 2 g - g g with a Gaussian
    filter g, because this filter hardly moves curved edges. A constant is added for each region except the largest, so
    that the volume of the region is the volume of its label.

    Args:
        labels: label of each voxel (nx, ny, nz).
        body: only labels at the voxels of this body are used. Every other voxel gets the nearest of these labels.
        known: the R labels that occur in the body.
        farther: distance [voxels] by which edges are moved. The edge between two regions is moved outwards from the
            smaller region.
    """
    measured = np.zeros(labels.shape, bool)
    measured[tuple(body.voxel.T)] = True
    nearest = ndimage.distance_transform_edt(~measured, return_distances=False, return_indices=True)
    whole = labels[tuple(nearest)]
    s = np.array([_smoothed(whole == label) for label in known])
    rank, out = ranks_of_regions(labels, body, known), s.copy()
    for k in range(len(known)):
        if rank[k] < len(known) - 1:
            others = np.delete(s, k, axis=0).max(axis=0)
            # The constant is added only near this region. A small region needs a large constant, and elsewhere this
            # constant would move the edges of other regions.
            apart = ndimage.distance_transform_edt(whole != known[k])
            out[k] += _level(s[k] - others, whole == known[k]) * np.clip(2 - 0.5 * apart, 0, 1)
    if farther:
        out = _moved_out(out, rank, farther)
    return np.asarray(out[(slice(None), *body.voxel.T)])


def ranks_of_regions(labels: np.ndarray, body: VoxelBody, known: np.ndarray) -> np.ndarray:
    """Return the rank (R,) of each label in `known` by its number of voxels in the body. The largest region has the
    highest rank. The arguments are those of `places`."""
    own = labels[tuple(body.voxel.T)]
    return np.argsort(np.argsort([np.sum(own == label) for label in known], kind="stable"))


def moved_edges(labels: np.ndarray, body: VoxelBody, known: np.ndarray) -> MovedEdges:
    """Return the regions with edges moved by `FARTHER`. The arguments are those of `places`."""
    return MovedEdges(places(labels, body, known, FARTHER), ranks_of_regions(labels, body, known))


def _moved_out(s: np.ndarray, rank: np.ndarray, farther: float) -> np.ndarray:
    """Return the indicator functions s (R, nx, ny, nz) with edges moved by `farther` [voxels] outwards from the smaller
    regions. `rank` (R,): rank of each region by its size."""
    out = s.copy()
    for k in np.flatnonzero(rank < len(s) - 1):  # the largest region is not moved
        others = s.copy()
        others[k] = -np.inf
        above = s[k] - others.max(axis=0)
        slope = np.stack(np.gradient(above))
        normal = slope / np.maximum(np.linalg.norm(slope, axis=0), 1e-12)
        # Each voxel gets the value of `above` from the distance `farther` along the normal, which points inwards. So
        # the edge moves outwards.
        moved = ndimage.map_coordinates(above, np.indices(above.shape) + farther * normal, order=3, mode="nearest")
        out[k] += np.where(rank[others.argmax(axis=0)] > rank[k], moved - above, 0.0)
    return out


def _smoothed(place: np.ndarray) -> np.ndarray:
    once = ndimage.gaussian_filter(place.astype(float), SMOOTHING, mode="nearest")
    return 2 * once - ndimage.gaussian_filter(once, SMOOTHING, mode="nearest")


def _level(above: np.ndarray, place: np.ndarray) -> float:
    """Return the constant that must be added to the field `above` near a label. With this constant, the volume where
    the field is positive is the volume of the label. `place` (nx, ny, nz) states which voxels have this label."""
    count, reach = int(np.sum(place)), ndimage.find_objects(place.astype(int))[0]
    box = tuple(slice(max(0, r.start - 2), r.stop + 2) for r in reach)
    # The values are interpolated linearly between the centres of the voxels, at several points within each voxel.
    inside = [np.clip(np.arange(n * FINE) / FINE + (0.5 / FINE - 0.5), 0, n - 1) for n in above[box].shape]
    fine = ndimage.map_coordinates(above[box], np.meshgrid(*inside, indexing="ij"), order=1)
    return -float(np.partition(fine.ravel(), -count * FINE**3)[-count * FINE**3])


def patches_of(s: np.ndarray, rank: np.ndarray, body: VoxelBody, nodes: np.ndarray) -> tuple[Patches, np.ndarray]:
    """Return the patches of the edges near given nodes, and the index of the nearest patch for each node (V,). The
    index is -1 for nodes that are not given.

    The edge between two regions belongs to the smaller one. So the largest region has no patches.

    Args:
        s: smoothed indicator functions (R, V) from `places`.
        rank: rank of each region (R,) by its size, from `ranks_of_regions`. `places` uses the same ranks to move edges.
        body: the body of the nodes.
        nodes: indices of the nodes of cut elements.
    """
    of_node = np.full(body.mesh.number_of_nodes, -1)
    if len(s) < 2 or not len(nodes):
        return NO_PATCHES, of_node
    highest = np.argsort(s[:, nodes], axis=0)[-2:]  # the two regions at the edge
    region = np.where(rank[highest[0]] < rank[highest[1]], *highest)
    foot = np.empty((len(nodes), 3))
    for k in np.unique(region):
        own = region == k
        foot[own] = _feet(s[k] - np.delete(s, k, axis=0).max(axis=0), body)[nodes[own]]
    block = np.column_stack([region, np.floor(foot / SIDE).astype(int)])
    known, patch = np.unique(block, axis=0, return_inverse=True)
    patch = patch.ravel()
    count = np.bincount(patch)
    centre = np.stack([np.bincount(patch, foot[:, a]) / count for a in range(3)], axis=1)
    of_node[nodes] = patch
    return Patches(known[:, 0], centre), of_node


def _feet(above: np.ndarray, body: VoxelBody) -> np.ndarray:
    """Return for each node the nearest point (V, 3) [voxels] where the field `above` is zero. The point is estimated
    from the nodal values (V,) and the gradient of the field. The distance of this point from the node is at most
    `REACH`."""
    first = body.voxel.min(axis=0)
    at = tuple((body.voxel - first).T)
    grid, known = np.zeros(np.ptp(body.voxel, axis=0) + 1), np.zeros(np.ptp(body.voxel, axis=0) + 1, bool)
    grid[at], known[at] = above, True
    grid = grid[tuple(ndimage.distance_transform_edt(~known, return_distances=False, return_indices=True))]
    slope = np.stack(np.gradient(grid), axis=-1)[at]
    step = -above[:, None] * slope / np.maximum(np.sum(slope**2, axis=1), 1e-12)[:, None]
    return body.voxel + step * np.minimum(1, REACH / np.maximum(np.linalg.norm(step, axis=1), 1e-12))[:, None]
