"""Algebra of 3 x 3 matrices (one per element), material axes, principal stretches."""
