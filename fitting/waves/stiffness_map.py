"""Compute a map of the complex modulus from measured waves: a smooth field, and its uncertainty.

At frequency f the complex modulus of an element is G = g_f exp(c + l_f). Here g_f is the modulus of a uniform organ
that is fitted to the same waves. The real part of the exponent is ln(|G| / |g_f|), and the imaginary part is the
difference of the loss angles of G and g_f. The term c is the mean of a complex field over the element. The field has
values at P corners, and is the same for all frequencies. The real and the imaginary part of this field have the prior
of `fitting.methods.prior`, with the same standard deviation. Each frequency has a complex unknown l_f, the level, with
the prior mean 0 and the prior standard deviation `LEVEL`. The levels are needed because the ratios between the values
g_f may be wrong if the organ is not uniform. With only one frequency there is no level, because a level would have the
same effect as the mean of c.

The data depend only on the means of the field over the elements. A field with opposite signs at neighbouring corners
has the mean 0 in every element, so the data do not determine such a field. Near a jump of the modulus, the most
probable field contains such an alternating field. Therefore the map shows the field after the filter 2 A - A A, where A
is the mean of c over the elements around a corner. This filter removes the alternating field, and hardly changes a
smooth field.

The prior standard deviation of c is increased step by step. The increase ends when chi^2 is as low as the number of
equations (discrepancy principle; Morozov 1966), or when the logarithm of the evidence, -(chi^2/n + |z|^2)/2 - ln det H,
decreases. Here z is the whitened field: c and the levels, transformed so that the prior covariance is the unit matrix.
n is chi^2 divided by its expected value (at least 1). The Hessian is H = I + J^H J/n, where J is the derivative of the
whitened unbalanced forces with respect to z. The standard deviation with the highest evidence is used. For each
standard deviation, the Gauss-Newton method minimises chi^2/2 + |z|^2/2. A search ends if the next step is shorter than
`NEAR` standard deviations of the map.

The uncertainty has two parts. The first part comes from the Hessian H. This part is larger if the noise of neighbouring
voxels is correlated (`fitting.waves.correlated_noise`). The second part is needed because the position of a jump of the
modulus is not known exactly. The prior smooths a jump over a width w: the correlation length, or the side of a brick if
the side is longer. The jump may lie anywhere within this width, so the variance of its position is w^2/12. So
|w dc/dx|^2/12 is added to the variance of c.
"""

import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import NamedTuple

import h5py
import numpy as np
import scipy.linalg
import scipy.sparse

from fitting.methods import prior as smooth
from fitting.waves import balance
from fitting.waves.balance import Balanced, Matrices
from fitting.waves.correlated_noise import correlation
from fitting.waves.regions import MeasuredWaves
from fitting.waves.voxels import VoxelBody, changes_over_slopes, mean_around_corners, mean_of_corners
from liverjax.core.errors import InputError
from liverjax.core.files import mark_of, refuse_other, whole
from liverjax.core.struct import Content

#: Prior standard deviations of c that are tried: from a nearly uniform organ to an organ with a strongly varying
#: modulus.
DEVIATIONS = (0.2, 0.4, 0.8)
#: Prior standard deviation of the real and of the imaginary part of l_f (the level: one complex unknown per frequency).
LEVEL = 0.5
#: STEPS: maximum number of Gauss-Newton steps for each of `DEVIATIONS`. NEAR: a search ends if the next step is shorter
#: than this. FAR: a map has converged if the next step is shorter than this. The unit of NEAR and FAR is one standard
#: deviation of the map.
STEPS, NEAR, FAR = 40, 0.1, 0.2
#: The search is repeated if the square roots of chi^2 per equation of two frequencies differ by more than this factor.
UNEQUAL = 1.5
#: The Hessian is computed again if a step is longer than this fraction of the step before. The search is then too far
#: from the point at which the last Hessian was computed.
_SLOW = 0.3


