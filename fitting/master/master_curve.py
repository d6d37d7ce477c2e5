"""Compute the master curve of sweeps at several temperatures, and fit laws to its shift factors."""

from collections.abc import Sequence
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
import scipy.special

from fitting.master import shifts, temperature_laws
from fitting.master.shifts import Shifts
from fitting.master.temperature_laws import TemperatureLaw
from fitting.master.temperature_sweeps import OFF_NAME, SAME, AtTemperatures, joined, temperatures_in
from fitting.readers.frequency_sweep import Sweep, merged, mostly_repeated, scatter
from fitting.readers.rheometer import WARMER
from fitting.readers.units import celsius
from liverjax.core.errors import InputError
from liverjax.core.struct import Content

if TYPE_CHECKING:
    from fitting.fits.together.measured_tests import Measured

#: The program warns if the relative distance of a sweep from the common curve is larger than FAR_OFF, and also larger
#: than SCATTERS times the scatter of the points. It also warns if the standard error of a shift factor is larger than
#: LOOSE [decades].
FAR_OFF, SCATTERS, LOOSE = 0.05, 2.0, 0.3
#: If the relative distance of the points from the curve is below this value, the error of the spline may be its cause.
#: Then no factors that multiply the moduli are reported.
SMOOTH = 1e-3
#: Factors that multiply the moduli (vertical shifts) are reported only if the probability of the same improvement by
#: chance is below this value.
CHANCE = 1e-3
#: Factors that multiply the moduli are reported only if they reduce the distance of the sweeps from one curve to less
#: than this fraction of the distance without such factors.
BETTER = 0.8


class MasterCurve(NamedTuple):
    """The master curve: all sweeps, shifted to the reference temperature, with the shift factors and the fitted
    laws."""

    sweep: Sweep
    parts: list[Sweep]  # the shifted sweeps, in the order of the temperatures
    shifts: Shifts
    laws: list[TemperatureLaw]  # fitted laws, best fit first
    ignored: np.ndarray = np.zeros(0)  # temperatures [K] whose sweeps are ignored


def master_curve(data: AtTemperatures, reference: float | None, vertical: bool = False) -> MasterCurve:
    """Shift all sweeps to one reference temperature, and return the master curve.

    Args:
        data: sweeps at two or more temperatures.
        reference: reference temperature [K]; the nearest measured temperature is used. None: the middle temperature. If
            the file gives shift factors, None means the temperature with the factor nearest to 1.
        vertical: whether factors that multiply the moduli are fitted too. Such factors cannot be fitted if the file
            gives the shift factors.
    """
    T = data.temperatures
    place = len(T) // 2 if reference is None else int(np.argmin(np.abs(T - reference)))
    if reference is not None and not T.min() - 10 <= reference <= T.max() + 10:
        raise InputError(
            f"--master {celsius(reference):.4g}: the sweeps are from {celsius(T[0]):.4g} to {celsius(T[-1]):.4g} °C; "
            "give a temperature in this range, or at most 10 K outside it"
        )
    untold: list[str] = []
    if data.shift_factors is not None:
        log_a = np.log10(data.shift_factors)
        if reference is None:  # the reference of the given factors is the temperature with the factor 1
            place = int(np.argmin(np.abs(log_a)))
            if log_a[place] != 0:
                untold.append(
                    f"no temperature has the shift factor 1, so the reference is {celsius(T[place]):.4g} °C, and the "
                    f"given factors are divided by {data.shift_factors[place]:.4g}"
                )
        found = shifts.known_shifts(data.sweeps, T, place, log_a - log_a[place])
    else:
        found = shifts.found(data.sweeps, T, place, vertical)
        untold = (_unshown_factors if vertical else _factors_of_moduli)(data.sweeps, found)
    parts = [_shifted_sweep(s, a, b) for s, a, b in zip(data.sweeps, found.log_a, found.log_b, strict=True)]
    laws = temperature_laws.temperature_laws_of(found)
    whole = joined(parts)
    notes = [*whole.notes, *_sentences(found, _scatter_of_points(data.sweeps), vertical), *untold]
    if vertical and found.given:
        notes.append(
            "--vertical finds no factors of the moduli, because the file gives the factors of the frequencies: remove "
            "the column shift_factor to find both kinds of factors"
        )
    return MasterCurve(whole._replace(notes=tuple(notes), raw=None), parts, found, laws, data.ignored)


