"""Block matrices, Krylov methods, factorisation, preconditioner, Newton, continuation, minimisation."""
