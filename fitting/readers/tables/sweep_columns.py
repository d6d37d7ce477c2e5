"""Columns of a frequency sweep: which headings of a file are used, and in which order."""

import re
from collections.abc import Collection
from typing import NamedTuple

from fitting.readers.tables.sweep_headings import known_unit, quantity_of

#: The pairs of columns that give storage and loss moduli, with the best pair first.
PAIRS = (
    ("storage", "loss"),
    ("complex", "phase"),
    ("complex", "tangent"),
    ("storage", "tangent"),
    ("storage", "phase"),
    ("loss", "tangent"),
    ("loss", "phase"),
)
NEEDED = {
    "frequency": "frequency_Hz or angular_frequency_rad_s",
    "storage": "storage_modulus_Pa",
    "loss": "loss_modulus_Pa (or phase_angle_deg or tan_delta with the other modulus)",
}


class Column(NamedTuple):
    """A column of a file that belongs to a sweep."""

    place: int  # index in the line, from 0
    name: str
    quantity: str  # frequency, storage, loss, complex, phase, tangent, viscosity; some also with "_sd"
    unit: str | None


def pair_of(quantities: Collection[str]) -> tuple[str, str] | None:
    """Return the best pair of quantities that determines both moduli, or None if there is no such pair."""
    return next((pair for pair in PAIRS if set(pair) <= set(quantities)), None)


#: Quantities in pascals.
MODULI = ("storage", "loss", "complex")


def is_complete(columns: list[Column]) -> bool:
    """Return whether the columns are enough for a sweep."""
    quantities = {c.quantity for c in columns}
    return "frequency" in quantities and pair_of(quantities) is not None


def first_missing(columns: list[Column]) -> str:
    """Return the first quantity of `NEEDED` that is missing."""
    quantities = {c.quantity for c in columns}
    if "frequency" not in quantities:
        return "frequency"
    return "loss" if quantities & {"storage", "complex"} else "storage"


def is_angular(column: Column) -> bool:
    """Return whether the heading names an angular frequency."""
    return bool(
        re.match(r"\s*(ang|omega|ω|kreisf|winkelf|circular|radian|pulsa|frecuencia ang|w\b)", column.name.lower())
    )


def header_columns(cells: list[str]) -> list[Column]:
    """Return the columns of a sweep. Known units come first, and angular frequencies come before frequencies.

    The first column of a quantity is used. Further columns of the same quantity are compared with the first. If the
    columns are enough for a sweep, columns that the sweep does not need are ignored.
    """
    found = [(k, cell, quantity_of(cell)) for k, cell in enumerate(cells)]
    columns = [Column(k, cell.strip(), *q) for k, cell, q in found if q is not None]
    shear = {c.quantity for c in columns if not is_tensile(c)}
    if "frequency" in shear and pair_of(shear):  # if a file has both G and E, G is read
        columns = [c for c in columns if not is_tensile(c)]
    pair = pair_of({c.quantity for c in columns})
    if pair:
        columns = [c for c in columns if c.quantity.removesuffix("_sd") in ("frequency", *pair)]
    columns.sort(key=lambda c: (not known_unit(c.quantity.removesuffix("_sd"), c.unit), not is_angular(c), c.place))
    return columns


def columns_beside(cells: list[str], units: list[str], used: list[Column]) -> list[Column]:
    """Return columns of |G*|, phase, tan(delta) and |eta*| that the sweep does not need: for each quantity, the first
    column with a known unit.

    Args:
        cells: headings.
        units: units from a separate line of the file; may be empty.
        used: the columns that are read.
    """
    needed = {c.quantity for c in used}
    found: dict[str, Column] = {}
    for k, cell in enumerate(cells):
        quantity, unit = quantity_of(cell) or ("", None)
        if quantity not in ("complex", "phase", "tangent", "viscosity") or quantity in needed or quantity in found:
            continue
        if quantity == "tangent":
            unit = unit or "1"
        own = Column(k, cell.strip(), quantity, unit or (units[k].strip('"[]() ') if k < len(units) else None))
        if known_unit(quantity, own.unit) and not is_tensile(own):
            found[quantity] = own
    return list(found.values())


def is_tensile(column: Column) -> bool:
    """Return whether the heading names a modulus of tension or bending, E."""
    name = re.sub('[′’`´″”"]', "'", column.name.lower())
    words = r"\b(tensile|young|flexural|bending|compressive|zug|biege)|(?:^|[\s(\[|_])e('|\*)"
    return bool(re.match(r"\s*e[_ ]|\s*epp?\b|\s*[(|]?e\b", name) or re.search(words, name))


def is_bent(column: Column) -> bool:
    """Return whether the heading names a modulus of bending."""
    return re.search(r"\b(flexural|bending|biege)", column.name.lower()) is not None


def names_shear(column: Column) -> bool:
    """Return whether the heading names a modulus of shear, G."""
    return re.search(r"shear|(^|[^a-z])g([^a-z]|$)", column.name.lower()) is not None


#: Units of temperature: factor and offset to kelvin.
_TEMPERATURE = {"c": (1.0, 273.15), "k": (1.0, 0.0), "f": (5 / 9, 459.67 * 5 / 9)}


def condition_columns(cells: list[str], units: list[str]) -> dict[str, tuple[int, float, float]]:
    """Return column index, factor and offset to SI of `temperature` [K] and `shift_factor`, if the headings name them.

    Args:
        cells: headings.
        units: units from a separate line of the file; may be empty.
    """
    found: dict[str, tuple[int, float, float]] = {}
    for k, cell in enumerate(cells):
        name = cell.strip().strip('"').lower()
        heat = re.match(r"(?:temperature|temp|t)\b[\s._]*(.*)|(?:temperature|temp|t)_(.*)", name)
        if heat and "temperature" not in found:
            rest = next((part for part in heat.groups() if part), "") or (units[k] if k < len(units) else "")
            plain = re.sub(r"deg(rees?)?|[^a-z]", "", rest.lower())
            unit = _TEMPERATURE.get(plain[:1] if plain in ("celsius", "kelvin", "fahrenheit") else plain)
            if unit:
                found["temperature"] = (k, *unit)
        if re.fullmatch(r"(shift[\s_]*factor|a[\s_]?t)s?[\s_]*([(\[]?1?[)\]]?)", name) and "shift_factor" not in found:
            found["shift_factor"] = (k, 1.0, 0.0)
    return found