class WaveMap(NamedTuple):
    """Map of the complex modulus at F frequencies and P corners, and its uncertainty."""

    exponent: np.ndarray  # (F, P) complex: c + l_f, log of the modulus divided by that of a uniform organ
    sd: np.ndarray  # (F, P) complex. Real part: sd of ln |G|; imaginary part: sd of the loss angle
    posterior_sd: np.ndarray  # (F, P) sd of real and of imaginary part of c + l_f, without uncertainty of positions
    prior_sd: np.ndarray  # (F, P) sd of the same quantities before the data are used
    change: np.ndarray  # (P,) change of ln |G| over the width w along the gradient of the map
    draws: np.ndarray  # (D, F, P) complex: D posterior samples of c + l_f, moved by random parts of the width w
    modulus: np.ndarray  # (F, P) complex [Pa]
    deviation: float  # chosen prior standard deviation of c
    length: float  # correlation length of the prior [m]
    chi2_of_frequencies: np.ndarray  # (F,) chi^2 of each frequency
    components: int  # number of real equations in all chi^2 together
    noise_factor: np.ndarray  # (F,) errors of the map, divided by those for white noise with the given sd
    reached: bool  # whether chi2 is at most `components`
    distance: float  # distance to the minimum: length of the next step, in standard deviations of the map
    history: list[dict[str, float]]
    seconds: float

    @property
    def chi2(self) -> float:
        """Sum of chi^2 over the frequencies."""
        return float(np.sum(self.chi2_of_frequencies))

    @property
    def white_factor(self) -> np.ndarray:
        """Square root (F,) of chi^2 per equation at each frequency, at least 1."""
        number = len(self.chi2_of_frequencies)
        return np.sqrt(np.maximum(1.0, self.chi2_of_frequencies * number / self.components))


class Course(NamedTuple):
    """Input of a search for a map, which is the same in all steps. There are F frequencies, E elements, P corners and L
    levels."""

    m: Matrices
    waves: MeasuredWaves
    whole: np.ndarray  # (F,) complex: modulus g_f of the uniform organ at each frequency [Pa]
    # F matrices (E, P + L). The product with (c, L levels) gives c + l_f of the E elements.
    exponents: tuple[scipy.sparse.csr_array, ...]
    # 3 matrices (P, P). The product with c (the field of the exponent at the corners) gives the change of c along x, y
    # or z over w, the width over which the prior smooths a jump.
    slopes: tuple[scipy.sparse.csr_array, ...]
    shown: scipy.sparse.csr_array  # matrix (P, P) of the filter 2 A - A A (module docstring)
    p: smooth.Prior
    length: float  # correlation length of the prior [m]
    voxel: np.ndarray | None = None  # (V, 3) voxel index of each node; None: white noise is assumed

    @property
    def corners(self) -> int:
        """Number P of corners."""
        return len(self.p.root_mass)

    def moduli(self, y: np.ndarray) -> list[np.ndarray]:
        """Return the complex moduli (E,) [Pa] of the elements for each frequency. y (P + L,) contains c at the corners,
        then the levels."""
        return [g * np.exp(own @ y) for g, own in zip(self.whole, self.exponents, strict=True)]

    def at(self, y: np.ndarray) -> list[Balanced]:
        """Return the most probable motion for each frequency, for given y (see `moduli`)."""
        w = self.waves
        each = zip(self.moduli(y), w.omega, w.motion, w.sd, strict=True)
        return [balance.balanced(self.m, *own) for own in each]

    def jacobians(self, y: np.ndarray, here: list[Balanced]) -> list[scipy.sparse.csc_array]:
        """Return for each frequency the derivatives (I, P + L) of the unbalanced forces with respect to y, divided by
        the standard deviation of the noise."""
        each = zip(self.moduli(y), self.exponents, here, self.waves.sd, strict=True)
        return [
            (balance.by_modulus(self.m, b.motion) @ scipy.sparse.diags_array(G) @ own).tocsc() / sd
            for G, own, b, sd in each
        ]

    def scales(self, k: int) -> np.ndarray:
        """Return factors (P + L,) for the prior standard deviation `DEVIATIONS[k]`: y is `natural`(z) times these
        factors."""
        return np.where(np.arange(self.exponents[0].shape[1]) < self.corners, DEVIATIONS[k], 1.0)

    def natural(self, z: np.ndarray) -> np.ndarray:
        """Return y (c at the corners, then the levels) for a whitened complex field z, (P + L,) or (P + L, n). For this
        y, the prior standard deviation of c is 1, and that of the levels is `LEVEL`."""
        c, levels = z[: self.corners], LEVEL * z[self.corners :]
        return np.concatenate(
            [smooth.field_at_nodes(self.p, c.real) + 1j * smooth.field_at_nodes(self.p, c.imag), levels]
        )

    def whitened(self, g: np.ndarray) -> np.ndarray:
        """Return T^T g, (P + L,) or (P + L, n), where T is the real matrix of `natural`. This converts a gradient with
        respect to y into the gradient with respect to z."""
        c, levels = g[: self.corners], LEVEL * g[self.corners :]
        return np.concatenate([smooth.to_whitened(self.p, c.real) + 1j * smooth.to_whitened(self.p, c.imag), levels])

    def by_frequency(self, y: np.ndarray) -> np.ndarray:
        """Return c + l_f at the corners (F, P, …), from y (P + L, …)."""
        c, levels = self.shown @ y[: self.corners], y[self.corners :]
        return c[None] + (levels[:, None] if len(levels) else np.zeros((1, 1, *y.shape[1:])))

    def marks(self) -> dict[str, object]:
        """Return a dictionary of digests and values that identify the data and the settings of this search."""
        m, w = self.m, self.waves
        return {
            "length": self.length,
            "unknowns": self.exponents[0].shape[1],
            "density": mark_of(m.mass[..., :1]),
            "spacing": mark_of(m.shear[..., :1]),
            "frequencies": mark_of(w.omega),
            "noise": mark_of(w.sd),
            "moduli of the organ": mark_of(self.whole),
            "displacements": mark_of(w.motion, m.unknowns),
        }


