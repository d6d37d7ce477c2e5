"""The module that users import for the simulated rheometer: all of `fitting.rigs.torsion`."""

from fitting.rigs.torsion import *  # noqa: F403
