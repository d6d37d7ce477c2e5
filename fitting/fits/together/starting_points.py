"""Starting points for a common fit of several tests."""

import numpy as np

from fitting.fits import time_tests
from fitting.fits.together.measured_tests import Measured, ResolvedBand
from fitting.fits.viscoelastic import FLUID, Kind
from fitting.methods import generalised_maxwell
from fitting.readers.frequency_sweep import Sweep
from fitting.readers.time_tests import TimeTest
from fitting.waves import shear_waves
from fitting.waves.dispersion import Dispersion

#: Number of starting points.
STARTS = 6


def starts_of_all(tests: list[Measured], band: ResolvedBand, modes: int, kind: Kind) -> np.ndarray:
    """Return S starting points (S, P) of the P variables, with relaxation times that are spread over the decades of the
    tests. The strengths are fitted to the moduli of the tests by non-negative least squares."""
    out = []
    for times in generalised_maxwell.times_over(band.resolved, modes, STARTS):
        A, b = (np.concatenate(rows) for rows in zip(*(_apparent(t, times) for t in tests), strict=True))
        u = generalised_maxwell.start_at_times(times, A, b)
        out.append(generalised_maxwell.fluid_of(u) if kind.name == FLUID.name else u)
    return np.stack(out)


def _apparent(test: Measured, times: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the matrix and the right-hand side of a linear least-squares problem for the moduli of a test, with
    relative residuals. The unknowns are the equilibrium modulus and the strengths of modes with the relaxation `times`
    [s]."""
    if isinstance(test, TimeTest):
        return time_tests.apparent_equations(test, times)
    b = np.concatenate(_moduli_of(test))
    A = generalised_maxwell.mode_columns(test.angular_frequency, times)[: len(b)]
    return A / b[:, None], np.ones(len(b))


def _moduli_of(test: Sweep | Dispersion) -> tuple[np.ndarray, ...]:
    """Return G' and G'' [Pa]. From velocities without attenuations, only one modulus is computed, which is about
    |G*|."""
    if isinstance(test, Sweep):
        return test.storage, test.loss
    if test.attenuation is None:
        return (test.density * test.velocity**2,)
    found = shear_waves.moduli_of(test.velocity, test.attenuation, test.angular_frequency, test.density)
    # Noise can make moduli negative, but a fit cannot begin from negative moduli. Small positive moduli replace them.
    return tuple(np.maximum(G, 1e-2 * np.abs(found[0]).max()) for G in found)