class _Reached(NamedTuple):
    z: np.ndarray
    k: int  # index of the standard deviation in `DEVIATIONS`
    here: list[Balanced]
    chi2: float
    cost: float


class _Begun(NamedTuple):
    """State of a search for a map, which can be stored and resumed."""

    point: _Reached  # state for the current prior standard deviation
    visited: list[tuple[_Reached, np.ndarray]]  # final state for each earlier sd of the prior, and its `_information`
    history: list[Content]


def course_of(body: VoxelBody, m: Matrices, waves: MeasuredWaves, whole: np.ndarray, length: float) -> Course:
    """Return the input of the search for a map.

    Args:
        body, m: the body and its matrices.
        waves: the measured waves.
        whole: complex modulus of the whole organ at each frequency (F,) [Pa].
        length: correlation length of the prior [m].
    """
    mean, p, number = mean_of_corners(body), smooth.prior(body.whole, length), len(whole)
    levels = np.eye(number) if number > 1 else np.zeros((1, 0))
    every = np.ones((mean.shape[0], 1))
    exponents = tuple(scipy.sparse.hstack([mean, scipy.sparse.csr_array(every * own)], "csr") for own in levels)
    slopes, once = changes_over_slopes(body, mean, length), mean_around_corners(body, mean) @ mean
    shown = (2 * once - once @ once).tocsr()
    return Course(m, waves, np.asarray(whole, complex), exponents, slopes, shown, p, length, body.voxel)


def map_of(
    course: Course,
    file: Path | None = None,
    resume: bool = False,
    draws: int = 20,
    progress: Callable[[int, float], None] = lambda weight, chi2: None,
) -> WaveMap:
    """Find the map of the modulus from the waves.

    The given noise may be too small at some frequencies. Then the search is repeated, with noise in the ratios that the
    residuals show. `file` contains only the first search. If the second search does not converge but the first one did,
    the first map is returned.

    Args:
        course: the result of `course_of`.
        file: HDF5 file that is written after every step. If it is None, no file is written.
        resume: whether the search continues from the state in this file, if the file exists.
        draws: number of samples of the posterior.
        progress: function that is called after every step, with the index in `DEVIATIONS` and chi^2 per equation.

    Raises:
        InputError: `file` belongs to another fit or cannot be read.

    """
    found, w = _one_map(course, file, resume, draws, progress), course.waves
    larger = found.white_factor / found.white_factor.min()
    if not larger.max() > UNEQUAL:
        return found
    again = _one_map(course._replace(waves=w._replace(sd=larger * w.sd)), None, False, draws, progress)
    if again.distance > FAR >= found.distance:
        return found
    chi2 = again.chi2_of_frequencies * larger**2
    return again._replace(
        chi2_of_frequencies=chi2,
        noise_factor=again.noise_factor * larger,
        reached=bool(chi2.sum() <= again.components),
        history=[*found.history, *again.history],
        seconds=found.seconds + again.seconds,
    )


