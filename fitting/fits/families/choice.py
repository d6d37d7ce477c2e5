"""The choice between models of several families by their information criteria.

If one model contains another, the general one is at least as close to any data. It is chosen only if the criterion is
strong evidence for it (Kass and Raftery 1995, J. Am. Stat. Assoc. 90): a general model that the data do not need
predicts worse outside their band.
"""

from collections.abc import Sequence
from typing import NamedTuple, Protocol

from fitting.fits.viscoelastic import FLUID, Kind

#: Models that a model becomes for some values of its numbers. `contains` adds three cases: a spectrum can become
#: any model, `prony` a fluid with at most as many modes, and a Zener model with the exponent 1 a single mode.
SPECIAL_CASES = {
    "fractional_kelvin_voigt": ("springpot",),
    "fractional_maxwell": ("springpot",),
    "fractional_parallel": ("springpot", "fractional_kelvin_voigt"),
    "fractional_zener": ("springpot", "fractional_kelvin_voigt"),
}
#: A model must be better than its special case by this difference of the criterion: strong evidence.
GENERAL = 6.0


class Label(NamedTuple):
    """The name of a model, and its number of modes if it is made of modes (else 0)."""

    name: str
    modes: int = 0


def contains(general: Label, special: Label) -> bool:
    """Whether the first model becomes the second for some of its numbers."""
    if general.name == special.name:
        return False
    if general.name == "spectrum" or special.name in SPECIAL_CASES.get(general.name, ()):
        return True
    if general.name == "prony":
        return special.name == FLUID.name and special.modes <= general.modes
    return general.name == "fractional_zener" and special == Label("prony", 1)


def preferred(labels: Sequence[Label], criteria: Sequence[float]) -> int:
    """Index of the model with the lowest criterion among those better than their special cases by `GENERAL`."""
    beaten = {
        j
        for j, general in enumerate(labels)
        for k, special in enumerate(labels)
        if contains(general, special) and criteria[j] > criteria[k] - GENERAL
    }
    left = [k for k in range(len(labels)) if k not in beaten] or list(range(len(labels)))
    return min(left, key=lambda k: criteria[k])


class OfAKind(Protocol):
    """Attributes that a fit of any data has."""

    @property
    def kind(self) -> Kind:
        """The meaning of its numbers."""

    @property
    def modes(self) -> int:
        """Number of Prony modes."""


def label_of(fit: OfAKind) -> Label:
    """The label of a fit; only Prony modes have a number of modes."""
    return Label(fit.kind.name, fit.modes if fit.kind.values is None else 0)
