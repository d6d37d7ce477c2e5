"""Input and output of a step's solvers: the problem, their limits, the tangent that is kept, and their statistics."""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax

from liverjax.core.struct import Number
from liverjax.solvers.krylov import Earlier

#: Most iterations of one linear solve.
MOST_LINEAR_ITERATIONS = 3000
#: Tolerance of the linear solve for a direction, the loosest.
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
    max_iterations: int = 25  # a part
    one_step: bool = False  # one linear solve a step and no more; derivatives are not those of it
    max_halvings: int = 6
    max_cuts: int = 12
    #: Without derivatives a program is traced in two thirds of the time.
    differentiable: bool = True


class Kept(NamedTuple):
    """The tangent of an earlier step. The next step uses it as long as its iterations converge fast."""

    tangent: Any
    made: jax.Array  # False: there is none yet
    pace: jax.Array  # linear iterations a digit, with its preconditioner when that was new
    worn: jax.Array  # the preconditioner takes much longer by now
    #: Root of the last step less what was predicted, and the part of it that the step before foretold: as much of it
    #: is added to the next guess.
    surprise: jax.Array
    trust: jax.Array
    beside: jax.Array | None = None  # what is solved for beside the root, there (`Problem.beside`)
    #: Of derivatives: their last linear solves, for the next to begin with. A run carries zeros.
    adjoints: Earlier | tuple[()] = ()


class Beside(NamedTuple):
    """Unknowns that the residual solves for at every q. Its iterations are fewer with a guess."""

    before: jax.Array  # a guess at the beginning of the step
    #: (q, s, guess) -> its solution at q.
    solved: Callable[..., jax.Array]
    #: (solution nearby, tolerance over the usual one) -> guess for `residual` and `solved`.
    guess: Callable[[jax.Array, Number], tuple]
    #: (q, solution) -> what r(q, 1) and the solution's own equation lack. Derivatives are of both together: no solve
    #: of its own is differentiated. Where r has a symmetric derivative, that of both together is symmetric too.
    lack: Callable[[jax.Array, jax.Array], tuple[jax.Array, jax.Array]]


class Problem(NamedTuple):
    """Equations of a step, and how their linear systems are solved."""

    #: (q, s) -> (r, force, by): a flat vector (n,), the size of the forces that it is small against, and what
    #: `tangent` needs beside. May close over traced parameters; derivatives are exact at the root. Where there is a
    #: `beside`, by is its solution and a third argument a guess of it.
    residual: Callable[..., tuple[jax.Array, jax.Array, Any]]
    #: (q, s, by, near) -> any pytree that stands for dr/dq, used again while iterations converge fast with it; near
    #: is None, or whether an earlier one is near enough to take parts from, and that one.
    tangent: Callable[[jax.Array, jax.Array, Any, Any], Any]
    #: (tangent, b, tolerance, max_iterations) -> (solution of dr/dq x = b, iterations, whether dr/dq seems positive).
    solve: Callable[[Any, jax.Array, Any, int], tuple[jax.Array, jax.Array, jax.Array]]
    #: tangent -> approximate inverse of dr/dq, for derivatives.
    preconditioner: Callable[[Any], Callable[[jax.Array], jax.Array]]
    #: (tangent, b, tolerance, max_iterations, earlier solves) -> solution with dr/dq itself, its load and its residual
    #: over |b|: for derivatives, where dr/dq is symmetric. Where there is a `beside`, b and the solution are of both
    #: together (`Beside.lack`), and the load is what is left when what is beside is eliminated. None: they are solved
    #: for with products of dr/dq.
    adjoint: Callable[[Any, jax.Array, Number, int, Earlier], tuple[jax.Array, jax.Array, jax.Array]] | None = None
    #: Whether dr/dq is.
    symmetric: bool = True
    #: Whether r depends on s.
    moved: bool = True
    #: |r| that the digits of q leave.
    roundoff: Any = 0.0
    beside: Beside | None = None
    #: Whether r has kinks, as where a surface comes to touch.
    kinks: bool = False
    #: What a step that cannot be followed is minimised with; None: it is not.
    potential: "Potential | None" = None
    #: A pytree of all numbers that r depends on, beside q and s: what a root has derivatives by.
    numbers: Any = None


class Potential(NamedTuple):
    """The energy of a step, for steps that cannot be followed."""

    #: (q, start) -> energy whose gradient at start is r(start, 1). Forces without an energy are held as at start.
    energy: Callable[[jax.Array, jax.Array], jax.Array]
    #: As `Problem.tangent`, of a matrix without negative eigenvalues; a fifth argument: only where it is true.
    definite: Callable[..., Any]
    #: (q, s) -> the least J of an element: not above 0 where elements are inverted.
    volume: Callable[[jax.Array, Any], jax.Array]
    #: The same of a body whose energy is finite where elements are inverted; None where it is already.
    surrogate: Problem | None
    #: Where the loads are followed from if the start is a guess, and whether it is; None where a start is a state.
    rest: tuple[jax.Array, jax.Array] | None
    #: q with the pressures that are best for its positions, where these are unknowns; None: there are none.
    settled: Callable[[jax.Array], jax.Array] | None = None
    #: How many of the unknowns are positions; None: all.
    positions: int | None = None
    #: Whether a solve with a definite tangent eliminates the pressures: its direction may be as loose as without any.
    eliminates: bool = False
