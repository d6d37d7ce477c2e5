"""The module that users import for fits of several tests: all of `fitting.fits.joint`."""

from fitting.fits.joint import *  # noqa: F403
