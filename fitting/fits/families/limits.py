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
#: Falls of G' in the first half decade of the band, over that in the next, above which much may relax after the test:
#: one relaxation time well inside the band has 0.1, a modulus that falls by the same amount in each half decade has 1.
SLOWING = 0.5
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


def still_relaxing(storage: np.ndarray, noise: float, longest: float) -> list[str]:
    """A sentence if G' still falls where the band begins, so that more may relax after the test.

    Args:
        storage: G' (3,) of the model at the lowest frequency and half a decade and a decade above it [Pa].
        noise: relative noise of the data.
        longest: longest relaxation time [s] of the model.
    """
    fall, next_fall = np.diff(storage)
    if fall <= max(TOLD * noise * storage[0], SLOWING * next_fall):
        return []
    return [
        f"G' falls by {100 * fall / storage[1]:.2g} % in the lowest half decade and by "
        f"{100 * next_fall / storage[2]:.2g} % in the next: the equilibrium modulus is what is left after "
        f"{longest:.3g} s, the longest time of the model; nothing tells how much of it relaxes later, and its error "
        "does not contain that; measure at lower frequencies"
    ]
