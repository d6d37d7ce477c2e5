"""Multifrontal factorisation of real or complex symmetric sparse matrices of a mesh, on the CPU.

`liverjax.solvers.factors.dissection` gives the order of elimination. Each group of nodes is eliminated in a dense
matrix of the group and its border: the later unknowns that are coupled with the group (Duff and Reid 1983, ACM TOMS 9,
302). `PIVOTS` unknowns are eliminated at a time, so that nearly all work is in matrix products. The matrices are
symmetric, so only the lower triangles are computed. Groups are eliminated in parallel, one per core, as soon as their
child groups are eliminated. While cores are idle, the matrix products of a group are divided into parts (tiles) that
run in parallel on these cores. Pivots are chosen only among unknowns that are eliminated together.

Large matrices are factorised in single precision, and solutions are refined iteratively. This needs half the time and
memory, and the solution has the same accuracy as in double precision. If the refinement does not converge, double
precision is used. Factors that would not fit in memory are stored as 16-bit integers, with a scale factor for each row.
This halves the memory again, and needs about two more refinement steps.
"""

import itertools
import os
from collections.abc import Callable
from concurrent.futures import FIRST_COMPLETED, Future, ThreadPoolExecutor, wait
from functools import partial
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from liverjax.solvers.factors.dissection import work

if TYPE_CHECKING:
    import scipy.sparse

#: Single precision saves time if the number of unknowns is at least this number.
SINGLE_FROM = 20_000
#: PIVOTS: number of unknowns of a group that are eliminated together. TILE: number of columns of a tile.
PIVOTS, TILE = 128, 192
#: If the work for a group and its descendants is less than this fraction of all work, these groups are one piece
#: (task): they are eliminated one after the other.
PIECE = 1 / 32
#: STEPS: maximum number of refinement steps. ENOUGH: the refinement ends below this backward error. WRONG: a solution
#: with a larger backward error is wrong.
STEPS, ENOUGH, WRONG = 12, 4e-16, 1e-11


class Front(NamedTuple):
    """A group of n unknowns, and the m later unknowns that are coupled with it."""

    own: np.ndarray  # (n,) unknowns of the group
    border: np.ndarray  # (m,) later unknowns
    children: list[int]  # indices of the earlier groups whose Schur complements are added to this group


class Eliminated(NamedTuple):
    """Result for n unknowns that were eliminated together: A is the matrix of these n unknowns. B couples them with m
    later unknowns."""

    own: np.ndarray  # (n,) eliminated unknowns
    after: np.ndarray  # (m,) later unknowns
    inverse: np.ndarray  # (n, n) A^-1
    X: np.ndarray  # (n, m) A^-1 B; as 16-bit integers (n, m), or (n, 2 m) if complex
    sizes: np.ndarray | None = None  # (n,) scale factor of each row of X; None: X is not stored as integers

    def times(self, y: np.ndarray) -> np.ndarray:
        """Return the product X y (n,)."""
        if self.sizes is None:
            return self.X @ y
        return self.sizes * (self.X.astype(self.sizes.dtype).view(y.dtype) @ y)

    def transposed_times(self, y: np.ndarray) -> np.ndarray:
        """Return the product X^T y (m,)."""
        if self.sizes is None:
            return y @ self.X
        return (self.sizes * y) @ self.X.astype(self.sizes.dtype).view(y.dtype)


class Factor(NamedTuple):
    """Result of the factorisation of a matrix (N, N)."""

    matrix: "scipy.sparse.csr_array"  # the factorised matrix, with scaled rows and columns
    scale: np.ndarray  # (N,) factors that multiply rows and columns
    steps: list[Eliminated]

    @property
    def nbytes(self) -> int:
        """Memory [bytes] of the matrix and its factor."""
        return self.matrix.data.nbytes + sum(step.inverse.nbytes + step.X.nbytes for step in self.steps)


