"""Checks of measured moduli without a model (causality, effects of the instrument), and a test of residuals.

Every material that relaxes has a spectrum, which is a sum of terms. Each term has a relaxation time tau and a
non-negative strength. With x = omega tau, the moduli of each term fulfil

    0 <= dG'/d ln(omega) <= G''      and      |dG''/d ln(omega)| <= G''

because 2 x^2 / (1 + x^2)^2 <= x / (1 + x^2). If the data violate these bounds by more than their scatter, the data
contain more than the response of the material. At high frequencies, the inertia of the instrument may cause a
violation: it adds a term to G' that grows as omega^2. This violation is called the mark of the instrument. At low
frequencies, the transient at the start of the test may cause a violation. A second check is the distance between the
data and the best spectrum of any shape. It tests the Kramers-Kronig relation and non-negative dissipation together,
over the whole band.
"""

import math
from typing import NamedTuple

import numpy as np
import scipy.special

from fitting.methods.generalised_maxwell import Spectrum
from fitting.readers.frequency_sweep import FEWEST, Sweep, merged, scatter, some

#: A violation of the bounds counts if it is larger than SIGNIFICANT (1 + _FEW_POINTS / n^2) standard deviations of the
#: scatter, where n is the number of frequencies, and also larger than NEGLIGIBLE times the modulus. The scatter of few
#: points is uncertain, and often too small. With this limit, fewer than 1 % of simulated sweeps (constant modulus with
#: random errors, 8 to 60 frequencies) show a violation in the last half decade.
SIGNIFICANT, _FEW_POINTS, NEGLIGIBLE = 4.0, 80, 0.002
#: A warning is given if the relative distance of the best spectrum from the data is larger than FAR, and also larger
#: than FAR_RATIO times the scatter.
FAR, FAR_RATIO = 0.01, 5.0
#: The misfit is called structured if the probability of so few changes of sign in random residuals is below this value.
CHANCE = 0.005


class Consistency(NamedTuple):
    """Results of the checks of a sweep."""

    misfit: float  # relative root mean square distance of the best non-negative spectrum from the data
    scatter: float  # relative scatter of neighbouring points about a smooth curve (root mean square)
    breaches: tuple[tuple[float, float, str], ...]  # intervals [rad/s] and the violated bound
    onset: float | None  # last frequency [rad/s] before the instrument's inertia shows; None: no effect of this inertia

    @property
    def far(self) -> bool:
        """Whether the data are far from every linear material."""
        return self.misfit > max(FAR, FAR_RATIO * self.scatter)


def of_data(sweep: Sweep, dense: Spectrum, sizes: np.ndarray | None = None) -> Consistency:
    """Check whether a sweep violates the bounds, and how far the best spectrum `dense` is from the data.

    Args:
        sweep: data with n frequencies.
        dense: the result of `generalised_maxwell.spectrum`.
        sizes: relative noise (2n,) of G' then G''. Only its dependence on the frequency is used, because the size is
            estimated from the scatter of the points. None: the relative noise is the same at all frequencies.
    """
    omega, noises = np.unique(sweep.angular_frequency), _relative_noises(sweep, sizes)
    breaches = []
    for k, why in enumerate(_breaches(sweep, sizes)):
        if why:
            breaches.append((float(omega[k]), float(omega[k + 1]), why))
    late, scattered = onset_of(sweep, sizes), max(float(np.sqrt(np.mean(noise**2))) for noise in noises)
    return Consistency(dense.misfit, scattered, tuple(breaches), None if late is None else late[0])


def without_instrument(sweep: Sweep, highest: float | None = None) -> Sweep:
    """Return the sweep without the points at high frequencies that show the inertia of the instrument. These points
    are moved to `grey`, and a note reports them.

    The search is repeated with the remaining points until the inertia is no longer found. Only the last half decade of
    the sweep is searched. `highest`: highest frequency [rad/s] of all sweeps of a master curve. The note recommends
    this value for --max-frequency, which keeps all points. None: there is only this sweep.
    """
    here, end = sweep, sweep.angular_frequency[-1] / math.sqrt(10)
    told = ""
    while True:
        found = onset_of(here)
        if found is None or found[0] <= end or len(np.unique(here.angular_frequency)) <= 2 * FEWEST:
            break
        told = told or found[1]
        here = some(here, here.angular_frequency <= found[0] * (1 + 1e-9))
    lost = sweep.angular_frequency > here.angular_frequency[-1]
    if not lost.any():
        return sweep
    low, high = (omega / (2 * np.pi) for omega in (here.angular_frequency[-1], highest or sweep.angular_frequency[-1]))
    note = (
        f"{lost.sum()} of {len(lost)} points above {low:.4g} Hz {'is' if lost.sum() == 1 else 'are'} ignored. Reason: "
        f"{told}, which is the mark of the instrument. The inertia of the instrument adds a term that grows as "
        "frequency^2; no material that relaxes shows this term. To keep all points, give --max-frequency "
        f"{_rounded_up(high):.4g}"
    )
    grey = np.column_stack([sweep.angular_frequency, sweep.storage, sweep.loss])[lost]
    grey = grey if sweep.grey is None else np.concatenate([sweep.grey, grey])
    return here._replace(grey=grey, notes=(*sweep.notes, note))


