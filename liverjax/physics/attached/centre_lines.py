"""Centre lines and radii of one tube or a tree of tubes, from their surface, for example from a segmentation.

The distance from one end is measured along the surface. Lines of equal distance are rings around the tubes, one ring
for each branch. The part of the surface between two rings is called a band. The centres of the two rings of a band are
joined by a piece of a centre line. The radius of a piece is the mean distance between the piece and the points of its
rings. The centre lines begin and end at the ends of the surface.

Source: level sets of geodesic distance (Verroust and Lazarus 2000, Extracting skeletal curves from 3D scattered data).
"""

from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from liverjax.core.errors import InputError

if TYPE_CHECKING:
    import scipy.sparse

#: Distance between rings along the surface, divided by the mean radius of the tubes.
_BAND = 2.0
#: Minimum number of points of a ring. A ring with fewer points is ignored, since it probably does not go around a
#: tube.
_LEAST = 5
#: A ring may be interrupted, for example by a hole of the surface, if the gap is shorter than this fraction of the
#: ring's length. Level lines with a longer gap end at the open end of a tube. They do not go around the tube, so they
#: are no rings.
_GAP = 0.25


class CentreLines(NamedTuple):
    """Begin, end and radius of m straight pieces of centre lines."""

    begin: np.ndarray  # (m, 3) [m]
    end: np.ndarray  # (m, 3) [m]
    radius: np.ndarray  # (m,) [m]


def read_surface(path: Path, scale: float, name: str) -> tuple[np.ndarray, np.ndarray]:
    """Read a surface file: n corners (n, 3) [m], and t triangles (t, 3) of corner numbers. Equal corners are merged.

    Args:
        path: file with triangles, in any format that meshio reads (STL, PLY, OBJ, VTK, …).
        scale: length of one unit of the file [m].
        name: name of the vessel, for messages.

    Raises:
        InputError: the file cannot be read, or contains no triangles.
    """
    import meshio

    try:
        found = meshio.read(path)
    except (OSError, ValueError, KeyError, IndexError, SystemExit, meshio.ReadError) as error:
        raise InputError(
            f"{name} surface {path} cannot be read ({error or 'unknown format'}): give an STL file"
        ) from None
    triangles = [block.data for block in found.cells if block.type == "triangle"]
    if not triangles:
        raise InputError(f"{name} surface {path} contains no triangles: export the surface of the tube")
    points = scale * np.asarray(found.points, float)[:, :3]
    size = float(np.ptp(points, axis=0).max())
    _, first, place = np.unique(np.round(points / (1e-7 * size)), axis=0, return_index=True, return_inverse=True)
    corners = place.ravel()[np.concatenate(triangles)]
    flat = (corners[:, 0] == corners[:, 1]) | (corners[:, 1] == corners[:, 2]) | (corners[:, 0] == corners[:, 2])
    return points[first], corners[~flat]


class _Rings(NamedTuple):
    """r rings with p points on a surface with n corners, and the bands between the rings."""

    points: np.ndarray  # (p, 3) [m] where edges of the surface cross a level of the distance from one end of the tube
    ring: np.ndarray  # (p,) number of the ring of each point
    closed: np.ndarray  # (r,) False for a line that does not go around the tube (`_GAP`)
    below: np.ndarray  # (r,) number of the band on the side of each ring with smaller distances
    above: np.ndarray  # (r,) number of the band on the side of each ring with larger distances
    band: np.ndarray  # (n,) number of the band of each corner


def centre_lines(points: np.ndarray, triangles: np.ndarray, name: str = "vessel") -> CentreLines:
    """Compute the centre lines of the tubes that have this surface.

    Args:
        points: positions (n, 3) [m] of the n corners of the surface.
        triangles: corner numbers (t, 3) of the t triangles. The ends of the tubes may be open or closed.
        name: name of the vessel, for messages.

    Raises:
        InputError: the surface is too short or too coarse for a centre line.
    """
    import scipy.sparse
    from scipy.sparse.csgraph import connected_components

    edges = _edges(triangles)
    lengths = np.linalg.norm(points[edges[:, 0]] - points[edges[:, 1]], axis=1)
    graph = scipy.sparse.coo_array((lengths, edges.T), shape=(len(points),) * 2).tocsr()
    parts, of = connected_components(graph, directed=False)
    found, said = [], f"{name} surface is too short or too coarse to find its centre line: give line and radius"
    for part in range(parts):
        own = np.flatnonzero(of == part)
        inside = triangles[of[triangles[:, 0]] == part]
        if len(own) < 2 * _LEAST:
            continue
        number = np.full(len(points), -1)
        number[own] = np.arange(len(own))
        here, corners = points[own], number[inside]
        away = _from_one_end(graph, own)[own]
        lines = _pieces(here, _rings_of(here, corners, away))
        if lines is None:
            raise InputError(said)
        found.append(lines)
    if not found or not sum(len(lines.begin) for lines in found):
        raise InputError(said)
    return CentreLines(*(np.concatenate(arrays) for arrays in zip(*found, strict=True)))


