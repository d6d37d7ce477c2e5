"""Several samples of one material. Each sample is fitted separately, but with the same model. Then the population of
the samples is estimated."""

from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import numpy as np
import scipy.stats

from fitting.fits import instrument, viscoelastic
from fitting.fits.families import choice, models
from fitting.fits.honesty import edges
from fitting.fits.viscoelastic import Fit, Kind, information_criterion
from fitting.methods import as_prony_modes, generalised_maxwell, relaxation_spectrum, springpots, uncertainty
from fitting.methods.generalised_maxwell import Maxwell, Spectrum
from fitting.methods.population import ABOVE_ZERO, Population, population
from fitting.readers.rheometer import Sweep
from liverjax.core.errors import InputError


class Samples(NamedTuple):
    """Fits of the same model to all samples, and the population of each parameter of this model."""

    sweeps: list[Sweep]  # corrected for the error of the instrument's inertia, if it was found
    fits: list[Fit]
    populations: dict[str, Population | None]  # population of each parameter; names as in `values_of_sample`
    typical: Maxwell  # Prony modes of a typical sample, for a simulation
    compared: list[dict]  # table of the compared models and numbers of modes, best first

    @property
    def kind(self) -> Kind:
        """The kind of the common model of all samples."""
        return self.fits[0].kind

    @property
    def mostly_fluids(self) -> bool:
        """Whether at least half of the samples may be fluids: the equilibrium modulus is at most two standard errors,
        or the model of the sample has no equilibrium modulus."""
        pairs = [values_of_sample(f).get("equilibrium_modulus", (0.0, np.inf)) for f in self.fits]
        return 2 * sum(value <= 2 * error for value, error in pairs) >= len(pairs)

    def values(self, k: int) -> dict[str, tuple[float, float]]:
        """Return the value and the standard error of each parameter of sample k. The keys are the names in
        `populations`. A strength that is missing in the spectrum of this sample is 0."""
        own = values_of_sample(self.fits[k])
        return {name: own.get(name, (0.0, np.inf)) for name in self.populations}


class _Candidate(NamedTuple):
    label: dict
    fits: list[Fit]
    criterion: float  # sum of the information criteria of the samples
    able: bool  # whether at least half of the samples determine all parameters


def fit(
    sweeps: list[Sweep],
    model: str = "prony",
    modes: int | str = "auto",
    progress: Callable[[str], None] = lambda text: None,
) -> Samples:
    """Choose the model with the lowest sum of the information criteria of all samples. A model can be chosen only if at
    least half of the samples determine all its parameters. If a sweep contains the raw torque or the raw phase, its
    Prony modes are then fitted again, together with the error of the inertia that the instrument subtracted.

    Args:
        sweeps: two or more samples.
        model: one of `models.MODELS`.
        modes: number of Prony modes, or "auto".
        progress: called with the name of each fit.

    Raises:
        InputError: there are fewer than two sweeps, the model is unknown, or `modes` is invalid.
    """
    if len(sweeps) < 2:
        raise InputError(
            f"sweeps needs two or more samples, not {len(sweeps)}: fit a single sample with viscoelastic.closed_form"
        )
    if model not in models.MODELS:
        raise InputError(f"model = {model!r} is not known: use one of {', '.join(models.MODELS)}")
    dense = [instrument.spectrum_before_correction(s) for s in sweeps]
    tried: list[_Candidate] = []
    if model in ("prony", "auto"):
        tried += _modes_for_all(sweeps, dense, modes, progress)
        solids = min(tried, key=lambda c: c.criterion).fits
        if model == "auto" and 2 * sum(uncertainty.may_be_fluid(f.uncertainty) for f in solids) >= len(sweeps):
            tried += _modes_for_all(sweeps, dense, modes, progress, viscoelastic.FLUID)
    if model in ("fractional", "auto"):
        progress("springpots")
        every = [{f.kind.name: f for f in models.fractional(s)} for s in sweeps]
        for name in (n for n in every[0] if all(n in own for own in every)):  # a few points allow only small models
            tried.append(_candidate_for_all(sweeps, [own[name] for own in every], {"model": name}))
    if model in ("spectrum", "auto"):
        progress("spectrum")
        found = relaxation_spectrum.fit_all(sweeps)
        fits = [models.spectrum_fit(s, f) for s, f in zip(sweeps, found, strict=True)]
        tried.append(_candidate_for_all(sweeps, fits, {"model": "spectrum"}))
    able = [c for c in tried if c.able] or tried
    best = able[choice.preferred([choice.label_of(c.fits[0]) for c in able], [c.criterion for c in able])]
    progress("ends of the band")
    checked = [_without_error_of_instrument(*own) for own in zip(best.fits, sweeps, dense, strict=True)]
    fits, sweeps = [own for own, _ in checked], [own for _, own in checked]
    lowest = min(c.criterion for c in tried)
    rows = [c.label | {"above_the_lowest": c.criterion - lowest, "identifiable": c.able} for c in tried]
    compared = sorted(rows, key=lambda row: row["above_the_lowest"])
    populations = _populations(fits)
    return Samples(sweeps, fits, populations, _typical_sample(sweeps, fits, populations), compared)