def _shifted_sweep(sweep: Sweep, log_a: float, log_b: float) -> Sweep:
    a, b = 10.0**log_a, 10.0**log_b
    moduli: Content = {q: getattr(sweep, q) for q in ("storage", "loss", "storage_sd", "loss_sd")}
    moduli = {q: None if values is None else b * values for q, values in moduli.items()}
    grey = None if sweep.grey is None else sweep.grey * [a, b, b]
    return sweep._replace(angular_frequency=a * sweep.angular_frequency, **moduli, grey=grey)


def _scatter_of_points(sweeps: list[Sweep]) -> float:
    """Return the relative scatter of the points about a smooth curve: the median of the scatter of G' and G'' in all
    sweeps. The result is 0 if there are too few points."""
    each = [scatter(*merged(s.angular_frequency, G)) for s in sweeps for G in (s.storage, s.loss)]
    known = [own for own in each if np.isfinite(own)]
    return float(np.median(known)) if known else 0.0


def _sentences(found: Shifts, noise: float, vertical: bool) -> list[str]:
    """Return a note about the shifts, and warnings if the shifted sweeps do not lie on one curve or if a shift is
    uncertain. `noise`: relative scatter of the points. `vertical`: whether the user wants factors of the moduli."""
    T = celsius(found.temperatures)
    out = [
        f"{len(T)} sweeps from {T[0]:.4g} to {T[-1]:.4g} °C are shifted to {T[found.reference]:.4g} °C. The root mean "
        f"square distance of the shifted points from one smooth curve is {100 * found.apart:.2g} %"
    ]
    far = [k for k in np.argsort(-found.misfit) if found.misfit[k] > max(FAR_OFF, SCATTERS * noise)]
    if far:
        listed = ", ".join(f"{T[k]:.4g} °C {100 * found.misfit[k]:.2g} %" for k in far[:4])
        more = f" and {len(far) - 4} more" if len(far) > 4 else ""
        remedy = ", or check the column shift_factor" if found.given else "" if vertical else ", or try --vertical"
        out.append(
            f"superposition is not valid at some temperatures (distance from the common curve: {listed}{more}); remove "
            f"these temperatures{remedy}"
        )
    loose = [k for k in range(len(T)) if found.log_a_errors[k] > LOOSE]
    if loose:
        listed = ", ".join(
            f"{T[k]:.4g} °C (uncertain by a factor of {10 ** found.log_a_errors[k]:.2g})" for k in loose[:4]
        )
        out.append(
            f"the data hardly determine the shift at {listed}: the curves are too flat to be shifted onto each other"
        )
    return out


def _factors_of_moduli(sweeps: list[Sweep], found: Shifts) -> list[str]:
    """Return a note if the sweeps lie much nearer to one curve after their moduli are multiplied by factors (F-test).
    The distances in G' and in G'' have the weights of the fit with factors. So the noise of one modulus does not hide a
    change of the other modulus."""
    try:
        other = shifts.found(sweeps, found.temperatures, found.reference, vertical=True)
        chance = _chance_of_factors(sweeps, found, other)
    except InputError:
        return []
    without, with_factors = (shifts.weighted_distance(sweeps, own, other.weights) for own in (found, other))
    if without < SMOOTH or not with_factors < BETTER * without or chance > CHANCE:
        return []
    b, T = 10.0**other.log_b, celsius(found.temperatures)
    moved = np.abs(other.log_a - found.log_a) / np.maximum(found.log_a_errors, 1e-12)
    k = int(np.argmax(moved))
    weighted = " (G' and G'' weighted by their noise)" if other.weights != (1.0, 1.0) else ""
    return [
        f"the moduli also change with the temperature by factors of {b.min():.3g} to {b.max():.3g}. With --vertical, "
        f"the sweeps lie {100 * with_factors:.2g} % from one curve instead of {100 * without:.2g} %{weighted}, and "
        f"log10 a at {T[k]:.4g} °C is {other.log_a[k]:.3g} instead of {found.log_a[k]:.3g} ± "
        f"{found.log_a_errors[k]:.1g}. The stated error does not contain this difference: give --vertical"
    ]


