"""The simulated rheometer, under the name that users import: all of `fitting.rigs.torsion`."""

from fitting.rigs.torsion import *  # noqa: F403