def fronts(
    neighbours: "scipy.sparse.csr_array", groups: list[tuple[np.ndarray, list[int]]], node: np.ndarray
) -> list[Front]:
    """Convert groups of nodes to groups of unknowns, and determine the border of each group.

    Args:
        neighbours: matrix (V, V) with an entry for each pair of nodes with coupled unknowns.
        groups: result of `liverjax.solvers.factors.dissection.dissected`.
        node: node of each unknown (N,).
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
    """Return the unknowns of the given nodes, ordered by node."""
    first, number = ends[nodes], ends[nodes + 1] - ends[nodes]
    before = np.cumsum(number) - number
    return order[np.repeat(first - before, number) + np.arange(number.sum())]


def single_bytes(plan: list[Front], kind: np.dtype) -> float:
    """Return the memory [bytes] of a factor in single precision. `kind` is the type of the entries, real or complex."""
    own, border = (np.array([len(part) for part in parts], float) for parts in zip(*(f[:2] for f in plan), strict=True))
    together = np.minimum(own, PIVOTS)
    return float(np.sum(own * (0.5 * (own + together) + border))) * (8 if kind.kind == "c" else 4)


def needed_bytes(plan: list[Front], kind: np.dtype, single: bool, small: bool) -> float:
    """Return the memory [bytes] for an elimination in the order of the plan. A parallel elimination needs more memory.

    It is the memory for the factor, for the matrix of one group, and for the lower triangles of the Schur complements
    that are not yet added to their parent groups.
    """
    each = (8 if kind.kind == "c" else 4) * (1 if single else 2)
    of_factor, waiting, most = 0.0, 0.0, 0.0
    lower = [each * len(border) ** 2 / 2 for _, border, _ in plan]
    for k, (own, border, children) in enumerate(plan):
        n, m = float(len(own)), len(border)
        most = max(most, of_factor + waiting + lower[k] + each * n * (n + 2 * m))
        of_factor += each * n * (0.5 * (n + min(n, PIVOTS)) + m) * (0.5 if small else 1.0)
        waiting += lower[k] - sum(lower[c] for c in children)
    return most


def factorised(A: "scipy.sparse.csr_array", plan: list[Front], single: bool, small: bool = False) -> Factor:
    """Factorise A: eliminate one group of unknowns after the other.

    Args:
        A: symmetric matrix (N, N).
        plan: result of `fronts`.
        single: whether to factorise in single precision.
        small: whether to store the factor as 16-bit integers; only if `single`.

    Raises:
        numpy.linalg.LinAlgError: A has values that are not finite, or the matrix of a group is singular.
    """
    A, scale = _scaled(A)
    if not np.all(np.isfinite(A.data)):
        raise np.linalg.LinAlgError("not finite")
    kind = np.result_type(A.dtype, np.float32)
    if single:
        kind = np.dtype(np.complex64 if kind.kind == "c" else np.float32)
    steps = _all_pieces(_Elimination(A, plan, kind, single and small, [None] * len(plan), [[] for _ in plan], {}))
    return Factor(A, scale, steps)


class _Elimination(NamedTuple):
    """Data that the threads share."""

    A: Any
    plan: list[Front]
    kind: np.dtype
    small: bool
    rests: list[np.ndarray | None]  # Schur complement of each group, until it is added to the parent group
    steps: list[list[Eliminated]]  # results of each group
    running: dict[Future, int]  # pieces in progress

    def idle(self) -> int:
        """Return the number of cores that a piece may use: one core, plus all cores that work on no piece."""
        return max(1, cores() + 1 - len(self.running))

    def piece(self, groups: list[int]) -> None:
        """Eliminate `groups` one after the other. The tiles of each group run on the idle cores."""
        place = np.full(self.A.shape[0], -1)
        fronts = [self.plan[k] for k in groups]
        memory = np.empty(max((len(own) + len(border)) * len(own) for own, border, _ in fronts), self.kind)
        for k, front in zip(groups, fronts, strict=True):
            own, m = _own_columns(self.A, front, place, memory), len(front.border)
            rest = np.zeros((m, m), self.kind, order="F")  # the child groups are added to its lower triangle
            for c in front.children:
                left = self.rests[c]
                if left is not None:  # None: the child is not coupled with later unknowns
                    _add(own, rest, place[self.plan[c].border], left)
                    self.rests[c] = None
            place[front.own] = place[front.border] = -1
            steps = _eliminated(own, rest, front, self.idle)
            self.steps[k] = [_in_whole_numbers(step) for step in steps] if self.small else steps
            if m:
                self.rests[k] = rest


def _all_pieces(own: _Elimination) -> list[Eliminated]:
    """Eliminate all pieces (tasks), at most one per core at a time.

    The result does not depend on which piece ends first.
    """
    pieces, waits_for = _work_in_pieces(own.plan)
    running = own.running
    with ThreadPoolExecutor(cores()) as pool:
        ready = [k for k, missing in enumerate(waits_for) if not missing]
        while ready or running:
            running |= {pool.submit(own.piece, pieces[k]): k for k in ready}
            over = wait(running, return_when=FIRST_COMPLETED).done
            ended = {running.pop(future) for future in over}
            for future in over:
                future.result()
            ready = [k for k, missing in enumerate(waits_for) if missing & ended and not missing - ended]
            for missing in waits_for:
                missing -= ended
    return [step for steps in own.steps for step in steps]


def cores() -> int:
    """Return the number of cores that the process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def _work_in_pieces(plan: list[Front]) -> tuple[list[list[int]], list[set[int]]]:
    """Divide the elimination into pieces (tasks). Return the groups of each piece, and for each piece the other pieces
    that must be finished first."""
    n, m = (
        np.array([len(part) for part in parts], float) for parts in zip(*(front[:2] for front in plan), strict=True)
    )
    below = work(n, m)
    least = PIECE * below.sum()
    for k, front in enumerate(plan):
        below[k] += below[front.children].sum()
    small, piece_of = below < least, np.full(len(plan), -1)
    pieces: list[list[int]] = []
    for k in range(len(plan) - 1, -1, -1):  # parent groups come before their child groups
        if piece_of[k] < 0:
            piece_of[k] = len(pieces)
            pieces.append([])
        pieces[piece_of[k]].insert(0, k)
        if small[k]:
            piece_of[plan[k].children] = piece_of[k]
    children = [{int(piece_of[c]) for k in piece for c in plan[k].children} - {q} for q, piece in enumerate(pieces)]
    return pieces, children


