"""From a rheometer's noise to an organ: uncertainty of the sagging of a liver, and contribution of each parameter.

The sweep of porcine liver that follows from the chapter's model, with 5 % of synthetic noise (fixed seed), is fitted.
The posterior of its five Prony parameters is taken as normal, with the covariance of the fit. Draws from this posterior
are run on the liver phantom under a fifth of gravity. Sobol indices (scipy, Saltelli 2010) are those of parameters
drawn independently from their intervals. With the correlation of the posterior, no part of the variance belongs to one
parameter alone. ``python -m experiments propagate_posterior`` (8 minutes).
"""

import time
from collections.abc import Callable

import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np
import scipy.stats
from tqdm import tqdm

import liverjax as lj
from experiments.common import either, save
from experiments.liver import models, with_solve
from fitting.fits.viscoelastic import closed_form
from fitting.readers.rheometer import read_sweep
from liverjax.core import status

SWEEP = "data/porcine_liver_frequency_sweep.csv"
NOISE, SEED, DRAWS, SOBOL, SECONDS, DT, LANES = 0.05, 3, either(256, 16), either(64, 4), 1.0, 0.05, either(32, 4)
NAMES = ("G0", "g1", "g2", "tau1", "tau2")
LABELS = {"G0": "$G_0$", "g1": "$g_1$", "g2": "$g_2$", "tau1": r"$\tau_1$", "tau2": r"$\tau_2$"}


def posterior() -> tuple[np.ndarray, np.ndarray]:
    """Return the mean (5,) and covariance (5, 5) of the parameters in the order of NAMES."""
    sweep, rng = read_sweep(SWEEP), np.random.default_rng(SEED)
    noisy = sweep._replace(
        storage=sweep.storage * (1 + NOISE * rng.standard_normal(len(sweep.storage))),
        loss=sweep.loss * (1 + NOISE * rng.standard_normal(len(sweep.loss))),
        storage_sd=NOISE * sweep.storage,
        loss_sd=NOISE * sweep.loss,
    )
    fit = closed_form(noisy, 2)
    return fit.uncertainty.values, fit.uncertainty.covariance


def possible(draws: np.ndarray) -> np.ndarray:
    """Return which draws (n, 5) are admissible materials."""
    return (draws > 0).all(axis=1) & (draws[:, 1] + draws[:, 2] < 1)


def liver() -> tuple[Callable[[np.ndarray], np.ndarray], int, np.ndarray]:
    """Return a function for the displacements (n, steps) [m] of the tip for parameters (n, 5), the node at the tip, and
    times.
    """
    scene = with_solve(models()["viscous"], SECONDS, DT)
    stiffer = float(scene.law.shear_modulus() / scene.law.mu)  # ground-state shear modulus G0, divided by mu
    tip = int(np.argmax(np.linalg.norm(lj.simulate(scene).check().positions[-1] - scene.mesh.points, axis=1)))

    @jax.jit
    def program(rows):
        values = {
            "law.mu": rows[:, 0] / stiffer,
            "viscosity.ratios": rows[:, 1:3],
            "viscosity.relaxation_times": rows[:, 3:5],
        }
        result = lj.simulate_batch(scene, values).result
        moved = jnp.linalg.norm(result.positions[:, :, tip] - scene.mesh.points[tip][None, None], axis=-1)
        return moved, jnp.all(result.status == status.CONVERGED, axis=1)

    def run(rows: np.ndarray) -> np.ndarray:
        filled, moved = np.concatenate([rows, np.repeat(rows[-1:], -len(rows) % LANES, axis=0)]), []
        for k in tqdm(range(0, len(filled), LANES), unit=f" x {LANES} runs", leave=False, disable=None):
            found, good = program(filled[k : k + LANES])
            if not np.all(good):
                raise RuntimeError("a run did not converge")
            moved.append(np.asarray(found))
        return np.concatenate(moved)[: len(rows)]

    return run, tip, np.arange(1, round(SECONDS / DT) + 1) * DT


def main() -> None:
    """Run all parts."""
    jax.config.update("jax_num_cpu_devices", 2)
    mean, covariance = posterior()
    rng = np.random.default_rng(SEED)
    drawn = rng.multivariate_normal(mean, covariance, 2 * DRAWS)
    draws = drawn[possible(drawn)][:DRAWS]
    run, tip, times = liver()
    run(draws[:1])  # compile before the times are measured
    begin = time.perf_counter()
    moved = run(draws)
    propagated = time.perf_counter() - begin
    spread = np.sqrt(np.diag(covariance))
    cut = [scipy.stats.truncnorm(max(-3.0, -0.99 * m / s), 3.0, m, s) for m, s in zip(mean, spread, strict=True)]
    begin = time.perf_counter()
    indices = scipy.stats.sobol_indices(func=lambda x: run(x.T).T, n=SOBOL, dists=cut, rng=rng)
    low, high = indices.bootstrap(n_resamples=200).total_order.confidence_interval
    content = {
        "noise": NOISE,
        "parameters": dict(zip(NAMES, mean.tolist(), strict=True)),
        "standard_errors": dict(zip(NAMES, spread.tolist(), strict=True)),
        "correlation": (covariance / np.outer(spread, spread)).tolist(),
        "draws": len(draws),
        "drawn_impossible": float(1 - possible(drawn).mean()),
        "tip_node": tip,
        "times_s": times.tolist(),
        "mean_m": moved.mean(axis=0).tolist(),
        "deviation_m": moved.std(axis=0, ddof=1).tolist(),
        "interval_m": np.quantile(moved, [0.025, 0.975], axis=0).tolist(),
        "error_of_mean_m": (moved.std(axis=0, ddof=1) / np.sqrt(len(draws))).tolist(),
        "seconds_propagation": propagated,
        "sobol_runs": SOBOL * (len(NAMES) + 2),
        "seconds_sobol": time.perf_counter() - begin,
        "first_order": dict(zip(NAMES, indices.first_order.T.tolist(), strict=True)),
        "total_order": dict(zip(NAMES, indices.total_order.T.tolist(), strict=True)),
        "total_order_interval": dict(zip(NAMES, np.stack([low, high], -1).transpose(1, 0, 2).tolist(), strict=True)),
    }
    save("propagate_posterior", content, _figure(content))


def _figure(content: dict) -> plt.Figure:
    figure, (left, right) = plt.subplots(1, 2, figsize=(8.6, 3.2), layout="constrained")
    t, mm = content["times_s"], 1e3
    low, high = mm * np.array(content["interval_m"])
    left.fill_between(t, low, high, alpha=0.3, label="95 % of the draws")
    left.plot(t, mm * np.array(content["mean_m"]), label="mean")
    left.set(xlabel="time [s]", ylabel="displacement of the tip [mm]", title="Posterior of the fit, through the liver")
    left.legend()
    for name, marker in zip(NAMES, "osd^v", strict=True):
        right.plot(t, content["total_order"][name], marker=marker, markersize=3, label=LABELS[name])
        right.fill_between(t, *np.array(content["total_order_interval"][name]).T, alpha=0.15)
    right.set(xlabel="time [s]", ylabel="total Sobol index [1]", title="Which parameter the spread comes from")
    right.set_ylim(0, 1)
    right.legend(loc="center left", bbox_to_anchor=(1, 0.5))
    return figure


if __name__ == "__main__":
    main()
