"""Solvers: block matrices, Krylov methods, factorisation, preconditioners, Newton's method, energy minimisation."""
