"""Nested dissection of a mesh (George 1973, SIAM J. Numer. Anal. 10, 345): an order to eliminate groups of nodes.

The elements are divided into two parts, and each part is divided again in the same way. The nodes that both parts share
are eliminated after the other nodes. Their elimination needs work that grows with the cube of the number of shared
nodes. Planes normal to nine directions are tried, and the plane with the least estimated work is used. In a mesh
without layers, the elements on the two sides of a plane share many nodes. In such a mesh it is better to use the
smallest set of nodes that separates both sides. This set is the minimum cut of a graph (Ford and Fulkerson 1956, Can.
J. Math. 8, 399).
"""

from typing import Any, NamedTuple

import numpy as np

#: LEAF: a part with at most this number of nodes is not divided. MANY: in a part with more nodes than this, diagonal
#: planes and minimum cuts are also tried.
LEAF, MANY = 40, 400
#: LEAST: minimum fraction of the elements on each side of a plane. BESIDE: fraction of the elements of a part, on each
#: side of the plane, through which a minimum cut may pass. These are the elements next to the plane.
LEAST, BESIDE = 0.25, 0.07
#: A minimum cut is used if its estimated work is below this fraction of the estimated work of the plane. Planes are
#: preferred because they leave parts with straighter boundaries.
BETTER = 0.9
#: Normal vectors of the planes.
DIRECTIONS = np.array(
    [[1, 0, 0], [0, 1, 0], [0, 0, 1], [1, 1, 0], [1, -1, 0], [1, 0, 1], [1, 0, -1], [0, 1, 1], [0, 1, -1]]
)


class _Part(NamedTuple):
    """A part with n elements, the k nodes that are eliminated inside it, and its m nodes that are eliminated later."""

    elements: np.ndarray  # (n,) element numbers
    nodes: np.ndarray  # (k,) nodes that are eliminated inside the part, in ascending order
    border: np.ndarray  # (m,) nodes that are eliminated later


class _Cut(NamedTuple):
    """A division of n elements into two sides: in `order`, the first `first` elements are on one side."""

    work: float
    order: np.ndarray  # (n,)
    first: int

    def sides(self) -> tuple[np.ndarray, np.ndarray]:
        return self.order[: self.first], self.order[self.first :]


def work(own: Any, border: Any) -> Any:
    """Return the number of multiplications to eliminate `own` unknowns, coupled with `border` other unknowns."""
    return own * (own * own / 3 + own * border + border * border)  # the operator ** would be slower


def dissected(elements: np.ndarray, points: np.ndarray) -> list[tuple[np.ndarray, list[int]]]:
    """Return groups of nodes in the order of elimination, each with the indices of its child groups.

    The child groups of a group are eliminated first, so they come before it in the list.

    Args:
        elements: node numbers (n, E), n for each element; an element with fewer nodes repeats one of its nodes.
        points: positions (V, 3).
    """
    centres, taken = points[elements].mean(axis=0), np.zeros(len(points), bool)
    groups: list[tuple[np.ndarray, list[int]]] = []

    def parted(part: _Part) -> int:
        children: list[int] = []
        nodes = part.nodes
        if len(nodes) > LEAF and len(part.elements) > 1:
            sides = _best_cut(elements, centres, part, len(points)).sides()
            within = [np.unique(elements[:, side]) for side in sides]
            later = [np.intersect1d(own, part.border, assume_unique=True) for own in within]
            within = [own[~taken[own]] for own in within]
            nodes = np.intersect1d(within[0], within[1], assume_unique=True)
            taken[nodes] = True
            for side, own, border in zip(sides, within, later, strict=True):
                rest = own[~taken[own]]
                if len(rest):
                    children.append(parted(_Part(side, rest, np.concatenate([border, nodes]))))
        taken[nodes] = True
        groups.append((_neighbours_together(nodes, points), children))
        return len(groups) - 1

    parted(_Part(np.arange(elements.shape[1]), np.unique(elements), np.empty(0, int)))
    return groups


def _best_cut(elements: np.ndarray, centres: np.ndarray, part: _Part, V: int) -> _Cut:
    """Return the plane, or the minimum cut near this plane, with the least estimated work."""
    n, span = len(part.elements), (np.empty(V, int), np.empty(V, int))
    least, most = max(1, int(LEAST * n)), min(n - 1, int(np.ceil((1 - LEAST) * n)))
    best = _Cut(np.inf, part.elements, 1)
    many = len(part.nodes) > MANY
    for direction in DIRECTIONS if many else DIRECTIONS[:3]:
        order = part.elements[np.argsort(centres[part.elements] @ direction, kind="stable")]
        found = _work_of_cuts(elements[:, order], part, span, slice(least - 1, most))
        k = int(np.argmin(found))
        if found[k] < best.work:
            best = _Cut(found[k], order, least + k)
    if not many:
        return best
    low, high = max(1, best.first - int(BESIDE * n)), min(n - 1, best.first + int(BESIDE * n))
    before, near, after = np.split(best.order, [low, high])
    plane = best
    _first_and_last(elements[:, plane.order], span)
    for own in _smallest_cuts(elements[:, near], part.nodes, span, (low, high)):
        order, first = np.concatenate([before, near[own], near[~own], after]), low + int(own.sum())
        found = _work_of_cuts(elements[:, order], part, span, slice(first - 1, first))[0]
        if found < min(BETTER * plane.work, best.work):
            best = _Cut(found, order, first)
    return best


