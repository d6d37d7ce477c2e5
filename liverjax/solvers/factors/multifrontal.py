"""Factorisation of sparse symmetric matrices of a mesh, on the host, by dense matrices: real or complex symmetric.

`liverjax.solvers.factors.dissection` gives the order. Each group of nodes is eliminated in a dense matrix of itself and
its border (Duff and Reid 1983, ACM TOMS 9, 302), `PIVOTS` unknowns at a time, so that nearly all work is products of
matrices. Groups whose children are done are eliminated in parallel, one per core. By symmetry the lower triangles are
enough. If only one piece can run, its tiles run in parallel instead. Pivots are chosen within the unknowns that are
eliminated together. Large matrices are factorised in single precision and solved with refinement: half the time and
memory, and the same digits. If the refinement does not converge, double precision follows. Factors that would not fit
in memory are kept as 16-bit integers, with a scale for each row: half the memory again, with about two more steps of
refinement.
"""

import itertools
import os
from concurrent.futures import FIRST_COMPLETED, Future, ThreadPoolExecutor, wait
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from liverjax.solvers.factors.dissection import work

if TYPE_CHECKING:
    import scipy.sparse

#: Unknowns from which on single precision pays.
SINGLE_FROM = 20_000
#: Unknowns of a group that are eliminated together, and the side of the tiles in which they change the rest.
PIVOTS, TILE = 256, 256
#: Part of all work below which groups are eliminated with their descendants, in one piece.
PIECE = 1 / 32
#: Most steps of refinement; backward error that ends it, and backward error above which a solution is wrong.
STEPS, ENOUGH, WRONG = 12, 4e-16, 1e-11


class Front(NamedTuple):
    """A group of unknowns, and the later unknowns that are coupled with it."""

    own: np.ndarray  # (n,)
    border: np.ndarray  # (m,)
    children: list[int]  # earlier groups whose remaining matrices are added to this one


class Eliminated(NamedTuple):
    """Unknowns that were eliminated together: A^-1 of their own matrix, and X = A^-1 B for the unknowns after them."""

    own: np.ndarray  # (n,)
    after: np.ndarray  # (m,)
    inverse: np.ndarray  # (n, n)
    X: np.ndarray  # (n, m), or whole numbers (n, m or 2 m)
    sizes: np.ndarray | None = None  # (n,) value of the whole number 1 in each row

    def times(self, y: np.ndarray) -> np.ndarray:
        """X y, (n,)."""
        if self.sizes is None:
            return self.X @ y
        return self.sizes * (self.X.astype(self.sizes.dtype).view(y.dtype) @ y)

    def transposed_times(self, y: np.ndarray) -> np.ndarray:
        """X^T y, (m,)."""
        if self.sizes is None:
            return y @ self.X
        return (self.sizes * y) @ self.X.astype(self.sizes.dtype).view(y.dtype)


class Factor(NamedTuple):
    """The result of an elimination."""

    matrix: "scipy.sparse.csr_array"  # scaled
    scale: np.ndarray  # (N,)
    steps: list[Eliminated]

    @property
    def nbytes(self) -> int:
        """Memory [bytes]."""
        return self.matrix.data.nbytes + sum(step.inverse.nbytes + step.X.nbytes for step in self.steps)


def fronts(
    neighbours: "scipy.sparse.csr_array", groups: list[tuple[np.ndarray, list[int]]], node: np.ndarray
) -> list[Front]:
    """The groups of nodes as groups of unknowns, with their borders.

    Args:
        neighbours: (V, V), an entry for each two nodes whose unknowns are coupled.
        groups: result of `liverjax.solvers.factors.dissection.dissected`.
        node: (N,) the node of each unknown.
    """
    order = np.argsort(node, kind="stable")
    ends = np.searchsorted(node[order], np.arange(neighbours.shape[0] + 1))
    when, nodes = np.zeros(neighbours.shape[0], int), np.concatenate([own for own, _ in groups])
    when[nodes] = np.arange(len(nodes))
    done, found = 0, []
    borders: list[np.ndarray] = []
    for own, children in groups:
        done += len(own)
        near = [neighbours.indices[neighbours.indptr[v] : neighbours.indptr[v + 1]] for v in own]
        later = np.unique(when[np.concatenate([*near, *(borders[c] for c in children)])])
        borders.append(nodes[later[later >= done]])
        found.append(Front(_unknowns(own, order, ends), _unknowns(borders[-1], order, ends), children))
    return found


def _unknowns(nodes: np.ndarray, order: np.ndarray, ends: np.ndarray) -> np.ndarray:
    """Unknowns of nodes, node by node."""
    first, number = ends[nodes], ends[nodes + 1] - ends[nodes]
    before = np.cumsum(number) - number
    return order[np.repeat(first - before, number) + np.arange(number.sum())]


def single_bytes(plan: list[Front], kind: np.dtype) -> float:
    """Memory [bytes] of a factor in single precision; `kind` says whether the matrix is real or complex."""
    own, border = (np.array([len(part) for part in parts], float) for parts in zip(*(f[:2] for f in plan), strict=True))
    together = np.minimum(own, PIVOTS)
    return float(np.sum(own * (0.5 * (own + together) + border))) * (8 if kind.kind == "c" else 4)


