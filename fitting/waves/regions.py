"""Find the complex moduli of the regions of an organ from measured waves, with their uncertainty. Each frequency is
fitted separately."""

import math
from collections.abc import Callable
from typing import NamedTuple

import numpy as np
import scipy.optimize
import scipy.sparse

from fitting.waves import balance
from fitting.waves.balance import Balanced, Matrices
from fitting.waves.correlated_noise import Correlation, correlation
from fitting.waves.edges import RegionMatrices

#: The starting point of a search is chosen from several storage moduli. WAVE_VOXELS, WAVE_BODIES: the wavelengths of
#: shear waves with these moduli go from WAVE_VOXELS voxels to WAVE_BODIES lengths of the body. MODULI_APART: largest
#: ratio between two neighbouring moduli. ROUGHLY: the best modulus is then found with this relative accuracy. LOSS:
#: ratio of loss to storage modulus at the starting point.
WAVE_VOXELS, WAVE_BODIES, MODULI_APART, ROUGHLY, LOSS = 4.0, 6.0, 3.0, 0.3, 0.3
#: ITERATIONS: maximum number of iterations. ENOUGH: the iterations end if the next change of each modulus, divided by
#: the standard error of this modulus, is below this value.
ITERATIONS, ENOUGH = 20, 0.1
#: If the noise is larger than the given noise by more than this factor, the search for moduli and edges is repeated
#: with the larger noise.
NOISIER = 1.2


class MeasuredWaves(NamedTuple):
    """Measured motion at the V nodes of a body at F frequencies."""

    omega: np.ndarray  # (F,) [rad/s]
    motion: np.ndarray  # (F, 3 V) complex [m], x, y, z of a node together
    sd: np.ndarray  # (F,) [m], standard deviation of the noise in real and imaginary part of one component


class Regions(NamedTuple):
    """Moduli of R regions at F frequencies."""

    modulus: np.ndarray  # (F, R) complex [Pa]
    covariance: np.ndarray  # (F, 2 R, 2 R) [Pa^2]: storage moduli of all regions, then loss moduli
    farther: np.ndarray  # (F, R) mean outward shift of the edges, relative to the labels [voxels]
    chi2: np.ndarray  # (F,) chi^2 for the fitted moduli
    components: int  # number of real equations in chi^2 of one frequency
    iterations: np.ndarray  # (F,) number of Gauss-Newton iterations
    converged: np.ndarray  # (F,) bool: whether the iterations converged
    correlations: tuple[Correlation, ...] = ()  # correlation of the noise at each frequency, if it was computed
    # (F, R) part of `standard_errors` that is due to the uncertain edges, not to the noise
    edge_errors: np.ndarray = np.zeros((1, 1))

    @property
    def noise_factor(self) -> np.ndarray:
        """Errors of the moduli (F, R), divided by their errors for white noise with the given standard deviations (at
        least 1).

        Without an estimate of the correlation, the factor is sqrt(chi^2 / number of equations). If the noise is
        correlated, the factor is `Correlation.enlarged`. If the noise is not correlated, the factor is the product of
        `Correlation.enlarged` and this square root.
        """
        factor = np.repeat(np.maximum(1.0, np.sqrt(self.chi2 / self.components))[:, None], self.modulus.shape[1], 1)
        for f, own in enumerate(self.correlations):
            # Even without correlated noise, two parts of the body have the same noise at their common voxels.
            factor[f] = np.maximum(1.0, own.enlarged if own.seen else factor[f] * own.enlarged)
        return factor

    @property
    def standard_errors(self) -> np.ndarray:
        """Standard errors (F, R) [Pa] of the moduli. Real part: storage modulus; imaginary part: loss modulus."""
        R = self.modulus.shape[1]
        sd = np.tile(self.noise_factor, 2) * np.sqrt(np.diagonal(self.covariance, axis1=1, axis2=2))
        errors = np.empty(self.modulus.shape, complex)
        errors.real, errors.imag = sd[:, :R], sd[:, R:]  # the sum sd + 1j * sd would be NaN if sd is infinite
        return errors


class _State(NamedTuple):
    """The most probable motion for given moduli G (R,), with the gradient and the Gauss-Newton Hessian of chi^2 / 2."""

    G: np.ndarray
    here: Balanced
    gradient: np.ndarray  # (2 R + P,): R storage moduli, R loss moduli, and shifts of the P patches of the edges
    hessian: np.ndarray  # (2 R + P, 2 R + P)