def _one_map(
    course: Course, file: Path | None, resume: bool, draws: int, progress: Callable[[int, float], None]
) -> WaveMap:
    """Return the map for the given noise. The arguments are those of `map_of`."""
    begin = time.perf_counter()
    begun = _first_or_resumed(course, file if resume else None)
    history, components = begun.history, course.m.balances * len(course.waves.omega)
    visited = _each_deviation(course, begun, file, progress)
    excess, evidence = _evidences(course, visited, components)
    for row, value in zip(history[-len(visited) :], evidence, strict=True):
        row["evidence"] = value
    point, information = visited[int(np.argmax(evidence))]
    y = course.natural(course.scales(point.k) * point.z)
    exponent = course.by_frequency(y)
    factors = _noise_factors(course, point, y)
    before, after, departures = _spread(course, point, _with_factors(course, point, information, factors), draws)
    slopes = np.stack([D @ y[: course.corners] for D in course.slopes])
    place = np.random.default_rng(1).uniform(-0.5, 0.5, (draws, 3)) @ slopes
    return WaveMap(
        exponent=exponent,
        sd=_with_place(after, slopes.real) + 1j * _with_place(after, slopes.imag),
        posterior_sd=after,
        prior_sd=before,
        change=np.linalg.norm([D @ exponent[0].real for D in course.slopes], axis=0),
        draws=exponent + departures + place[:, None],
        modulus=course.whole[:, None] * np.exp(exponent),
        deviation=DEVIATIONS[point.k],
        length=course.length,
        chi2_of_frequencies=np.array([here.chi2 for here in point.here]),
        components=components,
        noise_factor=factors,
        reached=point.chi2 <= components,
        distance=_newton_step(course, point, information, excess)[1],
        history=history,
        seconds=time.perf_counter() - begin,
    )


def sd_of_modulus(G: np.ndarray, sd: np.ndarray) -> np.ndarray:
    """Return standard deviations [Pa] of the moduli. Real part: storage modulus; imaginary part: loss modulus.

    `G`: complex moduli [Pa]; `sd`: standard deviations in the form of `WaveMap.sd`.
    """
    return np.hypot(G.real * sd.real, G.imag * sd.imag) + 1j * np.hypot(G.imag * sd.real, G.real * sd.imag)


def _with_place(sd: np.ndarray, slopes: np.ndarray) -> np.ndarray:
    """Add the uncertainty of positions (module docstring) to standard deviations `sd` (F, P), and return the result.
    `slopes` (3, P): changes of c over the width w."""
    return np.sqrt(sd**2 + np.sum(slopes**2, axis=0) / 12)


def _reached(course: Course, z: np.ndarray, k: int) -> _Reached:
    here = course.at(course.natural(course.scales(k) * z))
    chi2 = sum(b.chi2 for b in here)
    return _Reached(z, k, here, chi2, 0.5 * chi2 + 0.5 * float(np.vdot(z, z).real))


def _evidences(
    course: Course, visited: list[tuple[_Reached, np.ndarray]], components: int
) -> tuple[float, list[float]]:
    """Return the smallest chi^2 per equation (at least 1), and the log evidence for each standard deviation of the
    prior that was tried."""
    excess = max(1.0, min(p.chi2 for p, _ in visited) / components)
    return excess, [_evidence(course, p, information, excess) for p, information in visited]


def _hessian(course: Course, k: int, information: np.ndarray) -> np.ndarray:
    """Return the Hessian H (P + L, P + L) of the cost with respect to the whitened field z, for the prior standard
    deviation `DEVIATIONS[k]`."""
    scales = course.scales(k)
    return np.eye(len(information)) + scales[:, None] * information * scales


def _evidence(course: Course, point: _Reached, information: np.ndarray, excess: float) -> float:
    """Return the logarithm of the evidence, except for a constant. The evidence is the probability of the data for this
    standard deviation of the prior."""
    H = _hessian(course, point.k, information / excess)
    logarithm = 2 * float(np.sum(np.log(np.real(np.diagonal(np.linalg.cholesky(H))))))
    return -0.5 * (point.chi2 / excess + float(np.vdot(point.z, point.z).real)) - logarithm