def onset_of(sweep: Sweep, sizes: np.ndarray | None = None) -> tuple[float, str] | None:
    """Find the effect of the instrument's inertia (the mark of the instrument) in the last half decade of the sweep.
    Returns the last frequency [rad/s] before the mark and the violated bound, or None if there is no mark. `sizes`: see
    `of_data`."""
    omega = np.unique(sweep.angular_frequency)
    for low, why in zip(omega[:-1], _breaches(sweep, sizes), strict=True):
        if low > omega[-1] / math.sqrt(10) and why.startswith("G' "):
            return float(low), why
    return None


def _relative_noises(sweep: Sweep, sizes: np.ndarray | None) -> list[np.ndarray]:
    """Return the relative noise of G' and of G'' at every frequency, from the scatter of the points. `sizes`: see
    `of_data`."""
    omega, *moduli = merged(sweep.angular_frequency, sweep.storage, sweep.loss)
    sizes = np.ones(2 * len(sweep.storage)) if sizes is None else sizes
    _, *shapes = merged(sweep.angular_frequency, *np.split(sizes, 2))
    return [scatter(omega, m) * shape / np.median(shape) for m, shape in zip(moduli, shapes, strict=True)]


def _breaches(sweep: Sweep, sizes: np.ndarray | None) -> list[str]:
    """Return for each pair of neighbouring frequencies the result of `_breach`.

    If the sweep has standard deviations that were estimated from its scatter (`sd_estimated`), the noise of G'' is at
    least `loss_sd`. `sizes`: see `of_data`.
    """
    omega, storage, loss = merged(sweep.angular_frequency, sweep.storage, sweep.loss)
    limit = SIGNIFICANT * (1 + _FEW_POINTS / len(omega) ** 2)
    of_storage, of_loss = _relative_noises(sweep, sizes)
    if sweep.sd_estimated and sweep.loss_sd is not None:
        of_loss = np.maximum(of_loss, merged(sweep.angular_frequency, sweep.loss_sd / sweep.loss)[1])
    limits = limit * np.stack([of_storage, of_loss])
    pairs = [slice(k, k + 2) for k in range(len(omega) - 1)]
    return [_breach(omega[own], storage[own], loss[own], limits[:, own]) for own in pairs]


def _breach(omega: np.ndarray, storage: np.ndarray, loss: np.ndarray, limits: np.ndarray) -> str:
    """Return words that say how two neighbouring points violate a bound, or an empty string.

    `limits`: largest relative errors (2, 2) that are regarded as scatter, of G' and of G'' (rows) at the two points
    (columns).
    """
    step = math.log(omega[1] / omega[0])
    # Upper bound of the rise of G' between the two points, for the largest G'' that is possible between them:
    # |d ln G''/d ln omega| is at most 1.
    most = step * max(loss) * math.exp(step / 2)
    rise, margin = storage[1] - storage[0], max(math.hypot(*limits[0] * storage), NEGLIGIBLE * max(storage))
    if rise > most + margin:
        return "G' rises by more than G'' allows"
    if -rise > margin:
        return "G' falls"
    if abs(math.log(loss[1] / loss[0])) > step + max(math.hypot(*limits[1]), NEGLIGIBLE):
        return "G'' changes by a larger factor than the frequency"
    return ""


def sentences(found: Consistency, sweep: Sweep) -> list[str]:
    """Return warnings about the data for the user, each with a remedy."""
    out, last = [], sweep.angular_frequency[-1] / (2 * np.pi)
    if found.onset is not None:
        hertz, bound = found.onset / (2 * np.pi), next(why for low, _, why in found.breaches if low == found.onset)
        remedy = f"exclude them with --max-frequency {_rounded_up(hertz):.4g}"
        if sweep.sweep_numbers is not None:  # the frequencies are shifted
            remedy = (
                "exclude the ends of the sweeps with --max-frequency, which limits the frequencies before the shift"
            )
        out.append(
            f"above {hertz:.3g} Hz the storage modulus changes as in no material that relaxes ({bound}). This is the "
            "mark of the instrument: its inertia adds a term that grows as frequency^2. No model describes these "
            f"points: {remedy}"
        )
    inner = [b for b in found.breaches if found.onset is None or b[0] < found.onset]
    if inner:
        low, high, why = inner[0]
        start = low == sweep.angular_frequency[0]
        cause = "the start of the test, or a drift" if start else "an outlier, a drift, or the instrument"
        more = f" (and in {len(inner) - 1} more intervals)" if len(inner) > 1 else ""
        out.append(
            f"between {low / (2 * np.pi):.3g} and {high / (2 * np.pi):.3g} Hz{more} {why}, by more than the scatter of "
            f"the points. This is possible in no material that relaxes: look for {cause}"
        )
    if found.far:
        out.append(
            "G' and G'' contradict each other (Kramers-Kronig): the best spectrum of any shape differs from these "
            f"moduli by {100 * found.misfit:.2g} % on average up to {last:.3g} Hz, but the points scatter by only "
            f"{100 * found.scatter:.2g} %. No model can come closer. Look for drift, or strain beyond the linear range"
        )
    return out