def _without_error_of_instrument(fit: Fit, sweep: Sweep, dense: Spectrum) -> tuple[Fit, Sweep]:
    """Return the fit with the results of further checks (`edges.honest`), and the sweep. If the sweep has data of the
    instrument and the model has free Prony modes, both are corrected for the error of the instrument's inertia."""
    fit, corrected = instrument.without_error_of_inertia(fit, sweep)
    if instrument.nuisances_of(sweep):
        dense = generalised_maxwell.refuse_impossible(corrected)
    return edges.honest(fit, corrected, dense), corrected


def _candidate_for_all(sweeps: list[Sweep], fits: list[Fit], label: dict) -> _Candidate:
    determined = [models.identifiable(f, s) for f, s in zip(fits, sweeps, strict=True)]
    return _Candidate(label, fits, sum(map(information_criterion, fits)), 2 * sum(determined) >= len(fits))


def _modes_for_all(
    sweeps: list[Sweep], dense: list[Spectrum], modes: int | str, progress: Callable, kind: Kind = Kind()
) -> list[_Candidate]:
    """Return the fits of all samples with 1, 2, … Prony modes of a solid or a fluid (`kind`). The search ends after an
    exact fit. It also ends after two failures in a row: the fits do not lower the summed criterion, or most samples do
    not determine the modes."""
    largest = min(generalised_maxwell.largest_number_of_modes(s) for s in sweeps)
    for s in sweeps:
        viscoelastic.check_modes(s, 1 if modes == "auto" else modes)
    numbers = range(1, min(largest, min(map(uncertainty.supported_modes, sweeps))) + 1)
    if modes != "auto":
        numbers = range(int(modes), int(modes) + 1)
    tried: list[_Candidate] = []
    failures = 0
    for n in numbers:
        progress(f"{n} modes")
        starts = [models.starts_of_kind(kind, s, n, d) for s, d in zip(sweeps, dense, strict=True)]
        fits = [viscoelastic.modes_from(s, u, kind) for s, u in zip(sweeps, starts, strict=True)]
        tried.append(_candidate_for_all(sweeps, fits, {"model": kind.name, "modes": n}))
        lower = tried[-1].able and tried[-1].criterion <= min(c.criterion for c in tried)
        failures = 0 if lower or len(tried) == 1 else failures + 1
        exact = max(np.max(f.relative_errors(s)) for f, s in zip(fits, sweeps, strict=True)) < viscoelastic.EXACT
        if failures == 2 or exact:
            break
    return tried