def _scaled(A: Any) -> tuple[Any, np.ndarray]:
    """Scale rows and columns of A so that the largest entry of every row is nearly 1 (Ruiz 2001).

    Return the scaled matrix and the factors (N,).
    """
    import scipy.sparse

    A = A.tocsr()
    size, scale, in_row = abs(A.data), np.ones(A.shape[0]), np.diff(A.indptr)
    known, other = np.flatnonzero(in_row), np.empty(A.nnz)  # reused, since a new array takes longer than the arithmetic
    for _ in range(3):
        largest = np.zeros(len(scale))
        if len(known):
            np.multiply(size, np.take(scale, A.indices, out=other, mode="clip"), out=other)
            largest[known] = scale[known] * np.maximum.reduceat(other, A.indptr[known])
        scale = scale / np.sqrt(np.where(largest > 0, largest, 1.0))
    np.take(scale, A.indices, out=other, mode="clip")
    other *= np.repeat(scale, in_row)
    data = A.data * other
    return scipy.sparse.csr_array((data, A.indices, A.indptr), shape=A.shape), scale


def _own_columns(A: Any, front: Front, place: np.ndarray, memory: np.ndarray) -> np.ndarray:
    """Return the columns (n + m, n) of A for the n unknowns of a group with m border unknowns; 0 above the diagonal.

    For each unknown of the group and of its border, the row in these columns is written into `place`.
    """
    n, size = len(front.own), len(front.own) + len(front.border)
    place[front.own], place[front.border] = np.arange(n), np.arange(n, size)
    F = memory[: size * n].reshape((size, n), order="F")
    F[...] = 0
    mirrored = A[front.own].tocoo()
    row = place[mirrored.col]
    below = row >= mirrored.row
    F[row[below], mirrored.row[below]] = mirrored.data[below]
    return F


def _add(own: np.ndarray, rest: np.ndarray, at: np.ndarray, left: np.ndarray) -> None:
    """Add the Schur complement of a child group to the columns `own` of the group and to the matrix `rest` of its
    border. `left` contains the lower triangle of the Schur complement. `at`: for each row of `left`, its index among
    the unknowns of the group and its border (ascending). Entries with consecutive indices are added as one block.
    """
    n = own.shape[1]
    ends = np.unique([0, *(np.flatnonzero(np.diff(at) != 1) + 1), np.searchsorted(at, n), len(at)])
    runs = [(a, b, at[a]) for a, b in itertools.pairwise(ends)]
    for k, (a, b, column) in enumerate(runs):
        to, shift = (own, 0) if column < n else (rest, n)
        for c, d, row in runs[k:]:
            to[row - shift : row - shift + d - c, column - shift : column - shift + b - a] += left[c:d, a:b]


