"""Fits of frequency sweeps, under the name that users import: in closed form and through the simulated rheometer."""

from fitting.fits.simulated_rheometer import *  # noqa: F403
from fitting.fits.viscoelastic import *  # noqa: F403
