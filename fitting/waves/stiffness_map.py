"""A map of the complex modulus from measured waves: a smooth field, with its uncertainty.

At frequency f the modulus of an element is g_f exp(c + l_f). g_f is the modulus that a uniform organ would have; c =
ln(size) + i (loss angle) is the mean of a complex nodal field (P,), the same for all frequencies. Its real and its
imaginary part have the prior of `fitting.methods.prior`, with the same standard deviation. The levels l_f are complex
numbers about 0 with the deviation `LEVEL`: an organ that is not uniform may miss the ratios of the g_f. One frequency
has no level, for the mean of c does the same. Larger and larger deviations of c are tried. The search
ends when chi^2 is down to the number of equations (discrepancy principle; Morozov 1966), or when the evidence -(chi^2/n
+ |z|^2)/2 - ln det H falls. The deviation with the highest evidence is taken. The minimum of chi^2/2 + |z|^2/2 over the
whitened z is sought by Gauss-Newton. The search ends where the next step is shorter than `NEAR` standard deviations.

The uncertainty has two parts. One comes from the Hessian H = I + J^H J/n, where n is chi^2 over its expected value. The
other comes from the place of a change in modulus, which is not known exactly. The prior turns a step into a slope over
its correlation length, or over a brick if that is longer. The step may lie anywhere within the slope. So a place is
known only to this length w, with the variance w^2/12, which adds |w dc/dx|^2/12 to the variance of c.
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
from fitting.waves.regions import MeasuredWaves
from fitting.waves.voxels import VoxelBody
from liverjax.core.errors import InputError
from liverjax.core.files import mark_of, refuse_other, whole
from liverjax.core.struct import Content

#: Standard deviations of c to try, from a nearly uniform organ to a free one.
DEVIATIONS = (0.2, 0.4, 0.8)
#: Standard deviation of both parts of the levels.
LEVEL = 0.5
#: Most steps of Gauss-Newton for each. A search has ended, or at last a map has converged, where the next step is
#: shorter than this, in standard deviations of the map.
STEPS, NEAR, FAR = 40, 0.1, 0.2
#: A step that is longer than this part of the step before shows that the Hessian is from too far away.
_SLOW = 0.3


class WaveMap(NamedTuple):
    """The map and its uncertainty."""

    exponent: np.ndarray  # c + l_f (F, P) complex at the corners
    sd: np.ndarray  # (F, P) complex: of its real part (logarithm of the size), and of its imaginary part (loss angle)
    posterior_sd: np.ndarray  # (F, P) of both parts, without the uncertainty of places
    prior_sd: np.ndarray  # (F, P)
    draws: np.ndarray  # (D, F, P) complex: samples of the posterior, displaced within the length w
    modulus: np.ndarray  # (F, P) complex [Pa]
    deviation: float  # standard deviation of the prior that was chosen
    length: float  # [m]
    chi2: float
    components: int
    reached: bool
    distance: float  # to the minimum, in standard deviations of the map: the length of the next step
    history: list[dict[str, float]]
    seconds: float


class Course(NamedTuple):
    """The fixed input of a search."""

    m: Matrices
    waves: MeasuredWaves
    whole: np.ndarray  # (F,) complex
    exponents: tuple[scipy.sparse.csr_array, ...]  # (F,) of (E, P + L): c + l_f of the elements, from c and the levels
    slopes: tuple[scipy.sparse.csr_array, ...]  # (3,) of (P, P): change over the length w along x, y, z
    p: smooth.Prior
    length: float  # [m]

    @property
    def corners(self) -> int:
        """P."""
        return len(self.p.root_mass)

    def moduli(self, y: np.ndarray) -> list[np.ndarray]:
        """Moduli (E,) of the elements at every frequency, from y (P + L,): c at the corners, and the levels."""
        return [g * np.exp(own @ y) for g, own in zip(self.whole, self.exponents, strict=True)]

    def at(self, y: np.ndarray) -> list[Balanced]:
        """The likeliest motions at y (P + L,)."""
        w = self.waves
        each = zip(self.moduli(y), w.omega, w.motion, w.sd, strict=True)
        return [balance.balanced(self.m, *own) for own in each]

    def jacobians(self, y: np.ndarray, here: list[Balanced]) -> list[scipy.sparse.csc_array]:
        """Derivatives (I, P + L) by y of the forces out of balance, divided by the noise."""
        each = zip(self.moduli(y), self.exponents, here, self.waves.sd, strict=True)
        return [
            (balance.by_modulus(self.m, b.motion) @ scipy.sparse.diags_array(G) @ own).tocsc() / sd
            for G, own, b, sd in each
        ]

    def scales(self, k: int) -> np.ndarray:
        """Deviations (P + L,) of y over those of `natural`, for the deviation of number k."""
        return np.where(np.arange(self.exponents[0].shape[1]) < self.corners, DEVIATIONS[k], 1.0)

    def natural(self, z: np.ndarray) -> np.ndarray:
        """y of whitened complex z, (P + L,) or (P + L, n): c of deviation 1, levels of deviation `LEVEL`."""
        c, levels = z[: self.corners], LEVEL * z[self.corners :]
        return np.concatenate(
            [smooth.field_at_nodes(self.p, c.real) + 1j * smooth.field_at_nodes(self.p, c.imag), levels]
        )

    def whitened(self, g: np.ndarray) -> np.ndarray:
        """The transpose of `natural`, (P + L,) or (P + L, n)."""
        c, levels = g[: self.corners], LEVEL * g[self.corners :]
        return np.concatenate([smooth.to_whitened(self.p, c.real) + 1j * smooth.to_whitened(self.p, c.imag), levels])

    def by_frequency(self, y: np.ndarray) -> np.ndarray:
        """c + l_f at the corners (F, P, …), from y (P + L, …)."""
        c, levels = y[: self.corners], y[self.corners :]
        return c[None] + (levels[:, None] if len(levels) else np.zeros((1, 1, *y.shape[1:])))

    def marks(self) -> dict[str, object]:
        """Marks that identify the problem, by name."""
        m, w = self.m, self.waves
        return {
            "length": self.length,
            "unknowns": self.exponents[0].shape[1],
            "density": mark_of(m.mass[..., :1]),
            "spacing": mark_of(m.shear[..., :1]),
            "frequencies": mark_of(w.omega),
            "noise": mark_of(w.sd),
            "displacements": mark_of(w.motion, m.unknowns),
        }


class _Reached(NamedTuple):
    z: np.ndarray
    k: int  # number of the deviation
    here: list[Balanced]
    chi2: float
    cost: float


class _Begun(NamedTuple):
    """State of a search."""

    point: _Reached  # of the current deviation
    visited: list[tuple[_Reached, np.ndarray]]  # end of each earlier deviation, with `_information` there
    history: list[Content]


def course_of(body: VoxelBody, m: Matrices, waves: MeasuredWaves, whole: np.ndarray, length: float) -> Course:
    """The problem of a map.

    Args:
        body, m: the elements and their matrices.
        waves: the measured waves.
        whole: modulus of the whole organ at each frequency (F,) complex [Pa].
        length: correlation length of the prior [m].
    """
    mean, p, number = _mean_of_corners(body), smooth.prior(body.linear, length), len(whole)
    levels = np.eye(number) if number > 1 else np.zeros((1, 0))
    every = np.ones((mean.shape[0], 1))
    exponents = tuple(scipy.sparse.hstack([mean, scipy.sparse.csr_array(every * own)], "csr") for own in levels)
    slopes = _changes_over_slopes(body, mean, length)
    return Course(m, waves, np.asarray(whole, complex), exponents, slopes, p, length)


def map_of(
    course: Course,
    file: Path | None = None,
    resume: bool = False,
    draws: int = 20,
    progress: Callable[[int, float], None] = lambda weight, chi2: None,
) -> WaveMap:
    """The map that explains the waves.

    Args:
        course: from `course_of`.
        file: HDF5 file to which the point of every step is written; None: no file.
        resume: begin from that file if it exists.
        draws: samples of the posterior.
        progress: called after every step with the index of the deviation, and with chi^2 per equation.

    Raises:
        InputError: `file` belongs to another fit.
    """
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
    before, after, departures = _spread(course, point, information / excess, draws)
    slopes = np.stack([D @ y[: course.corners] for D in course.slopes])
    place = np.random.default_rng(1).uniform(-0.5, 0.5, (draws, 3)) @ slopes
    return WaveMap(
        exponent=exponent,
        sd=_with_place(after, slopes.real) + 1j * _with_place(after, slopes.imag),
        posterior_sd=after,
        prior_sd=before,
        draws=exponent + departures + place[:, None],
        modulus=course.whole[:, None] * np.exp(exponent),
        deviation=DEVIATIONS[point.k],
        length=course.length,
        chi2=point.chi2,
        components=components,
        reached=point.chi2 <= components,
        distance=_newton_step(course, point, information, excess)[1],
        history=history,
        seconds=time.perf_counter() - begin,
    )


def sd_of_modulus(G: np.ndarray, sd: np.ndarray) -> np.ndarray:
    """Standard deviations [Pa] of storage (real part) and loss (imaginary part) of moduli G, from `WaveMap.sd`."""
    return np.hypot(G.real * sd.real, G.imag * sd.imag) + 1j * np.hypot(G.imag * sd.real, G.real * sd.imag)


def _with_place(sd: np.ndarray, slopes: np.ndarray) -> np.ndarray:
    """Standard deviations (F, P) with the uncertainty of places; slopes (3, P) are changes over the length w."""
    return np.sqrt(sd**2 + np.sum(slopes**2, axis=0) / 12)


def _mean_of_corners(body: VoxelBody) -> scipy.sparse.csr_array:
    tets = np.asarray(body.linear.tetrahedra)
    rows = np.repeat(np.arange(len(tets)), 4)
    shape = (len(tets), body.linear.number_of_nodes)
    return scipy.sparse.csr_array((np.full(rows.size, 0.25), (rows, tets.ravel())), shape=shape)


def _changes_over_slopes(
    body: VoxelBody, mean: scipy.sparse.csr_array, length: float
) -> tuple[scipy.sparse.csr_array, ...]:
    """Change (P, P) of a field over a length [m], or over a brick's side if that is longer.

    At each corner it is the mean of its elements' slopes, by volume.
    """
    tets, volumes = np.asarray(body.linear.tetrahedra), np.asarray(body.linear.volumes)
    D = np.moveaxis(np.asarray(body.linear.shape_vectors), -1, 0)
    gradients = np.concatenate([-D.sum(axis=1, keepdims=True), D], axis=1)  # (E, 4, 3)
    around = scipy.sparse.diags_array(1 / (mean.T @ volumes)) @ mean.T @ scipy.sparse.diags_array(volumes)
    over = np.maximum(np.ptp(np.asarray(body.linear.points)[tets[0]], axis=0), length)
    rows, columns = np.repeat(np.arange(len(tets)), 4), tets.ravel()
    of_elements = [
        scipy.sparse.csr_array((w * gradients[:, :, a].ravel(), (rows, columns)), shape=mean.shape)
        for a, w in enumerate(over)
    ]
    return tuple((around @ own).tocsr() for own in of_elements)


def _reached(course: Course, z: np.ndarray, k: int) -> _Reached:
    here = course.at(course.natural(course.scales(k) * z))
    chi2 = sum(b.chi2 for b in here)
    return _Reached(z, k, here, chi2, 0.5 * chi2 + 0.5 * float(np.vdot(z, z).real))


def _evidences(
    course: Course, visited: list[tuple[_Reached, np.ndarray]], components: int
) -> tuple[float, list[float]]:
    """The factor by which chi^2 is too large, and the evidence of each deviation tried."""
    excess = max(1.0, min(p.chi2 for p, _ in visited) / components)
    return excess, [_evidence(course, p, information, excess) for p, information in visited]


def _hessian(course: Course, k: int, information: np.ndarray) -> np.ndarray:
    """The Hessian (P + L, P + L) by whitened z, of the deviation of number k."""
    scales = course.scales(k)
    return np.eye(len(information)) + scales[:, None] * information * scales


def _evidence(course: Course, point: _Reached, information: np.ndarray, excess: float) -> float:
    """Logarithm of the probability of the data at this deviation, up to a constant."""
    H = _hessian(course, point.k, information / excess)
    logarithm = 2 * float(np.sum(np.log(np.real(np.diagonal(np.linalg.cholesky(H))))))
    return -0.5 * (point.chi2 / excess + float(np.vdot(point.z, point.z).real)) - logarithm


def _each_deviation(course, begun: _Begun, file, progress) -> list[tuple[_Reached, np.ndarray]]:
    """Try one deviation after another, each from the last field, until chi^2 is down to the noise or evidence falls."""
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
    """The same field, written with the next deviation."""
    return _reached(course, point.z * course.scales(point.k) / course.scales(point.k + 1), point.k + 1)


def _information(course: Course, point: _Reached) -> np.ndarray:
    """J^H J in whitened z of a field of deviation 1, complex (P + L, P + L)."""
    y = course.natural(course.scales(point.k) * point.z)
    H = np.zeros((len(y), len(y)), complex)
    for J, b in zip(course.jacobians(y, point.here), point.here, strict=True):
        X = b.whitened(J, np.complex64)  # the Hessian only directs steps: it needs no more digits
        H += X.conj().T @ X
    # T^T H T, with T the real matrix of `natural`, from both sides.
    half = course.whitened(H)
    return course.whitened(half.conj().T).conj().T


def _newton_step(course: Course, point: _Reached, information: np.ndarray, excess: float) -> tuple[np.ndarray, float]:
    """The step of Gauss-Newton (P + L,), and its length in the standard deviations of noise that makes chi^2 `excess`
    times as large as expected.
    """
    scales = course.scales(point.k)
    y = course.natural(scales * point.z)
    each = zip(course.jacobians(y, point.here), point.here, course.waves.sd, strict=True)
    slope = scales * course.whitened(sum(j.conj().T @ (b.multipliers / sd) for j, b, sd in each))
    step = -scipy.linalg.solve(_hessian(course, point.k, information), slope + point.z, assume_a="pos")
    return step, float(np.sqrt(np.vdot(step, _hessian(course, point.k, information / excess) @ step).real))


def _lower(course: Course, point: _Reached, step: np.ndarray) -> _Reached | None:
    """The point after the step, or after a part of it, where the cost is lower; None: it is nowhere lower."""
    for part in (1.0, 0.5, 0.25, 0.1):
        new = _reached(course, point.z + part * step, point.k)
        if new.cost < point.cost:
            return new
    return None


def _spread(
    course: Course, point: _Reached, information: np.ndarray, draws: int
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Standard deviations (F, P) before and after the data, and departures (D, F, P) of samples of the posterior."""
    scales, n = course.scales(point.k)[:, None], len(point.z)
    L = np.linalg.cholesky(_hessian(course, point.k, information))

    roots = course.natural(scales * np.linalg.inv(L).conj().T)  # R R^H is the covariance
    rng = np.random.default_rng(0)
    normal = rng.normal(size=(n, draws)) + 1j * rng.normal(size=(n, draws))
    before = course.natural(scales * np.eye(n))

    def each(y: np.ndarray) -> Iterator[np.ndarray]:
        """c + l_f at the corners (P, n), one frequency at a time: all together would not fit into the memory."""
        levels = y[course.corners :]
        return (y[: course.corners] + level for level in (levels if len(levels) else [0.0]))

    def deviations(y: np.ndarray) -> np.ndarray:
        return np.stack([np.sqrt(np.sum(own.real**2 + own.imag**2, axis=1)) for own in each(y)])

    return deviations(before), deviations(roots), np.stack([(own @ normal).T for own in each(roots)], axis=1)