def values_of_sample(fit: Fit) -> dict[str, tuple[float, float]]:
    """Return the parameters of a fit with their standard errors. These are the parameters of `edges.values` and, for a
    spectrum, also its strengths."""
    out = edges.values(fit)
    if fit.kind.effective is not None and fit.parameters is not None:
        rows = zip(fit.kind.names, fit.parameters.values, fit.parameters.standard_errors, strict=True)
        out = {n: (float(v), float(e)) for n, v, e in rows}
    return out


def _populations(fits: list[Fit]) -> dict[str, Population | None]:
    known, out = [values_of_sample(f) for f in fits], {}
    names = sorted({n for row in known for n in row if "[" in n}, key=lambda n: (n.split("[")[0], _place(n)))
    # The spectrum of the first sample may have no equilibrium modulus.
    for name in (*dict.fromkeys(n for row in known for n in row if "[" not in n), *names):
        pairs = np.array([row.get(name, (0.0, np.inf)) for row in known])
        if "exponent" in name:
            found = _of_exponents(pairs[:, 0], pairs[:, 1])
        else:
            # The equilibrium modulus is a small difference of larger moduli: its error hardly depends on its value.
            found = population(pairs[:, 0], pairs[:, 1], additive=name == "equilibrium_modulus")
        if found is not None and (name.startswith("ratios[") or "exponent" in name):  # these cannot exceed 1
            of_mean, of_new = ((low, min(1.0, high)) for low, high in (found.mean_interval, found.new_interval))
            found = found._replace(mean_interval=of_mean, new_interval=of_new)
        out[name] = found
    return out


def _of_exponents(values: np.ndarray, errors: np.ndarray) -> Population | None:
    """Return the population of an exponent. Its mean is an arithmetic mean, because log|G*| is linear in the exponent.
    The spread is the standard deviation between samples, divided by the mean."""
    known = (values > 0) & (errors < 10 * values)
    size = np.exp(values)
    p = population(size, np.where(known, size * errors, np.inf))
    if p is None or p.mean <= 1:
        return None
    mean, pooled = float(np.log(p.mean)), np.maximum(np.log(p.pooled), 1e-300)
    low, high = (np.maximum(np.log(ends), 0.0).tolist() for ends in zip(p.mean_interval, p.new_interval, strict=True))
    return Population(
        mean=mean,
        spread=p.spread / mean,
        mean_interval=(low[0], high[0]),
        new_interval=(low[1], high[1]),
        pooled=pooled,
        pooled_errors=p.pooled_errors / pooled,
        mean_error=p.mean_error / mean,
    )


#: _STRANGE: a sample is reported as an outlier if the probability that any of the samples differs so much by chance is
#: below this value. _FEWEST: minimum number of samples for this test.
_STRANGE, _FEWEST = 0.05, 4
#: _APART: a sample is reported as an outlier only if its value, divided by the mean of the other samples, is above this
#: ratio or below the inverse of this ratio. _UNSURE: values whose logarithm has a larger standard error are not
#: compared.
_APART, _UNSURE = 1.3, 0.5
#: If moduli of one material differ by this factor, their units may be wrong.
_OTHER_UNIT = 100.0


