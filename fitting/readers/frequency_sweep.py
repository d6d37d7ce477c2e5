"""A measured frequency sweep: data, scales of the residuals, and selection of the usable points."""

import math
from functools import lru_cache
from typing import NamedTuple

import numpy as np
import scipy.special

from fitting.readers import raw_torque
from fitting.readers.tables.text_tables import without_multiples
from liverjax.core.errors import InputError
from liverjax.core.struct import Content

#: Minimum number of frequencies that must remain if points are ignored.
FEWEST = 3
#: Given standard deviations are regarded as the spread between samples, not as noise, if they exceed LARGE times the
#: moduli and also SHARED times the scatter of the points. If these deviations were noise, the points would scatter just
#: as much.
SHARED, LARGE = 3.0, 0.1


class Sweep(NamedTuple):
    """A frequency sweep in SI units, sorted by frequency."""

    angular_frequency: np.ndarray  # (n,) [rad/s]
    storage: np.ndarray  # (n,) G' [Pa]
    loss: np.ndarray  # (n,) G'' [Pa]
    storage_sd: np.ndarray | None = None  # (n,) standard deviations [Pa]
    loss_sd: np.ndarray | None = None
    source: str = ""
    notes: tuple[str, ...] = ()  # notes for the user: what the reader has changed, ignored or assumed
    raw: dict[str, np.ndarray] | None = None  # (n,) raw torque [N m], angle [rad], phase [rad], if in the file
    inertia: np.ndarray | None = (
        None  # (n,) [Pa] contribution of the instrument's inertia, already subtracted; None if unknown
    )
    friction: np.ndarray | None = None  # (n,) [Pa] change of G'' by one standard deviation of the bearing's friction
    friction_error: float = 0.0  # standard deviation of the bearing's friction [N m s]
    grey: np.ndarray | None = None  # (k, 3) frequency [rad/s], G', G'' [Pa] of k ignored points (mostly inertia)
    sd_estimated: bool = False  # True: the sd come from the scatter of the points and are only weights
    sd_before: bool = False  # True: the sd belong to the moduli before a correction, and are only weights
    sweep_numbers: np.ndarray | None = None  # (n,) number of the sweep of each point, if several sweeps are joined
    load: str = "shear"  # how the sample was loaded: shear, tension (or compression), bending; all moduli are of shear
    table: str = ""  # name of the table in the file
    files: tuple[str, ...] = ()  # all files of joined sweeps; `source` names only the first of them

    @property
    def deviations(self) -> tuple[np.ndarray, np.ndarray]:
        """Scales [Pa] of the residuals of G' and G'': the given standard deviations, or else smooth curves through the
        moduli (the residuals are then relative).

        Standard deviations that were estimated from few repeats are smoothed (`deviations_of_sweeps`).
        """
        omega, pairs = self.angular_frequency, ((self.storage, self.storage_sd), (self.loss, self.loss_sd))
        numbers = np.zeros(len(omega), int) if self.sweep_numbers is None else self.sweep_numbers
        scales = [
            smooth_curve(omega, modulus) if sd is None else deviations_of_sweeps(omega, modulus, sd, numbers)
            for modulus, sd in pairs
        ]
        return scales[0], scales[1]

    @property
    def tensile(self) -> bool:
        """Whether E' and E'' were measured, in tension or bending. Then `storage` is E' / 3 and `loss` is E'' / 3."""
        return self.load != "shear"

    @property
    def as_measured(self) -> "Sweep":
        """The sweep without the standard deviations that a correction added as weights (`sd_before`)."""
        return self._replace(storage_sd=None, loss_sd=None, sd_before=False) if self.sd_before else self

    @property
    def noise_given(self) -> bool:
        """Whether standard deviations are given that describe the noise of each point, not the spread between
        samples."""
        if self.storage_sd is None or self.sd_estimated or self.sd_before:
            return False
        return self.relative_deviation < LARGE or not self.point_scatter < self.relative_deviation / SHARED

    @property
    def relative_deviation(self) -> float:
        """Median of the standard deviations divided by the moduli; NaN if no standard deviations are known."""
        if self.storage_sd is None or self.loss_sd is None:
            return np.nan
        return float(np.median(np.concatenate([self.storage_sd / self.storage, self.loss_sd / self.loss])))

    @property
    def point_scatter(self) -> float:
        """Relative scatter of the points about a smooth curve; infinite if there are too few points."""
        omega, *columns = merged(self.angular_frequency, self.storage, self.loss)
        return max(scatter(omega, column) for column in columns)

    @property
    def resolved(self) -> tuple[float, float]:
        """Shortest and longest relaxation time [s] that the frequencies resolve."""
        return float(1 / self.angular_frequency[-1]), float(1 / self.angular_frequency[0])


