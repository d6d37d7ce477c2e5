"""Algebra of 3 x 3 matrices (one matrix per element), material axes, principal stretches."""
