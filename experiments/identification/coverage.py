"""Coverage of 95 % intervals, and prediction of a decade of frequency that the fit does not contain (synthetic data).

1,000 synthetic sweeps contain typical errors of laboratories: noise of 2 %, an inertia correction that is 0.05 % wrong,
a gap that is wrong by 50 um (standard deviations), and a sample trimmed under a compression of 0 to 20 %. The true
materials are Prony modes, springpots, and a wide spectrum. For the intervals, all sweeps are fitted at once in NumPy,
with the residuals, the iteration and the criterion of the program. The models there are Prony modes, and a springpot in
parallel with a spring. Some sweeps are fitted by the program itself with all its models. The program also chooses the
models of the predictions.

    python -m experiments coverage [--quick]
    python -m experiments.identification.coverage program prediction    (runs only these parts again)
"""

import json
import sys
import time
from collections.abc import Callable
from typing import NamedTuple

import numpy as np
import scipy.special

from experiments.common import RESULTS, either, plt, save
from fitting.fits import viscoelastic
from fitting.fits.families import models
from fitting.fits.families.choice import contains, label_of
from fitting.fits.honesty.moduli_errors import fitted_moduli
from fitting.fits.viscoelastic import Fit, information_criterion
from fitting.methods import generalised_maxwell, host
from fitting.methods.generalised_maxwell import Maxwell
from fitting.methods.least_squares import GAIN, State, accept, begin
from fitting.readers.frequency_sweep import Sweep
from liverjax.core.plotting import BLUE, GREY, ORANGE

SWEEPS, STARTS, NOISE = either(1000, 40), 6, 0.02
#: Number of sweeps whose first decade is left out (the last decade is left out of all), and number of sweeps of each
#: kind that the program itself fits.
FIRST, OWN = either(300, 40), either(200, 2)
OMEGA = np.geomspace(0.1, 100, 31)
#: Frequencies [rad/s] at which the intervals of the fitted moduli are tested, and those of the last decade.
LOOKED_AT, LAST_DECADE = np.geomspace(0.1, 100, 7), OMEGA > 10 * (1 + 1e-9)
#: Plates [m], inertia of the instrument [N m s^2] and its error, error of the gap [m], largest compression.
RADIUS, HEIGHT, INERTIA, INERTIA_OFF, GAP_OFF, COMPRESSION = 0.010, 0.004, 22.5e-6, 5e-4, 50e-6, 0.2
DISTURBANCES = ("noise", "inertia", "gap", "compression")
TRUTHS = ("prony", "fractional", "spectrum")


class Truth(NamedTuple):
    """Parameters of the true material of every sweep.

    Prony modes and the wide spectrum are in `strengths` and `times`, a springpot is in `pot`.
    """

    kind: np.ndarray  # (S,) index of TRUTHS
    strengths: np.ndarray  # (S, K) [Pa]; the first is the equilibrium modulus
    times: np.ndarray  # (S, K - 1) [s]
    pot: np.ndarray  # (S, 2) springpot [Pa s^a] and its exponent; 0 for materials without a springpot

    def moduli(self, omega: np.ndarray) -> np.ndarray:
        """Return G* (S, n) [Pa]."""
        x = 1j * omega[:, None] * self.times[:, None, :]
        modes = self.strengths[:, :1] + np.sum(self.strengths[:, None, 1:] * x / (1 + x), axis=-1)
        return modes + self.pot[:, :1] * (1j * omega) ** self.pot[:, 1:]


