"""Compute the effect of the instrument's inertia on a sweep from the raw columns (torque, angle, phase) that some
exports contain.

Raw torque M and angle theta obey M e^(i phase) = (K G* - I omega^2) theta. K is the geometry factor. I is the inertia
of the instrument, whose effect the software has already subtracted from the moduli. I omega^2 / K [Pa] is the
contribution of the inertia to the modulus, with the relative error `UNCERTAINTY`.
"""

import re
from collections.abc import Iterator
from typing import NamedTuple

import numpy as np

from fitting.readers.units import RAW_TORQUE_UNITS

#: Relative standard deviation of an instrument's inertia: the scatter between repeated calibrations of one instrument.
UNCERTAINTY = 0.03
#: First words of a heading, and the quantity that they mean. If several columns have the same quantity, the column
#: whose words come first in this list is used.
HEADINGS = (
    ("oscillation torque (sample)", "sample_torque"),
    ("oscillation torque", "torque"),
    ("raw oscillation phase", "phase"),
    ("raw phase", "phase"),
    ("oscillation displacement", "angle"),
    ("torque", "torque"),
    ("deflection angle", "angle"),
    ("angle", "angle"),
    ("oscillation strain", "strain"),
    ("shear strain", "strain"),
    ("strain amplitude", "strain"),
    ("strain", "strain"),
    ("scherdeformation", "strain"),
    ("deformation", "strain"),
    ("déformation", "strain"),
)


class SampleShare(NamedTuple):
    """The inertia of the instrument, and the size of its contribution to the modulus."""

    inertia: float  # I [N m s^2]; NaN if K is unknown
    modulus: np.ndarray  # (n,) I omega^2 / K [Pa]


def known_columns(cells: list[str], units: list[str]) -> dict[str, tuple[int, float]]:
    """Return column index and factor to SI for each quantity that has a known heading and a known unit.

    Args:
        cells: headings.
        units: units from a separate line of the file; may be empty.
    """
    return {q: (place, RAW_TORQUE_UNITS[q][unit]) for q, (place, unit) in _places_and_units(cells, units).items()}


def unit_of(quantity: str, cells: list[str], units: list[str]) -> str:
    """Return the unit of a quantity from its heading or the line of units, or an empty string if both have no unit."""
    return _places_and_units(cells, units).get(quantity, (0, ""))[1]


#: Example of a heading with a unit, for each raw column of the instrument.
_EXAMPLES = {"torque": "torque_uN.m", "angle": "angle_mrad", "phase": "raw_phase_deg"}


def without_unit(cells: list[str], units: list[str]) -> list[str]:
    """Return a note on each raw column of the instrument that cannot be used because its unit is unknown."""
    known = _places_and_units(cells, units)
    return [
        f"column {cells[k].strip()!r} is not used to find the inertia of the instrument, because the unit "
        f"{f'{unit!r} is not known' if unit else 'is not stated'}; name this column e.g. {_EXAMPLES[quantity]}"
        for k, quantity, _, unit in _known_headings(cells, units)
        if quantity in _EXAMPLES and quantity not in known
    ]


def _places_and_units(cells: list[str], units: list[str]) -> dict[str, tuple[int, str]]:
    found: dict[str, tuple[int, int, str]] = {}
    for k, quantity, rank, unit in _known_headings(cells, units):
        if unit in RAW_TORQUE_UNITS[quantity] and rank < found.get(quantity, (len(HEADINGS),))[0]:
            found[quantity] = (rank, k, unit)
    return {quantity: (k, unit) for quantity, (_, k, unit) in found.items()}


def _known_headings(cells: list[str], units: list[str]) -> Iterator[tuple[int, str, int, str]]:
    """Yield column index, quantity, rank in `HEADINGS` and unit of each known heading."""
    for k, cell in enumerate(cells):
        name = cell.strip().strip('"')
        plain = name.lower().replace("_", " ")
        rank = next((j for j, (word, _) in enumerate(HEADINGS) if plain.startswith(word)), None)
        if rank is None:
            continue
        word, quantity = HEADINGS[rank]
        # Remove the sign or word before the unit, as in "Strain / %", "Strain, %" or "Strain in %".
        rest = re.sub(r"^[\s_]*(?:[/,]|in\b)?[\s_\[(]*|[\s\])]+$", "", name[len(word) :])
        yield k, quantity, rank, _plain_unit(rest or (units[k] if k < len(units) else ""))


def _plain_unit(unit: str) -> str:
    return unit.replace("µ", "u").replace("μ", "u").replace("·", ".").replace("⋅", ".").strip('[]() "')


