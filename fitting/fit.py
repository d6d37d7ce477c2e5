"""The module that users import for fits of frequency sweeps, in closed form and by a simulation of the rheometer."""

from fitting.fits.simulated_rheometer import *  # noqa: F403
from fitting.fits.viscoelastic import *  # noqa: F403
