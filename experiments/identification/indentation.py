"""Indentation of a bonded layer: errors of the half-space and of a published series, and accuracy of fits.

The force of a sphere on a layer comes from the integral equation of the contact (`fitting.rigs.thin_layer`). A fit that
assumes a half-space (Hertz) gives a modulus that is too high by the factor shown. The series of Dimitriadis et al. 2002
(Biophys. J. 82:2798, equation 12, for an incompressible layer) is valid for small contacts only. Then curves with 5 %
of noise are fitted for modulus and contact point. Results are median errors, coverage of the 95 % intervals, and
seconds per curve.

``python -m experiments indentation`` (a minute) writes results/indentation.json.
"""

import time

import numpy as np

from experiments.common import either, plt, save
from fitting.methods.contact_point import fit_with_offset
from fitting.rigs.thin_layer import Indenter, Layer, dimitriadis
from liverjax.core.plotting import COLOURS

RADIUS, MODULUS, DEEPEST = 5e-3, 2400.0, 5e-4
#: Thickness divided by the contact radius of the half-space, sqrt(R d).
THICKNESSES = (0.5, 1.0, 2.0, 4.0, 10.0)
POISSONS = (0.3, 0.4, 0.5)
CURVES, NOISE = either(1000, 100), 0.05


def hertz(depth: np.ndarray, poisson: float) -> np.ndarray:
    """Return the force per unit modulus [N/Pa] of a half-space."""
    return 4 / 3 / (1 - poisson**2) * np.sqrt(RADIUS) * depth**1.5


def thin_layers() -> list[dict]:
    """Return the modulus of a half-space over the true one at the deepest point, and the error of the series."""
    rows = []
    for poisson in POISSONS:
        for ratio in THICKNESSES:
            h = ratio * np.sqrt(RADIUS * DEEPEST)
            force = Layer(Indenter("sphere", h, poisson, RADIUS)).force(np.array([DEEPEST]))[0]
            factor = float(force / hertz(np.array([DEEPEST]), poisson)[0])
            rows.append({"poisson": poisson, "thickness": ratio, "hertz": factor})
            if poisson == 0.5:
                rows[-1]["series_error"] = float(dimitriadis(np.array([1 / ratio]))[0] / factor - 1)
            print(rows[-1], flush=True)
    return rows


def fits() -> list[dict]:
    """Fit modulus and contact point to noisy curves of three layers."""
    start, rows = 1e-4, []
    depth = np.linspace(0.0, DEEPEST + start, 80)
    for ratio in (1.0, 2.0, 10.0):
        h, rng = ratio * np.sqrt(RADIUS * DEEPEST), np.random.default_rng(0)
        layer = Layer(Indenter("sphere", h, 0.5, RADIUS))
        force = MODULUS * layer.force(depth - start)
        begin, found = time.perf_counter(), []
        for _ in range(CURVES):
            found.append(fit_with_offset(depth, force + NOISE * force.max() * rng.normal(size=len(depth)), layer.force))
        seconds = (time.perf_counter() - begin) / CURVES
        row = {"thickness": ratio, "curves": CURVES, "seconds": seconds}
        for k, (name, true) in enumerate((("modulus", MODULUS), ("contact_point", start))):
            values = np.array([getattr(f, name) for f in found])
            errors = np.array([f.standard_errors[k] for f in found])
            row[f"{name}_off"] = float(np.median(np.abs(values - true)) / (true if k == 0 else DEEPEST))
            row[f"{name}_covered"] = float(np.mean(np.abs(values - true) < found[0].quantile * errors))
        rows.append(row)
        print(row, flush=True)
    return rows


def main() -> None:
    """Compute both tables and plot the factors."""
    layers, noisy = thin_layers(), fits()
    figure, axes = plt.subplots(figsize=(5, 3.2), layout="constrained")
    for poisson, colour in zip(POISSONS, COLOURS, strict=False):
        own = [r for r in layers if r["poisson"] == poisson]
        axes.loglog([r["thickness"] for r in own], [r["hertz"] for r in own], "o-", color=colour, label=f"{poisson:g}")
    axes.set_xlabel("thickness of the layer over the contact radius")
    axes.set_ylabel("modulus by Hertz over the true one")
    axes.legend(title="Poisson's ratio")
    save("indentation", {"layers": layers, "fits": noisy, "noise": NOISE}, figure)


if __name__ == "__main__":
    main()
