"""Input and output of the solvers of a step: the problem, limits, the tangent that is kept, and statistics."""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax

from liverjax.core.struct import Number
from liverjax.solvers.krylov import Earlier

#: Maximum number of iterations of one linear solve.
MOST_LINEAR_ITERATIONS = 3000
#: Maximum tolerance of the linear solve for a direction.
LINEAR_TOLERANCE = 5e-2


class StepStatistics(NamedTuple):
    """Statistics of one step. Every field is an array; under vmap it has one entry for each run."""

    status: jax.Array
    iterations: jax.Array  # Newton iterations of all parts together
    linear_iterations: jax.Array
    cuts: jax.Array  # how often a part was halved
    residual: jax.Array  # |r| over the norm of all forces


class StepOptions(NamedTuple):
    """Limits of a step's solver. All except the tolerance are fixed in the compiled program."""

    tolerance: float = 1e-8  # of |r|, relative to the norm of all forces
    max_iterations: int = 25  # per part
    one_step: bool = False  # only one linear solve per step; its result has no correct derivatives
    max_halvings: int = 6
    max_cuts: int = 12
    #: Whether derivatives are possible. Without them, tracing takes two thirds of the time.
    differentiable: bool = True


class Kept(NamedTuple):
    """The tangent of an earlier step. The next step uses it as long as the iterations converge fast."""

    tangent: Any
    made: jax.Array  # False: there is no tangent yet
    pace: jax.Array  # linear iterations per digit, when the preconditioner was new
    worn: jax.Array  # whether the preconditioner now needs many more iterations
    #: `surprise`: the last root minus its prediction. `trust`: which fraction of it the previous surprise predicted;
    #: the next guess adds this fraction of `surprise`.
    surprise: jax.Array
    trust: jax.Array
    beside: jax.Array | None = None  # the additional unknowns at the root (`Problem.beside`)
    #: The last linear solves for derivatives; the next such solve begins with them. In a run they are zeros.
    adjoints: Earlier | tuple[()] = ()


class Beside(NamedTuple):
    """Additional unknowns, for which the residual solves at every q. A guess reduces the iterations of this solve."""

    before: jax.Array  # a guess at the beginning of the step
    #: (q, s, guess) -> the additional unknowns at q.
    solved: Callable[..., jax.Array]
    #: (solution at a nearby q, factor on the usual tolerance) -> guess for `residual` and `solved`.
    guess: Callable[[jax.Array, Number], tuple]
    #: (q, solution) -> r and the residual of the equation of the additional unknowns. Both are differentiated together,
    #: so that no inner solve is differentiated. If dr/dq is symmetric, the derivative of both together is symmetric.
    lack: Callable[[jax.Array, jax.Array], tuple[jax.Array, jax.Array]]


class Problem(NamedTuple):
    """Equations of a step, and functions that solve their linear systems."""

    #: (q, s) -> (r, force, by): r is a flat vector (n,); `force` is the norm of all forces, with which r is compared;
    #: `by` is data for `tangent`. It may close over traced parameters; derivatives are exact at the root. With a
    #: `beside`, `by` is its solution, and a third argument is a guess for this solution.
    residual: Callable[..., tuple[jax.Array, jax.Array, Any]]
    #: (q, s, by, near) -> any pytree that represents dr/dq; it is used again while iterations converge fast with it.
    #: `near` is None or a pair (flag, earlier tangent): the flag says whether parts of this tangent can be used.
    tangent: Callable[[jax.Array, jax.Array, Any, Any], Any]
    #: (tangent, b, tolerance, max_iterations) -> (x with dr/dq x = b, iterations, whether dr/dq seems to be positive).
    solve: Callable[[Any, jax.Array, Any, int], tuple[jax.Array, jax.Array, jax.Array]]
    #: tangent -> approximate inverse of dr/dq, for derivatives.
    preconditioner: Callable[[Any], Callable[[jax.Array], jax.Array]]
    #: For derivatives, if dr/dq is symmetric: (tangent, b, tolerance, max_iterations, earlier solves) -> solution with
    #: the exact dr/dq, its load, and its residual over the norm of the load. With a `beside`, b and the solution are
    #: for both together (`Beside.lack`), and the load is what remains of b after the elimination of `beside`. None:
    #: derivatives use products with dr/dq.
    adjoint: Callable[[Any, jax.Array, Number, int, Earlier], tuple[jax.Array, jax.Array, jax.Array]] | None = None
    #: Whether dr/dq is symmetric.
    symmetric: bool = True
    #: Whether r depends on s.
    moved: bool = True
    #: |r| that the rounding of q causes.
    roundoff: Any = 0.0
    beside: Beside | None = None
    #: Whether dr/dq can jump, for example where contact begins.
    kinks: bool = False
    #: The energy that is minimised if the load cannot be followed; None: nothing is minimised.
    potential: "Potential | None" = None
    #: A pytree of all numbers on which r depends, except q and s: the root has derivatives with respect to them.
    numbers: Any = None


class Potential(NamedTuple):
    """The energy of a step, for steps whose load cannot be followed."""

    #: (q, start) -> energy. Its gradient at start is r(start, 1). Forces without an energy keep their values at start.
    energy: Callable[[jax.Array, jax.Array], jax.Array]
    #: As `Problem.tangent`, but without negative eigenvalues; with a fifth argument that is false, the true tangent.
    definite: Callable[..., Any]
    #: (q, s) -> minimum J of the elements. It is 0 or negative if elements are inverted.
    volume: Callable[[jax.Array, Any], jax.Array]
    #: The problem of a body with a finite energy for inverted elements; None if this body already has such an energy.
    surrogate: Problem | None
    #: The shape from which loads are followed if the start is a guess, and whether it is a guess; None: never a guess.
    rest: tuple[jax.Array, jax.Array] | None
    #: q -> q with the optimal pressures for its positions; None: pressures are not unknowns.
    settled: Callable[[jax.Array], jax.Array] | None = None
    #: Number of unknowns that are positions; None: all.
    positions: int | None = None
    #: Whether a solve with a definite tangent eliminates the pressures: then it needs no stricter tolerance.
    eliminates: bool = False
