"""Columns of a frequency sweep: what a heading names, and in which unit."""

import re
from typing import NamedTuple

from fitting.readers.units import FREQUENCY_UNITS, MODULUS_UNITS

DEVIATION_WORDS = {"sd", "std", "stdev", "stddev", "se", "sem", "error", "err", "uncertainty", "deviation"}
#: First words of the columns; those with an E are of tension or bending.
STORAGE, LOSS = ("storage", "g'", "gp", "e'", "ep"), ("loss", "g''", "gpp", "e''", "epp")
NEEDED = {
    "frequency": "frequency_Hz or angular_frequency_rad_s",
    "storage": "storage_modulus_Pa",
    "loss": "loss_modulus_Pa",
}


class Column(NamedTuple):
    """A column that is one of a sweep's."""

    place: int  # in the line, from 0
    name: str
    quantity: str  # frequency, storage, loss, storage_sd, loss_sd
    unit: str | None


def known_unit(quantity: str, unit: str | None) -> bool:
    """Whether the unit can be converted; a column without one takes the default."""
    return unit is None or (unit.lower() in FREQUENCY_UNITS if quantity == "frequency" else unit in MODULUS_UNITS)


def _quantity(cell: str) -> tuple[str, str | None] | None:
    """(quantity, unit) that a header cell names, or None."""
    name, unit = cell, None
    for prime, plain in (("′", "'"), ("’", "'"), ("″", "''"), ("”", "''"), ('"', "''")):
        name = name.replace(prime, plain)
    bracket = re.search(r"[\[(]\s*([^\])]*?)\s*[\])]\s*$", name)
    if bracket:
        name, unit = name[: bracket.start()], bracket.group(1)
    words = [w for w in re.split(r"[\s_.]+", name.strip()) if w]
    lower = [w.lower() for w in words]
    spread = any(w in DEVIATION_WORDS for w in lower)
    kept = [(w, l) for w, l in zip(words, lower, strict=True) if l not in DEVIATION_WORDS | {"standard", "mean"}]
    words, lower = [w for w, _ in kept], [l for _, l in kept]
    if not lower:
        return None
    if lower[:2] in (["e", "stor"], ["e", "storage"], ["e", "loss"]):  # DMA: "E_stor", "E_loss (MPa)"
        lower, words = [f"e'{'' if lower[1].startswith('stor') else chr(39)}", *lower[2:]], words[1:]
    if lower[0] in STORAGE + LOSS:
        quantity = "storage" if lower[0] in STORAGE else "loss"
        stem = 2 if lower[1:2] in (["modulus"], ["mod"]) else 1
        certain = stem == 2 or lower[0].startswith(("g", "e"))
    elif lower[0] in ("angular", "ang", "omega", "ω"):
        quantity, certain = "frequency", True
        stem = 2 if lower[1:2] in (["frequency"], ["freq"]) else 1
    elif lower[0] in ("frequency", "freq", "f"):
        quantity, certain, stem = "frequency", lower[0] != "f", 1
    else:
        return None
    rest = "_".join(words[stem:])
    if unit is not None and rest:
        return None  # "Storage compliance (1/Pa)", "Frequency point (1)"
    unit = unit if unit is not None else (rest or None)
    if not certain and not known_unit(quantity, unit):
        return None
    return quantity + ("_sd" if spread and quantity != "frequency" else ""), unit


def is_angular(column: Column) -> bool:
    """Whether the heading names an angular frequency."""
    return column.name.lower().startswith(("ang", "omega", "ω"))


def header_columns(cells: list[str]) -> list[Column]:
    """Columns by quantity. The first column with a known unit comes first, rad/s before Hz; the others follow, for
    comparison."""
    found = [(k, cell, _quantity(cell)) for k, cell in enumerate(cells)]
    columns = [Column(k, cell.strip(), *q) for k, cell, q in found if q is not None]
    shear = {c.quantity for c in columns if not is_tensile(c)}
    columns = [c for c in columns if c.quantity not in shear or not is_tensile(c)]  # G before E where a file has both
    columns.sort(key=lambda c: (not known_unit(c.quantity.removesuffix("_sd"), c.unit), not is_angular(c), c.place))
    return columns


def is_tensile(column: Column) -> bool:
    """Whether the heading names a modulus of tension or bending, E."""
    return bool(re.match(r"\s*e['′’_ ]|\s*epp?\b|\s*[(]?e\b|\s*tensile", column.name.lower().replace('"', "'")))


#: Units of temperature: factor and offset to kelvin.
_TEMPERATURE = {"c": (1.0, 273.15), "k": (1.0, 0.0), "f": (5 / 9, 459.67 * 5 / 9)}


def condition_columns(cells: list[str], units: list[str]) -> dict[str, tuple[int, float, float]]:
    """Place, factor and offset to SI of `temperature` [K] and `shift_factor`, of the headings that name them.

    Args:
        cells: headings.
        units: of a line of their own, or nothing.
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
