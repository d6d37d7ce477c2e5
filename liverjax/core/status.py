"""Result codes of solves, and one sentence of advice for each. Inside jit there are only the codes."""

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
    STALLED: "the residual stopped falling above the tolerance: take a looser one (in float32, with very stiff "
    "springs or with very short time steps, rounding may allow no smaller residual), float64, or else smaller steps",
    NOT_FINITE: "a residual was not finite, usually an inverted element: take smaller loads or steps, or a law with "
    "continued_below; if it is a law of your own, look at it with `python -m liverjax check`",
    INDEFINITE: "the stiffness has a negative eigenvalue and no equilibrium was reached (it buckles, collapses, or is "
    "stiff in bulk): take linear_solver = 'direct' or volumetric = 'mixed' if bulk is far above mu, else smaller "
    "steps, robust = 'projected' or, for a static scene, kind = 'dynamic'",
    INVERTED: "in equilibrium, but with inverted elements, which no body has: take smaller loads, a stiffer volumetric "
    "energy or a finer mesh",
    STEP_CUT: "the step was halved as often as allowed and still failed: take smaller steps, robust = 'projected', "
    "kind = 'dynamic' where a static body buckles or topples, or a lower stiffness of an obstacle that sets its own",
    GRADIENT_UNCONVERGED: "the derivative passes through a step that did not converge, so it is not the one of a "
    "solution: mend the run first (Result.status)",
    ADJOINT_FAILED: "the linear solves of the derivative did not converge and it is not finite: take "
    "linear_solver = 'direct' or smaller steps",
    ONE_STEP: "newton = 'one_step' solved once and left the residual above the tolerance: take smaller steps, a looser "
    "tolerance, or newton = 'converged'",
}


#: Short words for tables.
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


def advice(code: int) -> str:
    """One sentence for a result code."""
    return ADVICE[int(code)]
