"""A map of the complex modulus from measured waves: a smooth field, with its uncertainty.

At frequency f the modulus of an element is g_f exp(c + l_f). g_f is the modulus that a uniform organ would have. c =
ln(size) + i (loss angle) is the mean over the element of a complex nodal field (P,). This field is the same for all
frequencies. Its real and its imaginary part have the prior of `fitting.methods.prior`, with the same standard
deviation. The levels l_f are complex, with mean 0 and the standard deviation `LEVEL`. They are needed because in an
organ that is not uniform the ratios of the g_f may be wrong. With only one frequency there is no level: the mean of c
has the same effect. Larger and larger standard deviations of c are tried. This ends when chi^2 is as low as the number
of equations (discrepancy principle; Morozov 1966), or when the evidence -(chi^2/n + |z|^2)/2 - ln det H falls. The
standard deviation with the highest evidence is used. For each one, Gauss-Newton minimises chi^2/2 + |z|^2/2 over the
whitened field z. A search ends if the next step is shorter than `NEAR` standard deviations.

The uncertainty has two parts. The first part comes from the Hessian H = I + J^H J/n, where n is chi^2 divided by its
expected value. The second part is needed because the position of a change in modulus is not known exactly. The prior
turns a step into a slope over the correlation length, or over a brick if a brick is longer. The step may lie anywhere
within the slope. So its position is known only within this length w, with the variance w^2/12. This adds |w dc/dx|^2/12
to the variance of c.
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

#: Standard deviations of c to try: from a nearly uniform organ to an organ whose modulus may vary strongly.
DEVIATIONS = (0.2, 0.4, 0.8)
#: Standard deviation of the real and the imaginary part of the levels.
LEVEL = 0.5
#: Maximum number of Gauss-Newton steps for each of `DEVIATIONS`. A search ends if the next step is shorter than NEAR,
#: and a map has converged if it is shorter than FAR (in standard deviations of the map).
STEPS, NEAR, FAR = 40, 0.1, 0.2
#: If a step is longer than this part of the step before, the Hessian was computed too far away and is computed again.
_SLOW = 0.3


class WaveMap(NamedTuple):
    """The map and its uncertainty."""

    exponent: np.ndarray  # c + l_f (F, P) complex at the corners
    sd: np.ndarray  # (F, P) complex: sd of the real part (ln of the size) + i sd of the imaginary part (loss angle)
    posterior_sd: np.ndarray  # (F, P) of both parts, without the uncertainty of positions
    prior_sd: np.ndarray  # (F, P)
    draws: np.ndarray  # (D, F, P) complex: samples of the posterior, displaced within the length w
    modulus: np.ndarray  # (F, P) complex [Pa]
    deviation: float  # standard deviation of the prior that was chosen
    length: float  # [m]
    chi2: float
    components: int
    reached: bool
    distance: float  # distance to the minimum: length of the next step, in standard deviations of the map
    history: list[dict[str, float]]
    seconds: float


class Course(NamedTuple):
    """The fixed input of a search."""

    m: Matrices
    waves: MeasuredWaves
    whole: np.ndarray  # (F,) complex
    exponents: tuple[scipy.sparse.csr_array, ...]  # (F,) of (E, P + L): c and levels -> c + l_f of the elements
    slopes: tuple[scipy.sparse.csr_array, ...]  # (3,) of (P, P): change over the length w along x, y, z
    p: smooth.Prior
    length: float  # [m]

    @property
    def corners(self) -> int:
        """P."""
        return len(self.p.root_mass)

    def moduli(self, y: np.ndarray) -> list[np.ndarray]:
        """Moduli (E,) of the elements at every frequency. y (P + L,) has c at the corners, then the levels."""
        return [g * np.exp(own @ y) for g, own in zip(self.whole, self.exponents, strict=True)]

    def at(self, y: np.ndarray) -> list[Balanced]:
        """The likeliest motion at every frequency, for y (P + L,)."""
        w = self.waves
        each = zip(self.moduli(y), w.omega, w.motion, w.sd, strict=True)
        return [balance.balanced(self.m, *own) for own in each]

    def jacobians(self, y: np.ndarray, here: list[Balanced]) -> list[scipy.sparse.csc_array]:
        """Derivatives (I, P + L) of the unbalanced forces by y, divided by the noise."""
        each = zip(self.moduli(y), self.exponents, here, self.waves.sd, strict=True)
        return [
            (balance.by_modulus(self.m, b.motion) @ scipy.sparse.diags_array(G) @ own).tocsc() / sd
            for G, own, b, sd in each
        ]

    def scales(self, k: int) -> np.ndarray:
        """Factors (P + L,) from the result of `natural` to y, for `DEVIATIONS[k]`."""
        return np.where(np.arange(self.exponents[0].shape[1]) < self.corners, DEVIATIONS[k], 1.0)

    def natural(self, z: np.ndarray) -> np.ndarray:
        """y from whitened complex z, (P + L,) or (P + L, n). c has the standard deviation 1, the levels have
        `LEVEL`."""
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
    k: int  # index in `DEVIATIONS`
    here: list[Balanced]
    chi2: float
    cost: float


class _Begun(NamedTuple):
    """State of a search."""

    point: _Reached  # for the current deviation
    visited: list[tuple[_Reached, np.ndarray]]  # end point for each earlier deviation, with its `_information`
    history: list[Content]


def course_of(body: VoxelBody, m: Matrices, waves: MeasuredWaves, whole: np.ndarray, length: float) -> Course:
    """The problem of a map.

    Args:
        body, m: the body and its matrices.
        waves: the measured waves.
        whole: modulus of the whole organ at each frequency (F,) complex [Pa].
        length: correlation length of the prior [m].
    """
    mean, p, number = _mean_of_corners(body), smooth.prior(body.whole, length), len(whole)
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
    """Find the map from the waves.

    Args:
        course: the result of `course_of`.
        file: HDF5 file into which every step is written; None: no file.
        resume: begin from that file if it exists.
        draws: number of samples of the posterior.
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
    """Standard deviations (F, P) that contain the uncertainty of positions. `slopes` (3, P): changes of c over the
    length w."""
    return np.sqrt(sd**2 + np.sum(slopes**2, axis=0) / 12)