def _eliminated(own: np.ndarray, rest: np.ndarray, front: Front, idle: Callable[[], int]) -> list[Eliminated]:
    """Eliminate a group of n unknowns, whose border has m unknowns.

    `own` (n + m, n) contains the columns of the group. The columns are updated after each `PIVOTS` unknowns. `rest` (m,
    m) is the matrix of the border. At the end, its lower triangle becomes the Schur complement. This is done in one
    update, since large matrix products are the fastest.
    """
    n, every, found = len(front.own), np.concatenate([front.own, front.border]), []
    X = np.empty((n, len(rest)), own.dtype)
    for a in range(0, n, PIVOTS):
        b = min(a + PIVOTS, n)
        A = np.tril(own[a:b, a:b])
        inverse, below = _inverted(A + np.tril(A, -1).T), own[b:, a:b]
        after = np.empty((b - a, len(below)), own.dtype)
        cores = idle()
        width = max(TILE, -(-len(below) // cores))
        _dealt_out(partial(_solved_part, (inverse, below, after), width), len(below), cores, width)
        _take_off(own[b:, b:], below, after[:, : n - b], idle())
        X[a:b] = after[:, n - b :]
        found.append(Eliminated(every[a:b], every[b:], inverse, after))
    _take_off(rest, own[n:], X, idle())
    return found


def _solved_part(matrices: tuple[np.ndarray, np.ndarray, np.ndarray], width: int, j: int) -> None:
    """Compute `width` columns, from column j on, of `inverse` times the transpose of `below`, and write them to `out`.
    `matrices` contains these three matrices."""
    inverse, below, out = matrices
    np.matmul(inverse, below[j : j + width].T, out=out[:, j : j + width])


def _take_off(A: np.ndarray, left: np.ndarray, right: np.ndarray, cores: int) -> None:
    """Subtract left (N, k) times right (k, M) from A (N, M), only in the tiles on and below the diagonal."""

    def columns(j: int) -> None:
        part = A[j:, j : j + TILE]
        product = np.empty(part.shape, A.dtype, order="F")
        np.matmul(left[j:], right[:, j : j + TILE], out=product)
        part -= product

    _dealt_out(columns, A.shape[1], cores, TILE)


def _dealt_out(task: Callable[[int], None], size: int, cores: int, width: int) -> None:
    """Divide `size` columns into parts of `width` columns. Call `task` for each part, in parallel on `cores` cores.

    The argument of `task` is the index of the first column of the part.
    """
    starts = range(0, size, width)
    if cores == 1 or len(starts) < 2:
        for j in starts:
            task(j)
    else:
        with ThreadPoolExecutor(cores) as pool:
            list(pool.map(task, starts))


def _in_whole_numbers(step: Eliminated) -> Eliminated:
    """Return the result of an elimination with its matrix X converted to 16-bit integers."""
    parts = np.ascontiguousarray(step.X).view(step.X.real.dtype)
    sizes = np.abs(parts).max(axis=1, initial=0.0) / np.iinfo(np.int16).max
    sizes = np.where(sizes > 0, sizes, 1.0).astype(parts.dtype)
    return step._replace(X=np.rint(parts / sizes[:, None]).astype(np.int16), sizes=sizes)


def _inverted(A: np.ndarray) -> np.ndarray:
    """Return the inverse of a matrix that is not empty. Raise LinAlgError if the matrix is singular."""
    from scipy.linalg import get_lapack_funcs

    factor, invert = get_lapack_funcs(("getrf", "getri"), (A,))
    lu, pivots, info = factor(A)
    inverse, wrong = invert(lu, pivots, overwrite_lu=True)
    if info or wrong:
        raise np.linalg.LinAlgError("singular")
    return inverse


def refined_solution(factor: Factor, b: np.ndarray) -> tuple[np.ndarray, float]:
    """Solve A x = b with iterative refinement. Return x (N,) and the backward error (see `_backward_error`)."""
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
    """Return the backward error: the norm of `out` = b - A x, divided by the sum of the norms of |A| |x| and b."""
    terms = np.linalg.norm(size @ abs(x)) + np.linalg.norm(b)
    return float(np.linalg.norm(out) / terms) if terms > 0 else 0.0


def _once(factor: Factor, b: np.ndarray) -> np.ndarray:
    if not factor.steps:  # there are no free unknowns
        return b
    y = b.astype(factor.steps[0].inverse.dtype)
    for step in factor.steps:
        near = y[step.own]
        y[step.after] -= step.transposed_times(near)
        y[step.own] = step.inverse @ near
    for step in reversed(factor.steps):
        y[step.own] -= step.times(y[step.after])
    return y
