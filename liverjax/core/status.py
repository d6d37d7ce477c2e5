"""Result codes of solves, and one sentence of advice for each code. Compiled programs return only the codes."""

import jax
import jax.numpy as jnp
import numpy as np

CONVERGED = 0
STALLED = 1
NOT_FINITE = 2
INDEFINITE = 3
INVERTED = 4
STEP_CUT = 5
GRADIENT_UNCONVERGED = 6
ADJOINT_FAILED = 7
ONE_STEP = 8

ADVICE = {
    CONVERGED: "converged",
    STALLED: "the residual stopped decreasing above the tolerance: use float64, a larger tolerance or, in float64 or "
    "for a static scene, smaller steps (in float32, with very stiff springs or with very short time steps, roundoff "
    "may not allow a smaller residual, and smaller time steps make it larger)",
    NOT_FINITE: "a residual was not finite, usually because of an inverted element: use smaller loads or steps, or a "
    "law with continued_below; if you wrote the law, check it with `python -m liverjax check`",
    INDEFINITE: "the stiffness has a negative eigenvalue and no equilibrium was reached (the body buckles, collapses, "
    "or is nearly incompressible): if bulk is far above mu, use linear_solver = 'direct' or volumetric = 'mixed'; "
    "otherwise use smaller steps, robust = 'projected' or, for a static scene, kind = 'dynamic'",
    INVERTED: "equilibrium was reached, but with inverted elements, which are not physical: use smaller loads, a "
    "stiffer volumetric energy or a finer mesh",
    STEP_CUT: "the step was halved as often as allowed and still failed: use smaller steps or robust = 'projected'; if "
    "a static body buckles or topples, use kind = 'dynamic'; if the body touches an obstacle, give this obstacle a "
    "lower stiffness",
    GRADIENT_UNCONVERGED: "a step did not converge, so the derivative is not the derivative of a solution: first "
    "change the run so that all steps converge (see Result.status)",
    ADJOINT_FAILED: "the linear solves of the derivative did not converge, and the derivative is not finite: use "
    "linear_solver = 'direct' or smaller steps",
    ONE_STEP: "with newton = 'one_step', the residual is above the tolerance after the only linear solve of the step: "
    "use smaller steps, a larger tolerance, or newton = 'converged'",
}


#: Short names of the result codes, for tables.
NAMES = {
    CONVERGED: "converged",
    STALLED: "stalled",
    NOT_FINITE: "not finite",
    INDEFINITE: "indefinite",
    INVERTED: "inverted",
    STEP_CUT: "step cut",
    GRADIENT_UNCONVERGED: "gradient unconverged",
    ADJOINT_FAILED: "adjoint failed",
    ONE_STEP: "one step",
}

#: All codes, from the least to the most severe.
SEVERITY = (
    CONVERGED, ONE_STEP, STALLED, INVERTED, INDEFINITE, STEP_CUT, GRADIENT_UNCONVERGED, ADJOINT_FAILED, NOT_FINITE,
)  # fmt: skip


def most_severe(codes: jax.Array | np.ndarray, axis: int | None = None) -> jax.Array:
    """Return the most severe of the codes, along one axis of the array or in the whole array (see `SEVERITY`).

    The numbers of the codes are not in the order of severity, so the largest code is not always the most severe.
    """
    ranks = jnp.asarray(np.argsort(SEVERITY), jnp.int32)
    return jnp.asarray(SEVERITY, jnp.int32)[jnp.max(ranks[jnp.asarray(codes, jnp.int32)], axis=axis)]


def advice(code: int) -> str:
    """Return one sentence of advice for a result code."""
    return ADVICE[int(code)]
