"""Block matrices, Krylov methods, factorisation, preconditioners, Newton's method along a load, and minimisation."""
