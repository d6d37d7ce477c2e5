"""The module that users import for fits of several tests. It exports all names of `fitting.fits.joint`."""

from fitting.fits.joint import *  # noqa: F403