def factorised(A: "scipy.sparse.csr_array", plan: list[Front], single: bool, small: bool = False) -> Factor:
    """The factor of A, from the elimination of one group after the other.

    Args:
        A: (N, N).
        plan: `fronts`.
        single: in single precision.
        small: keep the factor as 16-bit integers; in single precision only.

    Raises:
        numpy.linalg.LinAlgError: values that are not finite, or a group whose own matrix has no inverse.
    """
    A, scale = _scaled(A)
    if not np.all(np.isfinite(A.data)):
        raise np.linalg.LinAlgError("not finite")
    kind = np.result_type(A.dtype, np.float32)
    if single:
        kind = np.dtype(np.complex64 if kind.kind == "c" else np.float32)
    steps = _all_pieces(_Elimination(A, plan, kind, single and small, [None] * len(plan), [[] for _ in plan]))
    return Factor(A, scale, steps)


class _Elimination(NamedTuple):
    """Data that the threads share."""

    A: Any
    plan: list[Front]
    kind: np.dtype
    small: bool
    rests: list[np.ndarray | None]  # the remaining matrix that each group leaves to its parent
    steps: list[list[Eliminated]]  # results of each group

    def piece(self, groups: list[int], cores: int) -> None:
        """Eliminate `groups` one after the other, with the tiles of each group on `cores` cores."""
        place = np.full(self.A.shape[0], -1)
        size = max(len(front.own) + len(front.border) for front in (self.plan[k] for k in groups))
        memory, scratch = np.empty(size**2, self.kind), np.empty((cores, min(size, TILE) ** 2), self.kind)
        for k in groups:
            front = self.plan[k]
            F, n = _matrix_of_group(self.A, front, place, memory), len(front.own)
            for c in front.children:
                rest = self.rests[c]
                if rest is not None:  # None: a part of the body that is not coupled with the others
                    _add(F, place[self.plan[c].border], rest)
                    self.rests[c] = None
            place[front.own] = place[front.border] = -1
            steps = _eliminated(F, front, scratch)
            self.steps[k] = [_in_whole_numbers(step) for step in steps] if self.small else steps
            if len(front.border):
                self.rests[k] = _lower_triangle(F[n:, n:])


def _all_pieces(own: _Elimination) -> list[Eliminated]:
    """Eliminate all pieces, as many at a time as there are cores. The sums do not depend on which ends first."""
    pieces, waits_for = _work_in_pieces(own.plan)
    running: dict[Future, int] = {}
    with ThreadPoolExecutor(_cores()) as pool:
        ready = [k for k, missing in enumerate(waits_for) if not missing]
        while ready or running:
            cores = _cores() if len(ready) == 1 and not running else 1
            running |= {pool.submit(own.piece, pieces[k], cores): k for k in ready}
            over = wait(running, return_when=FIRST_COMPLETED).done
            ended = {running.pop(future) for future in over}
            for future in over:
                future.result()
            ready = [k for k, missing in enumerate(waits_for) if missing & ended and not missing - ended]
            for missing in waits_for:
                missing -= ended
    return [step for steps in own.steps for step in steps]


def _cores() -> int:
    """Cores that the process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def _work_in_pieces(plan: list[Front]) -> tuple[list[list[int]], list[set[int]]]:
    """Groups that are eliminated in one piece, and the pieces that each piece waits for."""
    n, m = (
        np.array([len(part) for part in parts], float) for parts in zip(*(front[:2] for front in plan), strict=True)
    )
    below = work(n, m)
    least = PIECE * below.sum()
    for k, front in enumerate(plan):
        below[k] += below[front.children].sum()
    small, piece_of = below < least, np.full(len(plan), -1)
    pieces: list[list[int]] = []
    for k in range(len(plan) - 1, -1, -1):  # parents first
        if piece_of[k] < 0:
            piece_of[k] = len(pieces)
            pieces.append([])
        pieces[piece_of[k]].insert(0, k)
        if small[k]:
            piece_of[plan[k].children] = piece_of[k]
    children = [{int(piece_of[c]) for k in piece for c in plan[k].children} - {q} for q, piece in enumerate(pieces)]
    return pieces, children


def _scaled(A: Any) -> tuple[Any, np.ndarray]:
    """The matrix with scales (N,) on both sides that make the largest entry of every row nearly 1, and these scales
    (Ruiz 2001).
    """
    import scipy.sparse

    A = A.tocsr()
    size, scale, row = abs(A.data), np.ones(A.shape[0]), np.repeat(np.arange(A.shape[0]), np.diff(A.indptr))
    known = np.flatnonzero(np.diff(A.indptr))
    for _ in range(3):
        largest = np.zeros(len(scale))
        if len(known):
            largest[known] = scale[known] * np.maximum.reduceat(size * scale[A.indices], A.indptr[known])
        scale = scale / np.sqrt(np.where(largest > 0, largest, 1.0))
    data = A.data * (scale[row] * scale[A.indices])
    return scipy.sparse.csr_array((data, A.indices, A.indptr), shape=A.shape), scale


def _matrix_of_group(A: Any, front: Front, place: np.ndarray, memory: np.ndarray) -> np.ndarray:
    """The group's own columns of A, on and below the diagonal; `place` gets its unknowns' and border's places."""
    n, size = len(front.own), len(front.own) + len(front.border)
    place[front.own], place[front.border] = np.arange(n), np.arange(n, size)
    F = memory[: size * size].reshape((size, size), order="F")
    F[...] = 0
    mirrored = A[front.own].tocoo()
    row = place[mirrored.col]
    below = row >= mirrored.row
    F[row[below], mirrored.row[below]] = mirrored.data[below]
    return F


