"""Complex moduli of the regions of an organ from its waves, at each frequency by itself, with their uncertainty."""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
import scipy.sparse

from fitting.waves import balance
from fitting.waves.balance import Balanced, Matrices

#: Moduli [Pa] at which a search begins, and the loss over storage there.
STARTS, LOSS = np.geomspace(500.0, 40500.0, 5), 0.3
#: Iterations, and the step of a modulus over its standard error that is not worth to be made.
ITERATIONS, ENOUGH = 20, 0.1


class MeasuredWaves(NamedTuple):
    """Measured motion at the nodes of a body."""

    omega: np.ndarray  # (F,) [rad/s]
    motion: np.ndarray  # (F, 3 V) complex [m], x, y, z of a node together
    sd: np.ndarray  # (F,) [m], of real and of imaginary part of one component


class Regions(NamedTuple):
    """Moduli of R regions at F frequencies."""

    modulus: np.ndarray  # (F, R) complex [Pa]
    covariance: np.ndarray  # (F, R, R) complex [Pa^2]: of real parts and of imaginary parts each, both the same
    chi2: np.ndarray  # (F,)
    components: int  # of one frequency
    iterations: np.ndarray  # (F,)
    converged: np.ndarray  # (F,) bool

    @property
    def noise_factor(self) -> np.ndarray:
        """How much larger the residuals are than the noise (F,), at least 1; errors are enlarged by it."""
        return np.maximum(1.0, np.sqrt(self.chi2 / self.components))

    @property
    def standard_errors(self) -> np.ndarray:
        """Standard errors of storage and of loss (F, R) [Pa]."""
        variance = np.real(np.diagonal(self.covariance, axis1=1, axis2=2))
        return self.noise_factor[:, None] * np.sqrt(variance)


def first_modulus(m: Matrices, waves: MeasuredWaves) -> complex:
    """The modulus [Pa] of `STARTS` with the smallest forces out of balance at the lowest frequency."""
    ones = np.ones(m.rows.shape[-1])

    def out_of_balance(G):
        at = waves.omega[0], waves.motion[0], waves.sd[0]
        return balance.balanced(m, G * ones, *at).chi2

    return min(STARTS * (1 + LOSS * 1j), key=out_of_balance)


def moduli_of_regions(
    m: Matrices,
    waves: MeasuredWaves,
    shares: np.ndarray,
    start: np.ndarray,
    progress: Callable[[int, float], None] = lambda iteration, cost: None,
) -> Regions:
    """Moduli by Gauss-Newton, every frequency by itself.

    Args:
        m: `balance.matrices`.
        waves: what was measured.
        shares: part of each element that is in each region (E, R); see `geometric`.
        start: complex modulus of each region (R,) [Pa], of the lowest frequency.
        progress: told of every iteration: its number, and chi^2 over the number of components.
    """
    found, G = [], np.asarray(start, complex)
    for f in range(len(waves.omega)):
        found.append(_one_frequency(m, waves, f, shares, G, progress))
        G = found[-1][0]
    G, covariance, chi2, iterations, converged = (np.array(each) for each in zip(*found, strict=True))
    return Regions(G, covariance, chi2, m.balances, iterations, converged)


def geometric(shares: np.ndarray, G: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Moduli of elements (E,) from shares (E, R) and moduli of regions (R,) [Pa], and their derivatives (E, R).

    They lie between springs in a row, the least that a mixture can have, and springs side by side, the most.
    """
    elements = np.exp(shares @ np.log(G))
    return elements, elements[:, None] * shares / G


def side_by_side(shares: np.ndarray, G: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The same as `geometric` with arithmetic means."""
    return shares @ G, shares


def moved_by_mixing(m: Matrices, waves: MeasuredWaves, shares: np.ndarray, modulus: np.ndarray) -> np.ndarray:
    """Change of moduli (F, R) [Pa] if `side_by_side` took the place of `geometric`: one step of Gauss-Newton."""
    out = np.empty_like(modulus)
    for f, G in enumerate(modulus):
        elements, by_regions = side_by_side(shares, G)
        here = balance.balanced(m, elements, waves.omega[f], waves.motion[f], waves.sd[f])
        out[f] = _gauss_newton(m, here, by_regions, waves.sd[f])[0]
    return out


def _one_frequency(m, waves, f, shares, G, progress):
    """Modulus (R,), covariance (R, R), chi^2, iterations, and whether they ended by themselves."""
    at = waves.omega[f], waves.motion[f], waves.sd[f]
    elements, by_regions = geometric(shares, G)
    here, converged, k = balance.balanced(m, elements, *at), False, 0
    step, H = _gauss_newton(m, here, by_regions, waves.sd[f])
    for k in range(1, ITERATIONS + 1):
        part = min(1.0, 0.5 / max(np.max(np.abs(step / G)), 1e-300))  # a modulus changes by half of itself at most
        for _ in range(8):
            elements, by_regions = geometric(shares, G + part * step)
            new = balance.balanced(m, elements, *at)
            if new.chi2 <= here.chi2 * (1 + 1e-10):
                break
            part *= 0.5
        else:
            break
        G, here = G + part * step, new
        progress(k, here.chi2 / m.balances)
        step, H = _gauss_newton(m, here, by_regions, waves.sd[f])
        converged = bool(np.all(np.abs(step) < ENOUGH * np.sqrt(np.real(np.diagonal(np.linalg.inv(H))))))
        if converged or part < 1e-2:
            break
    return G, np.linalg.inv(H), here.chi2, k, converged


def _gauss_newton(m: Matrices, here: Balanced, by_regions: np.ndarray, sd: float) -> tuple[np.ndarray, np.ndarray]:
    """The step of Gauss-Newton (R,), and the Hessian (R, R) of chi^2 / 2, with derivatives (E, R) of the moduli."""
    J = (balance.by_modulus(m, here.motion) @ scipy.sparse.csc_array(by_regions)).tocsc()
    X = here.whitened(J)
    H = X.conj().T @ X / sd**2
    g = J.conj().T @ here.multipliers / sd**2
    return -np.linalg.solve(H, g), H
