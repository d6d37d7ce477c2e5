"""Draw figures of laws: stress-stretch curves, and the gradient check."""

from pathlib import Path

import jax
import numpy as np

from liverjax.core.plotting import BLUE, COLOURS, GREY, ORANGE, pyplot, save
from liverjax.laws import Law, homogeneous
from liverjax.laws.gradient_check import Check


def _stress_of_curve(law: Law, test: str, driven: np.ndarray) -> np.ndarray:
    return np.asarray(jax.jit(lambda v: homogeneous.response(law, test, v))(driven)) / 1000


def curves(named: dict[str, Law], file: Path, stretches: tuple[float, float] = (0.6, 1.6)) -> None:
    """Draw the nominal stress of incompressible samples in four tests, with one line per law, and write it to `file`.

    Args:
        named: label -> law.
        file: picture to write.
        stretches: range of stretches. The amount of shear goes from 0 to the upper end of this range minus 1.
    """
    figure, axes = pyplot().subplots(1, 4, figsize=(13, 3.4), layout="constrained")
    for axis, (test, what) in zip(axes, homogeneous.TESTS.items(), strict=True):
        driven = np.linspace(0.0, stretches[1] - 1, 101) if what == "shear" else np.linspace(*stretches, 201)
        ends = []
        for k, (name, law) in enumerate(named.items()):
            stress = _stress_of_curve(law, test, driven)
            style = ("-", "--", ":")[k // len(COLOURS) % 3]
            axis.plot(driven, stress, style, color=COLOURS[k % len(COLOURS)], label=name)
            ends.append((np.nanmin(stress), np.nanmax(stress)))
        low, high = 3 * np.nanmedian(ends, axis=0)  # without these limits, very large stresses would hide other curves
        if low < high:  # this condition is false for NaN
            axis.set_ylim(max(low, axis.get_ylim()[0]), min(high, axis.get_ylim()[1]))
        axis.set(title=test.replace("_", " "), xlabel="amount of shear" if what == "shear" else "stretch")
        axis.grid(alpha=0.3)
        axis.axhline(0, color=GREY, lw=0.5)
    axes[0].set_ylabel("nominal stress (kPa)")
    if len(named) > 4:
        figure.legend(*axes[0].get_legend_handles_labels(), loc="outside right center", fontsize=8)
    else:
        axes[0].legend(fontsize=8)
    save(figure, file)


def gradient_check(result: Check, name: str, file: Path) -> None:
    """Draw the errors of difference quotients as a function of the step, and the stress in stable ranges near rest."""
    figure, (left, right) = pyplot().subplots(1, 2, figsize=(10, 3.8), layout="constrained")
    for (label, errors), colour in zip(result.difference_errors.items(), (BLUE, ORANGE), strict=True):
        left.loglog(result.steps, errors, "o-", ms=3, color=colour, label=label)
    left.set(xlabel="step of the difference quotient", ylabel="relative error", title=f"{name}: derivatives")
    left.grid(alpha=0.3)
    left.legend(fontsize=8)
    for (test, (low, high)), colour in zip(result.stable.items(), COLOURS, strict=False):
        rest = 0.0 if homogeneous.TESTS[test] == "shear" else 1.0
        driven = np.linspace(max(low, rest - 0.3), min(high, rest + 0.6), 200)
        label = f"{test.replace('_', ' ')}, stable {low:.3g} to {high:.3g}"
        right.plot(driven - rest, _stress_of_curve(result.law, test, driven), color=colour, label=label)
    right.set(
        xlabel="stretch - 1, amount of shear", ylabel="nominal stress (kPa)", title="incompressible, stable range"
    )
    right.grid(alpha=0.3)
    right.legend(fontsize=8)
    save(figure, file)