def _each_deviation(course, begun: _Begun, file, progress) -> list[tuple[_Reached, np.ndarray]]:
    """Try one standard deviation of the prior after another, until chi^2 is as low as for noise alone, or until the
    evidence decreases. Each search begins at the result of the search before. Return the final state of each search and
    its `_information`."""
    components = course.m.balances * len(course.waves.omega)
    point, visited, history = begun
    information, fresh = (visited[-1][1], False) if visited else (_information(course, point), True)
    while True:
        begin, steps, before = time.perf_counter(), 0, np.inf
        while steps < STEPS:
            step, distance = _newton_step(course, point, information, max(1.0, point.chi2 / components))
            if distance <= NEAR:
                break
            new = None if distance > _SLOW * before else _lower(course, point, step)
            if new is None and fresh:
                break
            if new is None:
                information, fresh, before = _information(course, point), True, np.inf
                continue
            point, steps, before, fresh = new, steps + 1, distance, False
            progress(point.k, point.chi2 / components)
            _write(file, course, _Begun(point, visited, history))
        information, fresh = information if fresh else _information(course, point), True
        history.append(
            {
                "deviation": DEVIATIONS[point.k],
                "chi2_per_component": point.chi2 / components,
                "steps": float(steps),
                "seconds": time.perf_counter() - begin,
            }
        )
        visited.append((point, information))
        evidence = _evidences(course, visited, components)[1]
        if point.chi2 <= components or evidence[-1] < max(evidence) or point.k + 1 == len(DEVIATIONS):
            return visited
        point = _next_start(course, point)


def _next_start(course: Course, point: _Reached) -> _Reached:
    """Return the state with which the search for the next prior standard deviation begins. This state has the same map
    as `point`, so its whitened field z is scaled."""
    return _reached(course, point.z * course.scales(point.k) / course.scales(point.k + 1), point.k + 1)


def _noise_factors(course: Course, point: _Reached, y: np.ndarray) -> np.ndarray:
    """Return noise factors (F,): the errors of the map, divided by the errors for white noise with the given sd.

    It is assumed that correlated noise enlarges the errors of a map by the same factor as the error of one modulus of
    the whole organ. The correlation is computed from the residuals of the map. The residuals of a fit with a uniform
    modulus would also contain effects of real changes of the modulus.
    """
    w, white = course.waves, np.sqrt([max(1.0, here.chi2 / course.m.balances) for here in point.here])
    if course.voxel is None:
        return white
    found = []
    each = zip(course.moduli(y), w.omega, w.motion, w.sd, point.here, white, strict=True)
    for G, omega, d, sd, here, root in each:
        column = np.asarray(balance.by_modulus(course.m, here.motion) @ G)[:, None]
        own = correlation(balance.rows_of_balance(course.m, G, omega), here, column, d, sd, course.voxel)
        found.append(max(own.enlarged[0], root if own.seen else root * own.enlarged[0]))
    return np.array(found)


#: The noise factors of all frequencies are regarded as equal if the ratio of the largest to the smallest is below this.
_SAME = 1.05


def _with_factors(course: Course, point: _Reached, information: np.ndarray, factors: np.ndarray) -> np.ndarray:
    """Return the matrix of `_information` for noise whose standard deviation is multiplied by `factors` (F,)."""
    if factors.max() < _SAME * factors.min():
        return information / factors.max() ** 2
    return _information(course, point, factors)


def _information(course: Course, point: _Reached, factors: np.ndarray | None = None) -> np.ndarray:
    """Return the information matrix J^H J (P + L, P + L), complex. J is the derivative of the whitened unbalanced
    forces with respect to the whitened field z for a prior standard deviation of 1. `factors` (F,): noise factors;
    default: 1."""
    y = course.natural(course.scales(point.k) * point.z)
    H, factors = np.zeros((len(y), len(y)), complex), np.ones(len(point.here)) if factors is None else factors
    for J, b, factor in zip(course.jacobians(y, point.here), point.here, factors, strict=True):
        every = (J / factor).tocsr()
        for rows in course.m.parts:
            own = every[rows].tocsc()
            known = np.flatnonzero(np.diff(own.indptr))
            X = b.of(rows).whitened(own[:, known], np.complex64)  # single precision is enough for the Hessian
            H[np.ix_(known, known)] += X.conj().T @ X
    # The result is T^T H T, where T is the real matrix of the function `natural`.
    half = course.whitened(H)
    return course.whitened(half.conj().T).conj().T


