"""Block matrices, Krylov methods, factorisation, preconditioner, Newton along a load, minimisation."""
