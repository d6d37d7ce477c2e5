"""Moduli at zero and infinite frequency: of a model, and of the Prony modes that represent this model over the band.

Springpots relax over many decades. Prony modes follow them only within the band of the data. At frequency 0 and at
infinite frequency, the moduli of the modes therefore differ from the moduli of the model.
"""

import numpy as np

from fitting.methods.estimate import Estimate
from fitting.methods.generalised_maxwell import Maxwell
from fitting.methods.uncertainty import NO_REST, equilibrium_error

#: A difference above this many standard errors is reported in a sentence.
TOLD = 2.0
#: Limit for the fall of G' in the lowest half decade of the band, divided by its fall in the next half decade. Above
#: this limit, much may still relax after the test. One relaxation time well inside the band gives 0.1. A modulus that
#: falls by the same amount in each half decade gives 1.
SLOWING = 0.5
NAMES = {"shear_modulus": "instantaneous modulus", "equilibrium_modulus": "equilibrium modulus"}


def of_the_model(own: Estimate | None) -> dict[str, float]:
    """Moduli [Pa] of a model at infinite frequency and at 0, by their names in fit.json. Infinite moduli are left
    out."""
    if own is None:
        return {}
    values = {name: float(value) for name, value in zip(own.names, own.values, strict=True)}
    rest = values.get("equilibrium_modulus")
    found = {} if rest is None else {"equilibrium_modulus": rest}
    strengths = [value for name, value in values.items() if name == "relaxing_modulus" or name.startswith("strengths[")]
    return found | ({"shear_modulus": sum(strengths) + (rest or 0.0)} if strengths else {})


def of_the_modes(model: Maxwell) -> dict[str, float]:
    """Moduli [Pa] of Prony modes at infinite frequency and at 0, by the same names."""
    return {"shear_modulus": float(model.shear_modulus), "equilibrium_modulus": equilibrium_of(model)}


def equilibrium_of(model: Maxwell) -> float:
    """G0 (1 - sum g) [Pa]. A fluid has 0: its ratios g add up to 1 except for roundoff."""
    rest = 1 - float(np.sum(np.asarray(model.ratios)))
    return float(model.shear_modulus) * rest if rest > NO_REST else 0.0


def limit_errors(modes: Estimate, model: Maxwell, own: Estimate | None) -> dict[str, float]:
    """Standard errors [Pa] of the limits of Prony modes. They contain the difference from the limits of the model."""
    found = {"shear_modulus": float(modes.standard_errors[0]), "equilibrium_modulus": equilibrium_error(modes)}
    here = of_the_modes(model)
    return found | {name: float(np.hypot(found[name], there - here[name])) for name, there in of_the_model(own).items()}


def limit_sentences(name: str, modes: Estimate, model: Maxwell, own: Estimate | None) -> list[str]:
    """One sentence for every limit at which modes and model differ by more than `TOLD` standard errors of the fit."""
    here, alone = of_the_modes(model), limit_errors(modes, model, None)
    out = []
    for limit, there in of_the_model(own).items():
        if abs(here[limit] - there) > TOLD * alone[limit]:
            out.append(
                f"the {NAMES[limit]} of the {len(model.ratios)} Prony modes is {here[limit]:.4g} Pa, but the model "
                f"{name} has {there:.4g} Pa: the modes follow the model over the measured band only"
            )
    return out


def still_relaxing(storage: np.ndarray, noise: float, longest: float) -> list[str]:
    """A sentence if G' still falls at the lowest frequencies. Then more may relax after the test.

    Args:
        storage: G' (3,) of the model [Pa] at the lowest frequency, half a decade above it and one decade above it.
        noise: relative noise of the data.
        longest: longest relaxation time [s] of the model.
    """
    fall, next_fall = np.diff(storage)
    if fall <= max(TOLD * noise * storage[0], SLOWING * next_fall):
        return []
    return [
        f"G' falls by {100 * fall / storage[1]:.2g} % in the lowest half decade and by "
        f"{100 * next_fall / storage[2]:.2g} % in the next: the equilibrium modulus is the modulus after "
        f"{longest:.3g} s, the longest time of the model; nothing tells how much of it relaxes later, and its error "
        "does not contain this: measure at lower frequencies"
    ]