def _mean_of_corners(body: VoxelBody) -> scipy.sparse.csr_array:
    tets = np.asarray(body.whole.tetrahedra)
    rows = np.repeat(np.arange(len(tets)), 4)
    shape = (len(tets), body.whole.number_of_nodes)
    return scipy.sparse.csr_array((np.full(rows.size, 0.25), (rows, tets.ravel())), shape=shape)


def _changes_over_slopes(
    body: VoxelBody, mean: scipy.sparse.csr_array, length: float
) -> tuple[scipy.sparse.csr_array, ...]:
    """For each axis, a matrix (P, P) that gives the change of a field over a length [m], or over the side of a brick if
    the side is longer.

    The slope at a corner is the mean over the elements around it, weighted by volume.
    """
    tets, volumes = np.asarray(body.whole.tetrahedra), np.asarray(body.whole.volumes)
    D = np.moveaxis(np.asarray(body.whole.shape_vectors), -1, 0)
    gradients = np.concatenate([-D.sum(axis=1, keepdims=True), D], axis=1)  # (E, 4, 3)
    around = scipy.sparse.diags_array(1 / (mean.T @ volumes)) @ mean.T @ scipy.sparse.diags_array(volumes)
    over = np.maximum(np.ptp(np.asarray(body.whole.points)[tets[0]], axis=0), length)
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
    """The factor by which chi^2 is too large, and the evidence of each tried deviation."""
    excess = max(1.0, min(p.chi2 for p, _ in visited) / components)
    return excess, [_evidence(course, p, information, excess) for p, information in visited]


def _hessian(course: Course, k: int, information: np.ndarray) -> np.ndarray:
    """The Hessian (P + L, P + L) by whitened z, for `DEVIATIONS[k]`."""
    scales = course.scales(k)
    return np.eye(len(information)) + scales[:, None] * information * scales


def _evidence(course: Course, point: _Reached, information: np.ndarray, excess: float) -> float:
    """Logarithm of the probability of the data for this standard deviation of the prior, up to a constant."""
    H = _hessian(course, point.k, information / excess)
    logarithm = 2 * float(np.sum(np.log(np.real(np.diagonal(np.linalg.cholesky(H))))))
    return -0.5 * (point.chi2 / excess + float(np.vdot(point.z, point.z).real)) - logarithm