def _rounded_up(hertz: float) -> float:
    """Return the frequency [Hz], rounded upwards to four significant digits. As a frequency limit, this value does not
    exclude the point at `hertz`."""
    unit = 10.0 ** (math.floor(math.log10(hertz)) - 3)
    return math.ceil(hertz / unit) * unit


#: _ONE_SIDED: nearly all residuals have one sign if the probability of so many equal signs by chance is below this
#: value. _OUTLIERS: residuals of the rarer sign are outliers if their mean size exceeds this many times the mean size
#: of the others.
_ONE_SIDED, _OUTLIERS = 1e-4, 3.0


def runs_probability(residuals: np.ndarray) -> tuple[int, float]:
    """Return the number of runs (groups of consecutive residuals with equal sign), and the probability of at most this
    number of runs if the signs were in random order (Wald and Wolfowitz 1940). If nearly all residuals (n,) have one
    sign, their order gives no information. Then the second result is the probability that at least so many of n random
    signs are equal (two-sided sign test). If the residuals of the rarer sign are outliers, the probability of the runs
    test is still returned.
    """
    residuals = np.asarray(residuals)[np.asarray(residuals) != 0]
    up = residuals > 0
    n, a = len(up), int(up.sum())
    b = n - a
    runs = int(1 + np.sum(up[1:] != up[:-1])) if n else 0
    few, many = (np.abs(residuals[up == (keep == (a < b))]) for keep in (True, False))
    equal_signs = min(1.0, 2 * float(scipy.special.bdtr(len(few), n, 0.5))) if n else 1.0
    one_sided = equal_signs < _ONE_SIDED and not (len(few) and few.mean() > _OUTLIERS * many.mean())
    if len(few) == 0 or one_sided:
        return runs, equal_signs
    # Among r runs, one sign has r // 2 runs. The other sign has the same number, or one more.
    r = np.arange(2, runs + 1)
    k, more = r // 2, r // 2 + r % 2
    ways = np.logaddexp(_log_splits(a, k) + _log_splits(b, more), _log_splits(a, more) + _log_splits(b, k))
    return runs, min(1.0, float(np.exp(scipy.special.logsumexp(ways) - _log_splits(n + 1, a + 1))))


def _log_splits(n: int, parts: np.ndarray | int) -> np.ndarray:
    """Return the logarithm of the number of ways to divide n ordered points into `parts` runs, C(n - 1, parts - 1). The
    result is -inf if there is no way."""
    top, low = n - 1, np.asarray(parts) - 1
    log = scipy.special.gammaln
    return np.where(low <= top, log(n) - log(low + 1) - log(np.maximum(top - low, 0) + 1), -np.inf)


#: Part of the warning about a structured misfit. Other modules replace this part if the errors contain the misfit.
NOT_CONTAINED = "the standard errors do not contain it"


def structure(omega: np.ndarray, storage: np.ndarray, loss: np.ndarray) -> tuple[dict, list[str]]:
    """Test the signs of the residuals of G' and of G'', ordered by frequency, with a runs test. Returns the results of
    the tests, and one warning if the misfit is structured. The noise of repeated measurements at one frequency may be
    correlated, so their residuals are averaged first."""
    numbers, told = {}, []
    omega, storage, loss = merged(omega, storage, loss)
    for name, residuals in (("storage_modulus", storage), ("loss_modulus", loss)):
        runs, chance = runs_probability(residuals)
        numbers[name] = {"runs": runs, "probability": chance}
        if chance < CHANCE:
            told.append(
                f"of {name} change sign {runs - 1} times over {len(omega)} frequencies (probability by chance: "
                f"{chance:.1g})"
            )
    if not told:
        return numbers, []
    return numbers, [
        f"structured misfit: the residuals {' and those '.join(told)}. The model misses something that is not noise, "
        f"and {NOT_CONTAINED}: use the total errors, or another --model"
    ]
