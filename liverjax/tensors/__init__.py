"""Algebra of 3 x 3 matrices over elements, material axes, principal stretches."""
