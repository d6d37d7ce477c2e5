"""Compute storage and loss moduli from the columns of a file: storage or loss modulus, |G*|, phase, tan(delta)."""

import numpy as np

from fitting.readers.tables.sweep_columns import (
    MODULI,
    Column,
    is_angular,
    is_bent,
    is_tensile,
    names_shear,
    pair_of,
)
from fitting.readers.tables.sweep_headings import UNITS, known_unit
from fitting.readers.units import FREQUENCY_UNITS, MODULUS_UNITS, PER_SECOND
from liverjax.core.errors import InputError

#: Units that a column may have, for error messages.
OFFERED = {"frequency": "Hz or rad_s", "phase": "deg or rad", "tangent": "1, or none"}
NAMES = {"storage": "G'", "loss": "G''", "complex": "|G*|", "phase": "the phase", "tangent": "tan(delta)"}


def column_in_si(path: str, column: Column, written: np.ndarray, notes: list[str]) -> np.ndarray:
    """Return a column (n,), converted to rad/s, Pa, rad or 1. Tensile moduli are not divided by 3 here.

    Raises:
        InputError: the unit is unknown or ambiguous.
    """
    quantity, unit = column.quantity.removesuffix("_sd"), column.unit
    if quantity == "tangent":
        unit = unit or "1"
    if unit is None:
        default = {"frequency": "rad/s" if is_angular(column) else "Hz", "viscosity": "Pa s"}
        unit = default.get(quantity, "Pa")
        if quantity == "phase":
            if np.nanmax(written) <= 0.5 * np.pi:
                raise InputError(
                    f"{path}: column {column.name} may be in degrees or radians; name this column "
                    f"{column.quantity}_deg or {column.quantity}_rad"
                )
            unit = "deg"
        notes.append(f"column {column.name!r} states no unit; {unit} is assumed")
    if not known_unit(quantity, unit):
        known = OFFERED.get(quantity, "Pa, kPa or MPa")
        raise InputError(f"{path}: unit {unit!r} of column {column.name} is not known; use {known}")
    seen = written[np.isfinite(written)]
    if column.quantity == "phase" and unit.startswith(("deg", "°")) and seen.size and seen.max() <= 0.5 * np.pi:
        notes.append(
            f"column {column.name!r} has {seen.min():.3g} to {seen.max():.3g} degrees, which is less than in tissues: "
            "if the numbers are radians, name the column phase_rad"
        )
    if quantity == "frequency":
        return written * _of_frequency(path, column, unit)
    return written * UNITS.get(quantity, MODULUS_UNITS)[unit]


def _of_frequency(path: str, column: Column, unit: str) -> float:
    if is_angular(column) and unit.lower() == "hz":
        raise InputError(
            f"{path}: column {column.name} is an angular frequency in Hz; name this column frequency_Hz or "
            "angular_frequency_rad_s"
        )
    if not is_angular(column) and unit.lower() in PER_SECOND:
        raise InputError(
            f"{path}: column {column.name} in {unit} may be in Hz or rad/s; name this column frequency_Hz or "
            "angular_frequency_rad_s"
        )
    return FREQUENCY_UNITS[unit.lower()]


def fault_of(column: Column, written: float, value: float, smallest: float, largest: float) -> tuple[str, str] | None:
    """Return what is wrong with a value (in SI) and how to correct it, or None if the value is good. The first text
    quotes the value as written in the file."""
    if not np.isfinite(value):
        if np.isnan(written):
            return f"{column.name} is empty", "fill this cell, or remove the line"
        problem, remedy = "is not finite", "remove the line"
    elif value <= 0:
        problem, remedy = "is not positive", "correct the sign or remove the line"
    elif column.quantity == "phase" and value >= 0.5 * np.pi:
        problem, remedy = "is not a phase below 90 degrees", "check the unit, or remove the line"
    elif not smallest < value < largest:
        problem, remedy = "is beyond any measurement", "check the unit"
    else:
        return None
    return f"{column.name} = {written:g} {problem}", remedy


def load_of(columns: dict[str, tuple[Column, np.ndarray]]) -> str:
    """Return how the sample was loaded, from the headings of the moduli: shear, tension or bending."""
    moduli = [column for q, (column, _) in columns.items() if q.split("_")[0] in MODULI]
    if any(map(is_bent, moduli)):
        return "bending"
    return "tension" if any(map(is_tensile, moduli)) else "shear"


def to_shear(columns: dict[str, tuple[Column, np.ndarray]]) -> list[str]:
    """Divide moduli of tension or bending by 3, in place. Return a note if there are such moduli."""
    moduli = [q for q in columns if q.split("_")[0] in MODULI]
    tensile = [q for q in moduli if is_tensile(columns[q][0])]
    if tensile:  # if only one heading names tension, both columns are of tension
        sheared = [columns[q][0].name for q in moduli if q not in tensile and names_shear(columns[q][0])]
        if sheared:
            raise InputError(
                f"column {columns[tensile[0]][0].name} is of tension or bending, but {sheared[0]} of shear: name both "
                "in the same way"
            )
        tensile = moduli
    for q in tensile:
        columns[q] = columns[q][0], columns[q][1] / 3
    if not tensile:
        return []
    names = " and ".join(dict.fromkeys(columns[q][0].name for q in tensile))
    return [f"{names} are of tension or bending, so G = E / 3 is used (incompressible material)"]


def storage_and_loss(values: dict[str, np.ndarray], notes: list[str]) -> dict[str, np.ndarray]:
    """Return storage and loss moduli (n,) [Pa] from columns in SI units, and their standard deviations if given.

    Standard deviations of |G*|, phase or tan(delta) are converted by first-order propagation of independent errors.
    """
    pair = pair_of(values)
    assert pair is not None
    if pair == ("storage", "loss"):
        return {q: v for q, v in values.items() if q.removesuffix("_sd") in pair}
    size, angle = (values[q] for q in pair)
    delta = np.arctan(angle) if pair[1] == "tangent" else angle
    s, c = np.sin(delta), np.cos(delta)
    notes.append(f"G' and G'' are computed from {NAMES[pair[0]]} and {NAMES[pair[1]]}")
    # Each modulus is the measured modulus times a function of the angle. The entries are this function and its
    # derivative, first for G', then for G''.
    by_angle = {
        "complex": ((c, -s), (s, c)),
        "storage": ((1 + 0 * c, 0 * c), (s / c, 1 / c**2)),
        "loss": ((c / s, -1 / s**2), (1 + 0 * c, 0 * c)),
    }[pair[0]]
    out = {name: size * factor for name, (factor, _) in zip(("storage", "loss"), by_angle, strict=True)}
    if all(f"{q}_sd" in values for q in pair):
        of_size, of_angle = (values[f"{q}_sd"] for q in pair)
        of_angle = of_angle * c**2 if pair[1] == "tangent" else of_angle
        for name, (factor, slope) in zip(("storage", "loss"), by_angle, strict=True):
            out[f"{name}_sd"] = np.hypot(factor * of_size, size * slope * of_angle)
    elif any(f"{q}_sd" in values for q in pair):
        notes.append("only one of these two columns has standard deviations, so the deviations are not used")
    return out
