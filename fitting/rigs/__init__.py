"""Simulated tests: torsion in a rheometer, and tension, indentation and creep of samples that are glued to plates."""

from fitting.rigs.glued import Cells, Rig, creep, indentation, mesh_error, read, tension

__all__ = ["Cells", "Rig", "creep", "indentation", "mesh_error", "read", "tension"]