def _newton_step(course: Course, point: _Reached, information: np.ndarray, excess: float) -> tuple[np.ndarray, float]:
    """Return the Gauss-Newton step (P + L,) and its length in standard deviations of the map.

    `excess`: chi^2 divided by its expected value. The noise variance for these standard deviations is multiplied by
    this factor.
    """
    scales = course.scales(point.k)
    y = course.natural(scales * point.z)
    each = zip(course.jacobians(y, point.here), point.here, course.waves.sd, strict=True)
    slope = scales * course.whitened(sum(j.conj().T @ (b.multipliers / sd) for j, b, sd in each))
    step = -scipy.linalg.solve(_hessian(course, point.k, information), slope + point.z, assume_a="pos")
    return step, float(np.sqrt(np.vdot(step, _hessian(course, point.k, information / excess) @ step).real))


def _lower(course: Course, point: _Reached, step: np.ndarray) -> _Reached | None:
    """Return the state after the whole step or a fraction of the step, with a lower cost than the state `point`. Return
    None if no tested fraction lowers the cost."""
    for part in (1.0, 0.5, 0.25, 0.1):
        new = _reached(course, point.z + part * step, point.k)
        if new.cost < point.cost:
            return new
    return None


def _spread(
    course: Course, point: _Reached, information: np.ndarray, draws: int
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return prior and posterior standard deviations (F, P) of c + l_f, and the differences (D, F, P) between D =
    `draws` posterior samples and the map."""
    scales, n = course.scales(point.k)[:, None], len(point.z)
    L = np.linalg.cholesky(_hessian(course, point.k, information))

    roots = course.natural(scales * np.linalg.inv(L).conj().T)  # R R^H is the covariance, with R = `roots`
    rng = np.random.default_rng(0)
    normal = rng.normal(size=(n, draws)) + 1j * rng.normal(size=(n, draws))
    before = course.natural(scales * np.eye(n))

    def each(y: np.ndarray) -> Iterator[np.ndarray]:
        """Yield c + l_f at the corners (P, n) for one frequency after another. All frequencies together would need too
        much memory."""
        levels = y[course.corners :]
        c = course.shown @ y[: course.corners]
        return (c + level for level in (levels if len(levels) else [0.0]))

    def deviations(y: np.ndarray) -> np.ndarray:
        return np.stack([np.sqrt(np.sum(own.real**2 + own.imag**2, axis=1)) for own in each(y)])

    return deviations(before), deviations(roots), np.stack([(own @ normal).T for own in each(roots)], axis=1)


_HISTORY = ("deviation", "chi2_per_component", "steps", "seconds")


def _write(file: Path | None, course: Course, begun: _Begun) -> None:
    """Write the state of the search. The file is replaced in one operation, so the file on disk is always complete."""
    if file is None:
        return
    with whole(file) as new, h5py.File(new, "w") as f:
        f["z"], f["whole"] = begun.point.z, course.whole
        f["visited"] = np.array([p.z for p, _ in begun.visited]).reshape(-1, len(begun.point.z))
        f["history"] = np.array([[row[name] for name in _HISTORY] for row in begun.history]).reshape(-1, len(_HISTORY))
        f.attrs.update(course.marks())


def _first_or_resumed(course: Course, file: Path | None) -> _Begun:
    """Return the state with which the search begins: a uniform organ, or the state of an earlier run in the file. The
    final states of the searches that the earlier run has finished are evaluated again."""
    if file is None or not file.is_file():
        return _Begun(_reached(course, np.zeros(course.exponents[0].shape[1], complex), 0), [], [])
    try:
        with h5py.File(file) as f:
            refuse_other(file, f.attrs, course.marks())
            history = [dict(zip(_HISTORY, map(float, row), strict=True)) for row in f["history"][:]]
            z, ends = f["z"][:], f["visited"][:]
    except (OSError, KeyError):
        raise InputError(f"{file} is damaged, or was written by another program: remove --resume") from None
    visited = []
    for k, end in enumerate(ends):
        point = _reached(course, end, k)
        visited.append((point, _information(course, point)))
    return _Begun(_reached(course, z, len(visited)), visited, history)