def _first_and_last(nodes: np.ndarray, span: tuple[np.ndarray, np.ndarray]) -> None:
    """Write the first and the last element of each node into `span`.

    `nodes` (n, E): the n nodes of each of E elements, in the order of the elements.
    """
    number = np.repeat(np.arange(nodes.shape[1]), len(nodes))
    every = nodes.T.ravel()
    span[0][every[::-1]] = number[::-1]
    span[1][every] = number


def _work_of_cuts(nodes: np.ndarray, part: _Part, span: tuple[np.ndarray, np.ndarray], at: slice) -> np.ndarray:
    """Estimate the work of the elimination for each of several possible cuts. A cut divides E ordered elements after
    one of the elements `at`.

    `nodes` (n, E) are the n nodes of each element. The estimate is the work for the nodes that both sides share, plus
    twice the work of the next cut on each side. The next cut of a side with n nodes is assumed to contain n^(2/3)
    nodes, as in a cube.
    """
    n, m = nodes.shape[1], len(part.border)
    _first_and_last(nodes, span)
    begun, over = (np.cumsum(np.bincount(own[part.nodes], minlength=n))[at].astype(float) for own in span)
    later_begun, later_over = (np.cumsum(np.bincount(own[part.border], minlength=n))[at] for own in span)
    between = begun - over
    one = work(np.square(np.cbrt(over)), later_begun + between)
    other = work(np.square(np.cbrt(len(part.nodes) - begun)), m - later_over + between)
    return work(between, m) + 2 * (one + other)


def _smallest_cuts(
    near: np.ndarray, nodes: np.ndarray, span: tuple[np.ndarray, np.ndarray], ends: tuple[int, int]
) -> list[np.ndarray]:
    """Return two boolean arrays (h,): whether each element is on the first side of the first minimum cut, and of the
    last minimum cut.

    Args:
        near: nodes (n, h) of the h elements from low to high - 1, in the order of the elements; n nodes each.
        nodes: (k,) nodes, in ascending order, through which a cut may pass. Other nodes do not connect the two sides.
        span: first and last element of each node in this order.
        ends: low and high. Elements before low are on the first side, and elements from high on are on the second side.
    """
    import scipy.sparse
    from scipy.sparse.csgraph import breadth_first_order, maximum_flow

    (low, high), h = ends, near.shape[1]
    own = nodes[(span[0][nodes] < high) & (span[1][nodes] >= low)]
    k = len(own)
    if not k or not h:
        return []
    at = np.minimum(np.searchsorted(own, near), k - 1)
    known = own[at] == near
    into, element = at[known], 2 * k + np.broadcast_to(np.arange(h), near.shape)[known]
    first, last = np.flatnonzero(span[0][own] < low), np.flatnonzero(span[1][own] >= high)
    source, sink, inside = 2 * k + h, 2 * k + h + 1, np.arange(k)
    # In the graph, a path enters mesh node i at vertex i and leaves it at vertex i + k. The edge between both vertices
    # has the capacity 1. All other edges have a larger capacity, so a minimum cut does not pass through them.
    lines = np.concatenate([inside, k + into, element, np.full(len(first), source), k + last])
    columns = np.concatenate([k + inside, element, into, first, np.full(len(last), sink)])
    wide = np.where(np.arange(len(lines)) < k, 1, k + 1).astype(np.int32)
    graph = scipy.sparse.csr_matrix((wide, (lines, columns)), shape=(sink + 1, sink + 1))
    left = graph - maximum_flow(graph, source, sink).flow
    left.eliminate_zeros()
    from_source = np.isin(np.arange(h) + 2 * k, breadth_first_order(left, source, return_predecessors=False))
    to_sink = np.isin(np.arange(h) + 2 * k, breadth_first_order(left.T.tocsr(), sink, return_predecessors=False))
    return [from_source, ~to_sink]


def _neighbours_together(nodes: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Sort the nodes so that nodes which are close to each other in space follow each other in the list."""
    if len(nodes) <= 8:
        return nodes
    side = points[nodes, np.argmax(np.ptp(points[nodes], axis=0))]
    order = np.argsort(side, kind="stable")
    halves = nodes[order[: len(nodes) // 2]], nodes[order[len(nodes) // 2 :]]
    return np.concatenate([_neighbours_together(half, points) for half in halves])
