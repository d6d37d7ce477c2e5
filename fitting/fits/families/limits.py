"""Limits of a model, and those of the Prony modes that represent it over the band.

Springpots relax over many decades. Prony modes follow them within the band of the data only, so the limits of the modes
at frequency 0 and infinity differ from those of the model.
"""

import numpy as np

from fitting.methods.estimate import Estimate
from fitting.methods.generalised_maxwell import Maxwell
from fitting.methods.uncertainty import NO_REST, equilibrium_error

#: Differences above this many standard errors get a sentence.
TOLD = 2.0
NAMES = {"shear_modulus": "instantaneous modulus", "equilibrium_modulus": "equilibrium modulus"}


def of_the_model(own: Estimate | None) -> dict[str, float]:
    """Moduli [Pa] of a model at infinite frequency and at 0, by the names of fit.json; infinite ones are left out."""
    if own is None:
        return {}
    values = {name: float(value) for name, value in zip(own.names, own.values, strict=True)}
    rest = values.get("equilibrium_modulus")
    found = {} if rest is None else {"equilibrium_modulus": rest}
    strengths = [value for name, value in values.items() if name == "relaxing_modulus" or name.startswith("strengths[")]
    return found | ({"shear_modulus": sum(strengths) + (rest or 0.0)} if strengths else {})


def of_the_modes(model: Maxwell) -> dict[str, float]:
    """The same moduli [Pa] of Prony modes."""
    return {"shear_modulus": float(model.shear_modulus), "equilibrium_modulus": equilibrium_of(model)}


def equilibrium_of(model: Maxwell) -> float:
    """G0 (1 - sum g) [Pa]; 0 for a fluid, whose ratios add up to 1 but for roundoff."""
    rest = 1 - float(np.sum(np.asarray(model.ratios)))
    return float(model.shear_modulus) * rest if rest > NO_REST else 0.0


def limit_errors(modes: Estimate, model: Maxwell, own: Estimate | None) -> dict[str, float]:
    """Standard errors [Pa] of the limits of Prony modes, with the difference from the model's own limits."""
    found = {"shear_modulus": float(modes.standard_errors[0]), "equilibrium_modulus": equilibrium_error(modes)}
    here = of_the_modes(model)
    return found | {name: float(np.hypot(found[name], there - here[name])) for name, there in of_the_model(own).items()}


def limit_sentences(name: str, modes: Estimate, model: Maxwell, own: Estimate | None) -> list[str]:
    """A sentence for every limit in which the modes differ from the model by more than the errors of the fit."""
    here, alone = of_the_modes(model), limit_errors(modes, model, None)
    out = []
    for limit, there in of_the_model(own).items():
        if abs(here[limit] - there) > TOLD * alone[limit]:
            out.append(
                f"the {NAMES[limit]} of the {len(model.ratios)} Prony modes is {here[limit]:.4g} Pa, that of the model "
                f"{name} {there:.4g} Pa: the modes follow the model over the measured band only"
            )
    return out
