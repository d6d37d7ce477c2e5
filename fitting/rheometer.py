"""Readers of frequency sweeps, under the name that users import: all of `fitting.readers.rheometer`."""

from fitting.readers.rheometer import *  # noqa: F403
