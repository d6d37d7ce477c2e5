"""Preconditioned Krylov methods for use inside `jax.jit`. At the end, the methods compute the true residual."""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax.flatten_util import ravel_pytree

from liverjax.core.struct import Number


class LinearStatistics(NamedTuple):
    """Statistics of one linear solve: iterations and residual."""

    iterations: jax.Array
    residual: jax.Array  # |b - A x| / |b|, recomputed at the end
    positive: jax.Array  # False if a direction without positive curvature was found


def conjugate_gradients(
    matvec: Callable[[jax.Array], jax.Array],
    b: jax.Array,
    precondition: Callable[[jax.Array], jax.Array],
    tolerance: Number,
    max_iterations: int,
) -> tuple[jax.Array, LinearStatistics]:
    """Solve A x = b for a symmetric positive definite A, given as a function of a flat vector (n,).

    Args:
        matvec, precondition: A and an approximation of its inverse.
        tolerance: the iterations end if the residual that they update is at most `tolerance` |b|.
        max_iterations: maximum number of iterations.

    The iterations also stop at a direction without positive curvature. The statistics contain the true residual.
    """
    goal = tolerance * length(b)

    def go_on(c):
        _, r, _, _, k, positive = c
        return (length(r) > goal) & (k < max_iterations) & positive

    def step(c):
        x, r, p, rz_before, k, _ = c
        z = precondition(r)  # the only call of the preconditioner, so that it is compiled only once
        rz = jnp.vdot(r, z)
        p = z + rz / rz_before * p
        Ap = matvec(p)
        curvature = jnp.vdot(p, Ap)
        positive = (curvature > 0) & (rz > 0)
        alpha = jnp.where(positive, rz / jnp.where(positive, curvature, 1.0), 0.0)
        # Values that are not finite are not added to x.
        return jnp.where(positive, x + alpha * p, x), r - alpha * Ap, p, rz, k + 1, positive

    zero = jnp.zeros_like(b)
    start = (zero, b, zero, jnp.ones((), b.dtype), jnp.zeros((), jnp.int32), jnp.array(True))
    x, *_, k, positive = jax.lax.while_loop(go_on, step, start)
    return x, LinearStatistics(k, true_residual(matvec, b, x), positive)


def chebyshev(
    matvec: Callable[[jax.Array], jax.Array],
    b: jax.Array,
    diagonal: jax.Array,
    bounds: tuple[Number, Number],
    degree: Number,
) -> jax.Array:
    """Approximate A^-1 b by a polynomial of the matrix D^-1 A, multiplied by D^-1 b (Saad 2003, 12.3).

    The approximation of A^-1 is symmetric and positive definite.

    Args:
        matvec, diagonal: A and its diagonal D.
        bounds: lower and upper bound of the eigenvalues of D^-1 A. The error is at most 2 exp(-2 degree sqrt(low /
            high)).
        degree: number of products with A; may be unknown during compilation.
    """
    low, high = bounds
    theta, delta = (high + low) / 2, jnp.maximum((high - low) / 2, 1e-3 * high)
    sigma = theta / delta

    def step(_, t):
        x, r, d, rho = t
        x, r = x + d, r - matvec(d)
        rho_new = 1 / (2 * sigma - rho)
        return x, r, rho_new * rho * d + 2 * rho_new / delta * r / diagonal, rho_new

    start = (jnp.zeros_like(b), b, b / diagonal / theta, 1 / sigma)
    return jax.lax.fori_loop(0, degree, step, start)[0]


def stabilised_biconjugate_gradients(
    matvec: Callable[[jax.Array], jax.Array],
    b: jax.Array,
    precondition: Callable[[jax.Array], jax.Array],
    tolerance: Number,
    max_iterations: int,
) -> tuple[jax.Array, LinearStatistics]:
    """Solve A x = b for a matrix A that is not symmetric, by BiCGSTAB (van der Vorst 1992).

    The arguments are the same as for `conjugate_gradients`. Each iteration needs two products with A.
    """
    goal = tolerance * length(b)
    one = jnp.ones((), b.dtype)

    def divided(a, b):
        return jnp.where(b == 0, 0.0, a / jnp.where(b == 0, 1.0, b))

    def go_on(t):
        _, r, _, _, rho, alpha, omega, k = t
        return (length(r) > goal) & (k < max_iterations) & (rho * alpha * omega != 0)

    def step(t):
        x, r, p, v, rho_old, alpha, omega, k = t
        rho = jnp.vdot(b, r)
        p = r + divided(rho, rho_old) * divided(alpha, omega) * (p - omega * v)
        y = precondition(p)
        v = matvec(y)
        alpha = divided(rho, jnp.vdot(b, v))
        s = r - alpha * v
        z = precondition(s)
        t = matvec(z)
        omega = divided(jnp.vdot(t, s), jnp.vdot(t, t))
        return x + alpha * y + omega * z, s - omega * t, p, v, rho, alpha, omega, k + 1

    zero = jnp.zeros_like(b)
    start = (zero, b, zero, zero, one, one, one, jnp.zeros((), jnp.int32))
    x, *_, k = jax.lax.while_loop(go_on, step, start)
    return x, LinearStatistics(k, true_residual(matvec, b, x), jnp.array(True))


