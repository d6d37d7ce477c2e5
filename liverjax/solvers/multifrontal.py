"""Factorisation of sparse symmetric matrices of a mesh, on the host, by dense matrices: real or complex symmetric.

Nested dissection (George 1973, SIAM J. Numer. Anal. 10, 345): the elements are halved across their longest side again
and again, and the nodes between two halves come after both. Each group of nodes is eliminated in a dense matrix of
itself and its border (Duff and Reid 1983, ACM TOMS 9, 302), so nearly all work is LAPACK's, on all cores. Pivots are
chosen within a group. Large matrices are factorised in single precision and solved with refinement: half the time and
memory, and the same digits. Where that does not converge, double precision follows.
"""

from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

if TYPE_CHECKING:
    import scipy.sparse

#: Nodes of a group that is not halved any more; unknowns from which on single precision pays.
LEAF, SINGLE_FROM = 40, 20_000
#: Steps of refinement, and the part of the terms of an equation that may be out of balance.
STEPS, ENOUGH, WRONG = 12, 4e-16, 1e-11


class Front(NamedTuple):
    """A group of unknowns, and the later unknowns that are coupled with it."""

    own: np.ndarray  # (n,)
    border: np.ndarray  # (m,)
    children: list[int]  # groups before it whose rest it takes in


class Factor(NamedTuple):
    """The result of an elimination: for every group L U of its own matrix A, and X = A^-1 B of its border."""

    matrix: "scipy.sparse.csr_array"  # scaled
    scale: np.ndarray  # (N,)
    fronts: list[Front]
    eliminated: list[tuple[np.ndarray, np.ndarray, np.ndarray]]

    @property
    def nbytes(self) -> int:
        """Memory."""
        return self.matrix.data.nbytes + sum(lu.nbytes + X.nbytes for lu, _, X in self.eliminated)


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
        groups.append((nodes, children))
        return len(groups) - 1

    halved(np.arange(elements.shape[1]), np.unique(elements))
    return groups


def fronts(A: "scipy.sparse.csr_array", groups: list[tuple[np.ndarray, list[int]]], node: np.ndarray) -> list[Front]:
    """The groups as unknowns of A (N, N); `node` (N,) is the node of each unknown."""
    order = np.argsort(node, kind="stable")
    ends = np.searchsorted(
        node[order], np.arange(max(node.max(initial=0), max(g.max(initial=0) for g, _ in groups)) + 2)
    )
    when = np.empty(len(node), int)
    found: list[Front] = []
    for k, (nodes, _) in enumerate(groups):
        for v in nodes:
            when[order[ends[v] : ends[v + 1]]] = k
    for k, (nodes, children) in enumerate(groups):
        own = np.concatenate([order[ends[v] : ends[v + 1]] for v in nodes] or [np.zeros(0, int)])
        near = [A.indices[A.indptr[i] : A.indptr[i + 1]] for i in own] + [found[c].border for c in children]
        border = np.unique(np.concatenate(near)) if near else np.zeros(0, int)
        border = border[when[border] > k]
        found.append(Front(own, border[np.argsort(when[border], kind="stable")], children))
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
    place, eliminated = np.full(A.shape[0], -1), []
    rests: dict[int, np.ndarray] = {}
    for k, front in enumerate(plan):
        n = len(front.own)
        F = _matrix_of_group(A, front, place, kind)
        for c in front.children:
            rest = rests.pop(c)
            at = place[plan[c].border]
            F[np.ix_(at, at)] += rest
        place[front.own] = place[front.border] = -1
        lu, pivots, X, rest = _without(F, n)
        eliminated.append((lu, pivots, X))
        if len(front.border):
            rests[k] = rest
    return Factor(A, scale, plan, eliminated)


def _scale(A: Any) -> np.ndarray:
    """Scales (N,) that make the largest entry of every line nearly 1, on both sides alike (Ruiz 2001)."""
    import scipy.sparse

    size, scale = abs(A), np.ones(A.shape[0])
    for _ in range(3):
        D = scipy.sparse.diags_array(scale)
        largest = (D @ size @ D).max(axis=1).toarray().ravel()
        scale = scale / np.sqrt(np.where(largest > 0, largest, 1.0))
    return scale


def _matrix_of_group(A: Any, front: Front, place: np.ndarray, kind: np.dtype) -> np.ndarray:
    """The rows of A of the group itself, and their mirror image; `place` says where its unknowns and border are."""
    n, size = len(front.own), len(front.own) + len(front.border)
    place[front.own], place[front.border] = np.arange(n), np.arange(n, size)
    F = np.zeros((size, size), kind, order="F")
    rows = A[front.own].tocoo()
    column = place[rows.col]
    here = column >= 0
    F[rows.row[here], column[here]] = rows.data[here]
    F[n:, :n] = F[:n, n:].T
    return F


def _without(F: np.ndarray, n: int) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """L U and pivots of A, X = A^-1 B and D - B^T X of the matrix F = [[A, B], [B^T, D]] with A (n, n)."""
    from scipy.linalg import get_lapack_funcs

    factor, solve = get_lapack_funcs(("getrf", "getrs"), (F,))
    lu, pivots, info = factor(F[:n, :n])
    if info != 0:
        raise np.linalg.LinAlgError("singular")
    B, rest = F[:n, n:], F[n:, n:]
    X = solve(lu, pivots, B)[0] if B.shape[1] else B
    m = B.shape[1]
    step = max(256, -(-m // 4))
    for j in range(0, m, step):  # what is left is symmetric: the blocks below the diagonal are enough
        end = min(j + step, m)
        rest[j:, j:end] -= B[:, j:].T @ X[:, j:end]
        rest[j:end, end:] = rest[end:, j:end].T
    return lu, pivots, X, rest.copy()


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

    y = b.astype(factor.eliminated[0][0].dtype)
    (solve,) = get_lapack_funcs(("getrs",), (factor.eliminated[0][0],))
    both = list(zip(factor.fronts, factor.eliminated, strict=True))
    for front, (lu, pivots, X) in both:
        own = y[front.own]
        y[front.border] -= own @ X
        if len(own):
            y[front.own] = solve(lu, pivots, own)[0]
    for front, (_, _, X) in reversed(both):
        y[front.own] -= X @ y[front.border]
    return y
