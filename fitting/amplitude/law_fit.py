"""Fit hyperelastic laws to the first harmonic of strain sweeps, by least squares from many starting points."""

import json
import time
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from fitting.amplitude import cycle
from fitting.amplitude.strain_sweep import StrainSweep
from fitting.fits.families.compared_laws import tied_laws
from fitting.fits.families.hyperelastic import Candidate
from fitting.fits.stress_stretch import STARTS, LawFit, assessed
from fitting.methods.generalised_maxwell import Maxwell, moduli
from fitting.methods.least_squares import levenberg_marquardt
from fitting.readers.curves import Curve
from fitting.readers.frequency_sweep import smooth_curve
from liverjax.core.errors import InputError
from liverjax.laws import Law

#: The program compares the measured loss tangent with the loss tangent of the law. If their ratio changes by more than
#: this fraction over the sweep, the program warns that the relaxation depends on the strain.
CHANGED = 0.2
#: At each end of the sweep, the program uses the median loss tangent of at most this number of points, because a single
#: point may be wrong.
_AT_ENDS = 3


class Memory(NamedTuple):
    """Modulus ratio m = G*(n omega)/G0 for each harmonic n of the angular frequency omega (see `cycle`). m is computed
    from the Prony series `series`. If `series` is None, m is 1 + i (loss tangent) for every n > 0, with one loss
    tangent for all n.
    """

    series: Maxwell | None = None

    def of(self, omega: float) -> np.ndarray:
        """Return the modulus ratios m (1, N) of the series for N harmonics n = 0, 1, … of the angular frequency `omega`
        [rad/s]. If there is no series, return an array (2, N). Then m is the first row plus the loss tangent times the
        second row."""
        n = np.arange(cycle.INSTANTS // 2 + 1)
        if self.series is None:
            return np.array([np.ones(len(n)), np.where(n == 0, 0, 1j)])
        storage, loss = moduli(self.series, omega * n)
        return np.asarray(storage + 1j * loss)[None] / self.series.shear_modulus


class StrainFit(NamedTuple):
    """A fitted law, and the moduli that this law predicts at the n strain amplitudes of the sweep."""

    law: LawFit
    storage: np.ndarray  # (n,) [Pa]
    loss: np.ndarray  # (n,) [Pa]
    third: np.ndarray  # (n,) ratio of two amplitudes of the torque: third / first harmonic


def memory_from(path: Path) -> Memory:
    """Read the Prony series from the fit.json of a fitted frequency sweep.

    Raises:
        InputError: the file does not exist, or it has no series.
    """
    try:
        held = json.loads(path.read_text())
        model = Maxwell(
            float(held["shear_modulus"]), np.asarray(held["ratios"], float), np.asarray(held["relaxation_times"], float)
        )
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise InputError(
            f"{path} is not the fit.json of a frequency sweep ({type(error).__name__}): fit a frequency sweep first"
        ) from None
    return Memory(model)


#: A series covers the angular frequency omega if two conditions are fulfilled: omega times the longest relaxation time
#: is at least the first value, and omega times the shortest relaxation time is at most the second value.
KNOWN = (0.5, 2.0)


def outside_series(memory: Memory, omega: float) -> str | None:
    """Return a warning if the relaxation times of the series do not cover the angular frequency omega [rad/s];
    otherwise return None."""
    if memory.series is None:
        return None
    times = np.asarray(memory.series.relaxation_times)
    low, high = KNOWN
    side, part = ("above", "faster") if omega * times.min() > high else ("below", "slower")
    if side == "below" and omega * times.max() >= low:
        return None
    hertz = [f"{1 / (2 * np.pi * t):.3g}" for t in (times.max(), times.min())]
    return (
        f"the frequency of the strain sweep, {omega / 2 / np.pi:.3g} Hz, is {side} the frequencies that the series of "
        f"--model covers ({hertz[0]} to {hertz[1]} Hz). This series has no {part} relaxation, so all moduli of the law "
        "are wrong: give the fit.json of a frequency sweep that contains this frequency"
    )


def fit_law(candidate: Candidate, sweep: StrainSweep, memory: Memory, plates: str) -> StrainFit:
    """Minimise the sum of the squared relative residuals of G* at all amplitudes, from many starting points. Return the
    fit with the smallest sum.

    If `memory` has no Prony series, the loss tangent is an additional parameter of the fit. The fitted modulus is then
    valid only at the frequency of the sweep.

    `plates`: see `cycle.reading`.
    """
    own = candidate if memory.series is not None else with_loss_tangent(candidate)
    memories = memory.of(sweep.angular_frequency)
    r = cycle.reading(sweep.strain, memories, plates)
    measured = sweep.storage + 1j * sweep.loss
    scale = float(np.abs(measured[0]) / np.abs(memories[0, 1]))
    # Residuals are divided by a smooth curve. If they were divided by the measured moduli, points that are low by
    # chance would have the largest weight.
    sizes = smooth_curve(sweep.strain, np.abs(measured)) * np.exp(1j * np.angle(measured))

    def model(u: jax.Array) -> tuple[jax.Array, jax.Array]:
        values = own.values(u, scale)
        shares = jnp.ones(1) if memory.series is not None else jnp.stack([jnp.ones(()), values[-1]])
        return cycle.first_and_third(own.law(values), r, shares)

    def residuals(u: jax.Array) -> jax.Array:
        part = (model(u)[0] - measured) / sizes
        return jnp.concatenate([part.real, part.imag])

    begin = time.perf_counter()
    points = jnp.asarray(own.random(np.random.default_rng(0), STARTS))
    program = jax.jit(jax.vmap(lambda u: levenberg_marquardt(residuals, u))).lower(points).compile()
    compiled = time.perf_counter()
    found = jax.block_until_ready(program(points))
    times = (time.perf_counter() - compiled, compiled - begin)
    # `of_tests` is False, because G' and G'' belong to one sweep, and their residuals are already relative.
    law = assessed(own, _as_curves(sweep), found, scale, times, of_tests=False)
    best = found.u[int(np.nanargmin(np.where(np.isfinite(found.cost), found.cost, np.inf)))]
    G, third = (np.asarray(v) for v in model(best))
    # The residuals above describe magnitude and phase. Here the errors of G' and G'' are computed.
    off = {"G'": G.real / sweep.storage - 1, "G''": G.imag / sweep.loss - 1}
    law = law._replace(curve_errors={name: float(np.sqrt(np.mean(v**2))) for name, v in off.items()})
    return StrainFit(law, G.real, G.imag, third)


def with_loss_tangent(candidate: Candidate) -> Candidate:
    """Return the candidate law with the loss tangent as an additional parameter."""

    def values(u: jax.Array, scale: object) -> jax.Array:
        return jnp.concatenate([candidate.values(u[:-1], scale), u[-1:]])

    def law(p: jax.Array) -> Law:
        return candidate.law(p[:-1])

    def random(rng: np.random.Generator, n: int) -> np.ndarray:
        return np.column_stack([candidate.random(rng, n), rng.uniform(0.05, 0.5, n)])

    names, units, fields = (*candidate.names, "loss_tangent"), (*candidate.units, "1"), (*candidate.fields, {})
    return candidate._replace(names=names, units=units, fields=fields, values=values, law=law, random=random)


def _as_curves(sweep: StrainSweep) -> list[Curve]:
    """Return the storage modulus and the loss modulus as two curves over the amount of shear at the rim. `assessed`
    needs these curves."""
    F = np.tile(np.eye(3), (len(sweep.strain), 1, 1))
    F[:, 0, 1] = sweep.strain
    return [Curve(name, "simple_shear", F, (0, 1), G) for name, G in (("G'", sweep.storage), ("G''", sweep.loss))]


def _change_of_loss_tangent(of: StrainSweep | StrainFit) -> float:
    """Return the loss tangent at the largest strains, divided by the loss tangent at the smallest strains."""
    tangent, n = of.loss / of.storage, min(_AT_ENDS, len(of.loss) // 2)
    return float(np.median(tangent[-n:]) / np.median(tangent[:n]))


def said_of(sweep: StrainSweep, fits: Sequence[StrainFit]) -> list[str]:
    """Return warnings about the fits of a strain sweep. The best fit must be the first in `fits`."""
    best = fits[0]
    told = list(best.law.warnings)
    change, of_law = (_change_of_loss_tangent(own) for own in (sweep, best))
    names = [name for name in best.law.names if name != "loss_tangent"]
    shape = [n for n, unit in zip(best.law.names, best.law.units, strict=True) if unit == "1" and n in names]
    shape = shape or names[1:]  # if all parameters are moduli: all parameters except the first
    if "loss_tangent" in best.law.names and shape:
        told.append(
            "without --model, the constant part of the stress is also computed with the modulus at the frequency of "
            f"the test. {' and '.join(shape)} may be wrong by 5 to 20 %, and the standard errors do not contain this "
            "error: give --model with the fit.json of a frequency sweep"
        )
    if abs(change / of_law - 1) > CHANGED:
        told.append(
            f"the loss tangent changes by {100 * change - 100:+.0f} % over the sweep, but that of the law by "
            f"{100 * of_law - 100:+.0f} %: the relaxation depends on the strain. Fit only the strains before this "
            "change (--max-strain)"
        )
    ratio = (best.storage + 1j * best.loss) / (sweep.storage + 1j * sweep.loss)
    if np.sqrt(np.mean(np.abs(ratio - 1) ** 2)) > 0.05:
        # Below a strain of 1, every law has nearly the phase of the series.
        of_phase = np.mean(np.angle(ratio) ** 2) > np.mean(np.log(np.abs(ratio)) ** 2)
        told.append(
            "the law does not describe this sweep, because it misses the moduli by more than 5 % on average: "
            + (
                "most of this error is in the phase, which follows from the series of --model. Give the fit.json of a "
                "frequency sweep of the same sample"
                if of_phase and "loss_tangent" not in best.law.names
                else "try another law"
            )
        )
    if sweep.storage[-1] < 0.8 * sweep.storage[0]:
        told.append(
            "the storage modulus decreases with strain. This also happens if the tissue slips, yields or tears. In "
            "that case, a hyperelastic law describes the curve, but not the cause of the decrease"
        )
    return [*told, *tied_laws([f.law for f in fits], "sweep")]