#: EARLIER: number of earlier solves that are kept to compute the starting vector of a solve. _NEW: an earlier
#: right-hand side is ignored if a linear combination of newer right-hand sides represents it with a relative error
#: below _NEW. The solutions are not more accurate than this.
EARLIER, _NEW = 6, 1e-7


class Earlier(NamedTuple):
    """Right-hand sides (`loads`) and solutions of earlier solves, the latest first. Missing solves are zeros."""

    loads: jax.Array  # (EARLIER, n), n entries each
    solutions: jax.Array  # (EARLIER, m), m entries each

    def combined(self, b: jax.Array) -> jax.Array:
        """Return a linear combination (m,) of the earlier solutions. The same combination of the right-hand sides is as
        close as possible to b (n,).

        The method is Gram-Schmidt orthogonalisation of the right-hand sides, applied twice.
        """

        def add(c, pair):
            Q, Y, b, x, k = c
            (q, y), whole = pair, jnp.linalg.norm(pair[0])
            for _ in range(2):
                h = Q @ q
                q, y = q - h @ Q, y - h @ Y
            size = jnp.linalg.norm(q)
            factor = jnp.where(size > _NEW * whole, 1.0 / jnp.where(size > 0, size, 1.0), 0.0)
            q, y = factor * q, factor * y
            h = jnp.vdot(q, b)
            return (Q.at[k].set(q), Y.at[k].set(y), b - h * q, x + h * y, k + 1), None

        empty = (jnp.zeros_like(self.loads), jnp.zeros_like(self.solutions))
        start = (*empty, b, jnp.zeros_like(self.solutions[0]), 0)
        return jax.lax.scan(add, start, (self.loads, self.solutions))[0][3]

    def with_latest(self, load: jax.Array, solution: jax.Array) -> "Earlier":
        """Add a new solve and remove the oldest one."""
        pairs = ((self.loads, load), (self.solutions, solution))
        return Earlier(*(jnp.concatenate([new[None], old[:-1]]) for old, new in pairs))


def no_earlier(load: jax.Array, solution: jax.Array) -> Earlier:
    """Return an empty `Earlier` (zeros), for right-hand sides as long as `load` and solutions as long as `solution`."""
    return Earlier(*(jnp.zeros((EARLIER, len(each)), each.dtype) for each in (load, solution)))


#: A vector, together with earlier linear solves.
WithEarlier = tuple[jax.Array, Earlier]


def symmetric_solve(
    matvec: Callable[[WithEarlier], WithEarlier],
    both: WithEarlier,
    solver: Callable[[jax.Array, Earlier], tuple[jax.Array, jax.Array, jax.Array]],
    tolerance: Number,
) -> WithEarlier:
    """Solve A x = b for a symmetric A. Return x, and the earlier solves with this solve added.

    x is a linear function of b, so its derivatives are also solves, in forward and in reverse mode. x is NaN if the
    residual is too large (same bounds as in `differentiable_solve`).

    Args:
        matvec: function (x, earlier) -> (A x, the same earlier).
        both: b, and the earlier solves that give the starting vector.
        solver: function (b, earlier) -> (solution, right-hand side, norm of the true residual divided by the norm of
            the right-hand side). The right-hand side is b, or what remains of b after the elimination of unknowns.
        tolerance: tolerance of the solver.
    """
    # All arrays are joined into one vector, because JAX raises an error if some of the arrays have no cotangents.
    joined, parted = ravel_pytree(both)

    def solve(_, vector):
        b, earlier = parted(vector)
        x, load, residual = solver(b, earlier)
        x = jnp.where(_good(residual, tolerance, b), x, jnp.nan)
        return ravel_pytree((x, earlier.with_latest(load, x)))[0]

    def product(vector):
        return ravel_pytree(matvec(parted(vector)))[0]

    return parted(jax.lax.custom_linear_solve(product, joined, solve=solve, transpose_solve=solve))


def _good(residual: jax.Array, tolerance: Number, b: jax.Array) -> jax.Array:
    return residual <= jnp.maximum(min(1e-3, float(jnp.finfo(b.dtype).eps) ** (1 / 3)), 10 * tolerance)


