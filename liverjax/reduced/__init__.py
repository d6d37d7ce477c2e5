"""Reduced models: the motion of a scene is a sum of a few modes, stresses are evaluated at a few points, and the error
of both approximations is estimated."""