def _chance_of_factors(sweeps: list[Sweep], alone: Shifts, both: Shifts) -> float:
    """Return the p-value of an F-test: the probability that factors of the moduli reduce the distance of the sweeps
    from one curve so much by chance.

    Args:
        sweeps: the sweeps.
        alone, both: shifts without and with factors of the moduli. For the F-test, both are fitted again with the same
            distance between knots, the smaller one of `alone` and `both`.

    Raises:
        InputError: with this distance between knots, the shifted sweeps do not overlap.
    """
    knots = min(alone.knots, both.knots)
    at = both.temperatures, both.reference
    alone, both = (shifts.found(sweeps, *at, vertical, (knots,)) for vertical in (False, True))
    more, data = len(sweeps) - 1, sum(2 * len(s.storage) for s in sweeps)
    # The ratio of two sums with different weights would not follow the F-distribution.
    without, with_factors = (shifts.weighted_distance(sweeps, own, both.weights) ** 2 for own in (alone, both))
    ratio = without / max(with_factors, np.finfo(float).tiny)
    freedom = data - 2 * more - 2 * shifts.size_of_curve(sweeps, both.log_a, knots)
    return 1.0 if freedom < 1 else float(scipy.special.fdtrc(more, freedom, max(0.0, ratio - 1) * freedom / more))


def _unshown_factors(sweeps: list[Sweep], found: Shifts) -> list[str]:
    """Return a warning if a power law fits the sweeps as well as the common curve (F-test). For a power law, a factor
    of the moduli can replace any shift of the frequency, so the linearised errors are too small."""
    counts = [len(s.storage) for s in sweeps]
    of_sweep = np.repeat(np.eye(len(sweeps)), counts, axis=0)
    x = np.log10(np.concatenate([s.angular_frequency for s in sweeps]))[:, None]
    G = [np.log10(np.concatenate([getattr(s, name) for s in sweeps])) for name in ("storage", "loss")]
    # In a power law, log G' and log G'' have the same slope, and the temperature moves both by the same distance.
    A = np.block([[of_sweep, x, np.zeros_like(x)], [of_sweep, x, np.ones_like(x)]])
    y, weights = np.concatenate(G), np.repeat(found.weights, sum(counts))
    c = np.linalg.lstsq(weights[:, None] * A, weights * y, rcond=None)[0]
    straight = np.average((A @ c - y) ** 2, weights=weights**2) * np.log(10) ** 2
    numbers = 2 * (len(sweeps) - 1) + 2 * shifts.size_of_curve(sweeps, found.log_a, found.knots)
    more, freedom = numbers - A.shape[1], len(y) - numbers
    ratio = straight / max(shifts.weighted_distance(sweeps, found, found.weights) ** 2, np.finfo(float).tiny)
    if freedom < 1 or more < 1 or scipy.special.fdtrc(more, freedom, max(0.0, ratio - 1) * freedom / more) < CHANCE:
        return []
    return [
        "a power law fits the sweeps as well as the common curve, and then shifts of the frequency and factors of the "
        "moduli can replace each other. So --vertical does not determine these factors, and their stated errors are "
        "too small: remove --vertical, or measure a wider band"
    ]