def started(
    solver: Callable[[jax.Array, Number], tuple[jax.Array, jax.Array]],
    matvec: Callable[[jax.Array], jax.Array],
    b: jax.Array,
    near: jax.Array,
    tolerance: Number,
) -> tuple[jax.Array, jax.Array]:
    """Solve A x = b from the starting vector `near`, or from 0 if the residual is smaller there.

    `solver` is a function (b, tolerance) -> (solution, residual divided by |b|). `tolerance` is the upper bound of |b -
    A x| / |b|. Return the solution and its residual, divided by |b|.
    """
    left, size = b - matvec(near), length(b)
    helps = length(left) < size
    begin, left = jnp.where(helps, near, 0.0), jnp.where(helps, left, b)
    rest = length(left) / jnp.where(size > 0, size, 1.0)
    more, residual = solver(left, tolerance / jnp.where(rest > 0, rest, 1.0))
    return begin + more, rest * residual


def length(v: jax.Array) -> jax.Array:
    """Return the Euclidean norm |v|. In float32, squares of small numbers are 0, so v is divided by max |v| first."""
    if v.dtype != jnp.float32:
        return jnp.sqrt(jnp.vdot(v, v).real)
    most = jnp.max(jnp.abs(v))
    shown = v / jnp.where(most > 0, most, 1.0)
    return most * jnp.sqrt(jnp.vdot(shown, shown))


def true_residual(matvec: Callable[[jax.Array], jax.Array], b: jax.Array, x: jax.Array) -> jax.Array:
    """Return the relative residual |b - A x| / |b|."""
    scale = length(b)
    return length(b - matvec(x)) / jnp.where(scale > 0, scale, 1.0)


class Known(NamedTuple):
    """Known properties of the matrix A of `differentiable_solve`."""

    symmetric: bool = True
    #: Function b -> (solution for a symmetric A, true residual divided by |b|); None: a Krylov method solves.
    solver: Callable[[jax.Array], tuple[jax.Array, jax.Array]] | None = None
    diagonal: jax.Array | None = None  # diagonal of a diagonally dominant A


def differentiable_solve(
    matvec: Callable[[jax.Array], jax.Array],
    b: jax.Array,
    precondition: Callable[[jax.Array], jax.Array],
    tolerance: Number,
    max_iterations: int,
    known: Known = Known(),
) -> jax.Array:
    """Solve A x = b as a linear function of `b`: derivatives are also solves, not derivatives of the iterations.

    The method is conjugate gradients for a symmetric positive definite A, otherwise BiCGSTAB. The solution is NaN if
    the true residual is above 6e-6 |b| (float32: 1e-3) and above ten times the tolerance. With the `diagonal` D of a
    diagonally dominant A, a residual below 4 eps |D x| is also accepted, because the rounding of x alone causes a
    residual of eps |D x|.
    """
    symmetric, solver, diagonal = known
    method = conjugate_gradients if symmetric else stabilised_biconjugate_gradients

    def solve(matvec, b):
        eps, found = float(jnp.finfo(b.dtype).eps), jnp.array(True)
        if solver is None:
            x, s = method(matvec, b, precondition, tolerance, max_iterations)
            residual, found = s.residual, s.positive & (s.iterations < max_iterations)
        else:
            x, residual = solver(b)
        good = _good(residual, tolerance, b)
        if diagonal is not None:
            good = good | (found & (residual * length(b) <= 4 * eps * length(diagonal * x)))
        return jnp.where(good, x, jnp.nan)

    return jax.lax.custom_linear_solve(matvec, b, solve=solve, transpose_solve=solve, symmetric=symmetric)


def one_by_one(function: Callable) -> Callable:
    """Return an equivalent function. With `jax.vmap` on a CPU, it computes the members of a batch one after another.

    Otherwise all members would wait for the member with the most iterations, and products of several small matrices
    are slow on a CPU. `jax.custom_batching.sequential_vmap` is not used because it fails in second derivatives.
    """
    if jax.default_backend() != "cpu":
        return function
    own = jax.custom_batching.custom_vmap(function)

    @own.def_vmap
    def members(size: int, batched: list[bool], *arrays: jax.Array) -> tuple[Any, Any]:
        changing = [a for a, b in zip(arrays, batched, strict=True) if b]

        def one(member: list[jax.Array]) -> Any:
            left = iter(member)
            return own(*(next(left) if b else a for a, b in zip(arrays, batched, strict=True)))

        out = jax.lax.map(one, changing) if changing else function(*arrays)
        return out, jax.tree.map(lambda _: bool(changing), out)

    return own
