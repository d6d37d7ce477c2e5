"""Find the quantity and the unit of a column heading in a frequency sweep. The words are those of common
instruments."""

import re

from fitting.readers.units import ANGLE_UNITS, FREQUENCY_UNITS, MODULUS_UNITS, TANGENT_UNITS, VISCOSITY_UNITS

DEVIATION_WORDS = {"sd", "std", "stdev", "stddev", "se", "sem", "error", "err", "uncertainty", "deviation"}
#: Words in a heading that do not change its quantity, for example "mean", or a symbol after the name.
IDLE_WORDS = {"standard", "mean", "value", "g'", "g''", "g*", "e'", "e''", "e*", "delta", "omega", "f", "w"}
#: Quantities, and the words with which their headings begin. Words in `UNCERTAIN` count only with a known unit or
#: without a unit.
WORDS = {
    "frequency": (
        *("angular frequency", "ang frequency", "angular freq", "ang freq", "angular velocity", "angular", "omega"),
        *("circular frequency", "radian frequency", "frequency", "freq", "f", "w"),
        *("kreisfrequenz", "winkelfrequenz", "frequenz", "pulsation", "fréquence"),
        *("frecuencia angular", "frecuencia", "pulsazione", "frequenza"),
    ),
    "storage": (
        *("g'", "gp", "gprime", "g prime", "e'", "ep", "e stor", "e storage", "storage modulus", "storage mod"),
        *("stor modulus", "elastic modulus", "modulus elastic component", "speichermodul", "storage"),
        *("module de conservation", "module élastique", "módulo de almacenamiento", "modulo conservativo"),
    ),
    "loss": (
        *("g''", "gpp", "g double prime", "gdoubleprime", "e''", "epp", "e loss", "loss modulus", "loss mod"),
        *("viscous modulus", "modulus viscous component", "verlustmodul", "loss", "module de perte", "module visqueux"),
        *("módulo de pérdida", "módulo de pérdidas", "modulo dissipativo"),
    ),
    "complex": (
        *("g*", "e*", "complex modulus", "complex shear modulus", "modulus complex component"),
        *("komplexer modul", "komplexer schubmodul", "module complexe"),
    ),
    "phase": (
        *("phase angle", "phase shift angle", "phase shift", "phase lag", "phase", "loss angle", "delta"),
        *("phasenwinkel", "phasenverschiebung", "phasenverschiebungswinkel", "angle de perte"),
    ),
    "tangent": (
        *("tan delta", "tandelta", "tan d", "tand", "loss factor", "loss tangent", "damping factor"),
        *("verlustfaktor", "facteur de perte"),
    ),
    "viscosity": ("complex viscosity", "eta*", "komplexe viskosität", "viscosité complexe"),
}
#: Words that may stand before the name of a modulus.
KINDS = ("shear", "dynamic", "tensile", "flexural", "bending", "compressive", "young's", "youngs", "young")
UNCERTAIN = {"storage", "loss", "f", "w", "phase", "delta", "angular"}
_LONGEST_FIRST = sorted(
    ((words.split(), quantity) for quantity, names in WORDS.items() for words in names),
    key=lambda row: -len(row[0]),
)
#: Typographic characters, and the plain characters that replace them.
_PLAIN = {"′": "'", "’": "'", "`": "'", "´": "'", "″": "''", "”": "''", '"': "''", "δ": "delta", "ω": "omega"}
_PLAIN["η"] = "eta"


#: Units of quantities that are neither a modulus nor a frequency.
UNITS: dict[str, dict[str, float]] = {
    "phase": ANGLE_UNITS,
    "tangent": TANGENT_UNITS,
    "viscosity": VISCOSITY_UNITS,
}


def known_unit(quantity: str, unit: str | None) -> bool:
    """Return whether the unit can be converted. A column without a unit gets the default unit."""
    if unit is None:
        return True
    if quantity == "frequency":
        return unit.lower() in FREQUENCY_UNITS
    return unit in UNITS.get(quantity, MODULUS_UNITS)


def quantity_of(cell: str) -> tuple[str, str | None] | None:
    """Return quantity and unit of a heading, or None if the heading is not known. Quantities of standard deviations end
    in "_sd"."""
    name = cell
    for sign, plain in _PLAIN.items():
        name = name.replace(sign, plain)
    name = re.sub(r"\btan[\s_]*[(\[]\s*(delta|d)\s*[)\]]", "tan delta", name, flags=re.IGNORECASE)
    name, unit = _name_and_unit(re.sub(r"\|\s*(g|eta|e)\s*\*?\s*\|", r"\1*", name, flags=re.IGNORECASE))
    words = [w for w in re.split(r"[\s_.,:()\[\]]+", name) if w]
    spread = any(w.lower() in DEVIATION_WORDS for w in words)
    words = [w for w in words if w.lower() not in DEVIATION_WORDS | {"standard", "mean"}]
    while len(words) > 1 and words[0].lower() in KINDS:
        words = words[1:]
    lower = [w.lower() for w in words]
    found = next(((first, q) for first, q in _LONGEST_FIRST if lower[: len(first)] == first), None)
    if found is None:
        return None
    first, quantity = found
    rest = "_".join(w for w in words[len(first) :] if w.lower() not in IDLE_WORDS)
    if unit is not None and rest:
        return None  # another quantity, for example "Storage compliance (1/Pa)" or "Frequency point (1)"
    unit = unit if unit is not None else (rest or None)
    if " ".join(first) in UNCERTAIN and not known_unit(quantity, unit):
        return None
    return quantity + ("_sd" if spread and quantity != "frequency" else ""), unit


def _name_and_unit(name: str) -> tuple[str, str | None]:
    """Split a heading such as "G' [Pa]", "G' in Pa", "G' / Pa" or "G', Pa" into name and unit."""
    bracket = re.search(r"[\[(]\s*([^\])]*?)\s*[\])]\s*$", name)
    if bracket and not re.fullmatch(r"[ge]'*\*?|delta|omega|f|w", bracket.group(1), re.IGNORECASE):
        return name[: bracket.start()], bracket.group(1)
    if said := re.fullmatch(r"(.+?)\s+in\s+(\S+(?: s-1)?)\s*", name):
        return said.group(1), said.group(2)
    for split in re.finditer(r"\s*[/,]\s*", name):
        rest = name[split.end() :].strip()
        if any(known_unit(quantity, rest) for quantity in ("frequency", "storage", "phase")) and rest:
            return name[: split.start()], rest
    return name, None