def at_reference(tests: "Sequence[Measured]", shift: Content) -> "tuple[list[Measured], list[str]]":
    """Return the tests, shifted to the reference temperature. Also return a sentence about each test whose temperature
    is unknown or not the reference temperature. `shift`: `shift_numbers` of the master curve."""
    each = [_test_at_reference(test, shift) for test in tests]
    return [test for test, _ in each], [sentence for _, sentence in each if sentence]


def _test_at_reference(test: "Measured", shift: Content) -> "tuple[Measured, str]":
    """Return one test and its sentence for `at_reference` (empty if the test needs no sentence)."""
    reference, heat = shift["reference_temperature_C"], _temperatures_of(test)
    if not isinstance(test, Sweep) or not heat.size:
        add = "add a column temperature_C, or " if isinstance(test, Sweep) else ""
        return test, (
            f"{test.source}: its temperature is not known, so it is predicted at {reference:.4g} °C without a shift: "
            f"{add}check that it was measured at this temperature"
        )
    apart = float(np.ptp(heat))
    if WARMER < apart <= OFF_NAME and not mostly_repeated(test.angular_frequency):
        return test, (
            f"{test.source}: its temperature changes by {apart:.2g} K ({heat.min():.4g} to {heat.max():.4g} °C), so it "
            f"is predicted at {reference:.4g} °C without a shift: measure it at a constant temperature"
        )
    if apart > WARMER:
        return test, (
            f"{test.source}: it has several temperatures ({heat.min():.4g} to {heat.max():.4g} °C), so it is predicted "
            f"at {reference:.4g} °C without a shift: give one file for each temperature"
        )
    T = float(np.mean(heat))
    if abs(T - reference) <= WARMER:
        return test, ""
    near = np.abs(np.array(shift["temperatures_C"]) - T)
    k = int(np.argmin(near))
    at = f"{test.source}: measured at {T:.4g} °C"
    if near[k] < SAME:
        log_a, log_b = (shift[name][k] for name in ("log10_a", "log10_b"))
        shifted = _shifted_sweep(test, log_a, log_b)
        return shifted, f"{at}; its frequencies are multiplied by the shift factor {10.0**log_a:.4g}"
    dropped = any(abs(own - T) < SAME for own in shift.get("ignored_temperatures_C", []))
    why = "the sweep at its temperature is ignored" if dropped else "no sweep at its temperature is fitted"
    remedy = "include that sweep (a note says why it is ignored)" if dropped else "give such a sweep"
    return test, (
        f"{at}, but predicted at {reference:.4g} °C, because {why}: choose a reference temperature near to it, or "
        f"{remedy}"
    )


def _temperatures_of(test: "Measured") -> np.ndarray:
    """Return the temperatures (n,) [°C] from the column of a sweep, or from the name of its table if there is no such
    column. The array is empty if they are unknown, or if the name contains several temperatures."""
    if not isinstance(test, Sweep):
        return np.empty(0)
    T = (test.raw or {}).get("temperature", np.empty(0))
    T = T[np.isfinite(T)]
    stated = temperatures_in(test.table)
    return celsius(T if T.size else np.array(stated if len(stated) == 1 else []))


def shift_numbers(found: MasterCurve) -> Content:
    """Return the entry `shift` of fit.json: the shift factors, their standard errors and the fitted laws."""
    s = found.shifts
    return {
        "reference_temperature_C": float(celsius(s.temperatures[s.reference])),
        "given": s.given,
        "temperatures_C": celsius(s.temperatures).tolist(),
        "ignored_temperatures_C": celsius(found.ignored).tolist(),
        "log10_a": s.log_a.tolist(),
        "log10_a_standard_errors": s.log_a_errors.tolist(),
        "log10_b": s.log_b.tolist(),
        "log10_b_standard_errors": s.log_b_errors.tolist(),
        "distance_from_the_curve": s.misfit.tolist(),
        "laws": [
            {
                "law": law.name,
                "distance_decades": law.apart,
                "parameters": {n: {"value": v, "standard_error": e} for n, (v, e) in law.numbers.items()},
            }
            for law in found.laws
        ],
    }