_HISTORY = ("deviation", "chi2_per_component", "steps", "seconds")


def _write(file: Path | None, course: Course, begun: _Begun) -> None:
    """Write the current point; the file is never left half written."""
    if file is None:
        return
    with whole(file) as new, h5py.File(new, "w") as f:
        f["z"], f["whole"] = begun.point.z, course.whole
        f["visited"] = np.array([p.z for p, _ in begun.visited]).reshape(-1, len(begun.point.z))
        f["history"] = np.array([[row[name] for name in _HISTORY] for row in begun.history]).reshape(-1, len(_HISTORY))
        f.attrs.update(course.marks())


def _first_or_resumed(course: Course, file: Path | None) -> _Begun:
    """Begin at a uniform organ, or at the point of an earlier run, whose earlier deviations are evaluated again."""
    if file is None or not file.is_file():
        return _Begun(_reached(course, np.zeros(course.exponents[0].shape[1], complex), 0), [], [])
    try:
        with h5py.File(file) as f:
            refuse_other(file, f.attrs, course.marks())
            history = [dict(zip(_HISTORY, map(float, row), strict=True)) for row in f["history"][:]]
            z, ends = f["z"][:], f["visited"][:]
    except (OSError, KeyError):
        raise InputError(f"{file} is damaged, or of another program: leave out --resume") from None
    visited = []
    for k, end in enumerate(ends):
        point = _reached(course, end, k)
        visited.append((point, _information(course, point)))
    return _Begun(_reached(course, z, len(visited)), visited, history)