def share(omega: np.ndarray, G: np.ndarray, raw: dict[str, np.ndarray], geometry: float | None) -> SampleShare | None:
    """Return the inertia of the instrument and its contribution to the modulus, which the software has subtracted.
    Returns None if the columns do not determine the inertia, or if its contribution is below the modulus at the highest
    frequency that has a value in all raw columns.

    Args:
        omega: (n,) [rad/s].
        G: complex modulus (n,) [Pa] after the instrument's correction of the inertia.
        raw: columns (n,) in SI units: torque and angle; phase and sample_torque if the file has them.
        geometry: K [m^3], the torque per Pa and rad. It is needed if there is no sample_torque.
    """
    kept = with_raw_columns(raw)
    if not {"torque", "angle"} <= set(raw) or not kept.any():
        return None
    w, g, own = omega[kept], G[kept], {q: v[kept] for q, v in raw.items()}
    stiffness = np.abs(own["torque"] / own["angle"])
    K = geometry
    if "sample_torque" in own:
        K = float(np.median(np.abs(own["sample_torque"] / own["angle"]) / np.abs(g)))
    if K is None or not K > 0:
        return None
    if "phase" in own:
        inertias = (K * g.real - stiffness * np.cos(own["phase"])) / w**2
    else:  # the equation for the inertia has two roots; this root is the right one above the resonance
        inertias = (K * g.real + np.sqrt(np.maximum(stiffness**2 - (K * g.imag) ** 2, 0))) / w**2
    inertia = _agreed(w, inertias)
    if not inertia * w[-1] ** 2 > K * np.abs(g[-1]):
        return None
    return SampleShare(inertia, inertia * omega**2 / K)


#: Raw columns of the instrument.
COLUMNS = ("torque", "angle", "phase", "sample_torque")


def with_raw_columns(raw: dict[str, np.ndarray]) -> np.ndarray:
    """Return for each point (n,) whether all raw columns of the instrument have a value. A torque or an angle of 0 is
    no value: some exports write 0 if nothing was measured."""
    return np.all([np.isfinite(raw[q]) & ((raw[q] != 0) | (q == "phase")) for q in COLUMNS if q in raw], axis=0)


def share_by_phase(omega: np.ndarray, G: np.ndarray, raw: dict[str, np.ndarray]) -> SampleShare | None:
    """Return the contribution of the instrument's inertia to the modulus, from the raw phase alone, without torque and
    sample size: I omega^2 / K = G' - G'' / tan(phase).

    Returns None if there is no phase, or if the phases at the highest frequencies give different inertias. Also returns
    None if the contribution of the inertia is below the modulus even at the highest frequency that has a phase.
    """
    kept = np.isfinite(raw.get("phase", np.full(len(omega), np.nan)))
    if not kept.any():
        return None
    with np.errstate(divide="ignore", invalid="ignore"):
        per_square = _agreed(omega[kept], (G.real - G.imag / np.tan(raw["phase"]))[kept] / omega[kept] ** 2)
    if not per_square * omega[kept][-1] ** 2 > np.abs(G[kept][-1]):
        return None
    return SampleShare(np.nan, per_square * omega**2)


#: _FEWEST_LED: minimum number of different frequencies whose inertias are compared. _WIDTH_LED: minimum ratio of the
#: highest to the lowest of these frequencies, if the sweep is wide enough. If the raw columns contain no inertia and no
#: phase, the root that `share` uses is 2 K G' / omega^2. If the frequencies differed by less, this root would seem to
#: be a constant inertia.
_FEWEST_LED, _WIDTH_LED = 3, 1.1


def _agreed(omega: np.ndarray, values: np.ndarray) -> float:
    """Return the median inertia at the highest frequencies, or NaN if the inertias at these frequencies differ by a
    tenth or more, or if there are too few different frequencies. Points with the same frequency are averaged first.

    At these frequencies the contribution of the inertia is largest, so the inertia is known best. At other frequencies
    the inertia is a small difference of large numbers.
    """
    different, place = np.unique(omega, return_inverse=True)
    if len(different) < _FEWEST_LED:
        return np.nan
    means = np.bincount(place, values) / np.bincount(place)
    below = int(np.sum(different <= different[-1] / _WIDTH_LED))  # the last of these frequencies is compared, too
    led = means[max(0, min(len(means) - max(_FEWEST_LED, len(means) // 6), below - 1)) :]
    value, apart = float(np.median(led)), np.ptp(led)
    return value if value > 0 and apart < 0.1 * value else np.nan