def outliers(found: Samples) -> list[str]:
    """Return a warning for each sample with a parameter far from the other samples (t-tests on logarithms, Bonferroni
    correction). Half of the significance level is used for the first parameter, a modulus, because a wrong gap or
    radius multiplies all moduli by one factor. The other half is used for all other parameters together.

    The strengths of a spectrum are not compared, because one strength may be too large while its neighbour on the grid
    is too small. For a spectrum, the first parameter is |G*| in the middle of the common band.
    """
    names = [n for n in found.populations if not n.startswith("strengths[")]
    compared = {n: np.array([found.values(k)[n] for k in range(len(found.fits))]) for n in names}
    if len(names) < len(found.populations):
        compared = _middle_moduli(found) | compared
        names = list(compared)
    told: dict[int, list[tuple[float, str, float, float]]] = {}
    for name in names:
        for sample, chance, ratio, mean in _strangers(compared[name]):
            chance *= 1 if len(names) == 1 else 2 if name == names[0] else 2 * (len(names) - 1)
            if chance < _STRANGE:
                told.setdefault(sample, []).append((chance, name, ratio, mean))
    out = []
    for sample, own in told.items():
        which = ", and ".join(
            f"its {name} is {ratio:.2g} times the mean {mean:.4g} of the other samples (probability by chance "
            f"{chance:.1g})"
            for chance, name, ratio, mean in own
        )
        what = "the units and sizes of this sample"
        moduli = ("modulus", "springpot", "Hz")  # endings of the names of moduli; "Hz" is for `_middle_moduli`
        if not any(name.endswith(moduli) for _, name, _, _ in own):
            what = "the temperature, the unit of the frequency, and the sample"
        source = Path(found.sweeps[sample].source).name
        out.append(f"{source}: {which}. Check {what}. This sample widens the population's intervals")
    if out or not names:
        return out
    name = "shear_modulus" if "shear_modulus" in names else names[0]
    known, logs, _ = _known_logarithms(compared[name])
    return _of_another_unit(logs, [Path(found.sweeps[k].source).name for k in known], name)


def _middle_moduli(found: Samples) -> dict[str, np.ndarray]:
    """Return the fitted |G*| of the n samples in the middle of their common band. The key is the name of this modulus.
    The value is an array (n, 2): the moduli, and the typical error of a single point. The result is empty if the
    samples have no common band."""
    low, high = (np.log([s.angular_frequency[end] for s in found.sweeps]) for end in (0, -1))
    if low.max() > high.min():
        return {}
    at, rows = (low.max() + high.min()) / 2, []
    for fit, sweep in zip(found.fits, found.sweeps, strict=True):
        size = np.exp(np.interp(at, np.log(sweep.angular_frequency), np.log(np.hypot(fit.storage, fit.loss))))
        rows.append((size, size * fit.relative_errors(sweep).mean()))
    return {f"|G*| at {np.exp(at) / (2 * np.pi):.3g} Hz": np.array(rows)}