def _each_deviation(course, begun: _Begun, file, progress) -> list[tuple[_Reached, np.ndarray]]:
    """Try one deviation after another, until chi^2 is as low as the noise or the evidence falls. Each search begins at
    the last field."""
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
    """The same field, expressed with the next deviation."""
    return _reached(course, point.z * course.scales(point.k) / course.scales(point.k + 1), point.k + 1)


def _information(course: Course, point: _Reached) -> np.ndarray:
    """J^H J by whitened z for a field of deviation 1, complex (P + L, P + L)."""
    y = course.natural(course.scales(point.k) * point.z)
    H = np.zeros((len(y), len(y)), complex)
    for J, b in zip(course.jacobians(y, point.here), point.here, strict=True):
        every = J.tocsr()
        for rows in course.m.parts:
            own = every[rows].tocsc()
            known = np.flatnonzero(np.diff(own.indptr))
            X = b.of(rows).whitened(own[:, known], np.complex64)  # single precision is enough for directions of steps
            H[np.ix_(known, known)] += X.conj().T @ X
    # This is T^T H T, where T is the real matrix of `natural`.
    half = course.whitened(H)
    return course.whitened(half.conj().T).conj().T


def _newton_step(course: Course, point: _Reached, information: np.ndarray, excess: float) -> tuple[np.ndarray, float]:
    """The Gauss-Newton step (P + L,), and its length in standard deviations. The noise counts as so large that chi^2 is
    `excess` times its expected value.
    """
    scales = course.scales(point.k)
    y = course.natural(scales * point.z)
    each = zip(course.jacobians(y, point.here), point.here, course.waves.sd, strict=True)
    slope = scales * course.whitened(sum(j.conj().T @ (b.multipliers / sd) for j, b, sd in each))
    step = -scipy.linalg.solve(_hessian(course, point.k, information), slope + point.z, assume_a="pos")
    return step, float(np.sqrt(np.vdot(step, _hessian(course, point.k, information / excess) @ step).real))


def _lower(course: Course, point: _Reached, step: np.ndarray) -> _Reached | None:
    """The point after the step, or after a part of the step, at which the cost is lower; None if it is not lower at any
    of them."""
    for part in (1.0, 0.5, 0.25, 0.1):
        new = _reached(course, point.z + part * step, point.k)
        if new.cost < point.cost:
            return new
    return None


def _spread(
    course: Course, point: _Reached, information: np.ndarray, draws: int
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Standard deviations (F, P) without and with the data, and differences (D, F, P) of posterior samples from the
    map."""
    scales, n = course.scales(point.k)[:, None], len(point.z)
    L = np.linalg.cholesky(_hessian(course, point.k, information))

    roots = course.natural(scales * np.linalg.inv(L).conj().T)  # R R^H is the covariance
    rng = np.random.default_rng(0)
    normal = rng.normal(size=(n, draws)) + 1j * rng.normal(size=(n, draws))
    before = course.natural(scales * np.eye(n))

    def each(y: np.ndarray) -> Iterator[np.ndarray]:
        """c + l_f at the corners (P, n), one frequency at a time: all frequencies together would not fit into the
        memory."""
        levels = y[course.corners :]
        return (y[: course.corners] + level for level in (levels if len(levels) else [0.0]))

    def deviations(y: np.ndarray) -> np.ndarray:
        return np.stack([np.sqrt(np.sum(own.real**2 + own.imag**2, axis=1)) for own in each(y)])

    return deviations(before), deviations(roots), np.stack([(own @ normal).T for own in each(roots)], axis=1)


_HISTORY = ("deviation", "chi2_per_component", "steps", "seconds")


def _write(file: Path | None, course: Course, begun: _Begun) -> None:
    """Write the current point. The file is replaced as a whole, so it is never half written."""
    if file is None:
        return
    with whole(file) as new, h5py.File(new, "w") as f:
        f["z"], f["whole"] = begun.point.z, course.whole
        f["visited"] = np.array([p.z for p, _ in begun.visited]).reshape(-1, len(begun.point.z))
        f["history"] = np.array([[row[name] for name in _HISTORY] for row in begun.history]).reshape(-1, len(_HISTORY))
        f.attrs.update(course.marks())


def _first_or_resumed(course: Course, file: Path | None) -> _Begun:
    """Begin at a uniform organ, or at the point of an earlier run. The end points of its earlier deviations are
    evaluated again."""
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
