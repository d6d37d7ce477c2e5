"""Result codes of solves, each with a sentence of advice. Numbers inside jit, words on the host."""

CONVERGED = 0
STALLED = 1
NOT_FINITE = 2

ADVICE = {
    CONVERGED: "converged",
    STALLED: "the residual stopped falling above the tolerance: take smaller steps or a looser tolerance",
    NOT_FINITE: "a residual was not finite, usually an inverted element: take smaller loads or steps",
}


def advice(code: int) -> str:
    """One sentence for a result code."""
    return ADVICE[int(code)]
