"""Input and output of a step's solvers: the problem, their limits, the tangent that is kept, and their statistics."""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax

from liverjax.core.struct import Number
from liverjax.solvers.krylov import Earlier

#: Most iterations of one linear solve.
MOST_LINEAR_ITERATIONS = 3000
#: The loosest tolerance of the linear solve for a direction.
LINEAR_TOLERANCE = 5e-2


class StepStatistics(NamedTuple):
    """Statistics of one step; every field is an array (under vmap, one entry for each run)."""

    status: jax.Array
    iterations: jax.Array  # of Newton, all parts together
    linear_iterations: jax.Array
    cuts: jax.Array  # how often a part was halved
    residual: jax.Array  # |r| over the forces at work


class StepOptions(NamedTuple):
    """Limits of a step's solver; all except the tolerance are fixed when compiled."""

    tolerance: float = 1e-8  # of |r| relative to the forces at work
    max_iterations: int = 25  # per part
    one_step: bool = False  # only one linear solve per step; derivatives do not belong to its result
    max_halvings: int = 6
    max_cuts: int = 12
    #: Without derivatives a program is traced in two thirds of the time.
    differentiable: bool = True


class Kept(NamedTuple):
    """The tangent of an earlier step. The next step uses it as long as its iterations converge fast."""

    tangent: Any
    made: jax.Array  # False: there is none yet
    pace: jax.Array  # linear iterations per digit, when its preconditioner was new
    worn: jax.Array  # the preconditioner needs many more iterations by now
    #: Root of the last step minus its prediction, and the part of this that the step before foretold: this part
    #: is added to the next guess.
    surprise: jax.Array
    trust: jax.Array
    beside: jax.Array | None = None  # the further unknowns at the root (`Problem.beside`)
    #: The last linear solves of derivatives, from which the next solve begins. In a run they are zeros.
    adjoints: Earlier | tuple[()] = ()


class Beside(NamedTuple):
    """Unknowns that the residual solves for at every q. Its iterations are fewer with a guess."""

    before: jax.Array  # a guess at the beginning of the step
    #: (q, s, guess) -> its solution at q.
    solved: Callable[..., jax.Array]
    #: (solution nearby, tolerance over the usual one) -> guess for `residual` and `solved`.
    guess: Callable[[jax.Array, Number], tuple]
    #: (q, solution) -> residuals of r and of the solution's own equation. Both are differentiated together: no solve
    #: is differentiated by itself. If the derivative of r is symmetric, the one of both together is symmetric too.
    lack: Callable[[jax.Array, jax.Array], tuple[jax.Array, jax.Array]]


class Problem(NamedTuple):
    """Equations of a step, and how their linear systems are solved."""

    #: (q, s) -> (r, force, by): a flat vector (n,), the size of the forces that r is compared with, and data that
    #: `tangent` needs. It may close over traced parameters; derivatives are exact at the root. If there is a
    #: `beside`, by is its solution, and a third argument is a guess of this solution.
    residual: Callable[..., tuple[jax.Array, jax.Array, Any]]
    #: (q, s, by, near) -> any pytree that represents dr/dq, used again while iterations converge fast with it; near
    #: is None, or a pair: whether parts of an earlier tangent are near enough to be used, and this tangent.
    tangent: Callable[[jax.Array, jax.Array, Any, Any], Any]
    #: (tangent, b, tolerance, max_iterations) -> (solution of dr/dq x = b, iterations, whether dr/dq seems positive).
    solve: Callable[[Any, jax.Array, Any, int], tuple[jax.Array, jax.Array, jax.Array]]
    #: tangent -> approximate inverse of dr/dq, for derivatives.
    preconditioner: Callable[[Any], Callable[[jax.Array], jax.Array]]
    #: (tangent, b, tolerance, max_iterations, earlier solves) -> solution with dr/dq itself, its load and its residual
    #: over |b|: for derivatives, if dr/dq is symmetric. If there is a `beside`, b and the solution are for both
    #: together (`Beside.lack`), and the load is the rest of b after `beside` is eliminated. None: solutions are found
    #: with products of dr/dq.
    adjoint: Callable[[Any, jax.Array, Number, int, Earlier], tuple[jax.Array, jax.Array, jax.Array]] | None = None
    #: Whether dr/dq is symmetric.
    symmetric: bool = True
    #: Whether r depends on s.
    moved: bool = True
    #: |r| that is due to the rounding of q.
    roundoff: Any = 0.0
    beside: Beside | None = None
    #: Whether r has kinks, as at the beginning of contact.
    kinks: bool = False
    #: The energy that is minimised if the step cannot be followed; None: it is not minimised.
    potential: "Potential | None" = None
    #: A pytree of all numbers that r depends on, except q and s: the root has derivatives by them.
    numbers: Any = None


class Potential(NamedTuple):
    """The energy of a step, for steps that cannot be followed."""

    #: (q, start) -> energy whose gradient at start is r(start, 1). Forces without an energy keep their values at start.
    energy: Callable[[jax.Array, jax.Array], jax.Array]
    #: As `Problem.tangent`, but without negative eigenvalues, unless a fifth argument is false.
    definite: Callable[..., Any]
    #: (q, s) -> the least J of an element: not above 0 if elements are inverted.
    volume: Callable[[jax.Array, Any], jax.Array]
    #: The problem of a body whose energy is finite for inverted elements; None if this body's own energy is.
    surrogate: Problem | None
    #: The shape from which loads are followed if the start is a guess, and whether it is; None: a start is a state.
    rest: tuple[jax.Array, jax.Array] | None
    #: q with the pressures that are best for its positions, if pressures are unknowns; None: they are not.
    settled: Callable[[jax.Array], jax.Array] | None = None
    #: How many of the unknowns are positions; None: all.
    positions: int | None = None
    #: Whether a solve with a definite tangent eliminates the pressures: then its tolerance needs not be stricter.
    eliminates: bool = False
