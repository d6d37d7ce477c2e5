"""The module that users import for the simulated rheometer. It exports all names of `fitting.rigs.torsion`."""

from fitting.rigs.torsion import *  # noqa: F403