def first_modulus(m: Matrices, waves: MeasuredWaves, density: float, voxel: float, length: float) -> float:
    """Return a rough storage modulus [Pa] of the whole body, from which the search for the moduli starts. This modulus
    has the lowest chi^2 at the frequency with the largest ratio of motion to noise. The loss modulus is `LOSS` times
    the storage modulus.

    The moduli that are tried follow from the wavelengths that the voxels can show. So the order of magnitude of these
    moduli is right for all units of the data.

    Args:
        m: result of `balance.matrices`.
        waves: the measured waves.
        density: [kg/m^3].
        voxel: smallest distance between neighbouring voxels [m].
        length: longest side of the body [m].
    """
    clearest = int(np.argmax(np.mean(np.abs(waves.motion) ** 2, axis=1) / waves.sd**2))
    omega, motion, sd = waves.omega[clearest], waves.motion[clearest], waves.sd[clearest]
    ends = density * (omega / (2 * np.pi) * np.array([WAVE_VOXELS * voxel, WAVE_BODIES * length])) ** 2
    number = 1 + math.ceil(math.log(ends[1] / ends[0]) / math.log(MODULI_APART))
    every = np.ones(m.rows.shape[-1])

    def out_of_balance(logarithm: float) -> float:
        modulus = math.exp(logarithm)
        # Multiplying the equations by this ratio gives the same chi^2 as a pressure term for this modulus.
        C = balance.rows_of_balance(m, modulus * (1 + LOSS * 1j) * every, omega) * (m.typical / modulus)
        return balance.likeliest(C, m.pressure, motion, sd).chi2

    tried = np.log(np.geomspace(ends[0], ends[1], number))
    best = int(np.argmin([out_of_balance(each) for each in tried]))
    near = tried[max(best - 1, 0)], tried[min(best + 1, number - 1)]
    found = scipy.optimize.minimize_scalar(out_of_balance, bounds=near, method="bounded", options={"xatol": ROUGHLY})
    return math.exp(found.x)


def moduli_of_regions(
    m: RegionMatrices,
    waves: MeasuredWaves,
    start: np.ndarray,
    progress: Callable[[int, float], None] = lambda iteration, cost: None,
    voxel: np.ndarray | None = None,
) -> Regions:
    """Find the moduli by the Gauss-Newton method, separately for every frequency.

    The positions of the edges between regions are also unknowns (`edge_places`). If the noise turns out to be larger
    than given, the search is repeated with the larger noise. Otherwise the edges would follow the noise.

    Args:
        m: matrices from `edges.region_matrices`.
        waves: the measured waves.
        start: starting point of the search: the complex modulus of each region [Pa], (R,), or (F, R) with separate
            moduli for each frequency. If the search converged at a lower frequency, it starts from the moduli that were
            found there (at the nearest such frequency). If it does not converge from there, it starts again from
            `start`. The result of the second search is used only if it converges.
        progress: function that is called after every iteration, with the number of the iteration and chi^2 per
            equation.
        voxel: voxel index of each node (V, 3), needed to estimate the correlation of the noise. If it is None, the
            noise is assumed to be white.
    """
    found, before = [], None
    for f, own in enumerate(np.broadcast_to(start, (len(waves.omega), np.shape(start)[-1])).astype(complex)):
        *one, now = _one_frequency(m, waves, f, own if before is None else before, progress)
        if before is not None and not one[-1]:
            *again, then = _one_frequency(m, waves, f, own, progress)
            one, now = (again, then) if again[-1] else (one, now)
        fit = _with_errors(m, waves, f, (one, now), 1.0, voxel)
        factor = float(np.mean(fit.noise_factor))
        if len(m.patches.region) and factor > NOISIER:
            *again, then = _one_frequency(m, waves._replace(sd=factor * waves.sd), f, one[0], progress)
            if again[-1]:
                one = [*again[:-2], one[-2] + again[-2], True]
                fit = _with_errors(m, waves, f, (one, then), factor, voxel)
        found.append(fit)
        before = one[0] if one[-1] else before
    names = [name for name in Regions._fields if name not in ("components", "correlations")]
    joined = {name: np.concatenate([getattr(fit, name) for fit in found]) for name in names}
    return Regions(components=m.balances, correlations=tuple(c for fit in found for c in fit.correlations), **joined)


def _with_errors(m, waves, f, result, factor, voxel) -> Regions:
    """Return the moduli at frequency number f with their errors. `result`: results of `_one_frequency` for noise that
    is `factor` times the given noise, and the last state. `voxel`: see `moduli_of_regions`."""
    (G, covariance, farther, chi2, iterations, converged), now = result
    R = len(G)
    correlations: tuple[Correlation, ...] = ()
    if voxel is not None:
        given = m.by_moduli(now.here.motion), waves.motion[f], waves.sd[f], voxel
        correlations = (correlation(m.rows(G, waves.omega[f]), now.here, *given),)
    own = {"modulus": G, "covariance": covariance, "farther": farther, "chi2": chi2 * factor**2}
    own |= {"iterations": iterations, "converged": converged}
    joined = {name: np.array([value]) for name, value in own.items()}
    fit = Regions(components=m.balances, correlations=correlations, **joined)
    by_noise = _covariance_of(now.hessian[: 2 * R, : 2 * R])  # the covariance if the edges were known
    by_edges = np.where(np.isfinite(by_noise), covariance, 0.0) - np.where(np.isfinite(by_noise), by_noise, 0.0)
    larger = np.tile(fit.noise_factor[0], 2)
    if factor == 1.0:
        by_edges = by_edges * np.outer(larger, larger)
    else:  # `noise_factor` multiplies the covariance, but the uncertainty of the edges does not grow with the noise
        fit = fit._replace(covariance=(by_noise / factor**2 + by_edges / np.outer(larger, larger))[None])
    sd = np.sqrt(np.maximum(np.diagonal(by_edges), 0.0))
    return fit._replace(edge_errors=(sd[:R] + 1j * sd[R:])[None])


