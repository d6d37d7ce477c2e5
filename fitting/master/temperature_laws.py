"""Laws for the dependence of the shift factors a_T on temperature: WLF and Arrhenius, with standard errors.

WLF: log10 a_T = -C1 (T - T0) / (C2 + T - T0), with constants C1 and C2. Arrhenius: ln a_T = E / R (1 / T - 1 / T0),
with the activation energy E and the gas constant R. T0 is the reference temperature. All temperatures are in kelvin.
Source: Williams, Landel and Ferry (1955), J. Am. Chem. Soc. 77.
"""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
import scipy.optimize

from fitting.master.shifts import Shifts

#: GAS: molar gas constant [J / (mol K)]. LEAST: additional standard error [decades] of log10 a_T. The square of LEAST
#: is added to the variances of given shift factors. For fitted shift factors, a tenth of LEAST is used.
GAS, LEAST = 8.314462618, 0.01


class TemperatureLaw(NamedTuple):
    """A law of the temperature dependence: its fitted parameters, and the distance of the shift factors from this
    law."""

    name: str
    numbers: dict[str, tuple[float, float]]  # name with unit of each parameter -> value and standard error
    apart: float  # root mean square distance of the shift factors from the law [decades]
    at: Callable[[np.ndarray], np.ndarray]  # function: temperatures [K] -> log10 a_T


def temperature_laws_of(shifts: Shifts) -> list[TemperatureLaw]:
    """Fit each law if there are enough temperatures for it. Return the fitted laws, best fit first. The Arrhenius law
    needs three temperatures, the WLF law four."""
    T = shifts.temperatures
    T0 = T[shifts.reference]
    if len(T) < 3:
        return []
    found = [_arrhenius(T, T0, shifts)]
    if len(T) >= 4:
        wlf = _wlf(T, T0, shifts)
        found += [wlf] if wlf is not None else []
    return sorted(found, key=lambda law: law.apart)


def reasons_for_missing_laws(shifts: Shifts, laws: list[TemperatureLaw]) -> list[str]:
    """Return a note if a law is missing in `laws`, the result of `temperature_laws_of`; otherwise an empty list."""
    count = len(shifts.temperatures)
    if count < 3:
        return [f"no law is fitted to {count} temperatures: Arrhenius needs three, and WLF needs four"]
    if count < 4:
        return [f"WLF needs four temperatures, and there are {count}"]
    if all(law.name != "WLF" for law in laws):
        return ["WLF is left out: the shift factors do not curve over the temperature as in this law"]
    return []


def _whitening(shifts: Shifts) -> np.ndarray:
    """Return the whitening matrix W (K - 1, K) for the log shift factors of K sweeps. If W is multiplied by the errors
    of these factors, the entries of the product are independent with variance 1. The covariance of the errors contains
    the variance from `LEAST`. The factor of the reference has no error."""
    free = np.arange(len(shifts.log_a)) != shifts.reference
    least = LEAST if shifts.given else 0.1 * LEAST
    C = shifts.covariance[np.ix_(free, free)] + least**2 * np.eye(free.sum())
    return np.linalg.inv(np.linalg.cholesky(C)) @ np.eye(len(free))[free]


def _noise(off: np.ndarray, numbers: int, given: bool) -> float:
    """Return the factor that multiplies the covariance of the parameters of a law. It is computed from the whitened
    residuals `off`. `numbers`: number of parameters. The factor is at least 1, unless the shift factors were given."""
    found = float(off @ off) / max(1, len(off) - numbers)
    return found if given else max(1.0, found)


def _arrhenius(T: np.ndarray, T0: float, shifts: Shifts) -> TemperatureLaw:
    x, W = (1 / T - 1 / T0) / (GAS * np.log(10)), _whitening(shifts)
    energy = float((W @ x) @ (W @ shifts.log_a) / np.sum((W @ x) ** 2))
    off = energy * x - shifts.log_a
    error = float(np.sqrt(_noise(W @ off, 1, shifts.given) / np.sum((W @ x) ** 2)))

    def at(T: np.ndarray) -> np.ndarray:
        return energy * (1 / T - 1 / T0) / (GAS * np.log(10))

    numbers = {"activation_energy_J_per_mol": (energy, error)}
    return TemperatureLaw("Arrhenius", numbers, float(np.sqrt(np.mean(off**2))), at)


def _wlf(T: np.ndarray, T0: float, shifts: Shifts) -> TemperatureLaw | None:
    """Fit the WLF law. Return None if the fitted C1 is not between 0 and 1000, or if C2 is not below 10,000 K. This
    happens if the curve of log a_T over the temperature and the WLF law have curvatures of opposite sign."""
    W = _whitening(shifts)

    # C2 must stay above T0 minus the lowest temperature, because the law has a pole at T0 - C2.
    lowest = T0 - T.min()

    def curve(u: np.ndarray, T: np.ndarray) -> np.ndarray:
        return -u[0] * (T - T0) / (np.exp(u[1]) + lowest + T - T0)

    best = None
    for first in (np.log(5.0), np.log(50.0), np.log(300.0)):
        got = scipy.optimize.least_squares(lambda u: W @ (curve(u, T) - shifts.log_a), [10.0, first], method="lm")
        best = got if best is None or got.cost < best.cost else best
    assert best is not None
    c1, c2 = float(best.x[0]), float(np.exp(best.x[1]) + lowest)
    if not (0 < c1 < 1e3 and c2 < 1e4):
        return None
    noise = _noise(best.fun, 2, shifts.given)
    covariance = np.linalg.pinv(best.jac.T @ best.jac) * noise
    errors = np.sqrt(np.diag(covariance)) * np.array([1.0, np.exp(best.x[1])])
    off = curve(best.x, T) - shifts.log_a
    numbers = {"C1": (c1, float(errors[0])), "C2_K": (c2, float(errors[1]))}
    return TemperatureLaw("WLF", numbers, float(np.sqrt(np.mean(off**2))), lambda T: curve(best.x, T))
