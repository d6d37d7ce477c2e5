"""Factorisation of sparse symmetric matrices of a mesh, on the host, by dense matrices: real or complex symmetric.

Nested dissection (George 1973, SIAM J. Numer. Anal. 10, 345): the elements are halved across their longest side again
and again, and the nodes between two halves come after both. Each group of nodes is eliminated in a dense matrix of
itself and its border (Duff and Reid 1983, ACM TOMS 9, 302), `PIVOTS` unknowns at a time, so that nearly all work is
products of matrices, on all cores. By symmetry the lower triangles are enough. Pivots are chosen within the unknowns
that are eliminated together. Large matrices are factorised in single precision and solved with refinement: half the
time and memory, and the same digits. Where that does not converge, double precision follows.
"""

import itertools
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

if TYPE_CHECKING:
    import scipy.sparse

#: Nodes of a group that is not halved any more; unknowns from which on single precision pays.
LEAF, SINGLE_FROM = 40, 20_000
#: Unknowns of a group that are eliminated together, and the side of the tiles of what they change.
PIVOTS, TILE = 512, 512
#: Steps of refinement, and the part of the terms of an equation that may be out of balance.
STEPS, ENOUGH, WRONG = 12, 4e-16, 1e-11


class Front(NamedTuple):
    """A group of unknowns, and the later unknowns that are coupled with it."""

    own: np.ndarray  # (n,)
    border: np.ndarray  # (m,)
    children: list[int]  # groups before it whose rest it takes in


class Eliminated(NamedTuple):
    """Unknowns that were eliminated together: L U of their own matrix A, and X = A^-1 B of those that come after."""

    own: np.ndarray  # (n,)
    after: np.ndarray  # (m,)
    lu: np.ndarray  # (n, n)
    pivots: np.ndarray  # (n,)
    X: np.ndarray  # (n, m)


class Factor(NamedTuple):
    """The result of an elimination."""

    matrix: "scipy.sparse.csr_array"  # scaled
    scale: np.ndarray  # (N,)
    steps: list[Eliminated]

    @property
    def nbytes(self) -> int:
        """Memory."""
        return self.matrix.data.nbytes + sum(step.lu.nbytes + step.X.nbytes for step in self.steps)