def _one_frequency(m, waves, f, G, progress):
    """Fit the waves at frequency number f. Return moduli (R,), covariance (2 R, 2 R), mean shifts of the edges (R,),
    chi^2, number of iterations, whether the search converged, and the last state."""
    R, at = len(G), (waves.omega[f], waves.motion[f], waves.sd[f])
    now, converged, k = _state_of_regions(m, G, *at), False, 0
    labels = _of_labels(m, R)
    step, covariance = _gauss_newton(now, labels)
    for k in range(1, ITERATIONS + 1):
        both = step[:R] + 1j * step[R : 2 * R]
        part = min(1.0, 0.5 / max(np.max(np.abs(both / now.G)), 1e-300))  # one step changes a modulus by at most 50 %
        new = None
        # The most probable positions of the edges change with the moduli, which also changes chi^2. So chi^2 does not
        # show whether a step shorter than a standard error is an improvement.
        close = _in_errors(step, covariance, R) < 1
        for _ in range(8):
            if np.all((now.G + part * both).real > 0):
                new = _state_of_regions(m, now.G + part * both, *at)
                if close or _least(new, labels) <= _least(now, labels) * (1 + 1e-10):
                    break
                new = None
            part *= 0.5
        if new is None:
            break
        now = new
        progress(k, now.here.chi2 / m.balances)
        step, covariance = _gauss_newton(now, labels)
        converged = _in_errors(step, covariance, R) < ENOUGH
        if converged or part < 1e-2:
            break
    farther = m.patches.means(step[2 * R :], R)
    return now.G, covariance[: 2 * R, : 2 * R], farther, now.here.chi2, k, converged, now


def _in_errors(step: np.ndarray, covariance: np.ndarray, R: int) -> float:
    """Divide the steps of the 2 R storage and loss moduli by the standard errors of these moduli, and return the
    largest ratio."""
    return float(np.max(np.abs(step[: 2 * R]) / np.sqrt(np.diagonal(covariance)[: 2 * R])))


def _gauss_newton(now: _State, labels: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the Gauss-Newton step (2 R + P,) of storage moduli, loss moduli and edge shifts, and the covariance of
    these unknowns.

    In every step, the edges start from the labels, because the equations are nearly linear in the positions of the
    edges. The derivatives with respect to the moduli are also computed with these edges. If the most probable edges
    were used instead, the errors of the edges would count twice, and the modulus of a cylinder with a radius of 2.5
    voxels would be 1 % larger.
    """
    H = now.hessian + labels
    silent = np.diagonal(H) == 0  # the region has no element
    H[silent, silent] = 1.0
    return -np.linalg.solve(H, now.gradient), _covariance_of(now.hessian + labels)


def _covariance_of(H: np.ndarray) -> np.ndarray:
    """Return the inverse of a Hessian. The variance of an unknown without information is infinite."""
    silent = np.diagonal(H) == 0
    inverse = np.linalg.inv(H + np.diag(silent.astype(float)))
    inverse[silent, silent] = np.inf
    return inverse


def _of_labels(m: RegionMatrices, R: int) -> np.ndarray:
    """Return the prior inverse covariance (2 R + P, 2 R + P) of moduli and edge shifts. The result is 0 for the moduli.
    For the shifts it is the inverse of `Patches.covariance`."""
    P = len(m.patches.region)
    out = np.zeros((2 * R + P, 2 * R + P))
    out[2 * R :, 2 * R :] = np.linalg.inv(m.patches.covariance)
    return out


def _least(now: _State, labels: np.ndarray) -> float:
    """Return the minimum of chi^2 plus the prior term of the edge shifts, over all edge shifts, for the moduli of `now`
    (quadratic approximation)."""
    R = len(now.G)
    g, H = now.gradient[2 * R :], (now.hessian + labels)[2 * R :, 2 * R :]
    return float(now.here.chi2 - g @ np.linalg.solve(H, g))


def _state_of_regions(m: RegionMatrices, G: np.ndarray, omega: float, motion: np.ndarray, sd: float) -> _State:
    d = np.concatenate([motion, np.zeros(m.kinks)])
    spread = np.ones(len(d))
    spread[len(motion) :] = np.mean(np.abs(motion) ** 2) / sd**2
    here = balance.likeliest(m.rows(G, omega), m.pressure, d, sd, spread)
    R, J = len(G), np.concatenate([m.by_moduli(here.motion), m.by_edges(here, G, omega)], axis=1)
    g = (J.conj().T @ here.multipliers) / sd**2
    X = here.whitened(scipy.sparse.csc_array(J))
    # The derivative with respect to a loss modulus is i times the derivative with respect to the storage modulus.
    X = np.concatenate([X[:, :R], 1j * X[:, :R], X[:, R:]], axis=1)
    gradient = np.concatenate([g[:R].real, g[:R].imag, g[R:].real])
    return _State(G, here, gradient, np.real(X.conj().T @ X) / sd**2)