def _lower_triangle(F: np.ndarray) -> np.ndarray:
    """A copy of the lower triangle with whole tiles on the diagonal: half of the memory is never touched."""
    out = np.zeros(F.shape, F.dtype, order="F")
    for a in range(0, len(F), TILE):
        out[a:, a : a + TILE] = F[a:, a : a + TILE]
    return out


def _add(F: np.ndarray, at: np.ndarray, rest: np.ndarray) -> None:
    """Add a lower triangle to F at rising places `at`, one run of consecutive places after the other."""
    ends = [0, *(np.flatnonzero(np.diff(at) != 1) + 1), len(at)]
    runs = [(a, b, at[a]) for a, b in itertools.pairwise(ends) if a < b]
    for k, (a, b, column) in enumerate(runs):
        for c, d, row in runs[k:]:
            F[row : row + d - c, column : column + b - a] += rest[c:d, a:b]


def _eliminated(F: np.ndarray, front: Front, scratch: np.ndarray) -> list[Eliminated]:
    """Eliminate a group in its matrix F (n + m, n + m); the last m rows become the remaining lower triangle."""
    n, every, found = len(front.own), np.concatenate([front.own, front.border]), []
    for a in range(0, n, PIVOTS):
        b = min(a + PIVOTS, n)
        A = np.tril(F[a:b, a:b])
        inverse = _inverted(A + np.tril(A, -1).T)
        B = F[b:, a:b].T
        X = _taken_off(F[b:, b:], B, inverse, scratch)
        found.append(Eliminated(every[a:b], every[b:], inverse, X))
    return found


def _in_whole_numbers(step: Eliminated) -> Eliminated:
    """The step with X as 16-bit integers."""
    parts = np.ascontiguousarray(step.X).view(step.X.real.dtype)
    sizes = np.abs(parts).max(axis=1, initial=0.0) / np.iinfo(np.int16).max
    sizes = np.where(sizes > 0, sizes, 1.0).astype(parts.dtype)
    return step._replace(X=np.rint(parts / sizes[:, None]).astype(np.int16), sizes=sizes)


def _inverted(A: np.ndarray) -> np.ndarray:
    """The inverse of a matrix that is not empty."""
    from scipy.linalg import get_lapack_funcs

    factor, invert = get_lapack_funcs(("getrf", "getri"), (A,))
    lu, pivots, info = factor(A)
    inverse, wrong = invert(lu, pivots, overwrite_lu=True)
    if info or wrong:
        raise np.linalg.LinAlgError("singular")
    return inverse


def _taken_off(rest: np.ndarray, B: np.ndarray, inverse: np.ndarray, scratch: np.ndarray) -> np.ndarray:
    """Subtract the symmetric B^T A^-1 B from the lower triangle of `rest` (m, m), tile by tile; return A^-1 B.

    It runs on as many cores as `scratch` has rows; each row is memory for one tile.
    """
    X, starts = np.empty(B.shape, B.dtype), range(0, len(rest), TILE)

    def columns(own: range, memory: np.ndarray) -> None:
        for j in own:
            X[:, j : j + TILE] = inverse @ B[:, j : j + TILE]
            for i in range(j, len(rest), TILE):
                tile = rest[i : i + TILE, j : j + TILE]
                product = memory[: tile.size].reshape(tile.shape, order="F")
                np.matmul(B[:, i : i + TILE].T, X[:, j : j + TILE], out=product)
                tile -= product

    if len(scratch) == 1 or len(starts) < 4:
        columns(starts, scratch[0])
    else:
        # Later columns have fewer tiles: dealt out in turn, each core gets about the same work.
        with ThreadPoolExecutor(len(scratch)) as pool:
            list(pool.map(columns, [starts[k :: len(scratch)] for k in range(len(scratch))], scratch))
    return X


def refined_solution(factor: Factor, b: np.ndarray) -> tuple[np.ndarray, float]:
    """The refined solution x (N,) of A x = b, and its backward error: the residual over the size of its terms."""
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
    if not factor.steps:  # nothing is free
        return b
    y = b.astype(factor.steps[0].inverse.dtype)
    for step in factor.steps:
        near = y[step.own]
        y[step.after] -= step.transposed_times(near)
        y[step.own] = step.inverse @ near
    for step in reversed(factor.steps):
        y[step.own] -= step.times(y[step.after])
    return y