def dissected(elements: np.ndarray, points: np.ndarray) -> list[tuple[np.ndarray, list[int]]]:
    """Groups of nodes with the numbers of their children; a group stands after its children.

    Args:
        elements: nodes (n, E) of every element; one that has fewer repeats one of them.
        points: positions (V, 3).
    """
    centres, taken = points[elements].mean(axis=0), np.zeros(len(points), bool)
    groups: list[tuple[np.ndarray, list[int]]] = []

    def halved(part: np.ndarray, nodes: np.ndarray) -> int:
        children: list[int] = []
        if len(nodes) > LEAF and len(part) > 1:
            side = centres[part, np.argmax(np.ptp(centres[part], axis=0))]
            order = np.argpartition(side, len(part) // 2)
            halves = [part[order[: len(part) // 2]], part[order[len(part) // 2 :]]]
            within = [np.unique(elements[:, half]) for half in halves]
            within = [own[~taken[own]] for own in within]
            between = np.intersect1d(within[0], within[1], assume_unique=True)
            taken[between] = True
            for half, own in zip(halves, within, strict=True):
                rest = own[~taken[own]]
                if len(rest):
                    children.append(halved(half, rest))
            nodes = between
        taken[nodes] = True
        groups.append((_neighbours_together(nodes, points), children))
        return len(groups) - 1

    halved(np.arange(elements.shape[1]), np.unique(elements))
    return groups


def _neighbours_together(nodes: np.ndarray, points: np.ndarray) -> np.ndarray:
    """The nodes in an order in which those of a part of space follow each other."""
    if len(nodes) <= 8:
        return nodes
    side = points[nodes, np.argmax(np.ptp(points[nodes], axis=0))]
    order = np.argsort(side, kind="stable")
    halves = nodes[order[: len(nodes) // 2]], nodes[order[len(nodes) // 2 :]]
    return np.concatenate([_neighbours_together(half, points) for half in halves])


def fronts(A: "scipy.sparse.csr_array", groups: list[tuple[np.ndarray, list[int]]], node: np.ndarray) -> list[Front]:
    """The groups as unknowns of A (N, N); `node` (N,) is the node of each unknown."""
    order = np.argsort(node, kind="stable")
    ends = np.searchsorted(
        node[order], np.arange(max(node.max(initial=0), max(g.max(initial=0) for g, _ in groups)) + 2)
    )
    none = np.zeros(0, int)
    found: list[Front] = []
    each = [np.concatenate([order[ends[v] : ends[v + 1]] for v in nodes] or [none]) for nodes, _ in groups]
    when = np.empty(len(node), int)
    order_of = np.concatenate(each)
    when[order_of] = np.arange(len(node))
    done = 0
    for own, (_, children) in zip(each, groups, strict=True):
        done += len(own)
        near = [A.indices[A.indptr[i] : A.indptr[i + 1]] for i in own] + [found[c].border for c in children]
        later = np.unique(when[np.concatenate([none, *near])])
        found.append(Front(own, order_of[later[later >= done]], children))
    return found


def factorised(A: "scipy.sparse.csr_array", plan: list[Front], single: bool) -> Factor:
    """Eliminate group after group.

    Raises:
        numpy.linalg.LinAlgError: values that are not finite, or a group whose own matrix has no inverse.
    """
    import scipy.sparse

    scale = _scale(A)
    D = scipy.sparse.diags_array(scale)
    A = (D @ A @ D).tocsr()
    if not np.all(np.isfinite(A.data)):
        raise np.linalg.LinAlgError("not finite")
    kind = np.result_type(A.dtype, np.float32)
    if single:
        kind = np.dtype(np.complex64 if kind.kind == "c" else np.float32)
    place, steps = np.full(A.shape[0], -1), []
    rests: dict[int, np.ndarray] = {}
    memory = np.empty(max((len(front.own) + len(front.border)) ** 2 for front in plan), kind)
    for k, front in enumerate(plan):
        F, n = _matrix_of_group(A, front, place, memory), len(front.own)
        for c in front.children:
            if c in rests:  # a part of the body that nothing couples with the others has left nothing
                _add(F, place[plan[c].border], rests.pop(c))
        place[front.own] = place[front.border] = -1
        steps += _eliminated(F, front)
        if len(front.border):
            rests[k] = F[n:, n:].copy(order="F")
    return Factor(A, scale, steps)


def _scale(A: Any) -> np.ndarray:
    """Scales (N,) that make the largest entry of every line nearly 1, on both sides alike (Ruiz 2001)."""
    import scipy.sparse

    size, scale = abs(A), np.ones(A.shape[0])
    for _ in range(3):
        D = scipy.sparse.diags_array(scale)
        largest = (D @ size @ D).max(axis=1).toarray().ravel()
        scale = scale / np.sqrt(np.where(largest > 0, largest, 1.0))
    return scale


def _matrix_of_group(A: Any, front: Front, place: np.ndarray, memory: np.ndarray) -> np.ndarray:
    """The columns of A of the group itself, on and below the diagonal; `place` says where its unknowns and border
    are."""
    n, size = len(front.own), len(front.own) + len(front.border)
    place[front.own], place[front.border] = np.arange(n), np.arange(n, size)
    F = memory[: size * size].reshape((size, size), order="F")
    F[...] = 0
    mirrored = A[front.own].tocoo()
    row = place[mirrored.col]
    below = row >= mirrored.row
    F[row[below], mirrored.row[below]] = mirrored.data[below]
    return F


def _add(F: np.ndarray, at: np.ndarray, rest: np.ndarray) -> None:
    """Add a lower triangle to F at rising places `at`, of which many follow each other."""
    ends = [0, *(np.flatnonzero(np.diff(at) != 1) + 1), len(at)]
    runs = [(a, b, at[a]) for a, b in itertools.pairwise(ends) if a < b]
    for k, (a, b, column) in enumerate(runs):
        for c, d, row in runs[k:]:
            F[row : row + d - c, column : column + b - a] += rest[c:d, a:b]


def _eliminated(F: np.ndarray, front: Front) -> list[Eliminated]:
    """Eliminate a group in its matrix F (n + m, n + m), whose lower triangle becomes that of what is left."""
    from scipy.linalg import get_lapack_funcs

    factor, solve = get_lapack_funcs(("getrf", "getrs"), (F,))
    n, every, found = len(front.own), np.concatenate([front.own, front.border]), []
    for a in range(0, n, PIVOTS):
        b = min(a + PIVOTS, n)
        A = np.tril(F[a:b, a:b])
        lu, pivots, info = factor(A + np.tril(A, -1).T)
        if info != 0:
            raise np.linalg.LinAlgError("singular")
        B = F[b:, a:b].T
        X = solve(lu, pivots, B)[0] if B.shape[1] else B.copy()
        found.append(Eliminated(every[a:b], every[b:], lu, pivots, X))
        _take_off(F[b:, b:], B, X)
    return found


def _take_off(rest: np.ndarray, B: np.ndarray, X: np.ndarray) -> None:
    """Take B^T X, which is symmetric, off the lower triangle of `rest` (m, m), tile by tile."""
    for j in range(0, len(rest), TILE):
        for i in range(j, len(rest), TILE):
            rest[i : i + TILE, j : j + TILE] -= B[:, i : i + TILE].T @ X[:, j : j + TILE]


def refined_solution(factor: Factor, b: np.ndarray) -> tuple[np.ndarray, float]:
    """The refined solution x (N,) of A x = b, and its backward error: the residual of a line over the size of its
    terms."""
    A, scale = factor.matrix, factor.scale
    b, x = scale * b, np.zeros(len(b), A.dtype)
    size, left, last = abs(A), b, np.inf
    for _ in range(STEPS):
        new = x + _once(factor, left)
        out = b - A @ new
        error = _backward_error(size, new, b, out)
        if not error < last:
            break
        x, left, last = new, out, error
        if error < ENOUGH:
            break
    return scale * x, last


def _backward_error(size: Any, x: np.ndarray, b: np.ndarray, out: np.ndarray) -> float:
    """Backward error of the whole system: |b - A x| over |A| |x| + |b|."""
    terms = np.linalg.norm(size @ abs(x)) + np.linalg.norm(b)
    return float(np.linalg.norm(out) / terms) if terms > 0 else 0.0


def _once(factor: Factor, b: np.ndarray) -> np.ndarray:
    from scipy.linalg import get_lapack_funcs

    if not factor.steps:  # nothing is free
        return b
    y = b.astype(factor.steps[0].lu.dtype)
    (solve,) = get_lapack_funcs(("getrs",), (factor.steps[0].lu,))
    for own, after, lu, pivots, X in factor.steps:
        near = y[own]
        y[after] -= near @ X
        y[own] = solve(lu, pivots, near)[0]
    for own, after, _, _, X in reversed(factor.steps):
        y[own] -= X @ y[after]
    return y