def check_sweep(sweep: Sweep) -> None:
    """Check the values of a sweep that was made in Python. The file readers have separate checks, whose messages name
    line and column.

    Raises:
        InputError: a value is invalid; the message names the field, the value and the remedy.
    """
    name, first = sweep.source or "sweep", np.shape(sweep.angular_frequency)
    fields = {key: getattr(sweep, key) for key in ("angular_frequency", "storage", "loss", "storage_sd", "loss_sd")}
    for key, values in fields.items():
        if values is None and key.endswith("_sd"):
            continue
        kind = getattr(getattr(values, "dtype", None), "kind", "")
        if kind not in ("f", "i", "u"):
            raise InputError(f"{name}: {key} is of type {type(values).__name__}; give an array of real numbers (n,)")
        if values.ndim != 1 or values.shape != first or not len(values):
            raise InputError(f"{name}: {key} has shape {values.shape}; give one number per frequency, here {first}")
        wrong = np.flatnonzero(~(np.isfinite(values) & (values > 0)))
        if wrong.size:
            raise InputError(
                f"{name}: {key}[{wrong[0]}] = {values[wrong[0]]:g} must be above 0; correct or remove this value"
            )
    if (sweep.storage_sd is None) != (sweep.loss_sd is None):
        raise InputError(f"{name}: only one of storage_sd and loss_sd is given; give both, or neither")
    if np.any(np.diff(sweep.angular_frequency) < 0):
        raise InputError(f"{name}: angular_frequency must be in ascending order; sort the points")


#: Numbers of neighbouring points that are compared with a polynomial. With more neighbours the degree is higher, and
#: the curvature of the data adds less to the scatter.
NEIGHBOURS = (4, 5, 6)


def scatter(omega: np.ndarray, modulus: np.ndarray) -> float:
    """Return the robust relative standard deviation of the points about a smooth curve: the smallest of the values
    for several polynomials.

    Four neighbours are compared with a parabola, five with a cubic, six with a quartic. If there are few points per
    decade, the curvature of the material adds to the distance from the parabola: 1 % at six points per decade.

    Args:
        omega: different frequencies (n,), ascending.
        modulus: (n,), positive.
    """
    x, y = np.log(omega), np.log(modulus)
    if len(x) < 6:
        return math.inf
    return distance_from_smooth(x, y)


def distance_from_smooth(x: np.ndarray, y: np.ndarray) -> float:
    """Return the robust standard deviation of y (n,) about a smooth curve over x (n,), ascending; n is 6 or more."""
    left = (distances_from_polynomials(x, y, m) for m in NEIGHBOURS if len(x) >= m + 2)
    return min(float(np.median(np.abs(each)) / 0.6745) for each in left)


def distances_from_polynomials(x: np.ndarray, y: np.ndarray, m: int) -> np.ndarray:
    """Return the distances of y (n,) from polynomials of degree m - 2 that are fitted to m neighbouring points. The
    distances are scaled so that their variance is that of the noise."""
    left = []
    for k in range(len(x) - m + 1):
        own = x[k : k + m] - x[k]
        _, _, Vt = np.linalg.svd(np.vander(own, m - 1, increasing=True).T)
        left.append(Vt[-1] @ y[k : k + m])
    return np.array(left)


