"""Factorisation of the sparse symmetric matrices of a mesh."""
