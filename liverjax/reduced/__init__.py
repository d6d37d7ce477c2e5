"""Reduced models: a scene's motions as sums of a few modes, its stresses at a few points, and the error of both."""