def _edges(triangles: np.ndarray) -> np.ndarray:
    every = np.concatenate([triangles[:, [0, 1]], triangles[:, [1, 2]], triangles[:, [2, 0]]])
    return np.unique(np.sort(every, axis=1), axis=0)


def _from_one_end(graph: "scipy.sparse.csr_array", own: np.ndarray) -> np.ndarray:
    """Return the distances (n,) [m] of all n corners from a corner at one end of the surface, along the edges."""
    from scipy.sparse.csgraph import dijkstra

    first = dijkstra(graph, directed=False, indices=own[0])
    return dijkstra(graph, directed=False, indices=own[np.argmax(first[own])])


def _spacing(points: np.ndarray, triangles: np.ndarray, away: np.ndarray) -> float:
    """Return the distance [m] between rings: `_BAND` times the mean radius.

    If an edge of a triangle would cross two rings at this distance, the result is larger. The mean radius is estimated:
    area of the surface, divided by its length (the maximum of `away`) and by 2 pi.
    """
    a, b, c = (points[triangles[:, k]] for k in range(3))
    area = 0.5 * np.linalg.norm(np.cross(b - a, c - a), axis=1).sum()
    longest = max(np.ptp(away[triangles], axis=1).max(), 1e-300)
    return float(max(_BAND * area / (2 * np.pi * away.max()), 1.01 * longest))


def _rings_of(points: np.ndarray, triangles: np.ndarray, away: np.ndarray) -> _Rings:
    """Find the rings of points where edges cross a level of the distance `away` from one end.

    The levels are (k + 1/2) times the spacing, with k = 0, 1, 2, …
    """
    import scipy.sparse
    from scipy.sparse.csgraph import connected_components

    level = np.floor(away / _spacing(points, triangles, away) + 0.5).astype(int)
    spacing, edges, n = _spacing(points, triangles, away), _edges(triangles), len(points)
    same = edges[level[edges[:, 0]] == level[edges[:, 1]]]
    band = connected_components(scipy.sparse.coo_array((np.ones(len(same)), same.T), shape=(n, n)), directed=False)[1]
    crossing = edges[level[edges[:, 0]] != level[edges[:, 1]]]
    swap = level[crossing[:, 0]] > level[crossing[:, 1]]
    crossing[swap] = crossing[swap][:, ::-1]
    low, high = crossing.T
    part = ((level[low] + 0.5) * spacing - away[low]) / (away[high] - away[low])
    at = points[low] + part[:, None] * (points[high] - points[low])
    # If a level cuts a triangle, the points on its two cut edges are neighbours on the ring.
    key = np.minimum(low, high) * n + np.maximum(low, high)
    order = np.argsort(key)
    sides = np.stack([np.sort(triangles[:, pair], axis=1) @ [n, 1] for pair in ([0, 1], [1, 2], [2, 0])], axis=1)
    place = np.clip(np.searchsorted(key[order], sides), 0, len(key) - 1)
    known = key[order][place] == sides
    place = np.where(known, order[place], -1)
    cut = place[known.sum(axis=1) == 2]
    pairs = cut[cut >= 0].reshape(-1, 2)
    touching = scipy.sparse.coo_array((np.ones(len(pairs)), pairs.T), shape=(len(key),) * 2)
    count, ring = connected_components(touching, directed=False)
    first = np.zeros(count, int)
    first[ring] = np.arange(len(ring))
    return _Rings(at, ring, _goes_around(at, ring, pairs), band[low[first]], band[high[first]], band)


def _goes_around(points: np.ndarray, ring: np.ndarray, pairs: np.ndarray) -> np.ndarray:
    """Return for each of r rings whether it goes around the tube (r,).

    Args:
        points: positions (p, 3) [m] of the points of all rings.
        ring: (p,) number of the ring of each point.
        pairs: (s, 2) numbers of neighbouring points.
    """
    count = ring.max() + 1
    lengths = np.bincount(ring[pairs[:, 0]], np.linalg.norm(np.diff(points[pairs], axis=1)[:, 0], axis=1), count)
    ends = np.flatnonzero(np.bincount(pairs.ravel(), minlength=len(ring)) < 2)
    gaps = np.zeros(count)
    for a in np.unique(ring[ends]):
        own = points[ends[ring[ends] == a]]
        gaps[a] = np.linalg.norm(own[:, None] - own, axis=2).max()
    return gaps < _GAP * (lengths + gaps)


