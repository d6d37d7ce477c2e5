"""Moduli at frequency 0 and at infinite frequency: of a model, and of the Prony modes that represent this model.

Springpots relax over many decades. Prony modes represent them only within the band of the data. At frequency 0 and at
infinite frequency, the moduli of the modes therefore differ from the moduli of the model.
"""

import numpy as np

from fitting.methods.estimate import Estimate
from fitting.methods.generalised_maxwell import Maxwell
from fitting.methods.uncertainty import NO_REST, equilibrium_error

#: The program warns if the difference between two moduli exceeds this many standard errors.
TOLD = 2.0
#: Limit for the ratio of two decreases of G': in the lowest half decade of the band / in the next half decade. Above
#: this limit, the material may relax much more at lower frequencies. A material with one relaxation time well inside
#: the band gives 0.1. A modulus that falls by the same amount in each half decade gives 1.
SLOWING = 0.5
NAMES = {"shear_modulus": "instantaneous modulus", "equilibrium_modulus": "equilibrium modulus"}


def of_the_model(own: Estimate | None) -> dict[str, float]:
    """Return the moduli [Pa] of a model at infinite frequency and at frequency 0. The keys are the names of these
    moduli in fit.json. Infinite moduli, and the equilibrium modulus of a fluid, are not included. `own`: parameters of
    the model. For Prony modes, `own` is None and the result is empty."""
    if own is None:
        return {}
    values = {name: float(value) for name, value in zip(own.names, own.values, strict=True)}
    rest = values.get("equilibrium_modulus")
    found = {} if rest is None else {"equilibrium_modulus": rest}
    strengths = [value for name, value in values.items() if name == "relaxing_modulus" or name.startswith("strengths[")]
    return found | ({"shear_modulus": sum(strengths) + (rest or 0.0)} if strengths else {})


def of_the_modes(model: Maxwell) -> dict[str, float]:
    """Return the moduli [Pa] of Prony modes at infinite frequency and at frequency 0, with the same keys as
    `of_the_model`."""
    return {"shear_modulus": float(model.shear_modulus), "equilibrium_modulus": equilibrium_of(model)}


def equilibrium_of(model: Maxwell) -> float:
    """Return the equilibrium modulus G0 (1 - sum g) [Pa] for the ratios g. For a fluid, the sum of g is 1 (except for
    roundoff), and the result is 0."""
    rest = 1 - float(np.sum(np.asarray(model.ratios)))
    return float(model.shear_modulus) * rest if rest > NO_REST else 0.0


def limit_errors(modes: Estimate, model: Maxwell, own: Estimate | None) -> dict[str, float]:
    """Return the standard errors [Pa] of the moduli of Prony modes at infinite frequency and at frequency 0. The
    difference between the moduli of the modes and the moduli of the model is added to each error (root of the sum of
    squares)."""
    found = {"shear_modulus": float(modes.standard_errors[0]), "equilibrium_modulus": equilibrium_error(modes)}
    here = of_the_modes(model)
    return found | {name: float(np.hypot(found[name], there - here[name])) for name, there in of_the_model(own).items()}


def limit_sentences(name: str, modes: Estimate, model: Maxwell, own: Estimate | None) -> list[str]:
    """Return warnings about the moduli at frequency 0 and at infinite frequency. There is a warning for each modulus of
    the Prony modes that differs from the modulus of the model by more than `TOLD` standard errors of the fit."""
    here, alone = of_the_modes(model), limit_errors(modes, model, None)
    out = []
    for limit, there in of_the_model(own).items():
        if abs(here[limit] - there) > TOLD * alone[limit]:
            out.append(
                f"the {NAMES[limit]} of the {len(model.ratios)} Prony modes is {here[limit]:.4g} Pa, but the model "
                f"{name} has {there:.4g} Pa: the modes represent the model only over the measured band"
            )
    return out


def still_relaxing(
    storage: np.ndarray, noise: float, longest: float, remedy: str = "measure at lower frequencies"
) -> list[str]:
    """Return a warning if G' still decreases at the lowest frequencies. Then the material may relax more at lower
    frequencies.

    Args:
        storage: G' (3,) of the model [Pa] at the lowest frequency, half a decade above it and one decade above it.
        noise: relative noise of the data.
        longest: longest relaxation time [s] of the model.
        remedy: end of the warning, which says what the user can do.
    """
    fall, next_fall = np.diff(storage)
    if fall <= max(TOLD * noise * storage[0], SLOWING * next_fall):
        return []
    return [
        f"G' of the model falls by {100 * fall / storage[1]:.2g} % in the lowest half decade of frequency and by "
        f"{100 * next_fall / storage[2]:.2g} % in the next half decade. The equilibrium modulus is the modulus after "
        f"{longest:.3g} s, the longest relaxation time of the model. It is unknown how much of this modulus relaxes "
        f"later. The stated error does not contain this part: {remedy}"
    ]
