"""Simulated tests: torsion in a rheometer; tension, indentation and creep of glued samples."""

from fitting.rigs.glued import Rig, creep, indentation, read, tension

__all__ = ["Rig", "creep", "indentation", "read", "tension"]