def _known_logarithms(pairs: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the indices of the samples that determine a parameter, the logarithms of the values of this parameter, and
    the standard errors of these logarithms. `pairs` (n, 2): values and standard errors."""
    known = np.flatnonzero((pairs[:, 0] > 0) & (pairs[:, 1] < _UNSURE * pairs[:, 0]))
    return known, np.log(pairs[known, 0]), pairs[known, 1] / pairs[known, 0]


def _strangers(pairs: np.ndarray) -> list[tuple[int, float, float, float]]:
    """Return the samples whose parameter is far from the parameter of the other samples. Each entry contains the index
    of the sample, the probability of such a distance by chance in any of the samples, the parameter divided by the mean
    of the other samples, and this mean. `pairs` (n, 2): values and standard errors of the parameter.
    """
    known, logs, errors = _known_logarithms(pairs)
    out = []
    for k, sample in enumerate(known if len(known) >= _FEWEST else ()):
        others = np.delete(logs, k)
        deviation = np.sqrt(others.var(ddof=1) * (1 + 1 / len(others)) + errors[k] ** 2)
        apart = float((logs[k] - others.mean()) / max(deviation, 1e-12))
        chance = 2 * len(logs) * float(scipy.stats.t.sf(abs(apart), len(others) - 1))
        if chance < _STRANGE and abs(logs[k] - others.mean()) > np.log(_APART):
            out.append((int(sample), chance, float(np.exp(logs[k] - others.mean())), float(np.exp(others.mean()))))
    return out


def _of_another_unit(logs: np.ndarray, sources: list[str], name: str) -> list[str]:
    """Return a warning if some samples have a modulus far above or below the modulus of the others. `logs`: logarithms
    of the modulus `name`. This check also works if there are too few samples for a statistical test."""
    order = np.argsort(logs)
    gaps = np.diff(logs[order])
    if not len(gaps) or gaps.max() < np.log(_OTHER_UNIT):
        return []
    first = int(np.argmax(gaps)) + 1
    below, above = ([sources[k] for k in own] for own in (order[:first], order[first:]))
    fewer, way = (above, "above") if len(above) < len(below) else (below, "below")
    return [
        f"{', '.join(fewer)}: the {name} is at least a factor of {np.exp(gaps.max()):.2g} {way} that of the other "
        "samples; check units and sizes. This factor widens the population's intervals"
    ]


def _place(name: str) -> int:
    return int(name[name.index("[") + 1 : -1])


def typical_values(fits: list[Fit], populations: dict[str, Population | None]) -> dict[str, float]:
    """Return the parameters of a typical sample, for another model than Prony modes: the means of the populations. For
    a parameter without a mean, the median of the samples is used. A parameter of a spectrum is 0 if its median is 0."""
    kind, every = fits[0].kind, [values_of_sample(f) for f in fits]
    middle = {n: float(np.median([row.get(n, (0.0,))[0] for row in every])) for n in populations}
    zero = {n for n, m in middle.items() if kind.effective is not None and m <= 0}
    return {n: 0.0 if n in zero else middle[n] if p is None else p.mean for n, p in populations.items()}


def _typical_sample(sweeps: list[Sweep], fits: list[Fit], populations: dict[str, Population | None]) -> Maxwell:
    """Return the Prony modes of a typical sample, whose parameters are the means of the populations. Modes without a
    mean are not included. For other parameters without a mean, the median of the samples is used.

    The equilibrium modulus of Prony modes is also the mean of the population (0 if no sample determines it). The mean
    ratios alone would give another equilibrium modulus, so they are multiplied by one factor. This is not done if a
    mode has no mean, or if only one sample determines the equilibrium modulus."""
    kind, every = fits[0].kind, [values_of_sample(f) for f in fits]
    mean = {name: p.mean for name, p in populations.items() if p is not None}
    if kind.values is None:
        if "shear_modulus" not in mean:
            raise InputError("the samples together do not determine the shear modulus: fit each sample separately")
        known = [k for k in range(len(populations)) if {f"ratios[{k}]", f"relaxation_times[{k}]"} <= set(mean)]
        ratios, times = (np.array([mean[f"{n}[{k}]"] for k in known]) for n in ("ratios", "relaxation_times"))
        rest = mean.get("equilibrium_modulus", 0.0) / mean["shear_modulus"]
        factor = max(0.0, 1 - rest) / max(ratios.sum(), 1e-300)
        value, error = np.array([row.get("equilibrium_modulus", (0.0, np.inf)) for row in every]).T
        decided = rest < 1 and (rest > 0 or not np.any(value > ABOVE_ZERO * error))
        ratios = ratios * (factor if decided and len(known) == fits[0].modes else min(1.0, factor))
        return Maxwell(mean["shear_modulus"], ratios, times)  # type: ignore[arg-type]
    typical = typical_values(fits, populations)
    low, high = min(s.angular_frequency[0] for s in sweeps), max(s.angular_frequency[-1] for s in sweeps)
    if kind.effective is not None:
        grid = relaxation_spectrum.grid_of_times(1 / high, 1 / low, fits[0].details["spectrum"]["times_per_decade"])
        strengths = np.zeros(1 + len(grid))
        for name in populations:
            place = 0 if name == "equilibrium_modulus" else 1 + _place(name)
            strengths[place] = typical[name]

        def smooth(omega):
            return np.split(generalised_maxwell.mode_columns(omega, grid) @ strengths, 2)

        made = as_prony_modes.convert(smooth, low, high, bool(strengths[0] > 0))
        return as_prony_modes.modes(made, smooth(made.omega))
    (model,) = (m for m in springpots.FRACTIONAL if m.name == kind.name)
    values = [typical[name] for name in model.names]

    def formula(omega):
        G = model.formula(1j * omega, *values)
        return G.real, G.imag

    made = as_prony_modes.convert(formula, low, high, model.solid)
    return as_prony_modes.modes(made, formula(made.omega))