#: Points whose logarithms of x differ by less than _NEAR are merged into one point of the smooth curve. The curve needs
#: at least _PLACES such points, and has at most about _MOST.
_NEAR, _PLACES, _MOST = 0.01, 5, 400
#: A point is far from its neighbours if its logarithm differs from the median of the five logarithms around it by more
#: than _FAR, and also by more than _DEVIATIONS robust standard deviations. The curve is fitted without such points. The
#: same two limits determine which points are far above the fitted curve.
_FAR, _DEVIATIONS = 0.4, 5.0


def smooth_curve(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Return a smooth curve through positive values y (n,) over positive x (n,), for example moduli over frequencies.

    The curve is a spline of the logarithms, smoothed by cross-validation. Residuals are divided by the curve, so they
    are relative. If the residuals were divided by the measured values, a point that is low by chance would have more
    weight than a point that is high. The fit would then be too low by twice the square of the relative noise. At a
    point far above the curve, the measured value is returned, so that this wrong point does not dominate the fit.
    """
    return _curve_of_bytes(np.asarray(x, float).tobytes(), np.asarray(y, float).tobytes())


@lru_cache(maxsize=256)  # a fit uses the weights of the same sweep many times
def _curve_of_bytes(*columns: bytes) -> np.ndarray:
    """Compute `smooth_curve`. The columns are given as bytes, because the cache needs hashable arguments."""
    from scipy.interpolate import make_smoothing_spline

    x, y = (np.frombuffer(column) for column in columns)
    at, values, counts = _cells_along(np.log(x), np.log(y))
    if len(at) < _PLACES:
        return y
    far = _far_from_neighbours(values)
    kept = ~far if np.sum(~far) >= _PLACES else np.ones(len(at), bool)
    curve = make_smoothing_spline(at[kept], values[kept], counts[kept])(np.log(x))
    off = np.log(y) - curve
    scale = np.where(off > max(_FAR, _DEVIATIONS * 1.4826 * float(np.median(np.abs(off)))), y, np.exp(curve))
    scale.setflags(write=False)  # read-only, because the cache returns the same array again
    return scale


def _cells_along(x: np.ndarray, y: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Divide n points (x, y) into narrow cells along x. Return the mean x, the mean y and the number of points of each
    cell, in ascending order. Neighbouring points on the two sides of a cell border are merged."""
    near = max(_NEAR, float(np.ptp(x)) / _MOST)
    cell = np.round(x / near)
    for _ in range(2):
        counts = np.bincount(np.unique(cell, return_inverse=True)[1])
        _, at, values = merged(cell, x, y)
        number = np.cumsum(np.append(0, np.diff(at) > 0.1 * near))
        cell = number[np.unique(cell, return_inverse=True)[1]]
    return at, values, counts


def _far_from_neighbours(y: np.ndarray) -> np.ndarray:
    """Return for each logarithm (n,) whether it is far from the median of the five values around it."""
    from scipy.ndimage import median_filter

    off = np.abs(y - median_filter(y, size=5, mode="nearest"))
    return off > max(_FAR, _DEVIATIONS * 1.4826 * float(np.median(off)))


#: Standard deviations count as results of few repeats if ln(deviation / modulus) scatters about a smooth curve by more
#: than _FEW_REPEATS. Five repeats give a scatter of 0.4, three repeats 0.64. With _POINTS points or more, a polynomial
#: of degree _DEGREE replaces such deviations.
_FEW_REPEATS, _POINTS, _DEGREE = 0.25, 8, 2
#: If ln(deviation / modulus) varies by less than this, the deviations are a fixed percentage of the moduli.
_ROUNDED = 0.01
#: The relative deviations of short sweeps differ if the probability of the same differences by chance is below this.
_BY_CHANCE = 1e-3


def deviations_of_sweeps(omega: np.ndarray, modulus: np.ndarray, sd: np.ndarray, numbers: np.ndarray) -> np.ndarray:
    """Return smooth standard deviations (n,) of joined sweeps. `numbers` (n,): number of the sweep of each point.

    Each sweep with `_POINTS` or more frequencies is smoothed separately. A shorter sweep has too few points for this,
    so all shorter sweeps are smoothed together, after a division by the level of each sweep (`_levels_of_sweeps`). If
    the deviations of the shorter sweeps are already smooth in each sweep, they are not changed.
    """
    out, short = np.empty(len(omega)), np.zeros(len(omega), bool)
    for k in np.unique(numbers):
        own = numbers == k
        if len(np.unique(omega[own])) < _POINTS:
            short |= own
        else:
            out[own] = smooth_deviations(omega[own], modulus[own], sd[own])
    if short.any():
        part = np.log(sd / modulus)[short]
        if _smooth_in_sweeps(np.log(omega[short]), part, numbers[short]):
            out[short] = sd[short]
            return out
        level = _levels_of_sweeps(part, numbers[short])
        out[short] = level * smooth_deviations(omega[short], modulus[short], sd[short] / level)
    return out


def _smooth_in_sweeps(x: np.ndarray, part: np.ndarray, numbers: np.ndarray) -> bool:
    """Return whether relative standard deviations follow the same parabola over the frequency in each sweep, apart from
    a factor for each sweep. If they are a fixed percentage in each sweep, the result is False, because they then
    contain the noise of the measured moduli. `x`, `part`: logarithms (n,) of the frequency and of the relative
    deviations."""
    place = np.unique(numbers, return_inverse=True)[1]
    count = np.bincount(place)
    u = x - (np.bincount(place, x) / count)[place]
    levels = (place[:, None] == np.arange(len(count))).astype(float)
    A = np.column_stack([levels, u, u**2])
    off = part - A @ np.linalg.lstsq(A, part)[0]
    freedom = len(part) - A.shape[1]
    if freedom < 1 or np.ptp(part - (np.bincount(place, part) / count)[place]) < _ROUNDED:
        return False
    return float(np.sqrt(np.sum(off**2) / freedom)) < _FEW_REPEATS


def _levels_of_sweeps(part: np.ndarray, numbers: np.ndarray) -> np.ndarray:
    """Return for each point the level (n,) of its sweep: the geometric mean of its relative standard deviations,
    divided by the geometric mean of all sweeps. All levels are 1 if the sweeps do not differ more than by chance
    (F-test). `part`: logarithms (n,) of the relative standard deviations."""
    place = np.unique(numbers, return_inverse=True)[1]
    means = (np.bincount(place, part) / np.bincount(place))[place]
    more, freedom = int(place.max()), len(part) - int(place.max()) - 1
    if more < 1 or freedom < 1:
        return np.ones(len(part))
    within_sweeps = max(float(np.sum((part - means) ** 2)), np.finfo(float).eps)  # not zero
    ratio = float(np.sum((means - part.mean()) ** 2)) / more / (within_sweeps / freedom)
    differ = scipy.special.fdtrc(more, freedom, ratio) < _BY_CHANCE
    return np.exp(means - part.mean()) if differ else np.ones(len(part))


def smooth_deviations(omega: np.ndarray, modulus: np.ndarray, sd: np.ndarray) -> np.ndarray:
    """Return smooth standard deviations (n,) over the frequency, if the given ones scatter from point to point.

    A standard deviation from three repeats may be wrong by a factor of two and more. Points whose standard deviation is
    small by chance would have most of the weight, and the errors of the fit would be too small.
    """
    return _smooth_of_bytes(*(np.asarray(v, float).tobytes() for v in (omega, modulus, sd)))


@lru_cache(maxsize=256)  # a fit uses the weights of the same sweep many times
def _smooth_of_bytes(*columns: bytes) -> np.ndarray:
    """Compute `smooth_deviations`. The columns are given as bytes, because the cache needs hashable arguments."""
    omega, modulus, sd = (np.frombuffer(column) for column in columns)
    x, part, curve = np.log(omega), np.log(sd / modulus), smooth_curve(omega, modulus)
    at, of_modulus, of_sd = merged(x, part, np.log(sd))
    # Standard deviations in percent of the measured moduli contain the noise of the moduli. So they are computed as
    # percent of the smooth curve.
    if np.ptp(part) < _ROUNDED:
        return sd * curve / modulus
    if len(at) < _POINTS or mostly_repeated(omega):
        return sd
    off = distance_from_smooth(at, of_modulus)
    if off < _FEW_REPEATS:
        return sd * curve / modulus if off < 0.5 * distance_from_smooth(at, of_sd) else sd
    smooth = curve * np.exp(np.polyval(np.polyfit(x - x.mean(), part, _DEGREE), x - x.mean()))
    return smooth * np.sqrt(np.mean((sd / smooth) ** 2))  # then the mean square of sd / result is 1


def merged(omega: np.ndarray, *columns: np.ndarray) -> tuple[np.ndarray, ...]:
    """Return one point per frequency: points with the same frequency are averaged."""
    different, place = np.unique(omega, return_inverse=True)
    count = np.bincount(place)
    return different, *(np.bincount(place, column) / count for column in columns)


def mostly_repeated(omega: np.ndarray) -> bool:
    """Return whether most frequencies occur several times: the median number of points per frequency is 2 or more."""
    return bool(np.median(np.unique(omega, return_counts=True)[1]) >= 2)


def within(sweep: Sweep, low: float | None, high: float | None, fewest: int = FEWEST) -> Sweep:
    """Return the sweep with only the points from `low` to `high` [Hz]. A note reports the number of ignored points.

    Raises:
        InputError: fewer than `fewest` frequencies remain.
    """
    hertz = sweep.angular_frequency / (2 * np.pi)
    kept = np.ones(len(hertz), bool)
    for limit, side, name in ((low, -1, "min"), (high, 1, "max")):
        if limit is None:
            continue
        if not (np.isfinite(limit) and limit > 0):
            raise InputError(f"--{name}-frequency {limit:g} is not a frequency in Hz: give a positive number")
        kept &= side * hertz <= side * limit * (1 + side * 1e-9)
    if kept.all():
        return sweep
    if len(np.unique(hertz[kept])) < fewest:
        raise InputError(
            f"{sweep.source or 'sweep'}: --min-frequency and --max-frequency keep only {kept.sum()} of {len(kept)} "
            f"points (the file has {hertz[0]:.3g} to {hertz[-1]:.3g} Hz); keep {fewest} or more frequencies"
        )
    ends = " and ".join(
        f"{word} {limit:g} Hz" for word, limit in (("below", low), ("above", high)) if limit is not None
    )
    note = f"{(~kept).sum()} of {len(kept)} points {ends} are ignored as requested"
    return some(sweep, kept)._replace(notes=(*sweep.notes, note))


def some(sweep: Sweep, kept: np.ndarray) -> Sweep:
    """Return the sweep with only the points where `kept` (n,) is true."""
    names = ("angular_frequency", "storage", "loss", "storage_sd", "loss_sd", "inertia", "friction", "sweep_numbers")
    columns: Content = {q: None if getattr(sweep, q) is None else getattr(sweep, q)[kept] for q in names}
    raw = None if sweep.raw is None else {q: v[kept] for q, v in sweep.raw.items()}
    return sweep._replace(**columns, raw=raw)


def without_copies(sweep: Sweep) -> Sweep:
    """Return the sweep without copies of points (`without_multiples`). A copy is no new measurement. A note reports the
    number of copies."""
    columns = (sweep.angular_frequency, sweep.storage, sweep.loss, sweep.storage_sd, sweep.loss_sd)
    every = [*(v for v in columns if v is not None), *(sweep.raw or {}).values()]
    rows = np.nan_to_num(np.column_stack(every), nan=np.inf)  # an empty cell equals an empty cell
    kept = np.isin(np.arange(len(rows)), without_multiples([tuple(row) for row in rows.tolist()]))
    if kept.all():
        return sweep
    note = f"{(~kept).sum()} of {len(kept)} points are ignored, because they are copies of other points"
    return some(sweep, kept)._replace(notes=(*sweep.notes, note))


def with_friction(sweep: Sweep, error: float, radius: float, height: float) -> Sweep:
    """Return the sweep with new values of the fields `friction` and `friction_error`. `error` [N m s] is the standard
    deviation of the friction of the instrument's bearing; `radius` and `height` of the sample are in m.

    Raises:
        InputError: the moduli are of tension or bending.
    """
    if sweep.tensile:
        raise InputError(
            f"{sweep.source or 'sweep'}: the moduli are of {sweep.load}, and --friction-error {error:g} is the "
            "friction of an instrument that turns the sample: remove --friction-error"
        )
    geometry = np.pi * radius**4 / (2 * height)
    return sweep._replace(friction=error * sweep.angular_frequency / geometry, friction_error=error)


def without_inertia(
    sweep: Sweep, radius: float | None = None, height: float | None = None, fewest: int = FEWEST
) -> Sweep:
    """Return the sweep without the points at which the instrument's inertia dominates: there, the uncertainty of the
    inertia's contribution [Pa] exceeds the modulus. These points become `grey`.

    The inertia is found from raw torque and raw angle, with the torque of the sample or its `radius` and `height` [m].
    If these columns do not show the inertia, the inertia is found from the raw phase.

    Raises:
        InputError: fewer than `fewest` frequencies remain.
    """
    raw = sweep.raw
    if not raw or not set(raw_torque.COLUMNS) & set(raw):
        return sweep
    geometry = np.pi * radius**4 / (2 * height) if radius and height else None
    G = sweep.storage + 1j * sweep.loss
    omega = sweep.angular_frequency
    found = raw_torque.share(omega, G, raw, geometry) or raw_torque.share_by_phase(omega, G, raw)
    if found is None and "phase" in raw:
        found = raw_torque.share_by_phase(omega, G, {"phase": -raw["phase"]})
        if found is not None:
            sign = (
                "the raw phases agree with the moduli only after a change of sign (these phases are lags of the angle)"
            )
            sweep = sweep._replace(notes=(*sweep.notes, sign))
    if found is None:
        if {"torque", "angle"} <= set(raw) and geometry is None:
            size = "the inertia of the instrument can be computed from raw torque and angle: give --radius and --height"
            return sweep._replace(notes=(*sweep.notes, size))
        return sweep
    sweep = sweep._replace(inertia=found.modulus)
    unknown = raw_torque.UNCERTAINTY * found.modulus
    lost = unknown > np.abs(G)
    k = int(np.argmax(found.modulus / np.abs(G)))
    shows = "phase shows the inertia of the instrument"
    if np.isfinite(found.inertia):
        shows = f"torque shows an instrument inertia of {1e6 * found.inertia:.4g} uN m s^2"
    times = found.modulus[k] / np.abs(G[k])
    note = (
        f"the raw {shows}{_points_without_raw_values(raw)}; at {omega[k] / (2 * np.pi):.3g} Hz, the torque for the "
        f"inertia is {times:.3g} times the torque of the sample"
    )
    if not lost.any():
        return sweep._replace(notes=(*sweep.notes, note))
    if len(np.unique(sweep.angular_frequency[~lost])) < fewest:
        raise InputError(
            f"{sweep.source}: {note}: the instrument dominates at nearly all points; measure at lower frequencies"
        )
    lowest = sweep.angular_frequency[lost].min() / (2 * np.pi)
    share = f"the uncertainty of the torque for the inertia ({100 * raw_torque.UNCERTAINTY:g} % of this torque)"
    left = (
        f"{lost.sum()} of {len(lost)} points from {lowest:.4g} Hz on are ignored, because the torque of the sample is "
        f"below {share}"
    )
    grey = np.column_stack([sweep.angular_frequency, sweep.storage, sweep.loss])[lost]
    grey = grey if sweep.grey is None else np.concatenate([sweep.grey, grey])
    return some(sweep, ~lost)._replace(notes=(*sweep.notes, note, left), grey=grey)


def _points_without_raw_values(raw: dict[str, np.ndarray]) -> str:
    """Return words about the points without a value in one of the raw columns, or an empty string."""
    known = raw_torque.with_raw_columns(raw)
    if known.all():
        return ""
    return (
        f" ({np.sum(~known)} of {len(known)} points have an empty cell in the raw columns, or a torque or displacement "
        "of 0: for these points, the inertia of the other points is used)"
    )
