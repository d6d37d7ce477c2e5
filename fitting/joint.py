"""Fits of several tests, under the name that users import: all of `fitting.fits.joint`."""

from fitting.fits.joint import *  # noqa: F403
