"""Fits of frequency sweeps under the name that users have: all of `fitting.fits.viscoelastic`."""

from fitting.fits.viscoelastic import *  # noqa: F403
