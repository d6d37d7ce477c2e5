"""Input and output of the solvers of a step: the equations, limits, the tangent of an earlier step, and statistics.

q (n,) is the flat vector of unknowns. s is the fraction of the step: the loads have their values at the beginning of
the step for s = 0, and their values at the end for s = 1. r(q, s) is the residual.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax

from liverjax.core.struct import Number
from liverjax.solvers.krylov import Earlier

#: Maximum number of iterations of one linear solve.
MOST_LINEAR_ITERATIONS = 3000
#: Maximum tolerance of the linear solve for a Newton direction.
LINEAR_TOLERANCE = 5e-2


class StepStatistics(NamedTuple):
    """Statistics of one step. Every field is an array; under vmap it has one entry for each run."""

    status: jax.Array
    iterations: jax.Array  # Newton iterations of all substeps
    linear_iterations: jax.Array
    cuts: jax.Array  # number of times that a substep was halved
    residual: jax.Array  # norm of the residual forces, divided by the norm of all forces


class StepOptions(NamedTuple):
    """Limits of the solver of a step. All except the tolerance are fixed in the compiled program."""

    tolerance: float = 1e-8  # upper bound of |r|, relative to the norm of all forces
    max_iterations: int = 25  # maximum number of Newton iterations per substep
    one_step: bool = False  # only one linear solve per step; derivatives of its result are wrong
    max_halvings: int = 6
    max_cuts: int = 12
    #: Whether derivatives are possible. Without them, JAX prepares the compiled program in two thirds of the time.
    differentiable: bool = True


class Kept(NamedTuple):
    """Data of one step for the next step: above all the tangent, which is used as long as iterations converge fast."""

    tangent: Any
    made: jax.Array  # False if there is no tangent yet
    pace: jax.Array  # linear iterations per digit of accuracy when the preconditioner was new
    worn: jax.Array  # whether the preconditioner needs many more iterations than when it was new
    #: `surprise`: the last root minus its prediction. `trust`: the factor from 0 to 1 for which `trust` times the
    #: surprise of the previous step is closest to `surprise`. The next guess is the prediction plus `trust` times
    #: `surprise`.
    surprise: jax.Array
    trust: jax.Array
    beside: jax.Array | None = None  # the additional unknowns at the root (`Problem.beside`)
    #: The last linear solves for derivatives. The next such solve begins with a combination of their solutions. All
    #: entries are zeros if no derivatives are computed.
    adjoints: Earlier | tuple[()] = ()


class Beside(NamedTuple):
    """Additional unknowns, for example fluid pressures. `Problem.residual` computes them at every q from a guess."""

    before: jax.Array  # a guess at the beginning of the step
    #: Function (q, s, guess) -> values of the additional unknowns at q.
    solved: Callable[..., jax.Array]
    #: Function (additional unknowns at a nearby q, factor that multiplies the tolerance) -> guess for `residual` and
    #: `solved`.
    guess: Callable[[jax.Array, Number], tuple]
    #: Function (q, additional unknowns) -> (r, residual of the equation of the additional unknowns). Both are
    #: differentiated together, so that no inner solve is differentiated. If dr/dq is symmetric, this joint derivative
    #: is symmetric too.
    lack: Callable[[jax.Array, jax.Array], tuple[jax.Array, jax.Array]]


class Problem(NamedTuple):
    """Equations of a step, and functions that solve the linear systems of these equations."""

    #: Function (q, s) -> (r, force, by). r is the residual (n,), `force` is the norm of all forces for the relative
    #: residual, and `by` is data for `tangent`. At the root, derivatives of r with respect to `numbers` are exact.
    #: If there are additional unknowns (`beside`), `by` contains their values, and a third argument is a guess.
    residual: Callable[..., tuple[jax.Array, jax.Array, Any]]
    #: Function (q, s, by, near) -> any pytree that represents dr/dq. This tangent is used again while iterations
    #: converge fast. `near` is None or a pair (flag, earlier tangent). The flag shows whether parts of the earlier
    #: tangent can be used.
    tangent: Callable[[jax.Array, jax.Array, Any, Any], Any]
    #: Function (tangent, b, tolerance, max_iterations) -> (x, iterations, positive): x solves dr/dq x = b, and
    #: `positive` shows whether dr/dq seems positive definite.
    solve: Callable[[Any, jax.Array, Any, int], tuple[jax.Array, jax.Array, jax.Array]]
    #: Function tangent -> approximate inverse of dr/dq, a function of vectors (n,). It is used for derivatives.
    preconditioner: Callable[[Any], Callable[[jax.Array], jax.Array]]
    #: Function for derivatives if dr/dq is symmetric: (tangent, b, tolerance, max_iterations, earlier solves) -> the
    #: solution with the exact dr/dq, the right-hand side, and the residual divided by the norm of the right-hand side.
    #: If there are additional unknowns (`beside`), b and the solution include them. The right-hand side is
    #: then what remains of b after the elimination of the additional unknowns; otherwise it is b. None: derivatives use
    #: products with dr/dq.
    adjoint: Callable[[Any, jax.Array, Number, int, Earlier], tuple[jax.Array, jax.Array, jax.Array]] | None = None
    #: Whether dr/dq and its preconditioner are symmetric.
    symmetric: bool = True
    #: Whether the first right-hand side of a substep contains the term dr/ds. With only one linear solve, this term is
    #: always used.
    moved: bool = True
    #: Norm of the change of r due to the rounding of q.
    roundoff: Any = 0.0
    beside: Beside | None = None
    #: Whether dr/dq can jump, for example where contact begins.
    kinks: bool = False
    #: The energy that is minimised if Newton's method fails; None: no energy is minimised.
    potential: "Potential | None" = None
    #: A pytree of all numbers on which r depends, except q and s. The root has derivatives with respect to these
    #: numbers.
    numbers: Any = None


class Potential(NamedTuple):
    """Energy of a step. It is minimised if Newton's method (`liverjax.solvers.step_cutting`) fails."""

    #: Function (q, start) -> energy. The gradient of the energy at `start` is r(start, 1). Forces without an energy
    #: keep their values at `start`.
    energy: Callable[[jax.Array, jax.Array], jax.Array]
    #: Function with the same arguments as `Problem.tangent`, for a tangent without negative eigenvalues. If a fifth
    #: argument is false, the function returns the true tangent.
    definite: Callable[..., Any]
    #: Function (q, s) -> minimum volume ratio J of the elements, which is 0 or negative if elements are inverted.
    volume: Callable[[jax.Array, Any], jax.Array]
    #: The problem of the same body with another law, whose energy is finite in inverted elements. None if the law of
    #: the body already has such an energy.
    surrogate: Problem | None
    #: A pair: unknowns of the reference shape, and whether the unknowns at the beginning of the step are only a guess.
    #: If the guess fails, the solution is followed from the reference shape. None: the step never begins at a guess.
    rest: tuple[jax.Array, jax.Array] | None
    #: Function q -> q with the optimal pressures for its positions; None if pressures are not unknowns.
    settled: Callable[[jax.Array], jax.Array] | None = None
    #: Number of unknowns that are positions; None: all unknowns are positions.
    positions: int | None = None
    #: Whether the pressures are eliminated when a linear system with the tangent from `definite` is solved. Such a
    #: solve needs only the usual tolerance.
    eliminates: bool = False
