"""The choice between models of several families by their information criteria.

A general model may contain a special case: for some values of its parameters, the general model equals the special
case. The general model then fits the data at least as closely as the special case. It is chosen only if the criterion
is strong evidence for it (Kass and Raftery 1995, J. Am. Stat. Assoc. 90). If the data do not need the general model, it
predicts less well outside the measured band than the special case.
"""

from collections.abc import Callable, Sequence
from typing import NamedTuple, Protocol, TypeVar

from fitting.fits.viscoelastic import FLUID, Kind

#: The special cases of each general model. For some values of its parameters, the general model equals the special
#: case. `contains` adds three cases. A spectrum contains every model. `prony` contains every fluid with at most as many
#: modes. A fractional Zener model with exponent 1 is a solid with a single Prony mode.
SPECIAL_CASES = {
    "fractional_kelvin_voigt": ("springpot",),
    "fractional_maxwell": ("springpot",),
    "fractional_parallel": ("springpot", "fractional_kelvin_voigt"),
    "fractional_zener": ("springpot", "fractional_kelvin_voigt"),
}
#: A general model is chosen only if its criterion is lower than the criterion of its special case by at least this
#: difference (strong evidence).
GENERAL = 6.0
#: A difference of the criterion above this value is very strong evidence (Kass and Raftery 1995).
STRONG = 10.0


class Label(NamedTuple):
    """The name of a model, and its number of Prony modes. The number is 0 for models that do not consist of Prony
    modes."""

    name: str
    modes: int = 0


def contains(general: Label, special: Label) -> bool:
    """Return whether the model `general` equals the model `special` for some values of its parameters."""
    if general.name == special.name:
        return False
    if general.name == "spectrum" or special.name in SPECIAL_CASES.get(general.name, ()):
        return True
    if general.name == "prony":
        return special.name == FLUID.name and special.modes <= general.modes
    return general.name == "fractional_zener" and special == Label("prony", 1)


def preferred(labels: Sequence[Label], criteria: Sequence[float]) -> int:
    """Return the index of the model with the lowest criterion. A model can be chosen only if its criterion is lower, by
    at least `GENERAL`, than the criterion of each of its special cases."""
    beaten = {
        j
        for j, general in enumerate(labels)
        for k, special in enumerate(labels)
        if contains(general, special) and criteria[j] > criteria[k] - GENERAL
    }
    left = [k for k in range(len(labels)) if k not in beaten] or list(range(len(labels)))
    return min(left, key=lambda k: criteria[k])


def undecided(second: str, chosen: str, apart: float) -> str:
    """Return the warning that the data do not decide between the model `chosen` and the model `second`. `apart`: the
    criterion of `second` minus the criterion of `chosen`."""
    return (
        f"{second} explains the data about as well as {chosen} (criterion {abs(apart):.2g} "
        f"{'higher' if apart >= 0 else 'lower'}; {STRONG:g} is very strong evidence). The data do not decide between "
        "these models, and their moduli may differ much outside the measured band"
    )


class OfAKind(Protocol):
    """Attributes that every fit has, for any kind of data."""

    @property
    def kind(self) -> Kind:
        """The model, with the meaning of its parameters."""

    @property
    def modes(self) -> int:
        """Number of Prony modes."""


AnyFit = TypeVar("AnyFit", bound=OfAKind)


def label_of(fit: OfAKind) -> Label:
    """Return the name of the fitted model, and its number of modes (0 if the model does not consist of Prony modes)."""
    return Label(fit.kind.name, fit.modes if fit.kind.values is None else 0)


def rival_kind(chosen: AnyFit, determined: Sequence[AnyFit], criterion: Callable[[AnyFit], float]) -> list[str]:
    """Return a warning if a solid is chosen and a fluid explains the data about as well, or if a fluid is chosen and a
    solid explains the data better.

    Args:
        chosen: the chosen fit.
        determined: fits whose parameters the data determine.
        criterion: function that returns the information criterion of a fit.
    """
    others = [fit for fit in determined if fit.kind.name != chosen.kind.name]
    if not others:
        return []
    other = min(others, key=criterion)
    apart, limit = criterion(other) - criterion(chosen), 0.0 if chosen.kind.name == FLUID.name else STRONG
    return [undecided(other.kind.name, chosen.kind.name, apart)] if apart < limit else []