def truths(rng: np.random.Generator, count: int) -> Truth:
    """Return tissue-like materials: about 300 Pa at rest, and some hundred Pa that relax."""
    kind = np.arange(count) % 3
    strengths, times, pot = np.zeros((count, 25)), np.ones((count, 24)), np.zeros((count, 2))
    strengths[:, 0] = rng.uniform(200, 600, count)
    modes = kind == 0
    n = modes.sum()
    strengths[modes, 1:3] = rng.uniform(100, 400, (n, 2))
    times[modes, :2] = 10 ** np.stack([rng.uniform(-0.5, 0.7, n), rng.uniform(-1.7, -0.9, n)], axis=1)
    pots = kind == 1
    pot[pots] = np.stack([rng.uniform(50, 300, pots.sum()), rng.uniform(0.2, 0.6, pots.sum())], axis=1)
    wide = kind == 2
    times[wide] = np.geomspace(1e3, 1e-4, 24)
    centre, width = rng.uniform(-2, 1, wide.sum()), rng.uniform(0.8, 2, wide.sum())
    bell = np.exp(-0.5 * ((np.log10(times[wide]) - centre[:, None]) / width[:, None]) ** 2)
    strengths[wide, 1:] = rng.uniform(300, 900, wide.sum())[:, None] * bell / bell.sum(axis=1, keepdims=True)
    return Truth(kind, strengths, times, pot)


def measured(rng: np.random.Generator, truth: Truth, disturbance: int) -> np.ndarray:
    """Return G' then G'' (S, 2n) with noise and with all disturbances up to number `disturbance`."""
    G, count = truth.moduli(OMEGA), len(truth.kind)
    noise = 1 + NOISE * rng.standard_normal((2, *G.shape))
    inertia, gap, squeezed = rng.standard_normal((count, 1)), rng.standard_normal((count, 1)), rng.random((count, 1))
    scale = np.ones((count, 1))
    if disturbance >= 2:
        scale = scale * (1 + GAP_OFF / HEIGHT * gap)
    if disturbance >= 3:  # trimmed to the plates under compression: torque over twist is lambda^2 mu (neo-Hookean)
        scale = scale * (1 - COMPRESSION * squeezed) ** 2
    storage = scale * G.real
    if disturbance >= 1:
        storage = storage + INERTIA_OFF * inertia * INERTIA * OMEGA**2 * 2 * HEIGHT / (np.pi * RADIUS**4)
    return np.concatenate([storage * noise[0], scale * G.imag * noise[1]], axis=1)


# -- models: Prony modes and springpots, in real arithmetic, so that complex steps can differentiate them --------------


def prony(u: np.ndarray, omega: np.ndarray) -> np.ndarray:
    """Return G' then G'' for the unknowns u (…, 2N + 1)."""
    return np.concatenate(generalised_maxwell.moduli(generalised_maxwell.natural(u), omega), axis=-1)


def kelvin_voigt(u: np.ndarray, omega: np.ndarray) -> np.ndarray:
    """Return G' then G'' of a spring in parallel with a springpot, for u = log E, log V, logit of the exponent."""
    alpha = 1 / (1 + np.exp(-u[..., 2:3]))
    power = np.exp(u[..., 1:2] + alpha * np.log(omega))
    angle = 0.5 * np.pi * alpha
    return np.concatenate([np.exp(u[..., :1]) + power * np.cos(angle), power * np.sin(angle)], axis=-1)


MODELS: dict[str, tuple[int, Callable]] = {f"prony {n}": (2 * n + 1, prony) for n in (1, 2, 3, 4)}
MODELS["fractional Kelvin-Voigt"] = (3, kelvin_voigt)


class Fits(NamedTuple):
    """Results of one model fitted to every sweep."""

    u: np.ndarray  # (S, P)
    jacobian: np.ndarray  # (S, m, P) derivatives of the relative residuals
    square: np.ndarray  # (S,) sum of squares
    converged: np.ndarray  # (S,)


