"""Reduced models: motions of a scene as sums of a few modes, stresses at a few points, and the error of both."""
