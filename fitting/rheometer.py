"""The module that users import for readers of frequency sweeps. It exports all names of `fitting.readers.rheometer`."""

from fitting.readers.rheometer import *  # noqa: F403