def first_places(name: str, data: np.ndarray, omega: np.ndarray) -> np.ndarray:
    """Return starting points (S, STARTS, P).

    The first has relaxation times spread over the band, or the first of several exponents.
    """
    rng, half = np.random.default_rng(1), data.shape[1] // 2
    top, low = data[:, half - 1] * 1.05, data[:, 0] * 0.95
    if name.startswith("frac"):
        exponent = np.linspace(0.15, 0.7, STARTS)
        pot = data[:, half + half // 2, None] / np.sin(0.5 * np.pi * exponent)
        rest = np.repeat(np.log(0.9 * low)[:, None], STARTS, axis=1)
        return np.stack([rest, np.log(pot), np.tile(scipy.special.logit(exponent), (len(data), 1))], axis=-1)
    n, out = int(name[-1]), []
    ends = np.log(1 / omega[-1]), np.log(1 / omega[0])
    grids = [np.linspace(*ends, n + 2)[1:-1]] + [rng.uniform(*ends, n) for _ in range(STARTS - 1)]
    for grid in grids:
        times = np.exp(np.sort(grid)[::-1] + 0.1 * np.arange(n)[::-1])
        share = np.clip(1 - low / top, 0.1, 0.95) / n
        rows = [
            generalised_maxwell.unconstrained(Maxwell(t, np.full(n, s), times)) for t, s in zip(top, share, strict=True)
        ]
        out.append(np.stack(rows))
    return np.stack(out, axis=1)


def fitted(name: str, data: np.ndarray, omega: np.ndarray) -> Fits:
    """Fit all sweeps from all starting points at once by the program's Levenberg-Marquardt method.

    Returns the best minimum of each sweep.
    """
    size, model = MODELS[name]
    starts = first_places(name, data, omega).reshape(-1, size)
    scales = [np.concatenate(Sweep(omega, *np.split(row, 2)).deviations) for row in data]
    own = np.repeat(np.stack([data, np.stack(scales)], axis=1), STARTS, axis=0)

    def residuals(u: np.ndarray, rows: np.ndarray) -> np.ndarray:
        return (model(u, omega) - rows[:, :1]) / rows[:, 1:]

    going: np.ndarray = np.arange(len(starts))
    s = None
    with np.errstate(all="ignore"):
        while s is None or len(going):
            r, J = host.with_jacobian(residuals, starts if s is None else s.trial[going], own[going])
            if s is None:
                s = State(*(field.copy() for field in begin(starts, r.shape[-1])))
            new = accept(State(*(field[going] for field in s)), r, J, GAIN)
            for field, values in zip(s, new, strict=True):
                field[going] = values
            going = going[~new.converged & ~new.stuck & (new.iterations < 100)]
    cost = np.where(np.isfinite(s.r).all(axis=-1), np.sum(s.r**2, axis=-1), np.inf).reshape(-1, STARTS)
    best = np.arange(len(data)) * STARTS + cost.argmin(axis=1)
    return Fits(s.u[best], s.J[best], cost.min(axis=1), s.converged[best])


def intervals(name: str, fits: Fits, of: Callable, scale_error: float = 0.0) -> tuple[np.ndarray, np.ndarray]:
    """Return functions (S, K) of u and half the widths of their 95 % intervals, as the program reports them.

    The intervals use the delta method and Student's t. `scale_error` is the relative error of the gap if it is known
    (--gap-error). It changes every modulus by the same relative amount.
    """
    values, slope = host.with_jacobian(of, fits.u)
    m, size = fits.jacobian.shape[1:]
    scale = np.maximum(np.linalg.norm(fits.jacobian, axis=1), 1e-300)
    _, s, Vt = np.linalg.svd(np.nan_to_num(fits.jacobian / scale[:, None]), full_matrices=False)
    root = (slope / scale[:, None]) @ np.swapaxes(Vt, 1, 2) / np.maximum(s, 1e-14 * s[:, :1])[:, None]
    noise = np.sqrt(fits.square / (m - size))
    half = scipy.special.stdtrit(m - size, 0.975) * noise[:, None] * np.linalg.norm(root, axis=-1)
    return values, np.hypot(half, 1.96 * scale_error * np.abs(values))


def criterion(name: str, fits: Fits, count: int) -> np.ndarray:
    """Return the program's information criterion.

    A model with a parameter that the data do not determine is taken only if all models have one.
    """
    size, _ = MODELS[name]
    found = count * np.log(fits.square / count) + size * np.log(count)
    own = generalised_maxwell.natural if name.startswith("prony") else None
    vector = (lambda u: np.concatenate([own(u).ratios, own(u).relaxation_times], axis=-1)) if own else np.exp
    values, half = intervals(name, fits, vector)
    free = np.any(half > np.abs(values), axis=1)  # half the width is about two standard errors
    return found + np.where(free | ~fits.converged, 1e6, 0.0)


def ranked(data: np.ndarray, omega: np.ndarray) -> tuple[list[str], dict[str, Fits], np.ndarray]:
    """Return the names, the fits of each model, and the models in the order of the criterion (S, M)."""
    fits = {name: fitted(name, data, omega) for name in MODELS}
    table = np.stack([criterion(name, f, data.shape[1]) for name, f in fits.items()], axis=1)
    return list(MODELS), fits, np.argsort(table, axis=1)


def study(disturbance: int, truth: Truth, rng: np.random.Generator) -> dict:
    """Return the coverage of the moduli by the chosen model's intervals, and of the parameters if the chosen model is
    the true one.
    """
    data = measured(rng, truth, disturbance)
    names, fits, order = ranked(data, OMEGA)
    true = truth.moduli(LOOKED_AT)
    true = np.concatenate([true.real, true.imag], axis=1)
    inside, wider = np.zeros(true.shape, bool), np.zeros(true.shape, bool)
    for j, name in enumerate(names):
        mine = order[:, 0] == j
        model = MODELS[name][1]
        own = Fits(*(field[mine] for field in fits[name]))
        values, half = intervals(name, own, lambda u, model=model: model(u, LOOKED_AT))
        inside[mine] = np.abs(values - true[mine]) <= half
        half = intervals(name, own, lambda u, model=model: model(u, LOOKED_AT), GAP_OFF / HEIGHT)[1]
        wider[mine] = np.abs(values - true[mine]) <= half
    out = {"disturbance": DISTURBANCES[disturbance], "moduli": {}, "moduli_with_gap_error": {}, "chosen": {}}
    for k, kind in enumerate(TRUTHS):
        rows = truth.kind == k
        out["moduli"][kind] = float(inside[rows].mean())
        out["moduli_with_gap_error"][kind] = float(wider[rows].mean())
        out["chosen"][kind] = {n: int(np.sum(order[rows, 0] == j)) for j, n in enumerate(names)}
    out["parameters"] = parameters(truth, names, fits, order)
    return out


def parameters(truth: Truth, names: list[str], fits: dict[str, Fits], order: np.ndarray) -> dict[str, float]:
    """Return the coverage of G0, ratios and times (two modes), and of E, V and exponent (springpot), for chosen
    models.
    """

    def vector(u: np.ndarray) -> np.ndarray:
        found = generalised_maxwell.natural(u)
        return np.concatenate([found.shear_modulus[..., None], found.ratios, found.relaxation_times], axis=-1)

    out = {}
    rows = (truth.kind == 0) & (order[:, 0] == names.index("prony 2"))
    values, half = intervals("prony 2", Fits(*(f[rows] for f in fits["prony 2"])), vector)
    G0 = truth.strengths[rows, :3].sum(axis=1, keepdims=True)
    true = np.concatenate([G0, truth.strengths[rows, 1:3] / G0, truth.times[rows, :2]], axis=1)
    inside = np.abs(values - true) <= half
    out |= {"G0": inside[:, 0].mean(), "ratios": inside[:, 1:3].mean(), "times": inside[:, 3:].mean()}
    name = "fractional Kelvin-Voigt"
    rows = (truth.kind == 1) & (order[:, 0] == names.index(name))
    fractional = Fits(*(f[rows] for f in fits[name]))
    values, half = intervals(
        name, fractional, lambda u: np.concatenate([np.exp(u[..., :2]), 1 / (1 + np.exp(-u[..., 2:]))], axis=-1)
    )
    true = np.concatenate([truth.strengths[rows, :1], truth.pot[rows]], axis=1)
    inside = np.abs(values - true) <= half
    out |= {"equilibrium": inside[:, 0].mean(), "springpot": inside[:, 1].mean(), "exponent": inside[:, 2].mean()}
    return {key: float(value) for key, value in out.items()}


def by_the_program(truth: Truth) -> dict:
    """Return the coverage of the moduli by the program's choices, for sweeps with noise alone.

    There are four choices: N modes; a spectrum; the best of all models with its own errors; and the best of all models
    with the errors of the choice included, as reported.
    """
    data, out = measured(np.random.default_rng(10), truth, 0), {}
    for k, kind in enumerate(TRUTHS):
        inside: dict[str, list] = {"prony": [], "spectrum": [], "auto_alone": [], "auto": []}
        chosen: dict[str, int] = {}
        for row in np.flatnonzero(truth.kind == k)[:OWN]:
            sweep = Sweep(OMEGA, *np.split(data[row], 2))
            true = Truth(*(field[row : row + 1] for field in truth)).moduli(LOOKED_AT)[0]
            dense = generalised_maxwell.spectrum(sweep)
            prony = viscoelastic.choose_modes(sweep, dense)[0]
            tried = models.every_model(sweep, "auto", prony, dense)
            best, able = models.best_of_models(tried, sweep)
            several = best._replace(rivals=tuple(fit for fit in able if fit is not best))
            chosen[best.kind.name] = chosen.get(best.kind.name, 0) + 1
            wide = next(fit for fit in tried if fit.kind.name == "spectrum")
            for name, fit in (("prony", prony), ("spectrum", wide), ("auto_alone", best), ("auto", several)):
                found = fitted_moduli(fit, LOOKED_AT, sweep.noise_given)
                off = np.abs(found.values - np.concatenate([true.real, true.imag]))
                inside[name].append(off <= found.quantile * found.standard_errors)
        out[kind] = {name: float(np.mean(rows)) for name, rows in inside.items()} | {"chosen": chosen}
        print(kind, out[kind], flush=True)
    return {"sweeps": OWN, "moduli": out}


def beyond(fit: Fit, omega: np.ndarray) -> np.ndarray:
    """Return G* (n,) [Pa] of a fit at frequencies outside its band, from its own model."""
    if fit.kind.moduli is not None:
        storage, loss = fit.kind.moduli(fit.solution.u, omega)
    else:
        storage, loss = generalised_maxwell.moduli(fit.model, omega)
    return storage + 1j * loss


class Predicted(NamedTuple):
    """Errors of models that are fitted to two decades, in the third decade.

    An error is the root mean square of ln(G' / true) and ln(G'' / true).
    """

    chosen: float
    second: float  # the second-best model by the criterion
    rival: float  # the best model that does not contain the chosen one as a special case
    decided: bool  # the criterion is very strong evidence against the rival
    best: float  # the smallest error of all models


def predicted(truth: Truth, data: np.ndarray, k: int, kept: np.ndarray) -> Predicted:
    """Let the program choose a model (`--model auto`) for sweep k, from the frequencies that are `kept`."""
    sweep, out = Sweep(OMEGA[kept], *(half[kept] for half in np.split(data[k], 2))), OMEGA[~kept]
    true = Truth(*(field[k : k + 1] for field in truth)).moduli(out)[0]
    dense = generalised_maxwell.spectrum(sweep)
    tried = models.every_model(sweep, "auto", viscoelastic.choose_modes(sweep, dense)[0], dense)
    chosen, able = models.best_of_models(tried, sweep)

    def off(fit: Fit) -> float:
        G = beyond(fit, out)
        with np.errstate(all="ignore"):
            apart = np.sqrt(np.mean(np.log(np.concatenate([G.real / true.real, G.imag / true.imag])) ** 2))
        return float(apart) if np.isfinite(apart) else np.inf

    others = sorted((f for f in able if f is not chosen), key=information_criterion)
    different = [f for f in others if not contains(label_of(f), label_of(chosen))]
    decided = not different or information_criterion(different[0]) > information_criterion(chosen) + models.STRONG
    second, rival = (off(rest[0]) if rest else np.inf for rest in (others, different))
    return Predicted(off(chosen), second, rival, decided, min(map(off, able)))


def prediction(truth: Truth, rng: np.random.Generator) -> dict:
    """Compare predictions of the last or first decade by the model chosen on the other two, and by the next model."""
    data, out = measured(rng, truth, 0), {}
    for name, left_out, count in (("last", LAST_DECADE, len(data)), ("first", OMEGA < 1 - 1e-9, FIRST)):
        rows, kinds = [], truth.kind[:count]
        for k in range(count):
            rows.append(predicted(truth, data, k, ~left_out))
            if k % 100 == 99:
                print(f"{name} decade: {k + 1} sweeps", flush=True)
        chosen, second, rival, decided, best = (np.array(column) for column in zip(*rows, strict=True))
        better = chosen <= rival
        out[name] = {
            "sweeps": count,
            "better": float(np.mean(better)),
            "better_by_truth": {kind: float(np.mean(better[kinds == k])) for k, kind in enumerate(TRUTHS)},
            "better_than_any_second": float(np.mean(chosen <= second)),
            "decided": float(np.mean(decided)),
            "better_where_decided": float(np.mean(better[decided])),
            "median_error": {kind: float(np.median(chosen[kinds == k])) for k, kind in enumerate(TRUTHS)},
            "median_error_of_the_closest": {kind: float(np.median(best[kinds == k])) for k, kind in enumerate(TRUTHS)},
        }
    return out


def figure(rows: list[dict]) -> plt.Figure:
    """Plot the coverage for each disturbance."""
    fig, axes = plt.subplots(1, 2, figsize=(9, 3.6), layout="constrained", sharey=True)
    x = np.arange(len(rows))
    for kind, colour in zip(TRUTHS, (BLUE, ORANGE, GREY), strict=True):
        axes[0].plot(x, [100 * r["moduli"][kind] for r in rows], "o-", color=colour, label=f"moduli, {kind}")
        wider = [100 * r["moduli_with_gap_error"][kind] for r in rows[2:]]
        axes[0].plot(x[2:], wider, "o--", color=colour, mfc="none", label=f"{kind}, --gap-error")
    for name, marker in zip(rows[0]["parameters"], "osDv^x", strict=True):
        axes[1].plot(x, [100 * r["parameters"][name] for r in rows], f"{marker}-", ms=4, label=name)
    for panel in axes:
        panel.axhspan(93, 97, color=GREY, alpha=0.2, lw=0)
        panel.set(xticks=x, xticklabels=[r["disturbance"] for r in rows], ylim=(0, 100))
        panel.legend(fontsize=7)
    axes[0].set(ylabel="of 95 % intervals that cover [%]")
    return fig


def intervals_of(truth: Truth) -> list[dict]:
    """Return one row for each disturbance."""
    rows = []
    for k in range(len(DISTURBANCES)):
        rows.append(study(k, truth, np.random.default_rng(10 + k)))
        print(rows[-1], flush=True)
    return rows


PARTS: dict[str, Callable[[Truth], object]] = {
    "rows": intervals_of,
    "program": by_the_program,
    "prediction": lambda truth: prediction(truth, np.random.default_rng(20)),
}


def main(parts: list[str] | None = None) -> None:
    """Run all parts, or some parts and keep the results of the others."""
    truth = truths(np.random.default_rng(0), SWEEPS)
    content = json.loads((RESULTS / "coverage.json").read_text()) if parts else {"sweeps": SWEEPS, "noise": NOISE}
    seconds = content.setdefault("seconds_of_parts", {})
    for name in parts or PARTS:
        begin_at = time.perf_counter()
        content[name] = PARTS[name](truth)
        seconds[name] = time.perf_counter() - begin_at
    content["seconds"] = sum(seconds.values())
    save("coverage", content, figure(content["rows"]))


if __name__ == "__main__":
    main([a for a in sys.argv[1:] if not a.startswith("-")])
