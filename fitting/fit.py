"""The module that users import for fits of frequency sweeps, with closed-form moduli or with a simulated rheometer."""

from fitting.fits.simulated_rheometer import *  # noqa: F403
from fitting.fits.viscoelastic import *  # noqa: F403