def _pieces(points: np.ndarray, r: _Rings) -> CentreLines | None:
    """Join the centres of the two rings of every band by a straight piece of a centre line.

    Where a branch ends, a piece from the centre of its last ring to the end of the surface is added. Return None if
    there is only one ring: it may be oblique, so its normal is not the direction of the tube.
    """
    count = np.bincount(r.ring)
    centre = np.stack([np.bincount(r.ring, r.points[:, k]) for k in range(3)], axis=1) / count[:, None]
    r, real, open_ends = _without_open_lines(r, np.flatnonzero(count >= _LEAST))
    r, real = _without_tips(r, real, open_ends)
    if len(real) == 1:
        return None
    lines = []
    for a in real:
        for b in real[r.below[real] == r.above[a]]:
            lines.append((centre[a], centre[b], np.isin(r.ring, (a, b))))
        for own, side, others in ((r.above[a], r.above, r.below[real]), (r.below[a], r.below, r.above[real])):
            if own in others:
                continue
            beside = real[side[real] == own]
            # If other branches also meet or begin in this band, they are joined with this branch. Otherwise this branch
            # ends here.
            lines += [(centre[a], centre[b], np.isin(r.ring, (a, b))) for b in beside[beside > a]]
            if len(beside) > 1:
                continue
            last = points[r.band == own] - centre[a]
            along = _outwards(centre, r, real, a, own)
            along = along if np.sum(last @ along) >= 0 else -along  # the sign of a normal is arbitrary
            reach = (last @ along).max()
            if reach > 0:
                lines.append((centre[a], centre[a] + reach * along, r.ring == a))
    radius = [_distance(r.points[own], begin, end) for begin, end, own in lines]
    begin, end = (np.array([line[k] for line in lines]).reshape(-1, 3) for k in (0, 1))
    return CentreLines(begin, end, np.array(radius))


def _without_open_lines(r: _Rings, real: np.ndarray) -> tuple[_Rings, np.ndarray, np.ndarray]:
    """Remove the level lines that do not go around the tube. The bands on both sides of a removed line become one band.
    Return also the numbers of these bands."""
    import scipy.sparse
    from scipy.sparse.csgraph import connected_components

    lines, bands = real[~r.closed[real]], int(r.band.max()) + 1
    sides = (r.below[lines], r.above[lines])
    graph = scipy.sparse.coo_array((np.ones(len(lines)), sides), shape=(bands, bands))
    of = connected_components(graph, directed=False)[1]
    merged = r._replace(band=of[r.band], below=of[r.below], above=of[r.above])
    return merged, real[r.closed[real]], np.unique(merged.below[lines])


def _without_tips(r: _Rings, real: np.ndarray, open_ends: np.ndarray) -> tuple[_Rings, np.ndarray]:
    """Remove the last ring of each branch, since this ring may lie around a corner of the flat end of the tube.

    The bands on both sides of a removed ring become one band. Next to a band of `open_ends` no ring is removed: at an
    open end, level lines around the corners do not go around the tube, so `_without_open_lines` has already removed
    them.
    """
    keep, band, below, above = set(real.tolist()), r.band.copy(), r.below.copy(), r.above.copy()
    sides = np.concatenate([below[real], above[real]])
    for a in real:
        for tip, inner in ((below[a], above[a]), (above[a], below[a])):
            if tip not in open_ends and np.sum(sides == tip) == 1 and np.sum(sides == inner) == 2:
                keep.discard(int(a))
                band[band == tip] = inner
    return r._replace(band=band), np.array(sorted(keep), int)


def _outwards(centre: np.ndarray, r: _Rings, real: np.ndarray, a: int, own: int) -> np.ndarray:
    """Return the unit direction (3,) from ring a, the last ring of a branch, to the end of the surface.

    The direction is that from the previous ring to ring a. If there is no previous ring, it is the normal of ring a.
    """
    inner = r.below[a] if own == r.above[a] else r.above[a]
    before = [b for b in real if b != a and inner in (r.below[b], r.above[b])]
    if before:
        along = centre[a] - centre[before[0]]
    else:
        ring = r.points[r.ring == a] - centre[a]
        along = np.linalg.svd(ring)[2][2]
    return along / np.linalg.norm(along)


def _distance(points: np.ndarray, begin: np.ndarray, end: np.ndarray) -> float:
    """Return the mean distance [m] of n points (n, 3) from the straight line through two points (3,)."""
    along = (end - begin) / np.linalg.norm(end - begin)
    away = points - begin
    return float(np.mean(np.linalg.norm(away - np.outer(away @ along, along), axis=1)))
